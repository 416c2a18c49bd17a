"""A ball and a bowl of rough plastic under a flash: photos, mesh and textures for the tests of the
surface pass."""

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.pixels import batch_of, make_bank
from relit.geometry.se3 import look_at
from relit.lighting.flash import light_position
from relit.materials.plastic_field import plastic_at, start_plastic
from relit.materials.rough_plastic import Coat
from relit.rendering.transport import TraceableMesh, first_hits
from relit.rendering.transport_flash import direct, lit
from relit.scene import Camera, Mesh

OFFSET, INTENSITY = (-0.14, 0.08, 0.0), 6.0


def ball(rows: int = 40, columns: int = 80, radius: float = 0.7) -> Mesh:
    """A sphere with smooth normals; u around it, v from top to bottom."""
    v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    n = np.stack(
        [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1
    ).reshape(-1, 3)
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    faces = np.concatenate(
        [
            np.stack([a, a + columns + 1, a + columns + 2], 1),
            np.stack([a, a + columns + 2, a + 1], 1),
        ]
    )
    area = np.linalg.norm(
        np.cross(n[faces[:, 1]] - n[faces[:, 0]], n[faces[:, 2]] - n[faces[:, 0]]), axis=1
    )
    faces = faces[area > 1e-9].astype(np.int32)
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    return Mesh(
        (radius * n).astype(np.float32), faces, n.astype(np.float32), uvs.astype(np.float32)
    )


def bowl(rows: int = 24, columns: int = 64) -> Mesh:
    """The inside of the lower half of a ball."""
    v, u = np.meshgrid(np.linspace(0.5, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    n = np.stack(
        [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1
    ).reshape(-1, 3)
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    faces = np.concatenate(
        [
            np.stack([a, a + columns + 2, a + columns + 1], 1),
            np.stack([a, a + 1, a + columns + 2], 1),
        ]
    )
    area = np.linalg.norm(
        np.cross(n[faces[:, 1]] - n[faces[:, 0]], n[faces[:, 2]] - n[faces[:, 0]]), axis=1
    )
    uvs = np.stack([u, v], -1).reshape(-1, 2)
    return Mesh(
        (0.8 * n).astype(np.float32),
        faces[area > 1e-9].astype(np.int32),
        (-n).astype(np.float32),
        uvs.astype(np.float32),
    )


def textures(size: int = 64):
    """Two paints in stripes, each with its own lobe."""
    stripe = (np.arange(size)[None, :] * 6 // size + np.arange(size)[:, None] * 3 // size) % 2 == 0
    diffuse = np.where(stripe[..., None], [0.6, 0.5, 0.4], [0.12, 0.15, 0.2])
    return start_plastic(diffuse, np.where(stripe, 0.9, 0.5), np.where(stripe, 0.16, 0.3))


def cameras(count: int = 12, size: int = 40) -> list[Camera]:
    out = []
    for i in range(count):
        y = 0.9 - 1.5 * (i + 0.5) / count
        a = i * np.pi * (3 - np.sqrt(5))
        r = np.sqrt(1 - y * y)
        pose = look_at(
            3.0 * np.array([r * np.cos(a), y, r * np.sin(a)]), roll=0.4 * np.sin(3.0 * i)
        )
        focal = 1.7 * size
        out.append(Camera(size, size, focal, focal, size / 2, size / 2, pose))
    return out


def shoot(mesh: TraceableMesh, field, bank, pixel, offset=OFFSET, intensity=INTENSITY):
    """Direct light at pixels (UInt32): (Color3f, hit Bool)."""
    batch = batch_of(bank, pixel)
    points = first_hits(mesh, batch.o, batch.d)
    position = light_position(bank.cameras, batch.view, mi.Vector3f(*[float(v) for v in offset]))
    dr.eval(points, position)
    plastic, _ = plastic_at(field, points.uv, points.valid)
    seen = lit(mesh, points, position, points.valid)
    return direct(
        points, plastic, Coat(), points.n, position, mi.Float(intensity), seen
    ), points.valid


def capture(size: int = 40, count: int = 12):
    """(bank, cameras, TraceableMesh, true textures) with the photos in the bank."""
    views = cameras(count, size)
    mesh = ball()
    traceable = TraceableMesh(mesh, np.zeros_like(mesh.vertices))
    black = [np.zeros((size, size, 3), np.float32)] * count
    bank = make_bank(views, black, [np.ones((size, size), np.float32)] * count)
    field = textures()
    rgb, hit = shoot(traceable, field, bank, dr.arange(mi.UInt32, bank.total))
    images = (
        np.where(np.array(hit)[:, None], np.array(rgb).T, 0)
        .reshape(count, size, size, 3)
        .astype(np.float32)
    )
    masks = np.array(hit).reshape(count, size, size).astype(np.float32)
    return make_bank(views, list(images), list(masks)), views, traceable, field
