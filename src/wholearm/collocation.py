"""Collocation schemes as data: points in an interval, and integrals of what passes through them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from .model import Array


class Scheme(NamedTuple):
    """A collocation scheme on [0, 1].

    Attributes
    ----------
    points : ndarray, shape (d,)
        Increasing; the last one is 1.
    integrals : ndarray, shape (d, d)
        Row j integrates, from 0 to point j, the polynomial through values at the points.
    """

    points: Array
    integrals: Array

    @property
    def between(self) -> Array:
        """Values at 0 and midway between points, from those at the points, shape (d, d)."""
        powers = np.arange(self.degree)
        places = np.append(0.0, (self.points[1:] + self.points[:-1]) / 2)
        invert = np.linalg.inv(self.points[:, None] ** powers)
        return np.asarray(places[:, None] ** powers @ invert)

    @property
    def degree(self) -> int:
        """Number of points d."""
        return len(self.points)


@lru_cache(maxsize=8)
def radau(degree: int) -> Scheme:
    """Radau IIA points, order 2 d - 1: the zeros of P_d - P_d-1, 1 among them.

    Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, section IV.5.
    """
    series = np.zeros(degree + 1)
    series[degree - 1 :] = -1.0, 1.0
    roots = np.sort(np.polynomial.legendre.legroots(series).real)
    points = (roots + 1) / 2
    points[-1] = 1.0
    powers = np.arange(1, degree + 1)
    invert = np.linalg.inv(points[:, None] ** (powers - 1))
    integrals = (points[:, None] ** powers / powers) @ invert
    return Scheme(points, integrals)
