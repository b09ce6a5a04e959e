"""Least changes of the torques that prevent the contact losses of a replay.

In the state of a loss z'' and c are affine in the torques. A change holds from that instant on;
made earlier, it changes the motion up to there as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.limits import CONE, PRESS, LimitSet, make_limits
from ..mechanics.statics import Statics
from ..problem.definition import Phase, Problem
from ..results.report import Approach, ForceAt, Loss, PhaseReport, TorqueAdvice, TuningHelp
from ..simulation.events import EventKind, Simulation
from ..simulation.modes import Response, evaluate_rows, list_modes, list_units, respond
from ..simulation.rest import StartMode, find_rest
from .verdict import Allowance
from .verify import find_lowest

KEPT = 1e-9  # shortfall of a limit that counts as none, over the scale of it
FLAT = 1e-9
"""What a limit's slack changes with a torque below which it does not depend on it, in what is unit
for each."""
_TORQUES = ((0,), (1,), (0, 1))  # which torques change: one alone, or both
_KINDS = {EventKind.CONTACT_LOST: "lost", EventKind.SLIP: "slips"}


def find_help(
    problem: Problem, simulation: Simulation, phases: tuple[PhaseReport, ...], allowance: Allowance
) -> TuningHelp:
    """Losses with changes of the torques that prevent them, and the approach to a missed end."""
    rolling = [{own.name for own in phase.formation.rolling} for phase in problem.phases]
    events = [
        (event.phase, event.contact, _KINDS[event.kind], event.time)
        for event in simulation.events
        if event.kind is EventKind.CONTACT_LOST
        or (event.kind is EventKind.SLIP and event.contact in rolling[event.phase])
    ]
    ended = {event[:2] for event in events}
    allowed = allowance.measure_stray(problem)
    events += [
        (phase.number - 1, margin.contact, "thin", margin.time)
        for phase in phases
        for margin in phase.contacts
        if margin.margin < -allowed and (phase.number - 1, margin.contact) not in ended
    ]
    losses = (_examine_loss(problem, simulation, *event) for event in events)
    approach = None if simulation.outcome.reached else find_approach(problem, simulation)
    return TuningHelp(tuple(loss for loss in losses if loss is not None), approach)


def _examine_loss(
    problem: Problem, simulation: Simulation, index: int, contact: str, kind: str, time: float
) -> Loss | None:
    """A loss with changes that prevent it; None if the phase does not have the contact."""
    phase = problem.phases[index]
    formation = phase.formation
    if contact not in formation.names:
        return None
    row = _find_row(simulation, index, contact, kind, time)
    z, v, tau = simulation.z[row], simulation.z_dot[row], simulation.tau[row]
    load, epsilon = [1.0, *tau], max(problem.epsilon, 1e-3 * problem.scene.scales.force)
    distance = _measure_distance(phase, z[None], v[None])
    columns = [simulation.contacts.index(name) for name in formation.names]
    rests = bool(np.isnan(simulation.c_n[row, columns]).all())
    if rests:
        paths = find_rest(formation, z).modes
        free = [path for path in paths if path.slides(tau)]
        worst = min(free, key=lambda path: float((path.force_limits @ load).min()), default=None)
        response = None if worst is None else worst.response
        gradient = None if distance is None else distance[1][0]
        changes = find_resting_changes(formation, paths, epsilon, z, tau, gradient)
    else:
        response = find_moving(formation, z, v, tau, simulation.z_ddot[row])
        changes = () if response is None else list_changes(response, v, epsilon, contact, tau)
    forces: tuple[ForceAt, ...] = ()
    closing: tuple[float, ...] = ()
    if response is not None:
        forces = tuple(
            ForceAt(name, float(c_n @ load), float(c_t @ load), (float(c_n[1]), float(c_n[2])))
            for name, c_n, c_t in zip(formation.names, response.c, response.c_t, strict=False)
        )
    if response is not None and distance is not None:
        rows = -distance[1][0] @ response.acceleration
        closing = (float(rows @ load - distance[2][0]), float(rows[1]), float(rows[2]))
    when = float(simulation.t[row])
    return Loss(phase.number, contact, kind, when, rests, forces, closing, changes)


def list_changes(
    response: Response, v: Array, epsilon: float, contact: str, tau: Array
) -> tuple[TorqueAdvice, ...]:
    """Least changes of each torque alone that a moving contact is kept with, or of both.

    Both change if one alone misses other limits. What lets go with the contact is kept, too; what
    other limits miss already they must not miss by more.
    """
    formation = response.mode.formation
    unit, load = formation.scene.scales.torque, np.array([1.0, *tau])
    limits, bare = make_limits(formation, epsilon), make_limits(formation, 0.0)
    rows, forces = limits.sides[0], (PRESS, CONE)
    owners, scale = limits.owners[rows], limits.scales[rows]
    own = [limit.part == contact and limit.kind in forces for limit in limits.limits]
    gone = find_sides(bare, response, v) @ load < -KEPT * scale
    missed = np.array(own)[owners] | (gone & np.isin(rows, limits.of(*forces)))
    slack, slope = normalise(find_sides(limits, response, v), scale, tau, unit)
    slack = np.where(missed, slack, np.maximum(slack, 0.0))

    def describe(change: Array) -> TorqueAdvice:
        short = -(slack + slope @ change)
        worst, but = int(short.argmax()), ""
        if short[worst] > KEPT:
            limit = limits.limits[owners[worst]]
            but = f"{limit.text} is {short[worst] * scale[worst]:.3g} {limit.unit} short"
        return make_advice(unit * change, tau, but)

    short = slack < 0
    # A change of one torque may miss others, and is then told with them.
    singles = [find_least_change(slack[short], slope[short], one) for one in _TORQUES[:2]]
    changes = [describe(one) for one in singles if one is not None]
    both = None
    if all(change.but for change in changes):
        both = find_least_change(slack, slope, _TORQUES[2])
    changes += [] if both is None else [describe(both)]
    return tuple(sorted(changes, key=lambda change: (bool(change.but), np.hypot(*change.change))))


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
    distance = _measure_distance(phase, simulation.z[rows], v)
    if distance is None:
        return None
    is_angle = phase.until.coordinate == "phi"
    gaps, gradient, _ = distance
    rates = -np.einsum("ni,ni->n", gradient, v)
    least, time = find_lowest(t, gaps)
    unit = scales.rate if is_angle else scales.speed
    going = np.flatnonzero(np.abs(rates) > 1e-6 * unit)
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


def _measure_distance(phase: Phase, z: Array, v: Array) -> tuple[Array, Array, Array] | None:
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


def find_resting_changes(
    formation: Formation,
    paths: Sequence[StartMode],
    epsilon: float,
    z: Array,
    tau: Array,
    gradient: Array | None,
) -> tuple[TorqueAdvice, ...]:
    """Least changes of each torque alone, or else of both, that let it keep its contacts.

    With them it begins to move towards the end of its phase, or if that cannot be it rests.

    Parameters
    ----------
    paths             directions in which the formation could begin to move
    epsilon : [N]
    z : (5,)
    tau : (2,) [N m]
    gradient : (5,)   of the distance to the end of the phase, if that is known
    """
    limits, unit = make_limits(formation, epsilon), formation.scene.scales.torque
    starts = list[tuple[StartMode, tuple[Array, Array]]]()
    for path in paths:
        towards = [] if gradient is None else [-gradient @ path.response.acceleration]
        rows = np.vstack([path.margins, *towards])
        sizes = np.abs(rows) @ [1.0, unit, unit]
        scale = [limits.scales[limits.sides[0]], np.where(sizes > 0, sizes, 1.0)]
        sides = np.vstack([find_sides(limits, path.response, np.zeros(5)), rows])
        starts.append((path, normalise(sides, np.concatenate(scale), tau, unit)))
    changes: list[TorqueAdvice] = []
    for free in _TORQUES:
        if len(free) == 2 and changes:
            break
        found = ((path, find_least_change(*sides, free)) for path, sides in starts)
        least = [(path, unit * one) for path, one in found if one is not None]
        moved = [change for path, change in least if path.moves(tau + change)]
        held = None if moved else Statics(formation, z).find_holding_change(tau, epsilon, free)
        if moved:
            changes.append(make_advice(min(moved, key=np.linalg.norm), tau))
        elif held is not None:
            changes.append(make_advice(held, tau, holds=True))
    return tuple(sorted(changes, key=lambda change: (change.holds, np.hypot(*change.change))))


def find_sides(limits: LimitSet, response: Response, v: Array) -> Array:
    """Slack of one-sided limits at velocity v, (5,), rows @ (1, tau_1, tau_2), (n_sides, 3)."""
    formation = response.mode.formation
    of_c, of_tau, of_rates = limits.columns
    rolling = response.c_t[list(formation.rolling_rows)]
    values = of_c @ np.vstack([response.c[: formation.n_contacts], rolling])
    values[:, 1:] += of_tau
    values[:, 0] += of_rates @ v[3:]
    rows, signs, bounds = limits.sides
    sides = np.asarray(signs[:, None] * values[rows])
    sides[:, 0] -= signs * bounds
    return sides


def find_moving(
    formation: Formation, z: Array, v: Array, tau: Array, acceleration: Array
) -> Response | None:
    """The mode of a motion; where something stands still, with the friction that it had.

    That is the friction with which torques `tau` give the recorded `acceleration`, shape (5,).
    """
    scene, rows = formation.scene, evaluate_rows(formation, z, v)
    speeds = np.concatenate([rows.A_t @ v, v[3:]])
    units = np.repeat([scene.scales.speed, scene.scales.rate], [formation.n_contacts, 2])
    slow = np.abs(speeds) < 1e-6 * units
    signs = np.sign(speeds)
    signs[list(formation.rolling_rows)] = 0.0
    still = [unit for unit in list_units(formation) if slow[list(unit.rows)].all()]
    holds = formation.n_constraints < 4
    options = [(1.0, -1.0, 0.0) if holds and unit.grips else (1.0, -1.0) for unit in still]
    modes = list_modes(formation, signs, still, options)
    tried = (respond(mode, own, rows, v) for own, mode in modes)

    def misfit(response: Response) -> float:
        off = response.acceleration @ [1.0, *tau] - acceleration
        return float(scene.mass_diagonal @ off**2)

    return min((one for one in tried if one is not None), key=misfit, default=None)


def normalise(sides: Array, scale: Array, tau: Array, unit: float) -> tuple[Array, Array]:
    """Slack under torques `tau` and its slope, (n,) and (n, 2), in the scale of each."""
    slack = sides @ np.array([1.0, *tau]) / scale
    return np.asarray(slack), sides[:, 1:] * (unit / scale)[:, None]


def make_advice(change: Array, tau: Array, but: str = "", holds: bool = False) -> TorqueAdvice:
    """A change of torques `tau`, shape (2,) [N m]."""
    (first, second), (one, other) = change.tolist(), (tau + change).tolist()
    return TorqueAdvice((first, second), (one, other), but, holds)


def find_least_change(slack: Array, slope: Array, free: tuple[int, ...]) -> Array | None:
    """The shortest change of the torques `free`, (2,), with slack + slope @ change >= 0, or None.

    It is zero, on a side, or in a corner of two sides.
    """
    steep = slope * np.isin([0, 1], free)
    sizes = np.linalg.norm(steep, axis=1)
    used = sizes > FLAT
    normal, reach = steep[used] / sizes[used, None], slack[used] / sizes[used]
    found = [np.zeros(2), *(-reach[:, None] * normal)]
    for i, j in combinations(range(len(reach)), 2):
        pair = normal[[i, j]]
        if abs(np.linalg.det(pair)) > FLAT:
            found.append(np.linalg.solve(pair, -reach[[i, j]]))
    kept = [change for change in found if (slack + steep @ change >= -KEPT).all()]
    return min(kept, key=np.linalg.norm, default=None)
