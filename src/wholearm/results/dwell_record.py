"""Dwell at the ends of phases: constant torques that close contacts and hold at rest.

Between a motion and its dwell torques change at rest, in the least time that rate limits and lags
of motors allow, along a straight line, tau = tau_0 + sigma (tau_1 - tau_0). Motor j has the largest
rate R and the lag T. Its torque x, counted in the direction of the change d, and its command
x + T x' within the limit L require

    sigma' <= R / d,    sigma' <= (L - x_0 - sigma d) / (T d),

so sigma' is the minimum of straight lines in sigma: sigma is piecewise linear or exponential.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, Flags, sort_unique
from ..scene.model import Scene
from .torque import TorqueProfile
from .trajectory import ModeSpan, Motion, Samples, Trajectory


@dataclass(frozen=True, eq=False)
class TorqueChange:
    """Change of torques in least time."""

    before: Array  # (2,) [N m]
    after: Array  # (2,) [N m]
    times: Array  # (n + 1,) [s]: from 0 on
    sigma: Array  # (n + 1,): sigma at these times
    rates: Array  # (n,) [1/s]: its rate of change just after them
    decays: Array  # (n,) [1/s]: decay rates of this rate

    @property
    def duration(self) -> float:
        """Duration of the change [s]; 0 if torques do not change."""
        return float(self.times[-1])

    def fraction(self, t: Array) -> Array:
        """Fraction sigma of the change at some times."""
        t = np.clip(t, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.rates) - 1)
        elapsed, decay = t - self.times[k], self.decays[k]
        decayed = -np.expm1(-decay * elapsed) / np.where(decay > 0, decay, 1.0)
        return np.asarray(self.sigma[k] + self.rates[k] * np.where(decay > 0, decayed, elapsed))

    @property
    def torque(self) -> TorqueProfile:
        """The torques while they change."""
        decaying, durations = self.decays.max() > 0, np.diff(self.times)
        counts = [max(math.ceil(n), 1) for n in (durations * self.decays.max()).tolist()]
        spans = zip(self.times[:-1], self.times[1:], counts, strict=True)
        breaks = np.concatenate([np.linspace(a, b, n + 1)[:-1] for a, b, n in spans])
        breaks, change = np.append(breaks, self.duration), self.after - self.before
        # Pieces are not longer than the shortest lag.
        return TorqueProfile.fit(
            breaks, lambda t: self.before + self.fraction(t)[:, None] * change, 6 if decaying else 1
        )


def change_torques(scene: Scene, before: Array, after: Array) -> TorqueChange:
    """Change between torques of shape (2,) [N m] in least time."""
    sigma, spans, rates, decays = _divide(scene, before, after)
    nonempty = spans > 0
    times = np.append(0.0, np.cumsum(spans[nonempty]))
    sigma = np.append(sigma[:-1][nonempty], sigma[-1])
    return TorqueChange(before, after, times, sigma, rates[nonempty], decays[nonempty])


def find_change_times(scene: Scene, before: Array, after: Array) -> Array:
    """Least durations (...) [s] of changes between torques of shape (..., 2) [N m]."""
    return np.asarray(_divide(scene, before, after)[1].sum(axis=-1))


def _divide(scene: Scene, before: Array, after: Array) -> tuple[Array, Array, Array, Array]:
    """Pieces of the change in least time: sigma at their ends, durations, rates and decay rates."""
    limit, lags = scene.torque_limit, np.flatnonzero(scene.actuator_lag)
    step = np.abs(after - before)
    # Steps below a millionth of the limit need no time.
    changing = np.asarray((step > 1e-6 * limit).any(axis=-1))
    step = np.maximum(step, 1e-12 * limit)
    sign = np.where(after < before, -1.0, 1.0)
    # Without slack between torque and limit the duration would be infinite.
    slack = np.maximum(limit - sign * after, 5e-4 * limit) + step
    rate_limit = np.minimum(scene.torque_rate_limit, 1e12 * limit)
    constant = (rate_limit / step).min(axis=-1)
    decay = np.array([0.0, *(1 / scene.actuator_lag[lags])])
    starts = [constant, *((slack / step)[..., j] / scene.actuator_lag[j] for j in lags)]
    lines = np.stack(starts, axis=-1)
    # sigma' = lines - decay sigma: at a crossing of two lines the least one may change.
    crossings = [np.zeros_like(constant), np.ones_like(constant)]
    for k in range(len(decay)):
        for m in range(k):
            if decay[k] != decay[m]:
                crossing = (lines[..., k] - lines[..., m]) / (decay[k] - decay[m])
                crossings.append(np.clip(crossing, 0.0, 1.0))
    sigma = np.sort(np.stack(crossings, axis=-1), axis=-1)
    middles = (sigma[..., 1:] + sigma[..., :-1]) / 2
    least = np.argmin(lines[..., None, :] - decay * middles[..., None], axis=-1)
    beta = decay[least]
    rates = np.take_along_axis(lines, least, axis=-1) - beta * sigma[..., :-1]
    rise = np.diff(sigma)
    decayed = -np.log1p(-beta * rise / rates) / np.where(beta > 0, beta, 1.0)
    spans = np.where(beta > 0, decayed, rise / rates)
    return sigma, spans * changing[..., None], rates, beta


class Settling(NamedTuple):
    """Dwell at the end of a phase."""

    phase: int  # its number
    duration: float  # [s]: zero if no torques hold it
    tau: tuple[float, float]  # [N m]
    margin: float  # least of balance, normal forces and accelerations, over saturation values
    contact: str = ""  # gained contact, which closes if it is still open; empty without one
    gap: float = 0.0  # [m]: at the start of its simulation
    closes: float | None = None  # [s]: time at which a hundredth of the gap remains
    left: float = 0.0  # [m]: largest gap at the end
    speed: float = 0.0  # [m/s]: largest closing speed of the contact; 0 if others open before
    parts: tuple[str, ...] = ()  # contacts that would have to pull in the impact, and open
    warning: str = ""  # failure of the torques, or empty
    share: float = 0.0  # duration over that of the whole motion without dwells


@dataclass(frozen=True, eq=False)
class HeldMotion:
    """A motion, with rest before it while torques change, and with a dwell after it.

    Contact forces are not known in the dwell.
    """

    motion: Motion
    pause: TorqueChange | None = None  # of the torques before it
    # (2, n_c) [N]: c_n and c_t before the pause; NaN if other contacts may share in them
    forces: Array = field(default_factory=lambda: np.zeros((2, 0)))
    dwell: TorqueProfile | None = None  # torques after it, from 0 on; constant in the last piece

    @property
    def begin(self) -> float:
        """Start of the motion [s]."""
        return self.pause.duration if self.pause else 0.0

    @property
    def end(self) -> float:
        """End of the motion [s]."""
        return self.begin + self.motion.duration

    @property
    def duration(self) -> float:
        """Duration of the phase [s]."""
        return self.end + (self.dwell.duration if self.dwell else 0.0)

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.motion.contacts

    @property
    def modes(self) -> tuple[ModeSpan, ...]:
        """Contact modes of a motion planned in the time domain: the first ones with the pause."""
        return tuple(
            span._replace(start=span.start + self.begin if k else 0.0, stop=span.stop + self.begin)
            for k, span in enumerate(getattr(self.motion, "modes", ()))
        )

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        t = np.asarray(t, dtype=float)
        return self._evaluate(t, t > self.end)

    def sample(self, count: int, steps: Array) -> tuple[Array, Samples]:
        """`count` even rows until the motion ends, then rows of the dwell.

        Those of the dwell are at its ends, and at the time from which on its torques are constant.
        At times of `steps` [s] in the motion there are two rows, before and after the step.
        """
        even, tiny = np.linspace(0.0, self.end, count), 1e-12 * self.duration
        steps = steps[(steps > tiny) & (steps < self.end - tiny)]
        even = even[np.abs(even[:, None] - steps).min(axis=1, initial=np.inf) > tiny]
        t = np.sort(np.concatenate([even, steps, steps]))
        sides = np.sort(np.concatenate([even, steps - tiny, steps + tiny]))
        rest = self.dwell.breaks[[0, -2, -1]] if self.dwell is not None else np.zeros(0)
        rest, count = self.end + sort_unique(rest), len(t)
        t, sides = np.append(t, rest), np.append(sides, rest)
        return t, self._evaluate(sides, np.arange(len(t)) >= count)

    def _evaluate(self, t: Array, held: Flags) -> Samples:
        """Samples at times `t`; those with `held` are in the dwell."""
        samples = self.motion.evaluate(np.clip(t - self.begin, 0.0, self.motion.duration))
        if self.pause is not None:
            remaining = np.where(t < self.begin, 1 - self.pause.fraction(t), 0.0)[:, None]
            mixed = (
                np.where(remaining > 0, remaining * initial + (1 - remaining) * now, now)
                for initial, now in zip((self.pause.before, *self.forces), samples[3:], strict=True)
            )
            samples = Samples(*samples[:3], *mixed)
        if self.dwell is None:
            return samples
        rows, tau = held[:, None], self.dwell.at(t - self.end)
        # z', z'', torques and forces at rest
        rest: tuple[float | Array, ...] = (0.0, 0.0, tau, np.nan, np.nan)
        parts = (np.where(rows, *pair) for pair in zip(rest, samples[1:], strict=True))
        return Samples(samples.z, *parts)


def assemble(
    motions: Sequence[Motion], torque: TorqueProfile, meta: Mapping[str, Any], samples: int
) -> Trajectory:
    """Trajectory of consecutive motions, with `samples` rows for each one and two for its dwell.

    Steps of held torques have two rows each, too.
    """
    contacts = tuple(dict.fromkeys(name for motion in motions for name in motion.contacts))
    rows, times, start = [], [], 0.0
    for motion in motions:
        phase_motion = motion if isinstance(motion, HeldMotion) else HeldMotion(motion)
        t, row = phase_motion.sample(samples, torque.held_steps - start)
        rows.append(row.expand(motion.contacts, contacts))
        times.append(start + t)
        start += motion.duration
    columns = Samples(*map(np.concatenate, zip(*rows, strict=True)))
    return Trajectory(
        **columns._asdict(),
        t=np.concatenate(times),
        contacts=contacts,
        phase=np.repeat(np.arange(len(motions)), list(map(len, times))),
        torque=torque,
        motions=tuple(motions),
        meta=dict(meta),
    )
