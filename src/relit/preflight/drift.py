"""Exposure, white balance and sharpness from photo to photo."""

from __future__ import annotations

import numpy as np

from relit.preflight.look import Look

BLURRED = 0.6  # of the median sharpness
EXPOSURE_DRIFT = 0.35  # EV, standard deviation
TINT_DRIFT = 0.1  # log2 of red or blue over green, standard deviation


def drift(looks: list[Look]) -> dict:
    """Per photo: exposure (EV against the median, of what is on the object or in the whole
    picture), red and blue against green (log2, against the median), sharpness (against the median),
    EXIF exposure. Over all: their spreads, and the blurred photos."""
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
    low, high = np.percentile(
        gray, (5, 95)
    )  # without highlights and holes; a median jumps between the colours of a pattern
    r, g, b = np.log2(np.maximum(x.rgb[inside][(gray >= low) & (gray <= high)].mean(0), 1e-4))
    return (
        float(np.log2(max(float(np.array([0.2126, 0.7152, 0.0722]) @ np.exp2([r, g, b])), 1e-4))),
        float(r - g),
        float(b - g),
    )


def warnings_of(found: dict, has_masks: bool, from_anywhere: bool = False) -> list[dict]:
    """What to say of `drift`'s answer. from_anywhere: each photo has an exposure and a white of its
    own (a collection)."""
    out = [] if from_anywhere else _unsteady(found, has_masks)
    if found["blurred"]:
        listed = ", ".join(found["blurred"][:5]) + (" ..." if len(found["blurred"]) > 5 else "")
        what = f"{len(found['blurred'])} photos are less sharp than the others: {listed}"
        out.append({"what": what, "fix": "leave them out, or take them again"})
    return out


def _unsteady(found: dict, has_masks: bool) -> list[dict]:
    out = []
    spread = found["exif_exposure_spread"]
    if spread is not None and spread > EXPOSURE_DRIFT:
        what = f"the camera changed its exposure: {spread:.1f} EV from photo to photo (EXIF)"
        out.append(
            {"what": what, "fix": "lock exposure; until then the light's brightness is an average"}
        )
    elif spread is None and has_masks and found["exposure_spread"] > 3.5 * EXPOSURE_DRIFT:
        what = f"the object's brightness varies by {found['exposure_spread']:.1f} EV from photo to photo"
        out.append({"what": what, "fix": "lock exposure, or look at the light regime"})
    if has_masks and found["tint_spread"] > 4.5 * TINT_DRIFT:
        what = f"the object's colour varies by {found['tint_spread']:.2f} (log2) between photos"
        out.append({"what": what, "fix": "lock white balance; mixed light shows so as well"})
    return out
