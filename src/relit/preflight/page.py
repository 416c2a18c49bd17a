"""The preflight as one self-contained HTML page without scripts."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

import cv2
import numpy as np

from relit.conventions import srgb_from_linear
from relit.files import disk_errors, write_text
from relit.preflight.cameras import AGREES, MatchedPair, fundamental, sphere_outline
from relit.preflight.look import Look
from relit.preflight.text import rows_of
from relit.report.curves import curve
from relit.scene import Capture

SIDE = 260  # pixels of a thumbnail
LINES = 10  # matches drawn per pair
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:1300px;padding:0 1em;color:#222;background:#fafafa}
h1{font-size:1.5em;margin-bottom:.1em}h2{font-size:1.1em;margin:1.8em 0 .5em;border-bottom:1px solid #ccc}
.row{display:flex;flex-wrap:wrap;gap:10px}figure{margin:0}figcaption{font-size:12px;color:#555}img{display:block;border-radius:3px}
table{border-collapse:collapse}td{padding:2px 14px 2px 0;vertical-align:top}td:first-child{color:#555;white-space:nowrap}
.warn{background:#fff3e0;border-left:4px solid #e68a00;padding:6px 12px;margin:6px 0}.warn small{color:#555;display:block}
svg{background:#fff;border:1px solid #ddd;border-radius:3px}
"""


def write_page(
    path: Path,
    found: dict,
    capture: Capture,
    looks: list[Look],
    pairs: list[MatchedPair],
    plot: str | None,
) -> None:
    """Write the page. found: result of `inspect_input`. plot: the cameras as SVG, or None."""
    warnings = (
        "".join(
            f"<div class=warn>{escape(w['what'])}<small>{escape(w['fix'])}</small></div>"
            for w in found["warnings"]
        )
        or "<p>No warnings.</p>"
    )
    table = "".join(f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in rows_of(found))
    notes = "".join(f"<li>{escape(n)}</li>" for n in found["notes"])
    regime = found["light_regime"]
    evidence = "".join(f"<li>{escape(e)}</li>" for e in regime["evidence"])
    drawn = "".join(
        _thumbnail(x, capture, row) for x, row in zip(looks, found["drift"]["photos"], strict=True)
    )
    parts = [
        f"<h1>{escape(Path(found['input']).name or found['input'])}</h1><table>{table}</table>",
        _section("Warnings", warnings),
        _section("Notes of the reader", f"<ul>{notes}</ul>" if notes else ""),
        _section(
            f"Light: {regime['guess']}, confidence {100 * regime['confidence']:.0f} %",
            f"<ul>{evidence}</ul>" if evidence else "",
        ),
        _section("Cameras around the object sphere", plot or ""),
        _section(
            "Matches and the epipolar lines of the given cameras",
            "".join(_pair(p) for p in _worst(pairs)),
        ),
        _section(
            f"Photos ({len(looks)} of {found['photos']}), masks in colour, the object sphere as a circle",
            f"<div class=row>{drawn}</div>",
        ),
        _section(
            "From photo to photo", f"<div class=row>{_drifts(found['drift']['photos'])}</div>"
        ),
    ]
    title = escape(f"Relit preflight: {Path(found['input']).name}")
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
    with disk_errors(path.parent):
        write_text(path, head + "".join(parts) + "</html>\n")


def _section(title: str, body: str) -> str:
    return f"<h2>{escape(title)}</h2>{body}" if body else ""


def _codes(rgb: np.ndarray) -> np.ndarray:
    return (np.clip(srgb_from_linear(rgb), 0, 1) * 255).astype(np.uint8)


def _uri(codes: np.ndarray) -> str:
    ok, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(codes[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 82]
    )
    assert ok
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def _figure(codes: np.ndarray, caption: str) -> str:
    h, w = codes.shape[:2]
    text = f'<figcaption style="max-width:{w}px">{escape(caption)}</figcaption>'
    return f'<figure><img alt="" width={w} height={h} src="{_uri(codes)}">{text}</figure>'


def overlaid(x: Look, capture: Capture) -> np.ndarray:
    """(h, w, 3) uint8: the photo, darker and blue outside its mask, with the outline of the object
    sphere."""
    s = SIDE / max(x.gray.shape)
    size = (max(1, round(x.gray.shape[1] * s)), max(1, round(x.gray.shape[0] * s)))
    codes = cv2.resize(_codes(x.rgb), size, interpolation=cv2.INTER_AREA)
    if x.mask is not None:
        mask = cv2.resize(x.mask, size, interpolation=cv2.INTER_AREA)[..., None]
        codes = (
            (codes * (0.35 + 0.65 * mask) + np.array([40, 60, 130]) * 0.6 * (1 - mask))
            .clip(0, 255)
            .astype(np.uint8)
        )
    if x.camera is not None and capture.sphere is not None:
        cx, cy, r = (v * s for v in sphere_outline(x.camera, capture.sphere))
        if max(abs(cx), abs(cy), r) < 1e4:
            codes = cv2.circle(
                np.ascontiguousarray(codes),
                (round(cx), round(cy)),
                max(1, round(r)),
                (255, 170, 60),
                1,
                cv2.LINE_AA,
            )
    return codes


def _thumbnail(x: Look, capture: Capture, row: dict) -> str:
    e = x.exif
    parts = [f"{row['ev']:+.1f} EV", f"sharpness {row['sharpness']:.2f}"]
    parts += (
        [f"1/{1 / e.exposure:.0f} s" if e.exposure < 0.5 else f"{e.exposure:.1f} s"]
        if e.exposure
        else []
    )
    parts += [f"f/{e.fnumber:.1f}"] if e.fnumber else []
    parts += [f"ISO {e.iso:.0f}"] if e.iso else []
    parts += ["flash"] if e.flash else []
    parts += [e.camera] if e.camera else []
    return _figure(overlaid(x, capture), f"{x.name}: {', '.join(parts)}")


def _worst(pairs: list[MatchedPair]) -> list[MatchedPair]:
    """The pairs with the lowest and the highest share of matches near their epipolar lines."""
    order = sorted(
        pairs, key=lambda p: float((p.distance < AGREES * max(p.second.gray.shape)).mean())
    )
    return order[:1] + (order[-1:] if len(order) > 1 else [])


def _pair(p: MatchedPair) -> str:
    a, b = np.ascontiguousarray(_codes(p.first.rgb)), np.ascontiguousarray(_codes(p.second.rgb))
    h = max(a.shape[0], b.shape[0])
    assert p.first.camera is not None and p.second.camera is not None
    f = fundamental(p.first.camera, p.second.camera)
    chosen = np.linspace(0, len(p.points) - 1, min(LINES, len(p.points))).round().astype(int)
    for k, i in enumerate(chosen):
        colour = tuple(
            int(v)
            for v in cv2.cvtColor(
                np.array([[[k * 180 // LINES, 220, 255]]], np.uint8), cv2.COLOR_HSV2RGB
            )[0, 0]
        )
        q, r = p.points[i]
        l0, l1, l2 = f @ [q[0], q[1], 1]
        ends = (
            [(0.0, -l2 / l1), (b.shape[1], -(l2 + l0 * b.shape[1]) / l1)]
            if abs(l1) > abs(l0)
            else [(-l2 / l0, 0.0), (-(l2 + l1 * b.shape[0]) / l0, b.shape[0])]
        )
        if np.isfinite(ends).all() and np.abs(ends).max() < 1e5:
            start, end = (tuple(round(float(v)) for v in e) for e in ends)
            cv2.line(b, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(a, tuple(round(float(v)) for v in q), 4, colour, 2, cv2.LINE_AA)
        cv2.circle(b, tuple(round(float(v)) for v in r), 4, colour, 2, cv2.LINE_AA)
    both = np.concatenate([np.pad(x, ((0, h - x.shape[0]), (0, 0), (0, 0))) for x in (a, b)], 1)
    near = float((p.distance < AGREES * max(p.second.gray.shape)).mean())
    what = f"{p.first.name} and {p.second.name}: {len(p.points)} matches, {100 * near:.0f} % near their epipolar lines"
    return _figure(both, what + "; each ring on the right should lie on its epipolar line")


def _drifts(rows: list[dict]) -> str:
    against = "relative to the median"
    names = {
        "ev": f"brightness, EV {against}",
        "red": "red over green, log2",
        "blue": "blue over green, log2",
        "sharpness": f"sharpness {against}",
    }
    return (
        "".join(
            curve(text, [(i, row[key]) for i, row in enumerate(rows)])
            for key, text in names.items()
        )
        if len(rows) > 1
        else ""
    )
