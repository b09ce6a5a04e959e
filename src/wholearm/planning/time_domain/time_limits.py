"""Rows and bounds of the time-domain NLP for the limits of `mechanics.limits`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...common.errors import Parameter
from ...mechanics.limits import PRESS, SPEED, LimitSet, make_limits
from ..options import Objective
from .collocation import Scheme, blend
from .nlp_layout import MARGIN, Indices, NlpRows, StageLayout
from .stage import Stage

_WITHIN = np.array([0.3, 0.4, 0.5, 0.75, 0.85, 0.93])
"""Places at which c_n is also bounded with rate-limited torques: minima are inside intervals."""


class Target(NamedTuple):
    """Objective of an NLP."""

    objective: Objective
    epsilon: float  # [N]: least normal force
    time_weight: float = 0.0  # [(N m)^2]: for `effort`
    relaxation: Parameter | None = None  # the relaxed limit, for `relax`
    price: Array | None = None  # (5,): linear cost of z at the end

    @property
    def chained(self) -> bool:
        """Whether nodes have one more unknown, all of them copies: a margin or a relaxation."""
        return self.objective in (Objective.MARGIN, Objective.RELAX)

    def count_shortfalls(self, stage: Stage) -> int:
        """Number of shortfalls in each interval of a stage: of every limit but those of speeds."""
        limits = make_limits(stage.formation, self.epsilon).without(SPEED).limits
        return len(limits) * (self.objective is Objective.ELASTIC)


@dataclass(frozen=True, eq=False)
class LimitRows:
    """Limits of one stage, as rows and as bounds of unknowns."""

    limits: LimitSet
    # (K, m, n_c): c_n at the start of each interval, and where bounds of unknowns are not enough
    presses: Indices
    others: Indices  # (K, d, n): at the points, sides of limits of several unknowns: friction cones
    sides: NDArray[np.int64]  # (n,): which sides of the limits these are
    bounded: tuple[int, ...]  # sides that are bounds of an unknown
    alone: bool  # whether c_n are bounded at the points themselves

    @property
    def pressed(self) -> NDArray[np.int64]:
        """Sides of the limits that `presses` belong to."""
        return np.flatnonzero(np.isin(self.limits.sides[0], self.limits.of(PRESS)))

    @property
    def groups(self) -> tuple[Indices, Indices]:
        """The rows, interval by interval."""
        return self.presses, self.others


class _Gives(NamedTuple):
    """Slack of a row: an unknown of each interval, shape (K,), and its weight."""

    unknowns: Indices
    weight: float


def find_single(limits: LimitSet, n_forces: int) -> NDArray[np.int64]:
    """Column of y for each row that is of one torque or joint speed alone, shape (m,); else -1."""
    alone = (limits.rows != 0).sum(axis=1) == 1
    column = np.abs(limits.rows).argmax(axis=1)
    return np.where(alone & (column >= n_forces), column, -1)


def add_limits(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, target: Target
) -> LimitRows:
    """Add rows for the limits of a stage."""
    limits = make_limits(stage.formation, target.epsilon)
    gives = _list_gives(limits, layout, target)
    presses = limits.of(PRESS)
    own, signs, bounds = limits.sides
    single = find_single(limits, stage.formation.n_constraints)[own]
    others = np.flatnonzero(~np.isin(own, presses) & (single < 0))
    soft, slow = [gives[row] for row in presses], stage.formation.scene.has_slow_motors
    pressed = _add_presses(rows, limits, layout, scheme, soft, slow)
    added = rows.linear(*layout.z.shape[:2], len(others), high=np.inf)
    for k, side in enumerate(others):
        row = own[side]
        _add_point_row(rows, added[..., k], signs[side] * limits.rows[row], layout, scheme)
        _add_gives(rows, added[..., k], gives[row])
    bounded = []
    for side in np.flatnonzero(single >= 0):
        if gives[own[side]] is None:
            bounded.append(int(side))
            continue
        unknowns = _find_unknowns(layout, stage.formation.n_constraints, single[side])
        added_row = rows.linear(*unknowns.shape, low=signs[side] * bounds[side], high=np.inf)
        rows.add_entries(added_row, unknowns, signs[side])
        _add_gives(rows, added_row, gives[own[side]])
    return LimitRows(limits, pressed, added, others, tuple(bounded), alone=not any(soft))


def bound_by_limits(
    rows: LimitRows, layout: StageLayout, bounds: tuple[Array, Array], raised: Array | None = None
) -> None:
    """Bound torques and joint speeds, in place, by limits raised by shape (K, n_sides)."""
    low, high = bounds
    own, signs, values = rows.limits.sides
    n_forces = layout.forces.shape[2]
    single = find_single(rows.limits, n_forces)[own]
    for side in rows.bounded:
        unknowns = _find_unknowns(layout, n_forces, single[side])
        more = 0.0 if raised is None else raised[:, side, None]
        if signs[side] > 0:
            low[unknowns] = np.maximum(low[unknowns], values[side] + more)
        else:
            high[unknowns] = np.minimum(high[unknowns], values[side] - more)


def price_sides(rows: LimitRows, layout: StageLayout, on_x: Array, on_g: Array) -> Array:
    """Multiplier of each side of the limits in each interval, shape (K, n_sides).

    `on_x` and `on_g` are absolute multipliers of the unknowns' bounds and of the rows.
    """
    own, n_forces = rows.limits.sides[0], layout.forces.shape[2]
    single = find_single(rows.limits, n_forces)[own]
    price = np.zeros((len(layout.h), len(own)))
    c_n = layout.forces[..., : rows.presses.shape[2]]
    price[:, rows.pressed] = on_x[c_n].sum(axis=1) + on_g[rows.presses].sum(axis=1)
    price[:, rows.sides] = on_g[rows.others].sum(axis=1)
    for side in rows.bounded:
        price[:, side] = on_x[_find_unknowns(layout, n_forces, single[side])].sum(axis=1)
    return price


def _list_gives(limits: LimitSet, layout: StageLayout, target: Target) -> list[_Gives | None]:
    """Slack of each row, if it has one."""
    gives: list[_Gives | None] = [None] * len(limits.low)
    chain = layout.nodes[:-1, MARGIN:].ravel()
    if target.objective is Objective.MARGIN:
        for row in limits.of(PRESS):
            gives[row] = _Gives(chain, -1.0)
    elif target.objective is Objective.ELASTIC:
        for row in limits.of(*{limit.kind for limit in limits.without(SPEED).limits}):
            gives[row] = _Gives(layout.short[:, limits.owners[row]], 1.0)
    elif target.relaxation is not None:
        weights = limits.weigh(target.relaxation)
        for row in np.flatnonzero(weights):
            gives[row] = _Gives(chain, float(weights[row]))
    return gives


def _add_gives(rows: NlpRows, own: Indices, gives: _Gives | None) -> None:
    if gives is not None:
        rows.add_entries(own, gives.unknowns[:, None], gives.weight)


def _add_presses(
    rows: NlpRows,
    limits: LimitSet,
    layout: StageLayout,
    scheme: Scheme,
    gives: list[_Gives | None],
    slow: bool,
) -> Indices:
    """Normal forces by the polynomials through the points, shape (K, m, n_c)."""
    places = np.zeros(1) if scheme.ends else np.array([0.0, 1.0])
    if slow:
        places = np.append(places, _WITHIN)
    if any(gives):
        places = np.append(places, scheme.points)
    c_n = layout.forces[:, :, limits.rows[limits.of(PRESS)].argmax(axis=1)]
    presses = rows.linear(len(c_n), len(places), c_n.shape[2], high=np.inf)
    for i, row in enumerate(scheme.interpolate(places)):
        for j in np.flatnonzero(np.abs(row) > 1e-12):
            rows.add_entries(presses[:, i], c_n[:, j], row[j])
    for k, own in enumerate(gives):
        _add_gives(rows, presses[..., k], own)
    return presses


def _add_point_row(
    rows: NlpRows, own: Indices, row: Array, layout: StageLayout, scheme: Scheme
) -> None:
    """A row of y at every point, shape (K, d)."""
    of_c, of_tau, of_rates = np.split(row, [layout.forces.shape[2], layout.forces.shape[2] + 2])
    for unknowns, of_them in ((layout.forces, of_c), (layout.v[..., 3:], of_rates)):
        for k in np.flatnonzero(of_them):
            rows.add_entries(own, unknowns[..., k], of_them[k])
    for k in np.flatnonzero(of_tau):
        for i, shares in enumerate(blend(scheme.points, scheme.controls).T):
            rows.add_entries(own, layout.tau[:, None, 2 * i + k], of_tau[k] * shares)


def _find_unknowns(layout: StageLayout, n_forces: int, column: int) -> Indices:
    """The unknowns of one torque or joint speed: its control points, or those at the points."""
    if column < n_forces + 2:
        return layout.tau[:, column - n_forces :: 2]
    return layout.v[..., 3 + column - n_forces - 2]
