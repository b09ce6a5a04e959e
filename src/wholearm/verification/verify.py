"""Verification of torques by open-loop replay: margins between nodes, goal, deviation, energy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from ..common.arrays import Array, Numbers, find_lowest, sort_unique
from ..common.errors import InputError
from ..common.fields import POSITIVE, choice, declare, key, read_keys
from ..common.sharing import exclusive
from ..contacts.contact_limits import FINGERS_TOUCH, evaluate_finger_gap
from ..contacts.formation import Formation
from ..geometry.curve import describe_pose
from ..geometry.tracing import EndDistance
from ..mechanics import UNIQUENESS
from ..mechanics.dynamics import Directions, force_rows
from ..mechanics.limits import CONE, PRESS, TORQUE, LimitSet, make_limits
from ..mechanics.statics import SURE, Statics
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, describe_uniqueness, find_minors
from ..problem.definition import End, Phase, Problem
from ..results import report as results
from ..results.adopt import Torques, adopt_torques, require_same_contacts
from ..results.report import DEPARTURE, Deviation
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory, interpolate_quintic
from ..scene.model import Scene
from ..simulation import modes
from ..simulation.events import EventKind, Simulation
from ..simulation.system import EVENT_DELAY

if TYPE_CHECKING:
    from .free import FreeReport

REST_SPEED = 2e-2  # largest speed of rest at the end of a phase, relative to the scene's speed
DEFICIT = 2e-3  # tolerated deficit of normal forces of a plan below epsilon, over epsilon
EXACT_REST = 1e-9  # speed of rest but for rounding, relative to the scene's speed
N_INSTANTS = 33
"""Instants of a phase at which uniqueness margins and torques are evaluated."""
LIMIT_TOLERANCE = 1e-6  # least reported excess over a limit, over the scale of the limit
N_ROWS = 20
"""Approximate number of rows of each phase at which a replay is recorded and compared."""
_CHANGES = {EventKind.STICK: "sticks", EventKind.SLIP: "slips", EventKind.REVERSAL: "reverses"}


@declare(key("departure", kind=POSITIVE), key("rest_speed", kind=POSITIVE), UNIQUENESS)
@dataclass(frozen=True)
class Allowance:
    """Tolerances of the verdict on a replay.

    InputError if one of the first two is not positive, or the last is 1 or more.
    """

    departure: float = DEPARTURE  # departure, rest_speed: as of `verify`
    rest_speed: float = REST_SPEED
    uniqueness_margin: float = UNIQUENESS_MARGIN  # least one of contact forces

    def __post_init__(self) -> None:
        read_keys(self)


@overload
def verify(
    problem: Problem,
    what: Torques,
    *,
    contacts: Literal["prescribed"] = "prescribed",
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    rest_speed: float = REST_SPEED,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
    reduced: bool = False,
) -> results.Report: ...
@overload
def verify(
    problem: Problem,
    what: Torques,
    *,
    contacts: Literal["free"],
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    restitution: float = 0.0,
    progress: Callable[[str], None] | None = None,
) -> FreeReport: ...
@exclusive
def verify(
    problem: Problem,
    what: Torques,
    *,
    contacts: str = "prescribed",
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    rest_speed: float = REST_SPEED,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
    reduced: bool = False,
    restitution: float = 0.0,
    progress: Callable[[str], None] | None = None,
) -> results.Report | FreeReport:
    """Report on an open-loop simulation of a plan or of torques.

    Every contact has to hold, every phase with an end at rest has to be at rest there, and the goal
    has to be reached. A plan also has to keep every normal force above epsilon, and its replay has
    to stay near it; of torques alone a force below epsilon is a warning.

    With free contacts, no contacts are prescribed: see `verify_free`.

    Parameters
    ----------
    contacts           prescribed: those of the problem's phases; free: any
    tolerance          of the simulation
    departure          how far the replay may be from the trajectory: positions relative to the
                       scene's length (the object's radius of gyration), angles in rad
    rest_speed         largest speed of rest at the end of a phase, relative to the scene's speed
                       (the root of length times gravity); angular speeds count times the scene's
                       length
    uniqueness_margin  least uniqueness margin of contact forces (`mechanics.uniqueness`)
    reduced            whether to list the paper's scalar equation of motion along phases with four
                       constraints
    restitution        with free contacts, as progress, as of `verify_free`

    InputError if the trajectory has other contacts than the problem, or a number is out of its
    range; JammingError, SimulationError if the simulation cannot go on.
    """
    if choice("prescribed", "free").read(contacts, "contacts") == "free":
        from .free import verify_free

        values = {"tolerance": tolerance, "departure": departure, "restitution": restitution}
        return verify_free(problem, what, progress=progress, **values)
    if restitution:
        raise InputError("", "restitution", "needs contacts that are free")
    problem, torque, plan = adopt_torques(problem, what)
    allowance = Allowance(departure, rest_speed, uniqueness_margin=uniqueness_margin)
    require_same_contacts(problem, plan)
    simulation = replay_torques(problem, torque, plan, tolerance)
    report = judge(simulation, plan, allowance, tolerance, uniqueness=True, reduced=reduced)
    if report.ok and not report.warnings:
        return report
    return replace(report, help=find_help(simulation, report.phases))


def replay_torques(
    problem: Problem, torque: TorqueProfile, plan: Trajectory | None, tolerance: float = 1e-9
) -> Simulation:
    """Simulation of torques, recorded about `N_ROWS` times a phase and where forces are least.

    With a `plan` the recorded instants are some of its rows, for a comparison. JammingError,
    SimulationError if the simulation cannot go on.
    """
    from ..simulation.simulate import simulate  # not needed without a replay

    if plan is None:
        times = np.linspace(torque.breaks[0], torque.breaks[-1], N_ROWS * len(problem.phases) + 1)
    else:
        phases = (np.flatnonzero(plan.phase == index) for index in range(len(plan.motions)))
        chosen = (rows[np.linspace(0, len(rows) - 1, N_ROWS + 1).astype(int)] for rows in phases)
        times = np.concatenate([plan.t[rows] for rows in chosen])
    return simulate(problem, torque, tolerance=tolerance, times=times, minima=True)


def find_finger_gap(scene: Scene, motion: Simulation | Trajectory) -> results.FingerGap:
    """Least gap of the fingers, on quintics through the recorded states."""
    t, z = motion.t, motion.z
    starts = np.repeat(np.flatnonzero(np.diff(t) > 0), 7)
    h = np.diff(t)[starts]
    offsets = h * np.resize(np.arange(1, 8) / 8, len(h))
    interpolated = interpolate_quintic(h, offsets, (z, motion.z_dot, motion.z_ddot), starts)[0]
    times = np.append(t, t[starts] + offsets)
    order = np.argsort(times, kind="stable")
    gaps = evaluate_finger_gap(scene, np.concatenate([z, interpolated]))
    min_time = 2 * EVENT_DELAY * scene.scales.time
    return results.FingerGap(*find_lowest(times[order], gaps[order], min_time))


def judge(
    simulation: Simulation,
    plan: Trajectory | None,
    allowance: Allowance,
    tolerance: float = 1e-9,
    uniqueness: bool = False,
    reduced: bool = False,
) -> results.Report:
    """Report on a replay of a plan, or of torques alone; see `verify`.

    `uniqueness`: whether to find uniqueness margins, and static indeterminacy of starts.
    """
    problem, torque = simulation.problem, simulation.torque
    phases = tuple(
        _report_phase(simulation, plan, index, uniqueness)
        for index in range(int(simulation.phase[-1]) + 1)
    )
    gap = find_finger_gap(problem.scene, simulation) if problem.scene.fingers_collide else None
    reached, outcome = simulation.outcome.reached, simulation.outcome.text
    failures = [] if reached else [results.Failure(len(phases), outcome)]
    failures += describe_failures(simulation, phases, gap if reached else None, allowance)
    low_forces = list(describe_low_forces(simulation, phases))
    warnings = [
        f"phase {phase.number} may stay wedged for {1e3 * phase.wedged:.3g} ms: so long friction "
        "can hold everything at rest under its torques"
        for phase in phases
        if phase.wedged
    ]
    # Limits are relaxed by the allowed departure of a replay from its plan.
    allowed = LIMIT_TOLERANCE if plan is None else allowance.departure
    misses = [
        (sum(phase.start <= time for phase in phases), text)
        for time, text in describe_motors(problem, torque)
    ]
    for phase in problem.phases[: len(phases)]:
        misses += [(phase.number, text) for text in describe_excess(phase, simulation, allowed)]
    if plan is not None:
        failures += [results.Failure(max(number, 1), text) for number, text in misses]
        # The departure of later phases follows from that of the first.
        failures += low_forces + list(describe_departures(problem, phases, allowance))[:1]
    else:
        warnings += [text for _, text in misses] + [failure.text for failure in low_forces]
    return results.Report(
        name=problem.name,
        epsilon=problem.epsilon,
        outcome=outcome,
        reached=reached,
        missed_by=simulation.missed_by,
        failures=tuple(failure.text for failure in failures),
        failed_phase=failures[0].phase if failures else None,
        warnings=tuple(warnings),
        phases=phases,
        energy=_balance(simulation),
        finger_gap=gap,
        tolerance=tolerance,
        steps=simulation.steps,
        changes=tuple(
            results.ModeChange(float(e.time), e.phase + 1, e.contact, _CHANGES[e.kind])
            for e in simulation.find(*_CHANGES)
            if e.contact
        ),
        reduced=list_reduced_states(simulation) if reduced else (),
        replay=simulation,
    )


def _report_phase(
    simulation: Simulation, plan: Trajectory | None, index: int, uniqueness: bool
) -> results.PhaseReport:
    problem, phase = simulation.problem, simulation.problem.phases[index]
    rows = np.flatnonzero(simulation.phase == index)
    arrivals = simulation.find(EventKind.ARRIVAL, EventKind.RELEASE, phase=index)
    impacts = simulation.find(EventKind.IMPACT, phase=index)
    formation, until = phase.formation, str(phase.until)
    if arrivals and phase.until.is_release:
        what = "release" if arrivals[0].kind is EventKind.RELEASE else "change"
        until = f"{what} of {arrivals[0].contact}"
    forces = list_normal_forces(simulation, phase)
    normal = _find_least(simulation, index, forces, EventKind.CONTACT_LOST)
    columns = [simulation.contacts.index(name) for name in formation.names]
    c_n, c_t = (c[rows][:, columns] for c in (simulation.c_n, simulation.c_t))
    margins = {
        formation.names[row]: formation.friction[row] * c_n[:, row] - np.abs(c_t[:, row])
        for row in formation.rolling_rows
    }
    slip_margins = _find_least(simulation, index, margins, EventKind.SLIP)
    end_deviation = deviation = stuck = uniqueness_margin = None
    if uniqueness:
        # From the start of its motion on, if it moves.
        starts = [e.time for e in simulation.find(EventKind.START, phase=index)]
        stuck = find_stuck(problem, phase, simulation, REST_SPEED, *starts[:1])
        uniqueness_margin = find_uniqueness_margin(phase, simulation, rows)
    if plan is not None:
        end_deviation, deviation = _compare(simulation, plan, phase, bool(arrivals))
    last_speed = measure_speed(problem.scene, simulation.z_dot[rows[-1]])
    return results.PhaseReport(
        number=phase.number,
        until=until,
        end=phase.end.value,
        start=float(simulation.t[rows[0]]),
        contacts=tuple(results.ContactMargin(*each, each[1] - problem.epsilon) for each in normal),
        rolling=tuple(results.SlipMargin(*slip) for slip in slip_margins),
        arrival=arrivals[0].time if arrivals else None,
        arrival_rate=arrivals[0].value if arrivals and not phase.until.is_release else None,
        end_speed=last_speed if arrivals and phase.end is End.REST else None,
        impact=results.LeastImpulse(impacts[0].contact, impacts[0].value) if impacts else None,
        end_deviation=end_deviation,
        deviation=deviation,
        uniqueness_margin=uniqueness_margin,
        wedged=stuck,
    )


def _compare(
    simulation: Simulation, plan: Trajectory, phase: Phase, arrived: bool
) -> tuple[Deviation | None, Deviation | None]:
    """Difference from the plan at the end of a phase, and the largest one in it."""
    planned, length = np.flatnonzero(plan.phase == phase.index), phase.formation.scene.scales.length
    if not len(planned):
        return None, None
    rows = np.minimum(np.searchsorted(simulation.t, plan.t[planned]), len(simulation.t) - 1)
    recorded = simulation.t[rows] == plan.t[planned]
    difference = (simulation.z[rows] - plan.z[planned])[recorded]
    worst = _measure(difference, plan.t[planned][recorded], length)
    if not arrived:
        return None, worst
    last = int(np.flatnonzero(simulation.phase == phase.index)[-1])
    # A motion that does not end at rest is compared at the planned end of its phase.
    if phase.end is not End.REST and recorded[-1]:
        last = int(rows[-1])
    difference = simulation.z[[last]] - plan.z[planned[-1:]]
    return _measure(difference, simulation.t[[last]], length), worst


def _measure(difference: Array, t: Array, length: float) -> Deviation:
    """Largest of differences of z, shape (n, 5), at times `t`; NaN if there are none."""
    if not len(t):
        return Deviation(math.nan, math.nan, math.nan)
    position, angle = (np.abs(part).max(axis=1) for part in np.split(difference, [2], axis=1))
    time = float(t[np.maximum(position / length, angle).argmax()])
    return Deviation(float(position.max()), float(angle.max()), time)


def _balance(simulation: Simulation) -> results.EnergyBalance:
    scene, energies = simulation.problem.scene, simulation.energies
    ends = simulation.z_dot[[0, -1]]
    kinetic = float(np.diff(0.5 * ends**2 @ scene.mass_diagonal)[0])
    potential = float(scene.weight * (simulation.z[-1, 1] - simulation.z[0, 1]))
    work, viscous, dry, contact, impact, residual = (
        float(part[-1]) for part in (*energies[1:], energies.residual)
    )
    losses = viscous, dry, contact, impact
    scale = abs(work) + abs(kinetic) + abs(potential) + sum(map(abs, losses))
    # Without motion all terms are rounding errors of closing the contacts at the start.
    rounding = 1e-12 * scene.scales.force * scene.scales.length
    relative = abs(residual) / scale if scale > rounding else 0.0
    return results.EnergyBalance(work, kinetic, potential, *losses, residual, relative)


def list_normal_forces(simulation: Simulation, phase: Phase) -> dict[str, Array]:
    """Normal forces by contact in a phase [N].

    The force of a contact that is released without a jump of the torques falls to zero: values
    below epsilon before the release are NaN.
    """
    releases = simulation.find(EventKind.RELEASE, phase=phase.index)
    released = {name for event in releases for name in event.contact.split(", ")}
    forces = {}
    for name in phase.formation.names:
        values = simulation.c_n[simulation.phase == phase.index, simulation.contacts.index(name)]
        above = np.flatnonzero(values >= simulation.problem.epsilon)
        if name in released and len(above) and values[-1] < simulation.problem.epsilon / 2:
            values[above[-1] + 1 :] = math.nan
        forces[name] = values
    return forces


def _find_least(
    simulation: Simulation, index: int, series: dict[str, Array], kind: EventKind
) -> Iterator[tuple[str, float, float]]:
    """Least value of each contact and its time, including values at events of this kind."""
    t = simulation.t[simulation.phase == index]
    events = {e.contact: e for e in simulation.find(kind, phase=index)}
    for name, values in series.items():
        has_values = not np.isnan(values).all()
        row = int(np.nanargmin(values)) if has_values else 0
        least, time = float(values[row]), float(t[row]) if has_values else math.nan
        if name in events and not least <= events[name].value:
            least, time = events[name].value, events[name].time
        yield name, least, time


def describe_excess(
    phase: Phase, simulation: Simulation, allowed: float, span: tuple[float, float] | None = None
) -> list[str]:
    """Sentences on limits that a phase exceeds by `allowed` of their scale, in a `span` [s].

    Limits of contact forces and of torques are left out.
    """
    formation, t = phase.formation, simulation.t
    inside = simulation.phase == phase.index
    rows = np.flatnonzero(inside if span is None else (span[0] <= t) & (t <= span[1]))
    limits, t = make_limits(formation, 0.0).without(PRESS, CONE, TORQUE), t[rows]
    if not limits.limits or not len(rows):
        return []
    columns = [simulation.contacts.index(name) for name in formation.names]
    rolling = [columns[row] for row in formation.rolling_rows]
    c = [simulation.c_n[rows][:, columns], simulation.c_t[rows][:, rolling]]
    y = np.nan_to_num(np.hstack([*c, simulation.torque.at(t), simulation.z_dot[rows, 3:]]))
    return [
        f"{limit.text} is exceeded by {amount:.3g} {limit.unit} at t = {t[worst]:.5g} s, phase "
        f"{phase.number}"
        for limit, amount, worst in limits.list_violated(y @ limits.rows.T, allowed)
    ]


def find_commands(torque: TorqueProfile, lag: Array) -> TorqueProfile:
    """Motor commands tau + lag tau' of torques, for lags of shape (2,) [s]."""
    change = lag[:, None] * torque.slopes.coefficients
    return TorqueProfile(torque.breaks, torque.coefficients + change)


def describe_motors(
    problem: Problem, torque: TorqueProfile, period: float = 0.0
) -> list[tuple[float, str]]:
    """Violations of motor limits: of each kind the time of the worst one [s], and a sentence.

    Torques that are constant over a `period` [s] may step by their largest change in it.
    """
    scene, x = problem.scene, np.linspace(-1, 1, 33)
    torques, slopes = torque.at_places(x), torque.slopes.at_places(x)
    commands = torques + scene.actuator_lag[:, None] * slopes
    spans = np.diff(torque.breaks)[:, None]
    times = torque.breaks[:-1, None] + spans * (1 + x) / 2
    misses = list[tuple[float, str]]()
    limits = zip(scene.torque_limit, scene.torque_rate_limit, scene.actuator_lag, strict=True)
    for joint, (limit, rate, lag) in enumerate(limits):
        # An excess of a rate is ignored if its integral over the piece is less than `step`. Case:
        # phase 2 of new polygon 36 of seed 51, with pieces of 1 us.
        step, limited = 1e-5 * limit, f"where its rate limit is {rate:g} N m/s"
        reason = limited if np.isfinite(rate) else "where its motor lags"
        fast, high = f"above its rate limit {rate:g} N m/s", f"above its limit {limit:g} N m"
        kinds = [(torques, times, (1 + LIMIT_TOLERANCE) * limit, "reaches {:.3g} N m", high)]
        if np.isfinite(rate) or lag:
            max_slope = min(rate, 2 * limit / lag) if lag else rate
            step_limit = max(step, 1.001 * max_slope * period)
            kinds += [
                (torque.jumps, torque.breaks[1:-1], step_limit, "steps by {:.3g} N m", reason),
                (slopes, times, 1.001 * rate + step / spans, "changes at {:.4g} N m/s", fast),
                (commands, times, 1.001 * limit, "takes a command of {:.4g} N m", high),
            ]
        for values, when, bound, action, comparison in kinds:
            sizes = np.abs(values[:, joint])
            excess = (sizes - bound).ravel()
            if excess.max(initial=0.0) > 0:
                worst = int(excess.argmax())
                t, size = float(when.ravel()[worst]), action.format(sizes.ravel()[worst])
                misses.append((t, f"tau_{joint + 1} {size} at t = {t:.5g} s, {comparison}"))
    return misses


def max_deficit(problem: Problem) -> float:
    """Tolerated deficit of normal forces of a plan below epsilon, rounding included [N]."""
    return 5e-7 * problem.scene.scales.force + DEFICIT * problem.epsilon


def measure_speed(scene: Scene, v: Array) -> float:
    """Largest speed in z', shape (5,) [m/s]: angular ones count times the scene's length."""
    length = scene.scales.length
    return max(math.hypot(v[0], v[1]), length * float(np.abs(v[2:]).max()))


def describe_failures(
    simulation: Simulation,
    phases: Sequence[results.PhaseReport],
    gap: results.FingerGap | None,
    allowance: Allowance,
) -> Iterator[results.Failure]:
    """Ends at other places or not at rest, links that overlap, contact forces not unique."""
    problem, scene = simulation.problem, simulation.problem.scene
    for event in simulation.find(EventKind.ARRIVAL):
        phase = problem.phases[event.phase]
        first, row = np.flatnonzero(simulation.phase == event.phase)[[0, -1]].tolist()
        z, v = simulation.z[row], simulation.z_dot[row]
        until = phase.until.lead(simulation.z[first], scene.scales.length)
        if until.measure_pins(z, scene.scales.length) > allowance.departure:
            text = f"phase {phase.number} ends at {describe_pose(z)}, and not with {phase.until}"
            yield results.Failure(phase.number, text)
        moving = measure_speed(scene, v) > allowance.rest_speed * scene.scales.speed
        if phase.end is End.REST and moving:
            speed, rates = math.hypot(v[0], v[1]), np.abs(v[2:])
            fastest, energy = int(rates.argmax()), 0.5 * float(scene.mass_diagonal @ v**2)
            motion = f"the object moves at {speed:.3g} m/s"
            if scene.scales.length * rates[fastest] > speed:
                body = ("the object", "finger 1", "finger 2")[fastest]
                motion = f"{body} turns at {rates[fastest]:.3g} rad/s"
            unit = EndDistance(scene, until, simulation.z[first]).unit
            text = (
                f"phase {phase.number} does not end at rest: {phase.until} is reached at "
                f"{event.value:.3g} {unit}/s at t = {event.time:.5g} s, while {motion}, with "
                f"{energy:.3g} J left"
            )
            yield results.Failure(phase.number, text)
    # Less than this is touching within rounding.
    if gap is not None and gap.least < -3e-5 * scene.scales.length:
        number = [phase.number for phase in phases if phase.start <= gap.time][-1]
        text = f"{FINGERS_TOUCH} at t = {gap.time:.5g} s: they overlap by {-gap.least:.3g} m"
        yield results.Failure(number, f"{text}, phase {number}")
    for report in phases:
        least = report.uniqueness_margin
        # The margin of a replay may be a little less than that of its plan.
        if least is not None and least.value < allowance.uniqueness_margin - 1e-3:
            place = describe_pose(simulation.z[np.searchsorted(simulation.t, least.time)])
            required = allowance.uniqueness_margin
            text = describe_uniqueness(least.value, least.contacts, place, required)
            yield results.Failure(
                report.number, f"{text}, at t = {least.time:.5g} s, phase {report.number}"
            )


def describe_departures(
    problem: Problem, phases: Sequence[results.PhaseReport], allowance: Allowance
) -> Iterator[results.Failure]:
    """Sentences on the phases whose replay is too far from the plan."""
    length, allowed = problem.scene.scales.length, allowance.departure
    for phase in phases:
        deviations = [d for d in (phase.deviation, phase.end_deviation) if d is not None]
        largest = max(deviations, key=lambda d: d.measure(length), default=None)
        if largest is not None and largest.measure(length) > allowed:
            text = (
                f"phase {phase.number} departs from the plan, by {largest.position:.2g} m and "
                f"{largest.angle:.2g} rad at t = {largest.time:.5g} s; {allowed * length:.2g} "
                f"m and {allowed:.2g} rad are allowed"
            )
            yield results.Failure(phase.number, text)


def describe_low_forces(
    simulation: Simulation, phases: Sequence[results.PhaseReport]
) -> Iterator[results.Failure]:
    """Sentences on normal forces below epsilon, without those of lost contacts."""
    problem = simulation.problem
    lost = {(e.phase + 1, e.contact) for e in simulation.find(EventKind.CONTACT_LOST)}
    for phase in phases:
        for c in phase.contacts:
            thin = c.margin < -max_deficit(problem)
            if thin and (phase.number, c.contact) not in lost:
                text = f"below epsilon = {problem.epsilon:g} N, at t = {c.time:.5g} s"
                text = f"c_n of {c.contact} falls to {c.least:.5g} N, {text}, phase {phase.number}"
                yield results.Failure(phase.number, text)


def find_uniqueness_margin(
    phase: Phase, motion: Trajectory | Simulation, rows: Numbers
) -> results.UniquenessMargin | None:
    """The least uniqueness margin in a phase; None if nothing moved.

    Contacts slide where forces are on a side of their cones, and stick elsewhere. Forces within
    cones at rest do not count: they are statically indeterminate, see `find_stuck`. `rows` are
    those of the motion in the phase.
    """
    formation, rows = phase.formation, rows[:: -(-len(rows) // N_INSTANTS)]
    scene, z_dot = formation.scene, motion.z_dot[rows]
    columns = [motion.contacts.index(name) for name in formation.names]
    c_n, c_t = (forces[rows][:, columns] for forces in (motion.c_n, motion.c_t))
    slides = np.abs(c_t) >= (1 - 1e-6) * formation.friction * np.abs(c_n)
    # Case: phase 9 of query 44 under rate limits.
    moving = [measure_speed(scene, v) > EXACT_REST * scene.scales.speed for v in z_dot]
    counted = ~np.isnan(c_n).any(axis=1) & (np.array(moving) | slides.all(axis=1))
    if not counted.any():
        return None
    rows, slides, Xi = rows[counted], slides[counted], -np.sign(c_t * c_n)[counted]
    kinematics = formation.evaluate(motion.z[rows], z_dot[counted])
    margins = []
    for pattern in sorted(set(map(tuple, slides.tolist()))):
        selected = np.flatnonzero((slides == pattern).all(axis=1))
        part = kinematics.pick(selected)
        sticking = tuple(np.flatnonzero(np.logical_not(pattern)).tolist())
        ratio, names, row = find_minors(formation, part, Xi[selected], sticking).find_least()
        margins.append(results.UniquenessMargin(ratio, names, float(motion.t[rows[selected[row]]])))
    return min(margins)


def find_stuck(
    problem: Problem, phase: Phase, motion: Trajectory | Simulation, rest: float, start: float = 0.0
) -> float | None:
    """Time for which friction may hold a phase that begins at rest (static indeterminacy) [s].

    It ends when no forces within the cones of all closed contacts balance torques and gravity: see
    `mechanics.statics`. None if the phase does not begin at rest.

    Parameters
    ----------
    rest         largest speed of rest, relative to the scene's
    start : [s]  start of the motion: before it the phase may be at rest while torques change
    """
    scene, contacts = problem.scene, phase.formation.contacts
    rows = np.flatnonzero(motion.phase == phase.index)
    if phase.index:
        if measure_speed(scene, motion.z_dot[rows[0]]) > rest * scene.scales.speed:
            return None
        contacts += problem.phases[phase.index - 1].formation.contacts
    touching = Formation(scene, tuple(dict.fromkeys(contacts)))
    polygon = Statics(touching, motion.z[rows[0]]).torque_polygon()
    start, stop = max(start, float(motion.t[rows[0]])), float(motion.t[rows[-1]])
    breaks = motion.torque.breaks
    inner = breaks[(breaks > start) & (breaks < stop)]
    t = sort_unique(np.concatenate([np.linspace(start, stop, 4 * N_INSTANTS), inner]))
    # At the end of the phase the torques are those of the next one: that instant is left out.
    excess = polygon.measure(motion.torque.at(t[:-1])) - SURE * scene.scales.torque
    free = np.flatnonzero(excess > 0)
    if not len(free):
        return float(stop - start)
    if free[0] == 0:
        return 0.0
    before, after = excess[free[0] - 1], excess[free[0]]
    t_before, t_after = t[free[0] - 1 : free[0] + 1] - start
    stuck = float(t_after - after / (after - before) * (t_after - t_before))
    return stuck if stuck > EVENT_DELAY * scene.scales.time else 0.0


_ELIMINATED = [0, 1, 2, 4]  # degrees of freedom that are eliminated: q and theta_2


def list_reduced_states(simulation: Simulation) -> tuple[results.ReducedState, ...]:
    """The scalar equation at up to five instants of every phase with four constraints.

    At these instants theta_1' and the speeds of all sliding contacts are not zero.
    """
    problem, states = simulation.problem, []
    for index in range(int(simulation.phase[-1]) + 1):
        formation, rows = problem.phases[index].formation, np.flatnonzero(simulation.phase == index)
        if formation.n_constraints != 4:
            continue
        motion = simulation.z, simulation.z_dot, simulation.z_ddot, simulation.tau
        z, v, a, tau = (part[rows] for part in motion)
        slip_rates = (formation.evaluate(z, v).A_t @ v[:, :, None])[:, :, 0]
        sliding = [k for k in range(formation.n_contacts) if k not in formation.rolling_rows]
        scales = problem.scene.scales
        speeds = np.hstack([slip_rates[:, sliding], scales.length * v[:, 3:]])
        moving = np.flatnonzero(np.abs(speeds).min(axis=1) > 1e-4 * scales.speed)
        chosen = np.linspace(0, len(moving) - 1, min(5, len(moving))).round().astype(int)
        for k in moving[chosen].tolist():
            directions = Directions(np.sign(slip_rates[k]), np.sign(v[k, 3:]))
            Phi = reduce_to_first_joint(formation, z[k], v[k, 3], tau[k], directions)
            time, joint = float(simulation.t[rows[k]]), (float(v[k, 3]), float(a[k, 3]))
            states.append(results.ReducedState(time, index + 1, *Phi, *joint))
    return tuple(states)


def reduce_to_first_joint(
    formation: Formation, z: Array, theta_1_dot: float, tau: Array, directions: Directions
) -> tuple[float, float, float]:
    """Phi_1 [kg m^2], Phi_2 [N m s] and Phi_3 [N m] of a formation with four constraints.

    Eqs. (6)-(9) give (q', theta_2') = -P_AI^+ P_AII theta_1'. The equations of q and theta_2 give
    the contact forces, and that of theta_1 becomes the scalar equation. The pseudoinverse keeps the
    formula defined where P_AI is singular. Where theta_1 is stationary, the motion is not a
    multiple of theta_1' and the formula does not hold. Configuration z is (5,), theta_1' in rad/s,
    tau (2,) [N m]; directions are the signs of friction.
    """
    scene = formation.scene

    def extend(rows: Array, values: Array, first: float) -> Array:
        """Solution x, (5,), of rows @ x = right with component `first` of the first joint."""
        rest = np.linalg.pinv(rows[:, _ELIMINATED]) @ (values - rows[:, 3] * first)
        return np.insert(rest, 3, first)

    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0]
    slope = extend(P, np.zeros(4), 1.0)
    kinematics = formation.evaluate(z[None], slope[None])
    curvature = extend(P, -kinematics.P_dot_v[0], 0.0)
    # Weights with which the sum of the rows of M5 z'' + b - g - S tau = G^T c has no forces c.
    weights = extend(force_rows(formation, kinematics, directions)[0], np.zeros(4), 1.0)
    mass = scene.mass_diagonal
    static = -scene.applied_force
    static[3:] += scene.dry[3:] * directions.sigma - tau
    terms = mass * slope, mass * curvature * theta_1_dot + scene.viscous * slope, static
    Phi_1, Phi_2, Phi_3 = (float(term @ weights) for term in terms)
    return Phi_1, Phi_2, Phi_3


SLACK_TOLERANCE = 1e-9  # tolerance of the slack of a limit, over its scale
SLOPE_TOLERANCE = 1e-9  # slope of a slack by a torque that counts as zero, both over their scales
_TORQUES = ((0,), (1,), (0, 1))  # torques that change: one alone, or both
_KINDS = {EventKind.CONTACT_LOST: "lost", EventKind.SLIP: "slips"}


def find_help(
    simulation: Simulation, phases: tuple[results.PhaseReport, ...]
) -> results.TuningHelp:
    """Losses with changes of the torques that prevent them, and the approach to a missed end."""
    problem = simulation.problem
    rolling = [{contact.name for contact in phase.formation.rolling} for phase in problem.phases]
    events = [
        (e.phase, e.contact, _KINDS[e.kind], e.time)
        for e in simulation.find(*_KINDS)
        if e.kind is not EventKind.SLIP or e.contact in rolling[e.phase]
    ]
    lost = {event[:2] for event in events}
    tolerance = max_deficit(problem)
    events += [
        (phase.number - 1, margin.contact, "thin", margin.time)
        for phase in phases
        for margin in phase.contacts
        if margin.margin < -tolerance and (phase.number - 1, margin.contact) not in lost
    ]
    losses = (_advise_on_loss(simulation, *event) for event in events)
    approach = None if simulation.outcome.reached else find_approach(simulation)
    return results.TuningHelp(tuple(loss for loss in losses if loss is not None), approach)


def _advise_on_loss(
    simulation: Simulation, index: int, contact: str, kind: str, time: float
) -> results.Loss | None:
    """A loss with changes that prevent it; None if the phase does not have the contact."""
    problem, phase = simulation.problem, simulation.problem.phases[index]
    formation, rows = phase.formation, np.flatnonzero(simulation.phase == index)
    if contact not in formation.names:
        return None
    # The last row before the loss, or the row of the least force.
    if kind == "thin":
        row = int(rows[np.nanargmin(simulation.c_n[rows, simulation.contacts.index(contact)])])
    else:
        row = int(rows[simulation.t[rows] <= time][-1])
    z, v, tau = simulation.z[row], simulation.z_dot[row], simulation.tau[row]
    load, epsilon = [1.0, *tau], max(problem.epsilon, 1e-3 * problem.scene.scales.force)
    distance = None
    if not phase.until.is_release:
        end = EndDistance.to_leading(problem.scene, phase.until, simulation.z[rows[0]])
        distance = end.evaluate(z[None], v[None])
    columns = [simulation.contacts.index(name) for name in formation.names]
    at_rest = bool(np.isnan(simulation.c_n[row, columns]).all())
    if at_rest:
        rest = modes.Rest(formation, z)
        free = [path for path in rest.list_modes() if path.slides(tau)]
        worst = min(free, key=lambda path: float((path.force_limits @ load).min()), default=None)
        response = None if worst is None else worst.response
        gradient = None if distance is None else distance[1][0]
        changes = find_resting_changes(rest, epsilon, tau, gradient)
    else:
        response = find_moving_response(formation, z, v, tau, simulation.z_ddot[row])
        changes = () if response is None else list_changes(response, v, epsilon, contact, tau)
    forces: tuple[results.ForceAt, ...] = ()
    closing: tuple[float, ...] = ()
    if response is not None:
        forces = tuple(
            results.ForceAt(
                name, float(c_n @ load), float(c_t @ load), (float(c_n[1]), float(c_n[2]))
            )
            for name, c_n, c_t in zip(formation.names, response.c, response.c_t, strict=False)
        )
        if distance is not None:
            slope = -distance[1][0] @ response.acceleration
            closing = (float(slope @ load - distance[2][0]), float(slope[1]), float(slope[2]))
    instant = float(simulation.t[row])
    return results.Loss(phase.number, contact, kind, instant, at_rest, forces, closing, changes)


def list_changes(
    response: modes.Response, v: Array, epsilon: float, contact: str, tau: Array
) -> tuple[results.TorqueAdvice, ...]:
    """Least changes of each torque alone, or of both, with which a moving contact is kept.

    Both change if one alone violates other limits. Contacts that open at the same time are kept,
    too. Violations of other limits must not grow.
    """
    formation = response.mode.formation
    unit, load = formation.scene.scales.torque, np.array([1.0, *tau])
    limits, zero_limits = make_limits(formation, epsilon), make_limits(formation, 0.0)
    rows, forces = limits.sides[0], (PRESS, CONE)
    owners, scale = limits.owners[rows], limits.scales[rows]
    contact_limits = [limit.part == contact and limit.kind in forces for limit in limits.limits]
    opening = find_sides(zero_limits, response, v) @ load < -SLACK_TOLERANCE * scale
    required = np.array(contact_limits)[owners] | (opening & np.isin(rows, limits.of(*forces)))
    slack, slope = scale_slack(find_sides(limits, response, v), scale, tau, unit)
    slack = np.where(required, slack, np.maximum(slack, 0.0))

    def describe(change: Array) -> results.TorqueAdvice:
        short = -(slack + slope @ change)
        worst, but = int(short.argmax()), ""
        if short[worst] > SLACK_TOLERANCE:
            limit = limits.limits[owners[worst]]
            but = f"{limit.text} is {short[worst] * scale[worst]:.3g} {limit.unit} short"
        return make_advice(unit * change, tau, but)

    short = slack < 0
    # A change of one torque may violate other limits; the worst of these is named with it.
    singles = [find_least_change(slack[short], slope[short], one) for one in _TORQUES[:2]]
    changes = [describe(one) for one in singles if one is not None]
    both = None
    if all(change.but for change in changes):
        both = find_least_change(slack, slope, _TORQUES[2])
    changes += [] if both is None else [describe(both)]
    return tuple(sorted(changes, key=lambda change: (bool(change.but), np.hypot(*change.change))))


def find_approach(simulation: Simulation) -> results.Approach | None:
    """Least distance of the last phase from its end; None if it ends by a release."""
    problem = simulation.problem
    phase, scales = problem.phases[int(simulation.phase[-1])], problem.scene.scales
    rows = np.flatnonzero(simulation.phase == phase.index)
    if phase.until.is_release:
        return None
    t, z, v = simulation.t[rows], simulation.z[rows], simulation.z_dot[rows]
    end = EndDistance.to_leading(problem.scene, phase.until, z[0])
    gaps, gradient, _ = end.evaluate(z, v)
    rates = -np.einsum("ni,ni->n", gradient, v)
    least, time = find_lowest(t, gaps)
    unit = scales.rate if end.unit == "rad" else scales.speed
    moving = np.flatnonzero(np.abs(rates) > 1e-6 * unit)
    reversals = moving[np.flatnonzero(np.diff(np.sign(rates[moving])))]
    return results.Approach(
        phase=phase.number,
        until=str(phase.until),
        distance=max(least, 0.0),
        unit=end.unit,
        time=time,
        rate=float(np.interp(time, t, rates)) + 0.0,
        turns=tuple(float(t[row]) for row in reversals),
    )


def find_resting_changes(
    rest: modes.Rest, epsilon: float, tau: Array, gradient: Array | None
) -> tuple[results.TorqueAdvice, ...]:
    """Least changes of each torque alone, or else of both, with which contacts at rest are kept.

    With them motion begins towards the end of the phase, or if that is impossible, rest is kept.

    Parameters
    ----------
    epsilon : [N]
    tau : (2,) [N m]
    gradient : (5,)   of the distance to the end of the phase, if it is not a release
    """
    limits, unit = make_limits(rest.formation, epsilon), rest.formation.scene.scales.torque
    starts = list[tuple[modes.StartMode, tuple[Array, Array]]]()
    for path in rest.list_modes():
        progress = [] if gradient is None else [-gradient @ path.response.acceleration]
        rows = np.vstack([path.margins, *progress])
        magnitudes = np.abs(rows) @ [1.0, unit, unit]
        scale = [limits.side_scales, np.where(magnitudes > 0, magnitudes, 1.0)]
        sides = np.vstack([find_sides(limits, path.response, np.zeros(5)), rows])
        slack, slope = scale_slack(sides, np.concatenate(scale), tau, unit)
        slack[len(slack) - len(progress) :] -= SURE  # the acceleration has to be positive
        starts.append((path, (slack, slope)))
    changes: list[results.TorqueAdvice] = []
    for torques in _TORQUES:
        if len(torques) == 2 and not all(change.holds for change in changes):
            break
        solutions = ((path, find_least_change(*sides, torques)) for path, sides in starts)
        least = [(path, unit * change) for path, change in solutions if change is not None]
        moving = [change for path, change in least if path.moves(tau + change)]
        holding = None if moving else rest.find_holding_change(tau, epsilon, torques)
        if moving:
            changes.append(make_advice(min(moving, key=np.linalg.norm), tau))
        elif holding is not None and (len(torques) == 1 or not changes):
            changes.append(make_advice(holding, tau, holds=True))
    return tuple(sorted(changes, key=lambda change: (change.holds, np.hypot(*change.change))))


def find_sides(limits: LimitSet, response: modes.Response, v: Array) -> Array:
    """Slack of one-sided limits at velocity v, (5,), rows @ (1, tau_1, tau_2), (n_sides, 3)."""
    formation = response.mode.formation
    forces = response.c[: formation.n_contacts], response.c_t[list(formation.rolling_rows)]
    y = np.vstack([*forces, np.eye(3)[1:], np.column_stack([v[3:], np.zeros((2, 2))])])
    return limits.find_slack_rows(limits.rows @ y)


def find_moving_response(
    formation: Formation, z: Array, v: Array, tau: Array, acceleration: Array
) -> modes.Response | None:
    """The response in the contact mode of a motion.

    Units at rest have the mode in which torques `tau` best give the `acceleration`, shape (5,).
    """
    scene, rows = formation.scene, modes.evaluate_rows(formation, z, v)
    speeds = rows.A_t @ v
    units = np.repeat([scene.scales.speed, scene.scales.rate], [formation.n_contacts, 2])
    at_rest = np.abs(speeds) < 1e-6 * units
    signs = np.sign(speeds)
    signs[list(formation.rolling_rows)] = 0.0
    resting = [unit for unit in modes.list_units(formation) if at_rest[list(unit.rows)].all()]
    candidates = modes.list_modes(formation, signs, resting, formation.n_constraints < 4)
    responses = (modes.respond(mode, rows, v) for mode in candidates)

    def misfit(each: modes.Response) -> float:
        difference = each.acceleration @ [1.0, *tau] - acceleration
        return float(scene.mass_diagonal @ difference**2)

    return min((each for each in responses if each is not None), key=misfit, default=None)


def scale_slack(sides: Array, scale: Array, tau: Array, unit: float) -> tuple[Array, Array]:
    """Slack under torques `tau` and its slope, (n,) and (n, 2), over the scales of each."""
    slack = sides @ np.array([1.0, *tau]) / scale
    return np.asarray(slack), sides[:, 1:] * (unit / scale)[:, None]


def make_advice(
    change: Array, tau: Array, but: str = "", holds: bool = False
) -> results.TorqueAdvice:
    """Advice on a change of torques `tau`, shape (2,) [N m]."""
    (first, second), (tau_1, tau_2) = change.tolist(), (tau + change).tolist()
    return results.TorqueAdvice((first, second), (tau_1, tau_2), but, holds)


def find_least_change(slack: Array, slope: Array, free: tuple[int, ...]) -> Array | None:
    """The shortest change of the torques `free`, (2,), with slack + slope @ change >= 0, or None.

    Enumeration of candidates: zero, the nearest point of each side, the corner of each pair.
    """
    slopes = slope * np.isin([0, 1], free)
    sizes = np.linalg.norm(slopes, axis=1)
    active = sizes > SLOPE_TOLERANCE
    normal, distance = slopes[active] / sizes[active, None], slack[active] / sizes[active]
    changes = [np.zeros(2), *(-distance[:, None] * normal)]
    for i, j in combinations(range(len(distance)), 2):
        pair = normal[[i, j]]
        if abs(np.linalg.det(pair)) > SLOPE_TOLERANCE:
            changes.append(np.linalg.solve(pair, -distance[[i, j]]))
    feasible = [change for change in changes if (slack + slopes @ change >= -SLACK_TOLERANCE).all()]
    return min(feasible, key=np.linalg.norm, default=None)
