"""Estimated least times along the borders of a map in both directions, from rest to rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import contact_table, evaluate_each, group_alike
from ..contacts.formation import Kinematics
from ..geometry.curve import solve_tangent
from ..mapping.formation_map import Border
from ..mechanics.dynamics import Directions, inverse, metric_weights, reduced_inertia
from ..mechanics.limits import make_limits
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, find_minors
from ..planning.lower_bound.rows import PathLimitRows, limit
from ..problem.definition import Problem
from .travel_times import find_durations

NODES = 24  # intervals of a border


def time_borders(problem: Problem, borders: Sequence[Border]) -> Array:
    """Estimated least times along borders, from rest at one end to rest at the other one.

    Limits are kept at one place of each interval, with any internal force.

    Parameters
    ----------
    problem  whose scene and epsilon count
    borders  with something flush

    Returns
    -------
    ndarray, shape (n, 2), [s]
        With the coordinate along which points are ordered increasing, and decreasing; infinite
        where no motion keeps the limits, friction jams or contact forces are not unique.
    """
    if not borders:
        return np.zeros((0, 2))
    nodes = (1 - np.cos(np.linspace(0, np.pi, NODES + 1))) / 2
    places = (nodes[1:] + nodes[:-1]) / 2
    rows = _evaluate(problem, borders, places)
    times = find_durations(rows, np.diff(nodes), (places - nodes[:-1]) / np.diff(nodes))
    return times.reshape(-1, 2)


def _evaluate(problem: Problem, borders: Sequence[Border], places: Array) -> PathLimitRows:
    """Limits at places of borders, in both directions, with the share of length as parameter."""
    scene, weights = problem.scene, metric_weights(problem.scene)
    count, table = len(places), contact_table(scene)
    z, chord, length = _interpolate(borders, places, weights)
    indices = [[table.index(contact) for contact in border.contacts] for border in borders]
    labels = np.repeat(np.array(indices), count, axis=0)
    # One Newton step: between points of the map the contacts do not quite close.
    at = evaluate_each(scene, labels, z)
    z -= (np.linalg.pinv(at.P) @ at.C[..., None])[..., 0]
    run = length * chord / np.sqrt(chord**2 @ weights)[:, None]
    at = evaluate_each(scene, labels, z, run)
    z_s, z_ss = solve_tangent(at.P, at.P_dot_v, run, weights)
    tangent, curvature = length * z_s, length**2 * z_ss
    found = [np.empty(0)] * len(PathLimitRows._fields)
    for formation, mine in group_alike(scene, labels):
        part = Kinematics(*(array[mine] for array in at))
        every = make_limits(formation, problem.epsilon)
        for back, sign in enumerate((1.0, -1.0)):
            directions = Directions.of(part, sign * tangent[mine])
            turned = sign * tangent[mine]
            forces = inverse(formation, z[mine], turned, curvature[mine], directions, part)
            rows = limit(every, forces, turned[:, 3:])
            inertia = reduced_inertia(formation, part, directions)
            ratios = find_minors(formation, part, directions.Xi).ratios
            closed = ~(inertia > 0) | (ratios < UNIQUENESS_MARGIN)
            # No motion there.
            for values in rows:
                values[closed] = 0.0
            chosen = mine.reshape(-1, count)[:, 0]
            for k, values in enumerate(rows):
                split = values.reshape(-1, count, *values.shape[1:])
                if not found[k].size:
                    found[k] = np.empty((len(borders), 2, *split.shape[1:]))
                found[k][chosen, back] = split[:, ::-1] if back else split
    return PathLimitRows(*(array.reshape(-1, *array.shape[2:]) for array in found))


def _interpolate(
    borders: Sequence[Border], places: Array, weights: Array
) -> tuple[Array, Array, Array]:
    """Configurations at places of borders, the chord of each there, and lengths, shape (n, 1)."""
    every = []
    for border in borders:
        chords = np.diff(border.z, axis=0)
        arcs = np.append(0.0, np.cumsum(np.sqrt(chords**2 @ weights)))
        s = places * arcs[-1]
        z = np.column_stack([np.interp(s, arcs, column) for column in border.z.T])
        every.append((z, chords[np.searchsorted(arcs, s) - 1], np.full((len(s), 1), arcs[-1])))
    z, chord, length = (np.concatenate(part) for part in zip(*every, strict=True))
    return z, chord, length
