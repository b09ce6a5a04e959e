"""A formation with two or more freedoms at rest: with which directions it could start to move.

Each choice of the directions in which contacts slide and joints turn makes the accelerations affine
in the torques. A choice is consistent if contacts and joints then accelerate in those directions,
every contact presses, and nothing that touches closes further.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..cones import hold_rows
from ..dynamics import Directions, force_rows, reduced_inertia
from ..formation import Formation, Kinematics
from ..model import Array
from .stepper import SLACK_FORCE

STILL = 1e-9
"""Acceleration, in the metric M5 or of a contact or joint, that counts as rounding."""
CLOSING = 1e-6
"""Acceleration of a gap that counts as rounding [m/s^2]: its gradient is a difference quotient."""
_STEP = 1e-5
"""Step of the difference quotient [m, rad]."""


@dataclass(frozen=True, eq=False)
class Departure:
    """The formation starts to move, or goes on, at `x` in [-1, 1] of a piece of the torques.

    Attributes
    ----------
    x : float
    heading : ndarray, shape (5,)
        Where to, of length one in the metric M5.
    directions : Directions
    """

    x: float
    heading: Array
    directions: Directions


class Way(Protocol):
    """One way in which a formation at rest could start to move."""

    @property
    def holds(self) -> Array:
        """What has to be positive for the contacts to hold, H c, is holds @ (1, tau_1, tau_2).

        Shape (n_c + 2 R, 3) [N]; the first n_c are the normal forces.
        """

    @property
    def ratio(self) -> float:
        """Reduced inertia over that without friction; jammed at zero and below."""

    @property
    def margins(self) -> list[tuple[Array, float]]:
        """Rows r and offsets d with r @ (1, tau_1, tau_2) + d >= 0 while it moves this way."""

    def drive(self, tau: Array) -> float:
        """How strongly it accelerates this way, in the metric M5."""

    def slides(self, tau: Array) -> bool:
        """Whether it accelerates this way, if every contact can press or pull."""

    def moves(self, tau: Array) -> bool:
        """Whether the formation starts to move this way under torques `tau`, shape (2,)."""

    def depart(self, x: float, tau: Array) -> Departure:
        """Start this way at `x` of a piece, where the torques are `tau`."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """A choice of directions; quantities at rest are rows @ (1, tau_1, tau_2).

    Attributes
    ----------
    directions : Directions
    mass : ndarray, shape (5,)
        Diagonal of M5.
    acceleration : ndarray, shape (5, 3)
        z''.
    holds : ndarray, shape (n_c + 2 R, 3), [N]
        What has to be positive for the contacts to hold, H c (`wholearm.cones`).
    slips : ndarray, shape (n_c + 2, 3)
        Accelerations of the contacts' sliding and of the joints, along `directions`.
    openings : ndarray, shape (k, 3), [m/s^2]
        Accelerations of the gaps of what touches but is not in the formation.
    ratio : float
    """

    directions: Directions
    mass: Array
    acceleration: Array
    holds: Array
    slips: Array
    openings: Array
    ratio: float

    @property
    def margins(self) -> list[tuple[Array, float]]:
        """Rows r and offsets d with r @ (1, tau_1, tau_2) + d >= 0 while it moves this way."""
        kinds = (self.slips, STILL), (self.openings, CLOSING), (self.holds, SLACK_FORCE)
        return [(row, slack) for rows, slack in kinds for row in rows]

    def drive(self, tau: Array) -> float:
        """How strongly it accelerates, in the metric M5."""
        acceleration = self.acceleration @ [1.0, *tau]
        return float(np.sqrt(self.mass @ acceleration**2))

    def find_held(self, tau: Array) -> NDArray[np.int64]:
        """Contacts and then joints that would have to accelerate against their direction."""
        return np.flatnonzero(self.slips @ [1.0, *tau] < -STILL)

    def slides(self, tau: Array) -> bool:
        """Whether contacts and joints accelerate in their directions and nothing closes."""
        load = [1.0, *tau]
        return (
            self.ratio > 0
            and self.drive(tau) > STILL
            and not len(self.find_held(tau))
            and bool((self.openings @ load >= -CLOSING).all())
        )

    def moves(self, tau: Array) -> bool:
        """Whether it slides this way and every contact presses."""
        return bool((self.holds @ [1.0, *tau] >= -SLACK_FORCE).all()) and self.slides(tau)

    def depart(self, x: float, tau: Array) -> Departure:
        """Start this way at `x` of a piece, where the torques are `tau`."""
        heading = self.acceleration @ [1.0, *tau] / self.drive(tau)
        return Departure(x, heading, self.directions)


def find_patterns(formation: Formation, z: Array, near: NDArray[np.bool_]) -> tuple[Pattern, ...]:
    """Every choice of directions at a configuration at rest; contacts that roll have none.

    Parameters
    ----------
    formation : Formation
    z : ndarray, shape (5,)
    near : ndarray of bool, shape (n_limits,)
        Which limits of the formation are zero at `z`.
    """
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    gradient = np.zeros((0, 5))
    if near.any():
        steps = _STEP * np.concatenate([np.eye(5), -np.eye(5)])
        values = formation.evaluate_limits(z + steps)[:, near]
        gradient = (values[:5] - values[5:]).T / (2 * _STEP)
    count = formation.n_contacts
    choices: list[tuple[float, ...]] = [(1.0, -1.0)] * (count + 2)
    for row in formation.rolling_rows:
        choices[row] = (0.0,)
    return tuple(
        _build_pattern(
            formation, Directions(np.array(s[:count]), np.array(s[count:])), kinematics, gradient
        )
        for s in product(*choices)
    )


def solve_at_rest(
    formation: Formation, directions: Directions, kinematics: Kinematics
) -> tuple[Array, Array, float]:
    """Accelerations (5, 3) and H c (n_c + 2 R, 3), affine in the torques, and the ratio."""
    scene, P = formation.scene, kinematics.P[0]
    G = force_rows(formation, kinematics, directions)[0]
    inverse_mass = 1 / scene.mass_diagonal
    applied = np.zeros((5, 3))
    applied[:, 0] = scene.applied_force
    applied[3:, 0] -= scene.dry[3:] * directions.sigma
    applied[3:, 1:] = np.eye(2)
    ratio = float(reduced_inertia(formation, kinematics, directions)[0])
    c = np.zeros((len(P), 3))
    if abs(ratio) > 1e-12:
        c = np.linalg.solve((P * inverse_mass) @ G.T, -(P * inverse_mass) @ applied)
    return inverse_mass[:, None] * (applied + G.T @ c), hold_rows(formation) @ c, ratio


def _build_pattern(
    formation: Formation, directions: Directions, kinematics: Kinematics, gradient: Array
) -> Pattern:
    acceleration, holds, ratio = solve_at_rest(formation, directions, kinematics)
    rates = np.concatenate([kinematics.A_t[0] @ acceleration, acceleration[3:]])
    signs = np.concatenate(directions)
    return Pattern(
        directions=directions,
        mass=formation.scene.mass_diagonal,
        acceleration=acceleration,
        holds=holds,
        slips=signs[:, None] * rates,
        openings=gradient @ acceleration,
        ratio=ratio,
    )
