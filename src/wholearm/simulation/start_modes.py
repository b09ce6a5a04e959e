"""Start modes of a formation at rest: friction signs and sticking, with affine accelerations.

With one freedom these are both directions along it. With more, each choice of signs of sliding and
turning, and of what sticks, makes the accelerations affine in the torques. It is consistent if
contacts and joints accelerate with those signs, friction can hold the others, every contact presses
and nothing that touches closes further. Choices without sticking are tried first.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation, Kinematics
from ..mechanics.dynamics import Directions
from .modes import Mode, ModeRows, Response, find_grips, list_units, respond, share_mode
from .tolerances import ROUNDING_FORCE, Tolerances, find_tolerances, measure_units

_STEP = 3e-5  # step of the difference quotient, in units of the scene
_KINK = 1e-2  # rise of a limit both ways, over the step, from which it has a kink and no gradient
_GRAZE = 1e-3  # largest closing acceleration of a gap that grazes, over sliding and turning


class StartDeparture(NamedTuple):
    """The formation starts to move, or goes on, at `x` in [-1, 1] of a piece of the torques."""

    x: float
    heading: Array  # (5,): where to, of length one in the metric M5
    directions: Directions


class RestDirection(NamedTuple):
    """Start mode with one freedom."""

    heading: Array  # (5,): direction, of length one in the metric M5
    directions: Directions  # the friction that opposes it
    acceleration: Array  # (3,): acceleration along `heading` is acceleration @ (1, tau_1, tau_2)
    # (n_c + 2 R, 3): likewise what has to be positive for the contacts to hold, H c [N]
    # (`contacts.cones`)
    force_limits: Array
    ratio: float  # reduced inertia over that without friction; jammed at zero and below
    closes: bool  # whether it would push features that touch already into one another
    tolerances: Tolerances

    @property
    def margins(self) -> list[tuple[Array, float]]:
        """Rows r and offsets d with r @ (1, tau_1, tau_2) + d >= 0 where it is consistent."""
        rounding = self.tolerances
        force_limits = [(row, rounding.force) for row in self.force_limits]
        return [(self.acceleration, -rounding.drive), *force_limits]

    def drive(self, tau: Array) -> float:
        """Acceleration along `heading`, in the metric M5."""
        return float(self.acceleration @ [1.0, *tau])

    def slides(self, tau: Array) -> bool:
        """Whether it accelerates along `heading`, if every contact can press or pull."""
        return self.drive(tau) > self.tolerances.drive and not self.closes

    def moves(self, tau: Array) -> bool:
        """Whether the formation starts in this mode under torques `tau`, shape (2,)."""
        keeps = float((self.force_limits @ [1.0, *tau]).min()) >= -self.tolerances.force
        return self.ratio > 0 and keeps and self.slides(tau)

    def depart(self, x: float, tau: Array) -> StartDeparture:
        """Start at `x` of a piece, whatever the torques."""
        return StartDeparture(x, self.heading, self.directions)


class Slack(NamedTuple):
    """Rounding of the rows of the same names of a `ModeChoice`."""

    drive: float
    slips: Array
    grips: Array
    force_limits: Array
    openings: Array


class Touching:
    """Limits `near` zero at `z` of what touches outside the formation, with gradient (k, 5).

    A pointed tip at a vertex has a kink instead.
    """

    def __init__(self, formation: Formation, z: Array, near: NDArray[np.bool_]) -> None:
        self.formation, self.z = formation, z
        self.units = measure_units(formation.scene)[:5]
        self.gradient, self.kinked = np.zeros((0, 5)), np.zeros(0, dtype=np.int64)
        if not near.any():
            return
        ahead = _STEP * self.units
        values = formation.evaluate_limits(z + np.vstack([np.diag(ahead), -np.diag(ahead)]))
        values = (values - formation.evaluate_limits(z[None]))[:, near]
        rises = (values[:5] + values[5:]).max(axis=0)
        kinked = rises > _KINK * _STEP * formation.scene.scales.length
        self.kinked = np.flatnonzero(near)[kinked]
        self.gradient = (values[:5] - values[5:])[:, ~kinked].T / (2 * ahead)

    def opens(self, acceleration: Array) -> bool:
        """Whether what has a kink does not close along an acceleration, shape (5,)."""
        if not len(self.kinked):
            return True
        step = _STEP / np.abs(acceleration / self.units).max()
        places = self.z + np.array([[0.0], [step]]) * acceleration
        here, ahead = self.formation.evaluate_limits(places)[:, self.kinked]
        closing = _GRAZE * _STEP * self.formation.scene.scales.length
        return bool((ahead - here >= -closing).all())


class ModeChoice(NamedTuple):
    """Start mode with more freedoms; quantities at rest are rows @ (1, tau_1, tau_2)."""

    directions: Directions  # zero for what friction holds
    mass: Array  # (5,): diagonal of M5
    acceleration: Array  # (5, 3): z''
    # (n_c + 2 R, 3) [N]: what has to be positive for the contacts to hold, H c (`contacts.cones`)
    force_limits: Array
    # (n_c + 2, 3): accelerations of the contacts' sliding and of the joints, along `directions`
    slips: Array
    # (2 k, 3) [N, N m]: what has to be positive for friction to hold what has no direction
    grips: Array
    # (k, 3) [m/s^2]: accelerations of the gaps of what touches but is not in the formation, plus
    # what counts as grazing
    openings: Array
    ratio: float
    slack: Slack
    touching: Touching

    @property
    def margins(self) -> list[tuple[Array, float]]:
        """As of `RestDirection`."""
        kinds = ("slips", "openings", "force_limits", "grips")
        pairs = [(getattr(self, kind), getattr(self.slack, kind)) for kind in kinds]
        return [(row, float(offset)) for pair in pairs for row, offset in zip(*pair, strict=True)]

    def drive(self, tau: Array) -> float:
        """Acceleration in the metric M5."""
        acceleration = self.acceleration @ [1.0, *tau]
        return float(np.sqrt(self.mass @ acceleration**2))

    def slides(self, tau: Array) -> bool:
        """Whether contacts and joints accelerate with their signs and nothing closes."""
        load, slack = [1.0, *tau], self.slack
        return (
            self.ratio > 0
            and self.drive(tau) > slack.drive
            and bool((self.slips @ load >= -slack.slips).all())
            and bool((self.grips @ load >= -slack.grips).all())
            and bool((self.openings @ load >= -slack.openings).all())
            and self.touching.opens(self.acceleration @ load)
        )

    def moves(self, tau: Array) -> bool:
        """Whether it slides and every contact presses."""
        presses = (self.force_limits @ [1.0, *tau] >= -self.slack.force_limits).all()
        return bool(presses) and self.slides(tau)

    def depart(self, x: float, tau: Array) -> StartDeparture:
        """Start at `x` of a piece, where the torques are `tau`."""
        heading = self.acceleration @ [1.0, *tau] / self.drive(tau)
        return StartDeparture(x, heading, self.directions)


StartMode = RestDirection | ModeChoice


def find_patterns(
    formation: Formation, z: Array, near: NDArray[np.bool_], held: bool
) -> Iterator[ModeChoice]:
    """Yield every start mode at `z`, (5,), where limits `near`, (n_limits,), are zero.

    `held`: only those with sticking, the least first, or else the others.
    """
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    touching = Touching(formation, z, near)
    units = list_units(formation)
    choices = [(1.0, -1.0, 0.0) if held and unit.grips else (1.0, -1.0) for unit in units]
    for options in sorted(product(*choices), key=lambda options: options.count(0.0)):
        count = options.count(0.0)
        if (count > 0) != held or formation.n_constraints + count > 4:
            continue
        signs = np.zeros(formation.n_contacts + 2)
        for unit, sign in zip(units, options, strict=True):
            signs[list(unit.rows)] = sign
        mode = share_mode(formation, find_grips(formation, signs))
        pattern = _build_pattern(mode, signs, kinematics, touching)
        if pattern is not None:
            yield pattern


def respond_at_rest(mode: Mode, signs: Array, kinematics: Kinematics) -> Response | None:
    """Accelerations and forces of a mode at rest; None if its forces are not determined."""
    none = np.zeros(mode.formation.n_contacts)
    rows = ModeRows(kinematics.A[0], kinematics.A_t[0], none, none)
    return respond(mode, signs, rows, np.zeros(5))


def _build_pattern(
    mode: Mode, signs: Array, kinematics: Kinematics, touching: Touching
) -> ModeChoice | None:
    formation, count = mode.formation, mode.formation.n_contacts
    response = respond_at_rest(mode, signs, kinematics)
    if response is None:
        return None
    declared = np.array([mode.declares(k) for k in range(len(mode.holders))] * 2, dtype=bool)
    cones, cone_units = response.force_limits[count:], mode.force_limit_units[count:]
    tolerances, length = find_tolerances(formation.scene), formation.scene.scales.length
    slips = signs[:, None] * response.rates
    graze = _GRAZE * np.repeat([1.0, length], [count, 2]) @ slips
    units = np.concatenate([mode.force_limit_units[:count], cone_units[declared]])
    slack = Slack(
        drive=tolerances.drive,
        slips=np.repeat([tolerances.still, tolerances.still_joint], [count, 2]),
        grips=ROUNDING_FORCE * cone_units[~declared],
        force_limits=ROUNDING_FORCE * units,
        openings=np.full(len(touching.gradient), tolerances.closing),
    )
    return ModeChoice(
        directions=Directions(signs[:count], signs[count:]),
        mass=formation.scene.mass_diagonal,
        acceleration=response.acceleration,
        force_limits=np.vstack([response.force_limits[:count], cones[declared]]),
        slips=slips,
        grips=cones[~declared],
        openings=touching.gradient @ response.acceleration + graze,
        ratio=response.ratio,
        slack=slack,
        touching=touching,
    )
