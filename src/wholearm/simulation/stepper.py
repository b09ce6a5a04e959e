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

from ..contact import Expression, Limit, build_features, build_gap
from ..formation import Formation
from ..model import Array
from ..problem import Until
from .layout import STATE, EventRows, Inputs, Outputs, lay_out
from .modes import FREE, Grips, Mode
from .rungekutta import build_error, build_step
from .tolerances import ROUNDING_FORCE, find_tolerances, measure_units


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
    mode, functions, at, to, rows = _compile(formation, until, side, degree, grips)
    slack = _slack(mode, rows)
    inputs, results = np.zeros(at.size), np.zeros(to.size)
    buffers = [function.buffer() for function in functions]
    for buffer, _ in buffers:
        buffer.set_arg(0, inputs.data)
        buffer.set_res(0, results.data)
    step, look = (call for _, call in buffers)
    return Stepper(mode, inputs, results, at, to, rows, slack, step, look, buffers)


def _slack(mode: Mode, rows: EventRows) -> Array:
    scene = mode.formation.scene
    tolerances, slack = find_tolerances(scene), np.zeros(rows.size)
    slack[: rows.cone.stop] = ROUNDING_FORCE * mode.hold_units
    slack[rows.slide], slack[rows.joint] = tolerances.speed, tolerances.turning
    slack[rows.limit] = tolerances.short
    slack[rows.speed] = tolerances.speed * scene.scales.mass**0.5
    return slack


@lru_cache(maxsize=64)
def _compile(
    formation: Formation, until: Until, side: float, degree: int, grips: Grips
) -> tuple[Mode, list[Expression], Inputs, Outputs, EventRows]:
    mode = Mode(formation, grips)
    n_c, held = formation.n_contacts, len(mode.holders)
    at = Inputs(*lay_out(STATE, None, None, None, n_c, 2, held, 5, 2, 2 * (degree + 1)))
    limits = len(open_limits(formation, until))
    rows = EventRows(*lay_out(n_c, 2 * held, n_c, 2, limits, None, None))
    model = _Model(mode, until, side, ca.SX.sym("packed", at.size), at)
    report, to = model.build_report(_slack(mode, rows))
    stage, finish = model.build_stage(), model.build_finish()
    # What follows only says what calls what, which is quicker than writing out every stage.
    packed, forces = ca.MX.sym("packed", at.size), []
    y, t, h = packed[at.y], packed[at.t], packed[at.h]

    def rate(state: Expression, time: Expression) -> Expression:
        rates, force = stage(state, time, packed)
        forces.append(force)
        return rates

    end, error = finish(*build_step(rate, y, t, h), packed)
    results = {
        "step": report(end, t + h, error, ca.mmin(ca.vertcat(*forces)), packed),
        "look": report(y, t, 0, 0, packed),
    }
    functions = [ca.Function(name, [packed], [result]) for name, result in results.items()]
    return mode, functions, at, to, rows


class _Model:
    """Right-hand side and events of a mode, as expressions of the packed inputs."""

    def __init__(
        self, mode: Mode, until: Until, side: float, packed: Expression, at: Inputs
    ) -> None:
        self.mode, self.packed, self.at = mode, packed, at
        self.Xi, self.sigma = packed[at.Xi], packed[at.sigma]
        formation = mode.formation
        z = build_features(formation.scene).z
        limits = formation.limits
        gained = [limit for limit in limits if limit.gains(until.contact)]
        if until.is_release:
            distance = ca.SX(1)
        elif until.contact is None:
            distance = side * (z[0 if until.coordinate == "x" else 2] - until.value)
        elif gained:
            distance = gained[0].value
        else:
            distance = build_gap(until.contact, formation.scene)
        values = ca.vertcat(*(limit.value for limit in open_limits(formation, until)))
        rate = ca.jacobian(distance, z)
        self.geometry = ca.Function("geometry", [z], [values, distance, rate])
        state, time = ca.SX.sym("state", STATE), ca.SX.sym("time")
        self.dynamics = ca.Function("dynamics", [state, time, packed], self._move(state, time))

    def hold(self, c: Expression) -> Expression:
        """What has to be positive for everything to hold, from the forces c."""
        H, h = self.mode.hold_rows
        return ca.sparsify(ca.DM(H)) @ c + ca.DM(h)

    def torque(self, t: Expression) -> Expression:
        """Torques at time t, shape (2,)."""
        start, stop = self.packed[self.at.piece][0], self.packed[self.at.piece][1]
        x = (2 * t - start - stop) / (stop - start)
        coefficients = ca.reshape(self.packed[self.at.torque], -1, 2)
        value = coefficients[-1, :]
        for power in range(coefficients.shape[0] - 2, -1, -1):
            value = value * x + coefficients[power, :]
        return value.T

    def _move(self, y: Expression, t: Expression) -> list[Expression]:
        """Rates of the state, c, v_t, tau, K and P at (z, z') = y[:10]."""
        mode, scene = self.mode, self.mode.formation.scene
        v = y[5:10]
        _, P, P_dot_v, A_t = mode.build_constraints(y[:5], v)
        tau = self.torque(t)
        inverse_mass = ca.DM(1 / scene.mass_diagonal)
        G = mode.build_force_rows(P, A_t, self.Xi)
        viscous = ca.DM(scene.viscous[3:]) * v[3:]
        dry = ca.DM(scene.dry[3:]) * self.sigma
        applied = ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, tau - viscous - dry)
        K = P @ (inverse_mass * G.T)
        c = ca.solve(K, -P_dot_v - P @ (inverse_mass * applied))
        acceleration = inverse_mass * (applied + G.T @ c)
        v_t = A_t @ v
        drag = ca.DM(mode.rolled.sliding_friction) * self.Xi * c[: mode.formation.n_contacts]
        powers = [ca.dot(force, v[3:]) for force in (tau, viscous, dry)]
        powers.append(ca.dot(drag, v_t))
        return [ca.vertcat(v, acceleration, *powers), c, v_t, tau, K, P]

    def build_stage(self) -> Expression:
        """CasADi function (state, time, packed) -> (its rates, the least that holds it)."""
        state, time = ca.SX.sym("state", STATE), ca.SX.sym("time")
        rates, c, *_ = self.dynamics(state, time, self.packed)
        least = ca.mmin(self.hold(c) / self.mode.hold_units)
        return ca.Function("stage", [state, time, self.packed], [rates, least])

    def build_finish(self) -> Expression:
        """CasADi function (end, fifth, third, packed) -> (end on the contacts, error)."""
        end, fifth, third = (ca.SX.sym(name, STATE) for name in ("end", "fifth", "third"))
        units = ca.DM(measure_units(self.mode.formation.scene))
        start, tolerance = self.packed[self.at.y][:10], self.packed[self.at.tolerance]
        error = build_error(fifth[:10], third[:10], start, units, tolerance)
        projected = _project(self.mode, end, self.packed[self.at.kept])
        return ca.Function("finish", [end, fifth, third, self.packed], [projected, error])

    def build_report(self, slack: Array) -> tuple[Expression, Outputs]:
        """CasADi function (state, time, error, dip, packed) -> all outputs, and their layout."""
        y, t = ca.SX.sym("state", STATE), ca.SX.sym("time")
        error, dip = ca.SX.sym("error"), ca.SX.sym("dip")
        mode, formation = self.mode, self.mode.formation
        rates, c, v_t, tau, K, P = self.dynamics(y, t, self.packed)
        c_n = c[: formation.n_contacts]
        c_t = mode.build_tangential(c, self.Xi)
        mass = formation.scene.mass_diagonal
        frictionless = P @ (ca.DM(1 / mass) * P.T)
        v = y[5:10]
        size = ca.sqrt(ca.dot(v, ca.DM(mass) * v))
        heading = ca.if_else(size > 0, v / ca.fmax(size, 1e-300), self.packed[self.at.heading])
        values, distance, gradient = self.geometry(y[:5])
        speed = ca.SX(1)
        if mode.n_constraints >= 4:
            speed = ca.dot(self.packed[self.at.heading], ca.DM(mass) * v)
        held = self.hold(c)
        events = ca.vertcat(held, self.Xi * v_t, self.sigma * v[3:], values, distance, speed)
        parts = [
            y,
            rates[5:10],
            c_n,
            c_t,
            tau,
            heading,
            ca.det(K) / ca.det(frictionless),
            error,
            ca.mmin(events + ca.DM(slack)),
            dip,
            gradient @ v,
            events,
        ]
        sizes = [None if k in (6, 7, 8, 9, 10) else part.shape[0] for k, part in enumerate(parts)]
        packed = ca.densify(ca.vertcat(*parts))
        report = ca.Function("report", [y, t, error, dip, self.packed], [packed])
        return report, Outputs(*lay_out(*sizes))


def open_limits(formation: Formation, until: Until) -> list[Limit]:
    """Limits that end a phase early: all but that of the contact to be gained."""
    return [limit for limit in formation.limits if not limit.gains(until.contact)]


def _project(mode: Mode, y: Expression, kept: Expression) -> Expression:
    """Move z to closed gaps and what is kept, and z' to P z' = 0, the shortest way in metric M5.

    A step leaves gaps of the size of its error, so one Newton iteration closes them to rounding.
    """
    inverse_mass = ca.DM(1 / mode.formation.scene.mass_diagonal)
    kept = ca.vertcat(ca.SX(mode.formation.n_contacts, 1), kept)

    def correct(z: Expression, of_gaps: bool, v: Expression) -> Expression:
        held, P, _, _ = mode.build_constraints(z, v)
        lift = inverse_mass * P.T
        return lift @ ca.solve(P @ lift, held - kept if of_gaps else P @ v)

    z = y[:5] - correct(y[:5], True, ca.SX(5, 1))
    v = y[5:10] - correct(z, False, y[5:10])
    return ca.vertcat(z, v, y[10:])
