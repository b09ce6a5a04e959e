"""The planning NLP in the time domain, for formations with any number of freedoms.

A stage is a stretch on one formation with fixed directions of friction, of free duration T, in K
intervals with d collocation points each. At every point z, z', z'', c_n and tau are unknowns, and

    C(z) = 0,  A z' = 0,  A z'' + A' z' = 0,
    M5 z'' + B z' + D sigma = g + S tau + G^T c_n,
    c_n >= epsilon,  |tau| <= limit,  Xi A_t z' >= 0,  sigma theta' >= 0.

So contacts hold at every point, without drift, and friction never pushes the wrong way. Along the
contacts' tangent space alone, with an orthonormal basis N of the null space of A at a guess of
each interval, the differential equations are collocated:

    N^T (z_j - z_0 - h sum_l a_jl z'_l) = 0,  N^T (z'_j - z'_0 - h sum_l a_jl z''_l) = 0.

Stages that follow one another share position and velocity. The equations of a point are one
expanded function, mapped over the points of a stage.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from .collocation import Scheme
from .contact import Contact, Expression, build_features, build_gap
from .curve import metric_weights
from .formation import TOUCHING, Formation
from .ipopt import build_solver
from .model import Array
from .options import Objective
from .stage import Stage

OPENING = 0.1
"""Least acceleration with which the gap of a released contact opens [m/s^2]."""
CLEAR = 2e-5
"""Gap of a released contact after a third of the stage at least [m]."""
SLIDING = 0.005
"""Least sliding over the radius of gyration, and least speed of a joint [rad/s]."""
SHORTEST = 1e-4
"""Least duration of a stage [s]."""
LONGEST = 20.0
"""Largest duration of a stage [s]."""


@dataclass(frozen=True, eq=False)
class TimeNLP:
    """A built NLP.

    Attributes
    ----------
    solver : casadi.Function
    low, high : ndarray
        Bounds of the constraints.
    build_time : float, [s]
    """

    solver: Expression
    low: Array
    high: Array
    build_time: float


class _Rows:
    """Constraints under construction."""

    def __init__(self) -> None:
        self.parts: list[Expression] = []
        self.low: list[Array] = []
        self.high: list[Array] = []

    def add(self, rows: Expression, low: float = 0.0, high: float = 0.0) -> None:
        rows = ca.vec(rows)
        self.parts.append(rows)
        self.low.append(np.full(rows.numel(), low))
        self.high.append(np.full(rows.numel(), high))


def build_time_nlp(
    stages: Sequence[Stage],
    scheme: Scheme,
    start: tuple[Array, Array],
    objective: Objective,
    time_weight: float,
    max_iter: int,
) -> TimeNLP:
    """Build the NLP of stages that follow one another and end at rest.

    The unknowns are those of `StagePoints.pack`, stage after stage; for `margin` the least margin
    follows. The parameters, for each stage, are what c_n has to exceed, (n_c, K) [N], and what
    tau must not exceed, (2, K) [N m], in each interval.

    Parameters
    ----------
    stages : sequence of Stage
    scheme : Scheme
    start : tuple of ndarray, shape (5,)
        z and z' at the start.
    objective : Objective
    time_weight : float, [(N m)^2]
        For `effort`.
    max_iter : int
        Most iterations of Ipopt.
    """
    started = time.perf_counter()
    rows = _Rows()
    unknowns, durations, efforts, limits = [], [], [], []
    margin = ca.MX.sym("margin", 1 if objective is Objective.MARGIN else 0)
    z_before, v_before = ca.DM(start[0]), ca.DM(start[1])
    rho = stages[0].formation.scene.polygon.gyration_radius
    for stage in stages:
        count, n_c = len(stage.z) - 1, stage.formation.n_contacts
        duration, table = ca.MX.sym("T"), ca.MX.sym("points", 17 + n_c, count)
        unknowns += [duration, ca.vec(table)]
        durations.append(duration)
        z, v, a, c_n, tau = ca.vertsplit(table, [0, 5, 10, 15, 15 + n_c, 17 + n_c])
        Xi, sigma = (ca.repmat(ca.DM(part), 1, count) for part in stage.directions)
        physics, senses = _point_function(stage.formation).map(count)(z, v, a, c_n, tau, Xi, sigma)
        rows.add(physics)
        rows.add(senses - ca.DM(_least_senses(stage, scheme)), 0.0, np.inf)
        _collocate(rows, stage, scheme, (z, v, a), (z_before, v_before), duration)
        if stage.watched:
            values = _watch_function(stage.formation, stage.watched).map(count)(z)
            rows.add((values - ca.DM(_clearance(stage, scheme))) / rho, 0.0, np.inf)
        for contact in _find_opening(stage):
            opening = _opening_function(stage.formation, contact).map(scheme.degree)
            first = [block[:, : scheme.degree] for block in (z, v, a)]
            rows.add(opening(*first) - OPENING, 0.0, np.inf)
        intervals = count // scheme.degree
        floor, cap = ca.MX.sym("floor", n_c, intervals), ca.MX.sym("cap", 2, intervals)
        limits += [ca.vec(floor), ca.vec(cap)]
        least = floor if margin.is_empty() else floor + margin
        _limit(rows, scheme, (c_n, tau), (least, cap))
        z_before, v_before = z[:, -1], v[:, -1]
        _end_stage(rows, stage, z_before, v_before, rho)
        efforts.append(_integrate_squares(tau, scheme, duration, count))
    _rest(rows, stages[-1], v_before)
    total = sum(durations)
    cost = {
        Objective.TIME: total,
        Objective.EFFORT: sum(efforts) + time_weight * total,
        Objective.MARGIN: -margin,
    }[objective]
    if objective is Objective.MARGIN:
        rows.add(total, 0.0, np.inf)
    nlp = {
        "x": ca.vertcat(*unknowns, margin),
        "p": ca.vertcat(*limits),
        "f": cost,
        "g": ca.vertcat(*rows.parts),
    }
    solver = build_solver("time_nlp", nlp, 1e-6, max_iter=max_iter)
    low, high = np.concatenate(rows.low), np.concatenate(rows.high)
    return TimeNLP(solver, low, high, time.perf_counter() - started)


@lru_cache(maxsize=32)
def _point_function(formation: Formation) -> Expression:
    """Function (z, z', z'', c_n, tau, Xi, sigma) -> equations and senses of friction at a point."""
    scene, n_c = formation.scene, formation.n_contacts
    z, v, a = (ca.SX.sym(name, 5) for name in ("z", "v", "a"))
    c_n, tau = ca.SX.sym("c_n", n_c), ca.SX.sym("tau", 2)
    Xi, sigma = ca.SX.sym("Xi", n_c), ca.SX.sym("sigma", 2)
    C, A, A_t, A_dot_v = formation.function(z, v)
    G = A - ca.diag(ca.DM(formation.friction) * Xi) @ A_t
    friction = ca.DM(scene.viscous) * v + ca.DM(scene.dry) * ca.vertcat(0, 0, 0, sigma)
    applied = ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, tau)
    balance = ca.DM(scene.mass_diagonal) * a + friction - applied - G.T @ c_n
    rho = scene.polygon.gyration_radius
    equations = ca.vertcat(C / rho, A @ v, 0.1 * (A @ a + A_dot_v), balance)
    senses = ca.vertcat(Xi * (A_t @ v) / rho, sigma * v[3:])
    return ca.Function("point", [z, v, a, c_n, tau, Xi, sigma], [equations, senses])


@lru_cache(maxsize=64)
def _watch_function(formation: Formation, watched: tuple[int, ...]) -> Expression:
    values = ca.vertcat(*(formation.limits[k].value for k in watched))
    return ca.Function("watch", [build_features(formation.scene).z], [values])


def _least_senses(stage: Stage, scheme: Scheme) -> Array:
    """What each sense of friction has to exceed, shape (n_c + 2, K d) [rad/s].

    A contact that hardly slides would be held by friction, which is not what the plan assumes. At
    both ends, where motion starts, stops or turns, it is nothing.
    """
    x = _fractions(stage, scheme)
    return np.tile(SLIDING * 4 * x * (1 - x), (stage.formation.n_contacts + 2, 1))


def _clearance(stage: Stage, scheme: Scheme) -> Array:
    """What each watched limit has to exceed at each point, shape (n_watched, K d) [m].

    Nothing, but for a contact just released, which has to be well clear after a third of the stage.
    """
    values = stage.formation.evaluate_limits(stage.z[:1])[0, list(stage.watched)]
    released = stage.follows & (np.abs(values) < TOUCHING)
    later = _fractions(stage, scheme) > 1 / 3
    return np.asarray(CLEAR * np.outer(released, later), dtype=float)


def _fractions(stage: Stage, scheme: Scheme) -> Array:
    """Time of each point over the stage's duration, shape (K d,)."""
    count = (len(stage.z) - 1) // scheme.degree
    return np.asarray((np.arange(count)[:, None] + scheme.points).ravel() / count)


def _find_opening(stage: Stage) -> list[Contact]:
    """Contacts that touch at the start of a stage but are not in its formation."""
    if not stage.follows:
        return []
    values = stage.formation.evaluate_limits(stage.z[:1])[0]
    near = np.flatnonzero(np.abs(values) < TOUCHING)
    gained = [stage.formation.limits[k].gained for k in near]
    return [contact for contact in gained if contact is not None]


@lru_cache(maxsize=64)
def _opening_function(formation: Formation, contact: Contact) -> Expression:
    """Function (z, z', z'') -> second derivative of the gap of a contact [m/s^2]."""
    z, v, a = (ca.SX.sym(name, 5) for name in ("z", "v", "a"))
    _, A, _, A_dot_v = Formation(formation.scene, (contact,)).function(z, v)
    return ca.Function("opening", [z, v, a], [A @ a + A_dot_v])


def _collocate(
    rows: _Rows,
    stage: Stage,
    scheme: Scheme,
    points: tuple[Expression, Expression, Expression],
    start: tuple[Expression, Expression],
    duration: Expression,
) -> None:
    """Collocate z' and z'' along the tangent space.

    Everything is one sparse product over all intervals, which keeps the NLP's graph small.
    """
    z, v, a = points
    degree = scheme.degree
    count = z.shape[1] // degree
    metric = metric_weights(stage.formation.scene)
    middles = stage.z[degree // 2 :: degree][:count]
    bases = [_tangent_basis(stage.formation, z_k, metric).T / np.sqrt(metric[2]) for z_k in middles]
    project = ca.diagcat(*(ca.DM(basis) for basis in bases for _ in range(degree)))
    integrate = ca.kron(ca.DM.eye(count), ca.DM(scheme.integrals.T))
    repeat = ca.kron(ca.DM.eye(count), ca.DM.ones(1, degree))
    last = np.arange(degree - 1, (count - 1) * degree, degree).tolist()
    for state, rate, first in ((z, v, start[0]), (v, a, start[1])):
        firsts = ca.horzcat(first, state[:, last]) @ repeat
        defect = state - firsts - duration / count * (rate @ integrate)
        rows.add(project @ ca.vec(defect))


def _tangent_basis(formation: Formation, z: Array, metric: Array) -> Array:
    """Basis of the null space of A, orthonormal in the metric of curves, as covectors (5, f)."""
    A = formation.evaluate(z[None], np.zeros((1, 5))).A[0]
    _, values, right = np.linalg.svd(A / np.sqrt(metric))
    rank = int((values > 1e-9 * values[0]).sum())
    return np.asarray((right[rank:] * np.sqrt(metric)).T)


def _limit(
    rows: _Rows,
    scheme: Scheme,
    forces: tuple[Expression, Expression],
    limits: tuple[Expression, Expression],
) -> None:
    """Limits at the points, and at as many places between of the polynomials through them."""
    (c_n, tau), (floor, cap) = forces, limits
    wide = np.vstack([np.eye(scheme.degree), scheme.between]).T
    eye = ca.DM.eye(floor.shape[1])
    spread, repeat = ca.kron(eye, ca.DM(wide)), ca.kron(eye, ca.DM.ones(1, wide.shape[1]))
    torque, room = tau @ spread, cap @ repeat
    rows.add(c_n @ spread - floor @ repeat, 0.0, np.inf)
    rows.add(room - torque, 0.0, np.inf)
    rows.add(room + torque, 0.0, np.inf)


def _end_stage(rows: _Rows, stage: Stage, z: Expression, v: Expression, rho: float) -> None:
    """What holds at the end of a stage, but for rest at the end of the last one."""
    formation = stage.formation
    if stage.until is not None:
        if stage.until.contact is not None:
            z_ = build_features(formation.scene).z
            gap = ca.Function("gap", [z_], [build_gap(stage.until.contact, formation.scene)])
            rows.add(gap(z) / rho)
        elif stage.until.value is not None:
            rows.add(z[0 if stage.until.coordinate == "x" else 2] - stage.until.value)
    if stage.turns:
        _, _, A_t, _ = formation.function(z, v)
        rates = ca.vertcat(A_t @ v / rho, v[3:])
        rows.add(ca.vertcat(*(rates[k] for k in stage.turns)))
    if stage.gained is not None:
        extra = [i for i, c in enumerate(stage.gained.contacts) if c not in formation.contacts]
        _, A, _, _ = stage.gained.function(z, v)
        rows.add(ca.vertcat(*(A[i, :] @ v for i in extra)) / rho)


def _rest(rows: _Rows, stage: Stage, v: Expression) -> None:
    metric = metric_weights(stage.formation.scene)
    basis = _tangent_basis(stage.formation, stage.z[-1], metric)
    rows.add(ca.DM(basis.T) @ v / np.sqrt(metric[2]))


def _integrate_squares(
    tau: Expression, scheme: Scheme, duration: Expression, count: int
) -> Expression:
    """Integral of tau^T tau over a stage, by the scheme's quadrature."""
    intervals = count // scheme.degree
    weights = ca.DM(np.tile(scheme.integrals[-1], intervals) / intervals)
    return duration * ca.dot(weights, ca.sum1(tau**2).T)


def bound_unknowns(stages: Sequence[Stage], extra: int) -> tuple[Array, Array]:
    """Bounds of the unknowns: durations and joint speeds; `extra` free ones at the end."""
    lows: list[Any] = []
    highs: list[Any] = []
    for stage in stages:
        count, n_c = len(stage.z) - 1, stage.formation.n_contacts
        high = np.full((count, 17 + n_c), np.inf)
        high[:, 8:10] = stage.formation.scene.speed_limit
        low = -high
        lows.append(np.append(SHORTEST, low.ravel()))
        highs.append(np.append(LONGEST, high.ravel()))
    lows.append(np.full(extra, -np.inf))
    highs.append(np.full(extra, np.inf))
    return np.concatenate(lows), np.concatenate(highs)
