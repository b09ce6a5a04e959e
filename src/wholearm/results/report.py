"""What a replay of torques showed, phase by phase, as numbers and as tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ..common.document import Document, Result, Table, fixed
from .narrow import Moved
from .trajectory import Trajectory
from .tuning import TuningHelp

_UNIQUENESS = {
    "number": "phase:d", "uniqueness_margin.value": "uniqueness margin:.4f",
    "uniqueness_margin.contacts": "least of", "uniqueness_margin.time": "at t [s]:.5f",
    "wedged": "wedged [ms]:.1f",
}  # fmt: skip
_CHANGES = {"phase": "phase:d", "what": "mode of", "kind": "", "time": "at t [s]:.5f"}
_REDUCED = {
    "phase": "phase:d", "time": "at t [s]:.5f", "Phi_1": "Phi_1 [kg m^2]:.6g",
    "Phi_2": "Phi_2 [N m s]:.6g", "Phi_3": "Phi_3 [N m]:.6g",
    "theta_1_dot": "theta_1' [rad/s]:.6g", "theta_1_ddot": "theta_1'' [rad/s^2]:.6g",
    "residual": "residual [N m]:.1e",
}  # fmt: skip
_ENDS = {
    "number": "phase:d", "until": "until", "end": "end", "arrival": "arrival [s]:.5f",
    "arrival_rate": "rate [m/s, rad/s]:.1e", "end_speed": "left [m/s]:.1e",
}  # fmt: skip
_IMPACTS = {"impact.impulse": "least impulse [N s]:.4g", "impact.contact": "on"}
_DEVIATIONS = {
    "end_deviation.position": "end dev. [m]:.1e", "end_deviation.angle": "[rad]:.1e",
    "deviation.position": "largest dev. [m]:.1e", "deviation.angle": "[rad]:.1e",
}  # fmt: skip
_ENERGIES = (
    "work of the torques", "change of kinetic energy", "change of potential energy",
    "viscous joint friction", "dry joint friction", "sliding friction", "contacts gained",
    "residual",
)  # fmt: skip
"""Tables of a replay: columns by attributes, and what parts of the energy are called."""


class ContactMargin(NamedTuple):
    """The least normal force of one contact in one phase.

    Attributes
    ----------
    contact : str
    least : float, [N]
        NaN if the contact was never seen moving.
    time : float, [s]
        When.
    margin : float, [N]
        least - epsilon.
    """

    contact: str
    least: float
    time: float
    margin: float


class UniquenessMargin(NamedTuple):
    """Least uniqueness margin of contact forces in one phase (`mechanics.uniqueness`).

    Attributes
    ----------
    value : float
        Principal minor of the contact matrix K over that without friction: 1 without friction,
        and contact forces are the only ones where it is positive.
    contacts : str
        Whose minor it is, with the modes of those that do not slide.
    time : float, [s]
        When.
    """

    value: float
    contacts: str
    time: float


class LeastImpulse(NamedTuple):
    """The contact of the next phase with the least impulse in an impact, and that impulse [N s]."""

    contact: str
    impulse: float


class SlipMargin(NamedTuple):
    """The least margin to slipping of one rolling contact in one phase.

    Attributes
    ----------
    contact : str
    least : float, [N]
        Of mu c_n - |c_t|; NaN if the contact was never seen moving.
    time : float, [s]
        When.
    """

    contact: str
    least: float
    time: float


class FingerGap(NamedTuple):
    """The least gap between the two links.

    Attributes
    ----------
    least : float, [m]
        Negative where they overlap.
    time : float, [s]
        When.
    """

    least: float
    time: float


class Deviation(NamedTuple):
    """Largest difference between planned and simulated state.

    Attributes
    ----------
    position : float, [m]
        Of the coordinates x and y.
    angle : float, [rad]
        Of phi and the joint angles.
    time : float, [s]
        When the larger of the two was, positions counting over the scene's length.
    """

    position: float
    angle: float
    time: float


class PhaseReport(NamedTuple):
    """One phase of the replay.

    Attributes
    ----------
    number : int
        From 1.
    until : str
        What ends the phase.
    end : str
        How it passes into the next one: at rest, smoothly or with an impact.
    start : float, [s]
    contacts : tuple of ContactMargin
    rolling : tuple of SlipMargin
        Of the contacts that roll.
    arrival : float or None, [s]
        When its end was reached, None if it was not.
    arrival_rate : float or None, [m/s or rad/s]
        How fast the distance to the end was closing then; None for a release.
    end_speed : float or None, [m/s]
        The largest speed left at an end at rest, angular ones times the scene's length; None where
        the phase ends otherwise, or was not ended.
    impact : LeastImpulse or None
        None if there was no impact; one that is planned for may have been a stop.
    end_deviation, deviation : Deviation or None
        From the plan, at the end of the phase and at worst; None without a plan.
    uniqueness_margin : UniquenessMargin or None
        None if nothing was seen moving.
    wedged : float or None, [s]
        For how long friction could have held everything at rest; None if it did not begin so.
    """

    number: int
    until: str
    end: str
    start: float
    contacts: tuple[ContactMargin, ...]
    rolling: tuple[SlipMargin, ...]
    arrival: float | None
    arrival_rate: float | None
    end_speed: float | None
    impact: LeastImpulse | None
    end_deviation: Deviation | None
    deviation: Deviation | None
    uniqueness_margin: UniquenessMargin | None = None
    wedged: float | None = None


class ModeChange(NamedTuple):
    """A contact or joint that goes on in another mode while the rest moves.

    Attributes
    ----------
    time : float, [s]
    phase : int
        Number of the phase.
    what : str
        The contact or joint.
    kind : {"sticks", "slips", "reverses"}
    """

    time: float
    phase: int
    what: str
    kind: str


class ReducedState(NamedTuple):
    """Phi_1 theta_1'' + Phi_2 theta_1' + Phi_3 = 0, the paper's Eqs. (10)-(16), at one instant.

    Attributes
    ----------
    time : float, [s]
    phase : int
        Number of the phase.
    Phi_1 : float, [kg m^2]
        Inertia at the first joint; its sign depends on what friction makes of the elimination.
    Phi_2 : float, [N m s]
        Velocity terms over theta_1'.
    Phi_3 : float, [N m]
        Gravity, dry friction and torques.
    theta_1_dot : float, [rad/s]
    theta_1_ddot : float, [rad/s^2]
        As the replay has it.
    """

    time: float
    phase: int
    Phi_1: float
    Phi_2: float
    Phi_3: float
    theta_1_dot: float
    theta_1_ddot: float

    @property
    def residual(self) -> float:
        """What the equation leaves [N m]."""
        return self.Phi_1 * self.theta_1_ddot + self.Phi_2 * self.theta_1_dot + self.Phi_3


class Failure(NamedTuple):
    """Why torques are not good, and in which phase, by its number."""

    phase: int
    text: str


class EnergyBalance(NamedTuple):
    """Energies of the whole replay [J]: work = kinetic + potential + losses + residual.

    Attributes
    ----------
    work : float
        Of the torques.
    kinetic, potential : float
        Changes.
    viscous, dry, contact, impact : float
        Losses: viscous and dry joint friction, sliding, contacts gained at a speed.
    residual : float
        What the equations leave unexplained.
    relative : float
        The residual over the sum of all magnitudes.
    """

    work: float
    kinetic: float
    potential: float
    viscous: float
    dry: float
    contact: float
    impact: float
    residual: float
    relative: float


@dataclass(frozen=True, repr=False)
class Report(Result):
    """What a replay of torques showed.

    Attributes
    ----------
    name : str
        The problem's.
    epsilon : float, [N]
    outcome : str
        How the replay ended, in one sentence.
    reached : bool
        Whether the goal was reached.
    missed_by : float, [m or rad]
        Distance to the end of the last phase entered, NaN if that is a release.
    failures : tuple of str
        Why the torques are not good, the most important first, empty if they are.
    failed_phase : int or None
        Number of the phase that the first of them is about.
    warnings : tuple of str
        What is not asked for but worth knowing.
    phases : tuple of PhaseReport
        Those entered.
    energy : EnergyBalance
    finger_gap : FingerGap or None
        None if the fingers lie in different planes.
    tolerance : float
    steps : int
        Of the simulation.
    changes : tuple of ModeChange
        In the order of time.
    reduced : tuple of ReducedState
        The paper's scalar equation along the replay, if that was asked for.
    help : TuningHelp
        What helps to tune the torques.
    replay : Simulation or None
        What is reported on.
    """

    name: str
    epsilon: float
    outcome: str
    reached: bool
    missed_by: float
    failures: tuple[str, ...]
    failed_phase: int | None
    warnings: tuple[str, ...]
    phases: tuple[PhaseReport, ...]
    energy: EnergyBalance
    finger_gap: FingerGap | None
    tolerance: float
    steps: int
    changes: tuple[ModeChange, ...] = ()
    reduced: tuple[ReducedState, ...] = ()
    help: TuningHelp = field(default_factory=TuningHelp)
    replay: Moved | None = field(default=None, repr=False, compare=False)

    derived = ("ok", "exit_status", "reason")

    @property
    def trajectory(self) -> Trajectory:
        """The replayed motion, to be saved and drawn like a plan."""
        assert self.replay is not None
        return self.replay.trajectory

    @property
    def ok(self) -> bool:
        """Whether every contact held and the goal was reached."""
        return not self.failures

    @property
    def reason(self) -> str:
        """The one sentence behind the verdict: the first failure, or that the goal is reached."""
        return self.failures[0] if self.failures else self.outcome

    @property
    def document(self) -> Document:
        """The verdict with its reason, then everything else as tables."""
        lines = [f"failure: {text}" for text in self.failures[1:]]
        if self.outcome not in (*self.failures, self.reason):
            lines.append(f"end of the replay: {self.outcome}")
        lines += [f"warning: {text}" for text in self.warnings]
        help, gap = self.help, self.finger_gap
        lines += [f"help: {own.to_text()}" for own in (*help.losses, help.approach) if own]
        if gap is not None:
            lines.append(f"least gap of the fingers: {gap.least:.5g} m at t = {gap.time:.5g} s")
        # Epsilon with three digits, or a thousandth of the largest.
        least = [own.least for phase in self.phases for own in phase.contacts]
        largest = max((force for force in least if not math.isnan(force)), default=0.0)
        force = fixed(self.epsilon or 1e-3 * largest)
        forces = [
            (p.number, c.contact, c.least, c.margin, c.time)
            for p in self.phases
            for c in p.contacts
        ]
        slips = [(p.number, *own) for p in self.phases for own in p.rolling]
        impacts = any(p.end == "impact" for p in self.phases)
        planned = any(p.deviation is not None for p in self.phases)
        ends = _ENDS | (_IMPACTS if impacts else {}) | (_DEVIATIONS if planned else {})
        heads = ["phase:d", "contact", f"least c_n [N]:{force}", f"margin [N]:+{force}"]
        slip = f"least mu c_n - |c_t| [N]:+{force}"
        parts: list[str | Table] = [
            *lines,
            self._list_losses(force),
            Table([*heads, "at t [s]:.5f"], forces),
            Table(["phase:d", "rolling", slip, "at t [s]:.5f"], slips),
            Table.of(self.phases, ends),
            Table.of(self.phases, _UNIQUENESS),
            Table.of(self.changes, _CHANGES),
            Table.of(self.reduced, _REDUCED),
            Table(["energy", "[J]: .6e"], list(zip(_ENERGIES, self.energy, strict=False))),
        ]
        return self.judge(self.name, self.reason, parts)

    def _list_losses(self, force: str) -> Table:
        """Forces where contacts are lost or slip, and what torques change of them."""
        rows: list[Sequence[object]] = []
        for loss in self.help.losses:
            if loss.kind == "thin":
                continue
            for own in loss.forces:
                rows.append((loss.time, f"c_n of {own.contact}", own.c_n, own.c_t, *own.per_tau))
            if loss.closing:
                value, *per_tau = loss.closing
                until = self.phases[loss.phase - 1].until
                rows.append((loss.time, f"acceleration to {until}", f"{value:+.3f}", "", *per_tau))
        columns = ["at t [s]:.5f", "where lost", f"c_n [N]:+{force}", f"c_t [N]:+{force}"]
        return Table([*columns, "per N m of tau_1:+.3f", "of tau_2:+.3f"], rows)
