"""The report of torques that were simulated without being told which contacts hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..common.document import Document, Result, Table, fixed
from ..free_simulation.result import FreeSimulation
from ..results.report import Deviation
from ..results.trajectory import Trajectory

MOST = 60  # most events that the text lists; `to_dict` has all


class LostContact(NamedTuple):
    """A contact of a phase that opens, when it stops pressing [s], and by how much it opens [m]."""

    contact: str
    time: float
    gap: float


class FreePhase(NamedTuple):
    """A phase in a free simulation."""

    number: int  # from 1
    start: float  # start, stop [s]:
    stop: float
    reached: bool  # whether its end came
    losses: tuple[
        LostContact, ...
    ]  # contacts of the phase that opened by more than a bounce, by time
    deviation: Deviation | None  # from the plan at its end; None without a plan


@dataclass(frozen=True, repr=False)
class FreeReport(Result):
    """What a simulation without assumptions showed."""

    name: str  # the problem's
    whole: FreeSimulation = field(repr=False)  # from the exact start to the end of the torques
    # phases of a plan, each from its planned start; empty for torques alone
    alone: tuple[FreePhase, ...]
    phases: tuple[FreePhase, ...]  # of the whole: by the clock of a plan, or by what happens
    failures: tuple[str, ...]  # why the torques are not good; of a plan this is about `alone`
    # where the laws of contact allowed several motions, or none with finite forces
    warnings: tuple[str, ...]

    @property
    def trajectory(self) -> Trajectory:
        """The whole motion, to be saved and drawn like a plan."""
        return self.whole.trajectory

    @property
    def ok(self) -> bool:
        """Whether every contact held, and every phase ended where it should."""
        return not self.failures

    @property
    def reason(self) -> str:
        """The one sentence behind the verdict."""
        if self.failures:
            return self.failures[0]
        if not self.alone:
            count = len(self.phases)
            return f"every contact holds, and {count} phase{'s end' if count > 1 else ' ends'}"
        ends = [phase.deviation for phase in self.alone if phase.deviation is not None]
        position, angle = max(end.position for end in ends), max(end.angle for end in ends)
        return (
            "from its planned start each phase keeps its contacts and ends within "
            f"{position:.1e} m and {angle:.1e} rad of the plan"
        )

    @property
    def values(self) -> dict[str, Any]:
        """Everything that JSON has."""
        whole = self.whole
        energies = {name: values[-1] for name, values in whole.energies._asdict().items()}
        return {
            **{key: getattr(self, key) for key in ("ok", "exit_status", "reason", "name")},
            "failures": self.failures,
            "warnings": self.warnings,
            "phases_alone": self.alone,
            "phases": self.phases,
            "outcome": whole.outcome.text,
            "events": [{**e._asdict(), "phase": e.phase + 1} for e in whole.events],
            "contacts": whole.stretches,
            "energy": {**energies, "residual": whole.energies.residual[-1]},
            "residual": whole.residual,
            "steps": whole.steps,
        }

    @property
    def document(self) -> Document:
        """The verdict with its reason, then what happened."""
        whole, lines = self.whole, [f"failure: {text}" for text in self.failures[1:]]
        form = fixed(1e-3 * max((s.least for s in whole.stretches if s.least > 0), default=0.0))
        events = [
            (e.time, e.phase + 1, e.text.rpartition(" at t =")[0] or e.text) for e in whole.events
        ]
        columns = {"contact": "contact", "start": "presses from [s]:.6f", "stop": "to [s]:.6f"}
        columns |= {"least": f"least c_n [N]:{form}", "time": "at [s]:.6f"}
        told = "the whole from the start, by the clock" if self.alone else ""
        return self.judge(
            self.name,
            self.reason,
            [
                *lines,
                *(f"warning: {text}" for text in self.warnings),
                _list_phases(self.alone, "each phase from its planned start"),
                _list_phases(self.phases, told),
                Table.of(whole.stretches, columns)._replace(most=MOST),
                Table(["at t [s]:.6f", "phase:d", "event"], events, most=MOST),
                f"residual of the contact problems {whole.residual:.1e}, of the energy "
                f"{abs(whole.energies.residual).max():.1e} J; {whole.outcome.text}",
            ],
        )


def _list_phases(phases: tuple[FreePhase, ...], title: str) -> Table:
    rows = []
    for phase in phases:
        lost = ", ".join(f"{loss.contact} at {loss.time:.5f}" for loss in phase.losses)
        end, stop = phase.deviation or (None, None), phase.stop if phase.reached else None
        rows.append((phase.number, phase.start, stop, *end[:2], lost or "-"))
    heads = ["phase:d", "from [s]:.5f", "to [s]:.5f", "end dev. [m]:.1e", "[rad]:.1e"]
    return Table([*heads, "contacts lost [s]"], rows, title)
