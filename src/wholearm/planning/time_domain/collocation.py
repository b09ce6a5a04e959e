"""Collocation schemes: points, integration matrices, and Bernstein polynomials of torques."""

from __future__ import annotations

from functools import lru_cache
from math import comb
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array, jacobi_nodes


class Scheme(NamedTuple):
    """A collocation scheme on [0, 1]."""

    name: str
    points: Array  # (d,): increasing
    integrals: Array  # (d, d): row j integrates the interpolating polynomial from 0 to point j
    weights: Array  # (d,): the same from 0 to 1
    order: int  # of the error at the end of an interval
    controls: int  # number of control points of the torques in an interval

    @property
    def degree(self) -> int:
        """Number of points d."""
        return len(self.points)

    @property
    def ends(self) -> bool:
        """Whether the last point is the end of the interval."""
        return bool(self.points[-1] == 1.0)

    @property
    def rungs(self) -> Array:
        """Rows of the integrals to every point, and to the end if no point is there."""
        return self.integrals if self.ends else np.vstack([self.integrals, self.weights])

    def interpolate(self, places: Array) -> Array:
        """Values at `places`, shape (n,), from those at the points: a matrix of shape (n, d)."""
        powers = np.arange(self.degree)
        invert = np.linalg.inv(self.points[:, None] ** powers)
        return np.asarray(places[:, None] ** powers @ invert)


def blend(places: Array, count: int) -> Array:
    """Bernstein polynomials at `places`, shape (..., count): shares of the control points.

    A polynomial lies between its control points, the first and last of which are its ends.
    """
    k, n = np.arange(count), count - 1
    choices = np.array([comb(n, own) for own in k.tolist()], dtype=float)
    x = np.asarray(places)[..., None]
    return np.asarray(choices * x**k * (1 - x) ** (n - k))


def fit_controls(places: Array, values: Array, count: int) -> Array:
    """Control points of the polynomials nearest to values at places, shape (..., count, m)."""
    return np.asarray(np.linalg.pinv(blend(places, count)) @ values)


@lru_cache(maxsize=8)
def make_scheme(name: str, degree: int, controls: int = 2) -> Scheme:
    """Radau IIA points, order 2 d - 1, or Gauss-Legendre points, order 2 d.

    Zeros of P_d - P_d-1, 1 among them, or of P_d (E. Hairer and G. Wanner, Solving Ordinary
    Differential Equations II, section IV.5). `controls` are control points of torques.
    """
    if name == "radau":
        points = (np.append(jacobi_nodes(degree - 1, 1, 0), 1.0) + 1) / 2
    else:
        points = (jacobi_nodes(degree) + 1) / 2
    powers = np.arange(1, degree + 1)
    invert = np.linalg.inv(points[:, None] ** (powers - 1))
    integrals = (points[:, None] ** powers / powers) @ invert
    order = 2 * degree - (name == "radau")
    return Scheme(name, points, integrals, (1 / powers) @ invert, order, controls)
