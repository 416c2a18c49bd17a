"""Pictures under a light of one's own making: python examples/03_relight.py RUN OUT

Lights are lat-long arrays in linear radiance, row 0 up; this one is a warm lamp over a dim blue
sky.
"""

import sys
from pathlib import Path

import numpy as np

import relit
from relit.conventions import environment_directions
from relit.images import write_linear

run, out = sys.argv[1], Path(sys.argv[2])
d = environment_directions(64, 128)  # (64, 128, 3) unit directions of the texels
lamp = np.exp(80 * (d @ [0.6, 0.64, 0.48] - 1))[..., None]
sky = np.clip(d[..., 1:2], 0, 1)
write_linear(out / "lamp.exr", 40 * lamp * [1.0, 0.8, 0.55] + 0.4 * sky * [0.5, 0.7, 1.0] + 0.03)
for picture in relit.load(run).relight(
    out / "lamp.exr", out / "pictures", cameras="orbit:3", size=96, spp=16
):
    print(picture)
