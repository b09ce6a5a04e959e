"""References along curves: a plan's motion, or a slower one, with robustness margins.

Torques and limits at places along a curve are coefficients of (1, s'', s'^2, s', lambda) of a
nominal motion. Its torques are applied: with other friction, mass or gains they lead to another s''
and internal force, and thus to other contact forces. Without ranges the margin of each limit is the
root sum square of what usual errors take away. Within ranges, limits hold in the worst corner
(`Corners`), both under nominal torques and with feedback that tracks the reference. The reference
is the fastest motion of the backward pass of `mechanics.speed_sweep` that keeps the largest least
share of the margins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..geometry.curve import Curve, CurvePoint, directions_of
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import (
    LAMBDA,
    ONE,
    A,
    Directions,
    PathForces,
    inverse,
    metric_weights,
    stack_motion,
)
from ..mechanics.limits import LimitSet, make_limits
from ..mechanics.path_limits import PathLimits, find_slack_rows
from ..mechanics.sensitivity import find_force_slopes, find_shifts
from ..mechanics.speed_sweep import ControllableSet, find_controllable, find_duration
from ..problem.definition import GROUPS, End, Phase, Problem, change_scene
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from .curve_law import choose_internal_force
from .regulator import find_planned_internal_force

Motion = tuple[Array, Array, Array]  # a, b and internal force at n places


@dataclass(frozen=True)
class ReferenceSettings:
    """Margins and accuracies of references."""

    # Uncertainties without ranges, relative: of masses, frictions, torques; of the delay [s].
    mass: float = 0.05
    friction: float = 0.1
    gain: float = 0.01
    late: float = 5e-4
    least: float = 0.02  # least margin of a normal force, over the scene's unit of force
    spare: float = 0.05  # margin of a torque for feedback, over its limit
    kept: float = 1.3  # margin of the reference's forces within ranges, over those of the law
    authority: float = 2.0  # margin of the reference's torques, over those of the law
    near: float = 1e-3  # time around a reversal in which friction may have either direction [s]
    touch: float = 3e-3  # speed s' at which contacts are made, over the scene's
    arrival: float = 3e-3  # time constant of the approach to the end [s]
    # Squared speeds over the plan's, tried until there is a margin: relative errors of torques
    # matter less where torques are small. Case: square, phase 2.
    slower: tuple[float, ...] = (1.0, 0.25)
    slowest: float = 0.1  # least b over the plan's of a motion with a margin: slow ones can stick
    # Shares of the margin that are tried, the largest first. Negative ones: limits of a plan hold
    # between its own nodes, so that at others they may be violated a little.
    shares: tuple[float, ...] = (*(0.8**k for k in range(12)), 0.04, 0.0, -0.1, -0.2, -0.4, -0.8)
    # Upper limits of the share of all intervals, if some interval has less, as a large share in one
    # interval can reduce that of another one. Case: square, 28 % slower without them.
    parts: tuple[float, ...] = (0.5, 0.2, 0.0)
    enough: float = 0.4  # least share that needs no smaller upper limit and no slower motion
    widest: float = 0.9  # largest relative range


SETTINGS = ReferenceSettings()
UNLIMITED = np.array([1e9, 0.0, 0.0, 0.0, 0.0])
FIXED = np.array([1.0, 0.0, 1.0, 1.0, 0.0])
"""Columns that torques do not change: all but those of s'' and the internal force."""
CORNERS = ("mass", "inertia", *GROUPS["friction"])
"""Numbers whose ranges have corners; those of geometry and gains count to first order. The start is
measured, and a delay is in torques."""


class CurveLimitRows(NamedTuple):
    """Torques and limits at n places of a curve."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    # (n, m, 5) [N, N m]: distances from limits: of forces with friction before, then after the
    # nearest reversal; of torques
    slack: Array
    unit: Array  # (n, m) [N, N m]: margin at level 1
    presses: int  # how many of the m are of forces
    scenes: tuple[Scene, ...]  # in the corners of the ranges

    @property
    def levels(self) -> Array:
        """Limits over their margins, shape (n, m, 5)."""
        return np.asarray(self.slack / self.unit[..., None])


def split_limits(formation: Formation) -> tuple[LimitSet, LimitSet]:
    """Limits with an epsilon of zero: those of contact forces, and those of torques alone.

    Speed limits are kept by the plan, and no motion of a policy is faster.
    """
    limits, _ = make_limits(formation, 0.0).split_speeds()
    contact = [limit for limit in limits.limits if limit.rows[:, :-4].any()]
    joint = [limit for limit in limits.limits if not limit.rows[:, :-4].any()]
    return LimitSet(tuple(contact)), LimitSet(tuple(joint))


def find_torques(curve: Curve, s: Array, directions: Directions) -> Array:
    """Torques at n places, shape (n, 2, 5)."""
    point = curve.evaluate(np.clip(s, 0.0, curve.length))
    return inverse(curve.formation, *point[:3], directions, point.kinematics).of_tau


def respond(forces: PathForces, torque: Array) -> tuple[Array, Array]:
    """Contact forces, (n, n_c + R, 5), a and internal force, (n, 2, 5), from torques (n, 2, 5)."""
    free = [A, LAMBDA]
    motion = np.linalg.solve(forces.of_tau[..., free], torque - FIXED * forces.of_tau)
    return np.asarray(forces.of_c[..., free] @ motion + FIXED * forces.of_c), np.asarray(motion)


def measure_slack(limits: LimitSet, c: Array, torque: Array, rates: Array) -> Array:
    """Slack of limits, (n, m, 5) [N, N m], from coefficients of c and torques; `rates` (n, 2)."""
    rows = find_slack_rows(limits, PathForces(c, torque), rates)
    return np.asarray(rows * limits.scales[limits.sides[0], None])


def make_rows(curve: Curve, s: Array, motion: Motion) -> CurveLimitRows:
    """Rows at places of a curve, with margins for a motion (a, b, lambda)."""
    formation, point, speed = curve.formation, curve.evaluate(s), np.sqrt(motion[1])
    mean, *sides = blend_directions(curve, s, speed * SETTINGS.near)
    torque, late = (
        find_torques(curve, s, mean),
        find_torques(curve, s - SETTINGS.late * speed, mean),
    )
    tau, delayed = (PathForces(rows, rows).tau(*motion) for rows in (torque, late))
    (contact, joint), rates = split_limits(formation), point.z_s[:, 3:]
    slack, unit = [], []
    for side in sides:
        forces = inverse(formation, *point[:3], side, point.kinematics)
        slack.append(measure_slack(contact, respond(forces, torque)[0], torque, rates))
        error = _estimate_errors(formation, point, side, contact, motion[1], tau, delayed)
        unit.append(SETTINGS.least * contact.scales[contact.sides[0]] + error)
    slack[1][have_same_signs(*sides)] = UNLIMITED
    slack.append(measure_slack(joint, np.zeros_like(forces.of_c), torque, rates))
    unit.append(np.tile(SETTINGS.spare * joint.scales[joint.sides[0]], (len(s), 1)))
    table, count = np.concatenate(slack, axis=1), 2 * slack[0].shape[1]
    units = np.concatenate(unit, axis=1)
    return CurveLimitRows(s, torque, table, units, count, (formation.scene,))


def have_same_signs(before: Directions, after: Directions) -> Array:
    """Where directions before and after the nearest reversal are equal, shape (n,)."""
    same = [(one == other).all(axis=1) for one, other in zip(before, after, strict=True)]
    return np.asarray(same[0] & same[1])


def leave_one(levels: Array) -> Array:
    """Levels of intervals, (n, 2, m, 5), without duplicates."""
    found = levels.copy()
    for k in range(1, levels.shape[2]):
        twice = (found[:, :, :k] == levels[:, :, k : k + 1]).all(axis=(1, 3)).any(axis=1)
        found[twice, :, k] = UNLIMITED
    return found


def find_internal_force(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    """The internal force with the largest least level for a motion, shape (n,)."""
    levels = rows.levels
    base = np.einsum("nmi,ni->nm", levels, stack_motion(a, b, np.zeros_like(b)))
    pairs = zip(base.tolist(), levels[..., LAMBDA].tolist(), strict=True)
    return np.array([choose_internal_force(one, [0.0] * len(one), by, 0.0)[1] for one, by in pairs])


def find_forces(curve: Curve, s: Array, speed: Array) -> Array:
    """Normal forces at both ends of the intervals between places, (n - 1, 2, n_c, 5) [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    mean = blend_directions(curve, s, speed * SETTINGS.near)[0]
    forces = inverse(formation, *point[:3], mean, point.kinematics)
    c_n = forces.of_c[:, : formation.n_contacts]
    return np.stack([c_n[:-1], c_n[1:]], axis=1)


def blend_directions(curve: Curve, s: Array, width: Array) -> list[Directions]:
    """Sliding directions blended over reversals of a width (n,) [m], and as before and after."""
    first = curve.segments[0]
    found = [[np.tile(part, (len(s), 1)) for part in (first.Xi, first.sigma)] for _ in range(3)]
    for before, after in pairwise(curve.segments):
        near = max(float(np.interp(before.stop, s, width)), 1e-3 * curve.length)
        share = np.clip(0.5 + (s - before.stop) / (2 * near), 0.0, 1.0)[:, None]
        for directions, part in zip(found, (share, np.floor(share), np.ceil(share)), strict=True):
            directions[0] += part * (after.Xi - before.Xi)
            directions[1] += part * (after.sigma - before.sigma)
    return [Directions(*directions) for directions in found]


def _estimate_errors(
    formation: Formation,
    point: CurvePoint,
    side: Directions,
    limits: LimitSet,
    b: Array,
    tau: Array,
    delayed: Array,
) -> Array:
    """Errors of forces from uncertain numbers, torques and delays, root sum square, (n, m)."""

    def measure(scene: Scene, tau: Array) -> Array:
        changed = replace(formation, scene=scene)
        forces = inverse(changed, *point[:3], side, point.kinematics)
        torque = tau[..., None] * np.eye(5)[ONE]
        rows = measure_slack(limits, respond(forces, torque)[0], torque, point.z_s[:, 3:])
        return np.asarray(np.einsum("nmi,ni->nm", rows, stack_motion(0 * b, b, 0 * b)))

    scene = formation.scene
    doubts = dict(zip(CORNERS, [SETTINGS.mass] * 2 + [SETTINGS.friction] * 3, strict=True))
    cases = [(change_scene(scene, {name: width}), tau) for name, width in doubts.items()]
    cases += [(scene, tau * (1 + SETTINGS.gain * np.eye(2)[k])) for k in range(2)]
    cases.append((scene, delayed))
    base = measure(scene, tau)
    return np.asarray(np.sqrt(np.sum([(measure(*case) - base) ** 2 for case in cases], axis=0)))


class Corners(NamedTuple):
    """Limits at n places in k corners, of the nominal (1, a, b, s', internal force)."""

    rows: Array  # (k, n, m, 5)
    moves: Array  # (k, n, 5): actual acceleration s''
    swings: Array  # (p, n, m, 5): first-order changes by each other range

    def pick(self, motion: Motion) -> Array:
        """The limits in the corner that is worst for a motion, shape (n, m, 5)."""
        values = stack_motion(*motion)
        worst = np.einsum("knmq,nq->knm", self.rows, values).argmin(axis=0)
        rows = np.take_along_axis(self.rows, worst[None, ..., None], axis=0)[0]
        signs = np.sign(np.einsum("pnmq,nq->pnm", self.swings, values))
        return np.asarray(rows - np.einsum("pnm,pnmq->nmq", signs, self.swings))

    def close(self, others: Array) -> Corners:
        """These and other limits, (n, l, 5), with feedback that makes s'' equal to a."""
        count = len(self.rows)
        rows = np.concatenate([self.rows, np.tile(others, (count, 1, 1, 1))], axis=2)
        rate, rest = self.moves[:, :, None, [A]], self.moves[:, :, None].copy()
        rest[..., A] = 0.0
        asked = rows[..., [A]] / rate
        closed = rows - asked * rest
        closed[..., [A]] = asked
        wider = ((0, 0), (0, 0), (0, others.shape[1]), (0, 0))
        return Corners(closed, self.moves, np.pad(self.swings, wider))


def find_corners(
    formation: Formation,
    point: CurvePoint,
    side: Directions,
    torques: tuple[Array, Array, Array],
    widths: Mapping[str, float],
) -> Corners:
    """Limits of forces in the corners of ranges with half `widths`.

    Torques, (n, 2, 5) each, are the nominal ones, delayed ones, and the derivative by s.
    """
    rows, moves = list[Array](), list[Array]()
    torque, late, slope = torques
    for scene in list_scenes(formation.scene, widths):
        changed = replace(formation, scene=scene)
        c, motion = respond(inverse(changed, *point[:3], side, point.kinematics), torque)
        rows.append(measure_slack(split_limits(changed)[0], c, torque, point.z_s[:, 3:]))
        moves.append(motion[:, 0])
    nominal = inverse(formation, *point[:3], side, point.kinematics)
    swings = [respond(nominal, late)[0] - respond(nominal, torque)[0]]
    first_order = (*GROUPS["geometry"], *GROUPS["gain"])
    for name in (other for other in first_order if widths.get(other, 0.0) > 0):
        slopes = find_force_slopes(formation, point, side, nominal, (name,))[:, :, 0]
        if name in GROUPS["geometry"]:
            # Torques depend on the apparent place.
            shift = find_shifts(formation, point, side, nominal, name)
            moved = torque + shift[:, None, None] * slope
            slopes = slopes + respond(nominal, moved)[0] - respond(nominal, torque)[0]
        swings.append(widths[name] * slopes)
    limits, _ = split_limits(formation)
    side_rows, signs, _ = limits.sides
    of_c = signs[:, None] * limits.columns[0][side_rows]
    return Corners(np.array(rows), np.array(moves), of_c @ np.array(swings))


def list_scenes(scene: Scene, widths: Mapping[str, float]) -> tuple[Scene, ...]:
    """Scenes in the corners of ranges with half `widths`."""
    names = [name for name in CORNERS if widths.get(name, 0.0) > 0]
    return tuple(
        change_scene(scene, {n: k * widths[n] for n, k in zip(names, signs, strict=True)})
        for signs in product((-1, 1), repeat=len(names))
    )


class Within(NamedTuple):
    """Limits along a curve within ranges, at n places."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    left: Array  # (n, l, 5) [N m]: distances of torques from their limits
    sides: tuple[Corners, Corners]  # with friction before and after the nearest reversal
    same: Array  # (n,): where these are equal
    unit: Array  # (m + l,): margins at level 1, of forces and torques
    scenes: tuple[Scene, ...]  # in the corners of the ranges

    def at(self, motion: Motion) -> tuple[CurveLimitRows, Array, Array]:
        """The law's limits near a motion; those of the reference, and their margins."""
        motions = self._spread(motion)
        forces = self._pick(self.sides, motions)
        closed = self._pick([side.close(self.left) for side in self.sides], motions)
        count, n = len(self.unit) - self.left.shape[1], len(self.s)
        slack = np.concatenate([forces, self.left], axis=1)
        copies = forces.shape[1] // count
        unit = np.concatenate([np.tile(self.unit[:count], copies), self.unit[count:]])
        table, presses = np.tile(unit, (n, 1)), forces.shape[1]
        rows = CurveLimitRows(self.s, self.torque, slack, table, presses, self.scenes)
        kept = np.concatenate(
            [SETTINGS.kept * self.unit[:count], SETTINGS.authority * self.unit[count:]]
        )
        again = np.tile(kept, 2 * len(motions))
        wanted = np.concatenate([np.tile(kept[:count], copies), kept[count:], again])
        whole = np.concatenate([slack, closed], axis=1)
        return rows, whole, np.tile(wanted, (n, 1))

    def _pick(self, sides: tuple[Corners, ...] | list[Corners], motions: list[Motion]) -> Array:
        """Limits on both sides of reversals in the worst corners of motions, (n, rows, 5)."""
        found = [
            np.concatenate([side.pick(motion) for motion in motions], axis=1) for side in sides
        ]
        found[1][self.same] = UNLIMITED
        return np.concatenate(found, axis=1)

    def _spread(self, motion: Motion) -> list[Motion]:
        """A motion with its internal force, and with the least and largest one within torques."""
        a, b, internal = motion
        ends = PathLimits(self.left, b).find_internal_force_range(a, b)
        low, high = (np.where(np.isfinite(end), end, internal) for end in ends)
        return [motion, (a, b, np.minimum(low, internal)), (a, b, np.maximum(high, internal))]


def find_within(
    curve: Curve, s: Array, speed: Array, widths: Mapping[str, float], least: float
) -> Within:
    """Limits along a curve within ranges, with forces of at least so much [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    # Limits are interpolated: nodes next to a reversal need both directions.
    gaps = np.pad(np.diff(s), 1)
    width = np.maximum(speed * SETTINGS.near, 1.01 * np.maximum(gaps[1:], gaps[:-1]))
    mean, *sides = blend_directions(curve, s, width)
    late = s - (SETTINGS.late + widths.get("delay", 0.0)) * speed
    nominal, step = find_torques(curve, s, mean), 1e-4 * curve.length
    before, after = (find_torques(curve, s + sign * step, mean) for sign in (-1, 1))
    torques = nominal, find_torques(curve, late, mean), (after - before) / (2 * step)
    corners = [find_corners(formation, point, side, torques, widths) for side in sides]
    contact, joint = split_limits(formation)
    none = np.zeros((len(s), formation.n_constraints, 5))
    left = measure_slack(joint, none, nominal, point.z_s[:, 3:])
    scales, most = (each.scales[each.sides[0]] for each in (contact, joint))
    unit = np.concatenate([np.maximum(SETTINGS.least * scales, least), SETTINGS.spare * most])
    scenes = list_scenes(formation.scene, widths)
    same = have_same_signs(*sides)
    return Within(s, nominal, left, (corners[0], corners[1]), same, unit, scenes)


class ReferencePiece(NamedTuple):
    """The reference of a phase along a curve."""

    curve: Curve
    rows: CurveLimitRows
    reach: ControllableSet
    share: float  # least share of the margin
    begins: float  # [m^2/s^2]: the plan's b at the start
    passes: float  # ratio of b after and before the impact at the end; zero at rest
    b: Array  # (n,) [m^2/s^2]: the reference

    @property
    def duration(self) -> float:
        """Duration of the reference [s]."""
        return float(find_duration(self.b, np.diff(self.rows.s)))

    @property
    def reserves(self) -> dict[str, float]:
        """Least level of each contact's normal force along the reference."""
        rows, names = self.rows, self.curve.formation.names
        a = np.diff(self.b) / (2 * np.diff(rows.s))
        a = np.append(a, a[-1])
        count = len(split_limits(self.curve.formation)[0].low)
        motion = stack_motion(a, self.b, find_internal_force(rows, a, self.b))
        levels = np.einsum("nmi,ni->nm", rows.levels[:, : rows.presses], motion)
        least = levels.min(axis=0).reshape(-1, count).min(axis=0)
        return dict(zip(names, least[: len(names)].tolist(), strict=True))


def scale_ranges(ranges: Mapping[str, float], size: float, delay: float) -> dict[str, float]:
    """Half widths of scaled ranges; of the delay its unknown part, with a known `delay` [s]."""
    widths = {name: size * width for name, width in ranges.items()}
    late = widths.get("delay", 0.0)
    # Torques may be early as well: a delay is anything from none to its range.
    return widths | {"delay": max(late - delay, delay) if late else 0.0}


def trace_pieces(
    problem: Problem,
    phases: Sequence[Phase | None],
    plan: Trajectory,
    size: float,
    widths: Mapping[str, float] | None,
) -> list[ReferencePiece | None]:
    """References of phases along curves, with margins as large as possible; None for None.

    Margins are `size` times those of usual errors or, where there are half `widths` of ranges, such
    that limits are kept within these.
    """
    pieces: list[ReferencePiece | None] = []
    for phase in reversed(phases):
        after = pieces[-1] if pieces else None
        pieces.append(None if phase is None else _trace(problem, phase, plan, size, widths, after))
    pieces.reverse()
    before: ReferencePiece | None = None
    for k, piece in enumerate(pieces):
        if piece is not None:
            first = float(piece.reach.high[0])
            if before is not None and before.passes:
                first = float(before.b[-1]) * before.passes
            piece = pieces[k] = piece._replace(b=piece.reach.run(first))
        before = piece
    return pieces


def _trace(
    problem: Problem,
    phase: Phase,
    plan: Trajectory,
    size: float,
    widths: Mapping[str, float] | None,
    after: ReferencePiece | None,
) -> ReferencePiece:
    """A phase's curve, and the controllable motions along it that keep margins."""
    rows_of_phase = np.flatnonzero((plan.phase == phase.index) & ~plan.held)
    curve = trace_phase(phase, plan.z[rows_of_phase[0]], problem.phases[phase.index + 1 :])
    places, *values = _follow(curve, plan, rows_of_phase)
    # Nodes of the table, with all reversals.
    s = curve.length * (1 - np.cos(np.pi * np.linspace(0, 1, 121))) / 2
    s = np.sort(np.concatenate([s, [part.stop for part in curve.segments[:-1]]]))
    s = s[np.diff(s, prepend=-1.0) > 1e-7 * curve.length]
    a, b, internal = (np.interp(s, places, value) for value in values)
    touch, begins, passes, end = SETTINGS.touch * problem.scene.scales.speed, float(b[0]), 0.0, None
    if phase.end is End.IMPACT and after is not None and b[-1] > touch**2:
        passes = after.begins / float(b[-1])
        end = float(after.reach.low[0] / passes), float(after.reach.high[0] / passes)
    else:
        b = np.minimum(b, (touch + (curve.length - s) / SETTINGS.arrival) ** 2)
    if widths is not None and size:
        planned = a, b, internal
        within, share = retime_within(curve, s, planned, widths, problem.epsilon, end)
        if within is not None:
            return ReferencePiece(curve, *within, share, begins, passes, b)
    best: tuple[CurveLimitRows, ControllableSet, float] | None = None
    for factor in SETTINGS.slower:
        motion = factor * a, factor * b
        rows = make_rows(curve, s, (*motion, internal))
        for _ in range(2 if factor < 1.0 else 0):
            rows = make_rows(curve, s, (*motion, find_internal_force(rows, *motion)))
        wanted = size * rows.unit
        wanted[:, rows.presses :] = SETTINGS.authority * rows.unit[:, rows.presses :]
        found = retime(s, rows.slack, wanted, motion[1], end)
        share = float(found.share.min())
        if best is not None and share <= best[2]:
            break
        best = rows, found, share
        if share >= SETTINGS.enough:
            break
    assert best is not None
    rows, found, share = best
    # Margins without ranges keep no share of ranges.
    share = share if widths is None else 0.0
    return ReferencePiece(curve, rows, found, share, begins, passes, b)


def retime(
    s: Array,
    slack: Array,
    reserve: Array,
    cap: Array,
    end: tuple[float, float] | None = None,
    parts: Sequence[float] = SETTINGS.parts,
) -> ControllableSet:
    """Controllable motions nowhere faster than a plan, with the largest least share of margins.

    Parameters
    ----------
    s : (n,) [m]          nodes
    slack : (n, m, 5)     limits at the nodes, as in `CurveLimitRows`
    reserve : (n, m)      their margins
    cap : (n,) [m^2/s^2]  largest b
    end : [m^2/s^2]       least and largest b at the last node; by default the last of `cap`
    parts                 upper limits of the share, tried where some interval has less
    """
    limits, floor, end = PathLimits(slack, cap), SETTINGS.slowest * cap, end or (cap[-1], cap[-1])
    best: ControllableSet | None = None
    for part in (1.0, *parts):
        shares = [part, *(share for share in SETTINGS.shares if share < part)]
        found = find_controllable(limits, reserve, np.diff(s), floor, end, shares)
        if best is None or found.share.min() > best.share.min():
            best = found
        if best.share.min() >= min(0.8 * part, SETTINGS.enough):
            break
    assert best is not None
    return best


def retime_within(
    curve: Curve,
    s: Array,
    plan: Motion,
    widths: Mapping[str, float],
    least: float,
    end: tuple[float, float] | None = None,
) -> tuple[tuple[CurveLimitRows, ControllableSet] | None, float]:
    """The fastest motion that keeps its limits within the largest feasible share of ranges.

    Fixed-point iteration between the worst corners of the ranges and the motion.

    Parameters
    ----------
    s : (n,) [m]  nodes
    plan : (n,)   a, b and internal force of a plan there; no motion is faster
    widths        half widths of the ranges; that of the delay is its unknown part
    least : [N]   least normal force within them
    end           as of `retime`

    Returns
    -------
    tuple  the law's limits and the motions, None if there are none; and the share of the ranges
    """

    def find(share: float) -> tuple[CurveLimitRows, ControllableSet] | None:
        scaled = {name: min(share * width, SETTINGS.widest) for name, width in widths.items()}
        within, motion = find_within(curve, s, np.sqrt(plan[1]), scaled, least), plan
        for _ in range(3):
            rows, whole, wanted = within.at(motion)
            found = retime(s, whole, wanted, plan[1], end, ())
            b = found.run(float(found.high[0]))
            if found.share.min() < 0.5:
                return None
            a = np.gradient(b, s) / 2
            motion = a, b, find_internal_force(rows, a, b)
        return within.at(motion)[0], found

    low, high, best = 0.0, 1.0, find(1.0)
    if best is not None:
        return best, 1.0
    # Downwards first: most ranges are only a little too wide.
    while high - low > 0.03 * high and high > 0.02:
        share = 0.8 * high if best is None else (low + high) / 2
        found = find(share)
        if found is None:
            high = share
        else:
            low, best = share, found
    return best, low


def _follow(
    curve: Curve, plan: Trajectory, rows: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Places s, a, b and internal force of a plan's rows along a curve."""
    formation, metric = curve.formation, metric_weights(curve.formation.scene)
    z, grid = plan.z[rows], np.linspace(0.0, curve.length, 400)
    away = (z[:, None] - curve.evaluate(grid).z[None]) ** 2 @ metric
    s = grid[away.argmin(axis=1)]
    for _ in range(4):
        point = curve.evaluate(s)
        s = np.clip(s + ((z - point.z) * point.z_s) @ metric, 0.0, curve.length)
    point = curve.evaluate(s)
    v = (point.z_s * plan.z_dot[rows]) @ metric
    a = (point.z_s * plan.z_ddot[rows]) @ metric
    segment = np.searchsorted([part.stop for part in curve.segments[:-1]], s)
    forces = inverse(formation, *point[:3], directions_of(curve, segment), point.kinematics)
    c_n, c_t = plan.c_n[rows], plan.c_t[rows]
    return s, a, v**2, find_planned_internal_force(formation, forces, plan, c_n, c_t)
