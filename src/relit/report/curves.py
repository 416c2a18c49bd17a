"""Small drawings of the report as inline SVG."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from relit.conventions import move_points, similarity
from relit.scene import Asset, Camera

WIDTH, HEIGHT, MARGIN = 360, 160, 28
PLANE = 300  # a side of the camera plot


def curve(title: str, points: list[tuple[float, float]]) -> str:
    """A line over steps; the ordinate is logarithmic when all values are positive and span more
    than a factor of 5."""
    x, y = np.array(points, dtype=np.float64).T
    log = y.min() > 0 and y.max() / y.min() > 5
    v = np.log10(y) if log else y
    px = MARGIN + (x - x[0]) / max(x[-1] - x[0], 1e-12) * (WIDTH - 2 * MARGIN)
    py = HEIGHT - MARGIN - (v - v.min()) / max(v.max() - v.min(), 1e-12) * (HEIGHT - 2 * MARGIN)
    keep = np.unique(np.linspace(0, len(px) - 1, 400).round().astype(int))
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(px[keep], py[keep], strict=True))
    labels = [
        _text(MARGIN, 16, title + (" (log)" if log else "")),
        _text(MARGIN, HEIGHT - 8, f"step {x[0]:.0f}"),
        _text(WIDTH - MARGIN, HEIGHT - 8, f"{x[-1]:.0f}", "end"),
        _text(WIDTH - 2, py[-1], f"{y[-1]:.3g}", "end"),
        _text(2, py[0] - 4, f"{y[0]:.3g}"),
    ]
    return _svg(
        WIDTH,
        HEIGHT,
        f'<polyline fill="none" stroke="#26c" stroke-width="1.5" points="{line}"/>'
        + "".join(labels),
    )


def bars(rows: list[tuple[str, float]]) -> str:
    """Horizontal bars of seconds."""
    if not rows:
        return ""
    longest = max(seconds for _, seconds in rows) or 1.0
    parts = []
    for i, (name, seconds) in enumerate(rows):
        parts.append(
            f'<rect x="130" y="{8 + 22 * i}" width="{200 * seconds / longest:.1f}" height="14" fill="#8ac"/>'
        )
        parts.append(_text(124, 19 + 22 * i, name, "end"))
    return _svg(WIDTH, 22 * len(rows) + 12, "".join(parts))


def ball_of(asset: Asset) -> np.ndarray:
    """(4, 4) ball_from_world: the asset's bounding sphere becomes the unit ball at the origin, +Y
    up as in the GLB."""
    low, high = asset.mesh.vertices.min(0), asset.mesh.vertices.max(0)
    centre = 0.5 * (low + high)
    radius = float(np.linalg.norm(asset.mesh.vertices - centre, axis=1).max())
    return similarity(np.eye(3), -centre / radius, 1 / radius) @ np.linalg.inv(
        asset.world_from_asset
    )


def camera_plot(cameras: Sequence[Camera], ball_from_world: np.ndarray) -> str:
    """Cameras around the unit ball that holds the object, from above (X and Z) and from the side (X
    and Y, +Y up). One SVG."""
    if not cameras:
        return ""
    eyes = move_points(ball_from_world, np.array([c.centre for c in cameras]))
    axes = (
        np.array([np.asarray(c.world_from_camera)[:3, 2] for c in cameras])
        @ np.asarray(ball_from_world)[:3, :3].T
    )
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    reach = 1.1 * max(float(np.abs(eyes).max()), 1.0)
    above = _plane(eyes, axes, reach, (0, 2), f"{len(cameras)} cameras from above")
    side = _plane(eyes, axes, reach, (0, 1), "from the side")
    return _svg(2 * PLANE, PLANE, f'{above}<g transform="translate({PLANE} 0)">{side}</g>')


def _plane(eyes, axes, reach: float, pair: tuple[int, int], name: str) -> str:
    middle = PLANE / 2
    sign = (
        1 if pair[1] == 2 else -1
    )  # pictures grow downwards: +Z towards the reader's bottom, +Y up

    def place(p):
        return middle * (1 + p[pair[0]] / reach), middle * (1 + sign * p[pair[1]] / reach)

    parts = [
        f'<circle cx="{middle}" cy="{middle}" r="{middle / reach:.1f}" fill="#dde" stroke="#99a"/>'
    ]
    for eye, axis in zip(eyes, axes, strict=True):
        (x, y), (u, v) = place(eye), place(eye + 0.12 * reach * axis)
        parts.append(f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" stroke="#c63"/>')
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="#c63"/>')
    return "".join(parts) + _text(8, 16, name)


def _text(x: float, y: float, text: str, anchor: str = "start") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" font-size="11" fill="#444" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(width: int, height: int, body: str) -> str:
    return f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}">{body}</svg>'
