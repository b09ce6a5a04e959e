"""Ways to the end of a phase with two freedoms along which a motion keeps its limits.

The nearest end is not always one that contacts can reach: pushed that way, some would have to pull.
Ends beside it are looked at too, and straight ways to them are ranked by the largest margin that
any motion along them can have (`planning.time_domain.way_pace`). Where none keeps its limits, the
best of them are bent.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import find_tied, tangent_basis
from ...geometry.explore import close_contacts, is_inside
from ...geometry.path_guess import PathGuess, connect, guess_phase, list_ends
from ...mechanics.dynamics import Directions, force_rows
from ...mechanics.limits import CONE, PRESS, TORQUE
from ...mechanics.metric import metric_weights
from ...problem.definition import Phase, Problem
from .resting import list_headings
from .units import in_own_units, scale_state

FASTEST = 9.0  # largest square of the speed, over gravity times the radius of gyration
BRISK = 0.5  # share of a positive margin that a brisk motion keeps
GIVES = 0.02  # what a brisk motion may lose of a negative margin
LEAST = 1e-4  # least square of the speed, in the same unit, that a duration is taken from
STEP = 0.15  # how far apart ends are looked at, over the length of the way to the nearest end
GROWTH = 1.2  # by how much more each of these is apart from the one before
STEPS = 12  # most ends on either side of the nearest one
HEADINGS = 1  # in how many other ways motions are looked at that set out
BENT = 4  # how many of the best ways are bent, twice; the best one alone after that
SCALES = (1.0, 0.4, 0.3, 0.2, 0.1)  # how far ways are bent in each round, over `BENDS`
CLOSE = -0.2  # margin from which on it is worth to go on
BENDS = ((0.4, 0.0), (-0.4, 0.0), (0.8, 0.0), (-0.8, 0.0), (0.0, 0.3), (0.0, -0.3))
"""How ways are bent: parts of one arc and of two, over their length."""
_STRETCHES = 6  # most stretches of a way, between which something turns
_SHORTEST = 2
"""Fewest configurations, after its first, of a stretch that is not merged into another."""
SURE = 1e-3  # margin from which a motion surely keeps its limits
Way = list[PathGuess]


class PacedWay(NamedTuple):
    """A way, the largest margin of a motion along it, and a motion that is brisk."""

    stretches: Way
    margin: float
    pace: PathSpeed | None
    forces: WayForces  # what says so


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
    phase     of other than two freedoms, and of one that ends by a release, there are none
    z : (5,)  where it starts
    most      how many at most
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


class PathSpeed(NamedTuple):
    """When a motion is where on a way."""

    t: Array  # (n,) [s]
    s: Array  # (n,): share of the length
    v: Array  # (n,) [1/s]: its rate, which is linear in time in between
    forces: Array  # (n - 1, n_c + R): in between, over the weight of the object


class WayForces:
    """The linear programme of one way: x = (b at nodes, c in intervals, margin), over scales.

    Attributes
    ----------
    kinds  kind of the limit that each row belongs to, and the contact or finger
    """

    def __init__(self, way: Sequence[PathGuess], epsilon: float) -> None:
        formation, scene = way[0].formation, way[0].formation.scene
        z = np.concatenate([way[0].z[:1], *(part.z[1:] for part in way)])
        dz = np.diff(z, axis=0)
        self.runs = np.sqrt(dz**2 @ metric_weights(scene))
        self.n_c, m = formation.n_contacts, len(dz)
        z_s = dz / self.runs[:, None]
        middles = np.cumsum(self.runs) - self.runs / 2
        z_ss = np.gradient(z_s, middles, axis=0) if m > 1 else 0 * z_s
        kinematics = formation.evaluate((z[1:] + z[:-1]) / 2, z_s)
        parts = np.cumsum([0, *(len(part.z) - 1 for part in way)])
        G = np.concatenate(
            [
                force_rows(formation, kinematics, part.directions)[begin:stop]
                for part, begin, stop in zip(way, parts[:-1], parts[1:], strict=True)
            ]
        )
        sigma = np.repeat([part.directions.sigma for part in way], np.diff(parts), axis=0)
        force, length, square = scene.scales.force, scene.scales.length, scene.scales.speed**2
        width = G.shape[1]
        self.square, self.size = square, m + 1 + m * width + 1
        drive = np.zeros((m, 5, self.size))
        k = np.arange(m)
        mass = scene.mass_diagonal * square
        drive[k, :, k] = mass * (z_ss / 2 - z_s / (2 * self.runs[:, None]))
        drive[k, :, k + 1] = mass * (z_ss / 2 + z_s / (2 * self.runs[:, None]))
        own = m + 1 + k[:, None] * width + np.arange(width)
        drive[k[:, None], :, own] = -force * G
        drive[:, 3:] /= scene.torque_limit[:, None]
        drive[:, :3] /= force * np.array([1.0, 1.0, length])[:, None]
        load = scene.applied_force[:3] / (force * np.array([1.0, 1.0, length]))
        self.equal = drive[:, :3].reshape(-1, self.size)
        self.equal_to = np.tile(load, m)
        torque = drive[:, 3:].reshape(-1, self.size)
        dry = (scene.dry[3:] * sigma / scene.torque_limit).ravel()
        press = -np.eye(self.size)[own[:, : self.n_c].ravel()]
        rows, most = (
            [torque, -torque, press],
            [1 - dry, 1 + dry, np.full(len(press), -epsilon / force)],
        )
        self.kinds = [(TORQUE, "finger 1"), (TORQUE, "finger 2")] * (2 * m)
        self.kinds += [(PRESS, name) for name in formation.names] * m
        for i, row in enumerate(formation.rolling_rows):
            grip, slip = np.eye(self.size)[own[:, row]], np.eye(self.size)[own[:, self.n_c + i]]
            mu = formation.friction[row]
            rows += [slip - mu * grip, -slip - mu * grip]
            most += 2 * [np.full(m, -mu * epsilon / force)]
            self.kinds += [(CONE, formation.names[row])] * (2 * m)
        self.rows, self.most = np.concatenate(rows), np.concatenate(most)
        self.rows[:, -1] = 1.0
        with np.errstate(divide="ignore"):
            quick = ((scene.speed_limit / np.abs(z_s[:, 3:])) ** 2).min(axis=1) / square
        top = np.minimum(FASTEST, np.minimum(np.append(quick, np.inf), np.append(np.inf, quick)))
        self.top = [0.0, *top[1:-1].tolist(), 0.0]

    def find_margin(self) -> float:
        """The largest margin of any motion; -inf if there is none."""
        answer = self._maximise(np.eye(self.size)[-1], -np.inf)
        return -np.inf if answer is None else float(answer.x[-1])

    def find_critical(self) -> tuple[str, str]:
        """Kind of the limit that most keeps the margin from being larger, and what it limits."""
        answer = self._maximise(np.eye(self.size)[-1], -np.inf)
        shares = dict.fromkeys(self.kinds, 0.0)
        for kind, share in zip(self.kinds, np.abs(answer.ineqlin.marginals), strict=True):
            shares[kind] += float(share)
        return max(shares, key=lambda kind: shares[kind])

    def find_pace(self, margin: float) -> PathSpeed | None:
        """A brisk motion whose margin is not much less than the largest one, `margin`."""
        speed = np.zeros(self.size)
        speed[: len(self.top)] = 1.0
        answer = self._maximise(speed, min(BRISK * margin, margin - GIVES))
        if answer is None:
            return None
        x = answer.x
        v = np.sqrt(self.square * np.maximum(x[: len(self.top)], 0.0))
        steps = 2 * self.runs / np.maximum(v[1:] + v[:-1], np.sqrt(LEAST * self.square))
        length = np.append(0.0, np.cumsum(self.runs))
        forces = x[len(self.top) : -1].reshape(len(steps), -1)
        t = np.append(0.0, np.cumsum(steps))
        return PathSpeed(t, length / length[-1], v / length[-1], forces)

    def _maximise(self, gain: Array, least: float) -> Any:
        """What SciPy finds, None if that is no solution."""
        from scipy.optimize import linprog

        forces = self.size - len(self.top) - 1
        bounds: list[tuple[float | None, float | None]] = [(0.0, top) for top in self.top]
        bounds += [(None, None)] * forces + [(None if least == -np.inf else least, 1.0)]
        answer = linprog(
            -gain, self.rows, self.most, self.equal, self.equal_to, bounds, method="highs"
        )
        return answer if answer.status == 0 else None
