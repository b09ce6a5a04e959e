"""The curve or path along which a phase is looked at, with forces at many places.

A phase with one freedom runs along its curve. With two freedoms it is looked at along the straight
line in (x, phi) to the nearest end: the planner may go another way. Of a phase that ends by a
release, where the planner chooses, the first part of the curve is looked at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation, Kinematics
from ..geometry.curve import Curve
from ..geometry.path_guess import RELEASE_AT, count_freedoms, guess_phase
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import Directions, PathForces, force_rows, inverse, reduced_inertia
from ..mechanics.metric import metric_weights
from ..problem.definition import Phase
from .squeeze import Squeezing

PLACES = 241
"""About how many places of a phase are looked at."""
_NEWTON = 20
"""Most steps that close contacts."""
_CLOSED = 1e-11
"""Step that counts as none, in radii of gyration or radians."""


@dataclass(frozen=True, eq=False)
class Road:
    """Places along a phase, and what limits are of there.

    Attributes
    ----------
    phase : Phase
    curve : Curve or None
        None along a straight line.
    s : ndarray, shape (n,), [m]
        Arc lengths in the metric of curves; where a direction reverses a place is there twice.
    z, z_s, z_ss : ndarray, shape (n, 5)
    directions : Directions
        One row for each place.
    forces : PathForces
    squeezing : Squeezing
    kinematics : Kinematics
        Of the formation, for the velocity z_s.
    inertia : ndarray, shape (n,)
        Reduced inertia over that without friction: motions jam at zero and below.
    """

    phase: Phase
    curve: Curve | None
    s: Array
    z: Array
    z_s: Array
    z_ss: Array
    directions: Directions
    forces: PathForces
    squeezing: Squeezing
    kinematics: Kinematics
    inertia: Array

    @property
    def length(self) -> float:
        """Length of the phase [m]."""
        return float(self.s[-1])

    def press_under(self, tau: Array, speed: float) -> Array:
        """Contact forces [c_n; c_t(rolling)] under torques `tau`, (n, 2), at a speed, (n, n_c + R).

        Whatever acceleration these give: K c = -P' z' - P M5^-1 (g + S tau - b).
        """
        scene = self.phase.formation.scene
        at, inverse_mass = self.kinematics, 1 / scene.mass_diagonal
        G = force_rows(self.phase.formation, at, self.directions)
        load = scene.applied_force - speed * scene.viscous * self.z_s
        load[:, 3:] += tau - scene.dry[3:] * self.directions.sigma
        drop = at.P * inverse_mass
        right = -(speed**2) * at.P_dot_v - np.einsum("nij,nj->ni", drop, load)
        return np.asarray(np.linalg.solve(drop @ G.transpose(0, 2, 1), right[..., None])[..., 0])


def make_road(phase: Phase, z: Array, later: Sequence[Phase]) -> Road | None:
    """The places of a phase that starts at `z`, shape (5,); None with other than 1 or 2 freedoms.

    Raises
    ------
    InputError
        If the contacts do not touch at `z`, or the end cannot be reached.
    """
    formation = phase.formation
    if formation.n_constraints == 4 and count_freedoms(formation, z) == 1:
        curve = trace_phase(phase, z, later)
        if phase.until.is_release:
            curve = replace(curve, length=RELEASE_AT * curve.length)
        s, signs = _spread(curve)
        point = curve.evaluate(s)
        directions = Directions(signs[:, :-2], signs[:, -2:])
        return _measure(phase, curve, s, point[:3], point.kinematics, directions)
    if formation.n_constraints != 3 or count_freedoms(formation, z) != 2:
        return None
    goal = guess_phase(phase, z, later)[-1].z[-1]
    s, *line, kinematics = _straighten(formation, z, goal)
    slip = np.einsum("nij,nj->ni", kinematics.A_t, line[1])
    directions = Directions(np.sign(slip), np.sign(line[1][:, 3:]))
    return _measure(phase, None, s, line, kinematics, directions)


def _spread(curve: Curve) -> tuple[Array, Array]:
    """Places along a curve, both ends of each segment, and directions of contacts and joints."""
    places, signs = [], []
    for part in curve.segments:
        count = max(5, round(PLACES * (part.stop - part.start) / curve.length))
        # Denser at the ends, where motions start and stop.
        turn = (1 - np.cos(np.linspace(0.0, np.pi, count))) / 2
        places.append(part.start + turn * (part.stop - part.start))
        signs.append(np.tile(np.concatenate([part.Xi, part.sigma]), (count, 1)))
    return np.concatenate(places), np.vstack(signs)


def _measure(
    phase: Phase,
    curve: Curve | None,
    s: Array,
    line: Sequence[Array],
    kinematics: Kinematics,
    directions: Directions,
) -> Road:
    z, z_s, z_ss = line
    forces = inverse(phase.formation, z, z_s, z_ss, directions, kinematics)
    squeezing = Squeezing.of(phase.formation, forces, z_s[:, 3:])
    inertia = reduced_inertia(phase.formation, kinematics, directions)
    return Road(phase, curve, s, z, z_s, z_ss, directions, forces, squeezing, kinematics, inertia)


def _straighten(
    formation: Formation, start: Array, goal: Array
) -> tuple[Array, Array, Array, Array, Kinematics]:
    """Arc lengths, z, z_s and z_ss along a straight line in (x, phi), and the formation there."""
    u = (1 - np.cos(np.linspace(0.0, np.pi, PLACES))) / 2
    way = goal - start
    z, slip = start + u[:, None] * way, formation.evaluate_slip(start[None])[0]
    pose = np.zeros((PLACES, 2, 5))
    pose[:, [0, 1], [0, 2]] = 1.0
    wanted, metric = z[:, [0, 2]].copy(), metric_weights(formation.scene)
    none, rows = np.zeros_like(z), formation.n_constraints
    for _ in range(_NEWTON):
        at = formation.evaluate(z, none)
        off = np.hstack([at.C, formation.evaluate_slip(z) - slip, z[:, [0, 2]] - wanted])
        change = np.linalg.solve(np.concatenate([at.P, pose], axis=1), off[..., None])[..., 0]
        z = z - change
        if np.abs(change * np.sqrt(metric)).max() < _CLOSED * formation.scene.scales.length:
            break
    matrix = np.concatenate([formation.evaluate(z, none).P, pose], axis=1)
    right = np.zeros((PLACES, 5, 1))
    right[:, rows:, 0] = way[[0, 2]]
    z_u = np.linalg.solve(matrix, right)[..., 0]
    at = formation.evaluate(z, z_u)
    right = np.zeros((PLACES, 5, 1))
    right[:, :rows, 0] = -at.P_dot_v
    z_uu = np.linalg.solve(matrix, right)[..., 0]
    speed = np.sqrt(z_u**2 @ metric)[:, None]
    bend = ((z_u * z_uu) @ metric)[:, None] / speed**2
    steps = np.diff(u) * (speed[1:, 0] + speed[:-1, 0]) / 2
    s = np.concatenate([[0.0], np.cumsum(steps)])
    return s, z, z_u / speed, (z_uu - bend * z_u) / speed**2, formation.evaluate(z, z_u / speed)
