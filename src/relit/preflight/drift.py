"""Variation of exposure, white balance and sharpness between photos."""

from __future__ import annotations

import numpy as np

from relit.preflight.look import Look

BLURRED = 0.6  # of the median sharpness
EXPOSURE_DRIFT = 0.35  # EV, standard deviation
TINT_DRIFT = 0.1  # log2 of red or blue over green, standard deviation


def drift(looks: list[Look]) -> dict:
    """Per photo, relative to the median: exposure (EV, inside the mask or of the whole image), red
    and blue over green (log2), sharpness; and EXIF exposure. Over all photos: standard deviations,
    and the blurred photos."""
    level, red, blue = (np.array(a) for a in zip(*[_colour(x) for x in looks], strict=True))
    level, red, blue = level - np.median(level), red - np.median(red), blue - np.median(blue)
    sharp = np.array([x.sharpness for x in looks])
    sharp = sharp / max(float(np.median(sharp)), 1e-6)
    evs = [x.exif.ev for x in looks]
    known = [e for e in evs if e is not None]
    rows = [
        {
            "name": x.name,
            "ev": round(float(e), 2),
            "red": round(float(r), 3),
            "blue": round(float(b), 3),
            "sharpness": round(float(s), 2),
        }
        | ({} if ev is None else {"exif_ev": round(ev, 2)})
        for x, e, r, b, s, ev in zip(looks, level, red, blue, sharp, evs, strict=True)
    ]
    return {
        "exposure_spread": round(float(level.std()), 3),
        "tint_spread": round(float(max(red.std(), blue.std())), 3),
        "exif_exposure_spread": None if len(known) < 2 else round(float(np.std(known)), 3),
        "blurred": [x.name for x, s in zip(looks, sharp, strict=True) if s < BLURRED],
        "cameras": sorted({x.exif.camera for x in looks if x.exif.camera}),
        "photos": rows,
    }


def _colour(x: Look) -> tuple[float, float, float]:
    inside = (
        np.ones(x.rgb.shape[:2], bool)
        if x.mask is None or (x.mask > 0.9).sum() < 30
        else x.mask > 0.9
    )
    gray = x.gray[inside]
    # a trimmed mean: the median would jump between the colours of a pattern
    low, high = np.percentile(gray, (5, 95))
    r, g, b = np.log2(np.maximum(x.rgb[inside][(gray >= low) & (gray <= high)].mean(0), 1e-4))
    return (
        float(np.log2(max(float(np.array([0.2126, 0.7152, 0.0722]) @ np.exp2([r, g, b])), 1e-4))),
        float(r - g),
        float(b - g),
    )


def drift_warnings(found: dict, has_masks: bool, from_anywhere: bool = False) -> list[dict]:
    """Warnings for a result of `drift`. from_anywhere: exposure and white balance may differ per
    photo (a collection)."""
    out = [] if from_anywhere else _unsteady(found, has_masks)
    if found["blurred"]:
        listed = ", ".join(found["blurred"][:5]) + (" ..." if len(found["blurred"]) > 5 else "")
        what = f"{len(found['blurred'])} photos are blurred compared to the others: {listed}"
        out.append({"what": what, "fix": "remove them or take them again"})
    return out


def _unsteady(found: dict, has_masks: bool) -> list[dict]:
    out = []
    spread = found["exif_exposure_spread"]
    if spread is not None and spread > EXPOSURE_DRIFT:
        what = f"exposure varies by {spread:.1f} EV between photos (EXIF)"
        out.append(
            {"what": what, "fix": "lock exposure; otherwise the light's intensity is an average"}
        )
    elif spread is None and has_masks and found["exposure_spread"] > 3.5 * EXPOSURE_DRIFT:
        what = f"the object's brightness varies by {found['exposure_spread']:.1f} EV between photos"
        out.append({"what": what, "fix": "lock exposure, or check the light regime"})
    if has_masks and found["tint_spread"] > 4.5 * TINT_DRIFT:
        what = f"the object's colour varies by {found['tint_spread']:.2f} (log2) between photos"
        out.append({"what": what, "fix": "lock white balance; mixed light has the same effect"})
    return out
