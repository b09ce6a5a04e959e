"""What plans and torques do for one problem: tables and plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import zip_longest

from ..common.document import Document, Result, Table
from ..problem.definition import Problem
from ..results.report import Report
from ..results.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Contender:
    """What one plan or one table of torques does."""

    name: str  # the file: without its folder where that is enough
    ok: bool  # whether every contact held and the goal was reached
    reason: str  # the sentence behind that
    duration: float  # [s]: until the goal is reached, or of the torques where it is not
    effort: float  # [(N m)^2 s]: integral of tau^T tau
    peaks: tuple[float, float]  # [N m]: largest torque of each joint
    simulations: int | None  # how many it took to find it, if that is known
    # [N]: least margin of a normal force over epsilon in the replay, of `contact` in `phase`
    margin: float | None = None
    contact: str = ""
    phase: int = 0
    lost: float | None = None  # [J]: energy lost to friction and impacts
    # lasts, margins [s] and [N]: durations of the phases that were entered, and the least margin of
    # each; NaN where unknown
    lasts: tuple[float, ...] = ()
    margins: tuple[float, ...] = ()
    report: Report | None = field(default=None, repr=False)  # none where the replay could not go on
    # with the phases that it goes through
    problem: Problem | None = field(default=None, repr=False)
    # the motion that was given; None for torques alone
    planned: Trajectory | None = field(default=None, repr=False)

    @property
    def verdict(self) -> str:
        """Whether it holds, in a word."""
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
        """Whether all of them hold."""
        return all(contender.ok for contender in self.contenders)

    @property
    def summary(self) -> Table:
        """What each comes to."""
        columns = {
            "name": "", "verdict": "verdict", "duration": "duration [s]:.5f",
            "effort": "effort [(N m)^2 s]:.5f", "margin": "least margin [N]:+z.5f", "place": "of",
            "peaks": "peak torques [N m]:.4f", "lost": "energy lost [J]:.5f",
            "simulations": "simulations:d",
        }  # fmt: skip
        return Table.of(self.contenders, columns)

    @property
    def document(self) -> Document:
        """A table of all, one of their phases, and the reasons of those that fail."""
        failed = [
            f"{contender.name}: {contender.reason}"
            for contender in self.contenders
            if not contender.ok
        ]
        names = [own.name for own in self.contenders]
        heads = [f"{name}:{form}" for form in (".5f", "+z.4f") for name in names]
        lasts = zip_longest(*(own.lasts for own in self.contenders))
        margins = zip_longest(*(own.margins for own in self.contenders))
        pairs = zip(lasts, margins, strict=True)
        rows = [(number, *one, *two) for number, (one, two) in enumerate(pairs, start=1)]
        title = "phases: durations [s], then least margins [N]"
        phases = Table(["phase:d", *heads], rows, title)
        head = f"{self.name}, epsilon = {self.epsilon:g} N"
        return Document(head, parts=[*failed, self.summary, phases])
