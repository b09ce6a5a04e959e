"""Torques that go on from block to block, where motors are not quick.

What is planned over time begins and ends with the torques that its motion needs there. Those that
came before change into them in a pause before it, while everything rests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phase
from ..problem.definition import Phase
from ..results.torque_change import find_change_times
from ..results.trajectory import Motion
from .block_plan import Planning
from .options import PlanOptions
from .path_domain.junction import Joint, add_pause, choose_joint
from .phase_plan import PhasePlan
from .stops import Plans, runs_along_curves, split_blocks


def find_beside(
    planning: Planning, block: Sequence[Phase], end: Array, options: PlanOptions
) -> tuple[Curve | Array | None, Curve | Formation | None]:
    """What is before and after a block along curves that ends at `end`, as `plan_slowly` asks."""
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
    """Plans of a block over time, which `plan` makes for a longest duration [s], and its pauses."""
    plans = plan(duration)
    joints = _list_joints(planning, block, plans)
    pause = sum(joint.pause for joint in joints if joint)
    if duration is not None and pause:
        plans = plan(duration - pause)
        joints = _list_joints(planning, block, plans)
    paused: Plans = []
    for own, joint, phase in zip(plans, joints, block, strict=True):
        z = own.motion.evaluate(np.zeros(1)).z[0]
        given = phase.formation, z, planning.options
        paused.append(own if joint is None else add_pause(own, joint, *given))
    return paused


def _list_joints(planning: Planning, block: Sequence[Phase], plans: Plans) -> list[Joint | None]:
    """Where each of the phases begins, if torques change there."""
    ends = [_find_torque_before(planning, block), *map(_find_last, plans[:-1])]
    joints = list[Joint | None]()
    for end, own, phase in zip(ends, plans, block, strict=True):
        begins, scene = own.torque.at(np.zeros(1))[0], planning.problem.scene
        pause = 0.0 if end is None else float(find_change_times(scene, end, begins))
        if end is None or not pause:
            joints.append(None)
            continue
        z = own.motion.evaluate(np.zeros(1)).z[0]
        held = choose_joint(end, phase.formation, z, planning.problem.epsilon, phase.number)
        joints.append(held._replace(after=begins, pause=pause))
    return joints


def _find_torque_before(planning: Planning, block: Sequence[Phase]) -> Array | None:
    """The torques that the block before ends with, shape (2,) [N m], if that is planned."""
    known = [own for own in planning.blocks if own.phases[-1].index + 1 == block[0].index]
    return _find_last(known[0].plans[-1]) if known else None


def _find_last(plan: PhasePlan[Motion]) -> Array:
    return np.asarray(plan.torque.at(plan.torque.breaks[-1:])[0])
