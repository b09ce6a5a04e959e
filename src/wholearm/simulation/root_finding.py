"""Event location within a step: root finding on steps of other lengths."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..common.arrays import Array
from .stepper import Replay


def find_first(run: Replay, start: Array, h: float, among: range | None = None) -> list[int]:
    """Shorten the step just tried, of length h [s], to its first event; returns the event's rows.

    `start` are the outputs at its start, `among` the rows to look at.
    """
    s = run.stepper
    rows, among = s.rows, among or range(s.rows.size)
    before = start[s.to.events]
    # A value that starts within rounding of zero has to fall below that.
    shift = np.where(before > s.slack, 0.0, s.slack)
    before = before + shift
    turning = slice(rows.slide.start, rows.joint.stop)
    seen: list[int] = []
    done: list[int] = []
    while True:
        after = s.outputs[s.to.events] + shift
        left = [k for k in among if after[k] < 0 and k not in done]
        if not left:
            return [k for k in seen if after[k] <= s.slack[k] or k == done[-1]]
        seen += [k for k in left if k not in seen]
        share = {k: max(before[k], 0.0) / (max(before[k], 0.0) - after[k]) for k in left}
        k = rows.speed if rows.speed in left else min(left, key=share.__getitem__)
        place, offset = s.to.events.start + k, float(shift[k])

        def value(step: float, place: int = place, offset: float = offset) -> float:
            run.step_to(step)
            return float(s.outputs[place]) + offset

        near = 1e-2 * run.tolerances.shortest_step
        flat = 1e-3 * float(s.slack[k])
        h = find_root(value, h, float(before[k]), float(after[k]), near, flat)
        done.append(k)
        if h != s.inputs[s.at.h]:
            run.step_to(h)
        if k == rows.speed:
            # When the motion stops all sliding does; what reversed before shows just before.
            run.step_to(0.999 * h)
            if (s.outputs[s.to.events][turning] + shift[turning] < 0).any():
                h *= 0.999
            else:
                run.step_to(h)


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


def find_crossing(
    look: Callable[[float], tuple[float, float]],
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    near: float,
    flat: float,
) -> float:
    """Root of x -> f, f' that falls from `low` to `high`, each (x, f, f'); as `find_root`.

    Newton's method from the root of the cubic through both ends, within a bracket.
    """
    (left, f_left, slope), (right, f_right, _) = low, high
    if f_left <= 0:
        return left
    x = left + (right - left) * _cross_cubic(low, high)
    for _ in range(60):
        f, slope = look(x)
        if abs(f) <= flat:
            return x
        if f > 0:
            left, f_left = x, f
        else:
            right, f_right = x, f
        step = -f / slope if slope < 0 else math.inf
        if not left < x + step < right:
            step = right - f_right * (right - left) / (f_right - f_left) - x
            if not left < x + step < right:
                return right
        x += step
        if abs(step) <= near:
            return x
    return right


def _cross_cubic(low: tuple[float, float, float], high: tuple[float, float, float]) -> float:
    """Where the cubic through two ends of opposite sign, with its slopes, is zero, in (0, 1)."""
    (x_0, a, slope_0), (x_1, b, slope_1) = low, high
    c, d = slope_0 * (x_1 - x_0), slope_1 * (x_1 - x_0)
    third, second = 2 * (a - b) + c + d, 3 * (b - a) - 2 * c - d
    u, left, right = a / (a - b), 0.0, 1.0
    for _ in range(20):
        value = a + u * (c + u * (second + u * third))
        left, right = (u, right) if value > 0 else (left, u)
        slope = c + u * (2 * second + u * 3 * third)
        new = u - value / slope if slope < 0 else -1.0
        new = new if left < new < right else (left + right) / 2
        if abs(new - u) < 1e-12:
            break
        u = new
    return u
