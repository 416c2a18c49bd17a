"""Small pictures with known cameras: three coloured balls on the axes of the world, and writers of
the camera formats."""

import json
from dataclasses import replace

import numpy as np

from relit import images
from relit.conventions import world_from_gl_camera
from relit.geometry.se3 import look_at
from relit.scene import Camera

BALLS = {
    (0.6, 0, 0): (1, 0.05, 0.05),
    (0, 0.6, 0): (0.05, 1, 0.05),
    (0, 0, 0.6): (0.05, 0.05, 1),
}  # centre -> linear colour
RADIUS = 0.22
BACKGROUND = (0.3, 0.5, 0.2)  # linear, of photos without masks
EXTENT = 0.82  # of the three balls about the origin


def ring(count=6, width=72, height=56, distance=4.0, focal=100.0, centred=False):
    """Cameras on an upward spiral around the origin; the principal point is off the middle unless
    `centred`."""
    out = []
    for i in range(count):
        a = 2 * np.pi * i / count + 0.3
        eye = distance * np.array([np.cos(a), 0.25 + 0.1 * np.sin(2 * a), np.sin(a)])
        cx, cy = (width / 2, height / 2) if centred else (width / 2 + 1.5, height / 2 - 2.25)
        out.append(
            Camera(
                width,
                height,
                focal,
                focal if centred else focal * 1.02,
                cx,
                cy,
                look_at(eye, [0, 0, 0]),
            )
        )
    return out


def picture(camera, samples=2):
    """(rgb premultiplied linear (H, W, 3), alpha (H, W)) of the balls, without shading, `samples`^2
    rays a pixel."""
    w, h = camera.width * samples, camera.height * samples
    big = camera.resized(w, h)
    gx, gy = np.meshgrid(
        (np.arange(w) + 0.5 - big.cx) / big.fx, (np.arange(h) + 0.5 - big.cy) / big.fy
    )
    d = np.stack([gx, gy, np.ones_like(gx)], -1) @ camera.world_from_camera[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    rgb, depth = np.zeros((h, w, 3), np.float32), np.full((h, w), np.inf)
    for centre, colour in BALLS.items():
        to = np.asarray(centre) - camera.centre
        along = d @ to
        inside = RADIUS**2 - (to @ to - along**2)
        near = along - np.sqrt(np.maximum(inside, 0))
        hit = (inside > 0) & (near < depth)
        rgb[hit], depth[hit] = colour, near[hit]
    alpha = np.isfinite(depth).astype(np.float32)
    fold = (camera.height, samples, camera.width, samples)
    return rgb.reshape(*fold, 3).mean((1, 3)), alpha.reshape(fold).mean((1, 3))


def write_photos(folder, cameras, suffix=".png", alpha=False, background=None, stem="{:03d}"):
    """Write one picture per camera; returns the file names."""
    names = []
    for i, camera in enumerate(cameras):
        rgb, a = picture(camera)
        if background is not None:
            rgb = rgb + (1 - a[..., None]) * np.asarray(background, np.float32)
        name = stem.format(i) + suffix
        straight = np.concatenate([rgb / np.maximum(a, 1e-6)[..., None], a[..., None]], -1)
        folder.mkdir(parents=True, exist_ok=True)
        if suffix == ".exr":
            images.write_linear(folder / name, rgb)
        else:
            images.write_srgb(folder / name, straight if alpha else rgb)
        names.append(name)
    return names


def check_projection(photo):
    """Each ball's centre, projected by the photo's camera, falls on a pixel of that ball's colour
    unless another ball hides it."""
    rgb, seen = photo.load().rgb, 0
    for centre, colour in BALLS.items():
        x, y, z = photo.camera.project(np.asarray(centre))
        assert z > 0
        found = rgb[int(y), int(x)]
        expected = np.asarray(colour)
        hidden = any(
            np.linalg.norm(
                np.cross(
                    np.asarray(c) - photo.camera.centre, np.asarray(centre) - photo.camera.centre
                )
            )
            / z
            < 1.3 * RADIUS
            and photo.camera.project(np.asarray(c))[2] < z
            for c in BALLS
            if c != centre
        )
        if not hidden:
            assert np.abs(found - expected).max() < 0.1, (photo.name, centre, found)
            seen += 1
    return seen


def same_camera(a, b, atol=1e-6):
    assert (a.width, a.height) == (b.width, b.height)
    np.testing.assert_allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], atol=atol)
    np.testing.assert_allclose(a.world_from_camera, b.world_from_camera, atol=atol)


# ---------------------------------------------------------------- writers


def write_transforms(root, cameras, names, file="transforms.json", per_frame=False, **extra):
    frames = []
    for camera, name in zip(cameras, names, strict=True):
        frame = {
            "file_path": name,
            "transform_matrix": world_from_gl_camera(camera.world_from_camera).tolist(),
        }
        if per_frame:
            frame |= intrinsics_json(camera)
        frames.append(frame)
    head = {} if per_frame else intrinsics_json(cameras[0])
    (root / file).write_text(json.dumps({**head, **extra, "frames": frames}))


def intrinsics_json(c):
    return {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "w": c.width, "h": c.height}


def projection(camera):
    """(4, 4) K [R | t] with pixel centres at whole numbers."""
    k = np.eye(4)
    k[:3, :3] = replace(camera, cx=camera.cx - 0.5, cy=camera.cy - 0.5).intrinsics
    return k @ camera.camera_from_world


def write_colmap_text(folder, cameras, names, model="PINHOLE", extra=(), points=()):
    folder.mkdir(parents=True, exist_ok=True)
    rows, poses = [], []
    for i, (c, name) in enumerate(zip(cameras, names, strict=True), start=1):
        head = [c.fx, c.cx, c.cy] if model.startswith("SIMPLE") else [c.fx, c.fy, c.cx, c.cy]
        rows.append(
            f"{i} {model} {c.width} {c.height} " + " ".join(repr(float(v)) for v in [*head, *extra])
        )
        q = quaternion(c.camera_from_world[:3, :3])
        values = " ".join(repr(float(v)) for v in [*q, *c.camera_from_world[:3, 3]])
        poses.append(f"{i} {values} {i} {name}\n")
    (folder / "cameras.txt").write_text("\n".join(rows) + "\n")
    (folder / "images.txt").write_text("\n".join(poses) + "\n")
    lines = [
        f"{i} {x!r} {y!r} {z!r} 0 0 0 0.5"
        for i, (x, y, z) in enumerate(np.asarray(points).reshape(-1, 3).tolist(), start=1)
    ]
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")


def quaternion(rotation):
    """(w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return w, x, y, z
