"""Verdict on a replay: uniqueness of forces, limits relative to the scene, and their messages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array, Numbers
from ..common.fields import POSITIVE, declare, key, read_keys
from ..contacts.contact_limits import FINGERS_TOUCH
from ..contacts.formation import Formation, Kinematics
from ..geometry.curve import describe_pose
from ..geometry.tracing import EndDistance
from ..mechanics import UNIQUENESS
from ..mechanics.statics import SURE, Statics
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, describe_uniqueness, find_minors
from ..problem.definition import End, Phase, Problem
from ..results.report import Deviation, Failure, FingerGap, PhaseReport, UniquenessMargin
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from ..simulation.events import EventKind, Simulation

DEPARTURE = 1e-3
"""Largest distance of a replay from its plan, relative to the scene's length, and in rad."""
REST_SPEED = 2e-2  # speed at the end of a phase that passes for rest, relative to the scene's speed
STRAY = 2e-3  # how far normal forces of a plan may fall below epsilon, over epsilon
EXACT_REST = 1e-9  # speed of rest but for rounding, relative to the scene's speed
PLACES = 33
"""Instants of a phase at which uniqueness margins are looked at, and at which torques are."""


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


def measure_stray(problem: Problem) -> float:
    """How far normal forces of a plan may fall below epsilon, rounding included [N]."""
    return 5e-7 * problem.scene.scales.force + STRAY * problem.epsilon


def measure_speed(scene: Scene, v: Array) -> float:
    """Largest speed in z', shape (5,) [m/s]: angular ones count times the scene's length."""
    length = scene.scales.length
    return max(math.hypot(v[0], v[1]), length * float(np.abs(v[2:]).max()))


def describe_failures(
    simulation: Simulation,
    phases: Sequence[PhaseReport],
    gap: FingerGap | None,
    allowance: Allowance,
) -> Iterator[Failure]:
    """Ends elsewhere than pinned or at a speed, links that overlap, contact forces not unique."""
    problem, scene = simulation.problem, simulation.problem.scene
    for event in simulation.find(EventKind.ARRIVAL):
        phase = problem.phases[event.phase]
        first, row = np.flatnonzero(simulation.phase == event.phase)[[0, -1]].tolist()
        z, v = simulation.z[row], simulation.z_dot[row]
        if phase.until.measure_pins(z, scene.scales.length) > allowance.departure:
            text = f"phase {phase.number} ends at {describe_pose(z)}, and not with {phase.until}"
            yield Failure(phase.number, text)
        fast = measure_speed(scene, v) > allowance.rest_speed * scene.scales.speed
        if phase.end is End.REST and fast:
            speed, turns = math.hypot(v[0], v[1]), np.abs(v[2:])
            fastest, energy = int(turns.argmax()), 0.5 * float(scene.mass_diagonal @ v**2)
            moves = f"the object moves at {speed:.3g} m/s"
            if scene.scales.length * turns[fastest] > speed:
                body = ("the object", "finger 1", "finger 2")[fastest]
                moves = f"{body} turns at {turns[fastest]:.3g} rad/s"
            unit = EndDistance.to_leading(scene, phase.until, simulation.z[first]).unit
            text = (
                f"phase {phase.number} does not end at rest: {phase.until} is reached at "
                f"{event.value:.3g} {unit}/s at t = {event.time:.5g} s, while {moves}, with "
                f"{energy:.3g} J left"
            )
            yield Failure(phase.number, text)
    # More than passes for touching.
    if gap is not None and gap.least < -3e-5 * scene.scales.length:
        number = [phase.number for phase in phases if phase.start <= gap.time][-1]
        text = f"{FINGERS_TOUCH} at t = {gap.time:.5g} s: they overlap by {-gap.least:.3g} m"
        yield Failure(number, f"{text}, phase {number}")
    for one in phases:
        least = one.uniqueness_margin
        # Those of a replay may be a little less than those of its plan.
        if least is not None and least.value < allowance.uniqueness_margin - 1e-3:
            place = describe_pose(simulation.z[np.searchsorted(simulation.t, least.time)])
            asked = allowance.uniqueness_margin
            text = describe_uniqueness(least.value, least.contacts, place, asked)
            yield Failure(one.number, f"{text}, at t = {least.time:.5g} s, phase {one.number}")


def describe_departures(
    problem: Problem, phases: Sequence[PhaseReport], allowance: Allowance
) -> Iterator[Failure]:
    """Sentences on the phases whose replay is too far from the plan."""
    length, allowed = problem.scene.scales.length, allowance.departure
    for phase in phases:
        deviations = [d for d in (phase.deviation, phase.end_deviation) if d is not None]
        far = max(deviations, key=lambda d: measure_departure(d, length), default=None)
        if far is not None and measure_departure(far, length) > allowed:
            text = (
                f"phase {phase.number} departs from the plan, by {far.position:.2g} m and "
                f"{far.angle:.2g} rad at t = {far.time:.5g} s; {allowed * length:.2g} "
                f"m and {allowed:.2g} rad are allowed"
            )
            yield Failure(phase.number, text)


def measure_departure(deviation: Deviation, length: float) -> float:
    """Size of a difference, over the scene's `length` [m] and in rad; zero where none is known."""
    sizes = (deviation.position / length, deviation.angle)
    return max((size for size in sizes if not math.isnan(size)), default=0.0)


def describe_thin_margins(
    simulation: Simulation, phases: Sequence[PhaseReport]
) -> Iterator[Failure]:
    """Sentences on the normal forces below epsilon, but for contacts where they were lost."""
    problem = simulation.problem
    lost = {(e.phase + 1, e.contact) for e in simulation.find(EventKind.CONTACT_LOST)}
    for phase in phases:
        for c in phase.contacts:
            thin = c.margin < -measure_stray(problem)
            if thin and (phase.number, c.contact) not in lost:
                text = f"below epsilon = {problem.epsilon:g} N, at t = {c.time:.5g} s"
                text = f"c_n of {c.contact} falls to {c.least:.5g} N, {text}, phase {phase.number}"
                yield Failure(phase.number, text)


def find_uniqueness_margin(
    phase: Phase, motion: Trajectory | Simulation, rows: Numbers
) -> UniquenessMargin | None:
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
        part = Kinematics(*(array[rows_of] for array in kinematics))
        sticking = tuple(np.flatnonzero(np.logical_not(pattern)).tolist())
        ratio, names, row = find_minors(formation, part, Xi[rows_of], sticking).find_least()
        margins.append(UniquenessMargin(ratio, names, float(motion.t[rows[rows_of[row]]])))
    return min(margins)


def find_wedged(
    problem: Problem,
    phase: Phase,
    motion: Trajectory | Simulation,
    rows: Numbers,
    slow: float,
    start: float = -np.inf,
) -> float | None:
    """Time for which friction may hold a phase that begins at rest (static indeterminacy) [s].

    Until no contact forces within their cones, of all contacts that touch, balance torques and
    gravity: see `mechanics.statics`. None if the phase does not begin at rest.

    Parameters
    ----------
    rows         its rows in the phase
    slow         speed that passes for rest, relative to the scene's
    start : [s]  since when the phase is to move, if its rows begin with the time for which it is
                 held
    """
    scene, contacts = problem.scene, phase.formation.contacts
    if phase.index:
        if measure_speed(scene, motion.z_dot[rows[0]]) > slow * scene.scales.speed:
            return None
        contacts += problem.phases[phase.index - 1].formation.contacts
    touching = Formation(scene, tuple(dict.fromkeys(contacts)))
    static = Statics(touching, motion.z[rows[0]]).torque_polygon()
    start, stop = max(start, float(motion.t[rows[0]])), float(motion.t[rows[-1]])
    t = np.linspace(start, stop, 4 * PLACES)
    # At its end the torques are those of the next phase.
    beyond = static.measure(motion.torque.at(t[:-1])) - SURE * scene.scales.torque
    free = np.flatnonzero(beyond > 0)
    if not len(free):
        return float(stop - start)
    if free[0] == 0:
        return 0.0
    before, after = beyond[free[0] - 1], beyond[free[0]]
    return float((free[0] - after / (after - before)) * (t[1] - t[0]))
