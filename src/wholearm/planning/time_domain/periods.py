"""Rows of the time-domain NLP for torques that are held over control periods."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from ..columns import Columns
from .assembly import Indices
from .kernels import NamedKernel, name_kernel
from .layout import StageLayout
from .rows import Rows
from .stage import Stage


class _Piece(NamedTuple):
    """An interval as a part of a period: its stage, number there, share of it, and unknowns."""

    stage: int
    period: int
    share: float
    h: int
    tau: Indices


def add_periods(rows: Rows, stages: Sequence[Stage], layouts: Sequence[StageLayout]) -> None:
    """Intervals of one period last as long as it and have its torques, constant or linear.

    Linear torques go on from period to period.
    """
    scene = stages[0].formation.scene
    linear, goes_on = scene.control_hold == "linear", scene.has_slow_motors
    pieces = [
        (stage.phase, _Piece(k, period, float(stage.guess.fractions[i]), int(layout.h[i]), tau))
        for k, (stage, layout) in enumerate(zip(stages, layouts, strict=True))
        for i, (period, tau) in enumerate(zip(stage.periods, layout.tau, strict=True))
    ]
    for _, found in groupby(pieces, key=lambda own: own[0]):
        phase = [piece for _, piece in found]
        last = phase[-1].period
        for period, own in groupby(phase, key=lambda piece: piece.period):
            _add_period(rows, list(own), scene.control_period, period == last, linear)
        for before, after in pairwise(phase):
            if not goes_on and (linear or before.period == after.period):
                limit, same = 1 / scene.torque_limit, rows.linear(2)
                rows.add_entries(same, after.tau[:2], limit)
                rows.add_entries(same, before.tau[-2:], -limit)


def _add_period(
    rows: Rows, pieces: Sequence[_Piece], period: float, last: bool, linear: bool
) -> None:
    whole = rows.linear(1, low=0.0 if last else period, high=period)
    rows.add_entries(whole, np.array([piece.h for piece in pieces]), 1.0)
    for one, other in pairwise(pieces):
        if one.stage == other.stage:
            even = rows.linear(1)
            size = one.share + other.share
            rows.add_entries(even, np.array([one.h]), other.share / size)
            rows.add_entries(even, np.array([other.h]), -one.share / size)
        if linear:
            kernel = slope_kernel()
            columns = kernel.x.join(
                before=one.tau, after=other.tau, h=np.array([one.h]), coming=np.array([other.h])
            )
            rows.add_copies(kernel, columns, rows.nonlinear(kernel.outputs))


@lru_cache(maxsize=1)
def slope_kernel() -> NamedKernel:
    """What differs of the slopes of linear torques in two intervals, times both durations."""
    x = Columns(before=4, after=4, h=1, coming=1).make_symbols()
    slopes = (x.before[2:] - x.before[:2]) * x.coming - (x.after[2:] - x.after[:2]) * x.h
    return name_kernel(x, Columns().make_symbols(), slopes=slopes)
