"""Where the rates of torques step along a motion with slow motors.

Between switches torques are smooth in time, those at their largest rate straight lines. Elements in
which a torque is no smooth polynomial hide a corner of it, where the lines that go on from both
sides meet, or if these are apart, a ramp at the largest rate from one to the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .data import PhaseData
from .elements import DEGREE, Profile, find_basis
from .motion import PathMotion
from .motor_data import find_torques
from .switches import Switch

_BENT = 2e-3
"""Largest of the two highest modes of a torque that is smooth in an element, over its limit."""
_SLOW = 0.5
"""Largest rate, over what is allowed, of a torque that could take its step in less time."""
_VARIES = 0.5
"""Largest change of a rate within an element that is smooth, over the largest rate."""
_STRAYS = 0.03
"""The same beside a corner at the end of an element that is where it has to be."""
_CORNER = 0.2
"""Least step of a rate at a corner, over the largest rate."""
_GUARD = 1e-2
"""Length in time of an element on each side of a switch, over the duration: in these a motion shows
by how much the switch is off."""
_CLOSEST = 0.6
"""Least of such a place before the first switch, over the way there; and after the last one."""
_APART = 2e-3
"""Least time between two switches, over the duration."""


class _Lines(NamedTuple):
    """One torque in each element: when it begins and ends, its values and its rates there."""

    t: Array
    tau: Array
    rate: Array


def find_motor_switches(part: PhaseData, profile: Profile) -> list[Switch]:
    """Where torques of a phase begin to change at other rates, as places along its curve."""
    motion = PathMotion(part.curve, part.grid, profile)
    if motion.stalls:
        return []
    torques, rates = find_torques(part, profile, [motion])
    count = len(part.grid.kinds)
    times = np.append(motion.times.reshape(count, -1)[:, 0], motion.duration)
    ends = np.stack([times[:-1], times[1:]], axis=1)
    nodes = part.nodes.forces.tau(*profile).reshape(count, DEGREE + 1, 2)
    modes = np.abs(find_basis().modes[-2:] @ nodes).max(axis=1)
    torques, rates = (own.reshape(count, -1, 2) for own in (torques, rates))
    found = list[float]()
    for joint, limit in enumerate(part.rate_limit.tolist()):
        rate = rates[..., joint]
        largest = limit if np.isfinite(limit) else max(float(np.abs(rate).max()), 1e-300)
        bent = modes[:, joint] > _BENT * part.torque_limit[joint]
        bent &= np.abs(rate).max(axis=1) < _SLOW * limit
        varies = np.ptp(rate, axis=1) / largest
        bent |= varies > _VARIES
        lines = _Lines(ends, torques[:, [0, -1], joint], rate[:, [0, -1]])
        steps = np.abs(lines.rate[1:, 0] - lines.rate[:-1, 1]) > _CORNER * largest
        for k in np.flatnonzero(steps).tolist():
            # Where the end of an element is off a corner, the rate strays in one of the two.
            worse = k + int(varies[k + 1] > varies[k])
            if varies[worse] > _STRAYS:
                bent[worse] = True
            else:
                found.append(float(ends[k + 1, 0]))
        for first, last in _find_runs(bent):
            found += _place(lines, first, last, largest)
    quickest = (part.torque_limit / part.rate_limit).min()
    inside = _thin_out(found, motion.duration, min(_APART * motion.duration, quickest / 2))
    if not len(inside):
        return []
    places = motion.locate(inside)[0]
    edges = part.grid.edges[1:, 0]
    known = np.isin(inside, ends[1:, 0])
    places[known] = edges[np.searchsorted(ends[1:, 0], inside[known])]
    # Within the first and the last element the motion is yet to become as quick as it will be.
    length, (start, stop) = part.curve.length, part.grid.edges[[0, -1], [1, 0]]
    early, late = places < start, places > stop
    after, before = np.abs(profile.a[[DEGREE + 1, -DEGREE - 2]]) / 6
    places = np.where(early, np.minimum(after * inside**2, start), places)
    left = motion.duration - inside
    places = np.where(late, np.maximum(length - before * left**2, stop), places)
    beside = (inside[:, None] + _GUARD * motion.duration * np.array([-1.0, 1.0])).ravel()
    far = np.abs(beside[:, None] - np.append(inside, [0.0, motion.duration])).min(axis=1)
    guards = motion.locate(beside[far > 0.7 * _GUARD * motion.duration])[0]
    # Next to rest speeds are roots of the way, and a short way there is long for a polynomial.
    first, last = _CLOSEST * places[0], length - _CLOSEST * (length - places[-1])
    guards = np.clip(guards, first, last)
    switches = [Switch(float(place), True) for place in places]
    return switches + [Switch(float(place), False) for place in guards]


def _thin_out(found: list[float], duration: float, apart: float) -> Array:
    """Instants within a motion, increasing, none of which is near another one."""
    kept = list[float]()
    for t in sorted(found):
        if apart < t < duration - apart and (not kept or t - kept[-1] > apart):
            kept.append(t)
    return np.array(kept)


def _find_runs(bent: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last of the elements in a row that are bent."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bent.astype(int), [0]])))
    return [
        (int(first), int(stop) - 1) for first, stop in zip(edges[::2], edges[1::2], strict=True)
    ]


def _place(lines: _Lines, first: int, last: int, largest: float) -> list[float]:
    """When the rate steps within some elements in a row [s]."""
    start, stop = float(lines.t[first, 0]), float(lines.t[last, 1])
    left = (lines.tau[first - 1, 1], lines.rate[first - 1, 1]) if first else None
    inner = last + 1 < len(lines.t)
    right = (lines.tau[last + 1, 0], lines.rate[last + 1, 0]) if inner else None
    if left is None and right is None:
        return []
    if left is None or right is None:
        # Motions begin and end with torques that are known, from which they ramp.
        tau, (value, rate) = lines.tau[(0, 0) if right else (-1, 1)], right or left  # type: ignore[misc]
        lasts = (stop - start) * (1 if right else -1)
        rise = value - rate * lasts - tau
        ramp = np.sign(rise) * largest * np.sign(lasts) - rate
        after = rise / ramp if ramp else 0.0
        return [(start if right else stop) + float(after)]
    (tau_l, rate_l), (tau_r, rate_r) = left, right
    if abs(rate_l - rate_r) > _CORNER * largest:
        meet = start + (tau_r - rate_r * (stop - start) - tau_l) / (rate_l - rate_r)
        if start <= meet <= stop:
            return [float(meet)]
    middle = (start + stop) / 2
    jump = tau_r - rate_r * (stop - middle) - (tau_l + rate_l * (middle - start))
    ramp = np.sign(jump) * largest - (rate_l + rate_r) / 2
    half = abs(jump / ramp) / 2 if ramp else 0.0
    return [t for t in (middle - half, middle + half) if start < t < stop]
