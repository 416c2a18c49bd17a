"""Features of a network on the surface: an ONNX file of the right signature, made here byte by
byte, and how its tokens reach places."""

import numpy as np
import pytest

from relit.capture.networks import MEAN, SPREAD
from relit.conventions import srgb_from_linear
from relit.errors import UserError
from relit.fit.flash.dino import (
    KEPT,
    SCALE,
    DinoNetwork,
    dino_features,
    network_file,
    principal,
    sampled,
    token_map,
)
from relit.scene import Camera
from support.dino_network import CHANNELS, PATCH, write_network


@pytest.fixture(scope="module")
def weight():
    return np.random.default_rng(3).normal(0, 0.02, (CHANNELS, 3, PATCH, PATCH))


@pytest.fixture(scope="module")
def network(tmp_path_factory, weight):
    file = tmp_path_factory.mktemp("dino") / "patches.onnx"
    write_network(file, weight)
    return DinoNetwork(file)


def test_tokens_are_those_of_the_normalised_enlarged_picture(network, weight):
    rgb = np.full((56, 56, 3), 0.2) * [1.0, 0.5, 2.0]
    got = network.features(rgb)
    assert got.shape == (14, 14, CHANNELS)  # 2 x 56 / 8
    shown = (srgb_from_linear(rgb[0, 0]) - MEAN) / SPREAD
    np.testing.assert_allclose(got[7, 7], (weight.sum((2, 3)) @ shown), rtol=1e-3, atol=1e-4)


def test_rows_and_columns_stand_where_they_are(network):
    rgb = np.zeros((56, 56, 3))
    rgb[40:44, 8:12] = 1.0
    got = network.features(rgb)
    change = np.abs(got - got[0, 0]).sum(-1)
    assert np.unravel_index(change.argmax(), change.shape) == (10, 2)


def test_like_places_get_like_features(network):
    """Two paints on a plane that three cameras look at: the features tell the paints apart, and
    views agree."""
    photo = np.zeros((56, 56, 3))
    photo[:, :28], photo[:, 28:] = [0.5, 0.1, 0.1], [0.1, 0.3, 0.6]
    cameras = [Camera(56, 56, 60, 60, 28, 28, np.eye(4))] * 3
    rng = np.random.default_rng(0)
    column, row = rng.uniform(2, 54, (2, 300))
    weight = np.where(np.arange(300) < 290, 1.0, 0.0)
    features, seen = dino_features(
        network, lambda view: photo, cameras, lambda view: (column, row, weight), 300
    )
    assert features.shape == (300, KEPT) and seen[:290].all() and not seen[290:].any()
    left, right = (features[:290][side[:290]] for side in (column < 22, column > 34))
    assert np.linalg.norm(left.mean(0) - right.mean(0)) > 10 * max(
        left.std(0).max(), right.std(0).max()
    )
    assert np.all(features[290:] == 0)


def test_look_up_is_bilinear():
    picture = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), -1)  # x and y
    x, y = np.array([0.25, 3.5, -2.0, 9.0]), np.array([1.5, 2.75, 0.0, 9.0])
    np.testing.assert_allclose(
        sampled(picture, x, y), np.stack([np.clip(x, 0, 4), np.clip(y, 0, 3)], -1)
    )


def test_principal_components_keep_distances():
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(9, 2)))[0]
    flat = rng.normal(size=(200, 2)) * [3.0, 1.0]
    got = principal(flat @ basis.T, np.ones(200, bool))
    assert got[:, 0].std() == pytest.approx(SCALE, rel=1e-4)
    ratio = np.linalg.norm(got[:100] - got[100:], axis=1) / np.linalg.norm(
        flat[:100] - flat[100:], axis=1
    )
    assert np.ptp(ratio) < 1e-4 * ratio.mean()


@pytest.mark.parametrize("shape", [(1, 9, 4), (1, 10, 4), (1, 14, 4), (1, 4, 3, 3)])
def test_outputs_of_all_signatures(shape):
    assert token_map(np.zeros(shape)).shape == (3, 3, 4)


def test_wrong_networks(tmp_path, network, monkeypatch):
    with pytest.raises(UserError, match="no network at"):
        DinoNetwork(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(UserError, match="cannot be read"):
        DinoNetwork(tmp_path / "text.onnx")
    monkeypatch.setattr(network.network, "run", lambda shown: np.zeros((1, 7, 4)))
    with pytest.raises(UserError, match="output is 1 x 7 x 4"):
        network.features(np.zeros((56, 56, 3)))
    with pytest.raises(UserError, match="names no file on the hub"):
        network_file("hub:some/thing")


def test_the_hub_is_asked_only_when_named(monkeypatch, tmp_path):
    import sys

    assert network_file(str(tmp_path / "a.onnx")) == tmp_path / "a.onnx"
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(UserError, match="optional package"):
        network_file("hub:owner/name/model.onnx")
