"""Forward simulation of prescribed contact formations: joint torques in, motion and forces out.

Event-driven integration (DOP853) from rest in the first formation. Friction has the sliding signs
of the current mode; steps end where a polynomial piece of the torques ends, and events are located
by repeating the step with another length. At rest the formation waits until it can start
(`rest`).

A phase that ends at rest stops the motion. After a smooth end the velocity is projected onto the
next formation, and contacts that it does not have are released. A phase without an `until` ends at
that release, where a contact slips that slides in the next phase, or where contacts come to rest
that roll there. After an impact every contact of the next formation has to press
(`mechanics.impact`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array, sort_unique
from ..common.errors import InputError, JammingError, SimulationError
from ..common.sharing import exclusive
from ..contacts.contact_limits import takes_over
from ..contacts.formation import Formation
from ..mechanics.impact import ViolationKind, compute_impact, solve_impulses
from ..mechanics.statics import find_static_torques
from ..problem.definition import End, Phase, Problem
from ..problem.read import require_phases
from ..results.adopt import Torques, adopt_torques
from .events import EventKind, Glimpses, Outcome, OutcomeKind, Record, Simulation, collect
from .modes import find_fixed, find_grips, list_units, share_mode
from .replay import Replay, Step, find_first, open_limits
from .rest import BALANCED, Collapse, Rest, StartDeparture, close_contacts, find_rest
from .run import StuckError
from .runge_kutta import INNER_STAGES, NODES
from .sliding_signs import choose_mode, measure_rates, note_change
from .tolerances import (
    CREEPING,
    PASSED,
    REACHED,
    ROUNDING_FORCE,
    ROUNDING_LIMIT,
    SETTLING,
    SLOW,
    STANDING,
    is_slower,
    measure_units,
)

_FAR = 100.0  # speed over its change at which nothing reverses: lever arms are below that
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


class Arrival(NamedTuple):
    """The end of a phase is reached."""

    rate: float  # [m/s or rad/s]: how fast the distance to the phase's end closes
    # [s]: if the next break of the torques is no further off, the arrival belongs to it
    window: float
    strikes: bool = False  # whether it takes an impact to go on
    # [s]: time in which a motion whose deceleration fades would have come to rest
    remaining: float = 0.0


class Released(NamedTuple):
    """The contacts that the next phase does not have are let go."""

    c_n: float  # [N]: the least that the old formation would need of them


class Switched(NamedTuple):
    """A contact comes to rest, or slips, as the next phase has it."""

    contact: str
    sign: float = 0.0  # direction in which it slips; 0 if it comes to rest


class Rested:
    """The motion has come to rest."""


Ending = Arrival | Released | Switched | Rested | Outcome


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
        glimpses = list_glimpses(run.problem, run.taken if closer else ())
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
            return outcome, math.nan if release else run.distance
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
    run.previous = run.formation
    run.set_velocity(0.0)
    # The torques of the phase that has ended go on until they step, or end.
    coming = min(run.coming_step, run.breaks[-1])
    run.held_until = coming if coming - run.t <= arrival.window else run.t
    if run.problem.scene.has_slow_motors:
        # Rate-limited torques do not step. A motion whose deceleration fades comes early by about
        # the cube root of its error: the old torques act until it was to end.
        early = run.breaks[run.piece] < run.t < run.stop
        remaining = arrival.remaining if early else 0.0
        run.held_until = max(run.held_until, min(run.t + remaining, run.breaks[-1]))
        run.settled_by = run.held_until + run.tolerances.rest_window
    return None


def _rest(run: Replay) -> StartDeparture | Arrival | Released | Switched | Outcome:
    """Wait at rest until the formation can start, the goal is near or balance is lost."""
    run.set_velocity(0.0)
    run.look()
    run.record(still=True)
    if is_there(run):
        return Arrival(0.0, run.tolerances.rest_window)
    rest = find_rest(run.formation, run.z)
    sticks = False
    while True:
        if run.t >= run.breaks[-1]:
            return run.run_out()
        if run.t >= run.held_until:
            x = min(1.0, max(-1.0, run.fraction(run.t)))
            change = rest.wait(run.torque.coefficients[run.piece], x)
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
        if run.t < run.settled_by < run.stop:
            _advance(run, run.settled_by)
        else:
            _advance(run, run.stop)
            run.next_piece()


def _touches(run: Replay) -> bool:
    """Whether the contacts of both phases balance rate-limited torques on the present piece."""
    if run.previous is None or not run.problem.scene.has_slow_motors:
        return False
    contacts = dict.fromkeys((*run.formation.contacts, *run.previous.contacts))
    static = find_static_torques(Formation(run.problem.scene, tuple(contacts)), run.z)
    torques = np.array([run.tau(t) for t in np.linspace(run.t, run.stop, _HELD_AT).tolist()])
    return bool(static.measure(torques).max() <= BALANCED * run.problem.scene.scales.torque)


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
        row = run.formation.names.index(change.contact)
        if row in run.slipping:
            return Switched(change.contact, -math.copysign(1.0, change.c_t))
        return run.slip(row, change.c_n, change.c_t)
    if change.contact in run.releasable:
        return Released(change.c_n)
    return run.lose(change.contact, change.c_n)


def _collect(run: Replay, outcome: Outcome, missed_by: float) -> Simulation:
    contacts = [contact.name for contact in run.problem.contacts]
    return Simulation(
        **collect(run.system, run.records, contacts),
        problem=run.problem,
        torque=run.torque,
        events=tuple(sorted(run.events, key=lambda event: event.time)),
        outcome=outcome,
        missed_by=missed_by,
        steps=run.steps,
        rejected=run.rejected,
    )


def list_glimpses(problem: Problem, steps: Sequence[Step]) -> Glimpses:
    """Normal forces at the stages of all steps."""
    nodes, names = np.array(NODES)[list(INNER_STAGES)], [c.name for c in problem.contacts]
    columns = [(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, len(names))))]
    for step in steps:
        formation = step.leg.mode.formation
        c_n = np.full((len(nodes), len(names)), np.nan)
        at = [names.index(name) for name in formation.names]
        c_n[:, at] = step.stage_forces.reshape(len(nodes), -1)
        columns.append((step.t + nodes * step.h, np.full(len(nodes), step.leg.phase), c_n))
    return Glimpses(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def move(run: Replay) -> Ending:
    """Integrate until the motion rests, arrives, releases its contacts or fails."""
    start = run.values
    run.h = min(run.h, run.tolerances.first_step)
    while True:
        while run.wanted[run.next_wanted] <= run.t:
            run.next_wanted += 1
        target = min(run.stop, run.wanted[run.next_wanted])
        try:
            h, whole = run.try_step(target, run.happens)
        except StuckError:
            run.fail_to_step(float(run.s.outputs[run.s.to.ratio]))
        arrives = run.happens()
        ending = None
        if arrives and not (whole and _is_at_end(run, target)):
            ending = _stop_at_event(run, start, h)
        else:
            run.keep(target if whole else run.t + h, arrives)
            if whole and target == run.stop:
                ending = _pass_break(run)
        if ending is not None:
            return ending
        start = run.values


def _is_at_end(run: Replay, t: float) -> bool:
    """Whether the step just tried ends the phase, at a torque break and but for rounding.

    It has to be at rest there or to reach a contact softly. A coordinate, or the end of a contact's
    range, is passed at any speed; an impact comes at any, with its torque step or at their end.
    """
    if t != run.stop or not is_there(run) or _comes_later(run):
        return False
    speed = abs(_measure_rate(run))
    if run.passes:
        distance = run.distance / run.until_unit
        # Of several breaks as near as that, the nearest is the one at which the phase ends.
        later = run.breaks[run.piece + 2 : run.piece + 3]
        apart = (later[0] - t) / run.problem.scene.scales.time if len(later) else math.inf
        early = min(SETTLING, apart / 2)
        speed = 0.0 if -SETTLING * speed <= distance <= early * speed else math.inf
    elif run.phase.end is End.IMPACT and _strikes(run):
        coming = run.piece + 1
        speed = 0.0 if coming >= len(run.steps_at) or run.steps_at[coming] else speed
    elif run.phase.end is not End.SMOOTH and run.formation.n_constraints < 4:
        units = measure_units(run.problem.scene)[5:]
        speed = float(np.abs(run.s.outputs[5:10] / units).max())
    presses = bool(run.values[run.leg.rows.force].min() >= -ROUNDING_FORCE)
    return speed < SLOW and presses and not find_slipping(run)


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
    if _is_at_end(run, run.t):
        rate, strikes = -run.rate, _strikes(run)
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
    rows = run.leg.rows
    kinds = find_first(run, start, h)
    run.keep(run.t + float(run.s.inputs[run.s.at.h]))
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
            limit = open_limits(run.formation, run.phase.until)[k - rows.limit.start]
            text = f"{limit.text} {run.when()}"
            run.note(EventKind.LIMIT, text)
            return Outcome(OutcomeKind.LIMIT_REACHED, text)
    return turn(run, kinds)


def _reach(run: Replay) -> Arrival:
    """The end of the phase is reached while moving."""
    # A planned motion that comes this early by its error would have stopped v / a later.
    stopping = 2 * _time_to_stop(run)
    remaining = min(stopping, run.tolerances.longest_window) if stopping < math.inf else 0.0
    slow = abs(_measure_rate(run)) < SLOW
    window = max(remaining, run.tolerances.settling) if slow else remaining
    return Arrival(-run.rate, window, remaining=remaining)


def _measure_rate(run: Replay) -> float:
    """Time derivative of the distance to the end of the phase, in units of the scene."""
    return run.rate / run.until_unit * run.problem.scene.scales.time


def _time_to_stop(run: Replay) -> float:
    """Time in which the motion would stop at its present deceleration [s]."""
    v, acceleration = run.s.outputs[5:10], run.s.outputs[run.s.to.acceleration]
    slowing = -float((run.system.mass * v) @ acceleration)
    return float(run.system.mass @ v**2) / slowing if slowing > 0 else math.inf


def _strikes(run: Replay) -> bool:
    """Whether the phase ends here with an impact, and not at rest but for an error."""
    rate, time = -_measure_rate(run), _time_to_stop(run) / run.problem.scene.scales.time
    stops = rate < SLOW or rate * time / 2 < REACHED
    return run.phase.end is End.IMPACT and not stops


def _pass_on(run: Replay) -> Arrival:
    """The end of a phase is passed; the torques of the next one may still have to come."""
    window = settling = run.tolerances.settling
    rate, strikes = -run.rate, run.phase.end is End.IMPACT
    if run.passes and rate > 0:
        # A motion that is off by rounding comes the earlier the slower it is.
        early = PASSED * run.until_unit / rate
        window = min(max(early, settling), run.tolerances.longest_window)
    elif run.phase.until.contact is not None and not strikes:
        run.step_to(settling)
        slowing = (run.rate + rate) / settling
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
    formation, until, moves = phase.formation, phase.until, run.moving
    run.phase, old = phase, run.system.stored(run.z, run.v)
    run.y[:5] = _close(run, formation)
    v = project_velocity(formation, run.z, run.v) if moves else np.zeros(5)
    run.moving = moves and not is_slower(run.problem.scene, v, STANDING)
    run.y[5:10] = v if run.moving else 0.0
    run.impact += float(old - run.system.stored(run.z, run.v))
    # At any speed a contact can be gained only where it goes on for another one.
    gained = until.contact
    run.passes = phase.end is End.SMOOTH and (
        gained is None or takes_over(gained, formation.scene, formation.contacts)
    )
    run.enter(phase)
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
        return close_contacts(formation, run.z, 10 * REACHED * run.problem.scene.scales.length)
    except SimulationError as error:
        raise SimulationError(f"{error} {run.where()}") from None


def collide(run: Replay, following: Phase) -> Outcome | None:
    """Plastic impact onto the next formation; the outcome if it is not possible."""
    z = _close(run, following.formation)
    impact = compute_impact(run.formation, following.formation, z, run.v)
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
    run.set_velocity(impact.v)
    return None


def project_velocity(formation: Formation, z: Array, v: Array) -> Array:
    """Velocity nearest to `v` in the metric M5 that keeps every constraint, shape (5,)."""
    P = formation.evaluate(z[None], v[None]).P[0]
    return solve_impulses(formation.scene.mass_diagonal, P, P, v)[0]


def set_off(run: Replay, departure: StartDeparture) -> None:
    """Set the friction signs of a motion that starts from rest."""
    formation = run.formation
    grips = find_grips(formation, np.concatenate(departure.directions))
    if formation.n_constraints < 4:
        rows = formation.evaluate(run.z[None], run.v[None])
        fixed = find_fixed(share_mode(formation, grips), rows.A[0], rows.A_t[0])
        run.stuck = {row for u in list_units(formation) for row in u.rows if u.grips and fixed[row]}
    if grips != run.leg.mode.grips:
        run.take(grips)
    run.signs, run.heading = np.concatenate(departure.directions), departure.heading
    run.observe()


def go_on(run: Replay) -> Ending | None:
    """Set the friction signs of the present velocity; what ends the motion at once, if anything."""
    formation, v = run.formation, run.v
    run.heading = v / np.sqrt(run.system.mass @ v**2)
    rates = np.concatenate([formation.evaluate(run.z[None], v[None]).A_t[0] @ v, v[3:]])
    signs = np.where(rates < 0, -1.0, 1.0)
    for row, name in enumerate(formation.names):
        signs[row] = run.slip_signs.get(name, signs[row])
    run.slip_signs = {}
    movable = {row for unit in list_units(formation) for row in unit.rows}
    signs[[row for row in range(len(signs)) if row not in movable]] = 0.0
    run.signs = signs
    if formation.n_constraints < 4:
        return restart(run, enters=True)
    slow = STANDING * measure_rates(run.problem.scene, formation.n_contacts)
    still = np.flatnonzero((np.abs(rates) < slow) & (signs != 0)).tolist()
    for choice in product((1.0, -1.0), repeat=len(still)):
        tried = signs.copy()
        tried[still] *= choice
        run.signs = tried
        run.look()
        if run.s.outputs[run.s.to.ratio] > 0:
            break
    else:
        run.signs = signs
    return restart(run)


def look_within(run: Replay, times: Array) -> list[float]:
    """Record states at increasing instants, (n,) [s], within steps; those of missed events."""
    missed: list[float] = []
    begins = np.array([step.t for step in run.taken])
    owners = np.searchsorted(begins, times, side="left") - 1
    for time, owner in zip(times.tolist(), owners.tolist(), strict=True):
        step = run.taken[max(owner, 0)] if run.taken else None
        if step is None or owner < 0 or time - step.t >= step.h:
            continue
        leg, s = step.leg, step.leg.stepper
        s.inputs[:] = step.inputs
        s.inputs[s.at.h] = time - step.t
        s.step()
        run.records.append(Record.of(s, time, leg.phase, leg.section, step.impact))
        # Within a step more counts as rounding than at its end.
        rows, slack = leg.rows, leg.slack.copy()
        slack[rows.turning] = slack[rows.speed] = STANDING
        slack[rows.until] = ROUNDING_LIMIT
        leg.heading[:] = step.heading
        leg.measure()
        short = leg.event_values[: len(slack)] + slack < 0
        if step.arrives:
            # The end of the phase may be passed.
            short[rows.until] = short[rows.speed] = short[rows.turning] = False
        if short.any():
            missed.append(time)
    return missed


def restart(
    run: Replay, turned: Sequence[int] = (), *, time: float | None = None, enters: bool = False
) -> Ending | None:
    """Choose contact modes after forces jump and record them; what ends the motion, if that does.

    `turned`: contacts, then joints, that came to rest at `time` [s]; `enters`: a new formation.
    """
    stuck = run.stuck
    if _decide(run, turned, time=time, enters=enters):
        return come_to_rest(run)
    run.observe()
    if _bridge(run):
        return come_to_rest(run)
    s, holders = run.s, run.leg.mode.holders
    if not s.outputs[s.to.ratio] > 0:
        run.fail_to_step(float(s.outputs[s.to.ratio]))
    if not enters and run.resting and run.resting <= run.stuck:
        # A planned motion may all but come to rest a little before the torques step; until they do
        # it may slip and stick again.
        window = min(run.tolerances.longest_window, run.t - run.last_step)
        rested = run.resting <= stuck
        if run.has_slid if rested else not steps_within(run, window):
            return _hold(run)
        run.has_slid |= not rested
    slipping = {holders[k][0] for k in find_slipping(run)}
    pulling = np.flatnonzero(s.outputs[s.to.c_n] < -run.tolerances.force)
    # Whether anything pulls where a contact slips by plan, its next formation says.
    if len(pulling) and not slipping & run.slipping:
        return let_go(run, pulling.tolist())
    return slip(run) if slipping else None


def _decide(
    run: Replay, turned: Sequence[int], *, time: float | None = None, enters: bool = False
) -> bool:
    """Choose the modes of contacts and joints at rest; whether all motion has ended.

    With one freedom whatever slides or turns does so for as long as there is motion.
    """
    if run.formation.n_constraints < 4:
        return choose_mode(run, turned, time=time, enters=enters)
    signs = run.signs
    for row in turned:
        signs[row] *= -1
        note_change(run, row, -signs[row], signs[row], run.t if time is None else time)
    run.signs = signs
    return False


def come_to_rest(run: Replay) -> Rested | Switched:
    """End all motion, and the phase if a contact was to come to rest."""
    if not is_there(run):
        run.note(EventKind.REST, f"the object comes to rest {run.when()}")
    return _hold(run) if run.resting else Rested()


def _hold(run: Replay) -> Switched:
    return Switched(", ".join(run.formation.names[row] for row in sorted(run.resting)))


def _drop_repeated(run: Replay) -> None:
    """Take back forces after a jump that are those of a formation that is given up."""
    if run.repeats():
        run.records.pop()


def let_go(run: Replay, contacts: Sequence[int]) -> Released | Outcome:
    """End as contacts would have to pull: a release if that is planned of one of them."""
    names = run.formation.names
    forces = dict(zip(names, run.s.outputs[run.s.to.c_n].tolist(), strict=True))
    pulling = [names[k] for k in contacts]
    if any(name in run.releasable for name in pulling):
        _drop_repeated(run)
        return Released(min(forces[name] for name in run.releasable))
    name = min(pulling, key=forces.__getitem__)
    return run.lose(name, min(0.0, forces[name]))


def slip(run: Replay) -> Released | Switched | Outcome:
    """End because a rolling contact slips, or starts to part where its release is planned."""
    s, mode = run.s, run.leg.mode
    cones = _measure_reserves(run)
    declared = [k for k in range(len(cones)) if mode.declares(k)]
    planned = [k for k in find_slipping(run) if mode.holders[k][0] in run.slipping]
    row = mode.holders[min(planned or declared, key=cones.__getitem__)][0]
    name = run.formation.names[row]
    if name in run.releasable:
        return let_go(run, [row])
    c_n, c_t = (float(s.outputs[part][row]) for part in (s.to.c_n, s.to.c_t))
    if row in run.slipping:
        _drop_repeated(run)
        return Switched(name, -math.copysign(1.0, c_t))
    return run.slip(row, c_n, c_t)


def let_slip(run: Replay, events: Sequence[int]) -> Ending | None:
    """Go on after friction has reached its bound; a prescribed rolling contact must not slip."""
    mode, cone = run.leg.mode, run.leg.rows.cone
    bounds = [(k - cone.start) % len(mode.holders) for k in events if cone.start <= k < cone.stop]
    if any(map(mode.declares, bounds)):
        return slip(run)
    return restart(run, _find_turning(run, events))


def _find_turning(run: Replay, events: Sequence[int]) -> list[int]:
    """Contacts, then joints, whose sliding or turning is among events."""
    turning = run.leg.rows.turning
    return [k - turning.start for k in events if turning.start <= k < turning.stop]


def _measure_reserves(run: Replay) -> list[float]:
    """Friction margin of each contact and joint that sticks, over the scene's force or torque."""
    reserves: list[float] = run.values[run.leg.rows.cone].reshape(2, -1).min(axis=0).tolist()
    return reserves


def find_slipping(run: Replay) -> list[int]:
    """Which contacts that the phase lets roll are out of their cones."""
    reserves, mode = _measure_reserves(run), run.leg.mode
    return [k for k, x in enumerate(reserves) if x < -ROUNDING_FORCE and mode.declares(k)]


def turn(run: Replay, events: Sequence[int]) -> Ending | None:
    """Go on where contacts or joints have come to rest; None if the motion goes on."""
    now, window = run.t, run.tolerances.rest_window
    # With two freedoms the last speeds fall to zero one after the other by rounding.
    if (
        run.formation.n_constraints < 4
        and run.phase.end is End.REST
        and is_there(run)
        and is_slower(run.problem.scene, run.v, SLOW)
        and run.stop - now <= window
    ):
        return Arrival(-run.rate, window)
    if steps_within(run, run.tolerances.settling):
        _finish_piece(run)
    return restart(run, _find_turning(run, events), time=now)


def _finish_piece(run: Replay) -> None:
    """Step to the torque step, without a record of the forces on the way."""
    coast_to_step(run, hide=True)
    run.records.pop()
    run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")


def steps_within(run: Replay, window: float) -> bool:
    """Whether the torques step soon."""
    return run.coming_step - run.t <= window


def coast(run: Replay, stop: float, hide: bool) -> None:
    """Step to `stop`, whatever happens on the way; `hide` leaves out the forces on the way."""
    while run.wanted[run.next_wanted] < stop:
        place = run.wanted[run.next_wanted]
        run.step_to(place - run.t)
        run.accept(place)
        if hide:
            row = run.records[-1]
            none = np.full(len(row.kept), np.nan)
            run.records[-1] = row._replace(c_n=none, c_t=none)
        run.next_wanted += 1
    run.step_to(stop - run.t)
    run.accept(stop)


def coast_to_step(run: Replay, hide: bool) -> None:
    """Step to where the torques step next, as `coast` does, and go on to the piece from there."""
    while True:
        coast(run, run.stop, hide)
        if run.next_piece():
            return
        run.records.pop()


def is_there(run: Replay) -> bool:
    """Whether the distance to the end of the phase counts as none, at rest."""
    return abs(run.distance) < REACHED * run.until_unit


def _bridge(run: Replay) -> bool:
    """Integrate from a reversal to its torque step, unrecorded; whether all motion has ended."""
    rows: list[int] = []
    if steps_within(run, run.tolerances.settling):
        run.records.pop()
        _finish_piece(run)
    elif _goes_on(run):
        return False
    else:
        start = run.values
        stretch = min(run.tolerances.settling, run.stop - run.t)
        run.step_to(stretch)
        rows = _find_turning(run, find_first(run, start, stretch, run.leg.rows.turning))
        if not rows:
            run.look()
            return False
        run.records.pop()
        coast(run, run.t + float(run.s.inputs[run.s.at.h]), hide=True)
        run.records.pop()
    ended = _decide(run, rows)
    run.observe()
    return ended


def _goes_on(run: Replay) -> bool:
    """Whether all that slides or turns is far too fast to come to rest in the shortest time."""
    out, units = run.s.outputs, run.system.units[5:]
    fastest = np.abs(out[5:10] / units).max()
    strongest = np.abs(out[run.s.to.acceleration] / units).max() * run.system.scales.time
    least = _FAR * SETTLING * (strongest + fastest**2)
    return bool((run.values[run.leg.rows.turning][run.signs != 0] > least).all())
