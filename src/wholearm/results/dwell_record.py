"""Dwell at the ends of phases: constant torques that close contacts and hold at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from .torque import TorqueProfile
from .torque_change import TorqueChange
from .trajectory import Motion, Samples


class Settling(NamedTuple):
    """How the end of a phase is held."""

    phase: int  # its number
    duration: float  # [s]: zero where no torques hold it
    tau: tuple[float, float]  # [N m]
    # the least margin of balance, normal forces and accelerations, over what is ample
    margin: float
    contact: str = ""  # what closes if it is still open; empty if nothing is gained there
    gap: float = 0.0  # [m]: from which on that was simulated
    # [s]: from when on everything was closed then, but for a hundredth of the gap; None if it was
    # not
    closes: float | None = None
    left: float = 0.0  # [m]: largest gap at the end
    # [m/s]: at most, with which the contact is reached, if all others stay closed till then; else
    # zero
    speed: float = 0.0
    # contacts that would have to pull in the impact of that, and part for a moment
    parts: tuple[str, ...] = ()
    warning: str = ""  # what the torques do not do; empty if nothing


@dataclass(frozen=True, eq=False)
class SettledMotion:
    """A phase whose end is held at rest by constant torques; contact forces are not known there."""

    motion: Motion
    held: float  # [s]: how long, with the time in which torques change into these
    tau: Array  # (2,) [N m]
    # where torques may not step, how they change from those of the motion's end
    change: TorqueChange | None = None

    @property
    def ramp(self) -> float:
        """The time in which torques change [s]."""
        return self.change.duration if self.change else 0.0

    @property
    def duration(self) -> float:
        """How long the phase lasts, its end included [s]."""
        return self.motion.duration + self.held

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.motion.contacts

    @property
    def torque(self) -> TorqueProfile:
        """The torques of the end alone, from 0 on."""
        steady = np.array([0.0, self.held - self.ramp])
        hold = TorqueProfile(steady, self.tau[None, :, None])
        if self.change is None or not self.ramp:
            return hold
        return TorqueProfile.chain([self.change.torque, hold])

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        moves = np.minimum(t, self.motion.duration)
        held = np.asarray(t > self.motion.duration)
        return _stop(self.motion.evaluate(moves), held, self._hold(t))

    def sample(self, count: int) -> tuple[Array, Samples]:
        """`count` even rows of the motion, and the two ends of the time in which it is held.

        Between them where the torques are those that hold it, if that takes a while.
        """
        end = self.motion.duration
        inner = [end + self.ramp] if self.ramp else []
        t = np.append(np.linspace(0.0, end, count), [end, *inner, self.duration])
        samples = self.motion.evaluate(np.minimum(t, end))
        return t, _stop(samples, np.asarray(np.arange(len(t)) >= count), self._hold(t))

    def _hold(self, t: Array) -> Array:
        """Torques at times from the start of the phase on, as if it were held then."""
        if not self.ramp:
            return self.tau
        return self.torque.at(np.clip(t - self.motion.duration, 0.0, self.held))


def _stop(samples: Samples, held: NDArray[np.bool_], tau: Array) -> Samples:
    """The samples with those at rest that are held."""
    rows = held[:, None]
    z_dot, z_ddot = (np.where(rows, 0.0, part) for part in (samples.z_dot, samples.z_ddot))
    forces = (np.where(rows, np.nan, part) for part in (samples.c_n, samples.c_t))
    return Samples(samples.z, z_dot, z_ddot, np.where(rows, tau, samples.tau), *forces)
