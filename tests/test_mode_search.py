from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import wholearm.planning.time_domain.guesses as guesses
import wholearm.planning.time_domain.mode_search as mode_search
from plane import measure_slip
from thrown import raised
from timed import instants
from tipping import roll, tilting
from wholearm.mechanics.dynamics import Directions
from wholearm.planning.options import PlanOptions
from wholearm.planning.plan import solve
from wholearm.planning.time_domain.guesses import guess_stages
from wholearm.planning.time_domain.mode_search import (
    WORTH,
    StageMode,
    improve,
    in_mode,
    link,
    mode_of,
)
from wholearm.planning.time_domain.refinement import SETTINGS
from wholearm.planning.time_domain.search import TimeSearch, TimeSolution
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.time_motion import TimeMotion
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.definition import End, Problem, Until
from wholearm.verification.verdict import DEPARTURE
from wholearm.verification.verify import verify

OPTIONS = PlanOptions(time_intervals=10)


def outlined(problem: Problem, count: int = 10) -> tuple[TimeSearch, list[Stage]]:
    search = TimeSearch.of(problem, OPTIONS)
    start = problem.start
    return search, guess_stages(problem, problem.phases, start, search.scheme, count, 2.0)


def turn_joint(stages: list[Stage], joint: int) -> list[Stage]:
    """The same stages with a joint that turns the other way."""
    turned = []
    for stage in stages:
        sigma = stage.directions.sigma.copy()
        sigma[joint] *= -1
        turned.append(replace(stage, directions=Directions(stage.directions.Xi, sigma)))
    return link(turned)


@cache
def alphabet() -> dict[str, Stage]:
    """A stage in several modes, by name: sequences below are words of these; "r" rolls."""
    (stage,) = outlined(raised(), 4)[1]
    signs = {"a": (1, -1, -1), "b": (1, 1, -1), "c": (1, -1, 1), "d": (1, 1, 1), "r": (0, -1, -1)}
    return {
        name: in_mode(stage, StageMode((float(palm), 1.0, 1.0, float(one), float(two))))
        for name, (palm, one, two) in signs.items()
    }


def word_of(stages: list[Stage]) -> str:
    names = {mode_of(stage): name for name, stage in alphabet().items()}
    return "".join(names[mode_of(stage)] for stage in stages)


class Priced(TimeSearch):
    """A search whose solves cost what a table says, and fail for sequences that it leaves out."""

    costs: Mapping[str, float]
    asked: list[str]

    def solve(
        self,
        stages: list[Stage],
        before: TimeSolution | None = None,
        most: int = 0,
        raised: Any = None,
    ) -> TimeSolution:
        self.asked.append(word_of(stages))
        return self.answer(stages, self.costs.get(self.asked[-1], math.inf))

    def answer(self, stages: list[Stage], cost: float) -> TimeSolution:
        return TimeSolution(stages, cost, 0.0, "", math.isfinite(cost), None, {})  # type: ignore[arg-type]


LESS, MORE = 1 - 2 * WORTH, 1 + 2 * WORTH


@pytest.mark.parametrize(
    ("begin", "costs", "moves", "asked", "found"),
    [
        pytest.param(
            "a", {"b": 0.9, "c": 0.8}, {"a": "b d", "b": "a c"}, "b c", "c", id="down, step by step"
        ),
        pytest.param("a", {"b": LESS}, {"a": "b"}, "b", "b", id="worth it"),
        pytest.param("a", {"b": 1 - WORTH / 2}, {"a": "b"}, "b", "a", id="not worth it"),
        pytest.param("ab", {"b": 1 + WORTH / 2}, {"ab": "b"}, "b", "b", id="one stage less"),
        pytest.param("ab", {"b": MORE}, {"ab": "b"}, "b", "ab", id="one stage less, but dearer"),
        # A stage of no length gains by the intervals beside it; then there is one stage less.
        pytest.param(
            "a", {"ba": 0.9, "a": 0.9}, {"a": "ba", "ba": "a"}, "ba a", "a", id="of no length"
        ),
        pytest.param("ab", {"c": 2.0}, {"ab": "c c"}, "c", "ab", id="the same one twice"),
        pytest.param(
            "a", {"r": 1.1, "b": 0.9}, {"a": "r", "r*": "b"}, "r b", "b", id="leans where it rolls"
        ),
        pytest.param("a", {"d": 0.5}, {"a": "b c bc d"}, "b c bc", "a", id="lost three times"),
        pytest.param(
            "a",
            {"d": 0.5, "cd": 0.4},
            {"a": "b c d", "d": "bc bd cd"},
            "b c d bc bd cd",
            "cd",
            id="lost, and again after a gain",
        ),
    ],
)
def test_modes_change_for_as_long_as_that_gains(
    monkeypatch: pytest.MonkeyPatch,
    begin: str,
    costs: dict[str, float],
    moves: dict[str, str],
    asked: str,
    found: str,
) -> None:
    """Which sequences are solved for, in which order, and what is kept; the first one costs 1.

    Moves from what rolls and is no better are those of contacts that lean, "r*".
    """
    own = Priced(**vars(outlined(raised(), 4)[0]))
    own.costs, own.asked = costs, []

    def list_moves(
        search: TimeSearch, solution: TimeSolution, leaning: bool = False
    ) -> list[list[Stage]]:
        words = moves.get(word_of(solution.stages) + "*" * leaning, "").split()
        return [[alphabet()[name] for name in word] for word in words]

    monkeypatch.setattr(mode_search, "list_neighbours", list_moves)
    best = improve(own, own.answer([alphabet()[name] for name in begin], 1.0))
    assert own.asked == asked.split() and word_of(best.stages) == found
    assert own.tried.sequences == 1 + len(own.asked)
    assert own.tried.complete == ({*moves.get(found, "").split()} <= {begin, *own.asked})


def test_plans_are_the_same_whichever_way_a_joint_is_guessed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = raised()

    def guess_wrong(*given: object, **named: object) -> list[Stage]:
        return turn_joint(guess_stages(*given, **named), 1)  # type: ignore[arg-type]

    (right,) = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    monkeypatch.setattr(guesses, "guess_stages", guess_wrong)
    (plan,) = plan_phases(problem, problem.phases, problem.start, OPTIONS)
    assert plan.motion.duration == pytest.approx(right.motion.duration, rel=1e-3)
    for stage in plan.motion.stages:
        samples = stage.evaluate(instants(stage, 12))
        slip = measure_slip(stage.formation, samples.z, samples.z_dot)
        joints = samples.z_dot[:, 3:]
        assert (slip * stage.directions.Xi).min() > -1e-4 * np.abs(slip).max()
        assert (joints * stage.directions.sigma).min() > -1e-4 * np.abs(joints).max()


def test_what_may_slide_or_roll_is_faster_than_what_has_to_roll() -> None:
    """Rolling throughout is one of its motions, with one freedom: the bound is along a curve."""
    problem = tilting()
    (phase,) = problem.phases
    rolls = replace(phase, formation=roll(phase.formation, "v1-palm"))
    bound = solve(replace(problem, phases=(rolls,)), intervals=10, replay=False).trajectory
    plan = solve(problem, time_intervals=6, replay=False).trajectory
    assert plan.duration < 0.95 * bound.duration
    report = verify(problem, plan)
    assert report.ok, report.to_text()


def test_a_contact_slides_in_one_phase_and_rolls_in_the_next() -> None:
    sliding = tilting()
    (phase,) = sliding.phases
    rolling = roll(phase.formation, "v1-palm")
    first = replace(phase, until=Until(), end=End.SMOOTH)
    last = replace(phase, index=1, formation=rolling)
    problem = replace(sliding, phases=(first, last))
    plan = solve(problem, time_intervals=5, replay=False).trajectory
    report = verify(problem, plan)
    assert report.ok, report.to_text()
    assert report.phases[0].until == "change of v1-palm"
    ends = np.cumsum([motion.duration for motion in plan.motions])
    # How late a contact comes to rest, or slips, is an error of its speed over what slows it down,
    # or of its force over how fast that grows: no more than a replay may depart.
    assert report.phases[0].arrival == pytest.approx(ends[0], abs=DEPARTURE * ends[1])
    # No interval is halved for ever, and neither phase shrinks to nothing.
    motions = [motion for motion in plan.motions if isinstance(motion, TimeMotion)]
    stages = [stage for motion in motions for stage in motion.stages]
    assert sum(len(stage.points.fractions) for stage in stages) <= 2 * SETTINGS.intervals
    assert min(motion.duration for motion in plan.motions) > 0.1 * plan.duration
    # What rolls does so all along; what slides has friction against its motion.
    for motion, rolls in zip(motions, (False, True), strict=True):
        for stage in motion.stages:
            samples = stage.evaluate(instants(stage, 12))
            slip = measure_slip(stage.formation, samples.z, samples.z_dot)[:, 0]
            mu = stage.formation.friction[0]
            share = samples.c_t[:, 0] / (mu * samples.c_n[:, 0])
            assert bool(stage.formation.rolling) == rolls
            if rolls:
                assert np.abs(slip).max() < 1e-9 and np.abs(share).max() < 1.0
            else:
                Xi = stage.directions.Xi[0]
                assert mu > 0 and (slip * Xi).min() > -1e-4 * np.abs(slip).max()
                np.testing.assert_allclose(share, -Xi, rtol=1e-9)
