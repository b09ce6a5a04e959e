"""Parametric sensitivity of contact forces, by differentiating the equations of motion.

With z, z' and tau fixed, M5 z'' + b(z') = g + S tau + G^T c and P z'' + P' z' = 0 are linear in z''
and c. The derivative by a number p is linear in dz''/dp and dc/dp, with the same matrices:

    M5 dz'' - G^T dc = dg + S dtau - db - dM5 z'' + dG^T c,    P dz'' = -dP z'' - d(P' z').

Along a curve z'' = z_s a + z_ss b, and c, tau and dc/dp are affine in a = s'', b = s'^2, the
internal force lambda and s'.

With changed geometry the nearest configuration and velocity are compared; along a curve they have
the same s and s'. Moving the base of a finger is equivalent to moving the object back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import CurvePoint, Formation, Kinematics
from .dynamics import A, B, Directions, PathForces, V, force_rows, metric_weights, solve_min_norm

COUNT = 5  # number of coefficients: of 1, a, b, s' and the internal force


def find_slopes_at(
    formation: Formation,
    samples: tuple[Array, Array, Array, Array, Array, Array],
    directions: Directions,
    names: Sequence[str],
) -> Array:
    """`Sensitivity.find_slopes` at n instants of a motion, (n, n_c + R, len(names)) [N per unit].

    `samples` are z, z', z'', tau, c_n and c_t. `start_x` displaces the object along x, as far as
    the contacts permit.
    """
    z, v, a, tau, c_n, c_t = samples
    kinematics = formation.evaluate(z, v)
    c = np.hstack([c_n, c_t[:, list(formation.rolling_rows)]])
    c, tau, acceleration = (values[..., None] * np.eye(COUNT)[0] for values in (c, tau, a))
    # Low weights of the joints: fingers follow the object.
    metric = metric_weights(formation.scene) * np.array([1, 1, 1, 1e-6, 1e-6])
    unit = np.broadcast_to(np.eye(5)[0], z.shape)
    dz = unit + solve_min_norm(kinematics.P, -kinematics.P[..., 0], metric)
    start_shift = dz, np.zeros_like(dz)
    state = Sensitivity(formation, z, v, kinematics, directions, c, tau, acceleration, start_shift)
    state = state._replace(start_shift=(dz, state.turn_tangent("", dz)))
    slopes = state.find_slopes(names)
    # The velocity is that of the motion: s' = 1 along a tangent that is z'.
    return np.asarray(slopes @ np.array([1.0, 0.0, 1.0, 1.0, 0.0]))


class Sensitivity(NamedTuple):
    """A formation at n places, with coefficients (..., COUNT) of its motion."""

    formation: Formation
    z: Array  # z, z_s (n, 5): configurations and tangents, z' = z_s s'
    z_s: Array
    kinematics: Kinematics
    directions: Directions
    c: Array  # c, tau, acceleration (n, ..., COUNT):
    tau: Array
    acceleration: Array
    start_shift: tuple[Array, Array]  # (n, 5): derivatives of z and z_s by `start_x`

    @staticmethod
    def of_curve(
        formation: Formation, point: CurvePoint, directions: Directions, forces: PathForces
    ) -> Sensitivity:
        """At n places of a curve, with coefficients of (1, a, b, s', lambda)."""
        z, z_s, z_ss, kinematics = point
        acceleration = np.zeros((*z.shape, COUNT))
        acceleration[..., A], acceleration[..., B] = z_s, z_ss
        size = np.sqrt(z_s[:, :3] ** 2 @ metric_weights(formation.scene)[:3])[:, None]
        c, tau, shift = forces.of_c, forces.of_tau, (z_s / size, z_ss / size)
        return Sensitivity(formation, z, z_s, kinematics, directions, c, tau, acceleration, shift)

    def find_slopes(self, names: Sequence[str]) -> Array:
        """Derivatives of contact forces, shape (n, n_c + R, len(names), COUNT) [N per unit].

        Names are of `PARAMETERS`: relative numbers, or lengths in m; `start_x` is a shift along
        the curve.
        """
        changes = [self.change(name) for name in names]
        load, curvature = (np.stack(columns, axis=2) for columns in zip(*changes, strict=True))
        P_M = self.kinematics.P / self.formation.scene.mass_diagonal
        G = force_rows(self.formation, self.kinematics, self.directions)
        rhs = curvature - np.einsum("nij,njpq->nipq", P_M, load)
        solution = np.linalg.solve(P_M @ G.transpose(0, 2, 1), rhs.reshape(*rhs.shape[:2], -1))
        return np.asarray(solution.reshape(rhs.shape))

    def find_shifts(self, name: str) -> Array:
        """Apparent shift of s measured by joint angles, per unit of a length error, (n,)."""
        rates = self.z_s[:, 3:]
        square = np.maximum((rates**2).sum(axis=1), 1e-30)
        return np.asarray((self.displace(name)[:, 3:] * rates).sum(axis=1) / square)

    def change(self, name: str) -> tuple[Array, Array]:
        """Right-hand sides of the linear equations of the derivative by one parameter.

        Of the equations of motion, (n, 5, COUNT), and the constraints, (n, n_c + R, COUNT).
        """
        scene, load = self.formation.scene, np.zeros_like(self.acceleration)
        curvature = np.zeros_like(self.c)
        if name in ("mass", "inertia"):
            selected = np.array([1, 1, 0, 0, 0] if name == "mass" else [0, 0, 1, 0, 0])
            load -= (selected * scene.mass_diagonal)[:, None] * self.acceleration
            load[..., 0] += selected * scene.applied_force
        elif name.startswith("friction"):
            part = {"palm": None, "finger1": 0, "finger2": 1}[name.partition("_")[2]]
            flags = np.array([contact.finger == part for contact in self.formation.contacts])
            slip = flags * self.formation.sliding_friction * self.directions.Xi
            rows = -slip[..., None] * self.kinematics.A_t
            load += np.einsum("nij,niq->njq", rows, self.c[:, : rows.shape[1]])
        elif name.startswith("gain"):
            finger = int(name[-1]) - 1
            load[:, 3 + finger] = self.tau[:, finger]
        elif name == "start_x":
            return self._find_rhs("", *self.start_shift)
        elif name.startswith(("base", "length")):
            dz = self.displace(name)
            return self._find_rhs(name, dz, self.turn_tangent(name, dz))
        return load, curvature

    def displace(self, name: str) -> Array:
        """Derivative dz/dp of the nearest configuration by a base or a length, shape (n, 5)."""
        count, none = self.formation.n_contacts, np.zeros_like(self.z)
        gap = np.zeros(self.kinematics.P.shape[:2])
        gap[:, :count] = self._difference(name, none, none).C
        if self.formation.rolling and name.startswith("base"):
            axis = "xy".index(name[-1])
            gap[:, count:] = -(self._finger_rows(name) * self.kinematics.P[..., axis])[:, count:]
        return solve_min_norm(self.kinematics.P, -gap, metric_weights(self.formation.scene))

    def _difference(self, name: str, dz: Array, dz_s: Array) -> Kinematics:
        """Derivative of the kinematics by a length, with derivatives dz, dz_s, by differences."""
        step = 1e-5 * self.formation.scene.scales.length
        ends = [
            self._evaluate(name, change, self.z + change * dz, self.z_s + change * dz_s)
            for change in (-step, step)
        ]
        return Kinematics(*((b - a) / (2 * step) for a, b in zip(*ends, strict=True)))

    def turn_tangent(self, name: str, dz: Array) -> Array:
        """Derivative dz_s of the tangent, shape (n, 5)."""
        rate = np.einsum("nij,nj->ni", self._difference(name, dz, 0 * dz).P, self.z_s)
        return solve_min_norm(self.kinematics.P, -rate, metric_weights(self.formation.scene))

    def _find_rhs(self, name: str, dz: Array, dz_s: Array) -> tuple[Array, Array]:
        """Right-hand sides (as `change`) for derivatives dz, dz_s and a change of geometry."""
        slopes = self._difference(name, dz, dz_s)
        curvature = -np.einsum("nij,njq->niq", slopes.P, self.acceleration)
        curvature[..., B] -= slopes.P_dot_v
        dG = force_rows(self.formation, slopes, self.directions)
        load = np.einsum("nij,niq->njq", dG, self.c)
        load[..., V] -= self.formation.scene.viscous * dz_s
        return load, curvature

    def _finger_rows(self, name: str) -> Array:
        """Whether constraint rows belong to the finger of a parameter, shape (n_c + R,)."""
        finger = int(name.rstrip("_xy")[-1]) - 1
        contacts = (*self.formation.contacts, *self.formation.rolling)
        return np.array([contact.finger == finger for contact in contacts])

    def _evaluate(self, name: str, change: float, z: Array, v: Array) -> Kinematics:
        """Kinematics at configurations and tangents, with one length changed."""
        formation = self.formation
        if name.startswith("length"):
            formation = _lengthen(formation, int(name[-1]) - 1, change)
        kinematics = formation.evaluate(z, v)
        if not name.startswith("base"):
            return kinematics
        shift = np.zeros(5)
        shift["xy".index(name[-1])] = change
        shifted_back = formation.evaluate(z - shift, v)
        flags, count = self._finger_rows(name), formation.n_contacts

        def choose(fixed: Array, shifted: Array) -> Array:
            rows = flags[:count] if fixed.shape[1] == count else flags
            return np.where(rows.reshape(-1, *[1] * (fixed.ndim - 2)), shifted, fixed)

        return Kinematics(*map(choose, kinematics, shifted_back))


@lru_cache(maxsize=16)  # building the functions of a formation takes longer than evaluating them
def _lengthen(formation: Formation, finger: int, change: float) -> Formation:
    """The formation with a longer link; unchanged if its tip does not touch."""
    if not any(c.surface == "tip" and c.finger == finger for c in formation.contacts):
        return formation
    fingers = list(formation.scene.fingers)
    fingers[finger] = replace(fingers[finger], length=fingers[finger].length + change)
    return replace(formation, scene=replace(formation.scene, fingers=(fingers[0], fingers[1])))
