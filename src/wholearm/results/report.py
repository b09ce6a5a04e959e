"""Report of a replay: margins, ends, deviations and energies by phase, as tables.

Also records of replays, lower bounds, impacts and ranges in plans.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ..common.document import Document, Result, Table, fixed
from .adopt import MotionLike
from .trajectory import Trajectory

DEPARTURE = 1e-3  # largest `Deviation` from a plan, over the scene's length, and in rad


class Deviation(NamedTuple):
    """Largest difference between planned and simulated state."""

    position: float  # [m]: of the coordinates x and y
    angle: float  # [rad]: of phi and the joint angles
    time: float  # [s]: of the larger of the two, positions relative to the scene's length

    def measure(self, length: float) -> float:
        """The larger of both, over the scene's `length` [m] and in rad; zero if not known."""
        sizes = self.position / length, self.angle
        return max((size for size in sizes if not math.isnan(size)), default=0.0)


class ForceAt(NamedTuple):
    """A contact's forces at an instant, and their derivatives by torques."""

    contact: str
    c_n: float  # c_n, c_t [N]: NaN at rest, where they are indeterminate
    c_t: float
    per_tau: tuple[float, float]  # [N/(N m)]: d c_n / d tau_1 and d c_n / d tau_2, at that state


class TorqueAdvice(NamedTuple):
    """A change of the torques that avoids a loss."""

    change: tuple[float, float]  # of both torques [N m]
    to: tuple[float, float]  # new torques [N m]
    but: str = ""  # another limit that it violates, by name; empty if every limit is kept
    holds: bool = False  # whether the object then stays at rest

    def to_text(self) -> str:
        """The change in words."""
        pairs = enumerate(zip(self.change, self.to, strict=True), start=1)
        parts = (f"tau_{k} {by:+.3g} N m (to {to:.4g})" for k, (by, to) in pairs if by)
        text = " with ".join(parts)
        if self.but:
            return f"{text} would, but {self.but}"
        return f"{text} mends it" + ", but holds the object at rest" * self.holds


class Loss(NamedTuple):
    """A contact that is lost, slips or presses too little, and torques that avoid it."""

    phase: int  # number of the phase
    contact: str
    kind: str  # {"lost", "slips", "thin"}
    time: float  # [s]
    at_rest: bool  # if it is, forces are those at the start of a motion
    forces: tuple[ForceAt, ...]  # of every contact of the formation
    # [m/s^2 or rad/s^2]: acceleration towards the end of the phase, and its derivatives by tau_1
    # and tau_2 per N m; empty for a release, and if forces are indeterminate
    closing: tuple[float, ...]
    changes: tuple[TorqueAdvice, ...]  # of one torque, or of both if that violates other limits

    def to_text(self) -> str:
        """The loss and the changes that avoid it, in a sentence."""
        verb = {"lost": "is lost", "slips": "slips", "thin": "falls below epsilon"}[self.kind]
        text = f"{self.contact} {verb} at t = {self.time:.5g} s, phase {self.phase}"
        texts = [change.to_text() for change in self.changes]
        if all(change.but for change in self.changes):
            state = "at this place" if self.at_rest else "in this state, so change them earlier"
            texts.append(f"no torques keep every limit {state}")
        return f"{text}: {'; '.join(texts)}"


class Approach(NamedTuple):
    """Least distance of a motion from the end of a phase that it does not reach."""

    phase: int  # number of the phase
    until: str  # its end
    distance: float  # the least, [m] or [rad]
    unit: str  # {"m", "rad"}
    time: float  # [s]: of the least distance
    rate: float  # [m/s or rad/s]: closing speed at that time
    turns: tuple[float, ...]  # [s]: reversals of the motion in this phase

    def to_text(self) -> str:
        """The distance and the reversals, in a sentence."""
        text = (
            f"{self.until} was nearest at t = {self.time:.5g} s, {self.distance:.4g} {self.unit} "
            f"away, then closing at {self.rate:.2g} {self.unit}/s, phase {self.phase}"
        )
        turns = ", ".join(f"{time:.5g}" for time in self.turns)
        return f"{text}; the motion turns back at t = {turns} s" if turns else text


class TuningHelp(NamedTuple):
    """Advice on tuning of torques."""

    losses: tuple[Loss, ...] = ()  # losses that end the replay first
    approach: Approach | None = None  # None if the goal is reached, or the last end is a release


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
"""Tables of a replay: columns by attributes, and names of the parts of the energy."""


class ContactMargin(NamedTuple):
    """The least normal force of one contact in one phase."""

    contact: str
    least: float  # [N]: NaN without samples in motion
    time: float  # [s]: of the least force
    margin: float  # [N]: least - epsilon


class UniquenessMargin(NamedTuple):
    """Least uniqueness margin of contact forces in one phase (`mechanics.uniqueness`).

    A principal minor of the contact matrix K over that without friction: forces are unique if all
    are positive.
    """

    value: float
    contacts: str  # contacts of the minor, with the modes of those that do not slide
    time: float  # [s]: of the least margin


class LeastImpulse(NamedTuple):
    """The contact of the next phase with the least impulse in an impact, and that impulse [N s]."""

    contact: str
    impulse: float


class SlipMargin(NamedTuple):
    """The least margin to slipping of one rolling contact in one phase."""

    contact: str
    least: float  # [N]: of mu c_n - |c_t|; NaN without samples in motion
    time: float  # [s]: of the least margin


class FingerGap(NamedTuple):
    """The least gap between the two links."""

    least: float  # [m]: negative if they overlap
    time: float  # [s]: of the least gap


class PhaseReport(NamedTuple):
    """One phase of the replay."""

    number: int  # from 1
    until: str  # condition of its end
    end: str  # kind of its end: at rest, smooth or an impact
    start: float  # [s]
    contacts: tuple[ContactMargin, ...]
    rolling: tuple[SlipMargin, ...]  # of the contacts that roll
    arrival: float | None  # [s]: time of its end, None if it was not reached
    arrival_rate: float | None  # [m/s or rad/s]: closing speed at that time; None for a release
    # [m/s]: largest remaining speed at an end at rest, angular ones times the scene's length; None
    # for other ends, or if the end was not reached
    end_speed: float | None
    impact: LeastImpulse | None  # None without one, or if a stop was planned
    end_deviation: Deviation | None  # from the plan at the end of the phase; None without a plan
    deviation: Deviation | None  # largest one from the plan in the phase
    uniqueness_margin: UniquenessMargin | None = None  # None without samples in motion
    wedged: float | None = None  # [s]: time of possible sticking; None if not at rest

    @property
    def least_force(self) -> LeastForce | None:
        """The least normal force of all contacts; None if nothing moved."""
        known = [each for each in self.contacts if not math.isnan(each.least)]
        forces = (LeastForce(each.least, each.contact, self.number, each.time) for each in known)
        return min(forces, key=lambda force: force.value, default=None)


class ModeChange(NamedTuple):
    """A change of mode of a contact or joint in motion."""

    time: float  # [s]
    phase: int  # number of the phase
    what: str  # the contact or joint
    kind: str  # {"sticks", "slips", "reverses"}


class ReducedState(NamedTuple):
    """Phi_1 theta_1'' + Phi_2 theta_1' + Phi_3 = 0, the paper's Eqs. (10)-(16), at one instant."""

    time: float  # [s]
    phase: int  # number of the phase
    Phi_1: float  # [kg m^2]: inertia at the first joint, of either sign with friction
    Phi_2: float  # [N m s]: velocity terms over theta_1'
    Phi_3: float  # [N m]: gravity, dry friction and torques
    theta_1_dot: float  # [rad/s]
    theta_1_ddot: float  # [rad/s^2]: of the replay

    @property
    def residual(self) -> float:
        """Residual of the equation [N m]."""
        return self.Phi_1 * self.theta_1_ddot + self.Phi_2 * self.theta_1_dot + self.Phi_3


class Failure(NamedTuple):
    """A reason of failure, with the number of its phase."""

    phase: int
    text: str


class EnergyBalance(NamedTuple):
    """Energies of the whole replay [J]: work = kinetic + potential + losses + residual."""

    work: float  # of the torques
    kinetic: float  # kinetic, potential: changes
    potential: float
    viscous: float  # viscous, dry, contact, impact: losses
    dry: float
    contact: float  # by sliding
    impact: float  # by contacts gained at a speed
    residual: float  # of the balance
    relative: float  # the residual over the sum of all magnitudes


@dataclass(frozen=True, repr=False)
class Report(Result):
    """Results of a replay of torques."""

    name: str  # the problem's
    epsilon: float  # [N]
    outcome: str  # end of the replay, in one sentence
    reached: bool  # whether the goal was reached
    missed_by: float  # [m or rad]: distance to the end of the last phase, NaN if it is a release
    failures: tuple[str, ...]  # reasons of failure, the most important first
    failed_phase: int | None  # number of the phase of the first failure
    warnings: tuple[str, ...]  # violations that are no failure
    phases: tuple[PhaseReport, ...]  # phases that the replay has entered
    energy: EnergyBalance
    finger_gap: FingerGap | None  # None if the fingers lie in different planes
    tolerance: float
    steps: int  # of the simulation
    changes: tuple[ModeChange, ...] = ()  # in the order of time
    reduced: tuple[ReducedState, ...] = ()  # along the replay, if requested
    help: TuningHelp = field(default_factory=TuningHelp)  # advice on tuning of the torques
    replay: MotionLike | None = field(default=None, repr=False, compare=False)  # the simulation

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
        """Reason of the verdict: the first failure, or that the goal is reached."""
        return self.failures[0] if self.failures else self.outcome

    @property
    def least_force(self) -> LeastForce | None:
        """The least normal force of all phases; None if nothing moved."""
        forces = filter(None, (phase.least_force for phase in self.phases))
        return min(forces, key=lambda force: force.value, default=None)

    @property
    def document(self) -> Document:
        """The verdict with its reason, and tables of all results."""
        lines = [f"failure: {text}" for text in self.failures[1:]]
        if self.outcome not in (*self.failures, self.reason):
            lines.append(f"end of the replay: {self.outcome}")
        lines += [f"warning: {text}" for text in self.warnings]
        help, gap = self.help, self.finger_gap
        lines += [f"help: {advice.to_text()}" for advice in (*help.losses, help.approach) if advice]
        if gap is not None:
            lines.append(f"least gap of the fingers: {gap.least:.5g} m at t = {gap.time:.5g} s")
        # Epsilon with three digits, or a thousandth of the largest.
        least = [contact.least for phase in self.phases for contact in phase.contacts]
        largest = max((force for force in least if not math.isnan(force)), default=0.0)
        force = fixed(self.epsilon or 1e-3 * largest)
        forces = [
            (p.number, c.contact, c.least, c.margin, c.time)
            for p in self.phases
            for c in p.contacts
        ]
        slips = [(p.number, *slip_margin) for p in self.phases for slip_margin in p.rolling]
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
        """Forces where contacts are lost or slip, and their derivatives by torques."""
        rows: list[Sequence[object]] = []
        for loss in (loss for loss in self.help.losses if loss.kind != "thin"):
            for f in loss.forces:
                rows.append((loss.time, f"c_n of {f.contact}", f.c_n, f.c_t, *f.per_tau))
            if loss.closing:
                value, *per_tau = loss.closing
                until = self.phases[loss.phase - 1].until
                rows.append((loss.time, f"acceleration to {until}", f"{value:+.3f}", "", *per_tau))
        columns = ["at t [s]:.5f", "where lost", f"c_n [N]:+{force}", f"c_t [N]:+{force}"]
        return Table([*columns, "per N m of tau_1:+.3f", "of tau_2:+.3f"], rows)


@dataclass(frozen=True)
class TimeBound:
    """A lower bound of the time of phases that are planned together."""

    phases: tuple[int, ...]  # their numbers
    duration: float  # [s]: of the plan
    bound: float | None  # [s]: for all motions along their curves; None if not known
    error: float | None  # [s]: estimated error of the bound, already subtracted from it
    reason: str = ""  # of a missing bound, or empty

    derived = ("gap",)

    @property
    def gap(self) -> float | None:
        """Relative gap: duration of the plan over the bound, less 1."""
        return None if self.bound is None else self.duration / self.bound - 1


@dataclass(frozen=True)
class Certificate:
    """Lower bounds of the durations of all phases of a plan."""

    parts: tuple[TimeBound, ...]

    derived = ("total",)

    @property
    def gaps(self) -> dict[int, float]:
        """The gap of each phase that has a bound, by its number; zero where the plan is below."""
        return {
            phase: max(part.gap, 0.0)
            for part in self.parts
            if part.gap is not None
            for phase in part.phases
        }

    @property
    def total(self) -> TimeBound | None:
        """The bound of all phases that have one, together; None without any."""
        bounded_parts = [part for part in self.parts if part.bound is not None]
        if not bounded_parts:
            return None
        return TimeBound(
            tuple(phase for part in bounded_parts for phase in part.phases),
            sum(part.duration for part in bounded_parts),
            sum(part.bound or 0.0 for part in bounded_parts),
            sum(part.error or 0.0 for part in bounded_parts),
        )


class Transition(NamedTuple):
    """An impact of a problem, and its result."""

    phase: int  # number of the phase that ends
    gained: str  # its `until`
    possible: bool  # whether the motion passes it at speed
    reason: str  # of a stop, or empty
    velocity_ratio: float  # speed after over speed before; NaN if not known
    least_impulse: float  # [N s per m/s]: for unit speed before
    least_impulse_contact: str
    speed: float  # [m/s]: before; zero if the motion stops there
    # [s], [(N m)^2 s] or [N]: improvement of the objective over a plan with a stop, of phases
    # planned together; NaN if the impact is not possible, or there is no plan with a stop
    saves: float

    @property
    def stop(self) -> str:
        """Reason of a stop, as text; empty without a stop."""
        return "" if self.possible else f"stops: {self.reason}"


class RangeFigures(NamedTuple):
    """Figures of a plan that keeps its limits for all numbers within their ranges."""

    radii: Mapping[str, float]  # half widths of the ranges by name
    nominal: float  # the objective without ranges
    largest: float | None = None  # largest factor on the ranges with a plan, if requested
    # the same for each phase, planned with those that impacts join it to; None in the time domain
    phases: tuple[float | None, ...] = ()
    capped: bool = False  # whether the factor is at the largest sensible ranges
    held: tuple[int, ...] = ()  # numbers of phases that friction may hold at their start


class LeastForce(NamedTuple):
    """A least normal force [N], its contact, phase and time [s]."""

    value: float
    contact: str
    phase: int
    time: float


class RecordedDeviation(NamedTuple):
    """A `Deviation`, whose position, angle and time have the names of their units in files."""

    m: float
    rad: float
    s: float = math.nan  # missing in files of earlier versions


class ReplayedPhase(NamedTuple):
    """One phase of the replay."""

    arrival: float | None  # [s]: time of its end
    end_speed: float | None  # [m/s]: remaining speed at an end at rest
    # end_deviation, deviation: from the plan, at the end of the phase and the largest one
    end_deviation: RecordedDeviation | None
    deviation: RecordedDeviation | None
    least_c_n: LeastForce | None = None  # None in files of earlier versions


class ReplayFigures(NamedTuple):
    """The replay of a whole plan."""

    least_c_n: LeastForce
    phases: tuple[ReplayedPhase, ...]
    residual: float  # of the equations of motion at the samples, in the scene's own units
    steps: int  # of the simulation
    simulations: int | None = None  # replays until the accepted one; None in earlier versions
