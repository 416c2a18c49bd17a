"""Ground truth by Blender's Cycles, a renderer that shares no code with Relit.

Blender's Python wheel `bpy` is GPL-3.0 and wants an older NumPy, so it is never imported here: a
process of its own (`cycles_worker.py`) renders, under the interpreter that RELIT_CYCLES_PYTHON
names, else under this one. Meshes, textures and pictures pass through files.

Conventions. Blender's world is z up and its lat-long map has u(+X) = .5, u(+Y) = .25, row 0 at +Z;
ours is y up with u(+Z) = .5, u(+X) = .25, row 0 at +Y. BLENDER_FROM_WORLD, a rotation, takes one to
the other, so that a light map is passed on as it is. Texture row 0 is at v = 1 in Blender, at v = 0
in ours. Roughness is perceptual in both (alpha = roughness^2). Specular IOR Level .5 is a factor of
1 on the dielectric's F0.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO

import numpy as np

from relit.conventions import move_points, scale_of, world_from_gl_camera
from relit.errors import EXIT_FAILED, UserError
from relit.geometry.tangents import vertex_normals
from relit.images import read_data, write_linear
from relit.scene import Camera, Material, Mesh

PYTHON = "RELIT_CYCLES_PYTHON"  # environment variable: an interpreter that has bpy
WORKER = Path(__file__).with_name("cycles_worker.py")
BLENDER_FROM_WORLD = np.array(
    [[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
)  # (x, y, z) -> (z, x, y)
SENSOR = 36.0  # mm, width of Blender's film; only its ratio to the lens matters
DISTRIBUTION = "MULTI_GGX"  # Blender's default: compensated for multiple scattering
LAST_LINES = 12  # of the worker's output that an error message shows
INSTALL = (
    "`pip install 'relit[cycles]'` (CPython 3.11), or in an environment of its own: `python3.11 -m"
    f" venv cycles && cycles/bin/pip install 'bpy>=5.0.1,<5.1'` and {PYTHON}=cycles/bin/python. On "
    "Debian it needs: apt install libxrender1 libxi6 libxkbcommon0 libsm6 libxxf86vm1 libxfixes3 "
    "libgl1 libegl1"
)


def cycles_python() -> str:
    """The interpreter that runs the worker: RELIT_CYCLES_PYTHON, else this one."""
    return os.environ.get(PYTHON) or sys.executable


def cycles_missing() -> str:
    """Why Cycles cannot be used, '' when it can. Starts the interpreter (half a second)."""
    return _missing(cycles_python())


@lru_cache
def _missing(python: str) -> str:
    if shutil.which(python) is None:
        return f"there is no interpreter {python}"
    tried = subprocess.run(
        [python, "-I", "-c", "import bpy, numpy"], capture_output=True, text=True, check=False
    )
    said = (tried.stderr or tried.stdout).strip().splitlines()
    return "" if tried.returncode == 0 else (said or [f"{python} ended with an error"])[-1]


def require_cycles() -> None:
    """Raise UserError, with the commands that install it, where Cycles is missing."""
    if reason := cycles_missing():
        raise UserError("the renderer cycles is not there", reason, INSTALL)


@dataclass(frozen=True)
class CyclesLook:
    """What a picture depends on beside object, light and camera.

    max_depth: longest path in edges, as Mitsuba counts (2 = direct light only), so Cycles gets
    max_depth - 2 bounces. distribution: MULTI_GGX or GGX, of the Principled BSDF.
    """

    max_depth: int = 10
    distribution: str = DISTRIBUTION


class CyclesScene:
    """One object under one light, kept in a worker process until `close` or the end of this one.

    mesh, material: in the asset's frame, uvs with row 0 at v = 0. environment: (H, W, 3) lat-long
    radiance in the world frame. Raises UserError where bpy is missing.
    """

    def __init__(
        self,
        mesh: Mesh,
        material: Material,
        world_from_asset: np.ndarray,
        environment: np.ndarray,
        look: CyclesLook = CyclesLook(),
    ):
        if material.normal is not None and mesh.uvs is None:
            raise UserError(
                "the material has a normal map but the mesh has no texture coordinates",
                fix="give it uvs, or drop the map",
            )
        require_cycles()
        self.folder = Path(tempfile.mkdtemp(prefix="relit-cycles-"))
        job = write_job(self.folder, mesh, material, world_from_asset, look)
        write_linear(self.folder / "light.exr", np.asarray(environment, np.float32))
        (self.folder / "job.json").write_text(json.dumps(job))
        self._start()

    def _start(self) -> None:
        environ = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        errors = (self.folder / "errors.txt").open("wb")
        self.process = subprocess.Popen(
            [cycles_python(), "-X", "faulthandler", str(WORKER), str(self.folder / "job.json")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environ,
        )
        errors.close()
        self._end = weakref.finalize(self, _stop, self.process, self.folder)
        self.version = self._answer("ready")

    def _answer(self, word: str) -> str:
        """Wait for `RELIT word ...`; returns what follows."""
        heard: deque[str] = deque(maxlen=LAST_LINES)
        for line in _stream(self.process.stdout):
            if line.startswith(f"RELIT {word}"):
                return line.removeprefix(f"RELIT {word}").strip()
            heard.append(line.rstrip())
        code = self.process.wait()
        wrote = (self.folder / "errors.txt").read_text(errors="replace").splitlines()
        self.close()
        raise UserError(
            "Cycles stopped",
            "\n".join([f"its process ended with code {code}", *heard, *wrote[:LAST_LINES]]),
            f"check that `{cycles_python()} -c 'import bpy'` works and that memory is free",
            code=EXIT_FAILED,
        )

    def render(self, camera: Camera, *, spp: int, seed: int = 0) -> np.ndarray:
        """(H, W, 4) float32: linear radiance premultiplied on black, and alpha; box filter. The
        light is not seen. Deterministic by `seed`."""
        if camera.distortion and np.any(np.asarray(camera.distortion)):
            raise UserError(
                "a camera with lens distortion cannot be rendered",
                "pictures are pinhole pictures",
                "undistort the camera first",
            )
        out = self.folder / "picture.exr"
        out.unlink(missing_ok=True)
        view = {**view_of(camera), "samples": spp, "seed": seed % 2**31, "out": str(out)}
        try:
            _stream(self.process.stdin).write(json.dumps(view) + "\n")
            _stream(self.process.stdin).flush()
        except (BrokenPipeError, ValueError):
            pass  # the answer below says why
        self._answer("done")
        return np.ascontiguousarray(read_data(out)[..., :4], np.float32)

    def close(self) -> None:
        """End the process and delete its files; also done when the scene is dropped."""
        self._end()


def _stream(stream: IO[str] | None) -> IO[str]:
    assert stream is not None  # both are pipes
    return stream


def _stop(process: subprocess.Popen, folder: Path) -> None:
    try:
        _stream(process.stdin).close()
    except BrokenPipeError:
        pass
    try:
        process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    _stream(process.stdout).close()
    shutil.rmtree(folder, ignore_errors=True)


# ---------------------------------------------------------------- conventions


def view_of(camera: Camera) -> dict:
    """The worker's camera: pose (4, 4) of a camera that looks along -z with y up, in Blender's
    axes; lens in mm, shift in widths, pixel aspect."""
    pose = BLENDER_FROM_WORLD @ world_from_gl_camera(np.asarray(camera.world_from_camera))
    w, h = camera.width, camera.height
    ratio = camera.fx / camera.fy  # height of a pixel, in widths
    return {
        "pose": pose.tolist(),
        "lens": camera.fx / w * SENSOR,
        "shift": [-(camera.cx - w / 2) / w, (camera.cy - h / 2) / w * ratio],
        "aspect": [max(1.0, 1 / ratio), max(1.0, ratio)],  # Blender takes none below 1
        "size": [w, h],
    }


def write_job(
    folder: Path, mesh: Mesh, material: Material, world_from_asset: np.ndarray, look: CyclesLook
) -> dict:
    """Write arrays and textures into `folder`; returns the content of JOB.json."""
    place = BLENDER_FROM_WORLD @ np.asarray(world_from_asset, np.float64)
    faces = np.asarray(mesh.faces, np.int32)
    normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh)
    arrays = {
        "vertices": move_points(place, mesh.vertices).astype(np.float32),
        "faces": faces[(faces != np.roll(faces, 1, axis=1)).all(1)],  # Blender crashes on others
        "normals": (np.asarray(normals, np.float64) @ (place[:3, :3] / scale_of(place)).T).astype(
            np.float32
        ),
    }
    if mesh.uvs is not None:
        arrays["uvs"] = np.asarray(mesh.uvs, np.float32) * [1, -1] + [0, 1]
    np.savez(folder / "scene.npz", **arrays)
    constants, textures = {}, {}
    for name, value in inputs_of(material).items():
        flat = value.reshape(-1, value.shape[-1])
        if name != "Normal" and (flat == flat[0]).all():
            colour = name in ("Base Color", "Specular Tint")
            first = [float(v) for v in np.broadcast_to(flat[0], 3)]
            constants[name] = [*first, 1.0] if colour else first[0]
        else:
            file = folder / f"{name.replace(' ', '_').lower()}.exr"
            write_linear(file, np.broadcast_to(value, (*value.shape[:2], 3)))
            textures[name] = str(file)
    return {
        "arrays": str(folder / "scene.npz"),
        "light": str(folder / "light.exr"),
        "constants": constants,
        "textures": textures,
        "ior": float(material.ior),
        "bounces": max(0, look.max_depth - 2),
        "distribution": look.distribution,
        "sensor": SENSOR,
    }


def inputs_of(material: Material) -> dict[str, np.ndarray]:
    """The material as inputs of the Principled BSDF, each (H, W, 1 or 3) float32."""
    planes: dict[str, np.ndarray] = {
        "Base Color": np.asarray(material.base_color),
        "Roughness": np.asarray(material.roughness),
        "Metallic": np.asarray(material.metallic),
    }
    if material.specular is not None:  # a level and its tint
        factor = np.atleast_3d(np.asarray(material.specular, np.float32))
        level = factor.max(-1, keepdims=True)
        planes["Specular IOR Level"] = 0.5 * level
        planes["Specular Tint"] = np.where(level > 0, factor / np.maximum(level, 1e-6), 1)
    if material.normal is not None:
        planes["Normal"] = np.asarray(material.normal, np.float32) * 0.5 + 0.5
    return {
        name: np.ascontiguousarray(p[..., None] if p.ndim == 2 else p, np.float32)
        for name, p in planes.items()
    }
