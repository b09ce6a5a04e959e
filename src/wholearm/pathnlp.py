"""The planning NLP of one-freedom phases, in the path domain.

On a curve z(s) everything is affine in a = s'', b = s'^2 and the squeeze lambda, but for viscous
friction (`wholearm.dynamics.PathForces`). At the nodes s_k of a grid the unknowns are a_k, b_k and
lambda_k; between two nodes a and lambda are linear in s, and b' = 2 a (dash: d/ds) is then exact:

    b_k+1 = b_k + (s_k+1 - s_k) (a_k + a_k+1),
    c_n >= epsilon,  |tau| <= limit at every node,
    T = sum of 2 (s_k+1 - s_k) / (sqrt(b_k) + sqrt(b_k+1)).

Where a direction reverses, the grid has an interval of length zero: b is the same on its two sides,
a and lambda may jump. So one NLP, built once for a number of contacts, intervals and an objective,
serves every phase: grid, coefficients and limits are its parameters and bounds.

The least margin, and the relaxation of a limit, have an unknown at every node with m_k+1 = m_k. A
column through all rows would make building the Jacobian quadratic in the number of nodes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .nodechain import Chain, Links, stage
from .contact import Expression
from .ipopt import build_solver
from .model import Array
from .options import Objective
from .pathdata import PhaseData, Relaxation
from .pathmotion import Grid, Profile

_CALM = 1e-4
"""Weight of the squeeze against the objective: picks one among equally good ones."""
_SMOOTH = 1e-5
"""Weight of changes of a and lambda: rules out ripple that the objective does not see."""

_LEAST_B = 1e-8
"""Least b away from rest, in units of the typical one; keeps the square root differentiable."""
_MU = 1e-2
"""Complementarity of the first guess's multipliers: the barrier parameter to start from."""
_CHAINED = (Objective.MARGIN, Objective.RELAX)
"""Objectives with one more unknown, which every node has a copy of."""


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
    limits : ndarray, shape (N + 1, n_c + 4), [N, N m]
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
        limits = np.zeros((count, data.curve.formation.n_contacts + 4))
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
    solver : casadi.Function or wholearm.nodechain.StagedSolver
        Takes x0, p, bounds and multipliers; see `build_path_nlp` for their order.
    n_contacts, intervals : int
    objective : Objective
    build_time : float, [s]
    """

    solver: Expression
    n_contacts: int
    intervals: int
    objective: Objective
    build_time: float

    @property
    def columns(self) -> int:
        """Unknowns per node: b, a, squeeze, and what the objective adds."""
        return 3 + _count_extras(self.objective, self.n_contacts)

    @property
    def links(self) -> int:
        """Equations per interval."""
        return 2 if self.objective in _CHAINED else 1

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


def _count_extras(objective: Objective, n_contacts: int) -> int:
    """Unknowns per node besides b, a and squeeze: shortfalls, or the margin or relaxation."""
    return n_contacts + 2 if objective is Objective.ELASTIC else int(objective in _CHAINED)


@lru_cache(maxsize=16)
def build_path_nlp(
    n_contacts: int, intervals: int, objective: Objective, solver: str = "ipopt"
) -> PathNLP:
    """Build the NLP for every phase of so many contacts.

    The unknowns are (b, a, squeeze, extras) node by node, without b at the two ends. The extras
    are shortfalls for `elastic`, the least margin for `margin` and the relaxation for `relax`. The
    parameters are the speeds at the ends, the steps, the weight of time, and the coefficients of
    `PathForces` but for C0 and T0, which are part of the bounds; for `relax` also what the
    relaxation is worth for each limit, and b's coefficients in the speed limit. The constraints are
    the N rows of b' = 2 a, those that chain the margin or the relaxation, the changes of a over the
    first and the last interval, c_n and tau (and the speed for `relax`) node by node, and T for
    `margin`.
    """
    started = time.perf_counter()
    n, m = intervals + 1, n_contacts + 2
    staged = solver == "fatrop"
    b_inner, ends = ca.SX.sym("b", n - 2), ca.SX.sym("ends", 2)
    a, squeeze = ca.SX.sym("a", n), ca.SX.sym("squeeze", n)
    extra = ca.SX.sym("extra", n, _count_extras(objective, n_contacts))
    h, weight = ca.SX.sym("h", intervals), ca.SX.sym("weight")
    coefficients = [ca.SX.sym(name, n, m) for name in ("Pa", "Pb", "Pl")] + [ca.SX.sym("Tv", n, 2)]
    b = ca.vertcat(ends[0] ** 2, b_inner, ends[1] ** 2)
    # fatrop strays beyond bounds on its way, where the root must not fail.
    rooted = ca.fmax(b_inner, _LEAST_B) if staged else b_inner
    speed = ca.vertcat(ends[0], ca.sqrt(rooted), ends[1])

    def spread(column: Expression) -> Expression:
        return ca.repmat(column, 1, m)

    Pa, Pb, Pl, Tv = coefficients
    forces = Pa * spread(a) + Pb * spread(b) + Pl * spread(squeeze)
    c_n, tau = forces[:, :n_contacts], forces[:, n_contacts:] + Tv * ca.repmat(speed, 1, 2)
    interval_times = 2 * h / (speed[:-1] + speed[1:])
    node_weights = ca.vertcat(0, h) + ca.vertcat(h, 0)
    # What is relaxed has to be as little as possible, whatever the motion is like.
    share = 1e-3 if objective is Objective.RELAX else 1.0
    node_costs = share * _CALM * node_weights * squeeze**2
    link_costs = share * _SMOOTH * h * ((a[1:] - a[:-1]) ** 2 + (squeeze[1:] - squeeze[:-1]) ** 2)
    links = [b[1:] - b[:-1] - h * (a[1:] + a[:-1])]
    c_rows, tau_rows, last = c_n, tau, []
    if objective in _CHAINED:
        links.append(extra[1:] - extra[:-1])
    if objective is Objective.TIME:
        link_costs += interval_times
    elif objective is Objective.EFFORT:
        # The bounds hold T0, so the full torque is passed as a parameter for the integrand only.
        T0 = ca.SX.sym("T0", n, 2)
        coefficients.append(T0)
        full = tau + T0
        squares = full[:-1, :] ** 2 + full[:-1, :] * full[1:, :] + full[1:, :] ** 2
        link_costs += interval_times * (ca.sum2(squares) / 3 + weight)
    elif objective is Objective.MARGIN:
        c_rows = c_n - ca.repmat(extra, 1, n_contacts)
        node_costs[0] -= extra[0]
        last = [ca.sum1(interval_times)]
    elif objective is Objective.ELASTIC:
        # Every node counts alike: where intervals are short, being short must not be cheap.
        node_costs += ca.sum2(extra) / n
        link_costs += 1e-4 * interval_times
        short = extra
    else:
        worth, Rb = ca.SX.sym("worth", 1, m + 1), ca.SX.sym("Rb", n)
        coefficients += [worth, Rb]
        short = extra @ worth
        node_costs[0] += extra[0]
        link_costs += 1e-5 * interval_times
    if objective in (Objective.ELASTIC, Objective.RELAX):
        c_rows = c_n + short[:, :n_contacts]
        easing = short[:, n_contacts:m]
        tau_rows = ca.horzcat(tau + easing, tau - easing)
    if objective is Objective.RELAX:
        tau_rows = ca.horzcat(tau_rows, Rb * b - short[:, m])
    nodes = ca.horzcat(b, a, squeeze, extra).T
    rows = ca.horzcat(c_rows, tau_rows)
    chain = Chain(
        ca.vertcat(nodes[1:, 0], ca.vec(nodes[:, 1:-1]), nodes[1:, -1]),
        ca.vertcat(ends, h, weight, *(ca.vec(block) for block in coefficients)),
        np.repeat(np.arange(n), nodes.size1())[1:-1],
        Links(
            ca.vertcat(*links, a[1] - a[0], a[-1] - a[-2]),
            np.append(np.tile(np.arange(intervals), len(links)), [0, intervals - 1]),
        ),
        rows,
        link_costs,
        node_costs,
    )
    built = stage("path_nlp", chain) if staged else _build_ipopt(chain, last, objective)
    return PathNLP(built, n_contacts, intervals, objective, time.perf_counter() - started)


def _build_ipopt(chain: Chain, last: list[Expression], objective: Objective) -> Expression:
    """Ipopt for an NLP that may have more rows than a chain has."""
    nlp = {
        "x": chain.x,
        "p": chain.p,
        "f": ca.sum1(chain.link_costs) + ca.sum1(chain.node_costs),
        "g": ca.vertcat(chain.links.values, ca.vec(chain.rows.T), *last),
    }
    # Started from nowhere near their optimum, these need the more robust strategy.
    robust = objective in (Objective.ELASTIC, Objective.RELAX)
    strategy = {"mu_strategy": "monotone"} if robust else {"mu_oracle": "probing"}
    return build_solver("path_nlp", nlp, 1e-9, max_iter=300, **strategy)


def parameters(
    nlp: PathNLP,
    data: PhaseData,
    scales: Scales,
    time_weight: float,
    relaxation: Relaxation | None = None,
) -> Array:
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
    if relaxation is not None:
        units = np.append(np.full(nlp.n_contacts, force), np.ones(3))
        rates = data.relative_rates(data.nodes, relaxation.finger)
        blocks += [relaxation.worth / units, rates**2 * b_unit]
    steps = data.grid.steps / scales.length
    return np.concatenate([[0.0, 0.0], steps, [time_weight], *(b.ravel("F") for b in blocks)])


def make_bounds(
    nlp: PathNLP,
    data: PhaseData,
    scales: Scales,
    tightening: Tightening,
    relaxation: Relaxation | None = None,
) -> dict[str, Array]:
    """Bounds of the NLP, with every limit tightened."""
    tight, speed_share, duration = tightening
    n, n_c = len(data.grid.s), nlp.n_contacts
    b_unit = scales.profile[0]
    low, high = np.full((n, nlp.columns), -np.inf), np.full((n, nlp.columns), np.inf)
    low[:, 0] = _LEAST_B
    relaxed = None if relaxation is None else relaxation.finger
    b_max = data.largest_b(data.nodes, relaxed)
    high[:, 0] = np.maximum(b_max * speed_share / b_unit, 2 * _LEAST_B)
    low[:, 3:] = -np.inf if nlp.objective is Objective.MARGIN else 0.0
    forces, limit = data.nodes.forces, data.torque_limit
    c_low = (data.epsilon + tight[:, :n_c] - forces.C0) / scales.force
    t_low = tight[:, n_c : n_c + 2] - limit - forces.T0
    t_high = limit - tight[:, n_c + 2 :] - forces.T0
    free = np.full_like(t_low, np.inf)
    if nlp.objective in (Objective.ELASTIC, Objective.RELAX):
        t_low, t_high = np.hstack([t_low, -free]), np.hstack([free, t_high])
    if nlp.objective is Objective.RELAX:
        t_low, t_high = np.hstack([t_low, -free[:, :1]]), np.hstack([t_high, np.ones((n, 1))])
    equal = np.zeros(nlp.first)
    rows_low, rows_high = np.hstack([c_low, t_low]), np.hstack([c_low * 0 + np.inf, t_high])
    last_low, last_high = [], []
    if nlp.objective is Objective.MARGIN:
        last_low, last_high = [-np.inf], [(duration or np.inf) / scales.time]
    return {
        "lbx": low[nlp.free],
        "ubx": high[nlp.free],
        "lbg": np.concatenate([equal, rows_low.ravel(), last_low]),
        "ubg": np.concatenate([equal, rows_high.ravel(), last_high]),
    }


def first_multipliers(
    nlp: PathNLP, data: PhaseData, profile: Profile, scales: Scales
) -> dict[str, Array]:
    """Multipliers that put the first guess near the central path of the barrier problem."""
    if nlp.objective is not Objective.TIME:
        return {}
    n_c = nlp.n_contacts
    slack = data.slack(data.nodes, profile)
    slack[:, :n_c] /= scales.force
    pull = _MU / np.maximum(slack, 1e-3)
    rows = np.hstack([-pull[:, :n_c], pull[:, n_c + 2 :] - pull[:, n_c : n_c + 2]])
    on_b = np.zeros((len(data.grid.s), nlp.columns))
    on_b[:, 0] = -_MU / np.maximum(profile.b / scales.profile[0], 1e-3)
    return {
        "lam_x0": on_b[nlp.free],
        "lam_g0": np.concatenate([np.zeros(nlp.first), rows.ravel()]),
    }


def pack(
    nlp: PathNLP, profile: Profile, scales: Scales, margin: float, short: Array | None = None
) -> Array:
    """Unknowns of the NLP, in its units, from a profile and what its objective adds.

    That is the least margin [N], (elastic) shortfalls [N, N m], or the relaxation, given as margin.
    """
    table = np.zeros((len(profile.a), nlp.columns))
    if short is not None:
        table[:, 3:] = short / np.repeat([scales.force, 1.0], [nlp.n_contacts, 2])
    elif nlp.objective in _CHAINED:
        table[:, 3] = margin / _margin_unit(nlp, scales)
    table[:, :3] = np.column_stack([profile.b, profile.a, profile.squeeze]) / scales.profile
    return np.asarray(table[nlp.free])


def _margin_unit(nlp: PathNLP, scales: Scales) -> float:
    return scales.force if nlp.objective is Objective.MARGIN else 1.0


def unpack(nlp: PathNLP, grid: Grid, x: Array, scales: Scales) -> tuple[Profile, float]:
    """Profile of a solution, and the least margin [N] or the relaxation if that is an unknown.

    b is integrated again from a, so that b' = 2 a holds to rounding and not to Ipopt's tolerance.
    """
    table = np.zeros((len(grid.s), nlp.columns))
    table[nlp.free] = x
    a, squeeze = table[:, 1] * scales.profile[1], table[:, 2] * scales.profile[2]
    steps = grid.steps
    a = a - np.dot(steps, a[1:] + a[:-1]) / (2 * grid.s[-1])
    b = np.concatenate([[0.0], np.cumsum(steps * (a[1:] + a[:-1]))])
    b[-1] = 0.0
    margin = x[-1] * _margin_unit(nlp, scales) if nlp.objective in _CHAINED else 0.0
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
    stop = nlp.first + len(nodes) * (nlp.n_contacts + 2)
    rows = carry(on_g[nlp.first : stop].reshape(len(nodes), -1)).ravel()
    return {
        "lam_x0": carry(table)[nlp.free],
        "lam_g0": np.concatenate([*links, on_g[ends : nlp.first], rows, on_g[stop:]]),
    }
