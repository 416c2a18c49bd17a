"""What a photo tells after it was shrunk to fit the pass."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from relit.fit.passes.load_photos import load_pixels, partly_clipped
from relit.geometry.se3 import look_at
from relit.scene import Camera, Capture, Photo, Pixels, Sphere

SIDE, SHRUNK = 48, 16


def highlight(sigma: float, top: float) -> tuple[np.ndarray, np.ndarray]:
    """(true radiance (S, S, 3) of a highlight, what a camera that clips at 1 keeps of it)."""
    at = np.arange(SIDE) + 0.5 - SIDE / 2
    spot = 0.2 + top * np.exp(-(at[:, None] ** 2 + at**2) / (2 * sigma**2))
    true = np.repeat(spot[..., None], 3, -1).astype(np.float32)
    return true, np.minimum(true, 1)


def opened(rgb: np.ndarray, clipped) -> Capture:
    camera = Camera(SIDE, SIDE, 1.2 * SIDE, 1.2 * SIDE, SIDE / 2, SIDE / 2, look_at([0, 0, 4.0]))
    pixels = Pixels(rgb, np.ones(rgb.shape[:2], np.float32), None, clipped)
    photo = Photo("a.jpg", lambda: pixels, SIDE, SIDE, camera)
    return Capture(Path("."), "photos", (photo,), sphere=Sphere(np.zeros(3), 3.0))


def drawn_of(capture: Capture, max_pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """(rgb (h, w, 3), bool (h, w): pixels that batches are drawn from)."""
    options = SimpleNamespace(max_pixels=max_pixels)
    photos = load_pixels(capture, options, SimpleNamespace(say=lambda text: None))
    side = photos.cameras[0].width
    rgb = np.array(photos.bank.rgbm).reshape(side, side, 4)[..., :3]
    drawn = np.zeros(side * side, bool)
    drawn[np.array(photos.bank.candidates)] = True
    return rgb, drawn.reshape(side, side)


def test_no_pixel_that_is_drawn_is_darker_than_what_was_there():
    true, kept = highlight(sigma=3.0, top=20.0)
    mean = true.reshape(SHRUNK, 3, SHRUNK, 3, 3).mean((1, 3))
    rgb, drawn = drawn_of(opened(kept, (kept >= 1).any(-1)), SHRUNK**2)
    assert rgb.shape[:2] == (SHRUNK, SHRUNK) and (mean > 1.3 * rgb).any()
    exposed = drawn & (rgb.max(-1) < 0.99)
    np.testing.assert_allclose(rgb[exposed], mean[exposed], rtol=1e-4)
    assert (drawn & (rgb.max(-1) >= 0.99)).any()  # fully clipped: at least this bright
    assert 0.7 < drawn.mean() < 1


def test_at_full_size_and_without_codes_all_pixels_are_drawn():
    _, kept = highlight(sigma=3.0, top=20.0)
    for clipped in ((kept >= 1).any(-1), None):
        assert drawn_of(opened(kept, clipped), SIDE**2)[1].all()
    assert partly_clipped(Pixels(kept, None, None, None), kept) is None
