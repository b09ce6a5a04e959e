"""The report of a replay: numbers, text and plain values."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

from ..common.brief import write_brief
from .narrow import Moved
from .trajectory import Trajectory
from .tuning import TuningHelp


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


@dataclass(frozen=True)
class Report:
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

    __repr__ = write_brief

    @property
    def headline(self) -> str:
        """The verdict, in a line."""
        return f"{self.name!r}: {'ok' if self.ok else 'FAILED'}: {self.reason}"

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
    def exit_status(self) -> int:
        """Exit status of the command line: 0 or 1."""
        return 0 if self.ok else 1

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for JSON, with None where there is no number."""
        values = plain(asdict(replace(self, replay=None)))
        del values["replay"]
        verdict = {"ok": self.ok, "exit_status": self.exit_status, "reason": self.reason}
        return {**verdict, **values}

    def to_text(self) -> str:
        """The verdict with its reason, then everything else as aligned tables."""
        from .report_text import write

        return write(self)


def plain(value: Any) -> Any:
    """`value` with None for NaN and infinity and plain containers."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
