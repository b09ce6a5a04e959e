"""Constraints of the time-domain NLP in a stage and between stages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...common.arrays import Array
from ...geometry.curve import find_tied, tangent_basis
from . import stage_kernels as kernels
from .collocation import Scheme, blend
from .nlp_layout import MARGIN, Indices, NlpRows, StageLayout, V, Z
from .stage import Stage
from .time_limits import LimitRows, Target, add_limits
from .time_rate_limits import MotorRows, add_motors, join_motors

SLIDING = 1e-5  # least rate of sliding contacts, over the radius of gyration, and of joints


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
