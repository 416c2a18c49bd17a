"""Two solutions for the poses of a collection: what the photos bear out is kept, whatever found it,
and a result that all evidence contradicts is refused."""

from dataclasses import replace

import numpy as np
import pytest

from relit.cameras.links import Group
from relit.conventions import similarity
from relit.errors import UserError
from relit.fit.collection.options import CollectionOptions
from relit.fit.collection.photo_poses import PoseEvidence, find_all, supported
from relit.fit.collection.photos import CollectionPhoto, PhotoSet, collection_crops
from relit.fit.collection.verdict import check_borne_out, contradictions
from relit.geometry.se3 import camera_errors, exp_so3, look_at
from relit.recipe import FitContext
from relit.reference.mitsuba_scene import build_scene, render
from relit.run import Run
from relit.scene import Camera, Photo
from relit.synthesize.procedural import pawn

COUNT, SIDE, FOCAL = 12, 80, 100.0


@pytest.fixture(scope="module")
def photos(device):
    """Photos of a figure from all around, with hints 15 degrees off, and their true poses."""
    mesh, material = pawn(rows=24, columns=36, texture=64)
    middle = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
    scale = 0.8 / np.linalg.norm(mesh.vertices - middle, axis=1).max()
    light = np.full((8, 16, 3), 0.6, np.float32)
    light[2:4, 3:6] = 6.0
    placed = similarity(np.eye(3), -middle * scale, scale)
    scene = build_scene(mesh, material, placed, light)
    rng, shots, truth = np.random.default_rng(0), [], []
    for k in range(COUNT):
        angle = 2 * np.pi * k / COUNT
        eye = 3.2 * np.array([np.sin(angle), 0.5 * np.cos(3 * angle), np.cos(angle)])
        camera = Camera(SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, look_at(eye))
        picture = render(scene, camera, spp=24, seed=k)
        rgb = picture[..., :3] / np.maximum(picture[..., 3:], 1e-3)
        hint = exp_so3(np.radians(15) * rng.normal(size=3) / np.sqrt(3)) @ eye
        shots.append(
            CollectionPhoto(
                Photo(f"{k}.png", None, SIDE, SIDE),
                (rgb * (picture[..., 3:] > 0.5)).astype(np.float32),
                np.clip(picture[..., 3], 0, 1).astype(np.float32),
                replace(camera, world_from_camera=np.eye(4)),
                hint / np.linalg.norm(hint),
            )
        )
        truth.append(camera.world_from_camera)
    return PhotoSet(shots, [], 45.0), np.array(truth)


def group_at(poses) -> Group:
    """As matching would give it: all photos linked, at these poses."""
    count = len(poses)
    focals = np.full(count, FOCAL / SIDE)
    return Group(np.arange(count), np.array(poses), focals, np.zeros((0, 3)), np.zeros(0, int))


OPTIONS = CollectionOptions(rounds=2, keep=1, polish=0)


def found(photos, group, folder):
    with Run.open(folder, {}) as run:
        poses = find_all(photos, [group], FitContext(run, OPTIONS, 0))
        return poses, (run.folder / "log.txt").read_text()


@pytest.mark.slow
def test_wrong_links_do_not_win_against_the_search(photos, tmp_path):
    shots, truth = photos
    wrong = truth.copy()  # every other photo turned about the object, as where sides look alike
    wrong[::2] = similarity(exp_so3(np.array([0, np.radians(55), 0])), np.zeros(3)) @ truth[::2]
    best, said = found(shots, group_at(wrong), tmp_path / "run")
    assert "poses from matches" in said and best.source == "search" and best.margin > 0
    assert np.median(camera_errors(best.poses, truth)[0]) < 12, said


@pytest.mark.slow
def test_right_links_have_evidence(photos, tmp_path):
    """More than the same photos at wrong poses, so that these cannot win."""
    shots, truth = photos
    wrong = truth[np.random.default_rng(1).permutation(COUNT)]
    crops, none = collection_crops(shots.shots), np.zeros(COUNT, bool)
    with Run.open(tmp_path, {}) as run:
        fit = FitContext(run, OPTIONS, 0)
        right, other = (
            supported("matches", shots.shots, crops, (poses, np.full(COUNT, 0.95), none), fit)
            for poses in (truth, wrong)
        )
    assert right.evidence.total > other.evidence.total + 0.3


def test_evidence_adds_up_what_was_measured():
    none = float("nan")
    assert PoseEvidence(0.9, 0.8, 0.5, 0.7).total == pytest.approx(2.2)
    assert PoseEvidence(0.9, none, 0.5, 0.7).total == pytest.approx(1.4)
    assert PoseEvidence(0.9, 0.8, 0.4, 0.8).clear and not PoseEvidence(0.9, none, 0.4, 1.0).clear


def test_a_result_that_all_evidence_contradicts_is_refused(photos, tmp_path):
    shots, truth = photos
    right = [s.camera.with_pose(p) for s, p in zip(shots.shots, truth, strict=True)]
    wrong = [right[(k + COUNT // 3) % COUNT] for k in range(COUNT)]
    against, kinds = contradictions(shots, right, 0.3, 0.1)
    assert kinds == 3 and len(against) == 2  # the hints agree
    assert len(contradictions(shots, wrong, 0.3, 0.1)[0]) == 3
    assert contradictions(shots, wrong, float("nan"), 0.1)[1] == 2
    with Run.open(tmp_path / "run", {}) as run:
        check_borne_out(shots, right, 0.3, 0.1, run)
        check_borne_out(shots, wrong, 0.9, 0.1, run)
        with pytest.raises(UserError, match="contradict the camera poses") as raised:
            check_borne_out(shots, wrong, 0.3, 0.1, run)
        assert raised.value.code == 4 and "--force" in raised.value.fix
        run.force = True
        check_borne_out(shots, wrong, 0.3, 0.1, run)
