from __future__ import annotations

import numpy as np
import pytest

from wholearm.free_simulation.contact_problem import solve_lcp


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
