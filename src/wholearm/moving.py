"""A formation in motion: integrate its equations from event to event."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .events import EventKind, Outcome, OutcomeKind
from .model import Array
from .replay import FIRST_STEP, Replay
from .rungekutta import ORDER
from .stepper import SLACK_FORCE, Stepper
from .sticking import Departure

REACHED = 1e-6
"""Distance to the end of a phase that counts as there, when at rest [m or rad]."""
SLOW = 1e-4
"""Speed that counts as rest at the end of a phase [m/s or rad/s]."""
SETTLING = 1e-6
"""How long before a torque break a planned arrival may come by rounding [s]."""
REST_WINDOW = 1e-4
"""How long before a torque break a formation at rest is held, whatever the torques [s]: too short
for its contacts to part by more than what counts as touching."""
LONGEST_WINDOW = 1e-3
"""How long before a torque break an arrival at a speed may come and still belong to it [s]."""
SHORTEST_STEP = 1e-14
"""Step below which the integration gives up, relative to the time [s]."""


@dataclass(frozen=True)
class Arrival:
    """The end of a phase is reached.

    Attributes
    ----------
    rate : float, [m/s or rad/s]
        How fast the distance to the phase's end closes.
    window : float, [s]
        If the next break of the torques is no further off, the arrival belongs to it.
    """

    rate: float
    window: float


class Rested:
    """The motion has come to rest."""


Ending = Arrival | Rested | Outcome


def move(run: Replay, departure: Departure) -> Ending:
    """Integrate from rest until the motion rests, arrives or fails."""
    s, way = run.stepper, departure.direction
    inputs, outputs, at, to = s.inputs, s.outputs, s.at, s.to
    inputs[at.Xi], inputs[at.sigma] = way.directions
    inputs[at.heading] = way.heading
    run.note(EventKind.START, f"the object starts to move {run.when()}")
    start = run.record()
    run.h = min(run.h, FIRST_STEP)
    while True:
        target = min(run.breaks[run.piece + 1], run.wanted[run.next_wanted])
        h, whole = _try_step(run, target)
        if outputs[to.worst] < 0 and not (whole and _is_there(run, target)):
            ending = _stop_at_event(run, start, h)
            if ending is not None:
                return ending
            start = outputs.copy()
            continue
        start = run.accept(target if whole else run.t + h)
        if not whole:
            continue
        if target == run.wanted[run.next_wanted]:
            run.next_wanted += 1
        if target == run.breaks[run.piece + 1]:
            ending = _pass_break(run)
            if ending is not None:
                return ending
            start = outputs.copy()


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
        sudden = outputs[to.dip] < -1e-6 and outputs[to.worst] >= 0 and h > 1e-7
        if error <= 1 and not sudden:
            grown = h * (5.0 if error < 1e-6 else min(5.0, 0.9 * error ** (-1 / ORDER)))
            run.h = grown if h == run.h else max(run.h, grown)
            run.steps += 1
            return h, whole
        run.rejected += 1
        factor = 0.9 * error ** (-1 / ORDER) if error > 1 else 0.2
        run.h = h * (0.5 if error <= 1 else max(0.2, factor))
        if run.h < SHORTEST_STEP * max(1.0, abs(run.t)):
            run.fail_to_step(float(outputs[to.ratio]))


def _is_there(run: Replay, t: float) -> bool:
    """Whether the step just tried ends at the end of the phase, at rest and at a torque break.

    By rounding a planned motion ends a little beyond the end of its phase, or has just turned back.
    """
    s = run.stepper
    return (
        t == run.breaks[run.piece + 1]
        and abs(run.value(s.rows.until)) < REACHED
        and abs(float(s.outputs[s.to.until_rate])) < SLOW
        and bool(s.outputs[s.to.c_n].min() >= -SLACK_FORCE)
    )


def _pass_break(run: Replay) -> Ending | None:
    """Go on to the next piece of the torques."""
    s = run.stepper
    if _is_there(run, run.t):
        rate = float(s.outputs[s.to.until_rate])
        if run.piece + 2 < len(run.breaks):
            run.next_piece()
        return Arrival(-rate, SETTLING)
    if run.t >= run.breaks[-1]:
        return run.run_out()
    if not run.next_piece():
        return None
    run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")
    return _look_again(run)


def _look_again(run: Replay) -> Outcome | None:
    """Record the forces after they jump; the outcome if a contact is lost by the jump."""
    s = run.stepper
    run.record()
    if _bridge(run):
        run.record()
    if not s.outputs[s.to.ratio] > 0:
        run.fail_to_step(float(s.outputs[s.to.ratio]))
    forces = s.outputs[s.to.c_n]
    if forces.min() >= -SLACK_FORCE:
        return None
    index = int(forces.argmin())
    return run.lose(s.formation.names[index], float(forces[index]))


def _bridge(run: Replay) -> bool:
    """Pass over the instant between a reversal and the step of the torques that goes with it.

    Planned torques step where friction does, but by rounding the two come one after the other, and
    in between the forces are those of neither. That instant is integrated like any other, but its
    forces are not recorded.
    """
    s = run.stepper
    remaining = run.breaks[run.piece + 1] - run.t
    coming = run.piece + 1
    if remaining <= SETTLING and coming < len(run.steps_at) and run.steps_at[coming]:
        _cross(run, run.breaks[coming])
        run.next_piece()
        run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")
        return True
    start = run.sections[-1].rows[-1]
    stretch = min(SETTLING, remaining)
    run.step_to(stretch)
    kinds = _find_first(run, start, stretch, _turning(s))
    if not kinds:
        s.look()
        return False
    _cross(run, run.t + float(s.inputs[s.at.h]))
    for k in kinds:
        _reverse(run, k)
    return True


def _cross(run: Replay, stop: float) -> None:
    """Step to `stop` without a record of the forces on the way, the present ones included."""
    run.drop()
    to = run.stepper.to
    while run.wanted[run.next_wanted] < stop:
        place = run.wanted[run.next_wanted]
        run.step_to(place - run.t)
        row = run.accept(place)
        row[to.c_n] = row[to.c_t] = np.nan
        run.stepper.inputs[run.stepper.at.t] = place
        run.next_wanted += 1
    run.step_to(stop - run.t)
    run.accept(stop)
    run.drop()


def _turning(s: Stepper) -> range:
    """Rows of the event values that change sign at a reversal."""
    return range(s.rows.slide.start, s.rows.joint.stop)


def _stop_at_event(run: Replay, start: Array, h: float) -> Ending | None:
    """End the step at the first event within it; None if the motion goes on."""
    s = run.stepper
    rows = s.rows
    kinds = _find_first(run, start, h)
    run.accept(run.t + float(s.inputs[s.at.h]))
    if rows.until in kinds:
        return _reach(run)
    if rows.speed in kinds:
        if abs(run.value(rows.until)) >= REACHED:
            run.note(EventKind.REST, f"the object comes to rest {run.when()}")
        return Rested()
    for k in kinds:
        if k < rows.force.stop:
            return run.lose(s.formation.names[k], 0.0)
        if rows.limit.start <= k < rows.limit.stop:
            text = f"{run.limits[k - rows.limit.start]} {run.when()}"
            run.note(EventKind.LIMIT, text)
            return Outcome(OutcomeKind.LIMIT_REACHED, text)
    for k in kinds:
        _reverse(run, k)
    return _look_again(run)


def _reach(run: Replay) -> Arrival:
    """The end of the phase is reached while moving."""
    s = run.stepper
    rate = -float(s.outputs[s.to.until_rate])
    heading = run.problem.scene.mass_diagonal * s.outputs[s.to.heading]
    slowing = -float(heading @ s.outputs[s.to.acceleration])
    speed = float(heading @ s.outputs[s.to.y][5:10])
    # A planned motion that comes this early by its error would have stopped v / a later.
    window = min(2 * speed / slowing, LONGEST_WINDOW) if slowing > 0 else 0.0
    if abs(rate) < SLOW:
        window = max(window, SETTLING)
    return Arrival(rate, window)


def _reverse(run: Replay, row: int) -> None:
    """Flip the direction of a contact or a joint."""
    s = run.stepper
    if row < s.rows.slide.stop:
        index = row - s.rows.slide.start
        s.inputs[s.at.Xi.start + index] *= -1
        name = s.formation.names[index]
        run.note(EventKind.REVERSAL, f"{name} slides the other way {run.when()}", name)
    else:
        index = row - s.rows.joint.start
        s.inputs[s.at.sigma.start + index] *= -1
        name = f"joint {index + 1}"
        run.note(EventKind.REVERSAL, f"{name} turns the other way {run.when()}", name)


def _find_first(run: Replay, start: Array, h: float, among: range | None = None) -> list[int]:
    """Shorten the step just tried to the first event within it; returns the event's rows.

    Parameters
    ----------
    start : ndarray
        Outputs at the start of the step.
    h : float, [s]
    among : range, optional
        The rows to look at.
    """
    s = run.stepper
    rows, among = s.rows, among or range(s.rows.size)
    before = start[s.to.events]
    # A value that starts within rounding of zero has to fall below that.
    shift = np.where(before > s.slack, 0.0, s.slack)
    before = before + shift
    turning = slice(rows.slide.start, rows.joint.stop)
    seen: list[int] = []
    done: list[int] = []
    while True:
        after = s.outputs[s.to.events] + shift
        left = [k for k in among if after[k] < 0 and k not in done]
        if not left:
            return [k for k in seen if after[k] <= s.slack[k] or k == done[-1]]
        seen += [k for k in left if k not in seen]
        share = {k: before[k] / (before[k] - after[k]) for k in left}
        k = rows.speed if rows.speed in left else min(left, key=share.__getitem__)
        place, offset = s.to.events.start + k, float(shift[k])

        def value(step: float, place: int = place, offset: float = offset) -> float:
            run.step_to(step)
            return float(s.outputs[place]) + offset

        h = _find_root(value, h, float(before[k]), float(after[k]))
        done.append(k)
        if h != s.inputs[s.at.h]:
            run.step_to(h)
        if k == rows.speed:
            # When the motion stops all sliding does; what reversed before shows just before.
            run.step_to(0.999 * h)
            if (s.outputs[s.to.events][turning] + shift[turning] < 0).any():
                h *= 0.999
            else:
                run.step_to(h)


def _find_root(
    function: Callable[[float], float], high: float, f_low: float, f_high: float
) -> float:
    """Root in [0, high] of a function that falls from f_low >= 0 to f_high < 0, to rounding.

    The Illinois variant of regula falsi, which converges fast on the smooth functions here.
    """
    if f_low <= 0:
        return 0.0
    low = 0.0
    for _ in range(60):
        middle = high - f_high * (high - low) / (f_high - f_low)
        if not low < middle < high and not high < middle < low:
            break
        f_middle = function(middle)
        if f_middle == 0.0:
            return middle
        if f_middle * f_high < 0:
            low, f_low = high, f_high
        else:
            f_low /= 2
        close = abs(middle - high) <= 1e-16
        high, f_high = middle, f_middle
        if close:
            break
    return high
