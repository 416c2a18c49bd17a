"""A small procedural object: a UV sphere with a dent, textures with an up and a left, a normal map,
a light, two cameras."""

import numpy as np
import pytest

from relit.geometry.tangents import vertex_normals
from relit.scene import Asset, Camera, Material, Mesh


def look_at(position, target=(0, 0, 0), size=48, focal=60.0):
    """Camera at `position` that looks at `target`, +Y up."""
    position = np.asarray(position, float)
    z = np.asarray(target, float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 1, 0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    pose[:3, 3] = position
    return Camera(size, size, focal, focal, size / 2 + 1.5, size / 2 - 2.0, pose)


def sphere_mesh(rows=16, columns=32) -> Mesh:
    """Unit UV sphere, slightly squeezed, u eastwards and v downwards, with a seam."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, phi = v * np.pi, u * 2 * np.pi
    points = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    points *= (1 - 0.2 * np.exp(-8 * ((points - [0, 0, 1]) ** 2).sum(-1)))[..., None]
    index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1)[1:].reshape(-1, 3), np.stack([a, c, d], -1)[:-1].reshape(-1, 3)]
    )
    # rows at the poles have one real triangle each
    faces = np.concatenate([faces, np.stack([a, b, c], -1)[0], np.stack([a, c, d], -1)[-1]])
    p = points.reshape(-1, 3)
    area = np.linalg.norm(
        np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]]), axis=-1
    )
    mesh = Mesh(
        p.astype(np.float32),
        faces[area > 1e-9].astype(np.int32),
        None,
        np.stack([u, v], -1).reshape(-1, 2).astype(np.float32),
    )
    used = np.unique(mesh.faces)
    mesh = Mesh(
        mesh.vertices[used],
        np.searchsorted(used, mesh.faces).astype(np.int32),
        None,
        mesh.uvs[used],
    )
    return Mesh(mesh.vertices, mesh.faces, vertex_normals(mesh), mesh.uvs)


@pytest.fixture(scope="session")
def mesh() -> Mesh:
    return sphere_mesh()


@pytest.fixture(scope="session")
def material() -> Material:
    y, x = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(64) + 0.5) / 64, indexing="ij")
    base = np.stack([0.1 + 0.7 * x, 0.1 + 0.7 * y, 0.3 + 0.2 * np.sin(12 * x)], -1)
    n = np.stack([0.3 * np.sin(20 * x), 0.3 * np.cos(15 * y), np.ones_like(x)], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    f = np.float32
    return Material(
        base.astype(f),
        (0.3 + 0.5 * y).astype(f),
        (x > 0.5).astype(f),
        1.33,
        (0.5 + 0.5 * x).astype(f),
        n.astype(f),
    )


@pytest.fixture(scope="session")
def environment() -> np.ndarray:
    image = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    image[2, 5] = 20.0
    return image


@pytest.fixture(scope="session")
def asset(mesh, material, environment) -> Asset:
    turn = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], float)
    world_from_asset = np.eye(4)
    world_from_asset[:3, :3] = 2.5 * turn
    world_from_asset[:3, 3] = [3, -1, 2]
    cameras = tuple(
        (f"images/{i}.png", look_at(p, (3, -1, 2))) for i, p in enumerate([(9, 2, 6), (-3, -2, 6)])
    )
    meta = {"capture": "multiview", "seed": 3, "seconds": {"surface": 1.5}}
    return Asset(mesh, material, world_from_asset, environment, cameras, meta)


@pytest.fixture(scope="session")
def camera() -> Camera:
    return look_at((1.5, 1.2, 3.0))
