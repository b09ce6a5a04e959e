"""Carrying a stage's motion from one set of intervals to another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from .collocation import Scheme, blend, fit_controls
from .stage import StagePoints

_HAIR = 1e-12
"""Share of a duration that rounding may move a place by."""


def resample(
    part: StagePoints, scheme: Scheme, breaks: Array, begin: float = 0.0, stop: float = 1.0
) -> StagePoints:
    """Part of a stage on other intervals.

    Parameters
    ----------
    part : StagePoints
    scheme : Scheme
        Of both.
    breaks : ndarray, shape (K + 1,)
        Where the new intervals start and end, from 0 to 1.
    begin, stop : float
        Which part of the stage, as shares of its duration.
    """
    span = stop - begin
    fractions = np.diff(breaks)
    inner = breaks[:-1, None] + fractions[:, None] * scheme.points
    z, v, a, forces = _interpolate(part, scheme, (begin + span * inner).ravel())
    node_z, node_v, _, _ = _interpolate(part, scheme, begin + span * breaks)
    shape = (len(fractions), scheme.degree, -1)
    return StagePoints(
        part.duration * span,
        fractions,
        np.stack([node_z, node_v], axis=1),
        z.reshape(shape),
        v.reshape(shape),
        a.reshape(shape),
        forces.reshape(shape),
        _torques(part, begin + span * breaks),
        part.impulses if stop == 1.0 else part.impulses[:0],
    )


def bisect(part: StagePoints, scheme: Scheme, times: NDArray[np.int64]) -> StagePoints:
    """Halve each interval and its parts so many times, shape (K,)."""
    pairs = zip(part.breaks[:-1], part.breaks[1:], 2**times, strict=True)
    pieces = [np.linspace(start, stop, count, endpoint=False) for start, stop, count in pairs]
    return resample(part, scheme, np.append(np.concatenate(pieces), part.breaks[-1]))


def _interpolate(part: StagePoints, scheme: Scheme, places: Array) -> tuple[Array, ...]:
    """z, z', z'' and forces at shares of the duration, by the polynomials of the intervals."""
    count, degree = len(part.fractions), scheme.degree
    # An interval's last point is its own, and not the next one's start: z'' and forces may step.
    k = np.clip(np.searchsorted(part.breaks, places - _HAIR) - 1, 0, count - 1)
    x = (places - part.breaks[k]) / part.fractions[k]
    known = np.append(0.0, scheme.points)
    powers = np.arange(degree + 1)
    wide = x[:, None] ** powers @ np.linalg.inv(known[:, None] ** powers)
    narrow = scheme.interpolate(x)
    z, v = (
        np.einsum("nj,njd->nd", wide, np.concatenate([first[k, None], table[k]], axis=1))
        for first, table in ((part.nodes[:-1, 0], part.z), (part.nodes[:-1, 1], part.v))
    )
    a, forces = (np.einsum("nj,njd->nd", narrow, table[k]) for table in (part.a, part.forces))
    return z, v, a, forces


def with_controls(part: StagePoints, count: int) -> StagePoints:
    """A stage's points with another number of control points of torques."""
    known = part.tau.shape[1]
    at = np.linspace(0.0, 1.0, max(count, known))
    return part._replace(tau=fit_controls(at, blend(at, known) @ part.tau, count))


def _torques(part: StagePoints, breaks: Array) -> Array:
    """Control points of torques in new intervals, each inside one old interval at its middle."""
    middles = (breaks[1:] + breaks[:-1]) / 2
    count, controls = part.tau.shape[:2]
    k = np.clip(np.searchsorted(part.breaks, middles, side="right") - 1, 0, count - 1)
    at = np.linspace(0.0, 1.0, controls)
    places = breaks[:-1, None] + np.diff(breaks)[:, None] * at
    x = np.clip((places - part.breaks[k, None]) / part.fractions[k, None], 0.0, 1.0)
    return fit_controls(at, blend(x, controls) @ part.tau[k], controls)
