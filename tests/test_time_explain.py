from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refused import advising, ask_shoved
from thrown import shove
from tipping import box
from wholearm.common.errors import InfeasibleError, SolverError
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.limits import EPSILON
from wholearm.planning.options import Objective, PlanOptions
from wholearm.planning.path_domain.path_plan import plan_path
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.time_domain import time_explain, time_plan
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.guesses import Guesses, guess_stages
from wholearm.planning.time_domain.search import TimeSearch
from wholearm.planning.time_domain.stage import Stage
from wholearm.planning.time_domain.time_explain import (
    change_limit,
    explain,
    list_shortfalls,
    refuse,
    solve_elastic,
)
from wholearm.planning.time_domain.time_motion import TimeMotion
from wholearm.planning.time_domain.time_plan import plan_phases
from wholearm.problem.definition import Problem
from wholearm.problem.read import read_problem

SCHEME = make_scheme("radau", 3, 3)
TORQUE = "fingers.1.torque_limit"
COARSE = PlanOptions(time_intervals=4)
LEAST = 0.35 * 0.2 * 9.81
"""Least c_n of the shoved square [N]: friction shifts 0.15 of its weight to the vertex ahead."""


def plan_all(problem: Problem, **options: Any) -> list[PhasePlan[TimeMotion]]:
    return plan_phases(problem, problem.phases, problem.start, COARSE, **options)


def why_not(plan: Callable[[], object]) -> str:
    with pytest.raises(InfeasibleError) as caught:
        plan()
    return str(caught.value)


def search(problem: Problem) -> TimeSearch:
    return TimeSearch.of(problem, COARSE)


PENTAGON = """
epsilon = 0.05
object = { vertices = [[0, 0], [0.08, 0], [0.08, 0.03], [0.03, 0.09], [0, 0.09]], mass = 0.35 }
friction = { palm = 0.02, finger1 = 0.02, finger2 = 0.02 }
start = { flush = 0, x = 0.04 }
[fingers]
1 = { base = [0.09, -0.01], length = 0.17, radius = 0.006, inertia = 0.002, viscous = 0.01, dry = 0.01, torque_limit = 4.0 }
2 = { base = [-0.09, -0.01], length = 0.17, radius = 0.006, inertia = 0.002, viscous = 0.01, dry = 0.01, torque_limit = 4.0 }
[[phases]]
contacts = ["v0-palm", "v1-palm", "v1-finger1", "v4-finger2"]
until = "v2-finger1"
[[phases]]
contacts = ["v1-palm", "v1-finger1", "v2-finger1", "v4-finger2"]
until = "v4-tip2"
end = "smooth"
[[phases]]
contacts = ["v1-palm", "v1-finger1", "v2-finger1", "v4-tip2"]
until = "e4-tip2"
end = "smooth"
[[phases]]
contacts = ["v1-palm", "v1-finger1", "v2-finger1", "e4-tip2"]
until = "v0-finger2"
[[phases]]
contacts = ["v1-palm", "v2-finger1", "v0-finger2"]
until = { contact = "v3-finger1", x = 0.08804 }
"""  # noqa: E501
TURNED = np.array([0.10451807, 0.05929573, -1.03431931, 0.53647701, 0.53647701])
"""Start of the last phase, at whose end no contact forces balance the weight."""


@pytest.mark.parametrize("rate", [500.0, 1e4])
def test_torques_that_may_not_step_have_to_hold_the_end(tmp_path: Path, rate: float) -> None:
    (tmp_path / "pent.toml").write_text(PENTAGON)
    problem = read_problem(str(tmp_path / "pent.toml"))
    last = problem.phases[-1:]
    stages = Guesses(problem, last, TURNED, search(problem)).nearest.stages
    refuse(search(problem), problem, last, stages, None)
    slow = problem.with_(torque_rate_limit=rate)
    message = why_not(lambda: refuse(search(slow), slow, slow.phases[-1:], stages, None))
    assert "have to hold the object at rest at its end, x = 88.04 mm" in message
    assert "can be held there by no torques, however large" in message


def outline(problem: Problem, index: int = 0) -> Stage:
    """The first stage of a phase as it is guessed, but with c_n = 1 N, no c_t and no torques."""
    start = trace_phases(problem)[index - 1].end if index else problem.start
    stage = guess_stages(problem, problem.phases[index : index + 1], start, SCHEME, 4, 2.0)[0]
    forces = np.zeros_like(stage.guess.forces)
    forces[..., : stage.formation.n_contacts] = 1 / problem.scene.scales.force
    tau = np.zeros_like(stage.guess.tau)
    return replace(stage, guess=stage.guess._replace(forces=forces, tau=tau))


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Advice takes the time that it needs, however slow the machine is."""
    monkeypatch.setattr(time_explain, "ADVICE", np.inf)


def test_changes_are_planned_with_the_options_as_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the solver are in the scene's units, and would be scaled twice."""
    seen, plan = list[PlanOptions](), time_plan.plan_phases

    def watch(problem: Problem, phases: Any, z: Any, options: PlanOptions, **rest: Any) -> Any:
        seen.append(options)
        raise SolverError("only asked")

    problem = change_limit(shove()[0], EPSILON, 1.0)
    options = replace(COARSE, objective=Objective.EFFORT, time_weight=0.3)
    monkeypatch.setattr(time_plan, "plan_phases", watch)
    with pytest.raises(InfeasibleError), advising(lambda own: own.key == EPSILON):
        plan(problem, problem.phases, problem.start, options)
    assert seen and all(own == replace(options, accuracy=time_plan.ROUGH) for own in seen)


def test_a_force_that_weight_limits_has_its_closed_form() -> None:
    text = str(ask_shoved(EPSILON, 1.0))
    found = re.fullmatch(
        r"phases 1 and 2 are infeasible: c_n of v1-palm >= epsilon = 1 N is (\S+) N short at "
        r"t = \S+ s, phase 2; feasible with epsilon = (\S+) N instead of 1",
        text,
    )
    assert found, text
    # Pushed hard enough it begins; what it weighs there is all that presses while it slows down.
    assert float(found[1]) == pytest.approx(1 - LEAST, rel=1e-3)
    # Advice is meant to be within 2 % of what is needed.
    assert 0.98 * LEAST < float(found[2]) < LEAST


def test_there_is_a_plan_with_what_is_advised_and_none_with_less() -> None:
    problem, text = shove()[0], str(ask_shoved(TORQUE, 0.3))
    wanted = r"; feasible with torque limit of finger 1 = (\S+) N m instead of 0.3$"
    advised = re.search(wanted, text)
    assert advised, text
    enough = float(advised[1])
    assert enough > 0.3
    elastic = change_limit(problem, TORQUE, enough)
    for plan in plan_all(elastic, explained=False, patient=False):
        t = np.linspace(0.0, plan.motion.duration, 101)
        samples = plan.motion.evaluate(t)
        assert samples.c_n.min() > elastic.epsilon - 1e-6
        assert (np.abs(samples.tau) < elastic.scene.torque_limit + 1e-6).all()
    # Advice is meant to be within 2 % of what is needed.
    closer = change_limit(problem, TORQUE, 0.97 * enough)
    short = why_not(lambda: plan_all(closer, explained=False, patient=False))
    assert " short at t = " in short and "feasible with" not in short


def test_advice_is_that_along_the_curve(heptagon: Problem, curves: tuple[Curve, ...]) -> None:
    """Two formulations with different unknowns, one of them convex but for viscous friction."""
    problem, phase = change_limit(heptagon, EPSILON, 1.0), heptagon.phases[1]
    start = curves[0].end
    options, coarse = PlanOptions(time_intervals=4), PlanOptions(intervals=20)
    with advising(lambda own: own.key == EPSILON):
        texts = [
            why_not(lambda: plan_phases(problem, (problem.phases[1],), start, options)),
            why_not(lambda: plan_path(curves[1], problem.epsilon, coarse, phase.number)),
        ]
    shape = r"phase 2 is infeasible: .*c_n of v1-palm >= epsilon = 1 N is \S+ N short at "
    assert all(re.match(shape, text) for text in texts), texts
    within, along = (float(text.split("epsilon = ")[-1].split()[0]) for text in texts)
    assert within == pytest.approx(along, rel=0.02)


def test_shortfalls_are_measured_where_they_are_worst() -> None:
    """In a motion that is made up: c_n = 1 N but for single points, and single torques."""
    problem = change_limit(shove()[0], EPSILON, 0.9)
    stage = outline(problem)
    forces, tau = stage.guess.forces.copy(), stage.guess.tau.copy()
    scales = problem.scene.scales
    forces[1, 0, 0], forces[3, 2, 0] = 0.4 / scales.force, 0.85 / scales.force
    forces[2, 1, 2] = 0.9 / scales.force - 5e-5
    tau[0, 1, 1], tau[2, 0, 1] = 2.25 / scales.torque, -2.75 / scales.torque
    guess = stage.guess._replace(forces=forces, tau=tau, duration=0.8 / scales.time)
    stage = replace(stage, guess=guess)
    first, second = list_shortfalls(problem, [stage], SCHEME)
    name = stage.formation.names[0]
    # In the second and third of four even intervals; what is below 1e-4 of the weight is left out.
    assert str(first) == f"c_n of {name} >= epsilon = 0.9 N is 0.5 N short at t = 0.3000 s, phase 1"
    limit = "torque limit of finger 2 = 2 N m"
    assert str(second) == f"{limit} is 0.75 N m short at t = 0.5000 s, phase 1"
    # Another stage counts on from there, and only the worse place is kept.
    fewer = forces[..., : problem.phases[1].formation.n_contacts]
    later = replace(stage, phase=1, guess=guess._replace(forces=fewer - 0.1 / scales.force))
    worse, same = list_shortfalls(problem, [stage, later], SCHEME)[:2]
    assert worse.amount == pytest.approx(0.6) and worse.place.text == "t = 1.1000 s, phase 2"
    assert same == second
    assert list_shortfalls(change_limit(problem, EPSILON, 0.0), [outline(problem)], SCHEME) == []


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_cones_of_rolling_contacts_can_be_short(side: float) -> None:
    problem = box()
    stage = outline(problem, 1)
    formation = stage.formation
    (row,) = formation.rolling_rows
    forces = stage.guess.forces.copy()
    forces[2, 1, formation.n_contacts] = 0.7 * side / problem.scene.scales.force
    stage = replace(stage, guess=stage.guess._replace(forces=forces))
    (found,) = list_shortfalls(problem, [stage], SCHEME)
    mu = formation.friction[row]
    cone = f"|c_t| <= {mu:g} (c_n - {problem.epsilon:g} N),"
    assert found.limit == f"friction cone of {formation.names[row]}, {cone}"
    assert found.amount == pytest.approx(0.7 - mu * (1 - problem.epsilon)) and found.unit == "N"


def test_failures_that_no_limit_explains_are_the_solvers() -> None:
    problem, _ = shove()
    failed = explain(search(problem), problem, problem.phases, [], "Restoration_Failed", None)
    assert isinstance(failed, SolverError)
    text = str(failed)
    assert text.startswith("no plan for phases 1 and 2 (") and "Restoration_Failed" in text
    assert all(name in text for name in problem.phases[0].formation.names)
    assert text.endswith("intervals per phase (--time-intervals)") and "\n" not in text
    slide, own = box(), replace(COARSE, transcription="time")
    failed = explain(TimeSearch.of(slide, own), slide, slide.phases[:1], [], "Failed", None)
    assert "leave out --transcription time" in str(failed)


def test_easing_leaves_what_is_feasible_as_it_is() -> None:
    problem, _ = shove()
    stages = guess_stages(problem, problem.phases, problem.start, SCHEME, 4, 2.0)
    elastic = solve_elastic(search(problem), stages)
    assert elastic is not None and list_shortfalls(problem, elastic, SCHEME) == []
    weaker = solve_elastic(search(change_limit(problem, EPSILON, 0.8)), stages)
    assert weaker is not None
    shortfalls = list_shortfalls(change_limit(problem, EPSILON, 0.8), weaker, SCHEME)
    assert sum(short.amount for short in shortfalls) == pytest.approx(0.8 - LEAST, abs=5e-3)
