"""What torques of any shape would gain over those of a solution: an estimate of its error.

By the minimum principle the best torques at an instant are those, of all that keep the limits
there, which make the Hamiltonian l(tau) - p^T z''(tau) least. p is the costate of z', which the
multipliers of collocation are, and l = tau^T tau for the objective `effort`. What the torques of a
solution leave of that, integrated over time, is what the cost changes by to first order when they
are replaced; and motions differ by less than torques do, as these make up for one another within an
interval. What collocation misses is added, weighted with the costates.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ...common.arrays import Array
from ...mechanics.limits import PRESS, LimitSet
from .equations import least_senses
from .motion import Response, StageMotion
from .stage import Stage

_PLACES = 7
"""Gauss points of an interval at which torques are compared."""
_HELD = 3.0
"""Rate over the least one below which that holds it."""
_CLOSE = 1e-6
"""Gap over the radius of gyration below which it is held open."""
_STEP = 1e-6
"""Step of z by which slopes of gaps are found, over accelerations of a torque of 1."""
_ROUNDING = 1e-9
"""Largest miss of a limit that counts as none, over what is much for it."""


def find_gains(
    stage: Stage,
    motion: StageMotion,
    costate: Array,
    limits: LimitSet,
    margin: float,
    square: float,
) -> Array:
    """What better torques would gain in each interval of a stage, in the unit of the cost, (K,).

    Parameters
    ----------
    stage : Stage
    motion : StageMotion
    costate : ndarray, shape (K, 2, 5)
        Of z and z' at the start of each interval.
    limits : LimitSet
    margin : float
        What c_n but no friction cone has to exceed its least value by.
    square : float
        Weight of tau^T tau in the cost.
    """
    x, weights = np.polynomial.legendre.leggauss(_PLACES)
    x, lengths = (x + 1) / 2, np.diff(motion.breaks)
    t = motion.breaks[:-1, None] + lengths[:, None] * x
    found = motion.respond(np.append(t, motion.breaks[:-1]))
    here, n = Response(*(part[: t.size] for part in found)), t.size
    worth = np.einsum("kd,kdj->kj", costate[:, 1], found.a_by_torque[n:])
    worth = _interpolate(motion.breaks, worth, int(stage.opens), x)
    slope = 2 * square * here.y[:, -4:-2] - worth
    values = here.y @ limits.rows.T
    values[:, limits.of(PRESS)] -= margin
    own, signs, _ = limits.sides
    size = limits.scales[own]
    slack = np.maximum(limits.find_slack(values) / size, 0.0)
    rows = np.einsum("mi,nij->nmj", limits.rows, here.y_by_torque)[:, own] * (signs / size)[:, None]
    held = _find_held(stage, here, stage.guess.places(x))
    rows = np.concatenate([rows, held, -held], axis=1)
    slack = np.hstack([slack, np.zeros((n, 2 * held.shape[1]))])
    gains = -find_least(slope, square, rows, slack).reshape(t.shape) @ weights / 2 * lengths
    return np.asarray(gains + np.abs(np.einsum("ksd,ksd->k", costate, motion.defects)))


def _find_held(stage: Stage, here: Response, places: Array) -> Array:
    """Rows of accelerations by torque that limits of rates and gaps hold, shape (n, m, 2).

    A row is nothing at places where it is not held.
    """
    formation, z, v, by_torque = stage.formation, here.z, here.v, here.a_by_torque
    least = least_senses(stage, places).reshape(len(z), -1)
    least[:, np.delete(np.arange(formation.n_contacts), formation.rubbing_rows)] = -np.inf
    senses = np.concatenate([formation.evaluate(z, v).A_t @ by_torque, by_torque[:, 3:]], axis=1)
    slow = (stage.measure_senses(z, v) < _HELD * least) & (least > 0)
    monitored, size = list(stage.monitored), formation.scene.scales.length
    gaps = formation.evaluate_limits(z)[:, monitored]
    ahead = (
        formation.evaluate_limits(z + _STEP * by_torque[..., j])[:, monitored] for j in range(2)
    )
    slopes = np.stack([(after - gaps) / _STEP for after in ahead], axis=-1)
    close = gaps < _CLOSE * size
    first = np.repeat(np.arange(len(places)) == 0, places.shape[1])
    close |= first[:, None] & (np.isin(monitored, stage.released) & stage.opens)
    held = np.concatenate([slow, close], axis=1)[..., None] * np.concatenate(
        [senses, slopes], axis=1
    )
    return np.asarray(held[:, np.flatnonzero(held.any(axis=(0, 2)))])


def _interpolate(breaks: Array, values: Array, first: int, x: Array) -> Array:
    """Cubic interpolation of values at starts of K intervals, at `x` of each, shape (K n, 2).

    Both ends, before the value number `first` and after the last, are as those beside them go on.
    """
    known = np.arange(min(first, len(values) - 1), len(values))
    for end, near in ((0, known[:3]), (len(values), known[-3:])):
        powers = np.arange(len(near))
        at = (breaks[near] - breaks[end])[:, None] ** powers
        value = np.linalg.solve(at, values[near])[:1]
        values = np.vstack([value, values[1:]]) if end == 0 else np.vstack([values, value])
    slopes = np.gradient(values, breaks, axis=0, edge_order=2)
    x, lengths = x[:, None], np.diff(breaks)[:, None, None]
    y = 1 - x
    ends = y**2 * (1 + 2 * x) * values[:-1, None] + x**2 * (1 + 2 * y) * values[1:, None]
    bends = y**2 * x * slopes[:-1, None] - x**2 * y * slopes[1:, None]
    return np.asarray(ends + lengths * bends).reshape(-1, values.shape[1])


def find_least(slope: Array, square: float, rows: Array, slack: Array) -> Array:
    """Least value of slope^T u + square u^T u over u in the plane with rows u + slack >= 0, (n,).

    It is taken at a corner, or else on an edge or inside, or at u = 0, which counts as allowed.

    Parameters
    ----------
    slope, rows, slack : ndarray, shapes (n, 2), (n, m, 2), (n, m)
    square : float
    """
    first, second = np.array(list(combinations(range(rows.shape[1]), 2))).T
    one, other = rows[:, first], rows[:, second]
    across = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = slack[:, first, None] * other - slack[:, second, None] * one
        u = np.stack([-own[..., 1], own[..., 0]], axis=-1) / across[..., None]
        if square:
            free = (-slope / (2 * square))[:, None]
            beyond = (np.einsum("nmj,noj->nm", rows, free) + slack)[..., None]
            edges = free - rows * beyond / (rows**2).sum(axis=2, keepdims=True)
            u = np.concatenate([u, edges, free], axis=1)
        over = np.einsum("nmj,nuj->num", rows, u) + slack[:, None]
        value = np.einsum("nj,nuj->nu", slope, u) + square * (u**2).sum(axis=2)
    allowed = (over >= -_ROUNDING).all(axis=2) & np.isfinite(value)
    return np.asarray(np.where(allowed, value, 0.0).min(axis=1, initial=0.0))
