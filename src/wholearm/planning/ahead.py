"""What follows a block, as far as it says where the block had best end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from ..common.arrays import Array
from ..common.errors import SolverError
from ..geometry.cost_to_go import CostToGo
from ..geometry.tracing import trace_phase
from ..problem.definition import Phase
from .block_plan import Planning
from .lower_bound.lower_bound import look_along
from .lower_bound.sweep import NoMotionError
from .motors import free_torques
from .options import Objective, PlanOptions
from .path_domain.impact_sequence import ImpactSequence
from .splitting import runs_along_curves, split_blocks
from .stops import Plans

SKETCH = 24
"""Intervals on which what follows a block is looked at where it is only sketched."""


def look_ahead(
    planning: Planning,
    block: Sequence[Phase],
    options: PlanOptions,
    plan_block: Callable[..., tuple[Plans, ImpactSequence | None]],
) -> CostToGo | None:
    """What follows a block in the time domain, if that decides where on a curve it should end."""
    # How much more what follows costs from farther away is nearly the same, and known soon.
    problem, options = free_torques(planning.problem, options)
    planning, index = replace(planning, problem=problem), block[-1].index + 1
    if runs_along_curves(block, options) or index == len(problem.phases):
        return None
    phase, ending = problem.phases[index], block[-1]
    until = ending.until.contact
    gained = set(phase.formation.contacts) - set(ending.formation.contacts)
    following = next(own for own in split_blocks(problem) if own[0] is phase)
    if (
        options.goal is Objective.MARGIN
        or until is None
        or ending.until.pins
        or gained != {until}
        or not runs_along_curves(following, options)
    ):
        return None

    def value(z: Array) -> float:
        if planning.sketches and options.goal is Objective.TIME:
            return _sketch(phase, z, problem.epsilon)
        return sum(plan.value for plan in plan_block(planning, following, z, options)[0])

    return CostToGo(phase, value)


def _sketch(phase: Phase, z: Array, epsilon: float) -> float:
    """About the least time of a phase along its curve from `z` [s]."""
    try:
        return look_along((trace_phase(phase, z),), epsilon, SKETCH)
    except NoMotionError:
        raise SolverError(f"phase {phase.number}: no motion keeps the limits") from None
