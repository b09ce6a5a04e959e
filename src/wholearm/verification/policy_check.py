"""Verification of a policy by complementarity simulation of the closed loop."""

from __future__ import annotations

import math

from ..common.errors import InputError, require_number
from ..common.sharing import exclusive
from ..policy.playback import ROOM, ClosedLoop, Policy
from ..problem.definition import Phase, Problem
from ..results.adopt import Moved, adopt_motion
from ..results.trajectory import Trajectory
from ..simulation.events import FreeSimulation, OutcomeKind
from ..simulation.simulate import simulate_free
from .free import FreePhase, FreeReport, describe_losses, find_losses, measure_end, warn
from .verdict import DEPARTURE

REACHED, TURNED = 0.03, math.radians(1.0)
"""How far from the plan's end a policy may end: over the scene's length, and in rad."""


@exclusive
def verify_policy(
    problem: Problem,
    plan: Trajectory | Moved,
    policy: Policy,
    *,
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    restitution: float = 0.0,
) -> FreeReport:
    """Simulate the closed loop from the problem's start, and report the end of each phase.

    A contact of a phase counts from when the phase begins until the one that it gains presses.

    Parameters
    ----------
    plan                    where phases are to end
    tolerance, restitution  as of `verify_free`
    departure               how far contacts of a phase may open, over the scene's length

    Raises
    ------
    InputError  if the policy or the plan has other phases than the problem, or a number is out of
                its range
    """
    problem, plan = adopt_motion(problem, plan)
    allowed = require_number(departure, "departure", positive=True)
    count = len(problem.phases)
    for name, given in (("policy", policy.count), ("plan", len(plan.phase_starts) - 1)):
        if given != count:
            raise InputError("", f"phases of the {name}", f"{given} given; the problem has {count}")
    loop = ClosedLoop(policy)
    until = (1 + ROOM) * loop.find_duration(count)
    whole = simulate_free(problem, loop, until=until, tolerance=tolerance, restitution=restitution)
    phases = tuple(
        _judge(problem, plan, loop, whole, phase, allowed)
        for phase in problem.phases
        if phase.number in loop.began
    )
    failures = [] if whole.outcome.kind is OutcomeKind.ENDED else [whole.outcome.text]
    for phase in phases:
        failures += describe_losses(phase)
        if not phase.reached:
            failures.append(f"phase {phase.number} does not end within {until:.4g} s")
    end = phases[-1].deviation
    assert end is not None
    far = end.position / problem.scene.scales.length > REACHED or end.angle > TURNED
    if len(phases) == count and far:
        text = f"ends {end.position:.3g} m and {end.angle:.3g} rad away from the plan"
        failures.append(f"the policy {text}")
    warnings = tuple(warn("whole", whole))
    return FreeReport(problem.name, whole, (), phases, tuple(failures), warnings)


def _judge(
    problem: Problem,
    plan: Trajectory,
    loop: ClosedLoop,
    whole: FreeSimulation,
    phase: Phase,
    allowed: float,
) -> FreePhase:
    """Losses and end of a phase."""
    start, contact = loop.began[phase.number], phase.until.contact
    last = phase is problem.phases[-1]
    stop = float(whole.t[-1]) if last else loop.began.get(phase.number + 1, float(whole.t[-1]))
    gains = [
        closed.start
        for closed in whole.stretches
        if contact is not None and closed.contact == contact.name and closed.start > start
    ]
    reached = last or phase.number + 1 in loop.began
    losses = find_losses(problem, whole, phase, start, min([stop, *gains]), allowed)
    end = measure_end(whole, plan, phase.index, stop)
    return FreePhase(phase.number, start, stop, reached, tuple(losses), end)
