from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from wholearm.fatrop import Stages, build_solver, describe_status, keep_bounds
from wholearm.model import Array

STEPS = 12


def build(**options: Any) -> Any:
    """A point pushed from rest at 0 towards 1 with least effort: u_k^2, x = (place, speed)."""
    x = [ca.SX.sym(f"x{k}", 2) for k in range(STEPS + 1)]
    u = [ca.SX.sym(f"u{k}") for k in range(STEPS)]
    unknowns, rows, equations = [], [], []
    for k in range(STEPS):
        unknowns += [x[k], u[k]]
        rows.append(x[k + 1] - ca.vertcat(x[k][0] + x[k][1] + u[k] / 2, x[k][1] + u[k]))
        equations += [True, True]
        if k == 0:
            rows.append(x[0])
            equations += [True, True]
    rows.append(x[-1])
    equations += [False, True]
    nlp = {
        "x": ca.vertcat(*unknowns, x[-1]),
        "f": ca.sumsqr(ca.vertcat(*u)),
        "g": ca.vertcat(*rows),
    }
    stages = Stages([2] * (STEPS + 1), [1] * STEPS + [0], [2, *[0] * (STEPS - 1), 2], equations)
    return build_solver("toy", nlp, stages, **options)


def bounds(low: float, high: float) -> dict[str, Array]:
    """Bounds that leave the last place between two values, and end at rest."""
    count = 2 * STEPS + 4
    below, above = np.zeros(count), np.zeros(count)
    below[-2], above[-2] = low, high
    below, above = keep_bounds(below, above)
    return {"lbg": below, "ubg": above}


def push_exactly() -> Array:
    """The pushes of least squares with sum 0 and travel 1, from their two equations."""
    travel = STEPS - 0.5 - np.arange(STEPS)
    rows = np.vstack([travel, np.ones(STEPS)])
    return np.asarray(rows.T @ np.linalg.solve(rows @ rows.T, [1.0, 0.0]))


@pytest.fixture(scope="module")
def solver() -> Any:
    return build()


def test_a_staged_problem_is_solved(solver: Any) -> None:
    answer = solver(x0=0.5, **bounds(1.0, 2.0))
    assert solver.stats()["success"] and describe_status(solver) == "solved"
    found = answer["x"].full()[:, 0]
    np.testing.assert_allclose(found[2 : 3 * STEPS : 3], push_exactly(), rtol=0, atol=1e-7)
    assert float(answer["f"]) == pytest.approx((push_exactly() ** 2).sum(), rel=1e-7)


def test_bounds_are_kept_exactly(solver: Any) -> None:
    """It would fall short by some 1e-8 if they were passed as they are."""
    last = float(solver(x0=0.5, **bounds(1.0, 2.0))["g"][-2])
    assert 1.0 <= last < 1 + 1e-8
    far = float(solver(x0=0.5, **bounds(1e3, 2e3))["g"][-2])
    assert 1e3 * (1 - 1e-15) <= far < 1e3 * (1 + 1e-8)
    loose = bounds(1.0, 2.0)
    loose["lbg"][-2] = 1.0
    assert float(solver(x0=0.5, **loose)["g"][-2]) < 1 - 1e-9


def test_kept_bounds_leave_equal_and_infinite_ones() -> None:
    low, high = keep_bounds(np.array([0.0, 3.0, -np.inf]), np.array([np.inf, 3.0, 200.0]))
    np.testing.assert_array_equal(low, [1e-8, 3.0, -np.inf])
    np.testing.assert_array_equal(high, [np.inf, 3.0, 200.0 - 2e-6])


def test_failure_is_a_status_and_no_exception() -> None:
    hasty = build(max_iter=2)
    hasty(x0=0.5, **bounds(1.0, 2.0))
    assert not hasty.stats()["success"]
    assert describe_status(hasty) == "too many iterations"


def test_rows_out_of_order_are_refused() -> None:
    x = ca.SX.sym("x", 3)
    nlp = {"x": x, "f": ca.sumsqr(x), "g": ca.vertcat(x[0] + x[2], x[1] - x[0])}
    with pytest.raises(RuntimeError, match="structure"):
        build_solver("toy", nlp, Stages([1, 1, 1], [0, 0, 0], [0, 0, 0], [True, True]))
