"""The fastest motion along curves, by a sweep over the plane of s and b: what the NLP starts from.

It says about where a plan of least time switches. A plan of the largest margin is the fastest one
with that margin, as long as its duration is all that keeps the margin from being larger.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...common.shortfalls import Parameter
from ..lower_bound.rows import PathLimitRows
from ..lower_bound.speed_sweep import NoMotionError, SweepMode
from ..lower_bound.speed_sweep import find_fastest as sweep
from .path_data import PhaseData
from .switches import Sights, Switch

_SHARES = {SweepMode.PUSH: 0.0, SweepMode.SWITCH: 0.0, SweepMode.BRAKE: 1.0, SweepMode.HELD: 0.5}
"""How far s'' is from its largest, over the range that limits allow."""
_CLOSE = 1e-4  # error of the duration that is good enough for a margin, relatively
_TRIES = 40  # most margins that are tried
_SAME = 1e-4
"""Difference of margins, relatively, with one of which there is a motion and with one none."""


_WIDER = 5e-3
"""By how much limits are wider, over what is much for each, where it is sure that they are."""
_FREE = 1e6  # the same for limits that do not count
_GRADES = (1e-4, 1e-3, 1e-2)
"""Ends of elements next to an end that limits the margin, over the length of the curve."""


class Fastest(NamedTuple):
    """The fastest motion that a sweep has found."""

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
            near = jumps[np.abs(jumps - places[k]).argmin()] if len(jumps) else places[k]
            modes[k] = SweepMode.PUSH if places[k] < near else SweepMode.BRAKE
        return modes


class Narrow(NamedTuple):
    """Where it is no duration that limits the margin but a place, what surrounds that place."""

    switches: list[Switch]

    @staticmethod
    def about(start: float, stop: float, length: float) -> Narrow:
        """About an interval of a curve with a length [m]; at an end of it ever more finely."""
        near = length * np.array(_GRADES)
        places = np.array([start, stop])
        if start < near[-1]:
            places = near
        elif stop > length - near[-1]:
            places = length - near
        return Narrow([Switch(float(place), False) for place in np.sort(places)])


def find_fastest(data: PhaseData, duration: float | None) -> Fastest | Narrow | None:
    """The fastest motion, or if a duration [s] is given, the one of that with the largest margin.

    None if there is no motion.
    """
    sights, margin = Sights.of(data, 0.0), 0.0
    try:
        if duration is not None:
            found = _find_margin(data, sights, duration)
            if found is None or isinstance(found, Narrow):
                return found
            sights, margin = Sights.of(data, found), found
        return _find_at(sights, margin)
    except NoMotionError:
        return None


def is_hopeless(data: PhaseData, spared: Parameter | None = None) -> bool:
    """Whether no motion keeps the limits, nor would if each were a little wider.

    Without those that a parameter sets, if one is to be `spared`.
    """
    sights, free = Sights.of(data, 0.0), np.zeros(len(data.spans), dtype=bool)
    if spared is not None:
        free = data.limits.weigh(spared)[data.limits.sides[0]] > 0
    cap = np.inf if spared is not None and spared.is_speed else 1 + _WIDER
    rest = np.where(free, _FREE, sights.sides.rest + _WIDER)
    rows = sights.sides._replace(rest=rest, cap=cap * sights.sides.cap).eliminate()
    if rows.v.any():
        # Viscous friction may help by as much as it is at the largest speed.
        most = np.sqrt(rows.highest())[:, None]
        helps = np.multiply(np.abs(rows.v), most, out=np.zeros_like(rows.v), where=rows.v != 0)
        rows = rows._replace(one=rows.one + np.minimum(helps, _FREE), v=np.zeros_like(rows.v))
    try:
        _sweep(sights, rows, 1, None)
    except NoMotionError:
        return True
    return False


def _find_at(sights: Sights, margin: float) -> Fastest:
    s, b, modes, near = _sweep(sights, sights.rows, 1, None)
    steps, middle = np.diff(s), sights.rows.pick(slice(1, None, 2))
    pushed, braked = (middle.extreme(near, largest).a for largest in (True, False))
    # In an interval with a switch s'' is first the largest, then the least.
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (np.diff(b) / 2 - braked * steps) / (pushed - braked)
    places, index = sights.s, np.arange(len(sights.s)) // 2
    switched = modes[index] == SweepMode.SWITCH
    late = switched & (places - s[index] > first[index])
    share = np.array([_SHARES[SweepMode(mode)] for mode in modes.tolist()])[index] + late
    here = np.interp(places, s, b)
    before = (b[:-1] - 2 * pushed * s[:-1])[index] + 2 * pushed[index] * places
    after = (b[1:] - 2 * braked * s[1:])[index] + 2 * braked[index] * places
    here = np.where(switched, np.where(late, after, before), here)
    return Fastest(s, b, modes, sights.find_switches(here, share, index), margin)


def _sweep(
    sights: Sights, rows: PathLimitRows, stride: int, near: Array | None
) -> tuple[Array, Array, NDArray[np.int64], Array]:
    """A sweep with a middle of an interval every `2 stride` places, for limits `rows` there.

    Also returns b at those middles; `near` is what it is about.
    """
    places = np.append(sights.s, sights.length)
    s, middle = places[:: 2 * stride], slice(stride, len(sights.s), 2 * stride)
    inner, steps = rows.pick(middle), np.diff(s)
    part = (sights.s[middle] - s[:-1]) / steps
    cap = np.append(rows.cap[:: 2 * stride], np.inf)
    if near is None and inner.v.any():
        # Viscous friction is linearised about a motion without it, for which few places will do.
        wide = max(len(sights.fractions) // 2, stride)
        ends, b, *_ = _sweep(sights, rows._replace(v=np.zeros_like(rows.v)), wide, None)
        near = np.interp(sights.s[middle], ends, b)
    found = sweep(inner, steps, part, cap, near)
    return s, found.b, found.modes, (1 - part) * found.b[:-1] + part * found.b[1:]


class _Margins(NamedTuple):
    """Sweeps for several margins: limits at `sights`, and by how much they give way per newton."""

    sights: Sights
    rate: Array

    def find_lead(
        self, margin: float, duration: float, stride: int, near: Array | None
    ) -> tuple[float, Array]:
        """How much the fastest motion is ahead of a duration [s], and b in its intervals.

        As squares of mean speeds, over that wanted: about linear in the margin [N].
        """
        rows = self.sights.rows
        rows = rows._replace(one=rows.one + margin * self.rate)
        s, b, _, near = _sweep(self.sights, rows, stride, near)
        speed = np.sqrt(b)
        lasts = float((2 * np.diff(s) / (speed[1:] + speed[:-1])).sum())
        return (duration / lasts) ** 2 - 1, near


def _find_margin(data: PhaseData, sights: Sights, duration: float) -> float | Narrow | None:
    """The margin with which the fastest motion takes so long [N]: by false position."""
    force = data.curve.formation.scene.scales.force
    margins = _Margins(sights, (Sights.of(data, force).rows.one - sights.rows.one) / force)
    stride = max(len(sights.fractions) // 4, 1)
    ahead, near = margins.find_lead(0.0, duration, stride, None)
    if ahead < 0:
        return None
    low, high, behind, guess, kept = 0.0, np.inf, -1.0, force, 0
    margin, last, slope = 0.0, ahead, -1.0
    stuck: int | None = None
    for _ in range(_TRIES):
        blocked = None
        try:
            lead, near = margins.find_lead(guess, duration, stride, near)
            slope, margin, last = (lead - last) / (guess - margin), guess, lead
        except NoMotionError as error:
            lead, blocked = -1.0, error.interval
        if abs(lead) < _CLOSE:
            break
        # An end that is kept again and again would be near the root for ever.
        if lead > 0:
            behind, kept = (behind / 2 if kept > 0 else behind), 1
            low, ahead = guess, lead
        else:
            ahead, kept = (ahead / 2 if kept < 0 else ahead), -1
            high, behind, stuck = guess, lead, blocked
        if stuck is not None and high - low < _SAME * high:
            places = np.append(sights.s, sights.length)[2 * stride * np.arange(stuck, stuck + 2)]
            return Narrow.about(float(places[0]), float(places[1]), sights.length)
        guess = low + ahead / (ahead - behind) * (high - low) if np.isfinite(high) else 2 * low
    else:
        return None
    # Coarse intervals err a little.
    return guess - margins.find_lead(guess, duration, 1, None)[0] / slope
