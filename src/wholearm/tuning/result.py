"""What tuning has found: torques, how they came about, and what the free simulation says."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ..common.arrays import Array
from ..common.brief import write_brief
from ..results.report import plain
from ..results.report_text import align, show
from ..results.torque import TorqueProfile
from ..results.torque_table import format_rows, read_rows
from ..verification.free_report import FreeReport
from .passage import name_numbers
from .trial import Step, Trial


@dataclass(frozen=True, eq=False)
class PhaseTuning:
    """One phase, or several that are carried in one motion.

    Attributes
    ----------
    number, last : int
        The first phase's and the last one's.
    until : str
    acting : int
        Number of the finger behind the motion; 0 if the phase was not tuned.
    quasistatic : tuple of float, [N m]
        Torques that balance the slow motion at its start: both torques are these in steps of 10 %.
    raised : int or None
        How many times the acting torque was raised to drive the object; None if that did not help.
    braked : int or None
        Likewise while braking, lowered if negative; None without a brake.
    supported : int
        How many times the supporting torque is raised while braking, lowered if negative.
    steps : tuple of Step
        The torques, since the start of the phase, the last ones holding the object at its end.
    duration : float, [s]
        Until its end is reached.
    rate : float, [m/s or rad/s]
        How fast that closes then.
    least : float, [N]
        The least normal force, of `weakest`.
    weakest : str
    trials : tuple of Trial
    simulations : int
    """

    number: int
    last: int
    until: str
    acting: int = 0
    quasistatic: tuple[float, float] = (math.nan, math.nan)
    raised: int | None = None
    braked: int | None = None
    supported: int = 0
    steps: tuple[Step, ...] = ()
    duration: float = math.nan
    rate: float = math.nan
    least: float = math.nan
    weakest: str = ""
    trials: tuple[Trial, ...] = field(default=(), repr=False)
    simulations: int = 0

    @property
    def title(self) -> str:
        """Its numbers, for people."""
        return name_numbers(self.number, self.last)


@dataclass(frozen=True, eq=False)
class Tuning:
    """Torques tuned by the 10 % rule.

    Attributes
    ----------
    name : str
        The problem's.
    phases : tuple of PhaseTuning
        Up to the first that does not succeed.
    rows : ndarray, shape (n, 3), or None
        The table of t and both torques, a repeated time being a step; None if a phase failed.
    report : FreeReport or None
        Of the whole, simulated without telling which contacts hold.
    reason : str
        The one sentence behind the verdict.
    """

    name: str
    phases: tuple[PhaseTuning, ...]
    rows: Array | None
    report: FreeReport | None
    reason: str

    __repr__ = write_brief

    @property
    def torque(self) -> TorqueProfile | None:
        """The torques, None if there are none."""
        return None if self.rows is None else read_rows(self.rows)

    @property
    def ok(self) -> bool:
        """Whether the torques keep every contact to the end."""
        return self.report is not None and self.report.ok

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 or 1."""
        return 0 if self.ok else 1

    @property
    def simulations(self) -> int:
        """How many simulations it took, the last one of the whole included."""
        return sum(phase.simulations for phase in self.phases) + (self.report is not None)

    def to_csv(self) -> str:
        """The torques as a table, with how many simulations they took and what was done.

        Raises
        ------
        ValueError
            If there are none.
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

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for JSON, with None where there is no number."""
        values: dict[str, Any] = {
            "ok": self.ok,
            "exit_status": self.exit_status,
            "reason": self.reason,
            "name": self.name,
            "simulations": self.simulations,
            "duration": None if self.rows is None else float(self.rows[-1, 0]),
            "phases": [_list_values(phase) for phase in self.phases],
        }
        found: dict[str, Any] = plain(values)
        return found

    def to_text(self) -> str:
        """The verdict with its reason, and a table of the phases."""
        rows = [_make_row(phase) for phase in self.phases if phase.acting]
        header = ["phase", "until", "acts", "from [N m]", "drive", "brake", "support", "lasts [s]"]
        header += ["closing at", "least c_n [N]", "of", "simulations"]
        head = f"{self.name}: {'ok' if self.ok else 'FAILED'}: {self.reason}"
        table = ["", *align(header, rows, {1, 2, 3, 10})] if rows else []
        last = f"{self.simulations} simulations"
        if self.rows is not None:
            last += f", {self.rows[-1, 0]:.5f} s"
        return "\n".join([head, *table, "", last])


def _list_values(phase: PhaseTuning) -> dict[str, Any]:
    keys = [key for key in PhaseTuning.__dataclass_fields__ if key not in ("steps", "trials")]
    steps = [step._asdict() for step in phase.steps]
    trials = [
        trial._asdict()
        | {
            "outcome": trial.outcome.value,
            "steps": [step._asdict() for step in trial.steps],
            "z": trial.z.tolist(),
        }
        for trial in phase.trials
    ]
    return {key: getattr(phase, key) for key in keys} | {"steps": steps, "trials": trials}


def _make_row(phase: PhaseTuning) -> list[str]:
    start = " ".join(f"{tau:.4f}" for tau in phase.quasistatic)
    return [
        phase.title,
        phase.until,
        f"finger {phase.acting}",
        start,
        "-" if phase.raised is None else f"{phase.raised:+d}",
        "-" if phase.braked is None else f"{phase.braked:+d}",
        f"{phase.supported:+d}" if phase.supported else "-",
        show(phase.duration, ".5f"),
        show(phase.rate, ".2g"),
        show(phase.least, ".4f"),
        phase.weakest or "-",
        str(phase.simulations),
    ]
