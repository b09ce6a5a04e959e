"""How contact forces along a curve change with numbers that are off, at one state and torques.

With z, z' and tau given, the equations of motion (`mechanics.dynamics`)

    M5 z'' + b(z') = g + S tau + G^T c,    P z'' + P' z' = 0

are linear in z'' and c. Their derivative by a number p is linear in dz''/dp and dc/dp, with the
same matrices:

    M5 dz'' - G^T dc = dg + S dtau - db - dM5 z'' + dG^T c,    P dz'' = -dP z'' - d(P' z').

Along a curve z'' = z_s a + z_ss b, and c and tau are affine in a = s'', b = s'^2, the squeeze and
s'. So dc/dp is affine in them too.

Where geometry is off the curve is another one. Its place with the same s is the nearest one, and
so is its tangent: dz and dz_s are at right angles to z_s. Contacts of a finger depend on where the
object is from the finger's joint, so that a joint that moves is like an object that moves back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation, Kinematics
from ...geometry.curve import CurvePoint, border
from ...mechanics.dynamics import Directions, PathForces, force_rows
from ...mechanics.metric import metric_weights

COUNT = 5
"""Number of coefficients: of 1, a, b, the squeeze and s'."""
_STEP = 1e-5
"""Step of the differences of kinematics, over the scene's length."""


class _Change(NamedTuple):
    """The right sides of the derivative: of Newton's and Euler's laws, and of the constraints.

    Shapes (n, 5, COUNT) and (n, n_c + R, COUNT).
    """

    load: Array
    bend: Array


def find_force_slopes(
    formation: Formation,
    point: CurvePoint,
    directions: Directions,
    forces: PathForces,
    names: Sequence[str],
) -> Array:
    """Derivatives of the contact forces by some numbers, at n places of a curve.

    Parameters
    ----------
    formation : Formation
    point : CurvePoint
    directions : Directions
        One row for each place.
    forces : PathForces
        Of the formation there.
    names : sequence of str
        Of the numbers, as in `problem.uncertainty`: relative ones, or lengths in m. `start_x`
        is how far the object is along the curve. `delay` has no derivative.

    Returns
    -------
    ndarray, shape (n, n_c + R, len(names), COUNT)
        dc/dp = sum of coefficients times (1, a, b, squeeze, s') [N per unit of p].
    """
    state = _State.of(formation, point, directions, forces)
    count = len(point.z), len(names), COUNT
    load, bend = np.zeros((5, *count)), np.zeros((forces.C0.shape[1], *count))
    for k, name in enumerate(names):
        change = state.change(name)
        load[:, :, k], bend[:, :, k] = (part.transpose(1, 0, 2) for part in change)
    load, bend = (part.transpose(1, 0, 2, 3) for part in (load, bend))
    P, inverse_mass = point.kinematics.P, 1 / formation.scene.mass_diagonal
    K = (P * inverse_mass) @ state.G.transpose(0, 2, 1)
    right = bend - np.einsum("nij,njpq->nipq", P * inverse_mass, load)
    flat = np.linalg.solve(K, right.reshape(*right.shape[:2], -1))
    return np.asarray(flat.reshape(right.shape))


class _State(NamedTuple):
    """A formation at n places of a curve, with coefficients (..., COUNT) of its motion."""

    formation: Formation
    point: CurvePoint
    directions: Directions
    G: Array
    c: Array
    tau: Array
    acceleration: Array

    @staticmethod
    def of(
        formation: Formation, point: CurvePoint, directions: Directions, forces: PathForces
    ) -> _State:
        none = np.zeros_like(forces.C0)
        c = np.stack([forces.C0, forces.Ca, forces.Cb, forces.Cl, none], axis=-1)
        tau = np.stack([forces.T0, forces.Ta, forces.Tb, forces.Tl, forces.Tv], axis=-1)
        acceleration = np.zeros((*point.z.shape, COUNT))
        acceleration[..., 1], acceleration[..., 2] = point.z_s, point.z_ss
        G = force_rows(formation, point.kinematics, directions)
        return _State(formation, point, directions, G, c, tau, acceleration)

    def change(self, name: str) -> _Change:
        """What one number changes of the equations."""
        scene, load = self.formation.scene, np.zeros_like(self.acceleration)
        bend = np.zeros_like(self.c)
        if name in ("mass", "inertia"):
            own = np.array([1, 1, 0, 0, 0] if name == "mass" else [0, 0, 1, 0, 0])
            load -= (own * scene.mass_diagonal)[:, None] * self.acceleration
            load[..., 0] += own * scene.applied_force
        elif name.startswith("friction"):
            part = {"palm": None, "finger1": 0, "finger2": 1}[name.partition("_")[2]]
            mine = np.array([contact.finger == part for contact in self.formation.contacts])
            slip = mine * self.formation.sliding_friction * self.directions.Xi
            rows = -slip[..., None] * self.point.kinematics.A_t
            load += np.einsum("nij,niq->njq", rows, self.c[:, : rows.shape[1]])
        elif name.startswith("gain"):
            finger = int(name[-1]) - 1
            load[:, 3 + finger] = self.tau[:, finger]
        elif name == "start_x":
            metric = metric_weights(scene)[:3]
            size = np.sqrt(self.point.z_s[:, :3] ** 2 @ metric)[:, None]
            return self._move(self.point.z_s / size, self.point.z_ss / size)
        elif name.startswith(("base", "length")):
            return self._deform(name)
        return _Change(load, bend)

    def _deform(self, name: str) -> _Change:
        """What moving a joint, or a longer link, changes."""
        step = _STEP * self.formation.scene.scales.length
        z, z_s, _, kinematics = self.point
        here, there = (self._evaluate(name, way * step, z) for way in (-1, 1))
        gap = np.zeros(kinematics.P.shape[:2])
        gap[:, : self.formation.n_contacts] = (there.C - here.C) / (2 * step)
        if self.formation.rolling and name.startswith("base"):
            count, axis = self.formation.n_contacts, "xy".index(name[-1])
            rows = self._rows_of(name)[count:]
            gap[:, count:] = -(rows * kinematics.P[:, count:, axis])
        metric = metric_weights(self.formation.scene)
        matrix = border(kinematics.P, z_s * metric)
        dz = _solve(matrix, -gap)
        before, after = (self._evaluate(name, way * step, z + way * step * dz) for way in (-1, 1))
        turned = np.einsum("nij,nj->ni", (after.P - before.P) / (2 * step), z_s)
        return self._move(dz, _solve(matrix, -turned), name)

    def _move(self, dz: Array, dz_s: Array, name: str = "") -> _Change:
        """What another place and tangent change, with geometry that is off by as much."""
        step = _STEP * self.formation.scene.scales.length
        z, z_s = self.point[:2]
        ends = [self._evaluate(name, way * step, z + way * step * dz) for way in (-1, 1)]
        slopes = Kinematics(*((b - a) / (2 * step) for a, b in zip(*ends, strict=True)))
        # P' z' is a quadratic form of the velocity.
        turns = [self.formation.evaluate(z, z_s + way * dz_s).P_dot_v for way in (-1, 1)]
        bend = -np.einsum("nij,njq->niq", slopes.P, self.acceleration)
        bend[..., 2] -= slopes.P_dot_v + (turns[1] - turns[0]) / 2
        dG = force_rows(self.formation, slopes, self.directions)
        load = np.einsum("nij,niq->njq", dG, self.c)
        load[..., 4] -= self.formation.scene.viscous * dz_s
        return _Change(load, bend)

    def _rows_of(self, name: str) -> Array:
        """Which constraint rows are of the finger that a name ends in, shape (n_c + R,)."""
        finger = int(name.rstrip("_xy")[-1]) - 1
        contacts = (*self.formation.contacts, *self.formation.rolling)
        return np.array([contact.finger == finger for contact in contacts])

    def _evaluate(self, name: str, change: float, z: Array) -> Kinematics:
        """The formation at other places, with one length that is off."""
        formation, v = self.formation, self.point.z_s
        if name.startswith("length"):
            finger, fingers = int(name[-1]) - 1, list(formation.scene.fingers)
            if any(c.surface == "tip" and c.finger == finger for c in formation.contacts):
                longer = fingers[finger].length + change
                fingers[finger] = replace(fingers[finger], length=longer)
                scene = replace(formation.scene, fingers=(fingers[0], fingers[1]))
                formation = replace(formation, scene=scene)
        found = formation.evaluate(z, v)
        if not name.startswith("base"):
            return found
        back = np.zeros(5)
        back["xy".index(name[-1])] = change
        moved = formation.evaluate(z - back, v)
        mine, count = self._rows_of(name), formation.n_contacts

        def choose(one: Array, other: Array) -> Array:
            own = mine[:count] if one.shape[1] == count else mine
            return np.where(own.reshape(-1, *[1] * (one.ndim - 2)), other, one)

        return Kinematics(*map(choose, found, moved))


def _solve(matrix: Array, right: Array) -> Array:
    """Solve for a displacement at right angles to the tangent, shape (n, 5)."""
    whole = np.concatenate([right, np.zeros((len(right), 1))], axis=1)
    return np.asarray(np.linalg.solve(matrix, whole[..., None])[..., 0])
