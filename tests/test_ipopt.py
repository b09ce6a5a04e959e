from __future__ import annotations

import casadi as ca
import pytest

from wholearm.contact import Expression
from wholearm.ipopt import build_solver


@pytest.fixture(scope="module")
def solver() -> Expression:
    """Least x^2 + y^2 with x + y >= 1 and x >= 0.8."""
    x = ca.SX.sym("x", 2)
    return build_solver("toy", {"x": x, "f": ca.dot(x, x), "g": x[0] + x[1]}, 1e-9, max_iter=50)


def solve(solver: Expression, **start: Expression) -> dict[str, Expression]:
    answer: dict[str, Expression] = solver(lbx=[0.8, -ca.inf], lbg=1.0, ubg=ca.inf, **start)
    assert solver.stats()["success"]
    return answer


def test_bounds_are_kept_exactly(solver: Expression) -> None:
    answer = solve(solver, x0=[3.0, 3.0])
    # The barrier keeps inequalities strictly; relaxed bounds would be missed by 1e-8.
    assert float(answer["x"][0]) >= 0.8
    assert float(answer["g"]) >= 1.0
    assert float(answer["x"][0]) == pytest.approx(0.8, abs=1e-7)
    assert float(answer["x"][1]) == pytest.approx(0.2, abs=1e-7)


def test_a_solution_is_a_good_start(solver: Expression) -> None:
    answer = solve(solver, x0=[3.0, 3.0])
    cold = solver.stats()["iter_count"]
    solve(solver, x0=answer["x"], lam_x0=answer["lam_x"], lam_g0=answer["lam_g"])
    assert solver.stats()["iter_count"] < cold / 2


def test_failure_is_a_status_and_no_exception(solver: Expression) -> None:
    solver(x0=[3.0, 3.0], lbx=[0.8, 0.8], ubx=[0.9, 0.9], lbg=5.0, ubg=ca.inf)
    assert not solver.stats()["success"]
