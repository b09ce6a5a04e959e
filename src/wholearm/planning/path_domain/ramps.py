"""Where slow motors start from: a plan of quick ones whose steps of torques have become ramps.

Each step takes the time that the motors need for it, about where it was; so do torques at the ends
of the motion from what holds the object to what drives it. Elements end where ramps do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from .data import PhaseData
from .elements import DEGREE, Elements, Grid, Profile, follow
from .switches import Switch

_LONGER = 1.05
"""Factor on the least time of ramps, so that they are inside the limits."""
_STEP = 1e-2
"""Least step of a torque that gets a ramp, over its limit."""
_LAGS = 3.0
"""Time that a lag takes for a step of the size of the torque limit, over the lag."""
_BRIEF = 0.3
"""Largest part of the motion's time that all ramps may take together."""
_NEAR = 0.3
"""Least way between a ramp and another end of an element, over that of the ramp."""


class Ramped(NamedTuple):
    """What a plan of quick motors says about one of slow ones.

    Attributes
    ----------
    spans : ndarray, shape (r, 2), [m]
        Where ramps begin and end.
    holds : ndarray, shape (2,), [N]
        The squeeze before and after the motion.
    """

    spans: Array
    holds: Array

    def find_breaks(self, known: Array) -> list[Switch]:
        """Where elements are to end: with ramps, and where they did, at `known` places, but near.

        All of it along all curves [m].
        """
        way = np.diff(self.spans)
        near = (known > self.spans[:, :1] - _NEAR * way) & (known < self.spans[:, 1:] + _NEAR * way)
        places = np.concatenate([self.spans.ravel()[1:-1], known[~near.any(axis=0)]])
        return [Switch(float(place), True) for place in np.sort(places)]

    def guess(self, old: Grid, profile: Profile, new: Grid) -> Profile:
        """The quick plan, a `profile` on a grid, with ramps on another grid."""
        a, _, squeeze = Elements(old, profile).move(new)
        found = [a.copy(), squeeze.copy()]
        middles = np.repeat(new.edges.mean(axis=1), DEGREE + 1)
        for k, (start, stop) in enumerate(self.spans.tolist()):
            own = np.flatnonzero((middles > start) & (middles < stop))
            if not len(own):
                continue
            beside = np.clip([own[0] - 1, own[-1] + 1], 0, len(a) - 1)
            share = (new.s[own] - start) / (stop - start)
            values, presses = a[beside], squeeze[beside]
            if k == 0:
                share = np.cbrt(share)
                values[0], presses[0] = 0.0, self.holds[0]
            elif k == len(self.spans) - 1:
                share = 1 - np.cbrt(1 - share)
                values[1], presses[1] = 0.0, self.holds[1]
            found[0][own] = values[0] + share * (values[1] - values[0])
            found[1][own] = presses[0] + share * (presses[1] - presses[0])
        return follow(new, *found)


def ramp_up(
    data: PhaseData,
    profile: Profile,
    lasts: float,
    pins: tuple[float | None, float | None],
) -> Ramped | None:
    """Ramps in place of the steps of a plan of quick motors; None if they would take too long.

    Parameters
    ----------
    data : PhaseData
    profile : Profile
        At its nodes.
    lasts : float, [s]
        The duration of that.
    pins : tuple of float or None, [N]
        Squeezes before and after the motion, where these are given.
    """
    slowness = _find_slowness(data)
    tau = data.nodes.forces.tau(*profile).reshape(-1, DEGREE + 1, 2)
    holds = [_hold(data, tau[place, place], slowness, place, pins[place]) for place in (0, -1)]
    first = np.vstack([holds[0][1][None], tau[:, -1]])
    last = np.vstack([tau[:, 0], holds[1][1][None]])
    steps = np.abs(last - first)
    times = (steps * slowness).max(axis=1)
    large = (steps / data.torque_limit).max(axis=1) > _STEP
    if times[large].sum() > _BRIEF * lasts:
        return None
    inner = np.flatnonzero(large[1:-1])
    s, speed = data.grid.edges[1:, 0], np.sqrt(profile.b.reshape(-1, DEGREE + 1)[1:, 0])
    half = speed[inner] * times[1:-1][inner] / 2
    ways = np.abs(profile.a[[0, -1]]) * np.maximum(times[[0, -1]], 1e-4 * lasts) ** 2 / 6
    length = data.grid.s[-1]
    inside = np.stack([s[inner] - half, s[inner] + half], axis=1).tolist()
    spans = [[0.0, ways[0]]]
    for start, stop in [*inside, [length - ways[1], length]]:
        if start < spans[-1][1]:
            spans[-1][1] = max(stop, spans[-1][1])
        else:
            spans.append([start, stop])
    if len(spans) < 2 or spans[0][1] > ways[0] or spans[-1][0] < length - ways[1]:
        return None
    return Ramped(np.array(spans), np.array([hold[0] for hold in holds]))


def _find_slowness(data: PhaseData) -> Array:
    """Least time for a step of each torque, over the step, shape (2,) [s/(N m)]."""
    lag = _LAGS * data.curve.formation.scene.actuator_lag / data.torque_limit

    return np.asarray(_LONGER * np.maximum(1 / data.rate_limit, lag))


def _hold(
    data: PhaseData, tau: Array, slowness: Array, place: int, pin: float | None
) -> tuple[float, Array]:
    """The squeeze that holds the object at an end with torques near `tau`, and these torques."""
    forces = data.nodes.forces
    level, press = forces.T0[place], forces.Tl[place]
    if pin is None:
        weighted = press * slowness
        pin = float(weighted @ ((tau - level) * slowness) / max(weighted @ weighted, 1e-300))
    return pin, np.asarray(level + pin * press)
