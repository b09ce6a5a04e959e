"""What tuning has come to: torques, figures, text and plain values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..results.report import Report, plain
from ..results.report_text import align, show
from ..results.torque import TorqueProfile
from ..results.torque_table import format_rows, place_rows
from ..verification.verdict import DEPARTURE
from .phase import PhaseTuning


@dataclass(frozen=True, eq=False)
class Tuned:
    """Torques found by steps of 10 %.

    Attributes
    ----------
    name : str
        The problem's.
    epsilon : float, [N]
    phases : tuple of PhaseTuning
        Up to the first that has no torques.
    torque : TorqueProfile or None
        Of the phases that have some.
    report : Report or None
        Of the replay of all phases, where all have some.
    """

    name: str
    epsilon: float
    phases: tuple[PhaseTuning, ...]
    torque: TorqueProfile | None
    report: Report | None

    @property
    def simulations(self) -> int:
        """How many simulations it took, the replay of all phases included."""
        return sum(own.simulations for own in self.phases) + (self.report is not None)

    @property
    def ok(self) -> bool:
        """Whether all phases have torques, whose replay holds, free ones of each phase as well."""
        free = all(own.free < DEPARTURE for own in self.phases)
        return self.report is not None and self.report.ok and free

    @property
    def reason(self) -> str:
        """Why not, or how the replay ends."""
        if self.report is not None:
            gone = [own.number for own in self.phases if not own.free < DEPARTURE]
            text = f"phase {gone[0]} departs where contacts are not told" if gone else ""
            return text if gone and self.report.ok else self.report.reason
        return f"phase {self.phases[-1].number} {self.phases[-1].reason}"

    def to_csv(self) -> str:
        """The torques as CSV, with comments that `compare` reads."""
        assert self.torque is not None
        notes = (
            f"# from quasistatic torques, by steps of 10 %\n# simulations = {self.simulations}\n"
        )
        return notes + format_rows(place_rows(self.torque))

    def to_dict(self) -> dict[str, Any]:
        """Everything but the replay as plain values for JSON."""
        phases = [
            {
                "number": own.number,
                "finger": own.finger,
                "quasistatic": own.quasistatic.tolist(),
                "raises": own.raises,
                "brake": own.brake,
                "steps": [[start, *tau.tolist()] for start, tau in own.steps],
                "duration": own.outcome.time if own.steps else None,
                "speed": own.outcome.speed,
                "least_c_n": own.outcome.least,
                "free": own.free,
                "simulations": own.simulations,
                "reason": own.reason,
            }
            for own in self.phases
        ]
        values = {"ok": self.ok, "reason": self.reason, "simulations": self.simulations}
        found: dict[str, Any] = plain({"name": self.name, **values, "phases": phases})
        return found

    def to_text(self) -> str:
        """The verdict with its reason, and what became of each phase."""
        rows = []
        for own in self.phases:
            row = [str(own.number), str(own.finger or "-")]
            row += [show(value, ".4f") for value in own.quasistatic.tolist()]
            if own.steps:
                tau = own.steps[0][1][own.finger - 1]
                braked = own.steps[-1][0] if len(own.steps) > 1 else None
                below = str(own.brake) if len(own.steps) > 1 else "-"
                row += [str(own.raises), f"{tau:.4f}", show(braked, ".4f"), below]
                row += [show(own.outcome.time, ".4f"), show(own.outcome.least, ".4f")]
            else:
                row += ["-"] * 6
            rows.append([*row, show(own.free, ".1e"), str(own.simulations)])
        header = ["phase", "finger", "tau_1 [N m]", "tau_2 [N m]", "raises", "to [N m]"]
        header += [
            "brake at [s]",
            "lowered by",
            "lasting [s]",
            "least c_n [N]",
            "free",
            "simulations",
        ]
        verdict = "ok" if self.ok else "FAILED"
        head = f"{self.name}: {verdict}: {self.reason}; {self.simulations} simulations"
        return "\n".join([head, "", *align(header, rows, set())])
