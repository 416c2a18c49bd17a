"""The pairs of the report, for each kind of capture: the photo that an asset renders, and what the
report shows beside it."""

import base64
import io
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from relit.asset.asset import save_asset
from relit.conventions import similarity
from relit.evaluate.metrics import encode, psnr
from relit.geometry.se3 import exp_so3, look_at
from relit.reference.flash_scene import build_flash_scene, render_flash
from relit.reference.mitsuba_scene import build_scene, render
from relit.reference.pile import build_pile, instance_ids
from relit.report import page as report
from relit.report.comparison import kind_of, pairs
from relit.scene import Asset, Camera, Capture, Flash, Ground, Instance, Photo, Pixels
from relit.synthesize.procedural import pawn, studio

W, H, SPP = 48, 36, 48
PLACES = {
    7: ([-1.6, 0, 0], 0.3),
    9: ([1.5, 0, 0.4], 1.7),
    12: ([0.2, 0, -2.0], 3.0),
}  # label: where, turned by
HALF = np.diag([0.5, 0.5, 0.5, 1.0])


def bare() -> Asset:
    mesh, material = pawn(rows=10, columns=14, texture=16)
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    cameras = []
    for i, angle in enumerate((0.0, 1.4, 2.8, 4.2)):
        pose = look_at(middle + 6 * np.array([np.sin(angle), 0.4, np.cos(angle)]), middle)
        cameras.append((f"{i}.png", Camera(W, H, 95.0, 95.0, W / 2, H / 2, pose)))
    return Asset(mesh, material, np.eye(4), None, tuple(cameras))


def multiview():
    asset = replace(bare(), environment=studio(8))
    scene = build_scene(asset.mesh, asset.material, None, asset.environment)
    return asset, [render(scene, c, spp=SPP, seed=9) for _, c in asset.cameras], [None] * 4


def flash():
    asset = bare()
    light = Flash(np.array([0.4, 0.1, 0.0]), np.full(3, 60.0))
    specular = np.full(asset.material.roughness.shape, 0.8, np.float32)
    asset = replace(
        asset, material=replace(asset.material, ior=1.49, specular=specular), flash=light
    )
    scene = build_flash_scene(asset.mesh, asset.material)
    return (
        asset,
        [render_flash(scene, c, light, SPP, seed=9, max_depth=5) for _, c in asset.cameras],
        [None] * 4,
    )


def duplicates():
    asset = bare()
    poses = {
        k: similarity(exp_so3(np.array([0, turn, 0])), np.array(at)) @ HALF
        for k, (at, turn) in PLACES.items()
    }
    instances = (*(Instance(k, p) for k, p in poses.items()), Instance(20, None, "hidden"))
    ground = Ground(
        np.array([0, asset.mesh.vertices[:, 1].min() * 0.5, 0]),
        np.array([0, 1.0, 0]),
        9.0,
        np.array([0.3, 0.35, 0.2]),
    )
    camera = Camera(
        W, H, 60.0, 60.0, W / 2, H / 2, look_at(np.array([0.5, 3.5, 6.0]), np.array([0, 0.3, 0]))
    )
    cameras = (("0.png", camera),)
    asset = replace(
        asset,
        environment=studio(8),
        instances=instances,
        ground=ground,
        cameras=cameras,
        world_from_asset=poses[7],
    )
    pile = build_pile(asset.mesh, asset.material, list(poses.values()), ground)
    scene = build_scene(pile.mesh, pile.material, None, asset.environment)
    labels = np.array([*poses, 0])[
        instance_ids(scene, pile, camera)
    ]  # -1, what is nothing, takes the last
    return asset, [render(scene, camera, spp=SPP, seed=9)], [labels]


def collection():
    asset, rng = bare(), np.random.default_rng(3)
    lights = tuple(
        level * rng.uniform(0.2, 1.4, (8, 16, 3)).astype(np.float32)
        for level in (0.15, 0.6, 0.3, 1.0)
    )
    lights = tuple(
        np.roll(light * np.exp(rng.normal(size=3) * 0.3), i, 1).astype(np.float32)
        for i, light in enumerate(lights)
    )
    asset = replace(asset, environment=lights[0], lights=lights, meta={"held_out": ["2.png"]})
    scenes = [build_scene(asset.mesh, asset.material, None, light) for light in lights]
    return (
        asset,
        [render(s, c, spp=SPP, seed=9) for s, (_, c) in zip(scenes, asset.cameras, strict=True)],
        [None] * 4,
    )


CASES = {"multiview": multiview, "flash": flash, "duplicates": duplicates, "collection": collection}


@pytest.fixture(scope="module", params=CASES)
def made(request):
    """(kind, asset, capture whose photos the asset itself renders)."""
    asset, pictures, labels = CASES[request.param]()
    photos = []
    for (name, camera), picture, label in zip(asset.cameras, pictures, labels, strict=True):
        mask, rgb = (
            picture[..., 3],
            picture[..., :3] / np.maximum(picture[..., 3:], 1e-3),
        )  # at an edge the object alone
        pixels = (
            Pixels(rgb, mask)
            if label is None
            else Pixels(picture[..., :3], (label > 0).astype(np.float32), labels=label)
        )
        wrong = (
            camera.with_pose(np.eye(4)) if request.param == "collection" else camera
        )  # its format's own frame
        photos.append(Photo(name, lambda pixels=pixels: pixels, W, H, wrong))
    held = photos[2:3] if request.param == "collection" else []
    return (
        request.param,
        asset,
        Capture(None, "photos", tuple(p for p in photos if p not in held), tuple(held)),
    )


@pytest.mark.slow
def test_what_the_report_draws_is_what_the_photos_show(made, tmp_path, report_sizes):
    kind, asset, capture = made
    assert kind_of(asset) == kind
    report_sizes(SIDE=W, STILLS=3, SPP=2, SPP_COMPARED=SPP, VIEWS=2)
    save_asset(tmp_path / "asset", asset)
    text = report.write_report(tmp_path, capture).read_text()
    section = text.split("<h2>")[1]
    shown = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(s.split('"')[0])))) / 255.0
        for s in section.split("base64,")[1:]
    ]
    assert len(shown) == {"multiview": 2, "flash": 2, "duplicates": 1, "collection": 3}[kind]
    for row in shown:
        photo, drawn, difference = row[:, :W], row[:, W : 2 * W], row[:, 2 * W :]
        inside = photo.max(-1) > 0.1
        assert inside.mean() > 0.05 and drawn[inside].mean() > 0.15  # not black
        assert psnr(drawn, photo, inside) > 24 and difference.mean() < 0.12  # four times noise
    said = {
        "flash": "rough plastic",
        "duplicates": "3 of 4 objects that are registered",
        "collection": "2.png (held out)",
    }
    assert said.get(kind, "environment") in section
    assert {"flash": "specular albedo", "collection": "light of"}.get(kind, "base colour") in text
    assert "offset (0.4, 0.1, 0)" in text if kind == "flash" else "mean radiance" in text


def test_the_caption_tells_a_wrong_picture(made):
    """Half of the light, or an object at another place, costs decibels."""
    kind, asset, capture = made
    wrong = {
        "multiview": lambda: replace(asset, environment=asset.environment * 0.5),
        "flash": lambda: replace(
            asset, flash=Flash(asset.flash.offset, asset.flash.intensity * 0.5)
        ),
        "duplicates": lambda: replace(
            asset, instances=tuple(Instance(k, HALF @ HALF) for k in PLACES)
        ),
        "collection": lambda: replace(asset, lights=asset.lights[::-1]),
    }[kind]()
    options = {"views": 2, "held_out": 1, "side": W, "spp": 16}
    for good, bad in zip(
        pairs(asset, capture, **options), pairs(wrong, capture, **options), strict=True
    ):
        best, worst = (
            psnr(encode(p.render[..., :3]), encode(p.photo), good.where) for p in (good, bad)
        )
        assert best > worst + 4 and bad.difference.mean() > good.difference.mean()
        assert f"{best:.1f} dB" in good.caption


def test_photos_and_labels_are_shrunk_alike():
    asset, pictures, labels = duplicates()
    name, camera = asset.cameras[0]
    large = [
        cv2.resize(a, (2 * W, 2 * H), interpolation=cv2.INTER_NEAREST)
        for a in (pictures[0][..., :3], labels[0].astype(np.int32))
    ]
    photo = Photo(
        name,
        lambda: Pixels(large[0], None, labels=large[1]),
        2 * W,
        2 * H,
        camera.resized(2 * W, 2 * H),
    )
    asset = replace(asset, cameras=((name, camera.resized(2 * W, 2 * H)),))
    (pair,) = pairs(
        asset, Capture(None, "duplicates", (photo,)), views=4, held_out=2, side=W, spp=16
    )
    assert (
        pair.photo.shape == (H, W, 3)
        and (pair.where == np.isin(labels[0], list(PLACES))).mean() > 0.99
    )
