"""Pauses in which rate-limited torques change at rest between blocks.

A plan in the time domain begins and ends with the torques of its motion; those before it change
into them in a pause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phase
from ..problem.definition import Phase
from ..results.dwell_record import find_change_times
from ..results.trajectory import Motion
from .block_plan import Planning
from .options import PlanOptions
from .path_domain.junction import Joint, add_pause, choose_joint
from .phase_plan import PhasePlan
from .stops import Plans, runs_along_curves, split_blocks


def find_beside(
    planning: Planning, block: Sequence[Phase], end: Array, options: PlanOptions
) -> tuple[Curve | Array | None, Curve | Formation | None]:
    """Neighbours of a block along curves that ends at `end`, for `plan_slowly`."""
    index, later = block[-1].index + 1, planning.problem.phases[block[-1].index + 1 :]
    before: Curve | Array | None = planning.find_curve_before(block)
    if before is None:
        before = _find_torque_before(planning, block)
    if not later:
        return before, None
    following = next(own for own in split_blocks(planning.problem) if own[0] is later[0])
    if not runs_along_curves(following, options):
        return before, later[0].formation
    known = planning.curves[index] if index < len(planning.curves) else None
    return before, known or trace_phase(later[0], end, later[1:])


def plan_with_pauses(
    planning: Planning,
    block: Sequence[Phase],
    plan: Callable[[float | None], Plans],
    duration: float | None,
) -> Plans:
    """Plans of a block in the time domain by `plan` for a longest duration [s], with pauses."""
    plans = plan(duration)
    junctions = _list_junctions(planning, block, plans)
    pause = sum(junction.pause for junction in junctions if junction)
    if duration is not None and pause:
        plans = plan(duration - pause)
        junctions = _list_junctions(planning, block, plans)
    paused: Plans = []
    for own, junction, phase in zip(plans, junctions, block, strict=True):
        if junction is not None:
            z = own.motion.evaluate(np.zeros(1)).z[0]
            own = add_pause(own, junction, phase.formation, z, planning.options)
        paused.append(own)
    return paused


def _list_junctions(planning: Planning, block: Sequence[Phase], plans: Plans) -> list[Joint | None]:
    """Starts of the phases at which torques change."""
    ends = [_find_torque_before(planning, block), *map(_find_last, plans[:-1])]
    junctions = list[Joint | None]()
    for end, own, phase in zip(ends, plans, block, strict=True):
        first, scene = own.torque.at(np.zeros(1))[0], planning.problem.scene
        pause = 0.0 if end is None else float(find_change_times(scene, end, first))
        if end is None or not pause:
            junctions.append(None)
            continue
        z = own.motion.evaluate(np.zeros(1)).z[0]
        junction = choose_joint(end, phase.formation, z, planning.problem.epsilon, phase.number)
        junctions.append(junction._replace(after=first, pause=pause))
    return junctions


def _find_torque_before(planning: Planning, block: Sequence[Phase]) -> Array | None:
    """The last torques of the block before, shape (2,) [N m], if that is planned."""
    before = [own for own in planning.blocks if own.phases[-1].index + 1 == block[0].index]
    return _find_last(before[0].plans[-1]) if before else None


def _find_last(plan: PhasePlan[Motion]) -> Array:
    return np.asarray(plan.torque.at(plan.torque.breaks[-1:])[0])
