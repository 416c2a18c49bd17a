"""Photos of duplicates: layouts, labels, and what is wrong with them."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from relit.capture.corrections import FOLDER, save_mask
from relit.capture.open import open_capture
from relit.errors import UserError
from relit.masks.rle import runs_from

W, H = 160, 96


def labels_of(count=3):
    out = np.zeros((H, W), np.uint8)
    for k in range(count):
        cv2.circle(out, (30 + 48 * k, 48), 18, 60 + 40 * k, -1)
    return out


def photo(folder, name="photo.png"):
    folder.mkdir(parents=True, exist_ok=True)
    picture = np.random.default_rng(0).integers(0, 255, (H, W, 3), np.uint8)
    cv2.imwrite(str(folder / name), picture)
    return folder / name


def sfd(folder, focal="123.5"):
    photo(folder / "train", "000_rgb.png")
    cv2.imwrite(str(folder / "train" / "000_instance_seg.png"), labels_of())
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    frames = [{"file_path": "train/000", "transform_matrix": pose.tolist()}]
    (folder / "transforms_train.json").write_text(json.dumps({"focal": focal, "frames": frames}))
    return folder


def numbers(capture):
    return np.unique(capture.photos[0].load().labels).tolist()


def test_sfd_folder_with_focal_as_text_and_a_photo_that_is_not_square(tmp_path):
    capture = open_capture(sfd(tmp_path / "c"))
    camera = capture.photos[0].camera
    assert capture.kind == "duplicates" and (camera.width, camera.height) == (W, H)
    assert camera.fx == 123.5 and camera.cx == W / 2
    assert np.allclose(camera.centre, [1, 2, 3]) and np.allclose(
        camera.world_from_camera[:3, 2], [0, 0, -1]
    )
    assert numbers(capture) == [0, 60, 100, 140] and capture.objects == 3


def test_normal_priors_in_the_axes_of_sfd_and_in_our_own(tmp_path):
    folder, seen = sfd(tmp_path / "c"), np.array([0.0, 0.6, 0.8])  # up and towards the camera, y up
    code = np.full((H, W, 3), 255, np.uint8)  # white: not known
    code[20:70] = np.round((seen * 0.5 + 0.5) * 255)[::-1]
    cv2.imwrite(str(folder / "train" / "000_normal_pretrain.png"), code)
    capture = open_capture(folder)
    normal = capture.photos[0].load().normal
    assert np.allclose(normal[40, 50], [0, -0.6, -0.8], atol=0.01) and np.allclose(
        normal[90, 50], 0
    )
    assert any("normal priors" in n for n in capture.notes)
    cv2.imwrite(
        str(folder / "train" / "000_normal.png"), code
    )  # named as elsewhere: the photo's own axes
    assert np.allclose(open_capture(folder).photos[0].load().normal[40, 50], seen, atol=0.01)


def test_a_focal_length_from_the_command_line_wins(tmp_path):
    assert open_capture(sfd(tmp_path / "c"), focal=200.0).photos[0].camera.fx == 200.0


def test_a_senseless_focal_length_is_named(tmp_path):
    with pytest.raises(UserError, match="focal"):
        open_capture(sfd(tmp_path / "c", focal="wide"))


def test_a_photo_with_coloured_labels_beside_it(tmp_path):
    path = photo(tmp_path)
    grey = labels_of()
    colours = np.stack([grey, grey // 2, np.where(grey > 0, 200, 0).astype(np.uint8)], -1)
    cv2.imwrite(str(tmp_path / "photo_labels.png"), colours)
    capture = open_capture(path)
    assert len(numbers(capture)) == 4 and any(
        "focal length is not known" in n for n in capture.notes
    )
    assert open_capture(tmp_path).kind == "duplicates"


def test_shrunk_photos_keep_their_label_numbers(tmp_path):
    capture = open_capture(sfd(tmp_path / "c"), max_side=80)
    assert capture.photos[0].width == 80 and numbers(capture) == [0, 60, 100, 140]
    assert capture.photos[0].camera.fx == pytest.approx(123.5 / 2)


def test_labels_of_another_shape_are_refused(tmp_path):
    path = photo(tmp_path)
    cv2.imwrite(str(tmp_path / "photo_labels.png"), labels_of()[:, :80])
    with pytest.raises(UserError, match="another shape"):
        open_capture(path)


def test_labels_of_another_size_are_resampled(tmp_path):
    path = photo(tmp_path)
    big = cv2.resize(labels_of(), (2 * W, 2 * H), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(tmp_path / "photo_labels.png"), big)
    assert numbers(open_capture(path)) == [0, 60, 100, 140]


def test_tiny_objects_are_left_out_and_black_labels_refused(tmp_path):
    path = photo(tmp_path)
    labels = labels_of()
    labels[2:8, 2:8] = 17
    cv2.imwrite(str(tmp_path / "photo_labels.png"), labels)
    capture = open_capture(path)
    assert 17 not in numbers(capture) and any("left out" in n for n in capture.notes)
    cv2.imwrite(str(tmp_path / "photo_labels.png"), np.where(labels == 17, 17, 0).astype(np.uint8))
    with pytest.raises(UserError, match="smaller than 24"):
        open_capture(path)
    cv2.imwrite(str(tmp_path / "photo_labels.png"), np.zeros_like(labels))
    with pytest.raises(UserError, match="no object"):
        open_capture(path)


def test_one_object_and_objects_cut_by_the_border_are_noted(tmp_path):
    path = photo(tmp_path)
    labels = np.zeros((H, W), np.uint8)
    cv2.circle(labels, (5, 48), 30, 90, -1)
    cv2.imwrite(str(tmp_path / "photo_labels.png"), labels)
    notes = " ".join(open_capture(path).notes)
    assert "only one object" in notes and "cut by the photo's border" in notes


def test_cutouts(tmp_path):
    path = photo(tmp_path)
    (tmp_path / "cutouts").mkdir()
    for k, value in enumerate((60, 100)):
        alpha = np.where(labels_of() == value, 255, 0).astype(np.uint8)
        cv2.imwrite(
            str(tmp_path / "cutouts" / f"{k}.png"),
            np.dstack([np.zeros((H, W, 3), np.uint8), alpha]),
        )
    assert numbers(open_capture(path)) == [0, 1, 2]
    cv2.imwrite(str(tmp_path / "cutouts" / "2.png"), np.zeros((20, 20, 4), np.uint8))
    with pytest.raises(UserError, match="does not fit the photo"):
        open_capture(path)


def test_coco_polygons_and_run_lengths(tmp_path):
    path = photo(tmp_path)
    mask = (labels_of() == 100).astype(np.uint8)
    flat = mask.T.ravel()
    change = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], change, [len(flat)]])).tolist()
    annotations = [
        {"image_id": 7, "segmentation": [[12, 30, 48, 30, 48, 66, 12, 66]]},
        {"image_id": 7, "segmentation": {"size": [H, W], "counts": runs}},
        {"image_id": 8, "segmentation": [[100, 30, 148, 30, 148, 66]]},
    ]
    images = [
        {"id": 7, "file_name": "photo.png", "width": W, "height": H},
        {"id": 8, "file_name": "other.png"},
    ]
    (tmp_path / "annotations.json").write_text(
        json.dumps({"images": images, "annotations": annotations})
    )
    labels = open_capture(path).photos[0].load().labels
    assert (
        ((labels == 2) == (mask > 0)).all()
        and labels[48, 30] == 1
        and set(np.unique(labels)) == {0, 1, 2}
    )
    annotations[1]["segmentation"]["counts"] = [5, 5]
    (tmp_path / "annotations.json").write_text(
        json.dumps({"images": images, "annotations": annotations})
    )
    with pytest.raises(UserError, match="do not add up"):
        open_capture(path)


def test_coco_of_several_categories(tmp_path):
    path = photo(tmp_path)
    square = lambda x: [[x, 30, x + 36, 30, x + 36, 66, x, 66]]  # noqa: E731
    kinds = [
        (3, square(12), 0),
        (5, [[0, 0, W, 0, W, H, 0, H]], 0),
        (3, square(60), 1),
    ]  # of single objects some tools write iscrowd 1 too
    annotations = [
        {"image_id": 7, "category_id": k, "segmentation": s, "iscrowd": crowd}
        for k, s, crowd in kinds
    ]
    annotations += [
        {"image_id": 8, "category_id": 5, "segmentation": square(12)}
    ] * 4  # of a photo that is not here
    images = [
        {"id": 7, "file_name": "photo.png", "width": W, "height": H},
        {"id": 8, "file_name": "other.png"},
    ]
    data = {
        "images": images,
        "annotations": annotations,
        "categories": [{"id": 3, "name": "cup"}, {"id": 5, "name": "table"}, {"id": [5]}],
    }
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    capture = open_capture(path)
    labels = capture.photos[0].load().labels
    assert (
        set(np.unique(labels)) == {0, 1, 2}
        and labels[40, 20] == 1
        and labels[40, 70] == 2
        and labels[40, 5] == 0
        and labels[2, 2] == 0
    )
    assert any("category cup, the commonest" in note for note in capture.notes)
    for k, annotation in enumerate(annotations[:3]):
        annotation["category_id"] = k  # one for each object
    data["annotations"] = [annotations[1], annotations[0], annotations[2]]
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    assert set(np.unique(open_capture(path).photos[0].load().labels)) == {1, 2, 3}


def test_compressed_run_lengths():
    def compressed(runs):  # COCO's rleToString
        out = ""
        for i, run in enumerate(runs):
            x = run - runs[i - 2] if i > 2 else run
            more = True
            while more:
                c, x = x & 31, x >> 5
                more = x != -1 if c & 16 else x != 0
                out += chr((c | 32 if more else c) + 48)
        return out

    runs = [3, 40, 2, 55, 1, 700, 5, 9]
    read = runs_from({"size": [5, sum(runs) // 5], "counts": compressed(runs)}, "a mask")
    assert list(read.counts) == runs
    mask = read.decode()
    assert mask.T.ravel()[:3].sum() == 0 and mask.T.ravel()[3:43].all()


def test_several_photos_of_one_pile(tmp_path):
    for k in range(3):
        path = photo(tmp_path, f"p{k}.png")
        cv2.imwrite(str(tmp_path / f"p{k}_labels.png"), labels_of(3 - k % 2))
    photo(tmp_path, "other.png")  # has no labels
    capture = open_capture(tmp_path, focal=150.0)
    assert [p.name for p in capture.photos] == [
        "p0.png",
        "p1.png",
        "p2.png",
    ] and capture.kind == "duplicates"
    assert [len(np.unique(p.load().labels)) - 1 for p in capture.photos] == [3, 2, 3]
    assert any("3 photos of one pile" in n for n in capture.notes) and any(
        n.startswith("p1.png: 2 objects") for n in capture.notes
    )
    assert len(open_capture(path).photos) == 1  # one of them alone


def test_cutouts_of_several_photos(tmp_path):
    for k in range(2):
        photo(tmp_path, f"p{k}.png")
        (tmp_path / "cutouts" / f"p{k}").mkdir(parents=True)
        alpha = np.where(labels_of() == 60 + 40 * k, 255, 0).astype(np.uint8)
        cv2.imwrite(
            str(tmp_path / "cutouts" / f"p{k}" / "0.png"),
            np.dstack([np.zeros((H, W, 3), np.uint8), alpha]),
        )
    first, second = (p.load().labels for p in open_capture(tmp_path).photos)
    assert first[48, 30] == 1 and first[48, 78] == 0 and second[48, 78] == 1


def bop(folder):
    photo(folder / "rgb", "000004.png")
    (folder / "mask_visib").mkdir()
    for k in range(3):
        mask = np.where(labels_of() == 60 + 40 * k, 255, 0).astype(np.uint8)
        cv2.imwrite(str(folder / "mask_visib" / f"000004_{k:06d}.png"), mask)
    pose = {"cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 700.0]}
    (folder / "scene_gt.json").write_text(
        json.dumps({"4": [{"obj_id": o, **pose} for o in (5, 2, 5)]})
    )
    (folder / "scene_camera.json").write_text(
        json.dumps({"4": {"cam_K": [210.0, 0, 79.5, 0, 210.0, 40.0, 0, 0, 1]}})
    )
    return folder


def test_bop_scene(tmp_path):
    capture = open_capture(bop(tmp_path))
    camera, labels = capture.photos[0].camera, capture.photos[0].load().labels
    assert (camera.fx, camera.cx, camera.cy) == (210.0, 80.0, 40.5) and capture.photos[
        0
    ].name == "rgb/000004.png"
    assert (
        labels[48, 30] == 1 and labels[48, 78] == 0 and labels[48, 126] == 3
    )  # the second is another object
    assert any("obj_id 5" in n for n in capture.notes)
    (tmp_path / "mask_visib" / "000004_000002.png").unlink()
    with pytest.raises(UserError, match="no usable mask"):
        open_capture(tmp_path)
    (tmp_path / "scene_gt.json").write_text('{"4": [{"id": 3}]}')
    with pytest.raises(UserError, match="not as BOP"):
        open_capture(tmp_path)


def test_principal_point_and_size_of_a_transforms_file(tmp_path):
    folder = sfd(tmp_path / "c")
    data = json.loads((folder / "transforms_train.json").read_text())
    (folder / "transforms_train.json").write_text(
        json.dumps({**data, "w": 2 * W, "h": 2 * H, "cx": 150.0, "cy": 100.0})
    )
    camera = open_capture(folder).photos[0].camera
    assert (camera.fx, camera.cx, camera.cy) == (123.5 / 2, 75.0, 50.0)


# ---------------------------------------------------------------- corrected by hand


def corrected(folder, mask):
    """The capture with a corrected mask of its photo, and its labels before."""
    before = open_capture(folder)
    save_mask(folder, before.photos[0], mask.astype(np.float32))
    return open_capture(folder), before.photos[0].load().labels


def test_a_corrected_mask_corrects_the_labels(tmp_path):
    folder = sfd(tmp_path / "c")
    mask = labels_of() > 0
    mask[44:52, 24:36] = False  # taken out of the first object
    mask[47:50, 96:100] = True  # put in beside the second, whose border is at 96
    mask[2:6, 150:158] = True  # put in where nothing is near
    after, labels = corrected(folder, mask)
    fixed = after.photos[0].load()
    assert (fixed.labels[44:52, 24:36] == 0).all() and (fixed.labels[47:50, 97:99] == 100).all()
    assert (fixed.labels[2:6, 150:158] == 0).all() and (fixed.labels != labels).sum() == 8 * 12 + (
        labels[47:50, 96:100] == 0
    ).sum()
    assert np.array_equal(fixed.mask > 0, fixed.labels > 0)
    said = " ".join(after.notes)
    assert (
        "corrected by hand; 96 pixels were taken out" in said
        and "32 pixels that were painted in" in said
        and "not known" in said
    )


def test_painting_on_a_smaller_copy_changes_no_border(tmp_path):
    folder = sfd(tmp_path / "c")
    small = cv2.resize(
        (labels_of() > 0).astype(np.float32), (W // 2, H // 2), interpolation=cv2.INTER_AREA
    )
    small[:, 50:] = 0  # the third object, and a part of the second, go
    after, labels = corrected(folder, small)
    fixed = after.photos[0].load().labels
    assert np.array_equal(fixed[:, :98], labels[:, :98]) and not (fixed[:, 102:] > 0).any()
    assert "2 objects" in " ".join(after.notes)


def test_a_corrected_mask_that_leaves_nothing_or_does_not_fit(tmp_path):
    folder = sfd(tmp_path / "c")
    with pytest.raises(UserError, match="leaves no object"):
        corrected(folder, np.zeros((H, W)))
    path = next((folder / FOLDER / "masks").iterdir())
    cv2.imwrite(str(path), np.zeros((200, 40), np.uint8))
    with pytest.raises(UserError, match="different shapes"):
        open_capture(folder)


def test_objects_that_are_left_out_stay_so_under_a_corrected_mask(tmp_path):
    """They hide what lies behind them: no background, whatever the mask says."""
    folder = sfd(tmp_path / "c")
    labels = labels_of()
    labels[2:8, 2:8] = 200
    cv2.imwrite(str(folder / "train" / "000_instance_seg.png"), labels)
    mask = labels > 150
    mask = (labels > 0) & ~mask
    mask[40:44, 24:36] = False
    after, _ = corrected(folder, mask)
    fixed = after.photos[0].load().labels
    assert (fixed[2:8, 2:8] == -1).all() and (fixed[40:44, 24:36] == 0).all()
