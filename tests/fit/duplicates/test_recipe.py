"""The recipe from a rendered pile to its figures, at a size at which it only runs through: true
poses stand in for the search."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from relit.asset.asset import load_asset, save_asset
from relit.asset.gltf import write_glb
from relit.capture.open import open_capture
from relit.conventions import move_points, similarity
from relit.errors import UserError
from relit.evaluate.dispatch import evaluate
from relit.evaluate.registration import evaluate_registration
from relit.fit.duplicates import pose_passes, recipe, shape
from relit.fit.duplicates import poses as poses_stage
from relit.fit.duplicates import recover_unregistered as found_again
from relit.fit.duplicates.mirrored_silhouettes import Symmetry
from relit.fit.registration.instances import outliers as odd
from relit.fit.registration.instances.left_out import LeftOut
from relit.fit.registration.instances.views import ViewId
from relit.fit.registration.placements import all_placed
from relit.geometry.sdf import node_positions
from relit.geometry.se3 import exp_so3, rotation_angle
from relit.geometry.symmetry import Plane
from relit.images import write_linear
from relit.recipe import FitContext
from relit.records import from_arrays, to_arrays
from relit.run import Run, StageReached
from relit.scene import Mesh
from relit.synthesize.duplicates import RADIUS, heap, synthesize_duplicates
from relit.synthesize.procedural import pawn
from support.pile_of_pawns import SIZES, small_options, true_poses


@pytest.mark.slow
def test_a_pile_is_synthesized_once_and_never_with_other_settings(pile):
    folder = pile.parent
    files = folder / "pawn.glb", folder / "light.exr", pile
    relights = [folder / "light.exr"]
    assert synthesize_duplicates(*files, relights=relights, **SIZES) == pile
    with pytest.raises(UserError, match="other settings"):
        synthesize_duplicates(*files, **{**SIZES, "count": 5})


def stand_in(monkeypatch, poses, unsure=0.0):
    """Let the search of the poses return these, the first of them being ambiguous by `unsure`
    degrees."""
    monkeypatch.setattr(
        poses_stage,
        "place_few",
        lambda views, search, **_: all_placed(poses, np.full(len(views), 0.95)),
    )
    monkeypatch.setattr(
        poses_stage,
        "leave_out",
        lambda views, *_, **__: LeftOut(
            np.full(len(views), 0.95),
            np.full(len(views), 0.9),
            np.array([0.95 if unsure else 0.5] + [0.5] * (len(views) - 1)),
            np.array([unsure] + [0.0] * (len(views) - 1)),
        ),
    )


def middle_of_pawn():
    vertices = pawn(rows=16, columns=20, texture=32)[0].vertices
    return (vertices.min(0) + vertices.max(0)) / 2


def test_objects_of_a_heap_stand_on_the_ground_and_hardly_in_one_another():
    mesh, _ = pawn(rows=16, columns=20, texture=32)
    poses, reach = heap(mesh, 6, 0, 12.0, 1.0)
    again, _ = heap(mesh, 6, 0, 12.0, 1.0)
    assert np.allclose(poses, again)
    lowest = [move_points(p, mesh.vertices)[:, 1].min() for p in poses]
    assert min(lowest) == pytest.approx(0, abs=0.1) and min(lowest) > -0.05
    assert all(np.linalg.norm(p[[0, 2], 3]) < reach + 1.0 for p in poses)


def test_objects_of_a_heap_lie_on_one_another():
    from scipy.spatial import cKDTree

    mesh, _ = pawn(rows=40, columns=60, texture=32)
    poses, _ = heap(mesh, 5, 1, 12.0, 0.1)  # all at one place
    placed = [move_points(p, mesh.vertices) for p in poses]
    gaps = [
        min(cKDTree(q).query(p)[0].min() for q in placed[:k])
        for k, p in enumerate(placed)
        if p[:, 1].min() > 0.1
    ]
    assert (
        len(gaps) >= 3 and max(gaps) < 0.06 * RADIUS
    )  # a tenth and more on a height field of a third of the detail


def said_of_sides(*degrees) -> list[str]:
    """What is said of objects, labels 1, 2, ..., that are seen from so many degrees around an
    axis."""
    said, turns = [], [exp_so3(np.array([0, np.radians(a), 0])) for a in degrees]
    views = [SimpleNamespace(label=k + 1, photo=0) for k in range(len(turns))]
    poses_stage.say_groups(
        views,
        np.array([similarity(t, t @ [0, 0, -5.0]) for t in turns]),
        SimpleNamespace(say=said.append),
    )
    return said


def test_sides_that_others_lie_between_are_no_groups():
    assert not said_of_sides(0, 20, 40, 60)
    assert not said_of_sides(0, 0, 40, 80, 120, 160)  # opposite sides, and others between
    assert not said_of_sides(0, 70, 140)


def test_two_groups_of_sides_that_share_nothing_are_said():
    said = said_of_sides(0, 160, 10, 170, 20)
    assert (
        len(said) == 1
        and "labels 1, 3, 5 and labels 2, 4 " in said[0]
        and "140 degrees apart" in said[0]
    )


def test_without_the_search_one_set_that_matches_hold_together_is_left():
    told = ((0, 3, None), (3, 4, None), (1, 2, None))
    assert poses_stage.linked_together(6, told).tolist() == [True, False, False, True, True, False]
    assert not poses_stage.linked_together(3, ()).any()


@pytest.mark.slow
def test_poses_alone_are_measured_after_the_stage_that_finds_them(pile, tmp_path, monkeypatch):
    stand_in(monkeypatch, true_poses(pile))
    options = replace(recipe.options_for("draft"), side=64)
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        run.until = "poses"
        with pytest.raises(StageReached, match="poses"):
            recipe.reconstruct(open_capture(pile), run, options, 0)
    assert {s["name"] for s in run.stages()} == {"poses"}
    got = {k: v["value"] for k, v in evaluate_registration(run.folder, pile)["metrics"].items()}
    assert got["rotation_median"] < 1 and got["wrong"] == got["wrong_sure"] == 0
    assert got["determined_sure"] == 100 and got["stated_wrong"] < 10


@pytest.mark.slow
def test_from_photo_to_figures(pile, tmp_path, monkeypatch):
    stand_in(monkeypatch, true_poses(pile), unsure=90.0)
    capture = open_capture(pile)
    assert capture.kind == "duplicates" and len(np.unique(capture.photos[0].load().labels)) == 5
    small = {
        "levels": (24,),
        "level_steps": (12,),
        "rays": 512,
        "faces": 800,
        "texture": 32,
        "surface_steps": 4,
        "points": 128,
    }
    options = replace(recipe.options_for("draft"), **small, directions=8, light=8, side=64)
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        asset = recipe.reconstruct(capture, run, options, 0)
        resumed = recipe.reconstruct(capture, run, options, 0)
    assert np.allclose(asset.mesh.vertices, resumed.mesh.vertices)
    assert len(asset.instances) == 4 and all(i.registered for i in asset.instances)
    chances = [i.chance_wrong for i in asset.instances]
    assert chances[0] > 0.5 > max(chances[1:])
    assert "1 of 4 poses are uncertain" in (run.folder / "log.txt").read_text()
    assert [bool(i.reason) for i in asset.instances] == [
        True,
        False,
        False,
        False,
    ] and "90 degrees" in asset.instances[0].reason
    assert asset.ground is not None and asset.ground.normal[1] > 0.9  # the truth's ground is y = 0
    save_asset(tmp_path / "run" / "asset", asset)
    metrics = evaluate(tmp_path / "run", pile, spp=4)["metrics"]
    assert metrics["rotation_before"]["value"] < 0.01 and metrics["rotation_median"]["value"] < 5
    assert metrics["registered"]["value"] == 100 and metrics["translation_median"]["value"] < 0.6
    assert metrics["chamfer"]["value"] < 0.1 and metrics["photo_psnr"]["value"] > 8
    for name in ("albedo_psnr", "relit_psnr", "novel_psnr", "roughness_mse", "environment_mse"):
        assert np.isfinite(metrics[name]["value"])
    assert (tmp_path / "run" / "asset" / "scene.glb").is_file() and load_asset(
        tmp_path / "run"
    ).ground is not None
    # the same photo without its truth, SfD's poses beside it
    real = tmp_path / "real"
    shutil.copytree(pile, real, ignore=shutil.ignore_patterns("truth"))
    told = evaluate(tmp_path / "run", real, spp=4)["metrics"]
    assert {name.split("_")[0] for name in told} == {"photo"}
    assert told["photo_psnr"]["value"] == pytest.approx(metrics["photo_psnr"]["value"], abs=0.01)
    listed = {
        f"{k:03d}": i["world_from_object"]
        for k, i in enumerate(json.loads((pile / "truth" / "truth.json").read_text())["instances"])
    }
    (real / "object_pred_pose.json").write_text(json.dumps(listed))
    (real / "object_scale_matrix.json").write_text(
        json.dumps({"scale_matrix": similarity(np.eye(3), middle_of_pawn()).tolist()})
    )
    told = evaluate(tmp_path / "run", real, spp=4)["metrics"]
    for name in ("rotation_median", "rotation_pairs", "registered", "rotation_before"):
        assert told[name]["value"] == pytest.approx(metrics[name]["value"], abs=1e-6)


@pytest.mark.slow
def test_what_a_wrongly_placed_instance_shows_stands_out(pile, tmp_path):
    capture, options = open_capture(pile), small_options()
    shots = [(p.load(), p.camera.with_pose(np.eye(4))) for p in capture.photos]
    views, poses = poses_stage.all_views(shots, options.side, options), true_poses(pile)
    wrong = poses.copy()
    wrong[2] = similarity(exp_so3(np.radians([110.0, 0, 0])), np.zeros(3)) @ poses[2]
    errors = []
    for some, name in ((poses, "right"), (wrong, "wrong")):
        with (
            Run.open(tmp_path / name, {}) as run,
            run.stage("volume", steps=60, title="volume") as stage,
        ):
            model, bank, _ = pose_passes.shape_and_poses(views, some, run, stage, options, 0)
            errors.append(odd.view_errors(bank, model))
    assert errors[0].max() < 1.3 * np.median(errors[0])
    assert (
        errors[1][2] > 1.3 * np.delete(errors[1], 2).max()
    )  # of four in a short fit, the others suffer too


def test_poses_wait_for_the_coarse_level_and_distances_move_on_the_middle_one(
    pile, tmp_path, monkeypatch
):
    capture, options = (
        open_capture(pile),
        small_options(levels=(16, 24, 32), level_steps=(6, 6, 6), rays=256),
    )
    shots = [(p.load(), p.camera.with_pose(np.eye(4))) for p in capture.photos]
    views, poses = poses_stage.all_views(shots, options.side, options), true_poses(pile)
    seen, fit = [], pose_passes.fit_volume

    def watched(bank, model, o, stage, seed, begin_level):
        def begin(model):
            begin_level(model)
            seen.append(
                (
                    bank.corrections.numbers,
                    np.array(model.correction_ratios).reshape(-1, 8),
                )
            )

        return fit(bank, model, o, stage, seed, begin)

    with (
        Run.open(tmp_path / "still", {}) as run,
        run.stage("volume", steps=18, title="volume") as stage,
    ):
        assert np.allclose(
            pose_passes.shape_and_poses(views, poses, run, stage, options, 0, still=True)[2],
            poses,
            atol=1e-6,
        )
    monkeypatch.setattr(pose_passes, "fit_volume", watched)
    with (
        Run.open(tmp_path / "run", {}) as run,
        run.stage("volume", steps=18, title="volume") as stage,
    ):
        _, bank, _ = pose_passes.shape_and_poses(views, poses, run, stage, options, 0)
    last = bank.corrections.numbers
    (coarse, rates), (middle, then) = seen
    assert (
        not coarse.any() and middle[:, :3].any() and middle[:, 7].any()
    )  # nothing moves on the coarse grid
    assert (rates[:, 7] == 1).all() and (then[:, 7] == 0).all() and (then[:, :6] == 1).all()
    assert not np.array_equal(last[:, :3], middle[:, :3])
    own = [
        c[:, 7] - c[:, 7].mean() for c in (middle, last)
    ]  # what all do in common is taken out of them at every step
    assert np.allclose(*own, atol=1e-6)


def test_the_shape_is_built_again_where_the_poses_are_now(pile, tmp_path):
    """On the middle level, and so that the silhouettes at those poses, and not at others, are its
    own."""
    capture, options = (
        open_capture(pile),
        small_options(levels=(16, 32, 48), level_steps=(40, 60, 0), rays=1024),
    )
    shots = [(p.load(), p.camera.with_pose(np.eye(4))) for p in capture.photos]
    views, poses = poses_stage.all_views(shots, options.side, options), true_poses(pile)
    with Run.open(tmp_path / "run", {}) as run:
        values = shape.built_again(views, poses, None, run, options, 0)
    assert values.shape == (32, 32, 32)
    inside = node_positions(32).reshape(-1, 3)[values.ravel() < 0]
    wrong = np.array(
        [similarity(exp_so3(np.radians([0, 0, 90.0])), np.zeros(3)) @ p for p in poses]
    )

    def beside(some):
        """Share of what is inside that a view shows as background."""
        shares = []
        for view, pose in zip(views, some, strict=True):
            x, y, _ = view.camera.with_pose(pose).project(inside).T.astype(int)
            h, w = view.mask.shape
            away = (x < 0) | (y < 0) | (x >= w) | (y >= h)  # windows hold all of the object
            x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
            shares.append((away | ((view.mask[y, x] < 0.5) & (view.known[y, x] > 0.5))).mean())
        return np.mean(shares)

    assert beside(poses) < 0.1 and beside(wrong) > 0.3


def test_odd_instances_are_few_among_many():
    def found(errors):
        return np.flatnonzero(odd.odd_instances(np.array(errors))).tolist()

    assert found([1, 1.2, 0.9, 1.7, 1.1, 6.3, 1, 1]) == [5]
    assert found([1, 1.2, 0.9, 1.7, 1.1, 1.6, 1, 1]) == []
    assert found([1, 1.2, 1.1, 6.3, 1, 1]) == []  # too few to tell
    assert found([1, 1, 1, 1, 1, 1, 6.3, 7]) == []  # so many that the model itself is in doubt
    assert found([1, np.nan, 1.1, 1, 1, 0.9, 1, 1]) == []


@pytest.mark.slow
def test_odd_instances_are_left_out_and_said(pile, tmp_path, monkeypatch):
    stand_in(monkeypatch, true_poses(pile))
    calls = []

    def third(errors):
        calls.append(len(errors))
        return np.arange(len(errors)) == 2

    monkeypatch.setattr(pose_passes, "odd_instances", third)
    monkeypatch.setattr(found_again, "sought_again", lambda *_, **__: (None, False))
    capture, options = open_capture(pile), small_options(level_steps=(12,))
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        asset = recipe.reconstruct(capture, run, options, 0)
        assert calls == [4]  # those that are left are not asked again
        assert [i.registered for i in asset.instances].count(False) == 1 and len(
            asset.instances
        ) == 4
        assert all("agrees too little" in i.reason for i in asset.instances if not i.registered)
        assert run.done("joint")
        for stage in (
            "volume",
            "mesh",
            "surface",
        ):  # stopped in the second pass: what was found in the first stays
            (run.folder / "stages" / stage / "DONE").unlink()
        again = recipe.reconstruct(capture, run, options, 0)
    assert calls == [4] and [i.label for i in again.instances] == [i.label for i in asset.instances]
    assert "does not agree with the model of all" in (run.folder / "log.txt").read_text()


def told_passes(monkeypatch, asked: list, *told: dict):
    """What `joint_stages` makes of passes that turn all by a degree, are as `told` (fields of
    Pass), and say that b is odd."""
    asked.clear()

    def stage(views, poses, task, fit):
        names, number, last = [v.id for v in views], task.number, task.last
        asked.append(
            "".join(names)
            + ("?" + "".join(v.id for v in task.seek()) if task.seek else "")
            + "." * task.final
        )
        assert (last and last.symmetry) == (number or None)  # the pass before
        odd = np.array([name == "b" for name in names])
        fields = {"errors": np.ones(len(names)), "turn": 2.0, "off": 3.0, **told[number]}
        if "found" in fields:
            found = fields.pop("found")
            fields |= {"joining": tuple(found), "joining_poses": np.array([*found.values()])}
        return pose_passes.Pass(
            poses + np.where(odd, 0, 1)[:, None, None], odd, symmetry=number + 1, **fields
        )

    monkeypatch.setattr(pose_passes, "joint_stage", stage)
    some = [SimpleNamespace(id=name) for name in "abcde"]
    say = SimpleNamespace(say=lambda text: asked.append(text))
    views, *rest = pose_passes.joint_stages(
        some[:3], np.zeros((3, 4, 4)), some[3:], lambda left: left, FitContext(say, None, 0)
    )
    return "".join(v.id for v in views), *rest


def test_passes_for_the_poses_are_made_until_they_have_arrived(monkeypatch):
    """Who is left out of one pass is not in the next; at most PASSES are made. Poses that textures
    had to lead back are to stay then."""
    asked = []

    def passes(*told: tuple):
        """(poses, odd, arrived, the last pass), asked for passes which turn all by so many degrees,
        and leave textures so far off; whether some were half a turn off then, and whether
        silhouettes bound one side only."""
        names = ("turn", "off", "mixed", "one_sided")
        return told_passes(
            monkeypatch, asked, *(dict(zip(names, one, strict=False)) for one in told)
        )[1:]

    poses, odd, arrived, last = passes((2, 3.0), (2, 2.0), (0.1, 1.5))
    assert asked == ["abc?de", "ac?de", "ac?de"]
    assert odd.tolist() == [False, True, False] and poses[:, 0, 0].tolist() == [3, 0, 3]
    assert arrived and last.symmetry == 3 and not last.exact
    assert not passes((2, 3.0), (2, None))[2] and len(asked) == 2, "labels and textures agree"
    _, _, arrived, last = passes((2, 3.0), (2, 0.2))
    assert arrived and last.exact and len(asked) == 2, "textures lie on one another"
    _, _, arrived, last = passes((2, 0.2, False, True), (2, 0.2, False, False))
    assert arrived and last.symmetry == 2, "silhouettes bounded it from one side only"
    assert passes((0.1, 0.2, False, True))[2] and len(asked) == 1, "it has not moved"
    assert passes((2, 0.6), (2, 0.55))[2] and len(asked) == 2, "textures come no closer"
    assert passes((2.4, 0.32), (0.8, 0.28), (0.4, 0.17))[2] and len(asked) == 3, (
        "an eighth closer is still on the way"
    )
    assert passes((0.1, 0.2, True), (2, 0.3), (2, 0.2))[2] and len(asked) == 3, (
        "what was mixed tells nothing of what follows"
    )
    assert (
        not passes((2, 3.0), (2, 2.0), (2, 1.0), (2, 0.5))[2] and len(asked) == pose_passes.PASSES
    ), "still on their way"


def test_who_is_found_in_the_last_pass_takes_part_in_more(monkeypatch):
    asked, there, also = [], {"e": np.full((4, 4), 7.0)}, {"d": np.full((4, 4), 5.0)}
    views, poses, odd, arrived, last = told_passes(
        monkeypatch, asked, {"off": None, "found": there}, {"off": 2.0}, {"off": 0.2}
    )
    assert asked == ["abc?de", "ace?d", "ace?d"] and views == "abce"
    assert (
        poses[:, 0, 0].tolist() == [3, 0, 3, 9]
        and odd.tolist() == [False, True, False, False]
        and arrived
        and last.symmetry == 3
    )
    views, poses, *_ = told_passes(
        monkeypatch, asked, {"off": 0.2, "found": there}, {"off": 0.2, "found": also}, {"off": 0.2}
    )
    assert (
        asked == ["abc?de", "ace?d", "aced"]
        and views == "abced"
        and poses[:, 0, 0].tolist() == [3, 0, 3, 9, 6]
    )
    for errors, stays in ((1.05, True), (1.2, False)):
        after = {"off": None, "errors": np.array([errors, errors, 5.0 - 4 * errors])}
        views, poses, odd, arrived, last = told_passes(
            monkeypatch, asked, {"off": 0.2, "found": there}, after
        )
        assert views == ("abce" if stays else "abc") and len(odd) == len(poses) == len(views)
        assert (arrived, last.symmetry, poses[0, 0, 0]) == (
            (False, 2, 2) if stays else (True, 1, 1)
        )
        assert asked[2:] == (
            [] if stays else ["the others agree less for it: all is as it was before"]
        )
    ways = [{"off": 4000 * 0.5**k} for k in range(8)]
    ways[3]["found"] = there
    assert told_passes(monkeypatch, asked, *ways)[0] == "abce", "still on their way"
    assert asked == ["abc?de", *["ac?de"] * 2, "ac?de.", *["ace?d"] * 3, "ace."], (
        "nobody is sought where no pass would follow"
    )


def test_a_pass_is_kept_whole():
    mesh = Mesh(*(np.ones((3, 3), t) for t in (np.float32, np.int32, np.float32)))
    one = pose_passes.Pass(
        np.ones((2, 4, 4)),
        np.array([True, False]),
        np.array([0.1, 0.2]),
        1.5,
        None,
        Symmetry(Plane(np.array([1.0, 0, 0]), 0.2), mesh),
        True,
        True,
        (ViewId(1, 7),),
        np.eye(4)[None],
        np.zeros((2, 2, 2)),
    )
    again = from_arrays(pose_passes.Pass, to_arrays(one))
    assert again.off is None and again.mixed and again.one_sided and again.turn == 1.5
    assert again.symmetry.plane.offset == 0.2 and np.array_equal(again.errors, one.errors)
    assert np.array_equal(again.found[ViewId(1, 7)], np.eye(4)) and len(again.found) == 1


def test_who_joins_is_sought_where_few_are_left_out(monkeypatch):
    asked, said = [], []

    def sought(view, *, guess):
        asked.append(view.id)
        return {1: (np.eye(4), True), 2: (np.eye(4), False), 3: (None, False)}[view.id]

    def joined(count, *keys, axis=None, without=()):
        asked.clear()
        monkeypatch.setattr(found_again, "seeker", lambda *_: sought)
        monkeypatch.setattr(found_again, "body_axis", lambda mesh: axis)
        others = [SimpleNamespace(id=k, label=k, photo=0) for k in keys]
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, 0, 3] = np.arange(count)
        after = poses + np.eye(4)[3] * np.array([[2.0], [0], [0], [0]])
        options = replace(recipe.options_for("standard"), without=without)
        how = {"run": SimpleNamespace(say=said.append), "options": options, "seed": 0}
        return found_again.joiners(others, ["a view"] * count, poses, after, None, None, 0.1, **how)

    found = joined(12, 1, 2, 3)
    assert asked == [1, 2, 3] and list(found) == [1, 2] and found[1][0, 3] == 2, (
        "in the frame that poses have after the pass"
    )
    assert "label 1 was found" in said[0] and "label 2 may have been found" in said[1]
    for few in (
        (7, 1),
        (9, 1, 2, 3),
        (20, 1),
    ):  # too few tell who is odd; so many could not be told; so many need nobody
        assert joined(*few) == {} and asked == []
    assert (
        joined(12, 1, axis="an axis") == {}
        and joined(12, 1, without=("search",)) == {}
        and asked == []
    )


@pytest.mark.slow
def test_two_photos_of_one_pile(tmp_path, monkeypatch):
    write_glb(tmp_path / "pawn.glb", *pawn(rows=12, columns=16, texture=16))
    write_linear(tmp_path / "light.exr", np.full((8, 16, 3), 0.7, np.float32))
    sizes = {
        "count": 3,
        "photos": 2,
        "resolution": 80,
        "test_resolution": 16,
        "spp": 4,
        "test_spp": 4,
        "test_views": 1,
    }
    pile = synthesize_duplicates(
        tmp_path / "pawn.glb", tmp_path / "light.exr", tmp_path / "capture", **sizes
    )
    capture = open_capture(pile)
    assert len(capture.photos) == 2
    told = np.concatenate([true_poses(pile, 0), true_poses(pile, 1)])
    stand_in(monkeypatch, told)
    small = {
        "levels": (24,),
        "level_steps": (6,),
        "rays": 256,
        "faces": 500,
        "texture": 32,
        "surface_steps": 2,
        "points": 64,
    }
    options = replace(recipe.options_for("draft"), **small, directions=8, light=8, side=48)
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        asset = recipe.reconstruct(capture, run, options, 0)
        log = (run.folder / "log.txt").read_text()
    assert [i.label for i in asset.instances] == [85, 170, 255] and all(
        i.registered for i in asset.instances
    )
    assert "begins as metal" in log
    assert "photo 2 is turned by 35 degrees" in log and "3 instances in 2 photos" in log
    (_, first), (_, second) = asset.cameras
    true = [p.camera.world_from_camera for p in capture.photos]
    assert np.allclose(first.world_from_camera, true[0])
    wanted = true[0][:3, :3].T @ true[1][:3, :3]
    assert (
        rotation_angle(
            (first.world_from_camera[:3, :3].T @ second.world_from_camera[:3, :3]).T @ wanted
        )
        < 4
    )


@pytest.mark.slow
def test_one_object_in_several_photos_runs_and_says_what_it_is(pile, tmp_path, monkeypatch):
    capture = open_capture(pile)
    photo = capture.photos[0]
    pixels = photo.load()
    label = int(np.unique(pixels.labels[pixels.labels > 0])[0])
    alone = replace(
        photo,
        load=lambda: replace(
            pixels, labels=np.where(pixels.labels == label, label, 0).astype(np.int32)
        ),
    )
    told = true_poses(pile)[:1].repeat(2, 0)
    stand_in(monkeypatch, told)
    small = {
        "levels": (24,),
        "level_steps": (4,),
        "rays": 256,
        "faces": 500,
        "texture": 32,
        "surface_steps": 2,
        "points": 64,
    }
    options = replace(
        recipe.options_for("draft"),
        **small,
        directions=8,
        light=8,
        side=48,
        without=("matching", "normals", "visibility"),
    )
    with Run.open(tmp_path / "run", {"capture": "duplicates"}) as run:
        asset = recipe.reconstruct(replace(capture, photos=(alone, alone)), run, options, 0)
        log = (run.folder / "log.txt").read_text()
    assert "one object in 2 photos" in log and "--capture multiview" in log
    assert "without=normals changes nothing" in log
    assert len(asset.instances) == 1 and len(asset.cameras) == 2


def test_switched_off_parts_are_checked_by_name():
    with pytest.raises(ValueError, match="Did you mean 'refinement'"):
        replace(recipe.options_for("draft"), without=("refinment",))
    with pytest.raises(UserError, match="not known"):
        recipe.options_for("fast")


def test_a_photo_without_labels_is_refused(pile):
    with pytest.raises(UserError, match="no labels"):
        recipe.labelled_photos(replace(open_capture(pile), kind=""))
