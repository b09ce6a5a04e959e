"""Verification of torques by open-loop replay: margins between nodes, goal, deviation, energy."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from ..common.arrays import Array, Numbers, find_lowest, sort_unique
from ..common.errors import InputError
from ..common.fields import POSITIVE, declare, key, read_keys
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
from ..simulation.system import SETTLING

if TYPE_CHECKING:
    from .free import FreeReport

REST_SPEED = 2e-2  # speed at the end of a phase that passes for rest, relative to the scene's speed
STRAY = 2e-3  # how far normal forces of a plan may fall below epsilon, over epsilon
EXACT_REST = 1e-9  # speed of rest but for rounding, relative to the scene's speed
PLACES = 33
"""Instants of a phase at which uniqueness margins are looked at, and at which torques are."""
MISSED = 1e-6  # miss of a limit, over what is much for it, from which on it is reported
ROWS = 20
"""About how many rows of each phase of a trajectory its replay is compared with; without one, about
how many even parts of each phase are looked at."""
_CHANGES = {EventKind.STICK: "sticks", EventKind.SLIP: "slips", EventKind.REVERSAL: "reverses"}


@declare(key("departure", kind=POSITIVE), key("rest_speed", kind=POSITIVE), UNIQUENESS)
@dataclass(frozen=True)
class Allowance:
    """What a replay may differ by from what is asked and still hold.

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
    problem: Problem, what: Torques, *, contacts: Literal["free"], **options: Any
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
    **options: Any,
) -> results.Report | FreeReport:
    """Simulate the torques of a plan, or given ones, open loop and report what happens.

    Every contact has to hold, every phase with an end at rest has to be at rest there, and the goal
    has to be reached. A plan has to keep every normal force above epsilon, too, and its
    replay has to stay near it; of torques alone a force below epsilon is a warning.

    With free contacts, none is assumed: see `verify_free`.

    Parameters
    ----------
    contacts           prescribed: those of the problem's phases; free: any
    tolerance          of the simulation
    departure          how far the replay may be from the trajectory: positions relative to the
                       scene's length (the object's radius of gyration), angles in rad
    rest_speed         speed at the end of a phase that passes for rest, relative to the scene's
                       speed (the root of length times gravity); angular speeds count times the
                       scene's length
    uniqueness_margin  least uniqueness margin of contact forces (`mechanics.uniqueness`)
    reduced            whether to list the paper's scalar equation of motion along phases with four
                       constraints

    InputError if the trajectory has other contacts than the problem, or a number is out of its
    range; JammingError, SimulationError if the simulation cannot go on.
    """
    if contacts == "free":
        from .free import verify_free

        return verify_free(problem, what, tolerance=tolerance, departure=departure, **options)
    if contacts != "prescribed" or options:
        text = f"{', '.join(options)} needs free ones" if options else f"{contacts!r} given"
        raise InputError("", "contacts", f"{text}; allowed are prescribed and free")
    problem, torque, plan = adopt_torques(problem, what)
    allowance = Allowance(departure, rest_speed, uniqueness_margin=uniqueness_margin)
    require_same_contacts(problem, plan)
    simulation = observe(problem, torque, plan, tolerance)
    report = judge(simulation, plan, allowance, tolerance, uniqueness=True, reduced=reduced)
    if report.ok and not report.warnings:
        return report
    return replace(report, help=find_help(simulation, report.phases))


def observe(
    problem: Problem, torque: TorqueProfile, plan: Trajectory | None, tolerance: float = 1e-9
) -> Simulation:
    """Replay torques, and record forces where they are least and about `ROWS` times a phase.

    With a `plan` that is where it has rows, to compare it with. JammingError, SimulationError if
    the simulation cannot go on.
    """
    from ..simulation.simulate import simulate  # not needed without a replay

    if plan is None:
        times = np.linspace(torque.breaks[0], torque.breaks[-1], ROWS * len(problem.phases) + 1)
    else:
        owned = (np.flatnonzero(plan.phase == index) for index in range(len(plan.motions)))
        picked = (rows[np.linspace(0, len(rows) - 1, ROWS + 1).astype(int)] for rows in owned)
        times = np.concatenate([plan.t[rows] for rows in picked])
    return simulate(problem, torque, tolerance=tolerance, times=times, minima=True)


def find_finger_gap(scene: Scene, motion: Simulation | Trajectory) -> results.FingerGap:
    """Least gap of the fingers, on quintics through the recorded states."""
    t, z = motion.t, motion.z
    left = np.repeat(np.flatnonzero(np.diff(t) > 0), 7)
    h = np.diff(t)[left]
    run = h * np.resize(np.arange(1, 8) / 8, len(h))
    inside = interpolate_quintic(h, run, (z, motion.z_dot, motion.z_ddot), left)[0]
    times = np.append(t, t[left] + run)
    order = np.argsort(times, kind="stable")
    gaps = evaluate_finger_gap(scene, np.concatenate([z, inside]))
    shortest = 2 * SETTLING * scene.scales.time
    return results.FingerGap(*find_lowest(times[order], gaps[order], shortest))


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
    thin = list(describe_thin_margins(simulation, phases))
    warnings = [
        f"phase {phase.number} may stay wedged for {1e3 * phase.wedged:.3g} ms: so long friction "
        "can hold everything at rest under its torques"
        for phase in phases
        if phase.wedged
    ]
    # A replay may miss limits by as much as it may depart from its plan.
    allowed = MISSED if plan is None else allowance.departure
    missed = [
        (sum(phase.start <= time for phase in phases), text)
        for time, text in describe_motors(problem, torque)
    ]
    for phase in problem.phases[: len(phases)]:
        missed += [(phase.number, text) for text in describe_misses(phase, simulation, allowed)]
    if plan is not None:
        failures += [results.Failure(max(number, 1), text) for number, text in missed]
        # The departure of later phases follows from that of the first.
        failures += thin + list(describe_departures(problem, phases, allowance))[:1]
    else:
        warnings += [text for _, text in missed] + [failure.text for failure in thin]
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
    pressing = _find_least(simulation, index, forces, EventKind.CONTACT_LOST)
    columns = [simulation.contacts.index(name) for name in formation.names]
    c_n, c_t = (c[rows][:, columns] for c in (simulation.c_n, simulation.c_t))
    margins = {
        formation.names[row]: formation.friction[row] * c_n[:, row] - np.abs(c_t[:, row])
        for row in formation.rolling_rows
    }
    slips = _find_least(simulation, index, margins, EventKind.SLIP)
    end = worst = held = least = None
    if uniqueness:
        # Since it starts to move, if it does.
        starts = [e.time for e in simulation.find(EventKind.START, phase=index)]
        held = find_wedged(problem, phase, simulation, REST_SPEED, *starts[:1])
        least = find_uniqueness_margin(phase, simulation, rows)
    if plan is not None:
        end, worst = _compare(simulation, plan, phase, bool(arrivals))
    last_speed = measure_speed(problem.scene, simulation.z_dot[rows[-1]])
    return results.PhaseReport(
        number=phase.number,
        until=until,
        end=phase.end.value,
        start=float(simulation.t[rows[0]]),
        contacts=tuple(results.ContactMargin(*one, one[1] - problem.epsilon) for one in pressing),
        rolling=tuple(results.SlipMargin(*slip) for slip in slips),
        arrival=arrivals[0].time if arrivals else None,
        arrival_rate=arrivals[0].value if arrivals and not phase.until.is_release else None,
        end_speed=last_speed if arrivals and phase.end is End.REST else None,
        impact=results.LeastImpulse(impacts[0].contact, impacts[0].value) if impacts else None,
        end_deviation=end,
        deviation=worst,
        uniqueness_margin=least,
        wedged=held,
    )


def _compare(
    simulation: Simulation, plan: Trajectory, phase: Phase, arrived: bool
) -> tuple[Deviation | None, Deviation | None]:
    """Difference from the plan at the end of a phase and at worst."""
    planned, length = np.flatnonzero(plan.phase == phase.index), phase.formation.scene.scales.length
    if not len(planned):
        return None, None
    at = np.minimum(np.searchsorted(simulation.t, plan.t[planned]), len(simulation.t) - 1)
    recorded = simulation.t[at] == plan.t[planned]
    difference = (simulation.z[at] - plan.z[planned])[recorded]
    worst = _measure(difference, plan.t[planned][recorded], length)
    if not arrived:
        return None, worst
    last = int(np.flatnonzero(simulation.phase == phase.index)[-1])
    # A motion that goes on is compared when its phase was planned to end, not when it did.
    if phase.end is not End.REST and recorded[-1]:
        last = int(at[-1])
    difference = simulation.z[[last]] - plan.z[planned[-1:]]
    return _measure(difference, simulation.t[[last]], length), worst


def _measure(difference: Array, t: Array, length: float) -> Deviation:
    """Largest of differences of z, shape (n, 5), at times `t`; NaN if there are none."""
    if not len(t):
        return Deviation(math.nan, math.nan, math.nan)
    position, angle = (np.abs(part).max(axis=1) for part in np.split(difference, [2], axis=1))
    when = float(t[np.maximum(position / length, angle).argmax()])
    return Deviation(float(position.max()), float(angle.max()), when)


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
    # Where nothing moves all are rounding, of closing the contacts at the start.
    rounding = 1e-12 * scene.scales.force * scene.scales.length
    relative = abs(residual) / scale if scale > rounding else 0.0
    return results.EnergyBalance(work, kinetic, potential, *losses, residual, relative)


def list_normal_forces(simulation: Simulation, phase: Phase) -> dict[str, Array]:
    """Normal forces by contact in a phase [N].

    A contact that is let go without a jump of the torques passes epsilon on its way to zero: what
    it has below epsilon on that way is NaN.
    """
    releases = simulation.find(EventKind.RELEASE, phase=phase.index)
    gone = {name for event in releases for name in event.contact.split(", ")}
    forces = {}
    for name in phase.formation.names:
        values = simulation.c_n[simulation.phase == phase.index, simulation.contacts.index(name)]
        pressed = np.flatnonzero(values >= simulation.problem.epsilon)
        if name in gone and len(pressed) and values[-1] < simulation.problem.epsilon / 2:
            values[pressed[-1] + 1 :] = math.nan
        forces[name] = values
    return forces


def _find_least(
    simulation: Simulation, index: int, series: dict[str, Array], kind: EventKind
) -> Iterator[tuple[str, float, float]]:
    """Least value of each contact and its time; that of an event of its loss where it is less."""
    t = simulation.t[simulation.phase == index]
    events = {e.contact: e for e in simulation.find(kind, phase=index)}
    for name, values in series.items():
        has_values = not np.isnan(values).all()
        row = int(np.nanargmin(values)) if has_values else 0
        least, time = float(values[row]), float(t[row]) if has_values else math.nan
        if name in events and not least <= events[name].value:
            least, time = events[name].value, events[name].time
        yield name, least, time


def describe_misses(
    phase: Phase, simulation: Simulation, allowed: float, span: tuple[float, float] | None = None
) -> list[str]:
    """Sentences on limits that a phase exceeds by `allowed` of their scale, in its `span` [s].

    Those of forces and torques alone are left out.
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
        for limit, amount, worst in limits.list_misses(y @ limits.rows.T, allowed)
    ]


def find_commands(torque: TorqueProfile, lag: Array) -> TorqueProfile:
    """Commands that motors with some lags, shape (2,) [s], make torques of: tau + lag tau'."""
    change = lag[:, None] * torque.slopes.coefficients
    return TorqueProfile(torque.breaks, torque.coefficients + change)


def describe_motors(
    problem: Problem, torque: TorqueProfile, period: float = 0.0
) -> list[tuple[float, str]]:
    """Sentences on what motors cannot give, with the time of the worst place of each kind [s].

    Torques that a law holds over a `period` [s] may step by as much as they may change in it.
    """
    scene, x = problem.scene, np.linspace(-1, 1, 33)
    torques, rates = torque.at_places(x), torque.slopes.at_places(x)
    commands = torques + scene.actuator_lag[:, None] * rates
    lasts = np.diff(torque.breaks)[:, None]
    times = torque.breaks[:-1, None] + lasts * (1 + x) / 2
    misses = list[tuple[float, str]]()
    limits = zip(scene.torque_limit, scene.torque_rate_limit, scene.actuator_lag, strict=True)
    for joint, (limit, fastest, lag) in enumerate(limits):
        # Excess of a rate over a piece that is less than a step counts as none. Case: phase 2 of
        # new polygon 36 of seed 51, with pieces of 1 us.
        step, limited = 1e-5 * limit, f"where its rate limit is {fastest:g} N m/s"
        why = limited if np.isfinite(fastest) else "where its motor lags"
        rate, above = f"above its rate limit {fastest:g} N m/s", f"above its limit {limit:g} N m"
        kinds = [(torques, times, (1 + MISSED) * limit, "reaches {:.3g} N m", above)]
        if np.isfinite(fastest) or lag:
            quickest = min(fastest, 2 * limit / lag) if lag else fastest
            most_step = max(step, 1.001 * quickest * period)
            kinds += [
                (torque.jumps, torque.breaks[1:-1], most_step, "steps by {:.3g} N m", why),
                (rates, times, 1.001 * fastest + step / lasts, "changes at {:.4g} N m/s", rate),
                (commands, times, 1.001 * limit, "takes a command of {:.4g} N m", above),
            ]
        for of, when, most, what, against in kinds:
            sizes = np.abs(of[:, joint])
            over = (sizes - most).ravel()
            if over.max(initial=0.0) > 0:
                worst = int(over.argmax())
                t, size = float(when.ravel()[worst]), what.format(sizes.ravel()[worst])
                misses.append((t, f"tau_{joint + 1} {size} at t = {t:.5g} s, {against}"))
    return misses


def measure_stray(problem: Problem) -> float:
    """How far normal forces of a plan may fall below epsilon, rounding included [N]."""
    return 5e-7 * problem.scene.scales.force + STRAY * problem.epsilon


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
    """Ends elsewhere than pinned or at a speed, links that overlap, contact forces not unique."""
    problem, scene = simulation.problem, simulation.problem.scene
    for event in simulation.find(EventKind.ARRIVAL):
        phase = problem.phases[event.phase]
        first, row = np.flatnonzero(simulation.phase == event.phase)[[0, -1]].tolist()
        z, v = simulation.z[row], simulation.z_dot[row]
        until = phase.until.lead(simulation.z[first], scene.scales.length)
        if until.measure_pins(z, scene.scales.length) > allowance.departure:
            text = f"phase {phase.number} ends at {describe_pose(z)}, and not with {phase.until}"
            yield results.Failure(phase.number, text)
        fast = measure_speed(scene, v) > allowance.rest_speed * scene.scales.speed
        if phase.end is End.REST and fast:
            speed, turns = math.hypot(v[0], v[1]), np.abs(v[2:])
            fastest, energy = int(turns.argmax()), 0.5 * float(scene.mass_diagonal @ v**2)
            moves = f"the object moves at {speed:.3g} m/s"
            if scene.scales.length * turns[fastest] > speed:
                body = ("the object", "finger 1", "finger 2")[fastest]
                moves = f"{body} turns at {turns[fastest]:.3g} rad/s"
            unit = EndDistance(scene, until, simulation.z[first]).unit
            text = (
                f"phase {phase.number} does not end at rest: {phase.until} is reached at "
                f"{event.value:.3g} {unit}/s at t = {event.time:.5g} s, while {moves}, with "
                f"{energy:.3g} J left"
            )
            yield results.Failure(phase.number, text)
    # More than passes for touching.
    if gap is not None and gap.least < -3e-5 * scene.scales.length:
        number = [phase.number for phase in phases if phase.start <= gap.time][-1]
        text = f"{FINGERS_TOUCH} at t = {gap.time:.5g} s: they overlap by {-gap.least:.3g} m"
        yield results.Failure(number, f"{text}, phase {number}")
    for one in phases:
        least = one.uniqueness_margin
        # Those of a replay may be a little less than those of its plan.
        if least is not None and least.value < allowance.uniqueness_margin - 1e-3:
            place = describe_pose(simulation.z[np.searchsorted(simulation.t, least.time)])
            asked = allowance.uniqueness_margin
            text = describe_uniqueness(least.value, least.contacts, place, asked)
            yield results.Failure(
                one.number, f"{text}, at t = {least.time:.5g} s, phase {one.number}"
            )


def describe_departures(
    problem: Problem, phases: Sequence[results.PhaseReport], allowance: Allowance
) -> Iterator[results.Failure]:
    """Sentences on the phases whose replay is too far from the plan."""
    length, allowed = problem.scene.scales.length, allowance.departure
    for phase in phases:
        deviations = [d for d in (phase.deviation, phase.end_deviation) if d is not None]
        far = max(deviations, key=lambda d: d.measure(length), default=None)
        if far is not None and far.measure(length) > allowed:
            text = (
                f"phase {phase.number} departs from the plan, by {far.position:.2g} m and "
                f"{far.angle:.2g} rad at t = {far.time:.5g} s; {allowed * length:.2g} "
                f"m and {allowed:.2g} rad are allowed"
            )
            yield results.Failure(phase.number, text)


def describe_thin_margins(
    simulation: Simulation, phases: Sequence[results.PhaseReport]
) -> Iterator[results.Failure]:
    """Sentences on the normal forces below epsilon, but for contacts where they were lost."""
    problem = simulation.problem
    lost = {(e.phase + 1, e.contact) for e in simulation.find(EventKind.CONTACT_LOST)}
    for phase in phases:
        for c in phase.contacts:
            thin = c.margin < -measure_stray(problem)
            if thin and (phase.number, c.contact) not in lost:
                text = f"below epsilon = {problem.epsilon:g} N, at t = {c.time:.5g} s"
                text = f"c_n of {c.contact} falls to {c.least:.5g} N, {text}, phase {phase.number}"
                yield results.Failure(phase.number, text)


def find_uniqueness_margin(
    phase: Phase, motion: Trajectory | Simulation, rows: Numbers
) -> results.UniquenessMargin | None:
    """The least uniqueness margin in a phase; None if nothing moved.

    Tangential forces tell which way a contact slides; one that leans on no side of its cone sticks.
    Forces within cones at rest do not count: they are statically indeterminate, see `find_wedged`.
    `rows` are its rows in the phase.
    """
    formation, rows = phase.formation, rows[:: -(-len(rows) // PLACES)]
    scene, z_dot = formation.scene, motion.z_dot[rows]
    columns = [motion.contacts.index(name) for name in formation.names]
    c_n, c_t = (forces[rows][:, columns] for forces in (motion.c_n, motion.c_t))
    slides = np.abs(c_t) >= (1 - 1e-6) * formation.friction * np.abs(c_n)
    # Case: phase 9 of query 44 under rate limits.
    moves = [measure_speed(scene, v) > EXACT_REST * scene.scales.speed for v in z_dot]
    counted = ~np.isnan(c_n).any(axis=1) & (np.array(moves) | slides.all(axis=1))
    if not counted.any():
        return None
    rows, slides, Xi = rows[counted], slides[counted], -np.sign(c_t * c_n)[counted]
    kinematics = formation.evaluate(motion.z[rows], z_dot[counted])
    margins = []
    for pattern in sorted(set(map(tuple, slides.tolist()))):
        rows_of = np.flatnonzero((slides == pattern).all(axis=1))
        part = kinematics.pick(rows_of)
        sticking = tuple(np.flatnonzero(np.logical_not(pattern)).tolist())
        ratio, names, row = find_minors(formation, part, Xi[rows_of], sticking).find_least()
        margins.append(results.UniquenessMargin(ratio, names, float(motion.t[rows[rows_of[row]]])))
    return min(margins)


def find_wedged(
    problem: Problem, phase: Phase, motion: Trajectory | Simulation, slow: float, start: float = 0.0
) -> float | None:
    """Time for which friction may hold a phase that begins at rest (static indeterminacy) [s].

    Until no contact forces within their cones, of all contacts that touch, balance torques and
    gravity: see `mechanics.statics`. None if the phase does not begin at rest.

    Parameters
    ----------
    slow         speed that passes for rest, relative to the scene's
    start : [s]  since when the phase is to move: it may be at rest before while torques change
    """
    scene, contacts = problem.scene, phase.formation.contacts
    rows = np.flatnonzero(motion.phase == phase.index)
    if phase.index:
        if measure_speed(scene, motion.z_dot[rows[0]]) > slow * scene.scales.speed:
            return None
        contacts += problem.phases[phase.index - 1].formation.contacts
    touching = Formation(scene, tuple(dict.fromkeys(contacts)))
    static = Statics(touching, motion.z[rows[0]]).torque_polygon()
    start, stop = max(start, float(motion.t[rows[0]])), float(motion.t[rows[-1]])
    breaks = motion.torque.breaks
    inner = breaks[(breaks > start) & (breaks < stop)]
    t = sort_unique(np.concatenate([np.linspace(start, stop, 4 * PLACES), inner]))
    # At its end the torques are those of the next phase.
    beyond = static.measure(motion.torque.at(t[:-1])) - SURE * scene.scales.torque
    free = np.flatnonzero(beyond > 0)
    if not len(free):
        return float(stop - start)
    if free[0] == 0:
        return 0.0
    before, after = beyond[free[0] - 1], beyond[free[0]]
    since, until = t[free[0] - 1 : free[0] + 1] - start
    held = float(until - after / (after - before) * (until - since))
    return held if held > SETTLING * scene.scales.time else 0.0


_OTHERS = [0, 1, 2, 4]  # degrees of freedom that are eliminated: q and theta_2


def list_reduced_states(simulation: Simulation) -> tuple[results.ReducedState, ...]:
    """The scalar equation at a few instants of every phase with four constraints.

    At each instant theta_1 turns and every contact that the formation lets slide does so.
    """
    problem, states = simulation.problem, []
    for index in range(int(simulation.phase[-1]) + 1):
        formation, rows = problem.phases[index].formation, np.flatnonzero(simulation.phase == index)
        if formation.n_constraints != 4:
            continue
        motion = simulation.z, simulation.z_dot, simulation.z_ddot, simulation.tau
        z, v, a, tau = (part[rows] for part in motion)
        slip = (formation.evaluate(z, v).A_t @ v[:, :, None])[:, :, 0]
        sliding = [k for k in range(formation.n_contacts) if k not in formation.rolling_rows]
        scales = problem.scene.scales
        speeds = np.hstack([slip[:, sliding], scales.length * v[:, 3:]])
        moving = np.flatnonzero(np.abs(speeds).min(axis=1) > 1e-4 * scales.speed)
        chosen = np.linspace(0, len(moving) - 1, min(5, len(moving))).round().astype(int)
        for k in moving[chosen].tolist():
            directions = Directions(np.sign(slip[k]), np.sign(v[k, 3:]))
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
    formula defined where P_AI is singular; where that is because theta_1 is stationary, the motion
    is not a multiple of theta_1' and no such formula describes it. Configuration z is (5,),
    theta_1' in rad/s, tau (2,) [N m]; directions are the signs of friction.
    """
    scene = formation.scene

    def extend(rows: Array, right: Array, first: float) -> Array:
        """The x, (5,), with rows @ x = right and this component of the first joint."""
        others = np.linalg.pinv(rows[:, _OTHERS]) @ (right - rows[:, 3] * first)
        return np.insert(others, 3, first)

    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0]
    slope = extend(P, np.zeros(4), 1.0)
    kinematics = formation.evaluate(z[None], slope[None])
    bend = extend(P, -kinematics.P_dot_v[0], 0.0)
    # This sum of the rows of M5 z'' + b - g - S tau = G^T c has no contact forces.
    weights = extend(force_rows(formation, kinematics, directions)[0], np.zeros(4), 1.0)
    mass = scene.mass_diagonal
    resting = -scene.applied_force
    resting[3:] += scene.dry[3:] * directions.sigma - tau
    terms = mass * slope, mass * bend * theta_1_dot + scene.viscous * slope, resting
    Phi_1, Phi_2, Phi_3 = (float(term @ weights) for term in terms)
    return Phi_1, Phi_2, Phi_3


KEPT = 1e-9  # shortfall of a limit that counts as none, over the scale of it
FLAT = 1e-9
"""What a limit's slack changes with a torque below which it does not depend on it, in what is unit
for each."""
_TORQUES = ((0,), (1,), (0, 1))  # which torques change: one alone, or both
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
    ended = {event[:2] for event in events}
    allowed = measure_stray(problem)
    events += [
        (phase.number - 1, margin.contact, "thin", margin.time)
        for phase in phases
        for margin in phase.contacts
        if margin.margin < -allowed and (phase.number - 1, margin.contact) not in ended
    ]
    losses = (_examine_loss(simulation, *event) for event in events)
    approach = None if simulation.outcome.reached else find_approach(simulation)
    return results.TuningHelp(tuple(loss for loss in losses if loss is not None), approach)


def _examine_loss(
    simulation: Simulation, index: int, contact: str, kind: str, time: float
) -> results.Loss | None:
    """A loss with changes that prevent it; None if the phase does not have the contact."""
    problem, phase = simulation.problem, simulation.problem.phases[index]
    formation, rows = phase.formation, np.flatnonzero(simulation.phase == index)
    if contact not in formation.names:
        return None
    # The last row up to its time, or where the least force was seen.
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
    rests = bool(np.isnan(simulation.c_n[row, columns]).all())
    if rests:
        rest = modes.Rest(formation, z)
        free = [path for path in rest.list_modes() if path.slides(tau)]
        worst = min(free, key=lambda path: float((path.force_limits @ load).min()), default=None)
        response = None if worst is None else worst.response
        gradient = None if distance is None else distance[1][0]
        changes = find_resting_changes(rest, epsilon, tau, gradient)
    else:
        response = find_moving(formation, z, v, tau, simulation.z_ddot[row])
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
    when = float(simulation.t[row])
    return results.Loss(phase.number, contact, kind, when, rests, forces, closing, changes)


def list_changes(
    response: modes.Response, v: Array, epsilon: float, contact: str, tau: Array
) -> tuple[results.TorqueAdvice, ...]:
    """Least changes of each torque alone that a moving contact is kept with, or of both.

    Both change if one alone misses other limits. What lets go with the contact is kept, too; what
    other limits miss already they must not miss by more.
    """
    formation = response.mode.formation
    unit, load = formation.scene.scales.torque, np.array([1.0, *tau])
    limits, bare = make_limits(formation, epsilon), make_limits(formation, 0.0)
    rows, forces = limits.sides[0], (PRESS, CONE)
    owners, scale = limits.owners[rows], limits.scales[rows]
    contact_limits = [limit.part == contact and limit.kind in forces for limit in limits.limits]
    gone = find_sides(bare, response, v) @ load < -KEPT * scale
    missed = np.array(contact_limits)[owners] | (gone & np.isin(rows, limits.of(*forces)))
    slack, slope = normalise(find_sides(limits, response, v), scale, tau, unit)
    slack = np.where(missed, slack, np.maximum(slack, 0.0))

    def describe(change: Array) -> results.TorqueAdvice:
        short = -(slack + slope @ change)
        worst, but = int(short.argmax()), ""
        if short[worst] > KEPT:
            limit = limits.limits[owners[worst]]
            but = f"{limit.text} is {short[worst] * scale[worst]:.3g} {limit.unit} short"
        return make_advice(unit * change, tau, but)

    short = slack < 0
    # A change of one torque may miss others, and is then told with them.
    singles = [find_least_change(slack[short], slope[short], one) for one in _TORQUES[:2]]
    changes = [describe(one) for one in singles if one is not None]
    both = None
    if all(change.but for change in changes):
        both = find_least_change(slack, slope, _TORQUES[2])
    changes += [] if both is None else [describe(both)]
    return tuple(sorted(changes, key=lambda change: (bool(change.but), np.hypot(*change.change))))


def find_approach(simulation: Simulation) -> results.Approach | None:
    """How near the last phase entered has come to its end; None if it ends by a release."""
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
    going = np.flatnonzero(np.abs(rates) > 1e-6 * unit)
    turns = going[np.flatnonzero(np.diff(np.sign(rates[going])))]
    return results.Approach(
        phase=phase.number,
        until=str(phase.until),
        distance=max(least, 0.0),
        unit=end.unit,
        time=time,
        rate=float(np.interp(time, t, rates)) + 0.0,
        turns=tuple(float(t[row]) for row in turns),
    )


def find_resting_changes(
    rest: modes.Rest, epsilon: float, tau: Array, gradient: Array | None
) -> tuple[results.TorqueAdvice, ...]:
    """Least changes of each torque alone, or else of both, that let it keep its contacts.

    With them it begins to move towards the end of its phase, or if that cannot be it rests.

    Parameters
    ----------
    epsilon : [N]
    tau : (2,) [N m]
    gradient : (5,)   of the distance to the end of the phase, if that is known
    """
    limits, unit = make_limits(rest.formation, epsilon), rest.formation.scene.scales.torque
    starts = list[tuple[modes.StartMode, tuple[Array, Array]]]()
    for path in rest.list_modes():
        towards = [] if gradient is None else [-gradient @ path.response.acceleration]
        rows = np.vstack([path.margins, *towards])
        sizes = np.abs(rows) @ [1.0, unit, unit]
        scale = [limits.side_scales, np.where(sizes > 0, sizes, 1.0)]
        sides = np.vstack([find_sides(limits, path.response, np.zeros(5)), rows])
        slack, slope = normalise(sides, np.concatenate(scale), tau, unit)
        slack[len(slack) - len(towards) :] -= SURE  # on the verge it would hardly move
        starts.append((path, (slack, slope)))
    changes: list[results.TorqueAdvice] = []
    for free in _TORQUES:
        if len(free) == 2 and not all(change.holds for change in changes):
            break
        solutions = ((path, find_least_change(*sides, free)) for path, sides in starts)
        least = [(path, unit * one) for path, one in solutions if one is not None]
        moved = [change for path, change in least if path.moves(tau + change)]
        held = None if moved else rest.find_holding_change(tau, epsilon, free)
        if moved:
            changes.append(make_advice(min(moved, key=np.linalg.norm), tau))
        elif held is not None and (len(free) == 1 or not changes):
            changes.append(make_advice(held, tau, holds=True))
    return tuple(sorted(changes, key=lambda change: (change.holds, np.hypot(*change.change))))


def find_sides(limits: LimitSet, response: modes.Response, v: Array) -> Array:
    """Slack of one-sided limits at velocity v, (5,), rows @ (1, tau_1, tau_2), (n_sides, 3)."""
    formation = response.mode.formation
    forces = response.c[: formation.n_contacts], response.c_t[list(formation.rolling_rows)]
    y = np.vstack([*forces, np.eye(3)[1:], np.column_stack([v[3:], np.zeros((2, 2))])])
    return limits.find_slack_rows(limits.rows @ y)


def find_moving(
    formation: Formation, z: Array, v: Array, tau: Array, acceleration: Array
) -> modes.Response | None:
    """The mode of a motion; where something stands still, with the friction that it had.

    That is the friction with which torques `tau` give the recorded `acceleration`, shape (5,).
    """
    scene, rows = formation.scene, modes.evaluate_rows(formation, z, v)
    speeds = rows.A_t @ v
    units = np.repeat([scene.scales.speed, scene.scales.rate], [formation.n_contacts, 2])
    slow = np.abs(speeds) < 1e-6 * units
    signs = np.sign(speeds)
    signs[list(formation.rolling_rows)] = 0.0
    still = [unit for unit in modes.list_units(formation) if slow[list(unit.rows)].all()]
    every = modes.list_modes(formation, signs, still, formation.n_constraints < 4)
    tried = (modes.respond(mode, rows, v) for mode in every)

    def misfit(response: modes.Response) -> float:
        off = response.acceleration @ [1.0, *tau] - acceleration
        return float(scene.mass_diagonal @ off**2)

    return min((one for one in tried if one is not None), key=misfit, default=None)


def normalise(sides: Array, scale: Array, tau: Array, unit: float) -> tuple[Array, Array]:
    """Slack under torques `tau` and its slope, (n,) and (n, 2), in the scale of each."""
    slack = sides @ np.array([1.0, *tau]) / scale
    return np.asarray(slack), sides[:, 1:] * (unit / scale)[:, None]


def make_advice(
    change: Array, tau: Array, but: str = "", holds: bool = False
) -> results.TorqueAdvice:
    """A change of torques `tau`, shape (2,) [N m]."""
    (first, second), (one, other) = change.tolist(), (tau + change).tolist()
    return results.TorqueAdvice((first, second), (one, other), but, holds)


def find_least_change(slack: Array, slope: Array, free: tuple[int, ...]) -> Array | None:
    """The shortest change of the torques `free`, (2,), with slack + slope @ change >= 0, or None.

    It is zero, on a side, or in a corner of two sides.
    """
    steep = slope * np.isin([0, 1], free)
    sizes = np.linalg.norm(steep, axis=1)
    used = sizes > FLAT
    normal, reach = steep[used] / sizes[used, None], slack[used] / sizes[used]
    changes = [np.zeros(2), *(-reach[:, None] * normal)]
    for i, j in combinations(range(len(reach)), 2):
        pair = normal[[i, j]]
        if abs(np.linalg.det(pair)) > FLAT:
            changes.append(np.linalg.solve(pair, -reach[[i, j]]))
    kept = [change for change in changes if (slack + steep @ change >= -KEPT).all()]
    return min(kept, key=np.linalg.norm, default=None)
