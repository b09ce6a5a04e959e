"""The report of torques that were simulated without being told which contacts hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..common.brief import write_brief
from ..free_simulation.result import FreeSimulation
from ..results.report import Deviation, plain
from ..results.report_text import align, fixed, show
from ..results.trajectory import Trajectory

MOST = 60
"""Most events that the text lists; `to_dict` has all."""


class Loss(NamedTuple):
    """A contact of a phase that opens, when it stops pressing [s], and by how much it opens [m]."""

    contact: str
    time: float
    gap: float


class FreePhase(NamedTuple):
    """A phase in a free simulation.

    Attributes
    ----------
    number : int
        From 1.
    start, stop : float, [s]
    reached : bool
        Whether its end came.
    losses : tuple of Loss
        Contacts of the phase that opened by more than a bounce, by time.
    deviation : Deviation or None
        From the plan at its end; None without a plan.
    """

    number: int
    start: float
    stop: float
    reached: bool
    losses: tuple[Loss, ...]
    deviation: Deviation | None


@dataclass(frozen=True)
class FreeReport:
    """What a simulation without assumptions showed.

    Attributes
    ----------
    name : str
        The problem's.
    whole : FreeSimulation
        From the exact start to the end of the torques.
    alone : tuple of FreePhase
        Phases of a plan, each from its planned start; empty for torques alone.
    phases : tuple of FreePhase
        Of the whole: by the clock of a plan, or by what happens.
    failures : tuple of str
        Why the torques are not good; of a plan this is about `alone`.
    warnings : tuple of str
        Where the laws of contact allowed several motions, or none with finite forces.
    """

    name: str
    whole: FreeSimulation = field(repr=False)
    alone: tuple[FreePhase, ...]
    phases: tuple[FreePhase, ...]
    failures: tuple[str, ...]
    warnings: tuple[str, ...]

    __repr__ = write_brief

    @property
    def trajectory(self) -> Trajectory:
        """The whole motion, to be saved and drawn like a plan."""
        return self.whole.trajectory

    @property
    def ok(self) -> bool:
        """Whether every contact held, and every phase ended where it should."""
        return not self.failures

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 or 1."""
        return 0 if self.ok else 1

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

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for JSON, with None where there is no number."""
        whole = self.whole
        energies = {name: float(values[-1]) for name, values in whole.energies._asdict().items()}
        events = [{**e._asdict(), "kind": e.kind.value, "phase": e.phase + 1} for e in whole.events]
        values: dict[str, Any] = plain(
            {
                "ok": self.ok,
                "exit_status": self.exit_status,
                "reason": self.reason,
                "name": self.name,
                "failures": self.failures,
                "warnings": self.warnings,
                "phases_alone": self.alone,
                "phases": self.phases,
                "outcome": whole.outcome.text,
                "events": events,
                "contacts": whole.stretches,
                "energy": {**energies, "residual": float(whole.energies.residual[-1])},
                "residual": whole.residual,
                "steps": whole.steps,
            }
        )
        return values

    def to_text(self) -> str:
        """The verdict with its reason, then what happened, as aligned tables."""
        lines = [f"{self.name}: {'ok' if self.ok else 'FAILED'}: {self.reason}"]
        lines += [f"failure: {text}" for text in self.failures[1:]]
        lines += [f"warning: {text}" for text in self.warnings]
        if self.alone:
            lines += ["", "each phase from its planned start", *_list_phases(self.alone)]
            lines += ["", "the whole from the start, by the clock", *_list_phases(self.phases)]
        else:
            lines += ["", *_list_phases(self.phases)]
        lines += ["", *self._list_contacts(), "", *self._list_events()]
        energies = self.whole.energies
        lines += ["", f"residual of the contact problems {self.whole.residual:.1e}, of the energy"]
        lines[-1] += f" {abs(energies.residual).max():.1e} J; {self.whole.outcome.text}"
        return "\n".join(lines)

    def _list_contacts(self) -> list[str]:
        known = [s.least for s in self.whole.stretches if s.least > 0]
        form = fixed(1e-3 * max(known, default=0.0))
        rows = [
            [s.contact, f"{s.start:.6f}", f"{s.stop:.6f}", show(s.least, form), f"{s.time:.6f}"]
            for s in self.whole.stretches[:MOST]
        ]
        header = ["contact", "presses from [s]", "to [s]", "least c_n [N]", "at [s]"]
        return [*align(header, rows, {0}), *_more(len(self.whole.stretches))]

    def _list_events(self) -> list[str]:
        events = self.whole.events
        rows = [
            [f"{e.time:.6f}", str(e.phase + 1), e.text.rpartition(" at t =")[0] or e.text]
            for e in events[:MOST]
        ]
        return [*align(["at t [s]", "phase", "event"], rows, {2}), *_more(len(events))]


def _list_phases(phases: tuple[FreePhase, ...]) -> list[str]:
    rows = []
    for phase in phases:
        lost = ", ".join(f"{loss.contact} at {loss.time:.5f}" for loss in phase.losses)
        end = phase.deviation
        away = ("-", "-") if end is None else (f"{end.position:.1e}", f"{end.angle:.1e}")
        stop = f"{phase.stop:.5f}" if phase.reached else "-"
        rows.append([str(phase.number), f"{phase.start:.5f}", stop, *away, lost or "-"])
    header = ["phase", "from [s]", "to [s]", "end dev. [m]", "[rad]", "contacts lost [s]"]
    return align(header, rows, {5})


def _more(count: int) -> list[str]:
    return [f"... and {count - MOST} more, see --json"] if count > MOST else []
