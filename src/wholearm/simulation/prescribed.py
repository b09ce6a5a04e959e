"""Motion with prescribed contact formations: phase after phase, from rest in the first one.

Friction has the sliding signs of the current mode, steps end where a polynomial piece of the
torques ends. At rest the formation waits until it can start (`Rest.wait`), or after a motion
until the next one can that releases a contact.

A phase that ends at rest stops the motion. After a smooth end the velocity is projected onto the
next formation, and contacts that it does not have are released. A phase without an `until` ends at
that release, where a contact slips that slides in the next phase, or where contacts come to rest
that roll there. After an impact every contact of the next formation has to press
(`mechanics.impact`).

Where a sliding or joint velocity reaches zero, Coulomb's law decides. A contact at rest may slide
with a sign if it then accelerates with it, or stick if its c_t stays in the cone; a joint likewise.
Each combination is one linear system, and every contact has to press. Forces are evaluated a short
time later, which tells one that leaves its cone from one that returns. The combination with the
largest margin is taken.

What cannot move because something else sticks has no independent constraint. Its friction is
indeterminate and has either sign: margins elsewhere are monotonic in it, so some sign is consistent
for as long as any friction is. It counts as stuck.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import Enum
from functools import lru_cache
from operator import itemgetter
from typing import Any, NamedTuple, NoReturn, cast

import casadi as ca
import numpy as np

from ..common.arrays import Array, find_lowest
from ..common.errors import JammingError, SimulationError
from ..common.sharing import bind
from ..contacts.contact_limits import takes_over
from ..contacts.elemental import build_features
from ..contacts.formation import Formation
from ..mechanics.impact import ViolationKind, compute_impact
from ..problem.definition import End, Phase, Problem, Until
from ..results.torque import TorqueProfile
from . import modes
from .events import EventKind, Outcome, OutcomeKind, Record, describe_change
from .run import Run, StuckError
from .system import (
    FIRST_STEP,
    INNER_STAGES,
    NODES,
    REACHED,
    REST_WINDOW,
    ROUNDING_FORCE,
    SETTLING,
    SLOW,
    STANDING,
    build_system,
)

# Longest time between a reversal and its torque step where contacts press too little meanwhile:
# errors of the phases before make it 2.3e-5 in phase 11 of query 1. Contacts open less than 1e-7.
BRIDGED = 2e-4
CLEAR = 1e-8  # least margin of a clear decision, over the scene's units
_OUTCOMES = {
    ViolationKind.PULL: OutcomeKind.CONTACT_LOST,
    ViolationKind.SLIP: OutcomeKind.SLIPS,
    ViolationKind.CLOSING: OutcomeKind.LIMIT_REACHED,
    ViolationKind.HELD: OutcomeKind.HELD,
}


_STAGES = np.array([0.0, *(NODES[stage] for stage in INNER_STAGES), 1.0])[:, None]
_POWERS, _PLACES = np.arange(len(_STAGES)), (1 - np.cos(np.pi * np.arange(17) / 16)) / 2
_INSIDE = _PLACES[:, None] ** _POWERS @ np.linalg.inv(_STAGES**_POWERS)
"""Chebyshev points of a step, and values there from those at `INNER_STAGES` and the ends."""


class PhaseEnds(NamedTuple):
    """What ends a phase, as a compiled function of the state."""

    evaluate: Any  # sets `values` from `state`
    state: Array  # (10,): z, z'
    # gaps of the formation's limits that end the phase early [m], then the distance to its end, one
    # if that is a release [m or rad], and the time derivative of that
    values: Array
    texts: list[str]  # what has happened where these limits are reached
    unit: float  # of the distance [m or rad]


@lru_cache(maxsize=64)
def _build_ends(formation: Formation, until: Until, side: float) -> PhaseEnds:
    """Ends of a phase that comes to a coordinate from a `side`, 1 from above."""
    scene = formation.scene
    gained = [limit.value for limit in formation.limits if limit.gains(until.contact)]
    limits = [limit for limit in formation.limits if not limit.gains(until.contact)]
    features, v = build_features(scene), ca.SX.sym("v", 5)
    if until.is_release:
        distance = ca.SX(1)
    elif until.contact is None:
        row, value = until.poses[0]
        distance = side * (features.z[row] - value)
    elif gained:
        # A pointed tip comes to a vertex along the edge, or turns onto it with its link.
        distance = ca.mmin(ca.vertcat(*gained))
    else:
        distance = features.pairs[until.contact].gap
    parts = *(limit.value for limit in limits), distance, ca.jtimes(distance, features.z, v)
    function = ca.Function("ends", [ca.vertcat(features.z, v)], [ca.densify(ca.vertcat(*parts))])
    state, values = np.zeros(10), np.zeros(len(parts))
    evaluate, texts = bind(function, [state], [values]), [limit.text for limit in limits]
    unit = 1.0 if until.coordinate == "phi" else scene.scales.length
    return PhaseEnds(evaluate, state, values, texts, unit)


class Stop(Enum):
    """How a motion ends without an outcome."""

    PHASE = "the end of the phase is reached"
    REST = "the object comes to rest"


Ending = Stop | Outcome


class Replay(Run):
    """A running simulation with prescribed contacts."""

    minima: bool  # whether to record where margins are least within steps, too
    settling: float  # settling, rest_window [s], rounding [N]: see the constants of these names
    rest_window: float
    rounding: float
    phase: Phase
    following: Phase | None  # the next phase
    ends: PhaseEnds  # what ends the phase
    distance: float  # to its end [m or rad]
    rate: float  # time derivative of that
    passes: bool  # whether the end may be passed at any speed, without an impact
    moving: bool  # whether the motion goes on into the next phase
    mode: modes.Mode  # what rolls, sticks and is held
    # (5,): velocity at the start of a step, or the impending one, over its size in the metric M5
    heading: Array
    stuck: set[int]  # contacts, then joints, that stick while the rest moves
    slip_signs: dict[str, float]  # of contacts that have just begun to slip
    least: Array  # (n_c,): c_n up to now in the phase, over the scene's force
    releasable: tuple[str, ...]  # the contacts whose release ends the phase
    # resting, slipping: the contacts that come to rest, all of them, or slip, one of them, where
    # the phase ends
    resting: frozenset[int]
    slipping: frozenset[int]

    def __init__(
        self, problem: Problem, torque: TorqueProfile, tolerance: float, wanted: Array, minima: bool
    ) -> None:
        system = build_system(problem.scene)
        super().__init__(system, torque, np.asarray(problem.start), np.zeros(5), tolerance, wanted)
        self.problem, self.minima, time = problem, minima, system.scales.time
        self.settling, self.rest_window = SETTLING * time, REST_WINDOW * time
        self.rounding = ROUNDING_FORCE * system.scales.force
        self.step_times = [b for b, s in zip(self.breaks, self.steps_at, strict=False) if s]
        self.held_until = self.settled_by = -math.inf
        self.distance = self.rate = 0.0
        self.passes = self.moving = False
        self.stuck, self.slip_signs = set(), {}

    @property
    def formation(self) -> Formation:
        """That of the present phase."""
        return self.phase.formation

    @property
    def signs(self) -> Array:
        """Directions of contacts, then of joints, (n_c + 2,), zero for what is held or rolls."""
        return np.concatenate([self.s.inputs.Xi, self.s.inputs.sigma[3:]])

    @signs.setter
    def signs(self, signs: Array) -> None:
        self.mode = replace(self.mode, signs=signs)
        self.s.inputs.Xi[:], self.s.inputs.sigma[3:] = signs[:-2], signs[-2:]

    def take(self, mode: modes.Mode, heading: Array) -> None:
        """Go on in a mode, with the direction of the motion, (5,)."""
        self.load(mode.find_modes())
        self.mode, self.heading = mode, heading
        self.signs = mode.signs
        rows, count = self.s.rows, len(self.ends.texts)
        self.turning = slice(rows.slide.start, rows.slide.stop + 2)
        self.limit = slice(self.turning.stop, self.turning.stop + count)
        sizes = [rows.cone.stop, self.turning.stop - rows.cone.stop, count, 1, 1]
        # Of speeds 2e-13 is rounding.
        self.slack = np.repeat([ROUNDING_FORCE, 2e-13, REACHED, 0.0, 2e-13], sizes)

    def measure(self) -> Array:
        """Event values after the step just made, scaled.

        Forces and margins of friction; sliding velocities times Xi, and speeds of the joints times
        sigma; limits of the formation but that of the contact to be gained; distance to the end of
        the phase; speed along the heading, in the metric M5. The last is one with more than one
        freedom, where contacts and joints come to rest one by one.
        """
        out, ends, scales = self.s.outputs, self.ends, self.system.scales
        ends.state[:] = out.y[:10]
        ends.evaluate()
        self.distance, self.rate = ends.values[-2:].tolist()
        speed = 1.0
        if self.mode.n_constraints >= 4:
            size = float(self.heading @ (self.system.mass * out.y[5:10]))
            speed = size / (scales.speed * scales.mass**0.5)
        # Those of the coordinates of the object, between, are zero.
        moving, turning = out.values[: self.s.rows.slide.stop], out.values[-2:]
        last = self.distance / ends.unit, speed
        return np.concatenate([moving, turning, ends.values[:-2] / scales.length, last])

    @property
    def shift(self) -> Array:
        """A value that starts within rounding of zero has to fall below that."""
        return np.where(self.start > self.slack, 0.0, self.slack)

    def observe(self) -> None:
        """Evaluate the present state, and record it."""
        self.look()
        self.record()

    def keep(self, t: float) -> None:
        """Take the step just made, to time `t`, and record its end."""
        super().keep(t)
        if self.mode.n_constraints >= 4 and self.v.any():
            self.heading = self.v / math.sqrt(self.system.mass @ self.v**2)
        self.require_inertia()

    def require_inertia(self) -> None:
        """Raise a `JammingError` where friction leaves no reduced inertia."""
        ratio = float(self.s.outputs.ratio[0])
        if not ratio > 0:
            self.fail_to_step(ratio)

    def fail_to_step(self, ratio: float) -> NoReturn:
        """Raise the error for a step size that underflows."""
        names = " ".join(self.formation.names)
        if not ratio > 1e-3:
            text = f"friction makes the reduced inertia {ratio:.3g} of its frictionless value"
            raise JammingError(f"{names} jams {self.when()}: {text}")
        raise SimulationError(f"the step size of {names} underflows {self.when()}")

    def lose(self, contact: str, c_n: float) -> Outcome:
        """End because `contact` would have to pull."""
        how = "to zero" if c_n > -1e3 * self.rounding else f"to {c_n:.3g} N"
        text = self.note(EventKind.CONTACT_LOST, f"c_n of {contact} falls {how}", contact, c_n)
        return Outcome(OutcomeKind.CONTACT_LOST, text)

    def release(self, c_n: float) -> Stop:
        """End the phase as the next one lets contacts go; the least that they would need [N]."""
        names = ", ".join(self.releasable)
        self.note(EventKind.RELEASE, f"{names} released", names, c_n)
        self.moving = True
        return Stop.PHASE

    def switch(self, contact: str, sign: float = 0.0) -> Stop:
        """End the phase as a contact slips with a `sign`, or comes to rest, as in the next one."""
        self.note(EventKind.ARRIVAL, f"{contact} {'slips' if sign else 'comes to rest'}", contact)
        self.slip_signs = {contact: sign} if sign else {}
        self.moving = True
        return Stop.PHASE

    def fail_by_slip(self, row: int, c_n: float, c_t: float) -> Ending:
        """End because a rolling contact, the `row`-th, slips under forces in N: by plan, or not."""
        name, bound = self.formation.names[row], self.formation.friction[row] * c_n
        if row in self.slipping:
            return self.switch(name, -math.copysign(1.0, c_t))
        how = "exceeds" if abs(c_t) - bound > 1e3 * self.rounding else "reaches"
        text = f"{name} slips: |c_t| = {abs(c_t):.5g} N {how} mu c_n = {bound:.5g} N"
        text = self.note(EventKind.SLIP, text, name, bound - abs(c_t))
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
            more = f", before {' or '.join(texts)}"
        else:
            distance = self.distance
            unit = "rad" if until.coordinate == "phi" else "m"
            more = f", {distance:.3g} {unit} short of {until}"
        text = self.note(EventKind.END, "the torques end", "", distance, more)
        return Outcome(OutcomeKind.GOAL_MISSED, text)

    @property
    def coming_step(self) -> float:
        """When the torques step next, after the present piece, or infinity [s]."""
        k = bisect_left(self.step_times, self.stop)
        return self.step_times[k] if k < len(self.step_times) else math.inf

    def when(self) -> str:
        """Present time and phase, in a sentence."""
        return f"at t = {self.t:.5g} s, phase {self.phase.number}"

    def play(self, progress: Callable[[str], None] | None) -> tuple[Outcome, float]:
        """Simulate phase after phase; how that ends, and how far from the end of the last one."""
        phases = self.problem.phases
        for phase, following in zip(phases, [*phases[1:], None], strict=True):
            if progress is not None:
                progress(f"simulating phase {phase.number} of {len(phases)}")
            try:
                self.enter(phase, following)
                ending = (self.go_on() or self.move()) if self.moving else self._rest()
                while ending is Stop.REST:
                    ending = self._rest()
            except (JammingError, SimulationError) as error:
                error.phase = phase.number
                raise
            if isinstance(ending, Outcome):
                return ending, math.nan if phase.until.is_release else self.distance
        goal = phases[-1].until
        text = f"{goal} is reached at t = {self.t:.5g} s, the end of phase {len(phases)}"
        return Outcome(OutcomeKind.GOAL_REACHED, text), math.nan if goal.is_release else 0.0

    def _arrive(self, window: float | None = None, stepped: bool = False) -> Ending:
        """End the phase; if it ends at rest the motion stops, with a plastic impact if need be.

        If the next step of the torques, or their end, comes within the `window` [s], or before the
        motion was to end, the arrival belongs to it; the latter not if they have just `stepped`.
        While moving the window is short.
        """
        if window is None:
            window = self.settling if abs(self._measure_rate()) < SLOW else 0.0
        until, following = self.phase.until, self.following
        self.note(EventKind.ARRIVAL, f"{until} reached", str(until), -self.rate)
        if self._strikes() and following is not None:
            self.moving = True
            return self.collide(following) or Stop.PHASE
        self.moving = self.phase.end is End.SMOOTH
        if self.moving:
            return Stop.PHASE
        remaining = self._find_remaining()
        self.set_velocity(0.0)
        # The torques of the phase that has ended go on until they step, or end.
        window = window if stepped else max(window, remaining)
        coming = min(self.coming_step, self.breaks[-1])
        self.held_until = coming if coming - self.t <= window else self.t
        if self.problem.scene.has_slow_motors:
            # Rate-limited torques do not step. A motion whose deceleration fades comes early by
            # about the cube root of its error: the old torques act until it was to end.
            self.held_until = max(self.held_until, min(self.t + remaining, self.breaks[-1]))
            self.settled_by = self.held_until + self.rest_window
        return Stop.PHASE

    def _rest(self) -> Ending:
        """Wait until the formation starts, and move; or the goal is near, or balance is lost."""
        self.set_velocity(0.0)
        self.look()
        self.record(still=True)
        if self.is_there():
            return self._arrive(self.rest_window)
        rest, sticks = modes.Rest(self.formation, self.z), False
        # After a motion statics may leave open whether what the next phase releases still presses:
        # it does not where that phase starts. Case: phase 3 of query 44 with limited rates.
        leaving = None
        if self.releasable and self.following and self.heading.any():
            leaving = modes.Rest(self.following.formation, self.z)
        while True:
            if self.t >= self.breaks[-1]:
                return self.run_out()
            if self.t >= self.held_until:
                x = min(1.0, max(-1.0, self.fraction(self.t)))
                coefficients = self.torque.coefficients[self.piece]
                change = rest.wait(coefficients, x)
                parting = leaving.wait(coefficients, x) if leaving else None
                if isinstance(parting, modes.StartDeparture) and (
                    change is None or parting.x < change.x
                ):
                    self.wait(max(self.t, self.time(parting.x)))
                    return self.release(0.0)
                if isinstance(change, modes.StartDeparture) and change.x <= x:
                    return self.set_off(change)
                if not sticks:
                    self.note(EventKind.STICK, "the object sticks")
                sticks = True
                if isinstance(change, modes.StartDeparture):
                    self.wait(self.time(change.x))
                    return self.set_off(change)
                if isinstance(change, modes.Collapse):
                    # Balance may be lost where the torques are about to step or to be the next
                    # phase's.
                    t = self.time(change.x)
                    if not (t < self.settled_by or self.coming_step - t <= self.rest_window):
                        return self._collapse(change)
            if self.t < self.settled_by < self.stop:
                self.wait(self.settled_by)
            else:
                self.wait(self.stop)
                self.next_piece()

    def _collapse(self, change: modes.Collapse) -> Ending:
        """End because nothing balances at rest."""
        self.wait(max(self.t, self.time(change.x)))
        if change.jammed:
            raise JammingError(
                f"{' '.join(self.formation.names)} jams at rest {self.when()}: friction makes "
                "the reduced inertia vanish or turn negative"
            )
        if change.c_t is not None:
            row = self.formation.names.index(change.contact)
            return self.fail_by_slip(row, change.c_n, change.c_t)
        if change.contact in self.releasable:
            return self.release(change.c_n)
        return self.lose(change.contact, change.c_n)

    def move(self) -> Ending:
        """Integrate until the motion rests, arrives, releases its contacts or fails."""
        self.h = min(self.h, FIRST_STEP * self.system.scales.time)
        try:
            return cast(Ending, super().move())
        except StuckError:
            self.fail_to_step(float(self.s.outputs.ratio[0]))

    def locate(self, t: float) -> list[int]:
        """Shorten the step just made to its first event; rows of its event values."""
        rows, records, least = list[int](), list[Record](), math.inf
        if (self.values < -self.slack).any() and not self._is_at_end(t):
            rows = self.find_first()
        if self.minima:
            records, least = self._look_inside(float(self.s.inputs.h[0]))
        if least < math.inf:
            self.step_to(least)
            rows = self.find_first()
        end = self.t + float(self.s.inputs.h[0])
        self.records += [record for record in records if record.t < end]
        return rows

    def _look_inside(self, h: float) -> tuple[list[Record], float]:
        """States where margins are least within the step just made, of length h [s].

        Returns them and the first of these instants at which an event shows, since the start of
        the step, infinity if there is none.
        """
        s, rows = self.s, self.s.rows
        margins = s.outputs.values[: rows.cone.stop]
        stage_margins = np.vstack([s.outputs.stages.reshape(-1, len(margins)), margins])
        inside = _INSIDE @ stage_margins
        # Of a normal force, what is less than any of the phase before counts.
        least, force = np.minimum(stage_margins[0], stage_margins[-1]), rows.force
        self.least = least[force] = np.minimum(least[force], self.least)
        # Dips by less, in units of the scene, are no deeper than an error of interpolation.
        dips = inside.min(axis=0) < least - 1e-7
        if not dips.any():
            return [], math.inf
        lowest = {find_lowest(_PLACES, inside[:, row])[1] for row in np.flatnonzero(dips)}
        records, shown = list[Record](), math.inf
        for x in sorted(lowest):
            self.step_to(x * h)
            records.append(self.read_outputs(self.t + x * h))
            self.least = np.minimum(self.least, self.values[force])
            if (self.values + self.slack < 0).any():
                shown = min(shown, x * h)
        self.step_to(h)
        return records, shown

    def _is_at_end(self, t: float) -> bool:
        """Whether the step just tried ends the phase, at a torque break and but for rounding.

        It has to be at rest there or to reach a contact softly. A coordinate, or the end of a
        contact's range, is passed at any speed; an impact comes at any, with its torque step or at
        their end.
        """
        if t != self.stop or not self.is_there() or self._comes_later():
            return False
        speed = abs(self._measure_rate())
        if self.passes:
            distance = self.distance / self.ends.unit
            # Of several breaks as near as that, the nearest is the one at which the phase ends.
            later = self.breaks[self.piece + 2 : self.piece + 3]
            time = self.problem.scene.scales.time
            early = min(SETTLING, (later[0] - t) / time / 2 if len(later) else math.inf)
            # Phase 1 of scene 584 of seed 1128 stops there, for the least effort.
            stops = self._time_to_stop() < SETTLING * time
            passed = -SETTLING * speed <= distance <= early * speed
            speed = 0.0 if stops or passed else math.inf
        elif self.phase.end is End.IMPACT and self._strikes():
            coming = self.piece + 1
            speed = 0.0 if coming >= len(self.steps_at) or self.steps_at[coming] else speed
        elif self.phase.end is not End.SMOOTH:
            speed = float(np.abs(self.s.outputs.y[5:10] / self.system.units[5:]).max())
        return speed < SLOW

    def _comes_later(self) -> bool:
        """Whether a motion with fading deceleration still approaches, at a break before its end."""
        coming = self.piece + 1
        if not self.problem.scene.has_slow_motors or self.phase.end is not End.REST:
            return False
        if coming + 1 >= len(self.breaks) or self.steps_at[coming]:
            return False
        late = 2 * self._time_to_stop() > self.settling  # phase 4 of query 47: 9e-5 s
        # Above the error of integration.
        return late and self._measure_rate() < -1e-7

    def pass_break(self) -> Ending | None:
        """Go on to the next piece of the torques."""
        if self._is_at_end(self.t):
            # Before a step that is still to come, the torques are those of the phase that ends.
            stepped = self.next_piece() and self.steps_at[self.piece]
            # Phase 10 of query 32 is there two breaks before its end.
            return self._arrive(self.settling if stepped else self.rest_window, bool(stepped))
        if self.t >= self.breaks[-1]:
            return self.run_out()
        self.next_piece()
        if not self.steps_at[self.piece]:
            return None
        self.note(EventKind.TORQUE_STEP, "the torques step")
        return self.restart()

    def handle(self, kinds: Sequence[int]) -> Ending | None:
        """End the motion at events, or go on."""
        if len(self.slack) - 2 in kinds:
            return self._arrive()
        if len(self.slack) - 1 in kinds:
            return self.come_to_rest()
        pulling = [k for k in kinds if k < self.s.rows.force.stop]
        if pulling:
            return self.let_go(pulling)
        cone, limit, mode = self.s.rows.cone, self.limit, self.mode
        bounds = [k - cone.start for k in kinds if cone.start <= k < cone.stop]
        if any(mode.declares(k % len(mode.holders)) for k in bounds):
            return self.slip()
        reached = [] if bounds else [k for k in kinds if limit.start <= k < limit.stop]
        if reached:
            text = self.note(EventKind.LIMIT, self.ends.texts[reached[0] - limit.start])
            return Outcome(OutcomeKind.LIMIT_REACHED, text)
        turning, free = self._find_turning(kinds), self.formation.n_constraints < 4
        if turning and not free and self.phase.end is End.SMOOTH and self.is_there():
            # Phase 1 of scene 584 of seed 1128 turns 5 nm before its end, for the least time.
            return self._arrive()
        return self.restart(turning)

    def _find_remaining(self) -> float:
        """Time until the torques to come slow the motion no more, or have stopped it [s].

        A planned motion that is there early by its error, or has stopped just short of its end,
        would have ended then. A deceleration that fades linearly from a takes 2 v / a, which is
        sqrt(6 d / a) for the distance d; one that fades later is that of the next phase. Cases:
        phase 8 of query 79 and phase 14 of query 5 with limited rates.
        """
        v, longest = self.s.outputs.y[5:10].copy(), 2e-2 * self.system.scales.time
        speed = math.sqrt(self.system.mass @ v**2)
        if not speed or not self.rate:
            return 0.0
        rows = modes.evaluate_rows(self.formation, self.z, v)
        response = modes.respond(self.mode, rows, v)
        if response is None:
            return 0.0
        later = self.breaks[self.piece + 1 : bisect_right(self.breaks, self.t + longest)]
        t = np.array([self.t, *later])
        loads = np.column_stack([np.ones(len(t)), self.torque.at(t)])
        away = math.copysign(1.0, self.rate) * self.system.mass * v / speed
        slowing = loads @ response.acceleration.T @ away
        if slowing[0] <= 1e-2 * np.abs(slowing).max():
            return 0.0
        # A millionth of the scene's length is what a plan and its replay differ by.
        left = max(abs(self.distance) - 1e-6 * self.ends.unit, 0.0) * speed / abs(self.rate)
        latest = 1.1 * max(2 * speed / slowing[0], math.sqrt(6 * left / slowing[0]))
        fades = t[slowing <= 1e-3 * slowing[0]]
        if len(fades) and fades[0] - self.t <= latest:
            return float(fades[0] - self.t)
        lost = np.append(0.0, np.cumsum(np.diff(t) * (slowing[1:] + slowing[:-1]) / 2))
        lost = np.maximum.accumulate(lost)
        return float(np.interp(speed, lost, t) - self.t) if speed < lost[-1] else 0.0

    def _measure_rate(self) -> float:
        """Time derivative of the distance to the end of the phase, in units of the scene."""
        return self.rate / self.ends.unit * self.problem.scene.scales.time

    def _time_to_stop(self) -> float:
        """Time in which the motion would stop at its present deceleration [s]."""
        v, acceleration = self.s.outputs.y[5:10], self.s.outputs.acceleration
        slowing = -float((self.system.mass * v) @ acceleration)
        return float(self.system.mass @ v**2) / slowing if slowing > 0 else math.inf

    def _strikes(self) -> bool:
        """Whether the phase ends here with an impact, and not at rest but for an error."""
        rate, time = -self._measure_rate(), self._time_to_stop() / self.problem.scene.scales.time
        return self.phase.end is End.IMPACT and not (rate < SLOW or rate * time / 2 < REACHED)

    def enter(self, phase: Phase, following: Phase | None) -> None:
        """Enter the formation of `phase`; the energy that its projection takes is lost to impact.

        A phase without an `until` ends where a contact of `releasable` parts, or else where
        contacts of `resting` come to rest, as they roll in the next phase, or one of `slipping`
        slips.
        """
        formation, old = phase.formation, self.system.stored(self.z, self.v)
        until = phase.until.lead(self.z, self.system.scales.length)
        self.phase, self.phase_index = replace(phase, until=until), phase.index
        self.following = following
        self.y[:5] = self._close(formation)
        self.impact += float(old - self.system.stored(self.z, self.v))
        self.project_velocity(formation.evaluate(self.z[None], self.v[None]).P[0])
        self.moving = self.moving and not self.stands
        if not self.moving:
            self.set_velocity(0.0)
        # At any speed a contact can be gained only where it goes on for another one.
        gained = until.contact
        self.passes = phase.end is End.SMOOTH and (
            gained is None or takes_over(gained, formation.scene, formation.contacts)
        )
        side = 1.0
        if until.value is not None:
            row, value = until.poses[0]
            side = math.copysign(1.0, self.y[row] - value)
        self.ends = _build_ends(formation, until, side)
        self.stuck, self.least = set(), np.full(formation.n_contacts, math.inf)
        none = np.zeros(formation.n_contacts + 2)
        self.take(replace(modes.find_mode(formation, none + 1), signs=none), np.zeros(5))
        self.releasable, self.resting, self.slipping = (), frozenset(), frozenset()
        if phase.end is End.REST or following is None or not until.is_release:
            return
        contacts, kept = formation.contacts, set(following.formation.contacts)
        rolled, rolls = (set(each.formation.rolling) for each in (phase, following))
        self.releasable = tuple(c.name for c in contacts if c not in kept)
        if not self.releasable:
            self.resting = frozenset(k for k, c in enumerate(contacts) if c in rolls - rolled)
        self.slipping = frozenset(k for k, c in enumerate(contacts) if c in (rolled - rolls) & kept)

    def _close(self, formation: Formation) -> Array:
        """The present configuration with every contact of a formation closed."""
        try:
            return modes.require_closed(formation, self.z, 10 * REACHED * self.system.scales.length)
        except SimulationError as error:
            raise SimulationError(f"{error} {self.when()}") from None

    def collide(self, following: Phase) -> Outcome | None:
        """Plastic impact onto the next formation; the outcome if it is not possible."""
        z = self._close(following.formation)
        impact = compute_impact(self.formation, following.formation, z, self.v)
        name, least = impact.least_impulse
        names = following.formation.names
        normal = impact.p[: len(names)]
        impulses = ", ".join(f"{p:.4g} on {n}" for n, p in zip(names, normal, strict=True))
        self.note(EventKind.IMPACT, "impact", name, least, f", in N s {impulses}")
        if impact.violations:
            worst = impact.violations[0]
            text = f"{worst.describe()} in the impact {self.when()}"
            if worst.kind is ViolationKind.JAM:
                raise JammingError(text)
            return Outcome(_OUTCOMES[worst.kind], text)
        self.set_velocity(impact.v)
        return None

    def set_off(self, departure: modes.StartDeparture) -> Ending:
        """Move from rest, with the friction signs of the start."""
        if not self.gets_on():
            raise SimulationError(f"starting and stopping do not end {self.when()}")
        self.note(EventKind.START, "the object starts to move")
        formation, mode = self.formation, departure.mode
        if formation.n_constraints < 4:
            fixed = modes.find_fixed(mode, modes.evaluate_rows(formation, self.z, self.v))
            gripped = (row for u in modes.list_units(formation) if u.grips for row in u.rows)
            self.stuck = {row for row in gripped if fixed[row]}
        self.take(mode, departure.heading)
        self.observe()
        return self.move()

    def go_on(self) -> Ending | None:
        """Set the friction signs of the present velocity; what ends the motion at once, if any."""
        formation, v = self.formation, self.v
        self.heading = v / np.sqrt(self.system.mass @ v**2)
        rates = modes.evaluate_rows(formation, self.z, v).A_t @ v
        movable = [row for unit in modes.list_units(formation) for row in unit.rows]
        signs = np.zeros(len(rates))
        signs[movable] = np.where(rates < 0, -1.0, 1.0)[movable]
        for name, sign in self.slip_signs.items():
            signs[formation.names.index(name)] = sign
        self.slip_signs = {}
        self.signs = signs
        return self.restart(enters=formation.n_constraints < 4)

    def restart(self, turned: Sequence[int] = (), enters: bool = False) -> Ending | None:
        """Choose contact modes after forces jump and record them; what ends the motion, if any.

        `turned`: contacts, then joints, that came to rest; `enters`: a new formation.
        """
        if self._decide(turned, enters):
            return self.come_to_rest()
        self.observe()
        ended, c_n = self._bridge(SETTLING), self.s.outputs.c_n
        # By more than rounding: phase 5 of leg 59 of seed 1128.
        if ended or ((c_n < 0.99 * self.problem.epsilon).any() and self._bridge(BRIDGED)):
            return self.come_to_rest()
        self.require_inertia()
        if not enters and self.resting and self.resting <= self.stuck:
            return self._hold()
        reserves, holders = self._measure_reserves(), self.mode.holders
        slipping = {holders[k][0] for k, reserve in reserves.items() if reserve < -ROUNDING_FORCE}
        pulling: list[int] = np.flatnonzero(self.s.outputs.c_n < -self.rounding).tolist()
        # Whether anything pulls where a contact slips by plan, its next formation says.
        if pulling and not slipping & self.slipping:
            return self.let_go(pulling)
        return self.slip() if slipping else None

    def _decide(self, turned: Sequence[int], enters: bool = False) -> bool:
        """Choose the friction signs of all that stands still; whether all motion has ended.

        With one freedom whatever slides or turns does so for as long as there is motion.
        """
        formation, signs = self.formation, self.signs
        if formation.n_constraints >= 4:
            if len(turned) and self.stands:
                # What slides does so with the one velocity; events of slow contacts come later.
                turned = np.flatnonzero(signs).tolist()
            for row in turned:
                signs[row] *= -1
                self.note_change(row, -signs[row], signs[row])
            self.signs = signs
            return False
        self.look()
        slow = np.abs(self.values[self.turning]) < STANDING
        still = [
            unit
            for unit in modes.list_units(formation)
            if set(unit.rows) & set(turned) or (unit.grips and slow[list(unit.rows)].any())
        ]
        if not still:
            return False
        if self.stands:
            return True
        if not self.gets_on():
            names = " ".join(formation.names)
            raise SimulationError(f"sticking and slipping of {names} do not end {self.when()}")
        mode = self._choose(signs, still)
        chosen, rows = mode.signs, modes.evaluate_rows(formation, self.z, self.v)
        fixed = modes.find_fixed(mode, rows)
        # Rounding of speeds against the directions chosen is taken away.
        first = np.array([unit.rows[0] for unit in still])
        wrong = first[(chosen[first] == 0) | (chosen[first] * (rows.A_t[first] @ self.v) < 0)]
        stays = [*formation.rolling_rows, *wrong]
        self.project_velocity(np.vstack([rows.A, rows.A_t[stays]]))
        self.take(mode, self.v / np.sqrt(self.system.mass @ self.v**2))
        for unit in still:
            row = unit.rows[0]
            before = 0.0 if row in self.stuck else float(signs[row])
            after = float(chosen[row]) if not fixed[row] else 0.0
            changes = before != after and not (enters and after) and unit.grips
            for row in unit.rows if changes else ():
                self.note_change(row, before, after)
            self.stuck = (self.stuck - set(unit.rows)) | set(() if after else unit.rows)
        return False

    def come_to_rest(self) -> Stop:
        """End all motion, and the phase if a contact was to come to rest."""
        if not self.is_there():
            self.note(EventKind.REST, "the object comes to rest")
        return self._hold() if self.resting else Stop.REST

    def _hold(self) -> Stop:
        return self.switch(", ".join(self.formation.names[row] for row in sorted(self.resting)))

    def _drop_repeated(self) -> None:
        """Take back forces after a jump that are those of a formation that is given up."""
        last = self.records[-2:]
        same = len(last) > 1 and last[0].phase == last[1].phase == self.phase.index
        if same and self.t - last[0].t <= self.settling:
            self.records.pop()

    def let_go(self, contacts: Sequence[int]) -> Ending:
        """End as contacts would have to pull: a release if that is planned of one of them."""
        names = self.formation.names
        forces = dict(zip(names, self.s.outputs.c_n.tolist(), strict=True))
        pulling = [names[k] for k in contacts]
        if any(name in self.releasable for name in pulling):
            self._drop_repeated()
            return self.release(min(forces[name] for name in self.releasable))
        name = min(pulling, key=forces.__getitem__)
        return self.lose(name, min(0.0, forces[name]))

    def slip(self) -> Ending:
        """End because a rolling contact slips, or starts to part where its release is planned."""
        s, holders, reserves = self.s, self.mode.holders, self._measure_reserves()
        out = [k for k, reserve in reserves.items() if reserve < -ROUNDING_FORCE]
        planned = [k for k in out if holders[k][0] in self.slipping]
        row = holders[min(planned or reserves, key=reserves.__getitem__)][0]
        if self.formation.names[row] in self.releasable:
            return self.let_go([row])
        c_n, c_t = (float(part[row]) for part in (s.outputs.c_n, s.outputs.c_t))
        if row in self.slipping:
            self._drop_repeated()
        return self.fail_by_slip(row, c_n, c_t)

    def _find_turning(self, events: Sequence[int]) -> list[int]:
        """Contacts, then joints, whose sliding or turning is among events."""
        turning = self.turning
        return [k - turning.start for k in events if turning.start <= k < turning.stop]

    def _measure_reserves(self) -> dict[int, float]:
        """Friction margin of the forces that hold what rolls by plan, over the scene's force."""
        reserves = self.values[self.s.rows.cone].reshape(2, -1).min(axis=0).tolist()
        return {k: x for k, x in enumerate(reserves) if self.mode.declares(k)}

    def coast(self, stop: float) -> None:
        """Step to `stop`, whatever happens on the way, without a record of the forces there."""
        while self.wanted[0] < stop:
            place = self.wanted.popleft()
            self.step_to(place - self.t)
            self.keep(place)
            row = self.records[-1]
            none = np.full(len(row.kept), np.nan)
            self.records[-1] = row._replace(c_n=none, c_t=none)
        self.step_to(stop - self.t)
        self.keep(stop)
        self.records.pop()

    def is_there(self) -> bool:
        """Whether the distance to the end of the phase counts as none, at rest."""
        return abs(self.distance) < REACHED * self.ends.unit

    def _bridge(self, longest: float) -> bool:
        """Integrate between a reversal and its torque step, unrecorded; whether motion has ended.

        `longest` is the time between them, over the scene's.
        """
        rows, window = list[int](), longest * self.system.scales.time
        # A phase passed at speed may end before. Case: a pentagon (0, 0), (60, 0), (75, 30),
        # (30, 60), (-10, 35) mm, where e3-tip2 goes on as v4-tip2 1 us after a torque step.
        ending = self.passes and self.is_there()
        if self.coming_step - self.t <= window and not ending:
            self.records.pop()
            while True:
                self.coast(self.stop)
                self.next_piece()
                if self.steps_at[self.piece]:
                    break
            self.note(EventKind.TORQUE_STEP, "the torques step")
        else:
            stretch = min(window, self.stop - self.t)
            if self._turns_later(stretch):
                return False
            self.start = self.values
            self.step_to(stretch)
            rows = self._find_turning(self.find_first(self.turning))
            if not rows:
                self.look()
                return False
            self.records.pop()
            self.coast(self.t + float(self.s.inputs.h[0]))
        ended = self._decide(rows)
        if not ended:
            self.observe()
        return ended

    def _turns_later(self, span: float) -> bool:
        """Whether all that slides or turns is too fast to come to rest within a short time [s].

        Accelerations relative to each other are at most ten times the largest of the coordinates.
        """
        out, time, units = self.s.outputs, self.system.scales.time, self.system.units[5:]
        fastest = np.abs(out.y[5:10] / units).max()
        strongest = np.abs(out.acceleration / units).max() * time
        moving = self.values[self.turning][self.signs != 0]
        return bool((moving > 10 * span / time * (strongest + fastest**2)).all())

    def note_change(self, row: int, before: float, after: float) -> None:
        """Record that a contact or joint sticks, slips or turns back."""
        names = self.formation.names
        contact = row < len(names)
        name = names[row] if contact else f"joint {row - len(names) + 1}"
        kind, text = describe_change(name, before, after, "slides" if contact else "turns")
        self.note(kind, text, name)

    def _choose(self, signs: Array, still: Sequence[modes.Unit]) -> modes.Mode:
        """The most consistent mode by signs of what stands still; `JammingError` without any."""
        formation, scales, ahead = self.formation, self.system.scales, self.settling
        loads = [np.array([1.0, *self.tau(t)]) for t in (self.t, self.t + ahead)]
        present, count = modes.evaluate_rows(formation, self.z, self.v), formation.n_contacts
        speeds, ratios = np.repeat([scales.speed, scales.rate], [count, 2]), [1.0]

        def measure(mode: modes.Mode) -> tuple[float, float] | None:
            """Least margin of acceleration along the signs or of friction, and least c_n, relative.

            None if the combination jams or leaves its forces undetermined.
            """
            acceleration, rates = np.zeros(5), np.zeros(count + 2)
            for delay, load in zip((0.0, ahead), loads, strict=True):
                v = self.v + delay * acceleration
                z = self.z + delay * (self.v + v) / 2
                rows = modes.evaluate_rows(formation, z, v) if delay else present
                response = modes.respond(mode, rows, v)
                if response is None or not response.ratio > 0:
                    ratios.extend([] if response is None else [response.ratio])
                    return None
                acceleration = response.acceleration @ load
                rates = rates + response.rates @ load / 2
                held = response.force_limits @ load
            gained = mode.signs * rates / (speeds / scales.time)
            cones = held[count:].reshape(2, -1).min(axis=0)
            margins = [np.inf]
            for unit in still:
                row = unit.rows[0]
                if mode.signs[row] == 0:
                    margins.append(cones[mode.holders.index(unit.rows)])
                elif abs(gained[row]) > CLEAR:
                    margins.append(gained[row])
            return float(min(margins)), float(held[:count].min())

        measured = [(measure(mode), mode) for mode in modes.list_modes(formation, signs, still)]
        choices = [(*margins, mode) for margins, mode in measured if margins is not None]
        pressing = [choice for choice in choices if min(choice[:2]) > -CLEAR]
        # Where none presses a contact is about to be lost, and its forces say which.
        pulling = [choice for choice in choices if choice[1] <= -CLEAR]
        if pressing or pulling:
            return max(pressing or pulling, key=itemgetter(0))[2]
        if min(ratios) <= 0:
            self.fail_to_step(min(ratios))
        text = f"jams {self.when()}: no combination of sliding and sticking is consistent"
        raise JammingError(f"{' '.join(formation.names)} {text}")
