"""Ways to the end of a phase with two freedoms along which a slow motion keeps its limits.

The nearest end is not always one that contacts can reach: pushed that way, some would have to pull.
Ends beside it are looked at too, and straight ways to them are ranked by statics. Without speed and
acceleration the forces at a place are linear, so that the largest share `margin` by which all
limits can be kept is a linear programme,

    G^T c + S tau + g - D sigma = 0,  c_n >= epsilon + margin m g,  |tau| <= (1 - margin) limit,

with friction against the way that things move, or within its cone where contacts roll.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..curve import metric_weights, tangent_basis
from ..dynamics import Directions, force_rows
from ..explore import close, is_inside
from ..model import Array
from ..outline import Outline, connect, list_ends, outline_phase
from ..problem import Phase, Problem

PLACES = 6
"""Places along a stretch of a way at which forces are balanced."""
STEP = 0.15
"""How far apart ends are looked at, over the length of the way to the nearest end."""
STEPS = 10
"""Most ends on either side of the nearest one."""
_STRETCHES = 3
"""Most stretches of a way, between which something turns."""
_SHORTEST = 2
"""Fewest configurations, after its first, of a stretch that is not merged into another."""

AMPLE = 1e-3
"""Margin from which a slow motion surely keeps its limits."""

Way = list[Outline]


class SlowWay(NamedTuple):
    """Stretches of a way, and the margin of a slow motion along it."""

    stretches: Way
    margin: float


def list_slow_ways(problem: Problem, phase: Phase, z: Array, most: int) -> list[SlowWay]:
    """Straight ways of a phase, in different modes, those that keep limits best first.

    Parameters
    ----------
    problem : Problem
    phase : Phase
        Of other than two freedoms, and of one that ends by a release, there are none.
    z : ndarray, shape (5,)
        Where it starts.
    most : int
        How many at most.
    """
    formation = phase.formation
    if phase.until.is_release or tangent_basis(formation, z).shape[1] != 2:
        return []
    (nearest,) = outline_phase(problem, phase, z)
    ranked: list[tuple[float, Way]] = []
    for goal in list_goals(phase, z, nearest.z[-1]):
        way = split_way(connect(formation, z, goal))
        margin = find_margin(way, problem.epsilon)
        if np.isfinite(margin):
            ranked.append((margin, way))
    ranked.sort(key=lambda pair: _rank(*pair))
    best: dict[tuple[float, ...], SlowWay] = {}
    for margin, way in ranked:
        signs = [np.concatenate(part.directions) for part in way]
        best.setdefault(tuple(np.concatenate(signs).tolist()), SlowWay(way, margin))
    return list(best.values())[:most]


def _rank(margin: float, way: Way) -> tuple[float, float]:
    """Ways that keep limits are better the shorter they are, others the less they miss."""
    length = sum(part.length for part in way)
    return (-AMPLE, length) if margin > AMPLE else (-margin, length)


def list_goals(phase: Phase, z: Array, nearest: Array) -> list[Array]:
    """Ends of a phase: the nearest, shape (5,), and others on both sides of it."""
    formation, goals = phase.formation, [nearest]
    metric = np.sqrt(metric_weights(formation.scene))
    step = STEP * float(np.linalg.norm((nearest - z) * metric))
    slip, ends = formation.evaluate_slip(z[None])[0], list_ends(phase)
    N = tangent_basis(formation, nearest) * metric[2] / metric[:, None] ** 2

    def settle(guess: Array, last: Array) -> Array | None:
        for end in ends:
            goal = close(end.formation, guess, slip, end.fixed, end.active)
            if goal is None or not is_inside(end.formation, goal):
                continue
            if 0.2 * step < np.linalg.norm((goal - last) * metric) < 5 * step:
                return goal
        return None

    sides: list[Array] = []
    for way in (*N.T, *-N.T):
        goal = settle(nearest + step * way, nearest)
        # Directions across the ends lead back to those that are known.
        if goal is not None and all((goal - nearest) @ (s - nearest) <= 0 for s in sides):
            sides.append(goal)
    for goal in sides:
        last = nearest
        for _ in range(STEPS):
            goals.append(goal)
            ahead = (goal - last) * metric
            ahead = step * ahead / np.linalg.norm(ahead) / metric
            found = settle(goal + ahead, goal)
            if found is None:
                break
            last, goal = goal, found
    return goals


def split_way(outline: Outline) -> Way:
    """A way as stretches without a reversal."""
    z, formation = outline.z, outline.formation
    steps, middles = np.diff(z, axis=0), (z[1:] + z[:-1]) / 2
    slip = np.einsum("nij,nj->ni", formation.evaluate(middles, steps).A_t, steps)
    signs = np.where(np.hstack([slip, steps[:, 3:]]) < 0, -1.0, 1.0)
    signs[:, list(formation.rolling_rows)] = 1.0
    cuts = [0]
    for k in range(1, len(signs)):
        if (signs[k] != signs[cuts[-1]]).any():
            if k - cuts[-1] < _SHORTEST:
                signs[cuts[-1] : k] = signs[k]
            else:
                cuts.append(k)
    if len(signs) - cuts[-1] < _SHORTEST and len(cuts) > 1:
        signs[cuts.pop() :] = signs[cuts[-1]]
    n_c, way = formation.n_contacts, list[Outline]()
    for begin, stop in pairwise([*cuts, len(signs)]):
        own = signs[begin]
        turns: tuple[int, ...] = ()
        if stop < len(signs):
            turns = tuple(np.flatnonzero(own != signs[stop]).tolist())
        directions = Directions(own[:n_c].copy(), own[n_c:].copy())
        way.append(Outline(formation, z[begin : stop + 1], directions, turns))
    return way


def find_margin(way: Way, epsilon: float) -> float:
    """The margin of a slow motion along a way, where it is least; -inf if there is none."""
    if len(way) > _STRETCHES:
        return -np.inf
    worst = np.inf
    for outline in way:
        formation, z = outline.formation, outline.z
        if formation.evaluate_limits(z).min() < -formation.scene.touching:
            return -np.inf
        v = np.gradient(z, axis=0)
        at = np.unique(np.linspace(0, len(z) - 1, PLACES).astype(int))
        G = force_rows(formation, formation.evaluate(z[at], v[at]), outline.directions)
        worst = min(worst, *(_balance(outline, rows, epsilon) for rows in G))
    return worst


def _balance(outline: Outline, G: Array, epsilon: float) -> float:
    from scipy.optimize import linprog

    formation, scene = outline.formation, outline.formation.scene
    n_c, n = formation.n_contacts, len(G)
    force, limit = scene.scales.force, scene.torque_limit
    dry = scene.dry * np.append(np.zeros(3), outline.directions.sigma)
    load = scene.applied_force - dry
    size = np.array([1.0, 1.0, scene.scales.length]) * force
    # Unknowns are the forces over the weight, and the margin.
    equal = np.column_stack([(G[:, :3] * force / size).T, np.zeros(3)])
    rows, most = [], []
    for k in range(n_c):
        row = np.zeros(n + 1)
        row[k], row[n] = -1.0, 1.0
        rows.append(row)
        most.append(-epsilon / force)
    for i, k in enumerate(formation.rolling_rows):
        for side in (1.0, -1.0):
            row = np.zeros(n + 1)
            row[n_c + i], row[k], row[n] = side, -formation.friction[k], 1.0
            rows.append(row)
            most.append(-formation.friction[k] * epsilon / force)
    for joint in range(2):
        torque = -G[:, 3 + joint] * force / limit[joint]
        rest = -load[3 + joint] / limit[joint]
        for side in (1.0, -1.0):
            rows.append(np.append(side * torque, 1.0))
            most.append(1.0 - side * rest)
    cost = np.append(np.zeros(n), -1.0)
    bounds = [(None, None)] * n + [(None, 1.0)]
    answer = linprog(cost, np.array(rows), most, equal, -load[:3] / size, bounds)
    return float(-answer.fun) if answer.status == 0 else -np.inf
