"""Which protocol a truth asks for, and its figures.

Pictures are rendered by the same path tracer as the truth. What each figure means: evaluate/definitions.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from relit.evaluate.definitions import DEFINITIONS
from relit.evaluate.multiview import evaluate_asset
from relit.evaluate.results import entries
from relit.evaluate.roundtrip import glb_roundtrip
from relit.evaluate.truth import has_truth, load_truth, truth_kind

SPP, SPP_PILE = 256, 64


def evaluate(
    run_or_asset: str | Path, truth_folder: str | Path, *, spp: int | None = None, seed: int = 0
) -> dict[str, Any]:
    """Every figure that the truth allows, for the asset in a run or asset folder. truth_folder: what `relit synthesize` wrote; or the
    capture that the asset was made from, whose photos are the truth then (evaluate/photos.py, evaluate/collection_photos.py).

    spp: samples a pixel of the pictures that are compared, SPP where none are asked for (of piles SPP_PILE, whose pictures take long);
    their noise counts as error. Returns {"metrics": {name: {"value", "unit",
    "definition"}}, "per_view": {view: {name: value}}, "albedo_scale": [r, g, b], "alignment": "identity" or "sim3"}.
    Call `relit.device.use_device` first.
    """
    from relit.asset.asset import load_asset
    from relit.evaluate.duplicates import evaluate_duplicates, evaluate_on_photo
    from relit.evaluate.flash import evaluate_flash, is_flash_truth

    folder = Path(truth_folder)
    folder = (
        folder.parent if folder.name == "truth" and (folder / "settings.json").is_file() else folder
    )
    kind = truth_kind(folder)
    few, spp = (SPP_PILE, SPP) if spp is None else (spp, spp)
    if kind == "duplicates":
        return evaluate_duplicates(run_or_asset, folder, spp=few, seed=seed)
    if is_flash_truth(folder):
        return evaluate_flash(run_or_asset, folder, spp=spp, seed=seed)
    asset = load_asset(run_or_asset)
    if kind == "collection":
        from relit.evaluate.collection import evaluate_collection

        result = evaluate_collection(run_or_asset, folder, spp=spp, seed=seed)
    elif has_truth(folder):
        result = evaluate_asset(asset, load_truth(folder), spp=spp, seed=seed)
    elif asset.instances:
        result = evaluate_on_photo(run_or_asset, folder, spp=few, seed=seed)
    elif asset.lights:
        from relit.evaluate.collection_photos import evaluate_on_collection

        result = evaluate_on_collection(asset, folder, run=Path(run_or_asset), spp=spp, seed=seed)
    else:
        from relit.evaluate.photos import evaluate_on_photos

        result = evaluate_on_photos(asset, folder, run=Path(run_or_asset), spp=spp, seed=seed)
    value = glb_roundtrip(asset, Path(run_or_asset) / "stages" / "asset")
    if value is not None:
        result["metrics"].update(entries({"glb_roundtrip_psnr": value}, DEFINITIONS))
    return result
