"""Minimum-time speed profile along curves by reachability sweep: initial guess of the NLP.

It tells about where a plan of least time switches. A plan of the largest margin is the fastest one
with that margin, as long as only the duration limits the margin.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.dynamics import ONE
from ...mechanics.path_limits import PathLimits
from ...mechanics.speed_sweep import NoMotionError, SweepMode, find_duration, speed_sweep
from .elements import Profile
from .first_guess import find_middle
from .path_data import PhaseData
from .path_mesh import LimitSamples, Switch

# Distance of s'' from its largest, over the range that limits allow.
_SHARES = {SweepMode.PUSH: 0.0, SweepMode.SWITCH: 0.0, SweepMode.BRAKE: 1.0, SweepMode.HELD: 0.5}
_CLOSE = 1e-4  # relative tolerance of the duration for a margin
_TRIES = 40  # most margins tried


class Fastest(NamedTuple):
    """Minimum-time speed profile of a sweep."""

    s: Array  # (N + 1,) [m]
    b: Array  # (N + 1,) [m^2/s^2]
    modes: NDArray[np.int64]  # (N,): `SweepMode` in each interval
    switches: list[Switch]
    margin: float  # [N]: of normal forces over epsilon

    @property
    def slopes(self) -> Array:
        """The s'' of each interval, shape (N,) [m/s^2]."""
        return np.asarray(np.diff(self.b) / (2 * np.diff(self.s)))

    def find_modes(self, places: Array) -> NDArray[np.int64]:
        """Modes at some places [m]: never `SWITCH`."""
        modes = self.modes[np.clip(np.searchsorted(self.s, places) - 1, 0, len(self.modes) - 1)]
        jumps = np.array([place for place, jumps in self.switches if jumps])
        for k in np.flatnonzero(modes == SweepMode.SWITCH).tolist():
            jump = jumps[np.abs(jumps - places[k]).argmin()] if len(jumps) else places[k]
            modes[k] = SweepMode.PUSH if places[k] < jump else SweepMode.BRAKE
        return modes

    def follow(self, data: PhaseData) -> Profile:
        """The motion on a grid, with internal forces amid their range."""
        a = np.interp(data.grid.s, (self.s[1:] + self.s[:-1]) / 2, self.slopes)
        b = np.interp(data.grid.s, self.s, self.b)
        limits = data.find_limits(data.nodes, self.margin)
        low, high = limits.find_internal_force_range(a, b)
        return Profile(a, b, find_middle(data, low, high)[1])


def find_fastest(data: PhaseData, duration: float | None) -> Fastest | None:
    """The minimum-time profile; with a duration [s], the one of that with the largest margin.

    None if there is no motion, or if not only the duration limits the margin.
    """
    samples, margin = LimitSamples.of(data, 0.0), 0.0
    try:
        if duration is not None:
            largest = _find_margin(data, samples, duration)
            if largest is None:
                return None
            samples, margin = LimitSamples.of(data, largest), largest
        return _find_at(samples, margin)
    except NoMotionError:
        return None


def _find_at(samples: LimitSamples, margin: float) -> Fastest:
    s, b, modes, b_middle = _sweep(samples, samples.rows, 1)
    steps, middle = np.diff(s), samples.rows.pick(slice(1, None, 2))
    pushed, braked = (middle.extreme(b_middle, largest).a for largest in (True, False))
    # In an interval with a switch s'' is first the largest, then the least.
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (np.diff(b) / 2 - braked * steps) / (pushed - braked)
    places, index = samples.s, np.arange(len(samples.s)) // 2
    switched = modes[index] == SweepMode.SWITCH
    late = switched & (places - s[index] > first[index])
    share = np.array([_SHARES[SweepMode(mode)] for mode in modes.tolist()])[index] + late
    here = np.interp(places, s, b)
    before = (b[:-1] - 2 * pushed * s[:-1])[index] + 2 * pushed[index] * places
    after = (b[1:] - 2 * braked * s[1:])[index] + 2 * braked[index] * places
    here = np.where(switched, np.where(late, after, before), here)
    return Fastest(s, b, modes, samples.find_switches(here, share, index), margin)


def _sweep(
    samples: LimitSamples, limits: PathLimits, stride: int, b_guess: Array | None = None
) -> tuple[Array, Array, NDArray[np.int64], Array]:
    """Sweep with the middle of an interval every `2 stride` places, for limits at the places.

    Nodes s, b, modes, and b at the middles. Viscous terms are linearized about `b_guess` there.
    """
    places = np.append(samples.s, samples.length)
    s, middle = places[:: 2 * stride], slice(stride, len(samples.s), 2 * stride)
    part = (samples.s[middle] - s[:-1]) / np.diff(s)
    cap = np.append(limits.cap[:: 2 * stride], np.inf)
    motion = speed_sweep(limits.pick(middle), np.diff(s), part, cap, b_guess, 2)
    return s, motion.b, motion.modes, (1 - part) * motion.b[:-1] + part * motion.b[1:]


def _find_margin(data: PhaseData, samples: LimitSamples, duration: float) -> float | None:
    """The margin [N] with which the minimum time is a duration [s]: Illinois false position."""
    force, limits = data.curve.formation.scene.scales.force, samples.rows
    rate = (LimitSamples.of(data, force).rows.rows - limits.rows)[..., ONE] / force

    def evaluate(margin: float, stride: int, b_guess: Array | None) -> tuple[float, Array]:
        """Relative excess of the squared mean speed, nearly linear in the margin, and b."""
        s, b, _, b_guess = _sweep(samples, limits.relax(margin * rate), stride, b_guess)
        return (duration / float(find_duration(b, np.diff(s)))) ** 2 - 1, b_guess

    stride = max(len(samples.fractions) // 4, 1)
    at_low, b_guess = evaluate(0.0, stride, None)
    if at_low < 0:
        return None
    low, high, at_high, guess, side = 0.0, np.inf, -1.0, force, 0
    margin, last, slope = 0.0, at_low, -1.0
    for _ in range(_TRIES):
        try:
            value, b_guess = evaluate(guess, stride, b_guess)
            slope, margin, last = (value - last) / (guess - margin), guess, value
        except NoMotionError:
            value = -1.0
        if abs(value) < _CLOSE:
            break
        if value > 0:
            at_high, side = (at_high / 2 if side > 0 else at_high), 1
            low, at_low = guess, value
        else:
            at_low, side = (at_low / 2 if side < 0 else at_low), -1
            high, at_high = guess, value
        guess = low + at_low / (at_low - at_high) * (high - low) if np.isfinite(high) else 2 * low
    else:
        return None
    # One Newton step on the fine grid.
    return guess - evaluate(guess, 1, None)[0] / slope
