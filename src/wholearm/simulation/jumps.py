"""Instants at which forces jump: reversals, torque steps, contacts let go or held by friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..problem import End
from .events import EventKind, Outcome
from .locate import find_first
from .replay import Replay
from .stepper import SLACK_FORCE, Stepper

REACHED = 1e-6
"""Distance to the end of a phase that counts as there, when at rest [m or rad]."""
SLOW = 1e-4
"""Speed that counts as rest at the end of a phase [m/s or rad/s]."""
SETTLING = 1e-6
"""How long before a torque break a planned arrival may come by rounding [s]."""
REST_WINDOW = 1e-4
"""How long before a torque break a formation at rest is held, whatever the torques [s]: too short
for its contacts to part by more than what counts as touching."""


@dataclass(frozen=True)
class Arrival:
    """The end of a phase is reached.

    Attributes
    ----------
    rate : float, [m/s or rad/s]
        How fast the distance to the phase's end closes.
    window : float, [s]
        If the next break of the torques is no further off, the arrival belongs to it.
    strikes : bool
        Whether it takes an impact to go on.
    """

    rate: float
    window: float
    strikes: bool = False


@dataclass(frozen=True)
class Released:
    """The contacts that the next phase does not have are let go.

    Attributes
    ----------
    c_n : float, [N]
        The least that the old formation would need of them.
    """

    c_n: float


class Rested:
    """The motion has come to rest."""


Ending = Arrival | Released | Rested | Outcome


def look_again(run: Replay, turned: Sequence[int] = ()) -> Ending | None:
    """Record the forces after they jump; what ends the motion, if that does.

    Parameters
    ----------
    run : Replay
    turned : sequence of int
        Rows of the event values that have just changed direction.
    """
    s = run.stepper
    run.record()
    held = find_held(run, turned)
    if not held:
        turned = _bridge(run)
        held = find_held(run, turned)
    if not s.outputs[s.to.ratio] > 0:
        run.fail_to_step(float(s.outputs[s.to.ratio]))
    forces = s.outputs[s.to.c_n]
    if forces.min() < -SLACK_FORCE:
        return let_go(run, np.flatnonzero(forces < -SLACK_FORCE).tolist())
    cones = s.outputs[s.to.events][s.rows.cone]
    if (cones < -SLACK_FORCE).any():
        return slip(run)
    return _hold(run, held[0]) if held else None


def let_go(run: Replay, contacts: Sequence[int]) -> Released | Outcome:
    """End because contacts would have to pull: a release if that is planned of one of them.

    The next formation then decides whether the others press, and whether the released ones part.
    """
    s = run.stepper
    forces = dict(zip(s.formation.names, s.outputs[s.to.c_n].tolist(), strict=True))
    pulling = [s.formation.names[k] for k in contacts]
    if any(name in run.releasable for name in pulling):
        # Forces recorded after a jump are those of a formation that is given up.
        times = run.sections[-1].times
        if len(times) > 1 and times[-2] == run.t:
            run.drop()
        return Released(min(forces[name] for name in run.releasable))
    name = min(pulling, key=forces.__getitem__)
    return run.lose(name, min(0.0, forces[name]))


def slip(run: Replay) -> Released | Outcome:
    """End because a rolling contact slips, or starts to part where its release is planned."""
    s = run.stepper
    formation = s.formation
    cones = s.outputs[s.to.events][s.rows.cone]
    row = formation.rolling_rows[int(cones.argmin()) % formation.n_rolling]
    if formation.names[row] in run.releasable:
        return let_go(run, [row])
    return run.slip(row, float(s.outputs[s.to.c_n][row]), float(s.outputs[s.to.c_t][row]))


def turn(run: Replay, rows: Sequence[int]) -> Ending | None:
    """Reverse contacts and joints whose speed has just come to zero; None if the motion goes on.

    Planned torques step where friction does. If the step comes a little later, by rounding, it is
    waited for with the old friction: the new one could hold what is to reverse.
    """
    s = run.stepper
    s.inputs[s.at.t] = now = run.t
    window = SETTLING
    if s.is_free:
        if _is_settled(run):
            return Arrival(-float(s.outputs[s.to.until_rate]), REST_WINDOW)
        _flip(s, rows)
        s.look()
        if find_held(run, rows):
            window = REST_WINDOW
        _flip(s, rows)
        s.look()
    stepped = steps_within(run, window)
    if stepped:
        coast_to_step(run, hide=True)
        run.drop()
    _flip(s, rows)
    for row in rows:
        _note_reversal(run, row, now)
    if stepped:
        run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")
    return look_again(run, rows)


def find_held(run: Replay, rows: Sequence[int]) -> list[int]:
    """Which of the contacts and joints that start to slide or turn are pushed back by friction.

    Only with two or more freedoms can one of them stop while the rest moves.
    """
    s = run.stepper
    if not rows or not s.is_free:
        return []
    before = s.outputs[s.to.events].copy()
    run.step_to(SETTLING)
    after = s.outputs[s.to.events].copy()
    s.look()
    return [k for k in rows if after[k] < min(before[k], 0.0) - s.slack[k]]


def steps_within(run: Replay, window: float) -> bool:
    """Whether the torques step soon."""
    return run.coming_step - run.t <= window


def coast(run: Replay, stop: float, hide: bool) -> None:
    """Step to `stop`, whatever happens on the way; `hide` leaves out the forces on the way."""
    to = run.stepper.to
    while run.wanted[run.next_wanted] < stop:
        place = run.wanted[run.next_wanted]
        run.step_to(place - run.t)
        row = run.accept(place)
        if hide:
            row[to.c_n] = row[to.c_t] = np.nan
        run.stepper.inputs[run.stepper.at.t] = place
        run.next_wanted += 1
    run.step_to(stop - run.t)
    run.accept(stop)


def coast_to_step(run: Replay, hide: bool) -> None:
    """Step to where the torques step next, as `coast` does, and go on to the piece from there."""
    while True:
        coast(run, run.breaks[run.piece + 1], hide)
        if run.next_piece():
            return
        run.drop()
        run.stepper.inputs[run.stepper.at.t] = run.t


def _hold(run: Replay, row: int) -> Rested | Outcome:
    """End because friction holds a contact or a joint: at rest everything stops."""
    s = run.stepper
    if np.abs(run.y[5:10]).max() < SLOW:
        run.note(EventKind.REST, f"the object comes to rest {run.when()}")
        return Rested()
    return run.stay(name_row(s, row))


def _is_settled(run: Replay) -> bool:
    """Whether everything has all but stopped at the end of the phase, just before a torque break.

    With two freedoms the last speeds fall to zero one after the other by rounding.
    """
    return (
        run.phase.end is End.REST
        and abs(run.value(run.stepper.rows.until)) < REACHED
        and bool(np.abs(run.y[5:10]).max() < SLOW)
        and run.breaks[run.piece + 1] - run.t <= REST_WINDOW
    )


def _bridge(run: Replay) -> list[int]:
    """Pass over the instant between a reversal and the step of the torques that goes with it.

    Planned torques step where friction does, but by rounding the two come one after the other, and
    in between the forces are those of neither. That instant is integrated like any other, but its
    forces are not recorded. Returns the rows that have changed direction.
    """
    s = run.stepper
    if steps_within(run, SETTLING):
        run.drop()
        coast_to_step(run, hide=True)
        run.drop()
        run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")
        run.record()
        return []
    start = run.sections[-1].rows[-1]
    stretch = min(SETTLING, run.breaks[run.piece + 1] - run.t)
    run.step_to(stretch)
    rows = find_first(run, start, stretch, _turning(s))
    if not rows:
        s.look()
        return []
    _cross(run, run.t + float(s.inputs[s.at.h]))
    _flip(s, rows)
    for row in rows:
        _note_reversal(run, row, run.t)
    run.record()
    return rows


def _cross(run: Replay, stop: float) -> None:
    """Step to `stop` without a record of the forces on the way, the present ones included."""
    run.drop()
    coast(run, stop, hide=True)
    run.drop()


def _turning(s: Stepper) -> range:
    """Rows of the event values that change sign at a reversal."""
    return range(s.rows.slide.start, s.rows.joint.stop)


def name_row(s: Stepper, row: int) -> str:
    """Name of the contact or the joint of a row that changes sign at a reversal."""
    if row < s.rows.slide.stop:
        return str(s.formation.names[row - s.rows.slide.start])
    return f"joint {row - s.rows.joint.start + 1}"


def _flip(s: Stepper, rows: Sequence[int]) -> None:
    """Change the directions of contacts and joints."""
    for row in rows:
        if row < s.rows.slide.stop:
            s.inputs[s.at.Xi.start + row - s.rows.slide.start] *= -1
        else:
            s.inputs[s.at.sigma.start + row - s.rows.joint.start] *= -1


def _note_reversal(run: Replay, row: int, time: float) -> None:
    name = name_row(run.stepper, row)
    verb = "slides" if row < run.stepper.rows.slide.stop else "turns"
    text = f"{name} {verb} the other way at t = {time:.5g} s, phase {run.phase.number}"
    run.note(EventKind.REVERSAL, text, name, time=time)
