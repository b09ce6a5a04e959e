"""An independent reference for simulators: Newton-Euler equations at the tightest tolerance.

The Newton-Euler equations of object and fingers are written out contact by contact, and solved
together with the contact conditions as one linear system. Nothing is shared with the package's own
contacts and dynamics; friction keeps the directions that it is given. They are integrated by
SciPy's DOP853 from step to step of the torques, in double precision. Directions reverse where the
sliding velocity vanishes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from ...common.arrays import Array
from ...contacts.elemental import Contact
from ...contacts.formation import Formation
from ...geometry.curve import Curve, Segment
from ...problem.definition import Problem
from ...results.torque import TorqueProfile
from ...scene.model import Scene


def find_piece(torque: TorqueProfile, t: float) -> int:
    """The piece of the torques that a time is in, or the nearest one."""
    piece = int(np.searchsorted(torque.breaks, t, side="right")) - 1
    return min(max(piece, 0), len(torque.coefficients) - 1)


def evaluate_piece(torque: TorqueProfile, piece: int, t: float) -> Array:
    """Torques of one piece at a time, shape (2,) [N m]."""
    start, stop = torque.breaks[piece], torque.breaks[piece + 1]
    x = (2 * t - start - stop) / (stop - start)
    return np.asarray(torque.coefficients[piece] @ x ** np.arange(torque.coefficients.shape[2]))


def solve_motion(
    scene: Scene,
    contacts: tuple[Contact, ...],
    z: Array,
    z_dot: Array,
    tau: Array,
    Xi: Array,
    sigma: Array,
) -> tuple[Array, Array]:
    """Accelerations z'', shape (5,), and c_n, shape (n_c,) [N], from one linear system.

    The unknowns are those of Eqs. (1) and (2) with the friction of Eq. (3) put in, together with
    the contact conditions differentiated twice.
    """
    count = len(contacts)
    matrix, right = np.zeros((5 + count, 5 + count)), np.zeros(5 + count)
    matrix[range(5), range(5)] = scene.mass_diagonal
    right[1] = -scene.polygon.mass * scene.gravity
    for i, finger in enumerate(scene.fingers):
        friction = finger.viscous * z_dot[3 + i] + finger.dry * sigma[i]
        right[3 + i] = tau[i] - friction
    for k, contact in enumerate(contacts):
        point, normal, bend = _touch(scene, contact, z, z_dot)
        tangent = np.array([normal[1], -normal[0]])
        coefficient = scene.friction.of(contact.finger)
        row = _lever(scene, contact, z, point, normal)
        force = row - coefficient * Xi[k] * _lever(scene, contact, z, point, tangent)
        matrix[:5, 5 + k] = -force
        matrix[5 + k, :5] = row
        right[5 + k] = -bend
    solution = np.linalg.solve(matrix, right)
    return np.asarray(solution[:5]), np.asarray(solution[5:])


def find_sliding(scene: Scene, contact: Contact, z: Array, z_dot: Array) -> float:
    """Sliding velocity of a contact [m/s]."""
    point, normal, _ = _touch(scene, contact, z, z_dot)
    tangent = np.array([normal[1], -normal[0]])
    return float(_lever(scene, contact, z, point, tangent) @ z_dot)


def _lever(scene: Scene, contact: Contact, z: Array, point: Array, force: Array) -> Array:
    """Generalised force of a unit force on the object at `point` and its reaction on the finger."""
    row = np.zeros(5)
    arm = point - z[:2]
    row[:3] = force[0], force[1], arm[0] * force[1] - arm[1] * force[0]
    if contact.finger is not None:
        arm = point - np.asarray(scene.fingers[contact.finger].base)
        row[3 + contact.finger] = -(arm[0] * force[1] - arm[1] * force[0])
    return row


def _touch(scene: Scene, contact: Contact, z: Array, z_dot: Array) -> tuple[Array, Array, float]:
    """Contact point, normal into the object, and the gap's second derivative less A z''."""
    c, s = np.cos(z[2]), np.sin(z[2])
    turn = np.array([[c, -s], [s, c]])
    spin = z_dot[2]
    arm = turn @ scene.polygon.vertices[contact.index]
    vertex = z[:2] + arm
    velocity = z_dot[:2] + spin * np.array([-arm[1], arm[0]])
    if contact.finger is None:
        return vertex, np.array([0.0, 1.0]), -(spin**2) * arm[1]
    finger = scene.fingers[contact.finger]
    angle, rate = z[3 + contact.finger], z_dot[3 + contact.finger]
    axis = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-axis[1], axis[0]])
    if contact.surface == "finger":
        side = 1.0 if contact.finger == 0 else -1.0
        normal = side * across
        swing = -side * rate * axis
        reach = vertex - np.asarray(finger.base)
        bend = 2 * swing @ velocity - rate**2 * normal @ reach - spin**2 * normal @ arm
        return vertex, normal, bend
    if contact.feature != "e":
        raise ValueError(f"{contact.name}: the baseline knows no contacts with a tip's arc")
    following = scene.polygon.vertices[(contact.index + 1) % scene.polygon.n_vertices]
    along = turn @ following - arm
    along = along / np.hypot(*along)
    outward = np.array([along[1], -along[0]])
    tip = np.asarray(finger.base) + finger.length * axis
    tip_velocity = finger.length * rate * across
    swing = spin * np.array([-outward[1], outward[0]])
    bend = (
        2 * swing @ (tip_velocity - velocity)
        - spin**2 * outward @ (tip - vertex)
        + outward @ (spin**2 * arm - rate**2 * finger.length * axis)
    )
    return tip - finger.radius * outward, -outward, bend


TOLERANCE = 2.3e-14  # of the integration, relative: the smallest that SciPy takes
LOOSER = 100.0  # factor on the tolerance of the run that the reference's error is found with


class Span(NamedTuple):
    """A stretch of time within one piece of the torques, without a reversal."""

    start: float  # start, stop [s]:
    stop: float
    piece: int  # of the torques
    Xi: Array  # Xi, sigma (n_c,) and (2,): directions of sliding and of the joints
    sigma: Array


class Course(NamedTuple):
    """One phase with torques, and where it gets to."""

    problem: Problem  # of that phase alone
    torque: TorqueProfile
    spans: tuple[Span, ...]
    end: Array  # (10,): state (z, z') when the torques end
    own_error: float  # of that state, relative to the scene


def find_course(problem: Problem, torque: TorqueProfile, curve: Curve, reversals: int) -> Course:
    """Integrate torques along a phase whose directions reverse so often."""
    end, spans = _integrate(problem, torque, curve, reversals, TOLERANCE)
    rough, _ = _integrate(problem, torque, curve, reversals, LOOSER * TOLERANCE)
    return Course(problem, torque, spans, end, measure_error(problem, rough, end))


def measure_error(problem: Problem, state: Array, exact: Array) -> float:
    """Largest difference of two states (z, z'), relative to length and time of the scene."""
    scales = problem.scene.scales
    unit = np.array([scales.length, scales.length, 1.0, 1.0, 1.0])
    return float(np.abs((state - exact) / np.append(unit, unit / scales.time)).max())


def _integrate(
    problem: Problem, torque: TorqueProfile, curve: Curve, reversals: int, tolerance: float
) -> tuple[Array, tuple[Span, ...]]:
    """The state at the end, and the stretches on the way there."""
    contacts, formation = problem.phases[0].formation.contacts, curve.formation
    t, y, spans = 0.0, np.append(problem.start, np.zeros(5)), list[Span]()
    parts = [*curve.segments[: reversals + 1]]
    while t < torque.breaks[-1]:
        part, piece = parts[0], find_piece(torque, t)

        def rates(t: float, y: Array, part: Segment = part, piece: int = piece) -> Array:
            tau = evaluate_piece(torque, piece, t)
            found = solve_motion(problem.scene, contacts, y[:5], y[5:], tau, part.Xi, part.sigma)
            return np.concatenate([y[5:], found[0]])

        events = [_find_reversal(formation, *parts[:2])] if len(parts) > 1 else []
        run = solve_ivp(
            rates,
            (t, torque.breaks[piece + 1]),
            y,
            "DOP853",
            rtol=tolerance,
            atol=tolerance,
            events=events,
        )
        start, t, y = t, float(run.t[-1]), run.y[:, -1]
        spans.append(Span(start, t, piece, part.Xi, part.sigma))
        parts = parts[1:] if run.status == 1 else parts
    return y, tuple(spans)


def _find_reversal(formation: Formation, before: Segment, after: Segment) -> Any:
    """Event at which the rate vanishes whose direction differs in two segments."""
    directions = np.append(before.Xi, before.sigma)
    row = int(np.flatnonzero(directions * np.append(after.Xi, after.sigma) < 0)[0])

    def rate(_: float, y: Array) -> float:
        if row >= len(before.Xi):
            return float(y[8 + row - len(before.Xi)])
        return find_sliding(formation.scene, formation.contacts[row], y[:5], y[5:])

    rate.terminal, rate.direction = True, -directions[row]  # type: ignore[attr-defined]
    return rate
