"""Motion with prescribed contact formations: phase after phase, from rest in the first one.

Friction has the sliding signs of the current mode. Steps end at breaks of the torques. At rest the
formation waits until a motion can start (`Rest.wait`) in it, or, after a motion, in the next
formation that releases a contact.

A phase that ends at rest stops the motion. After a smooth end the velocity is projected onto the
next formation, which releases the other contacts. A phase without an `until` ends at that release,
or where a contact slips that slides in the next phase, or where contacts come to rest that roll in
the next phase. After an impact every contact of the next formation has to press
(`mechanics.impact`).

Where a sliding or joint velocity reaches zero, Coulomb's law selects the mode. A contact at rest
may slide with a sign if it accelerates with that sign, or stick if c_t stays in its cone; a joint
likewise. Each combination is one linear system, and every contact has to press. Forces are also
evaluated a short time later, as a force may leave its cone or return to it. The combination with
the largest margin is selected.

A unit fixed by the sticking of others has no independent constraint. Its friction is indeterminate
and gets either sign: the other margins are monotonic in it, so some sign is consistent if any
friction force is. The unit counts as stuck.
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
    ARRIVAL,
    EVENT_DELAY,
    FIRST_STEP,
    INNER_STAGES,
    REST_SPEED,
    REST_WINDOW,
    ROUNDING_FORCE,
    STAGE_TIMES,
    ZERO_SPEED,
    build_system,
)

# Longest time between a reversal and its torque step if normal forces are below epsilon meanwhile.
# Case: phase 11 of query 1, 2.3e-5 by errors of earlier phases. Contacts open less than 1e-7.
MAX_BRIDGE = 2e-4
CLEAR_MARGIN = 1e-8  # smallest margin of a unique choice, in units of the scene
_OUTCOMES = {
    ViolationKind.PULL: OutcomeKind.CONTACT_LOST,
    ViolationKind.SLIP: OutcomeKind.SLIPS,
    ViolationKind.CLOSING: OutcomeKind.LIMIT_REACHED,
    ViolationKind.HELD: OutcomeKind.HELD,
}

_STAGES = np.array([0.0, *(STAGE_TIMES[stage] for stage in INNER_STAGES), 1.0])[:, None]
_POWERS, _CHEBYSHEV = np.arange(len(_STAGES)), (1 - np.cos(np.pi * np.arange(17) / 16)) / 2
_INTERPOLATION = _CHEBYSHEV[:, None] ** _POWERS @ np.linalg.inv(_STAGES**_POWERS)
"""Interpolation from `INNER_STAGES` and the ends of a step to its Chebyshev points."""


class PhaseEnds(NamedTuple):
    """Distance to the end of a phase and limits that end it, compiled."""

    evaluate: Any  # sets `values` from `state`
    state: Array  # (10,): z, z'
    # limits of the formation that end the phase early [m], the distance to its end, one if that is
    # a release [m or rad], and the time derivative of the distance
    values: Array
    texts: list[str]  # messages of these limits
    unit: float  # of the distance [m or rad]


@lru_cache(maxsize=64)
def _build_ends(formation: Formation, until: Until, side: float) -> PhaseEnds:
    """Ends of a phase that approaches its coordinate from a `side`, 1 from above."""
    scene = formation.scene
    target_gaps = [limit.value for limit in formation.limits if limit.gains(until.contact)]
    limits = [limit for limit in formation.limits if not limit.gains(until.contact)]
    features, v = build_features(scene), ca.SX.sym("v", 5)
    if until.is_release:
        distance = ca.SX(1)
    elif until.contact is None:
        row, value = until.poses[0]
        distance = side * (features.z[row] - value)
    elif target_gaps:
        # A pointed tip reaches a vertex along the edge, or by rotation of its link.
        distance = ca.mmin(ca.vertcat(*target_gaps))
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
    """A running simulation with the contact formations of a problem."""

    minima: bool  # whether to record minima of margins within steps
    delay: float  # delay, rest_window [s], rounding [N]: see the constants of these names
    rest_window: float
    rounding: float
    phase: Phase
    next_phase: Phase | None  # None in the last phase
    ends: PhaseEnds  # ends of the phase
    distance: float  # distance to the end of the phase [m or rad]
    rate: float  # time derivative of `distance`
    passable: bool  # whether any speed is allowed at the end, without an impact
    in_motion: bool  # whether the next phase starts in motion
    mode: modes.Mode  # rolling, sticking and held units, and signs of the others
    # (5,): direction of the present or impending velocity, of length one in the metric M5
    heading: Array
    stuck: set[int]  # contacts, then joints, that stick during a motion
    slip_signs: dict[str, float]  # of contacts that start to slip at the present time
    min_force: Array  # (n_c,): smallest c_n so far in the phase, over the scene's force
    releasable: tuple[str, ...]  # contacts whose release ends the phase
    # resting, slipping: contacts whose end of sliding (of all), or start of slipping (of one), ends
    # the phase
    resting: frozenset[int]
    slipping: frozenset[int]

    def __init__(
        self, problem: Problem, torque: TorqueProfile, tolerance: float, times: Array, minima: bool
    ) -> None:
        system = build_system(problem.scene)
        super().__init__(system, torque, np.asarray(problem.start), np.zeros(5), tolerance, times)
        self.problem, self.minima, time = problem, minima, system.scales.time
        self.delay, self.rest_window = EVENT_DELAY * time, REST_WINDOW * time
        self.rounding = ROUNDING_FORCE * system.scales.force
        self.step_times = [b for b, s in zip(self.breaks, self.steps_at, strict=False) if s]
        self.hold_end = self.grace_end = -math.inf
        self.distance = self.rate = 0.0
        self.passable = self.in_motion = False
        self.stuck, self.slip_signs = set(), {}

    @property
    def formation(self) -> Formation:
        """Formation of the present phase."""
        return self.phase.formation

    @property
    def signs(self) -> Array:
        """Signs of sliding, then of joint rates, (n_c + 2,); zero if held or rolling."""
        return np.concatenate([self.s.inputs.Xi, self.s.inputs.sigma[3:]])

    @signs.setter
    def signs(self, signs: Array) -> None:
        self.mode = replace(self.mode, signs=signs)
        self.s.inputs.Xi[:], self.s.inputs.sigma[3:] = signs[:-2], signs[-2:]

    def set_mode(self, mode: modes.Mode, heading: Array) -> None:
        """Set the contact mode and the direction of motion, (5,)."""
        self.load(mode.find_modes())
        self.mode, self.heading = mode, heading
        self.signs = mode.signs
        rows, count = self.s.rows, len(self.ends.texts)
        self.rate_rows = slice(rows.slide.start, rows.slide.stop + 2)
        self.limit_rows = slice(self.rate_rows.stop, self.rate_rows.stop + count)
        sizes = [rows.cone.stop, self.rate_rows.stop - rows.cone.stop, count, 1, 1]
        # Rounding of speeds is 2e-13.
        self.slack = np.repeat([ROUNDING_FORCE, 2e-13, ARRIVAL, 0.0, 2e-13], sizes)

    def measure(self) -> Array:
        """Scaled event values after the last step.

        Forces and margins of friction; sliding velocities times Xi, and speeds of the joints times
        sigma; limits of the formation except for the gained contact; distance to the end of the
        phase; speed along the heading, in the metric M5. The last value is 1 with several degrees
        of freedom, as contacts and joints then come to rest one by one.
        """
        outputs, ends, scales = self.s.outputs, self.ends, self.system.scales
        ends.state[:] = outputs.y[:10]
        ends.evaluate()
        self.distance, self.rate = ends.values[-2:].tolist()
        speed = 1.0
        if self.mode.n_constraints >= 4:
            size = float(self.heading @ (self.system.mass * outputs.y[5:10]))
            speed = size / (scales.speed * scales.mass**0.5)
        # Values of the object's coordinates, between these, are zero.
        contacts, joints = outputs.values[: self.s.rows.slide.stop], outputs.values[-2:]
        end_values = self.distance / ends.unit, speed
        return np.concatenate([contacts, joints, ends.values[:-2] / scales.length, end_values])

    @property
    def shift(self) -> Array:
        """Event thresholds: values that start within rounding of zero have to fall below it."""
        return np.where(self.start > self.slack, 0.0, self.slack)

    def evaluate_and_record(self) -> None:
        """Evaluate and record the present state."""
        self.evaluate_state()
        self.record()

    def keep(self, t: float) -> None:
        """Accept the last step, to time `t` [s], and record its end."""
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
        """Raise the error of a step size underflow."""
        names = " ".join(self.formation.names)
        if not ratio > 1e-3:
            text = f"friction makes the reduced inertia {ratio:.3g} of its frictionless value"
            raise JammingError(f"{names} jams {self.when()}: {text}")
        raise SimulationError(f"the step size of {names} underflows {self.when()}")

    def end_by_loss(self, contact: str, c_n: float) -> Outcome:
        """End by the loss of `contact`."""
        suffix = "to zero" if c_n > -1e3 * self.rounding else f"to {c_n:.3g} N"
        text = self.note(EventKind.CONTACT_LOST, f"c_n of {contact} falls {suffix}", contact, c_n)
        return Outcome(OutcomeKind.CONTACT_LOST, text)

    def reach_limit(self, text: str) -> Outcome:
        """End at a limit of the formation."""
        return Outcome(OutcomeKind.LIMIT_REACHED, self.note(EventKind.LIMIT, text))

    def release(self, c_n: float) -> Stop:
        """End the phase by the release of contacts; `c_n`: the least that they need [N]."""
        names = ", ".join(self.releasable)
        self.note(EventKind.RELEASE, f"{names} released", names, c_n)
        self.in_motion = True
        return Stop.PHASE

    def end_phase(self, contact: str, sign: float = 0.0) -> Stop:
        """End the phase as planned: a contact slips with a `sign`, or comes to rest."""
        self.note(EventKind.ARRIVAL, f"{contact} {'slips' if sign else 'comes to rest'}", contact)
        self.slip_signs = {contact: sign} if sign else {}
        self.in_motion = True
        return Stop.PHASE

    def fail_by_slip(self, row: int, c_n: float, c_t: float) -> Ending:
        """End because the rolling contact `row` slips under forces [N], as planned or not."""
        name, bound = self.formation.names[row], self.formation.friction[row] * c_n
        if row in self.slipping:
            return self.end_phase(name, -math.copysign(1.0, c_t))
        verb = "exceeds" if abs(c_t) - bound > 1e3 * self.rounding else "reaches"
        text = f"{name} slips: |c_t| = {abs(c_t):.5g} N {verb} mu c_n = {bound:.5g} N"
        text = self.note(EventKind.SLIP, text, name, bound - abs(c_t))
        return Outcome(OutcomeKind.SLIPS, text)

    def end_by_torques(self) -> Outcome:
        """End with the torques."""
        until, distance = self.phase.until, math.nan
        if until.is_release:
            names = self.formation.names
            ends = [(self.resting, "comes to rest"), (self.slipping, "slips")]
            texts = [f"{', '.join(names[k] for k in sorted(rows))} {t}" for rows, t in ends if rows]
            if self.releasable:
                texts = [f"{', '.join(self.releasable)} is released"]
            tail = f", before {' or '.join(texts)}"
        else:
            distance = self.distance
            unit = "rad" if until.coordinate == "phi" else "m"
            tail = f", {distance:.3g} {unit} short of {until}"
        text = self.note(EventKind.END, "the torques end", "", distance, tail)
        return Outcome(OutcomeKind.GOAL_MISSED, text)

    @property
    def next_step_time(self) -> float:
        """Next torque step after the present piece, or infinity [s]."""
        k = bisect_left(self.step_times, self.stop)
        return self.step_times[k] if k < len(self.step_times) else math.inf

    def when(self) -> str:
        """Text of the present time and phase."""
        return f"at t = {self.t:.5g} s, phase {self.phase.number}"

    def play(self, progress: Callable[[str], None] | None) -> tuple[Outcome, float]:
        """Simulate all phases; returns the outcome and the distance to the last end."""
        phases = self.problem.phases
        for phase, next_phase in zip(phases, [*phases[1:], None], strict=True):
            if progress is not None:
                progress(f"simulating phase {phase.number} of {len(phases)}")
            try:
                self.enter(phase, next_phase)
                ending = (self.continue_motion() or self.move()) if self.in_motion else self._rest()
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

    def _arrive(self, window: float | None = None, after_step: bool = False) -> Ending:
        """End the phase: continue in motion, stop, or compute a plastic impact.

        After a stop the formation holds until the next torque step, or their end, within the
        `window` [s] or the planned remaining time; only the window counts `after_step`. The default
        window is `delay` at low speed, else zero.
        """
        if window is None:
            window = self.delay if abs(self._measure_rate()) < REST_SPEED else 0.0
        until, next_phase = self.phase.until, self.next_phase
        self.note(EventKind.ARRIVAL, f"{until} reached", str(until), -self.rate)
        if self._ends_by_impact() and next_phase is not None:
            self.in_motion = True
            return self.apply_impact(next_phase) or Stop.PHASE
        self.in_motion = self.phase.end is End.SMOOTH
        if self.in_motion:
            return Stop.PHASE
        remaining = self._find_remaining_time()
        self.set_velocity(0.0)
        # The torques of the ended phase act until they step, or end.
        window = window if after_step else max(window, remaining)
        step_time = min(self.next_step_time, self.breaks[-1])
        self.hold_end = step_time if step_time - self.t <= window else self.t
        if self.problem.scene.has_slow_motors:
            # Phases are joined by ramps: steps are those of a finger without a rate limit, within
            # phases. A motion with fading deceleration arrives early by about the cube root of its
            # error: the old torques act until its planned end.
            self.hold_end = min(self.t + remaining, self.breaks[-1])
            self.grace_end = self.hold_end + self.rest_window
        return Stop.PHASE

    def _rest(self) -> Ending:
        """Wait at rest for a start of motion, arrival, or loss of balance."""
        self.set_velocity(0.0)
        self.evaluate_state()
        self.record(still=True)
        if self.has_arrived():
            return self._arrive(self.rest_window)
        rest, sticking = modes.Rest(self.formation, self.z), False
        # After a motion, forces of contacts to be released may be statically indeterminate: they
        # open when the next phase starts. Case: phase 3 of query 44 with limited rates.
        next_rest = None
        if self.releasable and self.next_phase and self.heading.any():
            next_rest = modes.Rest(self.next_phase.formation, self.z)
        while True:
            if self.t >= self.breaks[-1]:
                return self.end_by_torques()
            if self.t >= self.hold_end:
                x = min(1.0, max(-1.0, self.fraction(self.t)))
                coefficients = self.torque.coefficients[self.piece]
                end = rest.wait(coefficients, x)
                release = next_rest.wait(coefficients, x) if next_rest else None
                if isinstance(release, modes.StartDeparture) and (end is None or release.x < end.x):
                    self.wait(max(self.t, self.time(release.x)))
                    return self.release(0.0)
                if isinstance(end, modes.StartDeparture) and end.x <= x:
                    return self.start_motion(end)
                if not sticking:
                    self.note(EventKind.STICK, "the object sticks")
                sticking = True
                if isinstance(end, modes.StartDeparture):
                    self.wait(self.time(end.x))
                    return self.start_motion(end)
                if isinstance(end, modes.Collapse):
                    # Balance may be lost shortly before a torque step or the torques of the next
                    # phase.
                    t = self.time(end.x)
                    if not (t < self.grace_end or self.next_step_time - t <= self.rest_window):
                        return self._collapse(end)
            if self.t < self.grace_end < self.stop:
                self.wait(self.grace_end)
            else:
                self.wait(self.stop)
                self.next_piece()

    def _collapse(self, change: modes.Collapse) -> Ending:
        """End by the loss of static balance."""
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
        if change.closing:
            return self.reach_limit(change.closing)
        return self.end_by_loss(change.contact, change.c_n)

    def move(self) -> Ending:
        """Integrate until rest, arrival, release of contacts or failure."""
        self.h = min(self.h, FIRST_STEP * self.system.scales.time)
        try:
            return cast(Ending, super().move())
        except StuckError:
            self.fail_to_step(float(self.s.outputs.ratio[0]))

    def locate(self, t: float) -> list[int]:
        """Shorten the last step to its first event; returns rows of event values."""
        rows, records, first = list[int](), list[Record](), math.inf
        if (self.values < -self.slack).any() and not self._is_at_end(t):
            rows = self.find_first()
        if self.minima:
            records, first = self._find_minima(float(self.s.inputs.h[0]))
        if first < math.inf:
            self.step_to(first)
            rows = self.find_first()
        end = self.t + float(self.s.inputs.h[0])
        self.records += [record for record in records if record.t < end]
        return rows

    def _find_minima(self, h: float) -> tuple[list[Record], float]:
        """States at minima of margins within the last step, of length h [s].

        Returns them and the first of these instants with an event, from the start of the step,
        infinity if there is none.
        """
        s, rows = self.s, self.s.rows
        margins = s.outputs.values[: rows.cone.stop]
        stage_margins = np.vstack([s.outputs.stages.reshape(-1, len(margins)), margins])
        dense = _INTERPOLATION @ stage_margins
        # A normal force counts only below its smallest value so far in the phase.
        bounds, force = np.minimum(stage_margins[0], stage_margins[-1]), rows.force
        self.min_force = bounds[force] = np.minimum(bounds[force], self.min_force)
        # Smaller dips, in units of the scene, may be errors of interpolation.
        is_dip = dense.min(axis=0) < bounds - 1e-7
        if not is_dip.any():
            return [], math.inf
        places = {find_lowest(_CHEBYSHEV, dense[:, row])[1] for row in np.flatnonzero(is_dip)}
        records, first = list[Record](), math.inf
        for x in sorted(places):
            self.step_to(x * h)
            records.append(self.read_outputs(self.t + x * h))
            self.min_force = np.minimum(self.min_force, self.values[force])
            if (self.values + self.slack < 0).any():
                first = min(first, x * h)
        self.step_to(h)
        return records, first

    def _is_at_end(self, t: float) -> bool:
        """Whether the last step ends the phase at a torque break, up to rounding.

        The motion has to be at rest there or reach a contact softly. A coordinate, or the end of a
        contact's range, is passed at any speed; an impact has any speed, at a torque step or at the
        end of the torques.
        """
        if t != self.stop or not self.has_arrived() or self._is_approaching():
            return False
        speed = abs(self._measure_rate())
        if self.passable:
            distance = self.distance / self.ends.unit
            # Of several close breaks, the phase ends at the nearest.
            next_break = self.breaks[self.piece + 2 : self.piece + 3]
            time = self.problem.scene.scales.time
            lead = min(EVENT_DELAY, (next_break[0] - t) / time / 2 if len(next_break) else math.inf)
            # Phase 1 of scene 584 of seed 1128 stops there, for the least effort.
            is_stopping = self._time_to_stop() < EVENT_DELAY * time
            is_passed = -EVENT_DELAY * speed <= distance <= lead * speed
            speed = 0.0 if is_stopping or is_passed else math.inf
        elif self.phase.end is End.IMPACT and self._ends_by_impact():
            piece = self.piece + 1
            speed = 0.0 if piece >= len(self.steps_at) or self.steps_at[piece] else speed
        elif self.phase.end is not End.SMOOTH:
            speed = float(np.abs(self.s.outputs.y[5:10] / self.system.units[5:]).max())
        return speed < REST_SPEED

    def _is_approaching(self) -> bool:
        """Whether a motion with fading deceleration still approaches its end at a break."""
        piece = self.piece + 1
        if not self.problem.scene.has_slow_motors or self.phase.end is not End.REST:
            return False
        if piece + 1 >= len(self.breaks) or self.steps_at[piece]:
            return False
        is_late = 2 * self._time_to_stop() > self.delay  # phase 4 of query 47: 9e-5 s
        # Larger than the integration error.
        return is_late and self._measure_rate() < -1e-7

    def pass_break(self) -> Ending | None:
        """Enter the next piece of the torques."""
        if self._is_at_end(self.t):
            # Before the next step the torques are those of the phase that ends.
            after_step = self.next_piece() and self.steps_at[self.piece]
            # Case of two breaks before the end: phase 10 of query 32.
            return self._arrive(self.delay if after_step else self.rest_window, bool(after_step))
        if self.t >= self.breaks[-1]:
            return self.end_by_torques()
        self.next_piece()
        if not self.steps_at[self.piece]:
            return None
        self.note(EventKind.TORQUE_STEP, "the torques step")
        return self.restart()

    def handle(self, rows: Sequence[int]) -> Ending | None:
        """Process events; returns how they end the motion, or None."""
        if len(self.slack) - 2 in rows:
            return self._arrive()
        if len(self.slack) - 1 in rows:
            return self.come_to_rest()
        pulling = [k for k in rows if k < self.s.rows.force.stop]
        if pulling:
            return self.handle_tension(pulling)
        cone, limit, mode = self.s.rows.cone, self.limit_rows, self.mode
        bounds = [k - cone.start for k in rows if cone.start <= k < cone.stop]
        if any(mode.is_rolling(k % len(mode.holders)) for k in bounds):
            return self.slip()
        reached = [] if bounds else [k for k in rows if limit.start <= k < limit.stop]
        if reached:
            return self.reach_limit(self.ends.texts[reached[0] - limit.start])
        rate_rows, free = self._select_rates(rows), self.formation.n_constraints < 4
        if rate_rows and not free and self.phase.end is End.SMOOTH and self.has_arrived():
            # Phase 1 of scene 584 of seed 1128 turns 5 nm before its end, for the least time.
            return self._arrive()
        return self.restart(rate_rows)

    def _find_remaining_time(self) -> float:
        """Time until the future torques stop the motion, or no longer decelerate it [s].

        This is the planned end of a motion that arrives early, or stops just short of its end, by
        its error. A deceleration that fades linearly from a stops a speed v in 2 v / a, which is
        sqrt(6 d / a) for the distance d; one that fades later belongs to the next phase. Cases:
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
        breaks = self.breaks[self.piece + 1 : bisect_right(self.breaks, self.t + longest)]
        t = np.array([self.t, *breaks])
        loads = np.column_stack([np.ones(len(t)), self.torque.at(t)])
        direction = math.copysign(1.0, self.rate) * self.system.mass * v / speed
        deceleration = loads @ response.acceleration.T @ direction
        if deceleration[0] <= 1e-2 * np.abs(deceleration).max():
            return 0.0
        # A plan and its replay differ by a millionth of the scene's length.
        distance = max(abs(self.distance) - 1e-6 * self.ends.unit, 0.0) * speed / abs(self.rate)
        latest = 1.1 * max(2 * speed / deceleration[0], math.sqrt(6 * distance / deceleration[0]))
        zero_times = t[deceleration <= 1e-3 * deceleration[0]]
        if len(zero_times) and zero_times[0] - self.t <= latest:
            return float(zero_times[0] - self.t)
        loss = np.append(0.0, np.cumsum(np.diff(t) * (deceleration[1:] + deceleration[:-1]) / 2))
        loss = np.maximum.accumulate(loss)
        return float(np.interp(speed, loss, t) - self.t) if speed < loss[-1] else 0.0

    def _measure_rate(self) -> float:
        """Time derivative of the distance to the end of the phase, in units of the scene."""
        return self.rate / self.ends.unit * self.problem.scene.scales.time

    def _time_to_stop(self) -> float:
        """Stopping time at the present deceleration [s]."""
        v, acceleration = self.s.outputs.y[5:10], self.s.outputs.acceleration
        power = -float((self.system.mass * v) @ acceleration)
        return float(self.system.mass @ v**2) / power if power > 0 else math.inf

    def _ends_by_impact(self) -> bool:
        """Whether the phase ends with an impact, at a speed above the errors of rest."""
        rate, time = -self._measure_rate(), self._time_to_stop() / self.problem.scene.scales.time
        is_soft = rate < REST_SPEED or rate * time / 2 < ARRIVAL
        return self.phase.end is End.IMPACT and not is_soft

    def enter(self, phase: Phase, next_phase: Phase | None) -> None:
        """Enter the formation of `phase`; energy lost by the projection counts as impact loss.

        A phase without an `until` ends where a contact of `releasable` opens, or else where the
        contacts of `resting` come to rest (they roll in the next phase), or one of `slipping`
        slips.
        """
        formation, energy = phase.formation, self.system.compute_energy(self.z, self.v)
        until = phase.until.lead(self.z, self.system.scales.length)
        self.phase, self.phase_index = replace(phase, until=until), phase.index
        self.next_phase = next_phase
        self.y[:5] = self._close(formation)
        self.impact += float(energy - self.system.compute_energy(self.z, self.v))
        self.project_velocity(formation.evaluate(self.z[None], self.v[None]).P[0])
        self.in_motion = self.in_motion and not self.is_at_rest
        if not self.in_motion:
            self.set_velocity(0.0)
        # Only a contact that replaces another one is gained at any speed.
        contact = until.contact
        self.passable = phase.end is End.SMOOTH and (
            contact is None or takes_over(contact, formation.scene, formation.contacts)
        )
        side = 1.0
        if until.value is not None:
            row, value = until.poses[0]
            side = math.copysign(1.0, self.y[row] - value)
        self.ends = _build_ends(formation, until, side)
        self.stuck, self.min_force = set(), np.full(formation.n_contacts, math.inf)
        zeros = np.zeros(formation.n_contacts + 2)
        self.set_mode(replace(modes.find_mode(formation, zeros + 1), signs=zeros), np.zeros(5))
        self.releasable, self.resting, self.slipping = (), frozenset(), frozenset()
        if phase.end is End.REST or next_phase is None or not until.is_release:
            return
        contacts, kept = formation.contacts, set(next_phase.formation.contacts)
        before, after = (set(each.formation.rolling) for each in (phase, next_phase))
        self.releasable = tuple(c.name for c in contacts if c not in kept)
        if not self.releasable:
            self.resting = frozenset(k for k, c in enumerate(contacts) if c in after - before)
        self.slipping = frozenset(k for k, c in enumerate(contacts) if c in (before - after) & kept)

    def _close(self, formation: Formation) -> Array:
        """The present configuration with every contact of a formation closed."""
        try:
            return modes.require_closed(formation, self.z, 10 * ARRIVAL * self.system.scales.length)
        except SimulationError as error:
            raise SimulationError(f"{error} {self.when()}") from None

    def apply_impact(self, next_phase: Phase) -> Outcome | None:
        """Plastic impact onto the next formation; returns the outcome if infeasible."""
        z = self._close(next_phase.formation)
        impact = compute_impact(self.formation, next_phase.formation, z, self.v)
        name, min_impulse = impact.least_impulse
        names = next_phase.formation.names
        normal = impact.p[: len(names)]
        impulses = ", ".join(f"{p:.4g} on {n}" for n, p in zip(names, normal, strict=True))
        self.note(EventKind.IMPACT, "impact", name, min_impulse, f", in N s {impulses}")
        if impact.violations:
            worst = impact.violations[0]
            text = f"{worst.describe()} in the impact {self.when()}"
            if worst.kind is ViolationKind.JAM:
                raise JammingError(text)
            return Outcome(_OUTCOMES[worst.kind], text)
        self.set_velocity(impact.v)
        return None

    def start_motion(self, departure: modes.StartDeparture) -> Ending:
        """Start a motion from rest, with the friction signs of its start mode."""
        if not self.makes_progress():
            raise SimulationError(f"starting and stopping do not end {self.when()}")
        self.note(EventKind.START, "the object starts to move")
        formation, mode = self.formation, departure.mode
        if formation.n_constraints < 4:
            fixed = modes.find_fixed(mode, modes.evaluate_rows(formation, self.z, self.v))
            rows = (row for u in modes.list_units(formation) if u.frictional for row in u.rows)
            self.stuck = {row for row in rows if fixed[row]}
        self.set_mode(mode, departure.heading)
        self.evaluate_and_record()
        return self.move()

    def continue_motion(self) -> Ending | None:
        """Set the friction signs of the present velocity; returns the ending of motion, or None."""
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

    def restart(self, stopped: Sequence[int] = (), enters: bool = False) -> Ending | None:
        """Select contact modes after a jump of forces; returns the ending of motion, or None.

        `stopped`: contacts, then joints, that came to rest; `enters`: the formation is new.
        """
        if self._decide(stopped, enters):
            return self.come_to_rest()
        self.evaluate_and_record()
        at_rest, c_n = self._bridge(EVENT_DELAY), self.s.outputs.c_n
        # More than rounding. Case: phase 5 of leg 59 of seed 1128.
        if at_rest or ((c_n < 0.99 * self.problem.epsilon).any() and self._bridge(MAX_BRIDGE)):
            return self.come_to_rest()
        self.require_inertia()
        if not enters and self.resting and self.resting <= self.stuck:
            return self._end_by_sticking()
        margins, holders = self._measure_margins(), self.mode.holders
        slipping = {holders[k][0] for k, margin in margins.items() if margin < -ROUNDING_FORCE}
        pulling: list[int] = np.flatnonzero(self.s.outputs.c_n < -self.rounding).tolist()
        # After a planned slip, the next formation decides which contacts need tension.
        if pulling and not slipping & self.slipping:
            return self.handle_tension(pulling)
        return self.slip() if slipping else None

    def _decide(self, stopped: Sequence[int], enters: bool = False) -> bool:
        """Select the friction signs of all units at rest; returns whether all motion has ended.

        With one degree of freedom all units move until the motion ends.
        """
        formation, signs = self.formation, self.signs
        if formation.n_constraints >= 4:
            if len(stopped) and self.is_at_rest:
                # All rates are proportional; events of slow contacts are detected later.
                stopped = np.flatnonzero(signs).tolist()
            for row in stopped:
                signs[row] *= -1
                self.note_change(row, -signs[row], signs[row])
            self.signs = signs
            return False
        self.evaluate_state()
        is_slow = np.abs(self.values[self.rate_rows]) < ZERO_SPEED
        units = [
            unit
            for unit in modes.list_units(formation)
            if set(unit.rows) & set(stopped) or (unit.frictional and is_slow[list(unit.rows)].any())
        ]
        if not units:
            return False
        if self.is_at_rest:
            return True
        if not self.makes_progress():
            names = " ".join(formation.names)
            raise SimulationError(f"sticking and slipping of {names} do not end {self.when()}")
        mode = self._choose(signs, units)
        chosen, rows = mode.signs, modes.evaluate_rows(formation, self.z, self.v)
        fixed = modes.find_fixed(mode, rows)
        # Remove rounding of speeds opposite to the selected signs.
        first = np.array([unit.rows[0] for unit in units])
        opposed = first[(chosen[first] == 0) | (chosen[first] * (rows.A_t[first] @ self.v) < 0)]
        fixed_rows = [*formation.rolling_rows, *opposed]
        self.project_velocity(np.vstack([rows.A, rows.A_t[fixed_rows]]))
        self.set_mode(mode, self.v / np.sqrt(self.system.mass @ self.v**2))
        for unit in units:
            row = unit.rows[0]
            old_sign = 0.0 if row in self.stuck else float(signs[row])
            new_sign = float(chosen[row]) if not fixed[row] else 0.0
            is_change = old_sign != new_sign and not (enters and new_sign) and unit.frictional
            for row in unit.rows if is_change else ():
                self.note_change(row, old_sign, new_sign)
            self.stuck = (self.stuck - set(unit.rows)) | set(() if new_sign else unit.rows)
        return False

    def come_to_rest(self) -> Stop:
        """End the motion, and the phase if it ends where a contact comes to rest."""
        if not self.has_arrived():
            self.note(EventKind.REST, "the object comes to rest")
        return self._end_by_sticking() if self.resting else Stop.REST

    def _end_by_sticking(self) -> Stop:
        return self.end_phase(", ".join(self.formation.names[row] for row in sorted(self.resting)))

    def _drop_repeated(self) -> None:
        """Remove the record of forces after a jump in a formation that ends at once."""
        last = self.records[-2:]
        is_repeated = len(last) > 1 and last[0].phase == last[1].phase == self.phase.index
        if is_repeated and self.t - last[0].t <= self.delay:
            self.records.pop()

    def handle_tension(self, contacts: Sequence[int]) -> Ending:
        """End by contacts in tension: a release if planned for one of them, else a loss."""
        names = self.formation.names
        forces = dict(zip(names, self.s.outputs.c_n.tolist(), strict=True))
        pulling = [names[k] for k in contacts]
        if any(name in self.releasable for name in pulling):
            self._drop_repeated()
            return self.release(min(forces[name] for name in self.releasable))
        name = min(pulling, key=forces.__getitem__)
        return self.end_by_loss(name, min(0.0, forces[name]))

    def slip(self) -> Ending:
        """End because a rolling contact slips, or by its release if that is planned."""
        s, holders, margins = self.s, self.mode.holders, self._measure_margins()
        exceeded = [k for k, margin in margins.items() if margin < -ROUNDING_FORCE]
        planned = [k for k in exceeded if holders[k][0] in self.slipping]
        row = holders[min(planned or margins, key=margins.__getitem__)][0]
        if self.formation.names[row] in self.releasable:
            return self.handle_tension([row])
        c_n, c_t = (float(part[row]) for part in (s.outputs.c_n, s.outputs.c_t))
        if row in self.slipping:
            self._drop_repeated()
        return self.fail_by_slip(row, c_n, c_t)

    def _select_rates(self, events: Sequence[int]) -> list[int]:
        """Contacts, then joints, whose rates are among events."""
        rows = self.rate_rows
        return [k - rows.start for k in events if rows.start <= k < rows.stop]

    def _measure_margins(self) -> dict[int, float]:
        """Friction margins of rolling contacts, over the scene's force, by holder."""
        margins = self.values[self.s.rows.cone].reshape(2, -1).min(axis=0).tolist()
        return {k: x for k, x in enumerate(margins) if self.mode.is_rolling(k)}

    def integrate_to(self, stop: float) -> None:
        """Integrate to `stop` [s] without events, and without a record at its end."""
        while self.times[0] < stop:
            time = self.times.popleft()
            self.step_to(time - self.t)
            self.keep(time)
            row = self.records[-1]
            nan_forces = np.full(len(row.kept), np.nan)
            self.records[-1] = row._replace(c_n=nan_forces, c_t=nan_forces)
        self.step_to(stop - self.t)
        self.keep(stop)
        self.records.pop()

    def has_arrived(self) -> bool:
        """Whether the distance to the end of the phase counts as zero."""
        return abs(self.distance) < ARRIVAL * self.ends.unit

    def _bridge(self, window: float) -> bool:
        """Integrate between a reversal and its torque step, unrecorded; whether motion has ended.

        `window` is the largest time between them, over the scene's time.
        """
        rows, span = list[int](), window * self.system.scales.time
        # A passable phase may end before. Case: a pentagon (0, 0), (60, 0), (75, 30),
        # (30, 60), (-10, 35) mm, where e3-tip2 becomes v4-tip2 1 us after a torque step.
        arrives = self.passable and self.has_arrived()
        if self.next_step_time - self.t <= span and not arrives:
            self.records.pop()
            while True:
                self.integrate_to(self.stop)
                self.next_piece()
                if self.steps_at[self.piece]:
                    break
            self.note(EventKind.TORQUE_STEP, "the torques step")
        else:
            stretch = min(span, self.stop - self.t)
            if self._keeps_signs(stretch):
                return False
            self.start = self.values
            self.step_to(stretch)
            rows = self._select_rates(self.find_first(self.rate_rows))
            if not rows:
                self.evaluate_state()
                return False
            self.records.pop()
            self.integrate_to(self.t + float(self.s.inputs.h[0]))
        at_rest = self._decide(rows)
        if not at_rest:
            self.evaluate_and_record()
        return at_rest

    def _keeps_signs(self, span: float) -> bool:
        """Whether all rates are too fast to vanish within a short time `span` [s].

        Accelerations relative to each other are at most ten times the largest of the coordinates.
        """
        out, time, units = self.s.outputs, self.system.scales.time, self.system.units[5:]
        max_speed = np.abs(out.y[5:10] / units).max()
        max_acceleration = np.abs(out.acceleration / units).max() * time
        rates = self.values[self.rate_rows][self.signs != 0]
        return bool((rates > 10 * span / time * (max_acceleration + max_speed**2)).all())

    def note_change(self, row: int, old_sign: float, new_sign: float) -> None:
        """Record that a contact or joint sticks, slips or reverses."""
        names = self.formation.names
        contact = row < len(names)
        name = names[row] if contact else f"joint {row - len(names) + 1}"
        kind, text = describe_change(name, old_sign, new_sign, "slides" if contact else "turns")
        self.note(kind, text, name)

    def _choose(self, signs: Array, units: Sequence[modes.Unit]) -> modes.Mode:
        """Consistent mode of largest margin by signs of units at rest; `JammingError` if none."""
        formation, scales, lookahead = self.formation, self.system.scales, self.delay
        loads = [np.array([1.0, *self.tau(t)]) for t in (self.t, self.t + lookahead)]
        present, count = modes.evaluate_rows(formation, self.z, self.v), formation.n_contacts
        speeds, ratios = np.repeat([scales.speed, scales.rate], [count, 2]), [1.0]

        def measure(mode: modes.Mode) -> tuple[float, float] | None:
            """Smallest margin of accelerations or friction, and smallest c_n, relative.

            None if the combination jams or its forces are indeterminate.
            """
            acceleration, rates = np.zeros(5), np.zeros(count + 2)
            for delay, load in zip((0.0, lookahead), loads, strict=True):
                v = self.v + delay * acceleration
                z = self.z + delay * (self.v + v) / 2
                rows = modes.evaluate_rows(formation, z, v) if delay else present
                response = modes.respond(mode, rows, v)
                if response is None or not response.ratio > 0:
                    ratios.extend([] if response is None else [response.ratio])
                    return None
                acceleration = response.acceleration @ load
                rates = rates + response.rates @ load / 2
                force_limits = response.force_limits @ load
            growth = mode.signs * rates / (speeds / scales.time)
            cones = force_limits[count:].reshape(2, -1).min(axis=0)
            margins = [np.inf]
            for unit in units:
                row = unit.rows[0]
                if mode.signs[row] == 0:
                    margins.append(cones[mode.holders.index(unit.rows)])
                elif abs(growth[row]) > CLEAR_MARGIN:
                    margins.append(growth[row])
            return float(min(margins)), float(force_limits[:count].min())

        results = [(measure(mode), mode) for mode in modes.list_modes(formation, signs, units)]
        candidates = [(*margins, mode) for margins, mode in results if margins is not None]
        pressing = [candidate for candidate in candidates if min(candidate[:2]) > -CLEAR_MARGIN]
        # Without a consistent mode a contact is lost; its force identifies it.
        pulling = [candidate for candidate in candidates if candidate[1] <= -CLEAR_MARGIN]
        if pressing or pulling:
            return max(pressing or pulling, key=itemgetter(0))[2]
        if min(ratios) <= 0:
            self.fail_to_step(min(ratios))
        text = f"jams {self.when()}: no combination of sliding and sticking is consistent"
        raise JammingError(f"{' '.join(formation.names)} {text}")
