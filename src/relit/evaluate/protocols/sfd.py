"""SfD's figures: Cheng et al. 2023, "Structure from Duplicates", as `utils/evaluate.py`,
`trainer/train_material.py`, `preprocess/7_extract_sfm_pose_and_visualize.py` and `utils/
mesh_metrics.py` of its release compute them.

Pictures are clipped to [0, 1] and raised to 1/2.2 (not sRGB). The base colour's factor is taken
after that, per view and channel. Roughness too is raised to 1/2.2 before it is compared. Relit
pictures are not scaled. Angles of normals are left out: the release compares them after a mapping
to [0, 1] that makes them smaller.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from relit.conventions import move_points
from relit.errors import UserError
from relit.evaluate import metrics as m
from relit.evaluate.alignment import align_points, aligned, angles_between
from relit.evaluate.baselines import CONSTANT, Baselines, Constants, chance, random_rotations
from relit.evaluate.lpips import Lpips
from relit.evaluate.picture_figures import Draw
from relit.evaluate.pile_alignment import frame_by_poses, scene_alignment
from relit.evaluate.pile_views import COVERED, PileViews, load_pile_truth, registered_poses
from relit.evaluate.results import PaperValue, entries, view_means
from relit.evaluate.truth import Truth, camera_key, has_truth, load_truth, truth_kind
from relit.geometry.se3 import nearest_rotation
from relit.scene import Asset, Camera

KINDS = ("duplicates", "multiview")
MEASURES = "piles of duplicates and multi-view captures with a truth"
SAMPLES = 200_000  # points a surface, as `evaluate_meshes` draws
EPS = 1e-8  # added to the mean squared error in `mse2psnr`
WINDOW = 7  # pixels; scikit-image's default

_GAMMA = "clipped to [0, 1], to the power 1/2.2"
_MASK = f"over pixels of true coverage >= {COVERED}"
_BOTH = f"over pixels of true and recovered coverage >= {COVERED} (the release's 'union mask')"
_SSIM = (
    f"SSIM (uniform {WINDOW} x {WINDOW}, sample covariance, data range max - min of the two), "
    f"{_GAMMA}, white outside the mask"
)
_NOVEL, _RELIT = (
    "test views under the recovered light",
    "test views under the unseen lights, nothing scaled",
)
_FACTOR = "after the factor sum(truth) / sum(recovered) per channel and view of the encoded values"


def _pictures(prefix: str, what: str) -> dict[str, tuple[str, str]]:
    return {
        f"{prefix}_psnr": ("dB", f"{what}: PSNR, {_GAMMA}, {_MASK}; mean over views"),
        f"{prefix}_psnr_both": ("dB", f"as {prefix}_psnr, {_BOTH}"),
        f"{prefix}_ssim": ("", f"{what}: {_SSIM}; mean over views"),
        f"{prefix}_lpips": ("", f"{what}: LPIPS, {_GAMMA}, white outside the mask"),
    }


DEFINITIONS: dict[str, tuple[str, str]] = {
    **_pictures("novel", _NOVEL),
    **_pictures("relit", _RELIT),
    "albedo_psnr": (
        "dB",
        f"base colour {_GAMMA}, {_FACTOR}, clipped again: PSNR {_MASK}; mean over views",
    ),
    "albedo_psnr_both": ("dB", f"as albedo_psnr, {_BOTH}"),
    "albedo_psnr_unscaled": ("dB", "as albedo_psnr, without the factor"),
    "roughness_mse": ("", f"roughness {_GAMMA}: mean squared error {_MASK}; mean over views"),
    "roughness_mse_both": ("", f"as roughness_mse, {_BOTH}"),
    "environment_mse": (
        "",
        f"recovered against true light, 256 x 512, {_GAMMA}: mean squared error of all texels",
    ),
    "chamfer": (
        "radii",
        f"mean of the two mean distances between {SAMPLES} points uniform by area on each whole "
        "surface (Chamfer-L1), in radii of the true object, after the similarity that cameras and "
        "poses give, no surface consulted",
    ),
    "rotation_mean": (
        "degrees",
        "mean over registered instances, the first one included, of the rotation error of their "
        "virtual cameras relative to that of the first",
    ),
    "rotation_median": ("degrees", "median of the errors of which rotation_mean is the mean"),
    "translation_mean": (
        "",
        "mean distance of the virtual cameras' centres, each set with mean 0 and mean length 1, "
        "after Procrustes on these centres",
    ),
    "registered": ("%", "share of the visible instances that the three figures before count"),
}
PAPERS = {
    "duplicates": {
        "albedo_psnr": PaperValue(17.63, "SfD Tab. 1", 17.28, "one photo"),
        "roughness_mse": PaperValue(0.062, "SfD Tab. 1", 0.070, "one photo"),
        "relit_psnr": PaperValue(21.37, "SfD Tab. 1", note="one photo"),
        "novel_psnr": PaperValue(
            20.33, "SfD Tab. 3", 20.28, "real photos; the re-run is of 15 synthetic objects"
        ),
        "environment_mse": PaperValue(0.052, "SfD Tab. 1", 0.137, "one photo"),
        "chamfer": PaperValue(0.034, "SfD Tab. 1", note="one photo; its unit is not stated"),
        "rotation_mean": PaperValue(
            0.186, "SfD Tab. 2, N = 10", note="2.5 at N = 6, .45 at 30, 51.5 at 60"
        ),
        "translation_mean": PaperValue(
            0.003, "SfD Tab. 2, N = 10", note=".070 at N = 6, .644 at 60"
        ),
    },
    "multiview": {
        "albedo_psnr": PaperValue(21.96, "SfD Tab. 1, 100 views"),
        "roughness_mse": PaperValue(0.026, "SfD Tab. 1, 100 views"),
        "relit_psnr": PaperValue(25.49, "SfD Tab. 1, 100 views"),
        "environment_mse": PaperValue(0.029, "SfD Tab. 1, 100 views"),
        "chamfer": PaperValue(0.011, "SfD Tab. 1, 100 views", note="its unit is not stated"),
    },
}


@dataclass(frozen=True)
class SfdView:
    """A test view. inside, network: (H, W) bool, the true and the recovered mask. albedo (H, W, 3),
    roughness (H, W): linear pairs (recovered, true). pictures: 'novel' or 'relit:LIGHT' -> linear
    pairs (H, W, 3)."""

    inside: np.ndarray
    network: np.ndarray
    albedo: tuple[np.ndarray, np.ndarray]
    roughness: tuple[np.ndarray, np.ndarray]
    pictures: dict[str, tuple[np.ndarray, np.ndarray]]


def psnr_of(a, b, where) -> float:
    """The release's `mse2psnr` of encoded pictures over `where`."""
    error = np.square(np.asarray(a, np.float64) - b)[where]
    return float(-10 * np.log10(error.mean() + EPS)) if error.size else float("nan")


def sfd_picture_scores(
    shown, truth, inside, network, lpips: Lpips | None = None
) -> dict[str, float]:
    """psnr, psnr_both, ssim, lpips of linear pictures (H, W, 3)."""
    a, b = m.gamma_encode(shown), m.gamma_encode(truth)
    out = {"psnr": psnr_of(a, b, inside), "psnr_both": psnr_of(a, b, inside & network)}
    white_a, white_b = (np.where(inside[..., None], x, 1.0) for x in (a, b))
    span = max(white_a.max(), white_b.max()) - min(white_a.min(), white_b.min())
    out["ssim"] = m.ssim_uniform(white_a, white_b, WINDOW, float(span) or 1.0, True)
    if lpips is not None:
        out["lpips"] = lpips(white_a, white_b)
    return out


def sfd_albedo_scores(shown, truth, inside, network) -> dict[str, float]:
    """albedo_psnr and its variants of linear base colours (H, W, 3). The factor is that of the
    pixels that both masks hold; the release hands it on to the figure over the true mask."""
    a, b, both = m.gamma_encode(shown), m.gamma_encode(truth), inside & network
    scaled = np.clip(a * m.albedo_scale(a[both], b[both]), 0, 1)
    return {
        "albedo_psnr": psnr_of(scaled, b, inside),
        "albedo_psnr_both": psnr_of(scaled, b, both),
        "albedo_psnr_unscaled": psnr_of(a, b, inside),
    }


def roughness_mse(shown, truth, where) -> float:
    """Mean squared error after the power 1/2.2."""
    error = np.square(m.gamma_encode(shown) - m.gamma_encode(truth))[where]
    return float(error.mean()) if error.size else float("nan")


def sfd_view_scores(view: SfdView, constants: Constants, lpips: Lpips | None) -> dict[str, float]:
    """All figures of one view; its truth is added to `constants`."""
    both = view.inside & view.network
    out = sfd_albedo_scores(*view.albedo, view.inside, view.network)
    out["roughness_mse"] = roughness_mse(*view.roughness, view.inside)
    out["roughness_mse_both"] = roughness_mse(*view.roughness, both)
    constants.add("roughness_mse", m.gamma_encode(view.roughness[1]), view.inside)
    constants.add("roughness_mse_both", m.gamma_encode(view.roughness[1]), both)
    constants.add("albedo_psnr_unscaled", m.gamma_encode(view.albedo[1]), view.inside)
    for key, pair in view.pictures.items():
        prefix, _, light = key.partition(":")
        for name, value in sfd_picture_scores(*pair, view.inside, view.network, lpips).items():
            out[f"{prefix}_{name}" + (f":{light}" if light else "")] = value
    return out


def constant_albedo(view: SfdView) -> dict[str, float]:
    """What a base colour of one value scores: the protocol's factor makes it the best one."""
    flat = np.full_like(view.albedo[1], 0.5)
    scores = sfd_albedo_scores(flat, view.albedo[1], view.inside, view.network)
    return {name: scores[name] for name in ("albedo_psnr", "albedo_psnr_both")}


def pose_scores(
    poses: Mapping[int, np.ndarray], true_poses: Mapping[int, np.ndarray], photo: Camera
) -> dict[str, float]:
    """rotation_mean, rotation_median, translation_mean of world_from_object (4, 4) by label, over
    the labels that both hold; at least 4, as Procrustes needs 3 beside the reference. photo: the
    camera of the photo, in the frame of both."""
    keys = [k for k in true_poses if k in poses]
    mine, true = (_relative(np.array([p[k] for k in keys]), photo) for p in (poses, true_poses))
    angle = angles_between(mine[:, :3, :3], true[:, :3, :3])
    a, b = (_normalised(p[:, :3, 3]) for p in (mine, true))
    distance = np.linalg.norm(move_points(align_points(a, b), a) - b, axis=1)
    return {
        "rotation_mean": float(angle.mean()),
        "rotation_median": float(np.median(angle)),
        "translation_mean": float(distance.mean()),
    }


def _relative(poses: np.ndarray, photo: Camera) -> np.ndarray:
    """(N, 4, 4) poses of the virtual cameras C_i = O_0 O_i^-1 C relative to C_0."""
    rigid = poses.copy()
    rigid[:, :3, :3] = [nearest_rotation(p[:3, :3]) for p in poses]
    cameras = rigid[0] @ np.linalg.inv(rigid) @ photo.world_from_camera
    return np.linalg.inv(cameras[0]) @ cameras


def _normalised(points: np.ndarray) -> np.ndarray:
    centred = points - points.mean(0)
    return centred / max(float(np.linalg.norm(centred, axis=1).mean()), 1e-12)


def pose_chance(true_poses: Mapping[int, np.ndarray], photo: Camera) -> Baselines:
    """What random rotations in the true places score under `pose_scores`."""

    def drawn(rng: np.random.Generator) -> dict[str, float]:
        turned = {}
        turns = random_rotations(len(true_poses), rng)
        for (k, pose), turn in zip(true_poses.items(), turns, strict=True):
            turned[k] = pose.copy()
            turned[k][:3, :3] = turn
        return pose_scores(turned, true_poses, photo)

    return chance(drawn)


def sfd_surface_score(mesh, true_mesh, true_from_mesh: np.ndarray, count: int = SAMPLES) -> float:
    """Chamfer-L1 in radii of the true object. mesh, true_mesh: (vertices, faces)."""
    own = m.sample_surface(*mesh, count, seed=0).samples
    true = m.sample_surface(*true_mesh, count, seed=1).samples
    vertices = np.asarray(true_mesh[0], np.float64)
    middle = (vertices.min(0) + vertices.max(0)) / 2
    radius = float(np.linalg.norm(vertices - middle, axis=1).max())
    return m.point_chamfer(move_points(true_from_mesh, own), true)[0] / radius


def evaluate_by_protocol(run: Path, folder: Path, draw: Draw) -> dict[str, Any]:
    """Every figure of DEFINITIONS that the truth allows. Raises UserError without a truth."""
    from relit.asset.asset import load_asset

    asset, constants = load_asset(run), Constants()
    if truth_kind(folder) == "duplicates":
        kind = "duplicates"
        values, baselines, views, light = _pile(asset, folder, draw)
    elif has_truth(folder):
        kind, truth = "multiview", load_truth(folder)
        asset, _ = aligned(asset, truth.train, {camera_key(n): c for n, c in asset.cameras})
        mesh, true = (asset.mesh.vertices, asset.mesh.faces), true_surface(folder)
        values = {"chamfer": sfd_surface_score(mesh, true, asset.world_from_asset)}
        baselines, views = {}, multiview_views(asset, truth, draw)
        light = truth.picture("environment")[..., :3]
    else:
        raise UserError(
            "the photos have no truth that SfD's protocol could use",
            "it compares base colour, roughness and light",
            "give a folder of relit synthesize, or use --protocol relit",
        )
    per_view, flat = {}, {}
    for name, view in views:
        per_view[name] = sfd_view_scores(view, constants, draw.lpips)
        flat[name] = constant_albedo(view)
    if asset.environment is not None:
        values["environment_mse"] = m.environment_mse(asset.environment, light)
        constants.add("environment_mse", m.encoded_environment(light))
    baselines |= constants.baselines()
    baselines |= {name: (value, CONSTANT) for name, value in view_means(flat).items()}
    values |= view_means(per_view)
    return {
        "metrics": entries(values, DEFINITIONS, baselines, PAPERS[kind]),
        "per_view": per_view,
    }


def true_surface(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """(vertices, faces) of truth/mesh.ply."""
    import trimesh

    loaded = trimesh.load(folder / "truth" / "mesh.ply", process=False)
    return np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces)


def _pile(asset: Asset, folder: Path, draw: Draw):
    """(values, baselines, views, true light) of a pile."""
    truth, poses = load_pile_truth(folder), registered_poses(asset)
    vertices, faces = true_surface(folder)
    points = m.sample_surface(vertices, faces, 30_000).samples
    scale, own, _ = scene_alignment(poses, truth.poses, truth.photo, points, asset.mesh.vertices)
    middle = (points.min(0) + points.max(0)) / 2
    frame = frame_by_poses(poses, truth.poses, scale, own, middle)
    mesh = (asset.mesh.vertices, asset.mesh.faces)
    values = {"chamfer": sfd_surface_score(mesh, (vertices, faces), np.linalg.inv(frame))}
    known = {k: p for k, p in truth.poses.items() if k in poses}
    visible = {i["label"] for i in truth.content["instances"] if i["visible"] > 0}
    values["registered"] = 100 * len(visible & set(known)) / max(len(visible), 1)
    baselines: Baselines = {}
    if len(known) >= 4:
        values |= pose_scores(poses, truth.poses, truth.photo)
        baselines = pose_chance(known, truth.photo)
    light = truth.picture("environment")[..., :3]
    return values, baselines, pile_views(PileViews.of(asset, truth, scale), draw), light


def pile_views(views: PileViews, draw: Draw) -> Iterator[tuple[str, SfdView]]:
    """The test views of a pile."""
    asset, truth = views.asset, views.truth
    pictures = {}
    if asset.environment is not None:
        pictures["novel"] = views.pictures(asset.material, asset.environment, "test", draw)
    for light in truth.content["relight"]:
        radiance = truth.picture(f"relight/{light}")[..., :3]
        shown = views.pictures(asset.material, radiance, f"relight/{light}", draw)
        pictures[f"relit:{light}"] = shown
    for name, p in views.predicted.items():
        true = views.albedo[name]
        yield (
            name,
            SfdView(
                true[..., 3] >= COVERED,
                p["alpha"] >= COVERED,
                (p["albedo"], true[..., :3]),
                (p["roughness"], truth.picture(f"test/{name}_roughness")),
                {key: shown[name] for key, shown in pictures.items()},
            ),
        )


def multiview_views(asset: Asset, truth: Truth, draw: Draw) -> Iterator[tuple[str, SfdView]]:
    """The test views of a multi-view capture. The asset stands in the truth's frame."""
    from relit.reference.mitsuba_scene import build_scene, render, render_channels

    def scene(light):
        return build_scene(asset.mesh, asset.material, asset.world_from_asset, light)

    lit = {} if asset.environment is None else {"novel": (asset.environment, "test")}
    for light in truth.meta.get("relight", ()):
        lit[f"relit:{light}"] = (truth.picture(f"relight/{light}")[..., :3], f"relight/{light}")
    scenes = {key: (scene(light), folder) for key, (light, folder) in lit.items()}
    bare = scene(None)
    for i, (name, camera) in enumerate(truth.test.items()):
        p, true = render_channels(bare, camera, spp=32), truth.picture(f"test/{name}_albedo")
        pictures = {
            key: (
                render(lit_scene, camera, spp=draw.spp, seed=draw.seed + i)[..., :3],
                truth.picture(f"{folder}/{name}")[..., :3],
            )
            for key, (lit_scene, folder) in scenes.items()
        }
        yield (
            name,
            SfdView(
                true[..., 3] >= COVERED,
                p["alpha"] >= COVERED,
                (p["albedo"], true[..., :3]),
                (p["roughness"], truth.picture(f"test/{name}_roughness")),
                pictures,
            ),
        )
