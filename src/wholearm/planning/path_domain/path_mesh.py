"""Grids of elements: switches of the minimum-time profile, halving, and equidistribution."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array, Numbers, sort_unique
from ...geometry.curve import Curve
from ...mechanics.path_limits import PathLimits
from ...mechanics.speed_sweep import NoMotionError, SweepMode, speed_sweep
from .path_data import PhaseData, find_torques
from .path_motion import NODES, Grid, PathMotion, lay_out

# Least length of an element that switches lead to, over the curve's; and under rate limits, as the
# time from rest is the cube root of the distance: phase 1 of the hexagon at 500 N m/s.
_MIN_LENGTH, _MIN_LENGTH_HELD = 1e-5, 1e-8
_FLICKER = 4e-3  # distance of switches that count as one, over the length of the curves


def make_grid(
    curve: Curve,
    breaks: Array,
    elements: int,
    rests: tuple[bool, bool] = (True, True),
    held: bool = False,
) -> Grid:
    """Grid of a curve with breaks [m], fine towards its ends (where the motion is slow)."""
    ends = find_ends(curve, breaks)
    angles = np.arccos(1 - 2 * np.clip(ends / curve.length, 0.0, 1.0))
    counts = allocate(elements, np.diff(angles))
    stretches = np.repeat(np.arange(len(counts)), counts)
    fractions = np.concatenate([np.arange(count) / count for count in counts])
    starts = angles[stretches] + fractions * np.diff(angles)[stretches]
    edges = curve.length * (1 - np.cos(starts)) / 2
    edges[fractions == 0] = ends[:-1]
    pairs = np.stack([edges, np.append(edges[1:], ends[-1])], axis=1)
    stops = [segment.stop for segment in curve.segments]
    return lay_out(pairs, np.searchsorted(stops[:-1], pairs.mean(axis=1)), rests, held)


def allocate(elements: int, weights: Array) -> Numbers:
    """Numbers of elements in proportion to weights, at least one each."""
    # Halves go up whatever their last bit is.
    quotas = weights / weights.sum() * elements + 0.5 + 1e-6
    counts = np.maximum(1, np.floor(quotas).astype(int))
    while counts.sum() != elements:
        counts[np.argmax(counts)] += np.sign(elements - counts.sum())
    return np.asarray(counts)


def find_ends(curve: Curve, breaks: Array) -> Array:
    """Ends of the stretches between breaks and reversals of a curve [m]."""
    return sort_unique(np.array([0.0, *(segment.stop for segment in curve.segments), *breaks]))


def halve(edges: Array, costs: Array, count: int) -> Array:
    """Inner ends of elements (E, 2) [m] after `count` halvings, each of the one of largest cost.

    The cost falls with the sixth power of an element's length where the plan is smooth.
    """
    stops, prices = edges[:, 1].tolist(), costs.reshape(len(edges), -1).sum(axis=1).tolist()
    starts = edges[:, 0].tolist()
    for _ in range(count):
        k = int(np.argmax(prices))
        middle = (starts[k] + stops[k]) / 2
        starts.insert(k + 1, middle)
        stops.insert(k, middle)
        prices[k : k + 1] = [prices[k] / 2**6] * 2
    return np.array(starts[1:])


def keep_apart(curve: Curve, places: Array, held: bool = False) -> Array:
    """Increasing places with a least distance to reversals and to those before in the list [m].

    It is smaller where motions start and end without acceleration (`held`).
    """
    min_distance = (_MIN_LENGTH_HELD if held else _MIN_LENGTH) * curve.length
    accepted = find_ends(curve, np.zeros(0)).tolist()
    count = len(accepted)
    for place in places.tolist():
        if min(abs(place - other) for other in accepted) > min_distance:
            accepted.append(place)
    return np.sort(accepted[count:])


class Fastest(NamedTuple):
    """Minimum-time speed profile of a sweep."""

    s: Array  # (N + 1,) [m]
    b: Array  # (N + 1,) [m^2/s^2]
    switches: Array  # [m]: where another limit becomes active


def find_fastest(data: PhaseData) -> Fastest | None:
    """The minimum-time profile by a reachability sweep; None if there is no motion.

    Limits are those of some checks between nodes: an even number in each interval, with its start.
    The nodes of the sweep and the places of its limits alternate.
    """
    fractions, k = data.sampling.checks, data.grid.nonempty
    count = max(320 // len(k), 2)  # places, at least two in an interval
    selection = np.arange(0, len(fractions) - 1, max(1, (len(fractions) - 1) // count))
    checks = (len(fractions) * np.arange(len(k))[:, None] + selection).ravel()
    s = (data.grid.s[k, None] + fractions[selection] * data.grid.steps[k, None]).ravel()
    nodes, places = np.append(s[::2], data.grid.s[-1]), s[1::2]
    limits = data.find_limits(data.checks.pick(checks))
    cap, limits = np.append(limits.cap[::2], np.inf), limits.pick(slice(1, None, 2))
    rows, steps = limits.eliminate(), np.diff(nodes)
    part = (places - nodes[:-1]) / steps
    try:
        b, modes, _ = speed_sweep(rows, steps, part, cap)
    except NoMotionError:
        return None
    b_places = (1 - part) * b[:-1] + part * b[1:]
    largest, least = (rows.extreme(b_places, is_largest) for is_largest in (True, False))
    active = np.choose(modes, [largest.row, 0, least.row, 0])
    first, last, switched = modes[:-1], modes[1:], modes == SweepMode.SWITCH
    with np.errstate(divide="ignore", invalid="ignore"):
        # In an interval with a switch s'' is first the largest, then the least.
        before_switch = (np.diff(b) / 2 - least.a * steps) / (largest.a - least.a)
        # A limit of b is met after a push, and left to brake, within an interval.
        push, brake = np.diff(b)[1:] / (2 * largest.a[1:]), np.diff(b)[:-1] / (-2 * least.a[:-1])
    to_cap = (first == SweepMode.PUSH) & (last == SweepMode.HELD)
    from_cap = (first == SweepMode.HELD) & (last == SweepMode.BRAKE)
    changes = nodes[1:-1] + np.select([to_cap, from_cap], [push, brake], 0.0)
    switches = [
        (nodes[:-1] + np.clip(before_switch, 0.0, steps))[switched],
        changes[(first != last) & ~(switched[1:] | switched[:-1])],
        _find_crossings(limits, places, b_places, active)[(first == last) & (np.diff(active) != 0)],
    ]
    candidates = np.sort(np.concatenate(switches))
    is_distinct = np.diff(candidates, prepend=-np.inf) > _FLICKER * nodes[-1]
    return Fastest(nodes, b, candidates[is_distinct])


def _find_crossings(limits: PathLimits, places: Array, b: Array, active: Numbers) -> Array:
    """Where from each place to the next the bounds of s'' by their active pairs of sides cross [m].

    A pair that bounds s'' at one place may not do so at the other; amid them if they do not cross.
    """
    pairs = limits.pair(active)
    with np.errstate(divide="ignore", invalid="ignore"):
        before, after = (
            limits.pick(k).meet(b[k], pairs[:-1])[0] - limits.pick(k).meet(b[k], pairs[1:])[0]
            for k in (slice(None, -1), slice(1, None))
        )
        fraction = np.where(before * after < 0, before / (before - after), 0.5)
    return np.asarray(places[:-1] + fraction * np.diff(places))


def equidistribute(part: PhaseData, motion: PathMotion, costs: Array, elements: int) -> Array:
    """Breaks between elements that share costs and changes of torque rates evenly [m] (de Boor).

    The density over time is the sum of a constant, the root of the variation of the rates, and the
    cube root of the `costs` of keeping limits between nodes, shape (N + 1,).
    """
    rates = find_torques(part, motion.profile, [motion])[1]
    rates = rates.transpose(0, 2, 1).reshape(-1, 2)
    scales = np.maximum(np.abs(rates).max(axis=0), part.torque_limit / motion.duration)
    changes = np.abs(np.diff(rates / scales, axis=0, prepend=0.0)).sum(axis=1)
    variation = changes.reshape(len(part.grid.edges), -1).sum(axis=1)
    times = motion.times.reshape(-1, NODES)
    spans = times[:, -1] - times[:, 0]
    density = np.sqrt(variation * spans)
    parts = density, spans, np.cbrt(costs.reshape(len(spans), -1).sum(axis=1))
    sums = np.sum([part / max(part.sum(), 1e-300) for part in parts], axis=0)
    cumulative, t = np.append(0.0, np.cumsum(sums)), np.append(times[:, 0], times[-1, -1])
    stops = part.grid.edges[:, 1]
    fixed = np.array(
        [0.0, *(cumulative[1:][stops == segment.stop][0] for segment in part.curve.segments)]
    )
    inner = [
        np.linspace(*pair, count + 1)[1:-1]
        for pair, count in zip(pairwise(fixed), allocate(elements, np.diff(fixed)), strict=True)
    ]
    return motion.locate(np.interp(np.concatenate(inner), cumulative, t))[0]
