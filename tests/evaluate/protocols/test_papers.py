"""The papers' figures, against values worked out by hand from their code."""

from __future__ import annotations

import numpy as np
import pytest

from relit.conventions import move_points, move_pose, similarity, srgb_from_linear
from relit.errors import EXIT_USAGE, UserError
from relit.evaluate import metrics as m
from relit.evaluate.baselines import Constants
from relit.evaluate.dispatch import PROTOCOLS, evaluate
from relit.evaluate.flash import FlashView
from relit.evaluate.pile_alignment import frame_by_poses, grown_about
from relit.evaluate.protocols import orb, pir, samurai, sfd
from relit.geometry.se3 import exp_so3, look_at
from relit.scene import Camera

SIZE = 24


def flat(*colour):
    return np.broadcast_to(np.array(colour, float), (SIZE, SIZE, len(colour))).copy()


def disc(share=0.5):
    """(H, W) bool: the upper rows."""
    inside = np.zeros((SIZE, SIZE), bool)
    inside[: int(SIZE * share)] = True
    return inside


# ---------------------------------------------------------------- SfD


def test_sfd_pictures_are_compared_at_2_2_inside_the_mask():
    inside, network = disc(), disc(0.25)
    shown, truth = flat(0.0, 0.0, 0.0), flat(0.5**2.2, 0.5**2.2, 0.5**2.2)
    shown[network] = 0.5**2.2  # right where the network sees the object, black elsewhere
    scores = sfd.sfd_picture_scores(shown, truth, inside, network)
    assert scores["psnr"] == pytest.approx(-10 * np.log10(0.25 / 2), abs=1e-4)
    assert scores["psnr_both"] == pytest.approx(80)  # 1e-8 is added to the error
    same = sfd.sfd_picture_scores(truth, truth, inside, inside)
    assert same["ssim"] == pytest.approx(1)


def test_sfd_ssim_is_white_outside_and_takes_the_span_of_values():
    from skimage.metrics import structural_similarity

    rng = np.random.default_rng(0)
    a, b, inside = rng.random((SIZE, SIZE, 3)), rng.random((SIZE, SIZE, 3)), disc()
    x, y = (np.where(inside[..., None], v ** (1 / 2.2), 1.0) for v in (a, b))
    span = max(x.max(), y.max()) - min(x.min(), y.min())
    theirs = structural_similarity(x, y, data_range=span, channel_axis=2)
    assert sfd.sfd_picture_scores(a, b, inside, inside)["ssim"] == pytest.approx(theirs, abs=1e-9)


def test_sfd_factor_of_base_colour_is_taken_in_gamma_space():
    truth = flat(0.04, 0.04, 0.04)
    truth[:, ::2] = 0.36
    shown = flat(0.02, 0.02, 0.02)
    shown[:, ::2] = 0.09
    inside = disc(1)
    a, b = shown ** (1 / 2.2), truth ** (1 / 2.2)
    factor = b[..., 0].sum() / a[..., 0].sum()
    expected = -10 * np.log10(np.mean((np.clip(a * factor, 0, 1) - b) ** 2) + 1e-8)
    scores = sfd.sfd_albedo_scores(shown, truth, inside, inside)
    assert scores["albedo_psnr"] == pytest.approx(expected)
    linear = truth[..., 0].sum() / shown[..., 0].sum()
    other = -10 * np.log10(np.mean((m.gamma_encode(shown * linear) - b) ** 2))
    assert abs(other - expected) > 0.3  # a factor of linear values gives another figure
    # any map of one value scores the same, as its factor makes it the mean
    one = sfd.sfd_albedo_scores(flat(0.1, 0.1, 0.1), truth, inside, inside)["albedo_psnr"]
    assert one == pytest.approx(-10 * np.log10(b[..., 0].var() + 1e-8))


def test_sfd_roughness_is_raised_to_1_over_2_2_first():
    inside = disc()
    value = sfd.roughness_mse(np.full((SIZE, SIZE), 0.5**2.2), np.full((SIZE, SIZE), 1.0), inside)
    assert value == pytest.approx(0.25)  # linear: (1 - .218)^2 = .61


def test_sfd_view_collects_baselines():
    inside, constants = disc(), Constants()
    rough = np.full((SIZE, SIZE), 0.4)
    view = sfd.SfdView(
        inside,
        inside,
        (flat(0.2, 0.2, 0.2), flat(0.2, 0.2, 0.2)),
        (rough, rough),
        {"relit:eve": (flat(0.1, 0.1, 0.1), flat(0.1, 0.1, 0.1))},
    )
    scores = sfd.sfd_view_scores(view, constants, None)
    assert scores["relit_psnr:eve"] == pytest.approx(80) and scores["roughness_mse"] == 0
    assert constants.baselines()["roughness_mse"][0] == pytest.approx(0, abs=1e-12)
    assert {k.split(":")[0] for k in scores} <= set(sfd.DEFINITIONS)


PHOTO = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, look_at(np.array([0.0, 3.0, 9.0])))


def pile(count=7, seed=0):
    rng = np.random.default_rng(seed)
    return {
        k: similarity(exp_so3(rng.normal(size=3)), rng.uniform(-2, 2, 3), 1.0) for k in range(count)
    }


def test_sfd_poses_do_not_depend_on_the_objects_frame_or_the_scene_scale():
    true = pile()
    frame = similarity(exp_so3(np.array([0.4, 1.0, -0.2])), np.zeros(3), 1.0)
    found = {k: grown_about(PHOTO.centre, 0.5) @ p @ frame for k, p in true.items()}
    scores = sfd.pose_scores(found, true, PHOTO)
    assert scores["rotation_mean"] == pytest.approx(0, abs=1e-4)
    chance = sfd.pose_chance(true, PHOTO)
    # the first is its own reference: 6 of 7 count 126.5 degrees on average
    assert chance["rotation_mean"][0] == pytest.approx(126.5 * 6 / 7, abs=8)


def test_sfd_rotation_is_relative_to_the_first_instance():
    true = pile()
    found = {k: p.copy() for k, p in true.items()}
    turn = exp_so3(np.radians([0, 14, 0]))
    found[3][:3, :3] = found[3][:3, :3] @ turn
    assert sfd.pose_scores(found, true, PHOTO)["rotation_mean"] == pytest.approx(2)
    found = {k: p.copy() for k, p in true.items()}
    found[0][:3, :3] = found[0][:3, :3] @ turn  # the reference is off: all others are
    assert sfd.pose_scores(found, true, PHOTO)["rotation_median"] == pytest.approx(14)


def test_sfd_frame_comes_from_poses_alone():
    true, frame = pile(), similarity(exp_so3(np.array([0.2, 0.3, 1.0])), [0.1, 0.2, 0.3], 1.6)
    middle = np.array([0.05, 0.0, -0.1])
    found = {
        k: grown_about(PHOTO.centre, 1 / 1.3) @ p @ np.linalg.inv(frame) for k, p in true.items()
    }
    got = frame_by_poses(found, true, 1.3, move_points(frame, middle), middle)
    np.testing.assert_allclose(got, frame, atol=1e-9)


def test_sfd_chamfer_is_in_radii():
    import trimesh

    ball = trimesh.creation.icosphere(3, radius=2.0)
    mesh = (np.asarray(ball.vertices), np.asarray(ball.faces))
    value = sfd.sfd_surface_score(mesh, mesh, similarity(np.eye(3), np.zeros(3), 1.1), 20_000)
    assert value == pytest.approx(0.1, rel=0.02)  # a tenth of the radius apart


# ---------------------------------------------------------------- PIR


def flash_view(**changes) -> FlashView:
    mask = disc(0.5)
    zero = np.zeros((SIZE, SIZE))
    values = {
        "name": "t_000",
        "picture": flat(0, 0, 0),
        "photo": flat(0, 0, 0),
        "coverage": mask.astype(float),
        "diffuse": (flat(0, 0, 0), flat(0, 0, 0)),
        "specular": (zero, zero),
        "alpha": (zero, zero),
        "normals": None,
    }
    return FlashView(**(values | changes))


def test_pir_pictures_have_8_bits_at_2_2_over_the_whole_frame():
    shown = flat(0, 0, 0)
    shown[disc(0.25)] = (51.2 / 255) ** 2.2  # rounds to 51: one fifth
    scores = pir.pir_view_scores(flash_view(picture=shown), Constants())
    assert scores["novel_psnr"] == pytest.approx(-10 * np.log10(0.2**2 / 4))


def test_pir_albedo_is_black_where_the_recovered_object_is_not():
    """The truth is cut by the RECOVERED mask: what lies outside costs nothing."""
    true = flat(0.5, 0.5, 0.5)
    shown = flat(0, 0, 0)
    shown[disc(0.5)] = [0.6, 0.5, 1.5]
    constants = Constants()
    scores = pir.pir_view_scores(flash_view(diffuse=(shown, true)), constants)
    error = (0.1**2 + 0 + 0.5**2) / 3 / 2  # 1.5 is clipped to 1; half of the frame
    assert scores["diffuse_psnr"] == pytest.approx(-10 * np.log10(error))
    assert constants.baselines()["diffuse_psnr"][0] == 100  # the truth is one value there
    aligned = pir.aligned_psnr(np.clip(shown, 0, 1), true * disc()[..., None], disc())
    assert scores["diffuse_psnr_aligned"] == pytest.approx(aligned) == 100


def test_pir_rims_hold_the_value_of_the_surface():
    coverage = np.where(disc(0.5), 0.6, 0.0)
    view = flash_view(coverage=coverage, alpha=(0.3 * coverage, 0.3 * disc(0.5)))
    assert pir.pir_view_scores(view, Constants())["roughness_mse"] == pytest.approx(0, abs=1e-12)
    view = flash_view(coverage=coverage * 0.5, alpha=(0.15 * coverage, 0.3 * disc(0.5)))
    assert pir.pir_view_scores(view, Constants())["roughness_mse"] == pytest.approx(0.09 / 2)


def test_pir_constant_of_aligned_maps_is_scored():
    true = flat(0.2, 0.2, 0.2)
    true[:, ::2] = 0.4
    scores = pir.constant_aligned(flash_view(diffuse=(true, true)))
    # the median of .2 and .4 is .3; the truth keeps its scale up to the median ratio
    assert 15 < scores["diffuse_psnr_aligned"] < 30


# ---------------------------------------------------------------- SAMURAI


def test_samurai_composes_srgb_values_on_white():
    rgba = np.array([[[0.1, 0.1, 0.1, 0.5], [0.0, 0.0, 0.0, 0.0]]])
    expected = srgb_from_linear(0.2) * 0.5 + 0.5  # the object's own colour is .1 / .5
    np.testing.assert_allclose(samurai.on_white_encoded(rgba)[0, 0], expected)
    np.testing.assert_allclose(samurai.on_white_encoded(rgba)[0, 1], 1.0)


def test_samurai_scores_a_picture():
    shown = np.concatenate([flat(0, 0, 0), flat(1)], -1)
    truth = np.concatenate([flat(0, 0, 0), flat(0)], -1)
    assert samurai.samurai_picture_scores(shown, truth)["novel_psnr"] == pytest.approx(0)
    assert samurai.samurai_picture_scores(shown, shown)["novel_ssim"] == pytest.approx(1)


def test_samurai_cameras_are_aligned_by_all_centres():
    rng = np.random.default_rng(2)
    true = {
        f"{i}": PHOTO.with_pose(look_at(5 * e / np.linalg.norm(e)))
        for i, e in enumerate(rng.normal(size=(10, 3)))
    }
    s = similarity(exp_so3(np.array([1.0, 0.2, 0.4])), [3.0, 1, 2], 0.3)
    found = {n: c.with_pose(move_pose(s, c.world_from_camera)) for n, c in true.items()}
    scores = samurai.camera_scores(found, true)
    assert scores["rotation_mean"] == pytest.approx(0, abs=1e-5)
    assert scores["translation_mean"] == pytest.approx(0, abs=1e-9) and scores["cameras"] == 100
    roll = np.eye(4)
    roll[:3, :3] = exp_so3(np.radians([0, 0, 20]))
    found["4"] = found["4"].with_pose(found["4"].world_from_camera @ roll)
    assert samurai.camera_scores(found, true)["rotation_mean"] == pytest.approx(2)


# ---------------------------------------------------------------- Stanford-ORB


def test_orb_masks_shrink_by_two_pixels():
    mask = np.zeros((SIZE, SIZE))
    mask[5:15, 5:15] = 1
    inside = orb.eroded(mask)
    assert inside.sum() == 36 and inside[7:13, 7:13].all()


def test_orb_scale_undoes_a_factor_per_channel():
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.1, 0.9, (SIZE, SIZE, 3))
    scores = orb.orb_picture_scores(truth * [0.5, 2, 3], truth, np.ones((SIZE, SIZE)))
    assert scores["psnr_hdr"] == 100 and scores["psnr_ldr"] == 100
    assert scores["ssim"] == pytest.approx(1)
    np.testing.assert_allclose(orb.least_squares_scale([[0, 1, 2]], [[3, 3, 3]]), [3, 3, 1.5])


def test_orb_error_is_over_the_frame_and_never_worse_than_grey():
    mask = np.zeros((SIZE, SIZE))
    mask[:12] = 1  # eroded: 10 rows
    truth = flat(0.4, 0.4, 0.4)
    truth[:, ::2] = 0.6
    value, _, _ = orb.orb_psnr(flat(1, 1, 1), truth, orb.eroded(mask), tone_mapped=False)
    # the factor of a white picture is the mean: .5, as the grey picture; its error .01
    columns = orb.eroded(mask)[0]
    share = orb.eroded(mask).mean()
    mean = truth[0, columns, 0].mean()
    error = max(np.mean((truth[0, columns, 0] - mean) ** 2), 0) * share
    floor = np.mean((truth[0, columns, 0] - 0.5) ** 2) * share
    assert value == pytest.approx(-10 * np.log10(min(error, floor)))
    bad = np.zeros((SIZE, SIZE, 3))
    bad[:, 1::2] = 1.0  # the wrong columns
    worse, _, _ = orb.orb_psnr(bad, truth, orb.eroded(mask), tone_mapped=False)
    assert worse == pytest.approx(-10 * np.log10(floor))  # the floor


def test_orb_normals_and_shape():
    up, side = flat(0, 1, 0), flat(1, 0, 0)
    full = np.ones((SIZE, SIZE))
    assert orb.normal_cosine(up, side, full) == pytest.approx(1)
    assert orb.normal_cosine(2 * up, up, full) == pytest.approx(0, abs=1e-5)
    assert np.isnan(orb.normal_cosine(up, up, 0 * full))


# ---------------------------------------------------------------- by name


def test_an_unknown_protocol_is_refused(tmp_path):
    with pytest.raises(UserError, match="unknown protocol 'sdf'") as error:
        evaluate(tmp_path, tmp_path, protocol="sdf")
    assert error.value.code == EXIT_USAGE and all(p in str(error.value.fix) for p in PROTOCOLS)


@pytest.mark.parametrize("protocol", ["sfd", "samurai", "orb"])
def test_a_protocol_that_does_not_apply_says_so(tmp_path, protocol):
    (tmp_path / "test" / "diffuse_albedo").mkdir(parents=True)
    with pytest.raises(UserError, match="does not apply to a capture of kind 'flash'") as error:
        evaluate(tmp_path, tmp_path, protocol=protocol)
    assert "relit or pir" in error.value.fix


def test_every_paper_value_belongs_to_a_defined_figure():
    for papers, definitions in (
        (sfd.PAPERS["duplicates"], sfd.DEFINITIONS),
        (sfd.PAPERS["multiview"], sfd.DEFINITIONS),
        (pir.PAPERS["offset"], pir.DEFINITIONS),
        (pir.PAPERS["co-located"], pir.DEFINITIONS),
        (samurai.PAPERS, samurai.DEFINITIONS),
        (orb.PAPERS, orb.DEFINITIONS),
    ):
        assert set(papers) <= set(definitions)
