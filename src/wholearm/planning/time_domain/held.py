"""Torques that are held over control periods, chosen as such.

A plan with free torques says how long each stage lasts and how everything moves. From there the
torques of each period, constant or linear over it, are unknowns of another problem on the same
stages: its intervals are periods, or parts of them where a stage ends within one. The periods of a
phase count from its start, and its last one may be shorter. As many are taken as the plan lasts
with a little to spare; where that is too few there are more, and where the last shrinks to nothing
there is one less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np

from ...common.arrays import Array
from .collocation import Scheme, make_scheme
from .enforcing import enforce_between
from .mesh import resample, with_controls
from .modes import drop, link, merge
from .search import Search, Solution
from .stage import Stage, StagePoints

_TRIES = ((1.01, 2), (1.03, 2), (1.07, 3), (1.15, 4), (1.3, 6), (1.6, 8))
"""Durations of phases with held torques to try, over those with free ones, and least periods."""
_PATIENCE = 80
"""Most iterations of one solve."""
_SLIVER = 0.5
"""Duration of a stage, over a period, below which it is first left out."""
_BRIEF = 1e-3
"""Share of a period below which it counts as nothing."""
_SHORTER = 4
"""Most times that a period is left out."""


def hold_torques(search: Search, free: Solution) -> Solution:
    """A plan with torques held over periods, from one with free torques.

    Where none is found the status says so.
    """
    scene = search.problem.scene
    options, count = search.options, 2 if scene.control_hold == "linear" else 1
    held = replace(search, scheme=make_scheme(options.scheme, options.degree, count))
    whole = drop_brief(free.stages)
    others = [free.stages] if len(whole) < len(free.stages) else []
    tries = [(known, *own) for known in (whole, *others) for own in _TRIES]
    for known, stretch, least in tries:
        stages = cut_periods(known, held.scheme, stretch, least)
        solution = held.solve(stages, most=search.wait(_PATIENCE))
        if not solution.success:
            continue
        kept = enforce_between(held, _leave_out(held, solution))
        if kept.success:
            return kept._replace(error=free.error, free=free)
    status = f"no torques held over {scene.control_hold} periods were found"
    return free._replace(status=status, success=False)


def _leave_out(held: Search, solution: Solution) -> Solution:
    """A solution with fewer periods, where the last one of a phase has shrunk to nothing."""
    for _ in range(_SHORTER):
        stages, changed = list(solution.stages), False
        for k, (stage, coming) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
            last = coming is None or coming.phase != stage.phase
            part, period = stage.guess, stage.formation.scene.control_period
            brief = part.duration * part.fractions[-1] < _BRIEF * period
            if last and brief and stage.intervals > 1 and stage.periods[-1] != stage.periods[-2]:
                stages[k], changed = _drop_last(stage), True
        if not changed:
            return solution
        fewer = held.solve(stages, most=held.wait(_PATIENCE))
        if not fewer.success or fewer.cost > solution.cost:
            return solution
        solution = fewer
    return solution


def _drop_last(stage: Stage) -> Stage:
    """A stage without its last interval, whose end is that of the one before."""
    part = stage.guess
    nodes = part.nodes[:-1].copy()
    nodes[-1] = part.nodes[-1]
    left = 1 - part.fractions[-1]
    tables = {name: getattr(part, name)[:-1] for name in ("z", "v", "a", "forces", "tau")}
    guess = part._replace(
        duration=part.duration * left,
        fractions=part.fractions[:-1] / left,
        nodes=nodes,
        **tables,
    )
    return replace(stage, guess=guess, periods=stage.periods[:-1])


def drop_brief(stages: Sequence[Stage]) -> list[Stage]:
    """Stages without those that are much shorter than a period, as far as phases have others."""
    left = list(stages)
    for stage in stages:
        if stage.guess.duration < _SLIVER * stage.formation.scene.control_period:
            fewer = drop(left, left.index(stage))
            left = left if fewer is None else fewer
    return link(merge(left)) if len(left) < len(stages) else left


def cut_periods(
    stages: Sequence[Stage], scheme: Scheme, stretch: float, least: int = 1
) -> list[Stage]:
    """Stages whose intervals are periods, or parts of them, at a duration that is stretched.

    From rest to rest they last at least as many periods as the `least` number, but for a half.
    """
    cut = list[Stage]()
    period = stages[0].formation.scene.control_period
    whole = sum(stage.guess.duration for stage in stages)
    stretch = max(stretch, (least - 0.5) * period / whole)
    for _, own in groupby(stages, key=lambda stage: stage.phase):
        start = 0.0
        for stage in own:
            stop = start + stretch * stage.guess.duration
            cut.append(_cut(stage, scheme, (start, stop), period, stretch))
            start = stop
    return cut


def _cut(
    stage: Stage, scheme: Scheme, span: tuple[float, float], period: float, stretch: float
) -> Stage:
    """One stage, from when to when in its phase."""
    start, stop = span
    ticks = period * np.arange(math.floor(start / period), math.ceil(stop / period) + 1)
    near = _BRIEF * period
    edges = np.array([start, *ticks[(ticks > start + near) & (ticks < stop - near)], stop])
    numbers = tuple(math.floor((a + b) / 2 / period) for a, b in pairwise(edges.tolist()))
    breaks = (edges - start) / (stop - start)
    part = resample(stage.guess, scheme, breaks)
    guess = _slow_down(part, stretch)._replace(duration=stop - start)
    return replace(stage, guess=with_controls(guess, scheme.controls), periods=numbers)


def _slow_down(part: StagePoints, stretch: float) -> StagePoints:
    rate: Array = np.array([[1.0], [stretch]])
    return part._replace(nodes=part.nodes / rate, v=part.v / stretch, a=part.a / stretch**2)
