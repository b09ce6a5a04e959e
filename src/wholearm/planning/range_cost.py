"""What ranges cost a plan, and how wide they may be."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from ..common.errors import InfeasibleError, SolverError
from ..problem.uncertainty import PARAMETERS
from ..results.range_figures import RangeFigures
from .block_plan import Planning
from .blocks import plan_blocks
from .options import PlanOptions
from .path_domain.impact_sequence import ImpactSequence
from .path_domain.sequence_plan import plan_sequence
from .phase_plan import add_up, combine

WIDEST = 0.95
"""Largest relative range that is tried."""
_CLOSE = 0.01
"""Error of the largest factor, relatively."""
_ROUGH = 1e-2
"""Accuracy of plans that are made to see whether there are any."""


def assess_ranges(planning: Planning, report: Callable[[str], None]) -> RangeFigures:
    """Plan without ranges too, and look for the widest ones if that is asked for."""
    options, problem = planning.options, planning.problem
    report("planning without ranges")
    bare = plan_blocks(problem, planning.curves, replace(options, ranges={}), report)
    nominal = combine(options.goal, [plan.value for plan in bare.plans])
    figures = RangeFigures(dict(options.ranges), nominal)
    if not options.largest:
        return figures
    unit = options.scale_ranges(problem.uncertainty or {}, 1.0).ranges
    relative = [unit[own.name] for own in PARAMETERS if not own.unit]
    most = WIDEST / max(max(relative), 1e-12)
    found: dict[int, float] = {}
    for numbers, part, duration in _list_parts(planning):
        report(f"looking for the widest ranges of phase {numbers[0]}")
        widest = _find_widest(
            part, problem.epsilon, options, problem.uncertainty or {}, duration, most
        )
        found |= dict.fromkeys(numbers, widest)
    each = tuple(found.get(phase.number) for phase in problem.phases)
    if not found:
        return figures
    return figures._replace(
        largest=min(found.values()), phases=each, capped=min(found.values()) >= most
    )


def _list_parts(
    planning: Planning,
) -> Iterator[tuple[Sequence[int], ImpactSequence, float | None]]:
    """What is planned along curves from rest to rest: phases, curves and duration."""
    for block in planning.blocks:
        for part in block.chain.split() if block.chain is not None else ():
            numbers = [phase.number for phase in part.phases]
            yield numbers, part, add_up(part.phases, planning.allowed)


def _find_widest(
    part: ImpactSequence,
    epsilon: float,
    options: PlanOptions,
    ranges: Mapping[str, float],
    duration: float | None,
    most: float,
) -> float:
    """The largest factor on ranges with which phases have a plan, by bisection."""
    rough = replace(options, accuracy=max(options.accuracy, _ROUGH))

    def exists(factor: float) -> bool:
        try:
            plan_sequence(part, epsilon, rough.scale_ranges(ranges, factor), duration, False)
        except (InfeasibleError, SolverError):
            return False
        return True

    low, high = 0.0, options.robust
    low, high = (high, min(2 * high, most))
    while high < most and exists(high):
        low, high = high, min(2 * high, most)
    if high >= most and exists(most):
        return most
    while high - low > _CLOSE * high:
        middle = (low + high) / 2
        low, high = (middle, high) if exists(middle) else (low, middle)
    return low
