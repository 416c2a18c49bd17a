"""Learn the prior of per-photo lights: `python tools/light_prior.py FOLDER [--without NAME,...]
[--network FOLDER] [--draws 1500]`.

Writes src/relit/lighting/light_prior.npz. Every .hdr and .exr in the folder whose stem does not
begin with one of the names is averaged down to 16 x 32 texels, brought to mean luminance 1, turned
about the vertical in 32 steps and mirrored; with a Neural-PIL network so many lights drawn from its
codes join them, each under four turns. The file holds the mean of the log radiance and its first
principal components times their standard deviations.

The network's lights know neither up nor down and nothing small and bright. So each drawn light gets
up to three lamps or suns above the horizon, and what is below the horizon becomes a ground of
reflectance .1 to .5, lit by what is above.

What is shipped was learnt without the six HDRIs that light the suite `collection`: `python
tools/light_prior.py ENVMAPS --without
adams_place,empty_warehouse,forest_slope,immenstadter,kiara,lebombo --network NEURAL_PIL`.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from relit.conventions import environment_directions, environment_solid_angles, luminance
from relit.images import read_image
from relit.lighting.neural_pil import load_neural_pil
from relit.lighting.per_photo import COLUMNS, ROWS

COMPONENTS = 96
TURNS = 4  # of a drawn light
LAMPS = (0, 1, 1, 2, 3)  # as likely each
WIDTH = (6.0, 16.0)  # degrees, of a lamp
SHARE = (0.1, 0.7)  # of all light that lamps bring together
REFLECTANCE = (0.25, 0.4)  # of the ground: median, standard deviation of its logarithm
WEIGHT = environment_solid_angles(ROWS, COLUMNS) / (4 * np.pi)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--without", default="")
    parser.add_argument("--network", type=Path)
    parser.add_argument("--draws", type=int, default=1500)
    args = parser.parse_args()
    without = tuple(n for n in args.without.split(",") if n)
    files = sorted(f for f in args.folder.iterdir() if f.suffix.lower() in (".hdr", ".exr"))
    files = [f for f in files if not (without and f.stem.startswith(without))]
    rows = []
    for file in files:
        small = level(
            cv2.resize(read_image(file).rgb, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
        )
        rows += [
            np.roll(m, k, axis=1).ravel() for m in (small, small[:, ::-1]) for k in range(COLUMNS)
        ]
    rng = np.random.default_rng(0)
    if args.network:
        network = load_neural_pil(args.network)
        for row in network.log_maps(rng.normal(size=(args.draws, network.size)).astype(np.float32)):
            small = level(grounded(with_lamps(np.exp(row).reshape(ROWS, COLUMNS, 3), rng), rng))
            rows += [
                np.roll(small, int(k), axis=1).ravel() for k in rng.integers(0, COLUMNS, TURNS)
            ]
    rows = np.array(rows)
    mean = (
        rows.mean(0).reshape(ROWS, COLUMNS, 3).mean(1, keepdims=True)
    )  # no azimuth is likelier than another
    mean = np.repeat(mean, COLUMNS, 1).ravel()
    _, s, vt = np.linalg.svd(rows - mean, full_matrices=False)
    kept = float((s[:COMPONENTS] ** 2).sum() / (s**2).sum())
    basis = vt[:COMPONENTS] * (s[:COMPONENTS, None] / np.sqrt(len(rows)))
    out = Path(__file__).parents[1] / "src" / "relit" / "lighting" / "light_prior.npz"
    np.savez_compressed(out, mean=mean.astype(np.float16), basis=basis.astype(np.float16))
    drawn = args.draws if args.network else 0
    size = out.stat().st_size / 1024
    print(
        f"{len(files)} HDRIs, {drawn} drawn lights; {COMPONENTS} components hold {kept:.0%} of the variance; {size:.0f} KiB: {out}"
    )


def with_lamps(radiance: np.ndarray, rng) -> np.ndarray:
    """The map with lamps of nearly its own colour above the horizon."""
    directions, count = environment_directions(ROWS, COLUMNS), int(rng.choice(LAMPS))
    if not count:
        return radiance
    lamps = np.zeros_like(radiance)
    for _ in range(count):
        height, azimuth = np.radians(rng.uniform(5, 85)), rng.uniform(0, 2 * np.pi)
        towards = np.array(
            [np.cos(height) * np.sin(azimuth), np.sin(height), np.cos(height) * np.cos(azimuth)]
        )
        sharpness = 1 / np.radians(rng.uniform(*WIDTH)) ** 2
        lobe = np.exp(sharpness * (directions @ towards - 1))[..., None] * np.exp(
            rng.normal(size=3) * 0.15
        )
        lamps += lobe / (lobe * WEIGHT[..., None]).sum() * rng.uniform(0.3, 1)
    share, whole = rng.uniform(*SHARE), (radiance * WEIGHT[..., None]).sum()
    return (1 - share) * radiance + share * whole * lamps / (lamps * WEIGHT[..., None]).sum()


def grounded(radiance: np.ndarray, rng) -> np.ndarray:
    """The map, its lower half scaled, channel by channel, so that the ground sends back what it
    reflects of the light from above."""
    height = environment_directions(ROWS, COLUMNS)[..., 1:2]
    down, up = (np.maximum(s * height, 0) * WEIGHT[..., None] * 4 for s in (1, -1))
    reflectance = REFLECTANCE[0] * np.exp(rng.normal() * REFLECTANCE[1] + rng.normal(size=3) * 0.15)
    factor = reflectance * (radiance * down).sum((0, 1)) / (radiance * up).sum((0, 1))
    blend = np.clip(0.5 - height / 0.2, 0, 1)  # across the horizon
    return radiance * factor**blend


def level(radiance: np.ndarray) -> np.ndarray:
    """Log radiance of a map brought to mean luminance 1."""
    return np.log(np.maximum(radiance / (luminance(radiance) * WEIGHT).sum(), 1e-3))


if __name__ == "__main__":
    main()
