"""Verification by complementarity simulation, without telling which contacts hold.

A plan is simulated whole, open loop from the exact start, and phase by phase, each from its planned
start. The verdict is about the phases: the junctions between them are unstable to arrival errors.
With torques alone a phase ends where its `until` is reached.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..common.errors import require_number
from ..common.sharing import exclusive
from ..free_simulation.free_simulate import simulate_free, simulate_phases
from ..free_simulation.hand import build_system
from ..free_simulation.result import FreeSimulation, list_pauses
from ..geometry.curve import describe_pose
from ..problem.definition import Phase, Problem
from ..results.adopt import Torques, adopt_torques, require_same_contacts
from ..results.report import Deviation
from ..results.trajectory import Trajectory
from ..simulation.events import EventKind, OutcomeKind
from .free_report import FreePhase, FreeReport, LostContact
from .verdict import DEPARTURE

_TOLD = (EventKind.AMBIGUOUS, EventKind.INCONSISTENT)


@exclusive
def verify_free(
    problem: Problem,
    what: Torques,
    *,
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    restitution: float = 0.0,
    progress: Callable[[str], None] | None = None,
) -> FreeReport:
    """Simulate torques without telling which contacts hold, and report what happens.

    Parameters
    ----------
    tolerance    of the simulation
    departure    how far the end of a phase may be from the plan, as of `verify`, and how far
                 contacts of a phase may open, over the scene's length: bounces by less are events,
                 but no failure
    restitution  poisson's coefficient of impacts
    progress     told what is simulated

    Raises
    ------
    InputError       if the trajectory has other contacts than the problem, or a number is out of
                     its range
    SimulationError  if bodies overlap at the start
    """
    problem, torque, plan = adopt_torques(problem, what)
    allowed = require_number(departure, "departure", positive=True)
    require_same_contacts(problem, plan)
    options: dict[str, Any] = {"tolerance": tolerance, "restitution": restitution}
    if progress is not None:
        progress("simulating the whole")
    whole = simulate_free(problem, torque if plan is None else plan, **options)
    warnings = warn("whole", whole)
    if plan is None:
        phases, failures = _follow(problem, whole, allowed)
        return FreeReport(problem.name, whole, (), phases, tuple(failures), tuple(warnings))
    failures, alone = [], []
    for part in simulate_phases(problem, plan, progress=progress, **options):
        indices = range(part.first, part.last + 1)
        compared = _compare(problem, plan, part.simulation, indices, allowed)
        alone += compared
        title = f"phases {compared[0].number} to {compared[-1].number}" if compared[1:] else ""
        warnings += warn(f"{title or f'phase {compared[0].number}'} alone", part.simulation)
        failures += _fail(problem, part.simulation, compared, allowed)
    every = range(len(plan.phase_starts) - 1)
    by_clock = _compare(problem, plan, whole, every, allowed)
    return FreeReport(
        problem.name, whole, tuple(alone), tuple(by_clock), tuple(failures), tuple(warnings)
    )


def _fail(
    problem: Problem, simulation: FreeSimulation, phases: Sequence[FreePhase], allowed: float
) -> list[str]:
    """Why phases from rest are not as planned."""
    texts = [] if simulation.outcome.kind is OutcomeKind.ENDED else [simulation.outcome.text]
    for phase in phases:
        texts += [
            f"phase {phase.number} alone: {loss.contact} is lost at t = {loss.time:.5g} s and "
            f"opens by {loss.gap:.2g} m"
            for loss in phase.losses
        ]
        end = phase.deviation
        assert end is not None
        if max(end.position / problem.scene.scales.length, end.angle) > allowed:
            texts.append(
                f"phase {phase.number} alone ends {end.position:.3g} m and {end.angle:.3g} rad "
                "away from the plan"
            )
    return texts


def warn(title: str, simulation: FreeSimulation) -> list[str]:
    """What was not decided by the laws of contact alone."""
    return [f"{title}: {event.text}" for event in simulation.events if event.kind in _TOLD]


def _compare(
    problem: Problem, plan: Trajectory, simulation: FreeSimulation, indices: range, allowed: float
) -> list[FreePhase]:
    """Phases by the clock: where each ends, and which of its contacts are lost meanwhile."""
    compared, starts = [], plan.phase_starts
    for phase in (problem.phases[index] for index in indices):
        start, stop = float(starts[phase.index]), float(starts[phase.index + 1])
        losses = find_losses(problem, simulation, phase, start, stop, allowed)
        end = measure_end(simulation, plan, phase.index, stop)
        reached = end.time == stop
        compared.append(FreePhase(phase.number, start, stop, reached, tuple(losses), end))
    return compared


def measure_end(simulation: FreeSimulation, plan: Trajectory, index: int, stop: float) -> Deviation:
    """Difference of the configuration at an instant from the planned end of a phase."""
    row = int(np.searchsorted(simulation.t, stop, side="right")) - 1
    away = np.abs(simulation.z[row] - plan.z[np.flatnonzero(plan.phase == index)[-1]])
    return Deviation(float(away[:2].max()), float(away[2:].max()), float(simulation.t[row]))


def describe_losses(phase: FreePhase) -> list[str]:
    """Sentences on contacts of a phase that open."""
    return [
        f"{loss.contact} is lost at t = {loss.time:.5g} s, phase {phase.number}, and opens by "
        f"{loss.gap:.2g} m"
        for loss in phase.losses
    ]


def _follow(
    problem: Problem, simulation: FreeSimulation, allowed: float
) -> tuple[tuple[FreePhase, ...], list[str]]:
    """Phases of torques alone: each until what ends it has happened."""
    phases: list[FreePhase] = []
    failures: list[str] = []
    start = float(simulation.t[0])
    following: Sequence[Phase | None] = [*problem.phases[1:], None]
    for phase, after in zip(problem.phases, following, strict=True):
        stop = _find_end(simulation, phase, after, start)
        last = float(simulation.t[-1]) if stop is None else stop
        losses = find_losses(problem, simulation, phase, start, last, allowed)
        phases.append(FreePhase(phase.number, start, last, stop is not None, tuple(losses), None))
        failures += describe_losses(phases[-1])
        if stop is None:
            failures.append(f"phase {phase.number} does not end: {phase.until} is not reached")
            break
        z = simulation.z[int(np.searchsorted(simulation.t, stop, side="right")) - 1]
        if phase.until.measure_pins(z, problem.scene.scales.length) > allowed:
            failures.append(
                f"phase {phase.number} ends at {describe_pose(z)}, and not with {phase.until}"
            )
        start = stop
    return tuple(phases), failures


def _find_end(
    simulation: FreeSimulation, phase: Phase, after: Phase | None, start: float
) -> float | None:
    """When a phase ends, None if it does not [s]."""
    until = phase.until
    later = [event for event in simulation.events if event.time >= start]
    if until.contact is not None:
        times = [e.time for e in later if e.contact == until.contact.name]
        closed = [s for s in simulation.stretches if s.contact == until.contact.name]
        times += [max(s.start, start) for s in closed if s.stop > start]
    elif until.value is not None:
        values = simulation.z[:, 0 if until.coordinate == "x" else 2] - until.value
        rows = np.flatnonzero(simulation.t >= start)
        passed = rows[values[rows] * values[rows[0]] <= 0]
        times = simulation.t[passed[:1]].tolist()
    else:
        kept = set() if after is None else set(after.formation.names)
        leaving = set(phase.formation.names) - kept
        lost = [e for e in later if e.kind is EventKind.CONTACT_LOST]
        times = [e.time for e in lost if e.contact in leaving]
    return min(times, default=None)


def find_losses(
    problem: Problem,
    simulation: FreeSimulation,
    phase: Phase,
    start: float,
    stop: float,
    allowed: float,
) -> list[LostContact]:
    """Contacts of a phase that open by more than is allowed, over the scene's length."""
    system, losses = build_system(problem.scene), []
    for name in phase.formation.names:
        for first, after in list_pauses(simulation.stretches, name, start, stop):
            rows = np.flatnonzero((simulation.t >= first) & (simulation.t <= after))
            gaps = system.measure(simulation.z[rows])[0][:, system.names.index(name)]
            if gaps.max(initial=0.0) > allowed * problem.scene.scales.length:
                losses.append(LostContact(name, first, float(gaps.max())))
                break
    return sorted(losses, key=lambda loss: loss.time)
