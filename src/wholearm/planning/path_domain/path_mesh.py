"""Mesh adaptation: elements end at switches, and are denser where violations between nodes cost.

The price of a violation is the multiplier times it: the first-order cost of tightening the limit.
It falls with the sixth power of an element's length where the plan is smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, sort_unique
from ...geometry.curve import Curve
from ..options import Objective
from .elements import Grid, Profile, lay_out
from .path_data import PhaseData
from .switches import Switch, find_switches

START, SOFT = 10, 20  # initial elements of a phase, and those for smoother plans of least effort
MOST = 80  # elements of a phase from which they are not doubled
SLOW_MOST = 40  # the same under rate limits, unless a high accuracy is asked for
SHIFTED = 0.02  # relative loss by a break's distance from its switch, over the curve's length
_ORDER = 6  # power of an element's length that its price falls with
_APART = 1e-5  # least length of an element that switches lead to, over the curve's
_CLOSE = 1e-10  # the same under rate limits: ramps next to rest are short in s
_NEAR = 0.02  # distance at which a switch belongs to a break, over the curve's length
_ENDS = 0.1  # factor on the elements of the first and last stretch under rate limits
_CHEAP = 1e-3  # least price of a stretch that counts, over that of all


class Mesh(NamedTuple):
    """The elements of one phase."""

    breaks: Array = np.zeros(0)  # [m]: where elements end at switches, increasing
    # elements of each stretch between breaks and reversals, as a ratio; None for as many as its
    # part of a half turn, fine towards the ends
    weights: Array | None = None

    @staticmethod
    def of(curve: Curve, switches: Sequence[Switch], held: bool = False) -> Mesh:
        """The mesh for a motion that switches at some places."""
        if held:
            return Mesh(_keep_apart([place for place, _ in switches], curve, _CLOSE))
        return Mesh(_match(np.zeros(0), switches, curve)[0])

    def make_grid(
        self,
        curve: Curve,
        elements: int,
        rests: tuple[bool, bool] = (True, True),
        held: bool = False,
    ) -> Grid:
        """Grid of a curve, fine towards its ends (where the motion is slow)."""
        ends = find_ends(curve, self.breaks)
        angles = np.arccos(1 - 2 * np.clip(ends / curve.length, 0.0, 1.0))
        weights = np.diff(angles) if self.weights is None else self.weights
        if held and len(weights) > 2 and self.weights is None:
            weights = weights * np.array([_ENDS, *[1.0] * (len(weights) - 2), _ENDS])
        counts = _share_out(elements, weights)
        places = np.repeat(np.arange(len(counts)), counts)
        done = np.concatenate([np.arange(count) / count for count in counts])
        starts = angles[places] + done * np.diff(angles)[places]
        edges = curve.length * (1 - np.cos(starts)) / 2
        edges[done == 0] = ends[:-1]
        if held and len(weights) > 2:
            # After a cubic start the speed is a root of s, which even lengths suit better.
            for k in {0, len(counts) - 1}:
                edges[places == k] = ends[k] + done[places == k] * (ends[k + 1] - ends[k])
        pairs = np.stack([edges, np.append(edges[1:], ends[-1])], axis=1)
        stops = [segment.stop for segment in curve.segments]
        return lay_out(pairs, np.searchsorted(stops[:-1], pairs.mean(axis=1)), rests, held)


def _share_out(elements: int, weights: Array) -> NDArray[np.int64]:
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


class Better(NamedTuple):
    """A mesh adapted to a solution on another."""

    mesh: Mesh
    shift: float  # of breaks, over the curve's length; infinite for a new one at a jump of s''
    price: float  # estimated cost of tightening on it with as many elements


def adapt(
    goal: Objective | None,
    part: PhaseData,
    profile: Profile,
    margin: float,
    prices: Array,
    before: Mesh,
) -> Better:
    """Adapt a mesh to a profile and the prices of its nodes; without a goal, not to switches."""
    breaks, shift = before.breaks, 0.0
    if goal in (Objective.TIME, Objective.MARGIN) and not part.grid.held:
        breaks, shift = _match(before.breaks, find_switches(part, profile, margin), part.curve)
    if len(breaks) != len(before.breaks):
        return Better(Mesh(breaks), shift, float(prices.sum()))
    ends = find_ends(part.curve, before.breaks)
    middles = part.grid.edges.mean(axis=1)
    owner = np.searchsorted(ends, middles) - 1
    per_element = prices.reshape(len(middles), -1).sum(axis=1)
    counts = np.bincount(owner, minlength=len(ends) - 1)
    price = np.bincount(owner, per_element, len(ends) - 1)
    weights = counts * (np.maximum(price, _CHEAP * price.sum() + 1e-300) / counts) ** (1 / _ORDER)
    finer = counts / _share_out(len(middles), weights)
    return Better(Mesh(breaks, weights), shift, float((price * finer**_ORDER).sum()))


def _match(breaks: Array, switches: Sequence[Switch], curve: Curve) -> tuple[Array, float]:
    """Breaks moved to switches near them, with new ones, and their shift.

    None is given up: a switch at an element's end may not show.
    """
    fixed, least = find_ends(curve, np.zeros(0)), _APART * curve.length
    moved, fresh, shift = dict[int, float](), list[float](), 0.0
    for place, jumps in switches:
        far = np.abs(breaks - place)
        far[list(moved)] = np.inf
        if far.min(initial=np.inf) < _NEAR * curve.length:
            moved[int(far.argmin())] = place
            shift = max(shift, float(far.min()) / curve.length)
        elif np.abs(np.concatenate([fixed, breaks, fresh]) - place).min() > least:
            fresh.append(place)
            shift = np.inf if jumps or not len(breaks) else shift
    every = sorted([*(moved.get(k, place) for k, place in enumerate(breaks)), *fresh])
    return _keep_apart(every, curve, _APART), shift


def _keep_apart(places: Sequence[float], curve: Curve, least: float) -> Array:
    """Places with a least distance, over the curve's length, to reversals and to each other [m]."""
    fixed, kept = find_ends(curve, np.zeros(0)), list[float]()
    for place in places:
        if np.abs(np.append(fixed, kept) - place).min() > least * curve.length:
            kept.append(place)
    return np.array(sorted(kept))
