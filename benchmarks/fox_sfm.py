"""Cameras of the fox photos found from the photos alone, against the cameras that come with them.

    python benchmarks/fox_sfm.py [folder of multiview_fox]

Prints how many photos were registered, the rotation errors in degrees and the centre errors in
percent of the cameras' spread, both after the best similarity, and the seconds it took.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from relit.cameras.sfm import find_cameras
from relit.capture.open import open_capture
from relit.geometry.se3 import camera_errors


def fox_folder() -> Path:
    """multiview_fox in the folder that RELIT_DATA names, or in shared/data beside the repository or
    in it."""
    here = Path(__file__).resolve().parents[1]
    places = [
        os.environ.get("RELIT_DATA"),
        here / "shared" / "data",
        here.parent / "shared" / "data",
    ]
    found = next((Path(p) for p in places if p and Path(p).is_dir()), None)
    if found is None:
        raise SystemExit(
            "the fox photos are not there: set RELIT_DATA to the folder of the third-party data"
        )
    return found / "real" / "multiview_fox"


def fox_sfm(folder: Path, seed: int = 0) -> dict[str, float]:
    """Run and compare; the figures by name."""
    truth = {Path(p.name).name: p.camera for p in open_capture(folder).photos}
    with tempfile.TemporaryDirectory() as work:
        found, verdict = find_cameras(
            open_capture(folder / "images"), seed=seed, workdir=Path(work)
        )
    names = [p.name for p in found.photos]
    poses = np.stack([p.camera.world_from_camera for p in found.photos])
    given = np.stack([truth[n].world_from_camera for n in names])
    angle, distance = camera_errors(poses, given)
    centres = given[:, :3, 3]
    spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).mean())
    print(verdict)
    print("tries:", *verdict.tries, sep="\n  ")
    return {
        "registered": len(names),
        "total": verdict.total,
        "median rotation error (degrees)": float(np.median(angle)),
        "largest rotation error (degrees)": float(angle.max()),
        "median centre error (% of spread)": 100 * float(np.median(distance)) / spread,
        "focal length / given": found.photos[0].camera.fx / truth[names[0]].fx,
        "seconds": verdict.seconds,
    }


if __name__ == "__main__":
    for name, value in fox_sfm(Path(sys.argv[1]) if len(sys.argv) > 1 else fox_folder()).items():
        print(f"{name}: {value:.4g}")
