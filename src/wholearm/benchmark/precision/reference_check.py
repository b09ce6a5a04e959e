"""An independent check of plans: their torques are replayed, whoever made them.

Fixed steps of the classical Runge-Kutta method on the equations of motion, open loop from rest.
Directions reverse when the plan says so, and lost contacts pull: how much is what is measured.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from .phases import OPTIMUM, Instance, PeerPlan
from .reference import Course, Span, measure_error
from .runs import SOLVED
from .simulators import pack_span, write_rates

STEPS = 1000  # least number of steps of a replay
CLOSE = 1e-2
"""Error of the end state, and of torques over their limits, up to which a plan counts as one."""
LOOKS = 9  # instants of every piece of the torques at which their limits are looked at


class ReferenceCheck(NamedTuple):
    """What a replay has shown."""

    end: float  # error of the end state, relative to the scene
    # worst violation of c_n >= epsilon, over the scene's force, or of a torque limit, over it
    violation: float
    outcome: str  # `SOLVED`, or why the plan is none


def check_plan(instance: Instance, plan: PeerPlan) -> ReferenceCheck:
    """Replay a plan."""
    if plan.status != OPTIMUM:
        return ReferenceCheck(math.nan, math.nan, plan.status)
    problem = instance.problem
    spans = _split(instance, plan)
    course = Course(problem, plan.torque, spans, np.zeros(10), 0.0)
    columns = [[*pack_span(course, span), span.start, span.stop] for span in spans]
    step = _build_step(course).mapaccum(len(spans))
    start = ca.DM(np.append(problem.start, np.zeros(5)))
    states, forces = (part.full() for part in step(start, ca.DM(np.array(columns).T)))
    rest = np.append(instance.curve.end, np.zeros(5))
    end = measure_error(problem, states[:, -1], rest)
    limit = problem.scene.torque_limit
    excess = float((np.abs(_look_at_torques(plan)) / limit - 1).max())
    missing = (problem.epsilon - float(forces.min())) / problem.scene.scales.force
    violation = max(0.0, excess, missing)
    outcome = SOLVED
    if not forces.min() > 0:
        outcome = "a contact is lost between nodes"
    elif not end <= CLOSE:
        outcome = "the replay ends elsewhere"
    elif not excess <= CLOSE:
        outcome = "a torque limit is missed between nodes"
    return ReferenceCheck(end, violation, outcome)


def _split(instance: Instance, plan: PeerPlan) -> tuple[Span, ...]:
    """Steps of the replay: within pieces of the torques, and between reversals."""
    breaks, stop = plan.torque.breaks, plan.torque.breaks[-1]
    inner = np.append(breaks, plan.marks)
    even = np.linspace(0.0, stop, STEPS + 1)
    ends = np.unique(np.concatenate([inner, even[1:-1]]))
    ends = ends[np.append(np.diff(ends) > 1e-12 * stop, True)]
    middle = (ends[1:] + ends[:-1]) / 2
    pieces = np.clip(np.searchsorted(breaks, middle, side="right") - 1, 0, len(breaks) - 2)
    owners = np.searchsorted(plan.marks, middle)
    parts = instance.curve.segments
    return tuple(
        Span(float(start), float(end), int(piece), parts[owner].Xi, parts[owner].sigma)
        for start, end, piece, owner in zip(ends[:-1], ends[1:], pieces, owners, strict=True)
    )


def _build_step(course: Course) -> Expression:
    """CasADi function (y, parameters) -> (y at the end, contact forces at start and end)."""
    t, y, p, ode, forces = write_rates(course)
    rates = ca.Function("rates", [t, y, p], [ode, forces])
    ends = ca.SX.sym("ends", 2)
    h, middle = ends[1] - ends[0], (ends[0] + ends[1]) / 2
    k1, before = rates(ends[0], y, p)
    k2, _ = rates(middle, y + h / 2 * k1, p)
    k3, _ = rates(middle, y + h / 2 * k2, p)
    k4, _ = rates(ends[1], y + h * k3, p)
    after = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    _, then = rates(ends[1], after, p)
    given = [y, ca.vertcat(p, ends)]
    return ca.Function("step", given, [after, ca.vertcat(before, then)])


def _look_at_torques(plan: PeerPlan) -> Array:
    """Torques at instants of every piece, its ends included, shape (n, 2) [N m]."""
    x = np.cos(np.linspace(0.0, np.pi, LOOKS))
    powers = x[:, None] ** np.arange(plan.torque.coefficients.shape[2])
    return np.asarray(np.einsum("kjd,nd->knj", plan.torque.coefficients, powers).reshape(-1, 2))
