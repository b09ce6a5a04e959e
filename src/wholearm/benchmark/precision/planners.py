"""Planners that are compared: both domains of ours, and public tools."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from ...planning.lower_bound.lower_bound import bound_least_time
from ...planning.options import Objective, PlanOptions
from ...planning.path_domain.path_data import prepare
from ...planning.path_domain.path_mesh import Mesh
from ...planning.path_domain.path_nlp import build_path_nlp
from ...planning.path_domain.path_plan import plan_path
from ...planning.path_domain.terms import LimitShape
from ...planning.phase_plan import PhasePlan
from ...planning.time_domain.time_plan import plan_phases
from .peers import build_toppra, build_yapss
from .phases import OPTIMUM, Instance, PeerPlan, list_instances, list_stretches, pick
from .reference_check import check_plan
from .runs import Median, measure

LEAST_TIME, NO_DRAG = "least time", "least time without viscous friction"
"""Studies: all phases, and the same without viscous friction."""
FINE = 1e-7
"""Accuracy of a plan along a curve whose duration is the reference where there is no bound."""
NEAR = 1e-7  # distance over the duration in which a step of the torques is that of a reversal


class Planner(NamedTuple):
    """A planner."""

    settings: str  # what it is told besides the number of intervals
    # takes an instance and a setting; gives what solves it
    build: Callable[[Instance, str], Callable[[], PeerPlan]]
    choices: tuple[str, ...]  # settings that are measured
    module: str = ""  # what has to be installed, if anything
    studies: tuple[str, ...] = (LEAST_TIME,)


def run_planner(study: str, name: str, method: str, setting: str, files: tuple[str, ...]) -> Median:
    """Run one setting of one planner on one phase, and check its plans."""
    instance = pick(list_instances(files, study != NO_DRAG), name)
    if module := PLANNERS[method].module:
        # No timing is to include the import.
        __import__(module)
    least = _find_least_time(name, study, files)

    def judge(plan: PeerPlan) -> tuple[tuple[float, ...], str]:
        end, violation, outcome = check_plan(instance, plan)
        error = plan.duration / least - 1 if plan.status == OPTIMUM else math.nan
        return (error, end, violation), outcome

    return measure(partial(PLANNERS[method].build, instance, setting), judge)


@lru_cache(maxsize=4)
def _find_least_time(name: str, study: str, files: tuple[str, ...]) -> float:
    return find_least_time(pick(list_instances(files, study != NO_DRAG), name))


def find_least_time(instance: Instance) -> float:
    """Lower bound of the least time by a sweep over speeds, which shares nothing with the NLP [s].

    That of a fine plan where there is none.
    """
    curve, epsilon = instance.curve, instance.problem.epsilon
    bound = bound_least_time((curve,), epsilon)
    if bound is not None:
        return bound.value
    return plan_path(curve, epsilon, PlanOptions(accuracy=FINE), 1).motion.duration


def is_installed(method: str) -> bool:
    """Whether a planner has what it needs."""
    module = PLANNERS[method].module
    return not module or find_spec(module) is not None


def _build_on_curve(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """Ours along the curve; its NLP is built anew."""
    curve, epsilon = instance.curve, instance.problem.epsilon
    options = PlanOptions(accuracy=float(setting))
    build_path_nlp.cache_clear()
    data = prepare(curve, epsilon, Mesh().make_grid(curve, 10), 1)
    build_path_nlp(LimitShape.of(data.limits), len(data.grid.steps), Objective.TIME)
    return lambda: _convert(instance, plan_path(curve, epsilon, options, 1))


def _build_over_time(instance: Instance, setting: str) -> Callable[[], PeerPlan]:
    """Ours over time; a setting is the number of intervals, and the degree."""
    intervals, degree = map(int, setting.split(" x "))
    options = PlanOptions(time_intervals=intervals, degree=degree, transcription="time")
    problem = instance.problem

    def run() -> PeerPlan:
        (plan,) = plan_phases(problem, problem.phases, problem.start, options)
        return _convert(instance, plan)

    return run


def _convert(instance: Instance, plan: PhasePlan[Any]) -> PeerPlan:
    """Our plan as those of peers are given: reversals are where the way passes their places."""
    motion, marks = plan.motion, []
    for stretch in list_stretches(instance.curve)[:-1]:
        low, high = 0.0, motion.duration
        for _ in range(60):
            middle = (low + high) / 2
            place = motion.evaluate(np.array([middle])).z[0, stretch.progress]
            first = instance.curve.start[stretch.progress]
            before = (place - stretch.target) * (first - stretch.target) > 0
            low, high = (middle, high) if before else (low, middle)
        breaks = plan.torque.breaks
        nearest = float(breaks[np.abs(breaks - high).argmin()])
        marks.append(nearest if abs(nearest - high) < NEAR * motion.duration else high)
    return PeerPlan(OPTIMUM, motion.duration, plan.torque, tuple(marks))


_CURVE = ("1e-2", "1e-3", "1e-4", "1e-5", "1e-6")
_TIME = ("8 x 3", "16 x 3", "32 x 3", "16 x 2", "16 x 4")
PLANNERS = {
    "wholearm, curve": Planner(
        "accuracy; limits tightened between nodes included",
        _build_on_curve,
        _CURVE,
        studies=(LEAST_TIME, NO_DRAG),
    ),
    "wholearm, time": Planner(
        "Radau, intervals x degree; linear torques, refinement included", _build_over_time, _TIME
    ),
    "yapss": Planner(
        "two Legendre-Gauss points a segment, automatic second derivatives; adaptive barrier, the "
        "slow motion",
        build_yapss,
        ("20", "40", "80", "160"),
        "yapss",
    ),
    "toppra": Planner(
        "Seidel, limits at both ends of intervals, squeeze eliminated after Fourier and Motzkin",
        build_toppra,
        ("50", "100", "200", "400", "800", "1600", "3200"),
        "toppra",
        (NO_DRAG,),
    ),
}
"""Planners by name."""
