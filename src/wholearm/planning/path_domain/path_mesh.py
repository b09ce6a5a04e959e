"""Grids of elements that end where a motion switches from one active limit to another.

Where a plan of least time switches is first told by a reachability sweep (`Fastest`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, sort_unique
from ...geometry.curve import Curve
from ...mechanics.path_limits import Extreme, PathLimits
from ...mechanics.speed_sweep import NoMotionError, SweepMode, speed_sweep
from .path_data import PhaseData, find_torques
from .path_motion import DEGREE, NODES, Grid, PathMotion, Profile, lay_out

_CAPPED = np.iinfo(np.int64).max  # label of places with an active speed limit
# Least length of an element that switches lead to, over the curve's; and under rate limits, as the
# time from rest is the cube root of the distance: phase 1 of the hexagon at 500 N m/s.
_APART, _APART_HELD = 1e-5, 1e-8
# Distance of s'' from its largest, over the range that limits allow, in intervals of a sweep.
_SHARES = {SweepMode.PUSH: 0.0, SweepMode.SWITCH: 0.0, SweepMode.BRAKE: 1.0, SweepMode.HELD: 0.5}


def make_grid(
    curve: Curve,
    breaks: Array,
    elements: int,
    rests: tuple[bool, bool] = (True, True),
    held: bool = False,
) -> Grid:
    """Grid of a curve with breaks [m], fine towards its ends (where the motion is slow)."""
    ends = find_ends(curve, breaks)
    angles = np.arccos(1 - 2 * np.clip(ends / curve.length, 0.0, 1.0))
    counts = share_out(elements, np.diff(angles))
    places = np.repeat(np.arange(len(counts)), counts)
    done = np.concatenate([np.arange(count) / count for count in counts])
    starts = angles[places] + done * np.diff(angles)[places]
    edges = curve.length * (1 - np.cos(starts)) / 2
    edges[done == 0] = ends[:-1]
    pairs = np.stack([edges, np.append(edges[1:], ends[-1])], axis=1)
    stops = [segment.stop for segment in curve.segments]
    return lay_out(pairs, np.searchsorted(stops[:-1], pairs.mean(axis=1)), rests, held)


def share_out(elements: int, weights: Array) -> NDArray[np.int64]:
    """Share out elements by weights, at least one each."""
    # Halves go up whatever their last bit is.
    wanted = weights / weights.sum() * elements + 0.5 + 1e-6
    counts = np.maximum(1, np.floor(wanted).astype(int))
    while counts.sum() != elements:
        counts[np.argmax(counts)] += np.sign(elements - counts.sum())
    return np.asarray(counts)


def find_ends(curve: Curve, breaks: Array) -> Array:
    """Ends of the stretches between breaks and reversals of a curve [m]."""
    return sort_unique(np.array([0.0, *(segment.stop for segment in curve.segments), *breaks]))


def halve(edges: Array, costs: Array, count: int) -> Array:
    """Inner ends of elements (E, 2) [m], of which the dearest are halved, `count` times.

    The cost falls with the sixth power of an element's length where the plan is smooth.
    """
    stops, price = edges[:, 1].tolist(), costs.reshape(len(edges), -1).sum(axis=1).tolist()
    starts = edges[:, 0].tolist()
    for _ in range(count):
        k = int(np.argmax(price))
        middle = (starts[k] + stops[k]) / 2
        starts.insert(k + 1, middle)
        stops.insert(k, middle)
        price[k : k + 1] = [price[k] / 2**6] * 2
    return np.array(starts[1:])


def match(breaks: Array, switches: Sequence[Switch], curve: Curve) -> tuple[Array, float]:
    """Breaks moved to switches near them, with new ones, and their shift.

    None is given up: a switch at an element's end may not show.
    """
    fixed, least = find_ends(curve, np.zeros(0)), _APART * curve.length
    moved, fresh, shift = dict[int, float](), list[float](), 0.0
    for place, jumps in switches:
        far = np.abs(breaks - place)
        far[list(moved)] = np.inf
        if far.min(initial=np.inf) < 0.02 * curve.length:  # it belongs to that break
            moved[int(far.argmin())] = place
            shift = max(shift, float(far.min()) / curve.length)
        elif np.abs(np.concatenate([fixed, breaks, fresh]) - place).min() > least:
            fresh.append(place)
            shift = np.inf if jumps or not len(breaks) else shift
    every = sorted([*(moved.get(k, place) for k, place in enumerate(breaks)), *fresh])
    return keep_apart(curve, np.array(every)), shift


def keep_apart(curve: Curve, places: Array, held: bool = False) -> Array:
    """Increasing places with a least distance to reversals and to those before in the list [m].

    It is smaller where motions start and end without acceleration (`held`).
    """
    least = (_APART_HELD if held else _APART) * curve.length
    kept = find_ends(curve, np.zeros(0)).tolist()
    count = len(kept)
    for place in places.tolist():
        if min(abs(place - other) for other in kept) > least:
            kept.append(place)
    return np.sort(kept[count:])


class Switch(NamedTuple):
    """A place [m] where a motion switches, and whether s'' jumps from one extreme to the other."""

    place: float
    jumps: bool


def find_switches(data: PhaseData, profile: Profile, margin: float) -> list[Switch]:
    """Where a motion switches between limits, in the order of the curve.

    Parameters
    ----------
    profile       at its nodes, roughly that of a plan
    margin : [N]  least margin of normal forces over epsilon
    """
    samples = LimitSamples.of(data, margin)
    here = data.interpolate(profile, samples.fractions)
    high, low = samples.find_extremes(here.b)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (high.a - here.a) / (high.a - low.a)
    element = np.arange(len(here.b)) // (len(samples.fractions) * DEGREE)
    return samples.find_switches(here.b, share, element, high, low)


class LimitSamples(NamedTuple):
    """Limits sampled along curves."""

    fractions: Array  # of every interval inside elements
    s: Array  # (n,) [m]: interval by interval
    sides: PathLimits  # limits there
    rows: PathLimits  # the same without the internal force
    segment: NDArray[np.int64]  # (n,): of the curves
    length: float  # [m]: of the curves

    @staticmethod
    def of(data: PhaseData, margin: float) -> LimitSamples:
        """Some of the checks between nodes: an even number in each interval, with its start."""
        fractions, k = data.sampling.checks, data.grid.nonempty
        wanted = max(320 // len(k), 2)  # places, at least two in an interval
        picked = np.arange(0, len(fractions) - 1, max(1, (len(fractions) - 1) // wanted))
        places = (len(fractions) * np.arange(len(k))[:, None] + picked).ravel()
        sides = data.find_limits(data.checks.pick(places), margin)
        s = (data.grid.s[k, None] + fractions[picked] * data.grid.steps[k, None]).ravel()
        segment, length = np.repeat(data.grid.segment[k], len(picked)), float(data.grid.s[-1])
        return LimitSamples(fractions[picked], s, sides, sides.eliminate(), segment, length)

    def find_extremes(self, b: Array) -> tuple[Extreme, Extreme]:
        """The largest and the least s'' for b of shape (n,)."""
        return self.rows.extreme(b, True), self.rows.extreme(b, False)

    def find_switches(
        self, b: Array, share: Array, element: NDArray[np.int64], high: Extreme, low: Extreme
    ) -> list[Switch]:
        """Switches of a motion with these extremes of s''; see `_Looks` for the rest."""
        span, switches = high.a - low.a, list[Switch]()
        choice = np.isfinite(span) & (span > 1e-3 * np.abs(high.a))  # else there is no choice
        row = np.where(share < 0.5, high.row, low.row)
        label = np.where(share < 0.5, row, -1 - row)
        label[b > (1 - 1e-3) * self.rows.cap] = _CAPPED  # active
        # Across a reversal limits are others, and an element ends there anyway.
        for segment in sorted(set(self.segment.tolist())):
            k = np.flatnonzero(choice & (self.segment == segment))
            motion = self.s[k], b[k], share[k], element[k], row[k], label[k]
            looks = _Looks(*motion, self.sides.pick(k), self.rows.pick(k))
            switches += looks.find_switches(4e-3 * self.length)  # nearer ones are one change
        return switches


class _Looks(NamedTuple):
    """Limits and motion at n places of a segment where limits leave a choice."""

    s: Array  # [m]
    b: Array  # [m^2/s^2]: of the motion there
    share: Array  # distance of s'' from its largest, over the range that limits allow
    element: NDArray[np.int64]  # that each place belongs to
    row: NDArray[np.int64]  # that sets the nearer one of the largest and the least s''
    label: NDArray[np.int64]  # the row, negative for the least s''; `_CAPPED` for a speed limit
    sides: PathLimits
    rows: PathLimits

    @property
    def rises(self) -> NDArray[np.bool_]:
        """Whether s'' is nearer to its largest than to its least."""
        return np.asarray(self.share < 0.5)

    def find_switches(self, flicker: float) -> list[Switch]:
        """Switches of rows; changes nearer to each other than `flicker` [m] are one."""
        label, switches = self.label, list[Switch]()
        changes = np.flatnonzero(label[1:] != label[:-1])
        if not len(changes):
            return switches
        for cluster in np.split(changes, np.flatnonzero(np.diff(self.s[changes]) > flicker) + 1):
            first, last = int(cluster[0]), int(cluster[-1]) + 1
            if label[first] == label[last]:
                continue
            capped = _CAPPED in (label[first], label[last])
            if not capped and self.rises[first] == self.rises[last]:
                switches.append(Switch(self.find_crossing(first, last), False))
            elif (place := self.find_jump(first, last)) is not None:
                switches.append(Switch(place, True))
        return switches

    def find_crossing(self, first: int, last: int) -> float:
        """Where another vertex takes over as that of the extreme s'', between two places [m]."""
        ends = np.array([first, last])
        sides = self.sides.pick(ends)
        # A pair of sides that bounds s'' here may not do so there, but they meet somewhere.
        before, after = (sides.meet(self.b[ends], sides.pair(row))[0] for row in self.row[ends])
        lead = before - after
        done = lead[0] / (lead[0] - lead[1]) if lead[0] * lead[1] < 0 else 0.5
        return float(self.s[first] + done * (self.s[last] - self.s[first]))

    def find_jump(self, first: int, last: int) -> float | None:
        """Where s'' jumps from one extreme to the other [m], if it does.

        The speed is integrated forwards along one extreme from the last element at it throughout,
        and backwards along the other from the first such element after. An active speed limit
        takes the place of either.
        """
        capped = self.label == _CAPPED
        off = (np.minimum(self.share, 1 - self.share) > 0.03) & ~capped  # at neither extreme
        along = capped[[first, last]]
        # Case: a rolling tip at the largest epsilon that its cone allows.
        first = int(np.flatnonzero(~off[: first + 1]).max(initial=0))
        last = last + int(np.argmin(off[last:]))
        within = (self.element >= self.element[first]) & (self.element <= self.element[last])
        k = np.flatnonzero(within)
        # The first place of the next element is where this one ends.
        k = np.append(k, k[-1] + 1) if k[-1] + 1 < len(self.s) else k
        rises = bool(self.rises[first])
        s, b, rows = self.s[k], self.b[k], self.rows.pick(k)
        steps, one, other = np.diff(s), b, b
        largest = rises or bool(along.any()), not rises and not along.any()
        for _ in range(4):  # Picard iterations between speeds and extremes of s''
            gains = []
            for part, most in zip((one, other), largest, strict=True):
                rate = rows.extreme(np.maximum(part, 0.0), most).a
                rate = np.where(np.isfinite(rate), rate, 0.0)
                gains.append(np.append(0.0, np.cumsum(steps * (rate[1:] + rate[:-1]))))
            one = np.where(along[0], rows.cap, b[0] + gains[0])
            other = np.where(along[1], rows.cap, b[-1] + gains[1] - gains[1][-1])
        gap = (other - one) * (1 if largest[0] else -1)
        crossed = np.flatnonzero((gap[1:] <= 0) & (gap[:-1] > 0))
        if not len(crossed):
            return None
        i = int(crossed[0])
        return float(s[i] + steps[i] * gap[i] / (gap[i] - gap[i + 1]))


class Fastest(NamedTuple):
    """Minimum-time speed profile of a sweep."""

    s: Array  # (N + 1,) [m]
    b: Array  # (N + 1,) [m^2/s^2]
    switches: list[Switch]

    @property
    def slopes(self) -> tuple[Array, Array]:
        """Middles of the intervals [m] and the s'' of each, shape (N,) [m/s^2]."""
        return (self.s[1:] + self.s[:-1]) / 2, np.diff(self.b) / (2 * np.diff(self.s))


def find_fastest(data: PhaseData) -> Fastest | None:
    """The minimum-time profile by a reachability sweep; None if there is no motion."""
    samples = LimitSamples.of(data, 0.0)
    places = np.append(samples.s, samples.length)
    s, middle = places[::2], samples.rows.pick(slice(1, None, 2))
    steps = np.diff(s)
    part, cap = (samples.s[1::2] - s[:-1]) / steps, np.append(samples.rows.cap[::2], np.inf)
    try:
        b, modes, _ = speed_sweep(middle, steps, part, cap, sweeps=2)
    except NoMotionError:
        return None
    b_middle = (1 - part) * b[:-1] + part * b[1:]
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
    switches = samples.find_switches(here, share, index, *samples.find_extremes(here))
    return Fastest(s, b, switches)


def equidistribute(part: PhaseData, motion: PathMotion, costs: Array, elements: int) -> Array:
    """Breaks between elements that share costs and changes of torque rates evenly [m] (de Boor).

    Of the density over time equal shares are even, the root of the variation of the rates, and the
    cube root of the `costs` of keeping limits between nodes, shape (N + 1,).
    """
    rates = find_torques(part, motion.profile, [motion])[1]
    most = np.maximum(np.abs(rates).max(axis=(0, 1)), part.torque_limit / motion.duration)
    changes = np.abs(np.diff((rates / most).reshape(-1, 2), axis=0, prepend=0.0)).sum(axis=1)
    variation = changes.reshape(len(part.grid.edges), -1).sum(axis=1)
    ends = motion.times.reshape(-1, NODES)
    spans = ends[:, -1] - ends[:, 0]
    density = np.sqrt(variation * spans)
    parts = density, spans, np.cbrt(costs.reshape(len(spans), -1).sum(axis=1))
    shares = np.sum([part / max(part.sum(), 1e-300) for part in parts], axis=0)
    done, t = np.append(0.0, np.cumsum(shares)), np.append(ends[:, 0], ends[-1, -1])
    stops = part.grid.edges[:, 1]
    fixed = np.array(
        [0.0, *(done[1:][stops == segment.stop][0] for segment in part.curve.segments)]
    )
    inner = [
        np.linspace(*pair, count + 1)[1:-1]
        for pair, count in zip(pairwise(fixed), share_out(elements, np.diff(fixed)), strict=True)
    ]
    return motion.locate(np.interp(np.concatenate(inner), done, t))[0]
