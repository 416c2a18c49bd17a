"""Flash captures: what `relit synthesize flash` writes is what the reader of IRON's layout reads;
and what is wrong with such folders."""

import json
import shutil

import numpy as np
import pytest

from relit.capture.open import open_capture
from relit.capture.readers.iron import read_flash_light
from relit.errors import UserError
from relit.synthesize.flash import OFFSET, synthesize_flash


@pytest.fixture(scope="module")
def made(tmp_path_factory, device):
    from relit.asset.gltf import write_glb
    from relit.synthesize.procedural import pawn

    folder = tmp_path_factory.mktemp("flash")
    mesh, material = pawn(24, 36, 64)
    write_glb(folder / "pawn.glb", mesh, material)
    return synthesize_flash(
        folder / "pawn.glb",
        (),
        folder / "capture",
        views=4,
        test_views=1,
        resolution=32,
        spp=2,
        test_spp=2,
    )


@pytest.mark.slow
def test_reader_and_synthesizer_agree(made):
    capture = open_capture(made)
    truth = json.loads((made / "truth" / "truth.json").read_text())
    assert (capture.format, capture.kind) == ("iron", "flash")
    assert len(capture.photos) == 4 and len(capture.held_out) == 1
    intensity, offset = read_flash_light(made)
    assert intensity == pytest.approx(truth["flash"]["intensity"][0], rel=1e-6)
    np.testing.assert_allclose(offset, OFFSET, atol=1e-8)
    for photo in (
        capture.photos
    ):  # the world's origin is the object's middle, which every camera has in its middle
        u, v, z = photo.camera.project(np.zeros(3))
        assert abs(u - 16) < 0.5 and abs(v - 16) < 0.5 and 2 < z < 3
    assert 0.6 < capture.sphere.radius < 2  # found from the masks, of few photos
    pixels = capture.photos[0].load()
    assert pixels.mask is not None and pixels.rgb[pixels.mask > 0.99].max() > 0.05


def test_one_folder_of_iron_alone(made):
    capture = open_capture(made / "train")
    assert capture.kind == "flash" and not capture.held_out


def test_without_mask_files_the_sphere_is_where_the_object_is(made, tmp_path):
    """IRON's cameras are normalised to the unit sphere by convention. Where they are not, the
    origin may well be in every picture; the masks that the dark room gives tell where the object
    is."""
    folder = tmp_path / "moved"
    shutil.copytree(made / "train", folder)
    shutil.rmtree(folder / "mask")
    content, centre, scale = (
        json.loads((folder / "cam_dict_norm.json").read_text()),
        np.array([1.0, 2.0, 0.5]),
        3.0,
    )
    for entry in content.values():
        pose = np.array(entry["W2C"]).reshape(4, 4)
        pose[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ centre
        entry["W2C"] = pose.ravel().tolist()
    (folder / "cam_dict_norm.json").write_text(json.dumps(content))
    capture, before = open_capture(folder), open_capture(made / "train")
    assert any("threshold" in note for note in capture.notes) and any(
        "found from the masks" in note for note in capture.notes
    )
    np.testing.assert_allclose(
        capture.sphere.centre, scale * before.sphere.centre + centre, atol=0.3 * scale
    )
    assert capture.sphere.radius == pytest.approx(scale * before.sphere.radius, rel=0.3)


def test_synthesizer_is_deterministic_and_resumes(made):
    before = (made / "train" / "image" / "r_000.exr").stat().st_mtime_ns
    asset = made.parent / "pawn.glb"
    options = {"views": 4, "test_views": 1, "resolution": 32, "spp": 2, "test_spp": 2}
    assert synthesize_flash(asset, (), made, **options) == made
    assert (made / "train" / "image" / "r_000.exr").stat().st_mtime_ns == before
    with pytest.raises(UserError, match="other settings"):
        synthesize_flash(asset, (), made, **{**options, "spp": 3})


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda c: c.pop("r_001.png"), "3 cameras and 4 photos"),
        (lambda c: c["r_001.png"].pop("K"), "the camera of 'r_001' cannot be read"),
        (lambda c: c["r_001.png"].update(W2C=[0.0] * 16), "the camera of 'r_001' cannot be read"),
        (
            lambda c: c["r_001.png"].update(img_size=[32, -1]),
            "the camera of 'r_001' cannot be read",
        ),
    ],
)
def test_broken_camera_files(made, tmp_path, change, message):
    import shutil

    folder = tmp_path / "train"
    shutil.copytree(made / "train", folder)
    content = json.loads((folder / "cam_dict_norm.json").read_text())
    change(content)
    (folder / "cam_dict_norm.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=message):
        open_capture(tmp_path)


def test_offsets_of_pir_and_of_our_own(made, tmp_path):
    """PIR's file is along Mitsuba's camera axes, left and up; ours says OpenCV's, or before it did
    so has truth/truth.json beside it."""
    assert "OpenCV" in (made / "light_offset.txt").read_text().splitlines()[0]
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "light_offset.txt").write_text("0.2 0.1 0.05\n")
    np.testing.assert_allclose(read_flash_light(tmp_path)[1], [-0.2, -0.1, 0.05])
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "truth.json").write_text("{}")
    np.testing.assert_allclose(read_flash_light(tmp_path)[1], [0.2, 0.1, 0.05])
    (tmp_path / "truth" / "truth.json").unlink()
    (tmp_path / "test" / "light_offset.txt").write_text((made / "light_offset.txt").read_text())
    np.testing.assert_allclose(read_flash_light(tmp_path)[1], OFFSET, atol=1e-8)


def test_light_files(tmp_path):
    assert read_flash_light(tmp_path) == (None, None)
    (tmp_path / "light_offset.txt").write_text("0.1 0.2")
    with pytest.raises(UserError, match=r"light_offset\.txt does not hold 3 numbers"):
        read_flash_light(tmp_path)


def test_missing_light_is_told_when_it_is_needed(made, tmp_path):
    import shutil

    from relit.evaluate.flash import load_flash_truth

    shutil.copytree(made, tmp_path / "c")
    (tmp_path / "c" / "light.txt").unlink()
    with pytest.raises(UserError, match=r"light\.txt is missing"):
        load_flash_truth(tmp_path / "c")


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 1},
        {"offset": (0, 0)},
        {"offset": (3, 0, 0)},
        {"relights": ["x.hdr"]},
        {"nodes": ["nothing"]},
    ],
)
def test_wrong_settings(made, tmp_path, wrong):
    with pytest.raises(UserError):
        synthesize_flash(
            made.parent / "pawn.glb",
            (),
            tmp_path / "out",
            **{"views": 3, "test_views": 1, "resolution": 16, "spp": 1, **wrong},
        )
