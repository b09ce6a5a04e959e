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
Expression = Any  # SX, MX, DM or Function of CasADi, which has no type annotations


_Number = TypeVar("_Number", np.float64, np.int64)


def sort_unique(values: NDArray[_Number]) -> NDArray[_Number]:
    """Distinct values in increasing order, shape (n,), as `np.unique` returns them.

    `np.unique` without indices imports masked arrays, which takes some 10 ms.
    """
    ordered = np.sort(values, axis=None)
    return ordered[np.diff(ordered, prepend=-np.inf) > 0]


class IndependentRows:
    """Basis of independent rows: residuals beyond `threshold` of their norms (Gram-Schmidt)."""

    def __init__(self, threshold: float) -> None:
        self.threshold, self.basis = threshold, list[Array]()

    def add(self, row: Array) -> bool:
        """Whether a row is independent of those before; if so, it extends the basis."""
        residual = row
        for other in self.basis:
            residual = residual - (other @ residual) * other
        norm = float(np.linalg.norm(residual))
        independent = norm > self.threshold * float(np.linalg.norm(row))
        if independent:
            self.basis.append(residual / norm)
        return independent


def find_runs(flags: Flags, min_length: int = 1) -> list[slice]:
    """Runs of True in flags, shape (n,), of `min_length` entries or more."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]]))).tolist()
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [slice(first, stop) for first, stop in pairs if stop - first >= min_length]


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
    """A value rounded to the decimals of a unit, without negative zero."""
    return round(value, math.ceil(-math.log10(unit))) + 0.0


def find_minima(values: Array) -> Array:
    """Minimum along the middle axis of evenly spaced samples, refined between them.

    By the quartic through the five samples around the least one, or a parabola next to the ends.
    Case: least effort of a box, whose torque is 2.6e-6 of its limit above that where parabolas
    see 2.4e-7.
    """
    before, middle, after = values[:, :-2], values[:, 1:-1], values[:, 2:]
    slope, curvature = (after - before) / 2, before - 2 * middle + after
    inside = (middle <= before) & (middle <= after) & (curvature > 0)
    third, fourth = np.zeros_like(slope), np.zeros_like(slope)
    third[:, 1:-1] = slope[:, 2:] - 2 * slope[:, 1:-1] + slope[:, :-2]
    fourth[:, 1:-1] = curvature[:, 2:] - 2 * curvature[:, 1:-1] + curvature[:, :-2]
    # Derivatives of the quartic.
    slope, curvature = slope - third / 6, np.maximum(curvature - fourth / 12, curvature / 2)
    shift = np.zeros_like(slope)
    for _ in range(2):
        rate = slope + shift * (curvature + shift * (third / 2 + shift * fourth / 6))
        change = curvature + shift * (third + shift * fourth / 2)
        step = np.divide(rate, change, out=np.zeros_like(rate), where=inside & (change > 0))
        shift = (shift - step).clip(-1, 1)
    terms = curvature / 2 + shift * (third / 6 + shift * fourth / 24)
    least = middle + shift * (slope + shift * terms)
    return np.asarray(np.minimum(least.min(axis=1), values[:, [0, -1]].min(axis=1)))


def find_lowest(t: Array, values: Array, min_step: float = 0.0) -> tuple[float, float]:
    """Minimum of a smooth function and its time, refined by parabolas through three samples.

    Times t, (n,) [s], never decrease. Intervals below `min_step` are not refined: rounding errors.
    """
    first = int(values.argmin())
    least, time = float(values[first]), float(t[first])
    left, right = np.diff(t)[:-1], np.diff(t)[1:]
    smooth = (left > min_step) & (right > min_step)
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
    x_tolerance: float = 0.0,
    f_tolerance: float = 0.0,
) -> float:
    """Root of a function in [low, high], whose values at the `ends` have opposite signs.

    Regula falsi (Anderson and Bjorck 1973) until the bracket is narrower than `x_tolerance` or
    rounding, or the function is within `f_tolerance`. If a step does not halve the bracket, the
    next one is a secant step of the square root of the function, which finds double roots; after
    two such steps the bracket is bisected. Without a change of sign the result is `low`.
    """
    low, high = float(low), float(high)
    f_low, f_high = ends or (function(low), function(high))
    if f_high == 0 or f_low * f_high >= 0:
        return low if f_high else high
    x_tolerance = max(x_tolerance, 9e-16 * max(abs(low), abs(high)))
    slow_steps, width = -1, abs(high - low)
    while abs(high - low) > x_tolerance:
        middle = high - f_high * (high - low) / (f_high - f_low)
        slow_steps = slow_steps + 1 if 2 * abs(high - low) > width else 0
        if not slow_steps:
            width = abs(high - low)
        if slow_steps == 1:
            fraction = 1 / (1 + math.sqrt(-f_low / f_high))
            middle = high - fraction * (high - low)
        if slow_steps > 1:
            middle, slow_steps, width = (low + high) / 2, 0, abs(high - low)
        elif abs(middle - high) < x_tolerance:
            middle = high + math.copysign(x_tolerance, low - high)
        elif abs(middle - low) < x_tolerance:
            middle = low + math.copysign(x_tolerance, high - low)
        if middle in (low, high):
            break
        f_middle = function(middle)
        if abs(f_middle) <= f_tolerance:
            return middle
        if f_middle * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low *= 1 - f_middle / f_high if abs(f_middle) < abs(f_high) else 0.5
        high, f_high = middle, f_middle
    return high
