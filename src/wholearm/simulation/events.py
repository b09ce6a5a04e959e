"""Results of a simulation: states, forces, energies, events and outcome."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array, Numbers, find_runs
from ..common.document import Drawn
from ..common.errors import InputError, SimulationError
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Samples, Trajectory, sample_phases


class EventKind(Enum):
    """What happens at an instant of a simulation."""

    START = "start"  # the object starts to move from rest
    REST = "rest"  # the object comes to rest short of the end of the phase
    STICK = "stick"  # friction holds a contact or joint, or the object stays at rest
    REVERSAL = "reversal"  # a contact's sliding or a joint changes direction
    TORQUE_STEP = "torque step"  # the torques jump
    ARRIVAL = "arrival"  # the end of the phase is reached, and the next formation taken
    IMPACT = "impact"  # the velocity jumps onto the next formation
    RELEASE = "release"  # contacts that the next phase does not have are let go
    CONTACT_LOST = "contact lost"  # a normal force falls to zero
    SLIP = "slip"  # friction no longer holds a contact or joint; a rolling one ends the motion
    LIMIT = "limit"  # the formation stops being valid in another way
    END = "end"  # the torques end before the goal
    GAINED = "contact gained"  # a contact outside the prescribed formation closes
    PASS = "pass"  # a contact goes on as one of a neighbouring feature
    CHATTER = "chatter"  # the end of a sequence of ever faster impacts: the contact stays closed
    AMBIGUOUS = "ambiguous"  # several motions are possible; the nearest modes are taken
    INCONSISTENT = "inconsistent"  # no motion has finite forces: an impact without a collision
    GIVEN_UP = "given up"  # events without progress of time, or underflow of the step size


class Event(NamedTuple):
    """Something that happens at an instant."""

    time: float  # [s]
    phase: int  # index of the phase, from 0
    kind: EventKind
    text: str  # what has happened, in words
    contact: str = ""  # the contact or joint concerned, empty if it is the object or none
    # arrival: rate at which the distance to the phase's end closes [m/s or rad/s]; contact lost and
    # release: the c_n that the contact would need [N]; slip of a contact that the phase lets roll:
    # its margin mu c_n - |c_t| [N]; impact: the least impulse, that of `contact` [N s]; end: the
    # distance to the phase's end [m or rad], NaN if that is a release; NaN otherwise. With free
    # contacts, impact: the closing speed of the gap [m/s].
    value: float = float("nan")


def describe_change(name: str, before: float, after: float, verb: str) -> tuple[EventKind, str]:
    """Kind and text of a change of sign, 0 at rest; `verb` is slides or turns."""
    slides = verb == "slides"
    if after == 0:
        return EventKind.STICK, f"{name} sticks" if slides else f"friction holds {name}"
    if before == 0:
        return EventKind.SLIP, f"{name} slips" if slides else f"{name} starts to turn"
    return EventKind.REVERSAL, f"{name} {verb} the other way"


class OutcomeKind(Enum):
    """How a simulation ends."""

    GOAL_REACHED = "goal reached"
    CONTACT_LOST = "contact lost"
    SLIPS = "slips"
    HELD = "held"
    LIMIT_REACHED = "limit reached"
    GOAL_MISSED = "goal missed"
    ENDED = "ended"  # a simulation that with free contacts reached its end
    GIVEN_UP = "given up"


class Outcome(NamedTuple):
    """How a simulation ended, in one sentence."""

    kind: OutcomeKind
    text: str

    @property
    def reached(self) -> bool:
        """Whether the last phase's end was reached."""
        return self.kind is OutcomeKind.GOAL_REACHED


class Energies(NamedTuple):
    """Energies at n instants, each of shape (n,) [J]."""

    stored: Array  # kinetic and potential energy
    work: Array  # work of the torques so far
    # viscous, dry, contact: lost so far to viscous and dry joint friction and to sliding
    viscous: Array
    dry: Array
    contact: Array
    impact: Array  # lost so far in impacts

    @property
    def residual(self) -> Array:
        """Work less the change of stored energy and the losses, shape (n,) [J]: zero if exact."""
        losses = self.viscous + self.dry + self.contact + self.impact
        return np.asarray(self.work - (self.stored - self.stored[0]) - losses)


class FreeStretch(NamedTuple):
    """Interval in which a contact presses."""

    contact: str
    start: float  # start, stop [s]:
    stop: float
    # [N]: its least c_n; NaN at rest, where forces are indeterminate
    least: float
    time: float  # [s]: instant of the least c_n


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Drawn):
    """A simulated motion at every accepted step and requested instant, twice where forces jump.

    With free contacts phases follow the clock of a plan, `contacts` includes others that pressed,
    forces of open contacts are NaN, and instants of events are recorded twice.
    """

    t: Array  # (n,) [s]
    z: Array  # z, z_dot, z_ddot (n, 5):
    z_dot: Array
    z_ddot: Array
    tau: Array  # (n, 2) [N m]
    phase: Numbers  # (n,): index of the phase, from 0
    contacts: tuple[str, ...]  # every contact of the problem
    # c_n, c_t (n, m) [N]: NaN where a contact is not in the formation, and at rest, where forces
    # are indeterminate
    c_n: Array
    c_t: Array
    problem: Problem = field(repr=False)
    torque: TorqueProfile = field(repr=False)  # the simulated torques
    events: tuple[Event, ...]
    energies: Energies
    outcome: Outcome
    # [m or rad]: distance to the end of the last phase entered; zero when the goal is reached, and
    # NaN if that phase ends by a release or contacts are free
    missed_by: float
    steps: int  # steps, rejected: accepted and rejected Runge-Kutta steps
    rejected: int
    # intervals in which pairs of features pressed, ordered by their start
    stretches: tuple[FreeStretch, ...] = field(repr=False)
    residual: float  # largest residual of a contact problem, relative to its largest rate

    @property
    def headline(self) -> str:
        """The outcome, in a line."""
        return f"{self.problem.name!r}, {self.t[-1]:.6g} s: {self.outcome.text}"

    @property
    def trajectory(self) -> Trajectory:
        """The simulated motion in the format of a plan, without phases of one instant.

        SimulationError if there is no motion.
        """
        phase_rows, problem = list[Numbers](), self.problem
        # Rows whose times increase in each phase, but for one repetition where forces step.
        for index in range(int(self.phase[-1]) + 1):
            rows = np.flatnonzero(self.phase == index)
            t = self.t[rows]
            before, after = np.append(True, np.diff(t) > 0), np.append(np.diff(t) > 0, True)
            # At the end of a phase the row before the last step stands for its last instant.
            phase_rows.append(rows[before | (after & (t < t[-1]))])
            if len(phase_rows[-1]) < 2:
                phase_rows.pop()
                break
        if not phase_rows:
            raise SimulationError(f"there is no motion to keep: {self.outcome.text}")
        rows = np.concatenate(phase_rows)
        t, phases = self.t[rows], self.phase[rows]
        samples = Samples(*(getattr(self, name)[rows] for name in Samples._fields))
        motions = sample_phases(t, phases, samples, self.contacts, self.torque)
        rolling = [phase.formation.rolling for phase in problem.phases[: len(motions)]]
        meta = {
            "status": "replayed",
            "outcome": self.outcome.text,
            "name": problem.name,
            "epsilon": problem.epsilon,
            "rolling": [[contact.name for contact in contacts] for contacts in rolling],
            "phase_durations": [motion.duration for motion in motions],
            "problem": problem.table,
        }
        arrays = samples._asdict() | {"t": t, "phase": phases, "contacts": self.contacts}
        return Trajectory(**arrays, torque=self.torque, motions=motions, meta=meta)

    def find(self, *kinds: EventKind, phase: int | None = None) -> tuple[Event, ...]:
        """Events of some kinds in the order of time, of all phases or of one by its index."""
        events = (event for event in self.events if event.kind in kinds)
        return tuple(event for event in events if phase is None or event.phase == phase)

    def count_phases(self, starts: Sequence[float] | Array) -> Simulation:
        """The same simulation with phases that begin at `starts` [s], in rising order."""
        clock = np.asarray(starts)
        phases = np.searchsorted(clock, [event.time for event in self.events], side="right") - 1
        pairs = zip(self.events, phases.tolist(), strict=True)
        events = tuple(event._replace(phase=max(index, 0)) for event, index in pairs)
        # Of two rows at a boundary the first one belongs to the previous phase.
        is_repeated = np.append(np.diff(self.t) == 0, False) & np.isin(self.t, clock[1:])
        phase = np.maximum(np.searchsorted(clock, self.t, side="right") - 1 - is_repeated, 0)
        return replace(self, phase=phase, events=events)

    def show(self, contacts: Sequence[str]) -> Simulation:
        """The same simulation with forces of other contacts; NaN if a contact never pressed."""
        forces = np.full((2, len(self.t), len(contacts)), np.nan)
        for column, name in enumerate(contacts):
            if name in self.contacts:
                source = self.contacts.index(name)
                forces[:, :, column] = self.c_n[:, source], self.c_t[:, source]
        return replace(self, contacts=tuple(contacts), c_n=forces[0], c_t=forces[1])

    def list_pauses(
        self, contact: str, start: float, stop: float, aliases: Collection[str] = ()
    ) -> list[tuple[float, float]]:
        """Intervals between two times [s] in which a contact does not press.

        `aliases` are neighbouring features to which the contact may pass.
        """
        pauses, time, names = [], start, {contact, *aliases}
        spans = sorted((part.start, part.stop) for part in self.stretches if part.contact in names)
        for first, last in spans:
            if first > time:
                pauses.append((time, min(first, stop)))
            time = max(time, last)
            if time >= stop:
                return pauses
        return [*pauses, (time, stop)]

    def at(self, t: float) -> Array:
        """State (z, z') at a recorded instant, shape (10,), the later one where there are two.

        InputError if `t` was not a requested instant and no step ends there.
        """
        index = int(np.searchsorted(self.t, t, side="right")) - 1
        if index < 0 or self.t[index] != t:
            raise InputError("", "t", f"{t} s was not recorded; ask for it with `times`")
        return np.concatenate([self.z[index], self.z_dot[index]])


FreeSimulation = Simulation  # the name of earlier versions for one with free contacts


class Record(NamedTuple):
    """State, forces and torques at one instant."""

    t: float
    phase: int
    kept: tuple[int, ...]  # pairs that press
    impact: float  # [J]: energy lost to impacts so far
    y: Array  # z, z' and integrals
    acceleration: Array
    tau: Array
    c_n: Array  # c_n, c_t: of the kept pairs
    c_t: Array


def list_stretches(rows: Sequence[Record], names: Sequence[str]) -> tuple[FreeStretch, ...]:
    """Maximal intervals in which each pair presses."""
    stretches: list[FreeStretch] = []
    for pair in {pair for row in rows for pair in row.kept}:
        for run in find_runs(np.array([pair in row.kept for row in rows])):
            block = rows[run]
            c_n = np.array([row.c_n[row.kept.index(pair)] for row in block])
            k = 0 if np.isnan(c_n).all() else int(np.nanargmin(c_n))
            minimum = float(c_n[k]), block[k].t
            stretches.append(FreeStretch(names[pair], block[0].t, block[-1].t, *minimum))
    return tuple(sorted(stretches, key=lambda stretch: (stretch.start, stretch.contact)))
