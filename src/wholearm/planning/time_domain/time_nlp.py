"""NLP of stages in the time domain by direct collocation, for any number of degrees of freedom.

A stage has one formation and fixed directions of friction, in K intervals of unknown durations h
with d collocation points. Its equations are in the README. No row but those of collocation has h,
so that a stage may vanish. Rates that equations keep at zero have no sign constraint, which would
leave the solver no interior. All quantities are in the scene's units.

Rate-limited torques have control points c_0 ... c_n in each interval and are continuous; with rate
limit R

    |c_k+1 - c_k| n <= R h,
    |h c_k + lag (k (c_k - c_k-1) + (n - k) (c_k+1 - c_k))| <= limit h

bound derivatives and commands throughout by their own control points. At both ends the torques hold
the object at rest, with friction in the directions of motion. Contact forces are continuous, too:
those of a contact that is released or gained softly vanish or set in within one interval, and a
rolling contact that begins to slide comes to the edge of its cone.
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
from ...mechanics.dynamics import build_force_rows
from ...mechanics.limits import CONE, PRESS, SPEED, LimitSet, make_limits
from ...problem.definition import Until
from ..nlp import (
    Columns,
    Indices,
    Kernel,
    NlpRows,
    SolverStatistics,
    book,
    build_kernel,
    build_solver,
    share,
)
from ..options import Objective
from .stage import LimitMisses, Scheme, Stage, StagePoints, blend, make_scheme

SLIDING = 1e-5  # least rate of sliding contacts, over the radius of gyration, and of joints


@dataclass(frozen=True, eq=False)
class StageLayout:
    """Indices of one stage's unknowns; those of `StagePoints` have the shapes there."""

    h: Indices
    nodes: Indices
    z: Indices
    v: Indices
    a: Indices
    forces: Indices
    tau: Indices
    impulses: Indices  # of the impact that leads to the next stage, if one does
    margin: Indices  # (K + 1, 1) or (K + 1, 0): copies of a margin or relaxation at the nodes
    short: Indices  # (K, n) or (K, 0): shortfalls of limits in each interval
    begin: Indices  # begin, finish: c_n, c_t and friction of the joints at rest at both ends, of
    finish: Indices  # continuous torques

    @property
    def stop(self) -> int:
        """Past its last unknown."""
        return 1 + max(int(part.max(initial=-1)) for part in vars(self).values())


def lay_out(
    stages: Sequence[Stage], scheme: Scheme, target: Target, held: bool = False
) -> list[StageLayout]:
    """Indices of the unknowns of successive stages; `held`: torques hold what rests."""
    layouts: list[StageLayout] = []
    stop, d, m, with_margin = 0, scheme.degree, scheme.controls, int(target.chained)

    def take(*shape: int) -> Indices:
        nonlocal stop
        indices = stop + np.arange(int(np.prod(shape))).reshape(shape)
        stop += indices.size
        return indices

    for k, stage in enumerate(stages):
        K, formation = stage.intervals, stage.formation
        # In elastic mode every limit but those of speeds has a shortfall in each interval.
        soft = make_limits(formation, target.epsilon).without(SPEED).limits
        short = len(soft) * (target.objective is Objective.ELASTIC)
        width, end = d * (15 + formation.n_constraints), 10 * (not scheme.ends)
        begins = held and (not k or stages[k - 1].rests)
        begin = take((2 * formation.n_contacts + 2) * begins)
        first, first_margin = take(10), take(with_margin)
        interval = Columns(h=1, tau=2 * m, points=width, end=end, short=short, m=with_margin)
        table = take(K, interval.count)
        at = {name: table[:, part] for name, part in interval.slices.items()}
        of_points = at["points"].reshape(K, d, -1)
        z, v, a, forces = np.split(of_points, [5, 10, 15], axis=2)
        ends = of_points[:, -1, :10] if scheme.ends else at["end"]
        jumps = stage.ends_in_impact and k + 1 < len(stages)
        nodes, tau = np.vstack([first, ends]).reshape(K + 1, 2, 5), at["tau"].reshape(K, m, 2)
        impulses = take(stages[k + 1].formation.n_constraints if jumps else 0)
        margin = np.vstack([first_margin, at["m"]])
        finish = take((2 * stage.ending.n_contacts + 2) * (held and stage.rests))
        points = at["h"][:, 0], nodes, z, v, a, forces, tau, impulses
        layouts.append(StageLayout(*points, margin, at["short"], begin, finish))
    return layouts


def pack(points: Sequence[StagePoints], layouts: Sequence[StageLayout], margin: float) -> Array:
    """Unknowns as one vector."""
    x = np.zeros(layouts[-1].stop)
    for part, layout in zip(points, layouts, strict=True):
        for name, table in part._asdict().items():
            x[getattr(layout, name)] = table
        x[layout.short], x[layout.margin] = 1.0, margin
        ends = (layout.begin, part.forces[0, 0]), (layout.finish, part.forces[-1, -1])
        for held, forces in ends:
            x[held[: len(forces)]] = forces[: len(held)]
    return x


def unpack(x: Array, layouts: Sequence[StageLayout]) -> list[StagePoints]:
    """What `pack` put together."""
    names = StagePoints._fields
    return [StagePoints(*(x[getattr(layout, name)] for name in names)) for layout in layouts]


class Target(NamedTuple):
    """Objective of an NLP."""

    objective: Objective
    epsilon: float  # [N]: least normal force
    time_weight: float = 0.0  # [(N m)^2]: for `effort`
    relaxation: Parameter | None = None  # the relaxed limit, for `relax`

    @property
    def chained(self) -> bool:
        """Whether nodes have one more unknown, all of them copies: a margin or a relaxation."""
        return self.objective in (Objective.MARGIN, Objective.RELAX)


class LimitPart(NamedTuple):
    """Where one side of the limits of a stage is kept: by rows, or bounds of unknowns."""

    side: int
    on_rows: bool
    indices: Indices  # (K, n): of the rows, whose lower bounds these are, or of the unknowns


@dataclass(frozen=True, eq=False)
class StageRows:
    """Rows of one stage, interval by interval."""

    states: Indices  # (K, 2, rungs, f): collocation of z and of z', along the columns of `bases`
    bases: Array  # (K, 5, f): tangent space of each interval
    balance: Indices  # (K, d, 5): equations of motion at the points
    senses: Indices  # (K, d, n_rubbing): sliding directions of contacts with friction there
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
        """Ipopt, to start from a solution."""
        return self.make_solver(1e-6)

    def make_solver(self, push: float, **options: Any) -> Expression:
        """Ipopt, with this distance of the first point from its bounds, and other options."""
        nlp, derivatives = self.assembled
        most = {"max_iter": self.max_iter, "max_cpu_time": 120.0}  # [s]
        options |= {**most, "obj_scaling_factor": self.scaling}
        return build_solver("time_nlp", nlp, push, derivatives, **options)


def build_time_nlp(
    stages: Sequence[Stage], scheme: Scheme, target: Target, max_iter: int
) -> TimeNLP:
    """Build the NLP of successive stages that end at rest; its parameters are prices of the end."""
    started = time.perf_counter()
    # Regularized friction holds nothing at rest.
    held = stages[0].formation.scene.has_slow_motors and not stages[0].onset
    layouts = lay_out(stages, scheme, target, held)
    rows, cost = NlpRows(), np.zeros(layouts[-1].stop)
    start = stages[0].guess.nodes[0].ravel()
    rows.add_entries(rows.linear(10, low=start, high=start), layouts[0].nodes[0].ravel(), 1.0)
    rows_of, controls = [], scheme.controls
    # Weight of time: a little, against violations.
    of_time = {Objective.TIME: 1.0, Objective.EFFORT: target.time_weight, Objective.ELASTIC: 3e-4}
    # Without a cost of second differences torques ring, if their squares cost little. Case: least
    # effort of the shipped square at a tenth of its size, where the weight of time is 4e5.
    squares, weight = 0.0, 1.0
    if target.objective is Objective.EFFORT:
        squares, weight = 1.0, target.time_weight
    for k, (stage, layout) in enumerate(zip(stages, layouts, strict=True)):
        rows_of.append(add_stage(rows, stage, layout, scheme, stage is stages[-1], target))
        if k + 1 < len(stages):
            join_stages(rows, (stage, stages[k + 1]), (layout, layouts[k + 1]), scheme)
        kernel, columns = effort_kernel(controls), _list_torques(layout)
        if squares:
            rows.add_copies(kernel, columns, cost=True)
        bend = 1e-2 * weight * stage.formation.scene.torque_limit**-2.0 - 0.1 * squares
        if controls > 2 and (bend > 0).any():
            weights = {"weight": np.maximum(bend, 0.0)}
            rows.add_copies(bend_kernel(controls), columns, weights, cost=True)
        cost[layout.h] = of_time.get(target.objective, 0.0)
        cost[layout.short] = 1 / stage.intervals
    duration_row, last, (end_z, end_v) = -1, stages[-1], layouts[-1].nodes[-1]
    if stages[0].periods:
        add_periods(rows, stages, layouts)
    if held:
        hold_ends(rows, stages, layouts, scheme, target.epsilon)
    if target.chained:
        cost[layouts[-1].margin[-1]] = -1.0 if target.objective is Objective.MARGIN else 1.0
        total = rows.linear(1, high=np.inf)
        rows.add_entries(total, np.concatenate([layout.h for layout in layouts]), 1.0)
        duration_row = int(total[0])
    N = tangent_basis(last.formation, last.guess.nodes[-1, 0])
    rows.add_entries(rows.linear(N.shape[1])[:, None], end_v, N.T)
    built = rows.assemble(cost, end_z)
    book(SolverStatistics(build_time=time.perf_counter() - started))
    return TimeNLP(built, max_iter, layouts, rows, rows_of, duration_row, 1 / (squares + weight))


def _list_torques(layout: StageLayout) -> dict[str, Indices]:
    """Control points of torques and durations of the intervals, as columns of kernels."""
    return {"tau": layout.tau.reshape(len(layout.tau), -1), "h": layout.h[:, None]}


def add_stage(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, last: bool, target: Target
) -> StageRows:
    """Add the constraints of a stage."""
    formation, guess, (K, d) = stage.formation, stage.guess, layout.z.shape[:2]
    places, node, ends = guess.places(scheme.points), layout.nodes[:-1], layout.nodes[1:]
    rows.add_equal(layout.margin[1:], layout.margin[:-1])

    # Collocation of z and z' along the tangent space.
    bases = np.array([tangent_basis(formation, z) for z in guess.z[:, d // 2]])
    f, pairs = bases.shape[2], ((layout.z, layout.v), (layout.v, layout.a))
    states = np.zeros((K, 2, len(scheme.rungs), f), dtype=np.int64)
    for k, (state, rate) in enumerate(pairs):
        columns = {
            "start": node[:, k],
            "points": state.reshape(K, -1),
            "end": ends[:, k, : 5 * (not scheme.ends)],
            "rates": rate.reshape(K, -1),
            "h": layout.h[:, None],
        }
        kernel, N = collocation_kernel(scheme.name, d, f), bases.transpose(0, 2, 1).reshape(K, -1)
        states[:, k] = rows.add_copies(kernel, columns, {"N": N}).reshape(states[:, k].shape)
    if not stage.periods:
        # Constant ratios of intervals, scaled like other rows.
        shares, ratio_rows = K * guess.fractions, rows.linear(K - 1)
        rows.add_entries(ratio_rows, layout.h[:-1], shares[1:])
        rows.add_entries(ratio_rows, layout.h[1:], -shares[:-1])

    # Equations of motion, contacts and sliding directions at the points.
    homotopy, first = stage.onset > 0, node[:, 0, : 5 * bool(formation.rolling)]
    kernel, least = point_kernel(formation, scheme.controls, homotopy), least_senses(stage, places)
    columns = {"z": layout.z, "v": layout.v, "a": layout.a, "forces": layout.forces}
    columns |= {"tau": _list_torques(layout)["tau"][:, None], "first": first[:, None]}
    parameters = stage.directions._asdict() | {
        "shares": blend(scheme.points, scheme.controls),
        "least": np.maximum(least[..., : formation.n_contacts], 0.0),
        "onset": np.full(1 * homotopy, stage.onset),
    }
    still, balance, senses = set[int](), kernel.y["balance"], kernel.y["senses"]
    if scheme.ends:
        still = find_still(stage, last)
    low, high = np.zeros((K, d, kernel.y.count)), np.zeros(kernel.y.count)
    high[senses] = np.inf
    low[..., senses] = -np.inf if homotopy else 0.0
    low[-1, -1, senses][[k in still for k in formation.rubbing_rows]] = -np.inf
    points = rows.add_copies(kernel, columns, parameters, low=low, high=high)
    if not scheme.ends:
        columns = {"z": ends[:, 0], "v": ends[:, 1], "first": first}
        rows.add_copies(end_kernel(formation), columns)

    # Limits of the formation that are not negative; that of the end's contact is zero there.
    goal = None if stage.until is None else stage.until.contact
    low = stage.list_clearances(places.ravel(), after=1 / 3).reshape(K, d, -1)
    if scheme.ends:
        low[-1, -1, [formation.limits[k].gains(goal) for k in stage.monitored]] = -np.inf
    kernel = monitor_kernel(formation, stage.monitored)
    monitor_rows = rows.add_copies(kernel, {"z": layout.z}, low=low, high=np.inf)
    slow = formation.scene.has_slow_motors
    if stage.opens and stage.opening is not None:
        gained = [formation.limits[k].gained for k in stage.released]
        # With continuous torques a released contact has no acceleration at first.
        opening = stage.opening * (scheme.points[:, None] if slow else 1.0)
        for contact in [c for c in gained if c is not None]:
            columns = {"z": layout.z[0], "v": layout.v[0], "a": layout.a[0]}
            rows.add_copies(opening_kernel(formation, contact), columns, low=opening, high=np.inf)

    # The end.
    until, (end_z, end_v) = stage.until, layout.nodes[-1]
    if last and stage.stop is not None:
        until, pinned = None, np.flatnonzero(np.isfinite(stage.stop))
        there = rows.linear(len(pinned), low=stage.stop[pinned], high=stage.stop[pinned])
        rows.add_entries(there, end_z[pinned], 1.0)
    turns, gained_softly = _list_free_turns(stage), stage.gained
    if stops(stage):
        turns, gained_softly = (), None
        N = tangent_basis(formation, guess.nodes[-1, 0])
        rows.add_entries(rows.linear(N.shape[1])[:, None], end_v, N.T)
    row = None if until is None else find_range_end(formation, until, guess.nodes[-1, 0])
    kernel = goal_kernel(formation, until, row, turns, gained_softly)
    rows.add_copies(kernel, {"z": end_z, "v": end_v})
    if stage.lands and until is not None and until.contact is not None:
        alone, scene = Formation(formation.scene, (until.contact,)), formation.scene
        ranges = tuple(range(len(build_limits(until.contact, scene))))
        rows.add_copies(monitor_kernel(alone, ranges), {"z": end_z}, high=np.inf)
    limits, parts = add_limits(rows, stage, layout, scheme, target)
    if slow:
        add_motors(rows, stage, layout, scheme)
    of_points = points[..., balance], points[..., senses]
    return StageRows(states, bases, *of_points, limits, parts, monitor_rows)


def _list_free_turns(stage: Stage) -> tuple[int, ...]:
    """One of each set of rows that reverse together: dependent equations spoil the solver's steps.

    Rows are tied, or vanish at the same place of a curve, as on the square by symmetry.
    """
    tied, free, end = set[int](), list[int](), stage.guess.nodes[-1, 0]
    still = find_vanishing(stage.formation, end)
    for row in stage.turns:
        if row not in tied:
            free.append(row)
            tied.update(find_tied(stage.formation, end, row), still if row in still else ())
    return tuple(free)


def stops(stage: Stage) -> bool:
    """Whether everything stops at the end of a stage, as independent rates reverse there.

    With one degree of freedom these are two, as one alone may have a zero.
    """
    return len(_list_free_turns(stage)) >= max(2, 5 - stage.formation.n_constraints)


def least_senses(stage: Stage, places: Array) -> Array:
    """Least rates of (contacts, joints) at `places`, shares of a stage's duration.

    In their shape and one more axis. Zero at both ends, for the second contact of a vertex, and
    with one degree of freedom, where friction cannot hold one contact alone; none in the friction
    homotopy.
    """
    contacts, free = stage.formation.contacts, stage.formation.n_constraints < 4
    least = SLIDING * free * np.minimum(1.0, 8 * np.minimum(places, 1 - places))[..., None]
    if stage.onset:
        least = np.full(least.shape, -np.inf)
    vertices = [contact.index if contact.feature == "v" else None for contact in contacts]
    again = [vertex is not None and vertex in vertices[:k] for k, vertex in enumerate(vertices)]
    return np.asarray(np.where([*again, False, False], np.minimum(least, 0.0), least))


def find_still(stage: Stage, last: bool) -> set[int]:
    """Rows of (contacts, joints) that stand still at the end of a stage."""
    if last or stops(stage):
        return set(range(stage.formation.n_contacts + 2))
    coming = stage.gained.rolling if stage.gained else ()
    rolls = [k for k, c in enumerate(stage.formation.contacts) if c in coming]
    return {*stage.turns, *rolls}


def join_stages(
    rows: NlpRows,
    pair: tuple[Stage, Stage],
    layouts: tuple[StageLayout, StageLayout],
    scheme: Scheme,
) -> None:
    """Continuous position and velocity from one stage to the next, or an impact."""
    (stage, coming), (layout, following) = pair, layouts
    last, first = layout.nodes[-1], following.nodes[0]
    if stage.formation.scene.has_slow_motors and not stage.rests:
        join_motors(rows, stage, layouts, scheme)
    same = slice(1 if stage.ends_in_impact else 2)
    rows.add_equal(first[same].ravel(), last[same].ravel())
    rows.add_equal(following.margin[0], layout.margin[-1])
    if stage.ends_in_impact:
        kernel = impact_kernel(stage.formation, coming.formation)
        high = np.zeros(kernel.y.count)
        high[kernel.y["leaving"]] = high[kernel.y["cones"]] = np.inf
        x = {"after": first[1], "before": last[1], "z": last[0], "impulses": layout.impulses}
        rows.add_copies(kernel, x, {"Xi": coming.directions.Xi}, high=high)


def add_limits(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, target: Target
) -> tuple[LimitSet, list[LimitPart]]:
    """Add rows for the limits of a stage; also the limits, and where their sides are kept."""
    limits, goal = make_limits(stage.formation, target.epsilon), target.objective
    presses, weights = limits.of(PRESS), np.zeros(len(limits.low))
    if goal is Objective.MARGIN:
        weights[presses] = -1.0
    elif goal is Objective.ELASTIC:
        weights[limits.of(*{limit.kind for limit in limits.without(SPEED).limits})] = 1.0
    elif target.relaxation is not None:
        weights = limits.weigh(target.relaxation.key)

    def give(added: Indices, row: int) -> None:
        """Add the slack of a limit's row, if it has one."""
        if weights[row]:
            short = goal is Objective.ELASTIC
            slack = layout.short[:, limits.owners[row]] if short else layout.margin[:-1, 0]
            rows.add_entries(added, slack[:, None], weights[row])

    # Normal forces by the polynomials through the points.
    soft = bool(weights[presses].any())
    places = np.zeros(1) if scheme.ends else np.array([0.0, 1.0])
    if stage.formation.scene.has_slow_motors:
        # Their minima are inside intervals.
        places = np.append(places, [0.3, 0.4, 0.5, 0.75, 0.85, 0.93])
    if soft:
        places = np.append(places, scheme.points)
    c_n = layout.forces[:, :, limits.rows[presses].argmax(axis=1)]
    pressed = rows.linear(len(c_n), len(places), c_n.shape[2], high=np.inf)
    for i, shares in enumerate(scheme.interpolate(places)):
        for j in np.flatnonzero(np.abs(shares) > 1e-12):
            rows.add_entries(pressed[:, i], c_n[:, j], shares[j])
    side_rows, signs, _ = limits.sides
    parts = list[LimitPart]()
    for k, row in enumerate(presses):
        give(pressed[..., k], row)
        side = int(np.flatnonzero(side_rows == row)[0])
        parts.append(LimitPart(side, True, pressed[..., k]))
        if not soft:  # with rows at the points the forces themselves have no bounds
            parts.append(LimitPart(side, False, c_n[..., k]))

    # Rows of y at the points, and bounds of one torque or joint speed alone.
    column, n_forces = np.abs(limits.rows).argmax(axis=1), stage.formation.n_constraints
    alone = ((limits.rows != 0).sum(axis=1) == 1) & (column >= n_forces)
    single = np.where(alone, column - n_forces, -1)[side_rows]
    others = np.flatnonzero(~np.isin(side_rows, presses) & (single < 0))
    added = rows.linear(*layout.z.shape[:2], len(others), high=np.inf)
    for k, side in enumerate(others.tolist()):
        of_y = np.split(signs[side] * limits.rows[side_rows[side]], [n_forces, n_forces + 2])
        for unknowns, of_them in ((layout.forces, of_y[0]), (layout.v[..., 3:], of_y[2])):
            for n in np.flatnonzero(of_them):
                rows.add_entries(added[..., k], unknowns[..., n], of_them[n])
        for n in np.flatnonzero(of_y[1]):
            for i, shares in enumerate(blend(scheme.points, scheme.controls).T):
                rows.add_entries(added[..., k], layout.tau[:, None, i, n], of_y[1][n] * shares)
        give(added[..., k], side_rows[side])
        parts.append(LimitPart(side, True, added[..., k]))
    for side in np.flatnonzero(single >= 0).tolist():
        k, softened = int(single[side]), bool(weights[side_rows[side]])
        # Control points of a torque, or speeds at the points.
        indices = layout.tau[..., k] if k < 2 else layout.v[..., 1 + k]
        if softened:
            added_row = rows.linear(*indices.shape, high=np.inf)
            rows.add_entries(added_row, indices, signs[side])
            give(added_row, side_rows[side])
            indices = added_row
        parts.append(LimitPart(side, softened, indices))
    return limits, parts


def add_motors(rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme) -> None:
    """Add the rows of one stage for rate-limited torques."""
    scene, K, n = stage.formation.scene, stage.intervals, scheme.controls - 1
    tau = layout.tau
    rows.add_equal(tau[1:, 0], tau[:-1, -1], 1 / scene.torque_limit)
    limited = np.flatnonzero(np.isfinite(scene.torque_rate_limit))
    rates = rows.linear(K, n, len(limited), 2, high=np.inf)
    limit, signs = scene.torque_limit[limited, None], np.array([1.0, -1.0])
    most = scene.torque_rate_limit[limited, None] / limit
    rows.add_entries(rates, layout.h[:, None, None, None], most)
    rows.add_entries(rates, tau[:, 1:, limited, None], -signs * n / limit)
    rows.add_entries(rates, tau[:, :-1, limited, None], signs * n / limit)
    lagging = tuple(np.flatnonzero(scene.actuator_lag).tolist())
    if lagging:
        parameters = {"lag": scene.actuator_lag, "limit": scene.torque_limit}
        kernel = command_kernel(scheme.controls, lagging)
        rows.add_copies(kernel, _list_torques(layout), parameters, high=np.inf)


def join_motors(
    rows: NlpRows, stage: Stage, layouts: tuple[StageLayout, StageLayout], scheme: Scheme
) -> None:
    """Continuous torques, forces and accelerations from a stage to the next."""
    layout, coming = layouts
    formation = stage.formation
    scale = 1 / formation.scene.torque_limit
    rows.add_equal(coming.tau[0, 0], layout.tau[-1, -1], scale)
    shares = scheme.interpolate(np.ones(1))[0]
    for fading, slips in stage.fading:
        equation, share = rows.linear(1), float(formation.friction[fading]) if slips else 1.0
        rows.add_entries(equation, layout.forces[-1, :, fading], share * shares)
        if slips:
            tangential = formation.n_contacts + formation.rolling_rows.index(fading)
            rows.add_entries(equation, layout.forces[-1, :, tangential], slips * shares)
    if scheme.ends and stage.gained is not None:
        for contact in stage.gained.contacts:
            if contact not in formation.contacts:
                z, v, a = (part[-1, -1] for part in (layout.z, layout.v, layout.a))
                rows.add_copies(opening_kernel(stage.gained, contact), {"z": z, "v": v, "a": a})


def hold_ends(
    rows: NlpRows,
    stages: Sequence[Stage],
    layouts: Sequence[StageLayout],
    scheme: Scheme,
    epsilon: float,
) -> None:
    """Torques hold the object at rest at the ends of a motion, and where it stops between phases.

    It begins without acceleration, on the verge of its directions: friction may not step. So it
    ends with one degree of freedom, as along its curve. With more it may stop with an acceleration,
    which the contact that is gained and friction at rest take up.
    """
    ends = list[tuple[Stage, Formation, Indices, Indices, Indices]]()
    for stage, layout in zip(stages, layouts, strict=True):
        z, tau = layout.nodes[[0, -1], 0], layout.tau
        if len(layout.begin):
            ends.append((stage, stage.formation, z[0], layout.begin, tau[0, 0]))
        if len(layout.finish):
            ends.append((stage, stage.ending, z[1], layout.finish, tau[-1, -1]))
            if scheme.ends:
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
                equal = rows.linear(1)
                rows.add_entries(equal, c_t[k], 1.0)
                rows.add_entries(equal, c_n[k], signs[k] * mu)
            else:
                cone = rows.linear(2, low=mu * epsilon, high=np.inf)
                rows.add_entries(cone, c_n[k], mu)
                rows.add_entries(cone, c_t[k], np.array([1.0, -1.0]))
        low, high = (scene.dry[3:] * np.where(signs[n_c:], signs[n_c:], side) for side in (-1, 1))
        rows.add_entries(rows.linear(2, low=low, high=high), friction, 1.0)
    if (first := stages[0]).phase:
        # A command approaches a torque limit only asymptotically in the pause before.
        scene, joints = first.formation.scene, np.flatnonzero(first.formation.scene.actuator_lag)
        limit, fastest = scene.torque_limit[joints], scene.torque_rate_limit[joints]
        most = 1 - np.minimum(0.05, fastest * scene.actuator_lag[joints] / limit)
        bounds = rows.linear(len(joints), low=-most, high=most)
        rows.add_entries(bounds, layouts[0].tau[0, 0, joints], 1 / limit)


def find_relieved(stage: Stage, limits: LimitSet) -> Flags:
    """Sides with bound zero in each interval, as forces vanish or set in or slip, (K, n_sides)."""
    relieved = np.zeros((stage.intervals, len(limits.sides[0])), dtype=bool)
    if stage.formation.scene.has_slow_motors:
        for contact, slips in stage.fading:
            kinds = (CONE,) if slips else (PRESS, CONE)
            relieved[-1] |= _find_sides(stage, limits, contact, *kinds)
        for contact in stage.growing:
            relieved[0] |= _find_sides(stage, limits, contact, PRESS, CONE)
    return relieved


def _find_sides(stage: Stage, limits: LimitSet, contact: int, *kinds: str) -> Flags:
    """Whether sides, (n_sides,), are of limits of some kinds of a contact."""
    name, owners = stage.formation.names[contact], limits.owners[limits.sides[0]]
    flags = [limit.kind in kinds and limit.part == name for limit in limits.limits]
    return np.array(flags)[owners]


def add_periods(rows: NlpRows, stages: Sequence[Stage], layouts: Sequence[StageLayout]) -> None:
    """Durations of control periods, and their torques, constant or linear and continuous.

    Without a given duration all periods but the last of a phase, which may be shorter, are equal.
    """
    scene, duration = stages[0].formation.scene, stages[0].period
    linear, goes_on = scene.control_hold == "linear", scene.has_slow_motors
    # Of each interval: its stage, period and share of the stage, and its unknowns.
    owners = [k for k, stage in enumerate(stages) for _ in stage.periods]
    periods = [period for stage in stages for period in stage.periods]
    share = np.concatenate([stage.guess.fractions for stage in stages])
    h, tau = (np.concatenate([getattr(part, name) for part in layouts]) for name in ("h", "tau"))
    first: Indices | None = None  # durations of the parts of the first period that is not a last
    for _, intervals in groupby(range(len(h)), key=lambda i: stages[owners[i]].phase):
        phase = list(intervals)
        last = periods[phase[-1]]
        for period, group in groupby(phase, key=periods.__getitem__):
            parts, least = list(group), 0.0 if period == last else duration
            if duration or first is not None:
                low = least if duration or period != last else -np.inf
                whole = rows.linear(1, low=low, high=duration)
                rows.add_entries(whole, h[parts], 1.0)
                if not duration:
                    rows.add_entries(whole, first, -1.0)
            elif period != last:
                first = h[parts]
            for one, other in pairwise(parts):
                if owners[one] == owners[other]:
                    weights = np.array([share[other], -share[one]]) / (share[one] + share[other])
                    rows.add_entries(rows.linear(1), h[[one, other]], weights)
                if linear:
                    slopes = {"before": tau[one].ravel(), "after": tau[other].ravel()}
                    rows.add_copies(slope_kernel(), slopes | {"h": h[[one]], "coming": h[[other]]})
        for one, other in pairwise(phase):
            if not goes_on and (linear or periods[one] == periods[other]):
                rows.add_equal(tau[other, 0], tau[one, -1], 1 / scene.torque_limit)


def find_bounds(
    nlp: TimeNLP, stages: Sequence[Stage], scheme: Scheme, limits: Sequence[LimitMisses]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Bounds of the NLP's unknowns and of its rows, with limits raised."""
    low, high = np.full((2, nlp.layouts[-1].stop), [[-np.inf], [np.inf]])
    low_g, high_g = nlp.rows.bounds
    every = zip(stages, [*stages[1:], None], nlp.layouts, nlp.rows_of, limits, strict=True)
    starts = dict[int, Array]()  # of phases
    for stage, coming, layout, rows, raised in every:
        low[layout.short] = 0.0
        low[layout.h] = 1e-6  # least duration of an interval, in the scene's unit
        if coming is not None and stage.ends_in_impact:
            low[layout.impulses[: coming.formation.n_contacts]] = 0.0
        if stage.ahead is not None:
            # A coordinate stays before the value at which the phase ends.
            row, value, side = stage.ahead
            left = 1.0 - stage.guess.places(scheme.points) * (stage.until is not None)
            start = starts.setdefault(stage.phase, stage.guess.nodes[0, 0])
            # Phase 2 of scene 96 of seed 1128 goes on by 1.3e-4 in all.
            before = min(1e-3, 0.1 * abs(value - float(start[row])))
            most = value - side * before * np.minimum(1.0, (2 * left) ** 2)
            if stage.until is not None and scheme.ends:
                most[-1, -1] = side * np.inf
            (low, high)[int(side > 0)][layout.z[..., row]] = most
        still = find_still(stage, stage is stages[-1]) if scheme.ends else set()
        rates = least_senses(stage, stage.guess.places(scheme.points))
        for joint, sigma in enumerate(stage.directions.sigma):
            speeds = layout.v[..., 3 + joint]
            one_way = rates[..., joint - 2] + raised.sense[:, joint - 2, None]
            if stage.formation.n_contacts + joint in still:
                one_way[-1, -1] = -np.inf
            if sigma > 0:
                low[speeds] = one_way
            else:
                high[speeds] = -one_way
        sides, signs, values = rows.limits.sides
        # Forces that vanish or set in are only nonnegative.
        least = np.where(find_relieved(stage, rows.limits), 0.0, signs * values)
        least += raised.held * rows.limits.scales[sides]
        for side, on_rows, indices in rows.parts:
            floor = least[:, side, None]
            if on_rows:
                low_g[indices] = floor
            elif signs[side] > 0:
                low[indices] = np.maximum(low[indices], floor)
            else:
                high[indices] = np.minimum(high[indices], -floor)
        if stage.formation.scene.has_slow_motors:
            _free_equal(stage, rows, scheme, low, low_g)
        low_g[rows.monitor_rows] += raised.gap[:, None, list(stage.monitored)]
        low_g[rows.senses] += raised.sense[:, None, list(stage.formation.rubbing_rows)]
    return (low, high), (low_g, high_g)


def _free_equal(stage: Stage, rows: StageRows, scheme: Scheme, low_x: Array, low_g: Array) -> None:
    """Remove bounds, in place, of forces that are given by equations."""
    for contact, slips in stage.fading:
        given = _find_sides(stage, rows.limits, contact, CONE if slips else PRESS)
        for side, on_rows, indices in rows.parts:
            if given[side] and on_rows and not slips:
                if not scheme.ends:  # the row of the end; otherwise a point's bound, below
                    low_g[indices[-1, 1]] = -np.inf
            elif given[side]:
                (low_g if on_rows else low_x)[indices[-1, -1]] = -np.inf
    for contact in stage.growing:
        given = _find_sides(stage, rows.limits, contact, PRESS)
        for side, on_rows, indices in rows.parts:
            if given[side] and on_rows:
                low_g[indices[0, 0]] = -np.inf


@share
def point_kernel(formation: Formation, controls: int, homotopy: bool = False) -> Kernel:
    """Contact constraints, equations of motion, and rates of sliding contacts at a point.

    `tau` are the control points of the torques, `shares` their Bernstein polynomials, `first` is z
    at the start of the interval if a contact rolls, `least` are the least rates. In the `homotopy`
    friction is regularized by tanh(rate / onset).
    """
    scene, n_c, rolls = formation.scene, formation.n_contacts, bool(formation.rolling)
    x = Columns(z=5, v=5, a=5, forces=formation.n_constraints, tau=2 * controls, first=5 * rolls)
    s = x.make_symbols()
    p = Columns(Xi=n_c, sigma=2, shares=controls, least=n_c, onset=1 * homotopy).make_symbols()
    gaps, P, P_dot_v, A_t = formation.build_constraints(s.z, s.v)
    Xi, sigma = p.Xi, p.sigma
    if homotopy:
        Xi, sigma = ca.tanh(A_t @ s.v / p.onset), ca.tanh(s.v[3:] / p.onset)
    if rolls:
        gaps[n_c:] -= formation.build_constraints(s.first, s.v)[0][n_c:]
    push = build_force_rows(formation, P, A_t, Xi).T @ s.forces
    at_joints = ca.reshape(s.tau, 2, controls) @ p.shares - ca.DM(scene.dry[3:]) * sigma
    applied = push + ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, at_joints)
    return build_kernel(
        s,
        p,
        gaps=gaps,
        rates=P @ s.v,
        bends=P @ s.a + P_dot_v,
        balance=ca.DM(scene.mass_diagonal) * s.a + ca.DM(scene.viscous) * s.v - applied,
        # With `:`, no rows of a single one are no rows, and not a row without columns.
        senses=(p.Xi * (A_t @ s.v) - p.least)[list(formation.rubbing_rows), :],
    )


@share
def end_kernel(formation: Formation) -> Kernel:
    """Contacts at the end of an interval without a point there; `first` is z at its start."""
    x = Columns(z=5, v=5, first=5 * bool(formation.rolling)).make_symbols()
    gaps, P, _, _ = formation.build_constraints(x.z, x.v)
    if formation.rolling:
        n_c = formation.n_contacts
        gaps[n_c:] -= formation.build_constraints(x.first, x.v)[0][n_c:]
    return build_kernel(x, gaps=gaps, rates=P @ x.v)


@share
def collocation_kernel(name: str, degree: int, freedoms: int) -> Kernel:
    """Collocation along the tangent space: N^T (s_j - s_0 - h sum_l a_jl r_l).

    s are the states at the `start`, the points and, if no point is there, the `end`; r are `rates`.
    """
    scheme: Scheme = make_scheme(name, degree)
    table, rungs = scheme.rungs, len(scheme.rungs)
    x = Columns(start=5, points=5 * degree, end=5 * (rungs - degree), rates=5 * degree, h=1)
    s, p = x.make_symbols(), Columns(N=5 * freedoms).make_symbols()
    here = ca.reshape(ca.vertcat(s.points, s.end), 5, rungs)
    rates, N = ca.reshape(s.rates, 5, degree), ca.reshape(p.N, 5, freedoms)
    steps = here - ca.repmat(s.start, 1, rungs) - s.h * (rates @ ca.DM(table).T)
    return build_kernel(s, p, steps=N.T @ steps)


@share
def monitor_kernel(formation: Formation, monitored: tuple[int, ...]) -> Kernel:
    """Limits of a formation."""
    x = Columns(z=5).make_symbols(z=build_features(formation.scene).z)
    values = ca.vertcat(ca.SX(0, 1), *(formation.limits[k].value for k in monitored))
    return build_kernel(x, values=values)


@share
def opening_kernel(formation: Formation, contact: Contact) -> Kernel:
    """Second derivative of a contact's gap."""
    x = Columns(z=5, v=5, a=5).make_symbols()
    _, A, _, A_dot_v = Formation(formation.scene, (contact,)).function(x.z, x.v)
    return build_kernel(x, opening=A @ x.a + A_dot_v)


def find_range_end(formation: Formation, until: Until, z: Array) -> int | None:
    """Row of the limit of the range of a contact that ends near z, (5,), where another is gained.

    None if that is gained by closing its gap, as a pointed tip also turns onto a vertex with the
    side of its link: phase 1 of scene 412 of seed 1128.
    """
    gaining = [k for k, limit in enumerate(formation.limits) if limit.gains(until.contact)]
    count = sum(len(build_limits(contact, formation.scene)) for contact in formation.contacts)
    ends = [k for k in gaining if k < count]
    if len(gaining) == len(ends) == 1:
        return ends[0]
    near = 1e-3 * formation.scene.scales.length
    values = formation.evaluate_limits(z[None])[0] if ends else ()
    return next((k for k in ends if values[k] < near), None)


@share
def goal_kernel(
    formation: Formation,
    until: Until | None,
    row: int | None,
    turns: tuple[int, ...],
    gained: Formation | None,
) -> Kernel:
    """End of a phase, zero rates of reversals, and zero speeds of contacts gained.

    `row` is as of `find_range_end`.
    """
    scene = formation.scene
    x = Columns(z=5, v=5).make_symbols(z=build_features(scene).z)
    z, v = x.z, x.v
    parts: list[Expression] = [ca.SX(0, 1)]
    if until is not None and until.contact is not None:
        # Where a contact changes its name its gap has no gradient, but the end of its range has.
        gap = build_features(scene).pairs[until.contact].gap
        parts.append(gap if row is None else formation.limits[row].value)
    if until is not None:
        parts += [z[row] - value for row, value in until.poses]
    if turns:
        rates = ca.vertcat(formation.function(z, v)[2] @ v, v[3:])
        parts += [rates[k] for k in turns]
    if gained is not None:
        P = gained.build_constraints(z, v)[1]
        parts += [P[i, :] @ v for i in new_rows(formation, gained)]
    return build_kernel(x, goals=ca.vertcat(*parts))


def new_rows(formation: Formation, following: Formation) -> list[int]:
    """Constraint rows of a formation that the one before does not have.

    A contact that goes on as that of a neighbouring feature has the same row.
    """
    renamed = list_renamed(formation.scene, formation.contacts, following.contacts).values()
    contacts = {*formation.contacts, *renamed}
    fresh = [i for i, c in enumerate(following.contacts) if c not in contacts]
    rolling = [following.contacts[row] for row in following.rolling_rows]
    n_c = following.n_contacts
    return fresh + [n_c + i for i, c in enumerate(rolling) if c not in formation.rolling]


@share
def effort_kernel(controls: int) -> Kernel:
    """Integral of tau^T tau over an interval, by the control points of tau."""
    x, n = Columns(tau=2 * controls, h=1).make_symbols(), controls - 1
    products = [
        [comb(n, i) * comb(n, j) / comb(2 * n, i + j) / (2 * n + 1) for j in range(controls)]
        for i in range(controls)
    ]
    tau = ca.reshape(x.tau, 2, controls)
    return build_kernel(x, effort=x.h * ca.trace(tau @ ca.DM(products) @ tau.T))


@share
def bend_kernel(controls: int) -> Kernel:
    """Cost of second differences of the control points of torques."""
    x, p = Columns(tau=2 * controls, h=1).make_symbols(), Columns(weight=2).make_symbols()
    tau = ca.reshape(x.tau, 2, controls)
    bends = tau[:, 2:] - 2 * tau[:, 1:-1] + tau[:, :-2]
    return build_kernel(x, p, cost=x.h * ca.dot(p.weight, ca.sum2(bends**2)))


def find_leaving(formation: Formation, following: Formation) -> list[int]:
    """Contacts of a formation that the next one does not have."""
    return [i for i, c in enumerate(formation.contacts) if c not in following.contacts]


@share
def impact_kernel(formation: Formation, following: Formation) -> Kernel:
    """A plastic impact M5 (v+ - v-) = G+^T p, P+ v+ = 0 onto the next formation, `Xi` after it.

    Rates of gaps that open, and friction cones of rolling contacts, are nonnegative.
    """
    scene, n_c = following.scene, following.n_contacts
    x = Columns(after=5, before=5, z=5, impulses=following.n_constraints).make_symbols()
    p = Columns(Xi=n_c).make_symbols()
    _, P, _, A_t = following.build_constraints(x.z, x.after)
    push = build_force_rows(following, P, A_t, p.Xi).T @ x.impulses
    A = formation.function(x.z, x.after)[1]
    rolling = list(following.rolling_rows)
    grip = ca.DM(following.friction)[rolling, :] * x.impulses[rolling, :]
    return build_kernel(
        x,
        p,
        jump=ca.DM(scene.mass_diagonal) * (x.after - x.before) - push,
        held=P @ x.after,
        leaving=A[find_leaving(formation, following), :] @ x.after,
        cones=ca.vertcat(grip - x.impulses[n_c:, :], grip + x.impulses[n_c:, :]),
    )


@share
def command_kernel(controls: int, joints: tuple[int, ...]) -> Kernel:
    """Slack of the commands' control points to torque limits, over these and times h."""
    x, n = Columns(tau=2 * controls, h=1).make_symbols(), controls - 1
    p = Columns(lag=2, limit=2).make_symbols()
    tau = ca.reshape(x.tau, 2, controls)
    left: list[Expression] = [ca.SX(0, 1)]
    for j in joints:
        for k in range(controls):
            rise = k * (tau[j, k] - tau[j, k - 1]) if k else 0
            rise += (n - k) * (tau[j, k + 1] - tau[j, k]) if k < n else 0
            command = (x.h * tau[j, k] + p.lag[j] * rise) / p.limit[j]
            left += [x.h - command, x.h + command]
    return build_kernel(x, p, left=ca.vertcat(*left))


@share
def rest_kernel(formation: Formation) -> Kernel:
    """Balance at rest of gravity, torques, c_n, c_t and friction of the joints (`forces`)."""
    scene, n_c = formation.scene, formation.n_contacts
    x = Columns(z=5, forces=2 * n_c + 2, tau=2).make_symbols()
    _, A, A_t, _ = formation.function(x.z, ca.SX.zeros(5))
    c_n, c_t, friction = x.forces[:n_c], x.forces[n_c : 2 * n_c], x.forces[2 * n_c :]
    at_joints = ca.vertcat(0, 0, 0, x.tau - friction)
    balance = A.T @ c_n + A_t.T @ c_t + ca.DM(scene.applied_force) + at_joints
    return build_kernel(x, balance=balance)


@share
def brake_kernel(formation: Formation) -> Kernel:
    """Accelerations of sliding contacts and joints against their directions, from z' = 0."""
    x = Columns(z=5, a=5).make_symbols()
    p = Columns(Xi=formation.n_contacts, sigma=2).make_symbols()
    A_t = formation.function(x.z, ca.SX.zeros(5))[2]
    slides = (p.Xi * (A_t @ x.a))[list(formation.rubbing_rows), :]
    return build_kernel(x, p, brake=-ca.vertcat(slides, p.sigma * x.a[3:]))


@share
def slope_kernel() -> Kernel:
    """Difference of the slopes of linear torques in two intervals, times both durations."""
    x = Columns(before=4, after=4, h=1, coming=1).make_symbols()
    slopes = (x.before[2:] - x.before[:2]) * x.coming - (x.after[2:] - x.after[:2]) * x.h
    return build_kernel(x, slopes=slopes)
