"""The renderers of ground truth, by name.

* `relit`: the package's own path tracer and BRDF, what fits use. Errors of the model cancel.
* `mitsuba`: Mitsuba's path tracer and its `principled` BSDF (diffuse of Burley 2012, GGX without
  compensation), never the package's BRDF.
* `cycles`: Blender's Cycles and its Principled BSDF (compensated GGX over Lambert).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.scene import Camera, Material, Mesh

if TYPE_CHECKING:
    from relit.reference.mitsuba_scene import Scene
    from relit.synthesize.cycles import CyclesScene

# Longest path in edges (2 = direct light only). `relit` keeps what captures always had (four
# inter-reflections); the others trace eight, beyond which a concave object gains less than noise.
DEPTHS = {"relit": 6, "mitsuba": 10, "cycles": 10}
RENDERERS = tuple(DEPTHS)


def depth_of(renderer: str, max_depth: int | None) -> int:
    """The longest path in edges: `max_depth`, else the renderer's own. Raises UserError for an
    unknown renderer."""
    if renderer not in DEPTHS:
        raise UserError(
            f"unknown renderer '{renderer}'.{did_you_mean(renderer, RENDERERS)}",
            fix=f"choose one of: {', '.join(RENDERERS)}",
            code=EXIT_USAGE,
        )
    return DEPTHS[renderer] if max_depth is None else max_depth


def require_renderer(renderer: str) -> None:
    """Raise UserError, with the commands that install it, where a renderer is missing."""
    if renderer == "cycles":
        from relit.synthesize.cycles import require_cycles

        require_cycles()


@dataclass(frozen=True)
class TrueObject:
    """The object of a capture, its material, and world_from_asset (4, 4)."""

    mesh: Mesh
    material: Material
    world_from_asset: np.ndarray


@dataclass(frozen=True)
class TruthScene:
    """An object under a light, ready to be rendered.

    channels: a Mitsuba scene whose geometry and textures the truth channels come from, whoever
    renders. cycles: the renderer's process, or None for Mitsuba. gain: factor on the pictures; the
    light is what was given times this.
    """

    channels: Scene
    cycles: CyclesScene | None = None
    gain: float = 1.0

    def brighter(self, gain: float) -> TruthScene:
        """The same scene with `gain` times the light."""
        return replace(self, gain=self.gain * gain)

    def close(self) -> None:
        """End what renders, if it is a process."""
        if self.cycles is not None:
            self.cycles.close()


def as_truth(scene: TruthScene | Scene) -> TruthScene:
    """A scene of Mitsuba as one that renders itself."""
    return scene if isinstance(scene, TruthScene) else TruthScene(scene)


def build_truth(
    renderer: str, thing: TrueObject, environment: np.ndarray, max_depth: int
) -> TruthScene:
    """The scene of one of RENDERERS. environment: (H, W, 3) lat-long radiance, world frame.

    Raises UserError where the renderer is missing or does not know the material.
    """
    from relit.reference.mitsuba_scene import build_scene

    parts = (thing.mesh, thing.material, thing.world_from_asset)
    if renderer != "cycles":
        bsdf = "principled" if renderer == "mitsuba" else "relit"
        return TruthScene(build_scene(*parts, environment, bsdf=bsdf))
    from relit.synthesize.cycles import CyclesLook, CyclesScene

    channels = build_scene(*parts, None)
    return TruthScene(channels, CyclesScene(*parts, environment, CyclesLook(max_depth)))


def truth_picture(
    scene: TruthScene, camera: Camera, spp: int, max_depth: int, seed: int
) -> np.ndarray:
    """(H, W, 4) float32: linear radiance premultiplied on black, and coverage."""
    if scene.cycles is not None:
        rgba = scene.cycles.render(camera, spp=spp, seed=seed)
    else:
        from relit.reference.mitsuba_scene import render

        rgba = render(scene.channels, camera, spp=spp, seed=seed, max_depth=max_depth)
    return rgba if scene.gain == 1 else rgba * np.array([*[scene.gain] * 3, 1], np.float32)


def describe_renderer(renderer: str, scene: TruthScene) -> dict[str, str]:
    """{"name", "version", "bsdf"} for the truth file."""
    import mitsuba as mi

    if scene.cycles is not None:
        return {
            "name": renderer,
            "version": f"Blender {scene.cycles.version}",
            "bsdf": "Principled BSDF",
        }
    bsdf = "principled" if renderer == "mitsuba" else "relit_metallic_roughness"
    return {"name": renderer, "version": f"Mitsuba {mi.__version__}", "bsdf": bsdf}
