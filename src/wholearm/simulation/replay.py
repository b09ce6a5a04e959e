"""State of a running simulation with prescribed contact formations, and its event values."""

from __future__ import annotations

import math
from bisect import bisect_left
from functools import lru_cache
from typing import Any, NamedTuple, NoReturn

import casadi as ca
import numpy as np

from ..common.arrays import Array
from ..common.errors import JammingError, SimulationError
from ..contacts.elemental import GapLimit, build_features, build_gap
from ..contacts.formation import Formation
from ..problem.definition import Phase, Problem, Until
from ..results.torque import TorqueProfile
from .events import EventKind, Outcome, OutcomeKind
from .hand import build_system
from .modes import FREE, Grips, Mode, share_mode
from .root_finding import find_root
from .run import Run, find_torque_steps
from .stepper import Modes, ModeStepper
from .tolerances import ROUNDING_FORCE, ROUNDING_SPEED, SHORT, find_tolerances, measure_until


class LegRows(NamedTuple):
    """Where each kind of event value of a leg is; all are in units of the scene."""

    force: slice  # c_n
    # what friction still has to give where it holds (`Mode.holders`): bound - f, then bound + f
    cone: slice
    slide: slice  # slide, joint: sliding velocities times Xi, joint speeds times sigma
    joint: slice
    limit: slice  # the formation's limits; that of the contact to be gained counts as `until`
    until: int  # distance to the end of the phase; one if that is a release
    # speed along the heading, in the metric M5; one with more than one freedom, where contacts and
    # joints come to rest one by one
    speed: int

    @property
    def turning(self) -> slice:
        """All that changes sign at a reversal: contacts, then joints."""
        return slice(self.slide.start, self.joint.stop)


class ModeSegment(NamedTuple):
    """A part of a phase with one set of contact modes."""

    mode: Mode
    stepper: ModeStepper
    rows: LegRows
    slack: Array  # (m,): how far below zero each event value counts as rounding
    # sets `event_values` from outputs of the steps and the `heading` at their start, (5,)
    measure: Any
    heading: Array
    # m values, distance to the end [m or rad], its rate, least value plus slack, heading
    event_values: Array
    buffers: Any  # what has to live as long as these
    phase: int = 0  # index of its phase
    section: int = 0  # number of its records


class Step(NamedTuple):
    """A step that has been made, into which may be looked."""

    leg: ModeSegment
    t: float  # t, h [s]: its start and length
    h: float
    inputs: Array  # its packed inputs
    heading: Array  # direction of the velocity at its start
    stage_forces: Array
    impact: float  # [J]: energy lost to impacts so far
    arrives: bool  # whether it ends where the phase ends, which it has passed by rounding


@lru_cache(maxsize=64)
def open_limits(formation: Formation, until: Until) -> tuple[GapLimit, ...]:
    """Limits that end a phase early: all but that of the contact to be gained."""
    return tuple(limit for limit in formation.limits if not limit.gains(until.contact))


@lru_cache(maxsize=64)
def _build_leg(
    formation: Formation, until: Until, side: float, s: ModeStepper, mode: Mode
) -> ModeSegment:
    """A segment with the steps of its mode, before it gets a phase and a number."""
    scene, own = formation.scene, s.rows
    limits, last = open_limits(formation, until), own.slide.stop + 2
    parts = own.force, own.cone, own.slide, slice(own.slide.stop, last)
    until_row = last + len(limits)
    rows = LegRows(*parts, slice(last, until_row), until_row, until_row + 1)
    sizes = [own.cone.stop, last - own.cone.stop, len(limits), 1, 1]
    slack = np.repeat([ROUNDING_FORCE, ROUNDING_SPEED, SHORT, 0.0, ROUNDING_SPEED], sizes)
    z, v, before = build_features(scene).z, ca.SX.sym("v", 5), ca.SX.sym("before", 5)
    values = ca.SX.sym("values", own.size)
    gained = [limit for limit in formation.limits if limit.gains(until.contact)]
    if until.is_release:
        distance = ca.SX(1)
    elif until.contact is None:
        distance = side * (z[0 if until.coordinate == "x" else 2] - until.value)
    elif gained:
        # A pointed tip comes to a vertex along the edge, or turns onto it with its link.
        distance = ca.mmin(ca.vertcat(*(limit.value for limit in gained)))
    else:
        distance = build_gap(until.contact, scene)
    mass, unit = ca.DM(scene.mass_diagonal), scene.scales.speed * scene.scales.mass**0.5
    speed = ca.dot(before, mass * v) / unit if mode.n_constraints >= 4 else ca.SX(1)
    gaps = [limit.value / scene.scales.length for limit in limits]
    reached = distance / measure_until(scene, until)
    every = ca.vertcat(values[: own.slide.stop], values[-2:], *gaps, reached, speed)
    size = ca.sqrt(ca.dot(v, mass * v))
    heading = ca.if_else(size > 0, v / ca.fmax(size, 1e-300), before)
    least = ca.mmin(every + ca.DM(slack))
    outputs = ca.vertcat(every, distance, ca.jtimes(distance, z, v), least, heading)
    inner = ca.Function("measure", [z, v, values, before], [ca.densify(outputs)])
    packed, start = ca.MX.sym("packed", s.to.size), ca.MX.sym("start", 5)
    measured = inner(packed[:5], packed[5:10], packed[s.to.values], start)
    buffer, measure = ca.Function("measure", [packed, start], [measured]).buffer()
    start, event_values = np.zeros(5), np.zeros(len(slack) + 8)
    buffer.set_arg(0, s.outputs.data)
    buffer.set_arg(1, start.data)
    buffer.set_res(0, event_values.data)
    return ModeSegment(mode, s, rows, slack, measure, start, event_values, buffer)


class Replay(Run):
    """A running simulation with prescribed contacts.

    Attributes
    ----------
    has_slid                 whether contacts that come to rest have slid in the phase
    slip_signs               signs of contacts, by name, that have just begun to slip
    side                     sign of (coordinate - value) before the end of the phase
    until_unit : [m or rad]  unit of the distance to the end of the phase
    passes                   whether the end may be passed at any speed, without an impact
    moving                   whether the motion goes on into the next phase
    previous                 formation of the last phase that has ended at rest
    wanted                   instants at which steps have to end; infinity is last
    stuck                    contacts, then joints, that stick while the rest moves
    taken                    steps so far, but for those that coast
    """

    leg: ModeSegment
    phase: Phase
    releasable: tuple[str, ...]  # the contacts whose release ends the phase
    # resting, slipping: the contacts that come to rest, all of them, or slip, one of them, where
    # the phase ends
    resting: frozenset[int]
    slipping: frozenset[int]

    def __init__(
        self, problem: Problem, torque: TorqueProfile, tolerance: float, wanted: Array
    ) -> None:
        system = build_system(problem.scene)
        super().__init__(system, torque, np.asarray(problem.start), np.zeros(5), tolerance)
        self.problem, self.tolerances = problem, find_tolerances(problem.scene)
        parts = torque.coefficients
        steps = find_torque_steps(parts[:-1], parts[1:], system)
        self.steps_at: list[bool] = [True, *steps.tolist()]
        self.step_times = [b for b, s in zip(self.breaks, self.steps_at, strict=False) if s]
        within = wanted[(wanted >= self.breaks[0]) & (wanted <= self.breaks[-1])]
        self.wanted = [*within.tolist(), math.inf]
        self.next_wanted = 0
        self.held_until = self.settled_by = -math.inf
        self.until_unit = self.side = 1.0
        self.passes = self.moving = self.has_slid = False
        self.previous: Formation | None = None
        self.stuck: set[int] = set()
        self.slip_signs: dict[str, float] = {}
        self.decided = (-math.inf, 0)
        self.taken: list[Step] = []

    @property
    def formation(self) -> Formation:
        """That of the present phase."""
        return self.phase.formation

    @property
    def signs(self) -> Array:
        """Directions of contacts, then of joints, (n_c + 2,), zero for what is held or rolls."""
        inputs, at = self.s.inputs, self.s.at
        return np.concatenate([inputs[at.Xi], inputs[at.sigma][3:]])

    @signs.setter
    def signs(self, signs: Array) -> None:
        inputs, at = self.s.inputs, self.s.at
        inputs[at.Xi], inputs[at.sigma][3:] = signs[:-2], signs[-2:]

    def enter(self, phase: Phase) -> None:
        """Go on with a phase, in which nothing sticks."""
        self.phase, self.phase_index, until = phase, phase.index, phase.until
        self.side = 1.0
        if until.value is not None:
            place = self.y[0 if until.coordinate == "x" else 2]
            self.side = math.copysign(1.0, place - until.value)
        self.until_unit = measure_until(self.problem.scene, until)
        self.stuck = set()
        self.take()

    def take(self, grips: Grips = FREE) -> None:
        """Go on with the steps of the phase's formation in which friction holds `grips`."""
        formation, mode = self.formation, share_mode(self.formation, grips)
        count = formation.n_contacts
        pairs = [self.system.names.index(name) for name in formation.names]
        stuck = (tuple(pairs[k] for k in rows) for rows in mode.holders if rows[0] < count)
        joints = tuple(3 + joint for joint in grips.joints)
        self.load(Modes(tuple(pairs), tuple(stuck), joints, (0.0,) * count, (0.0,) * 5))
        self.s.stay(self.system, self.z)
        self.section += 1
        leg = _build_leg(formation, self.phase.until, self.side, self.s, mode)
        self.leg = leg._replace(phase=self.phase.index, section=self.section)
        self.heading = np.zeros(5)

    @property
    def values(self) -> Array:
        """Event values at the end of the last step, or at the state looked at."""
        return self.leg.event_values[:-8].copy()

    @property
    def distance(self) -> float:
        """Distance to the end of the phase there [m or rad]."""
        return float(self.leg.event_values[-8])

    @property
    def rate(self) -> float:
        """Time derivative of the distance."""
        return float(self.leg.event_values[-7])

    def happens(self) -> bool:
        """Whether the step just made ends behind an event."""
        self.leg.measure()
        return bool(self.leg.event_values[-6] < 0)

    @property
    def heading(self) -> Array:
        """Velocity at the start of a step, scaled to one in the metric M5, or the impending one."""
        return self.leg.heading

    @heading.setter
    def heading(self, heading: Array) -> None:
        self.leg.heading[:] = heading

    def step_to(self, h: float) -> None:
        """Repeat the step with another length."""
        super().step_to(h)
        self.leg.measure()

    def look(self) -> None:
        """Evaluate the present state."""
        self.s.inputs[self.s.at.y], self.s.inputs[self.s.at.t] = self.y, self.t
        self.s.look()
        self.leg.measure()

    def observe(self) -> None:
        """Evaluate the present state, and record it."""
        self.look()
        self.record()

    def accept(self, t: float) -> None:
        """Take the step just made, to time `t`, and record its end."""
        s, self.t = self.s, t
        self.y[:] = s.outputs[s.to.y]
        self.leg.heading[:] = self.leg.event_values[-5:]
        if not s.outputs[s.to.ratio] > 0:
            self.fail_to_step(float(s.outputs[s.to.ratio]))
        s.inputs[s.at.y], s.inputs[s.at.t] = self.y, t
        self.record()

    def keep(self, t: float, arrives: bool = False) -> None:
        """Accept the step to time `t` as one to look into; `arrives`: see `Step`."""
        s, begin, heading = self.s, self.t, self.heading.copy()
        inputs, forces = s.inputs.copy(), s.outputs[s.to.stage_forces].copy()
        self.accept(t)
        step = Step(self.leg, begin, t - begin, inputs, heading, forces, self.impact, arrives)
        self.taken.append(step)

    def fail_to_step(self, ratio: float) -> NoReturn:
        """Raise the error for a step size that underflows."""
        names = " ".join(self.formation.names)
        if not ratio > 1e-3:
            raise JammingError(
                f"{names} jams {self.where()}: friction makes the reduced inertia {ratio:.3g} of "
                "its frictionless value"
            )
        raise SimulationError(f"the step size of {names} underflows {self.where()}")

    def repeats(self) -> bool:
        """Whether the last two records are of the same instant of one phase, but for rounding."""
        last = self.records[-2:]
        same = len(last) > 1 and last[0].phase == last[1].phase == self.phase.index
        return same and self.t - last[0].t <= self.tolerances.settling

    def lose(self, contact: str, c_n: float) -> Outcome:
        """End because `contact` would have to pull."""
        how = "to zero" if c_n > -1e3 * self.tolerances.force else f"to {c_n:.3g} N"
        text = f"c_n of {contact} falls {how} {self.when()}"
        self.note(EventKind.CONTACT_LOST, text, contact, c_n)
        return Outcome(OutcomeKind.CONTACT_LOST, text)

    def slip(self, row: int, c_n: float, c_t: float) -> Outcome:
        """End because a rolling contact slips: the `row`-th of the formation, with forces in N."""
        name, bound = self.formation.names[row], self.formation.friction[row] * c_n
        how = "exceeds" if abs(c_t) - bound > 1e3 * self.tolerances.force else "reaches"
        text = f"{name} slips: |c_t| = {abs(c_t):.5g} N {how} mu c_n = {bound:.5g} N {self.when()}"
        self.note(EventKind.SLIP, text, name, bound - abs(c_t))
        return Outcome(OutcomeKind.SLIPS, text)

    def run_out(self) -> Outcome:
        """End because the torques end."""
        until, distance = self.phase.until, math.nan
        if until.is_release:
            names = self.formation.names
            ends = [(self.resting, "comes to rest"), (self.slipping, "slips")]
            texts = [f"{', '.join(names[k] for k in sorted(rows))} {t}" for rows, t in ends if rows]
            if self.releasable:
                texts = [f"{', '.join(self.releasable)} is released"]
            text = f"the torques end {self.when()}, before {' or '.join(texts)}"
        else:
            distance = self.distance
            unit = "rad" if until.coordinate == "phi" else "m"
            text = f"the torques end {self.when()}, {distance:.3g} {unit} short of {until}"
        self.note(EventKind.END, text, "", distance)
        return Outcome(OutcomeKind.GOAL_MISSED, text)

    def next_piece(self) -> bool:
        """Go on to the next piece, if there is one; whether the torques step there."""
        if self.piece + 2 >= len(self.breaks):
            return False
        self.piece += 1
        self.feed()
        return self.steps_at[self.piece]

    @property
    def coming_step(self) -> float:
        """When the torques step next, after the present piece, or infinity [s]."""
        k = bisect_left(self.step_times, self.stop)
        return self.step_times[k] if k < len(self.step_times) else math.inf

    @property
    def last_step(self) -> float:
        """When the torques last stepped, at their start or later [s]."""
        return self.step_times[bisect_left(self.step_times, self.stop) - 1]

    def when(self) -> str:
        """Present time and phase, to end a sentence."""
        return f"at t = {self.t:.5g} s, phase {self.phase.number}"

    def where(self) -> str:
        """Present phase and time, for errors."""
        return f"in phase {self.phase.number} at t = {self.t:.5g} s"


def find_first(run: Replay, start: Array, h: float, among: slice | None = None) -> list[int]:
    """Shorten the step just tried, of length h [s], to its first event; returns the event's rows.

    `start` are the event values at its start, `among` the rows to look at.
    """
    rows, slack = run.leg.rows, run.leg.slack
    places = range(len(slack))[among] if among else range(len(slack))
    # A value that starts within rounding of zero has to fall below that.
    shift = np.where(start > slack, 0.0, slack)
    before = start + shift
    seen: list[int] = []
    done: list[int] = []
    while True:
        after = run.values + shift
        left = [k for k in places if after[k] < 0 and k not in done]
        if not left:
            return [k for k in seen if after[k] <= slack[k] or k == done[-1]]
        seen += [k for k in left if k not in seen]
        share = {k: max(before[k], 0.0) / (max(before[k], 0.0) - after[k]) for k in left}
        k = rows.speed if rows.speed in left else min(left, key=share.__getitem__)

        def value(step: float, place: int = k) -> float:
            run.step_to(step)
            return float(run.values[place] + shift[place])

        near = 1e-2 * run.tolerances.shortest_step
        h = find_root(value, h, float(before[k]), float(after[k]), near, 1e-3 * float(slack[k]))
        done.append(k)
        if h != run.s.inputs[run.s.at.h]:
            run.step_to(h)
        if k == rows.speed:
            # When the motion stops all sliding does; what reversed before shows just before.
            run.step_to(0.999 * h)
            if (run.values[rows.turning] + shift[rows.turning] < 0).any():
                h *= 0.999
            else:
                run.step_to(h)
