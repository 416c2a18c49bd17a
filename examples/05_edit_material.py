"""Another material on a recovered shape: python examples/05_edit_material.py RUN FILE.glb

An `Asset` is a frozen dataclass of arrays: change a copy, write it.
"""

import sys
from dataclasses import replace

import numpy as np

import relit
from relit.asset.gltf import write_glb

asset = relit.load(sys.argv[1]).asset
glossy = replace(
    asset.material,
    roughness=np.minimum(asset.material.roughness, 0.25),
    base_color=asset.material.base_color**1.2,
)
write_glb(sys.argv[2], asset.mesh, glossy)
print(sys.argv[2])
