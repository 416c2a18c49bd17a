"""One photo, or several, of a pile of identical objects, with its truth, in the layout of SfD's
released data.

    transforms_train.json         focal (pixels) and the camera's pose
    train/000_rgb.png             the photo, 8-bit sRGB (001_rgb.png ... where there are several)
    train/000_instance_seg.png    one grey level for each object, 0 for the rest
    truth/truth.json              poses, visible shares, ground, settings; written last
    truth/mesh.ply  truth/object.glb  truth/environment.exr
    truth/test/t_000.exr ...      novel views of the whole pile, with _albedo, _roughness,
                                  _metallic, _normal, _labels
    truth/relight/LIGHT.exr  truth/relight/LIGHT/t_000.exr ...

World: +Y up, the ground is y = 0, every object's bounding sphere has the radius RADIUS. Objects
come to rest on a facet of their convex hull, lean a little, and drop one after the other to where
they first touch what lies there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.conventions import move_points, similarity, world_from_gl_camera
from relit.errors import UserError
from relit.geometry.se3 import exp_so3, look_at, rotation_from
from relit.scene import Camera, Ground, Mesh
from relit.synthesize.multiview import (
    RADIUS,
    check_relight_names,
    claim_folder,
    exposed,
    identity_of,
    object_frame,
    overridden,
    radiance,
    tell_progress,
    write_json,
)
from relit.synthesize.renderers import TrueObject, depth_of, require_renderer

VERSION = 3
MAX_DEPTH = 5  # edges of the longest path, of the package's own renderer
FOV = 38.0  # degrees, the shorter side of the photo
ELEVATION = 55.0  # degrees, of the photo's camera
STEP = 35.0  # degrees around the pile from one photo to the next
TEST_ELEVATIONS = (38.0, 58.0)  # of the novel views, in turn
CELL = (
    RADIUS / 60
)  # of the height field that objects drop onto: they come to rest a cell or two above one another
GROUND_COLOUR, GROUND_ROUGHNESS = (0.36, 0.33, 0.30), 0.8


def synthesize_duplicates(
    asset_file: str | Path,
    light_file: str | Path,
    out: str | Path,
    *,
    count: int = 10,
    photos: int = 1,
    test_views: int = 8,
    relights: Sequence[str | Path] = (),
    resolution: int = 1600,
    test_resolution: int = 400,
    spp: int = 64,
    test_spp: int = 128,
    seed: int = 0,
    renderer: str = "relit",
    lean: float = 12.0,
    spread: float = 1.0,
    nodes: Sequence[str] = (),
    roughness: float | None = None,
    metallic: float | None = None,
    max_depth: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Path:
    """Render one photo of `count` copies of an object under one light, with its truth, into `out`;
    returns `out`.

    photos: of the same pile, STEP degrees apart around it; their labels agree. lean: standard
    deviation in degrees of the tilt away from the resting pose. spread: factor on the radius of the
    pile. renderer: one of `synthesize.renderers.RENDERERS`. nodes: names of the glTF nodes whose meshes are taken, all where empty. Others: as
    `synthesize_multiview`. Deterministic by `seed`; a call with the same settings takes up where a
    stopped one was. Raises UserError when a file cannot be read or a number makes no sense.
    """
    options = {
        k: v
        for k, v in locals().items()
        if k in synthesize_duplicates.__kwdefaults__ and k not in ("say", "relights")
    }
    asset_file, light_file, out = Path(asset_file), Path(light_file), Path(out)
    relights = [Path(r) for r in relights]
    _check(options, relights)
    settings = settings_of(asset_file, light_file, relights=relights, **options)
    max_depth = settings["max_depth"]
    if not (out / "truth" / "truth.json").exists():
        require_renderer(renderer)  # before anything is written
    if claim_folder(out, settings):
        return out

    from relit.asset.gltf import read_asset_file, write_glb
    from relit.images import read_image, write_linear, write_srgb
    from relit.reference.mitsuba_scene import render_channels
    from relit.reference.pile import build_pile, instance_ids

    mesh, material = read_asset_file(asset_file, nodes)
    material = overridden(material, roughness, metallic)
    poses, reach = heap(mesh, count, seed, lean, spread)
    ground = Ground(
        np.zeros(3), np.array([0.0, 1.0, 0.0]), 5 * reach, np.array(GROUND_COLOUR), GROUND_ROUGHNESS
    )
    pile = build_pile(mesh, material, poses, ground)
    first = np.random.default_rng(seed + 17).uniform(0, 360)
    shots = [pile_camera(reach, resolution, first + STEP * k, ELEVATION) for k in range(photos)]
    camera = shots[0]
    tests = test_cameras(reach, test_views, test_resolution, seed)
    truth = out / "truth"

    def lit(file: Path):
        """The pile under a light whose exposure fits it, and that light."""
        whole = TrueObject(pile.mesh, pile.material, np.eye(4))
        return exposed(renderer, whole, read_image(file).rgb, [("", camera)], max_depth)

    scene, environment = lit(light_file)
    write_linear(truth / "environment.exr", environment)
    levels = np.concatenate([[0], np.round(np.arange(1, count + 1) * 255 / count)]).astype(np.uint8)
    (out / "train").mkdir(parents=True, exist_ok=True)
    labels = instance_ids(scene.channels, pile, camera) + 1
    for k, shot in enumerate(shots):
        ids = labels if k == 0 else instance_ids(scene.channels, pile, shot) + 1
        cv2.imwrite(str(out / "train" / f"{k:03d}_instance_seg.png"), levels[ids])
        if not (out / "train" / f"{k:03d}_rgb.png").exists():
            write_srgb(
                out / "train" / f"{k:03d}_rgb.png",
                np.clip(radiance(scene, shot, spp, max_depth, seed + 7 * k)[..., :3], 0, 1),
            )
        say(f"photo {k + 1} of {photos} of {count} objects, {resolution} x {resolution}")
    for i, (name, view) in enumerate(tests):
        target = truth / "test" / f"{name}.exr"
        if not target.exists():
            ids = instance_ids(scene.channels, pile, view) + 1
            channels, alpha = (
                render_channels(scene.channels, view, spp=32),
                (ids > 0).astype(np.float32)[..., None],
            )
            for key in ("albedo", "normal"):
                write_linear(
                    truth / "test" / f"{name}_{key}.exr", np.concatenate([channels[key], alpha], -1)
                )
            for key in ("roughness", "metallic"):
                write_linear(truth / "test" / f"{name}_{key}.exr", channels[key])
            rgb = radiance(scene, view, test_spp, max_depth, seed + 50 + i)[..., :3]
            write_linear(
                target, np.concatenate([rgb, alpha], -1)
            )  # coverage of the objects, the ground left out
        tell_progress(say, "test view", i, len(tests))
    scene.close()
    for j, file in enumerate(relights):
        scene, light = lit(file)
        write_linear(truth / "relight" / f"{file.stem}.exr", light)
        for i, (name, view) in enumerate(tests):
            target = truth / "relight" / file.stem / f"{name}.exr"
            if not target.exists():
                write_linear(
                    target,
                    radiance(scene, view, test_spp, max_depth, seed + 90 + 40 * j + i),
                )
        scene.close()
        say(f"test views under {file.stem}")
    _write_mesh(truth / "mesh.ply", mesh)
    write_glb(truth / "object.glb", mesh, material)
    write_json(
        out / "transforms_train.json",
        _cameras([(f"train/{k:03d}", c) for k, c in enumerate(shots)]),
    )
    write_json(out / "transforms_test.json", _cameras([(f"test/{n}", c) for n, c in tests]))
    write_json(
        truth / "truth.json",
        {
            "settings": settings,
            "instances": [
                {"label": int(levels[k + 1]), "world_from_object": p.tolist(), "visible": v}
                for k, (p, v) in enumerate(
                    zip(poses, visible_shares(mesh, material, poses, labels, camera), strict=True)
                )
            ],
            "ground": {"point": [0, 0, 0], "normal": [0, 1, 0], "colour": list(GROUND_COLOUR)},
            "test": [n for n, _ in tests],
            "relight": [f.stem for f in relights],
            "radius": RADIUS,
        },
    )
    return out


def settings_of(asset_file: str | Path, light_file: str | Path, **options: Any) -> dict[str, Any]:
    """Everything that a capture depends on (see `synthetic.settings_of`)."""
    files = {"asset": Path(asset_file), "light": Path(light_file)}
    relights = [Path(r) for r in options.pop("relights", ())]
    for what, file in [*files.items(), *(("light", r) for r in relights)]:
        if not file.is_file():
            raise UserError(
                f"no {what} file: {file}",
                fix=f"give an existing {'GLB or OBJ' if what == 'asset' else 'HDR or EXR'} file",
            )
    defaults = synthesize_duplicates.__kwdefaults__
    plain = {
        key: options.get(key, value)
        for key, value in defaults.items()
        if key not in ("relights", "say")
    }
    plain["nodes"] = list(plain["nodes"])
    if plain["renderer"] == "relit":  # the settings, and the hash, of captures without the choice
        del plain["renderer"]
        plain["max_depth"] = plain["max_depth"] or MAX_DEPTH
    else:
        plain["max_depth"] = depth_of(plain["renderer"], plain["max_depth"])
    identities = {what: identity_of(file) for what, file in files.items()}
    return {
        "version": VERSION,
        "kind": "duplicates",
        **identities,
        "relights": [identity_of(r) for r in relights],
        **plain,
    }


def _check(o: dict, relights: list[Path]) -> None:
    check_relight_names(relights)
    limits = {
        "count": (1, 255),
        "photos": (1, 12),
        "test_views": (1, 1000),
        "resolution": (32, 8192),
        "test_resolution": (8, 8192),
        "spp": (1, 1 << 20),
    }
    for name, (low, high) in limits.items():
        if not low <= o[name] <= high:
            raise UserError(f"{name} = {o[name]} is outside {low} to {high}", code=2)
    for name in ("roughness", "metallic"):
        if o[name] is not None and not 0 <= o[name] <= 1:
            raise UserError(f"{name} = {o[name]} is outside [0, 1]", code=2)


# ---------------------------------------------------------------- the pile


def heap(
    mesh: Mesh, count: int, seed: int, lean: float, spread: float
) -> tuple[list[np.ndarray], float]:
    """Similarities world_from_asset (4, 4) of `count` objects in a pile around the origin, and the
    radius of the pile."""
    rng = np.random.default_rng(seed)
    frame = object_frame(mesh, RADIUS)
    points = surface_points(move_points(frame, mesh.vertices), mesh.faces, rng)
    hull = RestingHull(points)
    radius = spread * RADIUS * np.sqrt(0.9 * count)
    side = int(np.ceil((radius + 2 * RADIUS) / CELL)) * 2 + 1
    height = np.zeros((side, side))
    poses = []
    for _ in range(count):
        turn = exp_so3(np.array([0, rng.uniform(0, 2 * np.pi), 0])) @ rotation_from(
            hull.rest(rng), np.array([0.0, -1.0, 0.0])
        )
        axis = rng.normal(size=2)
        axis = np.array([axis[0], 0, axis[1]]) / np.linalg.norm(axis)
        turn = exp_so3(axis * np.radians(lean) * rng.normal()) @ turn
        p = points @ turn.T
        best = None
        for _ in range(6):
            r, phi = radius * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi)
            x, z = r * np.cos(phi), r * np.sin(phi)
            column, row = (
                np.round((c + o) / CELL).astype(int) + side // 2
                for c, o in ((p[:, 0], x), (p[:, 2], z))
            )
            y = float((grown(height)[row, column] - p[:, 1]).max())
            if best is None or y < best[0]:
                best = (y, x, z, row, column)
        y, x, z, row, column = best
        np.maximum.at(height, (row, column), p[:, 1] + y)
        poses.append(similarity(turn, [x, y, z]) @ frame)
    return poses, float(radius + 0.5 * RADIUS)


def grown(height: np.ndarray) -> np.ndarray:
    """The height field, each cell as high as the highest of its eight neighbours."""
    return cv2.dilate(height, np.ones((3, 3)))


def surface_points(vertices: np.ndarray, faces: np.ndarray, rng, count: int = 60_000) -> np.ndarray:
    """Vertices and random points on the faces, (M, 3)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    f = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return np.concatenate([vertices, a[f] + u * (b - a)[f] + v * (c - a)[f]])


class RestingHull:
    """The convex hull of points, for the facets that a body comes to rest on. The centre of mass is
    the mean of the surface points."""

    def __init__(self, points: np.ndarray):
        from scipy.spatial import ConvexHull

        hull = ConvexHull(points)
        self.normals, self.neighbours = hull.equations[:, :3], hull.neighbors
        self.distance = -hull.equations[:, 3] - self.normals @ points.mean(
            0
        )  # of the centre of mass from each facet

    def rest(self, rng) -> np.ndarray:
        """The direction (3,) in the body that points down when it has rolled to rest from a random
        pose: every roll over an edge to a neighbouring facet lowers the centre of mass."""
        down = rng.normal(size=3)
        facet = int(
            np.argmin(self.distance / np.maximum(self.normals @ down / np.linalg.norm(down), 1e-9))
        )
        while True:
            around = self.neighbours[facet]
            lower = around[np.argmin(self.distance[around])]
            if self.distance[lower] >= self.distance[facet] - 1e-9:
                return self.normals[facet]
            facet = int(lower)


# ---------------------------------------------------------------- cameras and files


def pile_camera(reach: float, resolution: int, azimuth: float, elevation: float) -> Camera:
    """A camera that has the pile of radius `reach` in its frame."""
    focal = resolution / (2 * np.tan(np.radians(FOV) / 2))
    a, e = np.radians(azimuth), np.radians(elevation)
    distance = 1.02 * reach / np.sin(np.radians(FOV) / 2)
    eye = distance * np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    return Camera(
        resolution,
        resolution,
        focal,
        focal,
        resolution / 2,
        resolution / 2,
        look_at(eye, (0.0, 0.3 * RADIUS, 0.0)),
    )


def test_cameras(reach: float, count: int, resolution: int, seed: int) -> list[tuple[str, Camera]]:
    """Novel views all around the pile, at the elevations TEST_ELEVATIONS in turn."""
    start = np.random.default_rng(seed + 18).uniform(0, 360)
    rises = TEST_ELEVATIONS
    return [
        (
            f"t_{i:03d}",
            pile_camera(reach, resolution, start + 360 * i / count, rises[i % len(rises)]),
        )
        for i in range(count)
    ]


def visible_shares(mesh, material, poses, labels: np.ndarray, camera: Camera) -> list[float]:
    """Share of each object's pixels that nothing hides and the frame holds, from its size when it
    stands alone."""
    from relit.reference.mitsuba_scene import build_scene
    from relit.reference.pile import build_pile, instance_ids

    side = max(64, camera.width // 4)
    wide = Camera(
        2 * side,
        2 * side,
        camera.fx * side / camera.width,
        camera.fx * side / camera.width,
        side,
        side,
        camera.world_from_camera,
    )
    shares = []
    for k, pose in enumerate(poses):
        alone = build_pile(mesh, material, [pose])
        ids = instance_ids(build_scene(alone.mesh, alone.material), alone, wide, samples=1)
        seen = float((labels == k + 1).sum()) * (side / camera.width) ** 2
        shares.append(round(min(1.0, seen / max(float((ids >= 0).sum()), 1.0)), 4))
    return shares


def _cameras(cameras: Sequence[tuple[str, Camera]]) -> dict:
    first = cameras[0][1]
    frames = [
        {"file_path": n, "transform_matrix": world_from_gl_camera(c.world_from_camera).tolist()}
        for n, c in cameras
    ]
    return {"focal": first.fx, "w": first.width, "h": first.height, "frames": frames}


def _write_mesh(path: Path, mesh: Mesh) -> None:
    import trimesh

    from relit.images import write_bytes

    write_bytes(
        path, trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply")
    )
