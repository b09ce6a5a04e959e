"""Limits of contact forces within ranges of numbers, as a policy keeps them.

Feedback knows the place and the speed; what it does not know is which forces its torques lead to.
At the same s, s' and torques, with other numbers of the scene, forces and s'' are affine in what
the torques are for: 1, b = s'^2, s', a = s'' and the squeeze. So in every corner of the ranges of
mass, inertia and friction a limit is a row of five coefficients. What geometry, gains and lateness
change is small, and is added to first order, as the sum of what each of them changes.

Which corner is worst depends on the motion. Of each limit there are rows for the corners that are
worst at a few squeezes between the least and the largest one: their least is concave in the
squeeze, as the limit itself is.
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
"""Columns of derivatives, of 1, a, b, squeeze and s', in the order used here."""

Motion = tuple[Array, Array, Array]  # a, b and squeeze at n places


class Corners(NamedTuple):
    """Limits at n places in k corners, of (1, b, s', a, squeeze) that torques are for."""

    rows: Array  # (k, n, m, 5)
    moves: Array  # (k, n, 5): the acceleration s'' there
    swings: Array  # (p, n, m, 5): what each of the other ranges changes

    def pick(self, motion: Motion) -> Array:
        """The limits in the corner that is worst for a motion, shape (n, m, 5)."""
        a, b, squeeze = motion
        known = np.column_stack([np.ones_like(a), b, np.sqrt(b), a, squeeze])
        worst = np.einsum("knmq,nq->knm", self.rows, known).argmin(axis=0)
        rows = np.take_along_axis(self.rows, worst[None, ..., None], axis=0)[0]
        signs = np.sign(np.einsum("pnmq,nq->pnm", self.swings, known))
        return np.asarray(rows - np.einsum("pnm,pnmq->nmq", signs, self.swings))

    def close(self, others: Array) -> Corners:
        """The same, and other limits, (n, l, 5), where feedback has made s'' what it was to be.

        The coefficients of a are then those of that acceleration.
        """
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
    """Limits of forces in the corners of ranges.

    Parameters
    ----------
    formation, point, side  where and which way contacts slide
    torques : (n, 2, 5)     those that are asked for, those of a little earlier, and how they change
                            along the curve
    widths                  half widths of ranges, by name
    """
    rows, moves = list[Array](), list[Array]()
    for scene in list_scenes(formation.scene, widths):
        own = replace(formation, scene=scene)
        c, motion = respond(inverse(own, *point[:3], side, point.kinematics), torques[0])
        limits = make_limits(own, 0.0).only(PRESS, CONE)
        rows.append(np.einsum("mi,nij->nmj", limits.columns[0], c))
        moves.append(motion[:, 0])
    plain = inverse(formation, *point[:3], side, point.kinematics)
    limits = make_limits(formation, 0.0).only(PRESS, CONE)
    swings = [respond(plain, torques[1])[0] - respond(plain, torques[0])[0]]
    for name in (own for own in OTHERS if widths.get(own, 0.0) > 0):
        slopes = find_force_slopes(formation, point, side, plain, (name,))[:, :, 0, _ORDER]
        if name in GROUPS["geometry"]:
            # Torques are those of where joints seem to be.
            shift = find_shifts(formation, point, side, plain, name)
            moved = torques[0] + shift[:, None, None] * torques[2]
            slopes = slopes + respond(plain, moved)[0] - respond(plain, torques[0])[0]
        swings.append(widths[name] * slopes)
    return Corners(
        np.array(rows), np.array(moves), np.einsum("mi,pnij->pnmj", limits.columns[0], swings)
    )


def list_scenes(scene: Scene, widths: Mapping[str, float]) -> tuple[Scene, ...]:
    """A scene in each corner of the ranges of some half widths."""
    names = [name for name in CORNERS if widths.get(name, 0.0) > 0]
    return tuple(
        change_scene(scene, {n: k * widths[n] for n, k in zip(names, signs, strict=True)})
        for signs in product((-1, 1), repeat=len(names))
    )


def respond(forces: PathForces, torque: Array) -> tuple[Array, Array]:
    """Contact forces, (n, n_c + R, 5), a and squeeze, (n, 2, 5), that torques lead to.

    Parameters
    ----------
    forces              what holds
    torque : (n, 2, 5)
    """
    lacking = torque.copy()
    lacking[:, :, :3] -= np.stack([forces.T0, forces.Tb, forces.Tv], axis=2)
    motion = np.linalg.solve(np.stack([forces.Ta, forces.Tl], axis=2), lacking)
    found = np.stack([forces.Ca, forces.Cl], axis=2) @ motion
    found[:, :, 0] += forces.C0
    found[:, :, 1] += forces.Cb
    return np.asarray(found), np.asarray(motion)
