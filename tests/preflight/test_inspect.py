"""The preflight: what it measures on photos whose light, cameras and blur are known."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image

from relit.cli import main as cli
from relit.conventions import srgb_from_linear, world_from_gl_camera
from relit.errors import UserError
from relit.geometry.se3 import look_at
from relit.preflight.cameras import fundamental, match, widest_view_gap
from relit.preflight.drift import drift, drift_warnings
from relit.preflight.inspect import inspect_input
from relit.preflight.light import LIMB, check_flash_light, light_regime, limb_slopes, shading_fits
from relit.preflight.look import Exif, look_at_photos, read_exif, sharpness
from relit.scene import Camera, Capture, Photo, Pixels, Sphere

SIDE, FOCAL = 96, 130.0
BALL = Sphere(np.zeros(3), 1.0)


def eye(i, n):
    return np.array(
        [4 * np.sin(2 * np.pi * i / n), 1.0 + 0.4 * (i % 2), 4 * np.cos(2 * np.pi * i / n)]
    )


def pattern(p):
    """(..., 3) points of the ball -> (..., 3) reflectance with much texture."""
    return 0.45 + 0.35 * np.sign(np.sin(9 * p) * np.sin(7 * p[..., ::-1] + 1))


def ball_photo(camera, light, surroundings=(0.2, 0.25, 0.3), mask=True):
    """A Lambertian ball of radius .85 with the texture `pattern` under light(n, camera) -> (..., 1
    or 3), before a plain backdrop."""
    h, w = camera.height, camera.width
    v, u = np.mgrid[:h, :w] + 0.5
    d = (
        np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
        @ camera.world_from_camera[:3, :3].T
    )
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = camera.centre
    b, q = d @ o, o @ o - 0.85**2
    hit = b * b > q
    n = (o + (-b - np.sqrt(np.maximum(b * b - q, 0)))[..., None] * d) / 0.85
    rgb = np.where(hit[..., None], pattern(n) * light(n, camera), np.array(surroundings)).astype(
        np.float32
    )
    return Pixels(rgb, hit.astype(np.float32) if mask else None)


def cameras(n=12, same=False):
    aims = np.random.default_rng(5).normal(size=(n, 3)) * 0.35 * (not same)
    return [
        Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, look_at(eye(0 if same else i, n), a))
        for i, a in enumerate(aims)
    ]


def capture(tmp_path, lights, surroundings=None, same=False, with_cameras=True, mask=True):
    """lights: one function per photo."""
    photos = []
    for i, (camera, light) in enumerate(zip(cameras(len(lights), same), lights, strict=True)):
        around = (0.2, 0.25, 0.3) if surroundings is None else surroundings[i]
        pixels = ball_photo(camera, light, around, mask)
        photos.append(
            Photo(f"{i}.png", lambda p=pixels: p, SIDE, SIDE, camera if with_cameras else None)
        )
    return Capture(tmp_path, "photos", tuple(photos), sphere=BALL if with_cameras else None)


def fixed(n, camera):
    return 0.3 + 0.6 * np.clip(n @ [0.6, 0.7, 0.39], 0, None)[..., None]


def flash(n, camera):
    return np.clip(n @ (camera.centre / np.linalg.norm(camera.centre)), 0, None)[..., None]


def sun(seed):
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=3)
    towards /= np.linalg.norm(towards)
    tint = rng.uniform(0.3, 1, 3)
    return lambda n, camera: tint * (0.1 + np.clip(n @ towards, 0, None)[..., None])


def test_light_regimes(tmp_path):
    assert light_regime(capture(tmp_path, [fixed] * 12))["guess"] == "fixed"
    dark = light_regime(capture(tmp_path, [flash] * 12, [(0.002, 0.002, 0.002)] * 12))
    assert (
        dark["guess"] == "flash"
        and dark["confidence"] > 0.5
        and any("moves with the camera" in e for e in dark["evidence"])
    )
    colours = np.random.default_rng(3).uniform(0.02, 0.8, (12, 3))
    varied = light_regime(capture(tmp_path, [sun(i) for i in range(12)], colours))
    assert varied["guess"] == "varied"
    moving = light_regime(capture(tmp_path, [sun(i) for i in range(6)], same=True))
    assert moving["guess"] == "moving light" and any(
        "one viewpoint" in e for e in moving["evidence"]
    )
    assert (
        light_regime(capture(tmp_path, [fixed] * 6, same=True))["guess"] == "fixed"
    )  # a tripod alone is no moving lamp


def test_light_regimes_without_cameras(tmp_path):
    assert light_regime(capture(tmp_path, [fixed] * 8, with_cameras=False))["guess"] == "fixed"
    assert (
        light_regime(capture(tmp_path, [flash] * 8, [(0.002,) * 3] * 8, with_cameras=False))[
            "guess"
        ]
        == "flash"
    )
    moving = light_regime(
        capture(tmp_path, [sun(i) for i in range(6)], same=True, with_cameras=False, mask=False)
    )
    assert moving["guess"] == "moving light"


def test_shading_is_separated_from_texture(tmp_path):
    spread, camera, _, facing = shading_fits(look_at_photos(capture(tmp_path, [flash] * 12)), BALL)
    assert spread > 0.2 and camera > 0.6 and facing > 0.5
    _, camera, photo, _ = shading_fits(
        look_at_photos(capture(tmp_path, [sun(i) for i in range(12)])), BALL
    )
    assert photo > 0.5 and camera < 0.35
    spread, _, _, _ = shading_fits(look_at_photos(capture(tmp_path, [fixed] * 12)), BALL)
    assert spread < 0.2
    assert shading_fits(look_at_photos(capture(tmp_path, [fixed] * 2)), BALL) is None


def test_lamp_at_the_camera_from_limb_darkening(tmp_path):
    """Without cameras or dark surroundings: only under a flash does the object darken evenly
    towards its outline."""
    slopes = limb_slopes(look_at_photos(capture(tmp_path, [flash] * 8, with_cameras=False)))
    assert (
        slopes.shape == (8, 3)
        and np.median(slopes[:, 2]) > LIMB
        and (np.abs(slopes[:, :2]).max(1) < slopes[:, 2]).all()
    )
    assert light_regime(capture(tmp_path, [flash] * 8, with_cameras=False))["guess"] == "flash"
    slopes = limb_slopes(look_at_photos(capture(tmp_path, [fixed] * 8)))
    assert np.median(slopes[:, 2]) < LIMB
    assert len(limb_slopes(look_at_photos(capture(tmp_path, [fixed] * 8, mask=False)))) == 0


def told(capture):
    """What `check_flash_light` says."""
    said = []
    check_flash_light(capture, said.append)
    return said


def test_flash_capture_is_accepted(tmp_path):
    assert told(capture(tmp_path, [flash] * 8, [(0.002,) * 3] * 8)) == []
    assert (
        told(capture(tmp_path, [flash] * 8, with_cameras=False)) == []
    )  # before a visible backdrop, with masks


@pytest.mark.parametrize("with_cameras", [True, False])
def test_fixed_light_is_refused_as_flash(tmp_path, with_cameras):
    with pytest.raises(
        UserError, match="does not move with the camera: it appears to be fixed"
    ) as error:
        told(capture(tmp_path, [fixed] * 14, [(0.0,) * 3] * 14, with_cameras=with_cameras))
    assert "--capture multiview" in error.value.fix and "check_light=false" in error.value.fix


def test_few_photos_are_not_refused(tmp_path):
    said = told(capture(tmp_path, [fixed] * 8, [(0.2,) * 3] * 8))
    assert len(said) == 1 and "may not be a flash" in said[0]


def test_fixed_viewpoint_with_moving_lamp_is_refused_as_flash(tmp_path):
    with pytest.raises(
        UserError, match="all photos are taken from one viewpoint, under a light that moves"
    ):
        told(
            capture(tmp_path, [sun(i) for i in range(6)], same=True, with_cameras=False, mask=False)
        )


def test_uncertain_flash_gives_a_note(tmp_path):
    said = told(capture(tmp_path, [fixed] * 8, mask=False))
    assert len(said) == 1 and "may not be a flash" in said[0]


def with_alpha(folder, light):
    """A capture of the ball on disk: PNG with alpha, cameras in transforms.json."""
    frames = []
    for i, camera in enumerate(cameras(14)):
        pixels = ball_photo(camera, light, (0.0, 0.0, 0.0))
        rgba = np.concatenate(
            [srgb_from_linear(np.clip(pixels.rgb, 0, 1)), pixels.mask[..., None]], -1
        )
        Image.fromarray((rgba * 255 + 0.5).astype(np.uint8)).save(folder / f"{i}.png")
        pose = world_from_gl_camera(camera.world_from_camera).tolist()
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose})
    head = {"w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIDE / 2, "cy": SIDE / 2}
    (folder / "transforms.json").write_text(json.dumps({**head, "frames": frames}))
    return folder


@pytest.mark.slow
def test_light_is_checked_before_a_flash_reconstruction(tmp_path, monkeypatch):
    """The environment-lit set with alpha is refused before anything is computed, and goes on when
    asked to; a flash set goes on."""
    from relit.fit.flash import recipe
    from relit.reconstruction import reconstruct

    class GoesOn(Exception):
        pass

    def stop(*args):
        raise GoesOn

    monkeypatch.setattr(recipe, "RECIPE", replace(recipe.RECIPE, run=stop))
    for name, light in (("room", fixed), ("flash", flash)):
        (tmp_path / name).mkdir()
        with_alpha(tmp_path / name, light)
    job = {"capture": "flash", "quality": "draft", "report": False}
    with pytest.raises(UserError, match="does not move with the camera"):
        reconstruct(tmp_path / "room", tmp_path / "run", **job)
    with pytest.raises(GoesOn):
        reconstruct(tmp_path / "room", tmp_path / "run2", pairs=["check_light=false"], **job)
    with pytest.raises(GoesOn):
        reconstruct(tmp_path / "flash", tmp_path / "run3", **job)


def test_light_regime_of_the_mug(shared, tmp_path):
    from relit.reconstruction import reconstruct

    with pytest.raises(UserError, match="taken from one viewpoint, under a light that moves"):
        reconstruct(
            shared / "real" / "flash_mug",
            tmp_path / "run",
            capture="flash",
            quality="draft",
            report=False,
        )


def test_blur_exposure_and_tint_are_found(tmp_path):
    def changed(i, pixels):
        rgb = pixels.rgb
        rgb = cv2.GaussianBlur(rgb, (0, 0), 2.5) if i == 3 else rgb
        rgb = rgb * 4 if i == 5 else rgb
        return Pixels(rgb * [1.5, 1, 1] if i == 7 else rgb, pixels.mask)

    c = capture(tmp_path, [fixed] * 9)
    photos = [
        Photo(p.name, lambda p=p, i=i: changed(i, p.load()), SIDE, SIDE, p.camera)
        for i, p in enumerate(c.photos)
    ]
    found = drift(look_at_photos(Capture(tmp_path, "photos", tuple(photos))))
    assert found["blurred"] == ["3.png"]
    rows = {r["name"]: r for r in found["photos"]}
    assert rows["5.png"]["ev"] == pytest.approx(2 + rows["4.png"]["ev"], abs=0.5)
    assert (
        rows["7.png"]["red"] == pytest.approx(np.log2(1.5), abs=0.2)
        and abs(rows["7.png"]["blue"]) < 0.2
    )
    assert found["exif_exposure_spread"] is None and found["cameras"] == []
    shifted = found | {"exif_exposure_spread": 1.4, "tint_spread": 1.0}
    said = [w["what"] for w in drift_warnings(shifted, True)]
    assert len(said) == 3 and "exposure varies by 1.4 EV" in said[0] and "colour varies" in said[1]
    assert [w["what"] for w in drift_warnings(shifted, True, from_anywhere=True)] == said[
        2:
    ]  # photos from anywhere differ in both


def test_sharpness_is_independent_of_content():
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.random((120, 120, 3)).astype(np.float32), (0, 0), 0.8)
    faint = 0.5 + 0.1 * (noise - 0.5)
    assert sharpness(faint, None) == pytest.approx(sharpness(noise, None), rel=0.1)
    assert sharpness(cv2.GaussianBlur(noise, (0, 0), 2), None) < 0.5 * sharpness(noise, None)


def test_exif_of_good_and_damaged_files(tmp_path):
    image, exif = Image.new("RGB", (32, 32), (90, 90, 90)), Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker", "Model 1"
    exif.get_ifd(0x8769).update({0x829A: 0.01, 0x829D: 4.0, 0x8827: 400, 0x9209: 1})
    image.save(tmp_path / "a.jpg", exif=exif)
    found = read_exif(tmp_path / "a.jpg")
    assert (
        found.camera == "Maker Model 1"
        and found.flash is True
        and found.ev == pytest.approx(np.log2(0.01 * 400 / 16))
    )
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    at = data.index(b"Exif") + 14
    data[at : at + 40] = b"\xff" * 40
    (tmp_path / "b.jpg").write_bytes(data)
    assert isinstance(read_exif(tmp_path / "b.jpg"), Exif)
    assert read_exif(tmp_path / "nowhere.jpg") == Exif()


def test_epipolar_distances():
    a, b = cameras(36)[:2]
    points = np.random.default_rng(0).normal(size=(30, 3)) * 0.5
    p, q = (np.concatenate([c.project(points)[:, :2], np.ones((30, 1))], 1) for c in (a, b))
    assert np.abs(np.einsum("ni,ij,nj->n", q, fundamental(a, b), p)).max() < 1e-9


def write(folder, n=24, turned=0.0, side=256):
    """A folder with transforms.json whose poses are `turned` (radians, about the camera's axis of
    sight) against the photos."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(n):
        camera = Camera(
            side, side, 1.3 * side, 1.3 * side, side / 2, side / 2, look_at(eye(i, n), np.zeros(3))
        )
        rgb = ball_photo(camera, fixed).rgb
        Image.fromarray((np.clip(srgb_from_linear(rgb), 0, 1) * 255).astype(np.uint8)).save(
            folder / f"images/{i:02d}.png"
        )
        c, s = np.cos(turned), np.sin(turned)
        pose = camera.world_from_camera @ np.array(
            [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]
        )
        frames.append(
            {
                "file_path": f"images/{i:02d}.png",
                "transform_matrix": world_from_gl_camera(pose).tolist(),
            }
        )
    intrinsics = {
        "w": side,
        "h": side,
        "fl_x": 1.3 * side,
        "fl_y": 1.3 * side,
        "cx": side / 2,
        "cy": side / 2,
    }
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    return folder


@pytest.mark.slow
def test_cameras_of_other_photos_give_a_warning(tmp_path):
    from relit.job import Job

    right = inspect_input(write(tmp_path / "right"), Job(masks="none"))
    assert right["epipolar"]["share"] > 0.9 and right["epipolar"]["median"] < 0.5
    assert not [w for w in right["warnings"] if "epipolar" in w["what"]]
    wrong = inspect_input(write(tmp_path / "wrong", turned=0.6), Job(masks="none"))
    assert wrong["epipolar"]["share"] < 0.5 and [
        w for w in wrong["warnings"] if "epipolar" in w["what"]
    ]


def test_photos_without_texture_are_not_matched(tmp_path):
    looks = look_at_photos(
        capture(tmp_path, [lambda n, c: np.full((*n.shape[:-1], 1), 0.5)] * 4, mask=False)
    )
    flat = [type(x)(**{**x.__dict__, "rgb": np.full_like(x.rgb, 0.3)}) for x in looks]
    assert match(flat[0], flat[1]) is None


def test_widest_gap():
    ring = np.array(
        [[np.cos(a), 0, np.sin(a)] for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)]
    )
    assert widest_view_gap(ring) == pytest.approx(90, abs=5)  # nobody looked from above
    assert (
        widest_view_gap(ring[:6])
        > 80
        > 60
        > widest_view_gap(np.concatenate([ring, ring[:, [1, 0, 2]]]))
    )


def test_the_page(tmp_path, capsys):
    folder = write(tmp_path / "photos & <co>", n=6, side=128)
    assert cli.main(["inspect", str(folder), "--html", str(tmp_path / "p.html"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    page = (tmp_path / "p.html").read_text()
    assert "<co>" not in page and "&lt;co&gt;" in page
    assert "<script" not in page and "http" not in page.replace("http://www.w3.org/2000/svg", "")
    assert page.count("<figure>") >= 6 and "<svg" in page and found["light_regime"]["guess"] in page
    assert (
        found["looked_at"] == 6
        and len(found["drift"]["photos"]) == 6
        and found["coverage"]["fill"] > 0.3
    )
    assert (
        cli.main(["inspect", str(folder), "--html", str(tmp_path / "p.html")]) == 3
    )  # nothing is overwritten


def planned(capsys, folder, *flags):
    code = cli.main(["inspect", str(folder), "--json", *flags])
    out = capsys.readouterr()
    assert code == 0, out.err
    return json.loads(out.out)


def test_plan_follows_the_capture_flag(tmp_path, capsys):
    """Photos with cameras in files that tell no kind: stages, cost, and the light that is expected
    are those of --capture."""
    folder = write(tmp_path / "photos", n=6, side=96)
    plain = planned(capsys, folder, "--masks", "none")
    flash = planned(capsys, folder, "--masks", "none", "--capture", "flash")
    assert (plain["capture"], flash["capture"]) == ("multiview", "flash") and "flash" in flash[
        "light"
    ]
    assert flash["estimate"]["seconds"] < plain["estimate"]["seconds"]
    (folder / "transforms.json").unlink()
    many = planned(capsys, folder, "--masks", "none", "--capture", "collection", "--max-side", "64")
    assert (
        many["capture"] == "collection"
        and many["stages"][0] == "links"
        and many["sizes"] == [[64, 64]]
    )
    assert planned(capsys, folder, "--masks", "none")["stages"][0] == "cameras"
    kinds = [
        w["what"] for w in flash["warnings"] if "a flash capture expects flash light" in w["what"]
    ]
    assert bool(kinds) == (
        flash["light_regime"]["guess"] != "flash" and flash["light_regime"]["confidence"] >= 0.25
    )


def test_plan_of_duplicates_with_a_segmenter(tmp_path, capsys, monkeypatch):
    """--masks segment:FILE.onnx and --focal reach the reader, as in `relit reconstruct`."""
    import relit.capture.readers.sfd as sfd

    labels = np.zeros((96, 160), np.int32)
    for k in range(3):
        cv2.circle(labels, (30 + 48 * k, 48), 18, k + 1, -1)
    monkeypatch.setattr(sfd, "Network", lambda path: path)
    monkeypatch.setattr(sfd, "found_instances", lambda network, rgb: labels)
    cv2.imwrite(
        str(tmp_path / "pile.png"),
        np.random.default_rng(0).integers(0, 255, (96, 160, 3), np.uint8),
    )
    words = ["--capture", "duplicates", "--masks", "segment:mine.onnx"]
    found = planned(capsys, tmp_path / "pile.png", *words, "--focal", "200")
    assert (
        found["capture"] == "duplicates"
        and found["stages"][0] == "poses"
        and "several identical objects" in found["light"]
    )
    assert any("3 objects found by mine.onnx" in n for n in found["notes"]) and not any(
        "focal length" in n for n in found["notes"]
    )
    assert any(
        "focal length is not known" in n
        for n in planned(capsys, tmp_path / "pile.png", *words)["notes"]
    )
    code = cli.main(["inspect", str(tmp_path / "pile.png"), "--capture", "duplicates"])
    assert code == 3 and "no labels were found" in capsys.readouterr().err
