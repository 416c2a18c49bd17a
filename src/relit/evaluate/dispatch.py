"""Which figures a truth allows under a protocol.

Pictures are rendered by the same path tracer as the truth. What each figure means:
evaluate/definitions.py and evaluate/protocols/.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.evaluate.definitions import DEFINITIONS
from relit.evaluate.lpips import load_lpips
from relit.evaluate.multiview import evaluate_asset
from relit.evaluate.results import entries
from relit.evaluate.roundtrip import glb_roundtrip
from relit.evaluate.truth import has_truth, load_truth, truth_kind

SPP, SPP_PILE = 256, 64
PROTOCOLS = ("relit", "sfd", "pir", "samurai", "orb")


def evaluate(
    run_or_asset: str | Path,
    truth_folder: str | Path,
    *,
    spp: int | None = None,
    seed: int = 0,
    protocol: str = "relit",
    lpips: str | Path | None = None,
) -> dict[str, Any]:
    """Every figure that the truth allows, for the asset in a run or asset folder. truth_folder:
    what `relit synthesize` wrote; or the capture that the asset was made from, whose photos are the
    truth then (evaluate/photos.py, evaluate/collection_photos.py).

    spp: samples a pixel of the pictures that are compared, SPP where none are asked for (of piles
    SPP_PILE, whose pictures take long); their noise counts as error. protocol: of PROTOCOLS, a
    paper's own way to measure. lpips: an ONNX file (`evaluate.lpips`).
    Returns {"protocol", "metrics": {name: {"value", "unit", "definition", ...}} (see
    `results.entries`), "per_view": {view: {name: value}}, "albedo_scale": [r, g, b], "alignment":
    "identity" or "sim3"}. Call `relit.device.use_device` first. Raises UserError where a protocol
    does not apply to the capture.
    """
    folder = Path(truth_folder)
    folder = (
        folder.parent if folder.name == "truth" and (folder / "settings.json").is_file() else folder
    )
    if protocol not in PROTOCOLS:
        raise UserError(
            f"unknown protocol '{protocol}'.{did_you_mean(protocol, PROTOCOLS)}",
            fix=f"choose one of: {', '.join(PROTOCOLS)}",
            code=EXIT_USAGE,
        )
    network = None if lpips is None else load_lpips(lpips)
    few, many = (SPP_PILE, SPP) if spp is None else (spp, spp)
    samples = few if kind_of_truth(run_or_asset, folder) == "duplicates" else many
    how = {"spp": samples, "seed": seed, "lpips": network}
    if protocol == "relit":
        result = _relit_figures(Path(run_or_asset), folder, how)
    else:
        result = _protocol_figures(protocol, Path(run_or_asset), folder, how)
    if lpips is not None:
        result["lpips"] = Path(lpips).name
    return {"protocol": protocol, **result}


def kind_of_truth(run_or_asset: str | Path, folder: Path) -> str:
    """'multiview', 'flash', 'duplicates' or 'collection': by the truth, else by the asset."""
    from relit.asset.asset import load_asset
    from relit.evaluate.flash import is_flash_truth

    if truth_kind(folder) in ("duplicates", "collection"):
        return truth_kind(folder)
    if is_flash_truth(folder):
        return "flash"
    if has_truth(folder):
        return "multiview"
    asset = load_asset(run_or_asset)
    if asset.instances:
        return "duplicates"
    if asset.lights:
        return "collection"
    return "multiview" if asset.flash is None else "flash"


def _relit_figures(run: Path, folder: Path, how: dict[str, Any]) -> dict[str, Any]:
    """Relit's own protocol. how: spp, seed, lpips."""
    from relit.asset.asset import load_asset
    from relit.evaluate.duplicates import evaluate_duplicates, evaluate_on_photo
    from relit.evaluate.flash import evaluate_flash, is_flash_truth

    kind = truth_kind(folder)
    if kind == "duplicates":
        return evaluate_duplicates(run, folder, **how)
    if is_flash_truth(folder):
        return evaluate_flash(run, folder, **how)
    asset = load_asset(run)
    if kind == "collection":
        from relit.evaluate.collection import evaluate_collection

        result = evaluate_collection(run, folder, **how)
    elif has_truth(folder):
        result = evaluate_asset(asset, load_truth(folder), **how)
    elif asset.instances:
        result = evaluate_on_photo(run, folder, **how)
    elif asset.lights:
        from relit.evaluate.collection_photos import evaluate_on_collection

        result = evaluate_on_collection(asset, folder, run=run, **how)
    else:
        from relit.evaluate.photos import evaluate_on_photos

        result = evaluate_on_photos(asset, folder, run=run, **how)
    values = glb_roundtrip(asset, run / "stages" / "asset")
    result["metrics"].update(entries(values, DEFINITIONS))
    return result


def _protocol_figures(
    protocol: str, run: Path, folder: Path, how: dict[str, Any]
) -> dict[str, Any]:
    """The figures of a paper's protocol. how: spp, seed, lpips."""
    from relit.evaluate.picture_figures import Draw
    from relit.evaluate.protocols import orb, pir, samurai, sfd

    kind, modules = (
        kind_of_truth(run, folder),
        {"sfd": sfd, "pir": pir, "samurai": samurai, "orb": orb},
    )
    module = modules[protocol]
    if kind not in module.KINDS:
        fitting = ["relit", *(name for name, each in modules.items() if kind in each.KINDS)]
        raise UserError(
            f"protocol '{protocol}' does not apply to a capture of kind '{kind}'",
            f"it measures {module.MEASURES}",
            f"use --protocol {' or '.join(fitting)}",
            code=EXIT_USAGE,
        )
    return module.evaluate_by_protocol(run, folder, Draw(**how))
