"""The surface pass under a flash: gradients against finite differences, and what it finds on a ball
whose photos it could have made."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from relit.fit.flash.lobe_clusters import best_lobes, start_kinship
from relit.fit.flash.surface import (
    FlashModel,
    FlashSurfaceOptions,
    FlashTerms,
    brightest_albedo,
    calm_weights,
    fit_flash_surface,
    offset_of,
    paired_loss,
    rescale,
    robust_weight,
)
from relit.fit.passes.optimiser import NoStage
from relit.fit.passes.pixels import batch_of
from relit.lighting.flash import light_position
from relit.materials.plastic_field import PlasticField, plastic_at, plastic_pictures, start_plastic
from relit.materials.rough_plastic import Coat
from relit.rendering.transport import bent_normal, first_hits
from relit.rendering.transport_flash import direct, indirect, lit
from support import flash_ball as scene


@pytest.fixture(scope="module")
def shot(device):
    return scene.capture()


PARAMETERS = ("offset", "log_intensity", "diffuse", "specular", "alpha", "slope")


def loss_of(shot, offset, log_intensity, field, bounces=0):
    """A smooth function of everything that the pass moves, over some pixels, the visibility left
    out."""
    bank, _, mesh, _ = shot
    pixel = dr.arange(mi.UInt32, 0, bank.total, 7)
    batch = batch_of(bank, pixel)
    points = first_hits(mesh, batch.o, batch.d)
    points.valid &= dr.dot(points.n, points.v) > 0.3
    dr.eval(points, batch.rgb, batch.view)
    position = light_position(bank.cameras, batch.view, offset_of(offset))
    intensity = dr.exp(dr.gather(mi.Float, log_intensity, mi.UInt32(0)))
    plastic, slope = plastic_at(field, points.uv, points.valid)
    n = bent_normal(points, slope)
    value = direct(points, plastic, Coat(), n, position, intensity, mi.Float(1))
    return dr.sum(dr.select(points.valid, dr.sum(dr.square(value - 0.8 * batch.rgb)), 0))


@pytest.mark.slow
@pytest.mark.parametrize("name", PARAMETERS)
def test_gradients(shot, name):
    field = scene.textures(16)
    values = {
        "offset": mi.Float(-0.05, 0.1, 0.02),
        "log_intensity": mi.Float([1.5]),
        "diffuse": mi.Float(field.diffuse),
        "lobe": mi.Float(field.lobe),
        "slope": mi.Float(
            np.random.default_rng(1).normal(0, 0.05, dr.width(field.slope)).astype(np.float32)
        ),
    }
    array = "lobe" if name in ("specular", "alpha") else name
    rng = np.random.default_rng(2)
    direction = np.abs(
        rng.normal(size=dr.width(values[array]))
    )  # one sign: the sum does not cancel down to rounding errors
    if array == "lobe":
        direction[(np.arange(len(direction)) % 2) != (name == "alpha")] = 0

    def at(t, grad=False):
        moved = {k: mi.Float(v) for k, v in values.items()}
        moved[array] = mi.Float((np.array(values[array]) + t * direction).astype(np.float32))
        if grad:
            dr.enable_grad(moved[array])
        field.diffuse, field.lobe, field.slope = moved["diffuse"], moved["lobe"], moved["slope"]
        loss = loss_of(shot, moved["offset"], moved["log_intensity"], field)
        if not grad:
            return float(loss[0])
        dr.backward(loss)
        return float(np.array(dr.grad(moved[array])) @ direction)

    h = 2e-3
    assert at(0, grad=True) == pytest.approx((at(h) - at(-h)) / (2 * h), rel=0.03)


def fitted(shot, kin=True, **options):
    """The model after a short fit from a co-located flash and one grey material."""
    bank, views, mesh, truth = shot
    size = truth.size
    true = plastic_pictures(truth)
    flat = np.full((size, size), 0.5, np.float32)
    start = start_plastic(0.9 * true["diffuse"], flat, 0.2 * flat / 0.5)
    features = np.concatenate([np.sqrt(true["diffuse"]), np.zeros((size, size, 1))], -1).astype(
        np.float32
    )
    kinship = None
    if kin:
        kinship = start_kinship(
            features[..., :3],
            np.ones((size, size), bool),
            np.stack([flat, 0.4 * flat], -1),
            groups=6,
        )
    model = FlashModel(
        start,
        mi.Float(features.ravel()),
        kinship,
        dr.zeros(mi.Float, 3),
        mi.Float([np.log(scene.INTENSITY)]),
        Coat(),
    )
    settings = {"steps": 200, "points": 2048, "directions": 0, "offset_rate": 0.006, **options}
    terms = FlashTerms(bank, views, mesh, model, FlashSurfaceOptions(**settings))
    fit_flash_surface(terms, NoStage())
    return model


@pytest.fixture(scope="module")
def found(shot):
    return fitted(shot)


@pytest.mark.slow
def test_offset_is_found_from_a_flash_at_the_camera(found):
    offset = np.array(found.offset)
    angle = np.degrees(np.linalg.norm(offset[:2] - scene.OFFSET[:2]) / 3.0)
    assert angle < 0.3  # 3.1 degrees at the start


def test_lobes_are_found_for_both_paints(shot, found):
    true, got = plastic_pictures(shot[3]), plastic_pictures(found.field)
    rows = slice(8, -12)  # the cameras look from above
    bright = true["diffuse"][rows, :, 0] > 0.3
    for paint in (bright, ~bright):
        assert np.median(got["alpha"][rows][paint]) == pytest.approx(
            np.median(true["alpha"][rows][paint]), rel=0.15
        )
        assert np.median(got["specular"][rows][paint]) == pytest.approx(
            np.median(true["specular"][rows][paint]), rel=0.2
        )


@pytest.mark.slow
def test_patches_lead_to_the_offset_too(shot):
    model = fitted(shot, patches=0.3, steps=60, kin=False)
    assert np.linalg.norm(np.array(model.offset)[:2] - scene.OFFSET[:2]) < 0.6 * np.linalg.norm(
        scene.OFFSET[:2]
    )


def test_fixed_offset_stays(shot):
    model = fitted(shot, steps=3, offset_rate=0.0, kin=False)
    np.testing.assert_array_equal(np.array(model.offset), 0)


def test_shadow_is_cast_by_the_ball_itself(shot):
    bank, _, mesh, _ = shot
    batch = batch_of(bank, dr.arange(mi.UInt32, bank.total))
    points = first_hits(mesh, batch.o, batch.d)
    dr.eval(points)
    behind = lit(mesh, points, mi.Vector3f(0, -3, 0), points.valid)
    facing = np.array(points.geometric.y) < -0.3
    hit = np.array(points.valid)
    assert (
        np.array(behind)[hit & facing].mean() > 0.99
        and np.array(behind)[hit & (np.array(points.geometric.y) > 0.1)].max() == 0
    )


def test_a_convex_body_has_no_inter_reflection(shot):
    bank, _, mesh, field = shot
    batch = batch_of(bank, dr.arange(mi.UInt32, 0, bank.total, 5))
    points = first_hits(mesh, batch.o, batch.d)
    dr.eval(points, batch.view)
    plastic, _ = plastic_at(field, points.uv, points.valid)
    position = light_position(bank.cameras, batch.view, mi.Vector3f(0.1, 0, 0))
    dr.eval(plastic, position)
    rng = mi.PCG32(size=dr.width(points.uv))
    light = indirect(mesh, field, Coat(), points, plastic, points.n, position, mi.Float(1), rng, 2)
    value = np.array(light)
    assert np.isfinite(value).all() and value.mean() < 1e-4


def test_even_pixels_count_more_than_edges(shot):
    bank, views, _, _ = shot
    weights = np.array(calm_weights(bank, views, 0.06)).reshape(len(views), 40, 40)
    masks = np.array(bank.rgbm).reshape(len(views), 40, 40, 4)[..., 3]
    assert weights[masks == 0].max() <= 1 and weights[0, 0, 0] == 1
    rim = (masks[0] > 0.5) & (np.roll(masks[0], 1, 1) < 0.5)
    assert weights[0][rim].mean() < 0.3


def test_common_scale_is_restored_and_direct_light_stays(shot):
    bank, _, mesh, field = shot
    brightest = brightest_albedo(field)
    batch = batch_of(bank, dr.arange(mi.UInt32, 0, bank.total, 11))
    points = first_hits(mesh, batch.o, batch.d)
    dr.eval(points, batch.view)

    def picture(model):
        plastic, _ = plastic_at(model.field, points.uv, points.valid)
        intensity = dr.exp(dr.gather(mi.Float, model.log_intensity, mi.UInt32(0)))
        return np.array(
            direct(points, plastic, Coat(), points.n, mi.Vector3f(0, 0, 3), intensity, mi.Float(1))
        )

    factors = mi.Float(np.tile([0.8, 1.0], field.size**2).astype(np.float32))
    darker = PlasticField(field.size, field.diffuse * 0.8, field.lobe * factors, field.slope)
    model = FlashModel(darker, None, None, mi.Vector3f(0), mi.Float([1.0]), Coat())
    before = picture(model)
    rescale(model, brightest)
    assert brightest_albedo(model.field) == pytest.approx(brightest, rel=1e-5)
    assert float(model.log_intensity[0]) == pytest.approx(1 + np.log(0.8), abs=1e-5)
    np.testing.assert_allclose(picture(model), before, rtol=1e-4, atol=1e-6)


def test_noise_of_inter_reflection_does_not_move_the_base(device):
    """Few directions carry most of the light that comes back. With the weight of residuals that
    have that noise, bright estimates hardly count and the base would be told to be brighter."""
    count = 400_000
    rng = np.random.default_rng(1)
    back = [
        mi.Color3f(mi.Float(rng.lognormal(-4.0, 1.5, count).astype(np.float32))) for _ in range(2)
    ]
    expected_back = float(np.exp(-4.0 + 1.5**2 / 2))
    target, sigma = mi.Color3f(0.3 + expected_back), mi.Float(0.1)

    def pull(weight_of):
        base = mi.Float(0.3)
        dr.enable_grad(base)
        a, b = (mi.Color3f(base) + other for other in back)
        trust = robust_weight(weight_of(dr.detach(a), dr.detach(b)) - target, target, sigma)
        dr.backward(paired_loss(a, b, target, mi.Mask(True), trust, mi.Float(1e9)))
        return float(dr.grad(base)[0])

    known = pull(lambda a, b: mi.Color3f(0.3 + 0.8 * expected_back))  # rough, and without noise
    noisy = pull(lambda a, b: (a + b) * 0.5)
    assert noisy < 0  # a descent would brighten the base
    assert abs(known) < 0.1 * abs(noisy)


def test_a_group_without_evidence_stays():
    level = np.array([[0.4, 0.2], [0.7, 0.3]])
    sums = np.zeros((18, 2, 4, 4))
    sums[:, 1] = np.eye(4)
    out = best_lobes(sums, level)
    np.testing.assert_allclose(out[0], [0.4, 0.2, 1, 0])
