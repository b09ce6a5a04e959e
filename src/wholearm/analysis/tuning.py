"""Torques from rest to rest, tuned in steps of 10 % by simulation.

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
from ..common.errors import InputError, WholearmError, name_source
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

RATIO = 1.1
"""Ratio of successive torques: raised by multiplication, lowered by division."""


@dataclass(frozen=True)
class TuningSettings:
    """Accuracies and limits of the search; times and speeds are relative to the scene's."""

    trial_time: float = 40.0  # duration of a trial after its last step of the torques
    pause: float = 0.2  # time for which the object is held at the end of each phase
    turn_back: float = 1e-6  # increase of the distance, over the path, that counts as turning back
    # Largest arrival speed with a brake; contacts open in the impact for a negligible time.
    slow: float = 3e-5
    coarse: float = 50.0  # factor on that speed during the comparison of brakes
    raises: int = 60  # largest number of raises or lowerings of a torque: a factor of 300
    brake_step: int = 2  # steps by which the acting torque is lowered while it brakes too little
    min_gain: float = 0.02  # least relative reduction of the duration by another step of the brake
    failures: int = 2  # failed torques after a successful one with which the search ends
    max_trials: int = 24  # most trials in the search for the instant of the brake
    max_losses: int = 4  # most of these trials that may lose a contact
    # The search ends below the relative bracket of the instant if the arrival speed, over the
    # drive's, and the distance, over the path, are both larger than these: a discontinuity.
    bracket: float = 1e-3
    speed: float = 0.1
    gap: float = 0.02
    n_grid: int = 16  # instants of the brake on a grid, if the object arrives with all of them
    max_sections: int = 45  # most steps of golden-section search for the slowest arrival
    max_holds: int = 6  # one more than the lowerings of the acting torque that holds the end
    max_simulations: int = 600  # largest number for one start
    max_stops: int = 7  # most stops of a phase: three bisections


SETTINGS = TuningSettings()


class TrialOutcome(Enum):
    """Outcome of a trial."""

    RESTS = "rests"
    """The object does not begin to slide, stops short of the end of the phase, or turns back."""
    ARRIVES = "arrives"  # the end of the phase is reached
    LOSES = "loses"  # a contact opens, or presses with less than epsilon
    LASTS = "lasts"  # the object still moves at the end of the trial


class TuningStep(NamedTuple):
    """Torques that are constant from an instant on."""

    time: float  # [s]: since the start of the phase, or of all
    tau: tuple[float, float]  # [N m]


class TuningTrial(NamedTuple):
    """Torques of a phase, and the motion that they cause."""

    steps: tuple[TuningStep, ...]  # the torques
    outcome: TrialOutcome
    time: float  # [s]: of the outcome, since the start of the phase
    contact: str  # the lost contact, or empty
    rate: float  # [m/s or rad/s]: closing speed of the end of the phase at that time
    slowing: float  # [m/s^2 or rad/s^2]: deceleration of the closing speed at that time
    # [m or rad]: least distance from the end; infinite before the last of several phases
    short: float
    least: float  # [N]: least normal force until then, of `weakest`; infinite if nothing moved
    weakest: str
    z: Array  # (5,): configuration at that time

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
    """Successive phases without a stop between them."""

    phases: tuple[Phase, ...]
    following: Phase | None  # the next phase; None after the last


def split_passages(problem: Problem) -> list[Passage]:
    """The phases of a problem, grouped into passages."""
    passages: list[Passage] = []
    phases: list[Phase] = []
    for phase, following in zip(problem.phases, (*problem.phases[1:], None), strict=True):
        phases.append(phase)
        # A contact that only changes its name at the end of the phase does not stop the motion.
        contact = phase.until.contact
        passes = contact is not None and contact.name not in free.list_gained(problem, phase)
        if following is None or (phase.end is End.REST and not passes):
            passages.append(Passage(tuple(phases), following))
            phases = []
    return passages


@dataclass(frozen=True, eq=False)
class PhaseTuning:
    """Tuning of a passage: one phase, or several without a stop between them."""

    number: int  # number, last: of the first and the last phase
    last: int
    until: str
    acting: int = 0  # number of the finger behind the motion; 0 if the phase was not tuned
    # [N m]: torques of the quasistatic motion at the start, which are changed in steps of 10 %
    quasistatic: tuple[float, float] = (math.nan, math.nan)
    # number of raises of the acting torque that drives the object; None if none succeeds
    raised: int | None = None
    braked: int | None = None  # raises in the brake, negative if lowered; None without a brake
    # raises of the supporting torque in the brake, negative if lowered
    supported: int = 0
    # the torques, since the start of the phase; the last ones hold the object at its end
    steps: tuple[TuningStep, ...] = ()
    duration: float = math.nan  # [s]: until its end is reached
    rate: float = math.nan  # [m/s or rad/s]: closing speed of the end at that time
    least: float = math.nan  # [N]: the least normal force, of `weakest`
    weakest: str = ""
    trials: tuple[TuningTrial, ...] = ()
    simulations: int = 0
    end: Array | None = field(default=None, repr=False)  # (5,): configuration of rest at the end
    reason: str = field(default="", repr=False)  # of a failure

    @property
    def title(self) -> str:
        """Phase numbers, such as 3 or 9-11."""
        return f"{self.number}" if self.number == self.last else f"{self.number}-{self.last}"


@dataclass(frozen=True, eq=False, repr=False)
class Tuning(Result):
    """Torques tuned by the 10 % rule."""

    name: str  # the problem's
    phases: tuple[PhaseTuning, ...]  # up to the first that fails
    # (n, 3): the table of t and both torques, a repeated time being a step; None if a phase failed
    rows: Array | None = field(repr=False)
    # simulation of all phases without prescribed contacts
    report: free.FreeReport | None = field(repr=False)
    reason: str  # of the verdict, a sentence

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
        """Duration of the torques [s]; None if there are none."""
        return None if self.rows is None else float(self.rows[-1, 0])

    @property
    def simulations(self) -> int:
        """Number of simulations, the last one of all phases included."""
        return sum(phase.simulations for phase in self.phases) + (self.report is not None)

    def to_csv(self) -> str:
        """The torques as a table, with comments on the number of simulations and on the raises.

        WholearmError if there are none.
        """
        if self.rows is None:
            raise WholearmError(f"no torques were found: {self.reason}")
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
        moved = [phase for phase in self.phases if phase.acting]
        torques = np.abs(np.nan_to_num([phase.quasistatic for phase in moved])).max(initial=0.0)
        forces = np.abs(np.nan_to_num([phase.least for phase in moved])).max(initial=0.0)
        torque, force = fixed(min(2.0, float(torques)), 5), fixed(min(0.5, float(forces)), 4)
        columns = {
            "title": "phase:d", "until": "until", "acting": "finger:d",
            "quasistatic": f"from [N m]:{torque}", "raised": "drive:+d", "braked": "brake:+d",
            "supported": "support:+d", "duration": "lasts [s]:.5f", "rate": "closing at:.2g",
            "least": f"least c_n [N]:{force}", "weakest": "of", "simulations": "simulations:d",
        }  # fmt: skip
        tuned = Table.of(moved, columns)
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

    Each phase has constant torques. The acting torque, with the largest work, is raised until the
    object slides to the end of the phase, and further for speed until a contact is lost; then it
    is lowered by 10 %. Phases without a stop between them are tuned as one.

    Parameters
    ----------
    brake     whether each phase may have one more step of its torques, which stops it at its end
    stops     largest number of stops, 0 to 7, on the path of a phase that fails with a brake:
              halfway, then halfway in the halves that fail
    squeeze   internal force of the quasistatic torques; as of `predict`
    share     selects one of the raises that reach the end of a phase, from the first, 0, to the
              last that keeps every contact, 1
    progress  called with a text on each trial

    InputError if the phases cannot be carried out geometrically, or a number is out of its range.
    """
    require_phases(problem)
    squeeze, share = SHARE.read(squeeze, "squeeze"), SHARE.read(share, "share")
    if Range(0, SETTINGS.max_stops).read(stops, "stops") and not brake:
        raise InputError("", "stops", f"{stops} given without a brake; allowed then is 0")
    options = TuningOptions(brake, squeeze, share, progress or (lambda text: None))
    tunings: list[PhaseTuning] = []
    steps: list[TuningStep] = []
    z, time = problem.start, 0.0
    with name_source(problem.source):
        for passage in split_passages(problem):
            tunings += (parts := _tune_passage(problem, passage, options, z, stops))
            for part in parts:
                if part.end is None:
                    reason = f"phase{'s' if '-' in part.title else ''} {part.title}: {part.reason}"
                    return Tuning(problem.name, tuple(tunings), None, None, reason)
                steps += [step._replace(time=time + step.time) for step in part.steps]
                time += part.duration + SETTINGS.pause * problem.scene.scales.time
                z = part.end
    rows = make_rows(steps, time)
    report = free.verify_free(problem, TorqueProfile.join_rows(rows))
    return Tuning(problem.name, tuple(tunings), rows, report, report.reason)


def _tune_passage(
    problem: Problem, passage: Passage, options: TuningOptions, z: Array, stops: int
) -> list[PhaseTuning]:
    """Tune a passage from rest at `z`; if that fails, in halves with up to `stops` stops."""
    tuner = PassageTuner(problem, passage, z, options)
    tuning = tuner.tune()
    halves = tuner.halve() if tuning.end is None and stops else None
    if halves is None:
        return [tuning]
    first = _tune_passage(problem, halves[0], options, z, (stops - 1) // 2)
    first[0] = replace(first[0], simulations=first[0].simulations + tuning.simulations)
    if first[-1].end is None:
        return first
    return [*first, *_tune_passage(problem, halves[1], options, first[-1].end, stops - len(first))]


class TuningOptions(NamedTuple):
    """Options of `tune`."""

    brake: bool
    squeeze: float
    share: float
    progress: Callable[[str], None]


class TuningDrive(NamedTuple):
    """Torques that reach the end of the phase, with a brake or without."""

    # number of raises of the acting torque (in the brake, if there is one); lowered if negative
    raised: int
    trial: TuningTrial
    supported: int = 0  # number of raises of the supporting torque in the brake


class PassageTuner:
    """Tuning of one passage from rest at `z`, shape (5,), and its trials.

    Quasistatic torques `tau`, (2,) [N m], are raised and lowered; `last` are those at the end of
    the passage; `acting` is the index of the acting finger.
    """

    tau: Array
    last: Array
    acting: int
    title: str  # of the trials, in texts on progress

    def __init__(
        self, problem: Problem, passage: Passage, z: Array, options: TuningOptions
    ) -> None:
        self.problem, self.passage, self.z, self.options = problem, passage, z, options
        self.until = passage.phases[-1].until
        self.end = EndDistance.to_leading(problem.scene, self.until, z)
        self.length = float(self.measure(z[None])[0])  # distance of the end [m or rad]
        self.limit, self.gains_contact = problem.scene.torque_limit, self.until.contact is not None
        scales, self.time = problem.scene.scales, problem.scene.scales.time
        self.slow = SETTINGS.slow * (scales.rate if self.end.unit == "rad" else scales.speed)
        # Two freedoms where the object arrives.
        self.is_free = passage.phases[-1].formation.n_constraints < 4
        self.trials: list[TuningTrial] = []
        self.simulations = 0  # trials, and landings

    def halve(self) -> tuple[Passage, Passage] | None:
        """Both halves of the path; the first ends at the value of x or phi in the middle."""
        phases, paths = self.passage.phases, list(self._follow(self.passage.phases, self.z))
        if len(paths) < len(phases):
            return None
        ends = np.cumsum([path.length for path in paths])
        k = int(np.searchsorted(ends, ends[-1] / 2))
        path, remaining = paths[k], ends[k] - ends[-1] / 2
        x, _, phi = path.point.z[int(np.searchsorted(path.s, path.length - remaining)), :3].tolist()
        middle = Until(coordinate="x", value=x, pins=(("phi", phi),))
        until = middle.lead(path.point.z[0], self.problem.scene.scales.length)
        part = replace(phases[k], until=replace(until, pins=()), end=End.REST)
        first = Passage((*phases[:k], part), phases[k])
        return first, Passage(phases[k:], self.passage.following)

    def tune(self) -> PhaseTuning:
        """Tune the passage."""
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
        # The supporting torque at the start, then the largest one towards the object: anticlockwise
        # of the right finger, clockwise of the left one.
        supporting, extreme = balanced[:, 1 - self.acting], np.max if self.acting else np.min
        for support in dict.fromkeys([supporting[0], extreme(supporting)]):
            self.tau = np.where(np.arange(2) == self.acting, balanced[0], support)
            attempt = self._attempt(replace(tuning, acting=self.acting + 1))
            if attempt.end is not None:
                return attempt
            if best is None or best.raised is None:
                best = attempt
            if self.is_exhausted:
                break
        assert best is not None
        return best

    def _attempt(self, phase: PhaseTuning) -> PhaseTuning:
        """Tune the passage from the present torques."""
        phase, drives = replace(phase, quasistatic=self.scale(0)), self.drive()
        drives = drives[: 1 + round(self.options.share * (len(drives) - 1))]
        if not drives:
            nearest, last = min(self.trials, key=lambda trial: trial.short), self.trials[-1]
            text = f"no constant torques reach {self.until}: the nearest trial "
            text += nearest.to_text()
            limit = "up to the torque limit"
            if last.outcome is TrialOutcome.LOSES:
                limit = f"and raised {len(self.trials) - 1} times it {last.to_text()}"
            return self._summarize(phase, last, reason=f"{text}, {limit}")
        if not self.options.brake:
            # The fastest drive after which the object is held; slower ones arrive at lower speed.
            solution = None
            for drive in drives:
                attempt = self._hold(replace(phase, raised=drive.raised), drive.trial)
                if attempt.end is None:
                    return solution or attempt
                solution = attempt
            assert solution is not None
            return solution
        braked = self.brake(drives)
        if braked is None:
            text = "no torque in steps of 10 % brings it to rest at its end: a trial "
            text += self.trials[-1].to_text()
            return self._summarize(phase, drives[-1].trial, raised=drives[-1].raised, reason=text)
        drive, brake = braked
        phase = replace(phase, raised=drive.raised, braked=brake.raised, supported=brake.supported)
        return self._hold(phase, brake.trial)

    def _hold(self, phase: PhaseTuning, trial: TuningTrial) -> PhaseTuning:
        """Tuning with torques that hold the object at the arrival of a trial."""
        rate = f"{trial.rate:.3g} {self.end.unit}/s at t = {trial.time:.5g} s"
        for tau in self._list_holds(trial):
            steps = trial.steps if tau is None else (*trial.steps, TuningStep(trial.time, tau))
            z, text = self.land(steps, trial.time, trial.time + SETTINGS.pause * self.time)
            phase = self._summarize(phase, trial, steps=steps, end=None if text else z)
            if not text:
                break
            phase = replace(phase, reason=f"{self.until} is reached at {rate}, and {text}")
        return phase

    def _list_holds(self, trial: TuningTrial) -> list[tuple[float, float] | None]:
        """Torques that may hold the object; None for those of the arrival.

        Next come quasistatic torques of the next phase, or of the end of the last one, with the
        acting one lowered; after the last phase also both torques of the arrival, lowered.
        """
        following = self.passage.following
        final = self.last[None], self.acting
        balance = final if following is None else self._balance((following,), trial.z)
        if balance is None:
            return [None]
        (first, second), acting = balance[0][0].tolist(), balance[1]
        factors = [RATIO**n for n in range(1, SETTINGS.max_holds)]
        lowered = [(first / f, second) if acting == 0 else (first, second / f) for f in factors]
        tau, last = np.array(trial.steps[-1].tau), []
        if following is None:
            tau[1 - acting] /= RATIO**SETTINGS.max_holds
            last = [tuple((tau / RATIO ** (SETTINGS.max_holds * n)).tolist()) for n in range(3)]
        return [None, *lowered, *last]

    def _balance(self, phases: Sequence[Phase], z: Array) -> tuple[Array, int] | None:
        """Torques of a quasistatic motion from `z`, (n, 2), and the index of the acting finger.

        They end at the first phase that loses a contact. The acting finger does most work.
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

    def _summarize(self, tuning: PhaseTuning, trial: TuningTrial, **values: Any) -> PhaseTuning:
        """The tuning with the values of a trial, all trials, and the number of simulations."""
        values |= {"duration": trial.time, "rate": trial.rate, "least": trial.least}
        values |= {"weakest": trial.weakest, "trials": tuple(self.trials)}
        return replace(tuning, simulations=self.simulations, **values)

    @property
    def is_exhausted(self) -> bool:
        """Whether the largest number of simulations is exceeded."""
        return self.simulations > SETTINGS.max_simulations

    def scale(self, acting: int, supporting: int = 0) -> tuple[float, float]:
        """Torques [N m] by numbers of raises of the acting and the supporting one."""
        powers = [supporting, supporting]
        powers[self.acting] = acting
        first, second = (float(tau) * RATIO**n for tau, n in zip(self.tau, powers, strict=True))
        return first, second

    def drive(self) -> list[TuningDrive]:
        """Drives that reach the end, by torque: the acting one is raised until a contact is lost.

        The last trial has the lost contact, or the outcome that the object did not slide.
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
        """The fastest drive that a brake stops at the end of the phase, and this brake.

        The acting torque of a brake is below that of the slowest drive and below the quasistatic
        one at the end. If no such brake keeps all contacts, the end's supporting torque is used.
        """
        count = len(drives)
        chosen = [drives[k] for k in sorted({count - 1, count // 2, count // 4, 0}, reverse=True)]
        first = min(drives[0].raised - 1, self._count_steps(self.acting))
        last = self._count_steps(1 - self.acting)
        # With two freedoms either torque starts a new motion at the end if it is too large.
        for supported in dict.fromkeys([last, 0] if self.is_free else [0, last]):
            if abs(self.scale(0, supported)[1 - self.acting]) > self.limit[1 - self.acting]:
                continue
            for drive in chosen:
                braking = self._lower(drive.trial, first, supported)
                if braking is not None:
                    return drive, braking
        return None

    def _count_steps(self, finger: int) -> int:
        """Number of raises, negative if lowered, from a torque to that of the end."""
        ratio = float(self.last[finger] / self.tau[finger]) if self.tau[finger] else 1.0
        return math.floor(math.log(max(ratio, RATIO**-SETTINGS.raises)) / math.log(RATIO))

    def _lower(self, drive: TuningTrial, first: int, supported: int) -> TuningDrive | None:
        """Brake with the earliest end, by lowering the acting torque; None if none stops there."""
        best: TuningDrive | None = None
        raised, failed = first, 0
        while raised > -SETTINGS.raises and failed < SETTINGS.failures and not self.is_exhausted:
            steps = [*drive.steps, TuningStep(0.0, self.scale(raised, supported))]
            trial = self._time_brake(steps, drive, best and best.trial, SETTINGS.coarse * self.slow)
            if trial is None:
                if best is None and self.trials[-1].outcome is TrialOutcome.LOSES:
                    break
                failed += best is not None
                raised -= SETTINGS.brake_step
                continue
            if best and trial.time > (1 - SETTINGS.min_gain) * best.trial.time:
                break
            best = TuningDrive(raised, trial, supported)
            if trial.rate < self.slow:
                return best
            raised -= 1
        if best is None:
            return None
        last = self._time_brake(list(best.trial.steps), drive, best.trial, self.slow)
        return None if last is None else best._replace(trial=last)

    def _time_brake(
        self, steps: list[TuningStep], drive: TuningTrial, similar: TuningTrial | None, speed: float
    ) -> TuningTrial | None:
        """Trial with the instant of the last step at which the object reaches the end slowly.

        False position on the distance from the end and the overshoot. The search begins near a
        `similar` trial, of a weaker brake or with nearly the same instant.
        """
        low, high = 0.0, drive.time
        error_low, error_high = self.length, self._overshoot(drive, speed)
        instant, side, losses = 0.5 * high, 0, 0
        distance, rate = self.length, drive.rate
        if similar is not None and speed == self.slow:
            high, error_high = similar.steps[-1].time, self._overshoot(similar, speed)
            instant = high * (1 - 1e-4)
        elif similar is not None:
            instant = min(1.02 * similar.steps[-1].time, 0.5 * (similar.steps[-1].time + high))
        for count in range(SETTINGS.max_trials):
            steps = [*steps[:-1], steps[-1]._replace(time=instant)]
            trial = self.run(steps, f"brake at {instant:.5g} s")
            if trial.outcome is TrialOutcome.ARRIVES:
                if trial.rate < speed:
                    return trial
                if instant < SETTINGS.bracket * drive.time:
                    return self._find_graze(steps, drive) if self.is_free else None
                high, error_high, rate = instant, self._overshoot(trial, speed), trial.rate
                error_low /= 2 if side < 0 else 1
                side = -1
            else:
                losses += trial.outcome is TrialOutcome.LOSES
                if losses > SETTINGS.max_losses:
                    return None
                low, distance = instant, trial.short
                # The distance over several phases is unknown.
                error_low = (
                    error_high if distance == math.inf else max(distance, 1e-12 * self.length)
                )
                error_high /= 2 if side > 0 else 1
                side = 1
            jumps = distance > SETTINGS.gap * self.length and rate > SETTINGS.speed * drive.rate
            if jumps and high - low < SETTINGS.bracket * high:
                return None
            fraction = error_low / (error_low + error_high) if count % 4 != 3 else 0.5
            instant = low + (high - low) * min(max(fraction, 0.02), 0.98)
            if high - low < 1e-12 * high:
                return None
        return None

    def _find_graze(self, steps: list[TuningStep], drive: TuningTrial) -> TuningTrial | None:
        """Trial with the instant of the brake at which the object just touches the end.

        Golden-section search from a grid. With two freedoms the object may turn back before the end
        and reach it on another path: its speed has a kink, of value zero, where it just touches.
        """

        def run(instant: float) -> tuple[float, TuningTrial]:
            braked = [*steps[:-1], steps[-1]._replace(time=instant)]
            trial = self.run(braked, f"brake at {instant:.5g} s")
            return trial.rate if trial.outcome is TrialOutcome.ARRIVES else math.inf, trial

        grid = [drive.time * (k + 1) / (SETTINGS.n_grid + 1) for k in range(SETTINGS.n_grid)]
        runs = [run(instant) for instant in grid]
        k = min(range(1, SETTINGS.n_grid - 1), key=lambda k: runs[k][0])
        instant, ends = grid[k], (grid[k - 1], grid[k + 1])
        rate, best = runs[k]
        if rate > min(runs[k - 1][0], runs[k + 1][0]):
            return None
        for count in range(SETTINGS.max_sections):
            if rate < self.slow:
                return best
            if count == SETTINGS.n_grid and rate > 2 * SETTINGS.coarse * self.slow:
                return None
            inner, outer = sorted(ends, key=lambda end: abs(end - instant))
            candidate = instant + (3 - math.sqrt(5)) / 2 * (outer - instant)
            candidate_rate, trial = run(candidate)
            if candidate_rate < rate:
                ends, instant, rate, best = (instant, outer), candidate, candidate_rate, trial
            else:
                ends = inner, candidate
        return None

    def _overshoot(self, trial: TuningTrial, speed: float) -> float:
        """Stopping distance beyond the end, less that from half the allowed speed [m or rad]."""
        slowing = max(trial.slowing, 0.1 * trial.rate / self.time)
        return (trial.rate**2 - (0.5 * speed) ** 2) / (2 * slowing)

    def measure(self, z: Array) -> Array:
        """Distance from the end of the passage, from (n, 5) to (n,) [m or rad]."""
        return self.end.evaluate(z, z)[0]

    def run(self, steps: Sequence[TuningStep], title: str) -> TuningTrial:
        """Simulate torques until the end of the passage, a lost contact, or rest."""
        end = steps[-1].time + SETTINGS.trial_time * self.time
        torque = TorqueProfile.join_rows(make_rows(steps, end))
        simulation = simulate_free(self.problem, torque, start=self.z, halt=self._is_over)
        self.simulations += 1
        self.trials.append(self._judge(tuple(steps), simulation))
        self.options.progress(f"{self.title}: {title}: {self.trials[-1].to_text()}")
        return self.trials[-1]

    def land(self, steps: Sequence[TuningStep], arrival: float, end: float) -> tuple[Array, str]:
        """Simulate torques that hold the object from its arrival [s] to an end [s].

        Returns the last configuration, (5,), and a failure; empty if everything rests and no
        contact of the next phase, or else of the last one, has opened.
        """
        self.simulations += 1
        torque = TorqueProfile.join_rows(make_rows(steps, end))
        simulation = simulate_free(self.problem, torque, start=self.z)
        names, reason = (self.passage.following or self.passage.phases[-1]).formation.names, ""
        pauses = [(name, simulation.list_pauses(name, arrival, end)) for name in names]
        spans = [(stop - start, name) for name, openings in pauses for start, stop in openings]
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
        return gap > (1 + SETTINGS.turn_back) * self.length or (not self.gains_contact and gap <= 0)

    def find_ends(self, events: Sequence[Event]) -> tuple[list[float], Event | None]:
        """End times of the phases that end [s], and the first loss of a contact before them.

        Only ends by gains and releases of contacts are events; ends at a coordinate are not.
        """
        ends: list[float] = []
        for event in events:
            phase, lost = self.passage.phases[len(ends)], event.kind is EventKind.CONTACT_LOST
            if phase.until.contact is not None:
                is_end = event.kind in free.TOUCHES and event.contact == phase.until.contact.name
            else:
                released = free.list_released(self.problem, phase) if phase.until.is_release else ()
                is_end = lost and event.contact in released
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
        if not self.gains_contact and gaps.min() <= 0:
            row, motion = int(np.flatnonzero(gaps <= 0)[0]), simulation.trajectory
            a, b = (float(t) for t in simulation.t[row - 1 : row + 1])
            arrival = find_root(lambda t: float(self.measure(motion.at([t]).z)[0]), a, b)
        starts = [0.0, *ends][: len(phases)]
        start = starts[-1] if len(starts) == len(phases) else math.inf  # of the last phase
        # Time at which the distance from the end begins to grow again.
        nearest = np.minimum.accumulate(np.where(simulation.t >= start, gaps, math.inf))
        receding = simulation.t[gaps - nearest > SETTINGS.turn_back * abs(self.length)]
        turn_time = float(receding.min(initial=math.inf))
        stop = min(arrival, turn_time, float(simulation.t[-1]))
        # Times at which contacts of the phases open, also those that never press.
        losses = [] if lost is None else [(lost.time, lost.contact)]
        for phase, start_of, end_of in zip(phases, starts, [*starts[1:], stop], strict=False):
            opened = free.find_losses(simulation, phase, start_of, end_of, DEPARTURE)
            losses += [(loss.time, loss.contact) for loss in opened]
        losses = [loss for loss in losses if loss[0] < stop]
        time, contact = min(losses, default=(stop, ""))
        k = int(np.searchsorted(simulation.t, time))
        t, c_n, gaps = (part[: k + 1].copy() for part in (simulation.t, simulation.c_n, gaps))
        # The step of the simulation may extend beyond the arrival of a coordinate.
        if t[k] > time:
            sample, t[k] = simulation.trajectory.at([time]), time
            gaps[k], c_n[k] = self.measure(sample.z)[0], sample.c_n[0]
        distance = float(gaps[t >= start].min(initial=math.inf))
        least, weakest, row = self._find_least(simulation.contacts, t, c_n, ends)
        if losses:
            outcome = TrialOutcome.LOSES
        elif least < self.problem.epsilon:
            outcome, contact, time = TrialOutcome.LOSES, weakest, float(t[row])
        elif arrival == stop:
            outcome = TrialOutcome.ARRIVES
        else:
            is_stopped = turn_time == stop or not simulation.z_dot[k].any()
            outcome = TrialOutcome.RESTS if is_stopped else TrialOutcome.LASTS
        z, v, z_ddot = (part[[k]] for part in (simulation.z, simulation.z_dot, simulation.z_ddot))
        if not self.gains_contact and time > 0:
            z, v, z_ddot = simulation.trajectory.at([time])[:3]
        _, (gradient,), (curvature,) = self.end.evaluate(z, v)
        rate, slowing = -float(gradient @ v[0]), float(gradient @ z_ddot[0] + curvature)
        values = contact, rate, slowing, distance, least, weakest, z[0]
        return TuningTrial(steps, outcome, time, *values)

    def _find_least(
        self, contacts: Sequence[str], t: Array, forces: Array, ends: Sequence[float]
    ) -> tuple[float, str, int]:
        """The least normal force over time [N], its contact and its row."""
        phases = self.passage.phases
        owners = np.minimum(np.searchsorted(ends, t, side="left"), len(phases) - 1)
        names = list(dict.fromkeys(name for phase in phases for name in phase.formation.names))
        c_n = np.nan_to_num(forces[:, [contacts.index(name) for name in names]], nan=math.inf)
        for index, phase in enumerate(phases):
            # Contacts that the phase releases at its end do not count.
            released = free.list_released(self.problem, phase) if phase.until.is_release else set()
            others = [name in released or name not in phase.formation.names for name in names]
            c_n[np.ix_(owners == index, others)] = math.inf
        row, column = np.unravel_index(int(c_n.argmin()), c_n.shape)
        return float(c_n[row, column]), names[int(column)], int(row)
