"""Verification of torques by open-loop replay: margins between nodes, goal, deviation, energy."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.sharing import exclusive
from ..contacts.links import evaluate_finger_gap
from ..mechanics.uniqueness import UNIQUENESS_MARGIN
from ..problem.definition import End, Phase, Problem
from ..results.adopt import Torques, adopt_torques, require_same_contacts
from ..results.report import (
    Deviation,
    EnergyBalance,
    Failure,
    FingerGap,
    LeastImpulse,
    ModeChange,
    PhaseReport,
    ReducedState,
    Report,
)
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..simulation.events import Event, EventKind, Glimpses, Simulation
from ..simulation.simulate import Closer, simulate
from .force_uniqueness import find_departure, find_uniqueness_margin, find_wedged
from .margins import (
    MISSED,
    SHORTEST,
    describe_misses,
    describe_motors,
    find_finger_gap,
    fit_parabolas,
    list_contact_margins,
    list_normal_forces,
    list_slip_margins,
    list_slips,
)
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

ROWS = 20
"""About how many rows of each phase of a trajectory its replay is compared with; without one, about
how many even parts of each phase are looked at."""
POINTS = 8  # instants around what seems to be a dip
LOOKS = 3  # how often what the looks before leave open is looked at closer
_DIP = 1e-7
"""How far below all that is known a dip has to seem, relative to the scene's force or length."""
Dips = list[tuple[float, float]]
"""Where something seems to dip, from start to end [s]."""
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


@exclusive
def verify(
    problem: Problem,
    what: Torques,
    *,
    tolerance: float = 1e-9,
    departure: float = DEPARTURE,
    rest_speed: float = REST_SPEED,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
    reduced: bool = False,
) -> Report:
    """Replay the torques of a plan, or given ones, open loop and report what happens.

    Every contact has to hold, every phase with an end at rest has to be at rest there, and the goal
    has to be reached. A plan has to keep every normal force above epsilon, too, and its
    replay has to stay near it; of torques alone a force below epsilon is a warning.

    Parameters
    ----------
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
    times, closer = choose_times(problem, torque, plan), make_closer(problem, torque.breaks)
    simulation = simulate(problem, torque, tolerance=tolerance, times=times, closer=closer)
    phases = tuple(
        _report_phase(problem, simulation, torque, plan, index, uniqueness)
        for index in range(int(simulation.phase[-1]) + 1)
    )
    gap = find_finger_gap(problem.scene, simulation, torque.breaks)
    return Observation(problem, torque, plan, tolerance, simulation, phases, gap)


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
        contacts=list_contact_margins(problem, simulation, rows, phase, torque.breaks),
        rolling=list_slip_margins(phase, simulation, rows, torque.breaks),
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


class Series(NamedTuple):
    """Recorded values of a force, a margin or a gap in a phase."""

    name: str
    t: Array  # t, values (n,) [s], [N or m]: at recorded instants
    values: Array
    more_t: Array  # more_t, more (k,): by glimpses, in any order
    more: Array
    breaks: Array  # [s]: where it may have a kink
    shortest: float  # [s]: interval below which it may jump
    depth: float  # [N or m]: how far below the least value a dip has to seem

    def find_dips(self) -> Dips:
        """Places where it seems to be lower than anywhere recorded, with and without glimpses."""
        t, values = np.append(self.t, self.more_t), np.append(self.values, self.more)
        order = np.argsort(t, kind="stable")
        return [*self._fit(t[order], values[order]), *self._fit(self.t, self.values)]

    def narrow(self, dip: tuple[float, float]) -> Dips:
        """Places within a dip where it still seems so by what is recorded."""
        within = slice(*np.searchsorted(self.t, [dip[0], np.nextafter(dip[1], np.inf)]))
        return self._fit(self.t[within], self.values[within])

    def _fit(self, t: Array, values: Array) -> Dips:
        parabolas = fit_parabolas(t, values, self.breaks, self.shortest)
        least = np.nanmin(self.values, initial=np.inf) - self.depth
        low = np.flatnonzero(parabolas.lowest < least).tolist()
        return [(float(parabolas.start[k]), float(parabolas.stop[k])) for k in low]


def make_closer(problem: Problem, breaks: Array) -> Closer:
    """Instants to add to a replay, near the minima of forces, slip margins and gaps.

    Parameters
    ----------
    breaks : [s]  those of its torques
    """
    left: dict[tuple[int, str], Dips] = {}

    def look(simulation: Simulation, glimpses: Glimpses, looks: int) -> Array:
        before, phases = left.copy(), problem.phases[: int(simulation.phase[-1]) + 1]
        left.clear()
        for phase in phases if looks < LOOKS else ():
            if looks and not any(index == phase.index for index, _ in before):
                continue
            for one in _list_series(problem, simulation, glimpses, phase, breaks):
                key = phase.index, one.name
                known = before.get(key, [])
                dips = [d for dip in known for d in one.narrow(dip)] if looks else one.find_dips()
                left.update({key: dips} if dips else {})
        every = [np.linspace(*dip, POINTS + 2)[1:-1] for dips in left.values() for dip in dips]
        return np.concatenate([np.zeros(0), *every])

    return look


def _list_series(
    problem: Problem, simulation: Simulation, glimpses: Glimpses, phase: Phase, breaks: Array
) -> Iterator[Series]:
    """Forces, slip margins and gaps of a phase; margins and gaps have no jumps."""
    scales, rows = problem.scene.scales, np.flatnonzero(simulation.phase == phase.index)
    t, none, shortest = simulation.t[rows], np.zeros(0), SHORTEST * scales.time
    own = np.flatnonzero(glimpses.phase == phase.index)
    least = _DIP * scales.force
    for name, values in list_normal_forces(problem, simulation, phase, rows).items():
        more = glimpses.c_n[own, simulation.contacts.index(name)]
        yield Series(name, t, values, glimpses.t[own], more, breaks, shortest, least)
    for name, values in list_slips(simulation, phase, rows).items():
        yield Series(f"{name} rolling", t, values, none, none, t[:1], shortest, least)
    if problem.scene.fingers_collide:
        gaps = evaluate_finger_gap(problem.scene, simulation.z[rows])
        yield Series("gap", t, gaps, none, none, t[:1], shortest, _DIP * scales.length)
