"""Minimum-time speed profile along a path: backward and forward reachability sweep in (s, b).

The backward pass finds the largest b = s'^2 from which rest at the end can be reached, the forward
pass the largest reachable one below it (TOPP-RA, Pham and Pham 2018). In an interval a = s'' is
constant and the limits are kept at one place.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .rows import PathLimitRows

_ROUNDING = 1e-12  # negative b at the end that is rounding, over the largest b
_SPEEDS = 4  # most sweeps until viscous friction is linearised about the right speed
_SETTLED = 2e-3  # relative change of b then: the error is about its square


class SweepMode(IntEnum):
    """Active bound in an interval."""

    PUSH = 0  # the largest a
    SWITCH = 1  # first the largest, then the least a
    BRAKE = 2  # the least a
    HELD = 3  # a limit of b


class Sweep(NamedTuple):
    """Minimum-time profile: b at the nodes, (N + 1,), and `SweepMode` of the intervals, (N,)."""

    b: Array
    modes: NDArray[np.int64]


class NoMotionError(ValueError):
    """No motion keeps the limits in an `interval` of this grid."""

    def __init__(self, interval: int) -> None:
        super().__init__()
        self.interval = interval


def find_fastest(
    rows: PathLimitRows, steps: Array, part: Array, cap: Array, b_guess: Array | None
) -> Sweep:
    """Minimum-time speed profile on a grid, from rest to rest.

    Parameters
    ----------
    rows                at a place of each interval
    steps, part : (N,)  lengths of the intervals, and which part of each is before its place
    cap : (N + 1,)      largest b at the nodes
    b_guess : (N,)      b about which the speed is linearised; without it, or at rest, neglected
    """
    of_b, one = rows.b, rows.one
    if b_guess is not None:
        speed = np.sqrt(np.maximum(b_guess, 0.0))[:, None]
        drag = np.divide(rows.v, 2 * speed, out=np.zeros_like(rows.v), where=speed > 0)
        of_b, one = of_b + drag, one + rows.v * speed / 2
    of_a = rows.a / (2 * steps)[:, None]
    before = (1 - part)[:, None] * of_b - of_a
    after = part[:, None] * of_b + of_a
    # From one node's b, bounds of the other's: slopes and values at zero, interval by interval.
    with np.errstate(divide="ignore", invalid="ignore"):
        brakes, pushes = (after >= 0) & (before < 0), after < 0
        brake_slopes = list(np.where(brakes, after / -before, 0))
        brake_values = list(np.where(brakes, one / -before, np.inf))
        push_slopes = list(np.where(pushes, before / -after, 0))
        push_values = list(np.where(pushes, one / -after, np.inf))
    count, least, caps = len(steps), np.minimum.reduce, cap.tolist()
    largest, braked = [0.0] * (count + 1), [False] * count
    following = 0.0
    for k in range(count - 1, -1, -1):
        b_k = float(least(brake_slopes[k] * following + brake_values[k]))
        pushed = float(least(push_slopes[k] * b_k + push_values[k])) if b_k < caps[k] else 0.0
        braked[k] = b_k < caps[k] and pushed >= following
        if not braked[k]:
            b_k = min(_find_corner(before[k], after[k], one[k], following), caps[k])
        if not b_k > 0 and (k or b_k < 0):
            raise NoMotionError(k)
        largest[k] = following = b_k
    b, reaches = [0.0] * (count + 1), [False] * (count + 1)
    reached = 0.0
    for k in range(count):
        pushed = float(least(push_slopes[k] * reached + push_values[k]))
        reaches[k + 1] = pushed >= largest[k + 1]
        b[k + 1] = reached = min(pushed, largest[k + 1])
        if not reached > 0 and k + 1 < count:
            raise NoMotionError(k)
    if b[-1] < -_ROUNDING * max(b):
        raise NoMotionError(count - 1)
    b[-1] = max(b[-1], 0.0)
    slower = ~np.array(reaches)
    modes = np.where(braked, SweepMode.BRAKE, SweepMode.HELD)
    modes = np.where(slower[:-1], SweepMode.SWITCH, modes)
    return Sweep(np.array(b), np.where(slower[1:], SweepMode.PUSH, modes))


def find_steady(rows: PathLimitRows, steps: Array, part: Array, cap: Array) -> Sweep:
    """Sweep until viscous friction is linearised about the resulting speeds; see `find_fastest`."""
    motion = find_fastest(rows, steps, part, cap, None)
    if not rows.v.any():
        return motion
    for _ in range(_SPEEDS - 1):
        before = motion.b
        motion = find_fastest(rows, steps, part, cap, before[:-1] + part * np.diff(before))
        if np.abs(motion.b - before).max() < _SETTLED * motion.b.max():
            break
    return motion


def add_up(b: Array, steps: Array) -> float:
    """Duration of a profile with constant a in intervals [s]."""
    speeds = np.sqrt(np.maximum(b, 0.0))
    return float((2 * steps / (speeds[1:] + speeds[:-1])).sum())


def _find_corner(before: Array, after: Array, one: Array, following: float) -> float:
    """Largest b from which rows before b + after b' + one >= 0 leave a b' from 0 to `following`."""
    before, after = np.append(before, [0, 0]), np.append(after, [1, -1])
    one = np.append(one, [0, following])
    up, down = np.maximum(after, 0)[:, None], np.maximum(-after, 0)
    slope, value = down * before[:, None] + up * before, down * one[:, None] + up * one
    bounded = (up > 0) & (down > 0) & (slope < 0)
    return float((value[bounded] / -slope[bounded]).min(initial=np.inf))
