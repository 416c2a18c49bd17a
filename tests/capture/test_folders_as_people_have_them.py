"""Folders as people have them: names of another machine, twins, hidden files, layers, masks in other
places, photos that EXIF turns, annotation layouts. Each row of a table is one folder."""

from __future__ import annotations

import json
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from relit.capture.listing import listed, photo_folders
from relit.capture.mask_edges import edge_strength
from relit.capture.names import NameIndex
from relit.capture.open import open_capture
from relit.errors import UserError
from relit.geometry.se3 import look_at
from relit.images import read_image, turn_upright, write_data, write_linear
from relit.scene import Camera
from support import camera_ring

APPLE_DOUBLE = bytes.fromhex("00051607000200004d6163204f532058") + bytes(100)
COUNT = 4
W, H = 96, 64


@pytest.fixture(scope="module")
def cameras():
    return camera_ring.ring(COUNT, W, H)


def photos(folder: Path, cameras, names=None, suffix=".png") -> list[str]:
    """Pictures of the cameras under the given names."""
    written = camera_ring.write_photos(
        folder, cameras, suffix=suffix, background=camera_ring.BACKGROUND
    )
    for old, new in zip(written, names or written, strict=True):
        (folder / old).rename(folder / new)
    return names or written


def nerf(root: Path, cameras, names) -> None:
    camera_ring.write_transforms(root, cameras, names)


def colmap(root: Path, cameras, names) -> None:
    camera_ring.write_colmap_text(root / "sparse" / "0", cameras, names)


# ---------------------------------------------------------------- names


NFC = [f"Käfer é{k}.png" for k in range(COUNT)]
NFD = [unicodedata.normalize("NFD", n) for n in NFC]
PLAIN = [f"{k:03d}.png" for k in range(COUNT)]


@pytest.mark.parametrize(
    "files, said, note",
    [
        (NFD, NFC, "Unicode"),
        (NFC, NFD, "Unicode"),
        ([n.replace("png", "PNG") for n in PLAIN], PLAIN, "letter case"),
        (PLAIN, [n.replace("png", "jpg") for n in PLAIN], "extension"),
        (PLAIN, [f"C:\\Users\\Anna\\fox\\images\\{n}" for n in PLAIN], "end of their path"),
        (PLAIN, [f"/home/anna/fox/images/{n}" for n in PLAIN], "end of their path"),
        (PLAIN, [f"../images/{n}" for n in PLAIN], ""),
        ([f"my {n}" for n in PLAIN], [f"my%20{n}" for n in PLAIN], "upload"),
        (PLAIN, [f"cb0618f6-{n}" for n in PLAIN], "upload"),
    ],
)
@pytest.mark.parametrize("layout", [nerf, colmap])
def test_names_of_another_machine(tmp_path, cameras, layout, files, said, note):
    photos(tmp_path / "images", cameras, files)
    prefix = "images/" if layout is nerf and not any("/" in n or "\\" in n for n in said) else ""
    layout(tmp_path, cameras, [prefix + n for n in said])
    capture = open_capture(tmp_path, masks="none")
    assert capture.has_cameras and len(capture.photos) == COUNT
    for photo, camera in zip(capture.photos, cameras, strict=True):
        camera_ring.same_camera(photo.camera, camera)
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > COUNT
    assert any(note in n for n in capture.notes) or files == said


def test_a_missing_photo_is_not_another_folders_twin(tmp_path, cameras):
    names = photos(tmp_path / "train", cameras)
    photos(tmp_path / "other", cameras)
    (tmp_path / "train" / names[0]).unlink()
    nerf(tmp_path, cameras, [f"train/{n}" for n in names])
    capture = open_capture(tmp_path, masks="none")
    assert [p.name for p in capture.photos] == [f"train/{n}" for n in names[1:]]
    assert any("1 photos named in transforms.json are not there" in n for n in capture.notes)


def test_ambiguous_names_are_not_guessed(tmp_path):
    for place in ("a/x.png", "b/x.png", "c/y.jpg", "c/y.png"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes(b"")
    index = NameIndex(tmp_path)
    assert index.find("x.png") is None and index.find("c/y.tif") is None
    assert index.find("/far/away/b/x.png") == tmp_path / "b/x.png"
    assert index.find("../../etc/passwd") is None and index.find("\0") is None


@pytest.mark.parametrize("wanted", [0, 2])
def test_cameras_of_duplicates_are_found_by_name(tmp_path, wanted):
    """Of several frames the photo's own, named by a path of Windows in another letter case."""
    codes, labels = scene()
    Image.fromarray(codes).save(tmp_path / f"Kfz_{wanted}.png")
    Image.fromarray(labels).save(tmp_path / f"kfz_{wanted}_Labels.PNG")
    frames = [
        {"file_path": f"C:\\x\\kfz_{k}.jpg", "fl_x": 100.0 + k, "w": W, "h": H} for k in range(3)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    capture = open_capture(tmp_path / f"Kfz_{wanted}.png")
    assert capture.photos[0].camera.fx == 100.0 + wanted and capture.objects == 4


# ---------------------------------------------------------------- orientation


TURNS = (1, 3, 6, 8)


def turned(path: Path, orientation: int, stored: np.ndarray) -> None:
    """A JPEG with the given pixels as stored and an orientation in EXIF."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(path, quality=97, subsampling=0, exif=exif.tobytes())


@pytest.mark.parametrize("orientation", TURNS)
@pytest.mark.parametrize("layout", [nerf, colmap])
def test_known_cameras_belong_to_the_pixels_as_stored(tmp_path, cameras, layout, orientation):
    names = photos(tmp_path / "images", cameras, suffix=".jpg")
    for name in names:
        stored = np.array(Image.open(tmp_path / "images" / name))
        turned(tmp_path / "images" / name, orientation, stored)
    layout(tmp_path, cameras, [("images/" if layout is nerf else "") + n for n in names])
    capture = open_capture(tmp_path, masks="none")
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > COUNT
    assert any("EXIF orientation that is not applied" in n for n in capture.notes) == (
        orientation != 1
    )


@pytest.mark.parametrize("orientation", [6, 8])
def test_cameras_of_the_upright_picture_keep_it(tmp_path, cameras, orientation):
    """Of photos on their side the shape tells that the cameras are those of the upright picture."""
    names = photos(tmp_path / "images", cameras, suffix=".jpg")
    for name in names:
        upright = np.array(Image.open(tmp_path / "images" / name))
        stored = turn_upright(upright, {6: 8, 8: 6}[orientation])
        turned(tmp_path / "images" / name, orientation, stored)
    colmap(tmp_path, cameras, names)
    capture = open_capture(tmp_path, masks="none")
    assert sum(camera_ring.check_projection(p) for p in capture.photos) > COUNT


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("size", ["stored", "upright"])
def test_cameras_of_duplicates_are_turned_with_the_photo(tmp_path, orientation, size):
    """A point of the world falls on the same pixel of the photo before and after it is turned."""
    codes, labels = scene()
    stored = turn_upright(codes, {3: 3, 6: 8, 8: 6}[orientation])
    turned(tmp_path / "a.jpg", orientation, stored)
    Image.fromarray(labels).save(tmp_path / "a_labels.png")
    h, w = stored.shape[:2]
    pose = look_at([3.0, 1.0, 2.0], [0.0, 0.0, 0.0])
    camera = Camera(w, h, 90.0, 90.0, w / 2 + 3, h / 2 - 5, pose)
    if size == "upright":  # some tools write cameras of the upright picture
        if orientation == 3:
            pytest.skip("the sizes are the same")
        camera = Camera(W, H, 90.0, 90.0, W / 2 + 3, H / 2 - 5, pose)
    nerf(tmp_path, [camera], ["a.jpg"])
    found = open_capture(tmp_path).photos[0].camera
    x, y = camera.project(np.array([0.3, -0.2, 0.1]))[:2]
    if size == "stored":
        x, y = {3: (w - x, h - y), 6: (h - y, x), 8: (y, w - x)}[orientation]
    assert (found.width, found.height) == (W, H)
    np.testing.assert_allclose(found.project(np.array([0.3, -0.2, 0.1]))[:2], (x, y), atol=1e-6)


@pytest.mark.parametrize("orientation", [2, 3, 4])
@pytest.mark.parametrize("made_of", ["stored", "upright"])
@pytest.mark.parametrize("known", [True, False])
def test_masks_of_a_photo_upside_down(tmp_path, cameras, orientation, made_of, known):
    """Neither tool nor shape tells whether a mask was made from the pixels as stored or from the
    upright picture: the edges of the photos do."""
    names = photos(tmp_path / "images", cameras, suffix=".jpg")
    (tmp_path / "masks").mkdir()
    for name, camera in zip(names, cameras, strict=True):
        stored = np.array(Image.open(tmp_path / "images" / name))
        turned(tmp_path / "images" / name, orientation, stored)
        mask = camera_ring.picture(camera)[1]
        mask = mask if made_of == "stored" else turn_upright(mask, orientation)
        write_data(tmp_path / "masks" / name.replace("jpg", "png"), mask)
    if known:
        colmap(tmp_path, cameras, names)
    capture = open_capture(tmp_path)
    for photo, camera in zip(capture.photos, cameras, strict=True):
        expected = camera_ring.picture(camera)[1]
        expected = expected if known else turn_upright(expected, orientation)
        assert np.abs(photo.load().mask - expected).mean() < 0.01
    assert any("masks were turned" in n for n in capture.notes) == (known != (made_of == "stored"))


# ---------------------------------------------------------------- what is passed over


def ball(folder: Path, suffix=".jpg", count=COUNT, stem="IMG_{:03d}") -> list[Path]:
    """Different pictures: a bright disc on a textured ground."""
    rng = np.random.default_rng(1)
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for k in range(count):
        codes = rng.integers(0, 200, (4, 6, 3)).astype(np.uint8)
        codes = cv2.resize(codes, (W, H), interpolation=cv2.INTER_NEAREST)
        cv2.circle(codes, (W // 2, H // 2), 18, (230, 40 * k, 30), -1)
        out.append(folder / (stem.format(k) + suffix))
        Image.fromarray(codes).save(out[-1])
    return out


def disc(touching=False) -> np.ndarray:
    mask = np.zeros((H, W), np.uint8)
    return cv2.circle(mask, (W // 2, H - 20 if touching else H // 2), 22, 255, -1)


def heic_twins(root, files):
    for f in files:
        f.with_suffix(".HEIC").write_bytes(b"\0\0\0\x18ftypheic")
        f.with_suffix(".AAE").write_text("<plist/>")
        f.with_suffix(".MOV").write_bytes(b"\0\0\0\x14ftypqt  ")


def cut_outs(root, files):
    for f in files:
        rgb = np.array(Image.open(f))
        Image.fromarray(np.dstack([rgb, disc()])).save(f.with_suffix(".png"))


def masks_of_the_same_name(root, files):
    for f in files:
        Image.fromarray(disc()).save(f.with_suffix(".png"))


def other_format(root, files):
    for f in files:
        Image.open(f).save(f.with_suffix(".webp"))


def copies(root, files):
    for f in files:
        shutil.copy(f, f.with_name(f.stem + " (1).jpg"))


def layers(root, files):
    for f in files:
        shutil.copy(f, f.with_name(f.name + ".texture.jpg"))


def layer_masks(root, files):
    for f in files:
        Image.fromarray(disc()).save(f.with_name(f.name + ".mask.png"))


def apple_double(root, files):
    for f in files:
        f.with_name("._" + f.name).write_bytes(APPLE_DOUBLE)
    (root / "__MACOSX").mkdir()
    (root / "__MACOSX" / "._x.jpg").write_bytes(APPLE_DOUBLE)


def further_folder(root, files):
    ball(root / "second_day")


def video(root, files):
    (root / "clip.mp4").write_bytes(b"\0\0\0\x18ftypmp42")


def formats_not_read(root, files):
    (root / "extra.jxl").write_bytes(b"\xff\x0a")


@pytest.mark.parametrize(
    "spoil, masked, note",
    [
        (heic_twins, False, "4 HEIC files"),
        (cut_outs, True, "4 cut-outs"),
        (masks_of_the_same_name, True, "4 black and white pictures"),
        (other_format, False, "4 second files"),
        (copies, False, "4 byte-identical copies"),
        (layers, False, "4 layers"),
        (layer_masks, True, "masks come from"),
        (apple_double, False, "4 hidden files"),
        (further_folder, False, "second_day/ (4)"),
        (video, False, "clip.mp4"),
        (formats_not_read, False, "extra.jxl"),
    ],
    ids=lambda v: getattr(v, "__name__", None),
)
def test_each_photo_counts_once_and_the_rest_is_named(
    tmp_path, spoil: Callable, masked: bool, note: str
):
    files = ball(tmp_path)
    spoil(tmp_path, files)
    capture = open_capture(tmp_path)
    assert [p.name for p in capture.photos] == [f.name for f in files]
    assert any(note in n for n in capture.notes), capture.notes
    mask = capture.photos[0].load().mask
    assert (mask is not None) == masked
    if masked:
        assert abs(mask.mean() - (disc() > 0).mean()) < 0.02


@pytest.mark.parametrize("suffix", [".png", ".exr", ".webp"])
def test_pictures_of_one_name_that_differ_are_both_kept(tmp_path, suffix):
    """Two objects photographed with two cameras that count alike."""
    for k, f in enumerate(ball(tmp_path)):
        other = np.random.default_rng(50 + k).uniform(0.1, 0.9, (H, W, 3)).astype(np.float32)
        if suffix == ".exr":
            write_linear(f.with_suffix(suffix), other)
        else:
            Image.fromarray((255 * other).astype(np.uint8)).save(f.with_suffix(suffix))
    assert len(open_capture(tmp_path, masks="none").photos) == 2 * COUNT


def test_photos_of_an_object_that_is_a_mask_are_photos(tmp_path):
    files = ball(tmp_path, stem="mask_{:03d}")
    assert list(listed(tmp_path).photos) == files


@pytest.mark.parametrize("ending", [".jfif", ".jpe", ".webp", ".avif", ".JPG"])
def test_extensions_of_the_web(tmp_path, ending):
    for f in ball(tmp_path):
        form = {".webp": "WEBP", ".avif": "AVIF"}.get(ending, "JPEG")
        Image.open(f).save(f.with_name(f.stem + "_w" + ending), form)
        f.unlink()
    assert len(open_capture(tmp_path, masks="none").photos) == COUNT


@pytest.mark.parametrize(
    "build, words",
    [
        (lambda r: [ball(r / "low"), ball(r / "high")], ("high/ holds 4", "low/ holds 4")),
        (lambda r: video(r, []), ("clip.mp4", "ffmpeg")),
        (lambda r: [ball(r / "keyframes" / "images"), ball(r, count=1)], ("keyframes/images/",)),
    ],
)
def test_a_refusal_names_what_lies_there(tmp_path, build, words):
    build(tmp_path)
    with pytest.raises(UserError) as refusal:
        open_capture(tmp_path)
    assert all(w in str(refusal.value) for w in words), str(refusal.value)


@pytest.mark.parametrize("name, said", [("clip.MP4", "a video"), ("photos.zip", "an archive")])
def test_a_file_in_the_place_of_a_folder(tmp_path, name, said):
    (tmp_path / name).write_bytes(b"\0" * 20)
    with pytest.raises(UserError, match=said):
        open_capture(tmp_path / name)


def test_rings_in_sub_folders_of_images_are_one_capture(tmp_path):
    ball(tmp_path / "Images" / "low"), ball(tmp_path / "Images" / "high", stem="B{}")
    assert len(open_capture(tmp_path, masks="none").photos) == 2 * COUNT
    assert sum(n for _, n in photo_folders(tmp_path)) == 2 * COUNT


# ---------------------------------------------------------------- masks in other places


@pytest.mark.parametrize(
    "place",
    [
        "Masks/{stem}.png",
        "masks/{stem}.jpg.png",
        "masks/{stem}_mask.JPG",
        "masks/mask_{stem}.png",
        "object_mask/{stem}.png",
        "fg_masks/{stem}.PNG",
        "Silhouettes/{stem}-mask.png",
        "images/{stem}.jpg.mask.png",
        "images/{stem}-mask.png",
        "images/{stem}_Mask.png",
    ],
)
@pytest.mark.parametrize("kind", ["plain", "inverted", "inverted, touching the border"])
def test_masks_in_other_places(tmp_path, place, kind):
    mask = disc("touching" in kind)
    for f in ball(tmp_path / "images"):
        path = tmp_path / place.format(stem=f.stem)
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(255 - mask if "inverted" in kind else mask).save(path)
    capture = open_capture(tmp_path)
    assert len(capture.photos) == COUNT
    assert abs(capture.photos[1].load().mask.mean() - (mask > 0).mean()) < 0.02
    assert any("inverted" in n for n in capture.notes) == ("inverted" in kind)


def test_close_ups_are_not_inverted(tmp_path):
    """The object fills the picture and leaves a corner free: the middle is white."""
    mask = np.full((H, W), 255, np.uint8)
    mask[: H // 3, : W // 2] = 0
    for f in ball(tmp_path / "images"):
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(mask).save(tmp_path / "masks" / f"{f.stem}.png")
    capture = open_capture(tmp_path)
    assert abs(capture.photos[0].load().mask.mean() - (mask > 0).mean()) < 0.02


def test_a_folder_named_like_masks_that_lacks_some_is_said(tmp_path):
    files = ball(tmp_path / "images")
    (tmp_path / "face_masks").mkdir()
    Image.fromarray(disc()).save(tmp_path / "face_masks" / f"{files[0].stem}.png")
    capture = open_capture(tmp_path)
    assert capture.photos[0].load().mask is None
    assert any("face_masks/" in n and "not used" in n for n in capture.notes)


# ---------------------------------------------------------------- black frames


def bars(codes):
    out = np.zeros((H, 2 * W, 3), np.uint8)
    out[:, W // 2 : W // 2 + W] = codes
    return out


def letterbox(codes):
    out = np.zeros((2 * H, W, 3), np.uint8)
    out[H // 2 : H // 2 + H] = codes
    return out


def circle(codes):
    inside = cv2.circle(np.zeros((H, W), np.uint8), (W // 2, H // 2), H // 2, 1, -1)
    return codes * inside[..., None]


def bent_edges(codes):
    k = np.array([[60.0, 0, W / 2], [0, 60.0, H / 2], [0, 0, 1]])
    wide = np.array([[50.0, 0, W / 2], [0, 50.0, H / 2], [0, 0, 1]])
    return cv2.undistort(codes, k, np.array([-0.2, 0.02, 0, 0]), None, wide)


def window(codes):
    """What a wide fisheye shows of a flat picture."""
    codes = cv2.resize(codes, (4 * W, 4 * H), interpolation=cv2.INTER_NEAREST)
    k = np.array([[240.0, 0, 2 * W], [0, 240.0, 2 * H], [0, 0, 1]])
    wide = np.array([[90.0, 0, 2 * W], [0, 90.0, 2 * H], [0, 0, 1]])
    return cv2.undistort(codes, k, np.array([0.08, 0, 0, 0]), None, wide)


@pytest.mark.parametrize("frame", [bars, letterbox, circle, bent_edges, window])
def test_a_black_frame_is_no_backdrop(tmp_path, frame):
    rng = np.random.default_rng(2)
    for k in range(6):
        codes = rng.integers(70, 250, (8, 12, 3)).astype(np.uint8)
        codes = cv2.resize(codes, (W, H), interpolation=cv2.INTER_NEAREST)
        Image.fromarray(frame(codes)).save(tmp_path / f"{k}.jpg", quality=92)
    capture = open_capture(tmp_path)
    assert capture.photos[0].load().mask is None and not capture.black_background
    with pytest.raises(UserError, match="black frame"):
        open_capture(tmp_path, masks="threshold")


def box_that_turns(codes, k):
    box = cv2.boxPoints(((W / 2, H / 2), (70, 30), 30 * k)).astype(np.int32)
    cv2.fillPoly(codes, [box], (200, 120, 60))


def ball_that_looks_the_same(codes, k):
    cv2.circle(codes, (W // 2, H // 2), 25, (200, 120, 60 + 10 * k), -1)


def bottle_that_looks_the_same(codes, k):
    cv2.rectangle(codes, (36, 20), (60, H), (200, 120, 60 + 10 * k), -1)
    cv2.rectangle(codes, (44, 4), (52, 20), (90, 120, 60), -1)


@pytest.mark.parametrize(
    "thing", [box_that_turns, ball_that_looks_the_same, bottle_that_looks_the_same]
)
@pytest.mark.parametrize("dark", [0, 8])
def test_an_object_before_a_dark_backdrop_keeps_its_mask(tmp_path, dark, thing):
    rng = np.random.default_rng(3)
    for k in range(6):
        codes = rng.normal(dark, 0.3 * dark, (H, W, 3)).clip(0, 255).astype(np.uint8)
        thing(codes, k)
        Image.fromarray(codes).save(tmp_path / f"{k}.png")
    capture = open_capture(tmp_path)
    assert capture.black_background and 0.15 < capture.photos[0].load().mask.mean() < 0.5


# ---------------------------------------------------------------- annotations


def scene():
    """(codes (H, W, 3), labels (H, W)) of four discs, not symmetric."""
    labels = np.zeros((H, W), np.uint8)
    for k, (x, y) in enumerate([(22, 18), (70, 20), (30, 46), (76, 48)], 1):
        cv2.circle(labels, (x, y), 13, k, -1)
    codes = np.full((H, W, 3), 40, np.uint8)
    codes[labels > 0] = (220, 200, 90)
    return codes, labels


def polygons_of(labels):
    out = []
    for k in range(1, labels.max() + 1):
        contours, _ = cv2.findContours(
            (labels == k).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        out.append(contours[0].reshape(-1, 2).astype(float))
    return out


def coco_of(labels, name, size, split=False, flat=False):
    """COCO's JSON. split: two overlapping polygons for each object. flat: no list of lists."""
    annotations = []
    for polygon in polygons_of(labels):
        parts = [polygon.ravel().tolist()]
        if split:
            x = polygon[:, 0]
            low, high = np.percentile(x, [35, 65])
            sides = (np.minimum(polygon, [high, 1e9]), np.maximum(polygon, [low, 0]))
            parts = [side.ravel().tolist() for side in sides]
        segmentation = parts[0] if flat else parts
        annotations.append({"image_id": 1, "category_id": 1, "segmentation": segmentation})
    image = {"id": 1, "file_name": name, "width": size[0], "height": size[1]}
    return {"images": [image], "annotations": annotations}


def labelme_of(labels, name, size):
    shapes = [
        {"label": "a", "points": p.tolist(), "group_id": None, "shape_type": "polygon"}
        for p in polygons_of(labels)
    ]
    return {"shapes": shapes, "imagePath": name, "imageWidth": size[0], "imageHeight": size[1]}


def via_of(labels, name):
    shapes = [
        {"shape_attributes": {"all_points_x": p[:, 0].tolist(), "all_points_y": p[:, 1].tolist()}}
        for p in polygons_of(labels)
    ]
    return {f"{name}123": {"filename": name, "regions": shapes}}


def same_labels(root: Path, labels: np.ndarray) -> None:
    capture = open_capture(root)
    assert capture.format == "duplicates" and capture.objects == labels.max(), capture.notes
    found = capture.photos[0].load().labels
    assert found.shape == labels.shape
    both, either = ((found > 0) & (labels > 0)).sum(), ((found > 0) | (labels > 0)).sum()
    assert both / either > 0.9


@pytest.mark.parametrize(
    "photo, file, content",
    [
        ("a.png", "a.json", lambda la: coco_of(la, "a.png", (W, H))),
        ("a.png", "a.json", lambda la: coco_of(la, "a.png", (2 * W, 2 * H))),
        ("a.png", "a.json", lambda la: coco_of(la, "a.png", (W, H), split=True)),
        ("a.png", "a.json", lambda la: coco_of(la, "a.png", (W, H), flat=True)),
        ("images/b/a.png", "annotations/instances_b.json", lambda la: coco_of(la, "a.png", (W, H))),
        ("images/a.png", "result.json", lambda la: coco_of(la, "images\\a.png", (W, H))),
        ("images/a.png", "result.json", lambda la: coco_of(la, "cb0618f6-a.png", (W, H))),
        ("images/a.png", "result.json", lambda la: coco_of(la, "/data/upload/3/a.jpg", (W, H))),
        ("train/a.png", "train/_annotations.coco.json", lambda la: coco_of(la, "a.png", (W, H))),
        ("a.png", "a.json", lambda la: labelme_of(la, "a.png", (W, H))),
        ("images/a.png", "labelme/a.json", lambda la: labelme_of(la, "..\\images\\a.png", (W, H))),
        ("a.png", "via_region_data.json", lambda la: via_of(la, "a.png")),
        ("a.png", "via.json", lambda la: {"_via_img_metadata": via_of(la, "a.png")}),
    ],
)
def test_annotation_layouts(tmp_path, photo, file, content):
    codes, labels = scene()
    for place in (tmp_path / photo, tmp_path / file):
        place.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(codes).save(tmp_path / photo)
    data = content(labels)
    size = data["images"][0] if "images" in data else {"width": W}
    if size["width"] == 2 * W:  # drawn on a picture of twice the size
        for a in data["annotations"]:
            a["segmentation"] = [[2 * v for v in p] for p in a["segmentation"]]
    (tmp_path / file).write_text(json.dumps(data))
    same_labels(tmp_path, labels)


@pytest.mark.parametrize("orientation", [6, 8])
@pytest.mark.parametrize("corners", ["upright", "stored"])
@pytest.mark.parametrize("size", ["upright", "stored"])
def test_annotations_of_a_photo_on_its_side(tmp_path, orientation, corners, size):
    """Tools exchange width and height, draw on the upright picture or on the one as stored."""
    if (corners, size) == ("stored", "upright"):
        pytest.skip("no tool writes it")
    codes, labels = scene()
    back = {6: 8, 8: 6}[orientation]
    turned(tmp_path / "a.jpg", orientation, turn_upright(codes, back))
    drawn = labels if corners == "upright" else turn_upright(labels, back)
    given = (W, H) if size == "upright" else (H, W)
    (tmp_path / "a.json").write_text(json.dumps(coco_of(drawn, "a.jpg", given)))
    same_labels(tmp_path, labels)
    rgb = read_image(tmp_path / "a.jpg").rgb
    assert edge_strength(rgb, labels) > edge_strength(rgb, labels[::-1])


def test_labels_of_the_pixels_as_stored_are_turned(tmp_path):
    codes, labels = scene()
    turned(tmp_path / "a.jpg", 6, turn_upright(codes, 8))
    Image.fromarray(turn_upright(labels, 8)).save(tmp_path / "a_labels.png")
    same_labels(tmp_path, labels)


def boxes(data):
    for a in data["annotations"]:
        a["segmentation"] = []


def stretched(data):
    data["images"][0] |= {"width": W, "height": W}


def words(data):
    data["annotations"][0]["segmentation"] = [["a", "b"]]


@pytest.mark.parametrize(
    "spoil, said", [(boxes, "no outline"), (stretched, "another shape"), (words, "no usable")]
)
def test_annotations_that_tell_no_outline_are_refused(tmp_path, spoil, said):
    codes, labels = scene()
    Image.fromarray(codes).save(tmp_path / "a.png")
    data = coco_of(labels, "a.png", (W, H))
    spoil(data)
    (tmp_path / "a.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match=said):
        open_capture(tmp_path)


def test_outlines_of_one_object_in_many_photos_are_masks(tmp_path):
    files = ball(tmp_path / "images")
    data = {"images": [], "annotations": []}
    for k, f in enumerate(files):
        one = coco_of((disc() > 0).astype(np.uint8), f.name, (W, H))
        data["images"].append(one["images"][0] | {"id": k})
        data["annotations"].append(one["annotations"][0] | {"image_id": k})
    (tmp_path / "annotations.json").write_text(json.dumps(data))
    capture = open_capture(tmp_path)
    assert capture.format == "photos" and len(capture.photos) == COUNT
    assert abs(capture.photos[2].load().mask.mean() - (disc() > 0).mean()) < 0.02
