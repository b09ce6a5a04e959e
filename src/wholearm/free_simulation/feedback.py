"""Torques by feedback: sampled at even times, and each held until the next one takes effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array
from ..common.errors import SimulationError
from ..common.require import require_number
from ..results.torque import TorqueProfile

SAME = 1e-9
"""Distance of two instants that counts as none, relative to the period."""


@runtime_checkable
class Law(Protocol):
    """Torques as a function of what a controller measures."""

    @property
    def period(self) -> float:
        """Time between two samples [s]."""

    @property
    def delay(self) -> float:
        """Time after which a sample takes effect; the first one does at once [s]."""

    def held(
        self, t: float, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> ArrayLike:
        """The torques that follow from a state.

        Parameters
        ----------
        t : float, [s]
        theta, theta_dot : ndarray, shape (2,) [rad, rad/s]
        forces : mapping of str to float
            c_n of the contacts that press, by name, just before `t`; NaN at rest. Empty at the
            start [N].

        Returns
        -------
        array_like, shape (2,)
            [N m]
        """


class Feedback:
    """The torques of a law, known up to the present.

    Parameters
    ----------
    law : Law
    until : float, [s]

    Attributes
    ----------
    torque : TorqueProfile
        A constant for each piece; those that have not begun are zero.
    """

    def __init__(self, law: Law, until: float) -> None:
        self.law = law
        period = require_number(law.period, "period", positive=True)
        delay = require_number(law.delay, "delay", nonnegative=True)
        ticks = period * np.arange(int(np.ceil(until / period - SAME)))
        times = np.sort(np.concatenate([ticks, ticks[1:] + delay]))
        times = times[times < until - SAME * period]
        times = times[np.diff(times, prepend=-np.inf) > SAME * period]
        self._samples = np.zeros((len(ticks), 2))
        # Rounding must not put an instant before its own sample.
        self._latest = np.floor(times / period + SAME).astype(int)
        self._source = np.floor((times - delay) / period + SAME).astype(int).clip(0)
        self.torque = TorqueProfile(np.append(times, until), np.zeros((len(times), 2, 1)))

    def begin(
        self, piece: int, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> None:
        """Take a sample where one is due at the start of a piece, and set the piece's torques.

        Raises
        ------
        SimulationError
            If the law gives no two numbers.
        """
        latest = self._latest[piece]
        if piece == 0 or latest > self._latest[piece - 1]:
            t = float(self.torque.breaks[piece])
            tau = np.asarray(self.law.held(t, theta, theta_dot, forces), dtype=float)
            if tau.shape != (2,) or not np.isfinite(tau).all():
                given = f"{tau.tolist()} at t = {t:.6g} s; two finite numbers are needed"
                raise SimulationError(f"the law of the torques gives {given}")
            self._samples[latest] = tau
        self.torque.coefficients[piece, :, 0] = self._samples[self._source[piece]]
