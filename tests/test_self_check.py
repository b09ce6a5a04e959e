from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from planned import brake_less, change, plan, plan_landing
from wholearm.common.errors import JammingError, ReplayError
from wholearm.geometry.tracing import trace_phases
from wholearm.planning import replay_check as self_check
from wholearm.planning.blocks import Planning, plan_blocks
from wholearm.planning.options import PlanOptions
from wholearm.planning.replay_check import (
    RESIDUAL,
    ReplayCheck,
    check_plan,
    find_residual,
    replay_plan,
)
from wholearm.problem.definition import Problem
from wholearm.results.plan_record import ReplayFigures
from wholearm.results.report import Report
from wholearm.results.trajectory import Trajectory
from wholearm.verification.verdict import Allowance, find_least_force
from wholearm.verification.verify import verify


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


@cache
def plan_coarsely(problem: Problem) -> Planning:
    return plan_blocks(problem, trace_phases(problem), PlanOptions(intervals=10), lambda _: None)


class Replayed:
    """A plan whose replay jams in phase 2 until the block of that is refined often enough.

    Solves and replays are not made: a refined block is the same one with another count.
    """

    def __init__(self, problem: Problem, patch: pytest.MonkeyPatch, cured: int) -> None:
        (self.holds,) = check_plan(*plan(), Allowance())
        self.planning = self.last = plan_coarsely(problem)
        self.cured, self.usual_before = cured, 0
        patch.setattr(self_check, "check_plan", self.check)
        patch.setattr(self_check, "plan_alone", lambda *_: None)
        patch.setattr(self_check, "refine_block", self.refine)

    def refine(self, planning: Planning, index: int, *_: object) -> Planning:
        own = list(planning.blocks)
        own[index] = replace(own[index], finer=own[index].finer + 1)
        return replace(planning, blocks=tuple(own))

    def build(self, planning: Planning) -> Trajectory:
        self.last = planning
        return replace(plan()[1])

    def check(self, *_: object) -> list[ReplayCheck]:
        """By a strict allowance, and by the usual one."""
        error = JammingError("v1-palm jams in phase 2 at t = 0.1 s")
        error.phase = 2
        finer = self.last.blocks[1].finer
        good = finer >= self.cured, finer >= self.cured or finer < self.usual_before
        return [self.holds if own else self.holds._replace(report=error) for own in good]

    def run(self) -> tuple[Planning, Trajectory, ReplayFigures]:
        return replay_plan(self.planning, self.build(self.planning), self.build, lambda _: None)


@pytest.mark.parametrize("cured", [0, 2])
def test_only_what_does_not_hold_is_refined(
    slide: Problem, monkeypatch: pytest.MonkeyPatch, cured: int
) -> None:
    own = Replayed(slide, monkeypatch, cured)
    planning, _, figures = own.run()
    assert [block.finer for block in planning.blocks] == [0, cured, 0]
    assert figures.refinements == (0, cured, 0) and figures.simulations == cured + 1
    assert all(planning.blocks[k] is own.planning.blocks[k] for k in (0, 2))


def test_refining_is_bounded_and_the_error_says_where(
    slide: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ReplayError) as caught:
        Replayed(slide, monkeypatch, 99).run()
    text = str(caught.value)
    assert caught.value.exit_status == 1
    assert text.startswith("the plan of phase 2 does not hold in its replay, with 8 times the ")
    assert "the intervals: v1-palm jams in phase 2 at t = 0.1 s; " in text and "--no-replay" in text


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
            assert max(own[key]["m"], own[key]["rad"]) < Allowance().departure
        assert own["end_speed"] < Allowance().rest_speed * heptagon.scene.scales.speed
    assert figures["residual"] < RESIDUAL and len(figures["refinements"]) == 5


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
