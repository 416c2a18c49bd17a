"""What stands around an object in a photo: a textured table or plate under it, and the light behind.

Everything is Mitsuba's: `principled` for object and table, its path tracer, its own shapes. Textures
are made of formulas, from a seed, or read from a file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.scene import Camera, Material, Mesh
from relit.synthesize.delivery import in_front_of

TEXTURES = ("wood", "cloth", "speckle")
TEXTURE_SIZE = 2048  # pixels a side: about one of a photo's at the default sizes
ROUGHNESS = {"wood": 0.45, "cloth": 0.9, "speckle": 0.6}
FILE_ROUGHNESS = 0.6  # of a supplied picture
PLANK_COUNT = 7  # over the table
MAX_DEPTH = 10  # edges of the longest path, as `--renderer mitsuba`
DISC_SIZE = 1024  # texels along the radius of a plate
COVERAGE_SAMPLES = 16  # rays a pixel of the object's coverage


@dataclass(frozen=True)
class Support:
    """What the object stands on. shape: 'square' (a table, radius = half a side) or 'disc' (a
    plate). height: of its surface, world units. colour: (H, W, 3) linear base colour. roughness: of
    `principled`. turn: radians about the vertical."""

    shape: str
    radius: float
    height: float
    colour: np.ndarray
    roughness: float
    turn: float = 0.0


def table_texture(name: str | Path, seed: int) -> tuple[np.ndarray, float]:
    """(H, W, 3) linear base colour and roughness: one of TEXTURES, or a picture file."""
    if Path(name).is_file():
        from relit.images import read_image

        return np.ascontiguousarray(read_image(name).rgb), FILE_ROUGHNESS
    if str(name) not in TEXTURES:
        raise UserError(
            f"unknown texture '{name}'.{did_you_mean(str(name), TEXTURES)}",
            fix=f"choose one of: {', '.join(TEXTURES)}, or give a picture",
            code=EXIT_USAGE,
        )
    rng = np.random.default_rng([seed, 70])
    make = {"wood": wood, "cloth": cloth, "speckle": speckle}[str(name)]
    return make(TEXTURE_SIZE, rng), ROUGHNESS[str(name)]


def _noise(size: int, cells: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """(size, size) smooth noise of mean 0 and deviation 1; cells: features along y and x."""
    shape = (max(2, round(cells[0])), max(2, round(cells[1])))
    coarse = rng.normal(size=shape).astype(np.float32)
    out = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    return (out - out.mean()) / max(float(out.std()), 1e-6)


def wood(size: int, rng: np.random.Generator) -> np.ndarray:
    """Planks with growth rings, grain along x and dark joints."""
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    plank = np.floor(y * PLANK_COUNT).astype(int)
    shift = rng.uniform(0, 10, PLANK_COUNT).astype(np.float32)[plank]
    tone = rng.uniform(0.7, 1.15, PLANK_COUNT).astype(np.float32)[plank]
    bend = 0.25 * _noise(size, (3 * PLANK_COUNT, 5), rng) + 0.06 * _noise(size, (60, 20), rng)
    rings = 0.5 + 0.5 * np.sin(6.28 * (y * PLANK_COUNT * 3.5 + shift + bend))
    grain = 0.5 * _noise(size, (700, 25), rng) + 0.5 * _noise(size, (1000, 60), rng)
    level = tone * (0.62 + 0.38 * rings) * (1 + 0.13 * grain)
    level *= np.where(np.abs(y * PLANK_COUNT - np.round(y * PLANK_COUNT)) < 0.012, 0.35, 1)
    knots = np.zeros_like(level)
    for cx, cy in rng.uniform(0, 1, (9, 2)):
        knots += np.exp(-(((x - cx) / 0.012) ** 2) - ((y - cy) / 0.007) ** 2)
    colour = np.array([0.36, 0.20, 0.10], np.float32) * level[..., None]
    return np.clip(colour * (1 - 0.7 * np.clip(knots, 0, 1))[..., None], 0.01, 0.9)


def cloth(size: int, rng: np.random.Generator) -> np.ndarray:
    """A woven check of two colours with uneven threads and stains."""
    y, x = np.mgrid[:size, :size].astype(np.float32) / size
    a, b = rng.uniform(0.08, 0.7, (2, 3)).astype(np.float32)
    widths = 1 + 0.15 * _noise(size, (9, 9), rng)
    check = ((np.sin(6.28 * 9 * x * 1.0 + 0.3 * widths) > 0.2).astype(np.float32)) + (
        np.sin(6.28 * 9 * y + 0.2 * widths) > 0.2
    )
    threads = 0.5 + 0.25 * np.sin(6.28 * 230 * x) + 0.25 * np.sin(6.28 * 230 * y)
    level = (0.75 + 0.35 * threads) * (1 + 0.12 * _noise(size, (300, 300), rng))
    stain = np.clip(_noise(size, (12, 12), rng) - 1.0, 0, 1)[..., None]
    colour = a + (b - a) * (check / 2)[..., None]
    return np.clip(colour * level[..., None] * (1 - 0.4 * stain), 0.01, 0.9)


def speckle(size: int, rng: np.random.Generator) -> np.ndarray:
    """Coloured speckles at several sizes: what a mat with a print has."""
    colour = np.full((size, size, 3), 0.45, np.float32)
    for cells, weight in ((12, 0.10), (60, 0.12), (250, 0.12)):
        for c in range(3):
            colour[..., c] += weight * np.clip(_noise(size, (cells, cells), rng), -2, 2)
    return np.clip(colour, 0.03, 0.9)


# ---------------------------------------------------------------- scenes


@dataclass(frozen=True)
class StagedObject:
    """An object on its supports under a light, for photos.

    whole, alone: Mitsuba scenes of everything and of the object without supports, in one frame.
    seen: (H, W, 3) lat-long radiance behind, out of focus.
    """

    whole: Any
    alone: Any
    seen: np.ndarray

    def take(self, camera: Camera, spp: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """`delivery.Take`: radiance (H, W, 3) of the scene, coverage (H, W) of the object."""
        from relit.reference.mitsuba_scene import render, render_channels

        rgba = render(self.whole, camera, spp=spp, seed=seed, max_depth=MAX_DEPTH)
        radiance, _ = in_front_of(self.seen, camera, rgba)
        alpha = render_channels(self.alone, camera, spp=COVERAGE_SAMPLES, seed=seed)["alpha"]
        return radiance, alpha


def staged(
    thing: tuple[Mesh, Material, np.ndarray],
    environment: np.ndarray,
    supports: tuple[Support, ...],
    blur: float,
) -> StagedObject:
    """thing: mesh, material, world_from_asset. environment: (H, W, 3) lat-long radiance, world
    frame. blur: degrees by which the light behind is out of focus."""
    import mitsuba as mi

    from relit.reference.mitsuba_scene import build_scene, environment_bitmap

    alone = build_scene(*thing, environment, bsdf="principled")
    content: dict[str, Any] = {"type": "scene"}
    for i, shape in enumerate(alone.mi_scene.shapes()):
        content[f"object{i}"] = shape
    for i, support in enumerate(supports):
        content[f"support{i}"] = support_plugin(support, alone.unit_from_world)
    bitmap = mi.Bitmap(environment_bitmap(environment))
    content["environment"] = {"type": "envmap", "bitmap": bitmap}
    whole = replace(alone, mi_scene=mi.load_dict(content))
    return StagedObject(whole, alone, out_of_focus(environment, blur))


def support_plugin(support: Support, unit_from_world: np.ndarray) -> dict[str, Any]:
    """A rectangle or disc for `load_dict`, its normal up."""
    import mitsuba as mi

    from relit.reference.mitsuba_scene import mitsuba_texture

    c, s, r = np.cos(support.turn), np.sin(support.turn), support.radius
    # the plugins lie in x, y with the normal z: x -> x, y -> -z, z -> y, turned about y
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    lay = np.array([[r, 0, 0], [0, 0, 1], [0, -r, 0]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ lay
    pose[:3, 3] = (0, support.height, 0)
    disc = support.shape == "disc"
    colour = polar_texture(support.colour) if disc else support.colour
    bsdf = {
        "type": "twosided",
        "bsdf": {
            "type": "principled",
            "base_color": mitsuba_texture(colour, color=True),
            "roughness": float(support.roughness),
        },
    }
    return {
        "type": "disk" if disc else "rectangle",
        "to_world": mi.ScalarTransform4f(np.asarray(unit_from_world) @ pose),
        "bsdf": bsdf,
    }


def polar_texture(colour: np.ndarray) -> np.ndarray:
    """(H, W, 3) texture of Mitsuba's disk, u = radius and v = angle, that shows the square texture
    `colour` flat. A mask over a rectangle would block shadow rays."""
    h, w = colour.shape[:2]
    radius = (np.arange(DISC_SIZE) + 0.5) / DISC_SIZE
    angle = (np.arange(2 * DISC_SIZE) + 0.5) / (2 * DISC_SIZE) * 2 * np.pi
    x = (radius * np.cos(angle[:, None]) + 1) / 2 * w - 0.5
    y = (radius * np.sin(angle[:, None]) + 1) / 2 * h - 0.5
    return cv2.remap(
        np.asarray(colour, np.float32),
        x.astype(np.float32),
        y.astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def out_of_focus(environment: np.ndarray, degrees: float) -> np.ndarray:
    """The lat-long map (H, W, 3) blurred by a Gaussian of `degrees`, wrapped around the vertical;
    without a correction for the poles, which photos do not show."""
    if degrees <= 0:
        return environment
    sigma = degrees / 180 * environment.shape[0]
    pad = min(int(4 * sigma) + 1, environment.shape[1])
    wide = np.concatenate([environment[:, -pad:], environment, environment[:, :pad]], 1)
    # the sun in one texel would become a bright disc: lights keep at most 20 times the mean
    top = 20 * float(environment.mean())
    return cv2.GaussianBlur(np.minimum(wide, top), (0, 0), sigma)[:, pad:-pad].astype(np.float32)
