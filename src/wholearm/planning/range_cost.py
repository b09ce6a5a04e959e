"""Cost of parametric ranges, and the largest factor of them with a plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..common.errors import InfeasibleError, SolverError
from ..geometry.curve import Curve
from ..mechanics.dynamics import measure_speed
from ..mechanics.statics import SURE
from ..problem.uncertainty import PARAMETERS
from ..results.plan_record import RangeFigures
from .blocks import Planning, plan_blocks
from .options import Objective, PlanOptions
from .path_domain.path_mesh import Fastest
from .path_domain.path_motion import PathMotion
from .path_domain.path_plan import Task, plan_curves
from .phase_plan import combine
from .robust.robust_rows import Guide, list_holds, measure_holds

WIDEST = 0.95  # largest relative range that is tried
_STILL = 1e-9  # relative speed of rest but for rounding
_MOST = 1e3  # largest factor that is tried
_CLOSE = 0.01  # error of the factor, relatively
_LESS = 0.98  # factor from one tried plan to the next
_TRIES = 8  # most plans that are tried


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
    chains = [block.chain for block in planning.blocks if block.chain is not None]
    for part in (part for chain in chains for part in chain.split()):
        numbers = [phase.number for phase in part.phases]
        motions = (planning.plans[number - 1].motion for number in numbers)
        guides = [Guide(m.grid.s, *m.profile) for m in motions if isinstance(m, PathMotion)]
        report(f"looking for the widest ranges of phase {numbers[0]}")
        curves = part.continuous_curves
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


def find_widest(
    curves: Sequence[Curve],
    epsilon: float,
    scale: Callable[[float], PlanOptions],
    phases: Sequence[int],
    guides: Sequence[Guide],
    most: float,
) -> float:
    """The largest factor on ranges with which phases have a plan; zero if there is none.

    The minimum-time sweep decides each step of a bisection; then plans are tried with ever smaller
    factors.

    Parameters
    ----------
    curves         as for `plan_curves`
    epsilon : [N]
    scale          options for the least time with ranges so many times as wide
    guides         a motion along each curve
    most           the largest factor that is tried
    """
    low, high, middle = 0.0, np.inf, min(1.0, most)
    while low < most and (np.isinf(high) or high - low > _CLOSE * high):
        task = Task(curves, epsilon, scale(middle), phases, None, guides=tuple(guides))
        fastest = task.find_fastest()
        if fastest is None:
            high = middle
        else:
            low, guides = middle, _cut(fastest, curves)
        middle = min(2 * low, most) if np.isinf(high) else (low + high) / 2
    for _ in range(_TRIES):
        try:
            plan_curves(curves, epsilon, scale(low).roughen(), phases, explained=False)
            return low
        except (InfeasibleError, SolverError):
            low *= _LESS
    return 0.0


def _cut(fastest: Fastest, curves: Sequence[Curve]) -> list[Guide]:
    """A minimum-time profile along each curve."""
    guides, start = [], 0.0
    for curve in curves:
        s = np.linspace(0.0, curve.length, len(fastest.s))
        b, none = np.interp(s + start, fastest.s, fastest.b), np.zeros_like(s)
        guides.append(Guide(s, none, b, none))
        start += curve.length
    return guides
