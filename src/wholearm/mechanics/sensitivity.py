"""Parametric sensitivity of contact forces, by differentiating the equations of motion.

With z, z' and tau fixed, M5 z'' + b(z') = g + S tau + G^T c and P z'' + P' z' = 0 are linear in z''
and c. The derivative by a number p is linear in dz''/dp and dc/dp, with the same matrices:

    M5 dz'' - G^T dc = dg + S dtau - db - dM5 z'' + dG^T c,    P dz'' = -dP z'' - d(P' z').

Along a curve z'' = z_s a + z_ss b, and c, tau and dc/dp are affine in a = s'', b = s'^2, the
internal force lambda and s'.

With other geometry the nearest place and velocity correspond: along a curve these have the same s
and s'. A joint that moves is like an object that moves back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import CurvePoint, Formation, Kinematics
from .dynamics import A, B, Directions, PathForces, V, force_rows, metric_weights, move_least

COUNT = 5  # number of coefficients: of 1, a, b, s' and the internal force


def find_slopes_at(
    formation: Formation,
    samples: tuple[Array, Array, Array, Array, Array, Array],
    directions: Directions,
    names: Sequence[str],
) -> Array:
    """`Sensitivity.find_slopes` at n instants of a motion, (n, n_c + R, len(names)) [N per unit].

    `samples` are z, z', z'', tau, c_n and c_t. `start_x` is how far the object is along x, or as
    far as the contacts let it.
    """
    z, v, a, tau, c_n, c_t = samples
    kinematics = formation.evaluate(z, v)
    c = np.hstack([c_n, c_t[:, list(formation.rolling_rows)]])
    c, tau, acceleration = (each[..., None] * np.eye(COUNT)[0] for each in (c, tau, a))
    # Fingers follow the object, however far.
    metric = metric_weights(formation.scene) * np.array([1, 1, 1, 1e-6, 1e-6])
    unit = np.broadcast_to(np.eye(5)[0], z.shape)
    dz = unit + move_least(kinematics.P, -kinematics.P[..., 0], metric)
    along = dz, np.zeros_like(dz)
    state = Sensitivity(formation, z, v, kinematics, directions, c, tau, acceleration, along)
    state = state._replace(along=(dz, state.turn("", dz)))
    slopes = state.find_slopes(names)
    # The velocity is that of the motion: s' = 1 along a tangent that is z'.
    return np.asarray(slopes @ np.array([1.0, 0.0, 1.0, 1.0, 0.0]))


class Sensitivity(NamedTuple):
    """A formation at n places, with coefficients (..., COUNT) of its motion."""

    formation: Formation
    z: Array  # z, z_s (n, 5): places and tangents, z' = z_s s'
    z_s: Array
    kinematics: Kinematics
    directions: Directions
    c: Array  # c, tau, acceleration (n, ..., COUNT):
    tau: Array
    acceleration: Array
    along: tuple[Array, Array]  # (n, 5): by how much places and tangents change with `start_x`

    @staticmethod
    def of_curve(
        formation: Formation, point: CurvePoint, directions: Directions, forces: PathForces
    ) -> Sensitivity:
        """At n places of a curve, with coefficients of (1, a, b, s', lambda)."""
        z, z_s, z_ss, kinematics = point
        acceleration = np.zeros((*z.shape, COUNT))
        acceleration[..., A], acceleration[..., B] = z_s, z_ss
        size = np.sqrt(z_s[:, :3] ** 2 @ metric_weights(formation.scene)[:3])[:, None]
        given = formation, z, z_s, kinematics, directions, *forces[:2]
        return Sensitivity(*given, acceleration, (z_s / size, z_ss / size))

    def find_slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of contact forces, shape (n, n_c + R, len(names), COUNT) [N per unit].

        Names are of `PARAMETERS`: relative numbers, or lengths in m; `start_x` is the place along
        the curve.
        """
        changes = [self.change(name) for name in names]
        load, bend = (np.stack(columns, axis=2) for columns in zip(*changes, strict=True))
        over = self.kinematics.P / self.formation.scene.mass_diagonal
        G = force_rows(self.formation, self.kinematics, self.directions)
        right = bend - np.einsum("nij,njpq->nipq", over, load)
        flat = np.linalg.solve(over @ G.transpose(0, 2, 1), right.reshape(*right.shape[:2], -1))
        return np.asarray(flat.reshape(right.shape))

    def find_shifts(self, name: str) -> Array:
        """Apparent progress along a curve by joint angles, per unit of a length error, (n,)."""
        rates = self.z_s[:, 3:]
        square = np.maximum((rates**2).sum(axis=1), 1e-30)
        return np.asarray((self.displace(name)[:, 3:] * rates).sum(axis=1) / square)

    def change(self, name: str) -> tuple[Array, Array]:
        """Right sides of the derivative by one number.

        Those of Newton's and Euler's laws, (n, 5, COUNT), and of constraints, (n, n_c + R, COUNT).
        """
        scene, load = self.formation.scene, np.zeros_like(self.acceleration)
        bend = np.zeros_like(self.c)
        if name in ("mass", "inertia"):
            share = np.array([1, 1, 0, 0, 0] if name == "mass" else [0, 0, 1, 0, 0])
            load -= (share * scene.mass_diagonal)[:, None] * self.acceleration
            load[..., 0] += share * scene.applied_force
        elif name.startswith("friction"):
            part = {"palm": None, "finger1": 0, "finger2": 1}[name.partition("_")[2]]
            mine = np.array([contact.finger == part for contact in self.formation.contacts])
            slip = mine * self.formation.sliding_friction * self.directions.Xi
            rows = -slip[..., None] * self.kinematics.A_t
            load += np.einsum("nij,niq->njq", rows, self.c[:, : rows.shape[1]])
        elif name.startswith("gain"):
            finger = int(name[-1]) - 1
            load[:, 3 + finger] = self.tau[:, finger]
        elif name == "start_x":
            return self._move("", *self.along)
        elif name.startswith(("base", "length")):
            dz = self.displace(name)
            return self._move(name, dz, self.turn(name, dz))
        return load, bend

    def displace(self, name: str) -> Array:
        """The nearest place where a joint is moved or a link is longer: dz/dp, shape (n, 5)."""
        count, none = self.formation.n_contacts, np.zeros_like(self.z)
        gap = np.zeros(self.kinematics.P.shape[:2])
        gap[:, :count] = self._difference(name, none, none).C
        if self.formation.rolling and name.startswith("base"):
            axis = "xy".index(name[-1])
            gap[:, count:] = -(self._rows_of(name) * self.kinematics.P[..., axis])[:, count:]
        return move_least(self.kinematics.P, -gap, metric_weights(self.formation.scene))

    def _difference(self, name: str, dz: Array, dz_s: Array) -> Kinematics:
        """Derivative of the kinematics by a length, with which places and tangents move."""
        step = 1e-5 * self.formation.scene.scales.length
        ends = [
            self._evaluate(name, change, self.z + change * dz, self.z_s + change * dz_s)
            for change in (-step, step)
        ]
        return Kinematics(*((b - a) / (2 * step) for a, b in zip(*ends, strict=True)))

    def turn(self, name: str, dz: Array) -> Array:
        """By how much the tangent changes."""
        turned = np.einsum("nij,nj->ni", self._difference(name, dz, 0 * dz).P, self.z_s)
        return move_least(self.kinematics.P, -turned, metric_weights(self.formation.scene))

    def _move(self, name: str, dz: Array, dz_s: Array) -> tuple[Array, Array]:
        """What another place and tangent change, with geometry that is off by as much."""
        slopes = self._difference(name, dz, dz_s)
        bend = -np.einsum("nij,njq->niq", slopes.P, self.acceleration)
        bend[..., B] -= slopes.P_dot_v
        dG = force_rows(self.formation, slopes, self.directions)
        load = np.einsum("nij,niq->njq", dG, self.c)
        load[..., V] -= self.formation.scene.viscous * dz_s
        return load, bend

    def _rows_of(self, name: str) -> Array:
        """Which constraint rows are of the finger that a name ends in, shape (n_c + R,)."""
        finger = int(name.rstrip("_xy")[-1]) - 1
        contacts = (*self.formation.contacts, *self.formation.rolling)
        return np.array([contact.finger == finger for contact in contacts])

    def _evaluate(self, name: str, change: float, z: Array, v: Array) -> Kinematics:
        """The formation at other places and tangents, with one length that is off."""
        formation = self.formation
        if name.startswith("length"):
            formation = _lengthen(formation, int(name[-1]) - 1, change)
        kinematics = formation.evaluate(z, v)
        if not name.startswith("base"):
            return kinematics
        back = np.zeros(5)
        back["xy".index(name[-1])] = change
        moved = formation.evaluate(z - back, v)
        mine, count = self._rows_of(name), formation.n_contacts

        def choose(one: Array, other: Array) -> Array:
            rows = mine[:count] if one.shape[1] == count else mine
            return np.where(rows.reshape(-1, *[1] * (one.ndim - 2)), other, one)

        return Kinematics(*map(choose, kinematics, moved))


@lru_cache(maxsize=16)  # compiled functions of a formation cost more than evaluating them
def _lengthen(formation: Formation, finger: int, change: float) -> Formation:
    """The formation with a longer link, if its tip is in contact."""
    if not any(c.surface == "tip" and c.finger == finger for c in formation.contacts):
        return formation
    fingers = list(formation.scene.fingers)
    fingers[finger] = replace(fingers[finger], length=fingers[finger].length + change)
    return replace(formation, scene=replace(formation.scene, fingers=(fingers[0], fingers[1])))
