"""OBJ and MTL: quads, negative indices, missing pieces."""

import numpy as np
import pytest

from relit.asset.gltf import read_asset_file
from relit.errors import UserError
from relit.images import write_srgb

QUAD = """mtllib a.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl m
f 1/1 2/2 3/3 -1/-1
"""


def test_quad_with_texture(tmp_path):
    picture = np.zeros((2, 2, 3), np.float32)
    picture[0, 0] = [1, 0, 0]  # top left
    write_srgb(tmp_path / "t.png", picture)
    (tmp_path / "a.obj").write_text(QUAD)
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd -clamp on t.png\nPr 0.25\nPm 1\n")
    mesh, material = read_asset_file(tmp_path / "a.obj")
    assert mesh.faces.shape == (2, 3)
    assert np.allclose(mesh.normals, [0, 0, 1])
    top_left = np.flatnonzero((mesh.vertices == [0, 1, 0]).all(1))[0]
    assert np.allclose(mesh.uvs[top_left], [0, 0])
    assert np.allclose(material.base_color, picture)
    assert (material.roughness.item(), material.metallic.item()) == (0.25, 1.0)


@pytest.mark.parametrize(
    ("obj", "mtl"),
    [
        (QUAD, None),
        (QUAD, "newmtl m\nmap_Kd gone.png\n"),
        ("v 0 0 0\nf 1 2 3\n", ""),
        ("v 0 0 zero\n", ""),
        ("v 0 0 0\n", ""),
    ],
    ids=["no mtl", "no texture", "indices", "number", "no faces"],
)
def test_broken_files_get_an_answer(tmp_path, obj, mtl):
    (tmp_path / "a.obj").write_text(obj)
    if mtl is not None:
        (tmp_path / "a.mtl").write_text(mtl)
    with pytest.raises(UserError):
        read_asset_file(tmp_path / "a.obj")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "spot/spot.obj",
        "bob/bob_tri.obj",
        "BoomBox.glb",
        "painted_wooden_stool_1k.glb",
        "tea_set_01_1k.glb",
    ],
)
def test_models_at_hand_are_read(shared, name):
    mesh, material = read_asset_file(shared / "assets" / name)
    corners = mesh.vertices[mesh.faces].astype(float)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.mean((face * mesh.normals[mesh.faces].mean(1)).sum(-1) > 0) > 0.99
    assert material.base_color.shape[0] >= 1024
    assert np.isfinite(mesh.uvs).all()
