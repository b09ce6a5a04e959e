"""What is looked at while a motion goes on with given modes of contact."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from .state import CLOSED
from .stepper import Modes, Outputs
from .system import System

ROUNDING = 1e-9
"""Shortfall of a force that counts as rounding, in the scene's unit."""
SPEED_ROUNDING = 1e-12
"""Likewise of a sliding or turning speed."""
TURNING = 1e-4
"""Speed, relative to the scene's, below which sliding or turning may be about to reverse."""


class Watch(NamedTuple):
    """Values that are positive until something happens, in units of the scene.

    In this order: c_n; reserves of friction that holds, either way; speeds of what slides and
    turns; ranges of the kept pairs.

    Attributes
    ----------
    columns : ndarray of int, shape (c,)
        Outputs of a step that they depend on.
    rows, constant : ndarray, shape (m, c) and (m,)
        They are rows @ outputs[columns] + constant.
    slack, clear : ndarray, shape (m,)
        What counts as rounding, and what is more than that for sure.
    pairs : ndarray of bool, shape (N,)
        Those that are not kept, and may close.
    plain : bool
        Whether friction holds nothing.
    """

    columns: NDArray[np.int64]
    rows: Array
    constant: Array
    slack: Array
    clear: Array
    pairs: NDArray[np.bool_]
    plain: bool

    def measure(self, out: Array) -> Array:
        """Values of the outputs of a step, shape (m,)."""
        return np.asarray(self.rows @ out[self.columns] + self.constant)


def build_watch(system: System, modes: Modes, to: Outputs) -> Watch:
    """What is looked at with some modes."""
    scales, n, k = system.scales, system.n, len(modes.kept)
    stuck, held = [modes.kept.index(pair) for pair in modes.stuck], list(modes.held)
    slides, turning = np.flatnonzero(modes.Xi), np.flatnonzero(modes.sigma)
    holds = len(stuck) + len(held)
    counts = [k + 2 * holds, len(slides) + len(turning), k]
    rows, constant = np.zeros((sum(counts), to.size)), np.zeros(sum(counts))
    i = np.arange(sum(counts))
    rows[i[:k], to.c_n.start + i[:k]] = 1 / scales.force
    for j, (one, sign) in enumerate(product(range(holds), (-1.0, 1.0)), start=k):
        unit, row = scales.force, rows[j]
        if one < len(stuck):
            row[to.c_n.start + stuck[one]] = system.friction[modes.stuck[one]] / unit
        else:
            unit = float(system.friction_units[held[one - len(stuck)]])
            constant[j] = system.dry[held[one - len(stuck)]] / unit
        row[to.f.start + one] = sign / unit
    at = i[counts[0] :]
    rows[at[: len(slides)], to.v_t.start + slides] = np.array(modes.Xi)[slides] / scales.speed
    at = at[len(slides) :]
    signs = np.array(modes.sigma)[turning] / system.units[n + turning]
    rows[at[: len(turning)], n + turning] = signs
    ranges = to.ranges.start + np.array(modes.kept, dtype=int)
    rows[at[len(turning) :], ranges] = 1 / scales.length
    columns = np.flatnonzero(rows.any(axis=0))
    pairs = np.ones(len(system.names), dtype=bool)
    pairs[list(modes.kept)] = False
    return Watch(
        columns,
        np.ascontiguousarray(rows[:, columns]),
        constant,
        np.repeat([ROUNDING, SPEED_ROUNDING, CLOSED], counts),
        np.repeat([10 * ROUNDING, TURNING, 10 * CLOSED], counts),
        pairs,
        not holds,
    )
