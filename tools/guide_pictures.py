"""Renders the pictures of the guide (docs/pictures/*.jpg) with Relit's own object and lights.

.venv/bin/python tools/guide_pictures.py
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))

from relit.device import use_device  # noqa: E402

use_device("cpu")

from relit.conventions import (  # noqa: E402
    direction_from_uv,
    environment_directions,
    environment_solid_angles,
    srgb_from_linear,
    uv_from_direction,
)
from relit.geometry.se3 import exp_so3, look_at  # noqa: E402
from relit.reference.mitsuba_scene import build_scene, render  # noqa: E402
from relit.scene import Camera, Mesh  # noqa: E402
from relit.synthesize.procedural import evening, pawn, studio  # noqa: E402

SIDE, SPP = 150, 48
MIDDLE = np.array([0.0, 0.8, 0.0])
MESH, PAINT = pawn(80, 120, 256)


def camera(angle, height=1.6, distance=3.4, zoom=1.7, aim=MIDDLE):
    eye = np.array([distance * np.sin(angle), height, distance * np.cos(angle)])
    return Camera(SIDE, SIDE, zoom * SIDE, zoom * SIDE, SIDE / 2, SIDE / 2, look_at(eye, aim))


def lobe(direction, strength, width=400.0, around=0.0):
    d = environment_directions(32, 64)
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    return (around + strength * np.exp(width * (d @ direction - 1))[..., None] * np.ones(3)).astype(
        np.float32
    )


def shot(light, view, mesh=MESH, backdrop=0.12, gain=1.0):
    """(SIDE, SIDE, 3) sRGB in [0, 1]."""
    scene = build_scene(mesh, PAINT, np.eye(4), light)
    picture = render(scene, view, spp=SPP) * gain
    return np.clip(
        srgb_from_linear(
            picture[..., :3] + (1 - np.clip(picture[..., 3:] / gain, 0, 1)) * backdrop
        ),
        0,
        1,
    )


def flash(view):
    towards = view.centre - MIDDLE
    light = lobe(towards, 1.0, 600.0)
    return light * np.float32(
        2.4 / (light[..., 0] * environment_solid_angles(*light.shape[:2])).sum()
    )


def pile(poses):
    parts = [(MESH.vertices @ r.T + t, MESH.normals @ r.T) for r, t in poses]
    n = len(MESH.vertices)
    return Mesh(
        np.concatenate([v for v, _ in parts]).astype(np.float32),
        np.concatenate([MESH.faces + i * n for i in range(len(parts))]).astype(np.int32),
        np.concatenate([m for _, m in parts]).astype(np.float32),
        np.concatenate([MESH.uvs] * len(parts)),
    )


def sheet(name, rows):
    """rows: [(word, colour, [(picture, caption), ...]), ...]; pictures in sRGB."""
    font = ImageFont.load_default(size=12)
    columns = max(len(pictures) for _, _, pictures in rows)
    out = Image.new("RGB", (60 + columns * (SIDE + 8), len(rows) * (SIDE + 26)), (250, 250, 250))
    draw = ImageDraw.Draw(out)
    for j, (word, colour, pictures) in enumerate(rows):
        y = j * (SIDE + 26)
        draw.text((6, y + SIDE // 2), word, fill=colour, font=font)
        for i, (picture, caption) in enumerate(pictures):
            x = 60 + i * (SIDE + 8)
            out.paste(Image.fromarray((picture * 255).astype(np.uint8)), (x, y + 2))
            draw.text((x, y + SIDE + 5), caption, fill=(60, 60, 60), font=font)
    out.save(ROOT / "docs/pictures" / f"{name}.jpg", quality=80)


GOOD, BAD = ("good", (20, 120, 40)), ("bad", (180, 40, 30))


def multiview():
    light = studio(32)
    good = [
        (shot(light, camera(a, h)), c)
        for a, h, c in (
            (0, 1.2, "sharp, large"),
            (0.6, 1.2, "a third further"),
            (1.2, 1.2, "and so on"),
            (0.6, 2.6, "from above"),
        )
    ]
    still = shot(light, camera(0.3))
    kernel = np.zeros((11, 11))
    kernel[5] = 1 / 11
    bad = [
        (cv2.filter2D(still, -1, kernel), "moved"),
        (shot(light, camera(0.3, zoom=0.4)), "too small"),
        (shot(light, camera(0.3), gain=3.5), "blown out"),
        (shot(lobe([-1, 0.4, 0.2], 60, 60, 0.1), camera(0.3)), "the lamp moved"),
    ]
    sheet("multiview", [(*GOOD, good), (*BAD, bad)])


def flashes():
    views = [camera(a, 1.4) for a in (0, 0.6, 1.2)]
    good = [(shot(flash(v), v, backdrop=0.002), "dark room, flash only") for v in views]
    bad = [
        (shot(flash(views[0]) + studio(32), views[0]), "the room is lit"),
        (shot(flash(views[1]) * 4, views[1], backdrop=0.002), "too close: clipped"),
        (shot(flash(views[2]) * 0.05, views[2], backdrop=0.002), "too far: noise"),
    ]
    sheet("flash", [(*GOOD, good), (*BAD, bad)])


def duplicates():
    rng = np.random.default_rng(4)
    light, view = studio(32), camera(0.2, 4.2, 5.5, 1.1, np.array([0, 0.3, 0]))
    turned = [
        (exp_so3(rng.normal(size=3) * 1.4), np.array([1.6 * x, 0.4, 1.6 * z]))
        for x in (-1, 0, 1)
        for z in (-1, 0, 1)
    ]
    alike = [(np.eye(3), np.array([1.5 * x, 0, 1.5 * z])) for x in (-1, 0, 1) for z in (-1, 0, 1)]
    heap = [(exp_so3(rng.normal(size=3) * 1.4), rng.normal(size=3) * 0.35) for _ in range(9)]
    bad = [
        (shot(light, view, pile(alike)), "all from one side"),
        (shot(light, view, pile(heap)), "hidden by each other"),
    ]
    sheet(
        "duplicates",
        [(*GOOD, [(shot(light, view, pile(turned)), "turned every way")]), (*BAD, bad)],
    )


def collection():
    lights = [
        studio(32),
        evening(32),
        lobe([0.2, 0.8, 0.5], 40, 60, 0.15),
        lobe([-1, 0.3, 0.2], 30, 20, 0.1) * np.array([1, 0.8, 0.6], np.float32),
    ]
    good = [
        (shot(light, camera(1.4 * i, 1.2 + 0.4 * i), backdrop=b), "another place")
        for i, (light, b) in enumerate(zip(lights, (0.1, 0.4, 0.02, 0.2), strict=True))
    ]
    view = camera(0.3)
    half = shot(lights[0], view)
    half[:, SIDE // 2 :] = 0.35
    tinted = dataclasses.replace(PAINT, base_color=PAINT.base_color[..., [2, 0, 1]])
    other = render(build_scene(MESH, tinted, np.eye(4), lights[0]), view, spp=SPP)
    bad = [
        (half, "half hidden"),
        (
            np.clip(srgb_from_linear(other[..., :3] + (1 - other[..., 3:]) * 0.12), 0, 1),
            "another specimen",
        ),
    ]
    sheet("collection", [(*GOOD, good), (*BAD, bad)])


def axes():
    """A lat-long map with the six directions, and the object under a lamp at +X: what
    `docs/conventions.md` says in words."""
    h, w = 150, 300
    d = direction_from_uv(
        np.stack(np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h), -1)
    )
    picture = Image.fromarray(((0.5 + 0.4 * d) * 255).astype(np.uint8))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=13)
    for name, direction in {
        "+X": [1, 0, 0],
        "-X": [-1, 0, 0],
        "+Y": [0, 0.97, 0.24],
        "-Y": [0, -0.97, 0.24],
        "+Z": [0, 0, 1],
        "-Z": [0.15, 0, -0.99],
    }.items():
        u, v = uv_from_direction(np.array(direction) / np.linalg.norm(direction))
        draw.text((u * w - 9, v * h - 8), name, fill=(0, 0, 0), font=font)
    lit = Image.fromarray(
        (shot(lobe([1, 0.2, 0], 40, 60, 0.06), camera(0.0, 1.2)) * 255).astype(np.uint8)
    )
    out = Image.new("RGB", (w + SIDE + 12, SIDE + 22), (250, 250, 250))
    out.paste(picture, (0, 0))
    out.paste(lit, (w + 12, 0))
    draw = ImageDraw.Draw(out)
    draw.text((2, SIDE + 4), "environment map: row 0 is +Y", fill=(60, 60, 60), font=font)
    draw.text((w + 12, SIDE + 4), "lamp at +X, seen from +Z", fill=(60, 60, 60), font=font)
    out.save(ROOT / "docs/pictures/axes.jpg", quality=85)


if __name__ == "__main__":
    (ROOT / "docs/pictures").mkdir(parents=True, exist_ok=True)
    for make in (multiview, flashes, duplicates, collection, axes):
        make()
