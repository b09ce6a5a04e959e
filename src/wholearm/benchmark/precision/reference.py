"""An independent reference for simulators: extrapolation in extended precision.

Gragg's modified midpoint rule with 2, 4, ... steps, extrapolated in the square of the step, on the
Newton-Euler equations of `newton` in NumPy's `longdouble` (64 bits of mantissa on
x86). Directions reverse where the sliding velocity vanishes, which a secant finds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...geometry.curve import Curve
from ...problem.definition import Problem
from ...results.torque import TorqueProfile
from .newton import evaluate_piece, find_piece, find_sliding, solve_motion

COLUMNS = 9
"""Columns of the extrapolation."""
TOLERANCE = 1e-17
"""Largest difference of the last two columns, over each entry or 1 where that is more."""
LOOSER = 1e4
"""Factor on the tolerance of the run that the own error is found with."""
_SMALLEST = 1e-9

Extended = Any
"""An array of `longdouble`."""


class Span(NamedTuple):
    """A stretch of time within one piece of the torques, without a reversal.

    Attributes
    ----------
    start, stop : float, [s]
    piece : int
        Of the torques.
    Xi, sigma : ndarray, shape (n_c,) and (2,)
        Directions of sliding and of the joints.
    """

    start: float
    stop: float
    piece: int
    Xi: Array
    sigma: Array


class Course(NamedTuple):
    """One phase with torques, and where it gets to.

    Attributes
    ----------
    problem : Problem
        Of that phase alone.
    torque : TorqueProfile
    spans : tuple of Span
    end : ndarray, shape (10,)
        State (z, z') when the torques end.
    own_error : float
        Of that state, relative to the scene.
    """

    problem: Problem
    torque: TorqueProfile
    spans: tuple[Span, ...]
    end: Array
    own_error: float


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
