"""The figures of one rendered picture against its reference: PSNR, SSIM and, with a network, LPIPS,
each over the whole frame and inside the mask."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.evaluate import metrics as m
from relit.evaluate.lpips import Lpips


@dataclass(frozen=True)
class Draw:
    """How pictures are drawn and compared. spp: samples a pixel. seed: of the first view, one more
    for each further one. lpips: distance of two pictures, or None."""

    spp: int
    seed: int = 0
    lpips: Lpips | None = None

    def fewer(self, factor: int) -> Draw:
        """With 1/factor of the samples and without LPIPS."""
        return Draw(max(1, self.spp // factor), self.seed)


LPIPS = {
    "lpips": "LPIPS of sRGB-encoded pictures by the network of --lpips, whole frame on black; mean "
    "over views",
    "lpips_masked": f"as lpips, black in both pictures where the truth coverage is < {m.MASK}",
}


def picture_figures(
    shown, truth, inside, lpips: Lpips | None = None, encode=m.encode
) -> dict[str, float]:
    """psnr, ssim, lpips and their `_masked` of linear pictures (H, W, 3) on black. inside: (H, W)
    bool. encode: linear -> [0, 1]."""
    a, b = encode(shown), encode(truth)
    s = m.ssim_map(a, b)
    out = {
        "psnr": m.psnr(a, b),
        "psnr_masked": m.psnr(a, b, inside),
        "ssim": float(s.mean()),
        "ssim_masked": float(s[inside].mean()) if np.any(inside) else float("nan"),
    }
    if lpips is not None:
        only = np.asarray(inside, bool)[..., None]
        out["lpips"] = lpips(a, b)
        out["lpips_masked"] = lpips(a * only, b * only)
    return out


def prefixed(prefix: str, figures: dict[str, float], tail: str = "") -> dict[str, float]:
    """{PREFIX_name TAIL: value}."""
    return {f"{prefix}_{name}{tail}": value for name, value in figures.items()}


def definitions_of(prefix: str, what: str) -> dict[str, tuple[str, str]]:
    """PREFIX_name -> (unit, definition) of all figures of `picture_figures`. what: the pictures."""
    units = {"psnr": "dB", "psnr_masked": "dB"}
    names = ("psnr", "psnr_masked", "ssim", "ssim_masked")
    texts = {name: m.DEFINITIONS[name] for name in names} | LPIPS
    return {f"{prefix}_{n}": (units.get(n, ""), f"{what}: {text}") for n, text in texts.items()}
