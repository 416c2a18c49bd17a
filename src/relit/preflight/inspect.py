"""Checks of an input before a reconstruction: format, cameras, masks, light, cost. `relit inspect`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.errors import UserError
from relit.files import write_text
from relit.job import Job, estimate, open_as, recipe_of
from relit.preflight.cameras import (
    camera_coverage,
    camera_warnings,
    epipolar_agreement,
    reprojection,
)
from relit.preflight.drift import drift, drift_warnings
from relit.preflight.light import light_regime
from relit.preflight.look import Look, look_at_photos
from relit.preflight.page import write_page
from relit.preflight.text import inspection_text
from relit.scene import Capture

__all__ = ["inspect_input", "inspection_text", "light_regime", "write_plot"]


def inspect_input(
    input: str | Path, job: Job, plot: Path | None = None, html: Path | None = None
) -> dict:
    """The format of an input, its content, warnings, and the estimated cost of a reconstruction.

    plot: SVG file for the cameras. html: page with images of all checks. Returns what
    `relit inspect --json` prints.
    """
    capture, kind = open_as(Path(input), job)
    recipe = recipe_of(kind)
    if plot is not None:
        write_plot(plot, capture)
    cost = estimate(capture, job, kind)
    finds_cameras = capture.has_cameras or recipe.finds_cameras
    sizes = sorted({(p.width, p.height) for p in capture.photos})
    ball = capture.sphere and {
        "centre": [float(x) for x in capture.sphere.centre],
        "radius": float(capture.sphere.radius),
    }
    looks = look_at_photos(capture)
    regime, drifts, (epipolar, pairs) = (
        light_regime(capture, looks),
        drift(looks),
        epipolar_agreement(looks),
    )
    around, masks = camera_coverage(capture), mask_coverage(looks)
    unsteady = drift_warnings(drifts, masks is not None, from_anywhere=kind == "collection")
    found = {
        "input": str(input),
        "format": capture.format,
        "photos": len(capture.photos),
        "held_out": len(capture.held_out),
        "looked_at": len(looks),
        "sizes": [list(s) for s in sizes],
        "cameras": "given"
        if capture.has_cameras
        else "none; structure from motion will estimate them",
        "sphere": ball,
        "coverage": around,
        "epipolar": epipolar,
        "reprojection": reprojection(capture, looks),
        "masks": masks,
        "capture": kind,
        "light": recipe.light,
        "light_regime": regime,
        "drift": drifts,
        "warnings": [*_of_light(kind, regime), *camera_warnings(epipolar, around), *unsteady],
        "notes": list(capture.notes),
        "stages": ([] if finds_cameras else ["cameras"]) + [*recipe.stages, "asset", "report"],
        "estimate": {
            "seconds": round(cost.seconds),
            "memory": round(cost.memory),
            "disk": round(cost.disk),
            "quality": job.quality,
        },
    }
    if html is not None:
        write_page(html, found, capture, looks, pairs, cameras_svg(capture))
    return found


EXPECTED = {
    "multiview": ("fixed",),
    "duplicates": ("fixed",),
    "flash": ("flash",),
    "collection": ("varied", "fixed"),
}


def _of_light(kind: str, regime: dict) -> list[dict]:
    """A warning where the estimated light regime contradicts the kind of capture."""
    guess = regime["guess"]
    if guess in EXPECTED.get(kind, (guess,)) or regime["confidence"] < 0.25:
        return []
    advice = {
        "flash": "use --capture flash if a flash at the camera was the only light",
        "varied": "use --capture collection if each photo has its own light",
        "moving light": "a fixed viewpoint with a moving lamp is not supported: photograph from all around",
        "fixed": "use --capture multiview if the lamps did not move",
    }
    looks = guess.removesuffix(" light")
    return [
        {
            "what": f"the light appears to be {looks}; a {kind} capture expects {' or '.join(EXPECTED[kind])} light",
            "fix": advice[guess],
        }
    ]


def write_plot(path: Path, capture: Capture) -> None:
    """Write an SVG file of the cameras around the object sphere, from above and from the side.
    Raises UserError when cameras or sphere are unknown."""
    drawing = cameras_svg(capture)
    if drawing is None:
        what = "the cameras are unknown, so there is nothing to plot"
        raise UserError(
            what, "the reconstruction estimates them", "run relit reconstruct and open its report"
        )
    write_text(path, drawing)


def cameras_svg(capture: Capture) -> str | None:
    """The cameras around the object sphere as SVG, or None when either is unknown."""
    if not capture.has_cameras or capture.sphere is None:
        return None
    from relit.report.curves import camera_plot

    plot = camera_plot(
        [p.camera for p in capture.photos if p.camera is not None],
        _upright(capture) @ np.linalg.inv(capture.sphere.world_from_unit),
    )
    return plot.replace(
        "<svg ", '<svg xmlns="http://www.w3.org/2000/svg" style="background:#fff" ', 1
    )


def _upright(capture: Capture) -> np.ndarray:
    """(4, 4) rotation of the capture's up direction to +Y."""
    out = np.eye(4)
    if capture.up is not None:
        y = np.asarray(capture.up, np.float64) / np.linalg.norm(capture.up)
        x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
        x /= np.linalg.norm(x)
        out[:3, :3] = np.stack([x, y, np.cross(x, y)])
    return out


def mask_coverage(looks: list[Look]) -> dict | None:
    """Share of each photo that its mask covers, or None when there are no masks."""
    if any(x.mask is None for x in looks):
        return None
    return {x.name: round(float(x.mask.mean()), 4) for x in looks}
