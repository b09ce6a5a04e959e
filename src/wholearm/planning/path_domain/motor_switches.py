"""Where the rates of torques step along a motion with slow motors.

Between switches torques are smooth in time, those at their largest rate straight lines. An element
in which a torque begins or ends such a line has a polynomial instead of a step of the rate. The
step has to be where the line meets what goes on beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .data import PhaseData
from .elements import DEGREE, Profile
from .motion import PathMotion
from .motor_data import find_torques
from .switches import Switch

_HALF = 0.5
"""Rate, over the largest one, from which on a torque is on its way to change at that."""
_SLOW = 0.1
"""Rate, over the largest one, up to which it is not."""
_KINK = 2.0
"""Least step of a rate that no motor limits, over the torque limit in the motion's time."""
_NEAR = 0.06
"""Least time between two switches, over that in which a torque changes by its limit."""
_APART = 4e-3
"""The same, over the duration, where that is less."""
_LATE = 0.4
"""Least part of the ramp at an end that an element takes: a short one there hides what it holds."""
_MOST = 24
"""Most switches of a phase: those beyond flicker."""


def find_motor_switches(part: PhaseData, profile: Profile) -> list[Switch]:
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
