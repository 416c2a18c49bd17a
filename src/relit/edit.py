"""A photo, changed: another material, of a pile of duplicates an instance taken away, a new object
put in, under the recovered light (of a collection the photo's own, of a flash capture the flash at
that camera).

Where the changed thing itself is seen, the picture is rendered; everywhere else the photo stays,
plus what the change does to it (`reference.changed`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation

from relit.asset.asset import load_asset, save_asset
from relit.asset.gltf import read_asset_file
from relit.conventions import move_points, scale_of, similarity
from relit.errors import EXIT_USAGE, UserError
from relit.files import digests
from relit.images import read_image, write_srgb
from relit.materials.plastic_as_gltf import base_colour, diffuse_albedo
from relit.reference.changed import change_of
from relit.reference.mitsuba_scene import build_scene, render
from relit.reference.photographed import as_photographed
from relit.reference.pile import build_pile, instance_ids, joined
from relit.scene import Asset, Camera, Material, Mesh

BEYOND_LABELS = 1 << 24  # labels have at most 24 bits of colour
RIM = 0.004  # of the photo's longer side: as much around what is removed is rendered too


def edit(
    run: str | Path,
    out: str | Path,
    *,
    photo: str | Path | None = None,
    base_color: Sequence[float] | None = None,
    tint: Sequence[float] | None = None,
    roughness: float | None = None,
    metallic: float | None = None,
    remove: Sequence[int] = (),
    spp: int = 64,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write an asset folder `out` with another material and without the instances `remove`
    (labels); with `photo`, also the changed photo, `out`/photo.png. Returns what was written.

    photo: any of the run's photos, known by its name or its content.
    base_color: (3,) linear, replaces the texture; tint: (3,), multiplies it. roughness, metallic:
    constants that replace the maps.
    progress: called with (done, all).
    """
    out, asset = Path(out), load_asset(run)
    _in_range({"roughness": roughness, "metallic": metallic})
    numbers = instance_numbers(asset)
    gone_numbers = removed_numbers(asset, numbers, remove)
    material = before = asset.material
    if base_color is not None:
        material = replace(
            material,
            base_color=np.broadcast_to(np.float32(base_color), material.base_color.shape).copy(),  # pyright: ignore[reportArgumentType]
        )
    if tint is not None:
        material = replace(
            material,
            base_color=np.clip(material.base_color * np.float32(tint), 0, 1).astype(np.float32),  # pyright: ignore[reportArgumentType]
        )
    for name, value in (("roughness", roughness), ("metallic", metallic)):
        if value is not None:
            material = replace(material, **{name: np.full_like(getattr(material, name), value)})
    if before.diffuse is not None:
        material = as_plastic(material, before, tint, base_color is not None, roughness is not None)
    kept = tuple(i for i, n in zip(asset.instances, numbers, strict=True) if n not in gone_numbers)
    if asset.instances and not any(i.registered for i in kept):
        raise UserError("nothing would be left", fix="keep at least one instance", code=EXIT_USAGE)
    changed = replace(asset, material=material, instances=kept)
    written = [save_asset(out, changed)]
    if photo is not None:
        name, camera, picture = _photo(asset, photo)
        ids, new_ids = _ids(asset, camera), _ids(changed, camera)
        same = material is asset.material
        drawn = [n for i, n in zip(asset.instances, numbers, strict=True) if i.registered]
        shown, told = np.array([*drawn, 0])[ids], _labels_beside(photo, ids.shape)
        if told is not None and name != asset.cameras[0][0]:
            told = as_shown(told, shown)
        gone = cleared(shown, told, gone_numbers)
        own = gone if same else gone | (new_ids >= 0)
        shows = [partial(as_photographed(a), name, spp=spp, seed=seed) for a in (asset, changed)]
        after, change = change_of(*shows, camera, picture, own, progress=progress)  # pyright: ignore[reportCallIssue]
        write_srgb(
            out / "photo.png", np.clip(np.where(own[..., None], after, picture + change), 0, 1)
        )
        written.append(out / "photo.png")
    return written


def instance_numbers(asset: Asset) -> list[int]:
    """A number for each instance: its label where it is the first photo's, else one that no label
    has."""
    return [i.label if i.photo == 0 else BEYOND_LABELS + k for k, i in enumerate(asset.instances)]


def removed_numbers(asset: Asset, numbers: Sequence[int], remove: Sequence[int]) -> list[int]:
    """The numbers of the registered instances with the labels `remove`; a label is the first
    photo's where that has it. Raises UserError for a label that none has."""
    known: dict[int, int] = {}
    for i, number in sorted(zip(asset.instances, numbers, strict=True), key=lambda p: p[0].photo):
        if i.registered:
            known.setdefault(i.label, number)
    for label in remove:
        if label not in known:
            raise UserError(
                f"no registered instance has the label {label}",
                f"labels: {', '.join(map(str, sorted(known)))}",
                code=EXIT_USAGE,
            )
    return [known[label] for label in remove]


def as_plastic(
    material: Material,
    before: Material,
    tint: Sequence[float] | None,
    painted: bool,
    polished: bool,
) -> Material:
    """A changed rough plastic whose diffuse albedo and base colour belong together again. `before`:
    as it was. painted: the base colour was given. polished: the roughness was."""
    coat = (material.roughness, material.specular, material.ior)
    if painted:
        return replace(material, diffuse=diffuse_albedo(material.base_color, *coat))
    diffuse = (
        before.diffuse
        if tint is None
        else np.clip(before.diffuse * np.float32(tint), 0, 1).astype(np.float32)  # pyright: ignore[reportArgumentType]
    )
    return replace(
        material,
        diffuse=diffuse,
        base_color=base_colour(diffuse, *coat) if polished else material.base_color,  # pyright: ignore[reportArgumentType]
    )


def cleared(shown: np.ndarray, told: np.ndarray | None, remove: Sequence[int]) -> np.ndarray:
    """(H, W) bool: the pixels of the instances `remove`, and a few around them, so that no rim of
    them stays.

    shown: (H, W) label of the instance that the model shows, 0 where none; told: the photo's own
    labels, or None.
    """
    gone = np.isin(shown, list(remove))
    others = (shown > 0) & ~gone
    if told is not None:
        gone |= np.isin(told, list(remove))
        others = (others | (told > 0)) & ~gone
    rim = binary_dilation(gone, iterations=max(2, round(RIM * max(shown.shape))))
    return gone | (rim & ~others)


def as_shown(told: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """The labels (H, W) of a photo that is not the run's first, in the numbers of the run, which
    are the first photo's: each object takes the number of the instance that the model shows on most
    of it, 0 where the model shows none on half of it."""
    out = np.zeros_like(told)
    for label in np.unique(told[told > 0]):
        values, counts = np.unique(shown[told == label], return_counts=True)
        if values[counts.argmax()] > 0 and 2 * counts.max() > counts.sum():
            out[told == label] = values[counts.argmax()]
    return out


def insert(
    run: str | Path,
    model: str | Path,
    out: str | Path,
    *,
    photo: str | Path,
    at: tuple[float, float],
    size: float = 1.0,
    turn: float = 0.0,
    spp: int = 128,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Put a model (.glb, .gltf, .obj; or an asset folder) into the photo, standing on the ground at
    pixel `at` (x, y), and write the picture `out`.

    photo: any of the run's photos. size: its bounding sphere, in that of the recovered object.
    turn: degrees about the vertical. progress: called with (done, all).
    """
    asset, out = load_asset(run), Path(out)
    if asset.ground is None or asset.environment is None:
        raise UserError(
            "the asset knows no ground to stand on",
            "few instances, or none that touch one plane",
            "insert needs the run of a duplicates capture in which a ground was found",
        )
    if not 0.01 <= size <= 100:
        raise UserError(f"--size {size} is outside 0.01 to 100", code=EXIT_USAGE)
    model = Path(model)
    mesh, material = (
        (lambda a: (a.mesh, a.material))(load_asset(model))
        if model.is_dir()
        else read_asset_file(model)
    )
    _, camera, picture = _photo(asset, photo)
    x, y = at
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise UserError(
            f"--at {x:g},{y:g} lies outside the photo of {camera.width} x {camera.height} pixels",
            code=EXIT_USAGE,
        )
    placed = mesh_on_ground(mesh, asset, camera, at, size, turn)
    poses = [i.world_from_object for i in asset.instances if i.registered]
    pile = build_pile(asset.mesh, asset.material, poses, asset.ground)  # pyright: ignore[reportArgumentType]
    before = build_scene(pile.mesh, pile.material, np.eye(4), asset.environment)
    whole, materials = joined(pile.mesh, pile.material, placed, material)
    scene = build_scene(whole, materials, np.eye(4), asset.environment)
    cover = coverage(scene, len(pile.mesh.faces), camera)
    shows = [partial(render, s, spp=spp, seed=seed) for s in (before, scene)]
    after, change = change_of(*shows, camera, picture, cover == 1, cover > 0, progress)  # pyright: ignore[reportCallIssue]
    write_srgb(
        out, np.clip(cover[..., None] * after + (1 - cover[..., None]) * (picture + change), 0, 1)
    )
    return out


def mesh_on_ground(mesh: Mesh, asset: Asset, camera: Camera, at, size: float, turn: float) -> Mesh:
    """The mesh in the world: its lowest point on the ground where the ray through pixel `at` meets
    it, +Y along the ground's normal."""
    from relit.geometry.se3 import exp_so3, rotation_from

    g = asset.ground
    ray = camera.world_from_camera[:3, :3] @ np.array(
        [(at[0] - camera.cx) / camera.fx, (at[1] - camera.cy) / camera.fy, 1.0]
    )
    down = float(ray @ g.normal)
    away = float((np.asarray(g.point) - camera.centre) @ g.normal) / (
        down if abs(down) > 1e-9 else 1e-9
    )
    if away <= 0:
        raise UserError(
            "the ray through --at does not meet the ground",
            "it goes above the horizon",
            "choose a lower pixel",
            code=EXIT_USAGE,
        )
    v = np.asarray(mesh.vertices, np.float64)
    own = np.linalg.norm(v - (v.min(0) + v.max(0)) / 2, axis=1).max()
    o = np.asarray(asset.mesh.vertices, np.float64)
    radius = np.linalg.norm(o - (o.min(0) + o.max(0)) / 2, axis=1).max() * scale_of(
        asset.world_from_asset
    )
    foot = np.array(
        [(v[:, 0].min() + v[:, 0].max()) / 2, v[:, 1].min(), (v[:, 2].min() + v[:, 2].max()) / 2]
    )
    rotation = rotation_from(np.array([0.0, 1.0, 0.0]), g.normal) @ exp_so3(
        np.array([0, np.radians(turn), 0])
    )
    s = size * radius / max(own, 1e-12)
    pose = similarity(rotation, camera.centre + away * ray - s * rotation @ foot, s)
    normals = (
        None if mesh.normals is None else (np.asarray(mesh.normals) @ rotation.T).astype(np.float32)
    )
    return replace(mesh, vertices=move_points(pose, v).astype(np.float32), normals=normals)


def coverage(scene, first_face: int, camera: Camera, samples: int = 16) -> np.ndarray:
    """(H, W) share of each pixel in which a face from `first_face` on is seen."""
    import drjit as dr
    import mitsuba as mi

    from relit.reference.mitsuba_scene import camera_rays

    pixels = camera.width * camera.height
    total = np.zeros(pixels)
    for k in range(samples):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, 500 + k), pixels)
        with dr.suspend_grad():
            ray, _ = camera_rays(scene, camera, dr.arange(mi.UInt32, pixels), sampler)
            pi = scene.mi_scene.ray_intersect_preliminary(mi.Ray3f(ray), coherent=True)
            total += (pi.is_valid() & (pi.prim_index >= first_face)).numpy()
    return (total / samples).reshape(camera.height, camera.width)


def _ids(asset: Asset, camera: Camera) -> np.ndarray:
    """(H, W) which registered instance each pixel shows, -1 for none."""
    poses = [i.world_from_object for i in asset.instances if i.registered] or [
        asset.world_from_asset
    ]
    pile = build_pile(asset.mesh, asset.material, poses, asset.ground)  # pyright: ignore[reportArgumentType]
    return instance_ids(build_scene(pile.mesh, pile.material, np.eye(4)), pile, camera)


def _labels_beside(photo: str | Path, shape: tuple[int, int]) -> np.ndarray | None:
    """The labels (H, W) that lie beside the photo, or None where there are none that can be
    used."""
    from relit.capture.readers.sfd import open_duplicates, recognise

    try:
        source = recognise(Path(photo))
        labels = None if source is None else open_duplicates(source).photos[0].load().labels
    except UserError:
        return None
    return labels if labels is not None and labels.shape == shape else None


def _photo(asset: Asset, photo: str | Path) -> tuple[str, Camera, np.ndarray]:
    """Which of the run's photos it is (the name in `asset.cameras`), its camera and its linear
    pixels. Raises UserError when it is none."""
    if (asset.environment is None and asset.flash is None) or not asset.cameras:
        raise UserError(
            "the asset has no camera or no light of its own",
            fix="give a run of `relit reconstruct`",
        )
    picture = read_image(Path(photo)).rgb
    name, camera = camera_of(asset, Path(photo))
    h, w = picture.shape[:2]
    if abs(w / h - camera.width / camera.height) > 0.01:
        raise UserError(
            f"the photo is {w} x {h} pixels, the asset's camera {camera.width} x {camera.height}",
            "it is another photo",
            f"give the photo that the run was made from: {photo}",
        )
    return name, camera.resized(w, h), picture


def camera_of(asset: Asset, photo: Path) -> tuple[str, Camera]:
    """(name, camera) of a photo of the run, by the end of its path (of photos of one file name the
    one whose folders agree furthest), else by its content where the run keeps digests. Raises
    UserError when it is none of the run's photos."""
    parts = photo.resolve().parts[::-1]

    def shared(name: str) -> int:
        return next(
            (
                k
                for k, (a, b) in enumerate(zip(Path(name).parts[::-1], parts, strict=False))
                if a != b
            ),
            len(Path(name).parts),
        )

    agree = [shared(name) for name, _ in asset.cameras]
    best = [c for c, k in zip(asset.cameras, agree, strict=True) if k and k == max(agree)]
    if len(best) == 1:
        return best[0]
    inputs, own = asset.meta.get("inputs") or {}, digests(photo.parent, [photo.name])[photo.name]
    same = [c for c in best or asset.cameras if inputs.get(c[0]) == own]
    if same:
        return same[0]
    named = ", ".join(name for name, _ in asset.cameras[:6]) + (
        ", ..." if len(asset.cameras) > 6 else ""
    )
    if best:
        told = " and ".join(name for name, _ in best)
        what = f"which of the run's photos this is cannot be told: {told}"
        raise UserError(what, "they have one name", f"give it as it lies in its folder: {photo}")
    raise UserError(
        f"'{photo.name}' is none of the photos whose cameras the run knows",
        f"those are {named}; under another name it must be the same file",
        f"give one of them: {photo}",
    )


def _in_range(values: dict[str, float | None]) -> None:
    for name, value in values.items():
        if value is not None and not 0 <= value <= 1:
            raise UserError(f"--{name} {value} is outside 0 to 1", code=EXIT_USAGE)
