"""Torques at ends at rest: changes between phases under rate limits and lag, and dwells.

Equations and rules are in the README. Torques that change in a pause hold the object throughout if
the first and the last ones do, as balanced forces within their cones are a convex set. Dwells press
all contacts together (`simulation.modes`); how soon they close depends on impacts, which are
simulated without assumptions on contacts.
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
from ..simulation.system import SLOW, build_system
from .options import PlanOptions
from .path_domain.path_data import PhaseData, prepare
from .path_domain.path_mesh import make_grid
from .phase_plan import PhasePlan, Plans, combine, end_of, value_of


class Junction(NamedTuple):
    """Torques between two phases, and internal forces [N] on both sides.

    Internal forces are NaN for phases planned in the time domain.
    """

    ends: float
    begins: float
    change: TorqueChange


def choose_junction(
    ending: Curve | Array, beginning: Curve | Formation, z: Array, epsilon: float, phase: int
) -> Junction:
    """The torques that change in the least time where phase number `phase` begins.

    Parameters
    ----------
    ending : (2,) [N m]  curve that ends, or final torques of a phase planned in the time domain
    beginning            curve that begins, or its formation in the time domain: then the final
                         torques before are those that friction holds with the largest margin

    Where none of the torques hold the object in the formation that begins, contacts that it does
    not have any more help to hold it until the motion begins. InfeasibleError if no torques hold
    the object at one of the two ends.
    """
    if isinstance(ending, Curve):
        before, ends = _list_torques(ending, epsilon, phase - 1, -1)
    else:
        before, ends = ending[None], np.full(1, np.nan)
    formation = beginning.formation if isinstance(beginning, Curve) else beginning
    scene, static = formation.scene, Statics(formation, z).torque_polygon()
    beyond = static.measure(before)
    held = beyond <= 1e-6 * scene.scales.torque  # rounding
    if not held.any():
        held = beyond <= beyond.min()
    if not isinstance(beginning, Curve):
        firmest = int(beyond.argmin())
        still = change_torques(scene, before[firmest], before[firmest])
        return Junction(float(ends[firmest]), np.nan, still)
    after, begins = _list_torques(beginning, epsilon, phase, 0)
    times = find_change_times(scene, before[held][:, None], after[None])
    p, q = np.unravel_index(int(times.argmin()), times.shape)
    change = change_torques(scene, before[held][p], after[q])
    return Junction(float(ends[held][p]), float(begins[q]), change)


def _list_torques(curve: Curve, epsilon: float, phase: int, place: int) -> tuple[Array, Array]:
    """Torques at an end of a curve at the limit of rest, (n, 2) [N m], and internal forces [N]."""
    data = prepare(curve, epsilon, make_grid(curve, np.zeros(0), 3, held=True), phase)  # ends count
    low, high = require_hold(data, phase, place)
    high = min(high, low + 40.0 * curve.formation.scene.scales.force)  # the widest range
    lams = low + np.linspace(0.01, 0.99, 129) * (high - low)  # those to try
    of_tau = data.of_tau[place]
    return of_tau[:, ONE] + np.outer(lams, of_tau[:, LAMBDA]), lams


def require_hold(data: PhaseData, phase: int, place: int) -> tuple[float, float]:
    """The range of internal forces that hold the object at an end of a phase [N], or an error."""
    still = np.zeros_like(data.grid.s)
    bounds = data.find_limits(data.nodes).find_internal_force_range(still, still)
    low, high = (float(bound[place]) for bound in bounds)
    if low <= high:
        return low, high
    where = "end" if place else "start"
    raise InfeasibleError(
        f"phase {phase}: torques may not step, and within the limits none hold the object at rest "
        f"at its {where}, on the verge of the motion; leave out torque_rate_limit and actuator_lag"
    )


def add_pause(
    plan: PhasePlan[Motion], change: TorqueChange, formation: Formation, options: PlanOptions
) -> PhasePlan[Motion]:
    """The plan of a phase with the pause before it in which torques change."""
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


def begin_from(plan: PhasePlan[Motion], formation: Formation, before: Array) -> PhasePlan[Motion]:
    """The plan of a phase with other torques before it, shape (2,) [N m], and the pause from them.

    Its value stays as it is.
    """
    if isinstance(motion := plan.motion, HeldMotion):
        torque = plan.torque.cut(motion.begin, float(plan.torque.breaks[-1]))
        torque = TorqueProfile(torque.breaks - motion.begin, torque.coefficients)
        plan = plan._replace(motion=motion.motion, torque=torque)
    change = change_torques(formation.scene, before, plan.end_torques[0])
    # Other contacts than the phase's may help to hold the object until it moves.
    forces = np.full((2, formation.n_contacts), np.nan)
    return _pause(plan, change, forces) if change.duration else plan


class DwellEnd(NamedTuple):
    """A dwell at an end at rest."""

    place: Standstill
    time: float  # [s]
    hold: Hold | None  # None if no torques hold it
    firm: bool  # whether torques are of the largest margin, also if they do not close gaps


def settle_plans(problem: Problem, plans: Plans) -> Plans:
    """The plans with the dwells that the problem asks for where phases come to rest."""
    places = list[Standstill | None]()  # where phases come to rest
    for phase, plan in zip(problem.phases, plans, strict=True):
        z, v = end_of(plan)
        slow = build_system(problem.scene).is_slower(v, SLOW)
        places.append(find_standstill(problem, phase, z) if slow else None)
    if problem.settle_share:
        ends = share_time(problem, plans, places)
    else:
        times = [problem.settles(phase) or 0.0 for phase in problem.phases]
        ends = find_ends(problem, places, times)
    held, whole = hold_plans(problem, plans, ends), sum(plan.motion.duration for plan in plans)
    return [
        plan if end is None else plan._replace(settling=_describe(problem, phase, end, whole))
        for plan, phase, end in zip(held, problem.phases, ends, strict=True)
    ]


def find_ends(
    problem: Problem,
    places: Sequence[Standstill | None],
    times: Sequence[float],
    firm: bool = False,
) -> list[DwellEnd | None]:
    """Dwells of given times [s] at ends at rest; None for all others."""

    def hold(place: Standstill) -> Hold | None:
        goal = place._replace(gained=None) if firm else place
        return find_hold(goal, problem.epsilon, problem.gap)

    pairs = zip(places, times, strict=True)
    return [DwellEnd(p, t, hold(p), firm) if p and t > 0 else None for p, t in pairs]


def hold_plans(problem: Problem, plans: Plans, ends: Sequence[DwellEnd | None]) -> Plans:
    """The plans with dwells; rate-limited torques change to those of the dwell and back."""
    held: Plans = []
    before: Array | None = None
    for phase, plan, end in zip(problem.phases, plans, ends, strict=True):
        if before is not None and problem.scene.has_slow_motors:
            plan = begin_from(plan, phase.formation, before)
        before = end.hold.tau if end is not None and end.hold is not None else None
        if end is not None and before is not None:
            dwell = TorqueProfile(np.array([0.0, end.time]), before[None, :, None])
            if problem.scene.has_slow_motors:
                change = change_torques(problem.scene, plan.end_torques[1], before)
                dwell = TorqueProfile.chain([change.torque, dwell]) if change.duration else dwell
            motion = plan.motion if isinstance(plan.motion, HeldMotion) else HeldMotion(plan.motion)
            torque = TorqueProfile.chain([plan.torque, dwell])
            plan = plan._replace(motion=replace(motion, dwell=dwell), torque=torque)
        held.append(plan)
    return held


def _describe(problem: Problem, phase: Phase, end: DwellEnd, whole: float) -> Settling:
    """How the end of a phase is held, of a motion that lasts `whole` without dwells [s]."""
    place, time, hold, firm = end
    if hold is None:
        text = f"no torques hold {' '.join(place.touching.names)} at the end of phase"
        warning = f"{text} {phase.number} with c_n >= epsilon"
        return Settling(phase.number, 0.0, (0.0, 0.0), 0.0, warning=warning)
    (first, second), tau = hold.tau.tolist(), hold.tau[None, :, None]
    settling = Settling(phase.number, time, (first, second), hold.margin, share=time / whole)
    opening = find_opening(place)
    if opening is None or place.gained is None:
        return settling
    # From rest where the contact is still open.
    closes, left, torque = None, problem.gap, TorqueProfile(np.array([0.0, time]), tau)
    with suppress(SimulationError, ArithmeticError):
        z = require_closed(place.formation, place.z + problem.gap * opening)
        run = simulate_free(problem, torque, start=z)
        gaps = np.abs(place.touching.evaluate(run.z, run.z_dot).C).max(axis=1)
        still = np.flatnonzero(gaps > 0.01 * problem.gap)  # relative gap that counts as closed
        last, left = int(still[-1]) + 1 if len(still) else 0, float(gaps[-1])
        closes = float(run.t[last]) if last < len(run.t) else None
    name, text = place.gained.name, f"that hold the end of phase {phase.number}"
    text = "" if hold.speed or firm else f"no torques {text} would drive it on to {name}"
    settling = settling._replace(speed=hold.speed, parts=hold.parts, warning=text)
    return settling._replace(contact=name, gap=problem.gap, closes=closes, left=left)


# Dwell times of the first end that gains a contact and of the plan's last end, over those of the
# other ends that gain one, and `DwellEnd.firm`, in the order in which they are tried.
ALLOCATIONS = (
    (2.0, 1.0, True),
    (0.0, 0.0, True),  # heptagon at 5 %
    (0.0, 0.0, False),  # heptagon_twice at 5 %
)
STOP = 0.06  # relative dwell time of an end that gains no contact


def share_time(
    problem: Problem, plans: Plans, places: Sequence[Standstill | None]
) -> list[DwellEnd | None]:
    """Dwells by the first allocation with a final error within `problem.gap`, or the best one.

    Simulated with the plan's torques from the exact start and from it moved by the gap either way.
    """
    times = [problem.settles(phase) for phase in problem.phases]
    whole = problem.settle_share * sum(plan.motion.duration for plan in plans)
    best, least = list[DwellEnd | None](), math.inf
    for first, last, firm in ALLOCATIONS:
        weights, gained = np.zeros(len(times)), 0
        for k, place in enumerate(places):
            if place is None or times[k] is not None:
                continue
            closes = find_opening(place) is not None
            weights[k] = (1.0 if gained else first) if closes else STOP
            gained += closes
        if gained > 1:
            weights[-1] *= last
        shares = whole * weights / max(float(weights.sum()), STOP**2)
        pairs = zip(shares.tolist(), times, strict=True)
        allotted = [share if time is None else time for share, time in pairs]
        ends = find_ends(problem, places, allotted, firm)
        off = measure_off(problem, plans, ends) if any(ends) else 0.0
        if not best or off < 0.8 * least:  # a later one has to be better by a fifth
            best, least = ends, off
        if least <= problem.gap:
            break
    return best


def measure_off(problem: Problem, plans: Plans, ends: Sequence[DwellEnd | None]) -> float:
    """Largest final error of plans with dwells [m], angles times the scene's length."""
    torque = TorqueProfile.chain([plan.torque for plan in hold_plans(problem, plans, ends)])
    goal, length = end_of(plans[-1])[0], problem.scene.scales.length
    most = 0.0
    for off in (0.0, problem.gap, -problem.gap):
        try:
            z = simulate_free(problem, torque, start=move_start(problem, off)).z[-1]
        except (WholearmError, ArithmeticError):
            return math.inf
        most = max(most, float(np.linalg.norm((z - goal)[:3] * [1.0, 1.0, length])))
    return most


def move_start(problem: Problem, off: float) -> Array | None:
    """The start moved along the palm by `off` [m], with the fingers closed; None for none."""
    if not off:
        return None
    q = problem.start[:3] + np.array([off, 0.0, 0.0])
    return np.array([*q, *(close_finger(problem.scene, q, finger) for finger in (0, 1))])
