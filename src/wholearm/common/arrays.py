"""Types of arrays and expressions; runs of flags, quadrature nodes, minima of samples, roots."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # floating-point numbers
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Expression = Any  # what CasADi computes with: SX, MX, DM or Function, for which it has no types


_Number = TypeVar("_Number", np.float64, np.int64)


def sort_unique(values: NDArray[_Number]) -> NDArray[_Number]:
    """Different values in increasing order, shape (n,), as `np.unique` has them.

    That imports masked arrays, unless it is asked for indices too: some 10 ms of a process.
    """
    ordered = np.sort(values, axis=None)
    return ordered[np.diff(ordered, prepend=-np.inf) > 0]


class Independent:
    """Rows that are independent of those before, by more than a share `least` (Gram-Schmidt)."""

    def __init__(self, least: float) -> None:
        self.least, self.basis = least, list[Array]()

    def add(self, row: Array) -> bool:
        """Whether a row is; it counts from then on."""
        rest = row
        for other in self.basis:
            rest = rest - (other @ rest) * other
        left = float(np.linalg.norm(rest))
        independent = left > self.least * float(np.linalg.norm(row))
        if independent:
            self.basis.append(rest / left)
        return independent


def find_runs(flags: Flags, least: int = 1) -> list[slice]:
    """Runs of True in flags, shape (n,), of `least` places or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]]))).tolist()
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [slice(first, stop) for first, stop in pairs if stop - first >= least]


def jacobi_nodes(count: int, alpha: int = 0, beta: int = 0) -> Array:
    """Zeros of the Jacobi polynomial P_n^(alpha, beta), increasing, shape (n,), in (-1, 1).

    Eigenvalues of the symmetric tridiagonal matrix of the three-term recurrence (Golub and Welsch
    1969), which are real in any arithmetic. Gauss-Legendre nodes are those of (0, 0); with the ends
    added, Radau nodes with 1 are those of (1, 0), Lobatto nodes those of (1, 1).

    Parameters
    ----------
    count        degree n of the polynomial; zero gives no nodes
    alpha, beta  exponents of the weight (1 - x)^alpha (1 + x)^beta, not negative
    """
    k, total = np.arange(count), alpha + beta
    diagonal = (beta**2 - alpha**2) / np.maximum((2 * k + total) * (2 * k + total + 2), 1)
    diagonal[:1] = (beta - alpha) / (total + 2)
    k = k[1:]
    squares = 4 * k * (k + alpha) * (k + beta) * (k + total)
    squares = squares / ((2 * k + total) ** 2 * (2 * k + total + 1) * (2 * k + total - 1))
    return np.linalg.eigvalsh(np.diag(diagonal) + np.diag(np.sqrt(squares), -1))


def interpolate(x: Array | float, places: Array, rows: Array) -> Array:
    """Rows of a table, shape (n, k), at places x between increasing ones, by straight lines."""
    return np.stack([np.interp(x, places, column) for column in rows.T], axis=-1)


def round_to(value: float, unit: float) -> float:
    """A value with the decimals of a unit, and no negative zero."""
    return round(value, math.ceil(-math.log10(unit))) + 0.0


def find_minima(values: Array) -> Array:
    """Least value along the middle axis of evenly spaced values, also between them.

    Slope and curvature at a least value are those of a parabola through three values, or, where
    there are five, of fourth order. Case: least effort of a box (test), whose torque is 2.6e-6 of
    its limit above that where parabolas see 2.4e-7.
    """
    before, here, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    slope, bend = (after - before) / 2, before - 2 * here + after
    inside = (here <= before) & (here <= after) & (bend > 0)
    far = values[:, 4:], values[:, :-4]
    slope[:, 1:-1] = (8 * slope[:, 1:-1] - (far[0] - far[1]) / 2) / 6
    fourth = (16 * bend[:, 1:-1] - far[0] - far[1] + 2 * here[:, 1:-1]) / 12
    bend[:, 1:-1] = np.where(fourth > 0, fourth, bend[:, 1:-1])
    shift = np.divide(-slope, bend, out=np.zeros_like(here), where=inside).clip(-1, 1)
    dip = shift * (slope + bend * shift / 2)
    return np.asarray(np.minimum((here + dip).min(axis=1), values[:, [0, -1]].min(axis=1)))


def find_lowest(t: Array, values: Array, shortest: float = 0.0) -> tuple[float, float]:
    """Least value of a smooth function and where, refined by parabolas through three samples.

    Times t, (n,) [s], never decrease. Parabolas are spoiled by rounding in intervals below
    `shortest`.
    """
    first = int(values.argmin())
    least, time = float(values[first]), float(t[first])
    left, right = np.diff(t)[:-1], np.diff(t)[1:]
    smooth = (left > shortest) & (right > shortest)
    smooth &= (values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])
    left, right, middle = left[smooth], right[smooth], t[1:-1][smooth]
    fall = (values[1:-1] - values[:-2])[smooth] / left
    rise = (values[2:] - values[1:-1])[smooth] / right
    slope = (fall * right + rise * left) / (left + right)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.nan_to_num(-slope * (left + right) / (2 * (rise - fall)))
    lowest = values[1:-1][smooth] + slope * shift / 2
    if len(lowest) and lowest.min() < least:
        k = int(lowest.argmin())
        least, time = float(lowest[k]), float(middle[k] + shift[k])
    return least, time


def find_root(
    function: Callable[[float], float],
    low: float,
    high: float,
    ends: tuple[float, float] | None = None,
    near: float = 0.0,
    flat: float = 0.0,
) -> float:
    """Root of a function in [low, high], whose values at the `ends` have opposite signs.

    Regula falsi of Anderson and Bjorck until the bracket is as narrow as `near`, or as rounding, or
    the function is within `flat`. After a step that has not halved the bracket the next one is that
    of the square root of the function, which finds double roots, and after two the next one is a
    bisection. Without a change of sign the result is `low`.
    """
    low, high = float(low), float(high)
    f_low, f_high = ends or (function(low), function(high))
    if f_high == 0 or f_low * f_high >= 0:
        return low if f_high else high
    near = max(near, 9e-16 * max(abs(low), abs(high)))
    slow, width = -1, abs(high - low)
    while abs(high - low) > near:
        middle = high - f_high * (high - low) / (f_high - f_low)
        slow = slow + 1 if 2 * abs(high - low) > width else 0
        if not slow:
            width = abs(high - low)
        if slow == 1:
            share = 1 / (1 + math.sqrt(-f_low / f_high))
            middle = high - share * (high - low)
        if slow > 1:
            middle, slow, width = (low + high) / 2, 0, abs(high - low)
        elif abs(middle - high) < near:
            middle = high + math.copysign(near, low - high)
        elif abs(middle - low) < near:
            middle = low + math.copysign(near, high - low)
        if middle in (low, high):
            break
        f_middle = function(middle)
        if abs(f_middle) <= flat:
            return middle
        if f_middle * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low *= 1 - f_middle / f_high if abs(f_middle) < abs(f_high) else 0.5
        high, f_high = middle, f_middle
    return high
