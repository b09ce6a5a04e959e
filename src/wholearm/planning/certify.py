"""Lower bounds of the durations that a plan of least time has."""

from __future__ import annotations

from collections.abc import Iterator

from ..results.plan_record import Certificate, TimeBound
from .block_plan import BlockPlan, Planning
from .lower_bound.lower_bound import bound_least_time

OVER_TIME = "planned over time"
NO_MOTION = "the sweep over the phase plane finds no motion"


def certify(planning: Planning) -> Certificate:
    """Bound the least time of every part of a planning that is run through from rest to rest."""
    parts = (part for block in planning.blocks for part in _bound(block, planning.problem.epsilon))
    return Certificate(tuple(parts))


def _bound(block: BlockPlan, epsilon: float) -> Iterator[TimeBound]:
    numbers = [phase.number for phase in block.phases]
    durations = [plan.motion.duration for plan in block.plans]
    if block.chain is None:
        yield TimeBound(tuple(numbers), sum(durations), None, None, OVER_TIME)
        return
    # The chain of a link of a route has numbers of its own: its phases are told by their order.
    first = 0
    for part in block.chain.split():
        own = slice(first, first := first + len(part.phases))
        phases, duration = tuple(numbers[own]), sum(durations[own])
        found = bound_least_time(part.continuous_curves, epsilon)
        if found is None:
            yield TimeBound(phases, duration, None, None, NO_MOTION)
        else:
            yield TimeBound(phases, duration, *found)
