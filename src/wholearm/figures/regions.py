"""Runs and regions: what hangs together, where a text fits best, tints that differ."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers


def find_runs(flags: Flags) -> list[slice]:
    """Stretches of True, of two places or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    runs = [slice(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)]
    return [run for run in runs if run.stop - run.start > 1]


def split(cell: Numbers) -> Iterator[tuple[int, Flags]]:
    """The parts of a grid that hang together by sides of its places, each with whose it is.

    `cell` says for each place whose it is, negative: nobody's. Parts come by owner, from below.
    """
    number = np.arange(cell.size).reshape(cell.shape)
    before = None
    # The least number of each part spreads along rows and columns until nothing changes.
    while before is None or (number != before).any():
        before = number
        number = _spread(_spread(number, cell).T, cell.T).T
    parts, first = np.unique(number, return_index=True)
    owners = cell.ravel()[first]
    for k in np.argsort(owners, kind="stable"):
        if owners[k] >= 0:
            yield int(owners[k]), number == parts[k]


def _spread(number: Numbers, cell: Numbers) -> Numbers:
    """The least number of each stretch of a row with one owner for all of it."""
    starts = np.ones(cell.shape, dtype=bool)
    starts[:, 1:] = cell[:, 1:] != cell[:, :-1]
    stretch = np.cumsum(starts.ravel()) - 1
    least = np.minimum.reduceat(number.ravel(), np.flatnonzero(starts.ravel()))
    return np.asarray(least[stretch].reshape(cell.shape))


def find_room(region: Flags, step: Array) -> tuple[int, int, float]:
    """Where a region is widest: row, column, and the distance to its edge there.

    `step` are the distances of rows and of columns, shape (2,). What lies beyond the grid
    is outside of the region.
    """
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    low = np.array([rows[0], columns[0]])
    padded = np.pad(region[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], 1)
    # Along columns first, then the nearest over all columns.
    place = np.arange(len(padded))[:, None]
    below = np.maximum.accumulate(np.where(padded, -np.inf, place), axis=0)
    above = np.minimum.accumulate(np.where(padded, np.inf, place)[::-1], axis=0)[::-1]
    upright = (step[0] * np.minimum(place - below, above - place)) ** 2
    apart = (step[1] * np.subtract.outer(*(np.arange(padded.shape[1]),) * 2)) ** 2
    room = np.array([(apart + row).min(axis=1) for row in upright])
    row, column = np.unravel_index(int(room.argmax()), room.shape)
    return int(row + low[0] - 1), int(column + low[1] - 1), float(np.sqrt(room[row, column]))


def choose_tints(cell: Numbers, tints: int) -> Numbers:
    """A tint for each cell, different from its neighbours' as far as there are enough.

    `cell` says for each place of a grid whose it is, negative: nobody's.
    """
    count = int(cell.max()) + 1
    touching = np.zeros((count, count), dtype=bool)
    for one, other in ((cell[1:], cell[:-1]), (cell[:, 1:], cell[:, :-1])):
        both = (one >= 0) & (other >= 0) & (one != other)
        touching[one[both], other[both]] = touching[other[both], one[both]] = True
    chosen = np.full(count, -1)
    for k in np.argsort(-touching.sum(axis=1), kind="stable"):
        used = set(chosen[touching[k]].tolist())
        fresh = [tint for tint in range(tints) if tint not in used]
        chosen[k] = fresh[0] if fresh else 0
    return chosen
