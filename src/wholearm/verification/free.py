"""Verification by complementarity simulation, without telling which contacts hold.

A plan is simulated whole, open loop from the exact start, and phase by phase, each from its planned
start. The verdict is about the phases: the junctions between them are unstable to arrival errors.
With torques alone a phase ends where its `until` is reached, and with a policy where that goes on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import find_runs
from ..common.document import Document, Result, Table, fixed
from ..common.errors import name_phases, require_number
from ..common.sharing import exclusive
from ..contacts.contact_limits import list_renamed
from ..geometry.curve import describe_pose
from ..geometry.tracing import EndDistance
from ..policy.make import make_policy
from ..policy.playback import ClosedLoop, Policy
from ..problem.definition import End, Phase, Problem
from ..results.adopt import Moved, Torques, adopt_motion, adopt_torques, require_same_contacts
from ..results.report import DEPARTURE, Deviation
from ..results.trajectory import Trajectory
from ..simulation.events import EventKind, OutcomeKind, Simulation
from ..simulation.simulate import simulate_free, simulate_phases
from ..simulation.system import build_system
from .verify import MISSED, REST_SPEED, describe_misses, describe_motors, measure_speed

MOST = 60  # most events that the text lists; `to_dict` has all
MOMENT = 0.1  # time in which contacts close that are open where a phase begins, over the scene's
TOUCHES = EventKind.IMPACT, EventKind.GAINED, EventKind.PASS  # with which a contact touches
REACHED, TURNED = 0.03, math.radians(1.0)
"""How far from the plan's end a policy may end: over the scene's length, and in rad."""


CONTACT_SPEEDS = (1.0, 0.5, 0.25)
"""Factors on the usual speed at which contacts are made. Impacts that open other contacts open them
by less (queries 24, 33, 51), and what is open closes meanwhile (new polygons 6, 8, 20, 39); a
quarter: query 0. Slower ones keep fewer contacts under errors: hexagon, 74 % instead of 80 %."""


@exclusive
def verify_free(
    problem: Problem,
    what: Torques,
    *,
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    restitution: float = 0.0,
    progress: Callable[[str], None] | None = None,
) -> FreeReport:
    """Simulate torques without telling which contacts hold, and report what happens.

    Parameters
    ----------
    tolerance    of the simulation
    departure    how far the end of a phase may be from the plan, as of `verify`, and how far
                 contacts of a phase may open, over the scene's length: bounces by less are events,
                 but no failure
    restitution  Poisson's coefficient of impacts
    progress     told what is simulated

    InputError if the trajectory has other contacts than the problem, or a number is out of its
    range; SimulationError if bodies overlap at the start.
    """
    problem, torque, plan = adopt_torques(problem, what)
    allowed = require_number(departure, "departure", positive=True)
    require_same_contacts(problem, plan)
    options: dict[str, Any] = {"tolerance": tolerance, "restitution": restitution}
    if progress is not None:
        progress("simulating the whole")
    whole = simulate_free(problem, torque if plan is None else plan, **options)
    warnings, beyond = warn("whole", whole), [text for _, text in describe_motors(problem, torque)]
    if plan is None:
        phases, failures = _follow(whole, allowed)
        warnings = [*beyond, *_list_misses(whole, phases, MISSED), *warnings]
        whole = whole.count_phases([phase.start for phase in phases])
        return FreeReport(problem.name, whole, (), phases, tuple(failures), tuple(warnings))
    by_clock = _compare(plan, whole, range(len(plan.phase_starts) - 1), allowed)
    failures, alone = [*beyond, *_list_misses(whole, by_clock, allowed)], []
    for indices, part in simulate_phases(problem, plan, progress, **options):
        compared = _compare(plan, part, indices, allowed)
        alone += compared
        names = name_phases([phase.number for phase in compared])
        warnings += warn(f"{names} alone", part)
        if part.outcome.kind is not OutcomeKind.ENDED:
            failures.append(f"{names} alone: the simulator gave up, as {part.outcome.text}")
        for phase in compared:
            title, end = f"phase {phase.number} alone", phase.deviation
            failures += [f"{title}: {loss.describe()}" for loss in phase.losses]
            assert end is not None
            if phase.reached and end.measure(problem.scene.scales.length) > allowed:
                away = f"{end.position:.3g} m and {end.angle:.3g} rad away from the plan"
                failures.append(f"{title} ends {away}")
    both = tuple(alone), tuple(by_clock)
    return FreeReport(problem.name, whole, *both, tuple(failures), tuple(warnings))


@exclusive
def verify_policy(
    problem: Problem,
    plan: Trajectory | Moved,
    policy: Policy,
    *,
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    restitution: float = 0.0,
) -> FreeReport:
    """Simulate the closed loop from the problem's start, and report the end of each phase.

    A contact of a phase counts from when the phase begins until the one that it gains presses. One
    that is open then, and closes within `MOMENT`, is a warning.

    Parameters
    ----------
    plan                    where phases are to end
    tolerance, restitution  as of `verify_free`
    departure               how far contacts of a phase may open, over the scene's length

    InputError if the policy or the plan has other phases than the problem, or a number is out of
    its range.
    """
    problem, plan = adopt_motion(problem, plan)
    allowed = require_number(departure, "departure", positive=True)
    count = len(problem.phases)
    policy.require_count(count, "problem")
    loop = ClosedLoop(policy)
    until = loop.find_limit(count)
    whole = simulate_free(problem, loop, until=until, tolerance=tolerance, restitution=restitution)
    failures = [] if whole.outcome.kind is OutcomeKind.ENDED else [whole.outcome.text]
    phases, moment = list[FreePhase](), MOMENT * problem.scene.scales.time
    beyond = describe_motors(problem, whole.torque, policy.settings.period)
    warnings, ends = warn("whole", whole) + [text for _, text in beyond], float(whole.t[-1])
    if whole.events and whole.events[-1].kind is EventKind.REST:
        ends = whole.events[-1].time
    for phase in (phase for phase in problem.phases if phase.number in loop.began):
        number, start = phase.number, loop.began[phase.number]
        stop = loop.began.get(number + 1, ends)
        touch = find_touch(whole, list_gained(problem, phase), start)
        losses = tuple(find_losses(whole, phase, start, min(stop, touch), allowed, moment))
        reached = number == count or number + 1 in loop.began
        end = measure_end(whole, plan, phase.index, stop)
        phases.append(FreePhase(number, start, stop, reached, losses, end))
        warnings += _list_misses(whole, phases[-1:], MISSED)
        lasting = [loss for loss in losses if loss.closes > start + moment]
        failures += [loss.describe(number) for loss in lasting]
        warnings += [
            f"{loss.contact} is open where phase {number} begins, by {loss.gap:.2g} m, and closes "
            f"within {loss.closes - start:.2g} s"
            for loss in losses
            if loss not in lasting
        ]
        if not reached:
            failures.append(f"phase {number} does not end within {until:.4g} s")
    far = end.position / problem.scene.scales.length > REACHED or end.angle > TURNED
    if len(phases) == count and far:
        text = f"ends {end.position:.3g} m and {end.angle:.3g} rad away from the plan"
        failures.append(f"the policy {text}")
    whole = whole.count_phases([phase.start for phase in phases])
    return FreeReport(problem.name, whole, (), tuple(phases), tuple(failures), tuple(warnings))


def find_policy(
    problem: Problem,
    plan: Trajectory | Moved,
    *,
    contact_speed: float | None = None,
    departure: float = DEPARTURE,
    **values: Any,
) -> tuple[Policy, FreeReport]:
    """A policy with its verification: the first of `CONTACT_SPEEDS` that holds, or the usual one.

    Arguments are those of `make_policy` and `verify_policy`; `contact_speed` is tried alone.
    """
    usual: tuple[Policy, FreeReport] | None = None
    for speed in CONTACT_SPEEDS if contact_speed is None else (contact_speed,):
        policy = make_policy(problem, plan, contact_speed=speed, **values)
        report = verify_policy(problem, plan, policy, departure=departure)
        if report.ok and usual is not None:
            text = f"contacts are made at {speed:g} times the usual speed: otherwise "
            warnings = (*report.warnings, text + "; ".join(usual[1].failures))
            return policy, replace(report, warnings=warnings)
        usual = usual or (policy, report)
        if report.ok:
            return usual
    assert usual is not None
    return usual


def warn(title: str, simulation: Simulation) -> list[str]:
    """What was not decided by the laws of contact alone."""
    events = simulation.find(EventKind.AMBIGUOUS, EventKind.INCONSISTENT)
    return [f"{title}: {event.text}" for event in events]


def _compare(
    plan: Trajectory, simulation: Simulation, indices: range, allowed: float
) -> list[FreePhase]:
    """Phases by the clock: where each ends, and which of its contacts are lost meanwhile."""
    compared, starts = [], plan.phase_starts.tolist()
    for phase in (simulation.problem.phases[index] for index in indices):
        start, stop = starts[phase.index : phase.index + 2]
        losses = find_losses(simulation, phase, start, stop, allowed)
        end = measure_end(simulation, plan, phase.index, stop)
        compared.append(FreePhase(phase.number, start, stop, end.time == stop, tuple(losses), end))
    return compared


def measure_end(simulation: Simulation, plan: Trajectory, index: int, stop: float) -> Deviation:
    """Difference of the configuration at an instant from the planned end of a phase."""
    row = int(np.searchsorted(simulation.t, stop, side="right")) - 1
    away = np.abs(simulation.z[row] - plan.z[np.flatnonzero(plan.phase == index)[-1]])
    return Deviation(float(away[:2].max()), float(away[2:].max()), float(simulation.t[row]))


def _list_misses(simulation: Simulation, phases: Sequence[FreePhase], allowed: float) -> list[str]:
    """Limits that phases exceed between their start and stop, as of `describe_misses`."""
    own = simulation.problem.phases
    spans = ((own[phase.number - 1], (phase.start, phase.stop)) for phase in phases)
    return [
        text for phase, span in spans for text in describe_misses(phase, simulation, allowed, span)
    ]


def _follow(simulation: Simulation, allowed: float) -> tuple[tuple[FreePhase, ...], list[str]]:
    """Phases of torques alone: each until what ends it has happened."""
    phases, failures = list[FreePhase](), list[str]()
    start = float(simulation.t[0])
    for phase in simulation.problem.phases:
        stop, failure = _find_end(simulation, phase, start, allowed)
        last = float(simulation.t[-1]) if stop is None else stop
        losses = find_losses(simulation, phase, start, last, allowed)
        phases.append(FreePhase(phase.number, start, last, stop is not None, tuple(losses), None))
        failures += [loss.describe(phase.number) for loss in losses]
        failures += [f"phase {phase.number} {failure}"] if failure else []
        if stop is None:
            break
        start = stop
    return tuple(phases), failures


def _find_end(
    simulation: Simulation, phase: Phase, start: float, allowed: float
) -> tuple[float | None, str]:
    """When a phase ends [s], None if it does not, and what is wrong with its end, if anything.

    Open loop, what is brought to rest may stop a little short: a phase with an end at rest also
    ends where it is slowest within `allowed` of it, over the scene's length or in rad.
    """
    problem, scene, rows = simulation.problem, simulation.problem.scene, simulation.t >= start
    t, z, length = simulation.t[rows], simulation.z[rows], scene.scales.length
    later, until = [e for e in simulation.events if e.time >= start], phase.until.lead(z[0], length)
    if until.is_release:
        lost = [e for e in later if e.kind is EventKind.CONTACT_LOST]
        times = [e.time for e in lost if e.contact in list_leaving(problem, phase)]
        return min(times, default=None), "" if times else "does not end: nothing is released"
    end = EndDistance(scene, until, z[0])
    left = end.measure(z)
    if until.contact is None:
        times = t[left <= 0].tolist()
    else:
        name, system = until.contact.name, build_system(scene)
        gaps, inside = (part[:, system.names.index(name)] for part in system.measure(z))
        left = np.maximum(gaps, -inside) / length
        closed = [s for s in simulation.stretches if s.contact == name and s.stop > start]
        times = [e.time for e in later if e.contact == name]
        times += [max(s.start, start) for s in closed]
    stop = min(times, default=math.inf)
    if phase.end is End.REST:
        away = np.maximum(left, until.measure_pins(z.T, length))
        speed = np.array([measure_speed(scene, v) for v in simulation.z_dot[rows]])
        rests = (away <= allowed) & (speed <= REST_SPEED * scene.scales.speed) & (t <= stop)
        slowest = (t[run][speed[run].argmin()] for run in find_runs(rests) if run.start)
        stop = float(next(slowest, stop))
    if stop == math.inf:
        row = int(left.argmin())
        place = f"nearest, at t = {t[row]:.5g} s, it is {end.scale * left[row]:.3g} {end.unit} away"
        return None, f"does not end: {phase.until} is not reached; {place}"
    at = z[int(np.searchsorted(t, stop, side="right")) - 1]
    beside = until.measure_pins(at, length) > allowed
    return stop, f"ends at {describe_pose(at)}, and not with {phase.until}" if beside else ""


def list_gained(problem: Problem, phase: Phase) -> set[str]:
    """Contacts that a phase ends with, but for those that its own go on as.

    Beyond a border the gained contact may press as that of another feature, as the next phase has.
    """
    following = problem.phases[phase.number : phase.number + 1]
    new = {name for after in following for name in after.formation.names}
    gained = {phase.until.contact.name} if phase.until.contact is not None else set()
    return (new | gained).difference(phase.formation.names, *list_aliases(problem, phase).values())


def find_touch(simulation: Simulation, contacts: Collection[str], start: float) -> float:
    """When one of some contacts first touches after `start`, if only to bounce; infinity if none.

    An impact may lift other contacts, before the one that strikes presses for good.
    """
    times = [e.time for e in simulation.events if e.kind in TOUCHES and e.contact in contacts]
    times += [s.start for s in simulation.stretches if s.contact in contacts]
    return min((time for time in times if time > start), default=math.inf)


def list_leaving(problem: Problem, phase: Phase) -> set[str]:
    """Contacts of a phase that the next one does not have."""
    following = problem.phases[phase.number : phase.number + 1]
    return set(phase.formation.names).difference(*(after.formation.names for after in following))


def list_aliases(problem: Problem, phase: Phase) -> dict[str, set[str]]:
    """Contacts of features that those of a phase go on from, or go on as, one after the other."""
    aliases: dict[str, set[str]] = {name: set() for name in phase.formation.names}
    formations = [part.formation.contacts for part in problem.phases]
    for step in (-1, 1):
        names, index = {contact: contact.name for contact in formations[phase.index]}, phase.index
        while names and 0 <= index + step < len(formations):
            pair = (formations[k] for k in sorted((index, index + step)))
            renamed = list_renamed(problem.scene, *pair)
            if step < 0:
                renamed = {new: old for old, new in renamed.items()}
            names = {renamed[one]: name for one, name in names.items() if one in renamed}
            for contact, name in names.items():
                aliases[name].add(contact.name)
            index += step
    return aliases


def find_losses(
    simulation: Simulation,
    phase: Phase,
    start: float,
    stop: float,
    allowed: float,
    moment: float = 0.0,
) -> list[LostContact]:
    """Contacts of a phase that open by more than is allowed, over the scene's length.

    Of each the first time, and that after a `moment` from `start` [s] on rather than one before.
    """
    scene, losses = simulation.problem.scene, []
    system, aliases = build_system(scene), list_aliases(simulation.problem, phase)
    for name in phase.formation.names:
        openings = list[LostContact]()
        for first, after in simulation.list_pauses(name, start, stop, aliases[name]):
            rows = np.flatnonzero((simulation.t >= first) & (simulation.t <= after))
            gaps = system.measure(simulation.z[rows])[0][:, system.names.index(name)]
            if gaps.max(initial=0.0) > allowed * scene.scales.length:
                openings.append(LostContact(name, first, float(gaps.max()), after))
        late = [opening for opening in openings if opening.closes > start + moment]
        losses += (late or openings)[:1]
    return sorted(losses, key=lambda loss: loss.time)


class LostContact(NamedTuple):
    """A contact of a phase that opens."""

    contact: str
    time: float  # [s]: when it stops pressing
    gap: float  # [m]: by how much it opens
    closes: float  # [s]: when it presses again, or the phase ends

    def describe(self, phase: int | None = None) -> str:
        """Say it, and in which phase by its number if that is given."""
        where = "" if phase is None else f", phase {phase},"
        text = f"{self.contact} is lost at t = {self.time:.5g} s{where}"
        return f"{text} and opens by {self.gap:.2g} m"


class FreePhase(NamedTuple):
    """A phase in a free simulation."""

    number: int  # from 1
    start: float  # start, stop [s]:
    stop: float
    reached: bool  # whether its end came
    losses: tuple[LostContact, ...]  # contacts that opened by more than a bounce, by time
    deviation: Deviation | None  # from the plan at its end; None without a plan


@dataclass(frozen=True, repr=False)
class FreeReport(Result):
    """What a simulation without assumptions showed."""

    name: str  # the problem's
    whole: Simulation = field(repr=False)  # from the exact start to the end of the torques
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

    def find_phase(self, time: float) -> int:
        """Number of the phase of the whole at a time [s]."""
        begun = (phase.number for phase in self.phases if phase.start <= time)
        return max(begun, default=1)

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
            "events": [{**e._asdict(), "phase": self.find_phase(e.time)} for e in whole.events],
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
            (e.time, self.find_phase(e.time), e.text.partition(" at t =")[0]) for e in whole.events
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
                Table.of(whole.stretches, columns)._replace(max_rows=MOST),
                Table(["at t [s]:.6f", "phase:d", "event"], events, max_rows=MOST),
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
