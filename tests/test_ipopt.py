from __future__ import annotations

import casadi as ca
import pytest

from wholearm.common.arrays import Expression
from wholearm.solvers.ipopt import build_solver, record_runs


def build(max_iter: int) -> Expression:
    """Least x^2 + y^2 with x + y >= 1 and x >= 0.8."""
    x = ca.SX.sym("x", 2)
    nlp = {"x": x, "f": ca.dot(x, x), "g": x[0] + x[1]}
    return build_solver("toy", nlp, 1e-9, max_iter=max_iter)


@pytest.fixture(scope="module")
def solver() -> Expression:
    return build(50)


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


def test_a_solution_is_kept_as_a_start(solver: Expression) -> None:
    """It is pushed from its bounds by as little as was asked for, and not by Ipopt's 1 %."""
    answer = solve(solver, x0=[3.0, 3.0])
    start = {"x0": answer["x"], "lam_x0": answer["lam_x"], "lam_g0": answer["lam_g"]}
    kept = build(0)(lbx=[0.8, -ca.inf], lbg=1.0, ubg=ca.inf, **start)
    assert float(ca.norm_inf(kept["x"] - answer["x"])) < 1e-8
    again = solve(solver, **start)
    assert float(again["f"]) == pytest.approx(0.8**2 + 0.2**2, abs=1e-7)


def test_failure_is_a_status_and_no_exception(solver: Expression) -> None:
    solver(x0=[3.0, 3.0], lbx=[0.8, 0.8], ubx=[0.9, 0.9], lbg=5.0, ubg=ca.inf)
    assert not solver.stats()["success"]


def test_runs_are_recorded_with_their_sizes(solver: Expression) -> None:
    with record_runs() as runs:
        solve(solver, x0=[3.0, 3.0])
        with record_runs() as inner:
            solve(solver, x0=[0.9, 0.9])
    solve(solver, x0=[3.0, 3.0])
    assert len(runs) == 2 and inner == runs[1:]
    for run in runs:
        assert (run.unknowns, run.rows) == (2, 1)
        # The row has both unknowns; the Hessian is diagonal.
        assert (run.jacobian_nonzeros, run.hessian_nonzeros) == (2, 2)
        assert run.iterations > 0 and run.seconds >= 0.0
