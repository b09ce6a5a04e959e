"""Impacts among phases that are planned in the time domain.

A plan that stops at each of them shows from where the motion comes; impacts that are not possible
from there stay stops, and the phases beside the others are planned as one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, SolverError
from ...geometry.cost_to_go import CostToGo
from ...mechanics.impact import Impact, compute_impact
from ...mechanics.metric import measure_speed
from ...problem.definition import End, Phase, Problem
from ...results.trajectory import Motion
from ..impacts import PER_SPEED, BlockImpact
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from ..stops import PlanPart, Plans, end_of, plan_stops
from .time_plan import plan_phases

AT_REST = 1e-4  # speed below which an impact counts as a stop, in the scene's own units


def plan_with_impacts(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None,
    to_go: CostToGo | None = None,
    ample: float = math.inf,
    fastest: Plans | None = None,
    pinned: bool = False,
    begun: Plans | None = None,
    only_begin: bool = False,
) -> Plans:
    """Plan a block with the impacts that are possible, or else with stops.

    Parameters
    ----------
    z : (5,)
    duration : [s]  longest duration of the block, for the objective `margin`
    to_go           what follows a block without impacts
    ample, fastest, pinned, begun, only_begin  as of `plan_phases`; a block with impacts makes its
        own, and plans as a whole

    Raises
    ------
    InputError, InfeasibleError, SolverError  as `plan_phases` does
    """
    ends = _find_impacts(block)
    if not ends:
        own = partial(plan_phases, problem, block, z, options, duration, to_go=to_go, ample=ample)
        going_on = partial(own, begun=begun or (), only_begin=only_begin)
        return [*going_on(fastest=fastest or (), pinned=pinned)]
    explained = plan_parts_of(problem, block, ample, explained=True)
    if duration is not None and fastest and all(_is_stop(problem, fastest[k - 1]) for k in ends):
        # Where least time has not led through an impact, nor will a longer duration.
        return plan_stops(explained, [0, *ends, len(block)], z, options, duration)
    # A duration that is too short for stops need not be so without them.
    probe = (
        options if duration is None else replace(options, objective=Objective.TIME, duration=None)
    )
    stopped = plan_stops(explained, [0, *ends, len(block)], z, probe)
    blocked = [
        k for k in ends if _impact_at_stop(block[k - 1], block[k], stopped[k - 1]).violations
    ]
    if len(blocked) < len(ends):
        bounds = [0, *blocked, len(block)]
        try:
            return plan_stops(plan_parts_of(problem, block, ample), bounds, z, options, duration)
        except (InfeasibleError, SolverError):
            pass
    if duration is None:
        return stopped
    return plan_stops(explained, [0, *ends, len(block)], z, options, duration)


def plan_parts_of(
    problem: Problem, block: Sequence[Phase], ample: float = math.inf, explained: bool = False
) -> PlanPart:
    """How parts of a block are planned; `explained`: looking further where there is no plan.

    Otherwise from the first guess alone: there is a plan with stops.
    """

    def plan_part(
        start: int, stop: int, z: Array, options: PlanOptions, duration: float | None
    ) -> Plans:
        part = block[start:stop]
        own = partial(plan_phases, problem, part, z, options, duration, ample=ample)
        return [*own(explained=explained, patient=explained)]

    return plan_part


def list_impacts(block: Sequence[Phase], plans: Sequence[PhasePlan[Motion]]) -> list[BlockImpact]:
    """The impacts that a block asks for, passed at speed or not."""
    found = []
    for k in _find_impacts(block):
        (z, v), scene, reason = end_of(plans[k - 1]), block[0].formation.scene, ""
        speed = measure_speed(scene, v)
        if speed < AT_REST * scene.scales.speed:
            speed, impact = 0.0, _impact_at_stop(block[k - 1], block[k], plans[k - 1])
            reason = "no plan passes it at speed"
            if impact.violations:
                reason = impact.violations[0].describe(PER_SPEED)
        else:
            impact = compute_impact(block[k - 1].formation, block[k].formation, z, v / speed)
        ratio = measure_speed(scene, impact.v)
        found.append(BlockImpact(k - 1, impact, ratio, reason, speed))
    return found


def _is_stop(problem: Problem, plan: PhasePlan[Motion]) -> bool:
    """Whether a plan ends at rest."""
    speed = measure_speed(problem.scene, end_of(plan)[1])
    return speed < AT_REST * problem.scene.scales.speed


def _find_impacts(block: Sequence[Phase]) -> list[int]:
    """Indices in the block of the phases that an impact leads to."""
    return [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]


def _impact_at_stop(phase: Phase, following: Phase, plan: PhasePlan[Motion]) -> Impact:
    """The impact for unit speed in the direction in which a phase comes to its stop."""
    duration = plan.motion.duration
    z = end_of(plan)[0]
    v = plan.motion.evaluate(np.array([duration * (1 - 1e-3)])).z_dot[0]
    v = v / measure_speed(phase.formation.scene, v)
    return compute_impact(phase.formation, following.formation, z, v)
