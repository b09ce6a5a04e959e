"""Torques at ends at rest: changes between phases under rate limits and lag, and dwells.

Equations and rules are in the README. Torques that change in a pause hold the object throughout if
the first and the last ones do, since balanced forces within their cones are a convex set. Dwells
press all contacts together (`simulation.modes`). The time of closing depends on impacts, which are
simulated without prescribed contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InfeasibleError, SimulationError, WholearmError
from ..contacts.closing import close_finger
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..mechanics.dynamics import LAMBDA, ONE
from ..mechanics.statics import Statics
from ..problem.definition import Phase, Problem
from ..results.dwell_record import (
    HeldMotion,
    Settling,
    TorqueChange,
    change_torques,
    find_change_times,
)
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion
from ..simulation.modes import (
    Hold,
    Standstill,
    find_hold,
    find_opening,
    find_standstill,
    require_closed,
)
from ..simulation.simulate import simulate_free
from ..simulation.system import REST_SPEED, build_system
from .options import PlanOptions
from .path_domain.path_data import PhaseData, prepare
from .path_domain.path_mesh import make_grid
from .phase_plan import PhasePlan, Plans, combine, end_of, value_of


class Junction(NamedTuple):
    """Torque change between two phases, and internal forces [N] at both ends of it.

    Internal forces are NaN for phases planned in the time domain.
    """

    end_force: float
    start_force: float
    change: TorqueChange


def choose_junction(
    ending: Curve | Array, beginning: Curve | Formation, z: Array, epsilon: float, phase: int
) -> Junction:
    """The fastest torque change at rest, from feasible torques before phase `phase` to those after.

    Parameters
    ----------
    ending : (2,) [N m]  curve that ends, or final torques of a phase planned in the time domain
    beginning            curve that begins, or its formation in the time domain: then the final
                         torques are those that friction holds with the largest margin

    Where no final torques hold the object in the formation that begins, released contacts help to
    hold it until the motion begins. InfeasibleError if no torques hold the object at one end.
    """
    if isinstance(ending, Curve):
        end_torques, end_forces = _list_torques(ending, epsilon, phase - 1, -1)
    else:
        end_torques, end_forces = ending[None], np.full(1, np.nan)
    formation = beginning.formation if isinstance(beginning, Curve) else beginning
    scene, static = formation.scene, Statics(formation, z).torque_polygon()
    excess = static.measure(end_torques)
    feasible = excess <= 1e-6 * scene.scales.torque  # rounding
    if not feasible.any():
        feasible = excess <= excess.min()
    if not isinstance(beginning, Curve):
        best = int(excess.argmin())
        constant = change_torques(scene, end_torques[best], end_torques[best])
        return Junction(float(end_forces[best]), np.nan, constant)
    start_torques, start_forces = _list_torques(beginning, epsilon, phase, 0)
    times = find_change_times(scene, end_torques[feasible][:, None], start_torques[None])
    p, q = np.unravel_index(int(times.argmin()), times.shape)
    change = change_torques(scene, end_torques[feasible][p], start_torques[q])
    return Junction(float(end_forces[feasible][p]), float(start_forces[q]), change)


def _list_torques(curve: Curve, epsilon: float, phase: int, node: int) -> tuple[Array, Array]:
    """Torques of impending motion at an end of a curve, (n, 2) [N m], and internal forces [N]."""
    data = prepare(curve, epsilon, make_grid(curve, np.zeros(0), 3, held=True), phase)  # ends count
    low, high = require_hold(data, phase, node)
    high = min(high, low + 40.0 * curve.formation.scene.scales.force)  # the widest range
    lam = low + np.linspace(0.01, 0.99, 129) * (high - low)  # candidates
    of_tau = data.of_tau[node]
    return of_tau[:, ONE] + np.outer(lam, of_tau[:, LAMBDA]), lam


def require_hold(data: PhaseData, phase: int, node: int) -> tuple[float, float]:
    """The range of internal forces that hold the object at an end of a phase [N], or an error."""
    zero = np.zeros_like(data.grid.s)
    bounds = data.find_limits(data.nodes).find_internal_force_range(zero, zero)
    low, high = (float(bound[node]) for bound in bounds)
    if low <= high:
        return low, high
    where = "end" if node else "start"
    raise InfeasibleError(
        f"phase {phase}: torques may not step, and within the limits none hold the object at rest "
        f"at its {where}, on the verge of the motion; leave out torque_rate_limit and actuator_lag"
    )


def add_pause(
    plan: PhasePlan[Motion], change: TorqueChange, formation: Formation, options: PlanOptions
) -> PhasePlan[Motion]:
    """The plan of a phase with a pause before it, in which torques change."""
    if not change.duration:
        return plan
    z = plan.motion.evaluate(np.zeros(1)).z[0]
    forces = Statics(formation, z).find_firmest_forces(change.before)
    pause = value_of(options, change.duration, change.torque, float(forces[0].min()))
    value = combine(options.goal, [plan.value, pause])
    return _pause(plan, change, forces)._replace(value=value)


def _pause(plan: PhasePlan[Motion], change: TorqueChange, forces: Array) -> PhasePlan[Motion]:
    motion = HeldMotion(plan.motion, change, forces)
    return plan._replace(motion=motion, torque=TorqueProfile.chain([change.torque, plan.torque]))


def begin_from(plan: PhasePlan[Motion], formation: Formation, tau: Array) -> PhasePlan[Motion]:
    """The plan of a phase with a pause in which torques change from `tau`, shape (2,) [N m].

    Its value stays the same.
    """
    if isinstance(motion := plan.motion, HeldMotion):
        torque = plan.torque.cut(motion.begin, float(plan.torque.breaks[-1]))
        torque = TorqueProfile(torque.breaks - motion.begin, torque.coefficients)
        plan = plan._replace(motion=motion.motion, torque=torque)
    change = change_torques(formation.scene, tau, plan.end_torques[0])
    # Other contacts than the phase's may help to hold the object until it moves.
    forces = np.full((2, formation.n_contacts), np.nan)
    return _pause(plan, change, forces) if change.duration else plan


class DwellEnd(NamedTuple):
    """A dwell at an end at rest."""

    place: Standstill
    time: float  # [s]
    hold: Hold | None  # None if no torques hold it
    max_margin: bool  # whether torques have the largest margin, whether or not they close gaps


def settle_plans(problem: Problem, plans: Plans) -> Plans:
    """The plans with the problem's dwells where phases come to rest."""
    places = list[Standstill | None]()  # where phases come to rest
    for phase, plan in zip(problem.phases, plans, strict=True):
        z, v = end_of(plan)
        at_rest = build_system(problem.scene).is_slower(v, REST_SPEED)
        places.append(find_standstill(problem, phase, z) if at_rest else None)
    if problem.settle_share:
        ends = share_time(problem, plans, places)
    else:
        times = [problem.settles(phase) or 0.0 for phase in problem.phases]
        ends = find_ends(problem, places, times)
    held, duration = hold_plans(problem, plans, ends), sum(plan.motion.duration for plan in plans)
    return [
        plan if end is None else plan._replace(settling=_describe(problem, phase, end, duration))
        for plan, phase, end in zip(held, problem.phases, ends, strict=True)
    ]


def find_ends(
    problem: Problem,
    places: Sequence[Standstill | None],
    times: Sequence[float],
    max_margin: bool = False,
) -> list[DwellEnd | None]:
    """Dwells with times [s] at ends at rest; None for other ends."""

    def hold(place: Standstill) -> Hold | None:
        target = place._replace(gained=None) if max_margin else place
        return find_hold(target, problem.epsilon, problem.gap)

    pairs = zip(places, times, strict=True)
    return [DwellEnd(p, t, hold(p), max_margin) if p and t > 0 else None for p, t in pairs]


def hold_plans(problem: Problem, plans: Plans, ends: Sequence[DwellEnd | None]) -> Plans:
    """The plans with dwells; rate-limited torques change continuously to the dwell and back."""
    held: Plans = []
    tau: Array | None = None
    for phase, plan, end in zip(problem.phases, plans, ends, strict=True):
        if tau is not None and problem.scene.has_slow_motors:
            plan = begin_from(plan, phase.formation, tau)
        tau = end.hold.tau if end is not None and end.hold is not None else None
        if end is not None and tau is not None:
            dwell = TorqueProfile(np.array([0.0, end.time]), tau[None, :, None])
            if problem.scene.has_slow_motors:
                change = change_torques(problem.scene, plan.end_torques[1], tau)
                dwell = TorqueProfile.chain([change.torque, dwell]) if change.duration else dwell
            motion = plan.motion if isinstance(plan.motion, HeldMotion) else HeldMotion(plan.motion)
            torque = TorqueProfile.chain([plan.torque, dwell])
            plan = plan._replace(motion=replace(motion, dwell=dwell), torque=torque)
        held.append(plan)
    return held


def _describe(problem: Problem, phase: Phase, end: DwellEnd, duration: float) -> Settling:
    """Record of a dwell, of a motion whose duration without dwells is `duration` [s]."""
    place, time, hold, max_margin = end
    if hold is None:
        text = f"no torques hold {' '.join(place.touching.names)} at the end of phase"
        warning = f"{text} {phase.number} with c_n >= epsilon"
        return Settling(phase.number, 0.0, (0.0, 0.0), 0.0, warning=warning)
    (first, second), tau = hold.tau.tolist(), hold.tau[None, :, None]
    settling = Settling(phase.number, time, (first, second), hold.margin, share=time / duration)
    opening = find_opening(place)
    if opening is None or place.gained is None:
        return settling
    # Simulation from rest with the contact open.
    closes, gap, torque = None, problem.gap, TorqueProfile(np.array([0.0, time]), tau)
    with suppress(SimulationError, ArithmeticError):
        z = require_closed(place.formation, place.z + problem.gap * opening)
        run = simulate_free(problem, torque, start=z)
        gaps = np.abs(place.touching.evaluate(run.z, run.z_dot).C).max(axis=1)
        rows = np.flatnonzero(gaps > 0.01 * problem.gap)  # relative gap that counts as closed
        last, gap = int(rows[-1]) + 1 if len(rows) else 0, float(gaps[-1])
        closes = float(run.t[last]) if last < len(run.t) else None
    name, text = place.gained.name, f"that hold the end of phase {phase.number}"
    text = "" if hold.speed or max_margin else f"no torques {text} would drive it on to {name}"
    settling = settling._replace(speed=hold.speed, parts=hold.parts, warning=text)
    return settling._replace(contact=name, gap=problem.gap, closes=closes, left=gap)


# Allocations in their order: dwell times of the first end that gains a contact and of the plan's
# last end, over those of other ends that gain one, and `DwellEnd.max_margin`.
ALLOCATIONS = (
    (2.0, 1.0, True),
    (0.0, 0.0, True),  # heptagon at 5 %
    (0.0, 0.0, False),  # heptagon_twice at 5 %
)
STOP_WEIGHT = 0.06  # relative dwell time of an end that gains no contact


def share_time(
    problem: Problem, plans: Plans, places: Sequence[Standstill | None]
) -> list[DwellEnd | None]:
    """Dwells by the first allocation with a final error within `problem.gap`, or the best one.

    The plan's torques are simulated from the exact start, and from it moved by the gap either way.
    """
    times = [problem.settles(phase) for phase in problem.phases]
    total = problem.settle_share * sum(plan.motion.duration for plan in plans)
    best, least_error = list[DwellEnd | None](), math.inf
    for first, last, max_margin in ALLOCATIONS:
        weights, gained = np.zeros(len(times)), 0
        for k, place in enumerate(places):
            if place is None or times[k] is not None:
                continue
            has_gap = find_opening(place) is not None
            weights[k] = (1.0 if gained else first) if has_gap else STOP_WEIGHT
            gained += has_gap
        if gained > 1:
            weights[-1] *= last
        durations = total * weights / max(float(weights.sum()), STOP_WEIGHT**2)
        pairs = zip(durations.tolist(), times, strict=True)
        dwell_times = [duration if time is None else time for duration, time in pairs]
        ends = find_ends(problem, places, dwell_times, max_margin)
        error = measure_final_error(problem, plans, ends) if any(ends) else 0.0
        if not best or error < 0.8 * least_error:  # a later one has to be better by a fifth
            best, least_error = ends, error
        if least_error <= problem.gap:
            break
    return best


def measure_final_error(problem: Problem, plans: Plans, ends: Sequence[DwellEnd | None]) -> float:
    """Largest final error of plans with dwells [m], angles times the scene's length."""
    torque = TorqueProfile.chain([plan.torque for plan in hold_plans(problem, plans, ends)])
    goal, length = end_of(plans[-1])[0], problem.scene.scales.length
    largest = 0.0
    for offset in (0.0, problem.gap, -problem.gap):
        try:
            z = simulate_free(problem, torque, start=move_start(problem, offset)).z[-1]
        except (WholearmError, ArithmeticError):
            return math.inf
        largest = max(largest, float(np.linalg.norm((z - goal)[:3] * [1.0, 1.0, length])))
    return largest


def move_start(problem: Problem, offset: float) -> Array | None:
    """The start moved along the palm by `offset` [m], with the fingers closed; None without one."""
    if not offset:
        return None
    q = problem.start[:3] + np.array([offset, 0.0, 0.0])
    return np.array([*q, *(close_finger(problem.scene, q, finger) for finger in (0, 1))])
