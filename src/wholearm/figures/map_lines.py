"""What is drawn of a map's borders and paths, on any paper: runs, lines aside, arrow heads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..mapping.formation_map import Border
from ..results.trajectory import Trajectory

SPACING = 42.0
"""Distance between arrow heads on a directed line [points]."""


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
    paths : sequence of ndarray, shape (n, 2)
        In units of the paper.
    size : float
        Diameter of the discs.
    low, high : ndarray, shape (2,)
        Corners of the paper.

    Returns
    -------
    ndarray, shape (m, 2)
    """
    angles = np.pi / 8 * (np.arange(16) + 4)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    aside = np.concatenate([radius * size * ring for radius in (1.0, 1.6, 2.3, 3.2, 4.2)])
    found = np.empty((0, 2))
    for path in paths:
        middle = find_middle(path)
        shares = np.array([0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8])
        every = np.concatenate([[find_middle(path, share) for share in shares], middle + aside])
        clear = np.hypot(*(every[:, None] - found[None]).transpose(2, 0, 1)) >= size
        inside = ((every >= low + size / 2) & (every <= high - size / 2)).all(axis=1)
        free = clear.all(axis=1) & inside
        found = np.vstack([found, every[free.argmax() if free.any() else 0]])
    return found


def find_middle(points: Array, share: float = 0.5) -> Array:
    """The place half way along a polyline, or a share of it, shape (2,)."""
    s = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
    return np.array([np.interp(share * s[-1], s, column) for column in points.T])
