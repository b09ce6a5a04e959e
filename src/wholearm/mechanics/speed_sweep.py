"""Minimum-time speed profiles along paths: backward and forward reachability sweep in (s, b).

The backward pass finds the largest b = s'^2 from which rest at the end can be reached, the forward
pass the largest reachable one below it (TOPP-RA, Pham and Pham 2018). In an interval a = s'' is
constant and the limits are kept at one place. Many paths are swept at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array, Numbers
from .dynamics import ONE, A, B, V
from .path_limits import PathLimits, find_range

_ROUNDING = 1e-12  # negative b at the end that is rounding, over the largest b
_UNBOUNDED = 1e100  # b [m^2/s^2] where no limit bounds it; case: the map of a rolling octagon


class SweepMode(IntEnum):
    """Active bound in an interval."""

    PUSH = 0  # the largest a
    SWITCH = 1  # first the largest, then the least a
    BRAKE = 2  # the least a
    HELD = 3  # a limit of b


class NoMotionError(ValueError):
    """No motion keeps the limits in an `interval` of this grid."""

    def __init__(self, interval: int) -> None:
        super().__init__()
        self.interval = interval


class SpeedProfile(NamedTuple):
    """Minimum-time profiles along paths, (..., N) intervals."""

    b: Array  # (..., N + 1) [m^2/s^2]: at the nodes
    modes: Numbers  # (..., N): `SweepMode` of the intervals
    blocked: Numbers  # (...,): an interval without a motion, or -1

    def find_durations(self, steps: Array) -> Array:
        """Durations for intervals of lengths `steps`, (...,) [s]; infinite without a motion."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.blocked < 0, find_duration(self.b, steps), np.inf)


def make_cosine_grid(intervals: int) -> tuple[Array, Array, Array]:
    """Lengths of intervals from 0 to 1, short at both ends, their middles, and `part` of these."""
    nodes = (1 - np.cos(np.linspace(0, np.pi, intervals + 1))) / 2
    places, steps = (nodes[1:] + nodes[:-1]) / 2, np.diff(nodes)
    return steps, places, (places - nodes[:-1]) / steps


def join_caps(before: Array, after: Array) -> Array:
    """Limits of b at nodes, (..., N + 1), from those in each interval or at its two ends."""
    infinite = np.full((*before.shape[:-1], 1), np.inf)
    pair = np.append(before, infinite, axis=-1), np.append(infinite, after, axis=-1)
    return np.asarray(np.minimum(*pair))


def find_duration(b: Array, steps: Array) -> Array:
    """Durations of profiles with constant a in intervals of lengths `steps` [s]."""
    speeds = np.sqrt(np.maximum(b, 0.0))
    return np.asarray((2 * steps / (speeds[..., 1:] + speeds[..., :-1])).sum(axis=-1))


def speed_sweep(
    limits: PathLimits,
    steps: Array,
    part: Array,
    cap: Array | None = None,
    b_guess: Array | None = None,
    sweeps: int = 4,
) -> SpeedProfile:
    """Minimum-time speed profiles from rest to rest.

    Parameters
    ----------
    limits              without lambda, at a place of each interval: rows (..., N, m, 4)
    steps, part : (N,)  lengths of the intervals, and which part of each is before its place
    cap : (..., N + 1)  largest b at the nodes, by default that of the places next to them
    b_guess : (N,)      b at the places about which viscous terms are linearized; neglected at rest
    sweeps              without a guess: most sweeps, each linearized about the one before

    NoMotionError if there is one path, and no motion along it; with more, it is `blocked`.
    """
    shape = limits.rows.shape[:-3]
    rows = limits.rows.reshape(-1, *limits.rows.shape[-3:])
    cap = join_caps(limits.cap, limits.cap) if cap is None else cap
    cap = cap.reshape(len(rows), -1)
    profile = _sweep(rows, steps, part, cap, b_guess)
    for _ in range(sweeps - 1 if b_guess is None and rows[..., V].any() else 0):
        before = np.where(profile.b < _UNBOUNDED, profile.b, 0.0)
        profile = _sweep(rows, steps, part, cap, before[:, :-1] + part * np.diff(before))
        # The error of the linearization is the square of the change.
        if np.abs(profile.b - before).max() < 2e-3 * profile.b.max():
            break
    if not shape and profile.blocked[0] >= 0:
        raise NoMotionError(int(profile.blocked[0]))
    b, modes, blocked = profile
    return SpeedProfile(
        b.reshape(*shape, -1), modes.reshape(*shape, -1), np.asarray(blocked.reshape(shape))
    )


def _sweep(
    rows: Array, steps: Array, part: Array, cap: Array, b_guess: Array | None
) -> SpeedProfile:
    """One sweep of w paths, with rows (w, N, m, 4)."""
    before, after, one = _split(rows, steps, part, b_guess)
    before, after, one = (np.ascontiguousarray(x.swapaxes(0, 1)) for x in (before, after, one))
    # From one node's b, bounds of the other's: slopes and values at zero, interval by interval.
    with np.errstate(divide="ignore", invalid="ignore"):
        is_lower = (after >= 0) & (before < 0)
        brake_slopes = np.where(is_lower, after / -before, 0)
        brake_values = np.where(is_lower, one / -before, np.inf)
        slopes, values = before / -after, one / -after
    low_bounds = np.where(after > 0, slopes, 0), np.where(after > 0, values, -np.inf)
    push_slopes, push_values = np.where(after < 0, slopes, 0), np.where(after < 0, values, np.inf)
    infeasible = ((before == 0) & (after == 0) & (one < 0)).any(axis=2)
    caps = np.minimum(cap.T, _UNBOUNDED)
    top = _find_corners(*low_bounds, push_slopes, push_values, caps[:-1])
    top[infeasible] = -1.0
    count = len(steps)
    lowest = _pass(brake_slopes[::-1], brake_values[::-1], top[::-1], 0.0)[::-1]
    largest = np.append(np.maximum(lowest, 0.0), np.zeros_like(top[:1]), axis=0)
    b = np.append(
        np.zeros_like(top[:1]), _pass(push_slopes, push_values, largest[1:], -np.inf), axis=0
    )
    brake_b, push_b = (
        (slopes * b_node[..., None] + values).min(axis=2)
        for slopes, values, b_node in (
            (brake_slopes, brake_values, largest[1:]),
            (push_slopes, push_values, b[:-1]),
        )
    )
    is_blocked = np.concatenate([lowest[:1] < 0, ~(lowest[1:] > 0)])
    blocked = np.where(is_blocked.any(axis=0), count - 1 - is_blocked[::-1].argmax(axis=0), -1)
    stalls = np.concatenate([~(b[1:-1] > 0), b[-1:] < -_ROUNDING * b.max(axis=0)])
    blocked = np.where((blocked < 0) & stalls.any(axis=0), stalls.argmax(axis=0), blocked)
    farthest = (push_slopes * lowest[..., None] + push_values).min(axis=2)
    is_braked = (brake_b < caps[:-1]) & (farthest >= largest[1:])
    is_pushed = np.concatenate([np.zeros((1, len(rows)), bool), push_b < largest[1:]])
    modes = np.where(is_braked, SweepMode.BRAKE, SweepMode.HELD)
    modes = np.where(is_pushed[:-1], SweepMode.SWITCH, modes)
    modes = np.where(is_pushed[1:], SweepMode.PUSH, modes)
    return SpeedProfile(np.maximum(b, 0.0).T, modes.T, blocked)


def _pass(slopes: Array, values: Array, top: Array, floor: float) -> Array:
    """Largest b, (N, w), at one node after the other, from zero at the first; see `_sweep`.

    Rows of slopes and values, (N, w, m), bound it by the b before, `top`, (N, w), by itself.
    """
    # Paths last: then the minimum over rows is vectorized.
    slopes, values = (
        np.ascontiguousarray(np.concatenate([rows, last[..., None]], axis=2).swapaxes(1, 2))
        for rows, last in ((slopes, np.zeros(top.shape)), (values, top))
    )
    b, nodes = np.zeros(top.shape[1]), list[Array]()
    for slope, value in zip(slopes, values, strict=True):
        b = np.minimum.reduce(slope * b + value, axis=0)
        nodes.append(b)
        b = np.maximum(b, floor)
    return np.array(nodes)


def _split(
    rows: Array, steps: Array, part: Array, b_guess: Array | None = None
) -> tuple[Array, Array, Array]:
    """Coefficients of rows before b + after b' + one >= 0 of b and b' at the ends of intervals."""
    one, of_b = rows[..., ONE], rows[..., B]
    if b_guess is not None:
        speed = np.sqrt(np.maximum(b_guess, 0.0))[..., None]
        viscous = np.divide(rows[..., V], 2 * speed, out=np.zeros_like(one), where=speed > 0)
        of_b, one = of_b + viscous, one + rows[..., V] * speed / 2
    of_a = rows[..., A] / (2 * steps)[:, None]
    return (1 - part)[:, None] * of_b - of_a, part[:, None] * of_b + of_a, one


def _find_corners(
    low_slopes: Array, low_values: Array, high_slopes: Array, high_values: Array, b: Array
) -> Array:
    """Largest b, at most that given, (..., w), that leaves some b' >= 0 between bounds; or -1.

    Rows of slopes and values, (..., w, m), bound b' from below and above. The room between them is
    a concave function of b: Newton's method from above ends at a corner of two rows.
    """
    shape, n = b.shape, np.arange(b.size)
    b = b.flatten()
    low_slopes, low_values, high_slopes, high_values = (
        rows.reshape(len(n), -1) for rows in (low_slopes, low_values, high_slopes, high_values)
    )
    for _ in range(low_slopes.shape[-1] ** 2):
        low, high = low_slopes * b[:, None] + low_values, high_slopes * b[:, None] + high_values
        i, j = (n, low.argmax(axis=1)), (n, high.argmin(axis=1))
        at_rest = low[i] <= 0
        with np.errstate(invalid="ignore", divide="ignore"):
            slope = high_slopes[j] - np.where(at_rest, 0, low_slopes[i])
            value = high_values[j] - np.where(at_rest, 0, low_values[i])
            corner = np.where(slope < 0, value / -slope, -1.0)
        is_infeasible = (slope * b + value < 0) & (corner < b * (1 - 1e-14)) & (b > 0)
        if not is_infeasible.any():
            break
        b[is_infeasible] = np.maximum(corner[is_infeasible], -1.0)
    return b.reshape(shape)


class ControllableSet(NamedTuple):
    """Squared speeds at n nodes of a path from which its end can be reached."""

    low: Array  # low, high (n,) [m^2/s^2]: range of b
    high: Array
    fraction: Array  # (n - 1,): share of the margins that each interval keeps
    rows: list[Array]  # (m, 3): limits before b + after b' + one >= 0 of each interval

    def run(self, first: float) -> Array:
        """Forward pass: b at the nodes of the fastest motion from b = `first`, shape (n,)."""
        b = np.full(len(self.low), first)
        for k, (before, after, one) in enumerate(rows.T for rows in self.rows):
            is_upper = after < 0
            fastest = float(((before[is_upper] * b[k] + one[is_upper]) / -after[is_upper]).min())
            b[k + 1] = min(max(fastest, self.low[k + 1]), self.high[k + 1])
        return b


def find_controllable(
    limits: PathLimits,
    margins: Array,
    steps: Array,
    floor: Array,
    end: tuple[float, float],
    fractions: Sequence[float],
) -> ControllableSet:
    """Backward pass in which each interval keeps the largest feasible share of margins.

    The limits are kept at both ends of each interval, each with its own internal force. Viscous
    terms are those at the largest speed.

    Parameters
    ----------
    limits          at the n nodes, with the internal force: rows (n, m, 5)
    margins : (n, m)  slack that a share of 1 leaves
    steps, floor    lengths of the intervals, (n - 1,), and least b at the nodes, (n,)
    end             least and largest b at the last node
    shares          that are tried, the largest first; with the last one only `limits.cap` is
                    feasible if nothing is
    """
    rows, tight = (x.eliminate().rows.copy() for x in (limits, limits.relax(-margins)))
    losses = rows[..., ONE] - tight[..., ONE]
    rows[..., ONE] += rows[..., V] * np.sqrt(limits.cap)[:, None]
    first = _split(rows[:-1], steps, np.zeros(len(steps)))
    last = _split(rows[1:], steps, np.ones(len(steps)))
    table = np.stack([np.hstack(pair) for pair in zip(first, last, strict=True)], axis=-1)
    losses = np.hstack([losses[:-1], losses[1:]])
    low, high, fraction = floor.copy(), limits.cap.copy(), np.full(len(steps), fractions[-1])
    low[-1], high[-1] = end
    intervals = list[Array]()
    for k in range(len(steps) - 1, -1, -1):
        box = np.array([[0.0, -1.0, high[k + 1]], [0.0, 1.0, -low[k + 1]]])
        bounding = (table[k, :, :2] != 0).any(axis=1) | (losses[k] != 0)
        rows_k, loss = table[k, bounding], losses[k, bounding]
        feasible, least, most = box, floor[k], limits.cap[k]
        begin, stop = 0, len(fractions)
        while begin < stop:
            middle = begin if begin == 0 else (begin + stop) // 2
            candidate = np.vstack([rows_k, box])
            candidate[:-2, 2] -= fractions[middle] * loss
            slowest, fastest = _find_range(candidate)
            slowest, fastest = max(slowest, floor[k]), min(fastest, limits.cap[k])
            if slowest <= fastest + 1e-9 * limits.cap[k]:
                feasible, least, most, stop = candidate, slowest, fastest, middle
                fraction[k] = fractions[middle]
            else:
                begin = middle + 1
        intervals.append(feasible)
        low[k], high[k] = least, most
    return ControllableSet(low, high, fraction, intervals[::-1])


def _find_range(rows: Array) -> tuple[float, float]:
    """Least and largest b for which rows before b + after b' + one >= 0, (m, 3), leave some b'."""
    before, after, one = (rows / np.abs(rows).max(axis=1, keepdims=True).clip(1e-300)).T
    up, down, flat = after > 0, after < 0, after == 0
    rise, fall = after[up, None], -after[down]
    value = np.append(fall * one[up, None] + rise * one[down], one[flat])
    slope = np.append(fall * before[up, None] + rise * before[down], before[flat])
    low, high = find_range(slope, value + _ROUNDING * (slope == 0))
    return float(low), float(high)
