"""Senseless values at random places of the JSON files that captures bring along: read, or refused
with an answer; never a stack trace."""

import copy
import json
import random

import numpy as np
import pytest
from PIL import Image

from relit.capture.open import open_capture
from relit.capture.readers.samurai import read_hints
from relit.conventions import world_from_gl_camera
from relit.errors import UserError
from relit.geometry.se3 import look_at

SIDE = 64
JUNK = [
    None,
    True,
    -1,
    0,
    1e308,
    -1e-308,
    float("nan"),
    float("inf"),
    10**30,
    10**400,
    "",
    "x",
    "../../etc/passwd",
    "\x00",
]
JUNK += [[], {}, [[]], [1, 2], {"a": 1}, [None] * 3]


def photos(folder, count=4):
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        Image.fromarray(rng.integers(0, 255, (SIDE, SIDE, 3), np.uint8)).save(folder / f"{i}.png")


def mvmc(root):
    photos(root / "images")
    turn = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    mask = {"size": [SIDE, SIDE], "counts": [1000, 2000, SIDE * SIDE - 3000]}
    entry = {
        "mask": mask,
        "camera_initial": {"R": turn, "T": [0, 0, 2], "fov": 60.0},
        "bbox": [1, 2, 9, 9],
    }
    return "annotations.json", {
        "id": "7",
        "car_model": "a",
        "annotations": [{"filename": f"{i}.png", **entry} for i in range(4)],
    }


def ners(root):
    photos(root / "images")
    return "metadata.json", {"azimuths": [0, 90, 180, 270], "elevations": [0, 10, 20, 30]}


def samurai(root):
    photos(root / "image")
    answers = (
        ["Left", "Center", "Front"],
        ["Right", "Above", "Front"],
        ["Center", "Center", "Back"],
        ["Left", "Below", "Back"],
    )
    return "quadrants.json", {
        "frames": [{"image_name": f"{i}.png", "quadrant": a} for i, a in enumerate(answers)]
    }


def coco(root):
    photos(root, 1)
    shapes = [
        [[2, 2, 30, 2, 30, 30, 2, 30]],
        {"size": [SIDE, SIDE], "counts": [2300, 1500, SIDE * SIDE - 3800]},
    ]
    return "annotations.json", {
        "images": [{"id": 7, "file_name": "0.png", "width": SIDE, "height": SIDE}],
        "annotations": [{"image_id": 7, "segmentation": s} for s in shapes],
    }


def labelme(root):
    photos(root, 1)
    shapes = [
        {"label": "a", "group_id": k, "shape_type": "polygon", "points": p}
        for k, p in enumerate([[[2, 2], [30, 2], [30, 30]], [[40, 2], [60, 2], [60, 30]]])
    ]
    size = {"imageWidth": SIDE, "imageHeight": SIDE}
    return "annotations.json", {"shapes": shapes, "imagePath": "0.png", **size}


def via(root):
    photos(root, 1)
    regions = [
        {"shape_attributes": {"all_points_x": x, "all_points_y": [2, 2, 40]}}
        for x in ([2, 30, 30], [40, 60, 60])
    ]
    return "annotations.json", {"0.png9": {"filename": "0.png", "regions": regions}}


def nerfstudio(root):
    photos(root / "images")
    poses = [
        world_from_gl_camera(look_at([3 * np.sin(i), 0.5, 3 * np.cos(i)], np.zeros(3))).tolist()
        for i in range(4)
    ]
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": p} for i, p in enumerate(poses)]
    lens = {"fl_x": 80.0, "fl_y": 80.0, "cx": 32.0, "cy": 32.0, "k1": 0.01, "p1": 0.0}
    return "transforms.json", {"camera_model": "OPENCV", **lens, "frames": frames}


def places(node, path=()):
    """Every place of a JSON value, as a tuple of keys."""
    yield path
    for key, value in (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    ):
        yield from places(value, (*path, key))


def spoilt(value, rng):
    value = copy.deepcopy(value)
    for _ in range(rng.randint(1, 3)):
        *way, last = rng.choice([p for p in places(value) if p])
        node = value
        for key in way:
            node = node[key]
        if rng.random() < 0.2:
            del node[last]
        else:
            node[last] = copy.deepcopy(rng.choice(JUNK))
        if not any(places(value)):
            break
    return value


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("layout", [mvmc, ners, samurai, coco, labelme, via, nerfstudio])
def test_senseless_values(tmp_path, layout):
    name, good = layout(tmp_path)
    path = tmp_path / name
    source = tmp_path / "0.png" if layout in (coco, labelme, via) else tmp_path
    path.write_text(json.dumps(good))
    capture = open_capture(source, min_photos=1)
    rng, outcomes = random.Random(5), {"read": 0, "refused": 0}
    for _ in range(150):
        path.write_text(json.dumps(spoilt(good, rng)))
        try:
            found = open_capture(source, min_photos=1)
            found.photos[0].load()
            if capture.kind == "collection":
                read_hints(found.root, [p.name for p in found.photos])
            outcomes["read"] += 1
        except UserError as error:
            assert error.what
            outcomes["refused"] += 1
    assert outcomes["refused"] > 30, outcomes
