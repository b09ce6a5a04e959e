"""Forward simulation: joint torques in, motion and contact forces out.

The motion starts at rest in the first phase's formation. While it moves, the constrained equations
of motion are integrated to a given tolerance with the friction of the sliding directions; every
step ends at the latest where a torque's polynomial piece ends, and events are located by repeating
a step with another length. At rest the formation waits until it can start (`wholearm.sticking`).

When the end of a phase is reached the motion stops, since two border curves share no velocity but
zero at a point with five contacts, and goes on from rest in the next phase's formation.

Nothing here is shared with the planner but the contacts and the scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from .errors import InputError, JammingError, SimulationError
from .events import EventKind, Outcome, OutcomeKind, Section, Simulation, collect
from .moving import REACHED, REST_WINDOW, Arrival, Ending, move
from .problem import Phase, Problem
from .replay import Replay
from .stepper import build_stepper, open_limits
from .sticking import Collapse, Departure, Rest, close_contacts, find_rest
from .torque import TorqueProfile


def simulate(
    problem: Problem,
    torque: TorqueProfile,
    *,
    tolerance: float = 1e-9,
    times: ArrayLike | None = None,
    progress: Callable[[str], None] | None = None,
) -> Simulation:
    """Replay joint torques open loop from the problem's start at rest.

    Parameters
    ----------
    problem : Problem
    torque : TorqueProfile
    tolerance : float
        Largest error of each step, in z and z' [m, rad, m/s, rad/s].
    times : array_like, shape (n,), optional, [s]
        Instants at which the state is wanted; steps end there. Those outside the torques' time
        are left out.
    progress : callable, optional
        Receives a line at the start of each phase.

    Returns
    -------
    Simulation
        Whatever happens to the object: a lost contact is an outcome, not an error.

    Raises
    ------
    InputError
        If `tolerance` is not a number from 1e-14 to 1e-2, or a time is not finite.
    JammingError
        If friction makes the reduced inertia vanish or turn negative.
    SimulationError
        If a formation does not close at its start, or the step size underflows.
    """
    if not 1e-14 <= tolerance <= 1e-2:
        raise InputError("", "tolerance", f"{tolerance!r} is not between 1e-14 and 1e-2")
    wanted = np.unique(np.asarray([] if times is None else times, dtype=float))
    if not np.isfinite(wanted).all():
        raise InputError("", "times", "holds numbers that are not finite")
    run = Replay(problem, torque, tolerance, wanted)
    for phase in problem.phases:
        if progress is not None:
            progress(f"simulating phase {phase.number} of {len(problem.phases)}")
        outcome = _play(run, phase)
        if outcome is not None:
            return _collect(run, outcome)
    goal = problem.phases[-1].until
    text = f"{goal} is reached at t = {run.t:.5g} s, the end of phase {len(problem.phases)}"
    return _collect(run, Outcome(OutcomeKind.GOAL_REACHED, text))


def _play(run: Replay, phase: Phase) -> Outcome | None:
    """Simulate one phase; None if its end is reached."""
    _enter(run, phase)
    brief = 0
    while True:
        ending: Departure | Ending = _rest(run)
        if isinstance(ending, Departure):
            started = run.t
            ending = move(run, ending)
            brief = brief + 1 if run.t - started < 1e-12 else 0
            if brief > 20:
                raise SimulationError(f"starting and stopping do not end {run.where()}")
        if isinstance(ending, Outcome):
            return ending
        if isinstance(ending, Arrival):
            _arrive(run, ending)
            return None


def _enter(run: Replay, phase: Phase) -> None:
    """Take the formation of `phase`, at rest."""
    run.phase = phase
    before = run.stored
    try:
        run.y[:5] = close_contacts(phase.formation, run.y[:5], 10 * REACHED)
    except SimulationError as error:
        raise SimulationError(f"{error} {run.where()}") from None
    run.impact += before - run.stored
    until, side = phase.until, 1.0
    if until.value is not None:
        side = math.copysign(1.0, run.y[0 if until.coordinate == "x" else 2] - until.value)
    degree = run.coefficients.shape[2] - 1
    run.stepper = build_stepper(phase.formation, until, side, degree)
    run.sections.append(Section(phase, run.stepper.to))
    run.limits = [limit.text for limit in open_limits(phase.formation, until)]
    run.stepper.inputs[run.stepper.at.tolerance] = run.tolerance
    run.load_piece()


def _arrive(run: Replay, arrival: Arrival) -> None:
    """Stop the motion at the end of the phase: a plastic impact if it is not at rest."""
    until, rate = run.phase.until, arrival.rate
    text = f"{until} reached {run.when()}"
    run.note(EventKind.ARRIVAL, text, str(until), rate)
    before = run.stored
    run.y[5:10] = 0.0
    run.impact += before - run.stored
    coming = next((b for b in run.breaks if b > run.t), math.inf)
    run.hold = coming if coming - run.t <= arrival.window else run.t


def _rest(run: Replay) -> Departure | Arrival | Outcome:
    """Wait at rest until the formation can start, the goal is near or something gives way."""
    y = run.y
    y[5:10] = 0.0
    run.record(still=True)
    if abs(run.value(run.stepper.rows.until)) < REACHED:
        return Arrival(0.0, REST_WINDOW)
    rest = find_rest(run.phase.formation, y[:5])
    sticks = False
    while True:
        if run.t >= run.breaks[-1]:
            return run.run_out()
        if run.t >= run.hold:
            x = run.fraction(run.t)
            change = rest.wait(run.coefficients[run.piece], x)
            if isinstance(change, Departure) and change.x <= x:
                return change
            if not sticks:
                run.note(EventKind.STICK, f"the object sticks {run.when()}")
            sticks = True
            if isinstance(change, Departure):
                _advance(run, run.time(change.x))
                return change
            if isinstance(change, Collapse) and not _settles(run, change):
                return _collapse(run, rest, change)
        _advance(run, run.breaks[run.piece + 1])
        run.next_piece()


def _settles(run: Replay, change: Collapse) -> bool:
    """Whether the torques step before a contact could part."""
    coming = run.piece + 1
    steps = coming < len(run.steps_at) and bool(run.steps_at[coming])
    return steps and run.breaks[coming] - run.time(change.x) <= REST_WINDOW


def _advance(run: Replay, stop: float) -> None:
    """Let time pass at rest."""
    while run.wanted[run.next_wanted] <= stop:
        run.t = max(run.t, run.wanted[run.next_wanted])
        run.record(still=True)
        run.next_wanted += 1
    run.t = stop
    run.record(still=True)


def _collapse(run: Replay, rest: Rest, change: Collapse) -> Outcome:
    """End because nothing balances at rest."""
    _advance(run, max(run.t, run.time(change.x)))
    if change.jammed:
        raise JammingError(
            f"{' '.join(rest.formation.names)} jams at rest {run.where()}: friction makes "
            "the reduced inertia vanish or turn negative"
        )
    return run.lose(change.contact, change.c_n)


def _collect(run: Replay, outcome: Outcome) -> Simulation:
    """Put everything recorded together."""
    missed = 0.0 if outcome.reached else run.value(run.stepper.rows.until)
    counts = (run.steps, run.rejected)
    return collect(run.problem, run.sections, run.events, outcome, missed, counts)


__all__ = ["simulate"]
