"""Learn the prior of per-photo lights from HDRIs: `python tools/light_prior.py FOLDER`, writes src/relit/lighting/light_prior.npz.

Every .hdr and .exr in the folder is averaged down to 16 x 32 texels, brought to mean luminance 1, turned about the vertical in 32 steps and
mirrored; the file holds the mean of the log radiance and its first principal components times their standard deviations.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from relit.conventions import environment_solid_angles, luminance
from relit.images import read_image
from relit.lighting.per_photo import COLUMNS, ROWS

COMPONENTS = 40


def main(folder: Path) -> None:
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in (".hdr", ".exr"))
    weight = environment_solid_angles(ROWS, COLUMNS) / (4 * np.pi)
    rows = []
    for file in files:
        small = cv2.resize(read_image(file).rgb, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
        small = np.log(np.maximum(small / (luminance(small) * weight).sum(), 1e-3))
        for turned in (np.roll(m, k, axis=1) for m in (small, small[:, ::-1]) for k in range(COLUMNS)):
            rows.append(turned.ravel())
    rows = np.array(rows)
    mean = rows.mean(0)
    _, s, vt = np.linalg.svd(rows - mean, full_matrices=False)
    kept = float((s[:COMPONENTS] ** 2).sum() / (s**2).sum())
    basis = vt[:COMPONENTS] * (s[:COMPONENTS, None] / np.sqrt(len(rows)))
    out = Path(__file__).parents[1] / "src" / "relit" / "lighting" / "light_prior.npz"
    np.savez_compressed(out, mean=mean.astype(np.float16), basis=basis.astype(np.float16))
    print(f"{len(files)} HDRIs, {COMPONENTS} components hold {kept:.0%} of the variance, {out.stat().st_size / 1024:.0f} KiB: {out}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
