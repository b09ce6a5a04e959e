"""What plans and torques do for one problem: tables and plain values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

from ..common.brief import write_brief
from ..problem.definition import Problem
from ..results.report import Report, plain
from ..results.report_text import align, show
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


class Comparison(NamedTuple):
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

    def __repr__(self) -> str:
        return write_brief(self)

    @property
    def headline(self) -> str:
        """Verdicts, in a line."""
        return "; ".join(f"{own.name}: {own.verdict}" for own in self.contenders)

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 1 if one of them does not hold."""
        return 0 if all(own.ok for own in self.contenders) else 1

    def to_dict(self) -> dict[str, Any]:
        """Everything but motions and replays as plain values for JSON."""
        # What is left out of the text of one is no plain value.
        keys = [own.name for own in fields(Contender) if own.repr]
        rows = [plain({key: getattr(own, key) for key in keys}) for own in self.contenders]
        return {"name": self.name, "epsilon": self.epsilon, "contenders": rows}

    def to_text(self) -> str:
        """A table of all, one of their phases, and the reasons of those that fail."""
        failed = [f"{own.name}: {own.reason}" for own in self.contenders if not own.ok]
        head = f"{self.name}, epsilon = {self.epsilon:g} N"
        parts = [[head, *failed], self._list_all(), self._list_phases()]
        return "\n\n".join("\n".join(lines) for lines in parts if lines)

    def _list_all(self) -> list[str]:
        rows = []
        for own in self.contenders:
            at = f"{own.contact}, phase {own.phase}" if own.contact else "-"
            peaks = " ".join(f"{peak:.4f}" for peak in own.peaks)
            rows.append(
                [
                    own.name,
                    own.verdict,
                    show(own.duration, ".5f"),
                    show(own.effort, ".5f"),
                    show(own.margin, "+z.5f"),
                    at,
                    peaks,
                    show(own.lost, ".5f"),
                    "-" if own.simulations is None else str(own.simulations),
                ]
            )
        header = ["", "verdict", "duration [s]", "effort [(N m)^2 s]", "least margin [N]", "of"]
        header += ["peak torques [N m]", "energy lost [J]", "simulations"]
        return align(header, rows, {0, 1, 5})

    def _list_phases(self) -> list[str]:
        """Durations and least margins, phase by phase."""
        count = max(len(own.lasts) for own in self.contenders)
        rows = []
        for k in range(count):
            row = [str(k + 1)]
            for part, form in (("lasts", ".5f"), ("margins", "+z.4f")):
                for own in self.contenders:
                    values = getattr(own, part)
                    row.append(show(values[k] if k < len(values) else math.nan, form))
            rows.append(row)
        names = [own.name for own in self.contenders]
        header = ["phase", *names, *names]
        title = "phases: durations [s], then least margins [N]"
        return [title, *align(header, rows, set())] if rows else []
