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
from ..mechanics.path_limits import PathLimits
from ..mechanics.speed_sweep import make_cosine_grid, speed_sweep
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, find_minors
from ..planning.lower_bound import GIVE
from ..problem.definition import Problem

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
    steps, places, part = make_cosine_grid(NODES)
    limits = _evaluate(problem, borders, places)
    return speed_sweep(limits, steps, part, sweeps=2).find_durations(steps)


def _evaluate(problem: Problem, borders: Sequence[Border], places: Array) -> PathLimits:
    """Limits at places of borders, in both directions, with the share of length as parameter.

    Rows have the shape (n, 2, count, m, 4). A place that no motion passes has b <= 0.
    """
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
    shape = len(borders), 2, count
    rows, cap = np.zeros((*shape, 0, 4)), np.zeros(shape)
    for formation, mine in group_alike(scene, labels):
        part = Kinematics(*(array[mine] for array in at))
        every, chosen = make_limits(formation, problem.epsilon), mine.reshape(-1, count)[:, 0]
        for back, sign in enumerate((1.0, -1.0)):
            turned = sign * tangent[mine]
            directions = Directions.of(part, turned)
            forces = inverse(formation, z[mine], turned, curvature[mine], directions, part)
            limits = PathLimits.of(every, forces, turned[:, 3:], GIVE).eliminate()
            inertia = reduced_inertia(formation, part, directions)
            ratios = find_minors(formation, part, directions.Xi).ratios
            closed = ~(inertia > 0) | (ratios < UNIQUENESS_MARGIN)
            limits.rows[closed], limits.cap[closed] = 0.0, 0.0
            if not rows.size:
                rows = np.zeros((*shape, *limits.rows.shape[1:]))
            way = slice(None, None, -1 if back else 1)
            rows[chosen, back] = limits.rows.reshape(-1, count, *rows.shape[3:])[:, way]
            cap[chosen, back] = limits.cap.reshape(-1, count)[:, way]
    return PathLimits(rows, cap)


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
