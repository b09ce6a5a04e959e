"""Dwell at the ends of phases: constant torques that close contacts and hold at rest.

Between a motion and its dwell torques change at rest, in the least time in which motors that are
not quick follow: straight from the ones to the others, tau = tau_0 + sigma (tau_1 - tau_0). Where
motor j has the largest rate R and the lag T, its torque x, counted in the direction of the change
d, and its command x + T x' within the limit L leave

    sigma' <= R / d,    sigma' <= (L - x_0 - sigma d) / (T d),

so sigma' is the least of straight lines in sigma: it is constant or decays from place to place.
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
    """How torques change."""

    before: Array  # (2,) [N m]
    after: Array  # (2,) [N m]
    times: Array  # (n + 1,) [s]: from 0 on
    levels: Array  # (n + 1,): sigma at these times
    rates: Array  # (n,) [1/s]: its rate of change just after them
    decays: Array  # (n,) [1/s]: how fast that decays

    @property
    def duration(self) -> float:
        """How long it takes [s]; 0 if they do not change."""
        return float(self.times[-1])

    def share(self, t: Array) -> Array:
        """What is done of it at some times, sigma."""
        t = np.clip(t, 0.0, self.duration)
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.rates) - 1)
        past, decay = t - self.times[k], self.decays[k]
        fading = -np.expm1(-decay * past) / np.where(decay > 0, decay, 1.0)
        return np.asarray(self.levels[k] + self.rates[k] * np.where(decay > 0, fading, past))

    @property
    def torque(self) -> TorqueProfile:
        """The torques while they change."""
        fades, lasts = self.decays.max() > 0, np.diff(self.times)
        counts = [max(math.ceil(n), 1) for n in (lasts * self.decays.max()).tolist()]
        spans = zip(self.times[:-1], self.times[1:], counts, strict=True)
        breaks = np.concatenate([np.linspace(a, b, n + 1)[:-1] for a, b, n in spans])
        breaks, change = np.append(breaks, self.duration), self.after - self.before
        # Pieces are as long as the shortest lag at most.
        return TorqueProfile.fit(
            breaks, lambda t: self.before + self.share(t)[:, None] * change, 6 if fades else 1
        )


def change_torques(scene: Scene, before: Array, after: Array) -> TorqueChange:
    """How torques change from ones to others, both of shape (2,) [N m]."""
    levels, spans, rates, decays = _divide(scene, before, after)
    nonempty = spans > 0
    times = np.append(0.0, np.cumsum(spans[nonempty]))
    levels = np.append(levels[:-1][nonempty], levels[-1])
    return TorqueChange(before, after, times, levels, rates[nonempty], decays[nonempty])


def find_change_times(scene: Scene, before: Array, after: Array) -> Array:
    """How long torques of shape (..., 2) [N m] take to change, as (...) [s]."""
    return np.asarray(_divide(scene, before, after)[1].sum(axis=-1))


def _divide(scene: Scene, before: Array, after: Array) -> tuple[Array, Array, Array, Array]:
    """Pieces of the least time: sigma at their ends, and how long, how fast and fading they are."""
    limit, lags = scene.torque_limit, np.flatnonzero(scene.actuator_lag)
    step = np.abs(after - before)
    # A step of a millionth of the limit is none.
    much = np.asarray((step > 1e-6 * limit).any(axis=-1))
    step = np.maximum(step, 1e-12 * limit)
    side = np.where(after < before, -1.0, 1.0)
    # Without any room between torque and limit it would take for ever.
    room = np.maximum(limit - side * after, 5e-4 * limit) + step
    fastest = np.minimum(scene.torque_rate_limit, 1e12 * limit)
    steady = (fastest / step).min(axis=-1)
    decay = np.array([0.0, *(1 / scene.actuator_lag[lags])])
    starts = [steady, *((room / step)[..., j] / scene.actuator_lag[j] for j in lags)]
    lines = np.stack(starts, axis=-1)
    # sigma' = lines - decay sigma: where two of these cross, another one may be the least.
    places = [np.zeros_like(steady), np.ones_like(steady)]
    for k in range(len(decay)):
        for m in range(k):
            if decay[k] != decay[m]:
                crossing = (lines[..., k] - lines[..., m]) / (decay[k] - decay[m])
                places.append(np.clip(crossing, 0.0, 1.0))
    levels = np.sort(np.stack(places, axis=-1), axis=-1)
    middles = (levels[..., 1:] + levels[..., :-1]) / 2
    least = np.argmin(lines[..., None, :] - decay * middles[..., None], axis=-1)
    beta = decay[least]
    rates = np.take_along_axis(lines, least, axis=-1) - beta * levels[..., :-1]
    way = np.diff(levels)
    fading = -np.log1p(-beta * way / rates) / np.where(beta > 0, beta, 1.0)
    spans = np.where(beta > 0, fading, way / rates)
    return levels, spans * much[..., None], rates, beta


class Settling(NamedTuple):
    """How the end of a phase is held."""

    phase: int  # its number
    duration: float  # [s]: zero where no torques hold it
    tau: tuple[float, float]  # [N m]
    margin: float  # least of balance, normal forces and accelerations, over what is ample
    contact: str = ""  # what closes if it is still open; empty if nothing is gained there
    gap: float = 0.0  # [m]: from which on that was simulated
    closes: float | None = None  # [s]: when all was closed, but for a hundredth of the gap
    left: float = 0.0  # [m]: largest gap at the end
    speed: float = 0.0  # [m/s]: most with which the contact is reached; 0 if others open before
    parts: tuple[str, ...] = ()  # contacts that would have to pull in that impact, and part
    warning: str = ""  # what the torques do not do; empty if nothing
    share: float = 0.0  # its duration over that of the whole motion without dwells


@dataclass(frozen=True, eq=False)
class HeldMotion:
    """A motion with rest before it, in which torques change, and after it, in which they hold.

    Contact forces are not known after it.
    """

    motion: Motion
    pause: TorqueChange | None = None  # of the torques before it
    # (2, n_c) [N]: c_n and c_t before the pause; NaN if other contacts may share in them
    forces: Array = field(default_factory=lambda: np.zeros((2, 0)))
    dwell: TorqueProfile | None = None  # torques after it, from 0 on; steady in the last piece

    @property
    def begin(self) -> float:
        """When the motion begins [s]."""
        return self.pause.duration if self.pause else 0.0

    @property
    def end(self) -> float:
        """When the motion ends [s]."""
        return self.begin + self.motion.duration

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return self.end + (self.dwell.duration if self.dwell else 0.0)

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.motion.contacts

    @property
    def modes(self) -> tuple[ModeSpan, ...]:
        """Its contact modes, if planned in the time domain: the first start with the pause."""
        return tuple(
            span._replace(start=span.start + self.begin if k else 0.0, stop=span.stop + self.begin)
            for k, span in enumerate(getattr(self.motion, "modes", ()))
        )

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        t = np.asarray(t, dtype=float)
        return self._evaluate(t, t > self.end)

    def sample(self, count: int) -> tuple[Array, Samples]:
        """`count` even rows until the motion ends, and those of the dwell at its ends.

        Also one from which on its torques are steady.
        """
        t = np.linspace(0.0, self.end, count)
        if self.dwell is not None:
            t = np.append(t, self.end + sort_unique(self.dwell.breaks[[0, -2, -1]]))
        return t, self._evaluate(t, np.arange(len(t)) >= count)

    def _evaluate(self, t: Array, held: Flags) -> Samples:
        """Samples, of which some are those of the dwell."""
        samples = self.motion.evaluate(np.clip(t - self.begin, 0.0, self.motion.duration))
        if self.pause is not None:
            left = np.where(t < self.begin, 1 - self.pause.share(t), 0.0)[:, None]
            mixed = (
                np.where(left > 0, left * first + (1 - left) * now, now)
                for first, now in zip((self.pause.before, *self.forces), samples[3:], strict=True)
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
    """Sample motions that follow one another, `samples` rows to a phase and two to its held end."""
    contacts = tuple(dict.fromkeys(name for motion in motions for name in motion.contacts))
    rows, times, start = [], [], 0.0
    for motion in motions:
        whole = motion if isinstance(motion, HeldMotion) else HeldMotion(motion)
        local, row = whole.sample(samples)
        rows.append(row.spread(motion.contacts, contacts))
        times.append(start + local)
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
