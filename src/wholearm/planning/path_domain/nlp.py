"""The planning NLP of one-freedom phases in the path domain: building, bounds, packing.

`terms` has its expressions. Built once for some contacts, intervals and an objective,
it serves every phase: grid, coefficients and limits are its parameters and bounds. Phases that
impacts join have an interval of length zero between them (`chain`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...solvers.ipopt import build_solver
from ..options import Objective
from .data import PhaseData, Relaxation
from .motion import Grid, Profile
from .terms import CHAINED, LEAST_B, count_extras, write_terms

_MU = 1e-2
"""Complementarity of the first guess's multipliers: the barrier parameter to start from."""


class Units(NamedTuple):
    """Units of the NLP, in which its numbers are near 1 whatever the scene's size and mass are.

    Attributes
    ----------
    length : float, [m]
    time : float, [s]
    force : float, [N]
    torque : ndarray, shape (2,), [N m]
        Of each joint.
    power : float, [(N m)^2]
        Of the effort's integrand.
    press : float, [N]
        What the hand can press with: a squeeze so large is nothing to be avoided.
    """

    length: float
    time: float
    force: float
    torque: Array
    power: float
    press: float

    @property
    def profile(self) -> Array:
        """Units of (b, a, squeeze), shape (3,)."""
        speed = self.length / self.time
        return np.array([speed**2, speed / self.time, self.force])

    def limits(self, n_held: int) -> Array:
        """Units of H c, tau + limit and limit - tau, shape (n_held + 4,)."""
        return np.append(np.full(n_held, self.force), np.tile(self.torque, 2))


class Tightening(NamedTuple):
    """By how much limits at the nodes are tightened so that they hold between nodes too.

    Attributes
    ----------
    limits : ndarray, shape (N + 1, n_h + 4), [N, N m]
        In the order of `PhaseData.slack`.
    speed_share : ndarray, shape (N + 1,)
        Factor on the largest b.
    duration : float or None, [s]
        Longest duration, if there is one.
    """

    limits: Array
    speed_share: Array
    duration: float | None

    @staticmethod
    def none(data: PhaseData, duration: float | None) -> Tightening:
        """Limits as they are."""
        count = len(data.grid.s)
        limits = np.zeros((count, len(data.least) + 4))
        return Tightening(limits, np.ones(count), duration)

    def by(self, reach: Array, limits: Array, speed_share: Array, late: float) -> Tightening:
        """Tighten further: limits by so much, b and the duration by a relative amount.

        Limits are first raised to `reach`, as what is slack already would not feel the rest.
        """
        duration = None if self.duration is None else self.duration * (1 - late)
        raised = np.maximum(self.limits, reach) + limits
        return Tightening(raised, self.speed_share * (1 - speed_share), duration)


@dataclass(frozen=True, eq=False)
class PathNLP:
    """A built NLP.

    Attributes
    ----------
    solver : casadi.Function
        Takes x0, p, bounds and multipliers; see `build_path_nlp` for their order.
    n_contacts, n_rolling, intervals : int
    objective : Objective
    build_time : float, [s]
    """

    solver: Expression
    n_contacts: int
    n_rolling: int
    intervals: int
    objective: Objective
    build_time: float

    @property
    def n_held(self) -> int:
        """Number n_h of rows of H c."""
        return self.n_contacts + 2 * self.n_rolling

    @property
    def columns(self) -> int:
        """Unknowns per node: b, a, squeeze, and what the objective adds."""
        return 3 + count_extras(self.objective, self.n_held)

    @property
    def links(self) -> int:
        """Equations per interval."""
        return 2 if self.objective in CHAINED else 1

    @property
    def first(self) -> int:
        """The first of the rows that belong to nodes."""
        return self.links * self.intervals + 2

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which entries of the (N + 1, columns) array of unknowns are not b at an end."""
        mask = np.ones((self.intervals + 1, self.columns), dtype=bool)
        mask[[0, -1], 0] = False
        return mask


@lru_cache(maxsize=16)
def build_path_nlp(
    n_contacts: int,
    intervals: int,
    objective: Objective,
    n_rolling: int = 0,
) -> PathNLP:
    """Build the NLP for every phase of so many contacts, of which so many roll.

    See `terms` for its unknowns, parameters and rows.
    """
    started = time.perf_counter()
    nlp = write_terms(n_contacts, intervals, objective, n_rolling)
    # Started from nowhere near their optimum, these need the more robust strategy.
    robust = objective in (Objective.ELASTIC, Objective.RELAX)
    strategy: dict[str, Any] = {"mu_strategy": "monotone"} if robust else {"mu_oracle": "probing"}
    solver = build_solver("path_nlp", nlp, 1e-9, max_iter=300, **strategy)
    seconds = time.perf_counter() - started
    return PathNLP(solver, n_contacts, n_rolling, intervals, objective, seconds)


def parameters(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    time_weight: float,
    relaxation: Relaxation | None = None,
) -> Array:
    """Parameters of the NLP, in its units; see `build_path_nlp` for their order."""
    forces, (b_unit, a_unit, force) = data.nodes.forces, units.profile
    torque = units.torque
    blocks = [
        np.hstack([forces.Ca * a_unit / force, forces.Ta * a_unit / torque]),
        np.hstack([forces.Cb * b_unit / force, forces.Tb * b_unit / torque]),
        np.hstack([forces.Cl, forces.Tl * force / torque]),
        forces.Tv * np.sqrt(b_unit) / torque,
    ]
    if nlp.objective is Objective.EFFORT:
        blocks += [forces.T0 / torque, torque**2 / units.power]
    if relaxation is not None:
        rows = np.concatenate([np.full(nlp.n_held, force), torque, [1.0]])
        rates = data.relative_rates(data.nodes, relaxation.finger)
        blocks += [relaxation.weights / rows, rates**2 * b_unit]
    steps, weight = data.grid.steps / units.length, time_weight / units.power
    scalars = [weight, force / units.press]
    return np.concatenate([[0.0, 0.0], steps, scalars, *(b.ravel("F") for b in blocks)])


def make_bounds(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    tightening: Tightening,
    relaxation: Relaxation | None = None,
) -> dict[str, Array]:
    """Bounds of the NLP, with every limit tightened."""
    tight, speed_share, duration = tightening
    n, n_h = len(data.grid.s), nlp.n_held
    b_unit = units.profile[0]
    low, high = np.full((n, nlp.columns), -np.inf), np.full((n, nlp.columns), np.inf)
    low[:, 0] = LEAST_B
    relaxed = None if relaxation is None else relaxation.finger
    b_max = data.largest_b(data.nodes, relaxed)
    high[:, 0] = np.maximum(b_max * speed_share / b_unit, 2 * LEAST_B)
    low[:, 3:] = -np.inf if nlp.objective is Objective.MARGIN else 0.0
    forces, limit = data.nodes.forces, data.torque_limit
    c_low = (data.least + tight[:, :n_h] - forces.C0) / units.force
    t_low = (tight[:, n_h : n_h + 2] - limit - forces.T0) / units.torque
    t_high = (limit - tight[:, n_h + 2 :] - forces.T0) / units.torque
    free = np.full_like(t_low, np.inf)
    if nlp.objective in (Objective.ELASTIC, Objective.RELAX):
        t_low, t_high = np.hstack([t_low, -free]), np.hstack([free, t_high])
    if nlp.objective is Objective.RELAX:
        t_low, t_high = np.hstack([t_low, -free[:, :1]]), np.hstack([t_high, np.ones((n, 1))])
    equal = np.zeros(nlp.first)
    rows_low, rows_high = np.hstack([c_low, t_low]), np.hstack([c_low * 0 + np.inf, t_high])
    last_low, last_high = [], []
    if nlp.objective is Objective.MARGIN:
        last_low, last_high = [-np.inf], [(duration or np.inf) / units.time]
    return {
        "lbx": low[nlp.free],
        "ubx": high[nlp.free],
        "lbg": np.concatenate([equal, rows_low.ravel(), last_low]),
        "ubg": np.concatenate([equal, rows_high.ravel(), last_high]),
    }


def first_multipliers(
    nlp: PathNLP, data: PhaseData, profile: Profile, units: Units
) -> dict[str, Array]:
    """Multipliers that put the first guess near the central path of the barrier problem."""
    if nlp.objective is not Objective.TIME:
        return {}
    n_h = nlp.n_held
    slack = data.slack(data.nodes, profile)
    slack /= units.limits(n_h)
    pull = _MU / np.maximum(slack, 1e-3)
    rows = np.hstack([-pull[:, :n_h], pull[:, n_h + 2 :] - pull[:, n_h : n_h + 2]])
    on_b = np.zeros((len(data.grid.s), nlp.columns))
    on_b[:, 0] = -_MU / np.maximum(profile.b / units.profile[0], 1e-3)
    return {
        "lam_x0": on_b[nlp.free],
        "lam_g0": np.concatenate([np.zeros(nlp.first), rows.ravel()]),
    }


def pack(
    nlp: PathNLP, profile: Profile, units: Units, margin: float, short: Array | None = None
) -> Array:
    """Unknowns of the NLP, in its units, from a profile and what its objective adds.

    That is the least margin [N], (elastic) shortfalls [N, N m], or the relaxation, given as margin.
    """
    table = np.zeros((len(profile.a), nlp.columns))
    if short is not None:
        table[:, 3:] = short / units.limits(nlp.n_held)[:-2]
    elif nlp.objective in CHAINED:
        table[:, 3] = margin / _margin_unit(nlp, units)
    table[:, :3] = np.column_stack([profile.b, profile.a, profile.squeeze]) / units.profile
    return np.asarray(table[nlp.free])


def _margin_unit(nlp: PathNLP, units: Units) -> float:
    return units.force if nlp.objective is Objective.MARGIN else 1.0


def unpack(nlp: PathNLP, grid: Grid, x: Array, units: Units) -> tuple[Profile, float]:
    """Profile of a solution, and the least margin [N] or the relaxation if that is an unknown.

    b is integrated again from a, so that b' = 2 a holds to rounding and not to Ipopt's tolerance.
    """
    table = np.zeros((len(grid.s), nlp.columns))
    table[nlp.free] = x
    a, squeeze = table[:, 1] * units.profile[1], table[:, 2] * units.profile[2]
    steps = grid.steps
    a = a - np.dot(steps, a[1:] + a[:-1]) / (2 * grid.s[-1])
    b = np.concatenate([[0.0], np.cumsum(steps * (a[1:] + a[:-1]))])
    # Where phases are joined at next to no speed, rounding can take b below zero.
    b = np.maximum(b, 0.0)
    b[-1] = 0.0
    margin = x[-1] * _margin_unit(nlp, units) if nlp.objective in CHAINED else 0.0
    return Profile(a, b, squeeze), float(margin)


def move_multipliers(
    nlp: PathNLP, multipliers: dict[str, Array], old: Grid, new: Grid
) -> dict[str, Array]:
    """Carry multipliers from one grid to another with the same segments."""
    nodes, intervals = np.arange(len(old.s)), nlp.intervals
    place = np.empty(len(nodes))
    for segment in range(int(old.segment[-1]) + 1):
        mine = old.segment == segment
        place[mine] = np.interp(new.s[mine], old.s[mine], nodes[mine])

    def carry(table: Array) -> Array:
        columns = [np.interp(place, nodes, column) for column in table.T]
        return np.column_stack(columns)

    on_x, on_g = multipliers["lam_x0"], multipliers["lam_g0"]
    table = np.zeros(nlp.free.shape)
    table[nlp.free] = on_x
    middles, ends = (place[1:] + place[:-1]) / 2, nlp.links * intervals
    links = [
        np.interp(middles, nodes[:-1] + 0.5, column)
        for column in on_g[:ends].reshape(nlp.links, intervals)
    ]
    stop = nlp.first + len(nodes) * (nlp.n_held + 2)
    rows = carry(on_g[nlp.first : stop].reshape(len(nodes), -1)).ravel()
    return {
        "lam_x0": carry(table)[nlp.free],
        "lam_g0": np.concatenate([*links, on_g[ends : nlp.first], rows, on_g[stop:]]),
    }
