"""What helps to tune torques by hand, from a replay: what would mend losses, and how near it came.

A loss is looked at in the state in which it happens: there z'' and c are affine in the torques. A
change of the torques that mends it is one from that instant on; made earlier, it changes the motion
up to there as well.
"""

from __future__ import annotations

import math

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.limits import CONE, PRESS, make_limits
from ..problem.definition import Phase, Problem
from ..results.report import PhaseReport
from ..results.tuning import Approach, ForceAt, Loss, TorqueChange, TuningHelp
from ..simulation.events import EventKind, Simulation
from .holding import find_resting_changes, find_worst, list_ways
from .instants import Instant, find_moving
from .margins import find_lowest
from .mending import KEPT, find_changes
from .verdict import Allowance

_KINDS = {EventKind.CONTACT_LOST: "lost", EventKind.SLIP: "slips"}
LEAST = 1e-3
"""Least normal force to aim at, over the scene's force, where epsilon is less."""
TURNED = 1e-6
"""Speed from which on a motion counts as going one way, relative to the scene's speed."""


def find_help(
    problem: Problem, simulation: Simulation, phases: tuple[PhaseReport, ...], allowance: Allowance
) -> TuningHelp:
    """What helps to mend a replay: losses with changes of the torques, and how near it came."""
    events = [
        (event.phase, event.contact, _KINDS[event.kind], event.time)
        for event in simulation.events
        if _is_loss(problem, event.kind, event.phase, event.contact)
    ]
    ended = {event[:2] for event in events}
    allowed = allowance.measure_stray(problem)
    events += [
        (phase.number - 1, margin.contact, "thin", margin.time)
        for phase in phases
        for margin in phase.contacts
        if margin.margin < -allowed and (phase.number - 1, margin.contact) not in ended
    ]
    losses = (_look_at(problem, simulation, *event) for event in events)
    approach = None if simulation.outcome.reached else find_approach(problem, simulation)
    return TuningHelp(tuple(loss for loss in losses if loss is not None), approach)


def _is_loss(problem: Problem, kind: EventKind, phase: int, contact: str) -> bool:
    rolling = {own.name for own in problem.phases[phase].formation.rolling}
    return kind is EventKind.CONTACT_LOST or (kind is EventKind.SLIP and contact in rolling)


def _look_at(
    problem: Problem, simulation: Simulation, index: int, contact: str, kind: str, time: float
) -> Loss | None:
    """A loss with what would mend it; None if the phase does not have the contact."""
    phase = problem.phases[index]
    formation = phase.formation
    if contact not in formation.names:
        return None
    row = _find_row(simulation, index, contact, kind, time)
    z, v, tau = simulation.z[row], simulation.z_dot[row], simulation.tau[row]
    epsilon = max(problem.epsilon, LEAST * problem.scene.scales.force)
    way = _measure_way(phase, z[None], v[None])
    columns = [simulation.contacts.index(name) for name in formation.names]
    rests = bool(np.isnan(simulation.c_n[row, columns]).all())
    if rests:
        ways = list_ways(formation, z)
        instant = find_worst(formation, ways, z, tau)
        gradient = None if way is None else way[1][0]
        changes = find_resting_changes(formation, ways, epsilon, z, tau, gradient)
    else:
        instant = find_moving(formation, z, v, tau, simulation.z_ddot[row])
        changes = () if instant is None else list_changes(instant, epsilon, contact, tau)
    load = np.array([1.0, *tau])
    forces: tuple[ForceAt, ...] = ()
    closing: tuple[float, ...] = ()
    if instant is not None:
        forces = tuple(
            ForceAt(name, float(c_n @ load), float(c_t @ load), (float(c_n[1]), float(c_n[2])))
            for name, c_n, c_t in zip(formation.names, instant.c_n, instant.c_t, strict=True)
        )
    if instant is not None and way is not None:
        rows = -way[1][0] @ instant.acceleration
        closing = (float(rows @ load - way[2][0]), float(rows[1]), float(rows[2]))
    when = float(simulation.t[row])
    return Loss(phase.number, contact, kind, when, rests, forces, closing, changes)


def list_changes(
    instant: Instant, epsilon: float, contact: str, tau: Array
) -> tuple[TorqueChange, ...]:
    """Changes of the torques of a motion that mend a contact, and what else lets go with it."""
    formation = instant.formation
    much, load = formation.scene.scales.torque, np.array([1.0, *tau])
    limits, bare = make_limits(formation, epsilon), make_limits(formation, 0.0)
    forces = (PRESS, CONE)
    own = [limit.part == contact and limit.kind in forces for limit in limits.limits]
    missed = np.array(own)[limits.owners][limits.sides[0]]
    gone = instant.find_sides(bare) @ load < -KEPT * limits.scales[limits.sides[0]]
    missed |= gone & np.isin(limits.sides[0], limits.of(*forces))
    return find_changes(limits, instant.find_sides(limits), missed, tau, much)


def _find_row(simulation: Simulation, index: int, contact: str, kind: str, time: float) -> int:
    """The row of a loss: the last one up to its time, or where the least force was seen."""
    rows = np.flatnonzero(simulation.phase == index)
    if kind == "thin":
        forces = simulation.c_n[rows, simulation.contacts.index(contact)]
        return int(rows[np.nanargmin(forces)])
    return int(rows[simulation.t[rows] <= time][-1])


def find_approach(problem: Problem, simulation: Simulation) -> Approach | None:
    """How near the last phase entered has come to its end; None if it ends by a release."""
    phase, scales = problem.phases[int(simulation.phase[-1])], problem.scene.scales
    rows = np.flatnonzero(simulation.phase == phase.index)
    t, v = simulation.t[rows], simulation.z_dot[rows]
    way = _measure_way(phase, simulation.z[rows], v)
    if way is None:
        return None
    is_angle = phase.until.coordinate == "phi"
    distance, gradient, _ = way
    rates = -np.einsum("ni,ni->n", gradient, v)
    least, time = find_lowest(t, distance, simulation.torque.breaks)
    going = np.flatnonzero(np.abs(rates) > TURNED * (1 / scales.time if is_angle else scales.speed))
    turns = going[np.flatnonzero(np.diff(np.sign(rates[going])))]
    return Approach(
        phase=phase.number,
        until=str(phase.until),
        distance=max(least, 0.0),
        unit="rad" if is_angle else "m",
        time=time,
        rate=float(np.interp(time, t, rates)) + 0.0,
        turns=tuple(float(t[row]) for row in turns),
    )


def _measure_way(phase: Phase, z: Array, v: Array) -> tuple[Array, Array, Array] | None:
    """Distance to the end of a phase at n states, its gradient, (n, 5), and its bend, (n,).

    The bend is what the velocity alone adds to its second derivative, towards the end.
    """
    until = phase.until
    if until.is_release:
        return None
    if until.contact is not None:
        at = Formation(phase.formation.scene, (until.contact,)).evaluate(z, v)
        return at.C[:, 0], at.A[:, 0], at.P_dot_v[:, 0]
    column = 0 if until.coordinate == "x" else 2
    assert until.value is not None
    offset = z[:, column] - until.value
    side = math.copysign(1.0, offset[0])
    gradient = np.zeros((len(z), 5))
    gradient[:, column] = side
    return side * offset, gradient, np.zeros(len(z))
