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
    """What one plan or one table of torques does.

    Attributes
    ----------
    name : str
        The file: without its folder where that is enough.
    ok : bool
        Whether every contact held and the goal was reached.
    reason : str
        The sentence behind that.
    duration : float, [s]
        Until the goal is reached, or of the torques where it is not.
    effort : float, [(N m)^2 s]
        Integral of tau^T tau.
    peaks : tuple of float, [N m]
        Largest torque of each joint.
    simulations : int or None
        How many it took to find it, if that is known.
    margin : float or None, [N]
        Least margin of a normal force over epsilon in the replay, of `contact` in `phase`.
    lost : float or None, [J]
        Energy lost to friction and impacts.
    lasts, margins : tuple of float, [s] and [N]
        Durations of the phases that were entered, and the least margin of each; NaN where unknown.
    report : Report or None
        None where the replay could not go on.
    problem : Problem or None
        With the phases that it goes through.
    planned : Trajectory or None
        The motion that was given; None for torques alone.
    """

    name: str
    ok: bool
    reason: str
    duration: float
    effort: float
    peaks: tuple[float, float]
    simulations: int | None
    margin: float | None = None
    contact: str = ""
    phase: int = 0
    lost: float | None = None
    lasts: tuple[float, ...] = ()
    margins: tuple[float, ...] = ()
    report: Report | None = field(default=None, repr=False)
    problem: Problem | None = field(default=None, repr=False)
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
    """Plans and torques for one problem.

    Attributes
    ----------
    name : str
        The problem's.
    epsilon : float, [N]
    contenders : tuple of Contender
    """

    name: str
    epsilon: float
    contenders: tuple[Contender, ...]

    @property
    def headline(self) -> str:
        """Verdicts, in a line."""
        return "; ".join(f"{own.name}: {own.verdict}" for own in self.contenders)

    @property
    def ok(self) -> bool:
        """Whether all of them hold."""
        return all(own.ok for own in self.contenders)

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
        failed = [f"{own.name}: {own.reason}" for own in self.contenders if not own.ok]
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
