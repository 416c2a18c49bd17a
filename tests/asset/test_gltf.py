"""GLB out and in, by its own reader, by trimesh, by the Khronos validator, and by the pictures."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from relit.asset.gltf import read_asset_file, write_glb
from relit.asset.validate import find_validator, validate_glb
from relit.errors import UserError
from relit.reference.mitsuba_scene import build_scene, render
from relit.scene import Material


def psnr(a, b):
    """Of linear pictures (H, W, 4), clipped to [0, 1]."""
    return -10 * np.log10(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2) + 1e-20)


def parse(path):
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def assemble(doc, blob) -> bytes:
    text = json.dumps(doc).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(blob), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob


def test_round_trip_of_the_arrays(tmp_path, mesh, material):
    write_glb(tmp_path / "a.glb", mesh, material)
    m, t = read_asset_file(tmp_path / "a.glb")
    assert np.array_equal(m.vertices, mesh.vertices)
    assert np.array_equal(m.faces, mesh.faces)
    assert np.array_equal(m.uvs, mesh.uvs)
    assert np.allclose(m.normals, mesh.normals, atol=1e-6)
    assert np.abs(t.base_color - material.base_color).max() < 0.006
    assert np.abs(t.roughness - material.roughness).max() < 0.003
    assert np.abs(t.metallic - material.metallic).max() < 0.003
    assert np.abs(t.normal - material.normal).max() < 0.01
    assert np.abs(t.specular - material.specular[..., None]).max() < 0.006
    assert t.ior == pytest.approx(1.33)


def test_round_trip_of_the_picture(tmp_path, mesh, material, environment, camera):
    write_glb(tmp_path / "a.glb", mesh, material)
    before = render(build_scene(mesh, material, None, environment), camera, spp=8)
    after = render(
        build_scene(*read_asset_file(tmp_path / "a.glb"), None, environment), camera, spp=8
    )
    assert before[..., 3].mean() > 0.2
    assert psnr(before, after) > 45


def test_root_transform_is_undone_by_reading(tmp_path, mesh, material):
    m = np.eye(4)
    m[:3, :3] = [[0, 0, 2], [2, 0, 0], [0, 2, 0]]
    m[:3, 3] = [1, 2, 3]
    write_glb(tmp_path / "a.glb", mesh, material, m)
    got, _ = read_asset_file(tmp_path / "a.glb")
    assert np.allclose(got.vertices, mesh.vertices @ m[:3, :3].T + m[:3, 3], atol=1e-5)
    assert np.allclose(got.normals, mesh.normals @ (m[:3, :3] / 2).T, atol=1e-5)


@pytest.mark.parametrize(
    "kind", ["all maps", "constant", "no uvs", "root transform", "no normal map"]
)
def test_khronos_validator_has_nothing_to_say(tmp_path, mesh, material, kind):
    missing = find_validator()
    if isinstance(missing, str):
        pytest.skip(missing)
    m, t, transform = mesh, material, None
    flat = Material(
        np.full((1, 1, 3), 0.5, np.float32),
        np.full((1, 1), 0.4, np.float32),
        np.zeros((1, 1), np.float32),
    )
    if kind == "constant":
        t = replace(flat, specular=np.full((4, 4), 0.7, np.float32))
    elif kind == "no uvs":
        m, t = replace(mesh, uvs=None, normals=None), flat
    elif kind == "root transform":
        transform = np.diag([1.0, -1.0, -1.0, 1.0])
    elif kind == "no normal map":
        t = replace(material, normal=None, specular=None, ior=1.5)
    write_glb(tmp_path / "a.glb", m, t, transform)
    issues = validate_glb(tmp_path / "a.glb")
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_another_reader_sees_the_same(tmp_path, mesh, material):
    import trimesh

    write_glb(tmp_path / "a.glb", mesh, replace(material, specular=None))
    other = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    assert np.allclose(other.vertices, mesh.vertices)
    assert np.allclose(
        other.visual.uv, mesh.uvs * [1, -1] + [0, 1], atol=1e-6
    )  # trimesh turns v round
    pbr = other.visual.material
    assert (
        np.abs(np.asarray(pbr.metallicRoughnessTexture)[..., 1] / 255 - material.roughness).max()
        < 0.003
    )
    assert (
        np.abs(np.asarray(pbr.metallicRoughnessTexture)[..., 2] / 255 - material.metallic).max()
        < 0.003
    )


def test_factors_and_missing_maps(tmp_path, mesh, material):
    """Factors multiply the maps; without a metallicRoughness texture they stand alone; no material
    at all is glTF's default."""
    write_glb(tmp_path / "a.glb", mesh, material)
    doc, blob = parse(tmp_path / "a.glb")
    pbr = doc["materials"][0]["pbrMetallicRoughness"]
    pbr |= {"roughnessFactor": 0.5, "metallicFactor": 0.25, "baseColorFactor": [0.5, 1, 1, 1]}
    (tmp_path / "b.glb").write_bytes(assemble(doc, blob))
    _, t = read_asset_file(tmp_path / "b.glb")
    assert np.abs(t.roughness - 0.5 * material.roughness).max() < 0.003
    assert np.abs(t.metallic - 0.25 * material.metallic).max() < 0.003
    assert np.abs(t.base_color - material.base_color * [0.5, 1, 1]).max() < 0.006
    del doc["meshes"][0]["primitives"][0]["material"]
    (tmp_path / "c.glb").write_bytes(assemble(doc, blob))
    _, t = read_asset_file(tmp_path / "c.glb")
    assert (t.base_color.ravel().tolist(), t.roughness.item(), t.metallic.item()) == (
        [1, 1, 1],
        1,
        1,
    )


def test_nodes_nest_and_mirrors_keep_the_outside_outside(tmp_path, mesh, material):
    write_glb(tmp_path / "a.glb", mesh, material)
    doc, blob = parse(tmp_path / "a.glb")
    doc["nodes"] = [
        {"children": [1, 2], "translation": [0, 5, 0]},
        {"mesh": 0, "scale": [-1, 1, 1]},
        {"mesh": 0, "rotation": [0, np.sqrt(0.5), 0, np.sqrt(0.5)], "translation": [4, 0, 0]},
    ]
    (tmp_path / "b.glb").write_bytes(assemble(doc, blob))
    m, _ = read_asset_file(tmp_path / "b.glb")
    n = len(mesh.vertices)
    assert len(m.vertices) == 2 * n
    assert np.allclose(m.vertices[:n], mesh.vertices * [-1, 1, 1] + [0, 5, 0], atol=1e-5)
    v = mesh.vertices
    assert np.allclose(
        m.vertices[n:], np.stack([v[:, 2] + 4, v[:, 1] + 5, -v[:, 0]], -1), atol=1e-5
    )
    corners = m.vertices[m.faces].astype(float)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((face * m.normals[m.faces].mean(1)).sum(-1) > 0).all()


def test_several_materials_become_one_atlas(tmp_path, mesh, material, environment, camera):
    """The same object cut in two materials with the same textures looks the same."""
    t = replace(material, specular=None, ior=1.5)
    write_glb(tmp_path / "a.glb", mesh, t)
    doc, blob = parse(tmp_path / "a.glb")
    whole = doc["meshes"][0]["primitives"][0]
    half = doc["accessors"][whole["indices"]]
    count = half["count"] // 6 * 3
    doc["accessors"] += [
        {**half, "count": count},
        {**half, "count": half["count"] - count, "byteOffset": 4 * count},
    ]
    last = len(doc["accessors"]) - 1
    doc["materials"].append({**doc["materials"][0], "name": "second"})
    doc["meshes"][0]["primitives"] = [
        {**whole, "indices": last - 1},
        {**whole, "indices": last, "material": 1},
    ]
    (tmp_path / "b.glb").write_bytes(assemble(doc, blob))
    m, atlas = read_asset_file(tmp_path / "b.glb")
    assert len(m.faces) == len(mesh.faces)
    assert atlas.base_color.shape[1] > 2 * 64
    before = render(
        build_scene(*read_asset_file(tmp_path / "a.glb"), None, environment), camera, spp=8
    )
    after = render(build_scene(m, atlas, None, environment), camera, spp=8)
    assert psnr(before, after) > 35


def test_flat_shading_without_normals(tmp_path, mesh, material):
    write_glb(tmp_path / "a.glb", mesh, replace(material, normal=None))
    doc, blob = parse(tmp_path / "a.glb")
    del doc["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    (tmp_path / "b.glb").write_bytes(assemble(doc, blob))
    m, _ = read_asset_file(tmp_path / "b.glb")
    assert len(m.vertices) == 3 * len(mesh.faces)
    assert np.allclose(m.normals[m.faces[:, 0]], m.normals[m.faces[:, 1]])


def damaged(kind, tmp_path, mesh, material):
    write_glb(tmp_path / "a.glb", mesh, material)
    doc, blob = parse(tmp_path / "a.glb")
    path = tmp_path / "bad.glb"
    if kind == "empty file":
        path.write_bytes(b"")
    elif kind == "cut":
        path.write_bytes((tmp_path / "a.glb").read_bytes()[:3000])
    elif kind == "draco":
        doc["extensionsRequired"] = ["KHR_draco_mesh_compression"]
        path.write_bytes(assemble(doc, blob))
    elif kind == "no triangles":
        doc["meshes"][0]["primitives"][0]["mode"] = 1
        path.write_bytes(assemble(doc, blob))
    elif kind == "indices beyond the vertices":
        doc["accessors"][0]["count"] = doc["accessors"][1]["count"] = 3
        path.write_bytes(assemble(doc, blob))
    elif kind == "accessor that is not there":
        doc["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 99
        path.write_bytes(assemble(doc, blob))
    elif kind == "wrong suffix":
        path = tmp_path / "a.fbx"
        path.write_bytes(b"x")
    return path


@pytest.mark.parametrize(
    "kind",
    [
        "empty file",
        "cut",
        "draco",
        "no triangles",
        "indices beyond the vertices",
        "accessor that is not there",
        "wrong suffix",
        "missing",
    ],
)
def test_damaged_files_get_an_answer(tmp_path, mesh, material, kind):
    with pytest.raises(UserError):
        read_asset_file(damaged(kind, tmp_path, mesh, material))


def test_textures_without_coordinates_are_refused(tmp_path, mesh, material):
    with pytest.raises(UserError, match="texture coordinates"):
        write_glb(tmp_path / "a.glb", replace(mesh, uvs=None), material)


def test_random_damage_never_ends_in_a_stack_trace(tmp_path, mesh, material):
    """One value of the JSON replaced or removed: the file is read, or the user is told."""
    small = replace(
        material,
        **{
            k: getattr(material, k)[:4, :4]
            for k in ("base_color", "roughness", "metallic", "specular", "normal")
        },
    )
    write_glb(tmp_path / "a.glb", mesh, small)
    text, blob = parse(tmp_path / "a.glb")
    text = json.dumps(text)

    def places(node, before=()):
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield (*before, key)
            if isinstance(value, dict | list):
                yield from places(value, (*before, key))

    rng = np.random.default_rng(0)
    everywhere = list(places(json.loads(text)))
    answers = 0
    for i in rng.choice(len(everywhere), 120, replace=False):
        doc = json.loads(text)
        node = doc
        for key in everywhere[i][:-1]:
            node = node[key]
        value = rng.choice(np.array([None, -1, 0, 1e9, 99, "x", True, "gone"], object))
        if value == "gone":
            del node[everywhere[i][-1]]
        else:
            node[everywhere[i][-1]] = value
        (tmp_path / "b.glb").write_bytes(assemble(doc, blob))
        try:
            read_asset_file(tmp_path / "b.glb")
        except UserError:
            answers += 1
    assert 20 < answers < 120


def test_an_atlas_holds_repeated_textures(tmp_path, mesh, material):
    """A part whose texture coordinates run over several tiles finds the same texels in the
    atlas."""
    from relit.asset.parts import Part, merge_parts

    t = replace(material, specular=None, normal=None)
    other = replace(t, base_color=t.base_color[::-1].copy())
    uvs = mesh.uvs.astype(float) * [3, 2] - [1, 0]
    parts = [
        Part(mesh.vertices, mesh.faces, mesh.normals, uvs, "a", t),
        Part(mesh.vertices + 5, mesh.faces, mesh.normals, mesh.uvs, "b", other),
    ]
    merged, atlas = merge_parts(parts, tmp_path)

    def look(image, uv):
        return image[
            (uv[:, 1] * image.shape[0]).astype(int) % image.shape[0],
            (uv[:, 0] * image.shape[1]).astype(int) % image.shape[1],
        ]

    n = len(mesh.vertices)
    off_seam = (np.abs(uvs[:, 0] - np.round(uvs[:, 0])) > 0.1) & (
        np.abs(uvs[:, 1] - np.round(uvs[:, 1])) > 0.1
    )
    assert (
        np.abs(look(atlas.base_color, merged.uvs[:n]) - look(t.base_color, uvs))[off_seam].max()
        < 0.08
    )
    assert (
        np.abs(look(atlas.roughness, merged.uvs[:n]) - look(t.roughness, uvs))[off_seam].max()
        < 0.08
    )
    inside = (mesh.uvs.min(1) > 0.05) & (mesh.uvs.max(1) < 0.95)
    assert (
        np.abs(look(atlas.base_color, merged.uvs[n:]) - look(other.base_color, mesh.uvs))[
            inside
        ].max()
        < 0.08
    )


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("accessors", "byteOffset", -8),
        ("bufferViews", "byteOffset", -8),
        ("bufferViews", "byteLength", 1 << 30),
    ],
)
def test_nothing_outside_the_file_is_read(tmp_path, mesh, material, part, key, value):
    write_glb(tmp_path / "a.glb", mesh, material)
    doc, blob = parse(tmp_path / "a.glb")
    doc[part][0][key] = value
    (tmp_path / "b.glb").write_bytes(assemble(doc, blob))
    with pytest.raises(UserError, match="damaged"):
        read_asset_file(tmp_path / "b.glb")
