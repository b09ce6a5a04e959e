"""Result of tuning: torques, their changes and trials by phase, and their free simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..common.arrays import Array
from ..common.document import Document, Result, Table
from ..results.torque import TorqueProfile
from ..results.torque_table import format_rows, read_rows
from ..verification.free_report import FreeReport
from .trial import TuningStep, TuningTrial, name_numbers


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
