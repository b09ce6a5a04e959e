from __future__ import annotations

import pytest

from shipped import BOX, HEPTAGON, plan_of, problem_of
from wholearm.verification.verify import verify


def test_the_scalar_equation_holds_along_a_replay() -> None:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    report = verify(problem, plan, reduced=True)
    assert {row.phase for row in report.reduced} == {1, 2, 3, 4, 5}
    for row in report.reduced:
        # Rounding: accelerations come from matrices of condition 1e4.
        assert abs(row.residual) < 1e-9 * (abs(row.Phi_1 * row.theta_1_ddot) + abs(row.Phi_3))
        assert plan.phase_starts[row.phase - 1] <= row.time <= plan.phase_starts[row.phase] + 1e-6
    text = report.to_text()
    assert "Phi_1 [kg m^2]" in text and len(report.to_dict()["reduced"]) == len(report.reduced)


def test_a_phase_with_a_rolling_contact_may_have_four_constraints() -> None:
    problem = problem_of(BOX)
    report = verify(problem, plan_of(BOX), reduced=True)
    four = {p.number for p in problem.phases if p.formation.n_constraints == 4}
    assert {row.phase for row in report.reduced} == four
    for row in report.reduced:
        assert row.residual == pytest.approx(0.0, abs=1e-9 * abs(row.Phi_3))


def test_it_is_left_out_unless_asked_for() -> None:
    report = verify(problem_of(HEPTAGON), plan_of(HEPTAGON))
    assert report.reduced == () and "Phi_1" not in report.to_text()
