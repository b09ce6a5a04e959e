"""Torques held over control periods: a second NLP, from the plan with free torques."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby, pairwise

import numpy as np

from .collocation import Scheme, make_scheme
from .refinement import refine
from .search import TimeSearch, TimeSolution
from .stage import Stage, resample, with_controls

_TRIES = ((1.01, 2), (1.03, 2), (1.07, 3), (1.15, 4), (1.3, 6), (1.6, 8))
"""Durations with held torques to try, over those with free ones, and least numbers of periods."""
_PATIENCE = 80  # most solver iterations with held torques
_BRIEF = 1e-3  # duration, over a period, that counts as zero
_SHORTER = 4  # most times that a period is left out


def hold_torques(search: TimeSearch, free: TimeSolution) -> TimeSolution:
    """Plan with torques held over control periods, from one with free torques."""
    scene, options = search.problem.scene, search.options
    controls = 2 if scene.control_hold == "linear" else 1
    held = replace(search, scheme=make_scheme(options.scheme, options.degree, controls))
    for stretch, least in _TRIES:
        periods = cut_periods(free.stages, held.scheme, stretch, least)
        solution = held.solve(periods, most=search.wait(_PATIENCE))
        if solution.success:
            solution = refine(held, _leave_out(held, solution))
            if solution.success:
                return solution._replace(error=free.error, free=free)
    status = f"no torques held over {scene.control_hold} periods were found"
    return free._replace(status=status, success=False)


def _leave_out(held: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """The solution without last periods of phases whose duration has vanished."""
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
    left = 1 - part.fractions[-1]
    guess = part._replace(
        **{name: getattr(part, name)[:-1] for name in ("z", "v", "a", "forces", "tau")},
        duration=part.duration * left,
        fractions=part.fractions[:-1] / left,
        nodes=np.delete(part.nodes, -2, axis=0),
    )
    return replace(stage, guess=guess, periods=stage.periods[:-1])


def cut_periods(
    stages: Sequence[Stage], scheme: Scheme, stretch: float, least: int = 1
) -> list[Stage]:
    """Stages whose intervals are periods or parts of them, stretched in time.

    From rest to rest they last at least half a period less than `least` periods.
    """
    cut = list[Stage]()
    period = stages[0].formation.scene.control_period
    whole = sum(stage.guess.duration for stage in stages)
    stretch = max(stretch, (least - 0.5) * period / whole)
    for _, own in groupby(stages, key=lambda stage: stage.phase):
        start = 0.0
        for stage in own:
            stop = start + stretch * stage.guess.duration
            ticks = period * np.arange(math.floor(start / period), math.ceil(stop / period) + 1)
            near = _BRIEF * period
            edges = np.array([start, *ticks[(ticks > start + near) & (ticks < stop - near)], stop])
            numbers = tuple(math.floor((a + b) / 2 / period) for a, b in pairwise(edges.tolist()))
            part = resample(stage.guess, scheme, (edges - start) / (stop - start))
            guess = part._replace(
                duration=stop - start,
                nodes=part.nodes / np.array([[1.0], [stretch]]),
                v=part.v / stretch,
                a=part.a / stretch**2,
            )
            guess = with_controls(guess, scheme.controls)
            cut.append(replace(stage, guess=guess, periods=numbers))
            start = stop
    return cut
