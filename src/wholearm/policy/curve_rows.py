"""Torques and limits at places along a curve, affine in a, b, speed and internal force.

Coefficients are in the order 1, b = s'^2, s', a = s'', lambda: the last axis of every array here.
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
from ..mechanics.dynamics import Directions, PathForces, inverse
from ..mechanics.limits import CONE, PRESS, LimitSet, make_limits
from ..problem.uncertainty import GROUPS, change_scene
from ..scene.model import Scene
from ..sensitivity.slopes import find_force_slopes, find_shifts
from .curve_law import choose_internal_force

CORNERS = ("mass", "inertia", "friction_palm", "friction_finger1", "friction_finger2")
"""Numbers whose ranges have corners."""
OTHERS = (*GROUPS["geometry"], *GROUPS["gain"])
"""Numbers whose ranges count to first order. The start is measured, and a delay is in torques."""
_ORDER = [0, 2, 4, 1, 3]
"""Columns of derivatives, by 1, a, b, internal force and s', in the order used here."""
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
NEVER = 1e9  # level of a limit that does not count


class CurveLimitRows(NamedTuple):
    """Torques and limits at n places of a curve."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    # (n, m, 5) [N, N m]: distances from limits: of forces with friction before, then after the
    # nearest reversal; of torques
    slack: Array
    unit: Array  # (n, m) [N, N m]: margin at level 1
    presses: int  # how many of the m are of forces
    ends: Array  # (k, n_c, 5) [N]: normal forces at the last place, in each corner of known ranges
    scenes: tuple[Scene, ...]  # the scenes of these corners

    @property
    def levels(self) -> Array:
        """Limits over their margins, shape (n, m, 5)."""
        return np.asarray(self.slack / self.unit[..., None])


def make_rows(curve: Curve, s: Array, motion: tuple[Array, Array, Array]) -> CurveLimitRows:
    """Rows at places of a curve, with margins for a motion (a, b, lambda)."""
    formation, point, speed = curve.formation, curve.evaluate(s), np.sqrt(motion[1])
    mean, *sides = blend_directions(curve, s, speed * NEAR)
    forces = inverse(formation, *point[:3], mean, point.kinematics)
    torque = np.stack([forces.T0, forces.Tb, forces.Tv, forces.Ta, forces.Tl], axis=2)
    late = curve.evaluate(np.clip(s - LATE * speed, 0.0, curve.length))
    delayed = inverse(formation, *late[:3], mean, late.kinematics).tau(*motion)
    tau = forces.tau(*motion)
    limits = make_limits(formation, 0.0).only(PRESS, CONE)
    slack, unit = [], []
    for side in sides:
        c = respond(inverse(formation, *point[:3], side, point.kinematics), torque)[0]
        slack.append(np.einsum("mi,nij->nmj", limits.columns[0], c))
        error = _estimate_errors(formation, point, side, limits, speed, tau, delayed)
        unit.append(LEAST * limits.scales + error)
    same = (sides[0].Xi == sides[1].Xi).all(axis=1) & (sides[0].sigma == sides[1].sigma).all(axis=1)
    slack[1][same] = np.array([NEVER, 0.0, 0.0, 0.0, 0.0])
    most = np.tile(formation.scene.torque_limit, 2)
    left = np.concatenate([-torque, torque], axis=1)
    left[:, :, 0] += most
    slack.append(left)
    unit.append(np.tile(SPARE * most, (len(s), 1)))
    count = 2 * len(limits.low)
    ends, scenes = slack[0][-1:, : formation.n_contacts], (formation.scene,)
    table = np.concatenate(slack, axis=1)
    return CurveLimitRows(s, torque, table, np.concatenate(unit, axis=1), count, ends, scenes)


def leave_one(levels: Array) -> Array:
    """Levels of intervals, (n, 2, m, 5), without duplicates."""
    found = levels.copy()
    for k in range(1, levels.shape[2]):
        twice = (found[:, :, :k] == levels[:, :, k : k + 1]).all(axis=(1, 3)).any(axis=1)
        found[twice, :, k] = np.array([NEVER, 0.0, 0.0, 0.0, 0.0])
    return found


def find_internal_force(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    """The internal force with the largest least level for a motion, shape (n,)."""
    pairs = zip(_measure_base(rows, a, b).tolist(), rows.levels[:, :, 4].tolist(), strict=True)
    return np.array(
        [choose_internal_force(base, [0.0] * len(base), by, 0.0)[1] for base, by in pairs]
    )


def measure_levels(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    """Levels of all limits for a motion with that internal force, shape (n, m)."""
    return (
        _measure_base(rows, a, b) + rows.levels[:, :, 4] * find_internal_force(rows, a, b)[:, None]
    )


def _measure_base(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    values = np.column_stack([np.ones(len(a)), b, np.sqrt(b), a])
    return np.asarray(np.einsum("nmi,ni->nm", rows.levels[:, :, :4], values))


def find_forces(curve: Curve, s: Array, speed: Array) -> Array:
    """Normal forces at both ends of the intervals between places, (n - 1, 2, n_c, 5) [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    forces = inverse(
        formation, *point[:3], blend_directions(curve, s, speed * NEAR)[0], point.kinematics
    )
    of = np.stack([forces.C0, forces.Cb, np.zeros_like(forces.C0), forces.Ca, forces.Cl], axis=2)
    of = of[:, : formation.n_contacts]
    return np.stack([of[:-1], of[1:]], axis=1)


def find_directions(curve: Curve, s: Array) -> Directions:
    """Directions at n places."""
    ends = [part.stop for part in curve.segments[:-1]]
    segments = [curve.segments[k] for k in np.searchsorted(ends, s)]
    return Directions(
        np.array([part.Xi for part in segments]), np.array([part.sigma for part in segments])
    )


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
    speed: Array,
    tau: Array,
    delayed: Array,
) -> Array:
    """Errors of forces from uncertain numbers, torques and delays, root sum square, (n, m)."""
    values = np.column_stack([np.ones(len(speed)), speed**2, speed])

    def find(scene: Scene) -> PathForces:
        return inverse(replace(formation, scene=scene), *point[:3], side)

    def measure(forces: PathForces, tau: Array) -> Array:
        rows = np.pad(tau[:, :, None], ((0, 0), (0, 0), (0, 4)))
        c = np.einsum("nij,nj->ni", respond(forces, rows)[0][:, :, :3], values)
        return np.asarray(c @ limits.columns[0].T)

    scene, nominal = formation.scene, find(formation.scene)
    cases = [(find(change_scene(scene, {name: width})), tau) for name, width in DOUBTS.items()]
    cases += [(nominal, tau * (1 + GAIN * np.eye(2)[k])) for k in range(2)]
    cases.append((nominal, delayed))
    base = measure(nominal, tau)
    return np.asarray(np.sqrt(np.sum([(measure(*case) - base) ** 2 for case in cases], axis=0)))


class Corners(NamedTuple):
    """Limits at n places in k corners, of the nominal (1, b, s', a, internal force)."""

    rows: Array  # (k, n, m, 5)
    moves: Array  # (k, n, 5): actual acceleration s''
    swings: Array  # (p, n, m, 5): first-order changes by each other range

    def pick(self, motion: Motion) -> Array:
        """The limits in the corner that is worst for a motion, shape (n, m, 5)."""
        a, b, internal = motion
        values = np.column_stack([np.ones_like(a), b, np.sqrt(b), a, internal])
        worst = np.einsum("knmq,nq->knm", self.rows, values).argmin(axis=0)
        rows = np.take_along_axis(self.rows, worst[None, ..., None], axis=0)[0]
        signs = np.sign(np.einsum("pnmq,nq->pnm", self.swings, values))
        return np.asarray(rows - np.einsum("pnm,pnmq->nmq", signs, self.swings))

    def close(self, others: Array) -> Corners:
        """These and other limits, (n, l, 5), with feedback that makes s'' equal to a."""
        count = len(self.rows)
        rows = np.concatenate([self.rows, np.tile(others, (count, 1, 1, 1))], axis=2)
        rate, rest = self.moves[..., 3:4], self.moves.copy()
        rest[..., 3] = 0.0
        asked = rows[..., 3:4] / rate[:, :, None]
        closed = rows - asked * rest[:, :, None]
        closed[..., 3] = asked[..., 0]
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
    for scene in list_scenes(formation.scene, widths):
        changed = replace(formation, scene=scene)
        c, motion = respond(inverse(changed, *point[:3], side, point.kinematics), torques[0])
        limits = make_limits(changed, 0.0).only(PRESS, CONE)
        rows.append(np.einsum("mi,nij->nmj", limits.columns[0], c))
        moves.append(motion[:, 0])
    plain = inverse(formation, *point[:3], side, point.kinematics)
    limits = make_limits(formation, 0.0).only(PRESS, CONE)
    swings = [respond(plain, torques[1])[0] - respond(plain, torques[0])[0]]
    for name in (other for other in OTHERS if widths.get(other, 0.0) > 0):
        slopes = find_force_slopes(formation, point, side, plain, (name,))[:, :, 0, _ORDER]
        if name in GROUPS["geometry"]:
            # Torques depend on the apparent place.
            shift = find_shifts(formation, point, side, plain, name)
            moved = torques[0] + shift[:, None, None] * torques[2]
            slopes = slopes + respond(plain, moved)[0] - respond(plain, torques[0])[0]
        swings.append(widths[name] * slopes)
    return Corners(
        np.array(rows), np.array(moves), np.einsum("mi,pnij->pnmj", limits.columns[0], swings)
    )


def list_scenes(scene: Scene, widths: Mapping[str, float]) -> tuple[Scene, ...]:
    """Scenes in the corners of ranges with half `widths`."""
    names = [name for name in CORNERS if widths.get(name, 0.0) > 0]
    return tuple(
        change_scene(scene, {n: k * widths[n] for n, k in zip(names, signs, strict=True)})
        for signs in product((-1, 1), repeat=len(names))
    )


def respond(forces: PathForces, torque: Array) -> tuple[Array, Array]:
    """Contact forces, (n, n_c + R, 5), a and internal force, (n, 2, 5), from torques (n, 2, 5)."""
    rest = torque.copy()
    rest[:, :, :3] -= np.stack([forces.T0, forces.Tb, forces.Tv], axis=2)
    motion = np.linalg.solve(np.stack([forces.Ta, forces.Tl], axis=2), rest)
    found = np.stack([forces.Ca, forces.Cl], axis=2) @ motion
    found[:, :, 0] += forces.C0
    found[:, :, 1] += forces.Cb
    return np.asarray(found), np.asarray(motion)
