"""Torques and limits at places along a curve, as coefficients of (1, s'', s'^2, s', lambda).

The coefficients multiply a nominal motion. Its torques are applied: with other friction, mass or
gains they lead to another s'' and internal force, and thus to other contact forces. Within ranges,
limits hold in the worst corner (`Corners`), both under nominal torques and with feedback that
tracks the reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..geometry.curve import Curve, CurvePoint
from ..mechanics.dynamics import LAMBDA, ONE, A, Directions, PathForces, inverse, stack_motion
from ..mechanics.limits import LimitSet, make_limits
from ..mechanics.path_limits import PathLimits, find_slack_rows
from ..problem.uncertainty import GROUPS, change_scene
from ..scene.model import Scene
from ..sensitivity.slopes import find_force_slopes, find_shifts
from .curve_law import choose_internal_force

CORNERS = ("mass", "inertia", "friction_palm", "friction_finger1", "friction_finger2")
"""Numbers whose ranges have corners."""
OTHERS = (*GROUPS["geometry"], *GROUPS["gain"])
"""Numbers whose ranges count to first order. The start is measured, and a delay is in torques."""
Motion = tuple[Array, Array, Array]  # a, b and internal force at n places
DOUBTS = {"mass": 0.05, "inertia": 0.05} | {
    f"friction_{part}": 0.1 for part in ("palm", "finger1", "finger2")
}
"""Relative uncertainties of a scene's numbers, for the margins of normal forces."""
GAIN = 0.01  # relative uncertainty of each torque
LATE = 5e-4  # uncertainty of the delay [s]
LEAST = 0.02  # least margin of a normal force, over the scene's unit of force
SPARE = 0.05  # margin of a torque for feedback, over its limit
NEAR = 1e-3  # time around a reversal in which friction may have either direction [s]
KEPT = 1.3  # margin of the reference's forces, in units: feedback may use what is above one
AUTHORITY = 2.0  # margin of torques for feedback, in units
WIDER = 1.01  # least width of a reversal, over the distance to the next node
STEP = 1e-4  # step of differences along a curve, over its length
NEVER = 1e9  # level of a limit that does not count
UNLIMITED = np.array([NEVER, 0.0, 0.0, 0.0, 0.0])
FIXED = np.array([1.0, 0.0, 1.0, 1.0, 0.0])
"""Columns that torques do not change: all but those of s'' and the internal force."""


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
    mean, *sides = blend_directions(curve, s, speed * NEAR)
    torque, late = find_torques(curve, s, mean), find_torques(curve, s - LATE * speed, mean)
    tau, delayed = (PathForces(rows, rows).tau(*motion) for rows in (torque, late))
    (contact, joint), rates = split_limits(formation), point.z_s[:, 3:]
    slack, unit = [], []
    for side in sides:
        forces = inverse(formation, *point[:3], side, point.kinematics)
        slack.append(measure_slack(contact, respond(forces, torque)[0], torque, rates))
        error = _estimate_errors(formation, point, side, contact, motion[1], tau, delayed)
        unit.append(LEAST * contact.scales[contact.sides[0]] + error)
    slack[1][have_same_signs(*sides)] = UNLIMITED
    slack.append(measure_slack(joint, np.zeros_like(forces.of_c), torque, rates))
    unit.append(np.tile(SPARE * joint.scales[joint.sides[0]], (len(s), 1)))
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


def measure_levels(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    """Levels of all limits for a motion with that internal force, shape (n, m)."""
    motion = stack_motion(a, b, find_internal_force(rows, a, b))
    return np.asarray(np.einsum("nmi,ni->nm", rows.levels, motion))


def find_forces(curve: Curve, s: Array, speed: Array) -> Array:
    """Normal forces at both ends of the intervals between places, (n - 1, 2, n_c, 5) [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    mean = blend_directions(curve, s, speed * NEAR)[0]
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
    cases = [(change_scene(scene, {name: width}), tau) for name, width in DOUBTS.items()]
    cases += [(scene, tau * (1 + GAIN * np.eye(2)[k])) for k in range(2)] + [(scene, delayed)]
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
    for name in (other for other in OTHERS if widths.get(other, 0.0) > 0):
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
        kept = np.concatenate([KEPT * self.unit[:count], AUTHORITY * self.unit[count:]])
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
    width = np.maximum(speed * NEAR, WIDER * np.maximum(gaps[1:], gaps[:-1]))
    mean, *sides = blend_directions(curve, s, width)
    late = s - (LATE + widths.get("delay", 0.0)) * speed
    nominal, step = find_torques(curve, s, mean), STEP * curve.length
    before, after = (find_torques(curve, s + sign * step, mean) for sign in (-1, 1))
    torques = nominal, find_torques(curve, late, mean), (after - before) / (2 * step)
    corners = [find_corners(formation, point, side, torques, widths) for side in sides]
    contact, joint = split_limits(formation)
    none = np.zeros((len(s), formation.n_constraints, 5))
    left = measure_slack(joint, none, nominal, point.z_s[:, 3:])
    scales, most = (each.scales[each.sides[0]] for each in (contact, joint))
    unit = np.concatenate([np.maximum(LEAST * scales, least), SPARE * most])
    scenes = list_scenes(formation.scene, widths)
    same = have_same_signs(*sides)
    return Within(s, nominal, left, (corners[0], corners[1]), same, unit, scenes)
