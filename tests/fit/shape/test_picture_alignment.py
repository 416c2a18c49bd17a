"""Pictures laid on photos: similarities that were put in are found."""

import cv2
import numpy as np
import pytest

from relit.fit.shape.picture_alignment import align_picture, moved_by

SIZE = 64


@pytest.fixture(scope="module")
def picture():
    rng = np.random.default_rng(2)
    return cv2.GaussianBlur(rng.uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32), (0, 0), 3) * 4


def similarity(right, down, degrees=0.0, size=1.0):
    a = np.radians(degrees)
    linear = size * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    middle = np.array([SIZE / 2, SIZE / 2])
    return np.column_stack([linear, np.array([right, down]) + middle - linear @ middle])


@pytest.mark.parametrize(
    "truth", [similarity(1.3, -0.8), similarity(0, 0, 2.0), similarity(0.5, 1.0, -1.5, 1.03)]
)
def test_a_similarity_is_found(picture, truth):
    where = np.zeros((SIZE, SIZE), bool)
    where[12:50, 10:54] = True
    found = align_picture(picture, moved_by(picture, truth), where)
    corners = np.array([[12, 12, 1], [50, 12, 1], [12, 50, 1], [50, 50, 1]]).T
    assert np.abs(found @ corners - truth @ corners).max() < 0.1


def test_only_what_is_asked_for_counts(picture):
    truth, where = similarity(1.0, 0.5), np.zeros((SIZE, SIZE), bool)
    where[10:54, 10:30] = True
    photo = moved_by(picture, truth)
    photo[:, 36:] = moved_by(picture, similarity(-2, -2))[:, 36:]
    assert np.abs(align_picture(picture, photo, where) - truth).max() < 0.1


def test_what_shows_no_structure_stays(picture):
    everywhere, nowhere = np.ones((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)
    flat = np.full((SIZE, SIZE, 3), 0.5, np.float32)
    assert np.allclose(align_picture(flat, flat, everywhere), np.eye(2, 3))
    assert np.allclose(align_picture(picture, flat, nowhere), np.eye(2, 3))
