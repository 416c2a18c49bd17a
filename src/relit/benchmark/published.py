"""Values that papers print for the figures of the suites. Each is under the paper's own protocol
(`relit evaluate --protocol`), on the paper's own captures."""

from __future__ import annotations

from relit.evaluate.protocols import pir, samurai, sfd
from relit.evaluate.results import PaperValue

_FLASH, _PILE = pir.PAPERS["offset"], sfd.PAPERS["duplicates"]
PUBLISHED: dict[str, dict[str, PaperValue]] = {
    "multiview": {"relit_psnr": PaperValue(31.84, "PTIR-GS, TensoIR-synthetic")},
    "flash": {
        figure: _FLASH[figure]
        for figure in ("novel_psnr", "diffuse_psnr", "specular_psnr", "roughness_mse")
    },
    "collection": {figure: samurai.PAPERS[figure] for figure in ("novel_psnr", "rotation_mean")},
    "duplicates": {
        "rotation_median": _PILE["rotation_mean"],
        **{
            figure: _PILE[figure]
            for figure in (
                *("albedo_psnr", "relit_psnr", "roughness_mse", "environment_mse", "chamfer"),
            )
        },
    },
}


def published_text(paper: PaperValue | None) -> str:
    """A cell of a table."""
    if paper is None:
        return "-"
    rerun = "" if paper.rerun is None else f"; re-run {paper.rerun:g}"
    return f"{paper.value:g} ({paper.where}{rerun})"
