"""Stages: parts of a motion in the time domain with one formation and fixed contact modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...mechanics.dynamics import Directions
from ...problem.definition import Until
from ..options import CLEARANCE, OPENING


class StagePoints(NamedTuple):
    """Motion and forces of a stage in K intervals with d points each."""

    duration: float  # [s]
    fractions: Array  # (K,): share of the duration that each interval has
    nodes: Array  # (K + 1, 2, 5): z and z' at the start of each interval and at the end of the last
    z: Array  # z, v, a (K, d, 5): z, z' and z'' at the collocation points
    v: Array
    a: Array
    forces: Array  # (K, d, n_c + R) [N]: c_n of all contacts, then c_t of the rolling ones
    tau: Array  # (K, m, 2) [N m]: control points of torques, of degree m - 1 in each interval
    impulses: Array  # (n_c + R,) [N s]: of the impact with which the stage ends, if it does

    @property
    def breaks(self) -> Array:
        """Start of each interval and end of the last, as shares of the duration, shape (K + 1,)."""
        breaks = np.append(0.0, np.cumsum(self.fractions))
        breaks[-1] = 1.0
        return breaks

    def places(self, points: Array) -> Array:
        """Shares of the duration passed at `points` of every interval, shape (K, n)."""
        return np.asarray(self.breaks[:-1, None] + self.fractions[:, None] * points)


@dataclass(frozen=True, eq=False)
class Stage:
    """A part of a motion with one formation and fixed directions of friction."""

    phase: int  # index of its phase
    formation: Formation
    directions: Directions
    guess: StagePoints  # initial guess; its intervals are those of the NLP
    until: Until | None = None  # reached at the end; None if it ends by a reversal or a release
    turns: tuple[int, ...] = ()  # rows of (contacts, joints) whose rate is zero at the end
    gained: Formation | None = None  # the next stage's, if a constraint of it is gained softly
    # contacts that the next stage releases, with 0, or lets slide, with their direction then
    fading: tuple[tuple[int, float], ...] = ()
    growing: tuple[int, ...] = ()  # contacts that the stage before does not have
    ends_in_impact: bool = False
    monitored: tuple[int, ...] = ()  # limits of the formation that are constraints at the points
    released: tuple[int, ...] = ()  # limits of the contacts released where the phase began
    opens: bool = False  # whether they are released at the start of this stage
    opening: float = OPENING  # least acceleration of their gaps, over gravity
    clearance: float = (
        CLEARANCE  # least gap after a third of the stage, over the radius of gyration
    )
    apart: tuple[
        int, ...
    ] = ()  # limits that are as clear at the end, as the next phase closes them
    # row of z, its value where the phase ends, and the side from which it comes there
    ahead: tuple[int, float, float] | None = None
    stop: Array | None = None  # (5,): the given end of the last stage
    periods: tuple[int, ...] = ()  # control period of each interval, if torques are held
    onset: float = (
        0.0  # rate of the friction homotopy, tanh(rate / onset), in the scene's unit; or 0
    )

    @property
    def intervals(self) -> int:
        """Number of intervals K."""
        return len(self.guess.fractions)

    def list_clearances(self, places: Array, after: float) -> Array:
        """Least values of monitored limits at `places`, shape (n,), of the stage: (n, n_monitored).

        From the share `after` of the stage on, but for contacts released before it. With continuous
        torques gaps open with the third power of time.
        """
        slow = self.formation.scene.has_slow_motors
        late = (np.minimum(places / after, 1.0) ** 3 if slow else places > after)[:, None]
        released, apart = (np.isin(self.monitored, own) for own in (self.released, self.apart))
        opened = np.where(self.opens, late, 1.0)
        return np.asarray(self.clearance * np.maximum(released * opened, apart * late))

    def measure_senses(self, z: Array, v: Array) -> Array:
        """Rates of contacts and joints in the stage's directions, shape (n, n_c + 2) [rad/s].

        Those of contacts are over the radius of gyration; z and v have the shape (n, 5).
        """
        slip = np.einsum("nij,nj->ni", self.formation.evaluate(z, v).A_t, v)
        rates = np.hstack([slip / self.formation.scene.polygon.gyration_radius, v[:, 3:]])
        return np.asarray(rates * np.concatenate(self.directions))
