"""Stages that a solution asks for: limits monitored, intervals bisected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .collocation import Scheme
from .mesh import bisect
from .stage import Stage, StagePoints

DEFECT = 2e-8
"""Largest error of z and z' by collocation at the end of an interval, in the scene's own units."""
DEAR = 1e-5
"""Largest price of limits that are raised in an interval, over the cost, without halving it."""
AT_ONCE = 2
"""Most times that an interval is halved at once."""
_LESS = 4.0
"""Factor by which a halving makes what better torques would gain less."""
_CHEAPER = 3
"""Power of two by which a halving makes misses of limits cheaper."""
_BROKEN = 1e-6
"""Distance below zero from which on a limit is broken, over the radius of gyration."""


def adopt(stages: Sequence[Stage], points: Sequence[StagePoints]) -> list[Stage]:
    """The same stages with a solution as their guess."""
    return [replace(stage, guess=part) for stage, part in zip(stages, points, strict=True)]


def bisect_intervals(
    stages: Sequence[Stage], scheme: Scheme, times: Sequence[NDArray[np.int64]]
) -> list[Stage]:
    """Stages with intervals halved so many times, each of shape (K,)."""
    return [
        replace(
            stage,
            guess=bisect(stage.guess, scheme, mine),
            periods=tuple(np.repeat(stage.periods, 2**mine).tolist()) if stage.periods else (),
        )
        if mine.any()
        else stage
        for stage, mine in zip(stages, times, strict=True)
    ]


def halve(stages: Sequence[Stage], scheme: Scheme) -> list[Stage]:
    """Stages with all intervals halved."""
    return bisect_intervals(stages, scheme, [np.ones(own.intervals, dtype=int) for own in stages])


def count_halvings(prices: Array, defects: Array, scheme: Scheme) -> NDArray[np.int64]:
    """How often to halve each interval and its parts, shape (K,).

    So often that what is too much will not be, by what a halving makes of it: defects shrink with
    the scheme's order, and what misses of limits cost, to less than a tenth.

    Parameters
    ----------
    prices : ndarray, shape (K,)
        What raising limits by their misses would cost, over the cost.
    defects : ndarray, shape (K, 2, 5)
        What collocation misses at the end of an interval.
    scheme : Scheme
    """
    dear = np.maximum(prices / DEAR, 1.0)
    off = np.maximum(np.abs(defects).max(axis=(1, 2)) / DEFECT, 1.0)
    times = np.maximum(np.log2(dear) / _CHEAPER, np.log2(off) / scheme.order)
    return np.asarray(np.clip(np.ceil(times), 0, AT_ONCE), dtype=np.int64)


def spread_halvings(shares: Sequence[Array], most: float) -> list[NDArray[np.int64]]:
    """How often to halve intervals, (K,) each, so that their shares of an error sum up to `most`.

    The largest are halved first, which leaves a quarter of what they have.
    """
    left, times = np.concatenate(shares), np.zeros(sum(map(len, shares)), dtype=np.int64)
    even = most / len(left)
    while left.sum() > most:
        worst = int(np.where(times < AT_ONCE, left, 0.0).argmax())
        if times[worst] == AT_ONCE or left[worst] <= even:
            break
        left[worst] /= _LESS
        times[worst] += 1
    return np.split(times, np.cumsum([len(own) for own in shares])[:-1])


def cap_halvings(times: list[NDArray[np.int64]], most: int) -> list[NDArray[np.int64]]:
    """How often to halve intervals: once at most, if there would be more than `most` of them."""
    wanted = sum(int((2**mine).sum()) for mine in times)
    return times if wanted <= most else [np.minimum(mine, 1) for mine in times]


def monitor_violated(stages: Sequence[Stage]) -> list[Stage] | None:
    """Stages that also watch the limits which their guesses break, or None if they break none."""
    changed = []
    for stage in stages:
        values = stage.formation.evaluate_limits(stage.guess.z.reshape(-1, 5))
        rho = stage.formation.scene.polygon.gyration_radius
        broken = np.flatnonzero(values.min(axis=0) < -_BROKEN * rho).tolist()
        changed.append(replace(stage, monitored=tuple(sorted({*stage.monitored, *broken}))))
    monitored = [stage.monitored for stage in stages]
    return changed if [stage.monitored for stage in changed] != monitored else None
