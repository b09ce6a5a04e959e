"""Verification by complementarity simulation, without prescribed contacts.

A plan is simulated whole, open loop from the exact start, and phase by phase, each from its planned
start. The verdict is about the phases: the junctions between them are unstable to arrival errors.
With torques alone a phase ends when its `until` is reached, with a policy when the policy goes on.
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
from ..results.adopt import MotionLike, Torques, adopt_motion, adopt_torques, require_same_contacts
from ..results.report import DEPARTURE, Deviation
from ..results.trajectory import Trajectory
from ..simulation.events import EventKind, OutcomeKind, Simulation
from ..simulation.simulate import simulate_free, simulate_phases
from ..simulation.system import build_system
from .verify import LIMIT_TOLERANCE, REST_SPEED, describe_excess, describe_motors, measure_speed

MAX_EVENTS = 60  # largest number of events in the text; `to_dict` has all
GRACE = 0.1  # time to close contacts that are open where a phase begins, over the scene's
TOUCHES = EventKind.IMPACT, EventKind.GAINED, EventKind.PASS  # events of a contact that closes
END_SHIFT, END_ANGLE = 0.03, math.radians(1.0)
"""Tolerances of a policy's end from the plan's: over the scene's length, and in rad."""


CONTACT_SPEEDS = (1.0, 0.5, 0.25)
"""Factors on the usual speed at which contacts are made. With lower ones, impacts open other
contacts by less (queries 24, 33, 51), and open contacts close in time (new polygons 6, 8, 20, 39);
a quarter: query 0. They keep fewer contacts under errors: hexagon, 74 % instead of 80 %."""


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
    """Report on an open-loop simulation without prescribed contacts.

    Parameters
    ----------
    tolerance    of the simulation
    departure    largest distance of the end of a phase from the plan, as of `verify`, and largest
                 opening of its contacts, over the scene's length: smaller bounces are events, but
                 no failure
    restitution  Poisson's coefficient of impacts
    progress     called with the name of each part before its simulation

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
    warnings, motors = warn("whole", whole), [text for _, text in describe_motors(problem, torque)]
    if plan is None:
        phases, failures = _find_ends(whole, allowed)
        warnings = [*motors, *_list_excess(whole, phases, LIMIT_TOLERANCE), *warnings]
        whole = whole.count_phases([phase.start for phase in phases])
        return FreeReport(problem.name, whole, (), phases, tuple(failures), tuple(warnings))
    by_times = _compare(plan, whole, range(len(plan.phase_starts) - 1), allowed)
    failures, alone = [*motors, *_list_excess(whole, by_times, allowed)], []
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
                distance = f"{end.position:.3g} m and {end.angle:.3g} rad away from the plan"
                failures.append(f"{title} ends {distance}")
    lists = tuple(alone), tuple(by_times)
    return FreeReport(problem.name, whole, *lists, tuple(failures), tuple(warnings))


@exclusive
def verify_policy(
    problem: Problem,
    plan: Trajectory | MotionLike,
    policy: Policy,
    *,
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    restitution: float = 0.0,
) -> FreeReport:
    """Report on a simulation of the closed loop from the problem's start.

    Contacts of a phase have to hold from its start until the contact that it gains touches. One
    that is open at the start, and closes within `GRACE`, is a warning.

    Parameters
    ----------
    plan                    has the ends of phases
    tolerance, restitution  as of `verify_free`
    departure               largest opening of contacts of a phase, over the scene's length

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
    phases, grace = list[FreePhase](), GRACE * problem.scene.scales.time
    motors = describe_motors(problem, whole.torque, policy.settings.period)
    warnings, last = (warn("whole", whole) + [text for _, text in motors], float(whole.t[-1]))
    if whole.events and whole.events[-1].kind is EventKind.REST:
        last = whole.events[-1].time
    for phase in (phase for phase in problem.phases if phase.number in loop.phase_starts):
        number, start = phase.number, loop.phase_starts[phase.number]
        stop = loop.phase_starts.get(number + 1, last)
        touch = find_touch(whole, list_gained(problem, phase), start)
        losses = tuple(find_losses(whole, phase, start, min(stop, touch), allowed, grace))
        reached = number == count or number + 1 in loop.phase_starts
        end = measure_end(whole, plan, phase.index, stop)
        phases.append(FreePhase(number, start, stop, reached, losses, end))
        warnings += _list_excess(whole, phases[-1:], LIMIT_TOLERANCE)
        lasting = [loss for loss in losses if loss.closes > start + grace]
        failures += [loss.describe(number) for loss in lasting]
        warnings += [
            f"{loss.contact} is open where phase {number} begins, by {loss.gap:.2g} m, and closes "
            f"within {loss.closes - start:.2g} s"
            for loss in losses
            if loss not in lasting
        ]
        if not reached:
            failures.append(f"phase {number} does not end within {until:.4g} s")
    far = end.position / problem.scene.scales.length > END_SHIFT or end.angle > END_ANGLE
    if len(phases) == count and far:
        text = f"ends {end.position:.3g} m and {end.angle:.3g} rad away from the plan"
        failures.append(f"the policy {text}")
    whole = whole.count_phases([phase.start for phase in phases])
    return FreeReport(problem.name, whole, (), tuple(phases), tuple(failures), tuple(warnings))


def find_policy(
    problem: Problem,
    plan: Trajectory | MotionLike,
    *,
    contact_speed: float | None = None,
    departure: float = DEPARTURE,
    **values: Any,
) -> tuple[Policy, FreeReport]:
    """A policy with its verification: the first of `CONTACT_SPEEDS` that holds, or the usual one.

    Arguments are those of `make_policy` and `verify_policy`; `contact_speed` is tried alone.
    """
    first: tuple[Policy, FreeReport] | None = None
    for speed in CONTACT_SPEEDS if contact_speed is None else (contact_speed,):
        policy = make_policy(problem, plan, contact_speed=speed, **values)
        report = verify_policy(problem, plan, policy, departure=departure)
        if report.ok and first is not None:
            text = f"contacts are made at {speed:g} times the usual speed: otherwise "
            warnings = (*report.warnings, text + "; ".join(first[1].failures))
            return policy, replace(report, warnings=warnings)
        first = first or (policy, report)
        if report.ok:
            return first
    assert first is not None
    return first


def warn(title: str, simulation: Simulation) -> list[str]:
    """Warnings of instants at which the laws of contact have several solutions or none."""
    events = simulation.find(EventKind.AMBIGUOUS, EventKind.INCONSISTENT)
    return [f"{title}: {event.text}" for event in events]


def _compare(
    plan: Trajectory, simulation: Simulation, indices: range, allowed: float
) -> list[FreePhase]:
    """Phases at the times of the plan: deviation of each end, and lost contacts."""
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
    error = np.abs(simulation.z[row] - plan.z[np.flatnonzero(plan.phase == index)[-1]])
    return Deviation(float(error[:2].max()), float(error[2:].max()), float(simulation.t[row]))


def _list_excess(simulation: Simulation, phases: Sequence[FreePhase], allowed: float) -> list[str]:
    """Sentences of `describe_excess` on phases from their start to their stop."""
    problem_phases = simulation.problem.phases
    spans = ((problem_phases[phase.number - 1], (phase.start, phase.stop)) for phase in phases)
    return [
        text for phase, span in spans for text in describe_excess(phase, simulation, allowed, span)
    ]


def _find_ends(simulation: Simulation, allowed: float) -> tuple[tuple[FreePhase, ...], list[str]]:
    """Phases of torques alone, each until its end is reached, and sentences on failures."""
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
    """End time of a phase [s], None if it does not end, and the failure of its end, or "".

    In open loop, motion may come to rest a little before the end: a phase with an end at rest also
    ends where it is slowest within `allowed` of it, over the scene's length or in rad.
    """
    problem, scene, rows = simulation.problem, simulation.problem.scene, simulation.t >= start
    t, z, length = simulation.t[rows], simulation.z[rows], scene.scales.length
    later, until = [e for e in simulation.events if e.time >= start], phase.until.lead(z[0], length)
    if until.is_release:
        lost = [e for e in later if e.kind is EventKind.CONTACT_LOST]
        times = [e.time for e in lost if e.contact in list_released(problem, phase)]
        return min(times, default=None), "" if times else "does not end: nothing is released"
    end = EndDistance(scene, until, z[0])
    left = end.measure(z)
    if until.contact is None:
        times = t[left <= 0].tolist()
    else:
        name, system = until.contact.name, build_system(scene)
        gaps, low = (part[:, system.names.index(name)] for part in system.measure(z))
        left = np.maximum(gaps, -low) / length
        closed = [s for s in simulation.stretches if s.contact == name and s.stop > start]
        times = [e.time for e in later if e.contact == name]
        times += [max(s.start, start) for s in closed]
    stop = min(times, default=math.inf)
    if phase.end is End.REST:
        off = np.maximum(left, until.measure_pins(z.T, length))
        speed = np.array([measure_speed(scene, v) for v in simulation.z_dot[rows]])
        resting = (off <= allowed) & (speed <= REST_SPEED * scene.scales.speed) & (t <= stop)
        slowest = (t[run][speed[run].argmin()] for run in find_runs(resting) if run.start)
        stop = float(next(slowest, stop))
    if stop == math.inf:
        row = int(left.argmin())
        place = f"nearest, at t = {t[row]:.5g} s, it is {end.scale * left[row]:.3g} {end.unit} away"
        return None, f"does not end: {phase.until} is not reached; {place}"
    end_pose = z[int(np.searchsorted(t, stop, side="right")) - 1]
    missed = until.measure_pins(end_pose, length) > allowed
    return stop, f"ends at {describe_pose(end_pose)}, and not with {phase.until}" if missed else ""


def list_gained(problem: Problem, phase: Phase) -> set[str]:
    """Contacts that close at the end of a phase, without new names of its own contacts.

    Beyond a border the gained contact may be that of another feature, as the next phase has.
    """
    following = problem.phases[phase.number : phase.number + 1]
    new = {name for later in following for name in later.formation.names}
    gained = {phase.until.contact.name} if phase.until.contact is not None else set()
    return (new | gained).difference(phase.formation.names, *list_aliases(problem, phase).values())


def find_touch(simulation: Simulation, contacts: Collection[str], start: float) -> float:
    """Time at which one of some contacts first touches after `start`, or infinity [s].

    A bounce counts: its impact may open other contacts.
    """
    times = [e.time for e in simulation.events if e.kind in TOUCHES and e.contact in contacts]
    times += [s.start for s in simulation.stretches if s.contact in contacts]
    return min((time for time in times if time > start), default=math.inf)


def list_released(problem: Problem, phase: Phase) -> set[str]:
    """Contacts of a phase that the next one does not have."""
    following = problem.phases[phase.number : phase.number + 1]
    return set(phase.formation.names).difference(*(later.formation.names for later in following))


def list_aliases(problem: Problem, phase: Phase) -> dict[str, set[str]]:
    """Names under which contacts of a phase exist in adjacent phases, and so on, by name."""
    aliases: dict[str, set[str]] = {name: set() for name in phase.formation.names}
    formations = [part.formation.contacts for part in problem.phases]
    for step in (-1, 1):
        names, index = {contact: contact.name for contact in formations[phase.index]}, phase.index
        while names and 0 <= index + step < len(formations):
            pair = (formations[k] for k in sorted((index, index + step)))
            renamed = list_renamed(problem.scene, *pair)
            if step < 0:
                renamed = {new: old for old, new in renamed.items()}
            names = {renamed[old]: name for old, name in names.items() if old in renamed}
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
    grace: float = 0.0,
) -> list[LostContact]:
    """Contacts of a phase that open by more than `allowed`, over the scene's length.

    Of each contact the first opening that lasts until `grace` [s] after `start`, or the first one.
    """
    scene, losses = simulation.problem.scene, []
    system, aliases = build_system(scene), list_aliases(simulation.problem, phase)
    for name in phase.formation.names:
        openings = list[LostContact]()
        for opened, closed in simulation.list_pauses(name, start, stop, aliases[name]):
            rows = np.flatnonzero((simulation.t >= opened) & (simulation.t <= closed))
            gaps = system.measure(simulation.z[rows])[0][:, system.names.index(name)]
            if gaps.max(initial=0.0) > allowed * scene.scales.length:
                openings.append(LostContact(name, opened, float(gaps.max()), closed))
        lasting = [opening for opening in openings if opening.closes > start + grace]
        losses += (lasting or openings)[:1]
    return sorted(losses, key=lambda loss: loss.time)


class LostContact(NamedTuple):
    """A contact of a phase that opens."""

    contact: str
    time: float  # [s]: when it stops pressing
    gap: float  # [m]: largest gap
    closes: float  # [s]: when it presses again, or the phase ends

    def describe(self, phase: int | None = None) -> str:
        """A sentence, with the number of the phase if it is given."""
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
    """Result of a simulation without prescribed contacts."""

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
        """Whether every contact held, and every phase ended at its planned end."""
        return not self.failures

    @property
    def reason(self) -> str:
        """The main reason of the verdict, in one sentence."""
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
        numbers = (phase.number for phase in self.phases if phase.start <= time)
        return max(numbers, default=1)

    @property
    def values(self) -> dict[str, Any]:
        """The values of the JSON document."""
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
        """The verdict with its reason, then phases, contacts and events."""
        whole, lines = self.whole, [f"failure: {text}" for text in self.failures[1:]]
        form = fixed(1e-3 * max((s.least for s in whole.stretches if s.least > 0), default=0.0))
        events = [
            (e.time, self.find_phase(e.time), e.text.partition(" at t =")[0]) for e in whole.events
        ]
        columns = {"contact": "contact", "start": "presses from [s]:.6f", "stop": "to [s]:.6f"}
        columns |= {"least": f"least c_n [N]:{form}", "time": "at [s]:.6f"}
        title = "the whole from the start, by the clock" if self.alone else ""
        return self.judge(
            self.name,
            self.reason,
            [
                *lines,
                *(f"warning: {text}" for text in self.warnings),
                _list_phases(self.alone, "each phase from its planned start"),
                _list_phases(self.phases, title),
                Table.of(whole.stretches, columns)._replace(max_rows=MAX_EVENTS),
                Table(["at t [s]:.6f", "phase:d", "event"], events, max_rows=MAX_EVENTS),
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
