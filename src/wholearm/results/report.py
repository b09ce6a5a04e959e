"""Report of a replay: margins, ends, deviations and energies by phase, as tables.

And what plans record of it, and of lower bounds, impacts and ranges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ..common.document import Document, Result, Table, fixed
from .adopt import Moved
from .trajectory import Trajectory

DEPARTURE = 1e-3  # largest `Deviation` from a plan, over the scene's length, and in rad


class Deviation(NamedTuple):
    """Largest difference between planned and simulated state."""

    position: float  # [m]: of the coordinates x and y
    angle: float  # [rad]: of phi and the joint angles
    time: float  # [s]: when the larger of the two was, positions counting over the scene's length

    def measure(self, length: float) -> float:
        """Its size, over the scene's `length` [m] and in rad; zero where none is known."""
        sizes = self.position / length, self.angle
        return max((size for size in sizes if not math.isnan(size)), default=0.0)


class ForceAt(NamedTuple):
    """A contact's forces at an instant, and what torques change of them."""

    contact: str
    c_n: float  # c_n, c_t [N]: NaN where they are not determined, at rest
    c_t: float
    per_tau: tuple[float, float]  # [N/(N m)]: d c_n / d tau_1 and d c_n / d tau_2, at that state


class TorqueAdvice(NamedTuple):
    """A change of the torques that mends a loss."""

    change: tuple[float, float]  # of both torques [N m]
    to: tuple[float, float]  # what they then are [N m]
    but: str = ""  # what else it spoils, by name; empty if every limit is kept
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
    """A contact that is lost, slips or presses with less than epsilon, and what would mend that."""

    phase: int  # number of the phase
    contact: str
    kind: str  # {"lost", "slips", "thin"}
    time: float  # [s]
    at_rest: bool  # whether it was; then forces are those with which it would start to move
    forces: tuple[ForceAt, ...]  # of every contact of the formation
    # [m/s^2 or rad/s^2]: acceleration towards the end of the phase, and what 1 N m of tau_1 and of
    # tau_2 adds to it; empty for a release, and where forces are not determined
    closing: tuple[float, ...]
    changes: tuple[TorqueAdvice, ...]  # of one torque, or if that spoils something of both

    def to_text(self) -> str:
        """What would mend it, in a sentence."""
        what = {"lost": "is lost", "slips": "slips", "thin": "falls below epsilon"}[self.kind]
        text = f"{self.contact} {what} at t = {self.time:.5g} s, phase {self.phase}"
        ways = [change.to_text() for change in self.changes]
        if all(change.but for change in self.changes):
            when = "at this place" if self.at_rest else "in this state, so change them earlier"
            ways.append(f"no torques keep every limit {when}")
        return f"{text}: {'; '.join(ways)}"


class Approach(NamedTuple):
    """How near a motion that misses the end of a phase has come to it."""

    phase: int  # number of the phase
    until: str  # its end
    distance: float  # the least, [m] or [rad]
    unit: str  # {"m", "rad"}
    time: float  # [s]: when
    rate: float  # [m/s or rad/s]: how fast the distance was closing then
    turns: tuple[float, ...]  # [s]: when the motion turned back in this phase

    def to_text(self) -> str:
        """All of it in a sentence."""
        text = (
            f"{self.until} was nearest at t = {self.time:.5g} s, {self.distance:.4g} {self.unit} "
            f"away, then closing at {self.rate:.2g} {self.unit}/s, phase {self.phase}"
        )
        turns = ", ".join(f"{time:.5g}" for time in self.turns)
        return f"{text}; the motion turns back at t = {turns} s" if turns else text


class TuningHelp(NamedTuple):
    """What helps to tune torques."""

    losses: tuple[Loss, ...] = ()  # those that end the replay first
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
"""Tables of a replay: columns by attributes, and what parts of the energy are called."""


class ContactMargin(NamedTuple):
    """The least normal force of one contact in one phase."""

    contact: str
    least: float  # [N]: NaN if the contact was never seen moving
    time: float  # [s]: when
    margin: float  # [N]: least - epsilon


class UniquenessMargin(NamedTuple):
    """Least uniqueness margin of contact forces in one phase (`mechanics.uniqueness`).

    A principal minor of the contact matrix K over that without friction: forces are the only ones
    where all are positive.
    """

    value: float
    contacts: str  # whose minor it is, with the modes of those that do not slide
    time: float  # [s]: when


class LeastImpulse(NamedTuple):
    """The contact of the next phase with the least impulse in an impact, and that impulse [N s]."""

    contact: str
    impulse: float


class SlipMargin(NamedTuple):
    """The least margin to slipping of one rolling contact in one phase."""

    contact: str
    least: float  # [N]: of mu c_n - |c_t|; NaN if the contact was never seen moving
    time: float  # [s]: when


class FingerGap(NamedTuple):
    """The least gap between the two links."""

    least: float  # [m]: negative where they overlap
    time: float  # [s]: when


class PhaseReport(NamedTuple):
    """One phase of the replay."""

    number: int  # from 1
    until: str  # what ends the phase
    end: str  # how it passes into the next one: at rest, smoothly or with an impact
    start: float  # [s]
    contacts: tuple[ContactMargin, ...]
    rolling: tuple[SlipMargin, ...]  # of the contacts that roll
    arrival: float | None  # [s]: when its end was reached, None if it was not
    arrival_rate: float | None  # [m/s or rad/s] towards the end then; None for a release
    # [m/s]: the largest speed left at an end at rest, angular ones times the scene's length; None
    # where the phase ends otherwise, or was not ended
    end_speed: float | None
    impact: LeastImpulse | None  # None without one, or if what was planned for was a stop
    end_deviation: Deviation | None  # from the plan at the end of the phase; None without a plan
    deviation: Deviation | None  # and at worst
    uniqueness_margin: UniquenessMargin | None = None  # None if nothing was seen moving
    wedged: float | None = None  # [s]: how long friction could have held it; None if not at rest

    @property
    def least_force(self) -> LeastForce | None:
        """The least normal force of all contacts; None if nothing moved."""
        seen = [one for one in self.contacts if not math.isnan(one.least)]
        forces = (LeastForce(one.least, one.contact, self.number, one.time) for one in seen)
        return min(forces, key=lambda force: force.value, default=None)


class ModeChange(NamedTuple):
    """A contact or joint that goes on in another mode while the rest moves."""

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
    theta_1_ddot: float  # [rad/s^2]: as the replay has it

    @property
    def residual(self) -> float:
        """What the equation leaves [N m]."""
        return self.Phi_1 * self.theta_1_ddot + self.Phi_2 * self.theta_1_dot + self.Phi_3


class Failure(NamedTuple):
    """Why torques are not good, and in which phase, by its number."""

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
    residual: float  # what the equations leave unexplained
    relative: float  # the residual over the sum of all magnitudes


@dataclass(frozen=True, repr=False)
class Report(Result):
    """What a replay of torques showed."""

    name: str  # the problem's
    epsilon: float  # [N]
    outcome: str  # how the replay ended, in one sentence
    reached: bool  # whether the goal was reached
    missed_by: float  # [m or rad]: distance to the last end entered, NaN if that is a release
    failures: tuple[str, ...]  # why the torques are not good, the most important first
    failed_phase: int | None  # number of the phase that the first of them is about
    warnings: tuple[str, ...]  # what is not asked for but worth knowing
    phases: tuple[PhaseReport, ...]  # those entered
    energy: EnergyBalance
    finger_gap: FingerGap | None  # None if the fingers lie in different planes
    tolerance: float
    steps: int  # of the simulation
    changes: tuple[ModeChange, ...] = ()  # in the order of time
    reduced: tuple[ReducedState, ...] = ()  # along the replay, if that was asked for
    help: TuningHelp = field(default_factory=TuningHelp)  # what helps to tune the torques
    replay: Moved | None = field(default=None, repr=False, compare=False)  # what is reported on

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
    def least_force(self) -> LeastForce | None:
        """The least normal force of all phases; None if nothing moved."""
        forces = filter(None, (phase.least_force for phase in self.phases))
        return min(forces, key=lambda force: force.value, default=None)

    @property
    def document(self) -> Document:
        """The verdict with its reason, then everything else as tables."""
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
        """Forces where contacts are lost or slip, and what torques change of them."""
        rows: list[Sequence[object]] = []
        for loss in (loss for loss in self.help.losses if loss.kind != "thin"):
            for at in loss.forces:
                rows.append((loss.time, f"c_n of {at.contact}", at.c_n, at.c_t, *at.per_tau))
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
    duration: float  # [s]: what the plan takes for them
    bound: float | None  # [s]: no motion along their curves takes less; None where nothing is known
    error: float | None  # [s]: estimate of the bound's own error, which it is lowered by
    reason: str = ""  # why there is no bound, or empty

    derived = ("gap",)

    @property
    def gap(self) -> float | None:
        """How much longer than the bound the plan takes at most, relative to the bound."""
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
    """An impact that a problem asks for, and what became of it."""

    phase: int  # number of the phase that ends
    gained: str  # its `until`
    possible: bool  # whether the motion passes it at speed
    reason: str  # why not, or empty
    velocity_ratio: float  # speed after over speed before; NaN where nothing says
    least_impulse: float  # [N s per m/s]: for unit speed before
    least_impulse_contact: str
    speed: float  # [m/s]: before; zero if the motion stops there
    # [s], [(N m)^2 s] or [N]: how much better than with a stop the objective is of phases planned
    # together; NaN if the impact is not possible, or there is no plan with a stop
    saves: float

    @property
    def stop(self) -> str:
        """Why the motion stops there; empty if it does not."""
        return "" if self.possible else f"stops: {self.reason}"


class RangeFigures(NamedTuple):
    """A plan that keeps its limits for all numbers within their ranges."""

    radii: Mapping[str, float]  # half widths of the ranges by name, as they were planned with
    nominal: float  # the objective without ranges
    largest: float | None = None  # factor on the ranges up to which there is a plan, if looked for
    # the same for each phase, planned with those that impacts join it to; None in the time domain
    phases: tuple[float | None, ...] = ()
    capped: bool = False  # whether the factor is as large as ranges make sense
    held: tuple[int, ...] = ()  # numbers of phases whose start friction may hold within the ranges


class LeastForce(NamedTuple):
    """A least normal force [N]: of which contact, in which phase, and when [s]."""

    value: float
    contact: str
    phase: int
    time: float


class RecordedDeviation(NamedTuple):
    """A `Deviation`, whose position, angle and time have the names of their units in files."""

    m: float
    rad: float
    s: float = math.nan  # files of earlier versions do not say when


class ReplayedPhase(NamedTuple):
    """One phase of the replay."""

    arrival: float | None  # [s]: when its end was reached
    end_speed: float | None  # [m/s]: what is left at an end at rest
    # end_deviation, deviation: from the plan, at the end of the phase and at worst
    end_deviation: RecordedDeviation | None
    deviation: RecordedDeviation | None
    least_c_n: LeastForce | None = None  # none in files of earlier versions


class ReplayFigures(NamedTuple):
    """The replay of a whole plan."""

    least_c_n: LeastForce
    phases: tuple[ReplayedPhase, ...]
    residual: float  # what the samples leave of the equations of motion, in the scene's own units
    steps: int  # of the simulation
    simulations: int | None = None  # replays up to the one that held; None in earlier versions
