"""Ends of phases held by constant torques, after their blocks are planned.

Where a phase stops, its plan is only as good as the place where it does: a little short of the
contact that is gained there, the next phase's torques set off in another formation. Held for a
while by torques that push everything together (`mechanics.arrival`), the contact closes first. How
soon it does hangs on the impacts on the way: that is simulated from where the contact is still
open, without telling which contacts hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import SimulationError
from ..contacts.formation import Formation
from ..free_simulation.simulate import simulate_free
from ..mechanics.arrival import Hold, Standstill, find_hold, find_opening
from ..problem.definition import Phase, Problem
from ..results.settling import SettledMotion, Settling
from ..results.torque import TorqueProfile
from ..results.torque_change import change_torques
from ..results.trajectory import Motion
from ..scene.model import Scene
from ..simulation.closing import close_contacts
from ..simulation.tolerances import SLOW, is_slower
from .path_domain.joint import begin_from
from .phase_plan import PhasePlan, Settled
from .stops import Plans, end_of

CLOSED = 0.01
"""What is left of a gap that counts as closed, over the gap."""


class End(NamedTuple):
    """An end at rest that is held.

    Attributes
    ----------
    place : Standstill
    time : float, [s]
    hold : Hold or None
        None if no torques hold it.
    firm : bool
        Whether they are the firmest ones, whether or not they drive on what is still open.
    """

    place: Standstill
    time: float
    hold: Hold | None
    firm: bool


class _Trial(NamedTuple):
    """What torques do from where the contact is still open.

    Attributes
    ----------
    closes : float or None, [s]
        From when on everything is closed; None if something is open at the end.
    left : float, [m]
        Largest gap at the end.
    """

    closes: float | None
    left: float


def settle_plans(problem: Problem, plans: Plans) -> Settled:
    """Hold the ends of those phases that come to rest and are to be held."""
    if problem.settle_share:
        from .shares import share_time

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
) -> list[End | None]:
    """Torques for ends at rest that are held for some time [s]; None for all others."""
    found = list[End | None]()
    for place, time in zip(find_places(problem, plans), times, strict=True):
        if place is None or time <= 0:
            found.append(None)
            continue
        goal = place._replace(gained=None) if firm else place
        found.append(End(place, time, find_hold(goal, problem.epsilon, problem.gap, time), firm))
    return found


def hold_plans(problem: Problem, plans: Plans, ends: Sequence[End | None]) -> Plans:
    """The plans with their ends held; torques that may not step change to what holds and back."""
    held: Plans = []
    before: Array | None = None
    for phase, plan, end in zip(problem.phases, plans, ends, strict=True):
        if before is not None and problem.scene.has_slow_motors:
            plan = begin_from(plan, phase.formation, before)
        held.append(_hold(problem.scene, plan, end))
        before = end.hold.tau if end is not None and end.hold is not None else None
    return held


def _hold(scene: Scene, plan: PhasePlan[Motion], end: End | None) -> PhasePlan[Motion]:
    if end is None or end.hold is None:
        return plan
    change, ramp = None, 0.0
    if scene.has_slow_motors:
        change = change_torques(scene, plan.torque.at(plan.torque.breaks[-1:])[0], end.hold.tau)
        ramp = change.duration
    motion = SettledMotion(plan.motion, ramp + end.time, end.hold.tau, change)
    torque = TorqueProfile.chain([plan.torque, motion.torque])
    return plan._replace(motion=motion, torque=torque)


def _describe(problem: Problem, phase: Phase, end: End) -> Settling:
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
