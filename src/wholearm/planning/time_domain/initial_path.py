"""Initial guesses: stages along paths, ranked by their largest margin of limits.

Straight and bent paths to several ends are compared. The largest uniform margin along a fixed path
is a linear programme in the squared speed at the nodes, contact forces in the intervals, and the
margin. Friction signs are those of the path; viscous friction is neglected. That is for phases with
two degrees of freedom; others follow the path to their nearest end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import find_tied, tangent_basis
from ...geometry.explore import close_contacts, is_inside
from ...geometry.path_guess import (
    PathGuess,
    connect,
    guess_onwards,
    guess_phase,
    list_ends,
)
from ...mechanics.dynamics import Directions, force_rows, metric_weights
from ...mechanics.limits import SPEED, make_limits
from ...problem.definition import End, Phase, Problem
from .collocation import Scheme
from .mode_search import LEAST_INTERVALS, link
from .resting import list_headings
from .stage import Stage, StagePoints, in_own_units, scale_state, unit_lengths

FASTEST = 9.0  # largest squared speed, over gravity times the radius of gyration
BRISK = 0.5  # share of a positive margin that the speed profile keeps
GIVES = 0.02  # what it may lose of a negative margin
LEAST = 1e-4  # least squared speed, in the same unit, that a duration is taken from
STEP = 0.15  # distance of ends, over the length of the path to the nearest end
GROWTH = 1.2  # ratio of successive distances
STEPS = 12  # most ends on either side of the nearest one
HEADINGS = 1  # number of other initial directions
BENT = 4  # number of the best paths that are bent, in two rounds; one after that
SCALES = (1.0, 0.4, 0.3, 0.2, 0.1)  # bending in each round, over `BENDS`
CLOSE = -0.2  # margin below which a path is not bent further
BENDS = ((0.4, 0.0), (-0.4, 0.0), (0.8, 0.0), (-0.8, 0.0), (0.0, 0.3), (0.0, -0.3))
"""Amplitudes of one arc and of two, over the path's length."""
_STRETCHES = 6  # most pieces between reversals
_SHORTEST = 2  # fewest steps of a piece that is not merged into another
SURE = 1e-3  # margin above which a motion keeps its limits
Way = list[PathGuess]
_LIGHT = 0.5  # normal forces of an initial guess, over the weight of the object
_NEAR = 0.02  # distance over the radius of gyration at which a limit is monitored from the start
_TOUCHES = 1e-5  # gap over the radius of gyration below which a released contact is closed


class PacedWay(NamedTuple):
    """A path, straight or bent, and the largest margin of limits along it."""

    goal: Array  # (5,): its end
    bends: tuple[float, float]
    heading: Array | None  # initial direction of z, shape (5,); None: to the goal
    stretches: Way
    forces: WayForces  # the linear programme
    margin: float

    @property
    def profile(self) -> PathSpeed | None:
        """A fast speed profile with nearly the largest margin."""
        return self.forces.find_profile(self.margin)

    @property
    def rank(self) -> tuple[float, float]:
        """Feasible paths by their length, others by their margin."""
        length = float(self.forces.runs.sum())
        return (-SURE, length) if self.margin > SURE else (-self.margin, length)


def list_ways(problem: Problem, phase: Phase, z: Array, most: int) -> list[PacedWay]:
    """At most so many paths of a phase from `z`, (5,), in different modes, the best first.

    None of a phase that ends by a release or has other than two degrees of freedom.
    """
    if not _is_planar(phase, z):
        return []
    (nearest,) = guess_phase(phase, z)
    goals, ways = list_goals(phase, z, nearest.z[-1]), list[PacedWay]()

    def add(goal: Array, bends: tuple[float, float], heading: Array | None) -> None:
        way = pace_way(problem, phase, z, goal, bends, heading)
        ways.extend([way] if way else [])

    def spread(heading: Array | None) -> None:
        for goal in goals:
            add(goal, (0.0, 0.0), heading)
        for turn, scale in enumerate(SCALES):
            ranked = sorted((w for w in ways if w.heading is heading), key=lambda way: way.rank)
            if not ranked or not (-np.inf if turn < 2 else CLOSE) < ranked[0].margin <= SURE:
                break
            for way in ranked[: BENT if turn < 2 else 1]:
                for one, two in BENDS:
                    bends = way.bends[0] + scale * one, way.bends[1] + scale * two
                    add(way.goal, bends, heading)

    spread(None)
    if all(way.margin <= CLOSE for way in ways):
        # Contacts may exclude motions that begin straight.
        scaled, scales = in_own_units(problem), problem.scene.scales
        start = scaled.phases[phase.index].formation, scale_state(z, scales), scaled.epsilon
        for heading in list_headings(*start)[:HEADINGS]:
            spread(unit_lengths(scales) * heading)
    best: dict[tuple[float, ...], PacedWay] = {}
    for way in sorted(ways, key=lambda way: way.rank):
        signs = [np.concatenate(part.directions) for part in way.stretches]
        best.setdefault(tuple(np.concatenate(signs).tolist()), way)
    return list(best.values())[:most]


def _is_planar(phase: Phase, z: Array) -> bool:
    """Whether a phase has two degrees of freedom, and does not end by a release."""
    return not phase.until.is_release and tangent_basis(phase.formation, z).shape[1] == 2


def pace_way(
    problem: Problem,
    phase: Phase,
    z: Array,
    goal: Array,
    bends: tuple[float, float] = (0.0, 0.0),
    heading: Array | None = None,
) -> PacedWay | None:
    """The path of a phase with two degrees of freedom to an end; None if obstructed.

    Also None if motion has to stop on it, or if it has many pieces.
    """
    if not _is_planar(phase, z):
        return None
    way = split_way(connect(phase.formation, z, goal, bends, heading))
    touching = phase.formation.scene.touching
    moves = all(np.diff(part.z, axis=0).any(axis=1).all() for part in way)
    if len(way) > _STRETCHES or not moves:
        return None
    if any(part.formation.evaluate_limits(part.z).min() <= -touching for part in way):
        return None
    forces = WayForces(way, problem.epsilon)
    margin = forces.find_margin()
    return PacedWay(goal, bends, heading, way, forces, margin) if margin > -np.inf else None


def list_goals(phase: Phase, z: Array, nearest: Array) -> list[Array]:
    """Ends of a phase: the nearest, shape (5,), and others on both sides of it."""
    formation, goals = phase.formation, [nearest]
    metric = np.sqrt(metric_weights(formation.scene))
    step = STEP * float(np.linalg.norm((nearest - z) * metric))
    slip, ends = formation.evaluate_slip(z[None])[0], list_ends(phase)
    N = tangent_basis(formation, nearest) * metric[2] / metric[:, None] ** 2

    def project(guess: Array, last: Array, step: float) -> Array | None:
        for end in ends:
            goal = close_contacts(end.formation, guess, slip, end.fixed, end.active)
            if goal is None or not is_inside(end.formation, goal):
                continue
            if 0.2 * step < np.linalg.norm((goal - last) * metric) < 5 * step:
                return goal
        return None

    sides: list[Array] = []
    for direction in (*N.T, *-N.T):
        goal = project(nearest + step * direction, nearest, step)
        # Directions across the ends lead back to the same.
        if goal is not None and all((goal - nearest) @ (s - nearest) <= 0 for s in sides):
            sides.append(goal)
    for goal in sides:
        last, length = nearest, step
        for _ in range(STEPS):
            goals.append(goal)
            secant = (goal - last) * metric
            length *= GROWTH
            secant = length * secant / np.linalg.norm(secant) / metric
            following = project(goal + secant, goal, length)
            if following is None:
                break
            last, goal = goal, following
    return goals


def split_way(outline: PathGuess) -> Way:
    """A path as pieces between reversals, of which no two coincide: there motion would stop."""
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
        # The reversals are within the steps before and after the cut.
        places = stop - 0.5 + (np.arange(len(turning)) + 1) / (len(turning) + 1)
        for rows, place in zip(turning, places, strict=True):
            k = int(place)
            end = z[k] + (place - k) * (z[k + 1] - z[k]) if len(turning) > 1 else z[stop]
            if len(part) == 1:
                part = np.stack([part[0], (part[0] + end) / 2])
            way.append(_make_stretch(formation, np.vstack([part, end]), own, rows))
            own[list(rows)] *= -1
            part = end[None]
    way.append(_make_stretch(formation, np.vstack([part, z[-1:]]), own, ()))
    return way


def _make_stretch(formation: Formation, z: Array, signs: Array, rows: Sequence[int]) -> PathGuess:
    Xi, sigma = np.split(signs.copy(), [formation.n_contacts])
    return PathGuess(formation, z, Directions(Xi, sigma), tuple(rows))


def _order_turns(
    formation: Formation, z: Array, before: Array, after: Array, rates: Array
) -> list[tuple[int, ...]]:
    """Rows that reverse between two pieces, tied ones together, in order of time."""
    rows = np.flatnonzero(before != after).tolist()
    groups = {tuple(sorted(i for i in find_tied(formation, z, k) if i in rows)) for k in rows}

    def cross(group: tuple[int, ...]) -> float:
        first, last = rates[:, group[0]]
        return float(first / (first - last)) if first * last < 0 else 0.5

    return sorted(groups, key=lambda group: (cross(group), group))


class PathSpeed(NamedTuple):
    """Speed profile along a path."""

    t: Array  # (n,) [s]
    s: Array  # (n,): share of the length
    v: Array  # (n,) [1/s]: its rate, piecewise linear in time
    forces: Array  # (n - 1, n_c + R): in the intervals, over the weight of the object


class WayForces:
    """Largest margin along a path by a linear programme in x = (b at nodes, c, margin), scaled.

    `kinds` are the kind of each row's limit, and its contact or finger.
    """

    def __init__(self, way: Sequence[PathGuess], epsilon: float) -> None:
        formation, scene = way[0].formation, way[0].formation.scene
        z = np.concatenate([way[0].z[:1], *(part.z[1:] for part in way)])
        dz = np.diff(z, axis=0)
        self.runs = np.sqrt(dz**2 @ metric_weights(scene))
        m = len(dz)
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
        force, square, width = scene.scales.force, scene.scales.speed**2, G.shape[1]
        self.square, self.size = square, m + 1 + m * width + 1
        drive, k = np.zeros((m, 5, self.size)), np.arange(m)
        mass, slope = scene.mass_diagonal * square, z_s / (2 * self.runs[:, None])
        drive[k, :, k], drive[k, :, k + 1] = mass * (z_ss / 2 - slope), mass * (z_ss / 2 + slope)
        own = m + 1 + k[:, None] * width + np.arange(width)
        drive[k[:, None], :, own] = -force * G
        units = force * np.array([1.0, 1.0, scene.scales.length])
        self.equal = (drive[:, :3] / units[:, None]).reshape(-1, self.size)
        self.equal_to = np.tile(scene.applied_force[:3] / units, m)
        # (c, tau) of each interval are affine in x; limits of joint speeds bound b.
        y, offset = np.zeros((m, width + 2, self.size)), np.zeros((m, width + 2))
        y[k[:, None], np.arange(width), own] = force
        y[:, width:], offset[:, width:] = drive[:, 3:], scene.dry[3:] * sigma
        limits = make_limits(formation, epsilon).without(SPEED)
        sides, signs, bounds = limits.sides
        scales = signs / limits.scales[sides]
        slopes = limits.rows[sides, :-2] * scales[:, None]
        self.rows, self.most = -(slopes @ y), offset @ slopes.T - scales * bounds
        self.rows[..., -1] = 1.0
        self.kinds = [(limits.limits[j].kind, limits.limits[j].part) for j in limits.owners[sides]]
        self.kinds *= m
        self.rows, self.most = self.rows.reshape(-1, self.size), self.most.ravel()
        with np.errstate(divide="ignore"):
            quick = ((scene.speed_limit / np.abs(z_s[:, 3:])) ** 2).min(axis=1) / square
        top = np.minimum(FASTEST, np.minimum(np.append(quick, np.inf), np.append(np.inf, quick)))
        self.top = [0.0, *top[1:-1].tolist(), 0.0]

    def find_margin(self) -> float:
        """The largest margin of any motion; -inf if there is none."""
        answer = self._maximise(np.eye(self.size)[-1], -np.inf)
        return -np.inf if answer is None else float(answer.x[-1])

    def find_critical(self) -> tuple[str, str]:
        """Kind and part of the limit with the largest sum of multipliers."""
        answer = self._maximise(np.eye(self.size)[-1], -np.inf)
        shares = dict.fromkeys(self.kinds, 0.0)
        for kind, share in zip(self.kinds, np.abs(answer.ineqlin.marginals), strict=True):
            shares[kind] += float(share)
        return max(shares, key=lambda kind: shares[kind])

    def find_profile(self, margin: float) -> PathSpeed | None:
        """A fast speed profile whose margin is not much less than the largest, `margin`."""
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
        """SciPy's result, None without a solution."""
        from scipy.optimize import linprog

        forces = self.size - len(self.top) - 1
        bounds: list[tuple[float | None, float | None]] = [(0.0, top) for top in self.top]
        bounds += [(None, None)] * forces + [(None if least == -np.inf else least, 1.0)]
        answer = linprog(
            -gain, self.rows, self.most, self.equal, self.equal_to, bounds, method="highs"
        )
        return answer if answer.status == 0 else None


def guess_stages(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    scheme: Scheme,
    intervals: int,
    falls: float,
    onwards: bool = False,
    way: PacedWay | None = None,
) -> list[Stage]:
    """Stages of phases in one NLP, with an initial guess, in the scene's own units.

    The guessed duration is `falls` times that of a fall over the length of the initial paths. With
    `onwards`, phases joined in motion may end farther away where that takes fewer reversals. A
    single phase may follow a given path with its speed profile instead.
    """
    parts = _list_parts(problem, phases, z, onwards, way)
    lengths = np.array([outline.length for _, outline, _ in parts])
    ends = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    # The path parameter of the guess is (1 - cos) / 2 over all stages.
    total = falls * float(np.sqrt(lengths.sum()))
    profile = None if way is None else way.profile
    clock = np.arccos(1 - 2 * np.clip(ends, 0.0, 1.0)) / np.pi
    if profile is not None:
        total = float(profile.t[-1]) / problem.scene.scales.time
        clock = np.interp(ends, profile.s, profile.t / profile.t[-1])
    stages: list[Stage] = []
    released: tuple[int, ...] = ()
    for k, (phase, outline, last) in enumerate(parts):
        ahead = None
        if phase.until.value is not None:
            row, value = 0 if phase.until.coordinate == "x" else 2, phase.until.value
            begin = next(other.z[0, row] for own, other, _ in parts if own is phase)
            ahead = row, value, 1.0 if value > begin else -1.0
        whole = lengths[[own is phase for own, _, _ in parts]].sum()
        count = max(LEAST_INTERVALS, round(lengths[k] / whole * intervals))
        guess = _guess(outline, scheme, count, clock[k : k + 2], ends[k : k + 2], total, profile)
        ends_in_impact = last and phase.end is End.IMPACT and k + 1 < len(parts)
        if ends_in_impact:
            guess = guess._replace(impulses=np.zeros(parts[k + 1][0].formation.n_constraints))
        # Limits near zero along the path, and that of the phase's end.
        near = phase.formation.evaluate_limits(outline.z).min(axis=0) < _NEAR
        near |= [limit.gains(phase.until.contact) for limit in phase.formation.limits]
        opens = k > 0 and parts[k - 1][0] is not phase
        if opens:
            touching = np.abs(phase.formation.evaluate_limits(outline.z[:1])[0]) < _TOUCHES
            released = tuple(np.flatnonzero(touching).tolist())
        stages.append(
            Stage(
                phase.index,
                phase.formation,
                outline.directions,
                guess,
                until=phase.until if last and not phase.until.is_release else None,
                ends_in_impact=ends_in_impact,
                monitored=tuple(sorted({*np.flatnonzero(near).tolist(), *released})),
                released=released,
                opens=opens,
                ahead=ahead,
            )
        )
    return link(stages)


def _list_parts(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    onwards: bool,
    way: PacedWay | None,
) -> list[tuple[Phase, PathGuess, bool]]:
    """Phases with their initial paths, in own units, and whether each is the last of its phase."""
    parts: list[tuple[Phase, PathGuess, bool]] = []
    for k, phase in enumerate(phases):
        outlines = list(way.stretches if way else guess_phase(phase, z, phases[k + 1 :]))
        if parts and parts[-1][0].end is End.SMOOTH:
            outlines = [*_turn_first(outlines[0], parts[-1][1]), *outlines[1:]]
            if onwards:
                further = guess_onwards(phase, parts[-1][1])
                ways = [outlines, *(_turn_first(own, parts[-1][1]) for own in further)]
                outlines = min(ways, key=lambda way: (len(way), sum(p.length for p in way)))
        parts += [(phase, outline, outline is outlines[-1]) for outline in outlines]
        z = outlines[-1].z[-1]
    scaled = []
    for phase, outline, last in parts:
        own = in_own_units(problem).phases[phase.index]
        z = scale_state(outline.z, problem.scene.scales)
        scaled.append((own, replace(outline, formation=own.formation, z=z), last))
    return scaled


def _guess(
    outline: PathGuess,
    scheme: Scheme,
    count: int,
    clock: Array,
    ends: Array,
    total: float,
    profile: PathSpeed | None,
) -> StagePoints:
    """Motion along an initial path, with equal normal forces where it has no speed profile.

    `clock` and `ends` are shares of the time `total` [s] and length of all stages at both ends.
    """
    knots = np.linspace(0.0, 1.0, len(outline.z))
    slopes = np.gradient(outline.z, knots, axis=0)
    bends = np.gradient(slopes, knots, axis=0)
    breaks = np.linspace(0.0, 1.0, count + 1)

    def follow(share: Array) -> tuple[Array, Array, Array]:
        passed = clock[0] + share * (clock[1] - clock[0])
        span = max(ends[1] - ends[0], 1e-12)
        place, rate, gain = _evaluate_profile(profile, passed)
        place = (place - ends[0]) / span
        rate, gain = rate[..., None] / (span * total), gain[..., None] / (span * total**2)
        z, slope, bend = (
            np.stack([np.interp(place, knots, column) for column in table.T], axis=-1)
            for table in (outline.z, slopes, bends)
        )
        return z, slope * rate, slope * gain + bend * rate**2

    at = breaks[:-1, None] + scheme.points / count
    z, v, a = follow(at)
    G, needed = _lack(outline, z, v, a)
    if profile is None:
        forces = _press(outline.formation, G, needed).reshape(*z.shape[:2], -1)
    else:
        passed = clock[0] + at * (clock[1] - clock[0])
        own = np.searchsorted(profile.t / profile.t[-1], passed) - 1
        forces = profile.forces[np.clip(own, 0, len(profile.forces) - 1)]
    # Torques of the motion, within limits, at about as many points as they have control points.
    limit = outline.formation.scene.torque_limit
    tau = needed[:, 3:] - np.einsum("nij,ni->nj", G[:, :, 3:], forces.reshape(len(G), -1))
    tau = np.clip(tau, -0.9 * limit, 0.9 * limit).reshape(*z.shape[:2], 2)
    tau = tau[:, np.linspace(0, scheme.degree - 1, scheme.controls).round().astype(int)]
    return StagePoints(
        total * (clock[1] - clock[0]),
        np.full(count, 1 / count),
        np.stack(follow(breaks)[:2], axis=1),
        z,
        v,
        a,
        forces,
        tau,
        np.zeros(0),
    )


def _evaluate_profile(profile: PathSpeed | None, passed: Array) -> tuple[Array, Array, Array]:
    """Share of the length at shares of the time, and its derivatives, without a profile by cos."""
    if profile is None:
        angle = np.pi * passed
        return (1 - np.cos(angle)) / 2, np.pi / 2 * np.sin(angle), np.pi**2 / 2 * np.cos(angle)
    total = profile.t[-1]
    k = np.clip(np.searchsorted(profile.t, passed * total) - 1, 0, len(profile.forces) - 1)
    begin, since = profile.v[k], passed * total - profile.t[k]
    gain = (np.diff(profile.v) / np.diff(profile.t))[k]
    place = profile.s[k] + since * (begin + gain * since / 2)
    return place, total * (begin + gain * since), total**2 * gain


def _lack(outline: PathGuess, z: Array, v: Array, a: Array) -> tuple[Array, Array]:
    """Rows of G, and the sum G^T c + S tau that the equations of motion require."""
    scene, flat = outline.formation.scene, [table.reshape(-1, 5) for table in (z, v, a)]
    G = force_rows(outline.formation, outline.formation.evaluate(*flat[:2]), outline.directions)
    applied = scene.applied_force - scene.dry * np.append(np.zeros(3), outline.directions.sigma)
    return G, scene.mass_diagonal * flat[2] + scene.viscous * flat[1] - applied


def _press(formation: Formation, G: Array, needed: Array) -> Array:
    """Contact forces of a motion nearest to equal normal forces, shape (n, n_c + R)."""
    light = np.zeros(formation.n_constraints)
    light[: formation.n_contacts] = _LIGHT
    missing = needed[:, :3] - light @ G[:, :, :3]
    forces = [
        light + np.linalg.lstsq(rows.T, short, rcond=1e-6)[0]
        for rows, short in zip(G[:, :, :3], missing, strict=True)
    ]
    c = np.array(forces)
    c[:, : formation.n_contacts] = np.clip(c[:, : formation.n_contacts], 0.1 * _LIGHT, 20.0)
    return c


def _turn_first(outline: PathGuess, before: PathGuess) -> list[PathGuess]:
    """Split a path so that it starts in the sliding directions of the one before.

    Velocities are continuous, so that other directions need reversals along the path.
    """
    # Rolling contacts have no direction to keep.
    slides = np.delete(np.arange(before.formation.n_contacts), before.formation.rolling_rows)
    known = {before.formation.names[k]: before.directions.Xi[k] for k in slides}
    own, formation = np.concatenate(outline.directions), outline.formation
    n_c = formation.n_contacts
    signs = own.copy()
    signs[n_c:] = before.directions.sigma
    for k in range(n_c):
        if k not in formation.rolling_rows:
            together = [formation.names[i] for i in formation.turn_with(k)]
            signs[k] = next((known[name] for name in together if name in known), signs[k])
    differing = np.flatnonzero(signs != own).tolist()
    turns = list(dict.fromkeys(formation.turn_with(k) for k in differing))
    pieces = []
    cuts = np.linspace(0, len(outline.z) - 1, len(turns) + 2).astype(int)
    for k, (begin, stop) in enumerate(pairwise(cuts)):
        turn = turns[k] if k < len(turns) else outline.turns
        pieces.append(_make_stretch(formation, outline.z[begin : stop + 1], signs, turn))
        if k < len(turns):
            signs[list(turns[k])] = own[list(turns[k])]
    return pieces
