"""The plan of a job before anything is computed: flags and configuration, how the input is opened,
what it will cost."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relit.capture.flash_energy import flash_photos
from relit.errors import EXIT_ENVIRONMENT, EXIT_USAGE, UserError, did_you_mean
from relit.files import digests
from relit.log import available_memory, readable_bytes
from relit.recipe import Recipe
from relit.scene import Capture, Photo, Sphere
from relit.settings import read_config, with_values

# The module of each kind of capture that holds its RECIPE (`relit.recipe.Recipe`).
RECIPES = {
    "multiview": "relit.fit.multiview.recipe",
    "flash": "relit.fit.flash.recipe",
    "duplicates": "relit.fit.duplicates.recipe",
    "collection": "relit.fit.collection.recipe",
}
QUALITIES = ("draft", "standard", "high")
JOB_KEYS = {
    "capture": str,
    "quality": str,
    "seed": int,
    "masks": str,
    "max_side": int,
    "focal": float,
    "sphere": list,
}
WRITTEN_KEYS = {"input", "relit", "run_format", "settings"}  # what config.toml holds besides


@dataclass(frozen=True)
class Job:
    """What a run was asked for. sphere: (x, y, z, radius) in the cameras' frame or None. focal:
    pixels or None. Others: see the flags."""

    capture: str = "auto"
    quality: str = "standard"
    seed: int = 0
    masks: str = "auto"
    max_side: int | None = None
    focal: float | None = None
    sphere: tuple[float, ...] | None = None


def plan_job(flags: dict, config: str | Path | None) -> tuple[Job, dict]:
    """The job from flags and a config file, and the file's settings of the recipe. Raises UserError
    (2) for unknown keys and values."""
    content = read_config(config) if config else {}
    recipe = dict(content.get("settings", {}))
    values = {}
    for key, value in content.items():
        if key in JOB_KEYS:
            values[key] = tuple(value) if key == "sphere" else value
        elif key not in WRITTEN_KEYS:
            recipe[key] = value
    values.update({k: v for k, v in flags.items() if v is not None})
    job = with_values(Job(), values, f"--config {config}" if config else "flags")
    if job.quality not in QUALITIES:
        what = f"quality '{job.quality}' is not known.{did_you_mean(job.quality, QUALITIES)}"
        raise UserError(what, f"one of: {', '.join(QUALITIES)}", code=EXIT_USAGE)
    return job, recipe


def capture_kind(asked: str) -> str:
    """The kind that was asked for, checked: one of RECIPES, or 'auto'. Raises UserError (code 2)
    for others."""
    if asked == "auto" or asked in RECIPES:
        return asked
    what = f"--capture {asked} is not known.{did_you_mean(asked, RECIPES)}"
    raise UserError(what, f"kinds that are reconstructed: {', '.join(RECIPES)}", code=EXIT_USAGE)


def recipe_of(kind: str) -> Recipe:
    """The recipe of a kind of capture. It may be imported before a device is chosen."""
    return importlib.import_module(RECIPES[kind]).RECIPE


def open_input(path: Path, job: Job) -> Capture:
    """`open_capture` with the job's wishes."""
    from relit.capture.open import open_capture

    if job.capture == "duplicates":
        if job.masks.startswith("segment:"):
            from relit.capture.readers.sfd import open_segmented

            return open_segmented(
                path, job.masks.split(":", 1)[1], focal=job.focal, max_side=job.max_side
            )
        check_labels(path)
    sphere = (
        None
        if job.sphere is None
        else Sphere(np.array(job.sphere[:3], dtype=np.float64), float(job.sphere[3]))
    )
    least = {} if job.capture not in RECIPES else {"min_photos": recipe_of(job.capture).min_photos}
    labels = job.capture in (
        "auto",
        "duplicates",
    )  # who asks for another kind has masks or annotations there, no pile
    return open_capture(
        path,
        sphere=sphere,
        masks=job.masks,
        max_side=job.max_side,
        focal=job.focal,
        labels=labels,
        **least,
    )


def check_labels(path: Path) -> None:
    """Raises UserError when a photo of duplicates has no labels beside it."""
    from relit.capture.readers.sfd import recognise

    if path.exists() and recognise(path) is None:
        name = path.stem if path.is_file() else "NAME"
        raise UserError(
            "no labels were found: which pixel belongs to which object is not known",
            f"looked for {name}_labels.png, {name}_instance_seg.png, cutouts/, COCO annotations, and the folders of SfD and BOP",
            "make a label image, one grey level for each object and black elsewhere, or give a segmenter: --masks segment:FILE.onnx "
            f"(docs/duplicates.md): {path}",
        )


def open_as(path: Path, job: Job) -> tuple[Capture, str]:
    """The capture, and its kind: as asked for, else as the layout of the input tells, else
    multiview."""
    asked = capture_kind(job.capture)
    capture = open_input(path, job)
    kind = capture_kind(capture.kind or "multiview") if asked == "auto" else asked
    return flash_photos(capture) if kind == "flash" else capture, kind


TEXTS = ("_par.txt", "light.txt", "light_offset.txt")  # other texts (notes, a log) decide nothing
# Folders whose files decide as well.
BESIDE = (
    "sparse",
    "relit-corrections",
    "masks",
    "mask",
    "segmentations",
    "silhouettes",
    "normals",
    "normal",
    "cutouts",
    "cut-outs",
    "instances",
    "mask_visib",
    "annotations",
)


def input_digests(capture: Capture) -> dict[str, str]:
    """Content digests of the photos, and of the cameras, masks and normal maps beside them."""
    from relit.capture.readers.colmap_model import model_folders

    root = capture.folder
    files = {root / p.name for p in (*capture.photos, *capture.held_out)}
    for folder in (root, root / "train", root / "test"):
        files |= {
            p
            for p in folder.glob("*")
            if p.suffix.lower() in (".json", ".npz", ".npy") or p.name.endswith(TEXTS)
        }
    files |= {
        p
        for folder in model_folders(root)
        for p in folder.iterdir()
        if p.suffix in (".bin", ".txt")
    }
    files |= {p for photo in (*capture.photos, *capture.held_out) for p in _read_with(photo)}
    if capture.kind == "duplicates":
        from relit.capture.readers.sfd import SUFFIXES

        files |= {
            p
            for f in list(files)
            for p in f.parent.iterdir()
            if p.stem.endswith((*SUFFIXES, "_normal", "_normal_pretrain"))
        }
    for folder in BESIDE:
        files |= set((root / folder).rglob("*"))
    names = sorted(Path(os.path.relpath(p, root)).as_posix() for p in files if p.is_file())
    return digests(root, names)


def _read_with(photo: Photo) -> Iterator[Path]:
    """The mask and the normal prior that a photo is read with, wherever they lie."""
    from relit.capture.photo import layers

    for layer in layers(photo.load):
        yield from (
            p
            for p in (getattr(layer, "mask", None), getattr(layer, "normal", None))
            if isinstance(p, Path)
        )


# ---------------------------------------------------------------- cost


@dataclass(frozen=True)
class Cost:
    """A rough forecast. seconds: on 2 CPU cores. memory: peak resident bytes. disk: bytes of the
    run folder."""

    seconds: float
    memory: float
    disk: float


# What more photos or pixels add to a recipe's cost.
MEASURED_PHOTOS, MEASURED_PIXELS = 60, 400 * 400
SECONDS_PER_PHOTO = {"cameras": 3.0, "load": 0.05}
BYTES_PER_PIXEL = 40.0  # a decoded photo and its share of the pixel bank


def estimate(capture: Capture, job: Job, kind: str = "multiview", options=None) -> Cost:
    """Forecast from the number of photos, their pixels and objects, the kind and the quality;
    before the job, so that it can be refused.

    options: of the recipe, by default those of the quality; photos are shrunk until all together
    have no more than its `max_pixels`.
    """
    recipe = recipe_of(kind)
    pixels = sum(p.width * p.height for p in capture.photos)
    pixels = min(pixels, getattr(options or recipe.options(job.quality), "max_pixels", pixels))
    seconds, memory = recipe.cost[job.quality]
    if capture.objects and (each := recipe.object_cost) is not None:
        seconds *= 1 + each.seconds * (capture.objects - each.measured_with)
        memory *= 1 + each.memory * (capture.objects - each.measured_with)
    seconds += (len(capture.photos) - MEASURED_PHOTOS) * SECONDS_PER_PHOTO["load"]
    if not capture.has_cameras and not recipe.finds_cameras:
        seconds += len(capture.photos) * SECONDS_PER_PHOTO["cameras"]
    largest = max((p.width * p.height for p in capture.photos), default=0)
    memory += BYTES_PER_PIXEL * (pixels + 2 * largest - (MEASURED_PHOTOS + 2) * MEASURED_PIXELS)
    return Cost(seconds, memory, 0.1e9 if job.quality == "draft" else 0.3e9)


def check_memory(cost: Cost) -> None:
    """Raises UserError (code 5) when the job would not fit into memory."""
    free = available_memory()
    if free is not None and cost.memory > free:
        raise UserError(
            f"the job would take about {readable_bytes(cost.memory)} of memory; {readable_bytes(free)} are available",
            "the photos are kept decoded while the fit draws pixels from all of them",
            "use --max-side 800, fewer photos, or --quality draft",
            code=EXIT_ENVIRONMENT,
        )
