"""One phase as an ordinary user would integrate it: `scipy.integrate.solve_ivp`, piece by piece."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from wholearm import Problem, TorqueProfile
from wholearm.benchmark.precision.reference import evaluate_piece, find_piece, solve_motion
from wholearm.common.arrays import Array
from wholearm.mechanics.dynamics import Directions


class Integrated(NamedTuple):
    """The time and the state (z, z') that a run ends at, and the index of the contact it lost."""

    t: float
    state: Array
    lost: int | None


def integrate_phase(
    problem: Problem,
    index: int,
    torque: TorqueProfile,
    state: Array,
    directions: Directions,
    span: tuple[float, float],
    *,
    accuracy: float = 1e-12,
) -> Integrated:
    """Integrate a phase until `span` ends or the first c_n falls to zero, directions as they are.

    Parameters
    ----------
    state : ndarray, shape (10,)
        At the start of `span`.
    accuracy : float
        Relative and absolute, of each step.
    """
    contacts, piece = problem.phases[index].formation.contacts, 0

    def forces(t: float, y: Array) -> tuple[Array, Array]:
        tau = evaluate_piece(torque, piece, t)
        return solve_motion(problem.scene, contacts, y[:5], y[5:], tau, *directions)

    def derivative(t: float, y: Array) -> Array:
        return np.concatenate([y[5:], forces(t, y)[0]])

    def falls(k: int) -> Callable[[float, Array], float]:
        def event(t: float, y: Array) -> float:
            return float(forces(t, y)[1][k])

        event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
        return event

    events, lost = [falls(k) for k in range(len(contacts))], None
    inner = torque.breaks[(torque.breaks > span[0]) & (torque.breaks < span[1])]
    for start, stop in pairwise([span[0], *inner.tolist(), span[1]]):
        piece = find_piece(torque, (start + stop) / 2)
        run = solve_ivp(
            derivative, (start, stop), state, "DOP853", rtol=accuracy, atol=accuracy, events=events
        )
        state = run.y[:, -1]
        if run.status == 1:
            lost = next(k for k, times in enumerate(run.t_events) if len(times))
            break
    return Integrated(float(run.t[-1]), state, lost)
