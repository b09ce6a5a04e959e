"""The state of a simulation under way, and what it records."""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np

from ..common.arrays import Array
from ..common.errors import JammingError, SimulationError
from ..contacts.formation import Formation
from ..problem.definition import Phase, Problem
from ..results.torque import TorqueProfile
from .events import Event, EventKind, Outcome, OutcomeKind, Section
from .layout import STATE, find_torque_steps
from .modes import FREE, Grips
from .stepper import ModeStepper, build_stepper
from .tolerances import find_tolerances


class Replay:
    """State, piece of the torques and records of a running simulation.

    Attributes
    ----------
    t, h : [s]               present time, and the step to try next
    y : (STATE,)             z, z', then work, viscous, dry and contact losses
    has_slid                 whether contacts that come to rest have slid in the phase
    slip_signs               signs of contacts, by name, that have just begun to slip
    side                     sign of (coordinate - value) before the end of the phase
    until_unit : [m or rad]  unit of the distance to the end of the phase
    passes                   whether the end may be passed at any speed, without an impact
    moving                   whether the motion goes on into the next phase
    previous                 formation of the last phase that has ended at rest
    wanted                   instants at which steps have to end; infinity is last
    stuck                    contacts, then joints, that stick while the rest moves
    """

    stepper: ModeStepper  # of the phase's formation
    phase: Phase
    limits: list[str]  # what has happened when each of the stepper's limits is zero
    releasable: tuple[str, ...]  # the contacts whose release ends the phase
    # resting, slipping: the contacts that come to rest, all of them, or slip, one of them, where
    # the phase ends
    resting: frozenset[int]
    slipping: frozenset[int]

    def __init__(
        self, problem: Problem, torque: TorqueProfile, tolerance: float, wanted: Array
    ) -> None:
        self.problem, self.torques, self.tolerance = problem, torque, tolerance
        self.tolerances = find_tolerances(problem.scene)
        self.until_unit = 1.0
        self.breaks = [float(b) for b in torque.breaks]
        self.coefficients = torque.coefficients
        parts, least = torque.coefficients, self.tolerances.torque_step
        self.steps_at: list[bool] = [
            True,
            *find_torque_steps(parts[:-1], parts[1:], least).tolist(),
        ]
        ends = torque.breaks[:-1], torque.breaks[1:]
        flat = self.coefficients.reshape(len(self.coefficients), -1)
        self.pieces = np.column_stack([*ends, flat])
        self.step_times = [b for b, s in zip(self.breaks, self.steps_at, strict=False) if s]
        within = wanted[(wanted >= self.breaks[0]) & (wanted <= self.breaks[-1])]
        self.wanted = [*within.tolist(), math.inf]
        self.next_wanted = 0
        self.t, self.piece = self.breaks[0], 0
        self.y = np.zeros(STATE)
        self.y[:5] = problem.start
        self.h = self.tolerances.first_step
        self.held_until = self.settled_by = -math.inf
        self.impact = 0.0
        self.passes = self.moving = False
        self.previous: Formation | None = None
        self.side = 1.0
        self.stuck: set[int] = set()
        self.has_slid = False
        self.slip_signs: dict[str, float] = {}
        self.decided = (-math.inf, 0)
        self.sections: list[Section] = []
        self.steppers: list[ModeStepper] = []
        self.events: list[Event] = []
        self.steps = self.rejected = 0

    def take(self, grips: Grips = FREE) -> None:
        """Go on with the steps of the phase's formation in which friction holds `grips`."""
        degree = self.coefficients.shape[2] - 1
        formation, until = self.phase.formation, self.phase.until
        self.stepper = s = build_stepper(formation, until, self.side, degree, grips)
        self.sections.append(Section(self.phase, s.to, [], [], [], []))
        self.steppers.append(s)
        s.inputs[s.at.tolerance] = self.tolerance
        s.inputs[s.at.kept] = s.mode.read_kept(self.y[:5])
        self.load_piece()

    def accept(self, t: float) -> Array:
        """Take the step just made, to time `t`, and record its end."""
        s = self.stepper
        self.t = t
        self.y[:] = s.outputs[s.to.y]
        s.inputs[s.at.heading] = s.outputs[s.to.heading]
        if not s.outputs[s.to.ratio] > 0:
            self.fail_to_step(float(s.outputs[s.to.ratio]))
        return self.keep(s.outputs.copy())

    def fail_to_step(self, ratio: float) -> None:
        """Raise the error for a step size that underflows."""
        names = " ".join(self.phase.formation.names)
        if not ratio > 1e-3:
            raise JammingError(
                f"{names} jams {self.where()}: friction makes the reduced inertia {ratio:.3g} of "
                "its frictionless value"
            )
        raise SimulationError(f"the step size of {names} underflows {self.where()}")

    def step_to(self, h: float) -> None:
        """Repeat the step with another length."""
        s = self.stepper
        s.inputs[s.at.h] = h
        s.step()

    def record(self, still: bool = False) -> Array:
        """Record the present state; at rest without forces and acceleration."""
        s = self.stepper
        s.inputs[s.at.y], s.inputs[s.at.t] = self.y, self.t
        s.look()
        row = s.outputs.copy()
        if still:
            row[s.to.acceleration] = 0.0
            row[s.to.c_n] = row[s.to.c_t] = math.nan
        return self.keep(row)

    def keep(self, row: Array) -> Array:
        """Append a row of outputs to the records; it becomes the start of the next step."""
        s, section = self.stepper, self.sections[-1]
        s.inputs[s.at.y] = self.y
        section.times.append(self.t)
        section.rows.append(row)
        section.impacts.append(self.impact)
        return row

    def drop(self) -> None:
        """Take back the last record."""
        section = next(section for section in reversed(self.sections) if section.times)
        for column in (section.times, section.rows, section.impacts):
            column.pop()

    def repeats(self) -> bool:
        """Whether the last two records are of the same instant of one phase, but for rounding."""
        sections = [section for section in self.sections if section.phase is self.phase]
        times = [time for section in sections[-2:] for time in section.times[-2:]]
        return len(times) > 1 and self.t - times[-2] <= self.tolerances.settling

    def note(
        self,
        kind: EventKind,
        text: str,
        contact: str = "",
        value: float = math.nan,
        time: float | None = None,
    ) -> None:
        """Append an event, at present if no time is given."""
        time = self.t if time is None else time
        self.events.append(Event(time, self.phase.index, kind, text, contact, value))

    def lose(self, contact: str, c_n: float) -> Outcome:
        """End because `contact` would have to pull."""
        how = "to zero" if c_n > -1e3 * self.tolerances.force else f"to {c_n:.3g} N"
        text = f"c_n of {contact} falls {how} {self.when()}"
        self.note(EventKind.CONTACT_LOST, text, contact, c_n)
        return Outcome(OutcomeKind.CONTACT_LOST, text)

    def slip(self, row: int, c_n: float, c_t: float) -> Outcome:
        """End because a rolling contact slips: the `row`-th of the formation, with forces in N."""
        formation = self.phase.formation
        name, bound = formation.names[row], formation.friction[row] * c_n
        how = "exceeds" if abs(c_t) - bound > 1e3 * self.tolerances.force else "reaches"
        text = f"{name} slips: |c_t| = {abs(c_t):.5g} N {how} mu c_n = {bound:.5g} N {self.when()}"
        self.note(EventKind.SLIP, text, name, bound - abs(c_t))
        return Outcome(OutcomeKind.SLIPS, text)

    def run_out(self) -> Outcome:
        """End because the torques end."""
        until, distance = self.phase.until, math.nan
        if until.is_release:
            names = self.phase.formation.names
            ends = [(self.resting, "comes to rest"), (self.slipping, "slips")]
            texts = [f"{', '.join(names[k] for k in sorted(rows))} {t}" for rows, t in ends if rows]
            if self.releasable:
                texts = [f"{', '.join(self.releasable)} is released"]
            text = f"the torques end {self.when()}, before {' or '.join(texts)}"
        else:
            distance = self.value(self.stepper.rows.until)
            unit = "rad" if until.coordinate == "phi" else "m"
            text = f"the torques end {self.when()}, {distance:.3g} {unit} short of {until}"
        self.note(EventKind.END, text, "", distance)
        return Outcome(OutcomeKind.GOAL_MISSED, text)

    def value(self, row: int) -> float:
        """One of the event values at the present state."""
        return float(self.stepper.outputs[self.stepper.to.events.start + row])

    def load_piece(self) -> None:
        """Set the stepper's inputs for the present piece of the torques."""
        s = self.stepper
        s.inputs[s.at.piece.start : s.at.torque.stop] = self.pieces[self.piece]

    def next_piece(self) -> bool:
        """Go on to the next piece, if there is one; whether the torques step there."""
        if self.piece + 2 >= len(self.breaks):
            return False
        self.piece += 1
        self.load_piece()
        return self.steps_at[self.piece]

    @property
    def coming_step(self) -> float:
        """When the torques step next, after the present piece, or infinity [s]."""
        k = bisect_left(self.step_times, self.breaks[self.piece + 1])
        return self.step_times[k] if k < len(self.step_times) else math.inf

    @property
    def last_step(self) -> float:
        """When the torques last stepped, at their start or later [s]."""
        return self.step_times[bisect_left(self.step_times, self.breaks[self.piece + 1]) - 1]

    def fraction(self, t: float) -> float:
        """Coordinate of time `t` on the present piece, from -1 to 1."""
        start, stop = self.breaks[self.piece], self.breaks[self.piece + 1]
        return min(1.0, max(-1.0, (2 * t - start - stop) / (stop - start)))

    def time(self, x: float) -> float:
        """Time at `x` of the present piece [s]."""
        start, stop = self.breaks[self.piece], self.breaks[self.piece + 1]
        return (start + stop + x * (stop - start)) / 2

    def when(self) -> str:
        """Present time and phase, to end a sentence."""
        return f"at t = {self.t:.5g} s, phase {self.phase.number}"

    def where(self) -> str:
        """Present phase and time, for errors."""
        return f"in phase {self.phase.number} at t = {self.t:.5g} s"

    @property
    def stored(self) -> float:
        """Kinetic and potential energy [J]."""
        scene, v = self.problem.scene, self.y[5:10]
        height = scene.polygon.mass * scene.gravity * self.y[1]
        return float(0.5 * v**2 @ scene.mass_diagonal + height)
