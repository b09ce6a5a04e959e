"""Largest factor on ranges with which phases have a plan, by bisection.

The minimum-time sweep decides each step; then plans are tried with ever smaller factors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...common.errors import InfeasibleError, SolverError
from ...geometry.curve import Curve
from ..options import PlanOptions
from ..robust.robust_rows import Guide
from .path_plan import ROUGH, Iterate, Task, plan_curves
from .speed_profile import Fastest

_CLOSE = 0.01  # error of the factor, relatively
_LESS = 0.98  # factor from one tried plan to the next
_TRIES = 8  # most plans that are tried


def find_widest(
    curves: Sequence[Curve],
    epsilon: float,
    scale: Callable[[float], PlanOptions],
    phases: Sequence[int],
    guides: Sequence[Guide],
    most: float,
) -> float:
    """The largest factor on ranges with which phases have a plan; zero if there is none.

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
        fastest = Iterate.begin(task, 1).fastest
        if fastest is None:
            high = middle
        else:
            low, guides = middle, _cut(fastest, curves)
        middle = min(2 * low, most) if np.isinf(high) else (low + high) / 2
    for _ in range(_TRIES):
        options = replace(scale(low), accuracy=ROUGH)
        try:
            plan_curves(curves, epsilon, options, phases, explained=False)
        except (InfeasibleError, SolverError):
            low *= _LESS
            continue
        return low
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
