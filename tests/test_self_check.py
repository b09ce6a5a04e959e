from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from planned import change, plan, plan_landing
from shipped import HEPTAGON, problem_of
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError, JammingError, ReplayError, SolverError
from wholearm.geometry.tracing import trace_phases
from wholearm.planning import self_check
from wholearm.planning.block_plan import Planning
from wholearm.planning.blocks import plan_blocks
from wholearm.planning.options import PlanOptions
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.plan import solve
from wholearm.planning.self_check import (
    Check,
    check_plan,
    find_residual,
    replay_plan,
)
from wholearm.problem.definition import Problem
from wholearm.results.replay_figures import ReplayFigures
from wholearm.results.report import Report
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Trajectory
from wholearm.verification.verdict import Allowance, find_least_force
from wholearm.verification.verify import Observation, observe, verify


def brake_less(starts: Array, c: Array) -> Array:
    c[(starts > 0.3) & (starts < 0.4 - 1e-9)] *= 0.97
    return c


def test_a_plan_that_holds() -> None:
    problem, trajectory = plan()
    check, harsh = check_plan(problem, trajectory, Allowance(), Allowance(departure=1e-15))
    assert harsh.failure is not None and " departs from the plan, by " in harsh.failure[1]
    assert check.failure is None and check.residual.size < 1e-9
    assert isinstance(check.report, Report)
    # Every piece is a step, and few end elsewhere.
    assert check.report.steps < 2 * len(trajectory.torque.coefficients) + 150


def test_torques_that_do_not_carry_the_motion_are_found() -> None:
    problem, trajectory = plan()
    weak = replace(trajectory, torque=change(trajectory.torque, brake_less))
    (check,) = check_plan(problem, weak, Allowance())
    assert check.failure is not None and check.failure == (2, verify(problem, weak).reason)
    # The first phase departs by the braking that it lacks.
    assert check.find_culprit(problem.scene.scales, Allowance(departure=1e-5), np.zeros(1)) == 1


def test_a_phase_that_hardly_stops_is_found_by_where_the_next_one_ends() -> None:
    """What departs is the second phase, by the speed that the first one leaves."""
    problem, trajectory = plan()
    (check,) = check_plan(
        problem, replace(trajectory, torque=change(trajectory.torque, brake_less)), Allowance()
    )
    assert isinstance(check.report, Report)
    first, *others = check.report.phases
    speed, least = 1e-3, Allowance(departure=1.0, rest_speed=1.0)
    report = replace(check.report, phases=(first._replace(end_speed=speed), *others))
    left = check._replace(report=report)
    duration_row = np.array([1.0, 2.0 * least.departure * problem.scene.scales.length / speed])
    assert left.find_culprit(problem.scene.scales, least, duration_row) == 1
    assert left.find_culprit(problem.scene.scales, least, duration_row / 4) == 2


def test_friction_the_wrong_way_is_found_by_the_residual() -> None:
    problem, trajectory = plan()
    tau, rows = trajectory.tau.copy(), np.flatnonzero(trajectory.phase == 2)[90:100]
    dry = problem.scene.dry[4]
    tau[rows, 1] -= 2 * dry * np.sign(trajectory.theta_dot[rows, 1])
    wrong = replace(trajectory, tau=tau)
    found = find_residual(problem, wrong)
    assert found.phase == 3
    assert found.size == pytest.approx(2 * dry / problem.scene.scales.torque, rel=1e-6)
    assert "finger 2" in found.text and "as joint 2 moves against the sense" in found.text
    times = [f"at t = {t:.5g} s, phase 3" for t in trajectory.t[rows]]
    assert any(found.text.endswith(time) for time in times)
    (check,) = check_plan(problem, wrong, Allowance())
    assert check.failure == (3, found.text)


class Spoiled:
    """Planning in which the torques of one phase are weak until it is refined often enough."""

    def __init__(self, problem: Problem, phase: int, cured: int) -> None:
        self.problem, self.phase, self.cured = problem, phase, cured
        self.refined: list[int] = []
        options = PlanOptions(intervals=10)
        self.planning = plan_blocks(problem, trace_phases(problem), options, lambda _: None)

    def build(self, planning: Planning) -> Trajectory:
        from wholearm.planning.plan import assemble_plan

        if planning.blocks[self.phase].finer >= self.cured:
            return assemble_plan(planning)
        block = planning.blocks[self.phase]
        (own,) = block.plans
        coefficients = own.torque.coefficients.copy()
        coefficients[len(coefficients) // 2 :] *= 0.9
        weak: PhasePlan[Any] = own._replace(torque=TorqueProfile(own.torque.breaks, coefficients))
        blocks = list(planning.blocks)
        blocks[self.phase] = replace(block, plans=[weak])
        return assemble_plan(replace(planning, blocks=tuple(blocks)))

    def run(self) -> tuple[Planning, Trajectory, ReplayFigures]:
        first = self.build(self.planning)
        return replay_plan(self.planning, first, self.build, lambda _: None)


@pytest.fixture(scope="module")
def slide(heptagon: Problem) -> Problem:
    """The heptagon's first three phases."""
    return replace(heptagon, phases=heptagon.phases[:3])


def test_a_contact_that_falls_a_little_short_is_pressed_more(slide: Problem) -> None:
    """The plan is one for a smaller epsilon, and on as many intervals as there may be."""
    from wholearm.planning.plan import assemble_plan

    short, options = 1e-3, PlanOptions(intervals=10)
    slide = replace(slide, phases=slide.phases[:1])
    easy = replace(slide, epsilon=slide.epsilon - short)
    planning = plan_blocks(easy, trace_phases(easy), options, lambda _: None)
    finest = tuple(replace(own, finer=self_check.REFINEMENTS) for own in planning.blocks)
    planning = replace(planning, problem=slide, blocks=finest)
    held, trajectory, figures = replay_plan(
        planning, assemble_plan(planning), assemble_plan, lambda _: None
    )
    assert figures.least_c_n.value > slide.epsilon
    assert held.more == {0: pytest.approx(self_check.SPARE * short, rel=0.05)}
    assert np.nanmin(trajectory.c_n) == pytest.approx(slide.epsilon + held.more[0], abs=1e-5)


@pytest.mark.parametrize("cured", [0, 2])
def test_only_what_does_not_hold_is_refined(slide: Problem, cured: int) -> None:
    spoiled = Spoiled(slide, 1, cured)
    planning, trajectory, figures = spoiled.run()
    assert [block.finer for block in planning.blocks] == [0, cured, 0]
    assert figures.refinements == (0, cured, 0)
    for k in 0, 2:
        assert planning.blocks[k] is spoiled.planning.blocks[k]
    assert verify(slide, trajectory).ok
    # Twice the intervals, but for those of no length where a direction reverses.
    pieces = [len(block.plans[0].torque.coefficients) for block in planning.blocks]
    assert pieces[1] >= 2**cured * 10 - 2


def jam(phase: int, pieces: int) -> Any:
    """`observe`, but for torques of less than so many pieces, which jam in a phase."""

    def replay(problem: Problem, torque: TorqueProfile, plan: Trajectory) -> Observation:
        if len(torque.coefficients) < pieces:
            error = JammingError(f"v1-palm jams in phase {phase} at t = 0.1 s")
            error.phase = phase
            raise error
        return observe(problem, torque, plan)

    return replay


def test_a_replay_that_jams_refines_the_phase(
    slide: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoiled = Spoiled(slide, 1, 0)
    pieces = len(spoiled.build(spoiled.planning).torque.coefficients)
    monkeypatch.setattr(self_check, "observe", jam(2, pieces + 1))
    planning, trajectory, _ = spoiled.run()
    assert [block.finer > 0 for block in planning.blocks] == [False, True, False]
    assert verify(slide, trajectory).ok
    monkeypatch.setattr(self_check, "observe", jam(2, 10**6))
    with pytest.raises(ReplayError, match=r"8 times the intervals: v1-palm jams in phase 2 at t"):
        spoiled.run()


def test_refining_is_bounded_and_the_error_says_where(slide: Problem) -> None:
    spoiled = Spoiled(slide, 1, 99)
    with pytest.raises(ReplayError) as caught:
        spoiled.run()
    text = str(caught.value)
    assert caught.value.exit_status == 1
    assert text.startswith("the plan of phase 2 does not hold in its replay, with 8 times the ")
    assert ", phase " in text and " at t = " in text and "--no-replay" in text


def test_a_finer_plan_that_is_not_found_leaves_the_error(
    slide: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Planning:
        raise SolverError("no plan")

    spoiled = Spoiled(slide, 1, 1)
    monkeypatch.setattr(self_check, "refine_block", fail)
    with pytest.raises(ReplayError, match="the plan of phase 2 does not hold in its replay: "):
        spoiled.run()


def test_a_plan_that_is_allowed_is_kept_where_finer_ones_are_not(
    slide: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoiled, seen = Spoiled(slide, 1, 0), list[Trajectory]()

    def look(problem: Problem, trajectory: Trajectory, *allowances: Allowance) -> list[Check]:
        error = JammingError("jams")
        error.phase = 2
        jammed = Check(error, find_residual(problem, trajectory))
        seen.append(trajectory)
        holds = check_plan(problem, trajectory, *allowances)[1] if len(seen) == 1 else jammed
        return [jammed, holds]

    monkeypatch.setattr(self_check, "check_plan", look)
    planning, trajectory, figures = spoiled.run()
    assert planning is spoiled.planning and trajectory is seen[0] and len(seen) > 1
    assert figures.simulations == len(seen)


def test_meta_keeps_the_figures(heptagon: Problem, trajectory: Trajectory) -> None:
    figures = trajectory.meta["replay"]
    report = verify(heptagon, trajectory)
    margins = [(c.least, c.contact, p.number) for p in report.phases for c in p.contacts]
    # Parabolas through other instants dip a little differently.
    assert figures["least_c_n"]["value"] == pytest.approx(min(margins)[0], abs=1e-5)
    assert (figures["least_c_n"]["contact"], figures["least_c_n"]["phase"]) in [
        margin[1:] for margin in margins if margin[0] < min(margins)[0] + 1e-6
    ]
    for own, phase in zip(figures["phases"], report.phases, strict=True):
        assert own["arrival"] == pytest.approx(phase.arrival, abs=1e-9)
        for key in ("end_deviation", "deviation"):
            assert max(own[key]["m"], own[key]["rad"]) < 1e-9
        assert own["end_speed"] < 1e-6
    assert figures["residual"] < 1e-11 and figures["refinements"] == [0] * 5


def test_a_contact_that_is_let_go_counts_until_then() -> None:
    """In an instant after the torques step, the formation given up would have it pull."""
    problem, trajectory = plan_landing()
    report = verify(problem, trajectory)
    phase = report.phases[0]
    assert phase.until == "release of v3-finger1"
    margins = {margin.contact: margin for margin in phase.contacts}
    assert margins["v3-finger1"].least > problem.epsilon - Allowance().measure_stray(problem)
    assert find_least_force(phase) == min(phase.contacts, key=lambda margin: margin.least)
    assert find_least_force(phase._replace(contacts=())) is None


def test_without_a_replay() -> None:
    meta = solve(problem_of(HEPTAGON), intervals=20, replay=False).meta
    assert meta["replay"] is None
    with pytest.raises(InputError, match="replay: 'no' given"):
        PlanOptions(replay="no")  # type: ignore[arg-type]
