"""Shares of successes, and how far they can be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass

Z = 1.959963984540054
"""Standard normal quantile of 0.975."""


@dataclass(frozen=True)
class Share:
    """How many of how many, with Wilson's interval of 95 % for the probability.

    Attributes
    ----------
    hits, total : int
    low, high : float

    References
    ----------
    E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """

    hits: int
    total: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share itself; NaN of none."""
        return self.hits / self.total if self.total else math.nan

    def __str__(self) -> str:
        if not self.total:
            return "none"
        percent = [f"{100 * value:.1f}" for value in (self.value, self.low, self.high)]
        return f"{percent[0]} % ({self.hits} of {self.total}, 95 %: {percent[1]} to {percent[2]} %)"


def count_share(count: int, total: int) -> Share:
    """A share with its interval: the probabilities p with |count/total - p| <= Z sigma(p)."""
    if not total:
        return Share(0, 0, 0.0, 1.0)
    share, spread = count / total, Z**2 / total
    centre = (share + spread / 2) / (1 + spread)
    half = math.sqrt(share * (1 - share) * spread + spread**2 / 4) / (1 + spread)
    # At the ends the interval begins and ends exactly there, but for rounding.
    low = centre - half if count else 0.0
    return Share(count, total, low, centre + half if count < total else 1.0)
