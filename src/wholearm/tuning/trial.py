"""Trials of torques from rest to rest, by complementarity simulation: end reached, contact lost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.document import Document, Result, Table
from ..contacts.elemental import Contact
from ..free_simulation.free_simulate import simulate_free
from ..free_simulation.hand import build_system
from ..free_simulation.result import FreeSimulation, list_pauses
from ..free_simulation.state import FreeRun
from ..problem.definition import End, Phase, Problem, Until
from ..results.torque import TorqueProfile, format_rows, read_rows
from ..simulation.events import Event, EventKind
from ..verification.free import FreeReport, find_losses
from ..verification.verdict import DEPARTURE

_GAINS = (EventKind.GAINED, EventKind.IMPACT, EventKind.PASS)
LASTS = 40.0
"""How long a trial goes on after its last step of the torques, relative to the scene's time."""
_BACK = 1e-6
"""Share of the way by which the end is farther away than before once the motion has turned back."""
_NUDGE = 1e-6  # time over which a rate is a difference, relative to the scene's


class TrialOutcome(Enum):
    """Outcome of a trial."""

    RESTS = "rests"
    """The object does not begin to slide, stops short of the end of the phase, or turns back."""
    ARRIVES = "arrives"
    """The end of the phase is reached."""
    LOSES = "loses"
    """A contact parts, or presses with less than epsilon."""
    LASTS = "lasts"
    """The object is still on its way when the trial is over."""


class TuningStep(NamedTuple):
    """Torques that hold from an instant on."""

    time: float  # [s]: since the start of the phase, or of all
    tau: tuple[float, float]  # [N m]


class TuningTrial(NamedTuple):
    """Torques of a phase, and the motion that they cause."""

    steps: tuple[TuningStep, ...]  # the torques
    outcome: TrialOutcome
    time: float  # [s]: when it came to that, since the start of the phase
    contact: str  # the one that is lost, empty if none is
    rate: float  # [m/s or rad/s]: how fast the end of the phase closes at that time
    slowing: float  # [m/s^2 or rad/s^2]: by how much that becomes less then
    # [m or rad]: how far away the end was when it was nearest; infinite before the last of several
    # phases
    short: float
    least: float  # [N]: the least normal force until then, of `weakest`; infinite if nothing moved
    weakest: str
    z: Array  # (5,): where it was then

    def to_text(self) -> str:
        """The outcome in words."""
        text = self.outcome.value
        if self.outcome is TrialOutcome.LOSES:
            return f"{text} {self.contact} at t = {self.time:.5g} s"
        if self.outcome is TrialOutcome.ARRIVES:
            return f"{text} at t = {self.time:.5g} s, closing at {self.rate:.3g}"
        if self.short == math.inf:
            return f"{text} before the last of these phases"
        return f"{text}, {abs(self.short):.3g} away from it"


class Landing(NamedTuple):
    """The object held at the end of a phase."""

    z: Array  # (5,): where it is held
    rests: bool  # whether everything rests there in the end
    parted: float  # [s]: for how long a contact of the phase, or of the next, parts meanwhile
    contact: str  # that contact


def make_rows(steps: Sequence[TuningStep], end: float) -> Array:
    """A table of t and both torques, shape (n, 3), that steps from one constant to the next."""
    t = np.repeat([*(step.time for step in steps), end], 2)[1:-1]
    return np.column_stack([t, np.repeat([step.tau for step in steps], 2, axis=0)])


class Bench:
    """Trials of one passage from one start.

    Parameters
    ----------
    z : (5,)  where it starts, at rest

    Attributes
    ----------
    trials
    simulations       trials, and landings
    way : [m or rad]  how far away the end is
    """

    def __init__(self, problem: Problem, passage: Passage, z: Array) -> None:
        self.problem, self.passage, self.z = problem, passage, z
        self.system = build_system(problem.scene)
        until = passage.until
        self.until = "" if until.contact is None else until.contact.name
        self.pair = self.system.names.index(self.until) if self.until else None
        self.column = 0 if until.coordinate == "x" else 2
        self.value = math.nan if until.value is None else until.value
        self.sign = float(np.sign(z[self.column] - self.value))
        self.way = float(self.measure(z[None])[0])
        self.trials: list[TuningTrial] = []
        self.simulations = 0

    @property
    def is_angle(self) -> bool:
        """Whether the end of the passage is one of phi."""
        return self.pair is None and self.column == 2

    def measure(self, z: Array) -> Array:
        """How far away the end of the passage is, from (n, 5) to (n,) [m or rad].

        Where a contact goes on as that of a neighbouring feature it is how far it has to slide.
        """
        if self.pair is None:
            return self.sign * (z[:, self.column] - self.value)
        gaps, ranges = self.system.measure(z)
        return np.asarray(-ranges[:, self.pair] if self.passage.passed else gaps[:, self.pair])

    def run(self, steps: Sequence[TuningStep]) -> TuningTrial:
        """Simulate torques until the end of the passage, or what keeps it from coming."""
        end = steps[-1].time + LASTS * self.problem.scene.scales.time
        torque = read_rows(make_rows(steps, end))
        simulation = simulate_free(self.problem, torque, start=self.z, halt=self._is_over)
        self.simulations += 1
        self.trials.append(self._judge(tuple(steps), simulation))
        return self.trials[-1]

    def land(self, steps: Sequence[TuningStep], arrival: float, pause: float) -> Landing:
        """Simulate torques that hold the object at the end of the passage.

        Parameters
        ----------
        arrival : [s]  when the end is reached
        pause : [s]    how long it is held
        """
        self.simulations += 1
        end, passage = arrival + pause, self.passage
        simulation = simulate_free(self.problem, read_rows(make_rows(steps, end)), start=self.z)
        stretches = simulation.stretches
        if passage.passed:
            # Whichever of the two presses where they meet.
            stretches = tuple(
                stretch._replace(contact=passage.passed)
                if stretch.contact == self.until
                else stretch
                for stretch in stretches
            )
        later = passage.after or passage.phases[-1]
        names = later.formation.names
        pauses = {name: list_pauses(stretches, name, arrival, end) for name in names}
        parted = {name: max((b - a for a, b in own), default=0.0) for name, own in pauses.items()}
        worst = max(parted, key=parted.__getitem__)
        rests = not simulation.z_dot[-1].any() and simulation.t[-1] == end
        return Landing(simulation.z[-1], rests, parted[worst], worst)

    def _is_over(self, run: FreeRun) -> bool:
        if run.t == 0:
            return False
        ends, loss = self.passage.follow(run.events)
        if run.resting or loss is not None or len(ends) == len(self.passage.phases):
            return True
        if len(self.passage.phases) > 1:
            return False
        gap = float(self.measure(run.z[None])[0])
        return gap > (1 + _BACK) * self.way or (self.pair is None and gap <= 0)

    def _judge(self, steps: tuple[TuningStep, ...], simulation: FreeSimulation) -> TuningTrial:
        gaps = self.measure(simulation.z)
        ends, lost = self.passage.follow(simulation.events)
        arrival = ends[-1] if len(ends) == len(self.passage.phases) else math.inf
        if self.pair is None and gaps.min() <= 0:
            from scipy.optimize import brentq

            row, motion = int(np.flatnonzero(gaps <= 0)[0]), simulation.trajectory
            a, b = (float(t) for t in simulation.t[row - 1 : row + 1])
            arrival = float(brentq(lambda t: self.measure(motion.at([t]).z)[0], a, b, xtol=1e-14))
        before = len(self.passage.phases) - 1
        start = [0.0, *ends][before] if len(ends) >= before else math.inf  # of the last phase
        turn = self._find_turn(simulation, gaps, start)
        losses = [] if lost is None else [(lost.time, lost.contact)]
        stop = min(arrival, turn, float(simulation.t[-1]))
        losses = [
            loss for loss in losses + self._list_losses(simulation, ends, stop) if loss[0] < stop
        ]
        time, contact = min(losses, default=(stop, ""))
        at = int(np.searchsorted(simulation.t, time))
        least, weakest, row = self._find_least(simulation, ends, at)
        short = float(gaps[: at + 1][simulation.t[: at + 1] >= start].min(initial=math.inf))
        if losses:
            outcome = TrialOutcome.LOSES
        elif least < self.problem.epsilon:
            outcome, contact, time = TrialOutcome.LOSES, weakest, float(simulation.t[row])
        elif arrival == stop:
            outcome = TrialOutcome.ARRIVES
        else:
            rests = turn == stop or not simulation.z_dot[at].any()
            outcome = TrialOutcome.RESTS if rests else TrialOutcome.LASTS
        rate, slowing, z = self._close(simulation, time, at)
        return TuningTrial(steps, outcome, time, contact, rate, slowing, short, least, weakest, z)

    def _find_turn(self, simulation: FreeSimulation, gaps: Array, start: float) -> float:
        """When the end, once nearer, is farther away again [s], infinite if it never is."""
        rows = np.flatnonzero(simulation.t >= start)
        risen = gaps[rows] - np.minimum.accumulate(gaps[rows]) if len(rows) else gaps[:0]
        back = np.flatnonzero(risen > _BACK * abs(self.way))
        return float(simulation.t[rows[back[0]]]) if len(back) else math.inf

    def _list_losses(
        self, simulation: FreeSimulation, ends: Sequence[float], stop: float
    ) -> list[tuple[float, str]]:
        """When contacts of its phases part, also those that never press; and which."""
        starts = [0.0, *ends][: len(self.passage.phases)]
        stops = [*starts[1:], stop]
        return [
            (loss.time, loss.contact)
            for phase, first, last in zip(self.passage.phases, starts, stops, strict=False)
            for loss in find_losses(self.problem, simulation, phase, first, last, DEPARTURE)
        ]

    def _find_least(
        self, simulation: FreeSimulation, ends: Sequence[float], at: int
    ) -> tuple[float, str, int]:
        """The least normal force up to a row, of which contact, and in which row."""
        phases = self.passage.phases
        of = np.minimum(np.searchsorted(ends, simulation.t[: at + 1], side="left"), len(phases) - 1)
        best = (math.inf, phases[0].formation.names[0], 0)
        for index in range(len(phases)):
            rows = np.flatnonzero(of == index)
            names = self.passage.list_pressed(index)
            own = [simulation.contacts.index(name) for name in names]
            c_n = np.nan_to_num(simulation.c_n[rows][:, own], nan=math.inf)
            if c_n.min(initial=math.inf) < best[0]:
                row, column = np.unravel_index(int(c_n.argmin()), c_n.shape)
                best = (float(c_n[row, column]), names[int(column)], int(rows[row]))
        return best

    def _close(self, run: FreeSimulation, time: float, at: int) -> tuple[float, float, Array]:
        """How fast the end closes, by how much that becomes less, and where."""
        if self.pair is None and time > 0:
            row = run.trajectory.at([time])
            v, a = row.z_dot[0, self.column], row.z_ddot[0, self.column]
            return -self.sign * float(v), self.sign * float(a), row.z[0]
        z, v, a = run.z[at], run.z_dot[at], run.z_ddot[at]
        if self.pair is None:
            return (-self.sign * float(v[self.column]), self.sign * float(a[self.column]), z)
        if self.passage.passed:
            step = _NUDGE * self.problem.scene.scales.time
            back, _, on = (float(x) for x in self.measure(z + np.outer([-step, 0, step], v)))
            return (back - on) / (2 * step), 0.0, z
        rows = self.system.evaluate(z, v, [self.pair])
        return -float(rows.A[0] @ v), float(rows.A[0] @ a + rows.bend[0]), z


@dataclass(frozen=True, eq=False)
class Passage:
    """Phases that are carried in one motion."""

    phases: tuple[Phase, ...]
    after: Phase | None  # the one that follows; None after the last

    @property
    def until(self) -> Until:
        """What ends it."""
        return self.phases[-1].until

    @property
    def title(self) -> str:
        """The numbers of its phases, for people."""
        return name_numbers(self.phases[0].number, self.phases[-1].number)

    @property
    def passed(self) -> str:
        """The contact that goes on as the one which ends it, empty if none does."""
        return _find_predecessor(self.phases[-1], self.after)

    def list_pressed(self, index: int) -> list[str]:
        """The contacts of a phase that press to its end: without those that it releases."""
        phase, after = self.phases[index], (*self.phases[1:], self.after)[index]
        leaving = _list_leaving(phase, after) if phase.until.is_release else set()
        return [name for name in phase.formation.names if name not in leaving]

    def follow(self, events: Sequence[Event]) -> tuple[list[float], Event | None]:
        """When its phases end [s], as far as they do, and the first loss of a contact before."""
        ends: list[float] = []
        following = (*self.phases[1:], self.after)
        for event in events:
            phase, after = self.phases[len(ends)], following[len(ends)]
            if _is_end(phase, after, event):
                ends.append(event.time)
                if len(ends) == len(self.phases):
                    break
            elif event.kind is EventKind.CONTACT_LOST and event.contact in phase.formation.names:
                return ends, event
        return ends, None


def split_passages(problem: Problem) -> list[Passage]:
    """The phases of a problem, those together that are carried in one motion."""
    passages: list[Passage] = []
    own: list[Phase] = []
    for phase, after in zip(problem.phases, (*problem.phases[1:], None), strict=True):
        own.append(phase)
        moves = after is not None and bool(_find_predecessor(phase, after))
        if after is None or (phase.end is End.REST and not moves):
            passages.append(Passage(tuple(own), after))
            own = []
    return passages


def name_numbers(first: int, last: int) -> str:
    """Numbers of phases, such as 3 or 9-11."""
    return f"{first}" if first == last else f"{first}-{last}"


def _is_end(phase: Phase, after: Phase | None, event: Event) -> bool:
    """Whether an event ends a phase; a coordinate that does is none."""
    until = phase.until
    if until.contact is not None:
        return event.kind in _GAINS and event.contact == until.contact.name
    gone = event.kind is EventKind.CONTACT_LOST
    return until.is_release and gone and event.contact in _list_leaving(phase, after)


def _list_leaving(phase: Phase, after: Phase | None) -> set[str]:
    kept = () if after is None else after.formation.names
    return set(phase.formation.names) - set(kept)


def _find_predecessor(phase: Phase, after: Phase | None) -> str:
    gained = phase.until.contact
    if gained is None or gained.finger is None:
        return ""
    count = phase.formation.scene.polygon.n_vertices
    kept = () if after is None else after.formation.contacts
    for contact in phase.formation.contacts:
        near = contact.finger == gained.finger and contact not in kept
        if near and (_adjoins(contact, gained, count) or _adjoins(gained, contact, count)):
            return contact.name
    return ""


def _adjoins(first: Contact, second: Contact, count: int) -> bool:
    """Whether a vertex on the arc of a tip is next to a contact with its side, or with an edge."""
    if (first.feature, first.surface) != ("v", "tip"):
        return False
    if second.surface == "finger":
        return first.index == second.index
    return second.feature == "e" and first.index in (second.index, (second.index + 1) % count)


@dataclass(frozen=True, eq=False)
class PhaseTuning:
    """One phase, or several that are carried in one motion."""

    number: int  # number, last: the first phase's and the last one's
    last: int
    until: str
    acting: int = 0  # number of the finger behind the motion; 0 if the phase was not tuned
    # [N m]: torques that balance the slow motion at its start: both torques are these in steps of
    # 10 %
    quasistatic: tuple[float, float] = (math.nan, math.nan)
    # how many times the acting torque was raised to drive the object; None if that did not help
    raised: int | None = None
    braked: int | None = None  # likewise while braking, lowered if negative; None without a brake
    # how many times the supporting torque is raised while braking, lowered if negative
    supported: int = 0
    # the torques, since the start of the phase, the last ones holding the object at its end
    steps: tuple[TuningStep, ...] = ()
    duration: float = math.nan  # [s]: until its end is reached
    rate: float = math.nan  # [m/s or rad/s]: how fast that closes then
    least: float = math.nan  # [N]: the least normal force, of `weakest`
    weakest: str = ""
    trials: tuple[TuningTrial, ...] = ()
    simulations: int = 0

    @property
    def title(self) -> str:
        """Its numbers, for people."""
        return name_numbers(self.number, self.last)

    @property
    def finger(self) -> str:
        """The finger behind the motion, for people."""
        return f"finger {self.acting}"

    @property
    def support(self) -> int | None:
        """How many times the supporting torque is raised while braking; None if it is not."""
        return self.supported or None


@dataclass(frozen=True, eq=False, repr=False)
class Tuning(Result):
    """Torques tuned by the 10 % rule."""

    name: str  # the problem's
    phases: tuple[PhaseTuning, ...]  # up to the first that does not succeed
    # (n, 3): the table of t and both torques, a repeated time being a step; None if a phase failed
    rows: Array | None = field(repr=False)
    # of the whole, simulated without telling which contacts hold
    report: FreeReport | None = field(repr=False)
    reason: str  # the one sentence behind the verdict

    derived = ("ok", "exit_status", "reason", "simulations", "duration")

    @property
    def torque(self) -> TorqueProfile | None:
        """The torques, None if there are none."""
        return None if self.rows is None else read_rows(self.rows)

    @property
    def ok(self) -> bool:
        """Whether the torques keep every contact to the end."""
        return self.report is not None and self.report.ok

    @property
    def duration(self) -> float | None:
        """How long the torques last [s]; None if there are none."""
        return None if self.rows is None else float(self.rows[-1, 0])

    @property
    def simulations(self) -> int:
        """How many simulations it took, the last one of the whole included."""
        return sum(phase.simulations for phase in self.phases) + (self.report is not None)

    def to_csv(self) -> str:
        """The torques as a table, with how many simulations they took and what was done.

        Raises
        ------
        ValueError  if there are none
        """
        if self.rows is None:
            raise ValueError("no torques were found")
        notes = [f"# simulations = {self.simulations}"]
        for phase in self.phases:
            text = f"finger {phase.acting} {phase.raised:+d}"
            if phase.braked is not None:
                text += f", brake {phase.braked:+d}"
            if phase.supported:
                text += f", support {phase.supported:+d}"
            notes.append(f"# phase {phase.title} = {text}")
        return "\n".join([*notes, format_rows(self.rows)])

    @property
    def document(self) -> Document:
        """The verdict with its reason, and a table of the phases."""
        columns = {
            "title": "phase:d", "until": "until", "finger": "acts",
            "quasistatic": "from [N m]:.4f", "raised": "drive:+d", "braked": "brake:+d",
            "support": "support:+d", "duration": "lasts [s]:.5f", "rate": "closing at:.2g",
            "least": "least c_n [N]:.4f", "weakest": "of", "simulations": "simulations:d",
        }  # fmt: skip
        tuned = Table.of((phase for phase in self.phases if phase.acting), columns)
        last = "" if self.duration is None else f", {self.duration:.5f} s"
        return self.judge(self.name, self.reason, [tuned, f"{self.simulations} simulations{last}"])
