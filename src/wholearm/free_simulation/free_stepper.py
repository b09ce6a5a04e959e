"""Compiled Runge-Kutta steps of a motion with given contact modes."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..simulation.layout import bind, build_torque, lay_out
from ..simulation.runge_kutta import INNER_STAGES, build_error, build_step
from .system import Structure

LOSSES = 4  # integrals: work, losses to viscous, dry and sliding friction


class Modes(NamedTuple):
    """What keeps which contacts while a motion is smooth."""

    kept: tuple[int, ...] = ()  # pairs that press
    stuck: tuple[int, ...] = ()  # those of them that stick
    held: tuple[int, ...] = ()  # coordinates that dry friction holds
    Xi: tuple[float, ...] = ()  # sliding directions of the kept pairs, zero where they stick
    # directions of coordinates with dry friction, zero for those that are held
    sigma: tuple[float, ...] = ()


class FreeInputs(NamedTuple):
    """Where each input of a step is in its packed vector; compare `simulation.layout.Inputs`.

    Those from `geometry` on are numbers of the system and its units.
    """

    y: slice
    t: int
    h: int
    tolerance: int
    Xi: slice
    sigma: slice
    stay: slice
    piece: slice
    torque: slice
    geometry: slice
    lift: slice
    applied: slice
    viscous: slice
    dry: slice
    mu: slice
    units: slice
    force: int
    friction_units: slice
    size: int


class FreeOutputs(NamedTuple):
    """Where each output is: state, z'', forces, v_t, tau, error, least margin, gaps, ranges."""

    y: slice
    acceleration: slice
    c_n: slice
    f: slice
    v_t: slice
    tau: slice
    error: int
    dip: int
    gaps: slice
    ranges: slice
    size: int


class FreeStepper(NamedTuple):
    """Compiled steps of one set of modes; calling `step` or `look` reads `inputs`."""

    inputs: Array
    outputs: Array
    at: FreeInputs
    to: FreeOutputs
    step: Any
    look: Any
    buffers: Any


@lru_cache(maxsize=256)
def build_stepper(structure: Structure, modes: Modes, degree: int) -> FreeStepper:
    """Steps of a set of modes without its signs, for torques of a polynomial degree."""
    return _FreeEquations(structure, modes, degree).compile()


class _FreeEquations:
    """Equations of motion, as expressions of one packed vector."""

    def __init__(self, structure: Structure, modes: Modes, degree: int) -> None:
        self.structure, (kept, stuck, held, _, _) = structure, modes
        self.kept, self.held = kept, held
        self.stick = [kept.index(pair) for pair in stuck]
        self.n, k, s = structure.n, len(kept), len(stuck) + len(held)
        n, size, g = structure.n, 2 * structure.n + LOSSES, structure.geometry.shape[0]
        numbers = (g, n, n, n, n, k, 2 * n, None, n)
        self.at = FreeInputs(*lay_out(size, None, None, None, k, n, s, 2, 2 * degree + 2, *numbers))
        pairs = len(structure.pairs)
        self.to = FreeOutputs(*lay_out(size, self.n, k, s, k, 2, None, None, pairs, pairs))
        self.dips: list[Expression] = []
        self._move = self._build_move()
        self._correct = self._build_correction()

    def compile(self) -> FreeStepper:
        """Steps, and looks at a state, as functions of the packed inputs."""
        at, n = self.at, self.n
        packed = ca.MX.sym("packed", at.size)
        y, t, h = packed[at.y], packed[at.t], packed[at.h]

        def rate(state: Expression, time: Expression) -> Expression:
            rates, _, _, _, _, least = self._move(state, time, packed, packed[at.geometry])
            self.dips.append(least)
            return rates

        end, fifth, third = build_step(rate, y, t, h, 2 * n)
        error = build_error(fifth, third, y[: 2 * n], packed[at.units], packed[at.tolerance])
        dip = ca.mmin(ca.vertcat(*(self.dips[stage] for stage in INNER_STAGES)))
        moved = self._correct(end[: 2 * n], packed)
        end = ca.vertcat(moved, end[2 * n :])
        functions = []
        for state, time, extra in ((end, t + h, (error, dip)), (y, t, (0, 0))):
            rates, *parts, _ = self._move(state[: 2 * n], time, packed, packed[at.geometry])
            gaps = self.structure.gap_function(state[:n], packed[at.geometry])
            outputs = ca.vertcat(state, rates[n : 2 * n], *parts, *extra, ca.vec(gaps))
            functions.append(ca.Function("step", [packed], [ca.densify(outputs)]))
        inputs, outputs, *calls = bind(at.size, self.to.size, functions)
        return FreeStepper(inputs, outputs, at, self.to, *calls)

    def _stack(self, normal: Expression, tangential: Expression) -> Expression:
        """Constraint rows: normal ones, tangential ones that stick, held coordinates."""
        hold = ca.DM(np.eye(self.n)[list(self.held)].reshape(len(self.held), self.n))
        return ca.vertcat(normal, *(tangential[row, :] for row in self.stick), hold)

    def _build_move(self) -> Expression:
        """CasADi function (state, time, packed, geometry) -> rates, c_n, f, v_t, tau, margin."""
        structure, n, at = self.structure, self.n, self.at
        k, stick = len(self.kept), self.stick
        z, v, time = structure.z, ca.SX.sym("v", n), ca.SX.sym("time")
        packed = ca.SX.sym("packed", at.size)
        Xi, sigma, mu = packed[at.Xi], packed[at.sigma], packed[at.mu]
        _, _, A, A_t, bend, bend_t = structure.build_rows(self.kept, v)
        P, G = (self._stack(part, A_t) for part in (A, A - ca.repmat(mu * Xi, 1, n) * A_t))
        curve = ca.vertcat(bend, *(bend_t[row] for row in stick), ca.DM(len(self.held), 1))
        tau = build_torque(time, packed[at.piece], packed[at.torque])
        viscous, dry = packed[at.viscous] * v, packed[at.dry] * sigma
        drive = ca.SX(n, 1)
        for row, coordinate in enumerate(structure.driven):
            drive[coordinate] = tau[row]
        lift = packed[at.lift]
        force = packed[at.applied] + drive - viscous - dry
        if P.shape[0]:
            spread = ca.repmat(lift, 1, P.shape[0])
            c = ca.solve(P @ (spread * G.T), -curve - P @ (lift * force))
            force = force + G.T @ c
        else:
            c = ca.SX(0, 1)
        v_t, (c_n, f) = A_t @ v, ca.vertsplit(c, [0, k, c.shape[0]])
        losses = [ca.dot(part, v) for part in (drive, viscous, dry)]
        losses.append(ca.dot(mu * Xi * c_n, v_t))
        bounds = [mu[row] * c_n[row] for row in stick]
        bounds += [packed[at.dry][i] for i in self.held]
        units = [packed[at.force] for _ in stick]
        units += [packed[at.friction_units][i] for i in self.held]
        spare = (ca.vertcat(ca.SX(0, 1), *bounds) - ca.fabs(f)) / ca.vertcat(ca.SX(0, 1), *units)
        least = ca.mmin(ca.vertcat(1.0, c_n / packed[at.force], spare))
        outputs = [ca.vertcat(v, lift * force, *losses), c_n, f, v_t, tau, least]
        inputs = [ca.vertcat(z, v), time, packed, structure.geometry]
        return ca.Function("move", inputs, [ca.densify(part) for part in outputs])

    def _build_correction(self) -> Expression:
        """CasADi function (state, packed) -> its projection on the constraints in the metric M.

        A step leaves gaps of the size of its error, so one Newton iteration closes them.
        """
        structure, n = self.structure, self.n
        z, v = structure.z, ca.SX.sym("v", n)
        packed = ca.SX.sym("packed", self.at.size)
        gap, slip, A, A_t, _, _ = structure.build_rows(self.kept, v)
        P, state = self._stack(A, A_t), ca.vertcat(z, v)
        if not P.shape[0]:
            return ca.Function("correct", [state, packed], [state])
        wanted = ca.vertcat(ca.DM(len(self.kept), 1), packed[self.at.stay])
        lift = ca.repmat(packed[self.at.lift], 1, P.shape[0]) * P.T
        off = (
            ca.vertcat(gap, *(slip[row] for row in self.stick), *(z[i] for i in self.held)) - wanted
        )
        y, inputs = ca.MX.sym("y", 2 * n), ca.MX.sym("packed", self.at.size)
        off_function = ca.Function("off", [z, packed, structure.geometry], [P, lift, off])
        P, lift, off = off_function(y[:n], inputs, inputs[self.at.geometry])
        place = y[:n] - lift @ ca.solve(P @ lift, off)
        P, lift, _ = off_function(place, inputs, inputs[self.at.geometry])
        speed = y[n:] - lift @ ca.solve(P @ lift, P @ y[n:])
        return ca.Function("correct", [y, inputs], [ca.vertcat(place, speed)])
