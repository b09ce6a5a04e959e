"""Equations of motion of a mode as CasADi functions of its constraint rows.

Formations of a scene with as many contacts of the same friction, and the same of them held, share
these: what tells them apart, geometry, enters by the constraint rows P, P' v and A_t.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..scene.model import Scene
from .layout import MOVING, STATE, Inputs, lay_out
from .modes import Grips, Mode
from .runge_kutta import build_error
from .tolerances import ROUNDING_FORCE, find_tolerances, measure_units


@dataclass(frozen=True)
class Kind:
    """What the equations of motion depend on besides the constraint rows.

    Attributes
    ----------
    scene : Scene
    friction : tuple of float
        Of each contact.
    rolling : tuple of int
        Contacts that the phase lets roll.
    grips : Grips
    degree : int
        Of the torque's polynomials.
    mode : Mode
        One of this kind.
    """

    scene: Scene
    friction: tuple[float, ...]
    rolling: tuple[int, ...]
    grips: Grips
    degree: int
    mode: Mode = field(compare=False)


class Mechanics(NamedTuple):
    """CasADi functions of the constraint rows: P, P' v and A_t.

    Attributes
    ----------
    at : Inputs
        Layout of the packed inputs.
    stage : callable
        (z and z', time, packed, rows) -> rates of the state, the least that holds it in units of
        the scene, and c_n.
    report : callable
        (state, time, packed, rows) -> outputs up to the ratio, events before and after the limits,
        and the least of these events with their slacks.
    correct : callable
        (P, r) -> M5^-1 P^T (P M5^-1 P^T)^-1 r, the shortest change of z that makes P change by r.
    error : callable
        (fifth, third, packed) -> error of a step over the tolerance.
    slack : ndarray, shape (n_events before the limits,)
        How far below zero each of these counts as rounding.
    stall : float
        Likewise for the speed.
    """

    at: Inputs
    stage: Expression
    report: Expression
    correct: Expression
    error: Expression
    slack: Array
    stall: float


def share_mechanics(mode: Mode, degree: int) -> Mechanics:
    """Return the equations of motion of a mode, for torques of a polynomial degree."""
    formation = mode.formation
    friction = tuple(formation.friction.tolist())
    kind = Kind(formation.scene, friction, formation.rolling_rows, mode.grips, degree, mode)
    return _build_mechanics(kind)


@lru_cache(maxsize=32)
def _build_mechanics(kind: Kind) -> Mechanics:
    return _Model(kind).build()


class _Model:
    """Right-hand side and events of a kind of modes, as expressions of the packed inputs."""

    def __init__(self, kind: Kind) -> None:
        self.mode = mode = kind.mode
        count, held = len(kind.friction), len(mode.holders)
        self.at = Inputs(
            *lay_out(STATE, None, None, None, count, 2, held, 5, 2, 2 * kind.degree + 2)
        )
        self.packed = packed = ca.SX.sym("packed", self.at.size)
        self.Xi, self.sigma = packed[self.at.Xi], packed[self.at.sigma]
        self.y, self.t = ca.SX.sym("state", STATE), ca.SX.sym("time")
        n = mode.n_constraints
        self.rows = [ca.SX.sym("P", n, 5), ca.SX.sym("bend", n), ca.SX.sym("A_t", count, 5)]

    def build(self) -> Mechanics:
        """All of its functions."""
        scene = self.mode.formation.scene
        tolerances = find_tolerances(scene)
        stall = tolerances.speed * scene.scales.mass**0.5
        slack = np.concatenate(
            [
                ROUNDING_FORCE * self.mode.force_limit_units,
                np.full(self.mode.formation.n_contacts, tolerances.speed),
                np.full(2, tolerances.turning),
            ]
        )
        inputs = [self.t, self.packed, *self.rows]
        rates, c, v_t, tau, K, P = self._move()
        held, c_n = self._hold(c), c[: self.mode.formation.n_contacts]
        least = ca.mmin(held / self.mode.force_limit_units)
        report = self._report(rates, c, v_t, tau, K, P, held, slack, stall)
        return Mechanics(
            self.at,
            ca.Function("stage", [self.y[:MOVING], *inputs], [rates, least, c_n]),
            ca.Function("report", [self.y, *inputs], report),
            self._build_correction(),
            self._build_error(),
            slack,
            stall,
        )

    def _hold(self, c: Expression) -> Expression:
        """What has to be positive for everything to hold, from the forces c."""
        H, h = self.mode.force_limit_rows
        return ca.sparsify(ca.DM(H)) @ c + ca.DM(h)

    def _torque(self) -> Expression:
        """Torques at the time, shape (2,)."""
        start, stop = self.packed[self.at.piece][0], self.packed[self.at.piece][1]
        x = (2 * self.t - start - stop) / (stop - start)
        coefficients = ca.reshape(self.packed[self.at.torque], -1, 2)
        value = coefficients[-1, :]
        for power in range(coefficients.shape[0] - 2, -1, -1):
            value = value * x + coefficients[power, :]
        return value.T

    def _move(self) -> list[Expression]:
        """Rates of the state, c, v_t, tau, K and P at (z, z') = y[:10]."""
        mode, scene = self.mode, self.mode.formation.scene
        v = self.y[5:10]
        P, bend, A_t = self.rows
        tau = self._torque()
        inverse_mass = ca.DM(1 / scene.mass_diagonal)
        G = mode.build_force_rows(P, A_t, self.Xi)
        viscous = ca.DM(scene.viscous[3:]) * v[3:]
        dry = ca.DM(scene.dry[3:]) * self.sigma
        applied = ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, tau - viscous - dry)
        K = P @ (inverse_mass * G.T)
        c = ca.solve(K, -bend - P @ (inverse_mass * applied))
        acceleration = inverse_mass * (applied + G.T @ c)
        v_t = A_t @ v
        drag = ca.DM(mode.rolled.sliding_friction) * self.Xi * c[: mode.formation.n_contacts]
        powers = [ca.dot(force, v[3:]) for force in (tau, viscous, dry)]
        powers.append(ca.dot(drag, v_t))
        return [ca.vertcat(v, acceleration, *powers), c, v_t, tau, K, P]

    def _report(
        self,
        rates: Expression,
        c: Expression,
        v_t: Expression,
        tau: Expression,
        K: Expression,
        P: Expression,
        held: Expression,
        slack: Array,
        stall: float,
    ) -> list[Expression]:
        mode, mass = self.mode, self.mode.formation.scene.mass_diagonal
        y, v, before = self.y, self.y[5:10], self.packed[self.at.heading]
        frictionless = P @ (ca.DM(1 / mass) * P.T)
        size = ca.sqrt(ca.dot(v, ca.DM(mass) * v))
        heading = ca.if_else(size > 0, v / ca.fmax(size, 1e-300), before)
        speed = ca.dot(before, ca.DM(mass) * v) if mode.n_constraints >= 4 else ca.SX(1)
        c_n, c_t = c[: mode.formation.n_contacts], mode.build_tangential(c, self.Xi)
        ratio = ca.det(K) / ca.det(frictionless)
        outputs = ca.vertcat(y, rates[5:10], c_n, c_t, tau, heading, ratio)
        events = ca.vertcat(held, self.Xi * v_t, self.sigma * v[3:])
        least = ca.fmin(ca.mmin(events + ca.DM(slack)), speed + stall)
        return [ca.densify(part) for part in (outputs, events, speed, least)]

    def _build_correction(self) -> Expression:
        P, r = self.rows[0], ca.SX.sym("r", self.mode.n_constraints)
        lift = ca.DM(1 / self.mode.formation.scene.mass_diagonal) * P.T
        return ca.Function("correct", [P, r], [ca.densify(lift @ ca.solve(P @ lift, r))])

    def _build_error(self) -> Expression:
        fifth, third = ca.SX.sym("fifth", MOVING), ca.SX.sym("third", MOVING)
        units = ca.DM(measure_units(self.mode.formation.scene))
        start, tolerance = self.packed[self.at.y][:MOVING], self.packed[self.at.tolerance]
        error = build_error(fifth, third, start, units, tolerance)
        return ca.Function("error", [fifth, third, self.packed], [error])
