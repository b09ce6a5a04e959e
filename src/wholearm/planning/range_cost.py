"""Cost of parametric ranges, and the largest factor of them with a plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..mechanics.dynamics import measure_speed
from ..mechanics.statics import SURE
from ..problem.uncertainty import PARAMETERS
from ..results.plan_record import RangeFigures
from .blocks import Planning, plan_blocks
from .options import Objective, PlanOptions
from .path_domain.impact_sequence import ImpactSequence
from .path_domain.path_motion import PathMotion
from .path_domain.range_factor import find_widest
from .phase_plan import combine
from .robust.robust_rows import Guide, list_holds, measure_holds

WIDEST = 0.95  # largest relative range that is tried
_STILL = 1e-9  # relative speed of rest but for rounding
_MOST = 1e3  # largest factor that is tried


def assess_ranges(planning: Planning, report: Callable[[str], None]) -> RangeFigures:
    """Plan without ranges, and if asked for find the widest ranges along curves."""
    options, problem = planning.options, planning.problem
    report("planning without ranges")
    bare = plan_blocks(problem, planning.curves, replace(options, ranges={}), report)
    nominal = combine(options.goal, [plan.value for plan in bare.plans])
    figures = RangeFigures(dict(options.ranges), nominal, held=tuple(_list_held(planning)))
    if not options.largest:
        return figures
    unit = options.scale_ranges(problem.ranges, 1.0).ranges
    relative = [unit[own.name] for own in PARAMETERS if not own.unit]
    most = WIDEST / max(max(relative), WIDEST / _MOST)

    def scale(factor: float) -> PlanOptions:
        wider = options.scale_ranges(problem.ranges, factor)
        return replace(wider, objective=Objective.TIME, duration=None)

    found: dict[int, float] = {}
    for numbers, part, motions in _list_parts(planning):
        report(f"looking for the widest ranges of phase {numbers[0]}")
        curves = part.continuous_curves
        guides = [Guide(own.grid.s, *own.profile) for own in motions]
        widest = find_widest(curves, problem.epsilon, scale, numbers, guides, most)
        found |= dict.fromkeys(numbers, widest)
    if not found:
        return figures
    each, least = tuple(found.get(phase.number) for phase in problem.phases), min(found.values())
    return figures._replace(largest=least, phases=each, capped=least >= most)


def _list_held(planning: Planning) -> Iterator[int]:
    """Numbers of phases that friction within the ranges may hold at rest at their start."""
    scales, ranges = planning.problem.scene.scales, planning.options.ranges
    for phase, plan in zip(planning.problem.phases, planning.plans, strict=True):
        first = plan.motion.evaluate(np.zeros(1))
        if measure_speed(planning.problem.scene, first.z_dot[0]) > _STILL * scales.speed:
            continue
        holds = list_holds(phase.formation, first.z[0], ranges)
        if measure_holds(holds, first.tau[0]) < SURE * scales.torque:
            yield phase.number


def _list_parts(
    planning: Planning,
) -> Iterator[tuple[Sequence[int], ImpactSequence, list[PathMotion]]]:
    """Parts of blocks along curves from rest to rest: phases, curves and motions."""
    for block in planning.blocks:
        for part in block.chain.split() if block.chain is not None else ():
            numbers = [phase.number for phase in part.phases]
            motions = [planning.plans[number - 1].motion for number in numbers]
            yield numbers, part, [own for own in motions if isinstance(own, PathMotion)]
