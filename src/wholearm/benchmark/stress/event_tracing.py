"""Curve of a phase by small predictor-corrector steps and overlap tests, apart from the planner.

It knows neither C-functions nor limits of formations. The motion ends where a contact leaves the
feature that it slides on, where two bodies run into each other, or at the phase's `until`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...problem.definition import Phase, Until
from ...scene.model import Scene
from .newton import clearances, locate

STEP = 0.02  # length of a step over the radius of gyration
LONGEST = 60.0  # longest curve, over the radius of gyration: several turns of the object
OVERLAP = 1e-6
"""Overlap over the radius of gyration from which on two bodies count as running into each other."""
MET = 1e-5  # distance over the radius of gyration (or angle) that counts as having reached `until`


DEPENDENT = "the contacts become dependent"


class Trace(NamedTuple):
    """A curve of configurations that keep a phase's contacts closed."""

    z: Array  # (n, 5)
    ending: str  # what ends it
    reached: bool  # whether that is the phase's `until`


def follow(scene: Scene, phase: Phase, z: Array) -> tuple[Trace, Trace]:
    """Follow a phase's contacts from `z`, shape (5,), both ways."""
    tangent = _tangents(scene, phase, z[None])[0]
    return _march(scene, phase, z, tangent), _march(scene, phase, z, -tangent)


def weights(scene: Scene) -> Array:
    """Diagonal of the metric, shape (5,): an angle counts as it moves the object's rim [1, m^2]."""
    return np.array([1.0, 1.0, *[scene.scales.length**2] * 3])


def project(
    scene: Scene,
    z: Array,
    equations: Callable[[Array], tuple[Array, Array]],
    farthest: float = math.inf,
) -> Array | None:
    """Nearest zero of equations to `z`, by Newton's method; None if none, or on a longer step.

    Parameters
    ----------
    equations  their values, shape (m,), and rows of their Jacobian, (m, 5)
    """
    scale, size = np.sqrt(weights(scene)), scene.scales.length
    for _ in range(20):
        miss, rows = equations(z)
        step = -np.linalg.pinv(rows / scale, rcond=1e-10) @ miss / scale
        z, change = z + step, np.abs(step * scale).max()
        if change < 1e-13 * size:
            break
        if change > farthest:
            return None
    return z if np.abs(equations(z)[0]).max() < 1e-9 * size else None


def constrain(scene: Scene, phase: Phase, z: Array) -> tuple[Array, Array]:
    """Gaps, shape (n, n_c), and rows of the constraints, (n, n_c + R, 5), at configurations."""
    touches = [locate(scene, name, z) for name in phase.formation.names]
    rows = [t.normal for t in touches] + [touches[k].tangent for k in phase.formation.rolling_rows]
    return np.stack([touch.gap for touch in touches], axis=1), np.stack(rows, axis=1)


def _tangents(scene: Scene, phase: Phase, z: Array) -> Array:
    """Unit tangents at n configurations, shape (n, 5)."""
    scale = np.sqrt(weights(scene))
    return np.asarray(np.linalg.svd(constrain(scene, phase, z)[1] / scale)[2][:, -1] / scale)


def close(scene: Scene, phase: Phase, z: Array, before: Array) -> Array | None:
    """Nearest configuration to `z` that keeps the contacts, coming from `before`; None if none.

    What rolls keeps its place: the slip between the two is taken out, to the second order.
    """

    def equations(z: Array) -> tuple[Array, Array]:
        gaps, rows = constrain(scene, phase, np.array([z, (z + before) / 2]))
        slip = rows[1, phase.formation.n_contacts :] @ (z - before)
        return np.concatenate([gaps[0], slip]), rows[0]

    return project(scene, z, equations, scene.scales.length)


def _march(scene: Scene, phase: Phase, z: Array, tangent: Array) -> Trace:
    points, scale, until = [z], weights(scene), phase.until
    passing = _overlaps(scene, phase, z)
    while STEP * len(points) < LONGEST:
        after = close(scene, phase, z + STEP * scene.scales.length * tangent, z)
        if after is None:
            return Trace(np.array(points), DEPENDENT, False)
        if _passes(scene, until, z, after) or _overlaps(scene, phase, after) - passing:
            return _end(scene, phase, points, after)
        way, z, passing = after - z, after, set()
        points.append(z)
        tangent = _tangents(scene, phase, z[None])[0]
        tangent = tangent * math.copysign(1.0, float((tangent * scale) @ way))
    return Trace(np.array(points), "nothing happens", False)


def _end(scene: Scene, phase: Phase, points: list[Array], beyond: Array) -> Trace:
    """Bisect for the first event between the last point and one beyond it."""
    last, until = points[-1], phase.until

    def place(share: float) -> Array | None:
        return close(scene, phase, last + share * (beyond - last), last)

    def stops(share: float) -> bool:
        z = place(share)
        return z is None or bool(_overlaps(scene, phase, z)) or _passes(scene, until, last, z)

    low, high = _bisect(stops, 40)
    here = _or(place(low), last) if low else last
    near = MET * (1.0 if until.coordinate == "phi" else scene.scales.length)
    met = abs(_distance(scene, until, here)) <= near
    if met and until.contact is not None:
        touch = locate(scene, until.contact.name, here[None])
        met = bool(min(touch.low[0], touch.high[0]) > -near)
    after = place(high)
    names = set() if after is None else _overlaps(scene, phase, after)
    text = str(until) if met else ", ".join(sorted(names)) or DEPENDENT
    return Trace(np.array([*points, here]), text, met)


def _overlaps(scene: Scene, phase: Phase, z: Array) -> set[str]:
    """Names of the bodies that are inside each other at `z`, and of contacts that left."""
    least = OVERLAP * scene.scales.length
    names = {name for name, gap in clearances(scene, z[None]).items() if gap[0] < -least}
    touches = {name: locate(scene, name, z[None]) for name in phase.formation.names}
    return names | {
        f"{name} leaves" for name, t in touches.items() if min(t.low[0], t.high[0]) < -least
    }


def _distance(scene: Scene, until: Until, z: Array) -> float:
    """How far the end of a phase is, [m] or [rad]; infinite if it has none."""
    if until.contact is not None:
        return float(locate(scene, until.contact.name, z[None]).gap[0])
    if until.value is None:
        return math.inf
    return float(z[0 if until.coordinate == "x" else 2] - until.value)


def _passes(scene: Scene, until: Until, before: Array, after: Array) -> bool:
    """Whether a coordinate passes the value that ends the phase."""
    if until.value is None:
        return False
    return _distance(scene, until, before) * _distance(scene, until, after) < 0


def resample(scene: Scene, phase: Phase, trace: Trace, count: int) -> tuple[Array, Array, Array]:
    """The curve at even places, and also where a contact or a joint turns.

    Returns
    -------
    s : (n,) [m]     arc length
    z, z_s : (n, 5)  configurations, and unit tangents along the way
    """
    scale = weights(scene)
    runs = np.sqrt(np.diff(trace.z, axis=0) ** 2 @ scale)
    keep = np.append(True, runs > 1e-9 * scene.scales.length)
    points, runs = trace.z[keep], runs[keep[1:]]
    s = np.append(0.0, np.cumsum(runs))
    where = np.linspace(0.0, s[-1], count)
    z = [points[0]]
    for place in where[1:-1]:
        k = min(int(np.searchsorted(s, place, side="right")) - 1, len(runs) - 1)
        guess = points[k] + (place - s[k]) / runs[k] * (points[k + 1] - points[k])
        z.append(_or(close(scene, phase, guess, points[k]), guess))
    z.append(points[-1])
    z_s = _orient(scene, phase, np.array(z))
    turning = _turns(scene, phase, np.array(z), z_s)
    for k in reversed(np.flatnonzero(turning)):
        z[k + 1 : k + 1] = [_find_turn(scene, phase, z[k], z[k + 1])]
    grid = np.array(z)
    runs = np.sqrt(np.diff(grid, axis=0) ** 2 @ scale)
    return np.append(0.0, np.cumsum(runs)), grid, _orient(scene, phase, grid)


def _or(first: Array | None, second: Array) -> Array:
    return second if first is None else first


def _orient(scene: Scene, phase: Phase, z: Array) -> Array:
    tangents, ahead = _tangents(scene, phase, z), np.gradient(z, axis=0)
    agree = (tangents * ahead) @ weights(scene)
    return np.asarray(tangents * np.where(agree < 0, -1.0, 1.0)[:, None])


def slides(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    """Rates of sliding of the contacts and of the joints along z_s, shape (n, n_c + 2)."""
    rows = [(locate(scene, n, z).tangent * z_s).sum(axis=1) for n in phase.formation.names]
    return np.column_stack([*rows, z_s[:, 3:]])


def _turns(scene: Scene, phase: Phase, z: Array, z_s: Array) -> Array:
    rates = slides(scene, phase, z, z_s)
    return np.asarray((rates[1:] * rates[:-1] < 0).any(axis=1))


def _find_turn(scene: Scene, phase: Phase, first: Array, last: Array) -> Array:
    """Bisect for the first place between two where a rate changes its sign."""

    def place(share: float) -> Array:
        return _or(close(scene, phase, first + share * (last - first), first), first)

    def turns(share: float) -> bool:
        pair = np.array([first, place(share), last])
        return bool(_turns(scene, phase, pair[:2], _orient(scene, phase, pair)[:2])[0])

    low, _ = _bisect(turns, 30)
    return place(low) if low else first


def _bisect(test: Callable[[float], bool], count: int) -> tuple[float, float]:
    """Bracket in [0, 1] of where a test becomes true, after `count` halvings."""
    low, high = 0.0, 1.0
    for _ in range(count):
        middle = (low + high) / 2
        low, high = (low, middle) if test(middle) else (middle, high)
    return low, high
