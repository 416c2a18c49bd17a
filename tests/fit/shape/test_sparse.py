import numpy as np
from scipy.sparse import bmat, diags, random_array

from relit.fit.shape.sparse import solved_symmetric


def test_few_dense_rows_beside_a_mesh():
    """As poses are among vertices: they meet all of them."""
    rng = np.random.default_rng(0)
    vertices, poses = 400, 12
    chain = diags(
        [-np.ones(vertices - 1), np.full(vertices, 3.0), -np.ones(vertices - 1)], [-1, 0, 1]
    )
    seen = random_array((poses, vertices), density=0.8, rng=rng)
    matrix = bmat([[500 * diags(np.ones(poses)), seen], [seen.T, chain]])
    right = rng.normal(size=(poses + vertices, 2))
    expected = np.linalg.solve(matrix.toarray(), right)
    np.testing.assert_allclose(solved_symmetric(matrix, right), expected, atol=1e-8)
    np.testing.assert_allclose(solved_symmetric(matrix, right[:, 0]), expected[:, 0], atol=1e-8)
