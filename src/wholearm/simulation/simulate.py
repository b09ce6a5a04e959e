"""Forward simulation of prescribed contact formations: joint torques in, motion and forces out.

Event-driven integration (DOP853) from rest in the first formation. Friction has the sliding signs
of the current mode; steps end where a polynomial piece of the torques ends, and events are located
by repeating the step with another length. At rest the formation waits until it can start
(`sticking`).

A phase that ends at rest stops the motion. After a smooth end the velocity is projected onto the
next formation, and contacts that it does not have are released. A phase without an `until` ends at
that release, where a contact slips that slides in the next phase, or where contacts come to rest
that roll there. After an impact every contact of the next formation has to press
(`mechanics.impact`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array, sort_unique
from ..common.errors import InputError, JammingError, SimulationError
from ..common.sharing import exclusive
from ..contacts.contact_limits import takes_over
from ..contacts.formation import Formation
from ..mechanics.impact import ViolationKind, compute_impact, solve_impulses
from ..problem.check import require_phases
from ..problem.definition import End, Phase, Problem
from ..results.adopt import Torques, adopt_torques
from .events import (
    EventKind,
    Glimpses,
    Outcome,
    OutcomeKind,
    Simulation,
    Step,
    collect,
    list_glimpses,
)
from .jumps import (
    Arrival,
    Ending,
    Released,
    Rested,
    Switched,
    coast_to_step,
    come_to_rest,
    find_slipping,
    is_there,
    let_go,
    let_slip,
    restart,
    steps_within,
    turn,
)
from .modes import find_fixed, find_grips, list_units, share_mode
from .root_finding import find_first
from .runge_kutta import ORDER
from .sliding_signs import measure_rates
from .start_modes import StartDeparture
from .stepper import ModeStepper, Replay, open_limits
from .sticking import Collapse, Rest, balances, close_contacts, find_rest
from .tolerances import (
    CREEPING,
    PASSED,
    REACHED,
    ROUNDING_LIMIT,
    SETTLING,
    SHORTEST_STEP,
    SLOW,
    STANDING,
    is_slower,
    measure_units,
    measure_until,
)

_OUTCOMES = {
    ViolationKind.PULL: OutcomeKind.CONTACT_LOST,
    ViolationKind.SLIP: OutcomeKind.SLIPS,
    ViolationKind.CLOSING: OutcomeKind.LIMIT_REACHED,
    ViolationKind.HELD: OutcomeKind.HELD,
}
_GROWTH = 40.0  # largest growth of a step: at order 8 an error of 1e-13 of the tolerance allows it
_HELD_AT = 5  # places of a piece of the torques at which they have to hold the object
ROUNDS = 8  # most simulations, each with steps that end at events missed before
Closer = Callable[[Simulation, Glimpses, int], ArrayLike]
"""Simulation, forces within its steps and number of calls so far -> further instants to check."""


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
    tolerance         largest error of each step, in z and z', over those or over the scene's
                      length, 1 rad, speed and angular speed (`Scene.scales`) where these are more
    times : (n,) [s]  instants at which the state is wanted; steps end there. Those outside the
                      torques' time are left out.
    closer            simulation, forces within its steps and number of calls so far -> instants
                      (n,) [s] within steps to evaluate too, until there are none. Steps change
                      only if an event shows there that their ends miss.
    progress          receives a line at the start of each phase

    Returns
    -------
    Simulation  whatever happens to the object: a lost contact is an outcome, not an error

    Raises
    ------
    InputError       if `tolerance` is not a number from 1e-14 to 1e-2, or a time is not finite
    JammingError     if friction makes the reduced inertia vanish or turn negative
    SimulationError  if a formation does not close at its start, or the step size underflows. Both
                     errors say in which phase.
    """
    problem, profile, _ = adopt_torques(problem, torque)
    require_phases(problem)
    if not 1e-14 <= tolerance <= 1e-2:
        raise InputError("", "tolerance", f"{tolerance!r} is not between 1e-14 and 1e-2")
    wanted = _sort_times(times)
    for attempts in range(ROUNDS, 0, -1):
        run = Replay(problem, profile, tolerance, wanted)
        outcome, missed_by = _simulate(run, progress)
        simulation, missed, calls = _collect(run, outcome, missed_by), list[float](), 0
        glimpses = list_glimpses(problem, run.sections if closer else ())
        while closer and not missed:
            times = _sort_times(closer(simulation, glimpses, calls))
            if not len(times):
                break
            missed, calls = look_within(run, times), calls + 1
            simulation = _collect(run, outcome, missed_by)
        if not missed or attempts == 1:
            break
        wanted, progress = _sort_times([*wanted, *missed]), None
    return simulation


def _sort_times(instants: ArrayLike | None) -> Array:
    times = np.asarray(() if instants is None else instants, dtype=float)
    if not np.isfinite(times).all():
        raise InputError("", "times", "holds numbers that are not finite")
    return sort_unique(times)


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
    ending: StartDeparture | Ending = Rested()
    if run.moving:
        ending = go_on(run) or move(run)
    brief = 0
    while isinstance(ending, Rested | StartDeparture):
        if isinstance(ending, Rested):
            ending = _rest(run)
        if isinstance(ending, StartDeparture):
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
        names = ", ".join(run.releasable)
        run.note(EventKind.RELEASE, f"{names} released {run.when()}", names, ending.c_n)
    else:
        contact, sign = ending
        text = f"{contact} {'slips' if sign else 'comes to rest'} {run.when()}"
        run.note(EventKind.ARRIVAL, text, contact)
        run.slip_signs = {contact: sign} if sign else {}
    run.moving = True
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
    before, run.previous = run.stored, run.phase.formation
    run.y[5:10] = 0.0
    run.impact += before - run.stored
    # The torques of the phase that has ended go on until they step, or end.
    coming = min(run.coming_step, run.breaks[-1])
    run.held_until = coming if coming - run.t <= arrival.window else run.t
    if run.problem.scene.has_slow_motors:
        # Rate-limited torques do not step. A motion whose deceleration fades comes early by about
        # the cube root of its error: the old torques act until it was to end.
        early = run.breaks[run.piece] < run.t < run.breaks[run.piece + 1]
        remaining = arrival.remaining if early else 0.0
        run.held_until = max(run.held_until, min(run.t + remaining, run.breaks[-1]))
        run.settled_by = run.held_until + run.tolerances.rest_window
    return None


def _rest(run: Replay) -> StartDeparture | Arrival | Released | Switched | Outcome:
    """Wait at rest until the formation can start, the goal is near or balance is lost."""
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
            if isinstance(change, StartDeparture) and change.x <= x:
                return change
            if not sticks:
                run.note(EventKind.STICK, f"the object sticks {run.when()}")
            sticks = True
            if isinstance(change, StartDeparture):
                _advance(run, run.time(change.x))
                return change
            if isinstance(change, Collapse):
                # Balance may be lost where the torques are about to step or to be the next phase's.
                t = run.time(change.x)
                soon = run.coming_step - t <= run.tolerances.rest_window
                if not (t < run.settled_by or soon or _touches(run)):
                    return _collapse(run, rest, change)
        stop = run.breaks[run.piece + 1]
        if run.t < run.settled_by < stop:
            _advance(run, run.settled_by)
        else:
            _advance(run, stop)
            run.next_piece()


def _touches(run: Replay) -> bool:
    """Whether the contacts of both phases balance rate-limited torques on the present piece."""
    if run.previous is None or not run.problem.scene.has_slow_motors:
        return False
    contacts = dict.fromkeys((*run.phase.formation.contacts, *run.previous.contacts))
    coefficients = run.coefficients[run.piece]
    x = np.linspace(run.fraction(run.t), 1.0, _HELD_AT)[:, None]
    torques = x ** np.arange(coefficients.shape[1]) @ coefficients.T
    return all(balances(run.problem.scene, tuple(contacts), run.y[:5], tau) for tau in torques)


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
    counts = (run.steps, run.rejected)
    return collect(run.problem, run.sections, run.events, run.torques, outcome, missed_by, counts)


def move(run: Replay) -> Ending:
    """Integrate until the motion rests, arrives, releases its contacts or fails."""
    start = run.stepper.outputs.copy()
    run.h = min(run.h, run.tolerances.first_step)
    while True:
        outputs, to = run.stepper.outputs, run.stepper.to
        while run.wanted[run.next_wanted] <= run.t:
            run.next_wanted += 1
        target = min(run.breaks[run.piece + 1], run.wanted[run.next_wanted])
        h, whole = _try_step(run, target)
        arrives = bool(outputs[to.worst] < 0)
        if arrives and not (whole and _is_at_end(run, target)):
            ending = _stop_at_event(run, start, h)
            if ending is not None:
                return ending
            start = run.stepper.outputs.copy()
            continue
        start = _accept(run, target if whole else run.t + h, arrives)
        if whole and target == run.breaks[run.piece + 1]:
            ending = _pass_break(run)
            if ending is not None:
                return ending
            start = run.stepper.outputs.copy()


def _accept(run: Replay, t: float, arrives: bool = False) -> Array:
    """Accept and keep the step to time `t`; `arrives`: it passes the phase's end by rounding."""
    begin, inputs = run.t, run.stepper.inputs.copy()
    row = run.accept(t)
    run.sections[-1].steps.append(Step(begin, t - begin, inputs, row, run.impact, arrives))
    return row


def _try_step(run: Replay, target: float) -> tuple[float, bool]:
    """Find a step within the tolerance; returns its length and whether it ends at `target`."""
    s = run.stepper
    inputs, outputs, at, to = s.inputs, s.outputs, s.at, s.to
    remaining = target - run.t
    while True:
        whole = run.h >= 0.999 * remaining
        h = remaining if whole else min(run.h, remaining / 2)
        inputs[at.t], inputs[at.h] = run.t, h
        s.step()
        error = outputs[to.error]
        brief = h <= run.tolerances.settling / 10
        sudden = outputs[to.dip] < -1e-6 and outputs[to.worst] >= 0 and not brief
        if error <= 1 and not sudden:
            grown = h * min(_GROWTH, 0.9 * max(error, 1e-300) ** (-1 / ORDER))
            run.h = grown if h == run.h else max(run.h, grown)
            run.steps += 1
            return h, whole
        run.rejected += 1
        factor = 0.9 * error ** (-1 / ORDER) if error > 1 else 0.2
        run.h = h * (0.5 if error <= 1 else max(0.2, factor))
        if run.h < max(run.tolerances.shortest_step, SHORTEST_STEP * abs(run.t)):
            run.fail_to_step(float(outputs[to.ratio]))


def _is_at_end(run: Replay, t: float) -> bool:
    """Whether the step just tried ends the phase, at a torque break and but for rounding.

    It has to be at rest there or to reach a contact softly. A coordinate, or the end of a contact's
    range, is passed at any speed; an impact comes at any, with its torque step or at their end.
    """
    s = run.stepper
    if t != run.breaks[run.piece + 1] or not is_there(run) or _comes_later(run):
        return False
    speed = abs(_measure_rate(run))
    if run.passes:
        distance = run.value(s.rows.until) / run.until_unit
        # Of several breaks as near as that, the nearest is the one at which the phase ends.
        later = run.breaks[run.piece + 2 : run.piece + 3]
        apart = (later[0] - t) / run.problem.scene.scales.time if len(later) else math.inf
        early = min(SETTLING, apart / 2)
        speed = 0.0 if -SETTLING * speed <= distance <= early * speed else math.inf
    elif run.phase.end is End.IMPACT and _strikes(run):
        coming = run.piece + 1
        speed = 0.0 if coming >= len(run.steps_at) or run.steps_at[coming] else speed
    elif run.phase.end is not End.SMOOTH and s.formation.n_constraints < 4:
        units = measure_units(run.problem.scene)[5:]
        speed = float(np.abs(s.outputs[s.to.y][5:10] / units).max())
    pressing = s.outputs[s.to.events][s.rows.force]
    return speed < SLOW and bool(pressing.min() >= -run.tolerances.force) and not find_slipping(s)


def _comes_later(run: Replay) -> bool:
    """Whether a motion with fading deceleration still approaches, at a break before its end."""
    coming = run.piece + 1
    if not run.problem.scene.has_slow_motors or run.phase.end is not End.REST:
        return False
    if coming + 1 >= len(run.breaks) or run.steps_at[coming]:
        return False
    late = 2 * _time_to_stop(run) > run.tolerances.rest_window
    return late and _measure_rate(run) < -CREEPING


def _pass_break(run: Replay) -> Ending | None:
    """Go on to the next piece of the torques."""
    s = run.stepper
    if _is_at_end(run, run.t):
        rate, strikes = -float(s.outputs[s.to.until_rate]), _strikes(run)
        # Before a step that is still to come, the torques are those of the phase that ends.
        stepped = run.next_piece()
        window = run.tolerances.settling if stepped else run.tolerances.rest_window
        return Arrival(rate, window, strikes)
    if run.t >= run.breaks[-1]:
        return run.run_out()
    if not run.next_piece():
        return None
    run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")
    return restart(run)


def _stop_at_event(run: Replay, start: Array, h: float) -> Ending | None:
    """End the step at the first event within it; None if the motion goes on."""
    s = run.stepper
    rows = s.rows
    kinds = find_first(run, start, h)
    _accept(run, run.t + float(s.inputs[s.at.h]))
    if rows.until in kinds:
        return _pass_on(run) if run.phase.end is End.SMOOTH or _strikes(run) else _reach(run)
    if rows.speed in kinds:
        return come_to_rest(run)
    pulling = [k for k in kinds if k < rows.force.stop]
    if pulling:
        return let_go(run, pulling)
    if any(rows.cone.start <= k < rows.cone.stop for k in kinds):
        return let_slip(run, kinds)
    for k in kinds:
        if rows.limit.start <= k < rows.limit.stop:
            text = f"{run.limits[k - rows.limit.start]} {run.when()}"
            run.note(EventKind.LIMIT, text)
            return Outcome(OutcomeKind.LIMIT_REACHED, text)
    return turn(run, kinds)


def _reach(run: Replay) -> Arrival:
    """The end of the phase is reached while moving."""
    s = run.stepper
    rate = -float(s.outputs[s.to.until_rate])
    # A planned motion that comes this early by its error would have stopped v / a later.
    stopping = 2 * _time_to_stop(run)
    remaining = min(stopping, run.tolerances.longest_window) if stopping < math.inf else 0.0
    slow = abs(_measure_rate(run)) < SLOW
    window = max(remaining, run.tolerances.settling) if slow else remaining
    return Arrival(rate, window, remaining=remaining)


def _measure_rate(run: Replay) -> float:
    """Time derivative of the distance to the end of the phase, in units of the scene."""
    s = run.stepper
    return float(s.outputs[s.to.until_rate]) / run.until_unit * run.problem.scene.scales.time


def _time_to_stop(run: Replay) -> float:
    """Time in which the motion would stop at its present deceleration [s]."""
    s = run.stepper
    heading = run.problem.scene.mass_diagonal * s.outputs[s.to.heading]
    slowing = -float(heading @ s.outputs[s.to.acceleration])
    speed = float(heading @ s.outputs[s.to.y][5:10])
    return speed / slowing if slowing > 0 else math.inf


def _strikes(run: Replay) -> bool:
    """Whether the phase ends here with an impact, and not at rest but for an error."""
    rate, time = -_measure_rate(run), _time_to_stop(run) / run.problem.scene.scales.time
    stops = rate < SLOW or rate * time / 2 < REACHED
    return run.phase.end is End.IMPACT and not stops


def _pass_on(run: Replay) -> Arrival:
    """The end of a phase is passed; the torques of the next one may still have to come."""
    s = run.stepper
    s.inputs[s.at.t] = run.t
    window = settling = run.tolerances.settling
    rate, strikes = -float(s.outputs[s.to.until_rate]), run.phase.end is End.IMPACT
    if run.passes and rate > 0:
        # A motion that is off by rounding comes the earlier the slower it is.
        early = PASSED * run.until_unit / rate
        window = min(max(early, settling), run.tolerances.longest_window)
    elif run.phase.until.contact is not None and not strikes:
        run.step_to(settling)
        slowing = (float(s.outputs[s.to.until_rate]) + rate) / settling
        if slowing > 0:
            window = min(max(2 * rate / slowing, settling), run.tolerances.longest_window)
    if steps_within(run, window):
        coast_to_step(run, hide=False)
    return Arrival(rate, window, strikes)


def enter(run: Replay, phase: Phase, following: Phase | None) -> None:
    """Enter the formation of `phase`; the energy that its projection takes is lost to impact.

    A phase without an `until` ends where a contact of `releasable` parts, or else where contacts
    of `resting` come to rest, as they roll in the next phase, or one of `slipping` slips.
    """
    run.phase = phase
    before = run.stored
    run.y[:5] = _close(run, phase.formation)
    if run.moving:
        run.y[5:10] = project_velocity(phase.formation, run.y[:5], run.y[5:10])
        run.moving = not is_slower(run.problem.scene, run.y[5:10], STANDING)
    if not run.moving:
        run.y[5:10] = 0.0
    run.impact += before - run.stored
    until, run.side = phase.until, 1.0
    if until.value is not None:
        run.side = math.copysign(1.0, run.y[0 if until.coordinate == "x" else 2] - until.value)
    run.stuck = set()
    run.until_unit = measure_until(run.problem.scene, until)
    # At any speed a contact can be gained only where it goes on for another one.
    gained, formation = until.contact, phase.formation
    run.passes = phase.end is End.SMOOTH and (
        gained is None or takes_over(gained, formation.scene, formation.contacts)
    )
    run.take()
    run.limits = [limit.text for limit in open_limits(formation, until)]
    run.releasable, run.resting, run.slipping = (), frozenset(), frozenset()
    run.has_slid = False
    if phase.end is End.REST or following is None or not until.is_release:
        return
    names, kept = formation.names, following.formation.names
    rolled, rolls = ({c.name for c in p.formation.rolling} for p in (phase, following))
    run.releasable = tuple(name for name in names if name not in kept)
    if not run.releasable:
        run.resting = frozenset(k for k, name in enumerate(names) if name in rolls - rolled)
    run.slipping = frozenset(
        k for k, name in enumerate(names) if name in rolled - rolls and name in kept
    )


def _close(run: Replay, formation: Formation) -> Array:
    """The present configuration with every contact of a formation closed."""
    try:
        return close_contacts(formation, run.y[:5], 10 * REACHED * run.problem.scene.scales.length)
    except SimulationError as error:
        raise SimulationError(f"{error} {run.where()}") from None


def collide(run: Replay, following: Phase) -> Outcome | None:
    """Plastic impact onto the next formation; the outcome if it is not possible."""
    z = _close(run, following.formation)
    impact = compute_impact(run.phase.formation, following.formation, z, run.y[5:10])
    name, least = impact.least
    names = following.formation.names
    normal = impact.p[: len(names)]
    impulses = ", ".join(f"{p:.4g} on {n}" for n, p in zip(names, normal, strict=True))
    run.note(EventKind.IMPACT, f"impact {run.when()}, in N s {impulses}", name, least)
    if impact.violations:
        worst = impact.violations[0]
        text = f"{worst.describe()} in the impact {run.when()}"
        if worst.kind is ViolationKind.JAM:
            raise JammingError(text)
        return Outcome(_OUTCOMES[worst.kind], text)
    before = run.stored
    run.y[5:10] = impact.v
    run.impact += before - run.stored
    return None


def project_velocity(formation: Formation, z: Array, v: Array) -> Array:
    """Velocity nearest to `v` in the metric M5 that keeps every constraint, shape (5,)."""
    P = formation.evaluate(z[None], v[None]).P[0]
    return solve_impulses(formation.scene.mass_diagonal, P, P, v)[0]


def set_off(run: Replay, departure: StartDeparture) -> None:
    """Set the friction signs of a motion that starts from rest."""
    formation = run.phase.formation
    grips = find_grips(formation, np.concatenate(departure.directions))
    if formation.n_constraints < 4:
        rows = formation.evaluate(run.y[None, :5], run.y[None, 5:10])
        fixed = find_fixed(share_mode(formation, grips), rows.A[0], rows.A_t[0])
        run.stuck = {row for u in list_units(formation) for row in u.rows if u.grips and fixed[row]}
    if grips != run.stepper.mode.grips:
        run.take(grips)
    s = run.stepper
    s.inputs[s.at.Xi], s.inputs[s.at.sigma] = departure.directions
    s.inputs[s.at.heading] = departure.heading
    run.record()


def go_on(run: Replay) -> Ending | None:
    """Set the friction signs of the present velocity; what ends the motion at once, if anything."""
    s = run.stepper
    y, formation = run.y, run.phase.formation
    s.inputs[s.at.y], s.inputs[s.at.t] = y, run.t
    v = y[5:10]
    mass = formation.scene.mass_diagonal
    s.inputs[s.at.heading] = v / np.sqrt(mass @ v**2)
    rates = np.concatenate([formation.evaluate(y[None, :5], v[None]).A_t[0] @ v, v[3:]])
    signs = np.where(rates < 0, -1.0, 1.0)
    for row, name in enumerate(formation.names):
        signs[row] = run.slip_signs.get(name, signs[row])
    run.slip_signs = {}
    movable = {row for unit in list_units(formation) for row in unit.rows}
    signs[[row for row in range(len(signs)) if row not in movable]] = 0.0
    _set_signs(run, signs)
    if s.is_free:
        return restart(run, enters=True)
    slow = STANDING * measure_rates(run.problem.scene, formation.n_contacts)
    still = np.flatnonzero((np.abs(rates) < slow) & (signs != 0)).tolist()
    for choice in product((1.0, -1.0), repeat=len(still)):
        tried = signs.copy()
        tried[still] *= choice
        _set_signs(run, tried)
        if s.outputs[s.to.ratio] > 0:
            break
    else:
        _set_signs(run, signs)
    return restart(run)


def _set_signs(run: Replay, signs: Array) -> None:
    """Evaluate the state with friction signs of contacts and joints, shape (n_c + 2,)."""
    s = run.stepper
    s.inputs[s.at.Xi], s.inputs[s.at.sigma] = signs[:-2], signs[-2:]
    s.look()


def look_within(run: Replay, times: Array) -> list[float]:
    """Record states at increasing instants, (n,) [s], within steps; those of missed events."""
    missed: list[float] = []
    scene, scales = run.problem.scene, run.problem.scene.scales
    for section, stepper in zip(run.sections, run.steppers, strict=True):
        if not section.steps:
            continue
        # Within a step more counts as rounding than at its end.
        at, rows, slack = stepper.at, stepper.rows, stepper.slack.copy()
        slack[rows.slide] = slack[rows.speed] = STANDING * scales.speed
        slack[rows.speed] *= scales.mass**0.5
        slack[rows.joint] = STANDING / scales.time
        slack[rows.until] = ROUNDING_LIMIT * measure_until(scene, section.phase.until)
        begins = np.array([step.t for step in section.steps])
        owners = np.searchsorted(begins, times, side="left") - 1
        for time, owner in zip(times.tolist(), owners.tolist(), strict=True):
            step = section.steps[max(owner, 0)]
            h = time - step.t
            if owner < 0 or h >= step.h:
                continue
            stepper.inputs[:] = step.inputs
            stepper.inputs[at.h] = h
            stepper.step()
            section.times.append(time)
            section.rows.append(stepper.outputs.copy())
            section.impacts.append(step.impact)
            if shows(step, stepper, slack):
                missed.append(time)
    return missed


def shows(step: Step, stepper: ModeStepper, slack: Array) -> bool:
    """Whether an event lies in a step before the instant just evaluated; its end may be passed."""
    short = stepper.outputs[stepper.to.events] + slack < 0
    if step.arrives:
        rows = stepper.rows
        short[rows.until] = short[rows.speed] = short[rows.slide] = short[rows.joint] = False
    return bool(short.any())
