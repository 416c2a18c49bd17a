"""Masks and the object sphere that people correct: kept beside the capture, used when it is opened,
painted in the page."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from relit.capture.corrections import FOLDER, save_mask, save_sphere, sphere_from_boxes
from relit.capture.open import open_capture
from relit.errors import UserError
from relit.job import Job, input_digests, open_input
from relit.scene import Sphere
from relit.viewer.correct import correction_server
from support.browser import READY, serve
from support.http_client import ask
from support.striped_ball import black_masks, photos_only, picture, write_capture


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "photos")


def disc(x, y, r, side=48):
    v, u = np.mgrid[:side, :side] + 0.5
    return ((u - x) ** 2 + (v - y) ** 2 < r * r).astype(np.float32)


@pytest.mark.slow
def test_a_corrected_mask_wins(capture):
    before = open_capture(capture)
    digest = input_digests(before)
    save_mask(capture, before.photos[2], disc(20, 24, 9))
    after = open_capture(capture)
    assert np.array_equal(after.photos[2].load().mask, disc(20, 24, 9))
    assert np.array_equal(after.photos[1].load().mask, before.photos[1].load().mask)
    assert any("1 masks were corrected by hand" in n for n in after.notes)
    assert input_digests(after) != digest  # a run that was begun before notices
    assert open_capture(capture, masks="none").photos[2].load().mask is None
    save_mask(
        capture, before.photos[2], cv2.resize(disc(20, 24, 9), (96, 96))
    )  # painted larger than the photo
    assert np.abs(open_capture(capture).photos[2].load().mask - disc(20, 24, 9)).mean() < 0.03


def test_photos_without_masks_need_all_of_them(tmp_path):
    folder = write_capture(tmp_path / "photos", mode="RGB")
    for path in (folder / "images").iterdir():  # no plain backdrop either
        picture = cv2.imread(str(path))
        noise = np.random.default_rng(0).integers(0, 255, picture.shape, dtype=np.uint8)
        cv2.imwrite(str(path), np.where(picture.sum(-1, keepdims=True) > 0, picture, noise))
    photos = open_capture(folder).photos
    assert photos[0].load().mask is None
    for photo in photos[:-1]:
        save_mask(folder, photo, disc(24, 24, 12))
    half = open_capture(folder)
    assert half.photos[0].load().mask is None and any(
        "not used until all have one" in n for n in half.notes
    )
    save_mask(folder, photos[-1], disc(24, 24, 12))
    assert open_capture(folder).photos[0].load().mask.sum() == disc(24, 24, 12).sum()


def test_a_corrected_photo_is_not_left_out(capture):
    first = open_capture(capture).photos[0]
    picture = cv2.imread(str(capture / "images/p0.png"), cv2.IMREAD_UNCHANGED)
    picture[..., 3] = 0
    cv2.imwrite(str(capture / "images/p0.png"), picture)
    assert len(open_capture(capture).photos) == 5
    save_mask(capture, first, disc(24, 24, 12))
    assert len(open_capture(capture).photos) == 6


def test_grabcut_leaves_a_corrected_mask_alone(capture):
    """Also of a photo that was undistorted since, as it is when its camera was found from the
    photos."""
    from relit.capture.open import with_grabcut
    from relit.capture.photo import with_camera

    save_mask(capture, open_capture(capture).photos[0], disc(20, 24, 6))
    opened = open_capture(capture)
    bent = [with_camera(p, replace(p.camera, distortion=(0.01, 0, 0, 0))) for p in opened.photos]
    masks = [p.load().mask for p in with_grabcut(replace(opened, photos=tuple(bent))).photos]
    h, w = masks[0].shape
    assert (
        np.abs(masks[0] - disc(20, 24, 6)[:h, :w]).mean() < 0.03
        and masks[1].sum() > 2 * masks[0].sum()
    )


def test_shapes_and_files_that_do_not_fit(capture):
    photo = open_capture(capture).photos[0]
    with pytest.raises(UserError, match="does not fit"):
        save_mask(capture, photo, np.ones((10, 40), np.float32))
    path = save_mask(capture, photo, disc(24, 24, 12))
    assert path.parent.parent == capture / FOLDER and "/" not in path.name
    cv2.imwrite(str(path), np.zeros((20, 80), np.uint8))
    with pytest.raises(UserError, match="different shapes"):
        open_capture(capture).photos[0].load()
    senseless = [
        '{"centre": [0, 0], "radius": 1}',
        '{"centre": [0, 0, 0], "radius": -1}',
        '{"centre": [0, 0, NaN], "radius": 1}',
    ]
    for text in ("{", "[]", *senseless):
        (capture / FOLDER / "sphere.json").write_text(text)
        with pytest.raises(UserError, match="corrected object sphere"):
            open_capture(capture)


def test_the_corrected_sphere(capture):
    save_sphere(capture, Sphere(np.array([0.0, 0.1, 0.0]), 0.9))
    found = open_capture(capture)
    assert found.sphere.radius == 0.9 and any("the corrected one" in n for n in found.notes)
    assert (
        open_input(capture, Job(sphere=(0, 0, 0, 0.8))).sphere.radius == 0.8
    )  # the command line wins


def test_a_sphere_from_boxes(capture):
    cameras = [p.camera for p in open_capture(capture).photos]
    centre, radius = np.array([0.1, -0.05, 0.2]), 0.5

    def box(c):
        x, y, z = c.project(centre)
        r = c.fx * radius / z / np.sqrt(2)
        return c, (x - r, y - r, x + r, y + r)

    found = sphere_from_boxes([box(c) for c in cameras[:3]])
    assert np.allclose(found.centre, centre, atol=1e-6) and found.radius == pytest.approx(
        radius, rel=1e-6
    )
    with pytest.raises(UserError, match="one box"):
        sphere_from_boxes([box(cameras[0])])
    with pytest.raises(UserError, match="one side"):
        sphere_from_boxes([box(cameras[0])] * 2)


def test_the_server_of_corrections(built, capture):
    server = serve(lambda: correction_server(open_capture(capture)))
    own = {"Origin": server.url.rstrip("/")}
    try:
        state = json.loads(ask(server, "/manifest.json")[1])
        assert state["mode"] == "edit" and len(state["photos"]) == 6
        assert state["photos"][0] == {"name": "images/p0.png", "corrected": False, "w": 48, "h": 48}
        assert (
            ask(server, "/photo.jpg?i=0")[1][:2] == b"\xff\xd8"
            and ask(server, "/mask.png?i=0")[1][1:4] == b"PNG"
        )
        for query in ("", "?i=6", "?i=-1", "?i=x", "?i=../../etc/passwd"):
            assert ask(server, "/photo.jpg" + query)[0] == 404
        good = cv2.imencode(".png", (disc(20, 20, 8) * 255).astype(np.uint8))[1].tobytes()
        assert ask(server, "/mask?i=0", "POST", good)[0] == 403  # no page of ours
        assert ask(server, "/mask?i=0", "POST", good, Origin="http://evil.example")[0] == 403
        small = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
        for bad in (b"hello", good[:40], small, b"\x89PNG\r\n\x1a\n" + b"\xff" * 100):
            code, said, _ = ask(server, "/mask?i=0", "POST", bad, **own)
            assert code == 422 and "mask" in json.loads(said)["error"]
        assert ask(server, "/mask?i=99", "POST", good, **own)[0] == 500
        assert not (capture / FOLDER).exists()
        assert ask(server, "/mask?i=0", "POST", good, **own)[0] == 200
        assert np.array_equal(open_capture(capture).photos[0].load().mask, disc(20, 20, 8))
        assert ask(server, "/mask?i=0", "POST", b"", **own)[0] == 200 and not list(
            (capture / FOLDER / "masks").iterdir()
        )
        code, said, _ = ask(
            server, "/boxes", "POST", json.dumps([{"i": 0, "box": [9, 9, 40, 40]}]).encode(), **own
        )
        assert code == 422 and "one box" in json.loads(said)["error"]
        assert ask(server, "/boxes", "POST", b"not json", **own)[0] == 500
        assert ask(server, "/files/../test.txt")[0] == 404
    finally:
        server.shutdown()
        server.server_close()


def test_boxes_without_cameras(built, capture):
    photos_only(capture)
    server = serve(lambda: correction_server(open_capture(capture)))
    try:
        assert json.loads(ask(server, "/manifest.json")[1])["boxes"] is False
        body = json.dumps([{"i": 0, "box": [9, 9, 40, 40]}]).encode()
        code, said, _ = ask(server, "/boxes", "POST", body, Origin=server.url.rstrip("/"))
        assert code == 422 and "boxes need cameras" in json.loads(said)["error"]
    finally:
        server.shutdown()
        server.server_close()


def test_a_box_gives_a_mask_without_cameras(built, capture):
    """GrabCut needs the box alone."""
    photos_only(capture)
    for i in range(6):
        rgb = np.array(cv2.imread(str(capture / f"images/p{i}.png")), np.uint8)
        around = np.random.default_rng(i).integers(
            90, 110, rgb.shape, dtype=np.uint8
        )  # grey, and no backdrop that a threshold finds
        around[:24] += 60
        cv2.imwrite(
            str(capture / f"images/p{i}.png"),
            np.where(picture(i)[..., 3:] > 127, picture(i)[..., 2::-1], around),
        )
    opened = open_capture(capture)
    assert not opened.has_cameras
    server = serve(lambda: correction_server(opened))
    own = {"Origin": server.url.rstrip("/")}
    try:
        state = json.loads(ask(server, "/manifest.json")[1])
        assert state["cut"] is True and state["boxes"] is False
        for bad in ([10, 10, 11, 11], [0, 0, 48, 48]):
            code, said, _ = ask(
                server, "/cut", "POST", json.dumps({"i": 0, "box": bad}).encode(), **own
            )
            assert code == 422 and "the box is too small" in json.loads(said)["error"]
        for i in range(6):
            y, x = np.nonzero(picture(i)[..., 3] > 127)
            box = [int(x.min()) - 2, int(y.min()) - 2, int(x.max()) + 3, int(y.max()) + 3]
            assert (
                ask(server, "/cut", "POST", json.dumps({"i": i, "box": box}).encode(), **own)[0]
                == 200
            )
    finally:
        server.shutdown()
        server.server_close()
    for i, photo in enumerate(open_capture(capture).photos):
        found, true = photo.load().mask > 0.5, picture(i)[..., 3] > 127
        assert (found & true).sum() / (found | true).sum() > 0.85


def test_a_pile_has_no_box(built, tmp_path):
    labels = np.zeros((96, 160), np.uint8)
    for k in range(3):
        cv2.circle(labels, (30 + 48 * k, 48), 18, 60 + 40 * k, -1)
    cv2.imwrite(
        str(tmp_path / "pile.png"),
        np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8),
    )
    cv2.imwrite(str(tmp_path / "pile_labels.png"), labels)
    server = serve(lambda: correction_server(open_capture(tmp_path)))
    try:
        assert json.loads(ask(server, "/manifest.json")[1])["cut"] is False
        body, own = (
            json.dumps({"i": 0, "box": [9, 9, 40, 40]}).encode(),
            {"Origin": server.url.rstrip("/")},
        )
        code, said, _ = ask(server, "/cut", "POST", body, **own)
        assert code == 422 and "no single box" in json.loads(said)["error"]
    finally:
        server.shutdown()
        server.server_close()


def test_painting_in_the_page(drive, capture, tmp_path):
    before = open_capture(capture)
    server = serve(lambda: correction_server(before))
    inside = "(() => { const d = document.querySelector('#canvas').getContext('2d').getImageData(2, 2, 1, 1).data; return [...d]; })()"
    try:
        results = drive(
            server.url,
            [
                READY,
                {"eval": inside},
                {"range": ["#brush", 6]},
                {"drag": [0.04, 0.04, 0.04, 0.5]},
                {"eval": inside},
                {"click": "#save"},
                {"wait": "document.getElementById('message').textContent === 'saved'"},
                {"shot": str(tmp_path / "edit.png")},
                {"click": '[data-photo="1"]'},
                {"wait": "relit.edit.i === 1"},
                {"select": ["#tool", "erase"]},
                {"range": ["#brush", 120]},
                {"drag": [0.5, 0.5, 0.6, 0.6]},
                {"click": "#undo"},
                {"select": ["#tool", "box"]},
                {"drag": [0.2, 0.2, 0.8, 0.8]},
                {"click": "#save"},
                {"wait": "!relit.edit.dirty"},
                {"click": '[data-photo="3"]'},
                {"wait": "relit.edit.i === 3"},
                {"drag": [0.2, 0.2, 0.8, 0.8]},
                {"click": "#save-boxes"},
                {
                    "wait": "document.getElementById('message').textContent.includes('sphere was saved')"
                },
                {"eval": "relit.edit.boxes.size"},
                {"click": '[data-photo="4"]'},
                {"wait": "relit.edit.i === 4"},
                {"drag": [0.1, 0.1, 0.9, 0.9]},
                {"click": "#cut"},
                {
                    "wait": "document.getElementById('message').textContent === 'the mask in the box was saved'"
                },
            ],
        )
    finally:
        server.shutdown()
        server.server_close()
    assert (
        results[0][2] > results[0][0] + 60 and results[1][2] < results[0][2] - 60
    )  # blue, then painted
    assert results[2] == 2
    after = open_capture(capture)
    painted = after.photos[0].load().mask - before.photos[0].load().mask
    assert painted[:26, :6].mean() > 0.8 and np.abs(painted[:, 14:]).max() < 0.02
    assert np.abs(after.photos[1].load().mask - before.photos[1].load().mask).max() < 0.02  # undone
    assert np.linalg.norm(after.sphere.centre) < 0.2
    cut, true = after.photos[4].load().mask > 0.5, before.photos[4].load().mask > 0.5
    assert (cut & true).sum() / (cut | true).sum() > 0.85


def test_a_capture_of_black_masks_can_be_mended(capture):
    black_masks(capture)
    with pytest.raises(UserError):
        open_capture(capture)
    photos = open_capture(capture, masks="none").photos
    assert len(photos) == 6
