"""Verification of torques by open-loop replay: margins between nodes, goal, deviation, energy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..contacts.cones import slip_margins
from ..contacts.contact_limits import evaluate_finger_gap
from ..mechanics.limits import CONE, PRESS, TORQUE, make_limits
from ..mechanics.uniqueness import UNIQUENESS_MARGIN
from ..problem.definition import End, Phase, Problem
from ..results.adopt import Torques, adopt_torques, require_same_contacts
from ..results.plan_record import Deviation
from ..results.report import (
    ContactMargin,
    EnergyBalance,
    Failure,
    FingerGap,
    LeastImpulse,
    ModeChange,
    PhaseReport,
    ReducedState,
    Report,
    SlipMargin,
)
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory, interpolate_quintic
from ..simulation.events import Event, EventKind, Simulation
from ..simulation.simulate import simulate
from ..simulation.tolerances import SETTLING
from .force_uniqueness import find_departure, find_uniqueness_margin, find_wedged
from .verdict import (
    DEPARTURE,
    REST_SPEED,
    Allowance,
    describe_ambiguity,
    describe_departures,
    describe_ends,
    describe_overlap,
    describe_thin_margins,
    describe_wedging,
    judge_end,
    measure_speed,
)

if TYPE_CHECKING:
    from .free import FreeReport

MISSED = 1e-6  # miss of a limit, over what is much for it, from which on it is reported
ROWS = 20
"""About how many rows of each phase of a trajectory its replay is compared with; without one, about
how many even parts of each phase are looked at."""
_ENDS = (EventKind.ARRIVAL, EventKind.RELEASE)
_CHANGES = {EventKind.STICK: "sticks", EventKind.SLIP: "slips", EventKind.REVERSAL: "reverses"}


class Observation(NamedTuple):
    """A replay and its measurements, before tolerances are applied."""

    problem: Problem
    torque: TorqueProfile
    plan: Trajectory | None  # what it is compared with
    tolerance: float  # of the simulation
    simulation: Simulation
    phases: tuple[PhaseReport, ...]
    gap: FingerGap | None


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
) -> Report: ...
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
) -> Report | FreeReport:
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

    Raises
    ------
    InputError                     if the trajectory has other contacts than the problem, or a
                                   number is out of its range
    JammingError, SimulationError  if the simulation cannot go on
    """
    if contacts == "free":
        from .free import verify_free

        return verify_free(problem, what, tolerance=tolerance, departure=departure, **options)
    if contacts != "prescribed" or options:
        text = f"{contacts!r} given; known: prescribed, free"
        raise InputError(
            "", "contacts", f"{', '.join(options)} needs free ones" if options else text
        )
    problem, torque, plan = adopt_torques(problem, what)
    allowance = Allowance(departure, rest_speed, uniqueness_margin=uniqueness_margin)
    require_same_contacts(problem, plan)
    seen = observe(problem, torque, plan, tolerance, True)
    report = judge(seen, allowance, reduced)
    if report.ok and not report.warnings:
        return report
    from .torque_advice import find_help

    return replace(report, help=find_help(problem, seen.simulation, seen.phases, allowance))


def observe(
    problem: Problem,
    torque: TorqueProfile,
    plan: Trajectory | None,
    tolerance: float = 1e-9,
    uniqueness: bool = False,
) -> Observation:
    """Replay torques and record forces and gaps, more densely near their minima.

    Parameters
    ----------
    plan        what to compare the replay with
    tolerance   of the simulation
    uniqueness  whether to find uniqueness margins, and static indeterminacy of starts

    Raises
    ------
    JammingError, SimulationError  if the simulation cannot go on
    """
    times = choose_times(problem, torque, plan)
    simulation = simulate(problem, torque, tolerance=tolerance, times=times, minima=True)
    phases = tuple(
        _report_phase(problem, simulation, torque, plan, index, uniqueness)
        for index in range(int(simulation.phase[-1]) + 1)
    )
    gap = find_finger_gap(simulation) if problem.scene.fingers_collide else None
    return Observation(problem, torque, plan, tolerance, simulation, phases, gap)


def find_finger_gap(simulation: Simulation) -> FingerGap:
    """Least gap of the fingers, on quintics through the recorded states."""
    t, z, scene = simulation.t, simulation.z, simulation.problem.scene
    left, share = np.flatnonzero(np.diff(t) > 0), np.arange(1, 8) / 8
    h, run = np.repeat(np.diff(t)[left], 7), np.outer(np.diff(t)[left], share).ravel()
    knots = z, simulation.z_dot, simulation.z_ddot
    inside = interpolate_quintic(h, run, knots, np.repeat(left, 7))[0]
    times = np.append(t, np.repeat(t[left], 7) + run)
    order = np.argsort(times, kind="stable")
    gaps = evaluate_finger_gap(scene, np.concatenate([z, inside]))
    return FingerGap(*find_lowest(times[order], gaps[order], 2 * SETTLING * scene.scales.time))


def judge(seen: Observation, allowance: Allowance, reduced: bool = False) -> Report:
    """Apply tolerances to a replay; see `verify`."""
    problem, simulation, phases, gap = seen.problem, seen.simulation, seen.phases, seen.gap
    reached, outcome = judge_end(problem, simulation, allowance)
    failures = [] if reached else [Failure(len(phases), outcome)]
    failures += describe_ends(problem, simulation, allowance)
    failures += describe_overlap(problem.scene, phases, gap) if reached else []
    failures += describe_ambiguity(problem, simulation, phases, allowance)
    thin = describe_thin_margins(problem, phases, simulation, allowance)
    warnings = _describe_torques(problem, seen.torque) + describe_wedging(phases)
    for phase in problem.phases[: len(phases)]:
        rows = np.flatnonzero(simulation.phase == phase.index)
        warnings += describe_misses(phase, simulation, rows, seen.torque)
    for time, text in describe_motors(problem, seen.torque):
        number = sum(phase.start <= time for phase in phases)
        if seen.plan is None:
            warnings.append(text)
        else:
            failures.append(Failure(max(number, 1), text))
    if seen.plan is not None:
        failures += thin + describe_departures(problem, phases, allowance)
    else:
        warnings += [failure.text for failure in thin]
    states: tuple[ReducedState, ...] = ()
    if reduced:
        from .minimal_coordinates import list_reduced_states

        states = list_reduced_states(problem, simulation)
    return Report(
        name=problem.name,
        epsilon=problem.epsilon,
        outcome=outcome,
        reached=reached,
        missed_by=simulation.missed_by,
        failures=tuple(failure.text for failure in failures),
        failed_phase=failures[0].phase if failures else None,
        warnings=tuple(warnings),
        phases=phases,
        energy=_balance(problem, simulation),
        finger_gap=gap,
        tolerance=seen.tolerance,
        steps=simulation.steps,
        changes=tuple(
            ModeChange(float(e.time), e.phase + 1, e.contact, _CHANGES[e.kind])
            for e in simulation.events
            if e.kind in _CHANGES and e.contact
        ),
        reduced=states,
        replay=simulation,
    )


def _report_phase(
    problem: Problem,
    simulation: Simulation,
    torque: TorqueProfile,
    plan: Trajectory | None,
    index: int,
    uniqueness: bool,
) -> PhaseReport:
    phase = problem.phases[index]
    rows = np.flatnonzero(simulation.phase == index)
    arrivals = [e for e in simulation.events if e.phase == index and e.kind in _ENDS]
    impacts = [e for e in simulation.find(EventKind.IMPACT) if e.phase == index]
    stops = bool(arrivals) and phase.end is End.REST
    moves = find_departure(simulation, torque, index)
    part, lost = (phase, simulation, rows), EventKind.CONTACT_LOST
    pressing = _find_least(*part, list_normal_forces(problem, simulation, phase, rows), lost)
    slips = _find_least(*part, list_slips(simulation, phase, rows), EventKind.SLIP)
    end = worst = held = None
    if uniqueness:
        held = find_wedged(problem, phase, simulation, rows, REST_SPEED, moves)
    if plan is not None:
        # A motion that goes on is compared when its phase was planned to end, not when it did.
        passes, length = phase.end is not End.REST, problem.scene.scales.length
        end, worst = _compare(simulation, plan, index, bool(arrivals), passes, length)
    return PhaseReport(
        number=phase.number,
        until=_describe_end(arrivals, phase),
        end=phase.end.value,
        start=float(simulation.t[rows[0]]),
        contacts=tuple(ContactMargin(*least, least[1] - problem.epsilon) for least in pressing),
        rolling=tuple(SlipMargin(*least) for least in slips),
        arrival=arrivals[0].time if arrivals else None,
        arrival_rate=arrivals[0].value if arrivals and not phase.until.is_release else None,
        end_speed=measure_speed(problem.scene, simulation.z_dot[rows[-1]]) if stops else None,
        impact=LeastImpulse(impacts[0].contact, impacts[0].value) if impacts else None,
        end_deviation=end,
        deviation=worst,
        uniqueness_margin=find_uniqueness_margin(phase, simulation, rows) if uniqueness else None,
        wedged=held,
    )


def _compare(
    simulation: Simulation, plan: Trajectory, index: int, arrived: bool, passes: bool, length: float
) -> tuple[Deviation | None, Deviation | None]:
    """Difference from the plan at the end of a phase and at worst."""
    planned = np.flatnonzero(plan.phase == index)
    if not len(planned):
        return None, None
    at = np.searchsorted(simulation.t, plan.t[planned])
    at = np.minimum(at, len(simulation.t) - 1)
    known = simulation.t[at] == plan.t[planned]
    difference = (simulation.z[at] - plan.z[planned])[known]
    worst = _measure(difference, plan.t[planned][known], length)
    if not arrived:
        return None, worst
    last = int(np.flatnonzero(simulation.phase == index)[-1])
    if passes and known[-1]:
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


def _describe_end(events: list[Event], phase: Phase) -> str:
    """What ends a phase, with the contacts that are released or change their mode."""
    if not events or not phase.until.is_release:
        return str(phase.until)
    what = "release" if events[0].kind is EventKind.RELEASE else "change"
    return f"{what} of {events[0].contact}"


def _describe_torques(problem: Problem, torque: TorqueProfile) -> list[str]:
    """Sentences on torques beyond their limits."""
    peaks = np.abs(torque.at_places(np.linspace(-1, 1, 9))).max(axis=2)
    texts = []
    for joint, limit in enumerate(problem.scene.torque_limit):
        piece = int(peaks[:, joint].argmax())
        if peaks[piece, joint] > limit * (1 + MISSED):
            texts.append(
                f"tau_{joint + 1} reaches {peaks[piece, joint]:.3g} N m, above its limit "
                f"{limit:g} N m, near t = {torque.breaks[piece]:.5g} s"
            )
    return texts


def _balance(problem: Problem, simulation: Simulation) -> EnergyBalance:
    scene, energies = problem.scene, simulation.energies
    ends = simulation.z_dot[[0, -1]]
    kinetic = float(np.diff(0.5 * ends**2 @ scene.mass_diagonal)[0])
    weight = scene.polygon.mass * scene.gravity
    potential = float(weight * (simulation.z[-1, 1] - simulation.z[0, 1]))
    losses = {
        name: float(getattr(energies, name)[-1]) for name in ("viscous", "dry", "contact", "impact")
    }
    work, residual = float(energies.work[-1]), float(energies.residual[-1])
    scale = abs(work) + abs(kinetic) + abs(potential) + sum(map(abs, losses.values()))
    relative = abs(residual) / scale if scale > 0 else 0.0
    return EnergyBalance(work, kinetic, potential, **losses, residual=residual, relative=relative)


def choose_times(problem: Problem, torque: TorqueProfile, plan: Trajectory | None) -> Array:
    """Instants to look at first: rows of a plan, or even ones; steps show what is in between."""
    if plan is None:
        return np.linspace(torque.breaks[0], torque.breaks[-1], ROWS * len(problem.phases) + 1)
    owned = (np.flatnonzero(plan.phase == index) for index in range(len(plan.motions)))
    picked = (own[np.linspace(0, len(own) - 1, ROWS + 1).astype(int)] for own in owned)
    return np.concatenate([plan.t[rows] for rows in picked])


def list_normal_forces(
    problem: Problem, simulation: Simulation, phase: Phase, rows: NDArray[np.int64]
) -> dict[str, Array]:
    """Normal forces by contact in a phase, which the simulation has at `rows` [N].

    A contact that is let go without a jump of the torques passes epsilon on its way to zero: what
    it has below epsilon on that way is NaN.
    """
    gone = {
        name
        for event in simulation.find(EventKind.RELEASE)
        if event.phase == phase.index
        for name in event.contact.split(", ")
    }
    forces = {}
    for name in phase.formation.names:
        values = simulation.c_n[rows, simulation.contacts.index(name)]
        pressed = np.flatnonzero(values >= problem.epsilon)
        if name in gone and len(pressed) and values[-1] < problem.epsilon / 2:
            values[pressed[-1] + 1 :] = math.nan
        forces[name] = values
    return forces


def list_slips(simulation: Simulation, phase: Phase, rows: NDArray[np.int64]) -> dict[str, Array]:
    """Margins to slipping by rolling contact in a phase, which the simulation has at `rows` [N]."""
    formation = phase.formation
    columns = [simulation.contacts.index(name) for name in formation.names]
    c_n, c_t = simulation.c_n[rows][:, columns], simulation.c_t[rows][:, columns]
    names = [formation.names[row] for row in formation.rolling_rows]
    return dict(zip(names, slip_margins(formation, c_n, c_t).T, strict=True))


def _find_least(
    phase: Phase,
    simulation: Simulation,
    rows: NDArray[np.int64],
    series: dict[str, Array],
    kind: EventKind,
) -> Iterator[tuple[str, float, float]]:
    """Least value of each contact and its time; that of an event of its loss where it is less."""
    events = {e.contact: e for e in simulation.find(kind) if e.phase == phase.index}
    for name, values in series.items():
        known = not np.isnan(values).all()
        row = int(np.nanargmin(values)) if known else 0
        least, time = float(values[row]), float(simulation.t[rows[row]]) if known else math.nan
        if name in events and not least <= events[name].value:
            least, time = events[name].value, events[name].time
        yield name, least, time


def describe_misses(
    phase: Phase, simulation: Simulation, rows: NDArray[np.int64], torque: TorqueProfile
) -> list[str]:
    """Sentences on limits that a phase exceeds, other than those of forces and torques alone."""
    formation, t = phase.formation, simulation.t[rows]
    limits = make_limits(formation, 0.0).without(PRESS, CONE, TORQUE)
    if not limits.limits:
        return []
    columns = [simulation.contacts.index(name) for name in formation.names]
    rolling = [columns[row] for row in formation.rolling_rows]
    c = [simulation.c_n[rows][:, columns], simulation.c_t[rows][:, rolling]]
    y = np.nan_to_num(np.hstack([*c, torque.at(t), simulation.z_dot[rows, 3:]]))
    short = limits.fold(-limits.find_slack(y @ limits.rows.T))
    texts = []
    for k, limit in enumerate(limits.limits):
        amounts = short[:, limits.owners == k].max(axis=1)
        worst = int(amounts.argmax())
        if amounts[worst] > MISSED * limit.scale:
            over = f"{amounts[worst]:.3g} {limit.unit}"
            texts.append(
                f"{limit.text} is exceeded by {over} at t = {t[worst]:.5g} s, phase {phase.number}"
            )
    return texts


def find_lowest(t: Array, values: Array, shortest: float = 0.0) -> tuple[float, float]:
    """Least value of a smooth function and where, refined by parabolas through three samples.

    Parameters
    ----------
    t, values : (n,)  times never decrease [s]
    shortest : [s]    interval below which rounding spoils a parabola
    """
    first = int(values.argmin())
    least, time = float(values[first]), float(t[first])
    left, right = np.diff(t)[:-1], np.diff(t)[1:]
    smooth = (left > shortest) & (right > shortest)
    smooth &= (values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])
    left, right, middle = left[smooth], right[smooth], t[1:-1][smooth]
    fall = (values[1:-1] - values[:-2])[smooth] / left
    rise = (values[2:] - values[1:-1])[smooth] / right
    slope = (fall * right + rise * left) / (left + right)
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.nan_to_num(-slope * (left + right) / (2 * (rise - fall)))
    lowest = values[1:-1][smooth] + slope * shift / 2
    if len(lowest) and lowest.min() < least:
        k = int(lowest.argmin())
        least, time = float(lowest[k]), float(middle[k] + shift[k])
    return least, time


def find_commands(torque: TorqueProfile, lag: Array) -> TorqueProfile:
    """Commands that motors with some lags, shape (2,) [s], make torques of: tau + lag tau'."""
    order = np.arange(1, torque.coefficients.shape[2])
    slopes = np.zeros_like(torque.coefficients)
    slopes[..., :-1] = torque.coefficients[..., 1:] * order
    slopes *= (2 / np.diff(torque.breaks))[:, None, None]
    return TorqueProfile(torque.breaks, torque.coefficients + lag[:, None] * slopes)


def describe_motors(problem: Problem, torque: TorqueProfile) -> list[tuple[float, str]]:
    """What misses cannot follow, with the time of the worst place of each kind [s]."""
    scene = problem.scene
    if not scene.has_slow_motors:
        return []
    x = np.linspace(-1, 1, 33)
    values, ones = torque.at_places(x), find_commands(torque, np.ones(2)).at_places(x)
    rates, commands = ones - values, values + scene.actuator_lag[:, None] * (ones - values)
    steps = np.abs(values[1:, :, 0] - values[:-1, :, -1])
    misses = list[tuple[float, str]]()
    limits = zip(scene.torque_limit, scene.torque_rate_limit, scene.actuator_lag, strict=True)
    for joint, (limit, fastest, lag) in enumerate(limits):
        name = f"tau_{joint + 1}"
        if np.isinf(fastest) and not lag:
            continue
        worst = int(steps[:, joint].argmax()) if len(steps) else 0
        if len(steps) and steps[worst, joint] > 1e-5 * limit:
            t = float(torque.breaks[worst + 1])
            text = f"{name} steps by {steps[worst, joint]:.3g} N m at t = {t:.5g} s"
            why = (
                f"its rate limit is {fastest:g} N m/s" if np.isfinite(fastest) else "its motor lags"
            )
            misses.append((t, f"{text}, where {why}"))
        kinds = (
            (rates[:, joint], fastest, "changes at {:.4g} N m/s, above its rate limit {:g} N m/s"),
            (commands[:, joint], limit, "takes a command of {:.4g} N m, above its limit {:g} N m"),
        )
        for of, most, text in kinds:
            size = np.abs(of)
            piece, look = np.unravel_index(int(size.argmax()), size.shape)
            if size[piece, look] > most * (1 + 1e-3):
                start, stop = torque.breaks[[piece, piece + 1]]
                t = float(start + (stop - start) * (1 + x[look]) / 2)
                said = text.format(size[piece, look], most)
                misses.append((t, f"{name} {said}, at t = {t:.5g} s"))
    return misses
