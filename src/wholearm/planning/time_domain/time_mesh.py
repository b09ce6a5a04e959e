"""Mesh of a stage: interpolation on other intervals, and how often to halve them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .collocation import Scheme, blend, fit_controls
from .stage import Stage, StagePoints

DEFECT = 2e-8  # largest collocation error of z and z' in an interval, in the scene's own units
DEAR = 1e-5  # largest relative cost of raised limits in an interval
AT_ONCE = 2  # most times that an interval is halved at once
_LESS = 4.0  # reduction by a halving of the gain of better torques
_CHEAPER = 3  # power of two of the reduction of the cost of missed limits
_BROKEN = 1e-6  # violation of a formation limit that counts, over the radius of gyration
_HAIR = 1e-12  # rounding of a place, as share of the duration


def resample(
    part: StagePoints, scheme: Scheme, breaks: Array, begin: float = 0.0, stop: float = 1.0
) -> StagePoints:
    """Part of a stage from `begin` to `stop`, on intervals with `breaks`, (K + 1,), in [0, 1]."""
    span = stop - begin
    fractions = np.diff(breaks)
    inner = breaks[:-1, None] + fractions[:, None] * scheme.points
    shape = (len(fractions), scheme.degree, -1)
    points = _interpolate(part, scheme, (begin + span * inner).ravel())
    nodes = np.stack(_interpolate(part, scheme, begin + span * breaks)[:2], axis=1)
    z, v, a, forces = (table.reshape(shape) for table in points)
    tau = _torques(part, begin + span * breaks)
    impulses = part.impulses if stop == 1.0 else part.impulses[:0]
    return StagePoints(part.duration * span, fractions, nodes, z, v, a, forces, tau, impulses)


def bisect(part: StagePoints, scheme: Scheme, times: NDArray[np.int64]) -> StagePoints:
    """Halve each interval and its parts so many times, shape (K,)."""
    pairs = zip(part.breaks[:-1], part.breaks[1:], 2**times, strict=True)
    pieces = [np.linspace(start, stop, count, endpoint=False) for start, stop, count in pairs]
    return resample(part, scheme, np.append(np.concatenate(pieces), part.breaks[-1]))


def _interpolate(part: StagePoints, scheme: Scheme, places: Array) -> tuple[Array, ...]:
    """z, z', z'' and forces at shares of the duration, by the polynomials of the intervals."""
    count, degree = len(part.fractions), scheme.degree
    # z'' and forces may step after the last point of an interval.
    k = np.clip(np.searchsorted(part.breaks, places - _HAIR) - 1, 0, count - 1)
    x = (places - part.breaks[k]) / part.fractions[k]
    powers = np.arange(degree + 1)
    wide = x[:, None] ** powers @ np.linalg.inv(np.append(0.0, scheme.points)[:, None] ** powers)
    z, v = (
        np.einsum("nj,njd->nd", wide, np.concatenate([first[k, None], table[k]], axis=1))
        for first, table in ((part.nodes[:-1, 0], part.z), (part.nodes[:-1, 1], part.v))
    )
    narrow = scheme.interpolate(x)
    a, forces = (np.einsum("nj,njd->nd", narrow, table[k]) for table in (part.a, part.forces))
    return z, v, a, forces


def with_controls(part: StagePoints, count: int) -> StagePoints:
    """A stage's points with another number of control points of torques."""
    old = part.tau.shape[1]
    at = np.linspace(0.0, 1.0, max(count, old))
    return part._replace(tau=fit_controls(at, blend(at, old) @ part.tau, count))


def _torques(part: StagePoints, breaks: Array) -> Array:
    """Control points of torques in new intervals, each inside one old interval at its middle."""
    middles = (breaks[1:] + breaks[:-1]) / 2
    count, controls = part.tau.shape[:2]
    k = np.clip(np.searchsorted(part.breaks, middles, side="right") - 1, 0, count - 1)
    at = np.linspace(0.0, 1.0, controls)
    places = breaks[:-1, None] + np.diff(breaks)[:, None] * at
    x = np.clip((places - part.breaks[k, None]) / part.fractions[k, None], 0.0, 1.0)
    return fit_controls(at, blend(x, controls) @ part.tau[k], controls)


def adopt(stages: Sequence[Stage], points: Sequence[StagePoints]) -> list[Stage]:
    """The same stages with a solution as their guess."""
    return [replace(stage, guess=part) for stage, part in zip(stages, points, strict=True)]


def bisect_intervals(
    stages: Sequence[Stage], scheme: Scheme, times: Sequence[NDArray[np.int64]]
) -> list[Stage]:
    """Stages with intervals halved so many times, each of shape (K,)."""
    return [
        replace(
            stage,
            guess=bisect(stage.guess, scheme, mine),
            periods=tuple(np.repeat(stage.periods, 2**mine).tolist()) if stage.periods else (),
        )
        if mine.any()
        else stage
        for stage, mine in zip(stages, times, strict=True)
    ]


def halve(stages: Sequence[Stage], scheme: Scheme) -> list[Stage]:
    """Stages with all intervals halved."""
    return bisect_intervals(stages, scheme, [np.ones(own.intervals, dtype=int) for own in stages])


def count_halvings(prices: Array, defects: Array, scheme: Scheme) -> NDArray[np.int64]:
    """How often to halve each interval, by its relative cost of misses and collocation error, (K,).

    Errors of collocation decrease with the scheme's order, costs to less than a tenth.
    """
    price = np.maximum(prices / DEAR, 1.0)
    error = np.maximum(np.abs(defects).max(axis=(1, 2)) / DEFECT, 1.0)
    times = np.maximum(np.log2(price) / _CHEAPER, np.log2(error) / scheme.order)
    return np.asarray(np.clip(np.ceil(times), 0, AT_ONCE), dtype=np.int64)


def spread_halvings(shares: Sequence[Array], most: float) -> list[NDArray[np.int64]]:
    """How often to halve intervals, (K,) each, the largest first, until errors sum up to `most`."""
    left, times = np.concatenate(shares), np.zeros(sum(map(len, shares)), dtype=np.int64)
    even = most / len(left)
    while left.sum() > most:
        worst = int(np.where(times < AT_ONCE, left, 0.0).argmax())
        if times[worst] == AT_ONCE or left[worst] <= even:
            break
        left[worst] /= _LESS
        times[worst] += 1
    return np.split(times, np.cumsum([len(own) for own in shares])[:-1])


def cap_halvings(times: list[NDArray[np.int64]], most: int) -> list[NDArray[np.int64]]:
    """How often to halve intervals: once at most, if there would be more than `most` of them."""
    wanted = sum(int((2**mine).sum()) for mine in times)
    return times if wanted <= most else [np.minimum(mine, 1) for mine in times]


def monitor_violated(stages: Sequence[Stage]) -> list[Stage] | None:
    """Stages with limits added that their guesses violate, or None if there are none."""
    changed = []
    for stage in stages:
        values = stage.formation.evaluate_limits(stage.guess.z.reshape(-1, 5))
        rho = stage.formation.scene.polygon.gyration_radius
        broken = np.flatnonzero(values.min(axis=0) < -_BROKEN * rho).tolist()
        changed.append(replace(stage, monitored=tuple(sorted({*stage.monitored, *broken}))))
    monitored = [stage.monitored for stage in stages]
    return changed if [stage.monitored for stage in changed] != monitored else None
