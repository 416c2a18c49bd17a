"""The real photo sets, where they are at hand."""

import numpy as np
import pytest

from relit.capture.open import open_capture


def real(shared, name):
    folder = shared / "real" / name
    if not folder.is_dir():
        pytest.skip(f"needs the photos of {name}")
    return folder


@pytest.mark.slow
def test_fox(shared):
    capture = open_capture(real(shared, "multiview_fox"), max_side=240)
    assert (len(capture.photos), len(capture.held_out), capture.format) == (50, 17, "transforms")
    assert capture.photos[0].load().mask is None and not capture.black_background
    assert (
        capture.photos[0].camera.distortion == ()
        and capture.photos[0].load().rgb.shape[0] == capture.photos[0].height
    )
    assert capture.up[2] > 0.98
    # the nose and the foot of the shield lie in the sphere: the middle of it projects near the
    # middle of the frontal photos
    x, y, _ = capture.photos[9].camera.project(capture.sphere.centre)
    assert (
        abs(x / capture.photos[9].width - 0.5) < 0.15
        and abs(y / capture.photos[9].height - 0.5) < 0.15
    )
    assert 2.5 < capture.sphere.radius < 3.2  # the ears stand out of a ball of 2.3


def test_dino(shared):
    capture = open_capture(real(shared, "multiview_dino"))
    assert (len(capture.photos), capture.format, capture.black_background) == (
        16,
        "middlebury",
        True,
    )
    low, high = (
        np.array([-0.061897, -0.018874, -0.057845]),
        np.array([0.010897, 0.068227, 0.015495]),
    )  # the data set's tight box
    middle = 0.5 * (low + high)
    assert np.linalg.norm(capture.sphere.centre - middle) < 0.012
    assert (
        0.9 * np.linalg.norm(high - low) / 2
        < capture.sphere.radius
        < 1.25 * np.linalg.norm(high - low) / 2 + 0.01
    )
    pixels = capture.photos[7].load()
    assert 0.38 < pixels.mask.mean() < 0.45
    assert pixels.rgb[pixels.mask == 0].max() == 0


def test_a_collection_with_its_poses(shared):
    capture = open_capture(real(shared, "collection_liberty"), max_side=128, masks="none")
    assert capture.format == "llff" and len(capture.photos) == 135 and capture.sphere is not None
    assert capture.photos[0].load().rgb.shape == (128, 85, 3)
