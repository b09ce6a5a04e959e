"""Impacts between phases in the time domain.

A plan with stops shows the velocity before each impact; impacts that are impossible stay stops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, SolverError
from ...geometry.arcs import CostToGo
from ...mechanics.dynamics import measure_speed
from ...mechanics.impact import Impact, compute_impact
from ...problem.definition import End, Phase, Problem
from ...results.trajectory import Motion
from ..options import Objective, PlanOptions
from ..path_domain.impact_sequence import PER_SPEED, BlockImpact
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

    The arguments are those of `plan_phases`; after `ample` they are for blocks without impacts.
    """
    ends = _find_impacts(block)
    if not ends:
        plan = partial(plan_phases, to_go=to_go, ample=ample, pinned=pinned, only_begin=only_begin)
        plan = partial(plan, fastest=fastest or (), begun=begun or ())
        return [*plan(problem, block, z, options, duration)]
    explained = plan_parts_of(problem, block, ample, explained=True)
    if duration is not None and fastest and all(_is_stop(problem, fastest[k - 1]) for k in ends):
        # Without an impact in least time there is none in a longer duration.
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
    """Planner of parts of a block: from all guesses with reasons (`explained`) or the first one."""

    def plan_part(
        start: int, stop: int, z: Array, options: PlanOptions, duration: float | None
    ) -> Plans:
        plan = partial(plan_phases, ample=ample, explained=explained, patient=explained)
        return [*plan(problem, block[start:stop], z, options, duration)]

    return plan_part


def list_impacts(block: Sequence[Phase], plans: Sequence[PhasePlan[Motion]]) -> list[BlockImpact]:
    """The impacts of a block, at speed or with a stop."""
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
    """Indices in the block of the phases after impacts."""
    return [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]


def _impact_at_stop(phase: Phase, following: Phase, plan: PhasePlan[Motion]) -> Impact:
    """The impact for unit speed in the direction in which a phase comes to its stop."""
    v = plan.motion.evaluate(np.array([plan.motion.duration * (1 - 1e-3)])).z_dot[0]
    v = v / measure_speed(phase.formation.scene, v)
    return compute_impact(phase.formation, following.formation, end_of(plan)[0], v)
