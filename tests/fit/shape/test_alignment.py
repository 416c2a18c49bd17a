"""Poses follow textures where labels mislead them, and labels alone where these are exact."""

from dataclasses import replace

import numpy as np
import pytest

from relit.conventions import linear_from_srgb, move_points, srgb_from_linear
from relit.fit.shape import alignment as joint_alignment
from relit.fit.shape.alignment import (
    EXACT,
    camera_after_motion,
    follow_views,
    projection,
    shift_quantile,
    solved,
    tangents,
    texture_rows,
    with_poses,
)
from relit.fit.shape.outlines import follow_with_poses, trace_rays
from relit.fit.shape.texture_shifts import (
    display_luminance,
    flow_weights,
    neighbouring_views,
    texture_shifts,
)
from relit.geometry.se3 import rotation_angle
from relit.reference.mitsuba_scene import build_geometry
from support.painted_lump import astray, camera_at, everywhere, lump, shown


@pytest.fixture(scope="module")
def seen():
    """(mesh, cameras, pictures, masks): six views of one lump, within 60 degrees of their
    neighbours."""
    mesh = lump()
    sides = [
        (1, 0, 0),
        (1, 0.5, 0.1),
        (0.8, 0.2, 0.6),
        (1, -0.5, 0.2),
        (0.9, 0.1, -0.5),
        (0.7, 0.6, 0.5),
    ]
    cameras = [camera_at(s, 0.9 * k) for k, s in enumerate(sides)]
    return mesh, cameras, *shown(mesh, cameras)


def apart(poses, cameras, mesh) -> float:
    """Pixels by which a place of the surface that one view truly sees is missed when another shows
    it, by these poses, root mean square over all pairs."""
    points = mesh.vertices[::10].astype(np.float64)
    placed = [
        move_points(p @ c.camera_from_world, points) for p, c in zip(poses, cameras, strict=True)
    ]
    found = [c.with_pose(p) for p, c in zip(poses, cameras, strict=True)]
    missed = [
        (f.project(x) - c.project(points))[:, :2]
        for n, (f, c) in enumerate(zip(found, cameras, strict=True))
        for x in placed[:n]
    ]
    return float(np.sqrt(np.square(missed).sum(-1).mean()))


def test_derivatives_are_those_of_the_projection(seen):
    mesh, cameras, *_ = seen
    points, camera, h = mesh.vertices[::100].astype(np.float64), cameras[1], 1e-6
    by_place, by_motion = projection(camera, points)
    for axis in range(3):
        moved = points + h * np.eye(3)[axis]
        np.testing.assert_allclose(
            (camera.project(moved) - camera.project(points))[:, :2] / h,
            by_place[..., axis],
            rtol=1e-4,
            atol=1e-2,
        )
    for axis in range(6):
        after = camera_after_motion(camera, h * np.eye(6)[axis])
        np.testing.assert_allclose(
            (after.project(points) - camera.project(points))[:, :2] / h,
            by_motion[..., axis],
            rtol=1e-4,
            atol=1e-2,
        )
    n = mesh.normals[::100].astype(np.float64)
    t = tangents(n)
    np.testing.assert_allclose(
        np.swapaxes(t, 1, 2) @ t, np.broadcast_to(np.eye(2), (len(n), 2, 2)), atol=1e-6
    )
    np.testing.assert_allclose((n[:, None] @ t)[:, 0], 0, atol=1e-6)


def test_pictures_lie_on_each_other_where_all_is_right(seen):
    mesh, cameras, pictures, masks = seen
    shifts = texture_shifts(mesh, cameras, pictures, masks)
    pairs = neighbouring_views(cameras)
    assert {(s.view, s.other) for s in shifts} == set(pairs) and shift_quantile(shifts) < 0.15
    assert len(pairs) >= 10 and len({frozenset(pair) for pair in pairs}) == len(pairs)  # each once
    assert len({first for first, _ in pairs}) == len(cameras)  # and each view is looked into
    assert shift_quantile([]) == 0


@pytest.mark.slow
def test_a_pose_is_asked_back_by_the_pixels_that_it_is_off(seen):
    """The shift is what the projection by the true pose says, in size and in sign, and so in both
    places of a pair."""
    mesh, cameras, pictures, masks = seen
    wrong = [astray(cameras[:1], 2.4, seed=4)[0], *cameras[1:]]
    shifts = texture_shifts(mesh, wrong, pictures, masks)
    mine = [s for s in shifts if s.view == 0]
    asked = np.concatenate(
        [(cameras[0].project(s.point) - wrong[0].project(s.point))[:, :2] for s in mine]
    )
    told = np.concatenate([s.shift for s in mine])
    assert len(mine) >= 4 and np.linalg.norm(asked, axis=1).mean() > 1.5
    assert np.corrcoef(asked.ravel(), told.ravel())[0, 1] > 0.85
    assert (
        0.5 < (told * asked).sum() / (asked * asked).sum() < 1.1
    )  # flow shrinks: rounds make up for it
    placed = wrong
    for _ in range(4):
        _, placed = solved(
            mesh,
            placed,
            texture_rows(texture_shifts(mesh, placed, pictures, masks), placed),
            still=True,
        )
    off = [
        rotation_angle(p.world_from_camera[:3, :3].T @ c.world_from_camera[:3, :3])
        for p, c in zip(placed, cameras, strict=True)
    ]
    assert max(off) < 0.6, "the one that was turned by 2.4 degrees is back, the others stay"


def test_a_mesh_that_is_too_thin_is_told_by_parallax(seen):
    """By the flow, and by the derivatives: what view j shows at a place is what its ray meets on
    the true surface, seen by view i."""
    mesh, cameras, pictures, masks = seen
    scene, depth = build_geometry(mesh), 0.01
    thin = replace(mesh, vertices=(mesh.vertices - depth * mesh.normals).astype(np.float32))
    shifts = texture_shifts(thin, cameras, pictures, masks)
    rows = texture_rows(shifts, cameras)
    truth, flow, told = [], [], []
    for s, x, y in zip(shifts, rows[::2], rows[1::2], strict=True):
        other = cameras[s.other]
        far = trace_rays(scene, other, *other.project(s.point)[:, :2].T)[0]
        ray = s.point - other.centre
        met = other.centre + ray * (far / np.linalg.norm(ray, axis=1))[:, None]
        use = np.isfinite(far) & (x.trust > 0)
        truth.append((cameras[s.view].project(met) - cameras[s.view].project(s.point))[use, :2])
        told.append(depth * np.stack([x.along.sum(1), y.along.sum(1)], -1)[use])
        flow.append(s.shift[use])
    truth, flow, told = (np.concatenate(some).ravel() for some in (truth, flow, told))
    assert np.abs(truth).mean() > 0.8
    assert np.corrcoef(truth, told)[0, 1] > 0.99 and 0.9 < truth @ told / (told @ told) < 1.1
    assert (
        np.corrcoef(truth, flow)[0, 1] > 0.85 and 0.5 < flow @ truth / (truth @ truth) < 1.1
    )  # flow shrinks: rounds make up for it
    found, _ = solved(thin, cameras, rows)
    assert ((found.vertices - thin.vertices) * mesh.normals).sum(1).mean() > 0


@pytest.mark.slow
def test_exact_labels_are_believed_alone(seen):
    mesh, cameras, pictures, masks = seen
    wrong = astray(cameras, 1.0)
    found, poses, off = follow_views(mesh, wrong, pictures, masks, everywhere(masks), 5)
    expected, alone = follow_with_poses(mesh, wrong, masks, everywhere(masks), 5)
    np.testing.assert_array_equal(poses, alone)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    assert off is None and apart(poses, cameras, mesh) < 0.5


@pytest.mark.slow
def test_labels_that_mislead_are_outvoted_by_textures(seen):
    """Labels moved by three pixels, each its own way."""
    mesh, cameras, pictures, masks = seen
    ways = [(3, 0), (-2, 2), (0, -3), (-3, 1), (2, 2), (1, -3)]
    wrong = [np.roll(m, (dy, dx), (0, 1)) for m, (dx, dy) in zip(masks, ways, strict=True)]
    _, alone = follow_with_poses(mesh, cameras, wrong, everywhere(masks), 5)
    found, poses, off = follow_views(mesh, cameras, pictures, wrong, everywhere(masks), 5)
    assert shift_quantile(texture_shifts(mesh, with_poses(cameras, alone), pictures, wrong)) > EXACT
    assert (
        shift_quantile(texture_shifts(found, with_poses(cameras, poses), pictures, wrong)) < EXACT
        and off[1] < EXACT < off[0]
    )
    assert apart(poses, cameras, mesh) < 0.5 * apart(alone, cameras, mesh)


def test_without_texture_outlines_are_followed_alone(seen):
    mesh, cameras, pictures, masks = seen
    plain = [np.full_like(p, 0.5) for p in pictures]
    assert texture_shifts(mesh, cameras, plain, masks) == []
    _, poses, off = follow_views(mesh, cameras, plain, masks, everywhere(masks), 2)
    np.testing.assert_array_equal(
        poses, follow_with_poses(mesh, cameras, masks, everywhere(masks), 2)[1]
    )
    assert off is None


@pytest.mark.slow
@pytest.mark.parametrize("left", [1, 3])
def test_where_textures_cease_to_tell_outlines_are_followed_alone(seen, monkeypatch, left):
    """After one look at them, or in the midst of the rounds, no pair shares enough."""
    mesh, cameras, pictures, masks = seen
    ways = [(3, 0), (-2, 2), (0, -3), (-3, 1), (2, 2), (1, -3)]
    wrong = [np.roll(m, (dy, dx), (0, 1)) for m, (dx, dy) in zip(masks, ways, strict=True)]
    looks = []

    def looked(*given):
        looks.append(1)
        return texture_shifts(*given) if len(looks) <= left else []

    monkeypatch.setattr(joint_alignment, "texture_shifts", looked)
    _, poses, off = follow_views(mesh, cameras, pictures, wrong, everywhere(masks), 2)
    np.testing.assert_array_equal(
        poses, follow_with_poses(mesh, cameras, wrong, everywhere(masks), 2)[1]
    )
    assert off is None and len(looks) > left


def test_colour_tells_where_brightness_does_not(seen):
    """Red and blue change, what a display shows of the three together does not."""
    mesh, cameras, pictures, masks = seen
    even = []
    for picture in pictures:
        shown = srgb_from_linear(np.clip(picture, 0, 1))
        red = 0.5 + (shown[..., 0] - shown[..., 1])
        even.append(
            linear_from_srgb(np.stack([red, np.full_like(red, 0.5), 1.0 - red], -1)).astype(
                np.float32
            )
        )
    assert np.ptp(display_luminance(even[0])) < 1e-5
    wrong = [astray(cameras[:1], 2.0, seed=4)[0], *cameras[1:]]
    shifts = texture_shifts(mesh, wrong, even, masks)
    mine = [s for s in shifts if s.view == 0]
    asked = np.concatenate(
        [(cameras[0].project(s.point) - wrong[0].project(s.point))[:, :2] for s in mine]
    )
    told = np.concatenate([s.shift for s in mine])
    assert len(mine) >= 4 and np.corrcoef(asked.ravel(), told.ravel())[0, 1] > 0.8


def test_places_count_by_their_structure(seen):
    """Half of the places have ten times the structure of the others: what these say hardly
    matters."""
    mesh, cameras, pictures, masks = seen
    one = texture_shifts(mesh, cameras, pictures, masks)[0]
    clear = np.arange(len(one.shift)) % 2 == 0
    some = replace(
        one,
        structure=np.where(clear, 0.1, 0.01),
        shift=np.where(clear[:, None], [[1.0, 0.0]], [[0.0, 9.0]]),
    )
    (share,) = flow_weights([some])
    assert share[clear].min() > 50 * share[~clear].max() and np.average(
        share, weights=share
    ) == pytest.approx(1.0)
    assert shift_quantile([some]) == 1.0


@pytest.mark.slow
def test_a_shape_that_is_wrong_bends_until_textures_agree():
    """Of views from all around, with poses that are off too: labels alone do not mend it."""
    mesh = lump()
    sides = np.array(
        [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        + [(0, 0, 1.0), (0, 0.1, -1), (1, 0, 0), (-1, 0, 0.1)]
    )
    cameras = [camera_at(s, 0.9 * k) for k, s in enumerate(sides)]
    pictures, masks = shown(mesh, cameras)
    v = mesh.vertices.astype(np.float64)
    bulge = 1 + 0.25 * np.sin(6 * v[:, :1]) * np.cos(5 * v[:, 2:])
    wrong = replace(mesh, vertices=(v * bulge).astype(np.float32))
    placed = astray(cameras, 4.0)
    ends = [
        follow_with_poses(wrong, placed, masks, everywhere(masks), 5),
        follow_views(wrong, placed, pictures, masks, everywhere(masks), 5)[:2],
    ]
    (labels, before), (both, after) = (
        (
            apart(poses, cameras, mesh),
            shift_quantile(texture_shifts(found, with_poses(cameras, poses), pictures, masks)),
        )
        for found, poses in ends
    )
    assert before > EXACT > 2 * after and both < 0.6 * labels


def test_most_textures_alone_are_not_believed_where_some_are_left_far_off(seen, monkeypatch):
    """A wrong shape whose poses bend until most of the textures agree: it begins again from where
    labels have left it."""
    mesh, cameras, pictures, masks = seen
    one = texture_shifts(mesh, cameras, pictures, masks)[0]
    some = np.arange(len(one.shift)) % 4 == 0
    left = replace(
        one,
        structure=np.ones_like(one.structure),
        shift=np.where(some[:, None], [[2.0, 0.0]], [[0.1, 0.0]]),
    )
    before = replace(left, shift=np.full_like(one.shift, 5.0))
    assert shift_quantile([left]) == pytest.approx(0.1) and shift_quantile(
        [left], 0.9
    ) == pytest.approx(2.0)
    begun = []
    monkeypatch.setattr(joint_alignment, "texture_shifts", lambda *_: [before])
    monkeypatch.setattr(
        joint_alignment,
        "by_both",
        lambda mesh, placed, shifts, *rest: begun.append(shifts) or (mesh, placed, shifts),
    )
    for alone in (left, replace(left, shift=np.full_like(one.shift, 0.1))):
        monkeypatch.setattr(
            joint_alignment, "by_textures", lambda mesh, placed, *_, alone=alone: (placed, [alone])
        )
        follow_views(mesh, cameras, pictures, masks, everywhere(masks), 1)
    assert begun[0][0] is before and begun[1][0] is not before
