"""Compiled steps of a contact mode: Runge-Kutta, projection and events in one CasADi function."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..contacts.elemental import GapLimit, build_features, build_gap
from ..contacts.formation import Formation
from ..problem.definition import Until
from ..scene.model import Scene
from .layout import MOVING, STATE, EventRows, Inputs, Outputs, bind, build_torque, lay_out
from .modes import FREE, Grips, Mode
from .runge_kutta import INNER_STAGES, build_error, build_step
from .tolerances import ROUNDING_FORCE, find_tolerances, measure_units


class ModeStepper(NamedTuple):
    """Compiled steps of one contact mode.

    Calling `step` or `look` reads `inputs` and overwrites `outputs`. Each simulation has its own.
    """

    mode: Mode
    inputs: Array  # inputs, outputs: packed vectors
    outputs: Array
    at: Inputs  # at, to: their layouts
    to: Outputs
    rows: EventRows
    slack: Array  # (n_events,): how far below zero each event value counts as rounding
    step: Any  # step, look: a step of length h; the same outputs at the state given, without a step
    look: Any
    buffers: Any  # what has to live as long as these

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
) -> ModeStepper:
    """Steps of a formation for torques of a polynomial degree, compiled when first used.

    `side` is the sign of (coordinate - value) before the end of the phase, `until`.
    """
    mode, at, to, rows, slack, functions = _compile(formation, until, side, degree, grips)
    inputs, outputs, *calls = bind(at.size, to.size, functions)
    return ModeStepper(mode, inputs, outputs, at, to, rows, slack, *calls)


class _Equations:
    """Equations of a formation, as calls on one packed vector: stages are not expanded."""

    def __init__(
        self, formation: Formation, until: Until, side: float, degree: int, grips: Grips
    ) -> None:
        self.mode = mode = Mode(formation, grips)
        self.mechanics = share_mechanics(mode, degree)
        self.short = find_tolerances(formation.scene).short
        self._measure = _build_measure(formation, until, side, self.short)
        inputs = [
            ca.SX.sym(n, k) for n, k in (("y", MOVING), ("t", 1), ("p", self.mechanics.at.size))
        ]
        _, *rows = mode.build_constraints(inputs[0][:5], inputs[0][5:10])
        self._stage = ca.Function("stage", inputs, self.mechanics.stage(*inputs, *rows))
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
        """Outputs at a state, with error, dip and stage forces of the step that led there."""
        mechanics, packed = self.mechanics, self.packed
        _, *constraints = self.mode.build_constraints(state[:5], state[5:10])
        outputs, events, speed, least = mechanics.report(state, time, packed, *constraints)
        values, distance, approach, closest = self._measure(state[:5], state[5:10])
        error, dip, stage_forces = errors
        worst = ca.fmin(least, closest)
        return ca.vertcat(
            outputs, error, worst, dip, stage_forces, approach, events, values, distance, speed
        )

    def project(self, y: Expression) -> Expression:
        """Move z onto the constraints and z' to P z' = 0, the shortest way in metric M5.

        A step leaves gaps of the size of its error, so one Newton iteration closes them.
        """
        z, v, mode, mechanics = y[:5], y[5:10], self.mode, self.mechanics
        values, P, _, _ = mode.build_constraints(z, v)
        kept = ca.vertcat(ca.DM(mode.formation.n_contacts, 1), self.packed[mechanics.at.kept])
        z = z - mechanics.correct(P, values - kept)
        _, P, _, _ = mode.build_constraints(z, v)
        v = v - mechanics.correct(P, P @ v)
        return ca.vertcat(z, v, y[10:])


@lru_cache(maxsize=64)
def _compile(
    formation: Formation, until: Until, side: float, degree: int, grips: Grips
) -> tuple[Mode, Inputs, Outputs, EventRows, Array, tuple[Expression, Expression]]:
    """What all steppers of a formation share: mode, layouts, slack, functions step and look."""
    equations = _Equations(formation, until, side, degree, grips)
    mechanics, mode, packed = equations.mechanics, equations.mode, equations.packed
    at, n_c, held = mechanics.at, formation.n_contacts, len(mode.holders)
    limits = len(open_limits(formation, until))
    rows = EventRows(*lay_out(n_c, 2 * held, n_c, 2, limits, None, None))
    brief = len(INNER_STAGES) * n_c
    to = Outputs(*lay_out(STATE, 5, n_c, n_c, 2, 5, None, None, None, None, brief, None, rows.size))
    short = np.full(limits, equations.short)
    slack = np.concatenate([mechanics.slack, short, [0.0, mechanics.stall]])
    y, t, h = packed[at.y], packed[at.t], packed[at.h]
    end, fifth, third = build_step(equations.rate, y, t, h, MOVING)
    error = mechanics.error(fifth, third, packed)
    stage_forces = ca.vertcat(*(equations.c_n[stage] for stage in INNER_STAGES))
    dip = ca.mmin(ca.vertcat(*equations.least))
    outputs = equations.report(equations.project(end), t + h, error, dip, stage_forces)
    step = ca.Function("step", [packed], [outputs])
    look = ca.Function("look", [packed], [equations.report(y, t, 0, 0, ca.DM.zeros(brief))])
    return mode, at, to, rows, slack, (step, look)


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


@dataclass(frozen=True)
class Kind:
    """What the equations of motion depend on besides the constraint rows."""

    scene: Scene
    friction: tuple[float, ...]  # of each contact
    rolling: tuple[int, ...]  # contacts that the phase lets roll
    grips: Grips
    degree: int  # of the torque's polynomials
    mode: Mode = field(compare=False)  # one of this kind


class Mechanics(NamedTuple):
    """CasADi functions of the constraint rows: P, P' v and A_t."""

    at: Inputs  # layout of the packed inputs
    # (z and z', time, packed, rows) -> rates of the state, the least that holds it in units of the
    # scene, and c_n
    stage: Expression
    # (state, time, packed, rows) -> outputs up to the ratio, events before and after the limits,
    # and the least of these events with their slacks
    report: Expression
    # (P, r) -> M5^-1 P^T (P M5^-1 P^T)^-1 r, the shortest change of z that makes P change by r
    correct: Expression
    error: Expression  # (fifth, third, packed) -> error of a step over the tolerance
    # (n_events before the limits,): how far below zero each of these counts as rounding
    slack: Array
    stall: float  # likewise for the speed


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
        H, h = self.mode.force_limit_rows
        margins, c_n = ca.sparsify(ca.DM(H)) @ c + ca.DM(h), c[: self.mode.formation.n_contacts]
        least = ca.mmin(margins / self.mode.force_limit_units)
        report = self._report(rates, c, v_t, tau, K, P, margins, slack, stall)
        row, r = self.rows[0], ca.SX.sym("r", self.mode.n_constraints)
        lift = ca.DM(1 / scene.mass_diagonal) * row.T
        correction = ca.densify(lift @ ca.solve(row @ lift, r))
        fifth, third = ca.SX.sym("fifth", MOVING), ca.SX.sym("third", MOVING)
        start, tolerance = self.packed[self.at.y][:MOVING], self.packed[self.at.tolerance]
        error = build_error(fifth, third, start, ca.DM(measure_units(scene)), tolerance)
        return Mechanics(
            self.at,
            ca.Function("stage", [self.y[:MOVING], *inputs], [rates, least, c_n]),
            ca.Function("report", [self.y, *inputs], report),
            ca.Function("correct", [row, r], [correction]),
            ca.Function("error", [fifth, third, self.packed], [error]),
            slack,
            stall,
        )

    def _move(self) -> list[Expression]:
        """Rates of the state, c, v_t, tau, K and P at (z, z') = y[:10]."""
        mode, scene = self.mode, self.mode.formation.scene
        v = self.y[5:10]
        P, bend, A_t = self.rows
        tau = build_torque(self.t, self.packed[self.at.piece], self.packed[self.at.torque])
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
        margins: Expression,
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
        events = ca.vertcat(margins, self.Xi * v_t, self.sigma * v[3:])
        least = ca.fmin(ca.mmin(events + ca.DM(slack)), speed + stall)
        return [ca.densify(part) for part in (outputs, events, speed, least)]
