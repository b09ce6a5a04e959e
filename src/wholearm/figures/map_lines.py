"""Geometry of map drawings: offset lines, arrow heads, labels, tints; in points of the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers
from ..contacts.elemental import Contact
from ..mapping.formation_map import CROSSED, Border
from ..results.trajectory import Trajectory

INK, LINE = "#222222", "#9aa1ab"
LOST = ("#ececec", "#b8b8b8", "////")  # face, lines and hatch
AMBIGUOUS = "#AA3377"
CROSSED_LOOK = ("#f6e3ee", "#CC79A7", "\\\\\\\\")
UNREACHED = {
    "finger 1 too short": -1,
    "finger 2 too short": -2,
    "joint 1 in or above the object": -3,
    "joint 2 in or above the object": -4,
    "fingers overlap": CROSSED,
}
"""What is written where nothing can be reached, and its code in `FormationMap.cell`."""
FORTH, BACK, FREE = "#0072B2", "#D55E00", "#7a838f"
TINTS = ("#f3f6fb", "#fbf6ea", "#eef7f0", "#f9eff4", "#f4f1fb", "#eef6f8", "#f7f7ee")
SPACING = 42.0  # distance between arrow heads on a directed line [points]


def shorten(contact: Contact) -> str:
    """The name of a contact in a cell's label."""
    rounded = contact.surface == "tip" and contact.feature == "v"
    return f"{contact.corner}{'*' if rounded else ''}"


def trace_plan(plan: Trajectory) -> list[Array]:
    """Path of each phase of a trajectory, (n, 2) [m, rad]."""
    return [plan.q[plan.phase == k][:, [0, 2]] for k in np.unique(plan.phase)]


def name_palm_lines(borders: tuple[Border, ...]) -> dict[float, int]:
    """The edge that lies on the palm, by phi [rad]."""
    return {
        float(border.points[0, 1]): border.contacts[0].index
        for border in borders
        if border.along == "x"
    }


def shift(points: Array, distance: float) -> Array:
    """A polyline moved to its right, seen along it with the second coordinate upwards."""
    run = np.gradient(points, axis=0)
    run /= np.maximum(np.hypot(*run.T), 1e-12)[:, None]
    return np.asarray(points + distance * np.column_stack([run[:, 1], -run[:, 0]]))


def place_heads(points: Array, way: float) -> Array:
    """Corners of arrow heads on a polyline, shape (n, 3, 2), all of them in printer's points."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    s = np.concatenate([[0.0], steps.cumsum()])
    count = int(s[-1] // SPACING) + int(s[-1] > 12.0)
    places = (np.arange(count) + 0.5) * s[-1] / max(count, 1)
    here = np.column_stack([np.interp(places, s, column) for column in points.T])
    k = np.minimum(np.searchsorted(s, places), len(s) - 1)
    run = way * (points[k] - points[k - 1])
    run /= np.maximum(np.hypot(*run.T), 1e-12)[:, None]
    aside = np.column_stack([-run[:, 1], run[:, 0]])
    corners = [3.4 * run, -2.6 * run + 2.5 * aside, -2.6 * run - 2.5 * aside]
    return np.stack([here + corner for corner in corners], axis=1)


def place_discs(paths: Sequence[Array], size: float, low: Array, high: Array) -> Array:
    """Places for the numbers of paths, on them or beside them, none over another.

    Parameters
    ----------
    paths : (n, 2)    in units of the paper
    size              diameter of the discs
    low, high : (2,)  corners of the paper

    Returns
    -------
    ndarray, shape (m, 2)
    """
    angles = np.pi / 8 * (np.arange(16) + 4)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    aside = np.concatenate([radius * size * ring for radius in (1.0, 1.6, 2.3, 3.2, 4.2)])
    discs = np.empty((0, 2))
    for path in paths:
        middle = find_middle(path)
        shares = np.array([0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8])
        every = np.concatenate([[find_middle(path, share) for share in shares], middle + aside])
        clear = np.hypot(*(every[:, None] - discs[None]).transpose(2, 0, 1)) >= size
        inside = ((every >= low + size / 2) & (every <= high - size / 2)).all(axis=1)
        free = clear.all(axis=1) & inside
        discs = np.vstack([discs, every[free.argmax() if free.any() else 0]])
    return discs


def find_middle(points: Array, share: float = 0.5) -> Array:
    """The place half way along a polyline, or a share of it, shape (2,)."""
    s = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
    return np.array([np.interp(share * s[-1], s, column) for column in points.T])


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
