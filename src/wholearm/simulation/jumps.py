"""Instants at which forces jump: reversals, torque steps, release, stick-slip transitions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..problem.definition import End
from .events import EventKind, Outcome
from .root_finding import find_first
from .sliding_signs import choose_mode, note_change
from .stepper import ModeStepper, Replay
from .tolerances import REACHED, SETTLING, SLOW, is_slower, measure_units

_FAR = 100.0  # speed over its change at which nothing reverses: lever arms are below that


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


def restart(
    run: Replay, turned: Sequence[int] = (), *, time: float | None = None, enters: bool = False
) -> Ending | None:
    """Choose contact modes after forces jump and record them; what ends the motion, if that does.

    `turned`: contacts, then joints, that came to rest at `time` [s]; `enters`: a new formation.
    """
    stuck = run.stuck
    if _decide(run, turned, time=time, enters=enters):
        return come_to_rest(run)
    run.record()
    if _bridge(run):
        return come_to_rest(run)
    s = run.stepper
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
    slipping = {s.mode.holders[k][0] for k in find_slipping(s)}
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
    if run.phase.formation.n_constraints < 4:
        return choose_mode(run, turned, time=time, enters=enters)
    s = run.stepper
    for row in turned:
        place = s.at.Xi.start + row
        before = float(s.inputs[place])
        s.inputs[place] = -before
        note_change(run, row, before, -before, run.t if time is None else time)
    return False


def come_to_rest(run: Replay) -> Rested | Switched:
    """End all motion, and the phase if a contact was to come to rest."""
    if not is_there(run):
        run.note(EventKind.REST, f"the object comes to rest {run.when()}")
    return _hold(run) if run.resting else Rested()


def _hold(run: Replay) -> Switched:
    return Switched(", ".join(run.phase.formation.names[row] for row in sorted(run.resting)))


def let_go(run: Replay, contacts: Sequence[int]) -> Released | Outcome:
    """End as contacts would have to pull: a release if that is planned of one of them."""
    s = run.stepper
    forces = dict(zip(s.formation.names, s.outputs[s.to.c_n].tolist(), strict=True))
    pulling = [s.formation.names[k] for k in contacts]
    if any(name in run.releasable for name in pulling):
        # Forces recorded after a jump are those of a formation that is given up.
        if run.repeats():
            run.drop()
        return Released(min(forces[name] for name in run.releasable))
    name = min(pulling, key=forces.__getitem__)
    return run.lose(name, min(0.0, forces[name]))


def slip(run: Replay) -> Released | Switched | Outcome:
    """End because a rolling contact slips, or starts to part where its release is planned."""
    s = run.stepper
    formation = s.formation
    cones = _measure_reserves(s)
    declared = [k for k in range(len(cones)) if s.mode.declares(k)]
    planned = [k for k in find_slipping(s) if s.mode.holders[k][0] in run.slipping]
    row = s.mode.holders[min(planned or declared, key=cones.__getitem__)][0]
    if formation.names[row] in run.releasable:
        return let_go(run, [row])
    c_n, c_t = (float(s.outputs[part][row]) for part in (s.to.c_n, s.to.c_t))
    if row in run.slipping:
        # Forces recorded after a jump are those of a contact that has rolled until then.
        if run.repeats():
            run.drop()
        return Switched(formation.names[row], -math.copysign(1.0, c_t))
    return run.slip(row, c_n, c_t)


def let_slip(run: Replay, events: Sequence[int]) -> Ending | None:
    """Go on after friction has reached its bound; a prescribed rolling contact must not slip."""
    s = run.stepper
    count = len(s.mode.holders)
    cone = range(s.rows.cone.start, s.rows.cone.stop)
    if any(s.mode.declares((k - cone.start) % count) for k in events if k in cone):
        return slip(run)
    return restart(run, [k - s.rows.slide.start for k in events if k in _turning(s)])


def _measure_reserves(s: ModeStepper) -> list[float]:
    """Friction margin of each contact and joint that sticks [N, N m]."""
    cones = s.outputs[s.to.events][s.rows.cone].reshape(2, -1)
    return [float(least) for least in cones.min(axis=0)]


def find_slipping(s: ModeStepper) -> list[int]:
    """Which contacts that the phase lets roll are out of their cones."""
    reserves = _measure_reserves(s) if s.mode.holders else []
    slack = -s.slack[s.rows.cone.start]
    return [k for k, least in enumerate(reserves) if least < slack and s.mode.declares(k)]


def turn(run: Replay, events: Sequence[int]) -> Ending | None:
    """Go on where contacts or joints have come to rest; None if the motion goes on."""
    s, window = run.stepper, run.tolerances.rest_window
    s.inputs[s.at.t] = now = run.t
    rows = [k - s.rows.slide.start for k in events if k in _turning(s)]
    # With two freedoms the last speeds fall to zero one after the other by rounding.
    if (
        s.formation.n_constraints < 4
        and run.phase.end is End.REST
        and is_there(run)
        and is_slower(run.problem.scene, run.y[5:10], SLOW)
        and run.breaks[run.piece + 1] - now <= window
    ):
        return Arrival(-float(s.outputs[s.to.until_rate]), window)
    if steps_within(run, run.tolerances.settling):
        _finish_piece(run)
    return restart(run, rows, time=now)


def _finish_piece(run: Replay) -> None:
    """Step to the torque step, without a record of the forces on the way."""
    coast_to_step(run, hide=True)
    run.drop()
    run.note(EventKind.TORQUE_STEP, f"the torques step {run.when()}")


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


def is_there(run: Replay) -> bool:
    """Whether the distance to the end of the phase counts as none, at rest."""
    return abs(run.value(run.stepper.rows.until)) < REACHED * run.until_unit


def _bridge(run: Replay) -> bool:
    """Integrate from a reversal to its torque step, unrecorded; whether all motion has ended."""
    s = run.stepper
    if steps_within(run, run.tolerances.settling):
        run.drop()
        _finish_piece(run)
        rows: list[int] = []
    elif _goes_on(run):
        return False
    else:
        start = s.outputs.copy()
        stretch = min(run.tolerances.settling, run.breaks[run.piece + 1] - run.t)
        run.step_to(stretch)
        events = find_first(run, start, stretch, _turning(s))
        if not events:
            s.look()
            return False
        rows = [k - s.rows.slide.start for k in events]
        run.drop()
        coast(run, run.t + float(s.inputs[s.at.h]), hide=True)
        run.drop()
    ended = _decide(run, rows)
    run.record()
    return ended


def _goes_on(run: Replay) -> bool:
    """Whether all that slides or turns is far too fast to come to rest in the shortest time."""
    s, scales = run.stepper, run.problem.scene.scales
    units = measure_units(run.problem.scene)[5:]
    # Lists, as there are few numbers.
    turning = s.outputs[s.to.events][s.rows.slide.start : s.rows.joint.stop].tolist()
    signs = [*s.inputs[s.at.Xi].tolist(), *s.inputs[s.at.sigma].tolist()]
    fastest = max(map(abs, (s.outputs[s.to.y][5:10] / units).tolist()))
    strongest = max(map(abs, (s.outputs[s.to.acceleration] / units).tolist())) * scales.time
    most = _FAR * SETTLING * (strongest + fastest**2)
    least = [most * scales.speed] * s.formation.n_contacts + [most / scales.time] * 2
    return all(not x or rate > low for x, rate, low in zip(signs, turning, least, strict=True))


def _turning(s: ModeStepper) -> range:
    """Rows of the event values that change sign at a reversal."""
    return range(s.rows.slide.start, s.rows.joint.stop)
