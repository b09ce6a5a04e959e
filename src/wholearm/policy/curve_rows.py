"""What holds at places along a curve: torques and limits, affine in a, b, speed and squeeze.

A motion is wanted with a = s'', b = s'^2, the speed s' and the squeeze lambda. Coefficients are in
the order 1, b, s', a, lambda, the last axis of every array here.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..geometry.curve import Curve, CurvePoint
from ..mechanics.dynamics import Directions, PathForces, inverse
from ..mechanics.limits import CONE, PRESS, LimitSet, make_limits
from ..problem.uncertainty import change_scene
from ..scene.model import Scene
from .corners import respond
from .curve_law import choose_squeeze

DOUBTS = {"mass": 0.05, "inertia": 0.05} | {
    f"friction_{part}": 0.1 for part in ("palm", "finger1", "finger2")
}
"""By how much numbers of a scene may be off, relative: what a reserve of normal force is for."""
GAIN = 0.01  # By how much each torque may be off, relative
LATE = 5e-4  # By how much torques may be early or late [s]
LEAST = 0.02  # Least reserve of a normal force, over the scene's unit of force
SPARE = 0.05  # Reserve of a torque, over its limit: what feedback may add
NEAR = 1e-3  # Time before and after a reversal in which friction may have either direction [s]
NEVER = 1e9  # Level of a limit that does not count


class CurveLimitRows(NamedTuple):
    """Torques and limits at n places of a curve."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    # (n, m, 5) [N, N m]: how far forces and torques are from their limits: those of forces with
    # friction as it is before, then as it is after the nearest reversal, which is the same but near
    # one
    slack: Array
    unit: Array  # (n, m) [N, N m]: what is in reserve at level 1
    presses: int  # how many of the m are of forces
    # (k, n_c, 5) [N]: normal forces at the last place, in each corner of ranges if they are known
    ends: Array
    scenes: tuple[Scene, ...]  # the scenes of these corners

    @property
    def levels(self) -> Array:
        """Limits in units of their reserves, shape (n, m, 5)."""
        return np.asarray(self.slack / self.unit[..., None])


def make_rows(curve: Curve, s: Array, motion: tuple[Array, Array, Array]) -> CurveLimitRows:
    """Rows at places of a curve, with reserves for a motion (a, b, lambda) there."""
    formation, point, speed = curve.formation, curve.evaluate(s), np.sqrt(motion[1])
    mean, *sides = turn(curve, s, speed * NEAR)
    forces = inverse(formation, *point[:3], mean, point.kinematics)
    torque = np.stack([forces.T0, forces.Tb, forces.Tv, forces.Ta, forces.Tl], axis=2)
    late = curve.evaluate(np.clip(s - LATE * speed, 0.0, curve.length))
    delayed = inverse(formation, *late[:3], mean, late.kinematics).tau(*motion)
    tau = forces.tau(*motion)
    limits = make_limits(formation, 0.0).only(PRESS, CONE)
    slack, unit = [], []
    for side in sides:
        own = respond(inverse(formation, *point[:3], side, point.kinematics), torque)[0]
        slack.append(np.einsum("mi,nij->nmj", limits.columns[0], own))
        doubt = _doubt(formation, point, side, limits, speed, (tau, delayed))
        unit.append(LEAST * limits.scales + doubt)
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
    """Levels of intervals, (n, 2, m, 5), of which those that are there twice count once."""
    found = levels.copy()
    for k in range(1, levels.shape[2]):
        twice = (found[:, :, :k] == levels[:, :, k : k + 1]).all(axis=(1, 3)).any(axis=1)
        found[twice, :, k] = np.array([NEVER, 0.0, 0.0, 0.0, 0.0])
    return found


def find_squeeze(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    """The squeeze with the largest least level for a motion, shape (n,)."""
    pairs = zip(_measure_base(rows, a, b).tolist(), rows.levels[:, :, 4].tolist(), strict=True)
    return np.array([choose_squeeze(base, [0.0] * len(base), by, 0.0)[1] for base, by in pairs])


def measure_levels(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    """Levels of all limits for a motion with that squeeze, shape (n, m)."""
    return _measure_base(rows, a, b) + rows.levels[:, :, 4] * find_squeeze(rows, a, b)[:, None]


def _measure_base(rows: CurveLimitRows, a: Array, b: Array) -> Array:
    known = np.column_stack([np.ones(len(a)), b, np.sqrt(b), a])
    return np.asarray(np.einsum("nmi,ni->nm", rows.levels[:, :, :4], known))


def find_forces(curve: Curve, s: Array, speed: Array) -> Array:
    """Normal forces at both ends of the intervals between places, (n - 1, 2, n_c, 5) [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    own = inverse(formation, *point[:3], turn(curve, s, speed * NEAR)[0], point.kinematics)
    of = np.stack([own.C0, own.Cb, np.zeros_like(own.C0), own.Ca, own.Cl], axis=2)
    of = of[:, : formation.n_contacts]
    return np.stack([of[:-1], of[1:]], axis=1)


def find_directions(curve: Curve, s: Array) -> Directions:
    """Directions at n places."""
    ends = [part.stop for part in curve.segments[:-1]]
    own = [curve.segments[k] for k in np.searchsorted(ends, s)]
    return Directions(np.array([part.Xi for part in own]), np.array([part.sigma for part in own]))


def turn(curve: Curve, s: Array, width: Array) -> list[Directions]:
    """Directions halfway through each reversal, before it and after it.

    They differ within a width of each reversal, shape (n,) [m].
    """
    first = curve.segments[0]
    found = [[np.tile(part, (len(s), 1)) for part in (first.Xi, first.sigma)] for _ in range(3)]
    for before, after in pairwise(curve.segments):
        near = max(float(np.interp(before.stop, s, width)), 1e-3 * curve.length)
        share = np.clip(0.5 + (s - before.stop) / (2 * near), 0.0, 1.0)[:, None]
        for own, part in zip(found, (share, np.floor(share), np.ceil(share)), strict=True):
            own[0] += part * (after.Xi - before.Xi)
            own[1] += part * (after.sigma - before.sigma)
    return [Directions(*own) for own in found]


def _doubt(
    formation: Formation,
    point: CurvePoint,
    side: Directions,
    limits: LimitSet,
    speed: Array,
    given: tuple[Array, Array],
) -> Array:
    """By how much forces are off with other numbers and torques, each in turn, (n, rows).

    `given` are the torques, and those that are late, shape (n, 2) each.
    """
    tau, delayed = given
    known = np.column_stack([np.ones(len(speed)), speed**2, speed])

    def find(scene: Scene) -> PathForces:
        return inverse(replace(formation, scene=scene), *point[:3], side)

    def measure(forces: PathForces, tau: Array) -> Array:
        held = np.zeros((*tau.shape, 5))
        held[:, :, 0] = tau
        c = np.einsum("nij,nj->ni", respond(forces, held)[0][:, :, :3], known)
        return np.asarray(c @ limits.columns[0].T)

    own = find(formation.scene)
    cases = [
        (find(change_scene(formation.scene, {name: width})), tau) for name, width in DOUBTS.items()
    ]
    cases += [(own, tau * (1 + GAIN * np.eye(2)[k])) for k in range(2)]
    cases.append((own, delayed))
    plain = measure(own, tau)
    return np.asarray(np.sqrt(np.sum([(measure(*case) - plain) ** 2 for case in cases], axis=0)))
