"""Roots of a function that falls, by regula falsi."""

from __future__ import annotations

import math
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

    Regula falsi of Anderson and Bjorck until the bracket is as narrow as `near` or the function is
    within `flat`. After a step that has not halved the bracket the next one is that of the square
    root of the function, which finds double roots, and after two the next one is a bisection.
    """
    if f_low <= 0:
        return low
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
