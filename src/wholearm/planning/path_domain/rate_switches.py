"""Where the rates of torques step along a motion with slow motors.

Between switches torques are smooth in time, those at their largest rate straight lines. An element
in which a torque begins or ends such a line has a polynomial instead of a step of the rate. The
step has to be where the line meets what goes on beside it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .elements import DEGREE, Elements, Grid, Profile, follow
from .path_data import PhaseData
from .path_motion import PathMotion
from .rate_terms import find_torques
from .switches import Switch

_LONGER = 1.05  # factor on the least time of ramps, so that they are inside the limits
_STEP = 1e-2  # least step of a torque that gets a ramp, over its limit
_LAGS = 3.0  # time that a lag takes for a step of the size of the torque limit, over the lag
_BRIEF = 0.3  # largest part of the motion's time that all ramps may take together
_RAMP_REACH = 0.3  # least way between a ramp and another end of an element, over that of the ramp
_HALF = 0.5  # rate, over the largest one, from which on a torque is on its way to change at that
_SLOW = 0.1  # rate, over the largest one, up to which it is not
_KINK = 2.0  # least step of a rate that no motor limits, over the torque limit in the motion's time
_NEAR = 0.06  # least time between two switches, over that in which a torque changes by its limit
_APART = 4e-3  # the same, over the duration, where that is less
_LATE = 0.4
"""Least part of the ramp at an end that an element takes: a short one there hides what it holds."""
_MOST = 24  # most switches of a phase: those beyond flicker


def find_rate_switches(part: PhaseData, profile: Profile) -> list[Switch]:
    """Where torques of a phase begin to change at other rates, as places along its curve."""
    motion = PathMotion(part.curve, part.grid, profile)
    if motion.stalls:
        return []
    torques, rates = find_torques(part, profile, [motion])
    first, last = motion.times[part.nonempty], motion.times[part.nonempty + 1]
    looks = np.linspace(0.0, 1.0, rates.shape[1])
    t = (first[:, None] + looks * (last - first)[:, None]).ravel()
    most = np.maximum(np.abs(rates).max(axis=(0, 1)), part.torque_limit / motion.duration)
    largest = np.where(np.isfinite(part.rate_limit), part.rate_limit, most)
    shares = (rates / largest).reshape(-1, 2)
    torques = torques.reshape(-1, 2)
    owner = np.repeat(part.nonempty // (DEGREE + 1), len(looks))
    given = zip(torques.T, shares.T, largest, strict=True)
    steps = [_find_ramps(t, owner, *own) for own in given]
    ends = np.arange(len(looks) - 1, len(t) - 1, len(looks))
    jumps = np.abs(rates.reshape(-1, 2)[ends + 1] - rates.reshape(-1, 2)[ends])
    kinks = t[ends[(jumps * motion.duration > _KINK * part.torque_limit).any(axis=1)]]
    quickest = float((part.torque_limit / largest).min())
    apart = min(_NEAR * quickest, _APART * motion.duration)
    every = _clear_ends(np.concatenate([*steps, kinks]), motion.duration, quickest)
    found = _thin_out(every, motion.duration, apart)[:_MOST]
    if not len(found):
        return []
    return [Switch(float(place), True) for place in _locate(part, motion, profile, found)]


def _find_ramps(
    t: Array, owner: NDArray[np.int64], tau: Array, shares: Array, largest: float
) -> Array:
    """When a torque begins and ends to change at its largest rate, of which rates are `shares`.

    Instants lie in elements that are their `owner`.
    """
    level = np.where(np.abs(shares) > _HALF, np.sign(shares), 0.0)
    ends = np.flatnonzero(np.diff(np.concatenate([[0.0], level, [0.0]])))
    starts, stops = ends[:-1], ends[1:] - 1
    ramps = level[starts] != 0
    starts, stops, found = starts[ramps], stops[ramps], list[float]()
    borders = np.concatenate([[0], starts, stops, [len(t) - 1]])
    for first, last in zip(starts.tolist(), stops.tolist(), strict=True):
        k = first + int(np.abs(shares[first : last + 1]).argmax())
        slope, middle = float(np.clip(shares[k], -1.0, 1.0)), (t[first] + t[last]) / 2
        level = np.interp(middle, t, tau)
        for end, step in ((first, -1), (last, 1)):
            beyond = borders[(borders - end) * step > 0]
            if not len(beyond):
                continue
            looks = np.arange(end, beyond[np.abs(beyond - end).argmin()] + step, step)
            calm = np.abs(shares[looks])
            # An element in which the line ends swings: others are believed first.
            slow = calm < _SLOW
            steady = slow & ~np.isin(owner[looks], owner[looks][~slow])
            slow = steady if steady.any() else slow
            beside = looks[int(np.argmax(slow) if slow.any() else calm.argmin())]
            rise = tau[beside] - level - slope * largest * (t[beside] - middle)
            change = (slope - shares[beside]) * largest
            if change:
                found.append(float(t[beside] + rise / change))
    return np.array(found)


def _locate(part: PhaseData, motion: PathMotion, profile: Profile, t: Array) -> Array:
    """Places that are passed at some times within a motion [m]."""
    places, edges = motion.locate(t)[0], part.grid.edges[1:, 0]
    # Ends of elements stay where they are, whatever rounding makes of the way there and back.
    ends = motion.times.reshape(len(edges) + 1, -1)[1:, 0]
    near = np.abs(t[:, None] - ends).argmin(axis=1)
    same = np.abs(t - ends[near]) < 1e-9 * motion.duration
    return np.where(same, edges[near], places)


def _clear_ends(t: Array, duration: float, quickest: float) -> Array:
    """Instants without those early in the ramps at both ends of a motion."""
    for left in (t, duration - t):
        longest = left[left < min(quickest, duration / 2)].max(initial=0.0)
        t = np.where(left < _LATE * longest, np.nan, t)
    return t[np.isfinite(t)]


def _thin_out(found: Array, duration: float, apart: float) -> Array:
    """Instants within a motion, increasing, none of which is near another one."""
    kept = list[float]()
    for t in found.tolist():
        near = min(abs(t - own) for own in [0.0, duration, *kept])
        if near > apart:
            kept.append(t)
    return np.sort(kept)


class Ramped(NamedTuple):
    """What a plan of quick motors says about one of slow ones."""

    spans: Array  # (r, 2) [m]: where ramps begin and end
    holds: Array  # (2,) [N]: the squeeze before and after the motion

    def find_breaks(self, known: Array) -> list[Switch]:
        """Where elements are to end: with ramps, and where they did, at `known` places, but near.

        All of it along all curves [m].
        """
        way = np.diff(self.spans)
        near = (known > self.spans[:, :1] - _RAMP_REACH * way) & (
            known < self.spans[:, 1:] + _RAMP_REACH * way
        )
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
    profile      at its nodes
    lasts : [s]  the duration of that
    pins : [N]   squeezes before and after the motion, where these are given
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
