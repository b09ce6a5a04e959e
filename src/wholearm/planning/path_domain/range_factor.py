"""How wide ranges may be along curves: as wide as a sweep finds a motion, and then a plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...common.errors import InfeasibleError, SolverError
from ...geometry.curve import Curve
from ..options import PlanOptions
from ..robust.robust_rows import Guide
from .path_plan import plan_curves
from .refine import Round
from .speed_profile import Fastest
from .task import Task

_CLOSE = 0.01
"""Error of the factor, relatively."""
_LESS = 0.98
"""Factor from one plan that is tried to the next."""
_TRIES = 8
"""Most plans that are tried."""
_ROUGH = 1e-2
"""Accuracy of plans that are made to see whether there are any."""


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

    def find_motion(factor: float, near: Sequence[Guide]) -> tuple[Guide, ...] | None:
        task = Task(curves, epsilon, scale(factor), phases, None, guides=tuple(near))
        found = Round.begin(task, 1).fastest
        return None if found is None else _cut(found, curves)

    low, high, near, middle = 0.0, np.inf, tuple(guides), min(1.0, most)
    while low < most and (np.isinf(high) or high - low > _CLOSE * high):
        found = find_motion(middle, near)
        if found is None:
            high = middle
        else:
            low, near = middle, found
        middle = min(2 * low, most) if np.isinf(high) else (low + high) / 2
    for _ in range(_TRIES):
        options = replace(scale(low), accuracy=_ROUGH)
        try:
            plan_curves(curves, epsilon, options, phases, explained=False)
        except (InfeasibleError, SolverError):
            low *= _LESS
            continue
        return low
    return 0.0


def _cut(found: Fastest, curves: Sequence[Curve]) -> tuple[Guide, ...]:
    """A fastest motion along each curve."""
    guides, start = [], 0.0
    for curve in curves:
        s = np.linspace(0.0, curve.length, len(found.s))
        b, none = np.interp(s + start, found.s, found.b), np.zeros_like(s)
        guides.append(Guide(s, none, b, none))
        start += curve.length
    return tuple(guides)
