"""Ends of phases held by constant torques, after their blocks are planned.

Where a phase stops, its plan is only as good as the place where it does: a little short of the
contact that is gained there, the next phase's torques set off in another formation. Held for a
while by torques that push everything together (`mechanics.arrival`), the contact closes first. How
soon it does hangs on the impacts on the way: that is simulated from where the contact is still
open, without telling which contacts hold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import SimulationError, WholearmError
from ..contacts.closing import close_finger
from ..contacts.formation import Formation
from ..free_simulation.free_simulate import simulate_free
from ..mechanics.arrival import Hold, Standstill, find_hold, find_opening
from ..problem.definition import Phase, Problem
from ..results.dwell_record import SettledMotion, Settling
from ..results.torque import TorqueProfile
from ..results.torque_change import change_torques
from ..results.trajectory import Motion
from ..scene.model import Scene
from ..simulation.sticking import close_contacts
from ..simulation.tolerances import SLOW, is_slower
from .path_domain.junction import begin_from
from .phase_plan import PhasePlan, Settled
from .stops import Plans, end_of

CLOSED = 0.01  # what is left of a gap that counts as closed, over the gap


class DwellEnd(NamedTuple):
    """An end at rest that is held."""

    place: Standstill
    time: float  # [s]
    hold: Hold | None  # none if no torques hold it
    firm: bool  # whether they are the firmest ones, whether or not they drive on what is still open


class _Trial(NamedTuple):
    """What torques do from where the contact is still open."""

    # [s]: from when on everything is closed; None if something is open at the end
    closes: float | None
    left: float  # [m]: largest gap at the end


def settle_plans(problem: Problem, plans: Plans) -> Settled:
    """Hold the ends of those phases that come to rest and are to be held."""
    if problem.settle_share:
        ends = share_time(problem, plans)
    else:
        ends = find_ends(problem, plans, [problem.settles(own) or 0.0 for own in problem.phases])
    numbered = zip(problem.phases, ends, strict=True)
    settlings = [None if end is None else _describe(problem, phase, end) for phase, end in numbered]
    return Settled(hold_plans(problem, plans, ends), tuple(settlings))


def find_places(problem: Problem, plans: Plans) -> list[Standstill | None]:
    """Where phases come to rest; None for those that do not."""
    found = list[Standstill | None]()
    for phase, plan in zip(problem.phases, plans, strict=True):
        z, v = end_of(plan)
        touching = list_touching(problem, phase)
        place = Standstill(z, phase.formation, phase.until.contact, touching)
        found.append(place if is_slower(problem.scene, v, SLOW) else None)
    return found


def find_ends(
    problem: Problem, plans: Plans, times: Sequence[float], firm: bool = False
) -> list[DwellEnd | None]:
    """Torques for ends at rest that are held for some time [s]; None for all others."""
    found = list[DwellEnd | None]()
    for place, time in zip(find_places(problem, plans), times, strict=True):
        if place is None or time <= 0:
            found.append(None)
            continue
        goal = place._replace(gained=None) if firm else place
        found.append(
            DwellEnd(place, time, find_hold(goal, problem.epsilon, problem.gap, time), firm)
        )
    return found


def hold_plans(problem: Problem, plans: Plans, ends: Sequence[DwellEnd | None]) -> Plans:
    """The plans with their ends held; torques that may not step change to what holds and back."""
    held: Plans = []
    before: Array | None = None
    for phase, plan, end in zip(problem.phases, plans, ends, strict=True):
        if before is not None and problem.scene.has_slow_motors:
            plan = begin_from(plan, phase.formation, before)
        held.append(_hold(problem.scene, plan, end))
        before = end.hold.tau if end is not None and end.hold is not None else None
    return held


def _hold(scene: Scene, plan: PhasePlan[Motion], end: DwellEnd | None) -> PhasePlan[Motion]:
    if end is None or end.hold is None:
        return plan
    change, ramp = None, 0.0
    if scene.has_slow_motors:
        change = change_torques(scene, plan.torque.at(plan.torque.breaks[-1:])[0], end.hold.tau)
        ramp = change.duration
    motion = SettledMotion(plan.motion, ramp + end.time, end.hold.tau, change)
    torque = TorqueProfile.chain([plan.torque, motion.torque])
    return plan._replace(motion=motion, torque=torque)


def _describe(problem: Problem, phase: Phase, end: DwellEnd) -> Settling:
    place, time, hold, firm = end
    if hold is None:
        text = f"no torques hold {' '.join(place.touching.names)} at the end of phase"
        warning = f"{text} {phase.number} with c_n >= epsilon"
        return Settling(phase.number, 0.0, (0.0, 0.0), 0.0, warning=warning)
    first, second = hold.tau.tolist()
    settling = Settling(phase.number, time, (first, second), hold.margin)
    trial = _close(problem, place, hold, time)
    if trial is None or place.gained is None:
        return settling
    name, text = place.gained.name, f"that hold the end of phase {phase.number}"
    return settling._replace(
        contact=name,
        gap=problem.gap,
        closes=trial.closes,
        left=trial.left,
        speed=hold.speed,
        parts=hold.parts,
        warning="" if hold.speed or firm else f"no torques {text} would drive it on to {name}",
    )


def _close(problem: Problem, place: Standstill, hold: Hold, time: float) -> _Trial | None:
    """Simulate torques from rest where the contact is still open, free of assumptions, if any is.

    None if there is none.
    """
    opening = find_opening(place)
    if opening is None:
        return None
    torque = TorqueProfile(np.array([0.0, time]), hold.tau[None, :, None])
    try:
        z = close_contacts(place.formation, place.z + problem.gap * opening)
        run = simulate_free(problem, torque, start=z)
    except (SimulationError, ArithmeticError):
        return _Trial(None, problem.gap)
    at = place.touching.evaluate(run.z, run.z_dot)
    gaps = np.abs(at.C).max(axis=1)
    still = np.flatnonzero(gaps > CLOSED * problem.gap)
    last = int(still[-1]) + 1 if len(still) else 0
    return _Trial(float(run.t[last]) if last < len(run.t) else None, float(gaps[-1]))


def list_touching(problem: Problem, phase: Phase) -> Formation:
    """All that touches where a phase has ended: its contacts, the one gained, and the next ones."""
    contacts = list(phase.formation.contacts)
    if phase.until.contact is not None:
        contacts.append(phase.until.contact)
    following = problem.phases[phase.number : phase.number + 1]
    contacts += [contact for own in following for contact in own.formation.contacts]
    return Formation(problem.scene, tuple(dict.fromkeys(contacts)))


class DwellAllocation(NamedTuple):
    """A way to share time: what ends have that gain a contact, over most others of them."""

    first: int  # how many of the first have more, or less
    more: float  # what they have
    last: float  # what the plan's last end has
    # whether torques are the firmest ones, whether or not they drive on what is still open
    firm: bool = False


WAYS = (
    DwellAllocation(1, 2.0, 1.0, firm=True),
    DwellAllocation(1, 0.0, 0.0, firm=True),
    DwellAllocation(1, 2.0, 1.0),
    DwellAllocation(2, 3.5, 1.0),
    DwellAllocation(2, 2.0, 1.0),
    DwellAllocation(1, 0.0, 0.0),
)
"""Ways to share that are tried, in this order, until a plan ends no farther off than its start."""


STOP = 0.06  # time for an end where nothing has to close, over that for a contact


BETTER = 0.8  # how far off another way's end may be to be better, over that of the best one before


def share_time(problem: Problem, plans: Plans) -> list[DwellEnd | None]:
    """How each end is held: the way to share time that ends best is taken.

    The first one whose plan's end is no farther off than `problem.gap`, simulated by the clock from
    the exact start and from starts moved along the palm by that to either side, or the best one.
    """
    best, least = list[DwellEnd | None](), math.inf
    for way in WAYS:
        ends = find_ends(problem, plans, _share(problem, plans, way), way.firm)
        off = measure_off(problem, plans, ends) if any(ends) else 0.0
        if not best or off < BETTER * least:
            best, least = ends, off
        if least <= problem.gap:
            break
    return best


def _share(problem: Problem, plans: Plans, way: DwellAllocation) -> list[float]:
    """For how long ends are held if time is shared in a way [s]."""
    times = [problem.settles(phase) for phase in problem.phases]
    weights, gained = np.zeros(len(times)), 0
    for k, place in enumerate(find_places(problem, plans)):
        if place is None or times[k] is not None:
            continue
        closes = find_opening(place) is not None
        weights[k] = (way.more if gained < way.first else 1.0) if closes else STOP
        gained += closes
    if gained > way.first:
        weights[-1] *= way.last
    whole = problem.settle_share * sum(plan.motion.duration for plan in plans)
    shares = whole * weights / max(float(weights.sum()), STOP**2)
    return [own if time is None else time for own, time in zip(shares.tolist(), times, strict=True)]


def measure_off(problem: Problem, plans: Plans, ends: Sequence[DwellEnd | None]) -> float:
    """How far off plans end at most [m] with ends held, turns counting by the scene's length."""
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
