from __future__ import annotations

import numpy as np
import pytest

from wholearm.simulation.contact_problem import (
    APART,
    BACK,
    FORTH,
    STICKS,
    ContactAnswer,
    ContactProblem,
    list_answers,
    solve,
    solve_lcp,
    try_modes,
)


def test_one_unknown() -> None:
    assert solve_lcp(np.array([[2.0]]), np.array([-3.0])).z == pytest.approx([1.5])
    assert solve_lcp(np.array([[2.0]]), np.array([3.0])).w == pytest.approx([3.0])
    assert solve_lcp(np.zeros((0, 0)), np.zeros(0)).residual == 0.0


def test_a_ray_is_no_solution() -> None:
    assert np.isinf(solve_lcp(np.array([[-1.0]]), np.array([-1.0])).residual)


@pytest.mark.parametrize("skew", [0.0, 1.0])
def test_positive_semidefinite_problems_are_solved(skew: float) -> None:
    # With degenerate solutions, singular matrices and ties, as contacts of flush edges make them.
    rng = np.random.default_rng(3)
    for _ in range(150):
        n = int(rng.integers(1, 13))
        root = rng.normal(size=(n, int(rng.integers(1, n + 1))))
        turn = skew * rng.normal(size=(n, n))
        M = root @ root.T + turn - turn.T
        z = np.maximum(rng.normal(size=n), 0)
        w = np.where(z > 0, 0.0, np.maximum(rng.normal(size=n), 0))
        found = solve_lcp(M, w - M @ z)
        assert found.residual < 1e-9 * np.abs(M).sum()
        assert found.z.min() >= 0 and found.w.min() >= 0
        assert found.w == pytest.approx(M @ found.z + w - M @ z, abs=1e-9 * np.abs(M).sum())


def test_ties_do_not_cycle() -> None:
    # Every row falls as much as every other.
    n = 8
    found = solve_lcp(np.ones((n, n)) + np.triu(np.ones((n, n)), 1), -np.ones(n))
    assert found.residual < 1e-12


def draw(rng: np.random.Generator, mu: float) -> ContactProblem:
    """Three contacts, the first two of which may stick, and a joint, on five coordinates."""
    A, A_t = rng.normal(size=(2, 3, 5))
    Xi = np.array([0.0, 0.0, rng.choice([-1.0, 1.0])])
    T = np.vstack([A_t[:2], np.eye(5)[3]])
    return ContactProblem(
        rng.uniform(0.5, 2.0, 5),
        A,
        A - mu * Xi[:, None] * A_t,
        rng.normal(size=3),
        T,
        rng.normal(size=3),
        np.array([0, 1, -1]),
        np.array([mu, mu, 0.0]),
        np.array([0.0, 0.0, 0.3]),
    )


def check(p: ContactProblem, answer: ContactAnswer) -> None:
    """Coulomb's law and complementarity, from the forces alone."""
    change = p.lift * (p.G.T @ answer.c_n + p.T.T @ answer.f)
    r_n, r_t = p.b_n + p.A @ change, p.b_t + p.T @ change
    assert answer.c_n.min() >= 0 and r_n.min() > -1e-9
    assert answer.c_n * r_n == pytest.approx(np.zeros(3), abs=1e-8)
    most = p.bound + p.mu * np.append(answer.c_n[:2], 0.0)
    assert (np.abs(answer.f) <= most + 1e-9).all()
    for force, rate, bound in zip(answer.f, r_t, most, strict=True):
        assert abs(rate) < 1e-8 or force == pytest.approx(-bound * np.sign(rate), abs=1e-8)


def test_lemke_finds_one_of_all_answers() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        problem = draw(rng, 0.15)
        found, every = solve(problem), list_answers(problem)
        assert found is not None and every
        check(problem, found)
        for answer in every:
            check(problem, answer)
        assert min(np.abs(found.change - a.change).max() for a in every) < 1e-8


def make_mass(b_n: float, b_t: float, mu: float = 0.5) -> ContactProblem:
    """A unit mass over a floor."""
    normal, tangent = np.array([[0.0, 1.0]]), np.array([[1.0, 0.0]])
    one, none = np.array([mu]), np.zeros(1)
    b = np.array([b_n]), np.array([b_t])
    return ContactProblem(np.ones(2), normal, normal, b[0], tangent, b[1], np.array([0]), one, none)


@pytest.mark.parametrize(
    ("b_n", "b_t", "mode", "c_n", "f"),
    [
        (-2.0, 0.5, STICKS, 2.0, -0.5),
        (-2.0, 1.5, FORTH, 2.0, -1.0),
        (-2.0, -1.5, BACK, 2.0, 1.0),
        (2.0, 1.5, APART, 0.0, 0.0),
    ],
)
def test_a_mass_on_a_floor(b_n: float, b_t: float, mode: int, c_n: float, f: float) -> None:
    problem = make_mass(b_n, b_t)
    for answer in (solve(problem), try_modes(problem, [mode])):
        assert answer is not None
        assert (*answer.c_n, *answer.f) == pytest.approx((c_n, f))
    for other in {APART, STICKS, FORTH, BACK} - {mode}:
        assert try_modes(problem, [other]) is None
    assert len(list_answers(problem) or []) == 1
