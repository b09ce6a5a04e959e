"""Steps of a motion with given modes of contact, compiled when they are first used."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..simulation.layout import lay_out
from ..simulation.runge_kutta import GLIMPSES, build_error, build_step
from .system import System

LOSSES = 4
"""Integrals along the motion: work of the torques, losses to viscous, dry and sliding friction."""


class Modes(NamedTuple):
    """What keeps which contacts while a motion is smooth.

    Attributes
    ----------
    kept : tuple of int
        Pairs that press.
    stuck : tuple of int
        Those of them that stick.
    held : tuple of int
        Coordinates that dry friction holds.
    Xi : tuple of float
        Sliding directions of the kept pairs, zero where they stick.
    sigma : tuple of float, length n
        Directions of coordinates with dry friction, zero for those that are held.
    """

    kept: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    Xi: tuple[float, ...] = ()
    sigma: tuple[float, ...] = ()


class Inputs(NamedTuple):
    """Where each input of a step is in its packed vector; compare `simulation.layout.Inputs`."""

    y: slice
    t: int
    h: int
    tolerance: int
    Xi: slice
    sigma: slice
    stay: slice
    piece: slice
    torque: slice
    size: int


class Outputs(NamedTuple):
    """Where each output is: state, z'', c_n, friction that holds, v_t, tau, error, least within."""

    y: slice
    acceleration: slice
    c_n: slice
    f: slice
    v_t: slice
    tau: slice
    error: int
    dip: int
    size: int


class Stepper(NamedTuple):
    """Compiled steps of one set of modes; calling `step` or `look` reads `inputs`."""

    inputs: Array
    outputs: Array
    at: Inputs
    to: Outputs
    step: Any
    look: Any
    buffers: Any


@lru_cache(maxsize=256)
def build_stepper(
    system: System,
    kept: tuple[int, ...],
    stuck: tuple[int, ...],
    held: tuple[int, ...],
    degree: int,
) -> Stepper:
    """Return the steps of a set of modes, for torques of a polynomial degree."""
    return _Equations(system, kept, stuck, held, degree).compile()


class _Equations:
    """The equations of motion, as expressions of one packed vector."""

    def __init__(
        self,
        system: System,
        kept: tuple[int, ...],
        stuck: tuple[int, ...],
        held: tuple[int, ...],
        degree: int,
    ) -> None:
        self.system, self.kept, self.stuck, self.held = system, kept, stuck, held
        self.n, k, s = system.n, len(kept), len(stuck) + len(held)
        size = 2 * self.n + LOSSES
        self.at = Inputs(*lay_out(size, None, None, None, k, self.n, s, 2, 2 * degree + 2))
        self.to = Outputs(*lay_out(size, self.n, k, s, k, 2, None, None))
        self.degree = degree
        self.dips: list[Expression] = []
        self._move = self._build_move()
        self._correct = self._build_correction()

    def compile(self) -> Stepper:
        """Steps, and looks at a state, as functions of the packed inputs."""
        at, n = self.at, self.n
        packed = ca.MX.sym("packed", at.size)
        y, t, h = packed[at.y], packed[at.t], packed[at.h]

        def rate(state: Expression, time: Expression) -> Expression:
            rates, _, _, _, _, least = self._move(state, time, packed)
            self.dips.append(least)
            return rates

        end, fifth, third = build_step(rate, y, t, h, 2 * n)
        units = ca.DM(self.system.units)
        error = build_error(fifth, third, y[: 2 * n], units, packed[at.tolerance])
        dip = ca.mmin(ca.vertcat(*(self.dips[stage] for stage in GLIMPSES)))
        moved = self._correct(end[: 2 * n], packed)
        end = ca.vertcat(moved, end[2 * n :])
        functions = []
        for state, time, extra in ((end, t + h, (error, dip)), (y, t, (0, 0))):
            rates, *parts, _ = self._move(state[: 2 * n], time, packed)
            outputs = ca.vertcat(state, rates[n : 2 * n], *parts, *extra)
            functions.append(ca.Function("step", [packed], [ca.densify(outputs)]))
        inputs, results = np.zeros(at.size), np.zeros(self.to.size)
        buffers = [function.buffer() for function in functions]
        for buffer, _ in buffers:
            buffer.set_arg(0, inputs.data)
            buffer.set_res(0, results.data)
        step, look = (call for _, call in buffers)
        return Stepper(inputs, results, at, self.to, step, look, buffers)

    def _build_move(self) -> Expression:
        """CasADi function (state, time, packed) -> rates, c_n, f, v_t, tau, least that holds."""
        system, n, at = self.system, self.n, self.at
        k, stick = len(self.kept), [self.kept.index(pair) for pair in self.stuck]
        z, v, time = system.z, ca.SX.sym("v", n), ca.SX.sym("time")
        packed = ca.SX.sym("packed", at.size)
        Xi, sigma = packed[at.Xi], packed[at.sigma]
        _, _, A, A_t, bend, bend_t = system.build_rows(self.kept, v)
        mu = system.friction[list(self.kept)]
        G = A - ca.repmat(ca.DM(mu) * Xi, 1, n) * A_t
        hold = ca.DM(np.eye(n)[list(self.held)].reshape(len(self.held), n))
        P = ca.vertcat(A, *(A_t[row, :] for row in stick), hold)
        G = ca.vertcat(G, *(A_t[row, :] for row in stick), hold)
        curve = ca.vertcat(bend, *(bend_t[row] for row in stick), ca.DM(len(self.held), 1))
        tau = self._torque(time, packed)
        viscous, dry = ca.DM(system.viscous) * v, ca.DM(system.dry) * sigma
        drive = ca.SX(n, 1)
        for row, coordinate in enumerate(system.driven):
            drive[coordinate] = tau[row]
        lift = ca.DM(1 / system.mass)
        force = ca.DM(system.applied) + drive - viscous - dry
        if P.shape[0]:
            c = ca.solve(P @ (lift * G.T), -curve - P @ (lift * force))
            force = force + G.T @ c
        else:
            c = ca.SX(0, 1)
        v_t, (c_n, f) = A_t @ v, ca.vertsplit(c, [0, k, c.shape[0]])
        losses = [ca.dot(part, v) for part in (drive, viscous, dry)]
        losses.append(ca.dot(ca.DM(mu) * Xi * c_n, v_t))
        bounds = ca.vertcat(
            *(mu[row] * c_n[row] for row in stick), *(system.dry[i] for i in self.held)
        )
        units = self.measure_forces()
        least = ca.vertcat(1.0, c_n / units[0], (bounds - ca.fabs(f)) / units[1])
        outputs = [ca.vertcat(v, lift * force, *losses), c_n, f, v_t, tau, ca.mmin(least)]
        return ca.Function(
            "move", [ca.vertcat(z, v), time, packed], [ca.densify(part) for part in outputs]
        )

    def measure_forces(self) -> tuple[Expression, Expression]:
        """The scene's units of c_n and of f."""
        scales = self.system.scales
        own = [scales.force] * len(self.stuck)
        own += [scales.torque if self.system.turns[i] else scales.force for i in self.held]
        return ca.DM([scales.force] * len(self.kept)), ca.DM(own)

    def _torque(self, time: Expression, packed: Expression) -> Expression:
        start, stop = packed[self.at.piece][0], packed[self.at.piece][1]
        x = (2 * time - start - stop) / (stop - start)
        coefficients = ca.reshape(packed[self.at.torque], self.degree + 1, 2)
        value = coefficients[-1, :]
        for power in range(self.degree - 1, -1, -1):
            value = value * x + coefficients[power, :]
        return value.T

    def _build_correction(self) -> Expression:
        """CasADi function (state, packed) -> state on the contacts, the shortest way in M.

        A step leaves gaps of the size of its error, so one Newton iteration closes them.
        """
        system, n = self.system, self.n
        z, v = system.z, ca.SX.sym("v", n)
        packed = ca.SX.sym("packed", self.at.size)
        gap, slip, A, A_t, _, _ = system.build_rows(self.kept, v)
        stick = [self.kept.index(pair) for pair in self.stuck]
        hold = ca.DM(np.eye(n)[list(self.held)].reshape(len(self.held), n))
        P = ca.vertcat(A, *(A_t[row, :] for row in stick), hold)
        state = ca.vertcat(z, v)
        if not P.shape[0]:
            return ca.Function("correct", [state, packed], [state])
        wanted = ca.vertcat(ca.DM(len(self.kept), 1), packed[self.at.stay])
        lift = ca.DM(1 / system.mass) * P.T
        off = ca.vertcat(gap, *(slip[row] for row in stick), *(z[i] for i in self.held)) - wanted
        y, given = ca.MX.sym("y", 2 * n), ca.MX.sym("packed", self.at.size)
        off_function = ca.Function("off", [z, packed], [P, lift, off])
        P, lift, off = off_function(y[:n], given)
        place = y[:n] - lift @ ca.solve(P @ lift, off)
        P, lift, _ = off_function(place, given)
        speed = y[n:] - lift @ ca.solve(P @ lift, P @ y[n:])
        return ca.Function("correct", [y, given], [ca.vertcat(place, speed)])
