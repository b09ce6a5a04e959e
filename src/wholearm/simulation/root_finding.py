"""Roots of a function that falls, by regula falsi."""

from __future__ import annotations

from collections.abc import Callable


def find_root(
    function: Callable[[float], float],
    high: float,
    f_low: float,
    f_high: float,
    near: float,
    flat: float,
    low: float = 0.0,
) -> float:
    """Root in [low, high] of a function that falls from f_low >= 0 to f_high < 0.

    Regula falsi of Anderson and Bjorck, until it moves by `near` or the function is within `flat`.
    """
    if f_low <= 0:
        return low
    for _ in range(60):
        middle = high - f_high * (high - low) / (f_high - f_low)
        if not low < middle < high and not high < middle < low:
            break
        f_middle = function(middle)
        if abs(f_middle) <= flat:
            return middle
        if f_middle * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low *= 1 - f_middle / f_high if abs(f_middle) < abs(f_high) else 0.5
        close = abs(middle - high) <= near
        high, f_high = middle, f_middle
        if close:
            break
    return high
