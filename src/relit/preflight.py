"""What an input was recognised as, and what a reconstruction of it would take. `relit inspect`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from relit.errors import UserError
from relit.files import write_text
from relit.log import readable_bytes, readable_seconds
from relit.plan import Job, estimate, open_as, recipe_of
from relit.scene import Capture


def inspect(input: str | Path, job: Job, plot: Path | None = None) -> dict:
    """What the input was recognised as, what stands in it, and what a reconstruction would take. plot: an SVG file for the cameras."""
    capture, kind = open_as(Path(input), job)
    recipe = recipe_of(kind)
    if plot is not None:
        write_plot(plot, capture)
    cost = estimate(capture, job, kind)
    finds_cameras = capture.has_cameras or getattr(recipe, "FINDS_CAMERAS", False)
    sizes = sorted({(p.width, p.height) for p in capture.photos})
    ball = capture.sphere and {"centre": [float(x) for x in capture.sphere.centre], "radius": float(capture.sphere.radius)}
    return {
        "input": str(input),
        "format": capture.format,
        "photos": len(capture.photos),
        "held_out": len(capture.held_out),
        "sizes": [list(s) for s in sizes],
        "cameras": "given" if capture.has_cameras else "none; they would be found from the photos",
        "sphere": ball,
        "masks": mask_coverage(capture),
        "capture": kind,
        "light": recipe.LIGHT,
        "notes": list(capture.notes),
        "stages": ([] if finds_cameras else ["cameras"]) + [*recipe.STAGES, "asset", "report"],
        "estimate": {"seconds": round(cost.seconds), "memory": round(cost.memory), "disk": round(cost.disk), "quality": job.quality},
    }


def write_plot(path: Path, capture: Capture) -> None:
    """An SVG file of the cameras around the object sphere, from above and from the side. Raises UserError when either is not known."""
    if not capture.has_cameras or capture.sphere is None:
        what = "there is nothing to plot: the cameras are not known yet"
        raise UserError(what, "they are found by the reconstruction", "relit reconstruct, then see its report")
    from relit.evaluate.curves import camera_plot

    plot = camera_plot([p.camera for p in capture.photos], _upright(capture) @ np.linalg.inv(capture.sphere.world_from_unit))
    write_text(path, plot.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" style="background:#fff" ', 1))


def _upright(capture: Capture) -> np.ndarray:
    """(4, 4) rotation that turns the capture's up to +Y."""
    out = np.eye(4)
    if capture.up is not None:
        y = np.asarray(capture.up, np.float64) / np.linalg.norm(capture.up)
        x = np.cross(y, np.eye(3)[np.argmin(np.abs(y))])
        x /= np.linalg.norm(x)
        out[:3, :3] = np.stack([x, y, np.cross(x, y)])
    return out


def mask_coverage(capture: Capture, views: int = 4) -> dict | None:
    """Share of each of a few photos that the mask covers, or None when there are no masks."""
    chosen = [capture.photos[i] for i in np.unique(np.linspace(0, len(capture.photos) - 1, views).round().astype(int))]
    masks = {p.name: p.load().mask for p in chosen}
    if any(m is None for m in masks.values()):
        return None
    return {name: round(float(mask.mean()), 4) for name, mask in masks.items()}


def as_text(found: dict) -> str:
    """`inspect`'s answer for a reader."""
    sphere, masks, cost = found["sphere"], found["masks"], found["estimate"]
    sizes = ", ".join(f"{w}x{h}" for w, h in found["sizes"][:4]) + (" ..." if len(found["sizes"]) > 4 else "")
    ball = "centre {:.4g} {:.4g} {:.4g}, radius {:.4g}".format(*sphere["centre"], sphere["radius"]) if sphere else "not known yet"
    forecast = f"{readable_seconds(cost['seconds'])}, {readable_bytes(cost['memory'])} of memory"
    rows = [
        ("input", found["input"]),
        ("recognised as", found["format"]),
        ("photos", f"{found['photos']} of {sizes} pixels" + (f", {found['held_out']} held out" if found["held_out"] else "")),
        ("cameras", found["cameras"]),
        ("object sphere", ball),
        ("masks", "none" if masks is None else "cover " + ", ".join(f"{100 * c:.0f} % of {n}" for n, c in masks.items())),
        ("light", found["light"]),
        ("stages", ", ".join(found["stages"])),
        ("estimate", f"{forecast} at quality {cost['quality']} on 2 cores"),
    ]
    return "\n".join([f"{name.ljust(14)}{value}" for name, value in rows] + [f"note: {n}" for n in found["notes"]])
