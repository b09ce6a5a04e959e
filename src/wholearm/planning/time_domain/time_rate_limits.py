"""Rows of the time-domain NLP for rate-limited torques and actuator lag.

Torques have control points c_0 ... c_n in each interval and are continuous; with rate limit R

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

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...contacts.formation import Formation
from ...mechanics.dynamics import build_force_rows
from ...mechanics.limits import CONE, PRESS, LimitSet
from ..columns import Columns
from .collocation import Scheme
from .nlp_layout import Indices, NlpRows, StageLayout, Z
from .stage import Stage
from .stage_kernels import NamedKernel, name_kernel, opening_kernel, share

_ROOM = 0.05  # most relative distance of a lagging motor's torque at rest from its limit


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
