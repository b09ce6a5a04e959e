"""About the least times along the borders of a map, each way, from rest to rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import contact_table, evaluate_contacts
from ..contacts.formation import Formation, Kinematics
from ..geometry.curve import solve_tangent
from ..mapping.formation_map import Border
from ..mechanics.dynamics import Directions, inverse, reduced_inertia
from ..mechanics.limits import make_limits
from ..mechanics.metric import metric_weights
from ..mechanics.uniqueness import LEAST_MINOR, find_minors
from ..planning.lower_bound.rows import Rows, limit
from ..problem.definition import Problem
from .sweep import find_durations

NODES = 24
"""Intervals of a border."""


def time_borders(problem: Problem, borders: Sequence[Border]) -> Array:
    """About the least times along borders, from rest at one end to rest at the other one.

    Limits are kept at one place of each of a few intervals, with any squeeze.

    Parameters
    ----------
    problem : Problem
        Whose scene and epsilon count.
    borders : sequence of Border
        With something flush.

    Returns
    -------
    ndarray, shape (n, 2), [s]
        With the coordinate along which points are ordered increasing, and decreasing; infinite
        where no motion keeps the limits, friction jams or forces are not the only ones.
    """
    if not borders:
        return np.zeros((0, 2))
    nodes = (1 - np.cos(np.linspace(0, np.pi, NODES + 1))) / 2
    places = (nodes[1:] + nodes[:-1]) / 2
    ways = [own for border in borders for own in _follow(problem, border, places)]
    rows = Rows(*(np.array(part) for part in zip(*ways, strict=True)))
    times = find_durations(rows, np.diff(nodes), (places - nodes[:-1]) / np.diff(nodes))
    return times.reshape(-1, 2)


def _follow(problem: Problem, border: Border, places: Array) -> list[Rows]:
    """Limits at places of a border, forth and back, by the share of it that is behind."""
    scene = problem.scene
    weights, formation = metric_weights(scene), Formation(scene, border.contacts)
    label = [contact_table(scene).index(contact) for contact in border.contacts]
    chords = np.diff(border.z, axis=0)
    arcs = np.append(0.0, np.cumsum(np.sqrt(chords**2 @ weights)))
    s = places * arcs[-1]
    z = np.column_stack([np.interp(s, arcs, column) for column in border.z.T])
    chords = chords[np.searchsorted(arcs, s) - 1]
    # Straight between points of the map the contacts do not quite touch.
    at = evaluate_contacts(scene, label, z)
    z -= (np.linalg.pinv(at.P) @ at.C[..., None])[..., 0]
    way = arcs[-1] * chords / np.sqrt(chords**2 @ weights)[:, None]
    at = evaluate_contacts(scene, label, z, way)
    z_s, z_ss = solve_tangent(at.P, at.P_dot_v, way, weights)
    every, found = make_limits(formation, problem.epsilon), []
    for sign, order in ((1.0, slice(None)), (-1.0, slice(None, None, -1))):
        part = Kinematics(*(array[order] for array in at))
        tangent = sign * arcs[-1] * z_s[order]
        directions = Directions.of(part, tangent)
        curvature = arcs[-1] ** 2 * z_ss[order]
        forces = inverse(formation, z[order], tangent, curvature, directions, part)
        rows = limit(every, forces, tangent[:, 3:])
        inertia = reduced_inertia(formation, part, directions)
        ratios = find_minors(formation, part, directions.Xi).ratios
        closed = ~(inertia > 0) | (ratios < LEAST_MINOR)
        rows.one[closed], rows.a[closed], rows.b[closed] = -1.0, 0.0, 0.0
        found.append(rows)
    return found
