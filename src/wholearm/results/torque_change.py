"""Torques that change at rest, in the least time in which motors that are not quick follow.

Torques go straight from the ones to the others, tau = tau_0 + sigma (tau_1 - tau_0). Where motor j
has the largest rate R and the lag T, its torque x, counted in the direction of the change d, and
its command x + T x' within the limit L leave

    sigma' <= R / d,    sigma' <= (L - x_0 - sigma d) / (T d),

so sigma' is the least of straight lines in sigma: it is constant or decays from place to place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array
from ..scene.model import Scene
from .torque import TorqueProfile

_STEP = 1e-6  # largest step of torques that is none, over their limits
_FLOOR = 5e-4
"""Least room that is counted on between a torque and its limit, over that: none takes for ever."""
_QUICK = 1e12  # rate of torques that stands for any, in their limits [1/s]
_DEGREE = 6  # degree of the polynomials in pieces that are as long as the shortest lag at most


@dataclass(frozen=True, eq=False)
class TorqueChange:
    """How torques change."""

    before: Array  # before, after (2,) [N m]:
    after: Array
    times: Array  # (n + 1,) [s]: from 0 on
    # levels, rates (n + 1,) and (n,) [-], [1/s]: sigma at these times, and its rate of change just
    # after them
    levels: Array
    rates: Array
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
        breaks = np.append(breaks, self.duration)

        def evaluate(t: Array) -> Array:
            return self.before + self.share(t)[:, None] * (self.after - self.before)

        return TorqueProfile.fit(breaks, evaluate, _DEGREE if fades else 1)


def change_torques(scene: Scene, before: Array, after: Array) -> TorqueChange:
    """How torques change from ones to others, both of shape (2,) [N m]."""
    levels, spans, rates, decays = _divide(scene, before, after)
    own = spans > 0
    times = np.append(0.0, np.cumsum(spans[own]))
    levels = np.append(levels[:-1][own], levels[-1])
    return TorqueChange(before, after, times, levels, rates[own], decays[own])


def find_change_times(scene: Scene, before: Array, after: Array) -> Array:
    """How long torques of shape (..., 2) [N m] take to change, as (...) [s]."""
    return np.asarray(_divide(scene, before, after)[1].sum(axis=-1))


def _divide(scene: Scene, before: Array, after: Array) -> tuple[Array, Array, Array, Array]:
    """Pieces of the least time: sigma at their ends, and how long, how fast and fading they are."""
    limit, lags = scene.torque_limit, np.flatnonzero(scene.actuator_lag)
    step = np.abs(after - before)
    much = np.asarray((step > _STEP * limit).any(axis=-1))
    step = np.maximum(step, _STEP**2 * limit)
    side = np.where(after < before, -1.0, 1.0)
    room = np.maximum(limit - side * after, _FLOOR * limit) + step
    fastest = np.minimum(scene.torque_rate_limit, _QUICK * limit)
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
