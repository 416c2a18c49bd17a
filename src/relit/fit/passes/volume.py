"""The volume pass: topology and shape by volume rendering of a signed distance field, coarse to
fine.

NeuS's rendering (rendering/march.py) with a deferred appearance
(rendering/appearance/fixed_light.py) against mini-batches of pixels from all photos. Levels double
the grid; between levels the field is made a distance again and the band is cut anew around the
surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from relit.fit.passes.camera_corrections import (
    CameraCorrections,
    CorrectionModel,
    without_common_motion,
)
from relit.fit.passes.losses import display_loss, mask_loss, normal_loss
from relit.fit.passes.optimiser import Adam, cosine_decay, memory, recall, run_steps
from relit.fit.passes.pixels import (
    PixelBank,
    RayBatch,
    batch_of,
    camera_rows,
    draw_pixels,
    rays_through,
    saturated_at,
    unlimited,
    well_exposed,
)
from relit.fit.passes.preview import volume_preview
from relit.geometry.sdf import (
    SdfGrid,
    dense_values,
    make_grid,
    neighbour_mean_difference,
    redistance,
    resample,
    row_features,
    smoothness_gradient,
    write_rows,
)
from relit.records import from_arrays, to_arrays
from relit.rendering.appearance.fixed_light import (
    CHANNELS,
    shade,
    start_features,
    start_reflections,
)
from relit.rendering.background import Background, render_background
from relit.rendering.march import Marched, march, sphere_interval
from relit.scene import Camera


@dataclass(frozen=True)
class VolumeOptions:
    """One entry of `levels` and `steps` per level (nodes a side, optimisation steps). rays: rays
    per step.

    sdf_rate: largest move of a distance per step, in voxels; feature_rate: of a feature. sharpness:
    inv_s * h at the start and the end of a level. step: smallest marching step in voxels. eikonal,
    mask, normal: weights of the terms; mask for each level, the last one for all further ones.
    diffusion: per step the field moves by -diffusion L L S (decaying like the rates), L the mean of
    the neighbours minus the
    value: noise of the grid's own scale dies out, curvature stays. band: half width of the
    optimised band, voxels. calm: see Adam's floor: distances with little evidence, such as under a
    glossy coat, are left to the smoothing. refine_cameras: step of the camera corrections (radians,
    unit lengths), 0 for fixed.
    hold: steps before the cameras move: they would follow the shape that the pass begins with.
    """

    levels: tuple[int, ...] = (64, 128, 192)
    steps: tuple[int, ...] = (300, 450, 350)
    rays: int = 8192
    sdf_rate: float = 0.1
    feature_rate: float = 0.02
    sharpness: tuple[float, float] = (3.0, 8.0)
    step: float = 0.9
    eikonal: float = 0.1
    diffusion: float = 0.2
    mask: tuple[float, ...] = (0.8,)
    normal: float = 0.05
    band: float = 5.0
    calm: float = 0.5
    refine_cameras: float = 0.0
    hold: int = 0


@dataclass
class VolumeModel:
    """What the pass optimises. grid: SDF and features. reflections: the learnt reflection map.
    background: or None.

    appearance: another deferred appearance than rendering/appearance/fixed_light.py's, called as
    f(marched, rays, cameras, reflections) -> (radiance Color3f premultiplied with opacity, unit
    normal Vector3f); `reflections` is then whatever flat Float it learns, each entry with its own
    rate, `rates` (Float, or a function of the step that gives it; times 0.06).

    correction_ratios: factors on the rate of the camera corrections, Float as wide as they are, or
    None for 1.

    mirrored: rays that bound the shape besides, mirrored (fit/duplicates/mirrored_silhouettes.py's
    MirroredRays), or None."""

    grid: SdfGrid
    reflections: Any
    background: Background | None
    inv_s: float = 0.0
    correction_ratios: Any = None
    appearance: Callable | None = None
    rates: Any = 1.0
    mirrored: Any = None

    def shade(self, m: Marched, rays: RayBatch, cameras):
        """Radiance premultiplied with opacity, and unit normal. cameras: as `PixelBank.cameras`."""
        return (
            shade(m, rays.d, self.reflections)
            if self.appearance is None
            else self.appearance(m, rays, cameras, self.reflections)
        )


@dataclass(frozen=True)
class VolumeResult:
    """What a volume pass ends with, and what its checkpoints keep.

    values: (n, n, n) float32 distances, in units of the unit frame. features: (R, C) float32, a row
    for each optimised node, row 0 for all others. nodes: (R - 1,) uint32, flat numbers of the
    optimised nodes. reflections: see `VolumeModel`. corrections: (views, k) float32 of the cameras,
    as correction_model has them. inv_s: sharpness of the surface (NeuS). background: cells of the background field, or None.
    """

    values: np.ndarray
    features: np.ndarray
    nodes: np.ndarray
    reflections: np.ndarray
    corrections: np.ndarray
    correction_model: CorrectionModel
    inv_s: float
    background: np.ndarray | None = None

    def camera_corrections(self) -> CameraCorrections:
        """The corrections on the device."""
        return CameraCorrections(self.correction_model, mi.Float(self.corrections.ravel()))

    def grid(self) -> SdfGrid:
        """The distances and features on the device."""
        n = self.values.shape[0]
        grid = make_grid(self.values, CHANNELS, band=np.inf)
        index = np.zeros(n**3, np.uint32)
        index[self.nodes] = np.arange(1, len(self.nodes) + 1, dtype=np.uint32)
        grid.index, grid.nodes, grid.rows = (
            mi.UInt32(index),
            mi.UInt32(self.nodes),
            len(self.nodes) + 1,
        )
        inside = self.values.ravel()[self.nodes]
        grid.row_values = mi.Float(np.concatenate([[1.0], inside]).astype(np.float32))
        grid.features = mi.Float(self.features.ravel())
        return grid


def start_model(
    values: np.ndarray, level: np.ndarray, background: Background | None, full: bool
) -> VolumeModel:
    """values: (n, n, n) start distances; level: (3,) mean radiance of the object; full: optimise
    every node."""
    grid = make_grid(values, CHANNELS, band=np.inf if full else 8.0, fill=start_features(level))
    return VolumeModel(grid, start_reflections(float(level.mean())), background)


Mend = Callable[[np.ndarray], np.ndarray]


def next_level(model: VolumeModel, n: int, band: float, mend: Mend | None = None) -> None:
    """Carry the field to n nodes a side: resample, make it a distance again, cut a new band. mend:
    distances (n, n, n) -> what the next level begins with."""
    old = model.grid
    features = np.zeros((old.n**3, old.channels), np.float32)
    rows = row_features(old)
    features[np.array(old.nodes)] = rows[1:]
    known = np.zeros(old.n**3, bool)
    known[np.array(old.nodes)] = True
    features = _fill_unknown(
        features.reshape(old.n, old.n, old.n, -1), known.reshape(old.n, old.n, old.n)
    )
    values = redistance(resample(dense_values(old), n))
    if mend is not None:
        values = redistance(mend(values))
    model.grid = make_grid(values, old.channels, band=band, features=resample(features, n))


def _fill_unknown(features: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Nearest known value for nodes outside the band, so that resampling does not mix in zeros."""
    from scipy.ndimage import distance_transform_edt

    if known.all():
        return features
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return features[tuple(nearest)]


def fit_volume(
    bank: PixelBank,
    model: VolumeModel,
    options: VolumeOptions,
    stage,
    seed: int = 0,
    begin_level: Callable[[VolumeModel], None] | None = None,
    mend: Mend | None = None,
) -> VolumeModel:
    """Run all levels; returns the same model, optimised. Resumes from the stage's checkpoint when
    there is one. begin_level: called with the model before every level but the first, and where a
    level is taken up again. mend: after the first level, see `next_level`."""
    done = 0
    saved = stage.load("checkpoint")
    start = int(saved["step"]) if saved else 0
    camera_adam = Adam(dr.width(bank.corrections.values))
    for number, (n, steps) in enumerate(zip(options.levels, options.steps, strict=False)):
        if start >= done + steps and number + 1 < len(options.levels):
            done += steps
            continue
        if saved and start > done:
            restore_model(model, bank, from_arrays(VolumeResult, saved))
        elif model.grid.n != n:
            next_level(model, n, options.band, mend if number == 1 else None)
        if start >= done + steps:
            break
        if begin_level is not None and number > 0:
            begin_level(model)
        weight = options.mask[min(number, len(options.mask) - 1)]
        span = {"first": max(start, done), "begin": done, "end": done + steps}
        _fit_level(
            bank, model, options, stage, camera_adam, **span, mask=weight, saved=saved, seed=seed
        )
        done += steps
    stage.save(
        "checkpoint", step=done, **to_arrays(volume_result(model, bank))
    )  # a stop during the mesh stage need not come back here
    return model


def _fit_level(bank, model, options, stage, camera_adam, *, first, begin, end, mask, saved, seed):
    grid = model.grid
    h, count = grid.h, options.rays
    rng = mi.PCG32(size=count, initstate=seed * 7919 + begin)
    refine = options.refine_cameras > 0 and end > options.hold
    ratios = model.correction_ratios
    # cameras that stay tell where the scene is
    held = ratios is not None and not np.array(ratios).reshape(bank.views, -1).any(axis=1).all()
    adam = {
        "sdf": Adam(grid.rows, floor=options.calm),
        "features": Adam(grid.rows * grid.channels),
        "reflections": Adam(dr.width(model.reflections)),
        "cameras": camera_adam,
    }
    if model.background is not None:
        adam["background"] = Adam(dr.width(model.background.cells))
    if first > begin:  # the next level has a grid of its own
        recall(saved, rng, adam)
    dt = dr.opaque(mi.Float, options.step * h)
    mask = dr.opaque(mi.Float, mask)

    def step(i: int) -> dict:
        e = (i - begin) / max(end - begin, 1)
        decay = cosine_decay(e, 0.1)
        model.inv_s = (options.sharpness[0] * (1 - e) + options.sharpness[1] * e) / h
        inv_s = dr.opaque(mi.Float, model.inv_s)

        params = [grid.row_values, grid.features, model.reflections]
        if model.background is not None:
            params.append(model.background.cells)
        if refine:
            params.append(bank.corrections.values)
        dr.enable_grad(*params)

        pixel = draw_pixels(bank, rng, count)
        if model.mirrored is not None:
            pixel, flipped = model.mirrored.drawn(pixel, rng)
        jitter = rng.next_float32()
        dr.eval(pixel, jitter, rng)
        batch = batch_of(bank, pixel, bank.corrections if refine else None)
        if model.mirrored is not None:
            model.mirrored.turned(batch, flipped)
        with dr.suspend_grad():
            t0, t1 = sphere_interval(dr.detach(batch.o), dr.detach(batch.d))
            hit = t1 > t0
            t0 = t0 + jitter * dt
        dr.eval(batch.o, batch.d, batch.rgb, batch.mask, t0, t1)
        m = march(grid, batch.o, batch.d, t0, t1, inv_s, dt)
        colour, normal = model.shade(m, batch, bank.cameras)
        if model.background is not None:
            colour = colour + m.transmittance * render_background(
                model.background, batch.o, batch.d, jitter
            )
        # with masks, only whole object pixels: silhouettes are the mask term's, which has no
        # preference for dark or bright
        counts = hit & (batch.mask > 0.99) if bank.masked else None
        if model.mirrored is not None:  # they tell of silhouettes alone
            counts = counts & ~flipped
        if bank.drop_saturated and not unlimited(
            bank.saturated
        ):  # "at least this bright", taken at its word, pulls highlights down
            exposed = well_exposed(batch.rgb, saturated_at(bank, batch.view))
            counts = exposed if counts is None else counts & exposed
        loss = display_loss(colour, batch.rgb, counts)
        report = {"colour": loss}
        if bank.masked:
            term = mask_loss(m.opacity, batch.mask)
            report["mask"] = term
            loss = loss + mask * term
        if batch.normal is not None:
            known = (
                batch.has_normal
                if model.mirrored is None
                else dr.select(flipped, 0, batch.has_normal)
            )
            loss = loss + options.normal * normal_loss(
                normal, batch.normal, known * dr.detach(m.opacity)
            )
        dr.backward(loss)

        smooth, diffusion = smoothness_gradient(grid, dr.opaque(mi.Float, options.eikonal))
        gradients = [dr.grad(grid.row_values) + smooth] + [dr.grad(p) for p in params[1:]]
        dr.disable_grad(*params)
        dr.eval(gradients, diffusion, report)
        kappa = dr.opaque(mi.Float, options.diffusion * (0.3 + 0.7 * decay))
        moved = adam["sdf"].step(
            dr.detach(grid.row_values), gradients[0], options.sdf_rate * h * decay
        )
        grid.row_values = moved - kappa * neighbour_mean_difference(grid, diffusion)
        grid.features = adam["features"].step(
            dr.detach(grid.features), gradients[1], options.feature_rate * decay
        )
        rates = model.rates(i) if callable(model.rates) else model.rates
        model.reflections = adam["reflections"].step(
            dr.detach(model.reflections), gradients[2], 0.06 * decay, rates
        )
        if model.background is not None:
            model.background.cells = adam["background"].step(
                dr.detach(model.background.cells), gradients[3], 0.05 * decay
            )
        if refine:
            rate = options.refine_cameras * decay if i >= options.hold else 0.0
            moved = camera_adam.step(
                dr.detach(bank.corrections.values),
                gradients[-1],
                rate,
                1.0 if ratios is None else ratios,
            )
            free = CameraCorrections(bank.corrections.model, moved)
            bank.corrections = free if held else without_common_motion(free, bank.cameras)
            dr.schedule(bank.corrections.values)  # a checkpoint then changes no rounding
        dr.eval(grid.row_values)
        write_rows(grid)
        return report

    corrections = (lambda: bank.corrections) if refine else None
    state = lambda: {**to_arrays(volume_result(model, bank)), **memory(rng, adam)}  # noqa: E731
    run_steps(
        stage,
        first,
        end,
        step,
        state,
        preview=volume_preview(bank, model, options.step, corrections),
    )


def render_views(model: VolumeModel, cameras: list[Camera], step: float = 0.9) -> list[np.ndarray]:
    """Linear pictures (H, W, 3) of the fitted field, background included, from `cameras` (unit
    frame)."""
    rows, pictures = mi.Float(camera_rows(cameras)), []
    inv_s, dt = dr.opaque(mi.Float, model.inv_s), dr.opaque(mi.Float, step * model.grid.h)
    for view, camera in enumerate(cameras):
        index = dr.arange(mi.UInt32, camera.width * camera.height)
        x, y = mi.Float(index % camera.width) + 0.5, mi.Float(index // camera.width) + 0.5
        number = dr.opaque(mi.UInt32, view, camera.width * camera.height)
        o, d = rays_through(rows, number, x, y)
        t0, t1 = sphere_interval(o, d)
        dr.eval(o, d, t0, t1)
        m = march(model.grid, o, d, t0, t1, inv_s, dt)
        colour, _ = model.shade(m, RayBatch(o, d, None, None, number, index), rows)
        colour = dr.select(t1 > t0, colour, 0)
        if model.background is not None:
            half = dr.full(mi.Float, 0.5, dr.width(index))
            colour = colour + dr.select(t1 > t0, m.transmittance, 1) * render_background(
                model.background, o, d, half
            )
        pictures.append(np.array(dr.detach(colour)).T.reshape(camera.height, camera.width, 3))
    return pictures


def volume_result(model: VolumeModel, bank: PixelBank) -> VolumeResult:
    """The state of the pass as arrays."""
    grid, background = model.grid, model.background
    return VolumeResult(
        values=dense_values(grid),
        features=row_features(grid),
        nodes=np.array(grid.nodes),
        reflections=np.array(model.reflections),
        corrections=bank.corrections.numbers,
        correction_model=bank.corrections.model,
        inv_s=float(model.inv_s),
        background=None if background is None else np.array(background.cells),
    )


def restore_model(model: VolumeModel, bank: PixelBank, state: VolumeResult) -> None:
    """Inverse of `volume_result`: put the arrays into the model and the bank."""
    model.grid = state.grid()
    model.reflections = mi.Float(state.reflections)
    bank.corrections = state.camera_corrections()
    model.inv_s = state.inv_s
    if model.background is not None:
        model.background.cells = mi.Float(state.background)
