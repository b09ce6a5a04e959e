"""Where along a curve a plan switches from one pair of limits to another.

At a place with a known speed, limits are half planes in s'' and the squeeze. A motion of least time
is in a corner of what they allow: that of the largest s'', or of the least. It switches where
another corner takes over, or from the largest to the least where what the speed gains at one suits
what it loses at the other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.limits import PRESS, SideTerms
from ..lower_bound.rows import PathLimitRows, eliminate
from .elements import DEGREE, Elements, Profile
from .path_data import PhaseData, Places

_PICARD = 4  # rounds in which speeds and extremes of s'' are made to agree
_LOOKS = 320  # places at which corners are looked for, at least two in an interval between nodes
_CAPPED = np.iinfo(np.int64).max  # label of places where a speed limit decides
_AT_CAP = 1e-3  # share of the largest square of the speed within which it does
_SURE = 0.03  # share of the range of s'' within which it counts as the largest or the least
_FLICKER = 4e-3  # length over which changes of corners count as one, over that of the curve
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
    sights = Sights.of(data, margin)
    here = Elements(data.grid, profile).at(sights.fractions)
    high, low = (sights.rows.extreme(here.b, largest).a for largest in (True, False))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (high - here.a) / (high - low)
    element = np.arange(len(here.b)) // (len(sights.fractions) * DEGREE)
    return sights.find_switches(here.b, share, element)


class Sights(NamedTuple):
    """Places of curves at which limits are looked at."""

    fractions: Array  # of every interval inside elements
    s: Array  # (n,) [m]: interval by interval
    sides: LimitSides  # of limits there
    rows: PathLimitRows  # the same without the squeeze
    segment: NDArray[np.int64]  # (n,): of the curves
    length: float  # [m]: of the curves

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
    """What limits allow at n places along a curve where they leave a choice."""

    s: Array  # [m]
    b: Array  # [m^2/s^2]: of the motion there
    sides: LimitSides
    rows: PathLimitRows
    at_high: NDArray[np.int64]  # at_high, at_low: which of them set the largest and the least s''
    at_low: NDArray[np.int64]
    share: Array  # how far s'' is from its largest, over the range that limits allow
    element: NDArray[np.int64]  # that each place belongs to

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


class LimitSides(NamedTuple):
    """Sides of limits, slack = rest + b bend + s' drag + a rate + squeeze press, at n places.

    Each of shape (n, n_sides), over what is much for a side. `cap` is the b that speed limits
    allow, shape (n,) [m^2/s^2].
    """

    rest: Array
    bend: Array
    drag: Array
    rate: Array
    press: Array
    cap: Array

    @staticmethod
    def of(data: PhaseData, places: Places, margin: float) -> LimitSides:
        """The sides of the limits of phases, for a margin of normal forces over epsilon [N]."""
        terms = SideTerms.of(data.limits, places.forces, places.rates)
        rows = data.limits.sides[0]
        pressing = np.isin(rows, data.limits.of(PRESS))
        rest = terms.rest - margin * pressing / data.spans
        return LimitSides(rest, *terms[1:], data.largest_b(places))

    def pick(self, rows: Any) -> LimitSides:
        """Some of the places."""
        return LimitSides(*(part[rows] for part in self))

    def eliminate(self) -> PathLimitRows:
        """Limits without the squeeze, one for each pair of sides."""
        return eliminate(self.press, self.rate, self.bend, self.drag, self.rest, self.cap)

    def at(self, b: Array) -> Array:
        """What sides are at rest and without squeeze, for squares of speeds, shape (n,)."""
        return np.asarray(self.rest + self.bend * b[:, None] + self.drag * np.sqrt(b)[:, None])

    def find_slack(self, profile: Profile) -> Array:
        """Slack of each side for a motion, shape (n, n_sides)."""
        a, b, squeeze = (part[:, None] for part in profile)
        return np.asarray(self.at(b[:, 0]) + a * self.rate + squeeze * self.press)

    def pair(self, row: NDArray[np.int64]) -> NDArray[np.int64]:
        """The sides that a row without the squeeze is of, shape (..., 2)."""
        pairs = np.stack(np.triu_indices(self.rest.shape[1], 1), axis=1)
        return np.asarray(pairs[row])

    def meet(
        self, b: Array, sides: NDArray[np.int64], slack: float | Array = 0.0
    ) -> tuple[Array, Array]:
        """The s'' and the squeeze at which two sides, (n, 2) or (2,), have some slack, (n, 2)."""
        k = np.arange(len(b))[:, None]
        rest, rate, press = (part[k, sides] for part in (self.at(b), self.rate, self.press))
        (one, other), (r1, r2), (p1, p2) = (rest - slack).T, rate.T, press.T
        with np.errstate(divide="ignore", invalid="ignore"):
            det = r1 * p2 - r2 * p1
            return (other * p1 - one * p2) / det, (one * r2 - other * r1) / det
