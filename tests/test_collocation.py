from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from wholearm.planning.time_domain.collocation import blend, fit_controls, make_scheme

NAMES = ["radau", "legendre"]
DEGREES = [1, 2, 3, 4, 5, 6]
ROOT = np.sqrt(6.0)


@pytest.mark.parametrize(
    "name, degree, points",
    [
        ("radau", 1, [1.0]),
        ("radau", 2, [1 / 3, 1.0]),
        ("radau", 3, [(4 - ROOT) / 10, (4 + ROOT) / 10, 1.0]),
        # To the six digits that tables of the nodes on [-1, 1] print.
        ("radau", 4, [(1 - 0.822824) / 2, (1 - 0.181066) / 2, (1 + 0.575319) / 2, 1.0]),
        ("legendre", 1, [0.5]),
        ("legendre", 2, [0.5 - np.sqrt(3) / 6, 0.5 + np.sqrt(3) / 6]),
        ("legendre", 3, [0.5 - np.sqrt(15) / 10, 0.5, 0.5 + np.sqrt(15) / 10]),
    ],
)
def test_points_are_the_tabulated_ones(name: str, degree: int, points: list[float]) -> None:
    got = make_scheme(name, degree).points
    np.testing.assert_allclose(got, points, atol=3e-7 if degree > 3 else 1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_legendre_points_and_weights_are_those_of_gauss(degree: int) -> None:
    x, weights = np.polynomial.legendre.leggauss(degree)
    scheme = make_scheme("legendre", degree)
    np.testing.assert_allclose(scheme.points, (x + 1) / 2, atol=1e-14)
    # Inverting the powers enlarges rounding a little.
    np.testing.assert_allclose(scheme.weights, weights / 2, atol=1e-10)


def test_schemes_have_butchers_coefficients() -> None:
    two = [[5 / 12, -1 / 12], [3 / 4, 1 / 4]]
    np.testing.assert_allclose(make_scheme("radau", 2).integrals, two, atol=1e-13)
    three = [
        [(88 - 7 * ROOT) / 360, (296 - 169 * ROOT) / 1800, (-2 + 3 * ROOT) / 225],
        [(296 + 169 * ROOT) / 1800, (88 + 7 * ROOT) / 360, (-2 - 3 * ROOT) / 225],
        [(16 - ROOT) / 36, (16 + ROOT) / 36, 1 / 9],
    ]
    np.testing.assert_allclose(make_scheme("radau", 3).integrals, three, atol=1e-14)
    gauss = [[1 / 4, 1 / 4 - np.sqrt(3) / 6], [1 / 4 + np.sqrt(3) / 6, 1 / 4]]
    np.testing.assert_allclose(make_scheme("legendre", 2).integrals, gauss, atol=1e-13)


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("name", NAMES)
def test_integrals_are_exact_up_to_the_degree(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    for power in range(degree):
        exact = scheme.points ** (power + 1) / (power + 1)
        # Rounding, which inverting the powers enlarges a little.
        np.testing.assert_allclose(scheme.integrals @ scheme.points**power, exact, atol=1e-10)
    over = scheme.integrals @ scheme.points**degree - scheme.points ** (degree + 1) / (degree + 1)
    assert np.abs(over).max() > 1e-7


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("name", NAMES)
def test_the_whole_interval_is_integrated_to_the_order(name: str, degree: int) -> None:
    scheme = make_scheme(name, degree)
    assert scheme.order == {"radau": 2 * degree - 1, "legendre": 2 * degree}[name]
    assert (scheme.weights > 0).all()
    # The inverse of the powers has a condition number of up to 1e5.
    for power in range(scheme.order):
        assert scheme.weights @ scheme.points**power == pytest.approx(1 / (power + 1), abs=1e-10)
    power = scheme.order
    assert abs(scheme.weights @ scheme.points**power - 1 / (power + 1)) > 1e-8
    if scheme.ends:
        np.testing.assert_allclose(scheme.integrals[-1], scheme.weights, atol=1e-10)


@pytest.mark.parametrize("degree, counts", [(1, (64, 128)), (2, (8, 16)), (3, (4, 8)), (4, (2, 4))])
@pytest.mark.parametrize("name", NAMES)
def test_a_linear_equation_is_integrated_to_the_order(
    name: str, degree: int, counts: tuple[int, int]
) -> None:
    rate = np.array([[-0.4, 2.0], [-2.0, -0.1]])
    scheme = make_scheme(name, degree)
    errors = []
    for count in counts:
        h, x = 1.0 / count, np.array([1.0, 0.5])
        system = np.eye(2 * degree) - h * np.kron(scheme.integrals, rate)
        for _ in range(count):
            points = np.linalg.solve(system, np.tile(x, degree)).reshape(degree, 2)
            x = x + h * scheme.weights @ points @ rate.T
        errors.append(np.abs(x - expm(rate) @ [1.0, 0.5]).max())
    slope = np.log2(errors[0] / errors[1])
    # Two step sizes only, so the next term of the error still shows.
    assert slope == pytest.approx(scheme.order, abs=0.3)
    assert errors[1] < 2e-2


@pytest.mark.parametrize("count", [2, 3, 5])
def test_polynomials_lie_between_their_control_points(count: int) -> None:
    rng, places = np.random.default_rng(count), np.linspace(0.0, 1.0, 41)
    controls = rng.uniform(-1.0, 1.0, (count, 2))
    values = blend(places, count) @ controls
    assert (values <= controls.max(axis=0) + 1e-14).all()
    assert (values >= controls.min(axis=0) - 1e-14).all()
    np.testing.assert_allclose(values[[0, -1]], controls[[0, -1]], atol=1e-13)
    # Of their degree they are: their control points follow from as many values.
    at = np.sort(rng.uniform(0.0, 1.0, count))
    np.testing.assert_allclose(
        fit_controls(at, blend(at, count) @ controls, count), controls, atol=1e-6
    )
