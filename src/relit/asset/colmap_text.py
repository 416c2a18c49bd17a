"""Cameras as a COLMAP model in text form: what other programs read.

One PINHOLE camera and one image per photo, points3D.txt empty. COLMAP's axes are OpenCV's and its
pixel centres lie at +.5, as here; its poses are camera_from_world, as a quaternion (w, x, y, z) and
a translation.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from relit.geometry.se3 import quaternion
from relit.scene import Camera


def write_colmap(folder: str | Path, cameras: Sequence[tuple[str, Camera]]) -> Path:
    """Write cameras.txt, images.txt and points3D.txt. cameras: (name of the photo, Camera in world
    units) pairs. Returns the folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics, images = (
        ["# id model width height fx fy cx cy"],
        ["# id qw qx qy qz tx ty tz camera name, then a line of points"],
    )
    for i, (name, c) in enumerate(cameras, 1):
        intrinsics.append(
            f"{i} PINHOLE {c.width} {c.height} {c.fx:.9g} {c.fy:.9g} {c.cx:.9g} {c.cy:.9g}"
        )
        pose = np.linalg.inv(np.asarray(c.world_from_camera, np.float64))
        numbers = " ".join(f"{v:.12g}" for v in (*quaternion(pose[:3, :3]), *pose[:3, 3]))
        images += [f"{i} {numbers} {i} {name}", ""]
    (folder / "cameras.txt").write_text("\n".join(intrinsics) + "\n", encoding="utf-8")
    (folder / "images.txt").write_text("\n".join(images) + "\n", encoding="utf-8")
    (folder / "points3D.txt").write_text("# none\n", encoding="utf-8")
    return folder
