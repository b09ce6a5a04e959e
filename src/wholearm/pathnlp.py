"""The planning NLP of one-freedom phases, in the path domain.

On a curve z(s) everything is affine in a = s'', b = s'^2 and the squeeze lambda, but for viscous
friction (`wholearm.dynamics.PathForces`). At the nodes s_k of a grid the unknowns are a_k, b_k and
lambda_k; between two nodes a and lambda are linear in s, and b' = 2 a (dash: d/ds) is then exact:

    b_k+1 = b_k + (s_k+1 - s_k) (a_k + a_k+1),
    H c >= least,  |tau| <= limit at every node,
    T = sum of 2 (s_k+1 - s_k) / (sqrt(b_k) + sqrt(b_k+1)).

H c are the normal forces, and the friction cones of contacts that roll (`wholearm.cones`).

Where a direction reverses, the grid has an interval of length zero: b is the same on its two sides,
a and lambda may jump. So one NLP, built once for some contacts, intervals and an objective, serves
every phase: grid, coefficients and limits are its parameters and bounds. Phases that impacts join
have such an interval between them, too (`wholearm.chain`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .contact import Expression
from .ipopt import build_solver
from .model import Array
from .options import Objective
from .pathdata import PhaseData
from .pathmotion import Grid, Profile

_CALM = 1e-4
"""Weight of the squeeze against the objective: picks one among equally good ones."""
_SMOOTH = 1e-5
"""Weight of changes of a and lambda: rules out ripple that the objective does not see."""

_LEAST_B = 1e-8
"""Least b away from rest, in units of the typical one; keeps the square root differentiable."""
_MU = 1e-2
"""Complementarity of the first guess's multipliers: the barrier parameter to start from."""


class Scales(NamedTuple):
    """Units of the NLP: length [m], time [s] and force [N]."""

    length: float
    time: float
    force: float

    @property
    def profile(self) -> Array:
        """Units of (b, a, squeeze), shape (3,)."""
        speed = self.length / self.time
        return np.array([speed**2, speed / self.time, self.force])


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
        """Unknowns per node: b, a, squeeze, and one shortfall per limit when elastic."""
        return 3 + (self.n_held + 2 if self.objective is Objective.ELASTIC else 0)

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which entries of the (N + 1, columns) array of unknowns are not b at an end."""
        mask = np.ones((self.intervals + 1, self.columns), dtype=bool)
        mask[[0, -1], 0] = False
        return mask


@lru_cache(maxsize=16)
def build_path_nlp(
    n_contacts: int, intervals: int, objective: Objective, n_rolling: int = 0
) -> PathNLP:
    """Build the NLP for every phase of so many contacts, of which so many roll.

    The unknowns are (b, a, squeeze, shortfalls) node by node, without b at the two ends, then the
    least margin for the objective `margin`. The parameters are the speeds at the ends, the steps,
    the weight of time, and the coefficients of `PathForces` but for C0 and T0, which are part of
    the bounds. The constraints are the N rows of b' = 2 a, the changes of a over the first and the
    last interval, H c and tau node by node, and T for `margin`.
    """
    started = time.perf_counter()
    n, n_held = intervals + 1, n_contacts + 2 * n_rolling
    m = n_held + 2
    elastic = objective is Objective.ELASTIC
    b_inner, ends = ca.SX.sym("b", n - 2), ca.SX.sym("ends", 2)
    a, squeeze = ca.SX.sym("a", n), ca.SX.sym("squeeze", n)
    short = ca.SX.sym("short", n, m if elastic else 0)
    margin = ca.SX.sym("margin", 1 if objective is Objective.MARGIN else 0)
    h, weight = ca.SX.sym("h", intervals), ca.SX.sym("weight")
    coefficients = [ca.SX.sym(name, n, m) for name in ("Pa", "Pb", "Pl")] + [ca.SX.sym("Tv", n, 2)]
    b = ca.vertcat(ends[0] ** 2, b_inner, ends[1] ** 2)
    speed = ca.vertcat(ends[0], ca.sqrt(b_inner), ends[1])

    def spread(column: Expression) -> Expression:
        return ca.repmat(column, 1, m)

    Pa, Pb, Pl, Tv = coefficients
    forces = Pa * spread(a) + Pb * spread(b) + Pl * spread(squeeze)
    held, tau = forces[:, :n_held], forces[:, n_held:] + Tv * ca.repmat(speed, 1, 2)
    interval_times = 2 * h / (speed[:-1] + speed[1:])
    duration = ca.sum1(interval_times)
    node_weights = ca.vertcat(0, h) + ca.vertcat(h, 0)
    calm = _CALM * ca.dot(node_weights, squeeze**2) + _SMOOTH * (
        ca.dot(h, (a[1:] - a[:-1]) ** 2) + ca.dot(h, (squeeze[1:] - squeeze[:-1]) ** 2)
    )
    c_rows, tau_rows, last = held, tau, []
    if objective is Objective.TIME:
        cost = duration
    elif objective is Objective.EFFORT:
        # The bounds hold T0, so the full torque is passed as a parameter for the integrand only.
        T0 = ca.SX.sym("T0", n, 2)
        coefficients.append(T0)
        full = tau + T0
        squares = full[:-1, :] ** 2 + full[:-1, :] * full[1:, :] + full[1:, :] ** 2
        cost = ca.dot(interval_times, ca.sum2(squares)) / 3 + weight * duration
    elif objective is Objective.MARGIN:
        counted = ca.horzcat(ca.DM.ones(1, n_contacts), ca.DM(1, 2 * n_rolling))
        c_rows = held - ca.repmat(margin, n, 1) @ counted
        cost, last = -margin, [duration]
    else:
        # Every node counts alike: where intervals are short, being short must not be cheap.
        cost = ca.sum1(ca.sum2(short)) / n + 1e-4 * duration
        c_rows = held + short[:, :n_held]
        tau_rows = ca.horzcat(tau + short[:, n_held:], tau - short[:, n_held:])
    nodes = ca.horzcat(b, a, squeeze, short).T
    x = ca.vertcat(nodes[1:, 0], ca.vec(nodes[:, 1:-1]), nodes[1:, -1], margin)
    constraints = ca.vertcat(
        b[1:] - b[:-1] - h * (a[1:] + a[:-1]),
        a[1] - a[0],
        a[-1] - a[-2],
        ca.vec(ca.horzcat(c_rows, tau_rows).T),
        *last,
    )
    parameters = ca.vertcat(ends, h, weight, *(ca.vec(block) for block in coefficients))
    nlp = {"x": x, "p": parameters, "f": cost + calm, "g": constraints}
    # Started from nowhere near its optimum, the elastic NLP needs the more robust strategy.
    strategy: dict[str, Any] = {"mu_strategy": "monotone"} if elastic else {"mu_oracle": "probing"}
    solver = build_solver("path_nlp", nlp, 1e-9, max_iter=300, **strategy)
    seconds = time.perf_counter() - started
    return PathNLP(solver, n_contacts, n_rolling, intervals, objective, seconds)


def parameters(nlp: PathNLP, data: PhaseData, scales: Scales, time_weight: float) -> Array:
    """Parameters of the NLP, in its units; see `build_path_nlp` for their order."""
    forces, (b_unit, a_unit, force) = data.nodes.forces, scales.profile
    blocks = [
        np.hstack([forces.Ca * a_unit / force, forces.Ta * a_unit]),
        np.hstack([forces.Cb * b_unit / force, forces.Tb * b_unit]),
        np.hstack([forces.Cl, forces.Tl * force]),
        forces.Tv * np.sqrt(b_unit),
    ]
    if nlp.objective is Objective.EFFORT:
        blocks.append(forces.T0)
    steps = data.grid.steps / scales.length
    return np.concatenate([[0.0, 0.0], steps, [time_weight], *(b.ravel("F") for b in blocks)])


def make_bounds(
    nlp: PathNLP,
    data: PhaseData,
    scales: Scales,
    tightening: Tightening,
) -> dict[str, Array]:
    """Bounds of the NLP, with every limit tightened."""
    tight, speed_share, duration = tightening
    n, n_h = len(data.grid.s), nlp.n_held
    b_unit = scales.profile[0]
    low, high = np.full((n, nlp.columns), -np.inf), np.full((n, nlp.columns), np.inf)
    low[:, 0] = _LEAST_B
    high[:, 0] = np.maximum(data.largest_b(data.nodes) * speed_share / b_unit, 2 * _LEAST_B)
    low[:, 3:] = 0.0
    forces, limit = data.nodes.forces, data.torque_limit
    c_low = (data.least + tight[:, :n_h] - forces.C0) / scales.force
    t_low = tight[:, n_h : n_h + 2] - limit - forces.T0
    t_high = limit - tight[:, n_h + 2 :] - forces.T0
    free = np.full_like(t_low, np.inf)
    if nlp.objective is Objective.ELASTIC:
        t_low, t_high = np.hstack([t_low, -free]), np.hstack([free, t_high])
    equal = np.zeros(nlp.intervals + 2)
    rows_low, rows_high = np.hstack([c_low, t_low]), np.hstack([c_low * 0 + np.inf, t_high])
    last_low, last_high, margin = [], [], []
    if nlp.objective is Objective.MARGIN:
        last_low, last_high, margin = [-np.inf], [(duration or np.inf) / scales.time], [np.inf]
    return {
        "lbx": np.concatenate([low[nlp.free], [-m for m in margin]]),
        "ubx": np.concatenate([high[nlp.free], margin]),
        "lbg": np.concatenate([equal, rows_low.ravel(), last_low]),
        "ubg": np.concatenate([equal, rows_high.ravel(), last_high]),
    }


def first_multipliers(
    nlp: PathNLP, data: PhaseData, profile: Profile, scales: Scales
) -> dict[str, Array]:
    """Multipliers that put the first guess near the central path of the barrier problem."""
    if nlp.objective is not Objective.TIME:
        return {}
    n_h = nlp.n_held
    slack = data.slack(data.nodes, profile)
    slack[:, :n_h] /= scales.force
    pull = _MU / np.maximum(slack, 1e-3)
    rows = np.hstack([-pull[:, :n_h], pull[:, n_h + 2 :] - pull[:, n_h : n_h + 2]])
    on_b = np.zeros((len(data.grid.s), nlp.columns))
    on_b[:, 0] = -_MU / np.maximum(profile.b / scales.profile[0], 1e-3)
    return {
        "lam_x0": on_b[nlp.free],
        "lam_g0": np.concatenate([np.zeros(nlp.intervals + 2), rows.ravel()]),
    }


def pack(
    nlp: PathNLP, profile: Profile, scales: Scales, margin: float, short: Array | None = None
) -> Array:
    """Unknowns of the NLP, in its units, from a profile and (elastic) shortfalls [N, N m]."""
    table = np.zeros((len(profile.a), nlp.columns))
    if short is not None:
        table[:, 3:] = short / np.repeat([scales.force, 1.0], [nlp.n_held, 2])
    table[:, :3] = np.column_stack([profile.b, profile.a, profile.squeeze]) / scales.profile
    last = [margin / scales.force] if nlp.objective is Objective.MARGIN else []
    return np.concatenate([table[nlp.free], last])


def unpack(nlp: PathNLP, grid: Grid, x: Array, scales: Scales) -> tuple[Profile, float]:
    """Profile of a solution, and the least margin [N] if that is an unknown.

    b is integrated again from a, so that b' = 2 a holds to rounding and not to Ipopt's tolerance.
    """
    table = np.zeros((len(grid.s), nlp.columns))
    table[nlp.free] = x[: int(nlp.free.sum())]
    a, squeeze = table[:, 1] * scales.profile[1], table[:, 2] * scales.profile[2]
    steps = grid.steps
    a = a - np.dot(steps, a[1:] + a[:-1]) / (2 * grid.s[-1])
    b = np.concatenate([[0.0], np.cumsum(steps * (a[1:] + a[:-1]))])
    # Where phases are joined at next to no speed, rounding can take b below zero.
    b = np.maximum(b, 0.0)
    b[-1] = 0.0
    margin = x[-1] * scales.force if nlp.objective is Objective.MARGIN else 0.0
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
    inner = int(nlp.free.sum())
    table = np.zeros(nlp.free.shape)
    table[nlp.free] = on_x[:inner]
    middles = (place[1:] + place[:-1]) / 2
    defects = np.interp(middles, nodes[:-1] + 0.5, on_g[:intervals])
    first = intervals + 2
    stop = first + len(nodes) * (nlp.n_held + 2)
    rows = carry(on_g[first:stop].reshape(len(nodes), -1)).ravel()
    return {
        "lam_x0": np.concatenate([carry(table)[nlp.free], on_x[inner:]]),
        "lam_g0": np.concatenate([defects, on_g[intervals:first], rows, on_g[stop:]]),
    }
