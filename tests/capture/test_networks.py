"""Networks that a user brings: segmenters and normal priors, ONNX files made here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh

from relit.capture.networks import MEAN, SPREAD, Network, found_instances, predicted_normals
from relit.conventions import similarity
from relit.errors import UserError
from relit.evaluate.duplicates import photo_figures_of
from relit.evaluate.picture_figures import Draw
from relit.job import Job, open_as
from relit.scene import Asset, Camera, Instance, Material, Mesh
from support.tiny_onnx import write_pointwise

W, H = 160, 96


def two_discs(folder):
    picture = np.full((H, W, 3), 90, np.uint8)
    cv2.circle(picture, (40, 48), 25, (10, 10, 240), -1)  # red
    cv2.circle(picture, (115, 50), 30, (240, 10, 10), -1)  # blue
    cv2.imwrite(str(folder / "photo.png"), picture)
    return folder / "photo.png"


def segmenter(file):
    """Masks as logits: red against blue, and blue against red."""
    weight = 8 * np.array([[1.0, 0, -1], [-1, 0, 1]])
    shift = weight @ (np.array(MEAN) / SPREAD)  # the network sees (x - MEAN) / SPREAD
    return write_pointwise(file, weight, [shift[0] - 8, shift[1] - 8])


def test_a_photo_without_labels_and_a_segmenter(tmp_path):
    path, network = two_discs(tmp_path), segmenter(tmp_path / "segmenter.onnx")
    capture, kind = open_as(
        path, Job(capture="duplicates", masks=f"segment:{network}", focal=200.0)
    )
    labels = capture.photos[0].load().labels
    assert kind == "duplicates" and set(np.unique(labels)) == {0, 1, 2}
    assert labels[48, 40] == 1 and labels[50, 115] == 2 and labels[5, 80] == 0
    assert abs((labels == 2).sum() - np.pi * 30**2) < 250
    assert any("2 objects found by segmenter.onnx" in n for n in capture.notes)
    folder, _ = open_as(
        tmp_path, Job(capture="duplicates", masks=f"segment:{network}", focal=200.0)
    )
    assert len(folder.photos) == 1


def test_a_run_with_a_segmenter_is_measured_by_its_labels(tmp_path, device):
    """There are no labels beside the photo: config.toml says which network told them."""
    path, network = two_discs(tmp_path), segmenter(tmp_path / "segmenter.onnx")
    (tmp_path / "run").mkdir()
    ball = trimesh.creation.icosphere(3)
    v, one = ball.vertices.astype(np.float32), np.ones((1, 1), np.float32)
    material = Material(np.full((1, 1, 3), 0.5, np.float32), one, 0 * one)
    poses = [
        similarity(np.eye(3), [(x - 80) / 20, (y - 48) / 20, 10.0], r / 20)
        for x, y, r in ((40, 48, 25), (115, 50, 30))
    ]
    instances = tuple(Instance(k + 1, pose) for k, pose in enumerate(poses))
    camera = Camera(W, H, 200.0, 200.0, W / 2, H / 2, np.eye(4))
    light = np.ones((8, 16, 3), np.float32)
    asset = Asset(
        Mesh(v, ball.faces.astype(np.int32), v),
        material,
        poses[0],
        light,
        (("photo.png", camera),),
        instances=instances,
    )
    with pytest.raises(UserError, match="no photo of duplicates"):
        photo_figures_of(asset, path, Draw(4), run=tmp_path / "run")
    (tmp_path / "run" / "config.toml").write_text(f'masks = "segment:{network}"\n')
    assert (
        3 < photo_figures_of(asset, path, Draw(4), run=tmp_path / "run")["photo_psnr"] < 20
    )  # a grey ball where a red and a blue disc are


def test_without_a_segmenter_it_is_named_in_the_way_out(tmp_path):
    with pytest.raises(UserError, match="no labels") as error:
        open_as(two_discs(tmp_path), Job(capture="duplicates"))
    assert "segment:FILE.onnx" in str(error.value)


def test_numbers_of_a_panoptic_segmenter(tmp_path):
    network = Network(write_pointwise(tmp_path / "numbers.onnx", np.array([[0.0, 0, 0]]), [3.0]))
    assert (found_instances(network, np.zeros((H, W, 3), np.float32)) == 3).all()
    nothing = Network(write_pointwise(tmp_path / "nothing.onnx", np.array([[0.0, 0, 0]]), [0.0]))
    with pytest.raises(UserError, match="finds no object"):
        found_instances(nothing, np.zeros((H, W, 3), np.float32))


@pytest.mark.parametrize("coded", [False, True])
def test_predicted_normals_are_turned_to_the_cameras_axes(tmp_path, coded):
    up_and_near = np.array([0.0, 0.6, 0.8])
    bias = up_and_near * 0.5 + 0.5 if coded else up_and_near - np.array([1e-3, 0, 0])
    network = Network(write_pointwise(tmp_path / "normals.onnx", np.zeros((3, 3)), bias))
    labels = np.zeros((H, W), np.int32)
    cv2.circle(labels, (40, 48), 25, 7, -1)
    normal = predicted_normals(network, np.full((H, W, 3), 0.3, np.float32), labels)
    assert (
        np.allclose(normal[labels == 7], [0, -0.6, -0.8], atol=0.01)
        and (normal[labels == 0] == 0).all()
    )


def test_wrong_networks_are_named(tmp_path):
    with pytest.raises(UserError, match="no network at"):
        Network(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"\x08\x08not a network")
    with pytest.raises(UserError, match="cannot be read"):
        Network(tmp_path / "bad.onnx")
    two = Network(write_pointwise(tmp_path / "two.onnx", np.zeros((2, 3)), [0.0, 1.0]))
    with pytest.raises(UserError, match="normals"):
        predicted_normals(two, np.zeros((H, W, 3), np.float32), np.ones((H, W), np.int32))
