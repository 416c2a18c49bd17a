"""Every parameter that a fit moves, against finite differences of the loss that moves it, on small
scenes.

The table PARAMETERS is the list: a new learnable parameter gets its line here.
"""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.conventions import environment_directions
from relit.fit.duplicates.lit_pile import TINT, TOE
from relit.fit.passes.camera_corrections import CameraCorrections, CorrectionModel
from relit.fit.passes.losses import display_loss, dual_loss, mask_loss, normal_loss
from relit.fit.passes.material_priors import (
    SurfaceOptions,
    common_scale,
    light_prior,
    material_prior,
    parsimony,
    slope_prior,
)
from relit.fit.passes.pixels import batch_of, make_bank
from relit.fit.passes.surface_loop import neighbour_points
from relit.geometry.sdf import make_grid, node_positions
from relit.geometry.se3 import look_at
from relit.lighting.environment import Environment
from relit.materials.field import material_at, slope_at, start_material
from relit.rendering import background as bg
from relit.rendering.appearance.fixed_light import CHANNELS, COLUMNS, ROWS, shade
from relit.rendering.march import march, sphere_interval
from relit.rendering.transport import (
    TraceableMesh,
    bent_normal,
    first_hits,
    reflected,
    sample_lights,
)
from relit.scene import Camera
from support.lump import lump

PARAMETERS = {  # name: (scenes whose loss moves it, step of the difference)
    "distances": (("volume", "saddle"), 1e-4),
    "features": (("volume", "saddle"), 2e-3),
    "reflections": (("volume", "saddle"), 1e-2),
    "background": (("volume",), 1e-2),
    "rotations": (("matt", "saddle"), 1e-4),
    "translations": (("matt", "saddle"), 2e-4),
    "colour": (("surface", "pile"), 1e-3),
    "metallic": (("surface", "pile"), 1e-3),
    "slope": (("surface", "pile"), 1e-3),
    "log_light": (("surface", "pile"), 2e-3),
}
N, SIZE, VIEWS = 16, 10, 4
ROUND = ([2.5, 0.3, 0.2], [-1, 2, 1], [0.2, -0.8, 2.4], [0.4, 1.5, -2])
ABOVE = ([0.5, 0.3, 2.2], [-0.5, 0.6, 2.0], [0.2, -0.8, 2.4], [0.4, 0.7, 2.0])


def smooth_map() -> np.ndarray:
    """Log radiance that changes little from texel to texel: the kinks of a bilinear look-up are
    none of a gradient's."""
    d = environment_directions(ROWS, COLUMNS).reshape(-1, 3)
    waves = [
        np.sin(2 * d[:, k] + c) * np.cos(1.5 * d[:, (k + 1) % 3])
        for k, c in enumerate((0.3, 1.0, 2.0))
    ]
    return (np.stack(waves, -1) * 0.8 - 1).astype(np.float32).ravel()


class VolumeScene:
    """The volume pass's loss for a fixed set of rays: colour, mask and normal terms, reflections,
    background.

    The derivative of a normal with respect to the ray is that of the trilinear interpolant within
    its cells: from cell to cell the normal jumps, which no derivative knows. So camera corrections
    are tested on a lumpy object without anything that sees normals (`matt`), and on a saddle, a
    polynomial that trilinear interpolation holds exactly.
    """

    def __init__(self, kind):
        rng = np.random.default_rng(0)
        p = node_positions(N)
        x, y, z = np.moveaxis(p.astype(np.float64), -1, 0)
        values = (
            np.linalg.norm(p - np.array([0.1, 0, 0.05]), axis=-1)
            - 0.55
            + 0.05 * np.sin(5 * x) * np.cos(4 * y)
        )
        if (
            kind == "saddle"
            # seen from one side, near its middle: where it leaves the sphere the quadrature ends within
            # the surface
        ):
            values = z + 0.1 * x + 0.25 * x * y - 0.2 * y * z + 0.1 * x * y * z - 0.05
        features = rng.uniform(0.1, 0.6, (N, N, N, CHANNELS))
        features[..., 3] *= kind != "matt"
        self.normal = 0.0 if kind == "matt" else 0.1
        self.grid = make_grid(
            values.astype(np.float32), CHANNELS, band=np.inf, features=features.astype(np.float32)
        )
        cameras, images, masks, normals = [], [], [], []
        focal = 40.0 if kind == "saddle" else 14.0
        for o in ABOVE if kind == "saddle" else ROUND:
            cameras.append(Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, look_at(o)))
            images.append(rng.uniform(0, 0.9, (SIZE, SIZE, 3)).astype(np.float32))
            masks.append(np.ones((SIZE, SIZE), np.float32))
            n = rng.normal(size=(SIZE, SIZE, 3))
            normals.append((n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32))
        self.bank = make_bank(cameras, images, masks, normals)
        self.pixel = mi.UInt32(np.arange(self.bank.total, dtype=np.uint32))
        cells = rng.normal(size=(8**3, 4)) * [1.5, 0.7, 0.7, 0.7] - [1.0, 1.0, 1.0, 1.0]
        self.field = bg.Background(8, mi.Float(cells.astype(np.float32).ravel()), 12)
        self.inv_s, self.dt = (
            dr.opaque(mi.Float, 1.0 / self.grid.h),
            dr.opaque(mi.Float, 0.1 * self.grid.h),
        )
        self.start = {
            "distances": np.array(self.grid.row_values),
            "features": np.array(self.grid.features),
            "reflections": smooth_map(),
            "background": np.array(self.field.cells),
            "rotations": rng.normal(size=3 * VIEWS).astype(np.float32) * 0.01,
            "translations": rng.normal(size=3 * VIEWS).astype(np.float32) * 0.01,
        }
        # positions along the rays are constants of the quadrature: those of the unchanged
        # parameters
        batch = self.batch({k: mi.Float(v) for k, v in self.start.items()})
        self.t0, self.t1 = sphere_interval(batch.o, batch.d)
        # masks near the opacity that is there: far from it the logarithm is so steep that no step
        # is small enough
        opacity = march(self.grid, batch.o, batch.d, self.t0, self.t1, self.inv_s, self.dt).opacity
        dr.scatter(self.bank.rgbm, 0.9 * opacity, dr.arange(mi.UInt32, self.bank.total) * 4 + 3)
        self.depths = bg.sample_depths(
            self.field, batch.o, batch.d, mi.Float(rng.uniform(0, 1, self.bank.total)), 0
        )

    def batch(self, x):
        row = dr.arange(mi.UInt32, 6 * VIEWS)
        view, k = row // 6, row % 6
        turn = dr.gather(mi.Float, x["rotations"], view * 3 + k, k < 3)
        values = turn + dr.gather(mi.Float, x["translations"], view * 3 + k - 3, k >= 3)
        corrections = CameraCorrections(CorrectionModel.ABOUT_CAMERA, values)
        return batch_of(self.bank, self.pixel, corrections)

    def loss(self, x):
        grid = self.grid
        grid.row_values, grid.features = x["distances"], x["features"]
        dr.scatter(
            grid.values,
            dr.gather(mi.Float, dr.detach(x["distances"]), dr.arange(mi.UInt32, grid.rows - 1) + 1),
            grid.nodes,
        )
        batch = self.batch(x)
        m = march(grid, batch.o, batch.d, self.t0, self.t1, self.inv_s, self.dt)
        colour, normal = shade(m, batch.d, x["reflections"])
        behind = bg.emission(
            replace(self.field, cells=x["background"]), batch.o, batch.d, self.depths
        )[0]
        loss = display_loss(colour + m.transmittance * behind, batch.rgb) + 0.5 * mask_loss(
            m.opacity, batch.mask
        )
        return loss + self.normal * normal_loss(normal, batch.normal, batch.has_normal * m.opacity)


class SurfaceScene:
    """The surface pass's loss for fixed points, directions, visibility and neighbours: two
    estimates against the photo, all priors."""

    def __init__(self, **options):
        rng = np.random.default_rng(1)
        self.options = SurfaceOptions(
            texture=8, light=6, smooth_colour=0.2, light_even=0.02, **options
        )
        mesh, _ = lump()
        self.mesh = TraceableMesh(mesh, rng.uniform(0.1, 0.6, mesh.vertices.shape))
        self.field = start_material(8, rng.uniform(0.1, 0.8, (8, 8, 3)), 0.45, 0.3)
        camera = Camera(
            SIZE, SIZE, 2.0 * SIZE, 2.0 * SIZE, SIZE / 2, SIZE / 2, look_at([1.2, 1.0, 1.4])
        )
        batch = batch_of(
            make_bank([camera], [np.zeros((SIZE, SIZE, 3), np.float32)], [None]),
            mi.UInt32(np.arange(SIZE * SIZE)),
        )
        self.points = first_hits(self.mesh, batch.o, batch.d)
        self.smooth = self.points.n
        self.target = mi.Color3f(*[mi.Float(rng.uniform(0.1, 0.9, SIZE * SIZE)) for _ in range(3)])
        lanes = mi.PCG32(size=SIZE * SIZE, initstate=1)
        self.near = neighbour_points(self.mesh, self.points, 0.15, lanes)
        self.close = neighbour_points(self.mesh, self.points, 0.05, lanes)
        colour = np.array(self.field.colour).reshape(-1, 4)
        colour[:, 3] = rng.uniform(0.3, 0.7, len(colour))
        if self.options.scale_power == 1:
            colour[rng.random(len(colour)) < 0.85, 2] = 0.02  # a channel in which most is black
        d = environment_directions(6, 12)
        self.start = {
            "colour": colour.astype(np.float32).ravel(),
            "metallic": rng.uniform(0.1, 0.9, 64).astype(np.float32),
            "slope": rng.uniform(-0.2, 0.2, 128).astype(np.float32),
            "log_light": (0.7 * np.sin(2 * d + [0, 1, 2])).astype(np.float32).ravel(),
        }
        x = {k: mi.Float(v) for k, v in self.start.items()}
        with dr.suspend_grad():
            surface, environment = self.place(x)
            self.lights = sample_lights(self.mesh, self.points, surface, environment, 16, lanes)
        self.valid = self.points.valid & (dr.dot(self.points.n, self.points.v) > 0.2)
        self.environment = environment

    def place(self, x):
        """The material and light of the parameters, and their normals in the points."""
        self.field.colour, self.field.metallic, self.field.slope = (
            x["colour"],
            x["metallic"],
            x["slope"],
        )
        self.points.n = self.smooth
        self.bend = slope_at(self.field, self.points.uv, self.points.valid)
        self.points.n = bent_normal(self.points, self.bend)
        radiance = dr.exp(x["log_light"])
        if not hasattr(self, "environment"):
            return material_at(self.field, self.points.uv, self.points.valid), Environment(
                radiance, 6, 12
            )
        self.environment.radiance = radiance
        return material_at(self.field, self.points.uv, self.points.valid), self.environment

    def loss(self, x):
        surface, environment = self.place(x)
        a, b = reflected(self.points, self.lights, surface, environment)
        fit = dual_loss(a, b, self.target, self.valid)
        side = mi.Float(
            dr.arange(mi.UInt32, dr.width(self.valid)) % 2
        )  # every other point began as metal
        level = common_scale(surface, self.valid, self.options.scale_power)
        smoothing = mi.Float(self.options.smooth_colour)
        prior = material_prior(
            self.field, surface, self.near, self.valid, level, self.options, smoothing, side
        )
        bend = self.bend.x * self.points.t + self.bend.y * self.points.b
        prior += slope_prior(self.field, bend, self.close, self.valid, self.options)
        prior += parsimony(
            self.field, surface, self.points.uv, self.valid, level, mi.UInt32(7), self.options
        )
        return fit + prior + light_prior(x["log_light"], self.options)


SCENES = {
    "surface": SurfaceScene,
    "pile": lambda: SurfaceScene(scale_power=1.0, parsimony_toe=TOE, light_tint=TINT),
    **{kind: lambda k=kind: VolumeScene(k) for kind in ("volume", "matt", "saddle")},
}


@pytest.fixture(scope="module")
def scenes():
    """Each scene once, with its gradients."""
    import relit.rendering.march as module

    patch = pytest.MonkeyPatch()
    for name, off in {"MIN_ALPHA": 0.0, "MIN_TRANSMITTANCE": 0.0, "ACCELERATE": 1e3}.items():
        patch.setattr(
            module,
            name,
            off,
            # what crosses a threshold, or a step that grows, moves the quadrature: that is no
            # gradient's
        )
    found = {}
    for name, make in SCENES.items():
        scene = make()
        x = {k: mi.Float(v) for k, v in scene.start.items()}
        dr.enable_grad(*x.values())
        dr.backward(scene.loss(x))
        found[name] = scene, {k: np.array(dr.grad(v)) for k, v in x.items()}
    yield found
    patch.undo()


def difference(scene, name, direction, step):
    def at(s):
        changed = scene.start[name] + np.float32(s * step) * direction
        return float(
            scene.loss(
                {**{k: mi.Float(v) for k, v in scene.start.items()}, name: mi.Float(changed)}
            )[0]
        )

    return (at(1) - at(-1)) / (2 * step)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, where", [(name, where) for name, (scenes, _) in PARAMETERS.items() for where in scenes]
)
def test_gradient_agrees_with_finite_differences(scenes, name, where):
    """Along the sign of the gradient, over all entries and over four parts of them, so that errors
    of opposite sign cannot hide."""
    step = PARAMETERS[name][1]
    scene, gradients = scenes[where]
    g = gradients[name]
    assert np.isfinite(g).all() and np.count_nonzero(g) > 0.02 * g.size
    kind = np.arange(g.size) * 4 // g.size
    for chosen in (np.ones(g.size, bool), *(kind == k for k in range(4))):
        direction = (np.sign(g) * chosen).astype(np.float32)
        expected = float((g.astype(np.float64) * direction).sum())
        assert difference(scene, name, direction, step) == pytest.approx(expected, rel=0.02), (
            chosen.mean()
        )


def test_the_list_is_complete(scenes):
    assert {name for scene, _ in scenes.values() for name in scene.start} == set(PARAMETERS)


@pytest.mark.parametrize("darker", [(0.5, 0.5, 0.5), (0.25, 1, 1)])
def test_darkening_everything_is_little_reward(scenes, darker):
    """What darkens in all places alike costs sqrt(factor) of what it did, channel by channel: the
    priors must not darken the object."""
    scene, _ = scenes["surface"]
    scene.place({k: mi.Float(v) for k, v in scene.start.items()})
    grey = scene.start["colour"].reshape(-1, 4)[:, [0, 0, 0, 3]]
    alone = replace(
        scene.options,
        smooth_roughness=0.0,
        smooth_metallic=0.0,
        metallic_binary=0.0,
        metallic_sparse=0.0,
        bright=0.0,
    )
    wide = replace(alone, similarity_width=100.0)

    def smoothness(colour):
        scene.field.colour = mi.Float(colour.ravel())
        surface = material_at(scene.field, scene.points.uv, scene.points.valid)
        level = common_scale(surface, scene.valid, wide.scale_power)
        return float(
            material_prior(
                scene.field, surface, scene.near, scene.valid, level, wide, mi.Float(1.0)
            )[0]
        )

    expected = np.mean(np.sqrt(darker)) * smoothness(grey)
    assert (
        smoothness(grey * np.float32([*darker, 1])) == pytest.approx(expected, rel=1e-3)
        and expected > 0
    )


@pytest.mark.parametrize("mean", [0.05, 0.5])
def test_a_veil_over_what_is_mostly_black_is_no_reward(mean):
    """Where a channel's colours differ by more than their mean, its factor in the priors is what it
    was under a grey veil, and what the channel is multiplied by divides it; elsewhere the mean
    alone counts."""
    base = (
        np.random.default_rng(0)
        .permutation(np.where(np.arange(1000) < 1000 * mean, 1.0, 0.0))
        .astype(np.float32)
    )
    valid = dr.full(mi.Bool, True, len(base))

    def factor(c):
        return float(common_scale(SimpleNamespace(base=mi.Color3f(mi.Float(c))), valid, 1.0).x[0])

    assert factor(base + 0.03) == pytest.approx(factor(base), rel=1e-3)
    assert factor(0.5 * base) == pytest.approx(2 * factor(base), rel=1e-3)
    assert factor(0.1 * base + 0.5) == pytest.approx(0.4 / (0.1 * base + 0.5).mean(), rel=1e-3)


def test_black_that_is_noisy_attracts_itself_without_a_veil():
    """By `parsimony` of a pile; without its toe a veil of .03 would pay."""
    noise = np.abs(np.random.default_rng(0).normal(0, 0.004, (16, 16, 3))).astype(np.float32)
    uv = mi.Point2f(*np.random.default_rng(1).uniform(0, 1, (2, 512)).astype(np.float32))

    def cost(veil, toe):
        field = start_material(16, noise + np.float32(veil), 0.4, 0.0)
        o = SurfaceOptions(scale_power=1.0, parsimony_toe=toe)
        valid = dr.full(mi.Bool, True, 512)
        surface = material_at(field, uv, valid)
        return float(parsimony(field, surface, uv, valid, mi.Color3f(1.0), mi.UInt32(7), o)[0])

    assert cost(0.03, 0.0) < cost(0.0, 0.0) - 0.05 * SurfaceOptions().parsimony
    assert abs(cost(0.03, TOE) - cost(0.0, TOE)) < 0.02 * SurfaceOptions().parsimony
