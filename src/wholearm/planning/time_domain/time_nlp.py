"""NLP of stages in the time domain by direct collocation, for any number of degrees of freedom.

A stage has one formation and fixed directions of friction, in K intervals of unknown durations h
with d collocation points. Its equations are in the README. Only rows of collocation contain h, so
that the duration of a stage may be zero. Rates that equations fix at zero have no sign constraint:
it would leave the feasible set without interior. All quantities are in the scene's units.

Rate-limited torques have control points c_0 ... c_n in each interval and are continuous; with rate
limit R

    |c_k+1 - c_k| n <= R h,
    |h c_k + lag (k (c_k - c_k-1) + (n - k) (c_k+1 - c_k))| <= limit h

bound derivatives and commands between nodes by their Bernstein control points. At both ends the
torques balance the object at rest, with friction in the directions of motion. Contact forces are
continuous, too. They decrease to zero before a release, increase from zero after a soft gain, and
reach the boundary of the friction cone before a rolling contact slides.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, pairwise
from math import comb
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression, Flags
from ...common.errors import Parameter
from ...contacts.contact_limits import build_limits, list_renamed
from ...contacts.elemental import Contact, build_features
from ...contacts.formation import Formation
from ...geometry.curve import find_tied, find_vanishing, tangent_basis
from ...mechanics.dynamics import build_force_rows, forward
from ...mechanics.limits import CONE, PRESS, SPEED, LimitSet, make_limits
from ...problem.definition import Until
from ..nlp import (
    Columns,
    Indices,
    Kernel,
    NlpRows,
    SolverStatistics,
    add_cost,
    build_kernel,
    build_solver,
    cached_kernel,
)
from ..options import Objective
from .stage import LimitViolations, Scheme, Stage, StagePoints, bernstein, make_scheme

MIN_RATE = 1e-5  # least rate of sliding contacts, over the radius of gyration, and of joints


@dataclass(frozen=True, eq=False)
class StageLayout:
    """Indices of one stage's unknowns; fields of `StagePoints` have the shapes given there."""

    h: Indices
    nodes: Indices
    z: Indices
    v: Indices
    a: Indices
    forces: Indices
    tau: Indices
    impulses: Indices  # of the impact that leads to the next stage, if one does
    margin: Indices  # (K + 1, 1) or (K + 1, 0): copies of a margin or relaxation at the nodes
    shortfalls: Indices  # (K, n) or (K, 0): shortfalls of limits in each interval
    start_forces: Indices  # start_forces, end_forces: c_n, c_t and joint friction at rest at both
    end_forces: Indices  # ends, with continuous torques

    @property
    def stop(self) -> int:
        """One past the index of the last unknown."""
        return 1 + max(int(part.max(initial=-1)) for part in vars(self).values())


def lay_out(
    stages: Sequence[Stage], scheme: Scheme, target: Target, with_statics: bool = False
) -> list[StageLayout]:
    """Indices of the unknowns of successive stages, `with_statics` also of forces at rest."""
    layouts: list[StageLayout] = []
    stop, d, m, n_margin = 0, scheme.degree, scheme.controls, int(target.has_margin)

    def take(*shape: int) -> Indices:
        nonlocal stop
        indices = stop + np.arange(int(np.prod(shape))).reshape(shape)
        stop += indices.size
        return indices

    for k, stage in enumerate(stages):
        K, formation = stage.intervals, stage.formation
        # In elastic mode every limit but those of speeds has a shortfall in each interval.
        soft = make_limits(formation, target.epsilon).without(SPEED).limits
        n_short = len(soft) * (target.objective is Objective.ELASTIC)
        width, end = d * (15 + formation.n_constraints), 10 * (not scheme.has_end)
        starts_at_rest = with_statics and (not k or stages[k - 1].ends_at_rest)
        start_forces = take((2 * formation.n_contacts + 2) * starts_at_rest)
        first, first_margin = take(10), take(n_margin)
        interval = Columns(h=1, tau=2 * m, points=width, end=end, short=n_short, margin=n_margin)
        table = take(K, interval.count)
        blocks = {name: table[:, part] for name, part in interval.slices.items()}
        by_point = blocks["points"].reshape(K, d, -1)
        z, v, a, forces = np.split(by_point, [5, 10, 15], axis=2)
        ends = by_point[:, -1, :10] if scheme.has_end else blocks["end"]
        has_impact = stage.ends_in_impact and k + 1 < len(stages)
        nodes, tau = np.vstack([first, ends]).reshape(K + 1, 2, 5), blocks["tau"].reshape(K, m, 2)
        impulses = take(stages[k + 1].formation.n_constraints if has_impact else 0)
        margin = np.vstack([first_margin, blocks["margin"]])
        end_forces = take((2 * stage.ending.n_contacts + 2) * (with_statics and stage.ends_at_rest))
        points = blocks["h"][:, 0], nodes, z, v, a, forces, tau, impulses
        layouts.append(StageLayout(*points, margin, blocks["short"], start_forces, end_forces))
    return layouts


def pack(points: Sequence[StagePoints], layouts: Sequence[StageLayout], margin: float) -> Array:
    """Unknowns as one vector."""
    x = np.zeros(layouts[-1].stop)
    for part, layout in zip(points, layouts, strict=True):
        for name, table in part._asdict().items():
            x[getattr(layout, name)] = table
        x[layout.shortfalls], x[layout.margin] = 1.0, margin
        statics = (layout.start_forces, part.forces[0, 0]), (layout.end_forces, part.forces[-1, -1])
        for indices, forces in statics:
            x[indices[: len(forces)]] = forces[: len(indices)]
    return x


def unpack(x: Array, layouts: Sequence[StageLayout]) -> list[StagePoints]:
    """Stage points of a vector of unknowns, the inverse of `pack`."""
    names = StagePoints._fields
    return [StagePoints(*(x[getattr(layout, name)] for name in names)) for layout in layouts]


class Target(NamedTuple):
    """Objective of an NLP."""

    objective: Objective
    epsilon: float  # [N]: least normal force
    time_weight: float = 0.0  # [(N m)^2]: for `effort`
    relaxation: Parameter | None = None  # the relaxed limit, for `relax`
    keeps_gaps: bool = True  # whether gaps closed at the start may not close further

    @property
    def has_margin(self) -> bool:
        """Whether nodes have a further unknown, equal at all: a margin or a relaxation."""
        return self.objective in (Objective.MARGIN, Objective.RELAX)


class LimitPart(NamedTuple):
    """How one side of the limits of a stage is imposed: as rows or as bounds of unknowns."""

    side: int
    on_rows: bool
    indices: Indices  # (K, n): of rows, by their lower bounds, or of unknowns


@dataclass(frozen=True, eq=False)
class StageRows:
    """Rows of one stage, interval by interval."""

    states: Indices  # (K, 2, n, f): collocation of z and z', n rows of the scheme along `bases`
    bases: Array  # (K, 5, f): tangent space of each interval
    balance: Indices  # (K, d, 5): equations of motion at the points
    slip_rates: Indices  # (K, d, n_rubbing): sliding directions of contacts with friction
    limits: LimitSet
    parts: list[LimitPart]
    monitor_rows: Indices  # (K, d, m): limits of the formation


@dataclass(frozen=True, eq=False)
class TimeNLP:
    """A built NLP."""

    assembled: tuple[dict[str, Expression], dict[str, Expression]]  # expressions and derivatives
    max_iter: int  # most iterations of the solver
    layouts: list[StageLayout]
    rows: NlpRows
    rows_of: list[StageRows]
    duration_row: int  # row of the whole duration with a margin or a relaxation; otherwise -1
    scaling: float  # of the objective for Ipopt, whose tolerances are for values of about 1

    @cached_property
    def solver(self) -> Expression:
        """Ipopt for a warm start."""
        return self.make_solver(1e-6)

    def make_solver(self, push: float, **options: Any) -> Expression:
        """Ipopt with `push`, the initial distance from the bounds, and further options."""
        nlp, derivatives = self.assembled
        limits = {"max_iter": self.max_iter, "max_cpu_time": 120.0}  # [s]
        options |= {**limits, "obj_scaling_factor": self.scaling}
        return build_solver("time_nlp", nlp, push, derivatives, **options)


def build_time_nlp(
    stages: Sequence[Stage], scheme: Scheme, target: Target, max_iter: int
) -> TimeNLP:
    """NLP of successive stages that end at rest; its parameters are the prices of the end."""
    start_time = time.perf_counter()
    # Regularized friction is zero at zero velocity.
    with_statics = stages[0].formation.scene.has_slow_motors and not stages[0].smoothing
    layouts = lay_out(stages, scheme, target, with_statics)
    rows, cost = NlpRows(), np.zeros(layouts[-1].stop)
    state = stages[0].guess.nodes[0].ravel()
    rows.add_entries(rows.linear(10, low=state, high=state), layouts[0].nodes[0].ravel(), 1.0)
    rows_of, controls = [], scheme.controls
    # Weight of the duration; in elastic mode small relative to violations.
    h_costs = {Objective.TIME: 1.0, Objective.EFFORT: target.time_weight, Objective.ELASTIC: 3e-4}
    # A cost of second differences prevents oscillation of torques of low cost. Case: least effort
    # of the shipped square at a tenth of its size, with a weight of time of 4e5.
    effort, weight = 0.0, 1.0
    if target.objective is Objective.EFFORT:
        effort, weight = 1.0, target.time_weight
    for k, (stage, layout) in enumerate(zip(stages, layouts, strict=True)):
        rows_of.append(add_stage(rows, stage, layout, scheme, stage is stages[-1], target))
        if k + 1 < len(stages):
            add_junction(rows, (stage, stages[k + 1]), (layout, layouts[k + 1]), scheme)
        kernel, columns = effort_kernel(controls), _list_torques(layout)
        if effort:
            rows.add_copies(kernel, columns, cost=True)
        curvature = 1e-2 * weight * stage.formation.scene.torque_limit**-2.0 - 0.1 * effort
        if controls > 2 and (curvature > 0).any():
            weights = {"weight": np.maximum(curvature, 0.0)}
            rows.add_copies(curvature_kernel(controls), columns, weights, cost=True)
        cost[layout.h] = h_costs.get(target.objective, 0.0)
        cost[layout.shortfalls] = 1 / stage.intervals
    duration_row, last_stage, (end_z, end_v) = -1, stages[-1], layouts[-1].nodes[-1]
    if stages[0].periods:
        add_periods(rows, stages, layouts)
    if with_statics:
        add_statics(rows, stages, layouts, scheme, target.epsilon)
    elif target.keeps_gaps and not stages[0].smoothing:
        add_openings(rows, stages[0], layouts[0])
    if target.has_margin:
        cost[layouts[-1].margin[-1]] = -1.0 if target.objective is Objective.MARGIN else 1.0
        total = rows.linear(1, high=np.inf)
        rows.add_entries(total, np.concatenate([layout.h for layout in layouts]), 1.0)
        duration_row = int(total[0])
    N = tangent_basis(last_stage.formation, last_stage.guess.nodes[-1, 0])
    rows.add_entries(rows.linear(N.shape[1])[:, None], end_v, N.T)
    nlp = rows.assemble(cost, end_z)
    add_cost(SolverStatistics(build_time=time.perf_counter() - start_time))
    return TimeNLP(nlp, max_iter, layouts, rows, rows_of, duration_row, 1 / (effort + weight))


def _list_torques(layout: StageLayout) -> dict[str, Indices]:
    """Control points of torques and durations of the intervals, as columns of kernels."""
    return {"tau": layout.tau.reshape(len(layout.tau), -1), "h": layout.h[:, None]}


def add_stage(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, last: bool, target: Target
) -> StageRows:
    """Add the constraints of a stage, and return their rows."""
    formation, guess, (K, d) = stage.formation, stage.guess, layout.z.shape[:2]
    places, node, ends = guess.places(scheme.points), layout.nodes[:-1], layout.nodes[1:]
    rows.add_equal(layout.margin[1:], layout.margin[:-1])

    # Collocation of z and z' along the tangent space.
    bases = np.array([tangent_basis(formation, z) for z in guess.z[:, d // 2]])
    f, pairs = bases.shape[2], ((layout.z, layout.v), (layout.v, layout.a))
    states = np.zeros((K, 2, len(scheme.weights), f), dtype=np.int64)
    for k, (state, rate) in enumerate(pairs):
        columns = {
            "start": node[:, k],
            "points": state.reshape(K, -1),
            "end": ends[:, k, : 5 * (not scheme.has_end)],
            "rates": rate.reshape(K, -1),
            "h": layout.h[:, None],
        }
        kernel, N = collocation_kernel(scheme.name, d, f), bases.transpose(0, 2, 1).reshape(K, -1)
        states[:, k] = rows.add_copies(kernel, columns, {"N": N}).reshape(states[:, k].shape)
    if not stage.periods:
        # Constant ratios of intervals, scaled like other rows.
        weights, ratio_rows = K * guess.fractions, rows.linear(K - 1)
        rows.add_entries(ratio_rows, layout.h[:-1], weights[1:])
        rows.add_entries(ratio_rows, layout.h[1:], -weights[:-1])

    # Equations of motion, contacts and sliding directions at the points.
    homotopy, z_start = stage.smoothing > 0, node[:, 0, : 5 * bool(formation.rolling)]
    kernel, least = point_kernel(formation, scheme.controls, homotopy), least_rates(stage, places)
    columns = {"z": layout.z, "v": layout.v, "a": layout.a, "forces": layout.forces}
    columns |= {"tau": _list_torques(layout)["tau"][:, None], "z_start": z_start[:, None]}
    parameters = stage.directions._asdict() | {
        "basis": bernstein(scheme.points, scheme.controls),
        "least": np.maximum(least[..., : formation.n_contacts], 0.0),
        "smoothing": np.full(1 * homotopy, stage.smoothing),
    }
    zero_rates, balance, slip_rates = set[int](), kernel.y["balance"], kernel.y["slip_rates"]
    if scheme.has_end:
        zero_rates = find_zero_rates(stage, last)
    low, high = np.zeros((K, d, kernel.y.count)), np.zeros(kernel.y.count)
    high[slip_rates] = np.inf
    low[..., slip_rates] = -np.inf if homotopy else 0.0
    low[-1, -1, slip_rates][[k in zero_rates for k in formation.rubbing_rows]] = -np.inf
    points = rows.add_copies(kernel, columns, parameters, low=low, high=high)
    if not scheme.has_end:
        columns = {"z": ends[:, 0], "v": ends[:, 1], "z_start": z_start}
        rows.add_copies(end_kernel(formation), columns)

    # Nonnegative limits of the formation; the end condition replaces that of the gained contact.
    end_contact = None if stage.until is None else stage.until.contact
    low = stage.list_clearances(places.ravel(), after=1 / 3).reshape(K, d, -1)
    if scheme.has_end:
        low[-1, -1, [formation.limits[k].gains(end_contact) for k in stage.monitored]] = -np.inf
    kernel = monitor_kernel(formation, stage.monitored)
    monitor_rows = rows.add_copies(kernel, {"z": layout.z}, low=low, high=np.inf)
    rate_limited = formation.scene.has_slow_motors
    if stage.opens and stage.opening is not None:
        gained = [formation.limits[k].gained for k in stage.released]
        # With continuous torques a released contact has no acceleration at first.
        opening = stage.opening * (scheme.points[:, None] if rate_limited else 1.0)
        for contact in [c for c in gained if c is not None]:
            columns = {"z": layout.z[0], "v": layout.v[0], "a": layout.a[0]}
            rows.add_copies(opening_kernel(formation, contact), columns, low=opening, high=np.inf)

    # The end.
    until, (end_z, end_v) = stage.until, layout.nodes[-1]
    if last and stage.end_pose is not None:
        until, fixed = None, np.flatnonzero(np.isfinite(stage.end_pose))
        end_rows = rows.linear(len(fixed), low=stage.end_pose[fixed], high=stage.end_pose[fixed])
        rows.add_entries(end_rows, end_z[fixed], 1.0)
    reversals, next_formation = _list_independent_reversals(stage), stage.next_formation
    if all_rates_vanish(stage):
        reversals, next_formation = (), None
        N = tangent_basis(formation, guess.nodes[-1, 0])
        rows.add_entries(rows.linear(N.shape[1])[:, None], end_v, N.T)
    row = None if until is None else find_range_end(formation, until, guess.nodes[-1, 0])
    kernel = goal_kernel(formation, until, row, reversals, next_formation)
    rows.add_copies(kernel, {"z": end_z, "v": end_v})
    if stage.ends_in_range and until is not None and until.contact is not None:
        single, scene = Formation(formation.scene, (until.contact,)), formation.scene
        ranges = tuple(range(len(build_limits(until.contact, scene))))
        rows.add_copies(monitor_kernel(single, ranges), {"z": end_z}, high=np.inf)
    limits, parts = add_limits(rows, stage, layout, scheme, target)
    if rate_limited:
        add_rate_limits(rows, stage, layout, scheme)
    balance_rows, slip_rows = points[..., balance], points[..., slip_rates]
    return StageRows(states, bases, balance_rows, slip_rows, limits, parts, monitor_rows)


def _list_independent_reversals(stage: Stage) -> tuple[int, ...]:
    """Rows whose rates reverse, one of each dependent set: others make the KKT matrix singular.

    Dependent rows are tied, or vanish at the same place of a curve, as on the square by symmetry.
    """
    tied, independent, end = set[int](), list[int](), stage.guess.nodes[-1, 0]
    zeros = find_vanishing(stage.formation, end)
    for row in stage.reversals:
        if row not in tied:
            independent.append(row)
            tied.update(find_tied(stage.formation, end, row), zeros if row in zeros else ())
    return tuple(independent)


def all_rates_vanish(stage: Stage) -> bool:
    """Whether all rates are zero at the end of a stage, by its number of independent reversals.

    At least two, and as many as degrees of freedom: with one a single rate may have a zero.
    """
    return len(_list_independent_reversals(stage)) >= max(2, 5 - stage.formation.n_constraints)


def least_rates(stage: Stage, places: Array) -> Array:
    """Least rates of (contacts, joints) at `places`, fractions of a stage's duration.

    Shape of `places` and one more axis. Zero at both ends, for the second contact of a vertex, and
    with one degree of freedom, where friction cannot hold one contact alone. -inf in the friction
    homotopy.
    """
    contacts, mobile = stage.formation.contacts, stage.formation.n_constraints < 4
    least = MIN_RATE * mobile * np.minimum(1.0, 8 * np.minimum(places, 1 - places))[..., None]
    if stage.smoothing:
        least = np.full(least.shape, -np.inf)
    vertices = [contact.index if contact.feature == "v" else None for contact in contacts]
    repeated = [vertex is not None and vertex in vertices[:k] for k, vertex in enumerate(vertices)]
    return np.asarray(np.where([*repeated, False, False], np.minimum(least, 0.0), least))


def find_zero_rates(stage: Stage, last: bool) -> set[int]:
    """Rows of (contacts, joints) whose rate is zero at the end of a stage."""
    if last or all_rates_vanish(stage):
        return set(range(stage.formation.n_contacts + 2))
    rolling = stage.next_formation.rolling if stage.next_formation else ()
    sticking = [k for k, c in enumerate(stage.formation.contacts) if c in rolling]
    return {*stage.reversals, *sticking}


def add_junction(
    rows: NlpRows,
    pair: tuple[Stage, Stage],
    layouts: tuple[StageLayout, StageLayout],
    scheme: Scheme,
) -> None:
    """Add rows for continuous position and velocity between stages, or for an impact."""
    (stage, next_stage), (layout, next_layout) = pair, layouts
    last, first = layout.nodes[-1], next_layout.nodes[0]
    if stage.formation.scene.has_slow_motors and not stage.ends_at_rest:
        add_torque_junction(rows, stage, layouts, scheme)
    continuous = slice(1 if stage.ends_in_impact else 2)
    rows.add_equal(first[continuous].ravel(), last[continuous].ravel())
    rows.add_equal(next_layout.margin[0], layout.margin[-1])
    if stage.ends_in_impact:
        kernel = impact_kernel(stage.formation, next_stage.formation)
        high = np.zeros(kernel.y.count)
        high[kernel.y["openings"]] = high[kernel.y["cones"]] = np.inf
        x = {"after": first[1], "before": last[1], "z": last[0], "impulses": layout.impulses}
        rows.add_copies(kernel, x, {"Xi": next_stage.directions.Xi}, high=high)


def add_limits(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, target: Target
) -> tuple[LimitSet, list[LimitPart]]:
    """Add rows for the limits of a stage; return the limits and how their sides are imposed."""
    limits, goal = make_limits(stage.formation, target.epsilon), target.objective
    normal, weights = limits.of(PRESS), np.zeros(len(limits.low))
    if goal is Objective.MARGIN:
        weights[normal] = -1.0
    elif goal is Objective.ELASTIC:
        weights[limits.of(*{limit.kind for limit in limits.without(SPEED).limits})] = 1.0
    elif target.relaxation is not None:
        weights = limits.weigh(target.relaxation.key)

    def add_slack(limit_rows: Indices, row: int, intervals: Any = slice(None)) -> None:
        """Add the slack of a limit's row in some intervals, if it has one."""
        if weights[row]:
            elastic = goal is Objective.ELASTIC
            slack = layout.shortfalls[:, limits.owners[row]] if elastic else layout.margin[:-1, 0]
            rows.add_entries(limit_rows, slack[intervals, None], weights[row])

    # Normal forces: values of the polynomials through the points.
    is_soft = bool(weights[normal].any())
    places = np.zeros(1) if scheme.has_end else np.array([0.0, 1.0])
    if stage.formation.scene.has_slow_motors:
        # Their minima are inside intervals.
        places = np.append(places, [0.3, 0.4, 0.5, 0.75, 0.85, 0.93])
    if is_soft:
        places = np.append(places, scheme.points)
    c_n = layout.forces[:, :, limits.rows[normal].argmax(axis=1)]
    normal_rows = rows.linear(len(c_n), len(places), c_n.shape[2], high=np.inf)
    for i, basis in enumerate(scheme.interpolate(places)):
        for j in np.flatnonzero(np.abs(basis) > 1e-12):
            rows.add_entries(normal_rows[:, i], c_n[:, j], basis[j])
    side_rows, signs, _ = limits.sides
    parts = list[LimitPart]()
    # A margin is not one of forces that begin or vanish.
    rising = find_zero_bounds(stage, limits) & target.has_margin
    for k, row in enumerate(normal):
        side = int(np.flatnonzero(side_rows == row)[0])
        add_slack(normal_rows[~rising[:, side], :, k], row, ~rising[:, side])
        parts.append(LimitPart(side, True, normal_rows[..., k]))
        if not is_soft:  # with rows at the points the forces themselves have no bounds
            parts.append(LimitPart(side, False, c_n[..., k]))

    # Rows of y at the points, and bounds of one torque or joint speed alone.
    column, n_forces = np.abs(limits.rows).argmax(axis=1), stage.formation.n_constraints
    single_column = ((limits.rows != 0).sum(axis=1) == 1) & (column >= n_forces)
    bounded = np.where(single_column, column - n_forces, -1)[side_rows]
    general = np.flatnonzero(~np.isin(side_rows, normal) & (bounded < 0))
    y_rows = rows.linear(*layout.z.shape[:2], len(general), high=np.inf)
    for k, side in enumerate(general.tolist()):
        blocks = np.split(signs[side] * limits.rows[side_rows[side]], [n_forces, n_forces + 2])
        for unknowns, block in ((layout.forces, blocks[0]), (layout.v[..., 3:], blocks[2])):
            for n in np.flatnonzero(block):
                rows.add_entries(y_rows[..., k], unknowns[..., n], block[n])
        for n in np.flatnonzero(blocks[1]):
            for i, basis in enumerate(bernstein(scheme.points, scheme.controls).T):
                rows.add_entries(y_rows[..., k], layout.tau[:, None, i, n], blocks[1][n] * basis)
        add_slack(y_rows[..., k], side_rows[side])
        parts.append(LimitPart(side, True, y_rows[..., k]))
    for side in np.flatnonzero(bounded >= 0).tolist():
        k, soft_side = int(bounded[side]), bool(weights[side_rows[side]])
        # Control points of a torque, or speeds at the points.
        indices = layout.tau[..., k] if k < 2 else layout.v[..., 1 + k]
        if soft_side:
            soft_rows = rows.linear(*indices.shape, high=np.inf)
            rows.add_entries(soft_rows, indices, signs[side])
            add_slack(soft_rows, side_rows[side])
            indices = soft_rows
        parts.append(LimitPart(side, soft_side, indices))
    return limits, parts


def add_rate_limits(rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme) -> None:
    """Add the rows of one stage for rate-limited torques."""
    scene, K, n = stage.formation.scene, stage.intervals, scheme.controls - 1
    tau = layout.tau
    rows.add_equal(tau[1:, 0], tau[:-1, -1], 1 / scene.torque_limit)
    limited = np.flatnonzero(np.isfinite(scene.torque_rate_limit))
    rates = rows.linear(K, n, len(limited), 2, high=np.inf)
    limit, signs = scene.torque_limit[limited, None], np.array([1.0, -1.0])
    ratio = scene.torque_rate_limit[limited, None] / limit
    rows.add_entries(rates, layout.h[:, None, None, None], ratio)
    rows.add_entries(rates, tau[:, 1:, limited, None], -signs * n / limit)
    rows.add_entries(rates, tau[:, :-1, limited, None], signs * n / limit)
    lagging = tuple(np.flatnonzero(scene.actuator_lag).tolist())
    if lagging:
        parameters = {"lag": scene.actuator_lag, "limit": scene.torque_limit}
        kernel = command_kernel(scheme.controls, lagging)
        rows.add_copies(kernel, _list_torques(layout), parameters, high=np.inf)


def add_torque_junction(
    rows: NlpRows, stage: Stage, layouts: tuple[StageLayout, StageLayout], scheme: Scheme
) -> None:
    """Add rows for continuous torques, forces and accelerations between stages."""
    layout, next_layout = layouts
    formation = stage.formation
    scale = 1 / formation.scene.torque_limit
    rows.add_equal(next_layout.tau[0, 0], layout.tau[-1, -1], scale)
    weights = scheme.interpolate(np.ones(1))[0]
    for row, sign in stage.ending_constraints:
        equation, factor = rows.linear(1), float(formation.friction[row]) if sign else 1.0
        rows.add_entries(equation, layout.forces[-1, :, row], factor * weights)
        if sign:
            tangential = formation.n_contacts + formation.rolling_rows.index(row)
            rows.add_entries(equation, layout.forces[-1, :, tangential], sign * weights)
    if scheme.has_end and stage.next_formation is not None:
        for contact in stage.next_formation.contacts:
            if contact not in formation.contacts:
                columns = {name: getattr(layout, name)[-1, -1] for name in ("z", "v", "a")}
                rows.add_copies(opening_kernel(stage.next_formation, contact), columns)


def add_statics(
    rows: NlpRows,
    stages: Sequence[Stage],
    layouts: Sequence[StageLayout],
    scheme: Scheme,
    epsilon: float,
) -> None:
    """Add static balance at both ends of a motion, and where it stops between phases.

    The motion begins without acceleration and with friction at its bound, as it is continuous. With
    one degree of freedom it also ends so. With more it may end with a deceleration; then the gained
    contact and friction at rest balance the torques.
    """
    ends = list[tuple[Stage, Formation, Indices, Indices, Indices]]()
    for stage, layout in zip(stages, layouts, strict=True):
        z, tau = layout.nodes[[0, -1], 0], layout.tau
        if len(layout.start_forces):
            ends.append((stage, stage.formation, z[0], layout.start_forces, tau[0, 0]))
        if len(layout.end_forces):
            ends.append((stage, stage.ending, z[1], layout.end_forces, tau[-1, -1]))
            if scheme.has_end:
                # Case: phase 11 of query 15, whose end no torques hold otherwise.
                columns = {"z": z[1], "a": layout.a[-1, -1]}
                brake = brake_kernel(stage.formation)
                rows.add_copies(brake, columns, stage.directions._asdict(), high=np.inf)
    for stage, formation, z, forces, tau in ends:
        n_c, scene = formation.n_contacts, formation.scene
        signs = np.zeros(n_c + 2)
        if formation is stage.formation:
            signs = np.concatenate(stage.directions)
            signs[list(formation.rolling_rows)] = 0.0
        c_n, c_t, friction = np.split(forces, [n_c, 2 * n_c])
        rows.add_copies(rest_kernel(formation), {"z": z, "forces": forces, "tau": tau})
        rows.add_entries(rows.linear(n_c, low=epsilon, high=np.inf), c_n, 1.0)
        for k, mu in enumerate(formation.friction.tolist()):
            if signs[k] or not mu:
                friction_row = rows.linear(1)
                rows.add_entries(friction_row, c_t[k], 1.0)
                rows.add_entries(friction_row, c_n[k], signs[k] * mu)
            else:
                cone = rows.linear(2, low=mu * epsilon, high=np.inf)
                rows.add_entries(cone, c_n[k], mu)
                rows.add_entries(cone, c_t[k], np.array([1.0, -1.0]))
        low, high = (scene.dry[3:] * np.where(signs[n_c:], signs[n_c:], side) for side in (-1, 1))
        rows.add_entries(rows.linear(2, low=low, high=high), friction, 1.0)
    if (first := stages[0]).phase:
        # A command approaches a torque limit only asymptotically in the pause before.
        scene, joints = first.formation.scene, np.flatnonzero(first.formation.scene.actuator_lag)
        limit, rate = scene.torque_limit[joints], scene.torque_rate_limit[joints]
        largest = 1 - np.minimum(0.05, rate * scene.actuator_lag[joints] / limit)
        bounds = rows.linear(len(joints), low=-largest, high=largest)
        rows.add_entries(bounds, layouts[0].tau[0, 0, joints], 1 / limit)


def add_openings(rows: NlpRows, stage: Stage, layout: StageLayout) -> None:
    """Add rows, linear in the first torques: gaps closed at the start do not accelerate inwards.

    Otherwise a gap could close before the first collocation point. Case: a pentagon of 9 cm whose
    v4 comes to the tip of finger 2 where v2 touches finger 1.
    """
    formation, scene, tau = stage.formation, stage.formation.scene, layout.tau[0, 0]
    touching = np.abs(formation.evaluate_limits(stage.guess.nodes[:1, 0])[0]) < scene.touching
    touching[: sum(len(build_limits(contact, scene)) for contact in formation.contacts)] = False
    gained = [formation.limits[k].gained for k in np.flatnonzero(touching)]
    if contacts := tuple(contact for contact in gained if contact is not None):
        z, v = np.repeat(stage.guess.nodes[:1], 3, axis=0).swapaxes(0, 1)
        torques = np.vstack([np.zeros(2), np.eye(2)])
        a, _ = forward(formation, formation.evaluate(z, v), v, torques, stage.directions)
        opening = Formation(scene, contacts).evaluate(z, v).A[0] @ a.T
        slopes = opening[:, 1:] - opening[:, :1]
        starts = rows.linear(len(contacts), low=-opening[:, 0], high=np.inf)
        rows.add_entries(starts[:, None], tau, slopes)


def find_zero_bounds(stage: Stage, limits: LimitSet) -> Flags:
    """Sides with bound zero in each interval, where contacts begin, end or slip, (K, n_sides)."""
    zero_bounds = np.zeros((stage.intervals, len(limits.sides[0])), dtype=bool)
    if stage.formation.scene.has_slow_motors:
        for contact, sign in stage.ending_constraints:
            kinds = (CONE,) if sign else (PRESS, CONE)
            zero_bounds[-1] |= _find_sides(stage, limits, contact, *kinds)
        for contact in stage.new_contacts:
            zero_bounds[0] |= _find_sides(stage, limits, contact, PRESS, CONE)
    return zero_bounds


def _find_sides(stage: Stage, limits: LimitSet, contact: int, *kinds: str) -> Flags:
    """Mask of the sides, (n_sides,), that belong to a contact's limits of some kinds."""
    name, owners = stage.formation.names[contact], limits.owners[limits.sides[0]]
    flags = [limit.kind in kinds and limit.part == name for limit in limits.limits]
    return np.array(flags)[owners]


def add_periods(rows: NlpRows, stages: Sequence[Stage], layouts: Sequence[StageLayout]) -> None:
    """Add rows for control periods: durations, and constant or linear continuous torques.

    Without a prescribed duration all periods are equal; the last of a phase may be shorter.
    """
    scene, duration = stages[0].formation.scene, stages[0].period
    linear, continuous = scene.control_hold == "linear", scene.has_slow_motors
    # Stage, period, fraction of the stage and unknowns of each interval.
    owners = [k for k, stage in enumerate(stages) for _ in stage.periods]
    periods = [period for stage in stages for period in stage.periods]
    ratio = np.concatenate([stage.guess.fractions for stage in stages])
    h, tau = (np.concatenate([getattr(part, name) for part in layouts]) for name in ("h", "tau"))
    first: Indices | None = None  # durations of the intervals of the first full period
    for _, intervals in groupby(range(len(h)), key=lambda i: stages[owners[i]].phase):
        phase = list(intervals)
        last = periods[phase[-1]]
        for period, group in groupby(phase, key=periods.__getitem__):
            parts, least = list(group), 0.0 if period == last else duration
            if duration or first is not None:
                low = least if duration or period != last else -np.inf
                total = rows.linear(1, low=low, high=duration)
                rows.add_entries(total, h[parts], 1.0)
                if not duration:
                    rows.add_entries(total, first, -1.0)
            elif period != last:
                first = h[parts]
            for k, next_k in pairwise(parts):
                if owners[k] == owners[next_k]:
                    weights = np.array([ratio[next_k], -ratio[k]]) / (ratio[k] + ratio[next_k])
                    rows.add_entries(rows.linear(1), h[[k, next_k]], weights)
                if linear:
                    slopes = {"before": tau[k].ravel(), "after": tau[next_k].ravel()}
                    rows.add_copies(slope_kernel(), slopes | {"h": h[[k]], "h_next": h[[next_k]]})
        for k, next_k in pairwise(phase):
            if not continuous and (linear or periods[k] == periods[next_k]):
                rows.add_equal(tau[next_k, 0], tau[k, -1], 1 / scene.torque_limit)


def find_bounds(
    nlp: TimeNLP, stages: Sequence[Stage], scheme: Scheme, tightening: Sequence[LimitViolations]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Bounds of the NLP's unknowns and of its rows, with tightened limits."""
    low, high = np.full((2, nlp.layouts[-1].stop), [[-np.inf], [np.inf]])
    low_g, high_g = nlp.rows.bounds
    groups = zip(stages, [*stages[1:], None], nlp.layouts, nlp.rows_of, tightening, strict=True)
    starts = dict[int, Array]()  # of phases
    for stage, next_stage, layout, rows, amounts in groups:
        low[layout.shortfalls] = 0.0
        low[layout.h] = 1e-6  # least duration of an interval, in the scene's unit
        if next_stage is not None and stage.ends_in_impact:
            low[layout.impulses[: next_stage.formation.n_contacts]] = 0.0
        if stage.approach is not None:
            # The coordinate stays below its value at the end of the phase until then.
            row, value, side = stage.approach
            remaining = 1.0 - stage.guess.places(scheme.points) * (stage.until is not None)
            start = starts.setdefault(stage.phase, stage.guess.nodes[0, 0])
            # The coordinate of phase 2 of scene 96 of seed 1128 changes by 1.3e-4 only.
            distance = min(1e-3, 0.1 * abs(value - float(start[row])))
            extreme = value - side * distance * np.minimum(1.0, (2 * remaining) ** 2)
            if stage.until is not None and scheme.has_end:
                extreme[-1, -1] = side * np.inf
            (low, high)[int(side > 0)][layout.z[..., row]] = extreme
        zero_rates = find_zero_rates(stage, stage is stages[-1]) if scheme.has_end else set()
        rates = least_rates(stage, stage.guess.places(scheme.points))
        for joint, sigma in enumerate(stage.directions.sigma):
            speeds = layout.v[..., 3 + joint]
            least_speed = rates[..., joint - 2] + amounts.rates[:, joint - 2, None]
            if stage.formation.n_contacts + joint in zero_rates:
                least_speed[-1, -1] = -np.inf
            if sigma > 0:
                low[speeds] = least_speed
            else:
                high[speeds] = -least_speed
        sides, signs, values = rows.limits.sides
        # Forces of contacts that begin or end are only nonnegative.
        least = np.where(find_zero_bounds(stage, rows.limits), 0.0, signs * values)
        least += amounts.sides * rows.limits.scales[sides]
        for side, on_rows, indices in rows.parts:
            floor = least[:, side, None]
            if on_rows:
                low_g[indices] = floor
            elif signs[side] > 0:
                low[indices] = np.maximum(low[indices], floor)
            else:
                high[indices] = np.minimum(high[indices], -floor)
        if stage.formation.scene.has_slow_motors:
            _drop_bounds(stage, rows, scheme, low, low_g)
        low_g[rows.monitor_rows] += amounts.gaps[:, None, list(stage.monitored)]
        low_g[rows.slip_rates] += amounts.rates[:, None, list(stage.formation.rubbing_rows)]
    return (low, high), (low_g, high_g)


def _drop_bounds(stage: Stage, rows: StageRows, scheme: Scheme, low_x: Array, low_g: Array) -> None:
    """Remove bounds, in place, of forces that equations determine."""
    for contact, sign in stage.ending_constraints:
        determined = _find_sides(stage, rows.limits, contact, CONE if sign else PRESS)
        for side, on_rows, indices in rows.parts:
            if determined[side] and on_rows and not sign:
                if not scheme.has_end:  # the row of the end; otherwise a point's bound, below
                    low_g[indices[-1, 1]] = -np.inf
            elif determined[side]:
                (low_g if on_rows else low_x)[indices[-1, -1]] = -np.inf
    for contact in stage.new_contacts:
        determined = _find_sides(stage, rows.limits, contact, PRESS)
        for side, on_rows, indices in rows.parts:
            if determined[side] and on_rows:
                low_g[indices[0, 0]] = -np.inf


@cached_kernel
def point_kernel(formation: Formation, controls: int, smoothed: bool = False) -> Kernel:
    """Contact constraints, equations of motion, and rates of sliding contacts at a point.

    `tau` are the control points of the torques, `basis` their Bernstein polynomials, `z_start` is z
    at the start of the interval if a contact rolls, `least` are the least rates. If `smoothed`
    friction is regularized by tanh(rate / smoothing).
    """
    scene, n_c, rolls = formation.scene, formation.n_contacts, bool(formation.rolling)
    x = Columns(z=5, v=5, a=5, forces=formation.n_constraints, tau=2 * controls, z_start=5 * rolls)
    s = x.make_symbols()
    p = Columns(Xi=n_c, sigma=2, basis=controls, least=n_c, smoothing=1 * smoothed).make_symbols()
    gaps, P, P_dot_v, A_t = formation.build_constraints(s.z, s.v)
    Xi, sigma = p.Xi, p.sigma
    if smoothed:
        Xi, sigma = ca.tanh(A_t @ s.v / p.smoothing), ca.tanh(s.v[3:] / p.smoothing)
    if rolls:
        gaps[n_c:] -= formation.build_constraints(s.z_start, s.v)[0][n_c:]
    contact_forces = build_force_rows(formation, P, A_t, Xi).T @ s.forces
    joint_torques = ca.reshape(s.tau, 2, controls) @ p.basis - ca.DM(scene.dry[3:]) * sigma
    applied = contact_forces + ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, joint_torques)
    return build_kernel(
        s,
        p,
        gaps=gaps,
        rates=P @ s.v,
        accelerations=P @ s.a + P_dot_v,
        balance=ca.DM(scene.mass_diagonal) * s.a + ca.DM(scene.viscous) * s.v - applied,
        # `:` keeps the column where no row is selected.
        slip_rates=(p.Xi * (A_t @ s.v) - p.least)[list(formation.rubbing_rows), :],
    )


@cached_kernel
def end_kernel(formation: Formation) -> Kernel:
    """Contacts at the end of an interval without a point there; `z_start` is z at its start."""
    x = Columns(z=5, v=5, z_start=5 * bool(formation.rolling)).make_symbols()
    gaps, P, _, _ = formation.build_constraints(x.z, x.v)
    if formation.rolling:
        n_c = formation.n_contacts
        gaps[n_c:] -= formation.build_constraints(x.z_start, x.v)[0][n_c:]
    return build_kernel(x, gaps=gaps, rates=P @ x.v)


@cached_kernel
def collocation_kernel(name: str, degree: int, freedoms: int) -> Kernel:
    """Collocation along the tangent space: N^T (s_j - s_0 - h sum_l a_jl r_l).

    s are the states at the `start`, the points and, if no point is there, the `end`; r are `rates`.
    """
    scheme: Scheme = make_scheme(name, degree)
    weights, count = scheme.weights, len(scheme.weights)
    x = Columns(start=5, points=5 * degree, end=5 * (count - degree), rates=5 * degree, h=1)
    s, p = x.make_symbols(), Columns(N=5 * freedoms).make_symbols()
    states = ca.reshape(ca.vertcat(s.points, s.end), 5, count)
    rates, N = ca.reshape(s.rates, 5, degree), ca.reshape(p.N, 5, freedoms)
    steps = states - ca.repmat(s.start, 1, count) - s.h * (rates @ ca.DM(weights).T)
    return build_kernel(s, p, steps=N.T @ steps)


@cached_kernel
def monitor_kernel(formation: Formation, monitored: tuple[int, ...]) -> Kernel:
    """Limits of a formation."""
    x = Columns(z=5).make_symbols(z=build_features(formation.scene).z)
    values = ca.vertcat(ca.SX(0, 1), *(formation.limits[k].value for k in monitored))
    return build_kernel(x, values=values)


@cached_kernel
def opening_kernel(formation: Formation, contact: Contact) -> Kernel:
    """Second derivative of a contact's gap."""
    x = Columns(z=5, v=5, a=5).make_symbols()
    _, A, _, A_dot_v = Formation(formation.scene, (contact,)).function(x.z, x.v)
    return build_kernel(x, opening=A @ x.a + A_dot_v)


def find_range_end(formation: Formation, until: Until, z: Array) -> int | None:
    """Row of the range limit of a contact that is reached near z, (5,), where `until` is gained.

    None if that contact is gained by closing its gap. Case: phase 1 of scene 412 of seed 1128: the
    side of a link with a pointed tip rotates onto a vertex.
    """
    gaining = [k for k, limit in enumerate(formation.limits) if limit.gains(until.contact)]
    count = sum(len(build_limits(contact, formation.scene)) for contact in formation.contacts)
    ends = [k for k in gaining if k < count]
    if len(gaining) == len(ends) == 1:
        return ends[0]
    tolerance = 1e-3 * formation.scene.scales.length
    values = formation.evaluate_limits(z[None])[0] if ends else ()
    return next((k for k in ends if values[k] < tolerance), None)


@cached_kernel
def goal_kernel(
    formation: Formation,
    until: Until | None,
    row: int | None,
    reversals: tuple[int, ...],
    next_formation: Formation | None,
) -> Kernel:
    """End of a phase, zero rates of reversals, zero velocities of contacts of the next formation.

    `row` is the limit of `find_range_end`.
    """
    scene = formation.scene
    x = Columns(z=5, v=5).make_symbols(z=build_features(scene).z)
    z, v = x.z, x.v
    parts: list[Expression] = [ca.SX(0, 1)]
    if until is not None and until.contact is not None:
        # The gap of a renamed contact has zero gradient there; the end of its range has not.
        gap = build_features(scene).pairs[until.contact].gap
        parts.append(gap if row is None else formation.limits[row].value)
    if until is not None:
        parts += [z[row] - value for row, value in until.poses]
    if reversals:
        rates = ca.vertcat(formation.function(z, v)[2] @ v, v[3:])
        parts += [rates[k] for k in reversals]
    if next_formation is not None:
        P = next_formation.build_constraints(z, v)[1]
        parts += [P[i, :] @ v for i in new_rows(formation, next_formation)]
    return build_kernel(x, goals=ca.vertcat(*parts))


def new_rows(formation: Formation, next_formation: Formation) -> list[int]:
    """Constraint rows of the next formation that a formation does not have.

    A contact that continues on a neighbouring feature has the same row.
    """
    renamed = list_renamed(formation.scene, formation.contacts, next_formation.contacts).values()
    contacts = {*formation.contacts, *renamed}
    rows = [i for i, c in enumerate(next_formation.contacts) if c not in contacts]
    rolling = [next_formation.contacts[row] for row in next_formation.rolling_rows]
    n_c = next_formation.n_contacts
    return rows + [n_c + i for i, c in enumerate(rolling) if c not in formation.rolling]


@cached_kernel
def effort_kernel(controls: int) -> Kernel:
    """Integral of tau^T tau over an interval, by the control points of tau."""
    x, n = Columns(tau=2 * controls, h=1).make_symbols(), controls - 1
    products = [
        [comb(n, i) * comb(n, j) / comb(2 * n, i + j) / (2 * n + 1) for j in range(controls)]
        for i in range(controls)
    ]
    tau = ca.reshape(x.tau, 2, controls)
    return build_kernel(x, effort=x.h * ca.trace(tau @ ca.DM(products) @ tau.T))


@cached_kernel
def curvature_kernel(controls: int) -> Kernel:
    """Cost of second differences of the control points of torques."""
    x, p = Columns(tau=2 * controls, h=1).make_symbols(), Columns(weight=2).make_symbols()
    tau = ca.reshape(x.tau, 2, controls)
    differences = tau[:, 2:] - 2 * tau[:, 1:-1] + tau[:, :-2]
    return build_kernel(x, p, cost=x.h * ca.dot(p.weight, ca.sum2(differences**2)))


def find_released(formation: Formation, next_formation: Formation) -> list[int]:
    """Indices of the contacts that the next formation does not have."""
    return [i for i, c in enumerate(formation.contacts) if c not in next_formation.contacts]


@cached_kernel
def impact_kernel(formation: Formation, target: Formation) -> Kernel:
    """Plastic impact onto a target formation: M5 (v+ - v-) = G+^T p, P+ v+ = 0.

    `Xi`: signs after it. Rates of released gaps and cone margins of rolling contacts are >= 0.
    """
    scene, n_c = target.scene, target.n_contacts
    x = Columns(after=5, before=5, z=5, impulses=target.n_constraints).make_symbols()
    p = Columns(Xi=n_c).make_symbols()
    _, P, _, A_t = target.build_constraints(x.z, x.after)
    impulses = build_force_rows(target, P, A_t, p.Xi).T @ x.impulses
    A = formation.function(x.z, x.after)[1]
    rolling = list(target.rolling_rows)
    cone_radius = ca.DM(target.friction)[rolling, :] * x.impulses[rolling, :]
    return build_kernel(
        x,
        p,
        jump=ca.DM(scene.mass_diagonal) * (x.after - x.before) - impulses,
        velocities=P @ x.after,
        openings=A[find_released(formation, target), :] @ x.after,
        cones=ca.vertcat(cone_radius - x.impulses[n_c:, :], cone_radius + x.impulses[n_c:, :]),
    )


@cached_kernel
def command_kernel(controls: int, joints: tuple[int, ...]) -> Kernel:
    """Slack of the control points of the commands, h (1 -+ command / limit)."""
    x, n = Columns(tau=2 * controls, h=1).make_symbols(), controls - 1
    p = Columns(lag=2, limit=2).make_symbols()
    tau = ca.reshape(x.tau, 2, controls)
    slack: list[Expression] = [ca.SX(0, 1)]
    for j in joints:
        for k in range(controls):
            change = k * (tau[j, k] - tau[j, k - 1]) if k else 0
            change += (n - k) * (tau[j, k + 1] - tau[j, k]) if k < n else 0
            command = (x.h * tau[j, k] + p.lag[j] * change) / p.limit[j]
            slack += [x.h - command, x.h + command]
    return build_kernel(x, p, slack=ca.vertcat(*slack))


@cached_kernel
def rest_kernel(formation: Formation) -> Kernel:
    """Static balance of gravity, torques and `forces`: c_n, c_t and friction of the joints."""
    scene, n_c = formation.scene, formation.n_contacts
    x = Columns(z=5, forces=2 * n_c + 2, tau=2).make_symbols()
    _, A, A_t, _ = formation.function(x.z, ca.SX.zeros(5))
    c_n, c_t, friction = x.forces[:n_c], x.forces[n_c : 2 * n_c], x.forces[2 * n_c :]
    joint_torques = ca.vertcat(0, 0, 0, x.tau - friction)
    balance = A.T @ c_n + A_t.T @ c_t + ca.DM(scene.applied_force) + joint_torques
    return build_kernel(x, balance=balance)


@cached_kernel
def brake_kernel(formation: Formation) -> Kernel:
    """Decelerations of sliding contacts and joints at z' = 0."""
    x = Columns(z=5, a=5).make_symbols()
    p = Columns(Xi=formation.n_contacts, sigma=2).make_symbols()
    A_t = formation.function(x.z, ca.SX.zeros(5))[2]
    decelerations = (p.Xi * (A_t @ x.a))[list(formation.rubbing_rows), :]
    return build_kernel(x, p, brake=-ca.vertcat(decelerations, p.sigma * x.a[3:]))


@cached_kernel
def slope_kernel() -> Kernel:
    """Difference of the slopes of linear torques in two intervals, times both durations."""
    x = Columns(before=4, after=4, h=1, h_next=1).make_symbols()
    slopes = (x.before[2:] - x.before[:2]) * x.h_next - (x.after[2:] - x.after[:2]) * x.h
    return build_kernel(x, slopes=slopes)
