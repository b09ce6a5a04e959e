"""Signed distance of the two links, by separating axes.

The distance of two convex bodies is the largest separation of their projections over all directions
d, or minus the penetration depth. For two segments the candidates are both sides of each link and
the lines from an end of one to an end of the other, so that

    gap = max_d (min_(q on link 2) d . q - max_(p on link 1) d . p) - radius_1 - radius_2

is the distance of the two capsules when apart, minus the depth when they overlap, and continuous.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.batch import Batch
from ..common.sharing import Store, exclusive
from ..scene.model import Scene
from .elemental import GapLimit, build_features, rotate_quarter

FINGERS_TOUCH = "finger 1 touches finger 2"  # sentence for where the gap of the fingers is zero
ROUNDING = 1e-30  # added to squared distances over squared lengths: normals at coincident points


class _Segment(NamedTuple):
    """A link as expressions: its joint and tip, shape (2, 1), and its length [m]."""

    base: Expression
    tip: Expression
    length: Expression


def build_finger_gap(scene: Scene) -> Expression:
    """Return the gap between the two links [m], an expression of the features' symbol z."""
    return _GAPS(scene)


def _build_gap(scene: Scene) -> Expression:
    links = build_features(scene).links
    first, second = (
        _Segment(link.base, link.tip, finger.length)
        for link, finger in zip(links, scene.fingers, strict=True)
    )
    return _separate(first, second) - sum(link.radius for link in scene.fingers)


def _separate(one: _Segment, two: _Segment) -> Expression:
    """Gap between the axes of two links."""
    links, lengths = (one, two), (one.length, two.length)
    axes = [(link.tip - link.base) / link.length for link in links]
    parts = []
    for own, other, axis in ((one, two, axes[0]), (two, one, axes[1])):
        ends = rotate_quarter(axis).T @ ca.horzcat(other.base - own.base, other.tip - own.base)
        parts += [ca.fmin(ends[0], ends[1]), -ca.fmax(ends[0], ends[1])]
    # From base and tip of link 1 to base and tip of link 2; each link goes on from there along its
    # axis or against it, and what goes on towards the other link takes from the separation.
    first = ca.horzcat(one.base, one.base, one.tip, one.tip)
    second = ca.horzcat(two.base, two.tip, two.base, two.tip)
    run = second - first
    distance = ca.sqrt(ca.sum1(run**2) + ROUNDING * sum(lengths) ** 2)
    onwards = axes[0].T @ run * ca.DM([[1.0, 1.0, -1.0, -1.0]]) * lengths[0]
    backwards = axes[1].T @ run * ca.DM([[-1.0, 1.0, -1.0, 1.0]]) * lengths[1]
    parts.append((distance - (ca.fmax(onwards, 0) + ca.fmax(backwards, 0)) / distance).T)
    return ca.mmax(ca.vertcat(*parts))


def build_finger_limit(scene: Scene) -> list[GapLimit]:
    """Return the limit that the gap between the links is; none where they pass each other."""
    return [GapLimit(build_finger_gap(scene), FINGERS_TOUCH)] if scene.fingers_collide else []


@lru_cache(maxsize=1)
def _build_gap_function() -> Batch:
    """Gap between the axes of any two links, of theta and (base, length) of each."""
    theta, numbers = ca.SX.sym("theta", 2), ca.SX.sym("numbers", 6)
    links = []
    for k in range(2):
        base, length = numbers[3 * k : 3 * k + 2], numbers[3 * k + 2]
        axis = ca.vertcat(ca.cos(theta[k]), ca.sin(theta[k]))
        links.append(_Segment(base, base + length * axis, length))
    return Batch(ca.Function("finger_gap", [theta, numbers], [_separate(*links)]))


_GAPS = Store(_build_gap, lambda scene: scene.shape)


@exclusive
def evaluate_finger_gap(scene: Scene, z: Array) -> Array:
    """Signed distance of the links at configurations z (n, 5), (n,) [m]; NaN where theta is."""
    numbers = np.concatenate([[*np.asarray(link.base), link.length] for link in scene.fingers])
    numbers = np.broadcast_to(numbers, (len(z), 6))
    gaps = _build_gap_function()(z[:, 3:], numbers)[0][:, 0, 0]
    return np.asarray(gaps - sum(link.radius for link in scene.fingers))
