"""Ways to the end of a phase with two freedoms along which a motion keeps its limits.

The nearest end is not always one that contacts can reach: pushed that way, some would have to pull.
Ends beside it are looked at too, and straight ways to them are ranked by the largest margin that
any motion along them can have (`planning.time_domain.way_pace`). Where none keeps its limits, the
best of them are bent.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import find_tied, tangent_basis
from ...geometry.explore import close_contacts, is_inside
from ...geometry.path_guess import PathGuess, connect, guess_phase, list_ends
from ...mechanics.dynamics import Directions
from ...mechanics.metric import metric_weights
from ...problem.definition import Phase, Problem
from .own_units import in_own_units, scale_state
from .resting import list_headings
from .way_pace import Pace, WayForces

STEP = 0.15
"""How far apart ends are looked at, over the length of the way to the nearest end."""
GROWTH = 1.2
"""By how much more each of these is apart from the one before."""
STEPS = 12
"""Most ends on either side of the nearest one."""
HEADINGS = 1
"""In how many other ways motions are looked at that set out."""
BENT = 4
"""How many of the best ways are bent, twice; the best one alone after that."""
SCALES = (1.0, 0.4, 0.3, 0.2, 0.1)
"""How far ways are bent in each round, over `BENDS`."""
CLOSE = -0.2
"""Margin from which on it is worth to go on."""
BENDS = ((0.4, 0.0), (-0.4, 0.0), (0.8, 0.0), (-0.8, 0.0), (0.0, 0.3), (0.0, -0.3))
"""How ways are bent: parts of one arc and of two, over their length."""
_STRETCHES = 6
"""Most stretches of a way, between which something turns."""
_SHORTEST = 2
"""Fewest configurations, after its first, of a stretch that is not merged into another."""

SURE = 1e-3
"""Margin from which a motion surely keeps its limits."""

Way = list[PathGuess]


class PacedWay(NamedTuple):
    """A way, the largest margin of a motion along it, and a motion that is brisk.

    Attributes
    ----------
    stretches : list of PathGuess
    margin : float
    pace : Pace or None
    forces : WayForces
        What says so.
    """

    stretches: Way
    margin: float
    pace: Pace | None
    forces: WayForces


class _Bent(NamedTuple):
    """A way to a goal with its bends, and its margin."""

    goal: Array
    bends: tuple[float, float]
    heading: Array | None
    way: Way
    forces: WayForces
    margin: float

    @property
    def rank(self) -> tuple[float, float]:
        """Ways that keep limits are better the shorter they are, others the less they miss."""
        length = float(self.forces.runs.sum())
        return (-SURE, length) if self.margin > SURE else (-self.margin, length)


def list_ways(problem: Problem, phase: Phase, z: Array, most: int) -> list[PacedWay]:
    """Ways of a phase, in different modes, those on which motions keep limits best first.

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
    (nearest,) = guess_phase(phase, z)
    found: list[_Bent] = []

    def look(goal: Array, bends: tuple[float, float], heading: Array | None = None) -> None:
        way = split_way(connect(formation, z, goal, bends, heading))
        forces = WayForces(way, problem.epsilon) if _is_free(way) else None
        if forces is not None and np.isfinite(margin := forces.find_margin()):
            found.append(_Bent(goal, bends, heading, way, forces, margin))

    def spread(heading: Array | None) -> None:
        for goal in goals:
            look(goal, (0.0, 0.0), heading)
        for turn, scale in enumerate(SCALES):
            own = sorted((b for b in found if b.heading is heading), key=lambda bent: bent.rank)
            near = bool(own) and (turn < 2 or own[0].margin > CLOSE)
            if not near or own[0].margin > SURE:
                break
            for bent in own[: BENT if turn < 2 else 1]:
                for one, two in BENDS:
                    bends = bent.bends[0] + scale * one, bent.bends[1] + scale * two
                    look(bent.goal, bends, heading)

    goals = list_goals(phase, z, nearest.z[-1])
    spread(None)
    if all(bent.margin <= CLOSE for bent in found):
        # Contacts may keep motions from setting out straight.
        for heading in _list_headings(problem, phase, z)[:HEADINGS]:
            spread(heading)
    found.sort(key=lambda bent: bent.rank)
    best: dict[tuple[float, ...], _Bent] = {}
    for bent in found:
        signs = [np.concatenate(part.directions) for part in bent.way]
        best.setdefault(tuple(np.concatenate(signs).tolist()), bent)
    return [
        PacedWay(bent.way, bent.margin, bent.forces.find_pace(bent.margin), bent.forces)
        for bent in list(best.values())[:most]
    ]


def pace_straight(problem: Problem, phase: Phase, z: Array, goal: Array) -> PacedWay | None:
    """The straight way of a phase to an end, with the largest margin of a motion along it.

    None where something is in the way, or along a phase that has not two freedoms.
    """
    if phase.until.is_release or tangent_basis(phase.formation, z).shape[1] != 2:
        return None
    way = split_way(connect(phase.formation, z, goal))
    if not _is_free(way):
        return None
    forces = WayForces(way, problem.epsilon)
    margin = forces.find_margin()
    return PacedWay(way, margin, forces.find_pace(margin), forces) if margin > -np.inf else None


def _list_headings(problem: Problem, phase: Phase, z: Array) -> list[Array]:
    """Ways in which motions begin at `z`, those that press most first."""
    own, scales = in_own_units(problem), problem.scene.scales
    formation = own.phases[phase.index].formation
    units = np.array([scales.length, scales.length, 1.0, 1.0, 1.0])
    return [units * way for way in list_headings(formation, scale_state(z, scales), own.epsilon)]


def _is_free(way: Way) -> bool:
    """Whether nothing is in a way, and it moves all along, in few stretches with their contacts."""
    if len(way) > _STRETCHES or not all(np.diff(part.z, axis=0).any(axis=1).all() for part in way):
        return False
    touching = way[0].formation.scene.touching
    return all(part.formation.evaluate_limits(part.z).min() > -touching for part in way)


def list_goals(phase: Phase, z: Array, nearest: Array) -> list[Array]:
    """Ends of a phase: the nearest, shape (5,), and others on both sides of it."""
    formation, goals = phase.formation, [nearest]
    metric = np.sqrt(metric_weights(formation.scene))
    step = STEP * float(np.linalg.norm((nearest - z) * metric))
    slip, ends = formation.evaluate_slip(z[None])[0], list_ends(phase)
    N = tangent_basis(formation, nearest) * metric[2] / metric[:, None] ** 2

    def settle(guess: Array, last: Array, step: float) -> Array | None:
        for end in ends:
            goal = close_contacts(end.formation, guess, slip, end.fixed, end.active)
            if goal is None or not is_inside(end.formation, goal):
                continue
            if 0.2 * step < np.linalg.norm((goal - last) * metric) < 5 * step:
                return goal
        return None

    sides: list[Array] = []
    for way in (*N.T, *-N.T):
        goal = settle(nearest + step * way, nearest, step)
        # Directions across the ends lead back to those that are known.
        if goal is not None and all((goal - nearest) @ (s - nearest) <= 0 for s in sides):
            sides.append(goal)
    for goal in sides:
        last, own = nearest, step
        for _ in range(STEPS):
            goals.append(goal)
            ahead = (goal - last) * metric
            own *= GROWTH
            ahead = own * ahead / np.linalg.norm(ahead) / metric
            found = settle(goal + ahead, goal, own)
            if found is None:
                break
            last, goal = goal, found
    return goals


def split_way(outline: PathGuess) -> Way:
    """A way as stretches without a reversal, between which one thing turns at a time.

    Where two turned at once a motion with two freedoms would have to stop.
    """
    z, formation = outline.z, outline.formation
    steps, middles = np.diff(z, axis=0), (z[1:] + z[:-1]) / 2
    slip = np.einsum("nij,nj->ni", formation.evaluate(middles, steps).A_t, steps)
    rates = np.hstack([slip, steps[:, 3:]])
    signs = np.where(rates < 0, -1.0, 1.0)
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
    way, part = list[PathGuess](), z[:1]
    for begin, stop in pairwise([*cuts, len(signs)]):
        own, part = signs[begin].copy(), np.concatenate([part, z[begin + 1 : stop]])
        turning = list[tuple[int, ...]]()
        if stop < len(signs):
            turning = _order_turns(formation, z[stop], own, signs[stop], rates[stop - 1 : stop + 1])
        # They turn within the steps before and after the cut.
        places = stop - 0.5 + (np.arange(len(turning)) + 1) / (len(turning) + 1)
        for rows, place in zip(turning, places, strict=True):
            end = _interpolate(z, place) if len(turning) > 1 else z[stop]
            if len(part) == 1:
                part = np.stack([part[0], (part[0] + end) / 2])
            way.append(_make_stretch(formation, np.vstack([part, end]), own, rows))
            own[list(rows)] *= -1
            part = end[None]
    way.append(_make_stretch(formation, np.vstack([part, z[-1:]]), own, ()))
    return way


def _make_stretch(formation: Formation, z: Array, signs: Array, rows: Sequence[int]) -> PathGuess:
    n_c = formation.n_contacts
    directions = Directions(signs[:n_c].copy(), signs[n_c:].copy())
    return PathGuess(formation, z, directions, tuple(rows))


def _order_turns(
    formation: Formation, z: Array, before: Array, after: Array, rates: Array
) -> list[tuple[int, ...]]:
    """Rows that turn between two stretches, those together that have to, the first ones first."""
    rows = np.flatnonzero(before != after).tolist()
    groups = {tuple(sorted(i for i in find_tied(formation, z, k) if i in rows)) for k in rows}

    def cross(group: tuple[int, ...]) -> float:
        first, last = rates[:, group[0]]
        return float(first / (first - last)) if first * last < 0 else 0.5

    return sorted(groups, key=lambda group: (cross(group), group))


def _interpolate(z: Array, place: float) -> Array:
    index = int(place)
    return np.asarray(z[index] + (place - index) * (z[index + 1] - z[index]))
