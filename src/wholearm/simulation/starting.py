"""A formation with two or more freedoms at rest: with which directions it could start to move.

Each choice of the directions in which contacts slide and joints turn, and of what sticks and is
held, makes the accelerations affine in the torques. A choice is consistent if contacts and joints
then accelerate in those directions, friction can hold the others, every contact presses, and
nothing that touches closes further. Choices in which nothing is held are tried first.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..dynamics import Directions
from ..formation import Formation, Kinematics
from ..model import Array
from .modes import Mode, Response, Rows, find_grips, list_units, respond
from .tolerances import ROUNDING_FORCE, find_tolerances, measure_units

_STEP = 3e-5
"""Step of the difference quotient, in units of the scene."""


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


class Slack(NamedTuple):
    """What counts as rounding in the rows of a pattern of the same names."""

    drive: float
    slips: Array
    grips: Array
    holds: Array
    openings: Array


@dataclass(frozen=True, eq=False)
class Pattern:
    """A choice of directions; quantities at rest are rows @ (1, tau_1, tau_2).

    Attributes
    ----------
    directions : Directions
        Zero for what friction holds.
    mass : ndarray, shape (5,)
        Diagonal of M5.
    acceleration : ndarray, shape (5, 3)
        z''.
    holds : ndarray, shape (n_c + 2 R, 3), [N]
        What has to be positive for the contacts to hold, H c (`wholearm.cones`).
    slips : ndarray, shape (n_c + 2, 3)
        Accelerations of the contacts' sliding and of the joints, along `directions`.
    grips : ndarray, shape (2 k, 3), [N, N m]
        What has to be positive for friction to hold what has no direction.
    openings : ndarray, shape (k, 3), [m/s^2]
        Accelerations of the gaps of what touches but is not in the formation.
    ratio : float
    slack : Slack
    """

    directions: Directions
    mass: Array
    acceleration: Array
    holds: Array
    slips: Array
    grips: Array
    openings: Array
    ratio: float
    slack: Slack

    @property
    def margins(self) -> list[tuple[Array, float]]:
        """Rows r and offsets d with r @ (1, tau_1, tau_2) + d >= 0 while it moves this way."""
        kinds = (
            (self.slips, self.slack.slips),
            (self.openings, self.slack.openings),
            (self.holds, self.slack.holds),
            (self.grips, self.slack.grips),
        )
        pairs = (pair for kind in kinds for pair in zip(*kind, strict=True))
        return [(row, float(offset)) for row, offset in pairs]

    def drive(self, tau: Array) -> float:
        """How strongly it accelerates, in the metric M5."""
        acceleration = self.acceleration @ [1.0, *tau]
        return float(np.sqrt(self.mass @ acceleration**2))

    def slides(self, tau: Array) -> bool:
        """Whether contacts and joints accelerate in their directions and nothing closes."""
        load, slack = [1.0, *tau], self.slack
        return (
            self.ratio > 0
            and self.drive(tau) > slack.drive
            and bool((self.slips @ load >= -slack.slips).all())
            and bool((self.grips @ load >= -slack.grips).all())
            and bool((self.openings @ load >= -slack.openings).all())
        )

    def moves(self, tau: Array) -> bool:
        """Whether it slides this way and every contact presses."""
        return bool((self.holds @ [1.0, *tau] >= -self.slack.holds).all()) and self.slides(tau)

    def depart(self, x: float, tau: Array) -> Departure:
        """Start this way at `x` of a piece, where the torques are `tau`."""
        heading = self.acceleration @ [1.0, *tau] / self.drive(tau)
        return Departure(x, heading, self.directions)


def find_patterns(
    formation: Formation, z: Array, near: NDArray[np.bool_], held: bool
) -> tuple[Pattern, ...]:
    """Every choice of directions at a configuration at rest; contacts that roll have none.

    Parameters
    ----------
    formation : Formation
    z : ndarray, shape (5,)
    near : ndarray of bool, shape (n_limits,)
        Which limits of the formation are zero at `z`.
    held : bool
        Whether to return those in which friction holds something, the least first, or the others.
    """
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    gradient = np.zeros((0, 5))
    if near.any():
        ahead = _STEP * measure_units(formation.scene)[:5]
        steps = np.concatenate([np.diag(ahead), -np.diag(ahead)])
        values = formation.evaluate_limits(z + steps)[:, near]
        gradient = (values[:5] - values[5:]).T / (2 * ahead)
    units = list_units(formation)
    choices = [(1.0, -1.0, 0.0) if held and unit.grips else (1.0, -1.0) for unit in units]
    patterns = []
    for options in sorted(product(*choices), key=lambda options: options.count(0.0)):
        count = options.count(0.0)
        if (count > 0) != held or formation.n_constraints + count > 4:
            continue
        signs = np.zeros(formation.n_contacts + 2)
        for unit, sign in zip(units, options, strict=True):
            signs[list(unit.rows)] = sign
        pattern = _build_pattern(formation, signs, kinematics, gradient)
        if pattern is not None:
            patterns.append(pattern)
    return tuple(patterns)


def respond_at_rest(mode: Mode, signs: Array, kinematics: Kinematics) -> Response | None:
    """How a mode at rest answers to torques; None if its forces are not determined."""
    none = np.zeros(mode.formation.n_contacts)
    rows = Rows(kinematics.A[0], kinematics.A_t[0], none, none)
    return respond(mode, signs, rows, np.zeros(5))


def _build_pattern(
    formation: Formation, signs: Array, kinematics: Kinematics, gradient: Array
) -> Pattern | None:
    mode, count = Mode(formation, find_grips(formation, signs)), formation.n_contacts
    response = respond_at_rest(mode, signs, kinematics)
    if response is None:
        return None
    declared = np.array([mode.declares(k) for k in range(len(mode.holders))] * 2, dtype=bool)
    cones, cone_units = response.holds[count:], mode.hold_units[count:]
    tolerances = find_tolerances(formation.scene)
    units = np.concatenate([mode.hold_units[:count], cone_units[declared]])
    slack = Slack(
        drive=tolerances.drive,
        slips=np.repeat([tolerances.still, tolerances.still_joint], [count, 2]),
        grips=ROUNDING_FORCE * cone_units[~declared],
        holds=ROUNDING_FORCE * units,
        openings=np.full(len(gradient), tolerances.closing),
    )
    return Pattern(
        directions=Directions(signs[:count], signs[count:]),
        mass=formation.scene.mass_diagonal,
        acceleration=response.acceleration,
        holds=np.vstack([response.holds[:count], cones[declared]]),
        slips=signs[:, None] * response.rates,
        grips=cones[~declared],
        openings=gradient @ response.acceleration,
        ratio=response.ratio,
        slack=slack,
    )
