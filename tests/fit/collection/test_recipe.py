import json

import numpy as np
import pytest

from relit.errors import UserError
from relit.run import Run

mi = pytest.importorskip("mitsuba")

TINY = [
    "side=48",
    "rounds=1",
    "polish=0",
    "least_score=0.5",
    "keep=1",
    "levels=24",
    "level_steps=15",
    "rays=512",
    "faces=600",
    "texture=64",
    "surface_steps=6",
    "points=128",
    "directions=8",
    "frozen_steps=4",
]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A collection of nine photos and one for testing, 64 pixels."""
    from relit.asset.gltf import write_glb
    from relit.images import write_linear
    from relit.synthesize.collection import synthesize_collection
    from support.lump import lump

    folder = tmp_path_factory.mktemp("collection")
    write_glb(folder / "lump.glb", *lump())
    light = np.full((8, 16, 3), 0.4, np.float32)
    light[1:3, 3:6] = 4.0
    write_linear(folder / "light.exr", light)
    out = folder / "capture"
    args = (folder / "lump.glb", folder / "light.exr", out)
    options = {
        "views": 9,
        "test_views": 1,
        "resolution": 64,
        "spp": 4,
        "test_spp": 4,
        "max_depth": 2,
    }
    assert synthesize_collection(*args, **options) == out
    before = (out / "image" / "000.jpg").stat().st_mtime_ns
    synthesize_collection(*args, **options)  # complete: nothing is rendered again
    assert (out / "image" / "000.jpg").stat().st_mtime_ns == before
    return out


@pytest.mark.slow
def test_layout_and_truth(capture):
    from relit.asset.asset import read_cameras
    from relit.capture.open import open_capture
    from relit.capture.readers.samurai import read_hints

    opened = open_capture(capture)
    assert (opened.kind, len(opened.photos), len(opened.held_out)) == ("collection", 9, 1)
    hints = read_hints(capture, [p.name for p in opened.photos])
    cameras = dict(read_cameras(capture / "truth" / "cameras.json"))
    for name, direction in hints.directions.items():
        centre = cameras[name].centre
        assert direction @ centre / np.linalg.norm(centre) > np.cos(np.radians(46))
    fields = {round(c.fx) for c in cameras.values()}
    assert len(fields) > 5  # every camera has its own focal length


def test_masks_are_roughened_but_right(capture):
    from relit.images import read_data

    assert (capture / "truth" / "lights" / "000.exr").is_file()
    name = json.loads((capture / "held_out.json").read_text())["frames"][0].removesuffix(".jpg")
    mask, alpha = (
        read_data(capture / "mask" / f"{name}.png"),
        read_data(capture / "truth" / "test" / f"{name}.exr")[..., 3],
    )
    mask = mask if mask.ndim == 2 else mask[..., 0]
    both, either = ((mask > 0.5) & (alpha > 0.5)).sum(), ((mask > 0.5) | (alpha > 0.5)).sum()
    assert 0.75 < both / either <= 1.0
    assert np.abs(mask - np.clip(alpha, 0, 1)).max() > 0.2


@pytest.mark.slow
def test_from_the_command_line_to_the_figures(capture, tmp_path):
    from relit.asset.asset import load_asset
    from relit.cli.main import main
    from relit.evaluate.collection import evaluate_collection

    words = [
        "reconstruct",
        str(capture),
        "-o",
        str(tmp_path / "run"),
        "--device",
        "cpu",
        "--quality",
        "draft",
    ]
    assert main([*words, *(w for pair in TINY for w in ("--set", pair))]) == 0
    asset = load_asset(tmp_path / "run")
    assert len(asset.cameras) == len(asset.lights) == 10
    assert asset.meta["held_out"] == [asset.cameras[-1][0]]
    assert asset.cameras[0][1].width in (48, 64)
    metrics = evaluate_collection(tmp_path / "run", capture, spp=4)["metrics"]
    for name in (
        "rotation_mean",
        "rotation_within_10",
        "novel_psnr",
        "novel_ssim",
        "albedo_psnr",
        "chamfer_percent",
        "focal_percent",
    ):
        assert np.isfinite(metrics[name]["value"]) and metrics[name]["definition"]
    assert metrics["rotation_mean"]["value"] < 40  # one round at 32 nodes


def test_posterior_silences_what_is_out_of_line():
    from relit.fit.collection.surface import posterior

    history = np.random.default_rng(0).normal(1.0, 0.1, 500).tolist()
    w = posterior(np.array([0.8, 1.0, 1.2, 3.0]), history)
    assert w[0] == 1 and w[1] > 0.9 and 0.01 < w[2] < 0.2 and w[3] < 1e-3
    assert (posterior(np.array([5.0]), [1.0] * 5) == 1).all()  # too little is known yet


def test_scale_is_exchanged_without_a_change_of_what_is_diffuse():
    from relit.fit.collection.surface import exchange_scale
    from relit.fit.passes.optimiser import Adam
    from relit.materials.field import start_material

    base = np.random.default_rng(0).uniform(0.1, 0.6, (8, 8, 3)).astype(np.float32)
    material = start_material(8, base, 0.5, 0.0)
    pull = np.zeros((8, 8, 4), np.float32)
    pull[..., 0], pull[..., 2], pull[..., 3] = (
        1,
        -1,
        5,
    )  # red is too bright, blue too dark; roughness has no part in it
    before = np.array(material.colour).reshape(8, 8, 4)
    move = exchange_scale(
        Adam(3), material, mi.Float(pull.ravel()), np.zeros((4, 3), np.float32), 0.05
    )
    after = np.array(material.colour).reshape(8, 8, 4)
    assert move[0] > 0.04 and abs(move[1]) < 1e-6 and move[2] < -0.04
    assert np.allclose(after[..., :3] * np.exp(move), before[..., :3], rtol=1e-5)
    assert (after[..., 3] == before[..., 3]).all()
    assert (
        exchange_scale(
            Adam(3), material, mi.Float(0 * pull.ravel()), np.full((4, 3), 0.2, np.float32), 0.05
        ).max()
        < -0.04
    )  # dimmer lights


@pytest.mark.parametrize("each", [7, 8])
def test_corrections_about_the_origin_are_rays_of_corrected_cameras(each):
    """Rays through corrected parameters equal those of the cameras that `corrected` builds; and
    their derivative is right."""
    import drjit as dr

    from relit.fit.passes.camera_corrections import CameraCorrections, CorrectionModel, corrected
    from relit.fit.passes.pixels import camera_rows, rays_through
    from relit.geometry.se3 import look_at
    from relit.scene import Camera

    cameras = [
        Camera(40, 30, 50.0, 50.0, 20.0, 15.0, look_at(np.array(e)))
        for e in ([0, 1, 3.0], [2, 0, -2.0])
    ]
    numbers = np.random.default_rng(2).normal(size=2 * each) * 0.05
    view, x, y = mi.UInt32([0, 1, 1]), mi.Float([3.5, 10.5, 30.5]), mi.Float([20.5, 2.5, 15.5])
    rows = mi.Float(camera_rows(cameras))
    own = CameraCorrections(CorrectionModel(each), mi.Float(numbers))
    o, d = rays_through(rows, view, x, y, own)
    o2, d2 = rays_through(mi.Float(camera_rows(corrected(cameras, own))), view, x, y)
    assert np.allclose(np.array(o), np.array(o2), atol=1e-5) and np.allclose(
        np.array(d), np.array(d2), atol=1e-5
    )

    def value(c):
        o, d = rays_through(rows, view, x, y, CameraCorrections(own.model, c))
        return dr.sum(
            dr.dot(o, mi.Vector3f(0.3, -0.7, 0.2)) + dr.dot(d, mi.Vector3f(1.1, 0.4, -0.6))
        )

    c = mi.Float(numbers)
    dr.enable_grad(c)
    dr.backward(value(c))
    gradient, step = np.array(dr.grad(c)), 1e-2
    for k in range(2 * each):
        e = np.zeros(2 * each)
        e[k] = step
        slope = (
            float(value(mi.Float(numbers + e))[0]) - float(value(mi.Float(numbers - e))[0])
        ) / (2 * step)
        assert abs(slope - gradient[k]) < 0.02 * max(1.0, abs(slope))


def test_the_appearance_has_the_right_derivative():
    """Of shade_photos, in a photo's own numbers, against finite differences."""
    import drjit as dr

    from relit.fit.passes.pixels import RayBatch
    from relit.rendering.appearance.light_per_photo import shade_photos, start_photo_lights
    from relit.rendering.march import Marched

    learnt, _ = start_photo_lights(np.array([[0.3, 0.2, 0.1], [0.1, 0.4, 0.2]]), 0.3)
    numbers = np.array(learnt) + np.random.default_rng(0).normal(size=108).astype(np.float32) * 0.2
    m = Marched(
        [mi.Float(v) for v in (0.5, 0.4, 0.3, 0.2)],
        mi.Vector3f(0.2, 0.9, 0.1),
        mi.Float(3.0),
        mi.Float(0.1),
        mi.UInt32(5),
    )
    rays = RayBatch(
        mi.Vector3f(0, 0, 3),
        dr.normalize(mi.Vector3f(0.1, -0.2, -1)),
        None,
        None,
        mi.UInt32(1),
        mi.UInt32(0),
    )

    def value(c):
        colour, _ = shade_photos(m, rays, None, c)
        return colour.x + 2 * colour.y + 3 * colour.z

    c = mi.Float(numbers)
    dr.enable_grad(c)
    dr.backward(value(c))
    gradient = np.array(dr.grad(c))
    assert (gradient[:54] == 0).all() and (np.abs(gradient[54:]) > 0).sum() > 40
    for k in (54, 60, 71, 82, 95, 107):
        e = np.zeros(108, np.float32)
        e[k] = 1e-2
        slope = (
            float(value(mi.Float(numbers + e))[0]) - float(value(mi.Float(numbers - e))[0])
        ) / 2e-2
        assert abs(slope - gradient[k]) < 0.02 * max(0.1, abs(slope))


def photos(folder, masks, count=6):
    from relit.images import write_data, write_srgb

    rng = np.random.default_rng(0)
    for i in range(count):
        write_srgb(folder / "image" / f"{i}.png", rng.uniform(0, 1, (40, 48, 3)).astype(np.float32))
        write_data(folder / "mask" / f"{i}.png", masks(i))
    return folder


def blob(i):
    mask = np.zeros((40, 48), np.float32)
    mask[10:30, 12 : 20 + 4 * i] = 1
    return mask


def reconstruct(folder, out, *pairs):
    from relit.reconstruction import reconstruct

    return reconstruct(
        folder,
        out,
        capture="collection",
        quality="draft",
        device="cpu",
        pairs=[*TINY, *pairs],
        report=False,
    )


def test_three_photos_are_too_few(tmp_path):
    with pytest.raises(UserError, match="3 photos are not enough") as raised:
        reconstruct(photos(tmp_path / "in", blob, 3), tmp_path / "run")
    assert raised.value.code == 3


@pytest.mark.slow
def test_noise_is_no_object(tmp_path):
    """Photos that have nothing in common end in a verdict, not in an asset."""
    folder = photos(
        tmp_path / "in", lambda i: np.roll(blob(i % 3), 3 * i, 1)[:, :: -1 if i % 2 else 1]
    )
    sides = ("Left", "Right", "Center")
    frames = [
        {"image_name": f"{i}.png", "quadrant": [sides[i % 3], "Above", "Front"]} for i in range(6)
    ]
    (folder / "quadrants.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(UserError, match=r"could not be found|no shape agrees") as raised:
        reconstruct(folder, tmp_path / "run", "least_score=0.97")
    assert raised.value.code == 4


def test_verdicts(tmp_path):
    """A mean score or an agreement that is too low ends the run; a photo far below the others is
    named."""
    from relit.fit.collection.options import CollectionOptions
    from relit.fit.collection.photo_poses import PhotoPoses, PoseEvidence, judge_poses

    options, names = CollectionOptions(), [f"{i}.jpg" for i in range(14)]

    def judged(scores, share):
        count = len(scores)
        evidence = PoseEvidence(float(np.mean(scores)), share, np.nan, np.nan)
        poses, none = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool)
        found = PhotoPoses(poses, scores, none, np.ones(count), "search", evidence)
        with Run.open(tmp_path / "run", {}) as run:
            judge_poses(found, names[:count], options, run)
        return (tmp_path / "run" / "log.txt").read_text()

    scores = np.full(14, 0.95) + np.linspace(-0.01, 0.01, 14)
    scores[5] = 0.7
    said = judged(scores, 0.4)
    assert "1 photos agree badly" in said and "5.jpg" in said
    assert "nothing tells" in judged(scores[:8], np.nan)
    for low, share in ((scores - 0.3, 0.4), (scores, 0.1)):
        with pytest.raises(UserError, match="could not be found") as raised:
            judged(low, share)
        assert raised.value.code == 4


def test_unknown_ablation(tmp_path):
    with pytest.raises(UserError) as raised:
        reconstruct(photos(tmp_path / "in", blob), tmp_path / "run", "without=multiplexx")
    assert raised.value.code == 2


def test_the_surface_pass_takes_the_network_and_the_first_colours(tmp_path):
    """Under Neural-PIL's lights the codes move; L_init draws the base colour to the pixels' own."""

    from relit.fit.collection.surface import (
        LightOptions,
        PhotoLightTerms,
        fit_collection_surface,
        start_collection_surface,
    )
    from relit.fit.passes.material_priors import ALBEDO_START, SurfaceOptions
    from relit.fit.passes.optimiser import NoStage
    from relit.fit.passes.pixels import make_bank
    from relit.geometry.se3 import look_at
    from relit.lighting.neural_pil import load_neural_pil
    from relit.materials.field import start_material
    from relit.rendering.transport import TraceableMesh
    from relit.scene import Camera
    from support.lump import lump
    from support.neural_pil_files import write_network

    write_network(tmp_path)
    network = load_neural_pil(tmp_path)
    mesh, _ = lump()
    cameras = [
        Camera(24, 24, 26, 26, 12, 12, look_at(np.array(eye)))
        for eye in ((0, 0.5, 3.0), (3.0, 0.5, 0))
    ]
    rgb = np.full((24, 24, 3), (0.5, 0.2, 0.1), np.float32)
    bank = make_bank(cameras, [rgb, rgb], [np.ones((24, 24), np.float32)] * 2)
    redness = []
    for anchor in (0.0, 30.0):
        material = start_material(16, np.full((16, 16, 3), 0.3, np.float32), 0.5, 0.05)
        model = start_collection_surface(material, np.full((2, 3), 0.3), ALBEDO_START, network)
        options = SurfaceOptions(6, 96, 8, 16, warm=0.01)
        light = LightOptions(anchor=anchor, lambda_a=100.0)
        traced = TraceableMesh(mesh, np.full((len(mesh.vertices), 3), 0.4))
        fit_collection_surface(PhotoLightTerms(bank, traced, model, options, light), NoStage())
        assert (
            model.coefficients.shape == (2, network.size)
            and np.abs(model.coefficients).max() > 1e-3
        )
        redness.append(np.array(material.colour).reshape(-1, 4) @ [1, 0, -1, 0])
    gained = redness[1] - redness[0]
    seen = np.abs(gained) > 1e-3
    assert seen.sum() > 20 and (gained[seen] > 0).mean() > 0.9  # the pixels are red


def test_given_cameras_tell_where_photos_were_taken_from():
    """Cameras in a frame of their own, tilted: their directions about the object, levelled."""
    from types import SimpleNamespace

    from relit.conventions import similarity
    from relit.fit.collection.photos import hints_of_cameras
    from relit.geometry.se3 import exp_so3, look_at
    from relit.scene import Camera, Sphere

    tilt = similarity(exp_so3(np.array([1.2, 0.3, -0.5])), np.array([4.0, -1.0, 2.0]))
    eyes = [np.array([3 * np.sin(a), 1.0, 3 * np.cos(a)]) for a in np.arange(8) * np.pi / 4]
    cameras = [Camera(40, 30, 50.0, 50.0, 20.0, 15.0, tilt @ look_at(eye)) for eye in eyes]
    photos = [SimpleNamespace(name=f"{i}.png", camera=c) for i, c in enumerate(cameras)]
    capture = SimpleNamespace(sphere=Sphere(tilt[:3, 3], 0.5), format="llff")
    hints = hints_of_cameras(capture, photos)
    found = np.array([hints.directions[p.name] for p in photos])
    wanted = np.array([eye / np.linalg.norm(eye) for eye in eyes])
    assert np.allclose(found[:, 1], wanted[:, 1], atol=1e-6)  # the same height
    assert np.allclose(
        found @ found.T, wanted @ wanted.T, atol=1e-6
    )  # and the same turns between them
    assert "llff" in hints.source and hints.degrees < 45
