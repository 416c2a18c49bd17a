"""Damaged and hostile files: every reader answers with a UserError or reads the file; nothing is
unpickled, allocated without bound, or read from outside its folder."""

from __future__ import annotations

import base64
import io
import json
import pickle
import struct
import subprocess
import sys
import zipfile
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from relit.asset.asset import read_cameras, save_asset
from relit.asset.gltf import read_asset_file, write_glb
from relit.capture.open import open_capture
from relit.conventions import world_from_gl_camera
from relit.errors import UserError
from relit.files import load_arrays
from relit.geometry.se3 import look_at
from relit.images import read_header, read_image, read_small, write_linear
from relit.images.opencv import decode_bytes, decode_file
from relit.lighting.spherical_gaussians import read_lobes as read_lobes
from relit.masks.files import read_mask
from relit.scene import Asset, Camera, Flash, Ground, Instance
from relit.synthesize.procedural import pawn
from support import ROOT

FUZZ = settings(
    max_examples=100, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)

# how a file is spoilt: cut to a share, bytes overwritten at shares of its length, a piece repeated
cuts = st.one_of(st.none(), st.floats(0, 1))
pokes = st.lists(st.tuples(st.floats(0, 0.999), st.binary(min_size=1, max_size=8)), max_size=6)


def spoilt(data: bytes, cut, changes, head: int = 0) -> bytes:
    """head: the first bytes that stay as they are, so that the reader gets beyond its first
    look."""
    out = bytearray(data if cut is None else data[: int(cut * len(data))])
    for where, content in changes:
        at = head + int(where * max(len(out) - head, 0))
        out[at : at + len(content)] = content
    return bytes(out)


def answers(read, path):
    """The reader returns or raises UserError, and the message names the file."""
    try:
        read(path)
    except UserError as error:
        assert error.what
    except MemoryError:
        pytest.fail("memory without bound")


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> dict[str, bytes]:
    """One small valid file of each kind."""
    folder = tmp_path_factory.mktemp("valid")
    rng = np.random.default_rng(0)
    rgb = rng.random((12, 16, 3)).astype(np.float32)
    codes = (rgb * 255).astype(np.uint8)
    write_linear(folder / "a.exr", rgb)
    write_linear(folder / "a.hdr", rgb)
    Image.fromarray(codes).save(folder / "a.png")
    Image.fromarray(np.dstack([codes, codes[..., :1]])).save(folder / "b.png")
    Image.fromarray((rgb[..., 0] * 65535).astype(np.uint16)).save(folder / "c.png")
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 35
    Image.fromarray(codes).save(folder / "a.jpg", exif=exif)
    Image.fromarray(codes).save(folder / "a.tif")
    Image.fromarray(codes).save(folder / "a.webp")
    mesh, material = pawn(6, 8, 8)
    write_glb(folder / "a.glb", mesh, material)
    np.savez(folder / "a.npz", world_mat_0=np.eye(4), scale_mat_0=np.eye(4))
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def test_a_tiff_of_absurd_width_is_told(tmp_path):
    """OpenCV raises for it, where it returns nothing for most damaged files."""
    Image.new("RGB", (16, 1)).save(tmp_path / "a.tif")
    data = bytearray((tmp_path / "a.tif").read_bytes())
    first = struct.unpack_from("<I", data, 4)[0]
    for k in range(struct.unpack_from("<H", data, first)[0]):
        at = first + 2 + 12 * k
        if struct.unpack_from("<H", data, at)[0] == 256:  # ImageWidth
            struct.pack_into("<HII", data, at + 2, 4, 1, 2**21)
    (tmp_path / "a.tif").write_bytes(data)
    assert (
        decode_bytes(bytes(data), cv2.IMREAD_UNCHANGED) is None
        and decode_file(tmp_path / "a.tif", cv2.IMREAD_UNCHANGED) is None
    )
    with pytest.raises(UserError, match=r"a\.tif"):
        read_image(tmp_path / "a.tif")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["a.exr", "a.hdr", "a.png", "b.png", "c.png", "a.jpg", "a.tif", "a.webp"]
)
@pytest.mark.filterwarnings("ignore")
def test_spoilt_pictures(valid, tmp_path, name):
    path = tmp_path / name

    @FUZZ
    @given(cuts, pokes, st.sampled_from([0, 8, 64]))
    def run(cut, changes, head):
        path.write_bytes(spoilt(valid[name], cut, changes, head))
        for read in (read_image, read_header, read_small, read_mask):
            answers(read, path)

    run()


@pytest.mark.filterwarnings("ignore")
def test_spoilt_models(valid, tmp_path):
    path = tmp_path / "a.glb"

    @FUZZ
    @given(cuts, pokes, st.sampled_from([0, 20, 200]))
    def run(cut, changes, head):
        path.write_bytes(spoilt(valid["a.glb"], cut, changes, head))
        answers(read_asset_file, path)

    run()


SENSELESS = [None, True, -1, 0, 1e308, 10**30, "x", "../../etc/passwd", [], {}, [[]], {"a": 1}]


def replaced(value, path, new):
    """`value` with the entry at `path` (indices into sorted keys and lists) replaced."""
    if not path or not isinstance(value, (dict, list)) or not value:
        return new
    if isinstance(value, dict):
        key = sorted(value)[path[0] % len(value)]
        return {**value, key: replaced(value[key], path[1:], new)}
    i = path[0] % len(value)
    return [*value[:i], replaced(value[i], path[1:], new), *value[i + 1 :]]


places = st.lists(st.integers(0, 9), min_size=1, max_size=5)


def test_senseless_values_in_a_model(valid, tmp_path):
    data = valid["a.glb"]
    size = struct.unpack("<I", data[12:16])[0]
    document, rest = json.loads(data[20 : 20 + size]), data[20 + size :]
    path = tmp_path / "a.glb"

    @FUZZ
    @given(places, st.sampled_from(SENSELESS))
    def run(where, new):
        text = json.dumps(replaced(document, where, new)).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest)) + struct.pack(
            "<I4s", len(text), b"JSON"
        )
        path.write_bytes(head + text + rest)
        answers(read_asset_file, path)

    run()


def frames(folder, n=4):
    (folder / "images").mkdir(parents=True, exist_ok=True)
    out = []
    for i in range(n):
        Image.fromarray(np.full((8, 8, 3), 40 * i, np.uint8)).save(folder / f"images/{i}.png")
        pose = world_from_gl_camera(look_at([3 * np.sin(i), 1, 3 * np.cos(i)], np.zeros(3)))
        out.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
    return {
        "w": 8,
        "h": 8,
        "fl_x": 10.0,
        "fl_y": 10.0,
        "cx": 4.0,
        "cy": 4.0,
        "k1": 0.0,
        "frames": out,
    }


@pytest.mark.filterwarnings("ignore")
def test_senseless_values_in_a_camera_file(tmp_path):
    good = frames(tmp_path)
    path = tmp_path / "transforms.json"

    @FUZZ
    @given(places, st.sampled_from(SENSELESS))
    def run(where, new):
        path.write_text(json.dumps(replaced(good, where, new)))
        answers(open_capture, tmp_path)
        answers(read_cameras, path)

    run()


def test_senseless_values_in_gaussians(tmp_path):
    path = tmp_path / "light.json"
    good = {"lobes": [{"axis": [0, 1, 0], "sharpness": 3.0, "amplitude": [1, 1, 1]}]}

    @FUZZ
    @given(places, st.sampled_from(SENSELESS))
    def run(where, new):
        path.write_text(json.dumps(replaced(good, where, new)))
        answers(read_lobes, path)

    run()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"frames": 3}',
        '{"a": 1e999}',
        "[" * 5000,
        '{"frames": [1, "x"]}',
        "\ud800".encode("utf-8", "replace").decode(),
    ],
)
def test_camera_files_that_are_none(tmp_path, text):
    frames(tmp_path)
    for name in ("transforms.json", "cameras.json"):
        (tmp_path / name).write_text(text)
    answers(open_capture, tmp_path)
    with pytest.raises(UserError):
        read_cameras(tmp_path / "cameras.json")


# ---------------------------------------------------------------- pickles and bombs


class Bomb:
    def __reduce__(self):
        return (open, ("was-here.txt", "w"))


def test_no_pickle_is_ever_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "cameras_sphere.npz", world_mat_0=np.array([Bomb()], dtype=object))
    (tmp_path / "image").mkdir()
    for i in range(4):
        Image.new("RGB", (8, 8)).save(tmp_path / f"image/{i:03d}.png")
    with pytest.raises(UserError):
        open_capture(tmp_path)
    (tmp_path / "evil.npz").write_bytes(pickle.dumps(Bomb()))
    (tmp_path / "cameras_sphere.npz").write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(UserError):
        open_capture(tmp_path)
    with pytest.raises(Exception, match=r".") as error:
        load_arrays(tmp_path / "evil.npz")
    assert isinstance(error.value, (ValueError, OSError, zipfile.BadZipFile))
    np.save(tmp_path / "poses_bounds.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    (tmp_path / "cameras_sphere.npz").unlink()
    with pytest.raises(UserError):
        open_capture(tmp_path)
    assert not (tmp_path / "was-here.txt").exists()


def png_of(width, height, rows):
    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


BOMBS = """
import sys
from relit.errors import UserError
from relit.images import read_image, read_header, read_small
from relit.asset.gltf import read_asset_file
for path in sys.argv[1:]:
    readers = (read_asset_file,) if path.endswith((".glb", ".gltf", ".obj")) else (read_header, read_small, read_image)
    for read in readers:
        try:
            read(path)
        except UserError:
            pass
print(next(int(line.split()[1]) // 1024 for line in open('/proc/self/status') if line.startswith('VmHWM')))
"""


def test_small_files_that_claim_to_be_huge(tmp_path):
    """None of them makes the process large: sizes are checked before anything is allocated."""
    (tmp_path / "wide.png").write_bytes(png_of(100_000, 100_000, b"\0" * 100))
    (tmp_path / "empty.png").write_bytes(png_of(0, 5, b""))
    write_linear(tmp_path / "a.exr", np.zeros((4, 4, 3), np.float32))
    data = (tmp_path / "a.exr").read_bytes()
    for i, window in enumerate(
        [
            (0, 0, 10**6, 10**6),
            (0, 0, 2**31 - 1, 2**31 - 1),
            (5, 5, 0, 0),
            (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1),
        ]
    ):
        (tmp_path / f"{i}.exr").write_bytes(
            data.replace(struct.pack("<4i", 0, 0, 3, 3), struct.pack("<4i", *window))
        )
    (tmp_path / "a.hdr").write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n" + b"\2\2\x7f\xff" * 8
    )
    bomb = base64.b64encode(png_of(60_000, 60_000, b"\0" * 100)).decode()
    textured = {
        "asset": {"version": "2.0"},
        "images": [{"uri": "data:image/png;base64," + bomb}],
        "textures": [{"source": 0}],
    }
    textured |= {
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
    }
    triangle = base64.b64encode(np.eye(3, dtype="<f4").tobytes()).decode()
    textured |= {
        "buffers": [{"byteLength": 36, "uri": "data:application/octet-stream;base64," + triangle}]
    }
    textured |= {
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    }
    (tmp_path / "texture.gltf").write_text(
        json.dumps(
            {
                **textured,
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
            }
        )
    )
    many = {
        "asset": {"version": "2.0"},
        "buffers": [
            {"byteLength": 12, "uri": "data:application/octet-stream;base64,AAAAAAAAAAAAAAAA"}
        ],
    }
    many |= {
        "bufferViews": [{"buffer": 0, "byteLength": 12}],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
    }
    many |= {
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 10**10, "type": "VEC3"},
            {"componentType": 5126, "count": 10**10, "type": "VEC3"},
        ]
    }
    for i, accessor in enumerate((0, 1)):
        (tmp_path / f"{i}.gltf").write_text(
            json.dumps(
                {**many, "meshes": [{"primitives": [{"attributes": {"POSITION": accessor}}]}]}
            )
        )
    files = sorted(str(p) for p in tmp_path.iterdir())
    done = subprocess.run(
        [sys.executable, "-c", BOMBS, *files], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 700  # MB


ZIP_BOMB = """
import sys
from relit.capture.open import open_capture
from relit.errors import UserError
try:
    open_capture(sys.argv[1])
except UserError:
    print(next(int(line.split()[1]) // 1024 for line in open('/proc/self/status') if line.startswith('VmHWM')))
"""


def test_a_zip_bomb_of_arrays(tmp_path):
    """An .npz of 4 MB that would unpack to 4 GB."""
    with (
        zipfile.ZipFile(tmp_path / "cameras_sphere.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("world_mat_0.npy", "w") as file,
    ):
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            head, {"descr": "<f8", "fortran_order": False, "shape": (2**29,)}
        )
        file.write(head.getvalue())
        for _ in range(64):
            file.write(b"\0" * (1 << 20))
    (tmp_path / "image").mkdir()
    for i in range(4):
        Image.new("RGB", (8, 8)).save(tmp_path / f"image/{i:03d}.png")
    done = subprocess.run(
        [sys.executable, "-c", ZIP_BOMB, str(tmp_path)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0 and int(done.stdout) < 700, done.stderr


# ---------------------------------------------------------------- ways out of the folder


def test_models_name_no_files_outside(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "secret.bin").write_bytes(b"\0" * 64)
    for uri in (
        "../secret.bin",
        str(tmp_path / "secret.bin"),
        "file:///etc/passwd",
        "%2e%2e/secret.bin",
        "http://example.com/a.bin",
    ):
        document = {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": 36, "uri": uri}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
        }
        (tmp_path / "model/a.gltf").write_text(json.dumps(document))
        with pytest.raises(UserError):
            read_asset_file(tmp_path / "model/a.gltf")


def test_asset_json_of_every_kind(tmp_path):
    from relit.asset.asset import load_asset

    mesh, material = pawn(6, 8, 8)
    cameras = (("a.png", Camera(8, 8, 10, 10, 4, 4, np.eye(4))),)
    more = {
        "instances": (Instance(1, np.eye(4)), Instance(2, None, "hidden")),
        "flash": Flash(np.zeros(3), np.ones(3)),
    }
    ground = Ground(np.zeros(3), np.array([0.0, 1.0, 0.0]), 4.0, np.full(3, 0.5))
    save_asset(
        tmp_path / "asset",
        Asset(
            mesh,
            material,
            np.eye(4),
            np.ones((4, 8, 3), np.float32),
            cameras,
            ground=ground,
            **more,
        ),
    )
    names = ("asset.json", "cameras.json", "instances.json", "lights/flash.json")
    good = {name: json.loads((tmp_path / "asset" / name).read_text()) for name in names}
    assert len(load_asset(tmp_path).instances) == 2 and load_asset(tmp_path).flash is not None

    @FUZZ
    @given(
        st.sampled_from(sorted(good)),
        places,
        st.sampled_from([*SENSELESS, float("inf"), float("nan"), 10**400]),
    )
    def run(name, where, new):
        (tmp_path / "asset" / name).write_text(json.dumps(replaced(good[name], where, new)))
        answers(load_asset, tmp_path)
        (tmp_path / "asset" / name).write_text(json.dumps(good[name]))

    run()


def test_the_valid_files_are_read(valid, tmp_path):
    """The tests above prove nothing if this fails."""
    for name, data in valid.items():
        (tmp_path / name).write_bytes(data)
    for name in valid:
        if name.endswith(".glb"):
            assert len(read_asset_file(tmp_path / name)[0].faces) > 50
        elif not name.endswith(".npz"):
            assert read_image(tmp_path / name).rgb.shape[2] == 3
    assert read_header(tmp_path / "a.jpg").focal > 0
    (tmp_path / "light.json").write_text(
        json.dumps({"lobes": [{"axis": [0, 1, 0], "sharpness": 3.0, "amplitude": [1, 1, 1]}]})
    )
    assert len(read_lobes(tmp_path / "light.json").sharpness) == 1
    (tmp_path / "transforms.json").write_text(json.dumps(frames(tmp_path)))
    assert len(open_capture(tmp_path, masks="none").photos) == 4
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    )
    for file in ("../secret.png", "/etc/passwd"):
        (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {file}\n")
        with pytest.raises(UserError, match="outside its folder"):
            read_asset_file(tmp_path / "a.obj")


# ---------------------------------------------------------------- other readers


COLMAP = """
import random, shutil, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from support.camera_ring import ring, write_colmap_text, write_photos
import pycolmap
from relit.capture.open import open_capture
from relit.errors import UserError
root = Path(sys.argv[2])
cameras = ring(4)
write_photos(root / "images", cameras)
model = root / "sparse/0"
write_colmap_text(model, cameras, sorted(p.name for p in (root / "images").iterdir()), points=[(0, 0, 0), (0.1, 0.2, 0.3)])
text = {p.name: p.read_bytes() for p in model.iterdir()}
(root / "binary").mkdir()
pycolmap.Reconstruction(str(model)).write_binary(str(root / "binary"))
binary = {p.name: p.read_bytes() for p in (root / "binary").iterdir()}
shutil.rmtree(root / "binary")
assert len(open_capture(root, masks="none").photos) == 4
rng, answers = random.Random(7), {"read": 0, "refused": 0}
for turn in range(160):
    for path in model.iterdir():
        path.unlink()
    files = dict(binary if turn % 2 else text)
    name = rng.choice(sorted(files))
    data = bytearray(files[name])
    for _ in range(rng.randint(0, 4)):
        if data:
            at, n = rng.randrange(len(data)), rng.randint(1, 8)
            data[at : at + n] = bytes(rng.choice([0, 255, rng.randrange(256)]) for _ in range(n))
    files[name] = bytes(data[: rng.randrange(len(data) + 1)] if rng.random() < 0.3 else data)
    for file, content in files.items():
        (model / file).write_bytes(content)
    try:
        open_capture(root, masks="none")
        answers["read"] += 1
    except UserError:
        answers["refused"] += 1
print(answers["read"], answers["refused"])
"""


def test_spoilt_colmap_models(tmp_path):
    """In another process: the reader is native code, which may end the process or read for ever."""
    here = ROOT / "tests"
    done = subprocess.run(
        [sys.executable, "-c", COLMAP, str(here), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    read, refused = map(int, done.stdout.split())
    assert read > 10 and refused > 50


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["cameras_sphere.npz", "poses_bounds.npy", "a_par.txt"])
def test_spoilt_camera_arrays(tmp_path, name):
    (tmp_path / "image").mkdir()
    poses = [
        np.linalg.inv(look_at([3 * np.sin(i), 1, 3 * np.cos(i)], np.zeros(3))) for i in range(4)
    ]
    for i in range(4):
        Image.fromarray(np.full((8, 8, 3), 40 * i, np.uint8)).save(tmp_path / f"image/{i:03d}.png")
    k = np.array([[10, 0, 4, 0], [0, 10, 4, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    path = tmp_path / name
    if name.endswith(".npz"):
        np.savez(
            path,
            **{f"world_mat_{i}": k @ p for i, p in enumerate(poses)},
            **{f"scale_mat_{i}": np.eye(4) for i in range(4)},
        )
    elif name.endswith(".npy"):
        axes = np.array(
            [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]]
        )  # down, right, back
        rows = [
            np.concatenate(
                [np.column_stack([(np.linalg.inv(p) @ axes)[:3], [8, 8, 10]]).ravel(), [1, 5]]
            )
            for p in poses
        ]
        np.save(path, np.array(rows))
    else:
        (tmp_path / "image").rename(tmp_path / "other")
        for i in range(4):
            (tmp_path / f"other/{i:03d}.png").rename(tmp_path / f"{i:03d}.png")

        def line(i, p):
            return " ".join(
                map(str, [f"{i:03d}.png", *k[:3, :3].ravel(), *p[:3, :3].ravel(), *p[:3, 3]])
            )

        path.write_text("4\n" + "\n".join(line(i, p) for i, p in enumerate(poses)) + "\n")
    good = path.read_bytes()
    assert len(open_capture(tmp_path, masks="none").photos) == 4

    @FUZZ
    @given(cuts, pokes, st.sampled_from([0, 10, 128]))
    def run(cut, changes, head):
        path.write_bytes(spoilt(good, cut, changes, head))
        answers(lambda p: open_capture(p, masks="none"), tmp_path)

    run()


@pytest.mark.filterwarnings("ignore")
def test_spoilt_obj_files(valid, tmp_path):
    (tmp_path / "a.glb").write_bytes(valid["a.glb"])
    mesh, material = read_asset_file(tmp_path / "a.glb")
    from relit.asset.obj import write_obj

    write_obj(tmp_path / "a.obj", mesh, material)
    good = {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.suffix in (".obj", ".mtl")}
    assert len(good) == 2

    @FUZZ
    @given(st.sampled_from(sorted(good)), cuts, pokes)
    def run(name, cut, changes):
        (tmp_path / name).write_bytes(spoilt(good[name], cut, changes))
        answers(read_asset_file, tmp_path / "a.obj")
        (tmp_path / name).write_bytes(good[name])

    run()


def test_spoilt_configurations(tmp_path):
    from relit.job import plan_job

    path = tmp_path / "config.toml"
    good = b'capture = "multiview"\nquality = "draft"\nseed = 3\nsphere = [0.0, 0.0, 0.0, 1.0]\n\n[settings]\nrays = 100\n'

    @FUZZ
    @given(cuts, pokes)
    def run(cut, changes):
        path.write_bytes(spoilt(good, cut, changes))
        answers(lambda p: plan_job({}, p), path)

    run()
