"""Impacts among phases that are planned in the time domain, and what they save over stopping.

A plan that stops at each of them shows from where the motion comes; impacts that are not possible
from there stay stops, and the phases beside the others are planned as one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, SolverError
from ...geometry.cost_to_go import CostToGo
from ...mechanics.impact import Impact, compute_impact
from ...mechanics.metric import measure_speed
from ...problem.definition import End, Phase, Problem
from ...results.trajectory import Motion
from ...results.transition import Transition
from ..options import Objective, PlanOptions
from ..path_domain.impact_sequence import PER_SPEED
from ..phase_plan import PhasePlan
from .motion import TimeMotion
from .plan import plan_phases

Plans = list[PhasePlan[TimeMotion]]
AT_REST = 1e-4
"""Speed below which an impact counts as a stop, in the scene's own units."""


def plan_with_impacts(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None,
    to_go: CostToGo | None = None,
) -> Plans:
    """Plan a block with the impacts that are possible, or else with stops.

    Parameters
    ----------
    problem : Problem
    block : sequence of Phase
    z : ndarray, shape (5,)
    options : PlanOptions
    duration : float or None, [s]
        Longest duration of the block, for the objective `margin`.
    to_go : CostToGo, optional
        What follows a block without impacts.

    Raises
    ------
    InputError, InfeasibleError, SolverError
        As `plan_phases` does.
    """
    ends = [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]
    if not ends:
        return plan_phases(problem, block, z, options, duration, to_go=to_go)
    stopped = _plan_stops(problem, block, z, options, duration, ends)
    blocked = [
        k for k in ends if _strike_at_stop(block[k - 1], block[k], stopped[k - 1]).violations
    ]
    if len(blocked) == len(ends):
        return stopped
    try:
        return _plan_stops(problem, block, z, options, duration, blocked, explained=False)
    except (InfeasibleError, SolverError):
        return stopped


def _plan_stops(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None,
    ends: Sequence[int],
    explained: bool = True,
) -> Plans:
    """Plan a block that stops before the phases `ends` of it."""
    plans: Plans = []
    for start, stop in pairwise([0, *ends, len(block)]):
        share = None if duration is None else duration * (stop - start) / len(block)
        part = block[start:stop]
        plans += plan_phases(problem, part, z, options, share, explained=explained)
        z = _last_state(plans[-1])[0]
    return plans


def _strike_at_stop(phase: Phase, following: Phase, plan: PhasePlan[Motion]) -> Impact:
    """The impact for unit speed in the direction in which a phase comes to its stop."""
    duration = plan.motion.duration
    z = _last_state(plan)[0]
    v = plan.motion.evaluate(np.array([duration * (1 - 1e-3)])).z_dot[0]
    v = v / measure_speed(phase.formation.scene, v)
    return compute_impact(phase.formation, following.formation, z, v)


def assess_time_impacts(
    problem: Problem,
    block: Sequence[Phase],
    plans: Sequence[PhasePlan[Motion]],
    options: PlanOptions,
    duration: float | None,
) -> list[Transition]:
    """Assess every impact of a block: whether it is passed at speed, and what that saves.

    Parameters
    ----------
    problem : Problem
    block : sequence of Phase
    plans : list of PhasePlan
        Of the block.
    options : PlanOptions
    duration : float or None, [s]
        Longest duration of the block, for the objective `margin`.
    """
    ends = [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]
    speeds = {k: measure_speed(problem.scene, _last_state(plans[k - 1])[1]) for k in ends}
    stops = [k for k in ends if speeds[k] < AT_REST * problem.scene.scales.speed]
    found = []
    for k in ends:
        phase, following = block[k - 1], block[k]
        if k in stops:
            found.append(_describe_stop(phase, following, plans[k - 1]))
            continue
        z, v = _last_state(plans[k - 1])
        impact = compute_impact(phase.formation, following.formation, z, v / speeds[k])
        contact, impulse = impact.least
        ratio = measure_speed(problem.scene, impact.v)
        begin = max((stop for stop in stops if stop < k), default=0)
        end = min((stop for stop in stops if stop > k), default=len(block))
        share = None if duration is None else duration * (end - begin) / len(block)
        saves = _find_saving(problem, block[begin:end], k - begin, plans[begin:end], options, share)
        until = str(phase.until)
        found.append(
            Transition(phase.number, until, True, "", ratio, impulse, contact, speeds[k], saves)
        )
    return found


def _describe_stop(phase: Phase, following: Phase, plan: PhasePlan[Motion]) -> Transition:
    impact = _strike_at_stop(phase, following, plan)
    contact, impulse = impact.least
    reason = "no plan passes it at speed"
    if impact.violations:
        reason = impact.violations[0].describe(PER_SPEED)
    ratio = measure_speed(phase.formation.scene, impact.v)
    until = str(phase.until)
    return Transition(phase.number, until, False, reason, ratio, impulse, contact, 0.0, math.nan)


def _find_saving(
    problem: Problem,
    block: Sequence[Phase],
    at: int,
    plans: Sequence[PhasePlan[Motion]],
    options: PlanOptions,
    duration: float | None,
) -> float:
    """What a stop before phase `at` of phases in motion would cost; NaN if it has no plan."""
    z = plans[0].motion.evaluate(np.zeros(1)).z[0]
    try:
        stopped = _plan_stops(problem, block, z, options, duration, [at], explained=False)
    except (InfeasibleError, SolverError):
        return math.nan
    if options.goal is Objective.MARGIN:
        return min(plan.value for plan in plans) - min(plan.value for plan in stopped)
    return sum(plan.value for plan in stopped) - sum(plan.value for plan in plans)


def _last_state(plan: PhasePlan[Motion]) -> tuple[Array, Array]:
    """Configuration and velocity at the end of a phase."""
    samples = plan.motion.evaluate(np.array([plan.motion.duration]))
    return samples.z[0], samples.z_dot[0]
