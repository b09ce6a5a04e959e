"""What is drawn of a map's borders and paths, on any paper: runs, lines aside, arrow heads."""

from __future__ import annotations

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


def find_middle(points: Array) -> Array:
    """The place half way along a polyline, shape (2,)."""
    s = np.concatenate([[0.0], np.hypot(*np.diff(points, axis=0).T).cumsum()])
    return np.array([np.interp(s[-1] / 2, s, column) for column in points.T])
