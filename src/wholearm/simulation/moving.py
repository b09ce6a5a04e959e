"""A formation in motion: integrate its equations from event to event."""

from __future__ import annotations

import math

import numpy as np

from ..common.arrays import Array
from ..problem.definition import End
from .events import EventKind, Outcome, OutcomeKind, Step
from .jumps import (
    Arrival,
    Ending,
    coast_to_step,
    come_to_rest,
    find_slipping,
    is_there,
    let_go,
    let_slip,
    look_again,
    steps_within,
    turn,
)
from .locate import find_first
from .replay import Replay
from .runge_kutta import ORDER
from .tolerances import CREEPING, PASSED, REACHED, SETTLING, SHORTEST_STEP, SLOW, measure_units

_GROWTH = 40.0
"""Largest growth of a step: at order 8 an error of 1e-13 of the tolerance allows it."""


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
    """Take the step just made, to time `t`; `arrives`: the end of the phase is passed by rounding.

    It is kept, so that more can be seen of what lies within it.
    """
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
    """Whether the step just tried ends at the end of the phase, and at a torque break.

    By rounding a planned motion ends a little beyond the end of its phase, or has just turned back.
    It has to be at rest there, or to reach a contact softly; a coordinate, or the end of a
    contact's range, is passed at any speed, just then, and an impact comes at any, with the step of
    the torques that goes with it, or as they end. A motion that is about to stop instead may step
    its torques before it is there.
    """
    s = run.stepper
    if t != run.breaks[run.piece + 1] or not is_there(run) or _comes_later(run):
        return False
    speed = abs(_measure_rate(run))
    if run.passes:
        speed = 0.0 if _is_passing(run) else math.inf
    elif run.phase.end is End.IMPACT and _strikes(run):
        coming = run.piece + 1
        speed = 0.0 if coming >= len(run.steps_at) or run.steps_at[coming] else speed
    elif run.phase.end is not End.SMOOTH and s.formation.n_constraints < 4:
        units = measure_units(run.problem.scene)[5:]
        speed = float(np.abs(s.outputs[s.to.y][5:10] / units).max())
    pressing = s.outputs[s.to.events][s.rows.force]
    return speed < SLOW and bool(pressing.min() >= -run.tolerances.force) and not find_slipping(s)


def _is_passing(run: Replay) -> bool:
    """Whether a motion that passes the end of a phase is there but for rounding of the time."""
    distance = abs(run.value(run.stepper.rows.until)) / run.until_unit
    return distance <= SETTLING * abs(_measure_rate(run))


def _comes_later(run: Replay) -> bool:
    """Whether a motion whose deceleration fades still comes nearer, at a break that is not its end.

    It is slow, and near the end of its phase, long before it is there. What slow motors do not make
    step may have breaks anywhere, as tables of torques do. What comes within the time for which
    a formation is held at rest may as well be there.
    """
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
    return look_again(run)


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
    left = min(stopping, run.tolerances.longest_window) if stopping < math.inf else 0.0
    slow = abs(_measure_rate(run)) < SLOW
    return Arrival(rate, max(left, run.tolerances.settling) if slow else left, left=left)


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
    """Whether the phase ends with an impact here, and not at rest but for an error of the motion.

    Where impulses do not allow an impact a planned motion stops instead.
    """
    rate, time = -_measure_rate(run), _time_to_stop(run) / run.problem.scene.scales.time
    stops = rate < SLOW or rate * time / 2 < REACHED
    return run.phase.end is End.IMPACT and not stops


def _pass_on(run: Replay) -> Arrival:
    """The end of a phase is reached that the motion passes.

    If a planned motion comes early by its error, the torques of the next formation have still to
    come. Until then the old one's contacts go on, while the gap dips below zero by that error.
    """
    s = run.stepper
    s.inputs[s.at.t] = run.t
    rate, settling = -float(s.outputs[s.to.until_rate]), run.tolerances.settling
    window = settling
    strikes = run.phase.end is End.IMPACT
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
