"""Constraints of the time-domain NLP in a stage and between stages, limits among them.

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

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...common.errors import Parameter
from ...contacts.formation import Formation
from ...geometry.curve import find_tied, tangent_basis
from ...mechanics.dynamics import build_force_rows
from ...mechanics.limits import CONE, PRESS, SPEED, LimitSet, make_limits
from ..columns import Columns
from ..options import Objective
from . import stage_kernels as kernels
from .collocation import Scheme, blend
from .nlp_layout import MARGIN, Indices, NlpRows, StageLayout, V, Z
from .stage import Stage
from .stage_kernels import NamedKernel, name_kernel, opening_kernel, share

SLIDING = 1e-5  # least rate of sliding contacts, over the radius of gyration, and of joints
_WITHIN = np.array([0.3, 0.4, 0.5, 0.75, 0.85, 0.93])
"""Places at which c_n is also bounded with rate-limited torques: minima are inside intervals."""
_ROOM = 0.05  # most relative distance of a lagging motor's torque at rest from its limit


@dataclass(frozen=True, eq=False)
class StageRows:
    """Rows of one stage, interval by interval."""

    chain: (
        Indices  # (K, m): constant margin, and contacts at ends of intervals without a point there
    )
    states: Indices  # (K, 2, rungs, f): collocation of z and of z', along the columns of `bases`
    bases: Array  # (K, 5, f): tangent space of each interval
    shares: Indices  # ratios of intervals
    points: Indices  # (K, d, m): equations and inequalities at the points
    balance: Indices  # (K, d, 5): of these, the equations of motion
    senses: Indices  # (K, d, n_rubbing): and the sliding directions of contacts with friction
    limits: LimitRows
    monitor_rows: Indices  # (K, d, m): limits of the formation
    motors: MotorRows | None  # of rate-limited torques

    @property
    def even(self) -> tuple[Indices, ...]:
        """Those whose multipliers are proportional to the length of an interval."""
        return (self.chain, self.points, *self.limits.groups, self.monitor_rows)


def add_stage(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, last: bool, target: Target
) -> StageRows:
    """Add the constraints of a stage."""
    formation = stage.formation
    node, ends = layout.nodes[:-1], layout.nodes[1:]
    chain = rows.linear(*node[:, MARGIN:].shape)
    rows.add_entries(chain, ends[:, MARGIN:], 1.0)
    rows.add_entries(chain, node[:, MARGIN:], -1.0)
    states, bases = _collocate(rows, stage, layout, scheme)
    shares = _share(rows, stage, layout)
    points, balance, senses = _balance(rows, stage, layout, scheme, last)
    first = node[:, Z] if formation.rolling else node[:, :0]
    if not scheme.ends:
        kernel = kernels.end_kernel(formation)
        own = rows.nonlinear(stage.intervals, kernel.outputs)
        rows.add_copies(kernel, kernel.x.join(z=ends[:, Z], v=ends[:, V], first=first), own)
        chain = np.hstack([chain, own])
    monitor_rows = _add_monitor_rows(rows, stage, layout, scheme)
    gained = [formation.limits[k].gained for k in stage.released]
    slow = formation.scene.has_slow_motors
    # With continuous torques a released contact has no acceleration at first.
    opening = stage.opening * (scheme.points[:, None] if slow else 1.0)
    for contact in [c for c in gained if c is not None and stage.opens]:
        kernel = kernels.opening_kernel(formation, contact)
        columns = kernel.x.join(z=layout.z[0], v=layout.v[0], a=layout.a[0])
        own = rows.nonlinear(scheme.degree, kernel.outputs, low=opening, high=np.inf)
        rows.add_copies(kernel, columns, own)
    until = stage.until
    if stage.stop is not None:
        until, N = None, tangent_basis(formation, stage.stop)
        there = rows.linear(N.shape[1], low=N.T @ stage.stop, high=N.T @ stage.stop)
        rows.add_entries(there[:, None], layout.nodes[-1, Z], N.T)
    turns, gained_softly = _list_free_turns(stage), stage.gained
    if _stops(stage):
        turns, gained_softly = (), None
        N = tangent_basis(formation, stage.guess.nodes[-1, 0])
        rows.add_entries(rows.linear(N.shape[1])[:, None], layout.nodes[-1, V], N.T)
    goal = kernels.goal_kernel(formation, until, turns, gained_softly)
    if goal is not None:
        end = layout.nodes[-1]
        rows.add_copies(goal, goal.x.join(z=end[Z], v=end[V]), rows.nonlinear(goal.outputs))
    limits = add_limits(rows, stage, layout, scheme, target)
    motors = add_motors(rows, stage, layout, scheme) if slow else None
    return StageRows(
        chain, states, bases, shares, points, balance, senses, limits, monitor_rows, motors
    )


def _list_free_turns(stage: Stage) -> tuple[int, ...]:
    """One of each set of tied rows that reverse: dependent equations spoil the solver's steps."""
    tied, free = set[int](), list[int]()
    for row in stage.turns:
        if row not in tied:
            free.append(row)
            tied.update(find_tied(stage.formation, stage.guess.nodes[-1, 0], row))
    return tuple(free)


def _stops(stage: Stage) -> bool:
    """Whether everything stops at the end of a stage, as independent rates reverse there.

    With one degree of freedom these are two, as one alone may have a zero.
    """
    return len(_list_free_turns(stage)) >= max(2, 5 - stage.formation.n_constraints)


def _collocate(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme
) -> tuple[Indices, Array]:
    """Collocation of z and z' along the tangent space, and its bases."""
    middles = stage.guess.z[:, scheme.degree // 2]
    bases = np.array([tangent_basis(stage.formation, z) for z in middles])
    K, _, f = bases.shape
    kernel = kernels.collocation_kernel(scheme.name, scheme.degree, f)
    parameters, collected = bases.transpose(0, 2, 1).reshape(K, -1), []
    if not f:
        return np.zeros((K, 2, len(scheme.rungs), 0), dtype=np.int64), bases
    for state, rate, part in ((layout.z, layout.v, Z), (layout.v, layout.a, V)):
        columns = kernel.x.join(
            start=layout.nodes[:-1, part],
            points=state.reshape(K, -1),
            end=layout.nodes[1:, part][:, : 5 * (not scheme.ends)],
            rates=rate.reshape(K, -1),
            h=layout.h[:, None],
        )
        own = rows.nonlinear(K, kernel.outputs)
        rows.add_copies(kernel, columns, own, kernel.p.join(N=parameters))
        collected.append(own.reshape(K, -1, f))
    return np.stack(collected, axis=1), bases


def _share(rows: NlpRows, stage: Stage, layout: StageLayout) -> Indices:
    """Constant ratios of intervals, unless they are parts of control periods."""
    if stage.periods:
        return np.zeros(0, dtype=np.int64)
    own = rows.linear(stage.intervals - 1)
    # Scaled like other rows.
    shares = stage.intervals * stage.guess.fractions
    rows.add_entries(own, layout.h[:-1], shares[1:])
    rows.add_entries(own, layout.h[1:], -shares[:-1])
    return own


def _balance(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, last: bool
) -> tuple[Indices, Indices, Indices]:
    """Equations of motion, contacts and sliding directions at the points, (K, d, n).

    Also those of the equations of motion and of the sliding directions alone.
    """
    formation, shape = stage.formation, layout.z.shape[:2]
    homotopy, node = stage.onset > 0, layout.nodes[:-1, None]
    kernel = kernels.point_kernel(formation, scheme.controls, homotopy)
    first = node[..., Z] if formation.rolling else node[..., :0]
    state = {"z": layout.z, "v": layout.v, "a": layout.a}
    columns = kernel.x.join(**state, forces=layout.forces, tau=layout.tau[:, None], first=first)
    least = least_senses(stage, stage.guess.places(scheme.points))[..., : formation.n_contacts]
    parameters = kernel.p.join(
        Xi=stage.directions.Xi,
        sigma=stage.directions.sigma,
        shares=blend(scheme.points, scheme.controls),
        least=np.maximum(least, 0.0),
        onset=np.full(1 * homotopy, stage.onset),
    )
    still, senses = find_still(stage, last) if scheme.ends else set(), kernel.y["senses"]
    low, high = np.zeros((*shape, kernel.outputs)), np.zeros(kernel.outputs)
    high[senses] = np.inf
    low[..., senses] = -np.inf if homotopy else 0.0
    low[-1, -1, senses][[k in still for k in formation.rubbing_rows]] = -np.inf
    own = rows.nonlinear(*shape, kernel.outputs, low=low, high=high)
    rows.add_copies(kernel, columns, own, parameters)
    return own, own[..., kernel.y["balance"]], own[..., senses]


def least_rates(stage: Stage, places: Array) -> Array:
    """Least rate at `places`, shares of a stage's duration, in their shape.

    Zero at both ends, and with one degree of freedom, where friction cannot hold one contact alone;
    none in the friction homotopy.
    """
    if stage.onset:
        return np.full(np.shape(places), -np.inf)
    free = stage.formation.n_constraints < 4
    return np.asarray(SLIDING * free * np.minimum(1.0, 8 * np.minimum(places, 1 - places)))


def least_senses(stage: Stage, places: Array) -> Array:
    """Least rates of (contacts, joints) at `places`, in their shape and one more axis.

    Zero for the second contact of a vertex.
    """
    contacts, least = stage.formation.contacts, least_rates(stage, places)[..., None]
    vertices = [contact.index if contact.feature == "v" else None for contact in contacts]
    again = [own is not None and own in vertices[:k] for k, own in enumerate(vertices)]
    return np.where([*again, False, False], np.minimum(least, 0.0), least)


def find_still(stage: Stage, last: bool) -> set[int]:
    """Rows of (contacts, joints) that stand still at the end of a stage."""
    if last or _stops(stage):
        return set(range(stage.formation.n_contacts + 2))
    coming = stage.gained.rolling if stage.gained else ()
    rolls = [k for k, c in enumerate(stage.formation.contacts) if c in coming]
    return {*stage.turns, *rolls}


def _add_monitor_rows(rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme) -> Indices:
    """Nonnegative limits of the formation, but for the end's there, shape (K, d, m)."""
    formation, (K, d) = stage.formation, layout.z.shape[:2]
    if not stage.monitored:
        return np.zeros((K, d, 0), dtype=np.int64)
    places = stage.guess.places(scheme.points).ravel()
    low = stage.list_clearances(places, after=1 / 3).reshape(K, d, -1)
    goal = None if stage.until is None else stage.until.contact
    reached = [formation.limits[k].gains(goal) for k in stage.monitored]
    if scheme.ends:
        low[-1, -1, reached] = -np.inf
    own = rows.nonlinear(K, d, len(stage.monitored), low=low, high=np.inf)
    kernel = kernels.monitor_kernel(formation, stage.monitored)
    rows.add_copies(kernel, kernel.x.join(z=layout.z), own)
    return own


def join_stages(
    rows: NlpRows,
    pair: tuple[Stage, Stage],
    layouts: tuple[StageLayout, StageLayout],
    scheme: Scheme,
) -> None:
    """Continuous position and velocity from one stage to the next, or an impact."""
    (stage, coming), layout = pair, layouts[0]
    last, first = layout.nodes[-1], layouts[1].nodes[0]
    if stage.formation.scene.has_slow_motors:
        join_motors(rows, stage, layouts, scheme)
    same = np.delete(np.arange(len(first)), V) if stage.ends_in_impact else slice(None)
    own = rows.linear(len(first[same]))
    rows.add_entries(own, first[same], 1.0)
    rows.add_entries(own, last[same], -1.0)
    if stage.ends_in_impact:
        kernel = kernels.impact_kernel(stage.formation, coming.formation)
        high = np.zeros(kernel.outputs)
        high[kernel.y["leaving"]] = high[kernel.y["cones"]] = np.inf
        columns = kernel.x.join(after=first[V], before=last[V], z=last[Z], impulses=layout.impulses)
        own = rows.nonlinear(kernel.outputs, high=high)
        rows.add_copies(kernel, columns, own, kernel.p.join(Xi=coming.directions.Xi))


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
    bounded: dict[int, Indices]  # unknowns of the sides that are bounds of these
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


def add_limits(
    rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme, target: Target
) -> LimitRows:
    """Add rows for the limits of a stage."""
    limits = make_limits(stage.formation, target.epsilon)
    gives = _list_gives(limits, layout, target)
    presses = limits.of(PRESS)
    own, signs, bounds = limits.sides
    # Column of y of each side that is of one torque or joint speed alone; else -1.
    column, n_forces = np.abs(limits.rows).argmax(axis=1), stage.formation.n_constraints
    alone = ((limits.rows != 0).sum(axis=1) == 1) & (column >= n_forces)
    single = np.where(alone, column - n_forces, -1)[own]
    others = np.flatnonzero(~np.isin(own, presses) & (single < 0))
    soft, slow = [gives[row] for row in presses], stage.formation.scene.has_slow_motors
    pressed = _add_presses(rows, limits, layout, scheme, soft, slow)
    added = rows.linear(*layout.z.shape[:2], len(others), high=np.inf)
    for k, side in enumerate(others):
        row = own[side]
        _add_point_row(rows, added[..., k], signs[side] * limits.rows[row], layout, scheme)
        _add_gives(rows, added[..., k], gives[row])
    bounded = dict[int, Indices]()
    for side in np.flatnonzero(single >= 0):
        j = int(single[side])
        # Control points of a torque, or speeds at the points.
        unknowns = layout.tau[:, j::2] if j < 2 else layout.v[..., 1 + j]
        if gives[own[side]] is None:
            bounded[int(side)] = unknowns
            continue
        added_row = rows.linear(*unknowns.shape, low=signs[side] * bounds[side], high=np.inf)
        rows.add_entries(added_row, unknowns, signs[side])
        _add_gives(rows, added_row, gives[own[side]])
    return LimitRows(limits, pressed, added, others, bounded, alone=not any(soft))


def bound_by_limits(
    rows: LimitRows, bounds: tuple[Array, Array], raised: Array | None = None
) -> None:
    """Bound torques and joint speeds, in place, by limits raised by shape (K, n_sides)."""
    low, high = bounds
    _, signs, values = rows.limits.sides
    for side, unknowns in rows.bounded.items():
        more = 0.0 if raised is None else raised[:, side, None]
        if signs[side] > 0:
            low[unknowns] = np.maximum(low[unknowns], values[side] + more)
        else:
            high[unknowns] = np.minimum(high[unknowns], values[side] - more)


def price_sides(rows: LimitRows, layout: StageLayout, on_x: Array, on_g: Array) -> Array:
    """Multiplier of each side of the limits in each interval, shape (K, n_sides).

    `on_x` and `on_g` are absolute multipliers of the unknowns' bounds and of the rows.
    """
    price = np.zeros((len(layout.h), len(rows.limits.sides[0])))
    c_n = layout.forces[..., : rows.presses.shape[2]]
    price[:, rows.pressed] = on_x[c_n].sum(axis=1) + on_g[rows.presses].sum(axis=1)
    price[:, rows.sides] = on_g[rows.others].sum(axis=1)
    for side, unknowns in rows.bounded.items():
        price[:, side] = on_x[unknowns].sum(axis=1)
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


@dataclass(frozen=True, eq=False)
class MotorRows:
    """Rows of one stage for rate-limited torques."""

    joins: Indices  # (K - 1, 2): continuous torques
    rates: Indices  # rates, commands (K, n): limits of rates, and of commands
    commands: Indices


def add_motors(rows: NlpRows, stage: Stage, layout: StageLayout, scheme: Scheme) -> MotorRows:
    """Add the rows of one stage."""
    scene, K, n = stage.formation.scene, stage.intervals, scheme.controls - 1
    tau = layout.tau.reshape(K, scheme.controls, 2)
    joins = rows.linear(K - 1, 2)
    _go_on(rows, joins, tau[:-1, -1], tau[1:, 0], scene.torque_limit)
    limited = np.flatnonzero(np.isfinite(scene.torque_rate_limit))
    rates = rows.linear(K, n, len(limited), 2, high=np.inf)
    for k, joint in enumerate(limited):
        limit = scene.torque_limit[joint]
        rows.add_entries(
            rates[:, :, k], layout.h[:, None, None], scene.torque_rate_limit[joint] / limit
        )
        for side, sign in enumerate((1.0, -1.0)):
            own = rates[:, :, k, side]
            rows.add_entries(own, tau[:, 1:, joint], -sign * n / limit)
            rows.add_entries(own, tau[:, :-1, joint], sign * n / limit)
    lagging = tuple(np.flatnonzero(scene.actuator_lag).tolist())
    kernel = command_kernel(scheme.controls, lagging)
    commands = rows.nonlinear(K, kernel.outputs, high=np.inf)
    if lagging:
        given = kernel.p.join(lag=scene.actuator_lag, limit=scene.torque_limit)
        columns = kernel.x.join(tau=layout.tau, h=layout.h[:, None])
        rows.add_copies(kernel, columns, commands, np.tile(given, (K, 1)))
    return MotorRows(joins, rates.reshape(K, -1), commands)


def join_motors(
    rows: NlpRows, stage: Stage, layouts: tuple[StageLayout, StageLayout], scheme: Scheme
) -> None:
    """Continuous torques, forces and accelerations from a stage to the next."""
    layout, coming = layouts
    formation, own = stage.formation, rows.linear(2)
    _go_on(rows, own, layout.tau[-1, -2:], coming.tau[0, :2], formation.scene.torque_limit)
    shares = scheme.interpolate(np.ones(1))[0]
    for fading, slips in stage.fading:
        own, share = rows.linear(1), float(formation.friction[fading]) if slips else 1.0
        rows.add_entries(own, layout.forces[-1, :, fading], share * shares)
        if slips:
            tangential = formation.n_contacts + formation.rolling_rows.index(fading)
            rows.add_entries(own, layout.forces[-1, :, tangential], slips * shares)
    if scheme.ends and stage.gained is not None:
        for contact in stage.gained.contacts:
            if contact not in formation.contacts:
                kernel = opening_kernel(stage.gained, contact)
                at = (layout.z, layout.v, layout.a)
                columns = kernel.x.join(**{k: v[-1, -1] for k, v in zip("zva", at, strict=True)})
                rows.add_copies(kernel, columns, rows.nonlinear(kernel.outputs))


def _go_on(rows: NlpRows, own: Indices, before: Indices, after: Indices, limit: Array) -> None:
    rows.add_entries(own, after, 1 / limit)
    rows.add_entries(own, before, -1 / limit)


def hold_ends(
    rows: NlpRows, stages: Sequence[Stage], layouts: Sequence[StageLayout], epsilon: float
) -> None:
    """Torques hold the object at rest at both ends of a motion."""
    for k, (place, tau) in ((0, (0, slice(None, 2))), (-1, (-1, slice(-2, None)))):
        stage, layout = stages[k], layouts[k]
        forces = layout.finish if k else layout.begin
        kernel = hold_kernel(stage.formation)
        columns = kernel.x.join(z=layout.nodes[place, Z], forces=forces, tau=layout.tau[place, tau])
        given = kernel.p.join(Xi=stage.directions.Xi, sigma=stage.directions.sigma)
        rows.add_copies(kernel, columns, rows.nonlinear(kernel.outputs), given)
        formation = stage.formation
        if not k and stage.phase:
            # A command approaches a torque limit only asymptotically in the pause before.
            scene, first = formation.scene, layout.tau[0, :2]
            for joint in np.flatnonzero(scene.actuator_lag):
                limit = scene.torque_limit[joint]
                fastest = scene.torque_rate_limit[joint] * scene.actuator_lag[joint] / limit
                most = 1 - min(_ROOM, float(fastest))
                rows.add_entries(rows.linear(1, low=-most, high=most), first[joint], 1 / limit)
        for r, row in enumerate(formation.rolling_rows):
            mu = float(formation.friction[row])
            own = rows.linear(2, low=mu * epsilon, high=np.inf)
            rows.add_entries(own, forces[row], mu)
            rows.add_entries(own, forces[formation.n_contacts + r], np.array([1.0, -1.0]))


def find_relieved(stage: Stage, limits: LimitSet) -> NDArray[np.bool_]:
    """Sides without effect in each interval, as forces vanish or set in or slip, (K, n_sides)."""
    relieved = np.zeros((stage.intervals, len(limits.sides[0])), dtype=bool)
    if not stage.formation.scene.has_slow_motors:
        return relieved
    names, owners = stage.formation.names, limits.owners[limits.sides[0]]

    def find(contact: int, *kinds: str) -> list[bool]:
        own = [limits.limits[k] for k in owners]
        return [limit.kind in kinds and limit.part == names[contact] for limit in own]

    for contact, slips in stage.fading:
        relieved[-1] |= find(contact, *((CONE,) if slips else (PRESS, CONE)))
    for contact in stage.growing:
        relieved[0] |= find(contact, PRESS, CONE)
    return relieved


@lru_cache(maxsize=8)
def command_kernel(controls: int, joints: tuple[int, ...]) -> NamedKernel:
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
    return name_kernel(x, p, left=ca.vertcat(*left))


@share(32)
def hold_kernel(formation: Formation) -> NamedKernel:
    """The equations of motion at rest, without acceleration."""
    scene, n_c = formation.scene, formation.n_contacts
    x = Columns(z=5, forces=formation.n_constraints, tau=2).make_symbols()
    p = Columns(Xi=n_c, sigma=2).make_symbols()
    _, P, _, A_t = formation.build_constraints(x.z, ca.SX.zeros(5))
    balance = (
        ca.DM(scene.applied_force)
        + ca.vertcat(0, 0, 0, x.tau)
        - ca.DM(scene.dry) * ca.vertcat(0, 0, 0, p.sigma)
        + build_force_rows(formation, P, A_t, p.Xi).T @ x.forces
    )
    return name_kernel(x, p, balance=balance)
