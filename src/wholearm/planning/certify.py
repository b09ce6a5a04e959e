"""Lower bounds of the durations that a plan of least time has."""

from __future__ import annotations

from collections.abc import Iterator

from ..results.certificate import Certificate, TimeBound
from .block_plan import BlockPlan, Planning
from .lower_bound.lower_bound import bound_least_time

OVER_TIME = "planned over time"
NO_MOTION = "the sweep over the phase plane finds no motion"


def certify(planning: Planning) -> Certificate:
    """Bound the least time of every part of a planning that is run through from rest to rest."""
    parts = (part for block in planning.blocks for part in _bound(block, planning.problem.epsilon))
    return Certificate(tuple(parts))


def _bound(block: BlockPlan, epsilon: float) -> Iterator[TimeBound]:
    durations = {
        phase.number: plan.motion.duration
        for phase, plan in zip(block.phases, block.plans, strict=True)
    }
    if block.chain is None:
        yield TimeBound(tuple(durations), sum(durations.values()), None, None, OVER_TIME)
        return
    for part in block.chain.split():
        phases = tuple(phase.number for phase in part.phases)
        duration = sum(durations[phase] for phase in phases)
        found = bound_least_time(part.continuous_curves, epsilon)
        if found is None:
            yield TimeBound(phases, duration, None, None, NO_MOTION)
        else:
            yield TimeBound(phases, duration, *found)
