from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from wholearm.collocation import radau

DEGREES = [1, 2, 3, 4, 5, 6]
ROOT = np.sqrt(6.0)


@pytest.mark.parametrize(
    "degree, points",
    [
        (1, [1.0]),
        (2, [1 / 3, 1.0]),
        (3, [(4 - ROOT) / 10, (4 + ROOT) / 10, 1.0]),
        # To the six digits that tables of the nodes on [-1, 1] print.
        (4, [(1 - 0.822824) / 2, (1 - 0.181066) / 2, (1 + 0.575319) / 2, 1.0]),
    ],
)
def test_points_are_the_tabulated_ones(degree: int, points: list[float]) -> None:
    np.testing.assert_allclose(radau(degree).points, points, atol=3e-7 if degree > 3 else 1e-14)


def test_two_and_three_stages_have_butchers_coefficients() -> None:
    two = [[5 / 12, -1 / 12], [3 / 4, 1 / 4]]
    np.testing.assert_allclose(radau(2).integrals, two, atol=1e-15)
    three = [
        [(88 - 7 * ROOT) / 360, (296 - 169 * ROOT) / 1800, (-2 + 3 * ROOT) / 225],
        [(296 + 169 * ROOT) / 1800, (88 + 7 * ROOT) / 360, (-2 - 3 * ROOT) / 225],
        [(16 - ROOT) / 36, (16 + ROOT) / 36, 1 / 9],
    ]
    np.testing.assert_allclose(radau(3).integrals, three, atol=1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_points_increase_and_end_at_one(degree: int) -> None:
    scheme = radau(degree)
    assert scheme.degree == degree == len(scheme.points)
    assert scheme.points[0] > 0 and (np.diff(scheme.points) > 0).all() and scheme.points[-1] == 1.0
    assert radau(degree) is scheme


@pytest.mark.parametrize("degree", DEGREES)
def test_integrals_are_exact_up_to_the_degree(degree: int) -> None:
    scheme = radau(degree)
    for power in range(degree):
        exact = scheme.points ** (power + 1) / (power + 1)
        # Rounding, which inverting the powers enlarges a little.
        np.testing.assert_allclose(scheme.integrals @ scheme.points**power, exact, atol=1e-13)
    over = scheme.integrals @ scheme.points**degree - scheme.points ** (degree + 1) / (degree + 1)
    assert np.abs(over).max() > 1e-7


@pytest.mark.parametrize("degree", DEGREES)
def test_the_whole_interval_is_integrated_to_order_2d_minus_1(degree: int) -> None:
    scheme = radau(degree)
    weights = scheme.integrals[-1]
    assert (weights > 0).all()
    for power in range(2 * degree - 1):
        assert weights @ scheme.points**power == pytest.approx(1 / (power + 1), abs=1e-13)
    power = 2 * degree - 1
    assert abs(weights @ scheme.points**power - 1 / (power + 1)) > 1e-7


@pytest.mark.parametrize("degree", DEGREES)
def test_values_between_points_are_those_of_the_polynomial(degree: int) -> None:
    scheme = radau(degree)
    rng = np.random.default_rng(degree)
    polynomial = np.polynomial.Polynomial(rng.normal(size=degree))
    places = [0.0, *(scheme.points[1:] + scheme.points[:-1]) / 2]
    values = scheme.between @ polynomial(scheme.points)
    np.testing.assert_allclose(values, polynomial(np.array(places)), atol=1e-12)


@pytest.mark.parametrize("degree, counts", [(1, (64, 128)), (2, (8, 16)), (3, (4, 8)), (4, (3, 6))])
def test_a_linear_equation_is_integrated_with_order_2d_minus_1(
    degree: int, counts: tuple[int, int]
) -> None:
    rate = np.array([[-0.4, 2.0], [-2.0, -0.1]])
    scheme = radau(degree)
    errors = []
    for count in counts:
        h, x = 1.0 / count, np.array([1.0, 0.5])
        system = np.eye(2 * degree) - h * np.kron(scheme.integrals, rate)
        for _ in range(count):
            x = np.linalg.solve(system, np.tile(x, degree)).reshape(degree, 2)[-1]
        errors.append(np.abs(x - expm(rate) @ [1.0, 0.5]).max())
    slope = np.log2(errors[0] / errors[1])
    # Two step sizes only, so the next term of the error still shows.
    assert slope == pytest.approx(2 * degree - 1, abs=0.3)
    assert errors[1] < 2e-2
