"""Photos into an asset: python examples/02_reconstruct.py PHOTOS RUN [QUALITY].

The same call again resumes, or finds it done.
"""

import sys

import relit

photos, run, quality = sys.argv[1], sys.argv[2], (sys.argv[3:] or ["draft"])[0]
result = relit.reconstruct(photos, run, quality=quality)
mesh, material = result.asset.mesh, result.asset.material
print(
    f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, textures of {material.base_color.shape[1]} pixels"
)
for name in ("base_color", "roughness", "metallic"):
    print(f"{name} {getattr(material, name).mean():.2f} on average")
print(result.folder / "object.glb")
