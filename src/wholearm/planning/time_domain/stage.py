"""Stages: stretches of a motion in the time domain, on one formation with fixed friction."""

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
    # (K, m, 2) [N m]: control points of each interval: torques are polynomials of degree m - 1
    # there
    tau: Array
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
    """A stretch on one formation with fixed directions of friction."""

    phase: int  # index of the phase it belongs to
    formation: Formation
    directions: Directions
    guess: StagePoints  # where the search starts; its intervals are those of the NLP
    # what is reached at the end; None if the stage ends by a reversal or a release
    until: Until | None = None
    turns: tuple[int, ...] = ()  # rows of (contacts, joints) whose rate is zero at the end
    # the next stage's formation where that has a constraint more, which is gained softly
    gained: Formation | None = None
    # contacts that the next stage lets go, with 0, or lets slip, with their direction then
    fading: tuple[tuple[int, float], ...] = ()
    growing: tuple[int, ...] = ()  # contacts that the stage before does not have
    ends_in_impact: bool = False  # whether an impact leads to the next stage
    monitored: tuple[int, ...] = ()  # limits of the formation that are kept positive at every point
    released: tuple[int, ...] = ()  # limits of the contacts that were let go where the phase began
    opens: bool = False  # whether they are let go at the start of this stage
    # least acceleration with which the gaps of contacts that are let go open, over gravity
    opening: float = OPENING
    # what these gaps are at least after a third of the first stage, over the radius of gyration
    clearance: float = CLEARANCE
    # monitored limits that are as clear at the end: what comes next ends by closing them
    apart: tuple[int, ...] = ()
    # row of z, the value that it has where the phase ends, and from which side it comes there:
    # reached before, that would be the end
    ahead: tuple[int, float, float] | None = None
    # (5,): where the last stage ends, if that is given: with two freedoms its end leaves one open
    stop: Array | None = None
    # the control period of its phase that each interval is part of, if torques are held
    periods: tuple[int, ...] = ()
    # rate of contacts and joints, in the scene's unit, at which three quarters of their friction
    # has set in, against whatever way they move; nothing if friction has the given directions
    onset: float = 0.0

    @property
    def intervals(self) -> int:
        """Number of intervals K."""
        return len(self.guess.fractions)

    def list_clearances(self, places: Array, after: float) -> Array:
        """Least values of monitored limits at `places`, shape (n,), of the stage: (n, n_monitored).

        From the share `after` of the stage on, but for contacts that were let go before it. Where
        torques go on, so do accelerations, and gaps open with the third power of time.
        """
        slow = self.formation.scene.has_slow_motors
        late = (np.minimum(places / after, 1.0) ** 3 if slow else places > after)[:, None]
        released, apart = (np.isin(self.monitored, own) for own in (self.released, self.apart))
        opened = np.where(self.opens, late, 1.0)
        return np.asarray(self.clearance * np.maximum(released * opened, apart * late))

    def measure_senses(self, z: Array, v: Array) -> Array:
        """Rates of contacts and joints in the stage's directions, shape (n, n_c + 2) [rad/s].

        Those of contacts are over the radius of gyration; what moves against its direction has a
        negative one.

        Parameters
        ----------
        z, v : (n, 5)  configurations and velocities
        """
        slip = np.einsum("nij,nj->ni", self.formation.evaluate(z, v).A_t, v)
        rates = np.hstack([slip / self.formation.scene.polygon.gyration_radius, v[:, 3:]])
        return np.asarray(rates * np.concatenate(self.directions))
