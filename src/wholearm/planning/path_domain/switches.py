"""Where along a curve a plan switches from one pair of limits to another.

At a place with a known speed, limits are half planes in s'' and the squeeze. A motion of least time
is in a corner of what they allow: that of the largest s'', or of the least. It switches where
another corner takes over, or from the largest to the least where what the speed gains at one suits
what it loses at the other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ..lower_bound.rows import Rows
from .corners import LimitSides
from .data import PhaseData
from .elements import DEGREE, Elements, Profile

_PICARD = 4
"""Rounds in which speeds and extremes of s'' are made to agree."""
_LOOKS = 320
"""Places at which corners are looked for, at least two in an interval between nodes."""
_CAPPED = np.iinfo(np.int64).max
"""Label of places where a speed limit decides."""
_AT_CAP = 1e-3
"""Share of the largest square of the speed within which it does."""
_SURE = 0.03
"""Share of the range of s'' within which it counts as the largest or the least."""
_FLICKER = 4e-3
"""Length over which changes of corners count as one, over that of the curve."""
_THIN = 1e-3
"""Range of s'', over its largest, below which limits leave no choice."""


class Switch(NamedTuple):
    """A place [m] where a motion switches, and whether s'' jumps from one extreme to the other."""

    place: float
    jumps: bool


def find_switches(data: PhaseData, profile: Profile, margin: float) -> list[Switch]:
    """Where a motion switches between limits, in the order of the curve.

    Parameters
    ----------
    data : PhaseData
    profile : Profile
        At its nodes, roughly that of a plan.
    margin : float, [N]
        Least margin of normal forces over epsilon.
    """
    sights = Sights.of(data, margin)
    here = Elements(data.grid, profile).at(sights.fractions)
    high, low = (sights.rows.extreme(here.b, largest).a for largest in (True, False))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (high - here.a) / (high - low)
    element = np.arange(len(here.b)) // (len(sights.fractions) * DEGREE)
    return sights.find_switches(here.b, share, element)


class Sights(NamedTuple):
    """Places of curves at which limits are looked at.

    Attributes
    ----------
    fractions : ndarray
        Of every interval inside elements.
    s : ndarray, shape (n,), [m]
        Interval by interval.
    sides : LimitSides
        Of limits there.
    rows : Rows
        The same without the squeeze.
    segment : ndarray of int, shape (n,)
        Of the curves.
    length : float, [m]
        Of the curves.
    """

    fractions: Array
    s: Array
    sides: LimitSides
    rows: Rows
    segment: NDArray[np.int64]
    length: float

    @staticmethod
    def of(data: PhaseData, margin: float) -> Sights:
        """Some of the checks between nodes: an even number in each interval, with its start."""
        fractions, k = data.sampling.checks, data.nonempty
        wanted = max(_LOOKS // len(k), 2)
        picked = np.arange(0, len(fractions) - 1, max(1, (len(fractions) - 1) // wanted))
        places = (len(fractions) * np.arange(len(k))[:, None] + picked).ravel()
        sides = LimitSides.of(data, data.checks.pick(places), margin)
        s = (data.grid.s[k, None] + fractions[picked] * data.grid.steps[k, None]).ravel()
        segment = np.repeat(data.grid.segment[k], len(picked))
        length = float(data.grid.s[-1])
        return Sights(fractions[picked], s, sides, sides.eliminate(), segment, length)

    def find_switches(self, b: Array, share: Array, element: NDArray[np.int64]) -> list[Switch]:
        """Where a motion switches; see `_Looks` for what it has to be known of."""
        high, low = (self.rows.extreme(b, largest) for largest in (True, False))
        # Across a reversal limits are others, and an element ends there anyway.
        span, found = high.a - low.a, list[Switch]()
        choice = np.isfinite(span) & (span > _THIN * np.abs(high.a))
        for segment in sorted(set(self.segment.tolist())):
            own = np.flatnonzero(choice & (self.segment == segment))
            looks = _Looks(
                self.s[own],
                b[own],
                self.sides.pick(own),
                self.rows.pick(own),
                high.row[own],
                low.row[own],
                share[own],
                element[own],
            )
            found += looks.find_switches(_FLICKER * self.length)
        return found


class _Looks(NamedTuple):
    """What limits allow at n places along a curve where they leave a choice.

    Attributes
    ----------
    s : ndarray, [m]
    b : ndarray, [m^2/s^2]
        Of the motion there.
    sides : LimitSides
    rows : Rows
    at_high, at_low : ndarray of int
        Which of them set the largest and the least s''.
    share : ndarray
        How far s'' is from its largest, over the range that limits allow.
    element : ndarray of int
        That each place belongs to.
    """

    s: Array
    b: Array
    sides: LimitSides
    rows: Rows
    at_high: NDArray[np.int64]
    at_low: NDArray[np.int64]
    share: Array
    element: NDArray[np.int64]

    @property
    def rises(self) -> NDArray[np.bool_]:
        """Whether s'' is nearer to its largest than to its least."""
        return np.asarray(self.share < 0.5)

    @property
    def label(self) -> NDArray[np.int64]:
        """The limits that the motion is at, or nearest to; negative for the least s''.

        `_CAPPED` where it is a speed limit that decides.
        """
        row = np.where(self.rises, self.at_high, -1 - self.at_low)
        return np.where(self.b > (1 - _AT_CAP) * self.rows.cap, _CAPPED, row)

    def find_switches(self, flicker: float) -> list[Switch]:
        """Where limits take turns; changes nearer to each other than `flicker` [m] are one."""
        label = self.label
        changes = np.flatnonzero(label[1:] != label[:-1])
        if not len(changes):
            return []
        apart, found = np.diff(self.s[changes]) > flicker, list[Switch]()
        for cluster in np.split(changes, np.flatnonzero(apart) + 1):
            first, last = int(cluster[0]), int(cluster[-1]) + 1
            if label[first] == label[last]:
                continue
            capped = _CAPPED in (label[first], label[last])
            if not capped and self.rises[first] == self.rises[last]:
                found.append(Switch(self.find_crossing(first, last), False))
                continue
            place = self.find_jump(first, last)
            found += [] if place is None else [Switch(place, True)]
        return found

    def find_crossing(self, first: int, last: int) -> float:
        """Where other limits take over as those of the extreme s'', between two places [m]."""
        ends = np.array([first, last])
        own = (self.at_high if self.rises[first] else self.at_low)[ends]
        sides = self.sides.pick(ends)
        # A pair of sides that bounds s'' here may not do so there, but they meet somewhere.
        before, after = (sides.meet(self.b[ends], sides.pair(row))[0] for row in own)
        lead = before - after
        done = lead[0] / (lead[0] - lead[1]) if lead[0] * lead[1] < 0 else 0.5
        return float(self.s[first] + done * (self.s[last] - self.s[first]))

    def find_jump(self, first: int, last: int) -> float | None:
        """Where s'' jumps from one extreme to the other [m], if it does.

        From the last element before that is at one extreme throughout, the speed is continued
        along that extreme, and backwards from the first one after along the other; they meet there.
        Where a speed limit decides on one side, that is what they meet.
        """
        capped = self.label == _CAPPED
        off = (np.minimum(self.share, 1 - self.share) > _SURE) & ~capped
        along = capped[[first, last]]
        first = int(np.flatnonzero(~off[: first + 1]).max(initial=0))
        last = last + int(np.argmin(off[last:]))
        within = (self.element >= self.element[first]) & (self.element <= self.element[last])
        own = np.flatnonzero(within)
        # The first place of the next element is where this one ends.
        own = np.append(own, own[-1] + 1) if own[-1] + 1 < len(self.s) else own
        rises = bool(self.rises[first])
        s, b, rows = self.s[own], self.b[own], self.rows.pick(own)
        steps, one, other = np.diff(s), b, b
        largest = rises or bool(along.any()), not rises and not along.any()
        for _ in range(_PICARD):
            rates = (
                rows.extreme(np.maximum(part, 0.0), most).a
                for part, most in zip((one, other), largest, strict=True)
            )
            before, after = (np.where(np.isfinite(rate), rate, 0.0) for rate in rates)
            one = b[0] + np.append(0.0, np.cumsum(steps * (before[1:] + before[:-1])))
            gained = np.append(0.0, np.cumsum(steps * (after[1:] + after[:-1])))
            other = b[-1] + gained - gained[-1]
            one, other = (
                np.where(cap, rows.cap, part) for cap, part in zip(along, (one, other), strict=True)
            )
        ahead = (other - one) * (1 if largest[0] else -1)
        passed = np.flatnonzero((ahead[1:] <= 0) & (ahead[:-1] > 0))
        if not len(passed):
            return None
        k = int(passed[0])
        return float(s[k] + steps[k] * ahead[k] / (ahead[k] - ahead[k + 1]))
