"""Switches of active limits along a curve, estimated from a nearly optimal motion.

At a place with a known speed, limits are a polygon in s'' and internal force. A minimum-time motion
is at its vertex of largest or least s''. It switches where another vertex takes over, or from the
largest to the least s'' where the speeds integrated along both from either side meet.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ..lower_bound.rows import LimitSides, PathLimitRows
from .elements import DEGREE, Elements, Profile
from .path_data import PhaseData

_PICARD = 4  # Picard iterations between speeds and extremes of s''
_SAMPLES = 320  # places at which vertices are found, at least two in an interval
_CAPPED = np.iinfo(np.int64).max  # label of places with an active speed limit
_AT_CAP = 1e-3  # relative distance of b from its limit at which it is active
_AT_EXTREME = 0.03  # distance of s'' from an extreme that counts as none, over its range
_FLICKER = 4e-3  # distance of changes that count as one, over the curve's length
_THIN = 1e-3  # range of s'', over its largest, below which limits leave no choice


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
    samples = Samples.of(data, margin)
    here = Elements(data.grid, profile).at(samples.fractions)
    high, low = (samples.rows.extreme(here.b, largest).a for largest in (True, False))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (high - here.a) / (high - low)
    element = np.arange(len(here.b)) // (len(samples.fractions) * DEGREE)
    return samples.find_switches(here.b, share, element)


class Samples(NamedTuple):
    """Limits sampled along curves."""

    fractions: Array  # of every interval inside elements
    s: Array  # (n,) [m]: interval by interval
    sides: LimitSides  # of limits there
    rows: PathLimitRows  # the same without the internal force
    segment: NDArray[np.int64]  # (n,): of the curves
    length: float  # [m]: of the curves

    @staticmethod
    def of(data: PhaseData, margin: float) -> Samples:
        """Some of the checks between nodes: an even number in each interval, with its start."""
        fractions, k = data.sampling.checks, data.nonempty
        wanted = max(_SAMPLES // len(k), 2)
        picked = np.arange(0, len(fractions) - 1, max(1, (len(fractions) - 1) // wanted))
        places = (len(fractions) * np.arange(len(k))[:, None] + picked).ravel()
        sides = data.list_sides(data.checks.pick(places), margin)
        s = (data.grid.s[k, None] + fractions[picked] * data.grid.steps[k, None]).ravel()
        segment, length = np.repeat(data.grid.segment[k], len(picked)), float(data.grid.s[-1])
        return Samples(fractions[picked], s, sides, sides.eliminate(), segment, length)

    def find_switches(self, b: Array, share: Array, element: NDArray[np.int64]) -> list[Switch]:
        """Switches of a motion; see `_Looks` for its arguments."""
        high, low = (self.rows.extreme(b, largest) for largest in (True, False))
        span, switches = high.a - low.a, list[Switch]()
        choice = np.isfinite(span) & (span > _THIN * np.abs(high.a))
        # Across a reversal limits are others, and an element ends there anyway.
        for segment in sorted(set(self.segment.tolist())):
            k = np.flatnonzero(choice & (self.segment == segment))
            limits = self.sides.pick(k), self.rows.pick(k), high.row[k], low.row[k]
            looks = _Looks(self.s[k], b[k], *limits, share[k], element[k])
            switches += looks.find_switches(_FLICKER * self.length)
        return switches


class _Looks(NamedTuple):
    """Limits and motion at n places of a segment where limits leave a choice."""

    s: Array  # [m]
    b: Array  # [m^2/s^2]: of the motion there
    sides: LimitSides
    rows: PathLimitRows
    at_high: NDArray[np.int64]  # at_high, at_low: rows that set the largest and the least s''
    at_low: NDArray[np.int64]
    share: Array  # distance of s'' from its largest, over the range that limits allow
    element: NDArray[np.int64]  # that each place belongs to

    @property
    def rises(self) -> NDArray[np.bool_]:
        """Whether s'' is nearer to its largest than to its least."""
        return np.asarray(self.share < 0.5)

    @property
    def label(self) -> NDArray[np.int64]:
        """The active or nearest row; negative for the least s'', `_CAPPED` for a speed limit."""
        row = np.where(self.rises, self.at_high, -1 - self.at_low)
        return np.where(self.b > (1 - _AT_CAP) * self.rows.cap, _CAPPED, row)

    def find_switches(self, flicker: float) -> list[Switch]:
        """Switches of rows; changes nearer to each other than `flicker` [m] are one."""
        label, switches = self.label, list[Switch]()
        changes = np.flatnonzero(label[1:] != label[:-1])
        if not len(changes):
            return switches
        apart = np.diff(self.s[changes]) > flicker
        for cluster in np.split(changes, np.flatnonzero(apart) + 1):
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
        active = (self.at_high if self.rises[first] else self.at_low)[ends]
        sides = self.sides.pick(ends)
        # A pair of sides that bounds s'' here may not do so there, but they meet somewhere.
        before, after = (sides.meet(self.b[ends], sides.pair(row))[0] for row in active)
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
        off = (np.minimum(self.share, 1 - self.share) > _AT_EXTREME) & ~capped
        along = capped[[first, last]]
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
        for _ in range(_PICARD):
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
