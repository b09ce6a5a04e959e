"""Ends of phases held by constant torques, after their blocks are planned.

Where a phase stops, its plan is only as good as the place where it does: a little short of the
contact that is gained there, the next phase's torques set off in another formation. Held for a
while by torques that push on (`mechanics.arrival`), the contact closes first.
"""

from __future__ import annotations

from ..contacts.formation import Formation
from ..mechanics.arrival import Standstill, find_hold, needs_closing
from ..problem.definition import Phase, Problem
from ..results.settling import SettledMotion, Settling
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion
from ..simulation.tolerances import SLOW, is_slower
from .phase_plan import PhasePlan, Settled
from .stops import Plans, end_of

SLACK = 1 + 1e-6
"""Share of the time that a contact may take to close: it may be just that time."""


def settle_plans(problem: Problem, plans: Plans) -> Settled:
    """Hold the ends of those phases that come to rest and are to be held."""
    pairs = [_settle(problem, own, plan) for own, plan in zip(problem.phases, plans, strict=True)]
    return Settled([plan for plan, _ in pairs], tuple(settling for _, settling in pairs))


def _settle(
    problem: Problem, phase: Phase, plan: PhasePlan[Motion]
) -> tuple[PhasePlan[Motion], Settling | None]:
    time = problem.settles(phase)
    if not time:
        return plan, None
    z, v = end_of(plan)
    if not is_slower(problem.scene, v, SLOW):
        return plan, None
    place = Standstill(z, phase.formation, phase.until.contact, list_touching(problem, phase))
    hold = find_hold(place, problem.epsilon, problem.gap, time)
    gained = phase.until.contact.name if needs_closing(place) and phase.until.contact else ""
    if hold is None:
        text = f"no torques hold {' '.join(place.touching.names)} at the end of phase"
        warning = f"{text} {phase.number} with c_n >= epsilon"
        none = Settling(phase.number, 0.0, (0.0, 0.0), 0.0, gained, 0.0, 0.0, 0.0, (), warning)
        return plan, none
    a, gap = hold.acceleration, problem.gap if hold.acceleration else 0.0
    warning = ""
    if gained and not a:
        warning = f"no torques that hold the end of phase {phase.number} would close {gained}"
    closes = (2 * gap / a) ** 0.5 if a else 0.0
    if closes > SLACK * time:
        warning = (
            f"from {1e3 * gap:.3g} mm {gained} takes {1e3 * closes:.3g} ms to close at the end of "
            f"phase {phase.number}, which is held for {1e3 * time:.3g} ms"
        )
    motion = SettledMotion(plan.motion, time, hold.tau)
    torque = TorqueProfile.chain([plan.torque, motion.torque])
    first, second = hold.tau.tolist()
    shown = (hold.margin, gained, gap, closes, hold.speed, hold.parts, warning)
    settling = Settling(phase.number, time, (first, second), *shown)
    return plan._replace(motion=motion, torque=torque), settling


def list_touching(problem: Problem, phase: Phase) -> Formation:
    """All that touches where a phase has ended: its contacts, the one gained, and the next ones."""
    contacts = list(phase.formation.contacts)
    if phase.until.contact is not None:
        contacts.append(phase.until.contact)
    following = problem.phases[phase.number : phase.number + 1]
    contacts += [contact for own in following for contact in own.formation.contacts]
    return Formation(problem.scene, tuple(dict.fromkeys(contacts)))
