"""Stages that a solution asks for: friction turned, limits watched, intervals halved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..dynamics import Directions
from .collocation import Scheme
from .mesh import bisect, resample
from .stage import Stage, StagePoints
from .staging import LEAST_INTERVALS
from .timenlp import least_rates

_STALLED = 1e-6
"""Rate over the largest one at which a direction of friction counts as held back."""
_BROKEN = 1e-6
"""How far below zero a limit is broken, over the radius of gyration."""


def adopt(stages: Sequence[Stage], points: Sequence[StagePoints]) -> list[Stage]:
    """The same stages with a solution as their guess."""
    return [replace(stage, guess=part) for stage, part in zip(stages, points, strict=True)]


def halve(
    stages: Sequence[Stage], scheme: Scheme, marked: Sequence[NDArray[np.bool_]]
) -> list[Stage]:
    """Stages with the marked intervals halved, each of shape (K,)."""
    return [
        replace(stage, guess=bisect(stage.guess, scheme, mine)) if mine.any() else stage
        for stage, mine in zip(stages, marked, strict=True)
    ]


def watch_broken(stages: Sequence[Stage]) -> list[Stage] | None:
    """Stages that also watch the limits which their guesses break, or None if they break none."""
    changed = []
    for stage in stages:
        values = stage.formation.evaluate_limits(stage.guess.z.reshape(-1, 5))
        rho = stage.formation.scene.polygon.gyration_radius
        broken = np.flatnonzero(values.min(axis=0) < -_BROKEN * rho).tolist()
        changed.append(replace(stage, watched=tuple(sorted({*stage.watched, *broken}))))
    watched = [stage.watched for stage in stages]
    return changed if [stage.watched for stage in changed] != watched else None


def turn_friction(stages: Sequence[Stage], scheme: Scheme) -> list[Stage] | None:
    """Stages with a direction of friction turned where their guesses hold it back, or None.

    Where a sense of friction is at its least rate over a stretch, the motion would rather go the
    other way: the stage is split there.
    """
    for k, stage in enumerate(stages):
        turning = set(stage.turns) | (set(stages[k - 1].turns) if k else set())
        row, first, last = _find_longest_run(_find_held(stage, scheme, turning))
        if last - first < scheme.degree:
            continue
        begin, stop = first // scheme.degree, -(-last // scheme.degree)
        signs = np.concatenate(stage.directions)
        rows = stage.formation.turn_with(row)
        signs[list(rows)] *= -1
        other = Directions(signs[:-2], signs[-2:])
        cuts = [(0, begin, stage.directions), (begin, stop, other)]
        cuts.append((stop, stage.intervals, stage.directions))
        pieces: list[Stage] = []
        for start, end, directions in cuts:
            if end > start:
                guess = _cut(stage.guess, scheme, start, end)
                piece = replace(stage, directions=directions, guess=guess, turns=rows)
                opens = stage.opens and not pieces
                pieces.append(replace(piece, until=None, gained=None, strikes=False, opens=opens))
        ending = {name: getattr(stage, name) for name in ("until", "gained", "strikes", "turns")}
        pieces[-1] = replace(pieces[-1], **ending)
        return [*stages[:k], *pieces, *stages[k + 1 :]]
    return None


def _find_held(stage: Stage, scheme: Scheme, turning: set[int]) -> NDArray[np.bool_]:
    """Which contacts and joints are held back at each point, shape (K d, n_c + 2)."""
    part, formation = stage.guess, stage.formation
    z, v = part.z.reshape(-1, 5), part.v.reshape(-1, 5)
    slip = np.einsum("nij,nj->ni", formation.evaluate(z, v).A_t, v)
    rates = np.hstack([slip / formation.scene.polygon.gyration_radius, v[:, 3:]])
    senses = rates * np.concatenate(stage.directions)
    fast = np.abs(v[:, 2:]).max()
    least = 1.01 * least_rates(stage, scheme).reshape(-1, 1)
    held = senses < least + _STALLED * fast
    held &= (np.abs(senses).max(axis=1) > 1e-3 * fast)[:, None]
    # What turns at an end of the stage has both its directions already.
    held[:, [*turning, *formation.rolling_rows]] = False
    return np.asarray(held)


def _find_longest_run(held: NDArray[np.bool_]) -> tuple[int, int, int]:
    """Column, first and past-the-last row of the longest run of True."""
    best = (0, 0, 0)
    for column, flags in enumerate(held.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
        for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if last - first > best[2] - best[1]:
                best = (column, first, last)
    return best


def _cut(part: StagePoints, scheme: Scheme, begin: int, stop: int) -> StagePoints:
    """Intervals `begin` to `stop`, on at least the least number of them."""
    breaks = part.breaks[begin : stop + 1]
    shares = (breaks - breaks[0]) / (breaks[-1] - breaks[0])
    while len(shares) - 1 < LEAST_INTERVALS:
        shares = np.sort(np.append(shares, (shares[1:] + shares[:-1]) / 2))
    return resample(part, scheme, shares, float(breaks[0]), float(breaks[-1]))
