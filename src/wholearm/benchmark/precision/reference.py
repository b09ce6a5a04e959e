"""An independent reference for simulators: extrapolation in extended precision.

The Newton-Euler equations of object and fingers are written out contact by contact, and solved
together with the contact conditions as one linear system. Nothing is shared with the package's own
contacts and dynamics; friction keeps the directions that it is given. They are integrated by
Gragg's modified midpoint rule with 2, 4, ... steps, extrapolated in the square of the step, in
NumPy's `longdouble` (64 bits of mantissa on x86). Directions reverse where the sliding velocity
vanishes, which a secant finds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.elemental import Contact
from ...geometry.curve import Curve
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
    the contact conditions differentiated twice. Extended precision is kept.
    """
    count = len(contacts)
    matrix = np.zeros((5 + count, 5 + count), dtype=z.dtype)
    right = np.zeros(5 + count, dtype=z.dtype)
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
    solution = solve_linear(matrix, right)
    return np.asarray(solution[:5]), np.asarray(solution[5:])


def solve_linear(matrix: Array, right: Array) -> Array:
    """Solve a linear system: by LAPACK, or by elimination what that has no precision for."""
    if matrix.dtype == np.float64:
        return np.asarray(np.linalg.solve(matrix, right))
    table = np.column_stack([matrix, right])
    for k in range(len(table)):
        pivot = k + int(np.abs(table[k:, k]).argmax())
        table[[k, pivot]] = table[[pivot, k]]
        table[k] /= table[k, k]
        factors = table[:, k].copy()
        factors[k] = 0.0
        table -= factors[:, None] * table[k]
    return np.asarray(table[:, -1])


def find_sliding(scene: Scene, contact: Contact, z: Array, z_dot: Array) -> Any:
    """Sliding velocity of a contact [m/s]."""
    point, normal, _ = _touch(scene, contact, z, z_dot)
    tangent = np.array([normal[1], -normal[0]])
    return _lever(scene, contact, z, point, tangent) @ z_dot


def _lever(scene: Scene, contact: Contact, z: Array, point: Array, force: Array) -> Array:
    """Generalised force of a unit force on the object at `point` and its reaction on the finger."""
    row = np.zeros(5, dtype=z.dtype)
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


COLUMNS = 9  # columns of the extrapolation
TOLERANCE = 1e-17
"""Largest difference of the last two columns, over each entry or 1 where that is more."""
LOOSER = 1e4  # factor on the tolerance of the run that the own error is found with
_SMALLEST = 1e-9

Extended = Any
"""An array of `longdouble`."""


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


def find_course(problem: Problem, torque: TorqueProfile, curve: Curve, reversals: Array) -> Course:
    """Integrate torques along a phase whose directions reverse at about the given instants."""
    # The first steps that are tried are far too long.
    with np.errstate(all="ignore"):
        exact, spans = _integrate(problem, torque, curve, reversals, TOLERANCE)
        looser, _ = _integrate(problem, torque, curve, reversals, LOOSER * TOLERANCE)
    end, rough = (np.asarray(state, dtype=float) for state in (exact, looser))
    return Course(problem, torque, spans, end, measure_error(problem, rough, end))


def measure_error(problem: Problem, state: Array, exact: Array) -> float:
    """Largest difference of two states (z, z'), relative to length and time of the scene."""
    scales = problem.scene.scales
    unit = np.array([scales.length, scales.length, 1.0, 1.0, 1.0])
    return float(np.abs((state - exact) / np.append(unit, unit / scales.time)).max())


def _integrate(
    problem: Problem, torque: TorqueProfile, curve: Curve, reversals: Array, tolerance: float
) -> tuple[Extended, tuple[Span, ...]]:
    """The state at the end, and the stretches on the way there."""
    (phase,), stop = problem.phases, float(torque.breaks[-1])
    contacts = phase.formation.contacts
    y = np.append(problem.start, np.zeros(5)).astype(np.longdouble)
    spans = []
    marks = [*(float(t) for t in reversals if t < stop), stop]
    start = np.longdouble(0.0)
    for index, (part, mark) in enumerate(zip(curve.segments, marks, strict=False)):
        inner = torque.breaks[(torque.breaks > start) & (torque.breaks < mark)]
        for end in [*inner, mark]:
            piece = find_piece(torque, (float(start) + end) / 2)

            def rates(t: Extended, y: Extended, piece: int = piece, part: Any = part) -> Extended:
                tau = evaluate_piece(torque, piece, t)
                found = solve_motion(
                    problem.scene, contacts, y[:5], y[5:], tau, part.Xi, part.sigma
                )
                return np.concatenate([y[5:], found[0]])

            end = np.longdouble(end)
            y = _advance(rates, start, y, end - start, tolerance)
            spans.append(Span(float(start), float(end), piece, part.Xi, part.sigma))
            start = end
        if index + 1 < len(marks):
            start, y = _find_reversal(rates, curve, index, start, y)
            spans[-1] = spans[-1]._replace(stop=float(start))
    return y, tuple(spans)


def _find_reversal(
    rates: Callable[..., Extended], curve: Curve, index: int, t: Extended, y: Extended
) -> tuple[Extended, Extended]:
    """Go on from near a reversal to where the rate that vanishes there is zero."""
    before, after = curve.segments[index : index + 2]
    turned = np.append(before.Xi * after.Xi, before.sigma * after.sigma) < 0
    row = int(np.flatnonzero(turned)[0])

    def rate(y: Extended) -> Extended:
        if row >= len(before.Xi):
            return y[8 + row - len(before.Xi)]
        contact = curve.formation.contacts[row]
        return find_sliding(curve.formation.scene, contact, y[:5], y[5:])

    step = np.longdouble(1e-7)
    for _ in range(4):
        near = _step(rates, t, y, step)[0]
        slope = (rate(near) - rate(y)) / step
        ahead = -rate(y) / slope
        t, y = t + ahead, _step(rates, t, y, ahead)[0]
    return t, y


def _advance(
    rates: Callable[..., Extended], t: Extended, y: Extended, length: Extended, tolerance: float
) -> Extended:
    """Integrate over a length of time, in halves where that is not exact enough."""
    end, difference = _step(rates, t, y, length)
    if difference <= tolerance or length < _SMALLEST:
        return end
    half = _advance(rates, t, y, length / 2, tolerance)
    return _advance(rates, t + length / 2, half, length / 2, tolerance)


def _step(
    rates: Callable[..., Extended], t: Extended, y: Extended, length: Extended
) -> tuple[Extended, float]:
    """One step of the extrapolated midpoint rule, and the difference of its last two columns."""
    first, row = rates(t, y), []
    for column in range(1, COLUMNS + 1):
        count = 2 * column
        h = length / count
        before, here = y, y + h * first
        for k in range(1, count):
            before, here = here, before + 2 * h * rates(t + k * h, here)
        smooth = (before + here + h * rates(t + length, here)) / 2
        row, old = [smooth], row
        for k, known in enumerate(old, start=1):
            ratio = np.longdouble(count) / (count - 2 * k)
            row.append(row[-1] + (row[-1] - known) / (ratio**2 - 1))
    difference = np.abs(row[-1] - row[-2]) / np.maximum(np.abs(y), 1.0)
    return row[-1], float(difference.max())
