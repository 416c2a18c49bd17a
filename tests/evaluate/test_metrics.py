"""Figures against values worked out by hand."""

import numpy as np
import pytest

from relit.conventions import srgb_from_linear
from relit.evaluate import metrics as m


def test_psnr_of_a_constant_error():
    a = np.full((8, 8, 3), 0.5)
    assert m.psnr(a, a + 0.1) == pytest.approx(20.0)
    assert m.psnr(a, a) == 100.0


def test_psnr_inside_a_mask_ignores_the_rest():
    a, b = np.zeros((4, 4, 3)), np.zeros((4, 4, 3))
    b[:2] = 0.1
    inside = np.zeros((4, 4), bool)
    inside[:2] = True
    assert m.psnr(a, b, inside) == pytest.approx(20.0)
    assert m.psnr(a, b) == pytest.approx(
        20.0 + 10 * np.log10(2)
    )  # half of the pixels are without error
    assert np.isnan(m.psnr(a, b, np.zeros((4, 4), bool)))


def test_pictures_are_clipped_and_encoded():
    assert m.encode(np.array([4.0]))[0] == pytest.approx(1.0)
    assert m.encode(np.array([0.2]))[0] == pytest.approx(srgb_from_linear(0.2))


def test_ssim_of_equal_constant_and_unrelated_pictures():
    rng = np.random.default_rng(0)
    a, b = rng.random((32, 32, 3)), rng.random((32, 32, 3))
    assert m.ssim(a, a) == pytest.approx(1.0)
    assert abs(m.ssim(a, b)) < 0.1
    # two constants: variances vanish, (2 x y + c1) / (x^2 + y^2 + c1) is left
    x, y = np.full((16, 16), 0.25), np.full((16, 16), 0.5)
    assert m.ssim(x, y) == pytest.approx((2 * 0.125 + 1e-4) / (0.0625 + 0.25 + 1e-4))


def test_ssim_agrees_with_scikit_image():
    from skimage.metrics import structural_similarity

    rng = np.random.default_rng(1)
    a = rng.random((40, 40))
    b = np.clip(a + 0.1 * rng.normal(size=a.shape), 0, 1)
    ours = m.ssim_map(a, b)
    theirs = structural_similarity(
        a,
        b,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )[1]
    np.testing.assert_allclose(ours[6:-6, 6:-6], theirs[6:-6, 6:-6], atol=1e-7)


def test_normals_turned_by_a_known_angle():
    n = np.random.default_rng(2).normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    axis = np.cross(n, [0.3, -0.5, 0.8])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turned = n * np.cos(np.radians(12)) + np.cross(axis, n) * np.sin(np.radians(12))
    np.testing.assert_allclose(m.normal_angles(turned * 3, n), 12.0, atol=1e-6)
    np.testing.assert_allclose(m.normal_angles(-n, n), 180.0, atol=1e-6)
    assert m.normal_angles(n.astype(np.float32), n).max() < 1e-4
    np.testing.assert_array_equal(m.normal_angles(np.zeros((2, 3)), n[:2]), 90.0)


def test_albedo_scale_undoes_a_known_scale():
    truth = np.random.default_rng(3).random((100, 3))
    np.testing.assert_allclose(m.albedo_scale(truth / [0.5, 2.0, 1.25], truth), [0.5, 2.0, 1.25])
    np.testing.assert_array_equal(m.albedo_scale(np.zeros((4, 3)), truth[:4]), 1.0)


def test_surface_samples_are_uniform_by_area():
    vertices = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0]], float)
    surface = m.sample_surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), 30_000)
    points = surface.points[surface.uniform]
    assert points.min() >= 0 and (points <= [3, 1, 0]).all()
    np.testing.assert_allclose(points.mean(0), [1.5, 0.5, 0.0], atol=0.02)
    np.testing.assert_allclose(points.var(0), [9 / 12, 1 / 12, 0], atol=0.02)
    assert (
        (points[:, 1] < points[:, 0] / 3) == (surface.triangle[surface.uniform] == 0)
    ).mean() > 0.999


def test_nearest_point_of_a_triangle_inside_at_an_edge_and_at_a_corner():
    a, b, c = (np.array(x, float) for x in ([0, 0, 0], [4, 0, 0], [0, 4, 0]))
    cases = {
        (1, 1, 2): (1, 1, 0),
        (2, -3, 1): (2, 0, 0),
        (3, 3, -1): (2, 2, 0),
        (-1, -2, 5): (0, 0, 0),
        (9, -1, 0): (4, 0, 0),
    }
    for point, nearest in cases.items():
        np.testing.assert_allclose(
            m.closest_on_triangles(np.array(point, float), a, b, c), nearest, atol=1e-12
        )
        np.testing.assert_allclose(
            m.closest_on_triangles(np.array(point, float), a, c, b), nearest, atol=1e-12
        )  # either winding
    np.testing.assert_allclose(
        m.closest_on_triangles(np.array([1.0, 1, 0]), a, b, b), [1, 0, 0]
    )  # no area: an edge is left


def test_chamfer_of_spheres():
    import trimesh

    sphere = trimesh.creation.icosphere(5)
    a = m.sample_surface(sphere.vertices, sphere.faces, 10_000, seed=0)
    b = m.sample_surface(sphere.vertices, sphere.faces, 10_000, seed=1)
    assert m.chamfer(a, b)[0] < 2e-4  # far below the spacing of the samples, .018
    larger = m.sample_surface(1.1 * sphere.vertices, sphere.faces, 10_000, seed=2)
    mean, out, back = m.chamfer(a, larger)
    assert mean == pytest.approx(0.1, rel=0.01) and mean == pytest.approx((out + back) / 2)
    half = b.only(b.points[:, 2] > 0)
    # from latitude t of the missing half the equator is a chord of 2 sin(t / 2) away: its mean over
    # the hemisphere, weight cos(t) dt
    missing = 2 / 3 * (1 + np.sqrt(0.5)) - 2 * (1 - np.sqrt(0.5))
    _, accuracy, completeness = m.chamfer(half, a)
    assert accuracy < 2e-4 and completeness == pytest.approx(missing / 2, rel=0.03)


def test_environment_figures():
    a = np.full((16, 32, 3), 0.25, np.float32)
    assert m.environment_mse(a, a) == 0.0
    assert m.environment_mse(a, np.ones((64, 128, 3))) == pytest.approx(
        (1 - 0.25 ** (1 / 2.2)) ** 2, rel=1e-4
    )
    assert m.environment_log_rmse(4 * a, a) == pytest.approx(2.0, rel=1e-5)
    # a lamp above the clipping point: only the logarithmic figure sees its strength
    lamp, stronger = a.copy(), a.copy()
    lamp[4:6, 4:8], stronger[4:6, 4:8] = 2.0, 32.0
    assert m.environment_mse(stronger, lamp) < 2e-3 < 0.1 < m.environment_log_rmse(stronger, lamp)


def test_mask_iou():
    a, b = np.zeros((4, 4)), np.zeros((4, 4))
    a[:2], b[1:3] = 1.0, 1.0
    assert m.mask_iou(a, b) == pytest.approx(4 / 12)


def test_ssim_with_a_uniform_window_agrees_with_scikit_image():
    from skimage.metrics import structural_similarity

    rng = np.random.default_rng(2)
    a = rng.random((30, 34, 3))
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)
    pir = structural_similarity(
        a, b, data_range=1.0, win_size=11, sigma=1.5, use_sample_covariance=False, channel_axis=2
    )
    assert m.ssim_uniform(a, b, 11) == pytest.approx(pir, abs=1e-9)
    sfd = structural_similarity(a, b, data_range=0.8, channel_axis=2)
    assert m.ssim_uniform(a, b, 7, 0.8, True) == pytest.approx(sfd, abs=1e-9)


def test_points_of_two_parallel_lines_are_as_far_apart_as_the_lines():
    a = np.array([[0, 0, 0], [1, 0, 0]], float)
    b = np.array([[0, 2, 0], [1, 2, 0], [5, 2, 0]], float)
    mean, to_b, to_a = m.point_chamfer(a, b)
    assert to_b == 2 and to_a == pytest.approx((2 + 2 + np.sqrt(20)) / 3)
    assert mean == pytest.approx((to_a + to_b) / 2)
    assert m.point_chamfer(a, b, squared=True)[1:] == pytest.approx((4, (4 + 4 + 20) / 3))


def test_samples_of_a_surface_are_uniform_by_area():
    """A square of one large triangle and many small ones: the halves get equal shares."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    edge = np.linspace([1, 0, 0], [0, 1, 0], 101)
    vertices = np.concatenate([vertices, edge])
    fan = [[3, 4 + i, 5 + i] for i in range(100)]
    surface = m.sample_surface(vertices, np.array([[0, 1, 2], *fan]), 4000)
    assert surface.samples.shape == (4000, 3) and len(surface.points) == 4101
    assert (surface.samples[:, :2].sum(1) < 1).mean() == pytest.approx(0.5, abs=1e-3)


def test_the_upper_half_of_a_light_is_compared_alone():
    truth = np.full((256, 512, 3), 0.25)
    filled = truth.copy()
    filled[128:] = 1.0
    assert m.environment_mse(filled, truth, upper=True) == pytest.approx(0, abs=1e-12)
    whole = (1 - 0.25 ** (1 / 2.2)) ** 2 / 2
    assert m.environment_mse(filled, truth) == pytest.approx(whole, rel=1e-5)
