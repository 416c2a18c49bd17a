"""Where the identical objects of a photo stand, by rendering crude models of them.

SfD finds the poses by matching features between the objects (Sec. 3.1; cameras/duplicates.py does that). Feature matching links what is
seen from similar sides; what it cannot link is found here by search:

    views_of          the photo and its labels -> one virtual camera with picture, mask and what is known for each instance
    pair_hypotheses   every instance's silhouette is inflated to a crude model, and every other instance registered against it, several ways
    consistent        the orientations of all that agree with as many of these guesses as possible
    settle            a coarse model is fitted to all instances, all poses are searched again by rendering it; a few rounds

Poses are `object_from_camera` of the PHOTO's camera, in the unit frame of the object: instance i in the photo's frame is the inverse,
SfD's ξ_obj = ξ_ref ∘ ξ_cam^-1 with ξ_ref the photo's camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from relit.cameras.se3 import nearest_rotation
from relit.conventions import similarity
from relit.fit.pixels import PixelBank, RayBatch, camera_rows, corrected, make_bank, rays_through
from relit.fit.register import (
    Crop,
    Gallery,
    crop_photo,
    crop_rings,
    directions_around,
    make_gallery,
    refine,
    rings_of,
    search,
    views_from,
)
from relit.fit.volume import VolumeModel, VolumeOptions, fit_volume, start_model
from relit.geometry.hull import distance_of
from relit.geometry.sdf import node_positions
from relit.rendering.march import march, sphere_interval
from relit.rendering.shade_world import shade_albedo, shade_world, start_world_light
from relit.scene import Camera

COARSE = 160  # pixels, longer side of a window while poses are searched
MARGIN = 0.15  # of a window around its instance, of its size
OBJECT_RADIUS = 0.8  # of the widest silhouette, in the unit frame


@dataclass(frozen=True)
class View:
    """One instance in its window of the photo. camera: of the window, its pose that of the photo. rgb: (h, w, 3) linear. mask: (h, w).
    known: (h, w), 0 where another object hides or may hide it. seen: share of the outline that ends at known background."""

    label: int
    camera: Camera
    rgb: np.ndarray
    mask: np.ndarray
    known: np.ndarray
    seen: float


def views_of(rgb: np.ndarray, labels: np.ndarray, camera: Camera, side: int) -> list[View]:
    """A view of each label > 0, in windows of at most `side` pixels. camera: of the photo, identity pose."""
    out = []
    for label in np.unique(labels[labels > 0]):
        own = labels == label
        rows, columns = np.flatnonzero(own.any(1)), np.flatnonzero(own.any(0))
        grow = max(8, round(MARGIN * max(np.ptp(rows), np.ptp(columns))))
        top, bottom = max(rows[0] - grow, 0), min(rows[-1] + 1 + grow, labels.shape[0])
        left, right = max(columns[0] - grow, 0), min(columns[-1] + 1 + grow, labels.shape[1])
        window = (slice(top, bottom), slice(left, right))
        mask = own[window].astype(np.float32)
        other = (labels[window] != label) & (labels[window] != 0)
        known = 1.0 - binary_dilation(other, iterations=1).astype(np.float32) * (1 - mask)
        edge = binary_dilation(mask > 0, iterations=2) & (mask == 0)
        seen = float(known[edge].mean()) if edge.any() else 0.0
        if rows[0] == 0 or columns[0] == 0 or rows[-1] == labels.shape[0] - 1 or columns[-1] == labels.shape[1] - 1:
            seen *= 0.5  # the frame cuts it
        w, h = right - left, bottom - top
        c = replace(camera, width=w, height=h, cx=camera.cx - left, cy=camera.cy - top)
        picture = rgb[window]
        s = min(1.0, side / max(w, h))
        if s < 1:
            size = (max(8, round(w * s)), max(8, round(h * s)))
            picture, mask, known = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (picture, mask, known))
            c = c.resized(*size)
        out.append(View(int(label), c, picture, mask, (known > 0.99).astype(np.float32), seen))
    return out


def pixel_bank(views: list[View], poses: np.ndarray) -> PixelBank:
    """The pixels of the views, with the virtual cameras at `poses`; unknown ones are never drawn."""
    cameras = [v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)]
    bank = make_bank(cameras, [v.rgb for v in views], [v.mask for v in views])
    known = np.concatenate([v.known.ravel() for v in views]) > 0.5
    candidates = np.array(bank.candidates)
    bank.candidates = mi.UInt32(candidates[known[candidates]])
    return bank


class NoStage:
    """Stands where a stage of a run is asked for: nothing is kept or shown."""

    def load(self, name):
        return None

    def save(self, name, **values):
        pass

    def step(self, i, **values):
        pass

    def checkpoint_due(self):
        return False


# ---------------------------------------------------------------- the model


def frame_scale(views: list[View]) -> float:
    """Distance (unit lengths) at which the widest silhouette has OBJECT_RADIUS: the scale of a photo is free, this fixes it."""
    widest = 0.0
    for v in views:
        y, x = np.nonzero(v.mask > 0.5)
        points = np.stack([(x + 0.5 - v.camera.cx) / v.camera.fx, (y + 0.5 - v.camera.cy) / v.camera.fy], -1)
        widest = max(widest, float(np.linalg.norm(points - (points.min(0) + points.max(0)) / 2, axis=1).max()))
    return OBJECT_RADIUS / widest


def first_pose(view: View, distance: float) -> np.ndarray:
    """object_from_camera (4, 4) of the instance that the model is grown from: the object's axes are the camera's, its middle lies on the
    ray through the middle of the silhouette."""
    y, x = np.nonzero(view.mask > 0.5)
    ray = np.array(
        [
            ((x.min() + x.max() + 1) / 2 - view.camera.cx) / view.camera.fx,
            ((y.min() + y.max() + 1) / 2 - view.camera.cy) / view.camera.fy,
            1.0,
        ]
    )
    return similarity(np.eye(3), -distance * ray)


def inflated(view: View, pose: np.ndarray, n: int, depth: float = 1.2, most: float = 0.55) -> np.ndarray:
    """Signed distance (n, n, n) of a body that fills the silhouette, as deep on both sides as `depth` times the distance to the outline."""
    camera = view.camera.with_pose(pose)
    solid = view.mask > 0.5
    p = node_positions(n).reshape(-1, 3)
    q = camera.project(p)
    u, v = np.floor(q[:, 0]).astype(int), np.floor(q[:, 1]).astype(int)
    ok = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & (q[:, 2] > 0)
    u, v = np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1)
    middle = float(np.linalg.norm(camera.centre))
    room = distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1] / camera.fx * middle
    along = p @ (camera.centre / middle)
    inside = ok & solid[v, u] & (np.abs(along) < np.minimum(room[v, u] * depth, most))
    return distance_of(inside.reshape(n, n, n))


def carved(views: list[View], poses: np.ndarray, n: int, tolerance: float, depth: float | None = None) -> np.ndarray:
    """Signed distance of what lies inside nearly all silhouettes: a node is out where more than `tolerance` of the views that know show
    background there. Raises ValueError when nothing is left.

    depth: a view also counts a node as out that lies farther before or behind the object's middle than `depth` times the distance to the
    outline, and a little: views from nearly one side would leave a body as deep as the ball.
    """
    p = node_positions(n).reshape(-1, 3)
    told, empty = np.zeros(len(p)), np.zeros(len(p))
    for view, pose in zip(views, poses, strict=True):
        camera = view.camera.with_pose(pose)
        q = camera.project(p)
        u, v = np.floor(q[:, 0]).astype(int), np.floor(q[:, 1]).astype(int)
        ok = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & (q[:, 2] > 0)
        u, v = np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1)
        known = np.where(ok, view.known[v, u], 1.0) > 0.5
        out = ~(ok & (view.mask[v, u] > 0.3))
        if depth is not None:
            middle = float(np.linalg.norm(camera.centre))
            room = distance_transform_edt(np.pad((view.mask > 0.5) | (view.known < 0.5), 1))[1:-1, 1:-1] / camera.fx * middle
            out |= np.abs(p @ (camera.centre / middle)) > depth * room[v, u] + 0.1
        told += known
        empty += known & out
    inside = (told > 0) & (empty <= tolerance * told) & ((p**2).sum(1) < 0.98)
    return distance_of(inside.reshape(n, n, n))


def fit_model(
    views: list[View], poses: np.ndarray, values: np.ndarray, steps: int, *, refine_cameras: float = 0.0, rays: int = 4096, seed: int = 0
) -> tuple[VolumeModel, np.ndarray]:
    """A coarse model from start distances; (model, poses with the corrections that the fit has found)."""
    bank = pixel_bank(views, poses)
    inside = np.concatenate([v.rgb[v.mask > 0.99] for v in views])
    model = start_model(values, np.maximum(inside.mean(0), 1e-3), None, full=False)
    model.appearance = shade_world
    model.reflections, model.rates = start_world_light(float(inside.mean()), len(views))
    if refine_cameras > 0:
        move_poses(bank, model)
    options = VolumeOptions((values.shape[0],), (steps,), rays, sharpness=(1.5, 4.0), refine_cameras=refine_cameras)
    fit_volume(bank, model, options, NoStage(), seed)
    return model, moved_poses(bank, views, poses)


def move_poses(bank: PixelBank, model: VolumeModel) -> None:
    """Let the volume pass turn the cameras about the object's middle (not about themselves, which would throw the picture aside), and move
    them; the focal length stays."""
    bank.corrections = dr.zeros(mi.Float, 7 * bank.views)
    model.extra["correction_rates"] = mi.Float(np.tile(np.array([1, 1, 1, 1, 1, 1, 0], np.float32), bank.views))


def moved_poses(bank: PixelBank, views: list[View], poses: np.ndarray) -> np.ndarray:
    """The poses (N, 4, 4) with the corrections that a fit has found."""
    cameras = corrected([v.camera.with_pose(p) for v, p in zip(views, poses, strict=True)], np.array(bank.corrections))
    return np.array([c.world_from_camera for c in cameras])


def albedo_render(model: VolumeModel):
    """Renders the model's colours without light on black, and its opacity: `fit.register.Render`."""

    def render(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
        side, rgb, alpha = cameras[0].width, [], []
        inv_s, dt = dr.opaque(mi.Float, model.inv_s), dr.opaque(mi.Float, 0.9 * model.grid.h)
        each = max(1, (1 << 20) // side**2)
        for first in range(0, len(cameras), each):
            some = cameras[first : first + each]
            index = dr.arange(mi.UInt32, len(some) * side * side)
            view, pixel = index // (side * side), index % (side * side)
            rows = mi.Float(camera_rows(some))
            o, d = rays_through(rows, view, mi.Float(pixel % side) + 0.5, mi.Float(pixel // side) + 0.5)
            t0, t1 = sphere_interval(o, d)
            dr.eval(o, d, t0, t1)
            m = march(model.grid, o, d, t0, t1, inv_s, dt)
            colour, _ = shade_albedo(m, RayBatch(o, d, None, None, view, pixel), rows, model.reflections)
            inside = t1 > t0
            colour, opacity = dr.select(inside, colour, 0), dr.select(inside, m.opacity, 0)
            dr.eval(colour, opacity)
            rgb.append(np.array(colour).T.reshape(-1, side, side, 3))
            alpha.append(np.array(opacity).reshape(-1, side, side))
        return np.concatenate(rgb), np.concatenate(alpha)

    return render


# ---------------------------------------------------------------- search

# weights in fit.register's descriptors: one photo, one light, so brightness tells more than across photos; colourful objects do with less
# of it
PARTS, COLOURFUL = (0.5, 2.0, 0.6), (0.6, 2.0, 0.1)


@dataclass(frozen=True)
class Search:
    """How poses are searched. nodes: of the coarse models, a side. steps: of each coarse fit. viewpoints: all around. cone: degrees from
    what a single instance has shown within which another can be recognised. models: instances that are inflated, at most. keep:
    hypotheses of each pair. tolerance: degrees within which hypotheses agree. settled: sets of poses that are fitted and compared.
    rounds: of fit and search for all instances at the end. rate: step of the pose corrections in coarse fits. depth: see `carved`."""

    nodes: int = 40
    steps: int = 50
    viewpoints: int = 1500
    cone: float = 65.0
    models: int = 14
    keep: int = 4
    tolerance: float = 22.0
    settled: int = 2
    rounds: int = 3
    rate: float = 0.004
    depth: float = 2.5


def crops_of(views: list[View]) -> list[Crop]:
    return [crop_photo(v.rgb, v.mask, v.camera.with_pose(np.eye(4)), v.known) for v in views]


def seen_from(poses: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) from the object's middle to the cameras."""
    c = poses[:, :3, 3]
    return c / np.linalg.norm(c, axis=1, keepdims=True)


def pair_hypotheses(views: list[View], crops, chosen: list[int], o: Search, distance: float, seed: int, say) -> dict:
    """For each of two descriptors (PARTS, COLOURFUL): rotations (S, N, K, 3, 3) that carry instance chosen[s] onto instance j in the
    photo, and their scores (S, N, K).

    Every chosen instance is inflated to a model, and every other one registered against it, `o.keep` ways. The scores of a descriptor are
    shifted so that one in ten pairs has more than 0.9: then the two can be compared.
    """
    rings = {parts: crop_rings(crops, parts) for parts in (PARTS, COLOURFUL)}
    shape = (len(chosen), len(views), o.keep)
    out = {parts: (np.tile(np.eye(3), (*shape, 1, 1)), np.full(shape, -1.0)) for parts in rings}
    directions = directions_around(o.viewpoints, seed)
    for s, k in enumerate(chosen):
        pose = first_pose(views[k], distance)
        model, _ = fit_model([views[k]], pose[None], inflated(views[k], pose, o.nodes), o.steps, seed=seed)
        close = directions @ seen_from(pose[None])[0] >= np.cos(np.radians(o.cone))
        cameras = views_from(directions[close], max(2.0, distance))
        rgb, alpha = albedo_render(model)(cameras)
        for parts, (rotations, scores) in out.items():
            gallery = Gallery(cameras, rings_of(rgb, alpha, parts=parts))
            found = search(crops, gallery, keep=o.keep, rings=rings[parts], apart=25.0)
            rotations[s] = np.swapaxes(found.poses[..., :3, :3], -1, -2)  # the model's axes are the photo's: pose^-1 turns k onto j
            scores[s] = found.scores
            scores[s, k] = -1.0
        say(s + 1, len(chosen))
    for _, scores in out.values():
        scores[scores > -1] += 0.9 - np.quantile(scores[..., 0][scores[..., 0] > -1], 0.9)
    return out


def consistent(rotations: np.ndarray, scores: np.ndarray, chosen: list[int], tolerance: float, links=()) -> list[tuple[float, np.ndarray]]:
    """Orientations (N, 3, 3) photo_from_object of all instances that agree with as many pair hypotheses as possible, one set from each
    start, best first: [(support, orientations)].

    Support of a set: sum over pairs of the best hypothesis' weight times a Gauss curve of its disagreement. links: ((i, j, rotation of i
    onto j, weight), ...) from matching.
    """
    n, sigma = rotations.shape[1], np.radians(tolerance)
    weight = np.exp((scores - 1) / 0.06)  # a good score means much: that of a wrong pose is often near-by
    edges: dict[tuple[int, int], list[tuple[np.ndarray, float]]] = {}
    for s, k in enumerate(chosen):
        for j in range(n):
            if j != k:
                edges.setdefault((k, j), []).extend(zip(rotations[s, j], weight[s, j], strict=True))
    for i, j, r, w in links:
        edges.setdefault((i, j), []).append((r, w))
    around: list[list[tuple[int, np.ndarray, np.ndarray]]] = [[] for _ in range(n)]  # of j: (i, rotations i onto j, weights)
    for (i, j), some in edges.items():
        r, w = np.array([x[0] for x in some]), np.array([x[1] for x in some])
        around[j].append((i, r, w))
        around[i].append((j, np.swapaxes(r, 1, 2), w))

    def votes(j: int, placed: dict[int, np.ndarray]) -> tuple[np.ndarray, float]:
        """The orientation of j with the most support from those placed, and that support."""
        candidates, owners = [], []
        for i, r, w in around[j]:
            if i in placed:
                candidates.append(r @ placed[i])
                owners.append(np.stack([np.full(len(r), len(owners)), w], 1))
        if not candidates:
            return np.eye(3), 0.0
        groups = len(candidates)
        c, own = np.concatenate(candidates), np.concatenate(owners)
        cosine = np.clip((np.einsum("aij,bij->ab", c, c) - 1) / 2, -1, 1)
        agree = np.exp(-0.5 * (np.arccos(cosine) / sigma) ** 2) * own[None, :, 1]
        best = np.zeros((len(c), groups))
        for g in range(groups):
            best[:, g] = agree[:, own[:, 0] == g].max(1)
        total = best.sum(1)
        a = int(total.argmax())
        near_by = agree[a] > 0.3 * own[:, 1]  # the mean of those that agree is better than any one
        return nearest_rotation((c[near_by] * agree[a][near_by][:, None, None]).sum(0)), float(total[a])

    out = []
    for start in chosen:
        placed = {start: np.eye(3)}
        while len(placed) < n:
            options = {j: votes(j, placed) for j in range(n) if j not in placed}
            j = max(options, key=lambda k: options[k][1])
            placed[j] = options[j][0]
        support = 0.0
        for _ in range(6):
            support = 0.0
            for j in range(n):
                rest = {i: r for i, r in placed.items() if i != j}
                placed[j], vote = votes(j, rest)
                support += vote
        out.append((support, np.array([placed[k] for k in range(n)])))
    return sorted(out, key=lambda x: -x[0])


def poses_of(views: list[View], orientations: np.ndarray, distance: float) -> np.ndarray:
    """object_from_camera (N, 4, 4) of given orientations photo_from_object, each instance in the middle of its silhouette."""
    out = []
    for view, r in zip(views, orientations, strict=True):
        pose = first_pose(view, distance)
        out.append(similarity(r.T, r.T @ pose[:3, 3]))
    return np.array(out)


def settle(views, crops, rings, poses, scores, o: Search, rounds: int, *, wide: bool, seed: int, parts=PARTS, say=lambda text: None):
    """Rounds of a coarse fit and a search for better poses by rendering it; (poses, scores).

    scores: of the poses so far, or None: then all instances shape the model. Otherwise only those that agree well do (see `trusted`), so
    that one in a wrong place does not spoil the model that is to put it right. wide: search all viewpoints in each round, else only
    around the present poses.
    """
    n = len(views)
    for turn in range(rounds):
        use = np.arange(n) if scores is None else trusted(scores)
        nodes = o.nodes if turn < 2 else round(1.3 * o.nodes)
        some = [views[k] for k in use]
        # a hull that is too fat misleads more than one that is too thin
        values = carved(some, poses[use], nodes, 0.3 if scores is None else 0.15, o.depth)
        steps = o.steps + 10 * turn
        model, poses[use] = fit_model(some, poses[use], values, steps, refine_cameras=o.rate, seed=seed + turn)
        render = albedo_render(model)
        poses, scores = refine(crops, poses, render, rings=rings, steps=(0, 8.0, 4.0, 2.0), parts=parts)
        moved = np.zeros(n, bool)
        if wide:
            far = float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))
            gallery = make_gallery(render, views_from(directions_around(o.viewpoints, seed + turn), far), parts)
            found = search(crops, gallery, keep=3, rings=rings)
            for k in range(3):
                other, also = refine(crops, found.poses[:, k], render, rings=rings, steps=(0, 4.0, 2.0), parts=parts)
                better = also > scores + 0.004
                poses, scores = np.where(better[:, None, None], other, poses), np.where(better, also, scores)
                moved |= better
        say(f"round {turn + 1}: {len(use)} shape the model, mean score {scores.mean():.3f}, lowest {scores.min():.3f}, {moved.sum()} moved")
    return poses, scores


def trusted(scores: np.ndarray, gap: float = 0.1) -> np.ndarray:
    """Indices of the instances whose score lies within `gap` of the mean of the best third; at least three."""
    best = np.sort(scores)[::-1]
    level = best[: max(1, round(len(scores) / 3))].mean() - gap
    return np.flatnonzero(scores >= min(level, best[min(2, len(scores) - 1)]))


def place(views: list[View], o: Search, *, seed: int = 0, links=(), say=lambda text: None, step=lambda done, total: None):
    """Poses (N, 4, 4) object_from_camera of all views and their scores (N,), from nothing but the photo and its labels.

    links: see `consistent`.
    """
    distance = frame_scale(views)
    if len(views) == 1:
        return first_pose(views[0], distance)[None], np.ones(1)
    crops = crops_of(views)
    order = sorted(range(len(views)), key=lambda k: -views[k].seen * np.sqrt(views[k].mask.sum()) / views[k].camera.fx)
    chosen = order[: o.models]
    guesses = pair_hypotheses(views, crops, chosen, o, distance, seed, step)
    judged = [(parts, consistent(*guesses[parts], chosen, o.tolerance, links)) for parts in guesses]
    parts, sets = max(judged, key=lambda x: x[1][0][0])  # the descriptor whose guesses agree more suits the object
    rings = crop_rings(crops, parts)
    best = None
    for support, orientations in distinct([sets[0], *stars(*guesses[parts]), *sets[1:]], o.settled):
        start = poses_of(views, orientations, distance)
        try:
            poses, agreed = settle(views, crops, rings, start, None, o, 2, wide=False, seed=seed, parts=parts)
        except ValueError:  # the silhouettes have nothing in common
            continue
        say(f"a set of poses with support {support:.2f}: mean score {agreed.mean():.3f}")
        if best is None or agreed.mean() > best[1].mean():
            best = poses, agreed
    if best is None:
        raise ValueError("no set of poses agrees with the silhouettes")
    return settle(views, crops, rings, *best, o, o.rounds, wide=True, seed=seed + 10, parts=parts, say=say)


def stars(rotations: np.ndarray, scores: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """The orientations that one inflated instance alone says, best guesses only: [(mean score, (N, 3, 3))], best first. Where all are
    seen from about one side this is better than any vote."""
    best = scores.argmax(2)
    mean = np.take_along_axis(scores, best[..., None], 2)[..., 0].sum(1) + 1  # its own score is -1
    picked = np.take_along_axis(rotations, best[..., None, None, None], 2)[:, :, 0]
    own = np.take_along_axis(scores, best[..., None], 2)[..., 0] <= -1
    picked[own] = np.eye(3)
    return [(float(mean[s] / max(scores.shape[1] - 1, 1)), picked[s]) for s in np.argsort(-mean)]


def distinct(sets: list[tuple[float, np.ndarray]], most: int) -> list[tuple[float, np.ndarray]]:
    """The first sets of orientations that differ from each other by more than their frame: a median of 8 degrees or more."""
    kept: list[tuple[float, np.ndarray]] = []
    for support, r in sets:
        different = True
        for _, q in kept:
            frame = nearest_rotation(np.einsum("nji,njk->ik", q, r))
            angles = np.arccos(np.clip((np.einsum("nij,nij->n", r, q @ frame) - 1) / 2, -1, 1))
            different &= bool(np.median(angles) > np.radians(8))
        if different:
            kept.append((support, r))
        if len(kept) == most:
            break
    return kept
