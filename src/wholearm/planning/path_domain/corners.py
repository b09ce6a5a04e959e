"""Limits at places of a curve as half planes in s'' and the squeeze, and the corners between them.

With the speed known, two limits leave a largest or a least s'': that of the corner in which they
meet. Fastest motions are in such corners.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...mechanics.limits import PRESS
from ...mechanics.sides import SideTerms
from ..lower_bound.rows import Rows, eliminate
from .data import PhaseData, Places
from .elements import Profile


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

    def eliminate(self) -> Rows:
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
