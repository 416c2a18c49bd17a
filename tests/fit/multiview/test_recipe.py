"""The recipe on a capture that the test renders: shape, pictures, resume, steady-state kernels."""

from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh

from relit.capture.open import open_capture
from relit.conventions import move_pose, srgb_from_linear
from relit.errors import UserError
from relit.fit.multiview.recipe import MultiviewOptions, options_for, reconstruct
from relit.fit.shape.mesh_stage import texels_of
from relit.fit.shape.unseen import seen_faces
from relit.images import read_image
from relit.run import Run, Stage

TINY = MultiviewOptions(
    hollows=0,
    levels=(24, 40),
    level_steps=(60, 60),
    rays=1024,
    faces=2000,
    texture=64,
    surface_steps=60,
    points=512,
    directions=16,
    light=8,
)
RADIUS = 0.5  # of the ball that is photographed


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory):
    """Fourteen 64x64 photos of a ball with two colours, as NeRF-synthetic files."""
    import json

    from relit.conventions import world_from_gl_camera
    from relit.images import write_linear
    from relit.reference.mitsuba_scene import build_scene, render
    from relit.scene import Camera, Material, Mesh

    ball = trimesh.creation.uv_sphere(RADIUS, count=[24, 24])
    v = np.asarray(ball.vertices, np.float32)
    n = v / np.linalg.norm(v, axis=1, keepdims=True)
    uvs = np.stack(
        [np.arctan2(n[:, 1], n[:, 0]) / (2 * np.pi) + 0.5, np.arccos(n[:, 2].clip(-1, 1)) / np.pi],
        -1,
    ).astype(np.float32)
    base = np.full((8, 8, 3), 0.6, np.float32)
    base[:4] = (0.5, 0.2, 0.1)
    material = Material(base, np.full((2, 2), 0.5, np.float32), np.zeros((2, 2), np.float32))
    light = np.full((8, 16, 3), 0.3, np.float32)
    light[1:3, 3:6] = 4.0
    scene = build_scene(
        Mesh(v, np.asarray(ball.faces, np.int32), n, uvs), material, np.eye(4), light
    )
    out = tmp_path_factory.mktemp("ball")
    (out / "train").mkdir()
    frames, size = [], 64
    focal = 0.5 * size / np.tan(np.radians(20))
    for i in range(14):
        z = 1 - 2 * (i + 0.5) / 14
        o = 2.0 * np.array(
            [np.sqrt(1 - z * z) * np.cos(2.4 * i), np.sqrt(1 - z * z) * np.sin(2.4 * i), z]
        )
        f = -o / np.linalg.norm(o)
        r = np.cross(f, [0, 0, 1.0])
        r /= np.linalg.norm(r)
        pose = np.eye(4)
        pose[:3, :4] = np.stack([r, np.cross(f, r), f, o], 1)
        picture = render(
            scene, Camera(size, size, focal, focal, size / 2, size / 2, pose), spp=32, seed=i
        )
        write_linear(out / "train" / f"r_{i}.exr", picture)
        frames.append(
            {
                "file_path": f"train/r_{i}.exr",
                "transform_matrix": world_from_gl_camera(pose).tolist(),
            }
        )
    (out / "transforms_train.json").write_text(
        json.dumps({"camera_angle_x": float(np.radians(40)), "frames": frames})
    )
    return out


def test_a_ball_comes_back(capture_folder, tmp_path):
    from relit.reference.mitsuba_scene import build_scene, render

    capture = open_capture(capture_folder)
    with Run.open(tmp_path / "run", {}) as run:
        asset = reconstruct(capture, run, TINY, 0)
        again = reconstruct(capture, run, TINY, 0)  # every stage is done: read back, not computed
    np.testing.assert_array_equal(asset.mesh.vertices, again.mesh.vertices)
    np.testing.assert_array_equal(asset.material.base_color, again.material.base_color)
    world = asset.mesh.vertices @ asset.world_from_asset[:3, :3].T + asset.world_from_asset[:3, 3]
    radius = np.linalg.norm(world, axis=1)
    assert abs(radius.mean() - RADIUS) < 0.02 and radius.std() < 0.02
    mesh = trimesh.Trimesh(asset.mesh.vertices, asset.mesh.faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    assert mesh.volume > 0  # faces look outward
    assert (asset.mesh.normals * (world / radius[:, None] @ asset.world_from_asset[:3, :3])).sum(
        1
    ).mean() > 0.97
    scene = build_scene(asset.mesh, asset.material, asset.world_from_asset, asset.environment)
    photo = capture.photos[3]
    truth, shown = photo.load(), render(scene, photo.camera, spp=32)
    error = np.clip(shown[..., :3], 0, 1) ** (1 / 2.2) - np.clip(truth.rgb, 0, 1) ** (1 / 2.2)
    assert -10 * np.log10(np.mean(error**2)) > 22
    # what `relit view` shows meanwhile: photo and volume model, then photo, base colour and
    # roughness, all at the photo's size
    first = read_image(tmp_path / "run" / "previews" / "volume.jpg").rgb
    assert first.shape == (64, 2 * 64, 3)
    photo = np.clip(capture.photos[0].load().rgb, 0, 1)
    assert np.abs(srgb_from_linear(first[:, :64]) - srgb_from_linear(photo)).mean() < 0.02
    assert (
        np.abs(srgb_from_linear(first[:, 64:]) - srgb_from_linear(photo)).mean()
        < 0.06
        < srgb_from_linear(photo).mean()
    )
    second = read_image(tmp_path / "run" / "previews" / "surface.jpg").rgb
    inside = photo[24:40, 24:40].sum(-1) > 0
    assert second.shape == (64, 3 * 64, 3) and inside.all()
    assert 0.03 < second[24:40, 88:104].mean() < 1 and second[24:40, 152:168].std(-1).max() < 0.05


@pytest.mark.slow
def test_what_no_photo_shows_is_painted_like_what_is_next_to_it(capture_folder, tmp_path):
    whole = open_capture(capture_folder)
    capture = replace(whole, photos=whole.photos[:5])  # from above
    with Run.open(tmp_path, {}) as run:
        asset = reconstruct(capture, run, TINY, 0)
    to_asset = np.linalg.inv(asset.world_from_asset)
    cameras = [c.with_pose(move_pose(to_asset, c.world_from_camera)) for _, c in asset.cameras]
    face = texels_of(asset.mesh, TINY.texture).face
    seen = seen_faces(asset.mesh, cameras)
    shown, hidden = (face >= 0) & seen[face], (face >= 0) & ~seen[face]
    assert 0.1 < hidden.sum() / (hidden | shown).sum() < 0.7
    for name in ("base_color", "roughness", "metallic"):
        texture = getattr(asset.material, name)
        lowest, highest = texture[shown].min(0), texture[shown].max(0)
        inside = (texture[hidden] > lowest - 1e-4) & (texture[hidden] < highest + 1e-4)
        assert inside.mean() > 0.999, "no colour that is not on it"


@pytest.mark.slow
def test_it_goes_on_from_a_checkpoint(capture_folder, tmp_path, monkeypatch):
    """A stop in the second level, then the same call: the steps before the checkpoint are not done
    again, and the result is as good."""
    import relit.fit.passes.volume as volume

    capture = open_capture(capture_folder)
    monkeypatch.setattr(Stage, "checkpoint_due", lambda self: True)
    counted = []
    original = volume.run_steps

    def stopping(stage, first, last, step, save=None, name="checkpoint", preview=None):
        def counting(i):
            counted.append(i)
            if len(counted) == 90:
                raise KeyboardInterrupt
            return step(i)

        original(stage, first, last, counting, save, name, preview)

    monkeypatch.setattr(volume, "run_steps", stopping)
    with Run.open(tmp_path / "run", {}) as run, pytest.raises(KeyboardInterrupt):
        reconstruct(capture, run, TINY, 0)
    with Run.open(tmp_path / "run", {}) as run:
        asset = reconstruct(capture, run, TINY, 0)
    assert counted[89:92] == [89, 89, 90]  # taken up at the step that was cut off
    world = asset.mesh.vertices @ asset.world_from_asset[:3, :3].T + asset.world_from_asset[:3, 3]
    assert abs(np.linalg.norm(world, axis=1).mean() - RADIUS) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["volume", "surface"])
def test_no_kernel_is_compiled_in_steady_state(capture_folder, tmp_path, monkeypatch, stage):
    """After the first steps every step launches kernels that were seen before, and always the same
    number of them."""
    import drjit as dr

    import relit.fit.passes.surface_loop as surface
    import relit.fit.passes.volume as volume

    seen, late = set(), []
    module = {"volume": volume, "surface": surface}[stage]
    original = module.run_steps

    monkeypatch.setattr(Stage, "preview_due", lambda self: True)

    def watching(s, first, last, step, save=None, name="checkpoint", preview=None):
        pictures = []

        def pictured():  # previews too compile what they need at the first one
            dr.kernel_history_clear()
            out = preview()
            hashes = {k["hash"] for k in dr.kernel_history() if "hash" in k}
            assert not pictures or not hashes - seen
            pictures.append(out)
            seen.update(hashes)
            return out

        def watched(i):
            dr.kernel_history_clear()
            out = step(i)
            dr.eval(out)
            history = dr.kernel_history()
            hashes = {k["hash"] for k in history if "hash" in k}
            if i - first >= 8:
                late.append(
                    (
                        len(hashes - seen),
                        sum(k.get("backend_time", 0) for k in history),
                        len(history),
                    )
                )
            seen.update(hashes)
            return out

        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            original(s, first, min(last, first + 20), watched, None, name, pictured)
        assert len(pictures) == 20

    monkeypatch.setattr(module, "run_steps", watching)
    with Run.open(tmp_path / "run", {}) as run:
        reconstruct(
            open_capture(capture_folder), run, replace(TINY, without=("first_material",)), 0
        )
    assert len(late) >= 12
    assert [new for new, _, _ in late] == [0] * len(late)
    assert sum(seconds for _, seconds, _ in late) == 0
    assert len({count for _, _, count in late}) == 1


NAMES = [
    "hull",
    "interreflection",
    "exchange",
    "material_prior",
    "colour_smoothing",
    "light_prior",
    "white",
    "parsimony",
]
NAMES += ["normal_map", "first_material"]


@pytest.mark.slow
@pytest.mark.parametrize("without", NAMES)
def test_every_ablation_changes_the_result(capture_folder, tmp_path, monkeypatch, without):
    """Each named part really is a part: switched off, what it acts on is not reached, and the fit
    still ends in an asset."""
    import relit.fit.multiview.recipe as multiview
    import relit.fit.passes.surface as surface

    seen = {"blocked": 0.0}
    options = replace(TINY, level_steps=(4, 4), surface_steps=3)
    if without == "hull":
        options = replace(options, hollows=0, levels=(32,), level_steps=(0,))
    else:
        options = replace(options, without=(without,))
    found = multiview.surface_options(options)
    full = multiview.surface_options(TINY)
    zeroed = {
        f.name for f in fields(found) if getattr(found, f.name) == 0 and getattr(full, f.name) != 0
    }
    assert zeroed == set(multiview.WITHOUT.get(without, {}))
    original = surface.sample_lights

    def watched(*args):
        lights = original(*args)
        seen["blocked"] += float(np.abs(np.array(lights.blocked)).sum())
        return lights

    monkeypatch.setattr(surface, "sample_lights", watched)
    with Run.open(tmp_path / "run", {}) as run:
        asset = reconstruct(open_capture(capture_folder), run, options, 0)
    assert np.isfinite(asset.material.base_color).all() and len(asset.mesh.faces) > 200
    assert (seen["blocked"] == 0) == (without == "interreflection")


def test_an_unknown_part_is_answered():
    with pytest.raises(ValueError, match="Did you mean 'exchange'"):
        MultiviewOptions(without=("exchang",))


def test_unknown_quality():
    with pytest.raises(UserError, match="standard"):
        options_for("standart")


def test_levels_and_steps_must_match(capture_folder, tmp_path):
    with Run.open(tmp_path / "run", {}) as run, pytest.raises(UserError, match="level_steps"):
        reconstruct(open_capture(capture_folder), run, MultiviewOptions(level_steps=(1,)), 0)


@pytest.mark.parametrize("quality", ["draft", "standard", "high"])
def test_the_first_level_reaches_into_concave_sides(quality):
    """The first band is eight voxels deep. At 128 nodes, .13, the dinosaur's concave flank kept its
    hull; at 48, .34, it is found."""
    options = options_for(quality)
    assert 8 * 2 / (options.levels[0] - 1) > 0.3
    assert max(b / a for a, b in zip(options.levels, options.levels[1:], strict=False)) < 3
