"""Phases whose ends are given in full: where they end, and what is said of other places."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from plane import make_formation, measure_gaps
from planned import plan_landing
from shipped import HEPTAGON, problem_of
from timed import landing
from wholearm.common.errors import InfeasibleError, InputError
from wholearm.geometry.tracing import trace_phases
from wholearm.planning.options import PlanOptions
from wholearm.planning.time_domain.pinning import Approach, refuse_pinned
from wholearm.planning.time_domain.plan import plan_phases, try_phases
from wholearm.planning.time_domain.search import Search, Solution
from wholearm.problem.definition import Problem
from wholearm.simulation.simulate import simulate
from wholearm.verification.verdict import Allowance, describe_ends

LANDS = 0.016
"""Where `plan_landing` ends [m]."""


def pin(problem: Problem, index: int, *pins: tuple[str, float]) -> Problem:
    phases = list(problem.phases)
    until = dataclasses.replace(phases[index].until, pins=pins)
    phases[index] = dataclasses.replace(phases[index], until=until)
    return dataclasses.replace(problem, phases=tuple(phases))


def test_a_landing_comes_to_rest_where_it_is_pinned() -> None:
    """Also beside the end that is the fastest, and far from the nearest; or it is said why not."""
    problem = pin(landing(), 5, ("x", 0.0195))
    start = trace_phases(problem)[-1].end
    # All guesses: what a single one leads to depends on the last bits.
    options = PlanOptions(time_intervals=6)
    plans = plan_phases(problem, problem.phases[4:], start, options)
    motion = plans[-1].motion
    end = motion.evaluate(np.array([motion.duration]))
    size, speed = problem.scene.scales.length, problem.scene.scales.speed
    assert end.z[0, 0] == pytest.approx(0.0195, abs=1e-7 * size)
    assert np.abs(end.z_dot[0, :2]).max() < 1e-6 * speed
    formation = make_formation(
        problem.scene, " ".join([*problem.phases[5].formation.names, "v2-palm"])
    )
    assert np.abs(measure_gaps(formation, end.z)).max() < 1e-6 * size
    # Much nearer to where the flip starts torques would have to be larger.
    begun = try_phases(landing(), landing().phases[4:], start, options)
    assert begun is not None and isinstance(begun[0].solution, Solution)
    short, solution = pin(landing(), 5, ("x", 0.0145)), begun[0].solution
    search = Search.of(short, options, None, None, math.inf, True)
    ends = {stage.phase: stage.guess.nodes[-1, 0] for stage in solution.stages}
    with pytest.raises(InfeasibleError, match=r"ends at x = .* mm, .* at the nearest") as own:
        refuse_pinned(search, short, short.phases[4:], Approach(None, solution, ends, 0.0))
    assert {lack.part for lack in own.value.shortfalls} & {"finger 1", "finger 2"}


def test_with_one_freedom_pins_have_to_agree_with_the_curve() -> None:
    problem = problem_of(HEPTAGON)
    x, phi = trace_phases(problem)[0].end[[0, 2]].tolist()
    same = pin(problem, 0, ("x", x), ("phi", phi))
    assert trace_phases(same)[0].end.tolist() == trace_phases(problem)[0].end.tolist()
    with pytest.raises(InputError, match=r"v3-finger1 at x = .* is never reached") as caught:
        trace_phases(pin(problem, 0, ("x", x + 1e-3)))
    assert caught.value.key == "phases[1].until"
    assert caught.value.problem.endswith("; one freedom leaves no choice")


def test_another_place_than_the_one_pinned_fails() -> None:
    problem, trajectory = plan_landing()
    simulation = simulate(problem, trajectory.torque)
    allowance, length = Allowance(), problem.scene.scales.length
    for off, missed in ((0.0, False), (0.9, False), (1.1, True)):
        x = LANDS + off * allowance.departure * length
        failures = describe_ends(pin(problem, 1, ("x", x)), simulation, allowance)
        assert bool(failures) == missed
        for failure in failures:
            assert failure.text.startswith("phase 2 ends at x = 16 mm, phi = ")
            assert failure.text.endswith(f"and not with v2-palm at x = {x:g} m")
