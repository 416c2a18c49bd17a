"""Captures that pass through a camera model, called as suites call a synthesizer: plain options
instead of the objects that `relit.synthesize` takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from relit.synthesize.camera_model import parse_camera_model
from relit.synthesize.delivery import Delivery
from relit.synthesize.everyday import EVERYDAY, EVERYDAY_SAMPLING, synthesize_everyday
from relit.synthesize.mask_errors import parse_mask_errors
from relit.synthesize.multiview import settings_of, synthesize_multiview
from relit.synthesize.object_truth import CaptureFiles, Sampling, settings_for
from relit.synthesize.turntable import (
    ELEVATIONS,
    TURNTABLE,
    TURNTABLE_SAMPLING,
    synthesize_turntable,
)

Say = Callable[[str], None]
DELIVERY = ("camera_model", "mask_errors", "masks", "cameras")  # options of `phone_delivery`
_SIZES = tuple(f.name for f in fields(Sampling))
OPTIONS = {  # of each synthesizer of this module
    "synthesize_phone": (
        *DELIVERY,
        *(k for k in synthesize_multiview.__kwdefaults__ if k not in ("say", "delivery")),
    ),
    "synthesize_everyday_item": (*_SIZES, "table", "roughness", "metallic"),
    "synthesize_turntable_item": (*_SIZES, "elevations", "roughness", "metallic"),
}


def silent(text: str) -> None:
    """A `say` that says nothing."""


def phone_delivery(
    camera_model: str = "phone",
    mask_errors: str = "segmenter",
    masks: bool = True,
    cameras: bool = True,
) -> Delivery:
    """What is handed over, named as on the command line."""
    model, errors = parse_camera_model(camera_model), parse_mask_errors(mask_errors)
    return Delivery(model, errors, masks=masks, cameras=cameras)


def synthesize_phone(
    asset: str | Path, light: str | Path, out: str | Path, *, say: Say = silent, **options: Any
) -> Path:
    """`synthesize_multiview` with `phone_delivery`: its options, and those of DELIVERY."""
    plain, delivery = _phone_parts(options)
    return synthesize_multiview(asset, light, out, delivery=delivery, say=say, **plain)


def phone_settings(asset: str | Path, light: str | Path, **options: Any) -> dict[str, Any]:
    """Everything that the capture depends on."""
    plain, delivery = _phone_parts(options)
    return settings_of(asset, light, delivery=delivery.settings(), **plain)


def _phone_parts(options: dict[str, Any]) -> tuple[dict[str, Any], Delivery]:
    given = {k: v for k, v in options.items() if k in DELIVERY}
    return {k: v for k, v in options.items() if k not in DELIVERY}, phone_delivery(**given)


def synthesize_everyday_item(
    asset: str | Path, light: str | Path, out: str | Path, *, say: Say = silent, **options: Any
) -> Path:
    """`synthesize_everyday`. options: the fields of Sampling, relights, roughness, metallic,
    table."""
    files, sampling, table = _everyday_parts(asset, light, options)
    return synthesize_everyday(files, out, sampling, texture=table, say=say)


def everyday_settings(asset: str | Path, light: str | Path, **options: Any) -> dict[str, Any]:
    """Everything that the capture depends on."""
    files, sampling, table = _everyday_parts(asset, light, options)
    return settings_for("everyday", files, sampling, EVERYDAY, texture=table)


def _everyday_parts(
    asset: str | Path, light: str | Path, options: dict[str, Any]
) -> tuple[CaptureFiles, Sampling, str]:
    files, sampling = _files_and_sizes(asset, light, options, EVERYDAY_SAMPLING)
    return files, sampling, str(options.get("table", "wood"))


def synthesize_turntable_item(
    asset: str | Path, light: str | Path, out: str | Path, *, say: Say = silent, **options: Any
) -> Path:
    """`synthesize_turntable`. options: the fields of Sampling, relights, roughness, metallic,
    elevations."""
    files, sampling = _files_and_sizes(asset, light, options, TURNTABLE_SAMPLING)
    turns = tuple(options.get("elevations", ELEVATIONS))
    return synthesize_turntable(files, out, sampling, elevations=turns, say=say)


def turntable_settings(asset: str | Path, light: str | Path, **options: Any) -> dict[str, Any]:
    """Everything that the capture depends on."""
    files, sampling = _files_and_sizes(asset, light, options, TURNTABLE_SAMPLING)
    turns = [float(e) for e in options.get("elevations", ELEVATIONS)]
    return settings_for("turntable", files, sampling, TURNTABLE, elevations=turns)


def _files_and_sizes(
    asset: str | Path, light: str | Path, options: dict[str, Any], default: Sampling
) -> tuple[CaptureFiles, Sampling]:
    relights: Sequence[str | Path] = options.get("relights", ())
    files = CaptureFiles(
        Path(asset),
        Path(light),
        tuple(Path(r) for r in relights),
        options.get("roughness"),
        options.get("metallic"),
    )
    return files, Sampling(**{k: options.get(k, getattr(default, k)) for k in _SIZES})
