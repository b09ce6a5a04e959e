"""The fastest motion along curves, by a sweep over the plane of s and b: what the NLP starts from.

It says about where a plan of least time switches. A plan of the largest margin is the fastest one
with that margin, as long as its duration is all that keeps the margin from being larger.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ..lower_bound.sweep import Mode, NoMotionError
from ..lower_bound.sweep import find_fastest as sweep
from .data import PhaseData
from .switches import Sights, Switch

_SPEEDS = 2
"""Sweeps until viscous friction is linearised about the right speed."""
_SHARES = {Mode.PUSH: 0.0, Mode.SWITCH: 0.0, Mode.BRAKE: 1.0, Mode.HELD: 0.5}
"""How far s'' is from its largest, over the range that limits allow."""
_CLOSE = 1e-4
"""Error of the duration that is good enough for a margin, relatively."""
_TRIES = 20
"""Most margins that are tried."""


class Fastest(NamedTuple):
    """The fastest motion that a sweep has found.

    Attributes
    ----------
    s : ndarray, shape (N + 1,), [m]
    b : ndarray, shape (N + 1,), [m^2/s^2]
    modes : ndarray of int, shape (N,)
        `Mode` in each interval.
    switches : list of Switch
    margin : float, [N]
        Of normal forces over epsilon.
    """

    s: Array
    b: Array
    modes: NDArray[np.int64]
    switches: list[Switch]
    margin: float

    @property
    def slopes(self) -> Array:
        """The s'' of each interval, shape (N,) [m/s^2]."""
        return np.asarray(np.diff(self.b) / (2 * np.diff(self.s)))

    def find_modes(self, places: Array) -> NDArray[np.int64]:
        """Modes at some places [m]: never `SWITCH`."""
        modes = self.modes[np.clip(np.searchsorted(self.s, places) - 1, 0, len(self.modes) - 1)]
        jumps = np.array([place for place, jumps in self.switches if jumps])
        for k in np.flatnonzero(modes == Mode.SWITCH).tolist():
            near = jumps[np.abs(jumps - places[k]).argmin()] if len(jumps) else places[k]
            modes[k] = Mode.PUSH if places[k] < near else Mode.BRAKE
        return modes


def find_fastest(data: PhaseData, duration: float | None) -> Fastest | None:
    """The fastest motion, or if a duration [s] is given, the one of that with the largest margin.

    None if there is none, or the duration is not what limits the margin.
    """
    margin = 0.0 if duration is None else _find_margin(data, duration)
    try:
        return None if margin is None else _find_at(data, margin)
    except NoMotionError:
        return None


def _find_at(data: PhaseData, margin: float) -> Fastest:
    sights = Sights.of(data, margin)
    s, b, modes = _sweep(sights)
    steps, middle = np.diff(s), sights.rows.pick(slice(1, None, 2))
    near = np.interp(sights.s[1::2], s, b)
    pushed, braked = (middle.extreme(near, largest).a for largest in (True, False))
    # In an interval with a switch s'' is first the largest, then the least.
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (np.diff(b) / 2 - braked * steps) / (pushed - braked)
    places, index = sights.s, np.arange(len(sights.s)) // 2
    switched = modes[index] == Mode.SWITCH
    late = switched & (places - s[index] > first[index])
    share = np.array([_SHARES[Mode(mode)] for mode in modes.tolist()])[index] + late
    here = np.interp(places, s, b)
    before = (b[:-1] - 2 * pushed * s[:-1])[index] + 2 * pushed[index] * places
    after = (b[1:] - 2 * braked * s[1:])[index] + 2 * braked[index] * places
    here = np.where(switched, np.where(late, after, before), here)
    return Fastest(s, b, modes, sights.find_switches(here, share, index), margin)


def _sweep(sights: Sights) -> tuple[Array, Array, NDArray[np.int64]]:
    """Every other place is in an interval of the sweep."""
    s = np.append(sights.s[::2], sights.length)
    rows, steps = sights.rows.pick(slice(1, None, 2)), np.diff(s)
    part, near = (sights.s[1::2] - s[:-1]) / steps, None
    cap = np.append(sights.rows.cap[::2], np.inf)
    for _ in range(_SPEEDS if rows.v.any() else 1):
        found = sweep(rows, steps, part, cap, near)
        near = (1 - part) * found.b[:-1] + part * found.b[1:]
    return s, found.b, found.modes


def _find_margin(data: PhaseData, duration: float) -> float | None:
    """The margin with which the fastest motion takes so long [N]."""

    def find_excess(margin: float) -> float:
        try:
            s, b, _ = _sweep(Sights.of(data, margin))
        except NoMotionError:
            return np.inf
        speed = np.sqrt(b)
        return float((2 * np.diff(s) / (speed[1:] + speed[:-1])).sum()) / duration - 1

    low, high = 0.0, data.curve.formation.scene.scales.force
    at_low, at_high = find_excess(low), find_excess(high)
    if at_low > 0:
        return None
    for _ in range(_TRIES):
        if at_high <= 0:
            low, high, at_low = high, 2 * high, at_high
            at_high = find_excess(high)
            continue
        # The excess grows ever faster: a secant falls short, so it alternates with halving.
        middle = (low + high) / 2
        if np.isfinite(at_high):
            secant = low - at_low * (high - low) / (at_high - at_low)
            middle = min(middle, secant + 0.1 * (secant - low))
        excess = find_excess(middle)
        if -_CLOSE < excess <= _CLOSE:
            return middle
        if excess > 0:
            high, at_high = middle, excess
        else:
            low, at_low = middle, excess
    return None
