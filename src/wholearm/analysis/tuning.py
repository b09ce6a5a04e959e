"""Torques from rest to rest by trial and error in steps of 10 %.

Constant torques of a phase start from quasistatic ones. The acting torque is raised until the end
is reached; the instant of a brake is found by false position in the arrival speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, find_root
from ..common.document import Document, Result, Table, fixed
from ..common.errors import InputError, name_source
from ..common.fields import SHARE, Range
from ..common.sharing import exclusive
from ..geometry.tracing import EndDistance
from ..problem.definition import End, Phase, Problem, Until
from ..problem.read import require_phases
from ..results.report import DEPARTURE
from ..results.torque import TorqueProfile, format_rows
from ..simulation.complementarity import FreeRun
from ..simulation.events import Event, EventKind, Simulation
from ..simulation.simulate import simulate_free
from ..simulation.system import REST_WINDOW
from ..verification import free
from .slow_speeds import SQUEEZE, PathSamples, find_torques, sample_path

FACTOR = 1.1
"""What raises a torque by 10 %; lowering divides by it, so that each torque comes again."""


@dataclass(frozen=True)
class TuningSettings:
    """Accuracies and limits of the search; times and speeds are over those of the scene."""

    lasts: float = 40.0  # how long a trial goes on after its last step of the torques
    pause: float = 0.2  # how long the object is held at the end of each phase
    back: float = 1e-6  # increase of the distance from the end, over the way, that is turning back
    # Speed at which a brake may reach the end: contacts part for less than a moment then.
    slow: float = 3e-5
    coarse: float = 50.0  # factor on that while brakes are compared
    raises: int = 60  # most times a torque is raised or lowered: a factor of 300
    brake_step: int = 2  # by how many steps the acting torque is lowered while it brakes too little
    gain: float = 0.02  # least share of the time by which another 10 % brings the end sooner
    failures: int = 2  # torques that stop nothing after which the search ends, once one has
    trials: int = 24  # most trials that look for the instant to brake
    losses: int = 4  # most of them that may lose a contact
    # Bracket of that instant, over its time, at which the end is either reached fast (over the
    # drive's speed) or missed by far (over the way): when to brake does not matter then.
    bracket: float = 1e-3
    fast: float = 0.1
    far: float = 0.02
    grid: int = 16  # instants to brake at that are tried, where all let the object arrive
    sections: int = 45  # most golden sections to the one at which it arrives most slowly
    hold: int = 6  # how many times the acting torque is lowered to hold the end, less one
    simulations: int = 600  # of one start, after which nothing further is tried
    stops: int = 7  # most stops of a phase: halves of halves of halves


SETTINGS = TuningSettings()


class TrialOutcome(Enum):
    """Outcome of a trial."""

    RESTS = "rests"
    """The object does not begin to slide, stops short of the end of the phase, or turns back."""
    ARRIVES = "arrives"  # the end of the phase is reached
    LOSES = "loses"  # a contact parts, or presses with less than epsilon
    LASTS = "lasts"  # the object is still on its way when the trial is over


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


def make_rows(steps: Sequence[TuningStep], end: float) -> Array:
    """A table of t and both torques, shape (n, 3), that steps from one constant to the next."""
    t = np.repeat([*(step.time for step in steps), end], 2)[1:-1]
    return np.column_stack([t, np.repeat([step.tau for step in steps], 2, axis=0)])


class Passage(NamedTuple):
    """Phases that are carried in one motion."""

    phases: tuple[Phase, ...]
    after: Phase | None  # the one that follows; None after the last


def split_passages(problem: Problem) -> list[Passage]:
    """The phases of a problem, those together that are carried in one motion."""
    passages: list[Passage] = []
    phases: list[Phase] = []
    for phase, after in zip(problem.phases, (*problem.phases[1:], None), strict=True):
        phases.append(phase)
        # A contact that goes on as the one which ends the phase is carried on in motion.
        contact = phase.until.contact
        moves = contact is not None and contact.name not in free.list_gained(problem, phase)
        if after is None or (phase.end is End.REST and not moves):
            passages.append(Passage(tuple(phases), after))
            phases = []
    return passages


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
    end: Array | None = field(default=None, repr=False)  # (5,): where it rests then, if it does
    reason: str = field(default="", repr=False)  # why it does not

    @property
    def title(self) -> str:
        """Its numbers, such as 3 or 9-11."""
        return f"{self.number}" if self.number == self.last else f"{self.number}-{self.last}"


@dataclass(frozen=True, eq=False, repr=False)
class Tuning(Result):
    """Torques tuned by the 10 % rule."""

    name: str  # the problem's
    phases: tuple[PhaseTuning, ...]  # up to the first that does not succeed
    # (n, 3): the table of t and both torques, a repeated time being a step; None if a phase failed
    rows: Array | None = field(repr=False)
    # of the whole, simulated without telling which contacts hold
    report: free.FreeReport | None = field(repr=False)
    reason: str  # the one sentence behind the verdict

    derived = ("ok", "exit_status", "reason", "simulations", "duration")

    @property
    def torque(self) -> TorqueProfile | None:
        """The torques, None if there are none."""
        return None if self.rows is None else TorqueProfile.join_rows(self.rows)

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

        ValueError if there are none.
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
        acted = [phase for phase in self.phases if phase.acting]
        torques = np.abs(np.nan_to_num([phase.quasistatic for phase in acted])).max(initial=0.0)
        forces = np.abs(np.nan_to_num([phase.least for phase in acted])).max(initial=0.0)
        torque, force = fixed(min(2.0, float(torques)), 5), fixed(min(0.5, float(forces)), 4)
        columns = {
            "title": "phase:d", "until": "until", "acting": "finger:d",
            "quasistatic": f"from [N m]:{torque}", "raised": "drive:+d", "braked": "brake:+d",
            "supported": "support:+d", "duration": "lasts [s]:.5f", "rate": "closing at:.2g",
            "least": f"least c_n [N]:{force}", "weakest": "of", "simulations": "simulations:d",
        }  # fmt: skip
        tuned = Table.of(acted, columns)
        last = "" if self.duration is None else f", {self.duration:.5f} s"
        return self.judge(self.name, self.reason, [tuned, f"{self.simulations} simulations{last}"])


@exclusive
def tune(
    problem: Problem,
    *,
    brake: bool = False,
    stops: int = 0,
    squeeze: float = SQUEEZE,
    share: float = 1.0,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Tune torques from the quasistatic ones, in steps of 10 %, by free simulations.

    Each phase has constant torques. That of the finger behind the motion is raised until the
    object slides to the end of the phase, and further for speed until a contact is lost; then it
    is lowered by 10 %. Phases that pass into one another in motion are tuned as one.

    Parameters
    ----------
    brake     whether each phase may have one more step of its torques, which stops it at its end
    stops     how often a phase that does not succeed with a brake may stop on its way, 0 to 7:
              halfway, then again in the halves that do not succeed
    squeeze   internal force of the quasistatic torques; as of `predict`
    share     which of the raises that reach the end of a phase is taken, from the first, 0, to the
              last that keeps every contact, 1
    progress  shown each trial, in words

    InputError if the phases cannot be carried out geometrically, or a number is out of its range.
    """
    require_phases(problem)
    squeeze, share = SHARE.read(squeeze, "squeeze"), SHARE.read(share, "share")
    if Range(0, SETTINGS.stops).read(stops, "stops") and not brake:
        raise InputError("", "stops", f"{stops} given without a brake; allowed then is 0")
    options = TuningOptions(brake, squeeze, share, progress or (lambda text: None))
    tuned: list[PhaseTuning] = []
    steps: list[TuningStep] = []
    z, clock = problem.start, 0.0
    with name_source(problem.source):
        for passage in split_passages(problem):
            tuned += (parts := _carry(problem, passage, options, z, stops))
            for part in parts:
                if part.end is None:
                    reason = f"phase{'s' if '-' in part.title else ''} {part.title}: {part.reason}"
                    return Tuning(problem.name, tuple(tuned), None, None, reason)
                steps += [step._replace(time=clock + step.time) for step in part.steps]
                clock += part.duration + SETTINGS.pause * problem.scene.scales.time
                z = part.end
    rows = make_rows(steps, clock)
    report = free.verify_free(problem, TorqueProfile.join_rows(rows))
    return Tuning(problem.name, tuple(tuned), rows, report, report.reason)


def _carry(
    problem: Problem, passage: Passage, options: TuningOptions, z: Array, stops: int
) -> list[PhaseTuning]:
    """Tune a passage from rest at `z`, with stops on the way where that does not succeed."""
    tuner = PassageTuner(problem, passage, z, options)
    tuning = tuner.tune()
    halves = tuner.halve() if tuning.end is None and stops else None
    if halves is None:
        return [tuning]
    first = _carry(problem, halves[0], options, z, (stops - 1) // 2)
    first[0] = replace(first[0], simulations=first[0].simulations + tuning.simulations)
    if first[-1].end is None:
        return first
    return [*first, *_carry(problem, halves[1], options, first[-1].end, stops - len(first))]


class TuningOptions(NamedTuple):
    """As of `tune`."""

    brake: bool
    squeeze: float
    share: float
    tell: Callable[[str], None]


class TuningDrive(NamedTuple):
    """Torques that reach the end of the phase, with a brake or without."""

    # how many times the acting torque (that of the brake) is raised; lowered if negative
    raised: int
    trial: TuningTrial
    supported: int = 0  # how many times the supporting torque is raised in the brake


class PassageTuner:
    """The rule at work on one passage from rest at `z`, shape (5,), and its trials.

    Quasistatic torques `tau`, (2,) [N m], are raised and lowered; `last` are those at the end of
    the passage; `acting` is the index of the acting finger.
    """

    tau: Array
    last: Array
    acting: int
    title: str  # what its trials are told with

    def __init__(
        self, problem: Problem, passage: Passage, z: Array, options: TuningOptions
    ) -> None:
        self.problem, self.passage, self.z, self.options = problem, passage, z, options
        self.until = passage.phases[-1].until
        self.end = EndDistance.to_leading(problem.scene, self.until, z)
        self.way = float(self.measure(z[None])[0])  # how far away the end is [m or rad]
        self.limit, self.gains = problem.scene.torque_limit, self.until.contact is not None
        scales, self.time = problem.scene.scales, problem.scene.scales.time
        self.slow = SETTINGS.slow * (scales.rate if self.end.unit == "rad" else scales.speed)
        # Two freedoms where the object arrives.
        self.is_free = passage.phases[-1].formation.n_constraints < 4
        self.trials: list[TuningTrial] = []
        self.simulations = 0  # trials, and landings

    def halve(self) -> tuple[Passage, Passage] | None:
        """Both halves of the way, the first until x or phi is what it is there."""
        phases, paths = self.passage.phases, list(self._follow(self.passage.phases, self.z))
        if len(paths) < len(phases):
            return None
        ends = np.cumsum([path.length for path in paths])
        k = int(np.searchsorted(ends, ends[-1] / 2))
        path, left = paths[k], ends[k] - ends[-1] / 2
        x, _, phi = path.point.z[int(np.searchsorted(path.s, path.length - left)), :3].tolist()
        middle = Until(coordinate="x", value=x, pins=(("phi", phi),))
        until = middle.lead(path.point.z[0], self.problem.scene.scales.length)
        part = replace(phases[k], until=replace(until, pins=()), end=End.REST)
        first = Passage((*phases[:k], part), phases[k])
        return first, Passage(phases[k:], self.passage.after)

    def tune(self) -> PhaseTuning:
        """Tune it."""
        phases = self.passage.phases
        tuning = PhaseTuning(phases[0].number, phases[-1].number, str(self.until))
        if any(phase.until.value is not None for phase in phases[:-1]):
            text = "a coordinate is passed in motion; the rule tunes phases to rest"
            return replace(tuning, reason=text)
        balance = self._balance(phases, self.z)
        if balance is None:
            text = "no quasistatic motion keeps every contact, where tuning would start"
            return replace(tuning, reason=text)
        best, (balanced, self.acting) = None, balance
        self.last, count = balanced[-1], len(self.problem.phases)
        self.title = f"phase {tuning.title} of {count}, finger {self.acting + 1}"
        # The supporting torque at the start, then the one where it presses most: the right finger
        # presses anticlockwise, the left one clockwise.
        supporting, press = balanced[:, 1 - self.acting], np.max if self.acting else np.min
        for support in dict.fromkeys([supporting[0], press(supporting)]):
            self.tau = np.where(np.arange(2) == self.acting, balanced[0], support)
            attempt = self._try(replace(tuning, acting=self.acting + 1))
            if attempt.end is not None:
                return attempt
            if best is None or best.raised is None:
                best = attempt
            if self.is_exhausted:
                break
        assert best is not None
        return best

    def _try(self, own: PhaseTuning) -> PhaseTuning:
        """Tune it from the present torques."""
        own, drives = replace(own, quasistatic=self.scale(0)), self.drive()
        drives = drives[: 1 + round(self.options.share * (len(drives) - 1))]
        if not drives:
            nearest, last = min(self.trials, key=lambda trial: trial.short), self.trials[-1]
            text = f"no constant torques reach {self.until}: the nearest trial "
            text += nearest.to_text()
            why = "up to the torque limit"
            if last.outcome is TrialOutcome.LOSES:
                why = f"and raised {len(self.trials) - 1} times it {last.to_text()}"
            return self._sum_up(own, last, reason=f"{text}, {why}")
        if not self.options.brake:
            # The fastest that is held where it arrives; the slowest arrives most gently.
            held = None
            for drive in drives:
                attempt = self._hold(replace(own, raised=drive.raised), drive.trial)
                if attempt.end is None:
                    return held or attempt
                held = attempt
            assert held is not None
            return held
        stopped = self.brake(drives)
        if stopped is None:
            text = "no torque in steps of 10 % brings it to rest at its end: a trial "
            text += self.trials[-1].to_text()
            return self._sum_up(own, drives[-1].trial, raised=drives[-1].raised, reason=text)
        drive, brake = stopped
        own = replace(own, raised=drive.raised, braked=brake.raised, supported=brake.supported)
        return self._hold(own, brake.trial)

    def _hold(self, own: PhaseTuning, trial: TuningTrial) -> PhaseTuning:
        """Hold the object where a trial has arrived: as it is, or lowered for the next phase."""
        rate = f"{trial.rate:.3g} {self.end.unit}/s at t = {trial.time:.5g} s"
        for tau in self._list_holds(trial):
            steps = trial.steps if tau is None else (*trial.steps, TuningStep(trial.time, tau))
            z, text = self.land(steps, trial.time, trial.time + SETTINGS.pause * self.time)
            own = self._sum_up(own, trial, steps=steps, end=None if text else z)
            if not text:
                break
            own = replace(own, reason=f"{self.until} is reached at {rate}, and {text}")
        return own

    def _list_holds(self, trial: TuningTrial) -> list[tuple[float, float] | None]:
        """What may hold the object: what it arrives with, or quasistatic torques lowered.

        Those are of the next phase, or of the end of the last one; then those it arrives with, the
        acting one lowered, and the supporting one more so.
        """
        after = self.passage.after
        own = self.last[None], self.acting
        balance = own if after is None else self._balance((after,), trial.z)
        if balance is None:
            return [None]
        (first, second), acting = balance[0][0].tolist(), balance[1]
        factors = [FACTOR**n for n in range(1, SETTINGS.hold)]
        lowered = [(first / f, second) if acting == 0 else (first, second / f) for f in factors]
        arrived, held = np.array(trial.steps[-1].tau), []
        if after is None:
            arrived[1 - acting] /= FACTOR**SETTINGS.hold
            held = [tuple((arrived / FACTOR ** (SETTINGS.hold * n)).tolist()) for n in range(3)]
        return [None, *lowered, *held]

    def _balance(self, phases: Sequence[Phase], z: Array) -> tuple[Array, int] | None:
        """Torques of a quasistatic motion from `z`, (n, 2), as far as one keeps every contact.

        And the index of the torque with the most work: the finger behind the motion.
        """
        tau, work = list[Array](), list[Array]()
        for path in self._follow(phases, z):
            torques = find_torques(path, self.problem.epsilon, self.options.squeeze)
            if torques is None:
                break
            tau.append(torques.tau)
            work.append(torques.tau * path.point.z_s[:, 3:])
        return (np.vstack(tau), int(np.vstack(work).mean(axis=0).argmax())) if tau else None

    def _follow(self, phases: Sequence[Phase], z: Array) -> Iterator[PathSamples]:
        """Paths of phases from `z` on, up to one with other than one or two freedoms."""
        for phase in phases:
            path = sample_path(phase, z, self.problem.phases[phase.index + 1 :])
            if path is None:
                return
            yield path
            z = path.point.z[-1]

    def _sum_up(self, own: PhaseTuning, trial: TuningTrial, **more: Any) -> PhaseTuning:
        """The tuning with the numbers of a trial, and what it took."""
        more |= {"duration": trial.time, "rate": trial.rate, "least": trial.least}
        more |= {"weakest": trial.weakest, "trials": tuple(self.trials)}
        return replace(own, simulations=self.simulations, **more)

    @property
    def is_exhausted(self) -> bool:
        """Whether there have been so many simulations that no other torques are tried."""
        return self.simulations > SETTINGS.simulations

    def scale(self, acting: int, supporting: int = 0) -> tuple[float, float]:
        """The torques raised so many times, lowered where negative."""
        powers = [supporting, supporting]
        powers[self.acting] = acting
        first, second = (float(tau) * FACTOR**n for tau, n in zip(self.tau, powers, strict=True))
        return first, second

    def drive(self) -> list[TuningDrive]:
        """Raise the acting torque until a contact is lost; those that reach the end, by torque.

        The last trial says what was lost, or that the object did not slide.
        """
        drives = []
        for raised in range(SETTINGS.raises):
            tau = self.scale(raised)
            if self.is_exhausted or abs(tau[self.acting]) > self.limit[self.acting]:
                break
            trial = self.run([TuningStep(0.0, tau)], f"raised {raised} times")
            if trial.outcome is TrialOutcome.ARRIVES:
                drives.append(TuningDrive(raised, trial))
            elif trial.outcome is TrialOutcome.LOSES:
                break
        return drives

    def brake(self, drives: Sequence[TuningDrive]) -> tuple[TuningDrive, TuningDrive] | None:
        """Stop a drive at the end of the phase, the fastest that lets itself be stopped.

        The acting torque is lowered to less than the slowest drive's and than balances the object
        at the end. Where no such torque stops any drive there without losing a contact the
        supporting one becomes that of the end.
        """
        count = len(drives)
        chosen = [drives[k] for k in sorted({count - 1, count // 2, count // 4, 0}, reverse=True)]
        first = min(drives[0].raised - 1, self._count_steps(self.acting))
        last = self._count_steps(1 - self.acting)
        # With two freedoms either torque sets the object in motion again, if it is too much there.
        for supported in dict.fromkeys([last, 0] if self.is_free else [0, last]):
            if abs(self.scale(0, supported)[1 - self.acting]) > self.limit[1 - self.acting]:
                continue
            for drive in chosen:
                braking = self._lower(drive.trial, first, supported)
                if braking is not None:
                    return drive, braking
        return None

    def _count_steps(self, finger: int) -> int:
        """How many times a torque is raised, lowered if negative, until it is that of the end."""
        share = float(self.last[finger] / self.tau[finger]) if self.tau[finger] else 1.0
        return math.floor(math.log(max(share, FACTOR**-SETTINGS.raises)) / math.log(FACTOR))

    def _lower(self, drive: TuningTrial, first: int, supported: int) -> TuningDrive | None:
        """Lower the acting torque while that brings the end sooner; None if nothing stops there."""
        best: TuningDrive | None = None
        raised, missed = first, 0
        while raised > -SETTINGS.raises and missed < SETTINGS.failures and not self.is_exhausted:
            steps = [*drive.steps, TuningStep(0.0, self.scale(raised, supported))]
            trial = self._place(steps, drive, best and best.trial, SETTINGS.coarse * self.slow)
            if trial is None:
                if best is None and self.trials[-1].outcome is TrialOutcome.LOSES:
                    break
                missed += best is not None
                raised -= SETTINGS.brake_step
                continue
            if best and trial.time > (1 - SETTINGS.gain) * best.trial.time:
                break
            best = TuningDrive(raised, trial, supported)
            if trial.rate < self.slow:
                return best
            raised -= 1
        if best is None:
            return None
        last = self._place(list(best.trial.steps), drive, best.trial, self.slow)
        return None if last is None else best._replace(trial=last)

    def _place(
        self, steps: list[TuningStep], drive: TuningTrial, near: TuningTrial | None, slow: float
    ) -> TuningTrial | None:
        """Find the instant from which on the last step brings the object to the end slowly.

        Where a weaker brake, or nearly the same instant, is known the search begins near it.
        """
        low, high = 0.0, drive.time
        below, above = self.way, self._overshoot(drive, slow)
        at, side, losses = 0.5 * high, 0, 0
        short, rate = self.way, drive.rate
        if near is not None and slow == self.slow:
            high, above = near.steps[-1].time, self._overshoot(near, slow)
            at = high * (1 - 1e-4)
        elif near is not None:
            at = min(1.02 * near.steps[-1].time, 0.5 * (near.steps[-1].time + high))
        for count in range(SETTINGS.trials):
            steps = [*steps[:-1], steps[-1]._replace(time=at)]
            trial = self.run(steps, f"brake at {at:.5g} s")
            if trial.outcome is TrialOutcome.ARRIVES:
                if trial.rate < slow:
                    return trial
                if at < SETTINGS.bracket * drive.time:
                    return self._graze(steps, drive) if self.is_free else None
                high, above, rate = at, self._overshoot(trial, slow), trial.rate
                below /= 2 if side < 0 else 1
                side = -1
            else:
                losses += trial.outcome is TrialOutcome.LOSES
                if losses > SETTINGS.losses:
                    return None
                low, short = at, trial.short
                # How far it is through several phases is not known.
                below = above if short == math.inf else max(short, 1e-12 * self.way)
                above /= 2 if side > 0 else 1
                side = 1
            jumps = short > SETTINGS.far * self.way and rate > SETTINGS.fast * drive.rate
            if jumps and high - low < SETTINGS.bracket * high:
                return None
            share = below / (below + above) if count % 4 != 3 else 0.5
            at = low + (high - low) * min(max(share, 0.02), 0.98)
            if high - low < 1e-12 * high:
                return None
        return None

    def _graze(self, steps: list[TuningStep], drive: TuningTrial) -> TuningTrial | None:
        """Find the instant to brake at which the end is just touched, on a way that always arrives.

        With two freedoms the object may turn back before the end, and come there later another way:
        how fast it arrives has a kink where it just touches, and falls to zero there.
        """

        def run(at: float) -> tuple[float, TuningTrial]:
            again = [*steps[:-1], steps[-1]._replace(time=at)]
            trial = self.run(again, f"brake at {at:.5g} s")
            return trial.rate if trial.outcome is TrialOutcome.ARRIVES else math.inf, trial

        grid = [drive.time * (k + 1) / (SETTINGS.grid + 1) for k in range(SETTINGS.grid)]
        runs = [run(at) for at in grid]
        k = min(range(1, SETTINGS.grid - 1), key=lambda k: runs[k][0])
        at, ends = grid[k], (grid[k - 1], grid[k + 1])
        rate, best = runs[k]
        if rate > min(runs[k - 1][0], runs[k + 1][0]):
            return None
        for count in range(SETTINGS.sections):
            if rate < self.slow:
                return best
            if count == SETTINGS.grid and rate > 2 * SETTINGS.coarse * self.slow:
                return None
            near, far = sorted(ends, key=lambda end: abs(end - at))
            other = at + (3 - math.sqrt(5)) / 2 * (far - at)
            new, trial = run(other)
            if new < rate:
                ends, at, rate, best = (at, far), other, new, trial
            else:
                ends = near, other
        return None

    def _overshoot(self, trial: TuningTrial, slow: float) -> float:
        """How far beyond the end the object would come to rest, less the wanted speed's part."""
        slowing = max(trial.slowing, 0.1 * trial.rate / self.time)
        return (trial.rate**2 - (0.5 * slow) ** 2) / (2 * slowing)

    def measure(self, z: Array) -> Array:
        """How far away the end of the passage is, from (n, 5) to (n,) [m or rad]."""
        return self.end.evaluate(z, z)[0]

    def run(self, steps: Sequence[TuningStep], title: str) -> TuningTrial:
        """Simulate torques until the end of the passage, or what keeps it from coming."""
        end = steps[-1].time + SETTINGS.lasts * self.time
        torque = TorqueProfile.join_rows(make_rows(steps, end))
        simulation = simulate_free(self.problem, torque, start=self.z, halt=self._is_over)
        self.simulations += 1
        self.trials.append(self._judge(tuple(steps), simulation))
        self.options.tell(f"{self.title}: {title}: {self.trials[-1].to_text()}")
        return self.trials[-1]

    def land(self, steps: Sequence[TuningStep], arrival: float, end: float) -> tuple[Array, str]:
        """Simulate torques that hold the object from its arrival [s] to an end [s].

        Returns where it is then, (5,), and what does not hold; empty if everything rests and no
        contact of the next phase, or else of the last one, has parted.
        """
        self.simulations += 1
        torque = TorqueProfile.join_rows(make_rows(steps, end))
        simulation = simulate_free(self.problem, torque, start=self.z)
        names, reason = (self.passage.after or self.passage.phases[-1]).formation.names, ""
        pauses = [(name, simulation.list_pauses(name, arrival, end)) for name in names]
        spans = [(last - first, name) for name, each in pauses for first, last in each]
        longest, worst = max(spans, key=lambda span: span[0], default=(0.0, ""))
        if longest > REST_WINDOW * self.time:
            reason = f"{worst} parts for {1e3 * longest:.3g} ms"
        elif simulation.z_dot[-1].any() or simulation.t[-1] != end:
            reason = "the object does not come to rest there"
        return simulation.z[-1], reason

    def _is_over(self, run: FreeRun) -> bool:
        if run.t == 0:
            return False
        ends, loss = self.find_ends(run.events)
        if run.resting or loss is not None or len(ends) == len(self.passage.phases):
            return True
        if len(self.passage.phases) > 1:
            return False
        gap = float(self.measure(run.z[None])[0])
        return gap > (1 + SETTINGS.back) * self.way or (not self.gains and gap <= 0)

    def find_ends(self, events: Sequence[Event]) -> tuple[list[float], Event | None]:
        """When the phases end [s], as far as they do, and the first loss of a contact before.

        Events end a phase that gains or releases a contact; a coordinate that ends one is no event.
        """
        ends: list[float] = []
        for event in events:
            phase, lost = self.passage.phases[len(ends)], event.kind is EventKind.CONTACT_LOST
            if phase.until.contact is not None:
                is_end = (
                    event.kind in free.TOUCH_EVENTS and event.contact == phase.until.contact.name
                )
            else:
                leaving = free.list_released(self.problem, phase) if phase.until.is_release else ()
                is_end = lost and event.contact in leaving
            if is_end:
                ends.append(event.time)
                if len(ends) == len(self.passage.phases):
                    break
            elif lost and event.contact in phase.formation.names:
                return ends, event
        return ends, None

    def _judge(self, steps: tuple[TuningStep, ...], simulation: Simulation) -> TuningTrial:
        gaps, phases = self.measure(simulation.z), self.passage.phases
        ends, lost = self.find_ends(simulation.events)
        arrival = ends[-1] if len(ends) == len(phases) else math.inf
        if not self.gains and gaps.min() <= 0:
            row, motion = int(np.flatnonzero(gaps <= 0)[0]), simulation.trajectory
            a, b = (float(t) for t in simulation.t[row - 1 : row + 1])
            arrival = find_root(lambda t: float(self.measure(motion.at([t]).z)[0]), a, b)
        starts = [0.0, *ends][: len(phases)]
        start = starts[-1] if len(starts) == len(phases) else math.inf  # of the last phase
        # When the end, once nearer, is farther away again.
        near = np.minimum.accumulate(np.where(simulation.t >= start, gaps, math.inf))
        back = simulation.t[gaps - near > SETTINGS.back * abs(self.way)]
        turn = float(back.min(initial=math.inf))
        stop = min(arrival, turn, float(simulation.t[-1]))
        # When contacts of its phases part, also those that never press.
        losses = [] if lost is None else [(lost.time, lost.contact)]
        for phase, first, last in zip(phases, starts, [*starts[1:], stop], strict=False):
            parted = free.find_losses(simulation, phase, first, last, DEPARTURE)
            losses += [(loss.time, loss.contact) for loss in parted]
        losses = [loss for loss in losses if loss[0] < stop]
        time, contact = min(losses, default=(stop, ""))
        at = int(np.searchsorted(simulation.t, time))
        t, c_n, gaps = (part[: at + 1].copy() for part in (simulation.t, simulation.c_n, gaps))
        # The step in which a coordinate arrives goes on beyond that.
        if t[at] > time:
            sample, t[at] = simulation.trajectory.at([time]), time
            gaps[at], c_n[at] = self.measure(sample.z)[0], sample.c_n[0]
        short = float(gaps[t >= start].min(initial=math.inf))
        least, weakest, row = self._find_least(simulation.contacts, t, c_n, ends)
        if losses:
            outcome = TrialOutcome.LOSES
        elif least < self.problem.epsilon:
            outcome, contact, time = TrialOutcome.LOSES, weakest, float(t[row])
        elif arrival == stop:
            outcome = TrialOutcome.ARRIVES
        else:
            rests = turn == stop or not simulation.z_dot[at].any()
            outcome = TrialOutcome.RESTS if rests else TrialOutcome.LASTS
        z, v, z_ddot = (part[[at]] for part in (simulation.z, simulation.z_dot, simulation.z_ddot))
        if not self.gains and time > 0:
            z, v, z_ddot = simulation.trajectory.at([time])[:3]
        _, (gradient,), (bend,) = self.end.evaluate(z, v)
        rate, slowing = -float(gradient @ v[0]), float(gradient @ z_ddot[0] + bend)
        at_last = contact, rate, slowing, short, least, weakest, z[0]
        return TuningTrial(steps, outcome, time, *at_last)

    def _find_least(
        self, contacts: Sequence[str], t: Array, forces: Array, ends: Sequence[float]
    ) -> tuple[float, str, int]:
        """The least of normal forces over time, of which contact, and in which row."""
        phases = self.passage.phases
        of = np.minimum(np.searchsorted(ends, t, side="left"), len(phases) - 1)
        names = list(dict.fromkeys(name for phase in phases for name in phase.formation.names))
        c_n = np.nan_to_num(forces[:, [contacts.index(name) for name in names]], nan=math.inf)
        for index, phase in enumerate(phases):
            # Contacts that the phase releases at its end do not count.
            leaving = free.list_released(self.problem, phase) if phase.until.is_release else set()
            others = [name in leaving or name not in phase.formation.names for name in names]
            c_n[np.ix_(of == index, others)] = math.inf
        row, column = np.unravel_index(int(c_n.argmin()), c_n.shape)
        return float(c_n[row, column]), names[int(column)], int(row)
