"""Results of a simulation: states, forces, energies, events and outcome."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..common.document import Drawn
from ..common.errors import SimulationError
from ..mechanics.dynamics import energy
from ..problem.definition import Phase, Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory, sample_phases
from .layout import Outputs
from .runge_kutta import INNER_STAGES, NODES

REPLAYED = "replayed"  # status in the `meta` of such a trajectory


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
    GAINED = "contact gained"  # a contact that nothing was said about presses from here on
    PASS = "pass"  # a contact goes on as one of a neighbouring feature
    CHATTER = "chatter"  # impacts that come ever faster are over: the contact stays closed
    AMBIGUOUS = "ambiguous"  # several motions are possible; the one nearest to the last is taken
    INCONSISTENT = "inconsistent"  # no motion has finite forces: an impact without a collision
    GIVEN_UP = "given up"  # events come without time passing, or steps do not get anywhere


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
    # distance to the phase's end [m or rad], NaN if that is a release; NaN otherwise. Where no
    # contacts are told, impact: the speed at which the gap closed [m/s].
    value: float = float("nan")


class OutcomeKind(Enum):
    """How a simulation ends."""

    GOAL_REACHED = "goal reached"
    CONTACT_LOST = "contact lost"
    SLIPS = "slips"
    HELD = "held"
    LIMIT_REACHED = "limit reached"
    GOAL_MISSED = "goal missed"
    ENDED = "ended"  # a simulation that is told no contacts came to its end
    GIVEN_UP = "given up"


class Outcome(NamedTuple):
    """How a simulation ended, with one sentence that says it."""

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
    impact: Array  # lost so far where a contact gained stopped the motion, or part of it

    @property
    def residual(self) -> Array:
        """Work less the change of stored energy and the losses, shape (n,) [J]: zero if exact."""
        losses = self.viscous + self.dry + self.contact + self.impact
        return np.asarray(self.work - (self.stored - self.stored[0]) - losses)


class Glimpses(NamedTuple):
    """Normal forces within steps, to the accuracy of Runge-Kutta stages."""

    t: Array  # (k,) [s]
    phase: NDArray[np.int64]  # (k,)
    c_n: Array  # (k, m) [N]: naN where a contact is not in the formation


@dataclass(frozen=True, eq=False, repr=False)
class Simulation(Drawn):
    """A simulated motion at every accepted step and requested instant, twice where forces jump."""

    t: Array  # (n,) [s]
    z: Array  # z, z_dot, z_ddot (n, 5):
    z_dot: Array
    z_ddot: Array
    tau: Array  # (n, 2) [N m]
    phase: NDArray[np.int64]  # (n,): index of the phase, from 0
    contacts: tuple[str, ...]  # every contact of the problem
    # c_n, c_t (n, m) [N]: naN where a contact is not in the formation, and at rest, where forces
    # are indeterminate
    c_n: Array
    c_t: Array
    problem: Problem = field(repr=False)
    torque: TorqueProfile = field(repr=False)  # what was simulated
    events: tuple[Event, ...]
    energies: Energies
    outcome: Outcome
    # [m or rad]: distance to the end of the last phase entered; zero when the goal is reached, and
    # NaN if that phase ends by a release
    missed_by: float
    steps: int  # steps, rejected: accepted and rejected Runge-Kutta steps
    rejected: int

    @property
    def headline(self) -> str:
        """How it ended, in a line."""
        return f"{self.problem.name!r}, {self.t[-1]:.6g} s: {self.outcome.text}"

    @property
    def trajectory(self) -> Trajectory:
        """The simulated motion as a trajectory, as of a plan."""
        return make_trajectory(self)

    def find(self, kind: EventKind) -> tuple[Event, ...]:
        """Events of one kind, in the order of time."""
        return tuple(event for event in self.events if event.kind is kind)

    def at(self, t: float) -> Array:
        """State (z, z') at a recorded instant, shape (10,), the later one where there are two.

        Raises
        ------
        ValueError  if `t` was not among the instants asked for and no step ends there
        """
        index = int(np.searchsorted(self.t, t, side="right")) - 1
        if index < 0 or self.t[index] != t:
            raise ValueError(f"t = {t} s was not recorded; ask for it with `times`")
        return np.concatenate([self.z[index], self.z_dot[index]])


class Step(NamedTuple):
    """A step that has been made."""

    t: float  # t, h [s]: its start and length
    h: float
    inputs: Array  # its packed inputs
    row: Array  # its packed outputs
    impact: float  # [J]: energy lost to impacts so far
    arrives: bool  # whether it ends where the phase ends, which it has passed by rounding


class Section(NamedTuple):
    """What is recorded while one phase is simulated, row by row."""

    phase: Phase
    to: Outputs  # layout of the rows
    # times, rows, impacts: instants [s], packed outputs, and the energy lost to impacts so far [J]
    times: list[float]
    rows: list[Array]
    impacts: list[float]
    steps: list[Step]  # those that may be looked into


def collect(
    problem: Problem,
    sections: Sequence[Section],
    events: Sequence[Event],
    torque: TorqueProfile,
    outcome: Outcome,
    missed_by: float,
    counts: tuple[int, int],
) -> Simulation:
    """Put the sections of a simulation together; `counts` are steps and rejected steps."""
    contacts = problem.contacts
    columns: list[tuple[Array, ...]] = []
    for section in sections:
        to, formation = section.to, section.phase.formation
        # What has been seen within steps comes last there.
        order = np.argsort(section.times, kind="stable")
        rows = np.array(section.rows).reshape(-1, to.size)[order]
        forces = np.full((2, len(rows), len(contacts)), np.nan)
        where = [contacts.index(contact) for contact in formation.contacts]
        forces[:, :, where] = rows[:, to.c_n], rows[:, to.c_t]
        y = rows[:, to.y]
        stored = energy(formation, y[:, :5], y[:, 5:10])
        index = np.full(len(rows), section.phase.index)
        parts = np.array(section.times)[order], y, rows[:, to.acceleration], rows[:, to.tau]
        columns.append((*parts, index, *forces, stored, np.array(section.impacts)[order]))
    t, y, z_ddot, tau, phase, c_n, c_t, stored, impact = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    return Simulation(
        t=t,
        z=y[:, :5],
        z_dot=y[:, 5:10],
        z_ddot=z_ddot,
        tau=tau,
        phase=phase,
        contacts=tuple(contact.name for contact in contacts),
        c_n=c_n,
        c_t=c_t,
        problem=problem,
        torque=torque,
        events=tuple(sorted(events, key=lambda event: event.time)),
        energies=Energies(stored, y[:, 10], y[:, 11], y[:, 12], y[:, 13], impact),
        outcome=outcome,
        missed_by=missed_by,
        steps=counts[0],
        rejected=counts[1],
    )


def list_glimpses(problem: Problem, sections: Sequence[Section]) -> Glimpses:
    """Normal forces at the stages of all steps."""
    contacts = problem.contacts
    nodes = np.array(NODES)[list(INNER_STAGES)]
    columns = [(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, len(contacts))))]
    for section in sections:
        if not section.steps:
            continue
        own = section.phase.formation.contacts
        places = np.array([(step.t, step.h) for step in section.steps])
        t = (places[:, :1] + nodes * places[:, 1:]).ravel()
        c_n = np.full((len(t), len(contacts)), np.nan)
        seen = np.array([step.row[section.to.stage_forces] for step in section.steps])
        where = [contacts.index(contact) for contact in own]
        c_n[:, where] = seen.reshape(len(t), len(own))
        columns.append((t, np.full(len(t), section.phase.index), c_n))
    return Glimpses(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def make_trajectory(simulation: Simulation) -> Trajectory:
    """Trajectory without phases of one instant; `SimulationError` if there is no motion."""
    rows, problem = _choose_rows(simulation), simulation.problem
    if not len(rows):
        raise SimulationError(f"there is no motion to keep: {simulation.outcome.text}")
    names = ("t", "tau", "c_n", "c_t", "phase")
    arrays: dict[str, Any] = {name: getattr(simulation, name)[rows] for name in names}
    for suffix in ("", "_dot", "_ddot"):
        z = getattr(simulation, f"z{suffix}")[rows]
        arrays |= {f"q{suffix}": z[:, :3], f"theta{suffix}": z[:, 3:]}
    motions = sample_phases(arrays, simulation.contacts)
    rolling = [phase.formation.rolling for phase in problem.phases[: len(motions)]]
    meta = {
        "status": REPLAYED,
        "outcome": simulation.outcome.text,
        "name": problem.name,
        "epsilon": problem.epsilon,
        "rolling": [[contact.name for contact in own] for own in rolling],
        "phase_durations": [motion.duration for motion in motions],
        "problem": problem.table,
    }
    return Trajectory(
        **arrays, contacts=simulation.contacts, torque=simulation.torque, motions=motions, meta=meta
    )


def _choose_rows(simulation: Simulation) -> NDArray[np.int64]:
    """Rows whose times increase in each phase, but for one repetition where forces step."""
    chosen = [np.zeros(0, dtype=np.int64)]
    for index in range(int(simulation.phase[-1]) + 1):
        rows = np.flatnonzero(simulation.phase == index)
        t = simulation.t[rows]
        before, after = np.append(True, np.diff(t) > 0), np.append(np.diff(t) > 0, True)
        # At the end of a phase what comes before the last step stands for its last instant.
        kept = rows[before | (after & (t < t[-1]))]
        if len(kept) < 2:
            break
        chosen.append(kept)
    return np.concatenate(chosen)
