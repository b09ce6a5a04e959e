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
from .data import PhaseData, Places
from .elements import DEGREE, Elements, Profile

_TOLERANCE = 1e-3
"""How far beyond a limit a corner may be, over the terms that the limit is the sum of."""
_PICARD = 4
"""Rounds in which speeds and extremes of s'' are made to agree."""
_LOOKS = 320
"""Places at which corners are looked for, at least two in an interval between nodes."""
_ROUNDING = 1e-9
"""The same where a corner is within the limits."""
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


class _Corners(NamedTuple):
    """Largest and least s'' that limits allow at n places, and the pair of sides that meet there.

    Infinite where no corner is within the limits.
    """

    high: Array
    low: Array
    at_high: NDArray[np.int64]
    at_low: NDArray[np.int64]

    def pick(self, rows: Any) -> _Corners:
        """Return the places that `rows` indexes."""
        high, low, at_high, at_low = self
        return _Corners(high[rows], low[rows], at_high[rows], at_low[rows])


class Switch(NamedTuple):
    """A place [m] where a motion switches, and whether s'' jumps from one extreme to the other."""

    place: float
    jumps: bool


def find_switches(data: PhaseData, profile: Profile, margin: float) -> list[Switch]:
    """Where a motion switches between limits, in the order of the curve.

    Parameters
    ----------
    data : PhaseData
        Of one phase.
    profile : Profile
        At its nodes, roughly that of a plan.
    margin : float, [N]
        Least margin of normal forces over epsilon.
    """
    looks = _Looks.take(data, profile, margin)
    changes = np.flatnonzero(looks.label[1:] != looks.label[:-1])
    if not len(changes):
        return []
    apart = np.diff(looks.s[changes]) > _FLICKER * data.grid.s[-1]
    found = list[Switch]()
    for cluster in np.split(changes, np.flatnonzero(apart) + 1):
        first, last = int(cluster[0]), int(cluster[-1]) + 1
        if looks.label[first] == looks.label[last]:
            continue
        if looks.label[first] == _CAPPED or looks.label[last] == _CAPPED:
            place = looks.find_jump(first, last)
        elif looks.rises[first] == looks.rises[last]:
            found.append(Switch(looks.find_crossing(first, last), False))
            continue
        else:
            place = looks.find_jump(first, last)
        found += [] if place is None else [Switch(place, True)]
    return found


class _Looks(NamedTuple):
    """What limits allow at n places along a curve where they leave a choice.

    Attributes
    ----------
    s : ndarray, [m]
    here : Profile
        The motion there.
    terms : _Terms
    corners : _Corners
    largest : ndarray, [m^2/s^2]
        The b that the speed limits allow.
    share : ndarray
        How far s'' is from its largest, over the range that limits allow.
    element : ndarray of int
        That each place belongs to.
    """

    s: Array
    here: Profile
    terms: _Terms
    corners: _Corners
    largest: Array
    share: Array
    element: NDArray[np.int64]

    @staticmethod
    def take(data: PhaseData, profile: Profile, margin: float) -> _Looks:
        """Look at some of the checks between nodes."""
        fractions, k = data.sampling.checks, data.nonempty
        wanted = max(_LOOKS // len(k), 2)
        picked = np.arange(0, len(fractions) - 1, max(1, (len(fractions) - 1) // wanted))
        rows = (len(fractions) * np.arange(len(k))[:, None] + picked).ravel()
        terms = _Terms.of(data, data.checks.pick(rows), margin)
        here = Elements(data.grid, profile).at(fractions[picked])
        s = (data.grid.s[k, None] + fractions[picked] * data.grid.steps[k, None]).ravel()
        corners = terms.find_corners(here.b)
        span = corners.high - corners.low
        known = np.flatnonzero(span > _THIN * np.abs(corners.high))
        element = np.arange(len(s)) // (len(picked) * DEGREE)
        return _Looks(
            s[known],
            Profile(*(part[known] for part in here)),
            terms.pick(known),
            corners.pick(known),
            data.largest_b(data.checks.pick(rows))[known],
            ((corners.high - here.a)[known] / span[known]),
            element[known],
        )

    @property
    def rises(self) -> NDArray[np.bool_]:
        """Whether s'' is nearer to its largest than to its least."""
        return np.asarray(self.share < 0.5)

    @property
    def label(self) -> NDArray[np.int64]:
        """The corner that the motion is at, or nearest to; negative for the least s''.

        `_CAPPED` where it is a speed limit that decides.
        """
        corner = np.where(self.rises, self.corners.at_high, -1 - self.corners.at_low)
        return np.where(self.here.b > (1 - _AT_CAP) * self.largest, _CAPPED, corner)

    def find_crossing(self, first: int, last: int) -> float:
        """Where another corner takes over as that of the extreme s'', between two places [m]."""
        ends = np.array([first, last])
        pairs = (self.corners.at_high if self.rises[first] else self.corners.at_low)[ends]
        before, after = self.terms.pick(ends).find_pairs(self.here.b[ends], pairs).T
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
        rows = np.flatnonzero(within)
        # The first place of the next element is where this one ends.
        rows = np.append(rows, rows[-1] + 1) if rows[-1] + 1 < len(self.s) else rows
        rises = bool(self.rises[first])
        s, b, terms = self.s[rows], self.here.b[rows], self.terms.pick(rows)
        steps, one, other = np.diff(s), b, b
        for _ in range(_PICARD):
            here, there = (terms.find_corners(np.maximum(part, 0.0)) for part in (one, other))
            rates = (here.high, there.low) if rises or along.any() else (here.low, there.high)
            before, after = (np.where(np.isfinite(rate), rate, 0.0) for rate in rates)
            one = b[0] + np.append(0.0, np.cumsum(steps * (before[1:] + before[:-1])))
            gained = np.append(0.0, np.cumsum(steps * (after[1:] + after[:-1])))
            other = b[-1] + gained - gained[-1]
            one, other = (
                np.where(cap, self.largest[rows], part)
                for cap, part in zip(along, (one, other), strict=True)
            )
        ahead = (other - one) * (1 if rises or along.any() else -1)
        passed = np.flatnonzero((ahead[1:] <= 0) & (ahead[:-1] > 0))
        if not len(passed):
            return None
        k = int(passed[0])
        return float(s[k] + steps[k] * ahead[k] / (ahead[k] - ahead[k + 1]))


class _Terms(NamedTuple):
    """What sides of limits are of at n places: rest + b bend + a rate + squeeze press, (n, m) each.

    `drag` is that of the speed; all over what is much.
    """

    rest: Array
    bend: Array
    drag: Array
    rate: Array
    press: Array

    @staticmethod
    def of(data: PhaseData, places: Places, margin: float) -> _Terms:
        """The terms of the limits of a phase."""
        of_c, of_tau, of_rates = (part.T for part in data.limits.columns)
        rows, signs, _ = data.limits.sides
        forces, scale = places.forces, signs / data.spans
        zero = np.zeros(len(places.rates))
        return _Terms(
            data.slack(places, Profile(zero, zero, zero), margin) / data.spans,
            (forces.Cb @ of_c + forces.Tb @ of_tau)[:, rows] * scale,
            (forces.Tv @ of_tau + places.rates @ of_rates)[:, rows] * scale,
            (forces.Ca @ of_c + forces.Ta @ of_tau)[:, rows] * scale,
            (forces.Cl @ of_c + forces.Tl @ of_tau)[:, rows] * scale,
        )

    def find_pairs(self, b: Array, pairs: NDArray[np.int64]) -> Array:
        """The s'' at which some pairs of limits meet, shape (n, pairs)."""
        rest = self.rest + self.bend * b[:, None] + self.drag * np.sqrt(b)[:, None]
        i, j = (side[pairs] for side in np.triu_indices(rest.shape[1], 1))
        det = self.rate[:, i] * self.press[:, j] - self.rate[:, j] * self.press[:, i]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.asarray((rest[:, j] * self.press[:, i] - rest[:, i] * self.press[:, j]) / det)

    def pick(self, rows: Any) -> _Terms:
        """Some of the places."""
        return _Terms(*(part[rows] for part in self))

    def find_corners(self, b: Array) -> _Corners:
        """Corners of what limits allow for squares of speeds, shape (n,) [m^2/s^2]."""
        rest = self.rest + self.bend * b[:, None] + self.drag * np.sqrt(b)[:, None]
        i, j = np.triu_indices(rest.shape[1], 1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            det = self.rate[:, i] * self.press[:, j] - self.rate[:, j] * self.press[:, i]
            a = (rest[:, j] * self.press[:, i] - rest[:, i] * self.press[:, j]) / det
            squeeze = (self.rate[:, j] * rest[:, i] - self.rate[:, i] * rest[:, j]) / det
            terms = self.rate[:, None] * a[..., None], self.press[:, None] * squeeze[..., None]
            size = 1 + np.abs(terms[0]) + np.abs(terms[1])
            beyond = -(rest[:, None] + terms[0] + terms[1]) / size
        pairs = np.arange(len(i))
        beyond[:, pairs, i] = beyond[:, pairs, j] = 0.0
        worst = np.where(np.isfinite(a), beyond.max(axis=2), np.inf)
        # Where the speed is slightly too large for any corner, the nearest to one will do.
        ok = worst <= np.minimum(2 * worst.min(axis=1, keepdims=True) + _ROUNDING, _TOLERANCE)
        high, low = np.where(ok, a, -np.inf), np.where(ok, a, np.inf)
        return _Corners(high.max(axis=1), low.min(axis=1), high.argmax(axis=1), low.argmin(axis=1))
