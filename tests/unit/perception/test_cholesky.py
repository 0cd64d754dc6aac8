"""Small positive definite systems, compared with NumPy."""

import numpy as np
import pytest

from common.perception.cholesky import factor, inverse, inverse_2, substitute


def positive(size: int) -> np.ndarray:
    rows = np.random.default_rng(size).standard_normal((size, 2 * size))
    return rows @ rows.T


@pytest.mark.parametrize("size", [1, 2, 6, 10])
def test_solution_factor_and_inverse_are_numpys(size):
    matrix, right = positive(size), np.arange(1.0, size + 1)
    lower, solution, found = np.zeros((size, size)), right.copy(), np.zeros((size, size))
    factor(matrix, lower)
    substitute(lower, solution, solution)  # in place
    inverse(lower, found)

    np.testing.assert_allclose(lower, np.linalg.cholesky(matrix), rtol=1e-12)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), rtol=1e-9)
    np.testing.assert_allclose(found, np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)


def test_only_the_lower_triangle_is_read():
    matrix, lower = np.tril(positive(4)), np.zeros((4, 4))
    factor(matrix, lower)

    np.testing.assert_allclose(lower, np.linalg.cholesky(positive(4)), rtol=1e-12)


def test_a_matrix_that_is_not_positive_definite_gives_nan():
    lower = np.zeros((2, 2))
    factor(np.array([[1.0, 2.0], [2.0, 1.0]]), lower)

    assert np.isnan(lower[1, 1])


def test_the_inverse_of_two_unknowns_is_numpys():
    matrix = positive(2)
    found = np.linalg.inv(matrix)

    np.testing.assert_allclose(
        inverse_2(matrix[0, 0], matrix[1, 0], matrix[1, 1]),
        [found[0, 0], found[1, 0], found[1, 1]],
        rtol=1e-9,
    )
