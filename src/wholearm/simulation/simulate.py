"""Forward simulation: joint torques in, motion and contact forces out.

The motion starts at rest in the first phase's formation. While it moves, the constrained equations
of motion are integrated to a given tolerance with the friction of the sliding directions; every
step ends at the latest where a torque's polynomial piece ends, and events are located by repeating
a step with another length. At rest the formation waits until it can start (`sticking`).

When the end of a phase is reached the motion stops, if the phase ends at rest, and goes on from
rest in the next phase's formation. If it ends smoothly the motion goes on with its velocity, less
what the contacts of the next formation do not let through; contacts that this formation does not
have are let go. A phase without an end of its own is over where that happens, where a contact slips
that slides in the next phase, or where contacts come to rest that roll there. If a phase ends with
an impact, impulses of the next formation's contacts change the velocity, and all of them have to
press (`mechanics.impact`).

Nothing here is shared with the planner but the contacts and the scene.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array, sort_unique
from ..common.errors import InputError, JammingError, SimulationError
from ..common.sharing import exclusive
from ..problem.check import require_phases
from ..problem.definition import End, Phase, Problem
from ..results.narrow import Torques, adopt_torques
from .events import EventKind, Glimpses, Outcome, OutcomeKind, Simulation, collect, list_glimpses
from .jumps import Arrival, Ending, Released, Rested, Switched, is_there
from .moving import move
from .replay import Replay
from .starting import Departure
from .statics import balances
from .sticking import Collapse, Rest, find_rest
from .transitions import collide, enter, go_on, set_off
from .within import look_within

_HELD_AT = 5
"""Places of a piece of the torques at which they have to hold the object."""

ROUNDS = 8
"""Most simulations, each with more steps that end where something showed within those before."""

Closer = Callable[[Simulation, Glimpses, int], ArrayLike]
"""Gives, from what is known and the number of looks so far, instants to look at too, or none."""


@exclusive
def simulate(
    problem: Problem,
    torque: Torques,
    *,
    tolerance: float = 1e-9,
    times: ArrayLike | None = None,
    closer: Closer | None = None,
    progress: Callable[[str], None] | None = None,
) -> Simulation:
    """Replay joint torques open loop from the problem's start at rest.

    Parameters
    ----------
    problem : Problem
    torque : TorqueProfile
    tolerance : float
        Largest error of each step, in z and z', over those or over the scene's length, 1 rad, speed
        and angular speed (`Scene.scales`) where these are more.
    times : array_like, shape (n,), optional, [s]
        Instants at which the state is wanted; steps end there. Those outside the torques' time
        are left out.
    closer : callable, optional
        Takes the simulation, glimpses of forces within its steps and the number of looks so far,
        from 0, and gives instants within steps that are to be seen, too, shape (n,) [s], until it
        gives none. That changes no step, unless something shows there that ends of steps do not.
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
        If a formation does not close at its start, or the step size underflows. Both errors say in
        which phase.
    """
    problem, profile, _ = adopt_torques(problem, torque)
    require_phases(problem)
    if not 1e-14 <= tolerance <= 1e-2:
        raise InputError("", "tolerance", f"{tolerance!r} is not between 1e-14 and 1e-2")
    wanted = _sort_times(times)
    for left in range(ROUNDS, 0, -1):
        run = Replay(problem, profile, tolerance, wanted)
        found, missed = _look_closer(run, _simulate(run, progress), closer)
        if not missed or left == 1:
            break
        wanted, progress = _sort_times([*wanted, *missed]), None
    return found


def _sort_times(given: ArrayLike | None) -> Array:
    """Instants that are asked for, increasing, shape (n,) [s]."""
    if given is None:
        return np.zeros(0)
    times = np.asarray(given, dtype=float)
    if not np.isfinite(times).all():
        raise InputError("", "times", "holds numbers that are not finite")
    return sort_unique(times)


def _look_closer(
    run: Replay, ended: tuple[Outcome, float], closer: Closer | None
) -> tuple[Simulation, list[float]]:
    """What is recorded, and instants within steps at which something showed that they missed."""
    found, looks = _collect(run, *ended), 0
    missed: list[float] = []
    glimpses = list_glimpses(run.problem, run.sections if closer else ())
    while closer and not missed and len(wanted := _sort_times(closer(found, glimpses, looks))):
        missed = look_within(run, wanted)
        found, looks = _collect(run, *ended), looks + 1
    return found, missed


def _simulate(run: Replay, progress: Callable[[str], None] | None) -> tuple[Outcome, float]:
    """Simulate phase after phase; how that ends, and how far from the end of the last one."""
    problem = run.problem
    for phase, following in zip(problem.phases, [*problem.phases[1:], None], strict=True):
        if progress is not None:
            progress(f"simulating phase {phase.number} of {len(problem.phases)}")
        try:
            outcome = _play(run, phase, following)
        except (JammingError, SimulationError) as error:
            error.phase = phase.number
            raise
        if outcome is not None:
            release = phase.until.is_release
            return outcome, math.nan if release else run.value(run.stepper.rows.until)
    goal = problem.phases[-1].until
    text = f"{goal} is reached at t = {run.t:.5g} s, the end of phase {len(problem.phases)}"
    return Outcome(OutcomeKind.GOAL_REACHED, text), math.nan if goal.is_release else 0.0


def _play(run: Replay, phase: Phase, following: Phase | None) -> Outcome | None:
    """Simulate one phase; None if its end is reached."""
    enter(run, phase, following)
    ending: Departure | Ending = Rested()
    if run.moving:
        ending = go_on(run) or move(run)
    brief = 0
    while True:
        if isinstance(ending, Rested):
            ending = _rest(run)
        if isinstance(ending, Departure):
            started = run.t
            run.note(EventKind.START, f"the object starts to move {run.when()}")
            set_off(run, ending)
            ending = move(run)
            brief = brief + 1 if run.t - started < 100 * run.tolerances.shortest_step else 0
            if brief > 20:
                raise SimulationError(f"starting and stopping do not end {run.where()}")
        if isinstance(ending, Outcome):
            return ending
        if isinstance(ending, Arrival):
            return _arrive(run, ending, following)
        if isinstance(ending, Released):
            _release(run, ending)
            return None
        if isinstance(ending, Switched):
            _switch(run, ending)
            return None


def _arrive(run: Replay, arrival: Arrival, following: Phase | None) -> Outcome | None:
    """End the phase; if it ends at rest the motion stops, with a plastic impact if need be."""
    until, rate = run.phase.until, arrival.rate
    text = f"{until} reached {run.when()}"
    run.note(EventKind.ARRIVAL, text, str(until), rate)
    if arrival.strikes and following is not None:
        run.moving = True
        return collide(run, following)
    run.moving = run.phase.end is End.SMOOTH
    if run.moving:
        return None
    before, run.left = run.stored, run.phase.formation
    run.y[5:10] = 0.0
    run.impact += before - run.stored
    # The torques of the phase that has ended go on until they step, or end.
    coming = min(run.coming_step, run.breaks[-1])
    run.held_until = coming if coming - run.t <= arrival.window else run.t
    if run.problem.scene.has_slow_motors:
        _await_torques(run, arrival)
    return None


def _await_torques(run: Replay, arrival: Arrival) -> None:
    """Let the phase that has ended keep its torques, which do not step, until it was to end.

    A motion whose deceleration fades comes early by about the cube root of its error. The time that
    it would still have taken is twice its speed over its deceleration.
    """
    early = run.breaks[run.piece] < run.t < run.breaks[run.piece + 1]
    left = arrival.left if early else 0.0
    run.held_until = max(run.held_until, min(run.t + left, run.breaks[-1]))
    run.settled_by = run.held_until + run.tolerances.rest_window


def _release(run: Replay, release: Released) -> None:
    """End the phase where the next one's formation lets contacts go."""
    names = ", ".join(run.releasable)
    run.note(EventKind.RELEASE, f"{names} released {run.when()}", names, release.c_n)
    run.moving = True


def _switch(run: Replay, switch: Switched) -> None:
    """End the phase where a contact goes on as the next one has it."""
    does = "slips" if switch.way else "comes to rest"
    run.note(EventKind.ARRIVAL, f"{switch.contact} {does} {run.when()}", switch.contact)
    run.ways = {switch.contact: switch.way} if switch.way else {}
    run.moving = True


def _rest(run: Replay) -> Departure | Arrival | Released | Switched | Outcome:
    """Wait at rest until the formation can start, the goal is near or something gives way."""
    y = run.y
    before = run.stored
    y[5:10] = 0.0
    run.impact += before - run.stored
    run.record(still=True)
    if is_there(run):
        return Arrival(0.0, run.tolerances.rest_window)
    rest = find_rest(run.phase.formation, y[:5])
    sticks = False
    while True:
        if run.t >= run.breaks[-1]:
            return run.run_out()
        if run.t >= run.held_until:
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
            if isinstance(change, Collapse) and not _settles(run, change) and not _touches(run):
                return _collapse(run, rest, change)
        stop = run.breaks[run.piece + 1]
        if run.t < run.settled_by < stop:
            _advance(run, run.settled_by)
        else:
            _advance(run, stop)
            run.next_piece()


def _settles(run: Replay, change: Collapse) -> bool:
    """Whether the torques step, or become those of the next phase, before a contact could part."""
    t = run.time(change.x)
    return t < run.settled_by or run.coming_step - t <= run.tolerances.rest_window


def _touches(run: Replay) -> bool:
    """Whether contacts of the phase that has ended help to hold this piece of the torques.

    That counts where torques do not step: they pass from the ones to the others.
    """
    if run.left is None or not run.problem.scene.has_slow_motors:
        return False
    contacts = dict.fromkeys((*run.phase.formation.contacts, *run.left.contacts))
    coefficients = run.coefficients[run.piece]
    x = np.linspace(run.fraction(run.t), 1.0, _HELD_AT)[:, None]
    torques = x ** np.arange(coefficients.shape[1]) @ coefficients.T
    given = run.problem.scene, tuple(contacts), run.y[:5]
    return all(balances(*given, tau) for tau in torques)


def _advance(run: Replay, stop: float) -> None:
    """Let time pass at rest."""
    while run.wanted[run.next_wanted] <= stop:
        run.t = max(run.t, run.wanted[run.next_wanted])
        run.record(still=True)
        run.next_wanted += 1
    run.t = stop
    run.record(still=True)


def _collapse(run: Replay, rest: Rest, change: Collapse) -> Released | Switched | Outcome:
    """End because nothing balances at rest."""
    _advance(run, max(run.t, run.time(change.x)))
    if change.jammed:
        raise JammingError(
            f"{' '.join(rest.formation.names)} jams at rest {run.where()}: friction makes "
            "the reduced inertia vanish or turn negative"
        )
    if change.c_t is not None:
        row = run.phase.formation.names.index(change.contact)
        if row in run.slipping:
            return Switched(change.contact, -math.copysign(1.0, change.c_t))
        return run.slip(row, change.c_n, change.c_t)
    if change.contact in run.releasable:
        return Released(change.c_n)
    return run.lose(change.contact, change.c_n)


def _collect(run: Replay, outcome: Outcome, missed_by: float) -> Simulation:
    """Put everything recorded together."""
    counts = (run.steps, run.rejected)
    return collect(run.problem, run.sections, run.events, run.torques, outcome, missed_by, counts)


__all__ = ["simulate"]
