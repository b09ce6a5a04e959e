"""Steps of the simulation, compiled for one contact formation and what friction holds in it.

A whole Runge-Kutta step, with the projection on the contacts and everything that events are found
from, is one CasADi function of one packed vector, so that a step costs one call.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..contacts.elemental import GapLimit, build_features, build_gap
from ..contacts.formation import Formation
from ..problem.definition import Until
from .layout import MOVING, STATE, EventRows, Inputs, Outputs, lay_out
from .mode_equations import Mechanics, share_mechanics
from .modes import FREE, Grips, Mode
from .runge_kutta import GLIMPSES, build_step
from .tolerances import find_tolerances


class Compiled(NamedTuple):
    """What all steppers of a formation share.

    Attributes
    ----------
    mode : Mode
    at, to : Inputs, Outputs
        Layouts of the packed vectors.
    rows : EventRows
    slack : ndarray, shape (n_events,)
        How far below zero each event value counts as rounding.
    step, look : casadi.Function
        Of the packed inputs.
    """

    mode: Mode
    at: Inputs
    to: Outputs
    rows: EventRows
    slack: Array
    step: Expression
    look: Expression


class Stepper(NamedTuple):
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
    buffers : list
        What has to live as long as these.
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
    buffers: Any

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
    c = _compile(formation, until, side, degree, grips)
    inputs, results = np.zeros(c.at.size), np.zeros(c.to.size)
    buffers = [function.buffer() for function in (c.step, c.look)]
    for buffer, _ in buffers:
        buffer.set_arg(0, inputs.data)
        buffer.set_res(0, results.data)
    step, look = (call for _, call in buffers)
    known = c.mode, inputs, results, c.at, c.to, c.rows, c.slack
    return Stepper(*known, step, look, buffers)


class _Equations:
    """Equations of a formation, as expressions of one packed vector.

    They only say what calls what, which is quicker to compile than writing out every stage.
    """

    def __init__(
        self, formation: Formation, until: Until, side: float, degree: int, grips: Grips
    ) -> None:
        self.mode = mode = Mode(formation, grips)
        self.mechanics = share_mechanics(mode, degree)
        self.short = find_tolerances(formation.scene).short
        self._measure = _build_measure(formation, until, side, self.short)
        self._stage = _build_stage(mode, self.mechanics)
        self.packed = ca.MX.sym("packed", self.mechanics.at.size)
        self.least: list[Expression] = []
        self.c_n: list[Expression] = []

    def rate(self, state: Expression, time: Expression) -> Expression:
        """Rates of the state at the next stage, whose forces are kept."""
        rates, least, c_n = self._stage(state, time, self.packed)
        self.least.append(least)
        self.c_n.append(c_n)
        return rates

    def report(self, state: Expression, time: Expression, *errors: Expression) -> Expression:
        """Outputs at a state, with error, dip and glimpses of the step that led there."""
        mechanics, packed = self.mechanics, self.packed
        _, *constraints = self.mode.build_constraints(state[:5], state[5:10])
        outputs, events, speed, least = mechanics.report(state, time, packed, *constraints)
        values, distance, approach, closest = self._measure(state[:5], state[5:10])
        error, dip, glimpses = errors
        worst = ca.fmin(least, closest)
        return ca.vertcat(
            outputs, error, worst, dip, glimpses, approach, events, values, distance, speed
        )

    def project(self, state: Expression) -> Expression:
        """The state moved onto the contacts and what friction keeps."""
        return _project(self.mode, self.mechanics, state, self.packed[self.mechanics.at.kept])


@lru_cache(maxsize=64)
def _compile(
    formation: Formation, until: Until, side: float, degree: int, grips: Grips
) -> Compiled:
    own = _Equations(formation, until, side, degree, grips)
    mechanics, mode, packed = own.mechanics, own.mode, own.packed
    at, n_c, held = mechanics.at, formation.n_contacts, len(mode.holders)
    limits = len(open_limits(formation, until))
    rows = EventRows(*lay_out(n_c, 2 * held, n_c, 2, limits, None, None))
    brief = len(GLIMPSES) * n_c
    to = Outputs(*lay_out(STATE, 5, n_c, n_c, 2, 5, None, None, None, None, brief, None, rows.size))
    slack = np.concatenate([mechanics.slack, np.full(limits, own.short), [0.0, mechanics.stall]])
    y, t, h = packed[at.y], packed[at.t], packed[at.h]
    end, fifth, third = build_step(own.rate, y, t, h, MOVING)
    error = mechanics.error(fifth, third, packed)
    glimpses = ca.vertcat(*(own.c_n[stage] for stage in GLIMPSES))
    dip = ca.mmin(ca.vertcat(*own.least))
    seen = own.report(own.project(end), t + h, error, dip, glimpses)
    step = ca.Function("step", [packed], [seen])
    look = ca.Function("look", [packed], [own.report(y, t, 0, 0, ca.DM.zeros(brief))])
    return Compiled(mode, at, to, rows, slack, step, look)


def _build_stage(mode: Mode, mechanics: Mechanics) -> Expression:
    """CasADi function (state, time, packed) -> (its rates, the least that holds it, c_n)."""
    state, time = ca.SX.sym("state", MOVING), ca.SX.sym("time")
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
        # A pointed tip comes to a vertex along the edge, or turns onto it with its link.
        distance = ca.mmin(ca.vertcat(*(limit.value for limit in gained)))
    else:
        distance = build_gap(until.contact, formation.scene)
    values = ca.vertcat(*(limit.value for limit in open_limits(formation, until)))
    closest = ca.mmin(ca.vertcat(values + short, distance))
    parts = [values, distance, ca.jtimes(distance, z, v), closest]
    return ca.Function("measure", [z, v], [ca.densify(part) for part in parts])


@lru_cache(maxsize=64)
def open_limits(formation: Formation, until: Until) -> tuple[GapLimit, ...]:
    """Limits that end a phase early: all but that of the contact to be gained."""
    return tuple(limit for limit in formation.limits if not limit.gains(until.contact))


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
