"""Switches of torque rates along a motion under rate limits, and ramps for a plan without them.

Between switches torques are smooth in time, and straight lines at the largest rate. An element in
which such a ramp starts or ends has a polynomial instead of a step of the rate: the switch is where
the line meets the torque beside it.
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
_LAGS = 3.0  # time of a step by the torque limit, over the lag
_BRIEF = 0.3  # largest share of all ramps in the duration
_RAMP_REACH = 0.3  # least distance of a break from a ramp, over the ramp's length
_RAMPED = 0.5  # rate, over the largest one, above which a torque is in a ramp
_FLAT = 0.1  # rate, over the largest one, up to which it is not
_KINK = 2.0  # least step of a rate that counts, times the duration, over the torque limit
_NEAR = 0.06  # least time between switches, over that of a ramp by the torque limit
_APART = 4e-3  # the same over the duration, where that is less
_LATE = 0.4  # least length of a first or last element, over that of the ramp there
_MOST = 24  # most switches of a phase


def find_rate_switches(part: PhaseData, profile: Profile) -> list[Switch]:
    """Places along a phase's curve where torque rates step."""
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
    owner = np.repeat(part.nonempty // (DEGREE + 1), len(looks))
    columns = zip(torques.reshape(-1, 2).T, shares.T, largest, strict=True)
    steps = [_find_ramps(t, owner, *column) for column in columns]
    ends = np.arange(len(looks) - 1, len(t) - 1, len(looks))
    jumps = np.abs(rates.reshape(-1, 2)[ends + 1] - rates.reshape(-1, 2)[ends])
    kinks = t[ends[(jumps * motion.duration > _KINK * part.torque_limit).any(axis=1)]]
    quickest = float((part.torque_limit / largest).min())
    apart = min(_NEAR * quickest, _APART * motion.duration)
    every = _clear_ends(np.concatenate([*steps, kinks]), motion.duration, quickest)
    times = _thin_out(every, motion.duration, apart)[:_MOST]
    return [Switch(float(s), True) for s in _locate(part, motion, times)] if len(times) else []


def _find_ramps(
    t: Array, owner: NDArray[np.int64], tau: Array, shares: Array, largest: float
) -> Array:
    """Times at which ramps of a torque start and end.

    Parameters
    ----------
    t, owner, tau, shares : (n,)  samples: time, element, torque, and rate over the `largest`
    """
    level = np.where(np.abs(shares) > _RAMPED, np.sign(shares), 0.0)
    ends = np.flatnonzero(np.diff(np.concatenate([[0.0], level, [0.0]])))
    starts, stops = ends[:-1], ends[1:] - 1
    ramps = level[starts] != 0
    starts, stops, switches = starts[ramps], stops[ramps], list[float]()
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
            rate = np.abs(shares[looks])
            # The polynomial of an element with a switch oscillates: others are preferred.
            flat = rate < _FLAT
            steady = flat & ~np.isin(owner[looks], owner[looks][~flat])
            flat = steady if steady.any() else flat
            neighbour = looks[int(np.argmax(flat) if flat.any() else rate.argmin())]
            rise = tau[neighbour] - level - slope * largest * (t[neighbour] - middle)
            change = (slope - shares[neighbour]) * largest
            if change:
                switches.append(float(t[neighbour] + rise / change))
    return np.array(switches)


def _locate(part: PhaseData, motion: PathMotion, t: Array) -> Array:
    """Places at some times within a motion [m]; ends of elements without rounding."""
    places, edges = motion.locate(t)[0], part.grid.edges[1:, 0]
    ends = motion.times.reshape(len(edges) + 1, -1)[1:, 0]
    near = np.abs(t[:, None] - ends).argmin(axis=1)
    same = np.abs(t - ends[near]) < 1e-9 * motion.duration
    return np.where(same, edges[near], places)


def _clear_ends(t: Array, duration: float, quickest: float) -> Array:
    """Times without those early in the ramps at both ends of a motion."""
    for left in (t, duration - t):
        longest = left[left < min(quickest, duration / 2)].max(initial=0.0)
        t = np.where(left < _LATE * longest, np.nan, t)
    return t[np.isfinite(t)]


def _thin_out(times: Array, duration: float, apart: float) -> Array:
    """Times within a motion, increasing, none of which is near another one."""
    kept = list[float]()
    for t in times.tolist():
        if min(abs(t - other) for other in [0.0, duration, *kept]) > apart:
            kept.append(t)
    return np.sort(kept)


class Ramped(NamedTuple):
    """Ramps in place of the torque steps of a plan without rate limits."""

    spans: Array  # (r, 2) [m]: where ramps start and end, along all curves
    holds: Array  # (2,) [N]: the internal force before and after the motion

    def find_breaks(self, breaks: Array) -> list[Switch]:
        """Breaks at the ends of ramps, and the former ones that are not near a ramp [m]."""
        reach = _RAMP_REACH * np.diff(self.spans)
        near = (breaks > self.spans[:, :1] - reach) & (breaks < self.spans[:, 1:] + reach)
        places = np.concatenate([self.spans.ravel()[1:-1], breaks[~near.any(axis=0)]])
        return [Switch(float(place), True) for place in np.sort(places)]

    def guess(self, old: Grid, profile: Profile, new: Grid) -> Profile:
        """A `profile` on a grid, with ramps, on another grid."""
        a, _, lam = Elements(old, profile).move(new)
        ramped, holds = (a.copy(), lam.copy()), ((0.0, 0.0), self.holds.tolist())
        middles = np.repeat(new.edges.mean(axis=1), DEGREE + 1)
        for k, (start, stop) in enumerate(self.spans.tolist()):
            inside = np.flatnonzero((middles > start) & (middles < stop))
            if not len(inside):
                continue
            neighbour = np.clip([inside[0] - 1, inside[-1] + 1], 0, len(a) - 1)
            share = (new.s[inside] - start) / (stop - start)
            end = 0 if k == 0 else 1 if k == len(self.spans) - 1 else None
            if end is not None:
                share = 1 - np.cbrt(1 - share) if end else np.cbrt(share)
            for column, hold in zip(ramped, holds, strict=True):
                values = column[neighbour]
                if end is not None:
                    values[end] = hold[end]
                column[inside] = values[0] + share * (values[1] - values[0])
        return follow(new, *ramped)


def ramp_up(
    data: PhaseData,
    profile: Profile,
    duration: float,
    pins: tuple[float | None, float | None],
) -> Ramped | None:
    """Ramps in place of the torque steps of a `profile`; None if they would take too long.

    Parameters
    ----------
    duration : [s]  of the profile
    pins : [N]      prescribed internal forces before and after the motion, if any
    """
    lag = _LAGS * data.curve.formation.scene.actuator_lag / data.torque_limit
    slowness = _LONGER * np.maximum(1 / data.rate_limit, lag)  # (2,) [s/(N m)]: least, of a step
    tau = data.nodes.forces.tau(*profile).reshape(-1, DEGREE + 1, 2)
    holds = [_hold(data, tau[place, place], slowness, place, pins[place]) for place in (0, -1)]
    first = np.vstack([holds[0][1][None], tau[:, -1]])
    last = np.vstack([tau[:, 0], holds[1][1][None]])
    steps = np.abs(last - first)
    times = (steps * slowness).max(axis=1)
    large = (steps / data.torque_limit).max(axis=1) > _STEP
    if times[large].sum() > _BRIEF * duration:
        return None
    inner = np.flatnonzero(large[1:-1])
    s, speed = data.grid.edges[1:, 0], np.sqrt(profile.b.reshape(-1, DEGREE + 1)[1:, 0])
    half = speed[inner] * times[1:-1][inner] / 2
    ways = np.abs(profile.a[[0, -1]]) * np.maximum(times[[0, -1]], 1e-4 * duration) ** 2 / 6
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


def _hold(
    data: PhaseData, tau: Array, slowness: Array, place: int, pin: float | None
) -> tuple[float, Array]:
    """The internal force that holds the object at an end with torques near `tau`, and those."""
    forces = data.nodes.forces
    level, press = forces.T0[place], forces.Tl[place]
    if pin is None:
        weighted = press * slowness
        pin = float(weighted @ ((tau - level) * slowness) / max(weighted @ weighted, 1e-300))
    return pin, np.asarray(level + pin * press)
