"""Limits of contact forces in the corners of parameter ranges, as a policy keeps them.

At given s, s' and torques, forces and s'' of a perturbed scene are affine in 1, b = s'^2, s',
a = s'' and the internal force: in each corner of the ranges of mass, inertia and friction a limit
is a row of five coefficients. Geometry, gains and delays are added to first order, in absolute sum.

The worst corner depends on the motion: `Corners.pick` takes that of one motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..geometry.curve import CurvePoint
from ..mechanics.dynamics import Directions, PathForces, inverse
from ..mechanics.limits import CONE, PRESS, make_limits
from ..problem.uncertainty import GROUPS, change_scene
from ..scene.model import Scene
from ..sensitivity.slopes import find_force_slopes, find_shifts

CORNERS = ("mass", "inertia", "friction_palm", "friction_finger1", "friction_finger2")
"""Numbers whose ranges have corners."""
OTHERS = (*GROUPS["geometry"], *GROUPS["gain"])
"""Numbers whose ranges count to first order. The start is measured, and a delay is in torques."""
_ORDER = [0, 2, 4, 1, 3]
"""Columns of derivatives, by 1, a, b, internal force and s', in the order used here."""

Motion = tuple[Array, Array, Array]  # a, b and internal force at n places


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
