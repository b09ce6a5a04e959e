"""Comparison of plans and torques for one problem by their replays: margins, effort, losses."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import zip_longest

from ..common.document import Document, Result, Table
from ..common.errors import InputError, JammingError, SimulationError, name_source
from ..common.fields import Range
from ..common.files import require_ending
from ..problem.definition import Problem
from ..problem.read import require_phases
from ..results.adopt import Torques, adopt_phases, require_made_for, split_torques
from ..results.report import Report
from ..results.torque import read_notes, read_torque_csv
from ..results.trajectory import Trajectory, load_trajectory
from ..verification.verify import verify

SIMULATIONS = "simulations"
"""Key of the number of simulations, in comments of torques and in the `meta` of a trajectory."""
PathOrTorques = str | os.PathLike[str] | Torques  # a file, or an object with torques


@dataclass(frozen=True, eq=False)
class Contender:
    """Replay of one plan or one table of torques, in numbers."""

    name: str  # the file: without its folder if that is unique
    ok: bool  # whether every contact held and the goal was reached
    reason: str  # of the verdict, a sentence
    duration: float  # [s]: until the goal is reached, or of the torques if it is not
    effort: float  # [(N m)^2 s]: integral of tau^T tau
    peaks: tuple[float, float]  # [N m]: largest torque of each joint
    simulations: int | None  # number of simulations that were needed to find it, if stored
    # [N]: least margin of a normal force over epsilon in the replay, of `contact` in `phase`
    margin: float | None = None
    contact: str = ""
    phase: int = 0
    lost: float | None = None  # [J]: energy lost to friction and impacts
    # lasts, margins [s] and [N]: duration and least margin of each phase that was entered; NaN
    # where unknown
    lasts: tuple[float, ...] = ()
    margins: tuple[float, ...] = ()
    report: Report | None = field(default=None, repr=False)  # None if the replay stopped
    # with the phases of the motion
    problem: Problem | None = field(default=None, repr=False)
    # the motion of the file; None for torques alone
    planned: Trajectory | None = field(default=None, repr=False)

    @property
    def replayed(self) -> Trajectory | None:
        """The motion of the replay; None if it loses a contact at once, or stopped."""
        with suppress(SimulationError):
            return None if self.report is None else self.report.trajectory
        return None

    @property
    def verdict(self) -> str:
        """`ok` as a word."""
        return "ok" if self.ok else "FAILED"

    @property
    def place(self) -> str:
        """The contact with the least margin, and its phase."""
        return f"{self.contact}, phase {self.phase}" if self.contact else "-"


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Result):
    """Plans and torques for one problem."""

    name: str  # the problem's
    epsilon: float  # [N]
    contenders: tuple[Contender, ...]

    @property
    def headline(self) -> str:
        """Verdicts, in a line."""
        return "; ".join(f"{contender.name}: {contender.verdict}" for contender in self.contenders)

    @property
    def ok(self) -> bool:
        """Whether all plans and torques are ok."""
        return all(contender.ok for contender in self.contenders)

    @property
    def summary(self) -> Table:
        """Table of all plans and torques."""
        columns = {
            "name": "", "verdict": "verdict", "duration": "until the goal [s]:.5f",
            "effort": "effort [(N m)^2 s]:.5f", "margin": "least margin [N]:+z.5f", "place": "of",
            "peaks": "peak torques [N m]:.4f", "lost": "energy lost [J]:.5f",
            "simulations": "simulations:d",
        }  # fmt: skip
        return Table.of(self.contenders, columns)

    @property
    def document(self) -> Document:
        """A table of all, one of their phases, and reasons of failures."""
        failed = [f"{each.name}: {each.reason}" for each in self.contenders if not each.ok]
        names = [contender.name for contender in self.contenders]
        heads = [f"{name}:{form}" for form in (".5f", "+z.4f") for name in names]
        lasts = zip_longest(*(contender.lasts for contender in self.contenders))
        margins = zip_longest(*(contender.margins for contender in self.contenders))
        pairs = zip(lasts, margins, strict=True)
        rows = [(number, *times, *least) for number, (times, least) in enumerate(pairs, start=1)]
        title = "phases: times until their ends [s], then least margins [N]"
        phases = Table(["phase:d", *heads], rows, title)
        head = f"{self.name}, epsilon = {self.epsilon:g} N"
        return Document(head, parts=[*failed, self.summary, phases])


def compare(
    problem: Problem, paths: Sequence[PathOrTorques], progress: Callable[[str], None] | None = None
) -> Comparison:
    """Replay trajectory files (.npz), torques (.csv), plans and trajectories, and compare them.

    `progress` is called with the name of each file before its replay.

    InputError if a file cannot be read, or a trajectory is one of another problem; names the file.
    """
    Range(1, 10**5).read(len(paths), "paths: COUNT")
    sources = [
        os.fspath(each) if isinstance(each, str | os.PathLike) else f"{type(each).__name__} {k}"
        for k, each in enumerate(paths, start=1)
    ]
    short = [os.path.basename(source) for source in sources]
    names = short if len({*short}) == len(short) else sources
    contenders = []
    for name, source, each in zip(names, sources, paths, strict=True):
        if progress is not None:
            progress(f"replaying {name}")
        contenders.append(_judge(name, problem, source, each))
    return Comparison(problem.name, problem.epsilon, tuple(contenders))


def _judge(name: str, problem: Problem, source: str, what: PathOrTorques) -> Contender:
    """The replay of a trajectory or of torques, in numbers.

    The phases of a trajectory with forces replace a goal of the problem.
    """
    simulations = None
    if isinstance(what, str | os.PathLike):
        if require_ending(what, ".npz", ".csv") == ".csv":
            note = read_notes(source).get(SIMULATIONS)
            if note is not None and not note.isdecimal():
                raise InputError(source, SIMULATIONS, f"{note!r} given; a whole number is needed")
            what, simulations = read_torque_csv(source), None if note is None else int(note)
        else:
            what = load_trajectory(what)
    torque, planned = split_torques(what)
    if planned is None:
        require_phases(problem)
    else:
        meta = planned.meta
        problem = adopt_phases(problem, meta, planned.q[-1], source)
        with name_source(source):
            require_made_for(problem, meta)
        simulations = (meta.get("replay") or {}).get(SIMULATIONS, meta.get(SIMULATIONS))
        simulations = simulations if isinstance(simulations, int) else None
    peak1, peak2 = torque.peaks.max(axis=0).tolist()
    numbers = torque.duration, torque.integrate_squares(), (peak1, peak2), simulations
    contender = Contender(name, False, "", *numbers, problem=problem, planned=planned)
    try:
        report = verify(problem, planned or torque)
    except (JammingError, SimulationError) as error:
        return replace(contender, reason=str(error))
    least, energy, end = report.least_force, report.energy, report.phases[-1].arrival
    spans = [(phase.start, phase.arrival) for phase in report.phases]
    forces = [phase.least_force for phase in report.phases]
    return replace(
        contender,
        ok=report.ok,
        reason=report.reason,
        duration=end if report.reached and end is not None else torque.duration,
        margin=None if least is None else least.value - report.epsilon,
        contact="" if least is None else least.contact,
        phase=0 if least is None else least.phase,
        lost=energy.viscous + energy.dry + energy.contact + energy.impact,
        lasts=tuple(math.nan if t is None else t - start for start, t in spans),
        margins=tuple(math.nan if f is None else f.value - report.epsilon for f in forces),
        report=report,
    )
