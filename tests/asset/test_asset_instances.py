"""instances.json and scene.glb: written, read back, damaged."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from relit.asset.asset import load_asset, save_asset
from relit.conventions import similarity
from relit.errors import UserError
from relit.geometry.se3 import exp_so3
from relit.scene import Asset, Ground, Instance, Material, Mesh


def asset():
    box = trimesh.creation.box((1, 2, 3))
    mesh = Mesh(
        np.asarray(box.vertices, np.float32),
        np.asarray(box.faces, np.int32),
        np.asarray(box.vertex_normals, np.float32),
    )
    material = Material(
        np.full((1, 1, 3), 0.5, np.float32),
        np.full((1, 1), 0.4, np.float32),
        np.zeros((1, 1), np.float32),
    )
    poses = [similarity(exp_so3(np.array([0.2 * k, 1.0, 0])), [3 * k, 0, -5]) for k in range(2)]
    instances = (
        Instance(42, poses[0]),
        Instance(85, None, "it agrees too little"),
        Instance(127, poses[1], "ambiguous: turned by 90 degrees"),
    )
    ground = Ground(np.array([0, -1, 0.0]), np.array([0, 1, 0.0]), 9.0, np.array([0.2, 0.3, 0.4]))
    return Asset(mesh, material, poses[0], None, (), {}, None, instances, ground)


def test_round_trip(tmp_path):
    a = asset()
    b = load_asset(save_asset(tmp_path / "asset", a))
    assert [(i.label, i.registered, i.reason) for i in b.instances] == [
        (i.label, i.registered, i.reason) for i in a.instances
    ]
    assert np.allclose(b.instances[2].world_from_object, a.instances[2].world_from_object)
    assert np.allclose(b.ground.point, a.ground.point) and b.ground.radius == 9.0


def test_scene_glb_has_one_mesh_and_a_node_for_each_registered_instance(tmp_path):
    a = asset()
    folder = save_asset(tmp_path / "asset", a)
    scene = trimesh.load(folder / "scene.glb")
    assert len(scene.geometry) == 1 and sorted(scene.graph.nodes_geometry) == [
        "instance_127",
        "instance_42",
    ]
    expected = np.linalg.inv(a.world_from_asset) @ a.instances[2].world_from_object
    assert np.allclose(scene.graph["instance_127"][0], expected, atol=1e-5)


@pytest.mark.parametrize(
    "damage", ["{", '{"instances": [{"label": 1, "registered": true}]}', '{"instances": 3}', "[]"]
)
def test_damaged_files_are_told(tmp_path, damage):
    folder = save_asset(tmp_path / "asset", asset())
    (folder / "instances.json").write_text(damage)
    with pytest.raises(UserError, match="instances"):
        load_asset(folder)


def test_a_singular_pose_is_told(tmp_path):
    folder = save_asset(tmp_path / "asset", asset())
    data = json.loads((folder / "instances.json").read_text())
    data["instances"][0]["world_from_object"] = np.zeros((4, 4)).tolist()
    (folder / "instances.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match="no regular"):
        load_asset(folder)
