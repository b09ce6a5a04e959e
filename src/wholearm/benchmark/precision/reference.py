"""An independent reference for simulators: Newton-Euler equations at the tightest tolerance.

The Newton-Euler equations of object and fingers, with contacts that are points with normals of
rigid bodies (`verification.newton_euler`), are solved together with the contact conditions as one
linear system. Nothing is shared with the package's own contacts and dynamics; friction keeps the
directions that it is given. They are integrated by SciPy's DOP853 from step to step of the torques,
in double precision. Directions reverse where the sliding velocity vanishes.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from ...verification.newton_euler import locate


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
    contacts: Sequence[Contact],
    z: Array,
    z_dot: Array,
    tau: Array,
    Xi: Array,
    sigma: Array,
) -> tuple[Array, Array]:
    """Accelerations z'', shape (5,), and c_n, shape (n_c,) [N], from one linear system.

    The unknowns are those of Eqs. (1) and (2) with the friction of Eq. (3) put in, together with
    the contact conditions differentiated twice: rates of their rows by complex steps.
    """
    tiny = 1e-30  # [s]
    ahead = (z + 1j * tiny * z_dot)[None]
    touches = [locate(scene, contact.name, ahead) for contact in contacts]
    rows = np.array([touch.normal[0] for touch in touches])
    slide = np.array([touch.friction * touch.tangent[0].real for touch in touches])
    friction = scene.viscous * z_dot + scene.dry * np.append(np.zeros(3), sigma)
    force = scene.applied_force + np.append(np.zeros(3), tau) - friction
    count = len(rows)
    matrix = np.zeros((5 + count, 5 + count))
    matrix[range(5), range(5)] = scene.mass_diagonal
    matrix[:5, 5:], matrix[5:, :5] = (Xi[:, None] * slide - rows.real).T, rows.real
    solution = np.linalg.solve(matrix, np.append(force, -rows.imag @ z_dot / tiny))
    return np.asarray(solution[:5]), np.asarray(solution[5:])


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
    # The smallest tolerance that SciPy takes, and a larger one.
    end, spans, _ = integrate(problem, torque, curve, reversals, 2.3e-14)
    rough, *_ = integrate(problem, torque, curve, reversals, 2.3e-12)
    return Course(problem, torque, spans, end, measure_error(problem, rough, end))


def measure_error(problem: Problem, state: Array, exact: Array) -> float:
    """Largest difference of two states (z, z'), relative to length and time of the scene."""
    scales = problem.scene.scales
    unit = np.array([scales.length, scales.length, 1.0, 1.0, 1.0])
    return float(np.abs((state - exact) / np.append(unit, unit / scales.time)).max())


def integrate(
    problem: Problem, torque: TorqueProfile, curve: Curve, reversals: int, tolerance: float
) -> tuple[Array, tuple[Span, ...], float]:
    """State at the end of torques, the stretches on the way there, and the least c_n of all steps.

    Contacts stay closed: those that are lost pull.
    """
    contacts, formation = problem.phases[0].formation.contacts, curve.formation
    t, y, spans, least = 0.0, np.append(problem.start, np.zeros(5)), list[Span](), np.inf
    parts = [*curve.segments[: reversals + 1]]
    while t < torque.breaks[-1]:
        part, piece = parts[0], find_piece(torque, t)

        def solve(
            t: float, y: Array, part: Segment = part, piece: int = piece
        ) -> tuple[Array, Array]:
            tau = evaluate_piece(torque, piece, t)
            return solve_motion(problem.scene, contacts, y[:5], y[5:], tau, part.Xi, part.sigma)

        def rates(t: float, y: Array, solve: Any = solve) -> Array:
            return np.concatenate([y[5:], solve(t, y)[0]])

        events = [_find_reversal(formation, *parts[:2])] if len(parts) > 1 else []
        options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "events": events}
        run = solve_ivp(rates, (t, torque.breaks[piece + 1]), y, "DOP853", **options)
        least = min([least, *(solve(*own)[1].min() for own in zip(run.t, run.y.T, strict=True))])
        start, t, y = t, float(run.t[-1]), run.y[:, -1]
        spans.append(Span(start, t, piece, part.Xi, part.sigma))
        parts = parts[1:] if run.status == 1 else parts
    return y, tuple(spans), float(least)


def _find_reversal(formation: Formation, before: Segment, after: Segment) -> Any:
    """Event at which the rate vanishes whose direction differs in two segments."""
    directions = np.append(before.Xi, before.sigma)
    row = int(np.flatnonzero(directions * np.append(after.Xi, after.sigma) < 0)[0])

    def rate(_: float, y: Array) -> float:
        if row >= len(before.Xi):
            return float(y[8 + row - len(before.Xi)])
        touch = locate(formation.scene, formation.contacts[row].name, y[None, :5])
        return float(touch.tangent[0] @ y[5:])

    rate.terminal, rate.direction = True, -directions[row]  # type: ignore[attr-defined]
    return rate
