"""Masks whose outlines wander: what the volume pass makes of them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from relit.synthesize.collection import roughened
from support.volume_lump import photos_of, volume_lump

LEVELS = {"levels": (24, 48), "steps": (60, 120), "rays": 2048}


@pytest.fixture(scope="module")
def lump():
    return volume_lump()


@pytest.fixture(scope="module")
def photos(lump):
    """(rgb, roughened mask, camera) of the lump, from true cameras, each under an exposure and a
    white of its own."""
    shots = photos_of(lump, 24, np.random.default_rng(3))
    return [(rgb, roughened(alpha, 3.0, i), camera) for i, (rgb, alpha, camera) in enumerate(shots)]


def fitted(photos, **options):
    """The mesh that the volume pass makes of the photos."""
    from relit.fit.collection.shape import tolerant_hull
    from relit.fit.passes.optimiser import NoStage
    from relit.fit.passes.pixels import make_bank
    from relit.fit.passes.volume import VolumeOptions, fit_volume, start_model
    from relit.geometry.mesh import extract_mesh
    from relit.geometry.sdf import dense_values
    from relit.rendering.appearance.light_per_photo import shade_photos, start_photo_lights

    rgb, masks, cameras = zip(*photos, strict=True)
    tints = np.array([r[m > 0.9].mean(0) for r, m in zip(rgb, masks, strict=True)])
    model = start_model(
        tolerant_hull(list(cameras), list(masks), LEVELS["levels"][0]),
        np.full(3, 0.3),
        None,
        full=False,
    )
    model.reflections, model.rates = start_photo_lights(tints, 0.3)
    model.appearance = shade_photos
    fit_volume(
        make_bank(list(cameras), list(rgb), list(masks)),
        model,
        VolumeOptions(**LEVELS, **options),
        NoStage(),
        0,
    )
    return extract_mesh(dense_values(model.grid), faces=8000)


def normal_error(mesh, lump) -> float:
    """Mean angle between the normals of a mesh and those of the lump where it is nearest,
    degrees."""
    from relit.geometry.mesh import extract_mesh
    from relit.geometry.sdf import dense_values

    true = extract_mesh(dense_values(lump.grid), faces=20_000)
    nearest = cKDTree(true.vertices).query(mesh.vertices)[1]
    return float(
        np.degrees(np.arccos(np.clip((mesh.normals * true.normals[nearest]).sum(1), -1, 1))).mean()
    )


@pytest.mark.slow
def test_masks_that_are_heard_less_in_the_fine_level_leave_a_smoother_surface(photos, lump):
    loud, quiet = (normal_error(fitted(photos, mask=m), lump) for m in ((0.8,), (0.8, 0.1)))
    assert quiet < 0.9 * loud  # measured on four sets of photos: .850 to .865


def test_a_weight_is_that_of_its_level_and_the_last_one_of_all_further_levels(photos, monkeypatch):
    from relit.fit.passes import volume

    heard = []
    monkeypatch.setattr(
        volume, "_fit_level", lambda bank, model, *a, **k: heard.append((model.grid.n, k["mask"]))
    )
    monkeypatch.setitem(LEVELS, "levels", (16, 24, 32))
    monkeypatch.setitem(LEVELS, "steps", (1, 1, 1))
    fitted(photos[:6], mask=(0.8, 0.1))
    assert heard == [(16, 0.8), (24, 0.1), (32, 0.1)]


@pytest.mark.parametrize("weights", [(), (0.8, -0.1)])
def test_senseless_weights_are_refused(weights):
    from relit.fit.collection.options import CollectionOptions

    with pytest.raises(ValueError, match="mask_weights"):
        CollectionOptions(mask_weights=weights)
