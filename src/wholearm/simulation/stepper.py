"""Compiled steps of a contact mode: Runge-Kutta, projection and events in one CasADi function."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.arrays import Array, Expression
from ..common.errors import JammingError, SimulationError
from ..contacts.elemental import GapLimit, build_features, build_gap
from ..contacts.formation import Formation
from ..problem.definition import Phase, Problem, Until
from ..results.torque import TorqueProfile
from ..scene.model import Scene
from .events import Event, EventKind, Outcome, OutcomeKind, Section
from .layout import (
    MOVING,
    STATE,
    EventRows,
    Inputs,
    Outputs,
    bind,
    build_torque,
    find_torque_steps,
    lay_out,
)
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


class Replay:
    """State, piece of the torques and records of a running simulation.

    Attributes
    ----------
    t, h : [s]               present time, and the step to try next
    y : (STATE,)             z, z', then work, viscous, dry and contact losses
    has_slid                 whether contacts that come to rest have slid in the phase
    slip_signs               signs of contacts, by name, that have just begun to slip
    side                     sign of (coordinate - value) before the end of the phase
    until_unit : [m or rad]  unit of the distance to the end of the phase
    passes                   whether the end may be passed at any speed, without an impact
    moving                   whether the motion goes on into the next phase
    previous                 formation of the last phase that has ended at rest
    wanted                   instants at which steps have to end; infinity is last
    stuck                    contacts, then joints, that stick while the rest moves
    """

    stepper: ModeStepper  # of the phase's formation
    phase: Phase
    limits: list[str]  # what has happened when each of the stepper's limits is zero
    releasable: tuple[str, ...]  # the contacts whose release ends the phase
    # resting, slipping: the contacts that come to rest, all of them, or slip, one of them, where
    # the phase ends
    resting: frozenset[int]
    slipping: frozenset[int]

    def __init__(
        self, problem: Problem, torque: TorqueProfile, tolerance: float, wanted: Array
    ) -> None:
        self.problem, self.torques, self.tolerance = problem, torque, tolerance
        self.tolerances = find_tolerances(problem.scene)
        self.until_unit = 1.0
        self.breaks = [float(b) for b in torque.breaks]
        self.coefficients = torque.coefficients
        parts, least = torque.coefficients, self.tolerances.torque_step
        self.steps_at: list[bool] = [
            True,
            *find_torque_steps(parts[:-1], parts[1:], least).tolist(),
        ]
        ends = torque.breaks[:-1], torque.breaks[1:]
        flat = self.coefficients.reshape(len(self.coefficients), -1)
        self.pieces = np.column_stack([*ends, flat])
        self.step_times = [b for b, s in zip(self.breaks, self.steps_at, strict=False) if s]
        within = wanted[(wanted >= self.breaks[0]) & (wanted <= self.breaks[-1])]
        self.wanted = [*within.tolist(), math.inf]
        self.next_wanted = 0
        self.t, self.piece = self.breaks[0], 0
        self.y = np.zeros(STATE)
        self.y[:5] = problem.start
        self.h = self.tolerances.first_step
        self.held_until = self.settled_by = -math.inf
        self.impact = 0.0
        self.passes = self.moving = False
        self.previous: Formation | None = None
        self.side = 1.0
        self.stuck: set[int] = set()
        self.has_slid = False
        self.slip_signs: dict[str, float] = {}
        self.decided = (-math.inf, 0)
        self.sections: list[Section] = []
        self.steppers: list[ModeStepper] = []
        self.events: list[Event] = []
        self.steps = self.rejected = 0

    def take(self, grips: Grips = FREE) -> None:
        """Go on with the steps of the phase's formation in which friction holds `grips`."""
        degree = self.coefficients.shape[2] - 1
        formation, until = self.phase.formation, self.phase.until
        self.stepper = s = build_stepper(formation, until, self.side, degree, grips)
        self.sections.append(Section(self.phase, s.to, [], [], [], []))
        self.steppers.append(s)
        s.inputs[s.at.tolerance] = self.tolerance
        s.inputs[s.at.kept] = s.mode.read_kept(self.y[:5])
        self.load_piece()

    def accept(self, t: float) -> Array:
        """Take the step just made, to time `t`, and record its end."""
        s = self.stepper
        self.t = t
        self.y[:] = s.outputs[s.to.y]
        s.inputs[s.at.heading] = s.outputs[s.to.heading]
        if not s.outputs[s.to.ratio] > 0:
            self.fail_to_step(float(s.outputs[s.to.ratio]))
        return self.keep(s.outputs.copy())

    def fail_to_step(self, ratio: float) -> None:
        """Raise the error for a step size that underflows."""
        names = " ".join(self.phase.formation.names)
        if not ratio > 1e-3:
            raise JammingError(
                f"{names} jams {self.where()}: friction makes the reduced inertia {ratio:.3g} of "
                "its frictionless value"
            )
        raise SimulationError(f"the step size of {names} underflows {self.where()}")

    def step_to(self, h: float) -> None:
        """Repeat the step with another length."""
        s = self.stepper
        s.inputs[s.at.h] = h
        s.step()

    def record(self, still: bool = False) -> Array:
        """Record the present state; at rest without forces and acceleration."""
        s = self.stepper
        s.inputs[s.at.y], s.inputs[s.at.t] = self.y, self.t
        s.look()
        row = s.outputs.copy()
        if still:
            row[s.to.acceleration] = 0.0
            row[s.to.c_n] = row[s.to.c_t] = math.nan
        return self.keep(row)

    def keep(self, row: Array) -> Array:
        """Append a row of outputs to the records; it becomes the start of the next step."""
        s, section = self.stepper, self.sections[-1]
        s.inputs[s.at.y] = self.y
        section.times.append(self.t)
        section.rows.append(row)
        section.impacts.append(self.impact)
        return row

    def drop(self) -> None:
        """Take back the last record."""
        section = next(section for section in reversed(self.sections) if section.times)
        for column in (section.times, section.rows, section.impacts):
            column.pop()

    def repeats(self) -> bool:
        """Whether the last two records are of the same instant of one phase, but for rounding."""
        sections = [section for section in self.sections if section.phase is self.phase]
        times = [time for section in sections[-2:] for time in section.times[-2:]]
        return len(times) > 1 and self.t - times[-2] <= self.tolerances.settling

    def note(
        self,
        kind: EventKind,
        text: str,
        contact: str = "",
        value: float = math.nan,
        time: float | None = None,
    ) -> None:
        """Append an event, at present if no time is given."""
        time = self.t if time is None else time
        self.events.append(Event(time, self.phase.index, kind, text, contact, value))

    def lose(self, contact: str, c_n: float) -> Outcome:
        """End because `contact` would have to pull."""
        how = "to zero" if c_n > -1e3 * self.tolerances.force else f"to {c_n:.3g} N"
        text = f"c_n of {contact} falls {how} {self.when()}"
        self.note(EventKind.CONTACT_LOST, text, contact, c_n)
        return Outcome(OutcomeKind.CONTACT_LOST, text)

    def slip(self, row: int, c_n: float, c_t: float) -> Outcome:
        """End because a rolling contact slips: the `row`-th of the formation, with forces in N."""
        formation = self.phase.formation
        name, bound = formation.names[row], formation.friction[row] * c_n
        how = "exceeds" if abs(c_t) - bound > 1e3 * self.tolerances.force else "reaches"
        text = f"{name} slips: |c_t| = {abs(c_t):.5g} N {how} mu c_n = {bound:.5g} N {self.when()}"
        self.note(EventKind.SLIP, text, name, bound - abs(c_t))
        return Outcome(OutcomeKind.SLIPS, text)

    def run_out(self) -> Outcome:
        """End because the torques end."""
        until, distance = self.phase.until, math.nan
        if until.is_release:
            names = self.phase.formation.names
            ends = [(self.resting, "comes to rest"), (self.slipping, "slips")]
            texts = [f"{', '.join(names[k] for k in sorted(rows))} {t}" for rows, t in ends if rows]
            if self.releasable:
                texts = [f"{', '.join(self.releasable)} is released"]
            text = f"the torques end {self.when()}, before {' or '.join(texts)}"
        else:
            distance = self.value(self.stepper.rows.until)
            unit = "rad" if until.coordinate == "phi" else "m"
            text = f"the torques end {self.when()}, {distance:.3g} {unit} short of {until}"
        self.note(EventKind.END, text, "", distance)
        return Outcome(OutcomeKind.GOAL_MISSED, text)

    def value(self, row: int) -> float:
        """One of the event values at the present state."""
        return float(self.stepper.outputs[self.stepper.to.events.start + row])

    def load_piece(self) -> None:
        """Set the stepper's inputs for the present piece of the torques."""
        s = self.stepper
        s.inputs[s.at.piece.start : s.at.torque.stop] = self.pieces[self.piece]

    def next_piece(self) -> bool:
        """Go on to the next piece, if there is one; whether the torques step there."""
        if self.piece + 2 >= len(self.breaks):
            return False
        self.piece += 1
        self.load_piece()
        return self.steps_at[self.piece]

    @property
    def coming_step(self) -> float:
        """When the torques step next, after the present piece, or infinity [s]."""
        k = bisect_left(self.step_times, self.breaks[self.piece + 1])
        return self.step_times[k] if k < len(self.step_times) else math.inf

    @property
    def last_step(self) -> float:
        """When the torques last stepped, at their start or later [s]."""
        return self.step_times[bisect_left(self.step_times, self.breaks[self.piece + 1]) - 1]

    def fraction(self, t: float) -> float:
        """Coordinate of time `t` on the present piece, from -1 to 1."""
        start, stop = self.breaks[self.piece], self.breaks[self.piece + 1]
        return min(1.0, max(-1.0, (2 * t - start - stop) / (stop - start)))

    def time(self, x: float) -> float:
        """Time at `x` of the present piece [s]."""
        start, stop = self.breaks[self.piece], self.breaks[self.piece + 1]
        return (start + stop + x * (stop - start)) / 2

    def when(self) -> str:
        """Present time and phase, to end a sentence."""
        return f"at t = {self.t:.5g} s, phase {self.phase.number}"

    def where(self) -> str:
        """Present phase and time, for errors."""
        return f"in phase {self.phase.number} at t = {self.t:.5g} s"

    @property
    def stored(self) -> float:
        """Kinetic and potential energy [J]."""
        scene, v = self.problem.scene, self.y[5:10]
        height = scene.polygon.mass * scene.gravity * self.y[1]
        return float(0.5 * v**2 @ scene.mass_diagonal + height)
