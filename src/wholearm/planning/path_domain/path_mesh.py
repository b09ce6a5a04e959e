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
_APART, _APART_HELD = 1e-5, 1e-8
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
    counts = share_out(elements, np.diff(angles))
    places = np.repeat(np.arange(len(counts)), counts)
    done = np.concatenate([np.arange(count) / count for count in counts])
    starts = angles[places] + done * np.diff(angles)[places]
    edges = curve.length * (1 - np.cos(starts)) / 2
    edges[done == 0] = ends[:-1]
    pairs = np.stack([edges, np.append(edges[1:], ends[-1])], axis=1)
    stops = [segment.stop for segment in curve.segments]
    return lay_out(pairs, np.searchsorted(stops[:-1], pairs.mean(axis=1)), rests, held)


def share_out(elements: int, weights: Array) -> Numbers:
    """Share out elements by weights, at least one each."""
    # Halves go up whatever their last bit is.
    wanted = weights / weights.sum() * elements + 0.5 + 1e-6
    counts = np.maximum(1, np.floor(wanted).astype(int))
    while counts.sum() != elements:
        counts[np.argmax(counts)] += np.sign(elements - counts.sum())
    return np.asarray(counts)


def find_ends(curve: Curve, breaks: Array) -> Array:
    """Ends of the stretches between breaks and reversals of a curve [m]."""
    return sort_unique(np.array([0.0, *(segment.stop for segment in curve.segments), *breaks]))


def halve(edges: Array, costs: Array, count: int) -> Array:
    """Inner ends of elements (E, 2) [m], of which the dearest are halved, `count` times.

    The cost falls with the sixth power of an element's length where the plan is smooth.
    """
    stops, price = edges[:, 1].tolist(), costs.reshape(len(edges), -1).sum(axis=1).tolist()
    starts = edges[:, 0].tolist()
    for _ in range(count):
        k = int(np.argmax(price))
        middle = (starts[k] + stops[k]) / 2
        starts.insert(k + 1, middle)
        stops.insert(k, middle)
        price[k : k + 1] = [price[k] / 2**6] * 2
    return np.array(starts[1:])


def keep_apart(curve: Curve, places: Array, held: bool = False) -> Array:
    """Increasing places with a least distance to reversals and to those before in the list [m].

    It is smaller where motions start and end without acceleration (`held`).
    """
    least = (_APART_HELD if held else _APART) * curve.length
    kept = find_ends(curve, np.zeros(0)).tolist()
    count = len(kept)
    for place in places.tolist():
        if min(abs(place - other) for other in kept) > least:
            kept.append(place)
    return np.sort(kept[count:])


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
    wanted = max(320 // len(k), 2)  # places, at least two in an interval
    picked = np.arange(0, len(fractions) - 1, max(1, (len(fractions) - 1) // wanted))
    checks = (len(fractions) * np.arange(len(k))[:, None] + picked).ravel()
    s = (data.grid.s[k, None] + fractions[picked] * data.grid.steps[k, None]).ravel()
    nodes, places = np.append(s[::2], data.grid.s[-1]), s[1::2]
    sides = data.find_limits(data.checks.pick(checks))
    cap, sides = np.append(sides.cap[::2], np.inf), sides.pick(slice(1, None, 2))
    rows, steps = sides.eliminate(), np.diff(nodes)
    part = (places - nodes[:-1]) / steps
    try:
        b, modes, _ = speed_sweep(rows, steps, part, cap)
    except NoMotionError:
        return None
    b_places = (1 - part) * b[:-1] + part * b[1:]
    pushed, braked = (rows.extreme(b_places, largest) for largest in (True, False))
    active = np.choose(modes, [pushed.row, 0, braked.row, 0])
    first, last, switched = modes[:-1], modes[1:], modes == SweepMode.SWITCH
    with np.errstate(divide="ignore", invalid="ignore"):
        # In an interval with a switch s'' is first the largest, then the least.
        done = (np.diff(b) / 2 - braked.a * steps) / (pushed.a - braked.a)
        # A limit of b is met after a push, and left to brake, within an interval.
        after, before = np.diff(b)[1:] / (2 * pushed.a[1:]), np.diff(b)[:-1] / (-2 * braked.a[:-1])
    meets = (first == SweepMode.PUSH) & (last == SweepMode.HELD)
    leaves = (first == SweepMode.HELD) & (last == SweepMode.BRAKE)
    changes = nodes[1:-1] + np.select([meets, leaves], [after, before], 0.0)
    switches = [
        (nodes[:-1] + np.clip(done, 0.0, steps))[switched],
        changes[(first != last) & ~(switched[1:] | switched[:-1])],
        _find_crossings(sides, places, b_places, active)[(first == last) & (np.diff(active) != 0)],
    ]
    every = np.sort(np.concatenate(switches))
    apart = np.diff(every, prepend=-np.inf) > _FLICKER * nodes[-1]
    return Fastest(nodes, b, every[apart])


def _find_crossings(sides: PathLimits, places: Array, b: Array, active: Numbers) -> Array:
    """Where from each place to the next the bounds of s'' by their active pairs of sides cross [m].

    A pair that bounds s'' at one place may not do so at the other; amid them if they do not cross.
    """
    pairs = sides.pair(active)
    with np.errstate(divide="ignore", invalid="ignore"):
        before, after = (
            sides.pick(k).meet(b[k], pairs[:-1])[0] - sides.pick(k).meet(b[k], pairs[1:])[0]
            for k in (slice(None, -1), slice(1, None))
        )
        share = np.where(before * after < 0, before / (before - after), 0.5)
    return np.asarray(places[:-1] + share * np.diff(places))


def equidistribute(part: PhaseData, motion: PathMotion, costs: Array, elements: int) -> Array:
    """Breaks between elements that share costs and changes of torque rates evenly [m] (de Boor).

    Of the density over time equal shares are even, the root of the variation of the rates, and the
    cube root of the `costs` of keeping limits between nodes, shape (N + 1,).
    """
    rates = find_torques(part, motion.profile, [motion])[1]
    rates = rates.transpose(0, 2, 1).reshape(-1, 2)
    most = np.maximum(np.abs(rates).max(axis=0), part.torque_limit / motion.duration)
    changes = np.abs(np.diff(rates / most, axis=0, prepend=0.0)).sum(axis=1)
    variation = changes.reshape(len(part.grid.edges), -1).sum(axis=1)
    ends = motion.times.reshape(-1, NODES)
    spans = ends[:, -1] - ends[:, 0]
    density = np.sqrt(variation * spans)
    parts = density, spans, np.cbrt(costs.reshape(len(spans), -1).sum(axis=1))
    shares = np.sum([part / max(part.sum(), 1e-300) for part in parts], axis=0)
    done, t = np.append(0.0, np.cumsum(shares)), np.append(ends[:, 0], ends[-1, -1])
    stops = part.grid.edges[:, 1]
    fixed = np.array(
        [0.0, *(done[1:][stops == segment.stop][0] for segment in part.curve.segments)]
    )
    inner = [
        np.linspace(*pair, count + 1)[1:-1]
        for pair, count in zip(pairwise(fixed), share_out(elements, np.diff(fixed)), strict=True)
    ]
    return motion.locate(np.interp(np.concatenate(inner), done, t))[0]
