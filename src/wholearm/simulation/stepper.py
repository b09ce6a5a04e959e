"""Steps of the simulation, compiled for one contact formation and what friction holds in it.

A whole Runge-Kutta step, with the projection on the contacts and everything that events are found
from, is one CasADi function of one packed vector, so that a step costs one call.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..contacts.elemental import GapLimit, build_features, build_gap
from ..contacts.formation import Formation
from ..problem.definition import Until
from .layout import STATE, EventRows, Inputs, Outputs, lay_out
from .mode_equations import Mechanics, share_mechanics
from .modes import FREE, Grips, Mode
from .runge_kutta import build_step
from .tolerances import find_tolerances


@dataclass(frozen=True, eq=False)
class Stepper:
    """The compiled steps of one formation, with what sticks and is held in it.

    Calling `step` or `look` reads `inputs` and overwrites `outputs`. Each simulation has its own.

    Attributes
    ----------
    mode : Mode
    inputs, outputs : ndarray
        Packed vectors.
    at, to : Inputs, Outputs
        Their layouts.
    rows : EventRows
    slack : ndarray, shape (n_events,)
        How far below zero each event value counts as rounding.
    step, look : callable
        A step of length h; the same outputs at the state given, without a step.
    """

    mode: Mode
    inputs: Array
    outputs: Array
    at: Inputs
    to: Outputs
    rows: EventRows
    slack: Array
    step: Any
    look: Any
    _keep: Any

    @property
    def formation(self) -> Formation:
        """The phase's formation."""
        return self.mode.formation

    @property
    def is_free(self) -> bool:
        """Whether more than one freedom is left."""
        return self.mode.n_constraints < 4


def build_stepper(
    formation: Formation, until: Until, side: float, degree: int, grips: Grips = FREE
) -> Stepper:
    """Return the steps of a formation for torques of a polynomial degree, compiled when first used.

    Parameters
    ----------
    formation : Formation
    until : Until
        What ends the phase.
    side : float
        +1 or -1: the sign of (coordinate - value) before the end, when `until` is a coordinate.
    degree : int
        Of the torque's polynomials.
    grips : Grips
        What friction holds meanwhile.
    """
    mode, functions, at, to, rows, slack = _compile(formation, until, side, degree, grips)
    inputs, results = np.zeros(at.size), np.zeros(to.size)
    buffers = [function.buffer() for function in functions]
    for buffer, _ in buffers:
        buffer.set_arg(0, inputs.data)
        buffer.set_res(0, results.data)
    step, look = (call for _, call in buffers)
    return Stepper(mode, inputs, results, at, to, rows, slack, step, look, buffers)


@lru_cache(maxsize=64)
def _compile(
    formation: Formation, until: Until, side: float, degree: int, grips: Grips
) -> tuple[Mode, list[Expression], Inputs, Outputs, EventRows, Array]:
    mode = Mode(formation, grips)
    mechanics = share_mechanics(mode, degree)
    at, n_c, held = mechanics.at, formation.n_contacts, len(mode.holders)
    limits = len(open_limits(formation, until))
    rows = EventRows(*lay_out(n_c, 2 * held, n_c, 2, limits, None, None))
    to = Outputs(*lay_out(STATE, 5, n_c, n_c, 2, 5, None, None, None, None, None, rows.size))
    short = find_tolerances(formation.scene).short
    slack = np.concatenate([mechanics.slack, np.full(limits, short), [0.0, mechanics.stall]])
    measure = _build_measure(formation, until, side, short)
    # What follows only says what calls what, which is quicker than writing out every stage.
    packed, forces = ca.MX.sym("packed", at.size), []
    y, t, h = packed[at.y], packed[at.t], packed[at.h]

    stage = _build_stage(mode, mechanics)

    def rate(state: Expression, time: Expression) -> Expression:
        rates, force = stage(state, time, packed)
        forces.append(force)
        return rates

    def report(state: Expression, time: Expression, *errors: Expression) -> Expression:
        _, *constraints = mode.build_constraints(state[:5], state[5:10])
        outputs, events, speed, least = mechanics.report(state, time, packed, *constraints)
        values, distance, approach, closest = measure(state[:5], state[5:10])
        error, dip = errors
        worst = ca.fmin(least, closest)
        return ca.vertcat(outputs, error, worst, dip, approach, events, values, distance, speed)

    end, fifth, third = build_step(rate, y, t, h)
    error = mechanics.error(fifth, third, packed)
    end = _project(mode, mechanics, end, packed[at.kept])
    results = {
        "step": report(end, t + h, error, ca.mmin(ca.vertcat(*forces))),
        "look": report(y, t, 0, 0),
    }
    functions = [ca.Function(name, [packed], [result]) for name, result in results.items()]
    return mode, functions, at, to, rows, slack


def _build_stage(mode: Mode, mechanics: Mechanics) -> Expression:
    """CasADi function (state, time, packed) -> (its rates, the least that holds it)."""
    state, time = ca.SX.sym("state", STATE), ca.SX.sym("time")
    packed = ca.SX.sym("packed", mechanics.at.size)
    _, *rows = mode.build_constraints(state[:5], state[5:10])
    return ca.Function("stage", [state, time, packed], mechanics.stage(state, time, packed, *rows))


def _build_measure(formation: Formation, until: Until, side: float, short: float) -> Expression:
    """CasADi function (z, v) -> limits, distance to the end, its rate, least slack of these."""
    z, v = build_features(formation.scene).z, ca.SX.sym("v", 5)
    gained = [limit for limit in formation.limits if limit.gains(until.contact)]
    if until.is_release:
        distance = ca.SX(1)
    elif until.contact is None:
        distance = side * (z[0 if until.coordinate == "x" else 2] - until.value)
    elif gained:
        distance = gained[0].value
    else:
        distance = build_gap(until.contact, formation.scene)
    values = ca.vertcat(*(limit.value for limit in open_limits(formation, until)))
    closest = ca.mmin(ca.vertcat(values + short, distance))
    parts = [values, distance, ca.jtimes(distance, z, v), closest]
    return ca.Function("measure", [z, v], [ca.densify(part) for part in parts])


def open_limits(formation: Formation, until: Until) -> list[GapLimit]:
    """Limits that end a phase early: all but that of the contact to be gained."""
    return [limit for limit in formation.limits if not limit.gains(until.contact)]


def _project(mode: Mode, mechanics: Mechanics, y: Expression, kept: Expression) -> Expression:
    """Move z to closed gaps and what is kept, and z' to P z' = 0, the shortest way in metric M5.

    A step leaves gaps of the size of its error, so one Newton iteration closes them to rounding.
    """
    z, v = y[:5], y[5:10]
    held, P, _, _ = mode.build_constraints(z, v)
    wanted = ca.vertcat(ca.DM(mode.formation.n_contacts, 1), kept)
    z = z - mechanics.correct(P, held - wanted)
    _, P, _, _ = mode.build_constraints(z, v)
    v = v - mechanics.correct(P, P @ v)
    return ca.vertcat(z, v, y[10:])
