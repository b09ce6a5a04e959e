"""Planning chains of one-freedom phases, and what their impacts save over stopping instead."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...common.errors import InfeasibleError, SolverError
from ...geometry.curve import Curve
from ...mechanics.metric import measure_speed
from ...problem.definition import Phase
from ...results.trajectory import Motion
from ...results.transition import Transition
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from .impact_sequence import CurveImpact, ImpactSequence
from .motion import PathMotion
from .plan import plan_curves


def plan_sequence(
    chain: ImpactSequence,
    epsilon: float,
    options: PlanOptions,
    duration: float | None = None,
    explained: bool = True,
) -> list[PhasePlan[PathMotion]]:
    """Plan phases that possible impacts join, from rest to rest.

    Parameters
    ----------
    chain : ImpactSequence
    epsilon : float, [N]
    options : PlanOptions
    duration : float, optional, [s]
        Longest duration of all, for the objective `margin`; the phases share it as is best.
    explained : bool
        Whether to find out why there is no plan.
    """
    phases = [phase.number for phase in chain.phases]
    return plan_curves(chain.continuous_curves, epsilon, options, phases, duration, explained)


def add_up(phases: Sequence[Phase], allowed: Sequence[float | None]) -> float | None:
    """Longest duration of some phases in all [s], given that of each of the problem's phases."""
    own = [allowed[phase.index] for phase in phases]
    return sum(time for time in own if time is not None) if None not in own else None


def combine(goal: Objective, values: Sequence[float]) -> float:
    """Objective value of some phases, given that of each."""
    return min(values) if goal is Objective.MARGIN else sum(values)


def assess(
    sequences: Sequence[ImpactSequence],
    plans: Sequence[PhasePlan[Motion]],
    epsilon: float,
    options: PlanOptions,
    allowed: Sequence[float | None],
    report: Callable[[str], None],
) -> list[Transition]:
    """Assess every impact: whether it is possible, and what it saves, by planning a stop instead.

    Parameters
    ----------
    sequences : sequence of ImpactSequence
        As asked for, with the impacts that are not possible.
    plans : sequence of PhasePlan
        Of all phases of the problem.
    epsilon : float, [N]
    options : PlanOptions
    allowed : sequence of float or None, [s]
        Longest duration of each phase of the problem.
    report : callable
        Told in a few words what is being done.
    """
    found = []
    for chain in sequences:
        found += [_describe(join, 0.0, math.nan) for join in chain.impacts if not join.possible]
        for part in chain.split():
            own = [plans[phase.index] for phase in part.phases]
            value = combine(options.goal, [plan.value for plan in own])
            for k, join in enumerate(part.impacts):
                report(f"phase {join.phase.number}: what its impact saves")
                limit = add_up(part.phases, allowed)
                try:
                    stopped = _plan_stop(part, k + 1, epsilon, options, limit)
                except (InfeasibleError, SolverError):
                    stopped = math.nan
                gain = value - stopped if options.goal is Objective.MARGIN else stopped - value
                found.append(_describe(join, _speed_at_end(part.curves[k], own[k].motion), gain))
    return found


def _describe(join: CurveImpact, speed: float, saves: float) -> Transition:
    contact, impulse = join.impact.least
    possible, until = join.possible, str(join.phase.until)
    return Transition(
        join.phase.number, until, possible, join.reason, join.ratio, impulse, contact, speed, saves
    )


def _speed_at_end(curve: Curve, motion: Motion) -> float:
    """Speed along a curve at the end of a motion [m/s]."""
    z_dot = motion.evaluate(np.array([motion.duration])).z_dot[0]
    return measure_speed(curve.formation.scene, z_dot)


def _plan_stop(
    chain: ImpactSequence, at: int, epsilon: float, options: PlanOptions, duration: float | None
) -> float:
    """Value of a chain whose motion stops before its phase `at`; NaN if it cannot in `duration`."""
    halves = chain.part(0, at), chain.part(at, len(chain.phases))
    limits: list[float | None] = [None, None]
    if options.goal is Objective.MARGIN and duration is not None:
        fastest = replace(options, objective=Objective.TIME, duration=None)
        times = [
            sum(plan.value for plan in plan_sequence(half, epsilon, fastest, None, False))
            for half in halves
        ]
        if duration <= sum(times):
            return math.nan
        limits = [duration * own / sum(times) for own in times]
    plans = [
        plan
        for half, limit in zip(halves, limits, strict=True)
        for plan in plan_sequence(half, epsilon, options, limit, False)
    ]
    return combine(options.goal, [plan.value for plan in plans])
