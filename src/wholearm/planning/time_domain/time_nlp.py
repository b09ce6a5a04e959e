"""NLP of stages in the time domain by direct collocation, for any number of degrees of freedom.

A stage has one formation and fixed directions of friction, in K intervals of unknown durations h
with d collocation points. Torques are polynomials in each interval and may step between. Unknowns
are z and z' at the nodes, h, and z, z', z'' and the contact forces c at every point, where

    C(z) = 0,  P z' = 0,  P z'' + P' z' = 0,
    M5 z'' + B z' = g - D sigma + S tau + G^T c,
    c_n >= epsilon,  |tau| <= limit,  Xi A_t z' >= 0,  sigma theta' >= 0,
    |c_t| <= mu (c_n - epsilon) (rolling).

Contacts hold without drift, and friction opposes motion. With an orthonormal basis N of the null
space of P at a guess of each interval, the differential equations are collocated by

    N^T (z_j - z_0 - h sum_l a_jl z'_l) = 0,  N^T (z'_j - z'_0 - h sum_l a_jl z''_l) = 0.

No other row has h, so that a stage may vanish. Rates that equations keep at zero have no sign
constraint, which would leave the solver no interior. All quantities are in the scene's units.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import groupby, pairwise
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array, Expression
from ...geometry.curve import tangent_basis
from ...solvers.ipopt import SolverStatistics, book, build_solver
from ..columns import Columns
from ..options import Objective
from .collocation import Scheme
from .equations import (
    LimitRows,
    StageRows,
    Target,
    add_stage,
    bound_by_limits,
    find_relieved,
    find_still,
    hold_ends,
    join_stages,
    least_senses,
)
from .nlp_layout import (
    MARGIN,
    STATE,
    Assembled,
    Indices,
    NlpRows,
    StageLayout,
    V,
    Z,
    assemble_nlp,
    lay_out,
)
from .stage import LimitMisses, Stage
from .stage_kernels import NamedKernel, bend_kernel, effort_kernel, name_kernel

SHORTEST = 1e-6  # least duration of an interval, in the scene's unit
_BEND = 1e-2  # weight of second differences of torques over their limits, which else may ring
_HURRY = 3e-4  # weight of time against violations
CLEAR = 1e-3  # distance of a coordinate from its value at the phase's end; less near the end
LONGEST = 120.0  # most processor time of one solve [s]
NEAR, FAR = 1e-6, 1e-2  # distance of a start from its bounds: a solution, and a first guess


@dataclass(frozen=True, eq=False)
class TimeNLP:
    """A built NLP."""

    assembled: Assembled | None  # None in copies and files: CasADi's objects belong to one process
    max_iter: int  # most iterations of the solver
    layouts: list[StageLayout]
    rows: NlpRows
    rows_of: list[StageRows]
    duration_row: int  # row of the whole duration with a margin or a relaxation; otherwise -1

    def __getstate__(self) -> dict[str, Any]:
        known = {own.name: getattr(self, own.name) for own in fields(self)}
        return known | {"assembled": None}

    @cached_property
    def solver(self) -> Expression:
        """Ipopt, to start from a solution."""
        return self._build(NEAR)

    @cached_property
    def first_solver(self) -> Expression:
        """Ipopt, to start from a guess."""
        return self._build(FAR)

    def _build(self, push: float) -> Expression:
        assert self.assembled is not None
        nlp, derivatives = self.assembled
        most = {"max_iter": self.max_iter, "max_cpu_time": LONGEST}
        return build_solver("time_nlp", nlp, push, derivatives, **most)


def build_time_nlp(
    stages: Sequence[Stage], scheme: Scheme, target: Target, max_iter: int
) -> TimeNLP:
    """Build the NLP of successive stages that end at rest."""
    started = time.perf_counter()
    shortfalls = [target.count_shortfalls(stage) for stage in stages]
    # Regularized friction holds nothing at rest.
    held = stages[0].formation.scene.has_slow_motors and not stages[0].onset
    layouts = lay_out(stages, scheme, target.chained, shortfalls, held)
    rows, cost = NlpRows(), np.zeros(layouts[-1].stop)
    start = stages[0].guess.nodes[0].ravel()
    rows.add_entries(rows.linear(STATE, low=start, high=start), layouts[0].nodes[0, :STATE], 1.0)
    rows_of = []
    for k, (stage, layout) in enumerate(zip(stages, layouts, strict=True)):
        rows_of.append(add_stage(rows, stage, layout, scheme, stage is stages[-1], target))
        if k + 1 < len(stages):
            join_stages(rows, (stage, stages[k + 1]), (layout, layouts[k + 1]), scheme)
        _add_costs(rows, cost, stage, layout, scheme, target)
    duration_row, last, end = -1, stages[-1], layouts[-1].nodes[-1]
    if stages[0].periods:
        add_periods(rows, stages, layouts)
    if held:
        hold_ends(rows, stages, layouts, target.epsilon)
    if target.chained:
        cost[end[MARGIN]] = -1.0 if target.objective is Objective.MARGIN else 1.0
        total = rows.linear(1, high=np.inf)
        rows.add_entries(total, np.concatenate([layout.h for layout in layouts]), 1.0)
        duration_row = int(total[0])
    if target.price is not None:
        cost[end[Z]] = target.price
    N = tangent_basis(last.formation, last.guess.nodes[-1, 0])
    rest = rows.linear(N.shape[1])
    rows.add_entries(rest[:, None], end[V], N.T)
    built = assemble_nlp(len(cost), rows.triplets, rows.linear_rows, rows.blocks, cost)
    book(SolverStatistics(build_time=time.perf_counter() - started))
    return TimeNLP(built, max_iter, layouts, rows, rows_of, duration_row)


def _add_costs(
    rows: NlpRows, cost: Array, stage: Stage, layout: StageLayout, scheme: Scheme, target: Target
) -> None:
    """Add the cost of a stage."""
    if target.objective is Objective.EFFORT:
        kernel = effort_kernel(scheme.controls)
        rows.add_cost(kernel, kernel.x.join(tau=layout.tau, h=layout.h[:, None]))
    elif scheme.controls > 2:
        kernel, weight = bend_kernel(scheme.controls), stage.formation.scene.torque_limit**-2.0
        given = np.tile(_BEND * weight, (stage.intervals, 1))
        rows.add_cost(kernel, kernel.x.join(tau=layout.tau, h=layout.h[:, None]), given)
    of_time = {Objective.TIME: 1.0, Objective.EFFORT: target.time_weight, Objective.ELASTIC: _HURRY}
    cost[layout.h] = of_time.get(target.objective, 0.0)
    cost[layout.short] = 1 / stage.intervals


def bound_unknowns(nlp: TimeNLP, stages: Sequence[Stage], scheme: Scheme) -> tuple[Array, Array]:
    """Bounds of the unknowns but for the least c_n: durations, torques, joint speeds, impulses."""
    size = nlp.layouts[-1].stop
    low, high = np.full(size, -np.inf), np.full(size, np.inf)
    for k, (stage, coming) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
        layout = nlp.layouts[k]
        low[layout.short] = 0.0
        low[layout.h] = SHORTEST
        still = find_still(stage, stage is stages[-1]) if scheme.ends else set()
        rates = least_senses(stage, stage.guess.places(scheme.points))
        for joint, sigma in enumerate(stage.directions.sigma):
            own, one_way = layout.v[..., 3 + joint], rates[..., joint - 2].copy()
            if stage.formation.n_contacts + joint in still:
                one_way[-1, -1] = -np.inf
            if sigma > 0:
                low[own] = one_way
            else:
                high[own] = -one_way
        bound_by_limits(nlp.rows_of[k].limits, (low, high))
        _stay_short(stage, layout, scheme, (low, high))
        if coming is not None and stage.ends_in_impact:
            low[layout.impulses[: coming.formation.n_contacts]] = 0.0
    return low, high


def _stay_short(
    stage: Stage, layout: StageLayout, scheme: Scheme, bounds: tuple[Array, Array]
) -> None:
    """Bound a coordinate, in place, before the value at which the phase ends."""
    if stage.ahead is None:
        return
    row, value, side = stage.ahead
    left = 1.0 - stage.guess.places(scheme.points) * (stage.until is not None)
    most = value - side * CLEAR * np.minimum(1.0, (2 * left) ** 2)
    if stage.until is not None and scheme.ends:
        most[-1, -1] = side * np.inf
    bounds[int(side > 0)][layout.z[..., row]] = most


class _Piece(NamedTuple):
    """An interval as a part of a period: stage, period, share of the stage, and unknowns."""

    stage: int
    period: int
    share: float
    h: int
    tau: Indices


def add_periods(rows: NlpRows, stages: Sequence[Stage], layouts: Sequence[StageLayout]) -> None:
    """Durations of control periods, and their torques, constant or linear and continuous."""
    scene = stages[0].formation.scene
    linear, goes_on = scene.control_hold == "linear", scene.has_slow_motors
    pieces = [
        (stage.phase, _Piece(k, period, float(stage.guess.fractions[i]), int(layout.h[i]), tau))
        for k, (stage, layout) in enumerate(zip(stages, layouts, strict=True))
        for i, (period, tau) in enumerate(zip(stage.periods, layout.tau, strict=True))
    ]
    for _, found in groupby(pieces, key=lambda own: own[0]):
        phase = [piece for _, piece in found]
        last = phase[-1].period
        for period, own in groupby(phase, key=lambda piece: piece.period):
            _add_period(rows, list(own), scene.control_period, period == last, linear)
        for before, after in pairwise(phase):
            if not goes_on and (linear or before.period == after.period):
                limit, same = 1 / scene.torque_limit, rows.linear(2)
                rows.add_entries(same, after.tau[:2], limit)
                rows.add_entries(same, before.tau[-2:], -limit)


def _add_period(
    rows: NlpRows, pieces: Sequence[_Piece], period: float, last: bool, linear: bool
) -> None:
    whole = rows.linear(1, low=0.0 if last else period, high=period)
    rows.add_entries(whole, np.array([piece.h for piece in pieces]), 1.0)
    for one, other in pairwise(pieces):
        if one.stage == other.stage:
            even = rows.linear(1)
            size = one.share + other.share
            rows.add_entries(even, np.array([one.h]), other.share / size)
            rows.add_entries(even, np.array([other.h]), -one.share / size)
        if linear:
            kernel = slope_kernel()
            columns = kernel.x.join(
                before=one.tau, after=other.tau, h=np.array([one.h]), coming=np.array([other.h])
            )
            rows.add_copies(kernel, columns, rows.nonlinear(kernel.outputs))


@lru_cache(maxsize=1)
def slope_kernel() -> NamedKernel:
    """Difference of the slopes of linear torques in two intervals, times both durations."""
    x = Columns(before=4, after=4, h=1, coming=1).make_symbols()
    slopes = (x.before[2:] - x.before[:2]) * x.coming - (x.after[2:] - x.after[:2]) * x.h
    return name_kernel(x, Columns().make_symbols(), slopes=slopes)


def raise_bounds(
    nlp: TimeNLP,
    stages: Sequence[Stage],
    limits: Sequence[LimitMisses],
    bounds: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Bounds of the NLP's rows; raises `bounds`, those of its unknowns, in place."""
    low, high = nlp.rows.bounds
    low_x, high_x = bounds
    for k, (stage, raised) in enumerate(zip(stages, limits, strict=True)):
        own, layout = nlp.rows_of[k], nlp.layouts[k]
        kept = own.limits.limits
        rows, signs, values = kept.sides
        more = raised.held * kept.scales[rows]
        # Forces that vanish or set in are only nonnegative.
        more = np.where(find_relieved(stage, kept), -signs * values, more)
        pressed = own.limits.pressed
        floor = values[pressed] + more[:, pressed]
        # Where rows hold c_n at the points too, its own bounds must not.
        if own.limits.alone:
            low_x[layout.forces[..., : stage.formation.n_contacts]] = floor[:, None]
        low[own.limits.presses] = floor[:, None]
        others = own.limits.sides
        low[own.limits.others] = ((signs * values)[others] + more[:, others])[:, None]
        for held in (layout.begin, layout.finish):
            low_x[held[: stage.formation.n_contacts]] = values[pressed][: len(held)]
        _free_equal(stage, own.limits, layout, (low_x, low))
        bound_by_limits(own.limits, bounds, more)
        low[own.monitor_rows] += raised.gap[:, None, list(stage.monitored)]
        low[own.senses] += raised.sense[:, None, list(stage.formation.rubbing_rows)]
        for joint, sigma in enumerate(stage.directions.sigma):
            rates, faster = layout.v[..., 3 + joint], raised.sense[:, -2 + joint, None]
            low_x[rates] += faster * (sigma > 0)
            high_x[rates] -= faster * (sigma < 0)
    return low, high


def _free_equal(
    stage: Stage, rows: LimitRows, layout: StageLayout, lows: tuple[Array, Array]
) -> None:
    """Remove bounds, in place, of forces that are given by equations."""
    if not stage.formation.scene.has_slow_motors:
        return
    low_x, low = lows
    for contact, slips in stage.fading:
        if slips:
            names = [rows.limits.limits[k].part for k in rows.limits.owners]
            own = [names[k] == stage.formation.names[contact] for k in rows.limits.sides[0]]
            low[rows.others[-1, -1, np.array(own)[rows.sides]]] = -np.inf
        else:
            low_x[layout.forces[-1, -1, contact]] = -np.inf
            low[rows.presses[-1, 1:2, contact]] = -np.inf
    low[rows.presses[0, 0, list(stage.growing)]] = -np.inf
