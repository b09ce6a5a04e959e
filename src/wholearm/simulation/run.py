"""State, torques, records and integration steps of a simulation; sampled feedback laws."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from ..common.arrays import Array, Flags, find_root
from ..common.errors import SimulationError, require_number
from ..results.torque import TorqueProfile
from .events import Event, EventKind, Record
from .system import (
    FIRST_STEP,
    N_LOSSES,
    ORDER,
    SHORTEST_STEP,
    ZERO_SPEED,
    Modes,
    ModeStepper,
    System,
    build_stepper,
)

TIME_TOLERANCE = 1e-9  # difference of two instants that counts as zero, relative to the period


class StuckError(ArithmeticError):
    """The step size underflows."""


class Run(ABC):
    """A running simulation; subclasses define the rule that selects contact modes."""

    t: float  # t, h [s]: present time, and the next trial step
    h: float
    y: Array  # (2 n + LOSSES,): z, z', then work, viscous, dry and contact losses
    modes: Modes
    s: ModeStepper  # compiled steps of the present modes
    piece: int  # index of the present piece of the torques
    steps_at: list[bool]  # whether the torques step at the start of each piece
    impact: float  # [J]: energy lost to impacts so far
    times: deque[float]  # [s]: remaining instants at which steps have to end; infinity is last
    # values, start: event values after the last step and before it, in units of the scene; an
    # event is a zero crossing to negative values
    values: Array
    start: Array
    slack: Array  # largest negative event value that counts as rounding
    longest = math.inf  # [s]: longest step from the present state

    def __init__(
        self,
        system: System,
        torque: TorqueProfile | Feedback,
        z: Array,
        v: Array,
        tolerance: float = 1e-9,
        times: Sequence[float] | Array = (),
    ) -> None:
        self.feedback = torque if isinstance(torque, Feedback) else None
        torque = torque.torque if isinstance(torque, Feedback) else torque
        self.system, self.torque, self.tolerance = system, torque, tolerance
        self.breaks: list[float] = torque.breaks.tolist()
        self.t, self.piece = self.breaks[0], 0
        self.steps_at = [True, *self.find_torque_steps(torque.jumps).tolist()]
        self.y = np.concatenate([z, v, np.zeros(N_LOSSES)])
        self.h = FIRST_STEP * system.scales.time
        self.impact = 0.0
        self.phase_index = self.steps = self.rejected = 0
        self.records: list[Record] = []
        self.events: list[Event] = []
        inner = (t for t in times if self.breaks[0] <= t <= self.breaks[-1])
        self.times = deque([*map(float, inner), math.inf])
        self.residual = 0.0
        self.sample()
        self.decisions, self.decision_time = 0, -math.inf

    @property
    def z(self) -> Array:
        """Coordinates, shape (n,)."""
        return self.y[: self.system.n]

    @property
    def v(self) -> Array:
        """Velocities, shape (n,)."""
        return self.y[self.system.n : 2 * self.system.n]

    @property
    def stop(self) -> float:
        """End of the present piece of the torques [s]."""
        return self.breaks[self.piece + 1]

    @property
    def near(self) -> float:
        """Tolerance of event times: final width of the bracket [s]."""
        return 1e-3 * SHORTEST_STEP * max(self.system.scales.time, abs(self.t))

    @abstractmethod
    def measure(self) -> Array:
        """Event values after the last step."""

    @property
    @abstractmethod
    def shift(self) -> Array:
        """Threshold of each event value below zero, by its value before the step."""

    def locate(self, t: float) -> list[int]:
        """Shorten the last step, to time `t` [s], to its first events; returns their rows."""
        return self.find_first()

    def find_closing(self, h: float, done: Sequence[int]) -> tuple[int, float] | None:
        """First pair that closes in the last step, of length `h`, and its time [s].

        Pairs in `done` are excluded.
        """
        return None

    def handle(self, rows: list[int]) -> Any:
        """Process events, by their rows; returns how they end the motion, None if it continues."""
        return True

    @abstractmethod
    def pass_break(self) -> Any:
        """Enter the next piece of the torques; returns how that ends the motion, or None."""

    @property
    def is_at_rest(self) -> bool:
        """Whether all velocities are zero."""
        return self.system.is_slower(self.v, ZERO_SPEED)

    def makes_progress(self) -> bool:
        """Count a choice of contact modes; False after 60 in a row without progress of time."""
        shortest = 100 * SHORTEST_STEP * self.system.scales.time
        self.decisions = self.decisions + 1 if self.t - self.decision_time <= shortest else 0
        self.decision_time = self.t
        return self.decisions <= 60

    def tau(self, t: float) -> Array:
        """Torques at `t`, held from where they step next, shape (2,) [N m]."""
        piece = self.piece
        # Ramps between contact modes may be shorter than the lookahead of mode choices. Polynomials
        # are not extrapolated beyond their pieces, which may be shorter still after a step.
        while t > self.breaks[piece + 1] and piece + 2 < len(self.breaks):
            if self.feedback is not None or self.steps_at[piece + 1]:
                break
            piece += 1
        t = min(t, self.breaks[piece + 1])
        coefficients, x = self.torque.coefficients[piece], self.fraction(t, piece)
        return np.asarray(coefficients @ x ** np.arange(coefficients.shape[1]))

    def fraction(self, t: float, piece: int | None = None) -> float:
        """Coordinate of time `t` on the present piece of the torques, in [-1, 1]."""
        first = self.piece if piece is None else piece
        start, stop = self.breaks[first : first + 2]
        return (2 * t - start - stop) / (stop - start)

    def time(self, x: float) -> float:
        """Time at `x` of the present piece [s]."""
        start, stop = self.breaks[self.piece : self.piece + 2]
        return (start + stop + x * (stop - start)) / 2

    def find_torque_steps(self, jumps: Array) -> Flags:
        """Whether torques step, (k,), by their jumps between pieces, (k, 2) [N m]."""
        return np.asarray(np.abs(jumps).max(axis=1) > 2e-8 * self.system.scales.torque)

    def set_velocity(self, v: Array | float) -> None:
        """Set the velocity, shape (n,); the change of kinetic energy counts as impact loss."""
        energy = self.system.compute_energy(self.z, self.v)
        self.y[self.system.n : 2 * self.system.n] = v
        self.impact += float(energy - self.system.compute_energy(self.z, self.v))

    def project_velocity(self, rows: Array) -> None:
        """Project the velocity onto rows v = 0, (m, n), in the metric M."""
        root = np.sqrt(self.system.mass)
        scaled = rows / root
        scaled /= np.sqrt((scaled**2).sum(axis=1))[:, None]
        speed = root * self.v
        residual = scaled @ speed
        if np.abs(residual).max(initial=0.0) > 1e-15 * np.abs(speed).max():
            self.set_velocity(self.v - np.linalg.lstsq(scaled, residual, rcond=1e-9)[0] / root)

    def load(self, modes: Modes) -> None:
        """Load the compiled steps of some modes, and the signs of these if given."""
        self.modes, degree = modes, self.torque.coefficients.shape[2] - 1
        self.s = build_stepper(self.system.structure, modes._replace(Xi=(), sigma=()), degree)
        self.s.load(self.system, self.tolerance, self.z)
        if modes.sigma:
            self.s.inputs.Xi[:], self.s.inputs.sigma[:] = modes.Xi, modes.sigma
        self.feed()

    def feed(self) -> None:
        """Write the present state and torques to the inputs of the steps."""
        inputs = self.s.inputs
        inputs.y[:], inputs.t[:] = self.y, self.t
        inputs.piece[:] = self.torque.breaks[self.piece : self.piece + 2]
        inputs.torque[:] = self.torque.coefficients[self.piece].ravel()

    def next_piece(self) -> bool:
        """Enter the next piece of the torques; False at the last one."""
        if self.piece + 2 >= len(self.breaks):
            return False
        self.piece += 1
        self.sample()
        self.feed()
        return True

    def sample(self) -> None:
        """Sample the feedback law, if there is one, at the start of a piece of the torques."""
        if self.feedback is None:
            return
        theta, theta_dot = (part[list(self.system.structure.driven)] for part in (self.z, self.v))
        forces = {}
        if self.records:
            last = self.records[-1]
            names = (self.system.names[pair] for pair in last.kept)
            forces = dict(zip(names, last.c_n.tolist(), strict=True))
        self.feedback.begin(self.piece, theta, theta_dot, forces)
        if self.piece:
            torques = self.torque.coefficients[self.piece - 1 : self.piece + 1, :, 0]
            self.steps_at[self.piece] = bool(self.find_torque_steps(np.diff(torques, axis=0))[0])

    def step_to(self, h: float) -> None:
        """Repeat the last step with length `h` [s]."""
        self.s.inputs.h[:] = h
        self.s.step()
        self.values = self.measure()

    def evaluate_state(self) -> None:
        """Evaluate the present state."""
        self.s.inputs.y[:], self.s.inputs.t[:] = self.y, self.t
        self.s.evaluate_state()
        self.values = self.measure()

    def keep(self, t: float) -> None:
        """Accept the last step, to time `t` [s], and record its end."""
        self.t, self.y[:] = t, self.s.outputs.y
        self.s.inputs.y[:], self.s.inputs.t[:] = self.y, t
        self.record()

    def find_first(self, candidates: slice = slice(None)) -> list[int]:
        """Shorten the last step to its first event; returns rows of `values`.

        Only `candidates` are searched. A pair that closes has the row len(values) + its index.
        """
        shift, h = self.shift, float(self.s.inputs.h[0])
        before, rows = np.maximum(self.start + shift, 0.0), np.arange(len(shift))[candidates]
        events, located = list[int](), list[int]()
        latest = -1
        while True:
            if h != self.s.inputs.h[0]:
                self.step_to(h)
            after = self.values + shift
            negative = [k for k in rows[after[rows] < 0].tolist() if k not in located]
            closing = self.find_closing(h, [k - len(shift) for k in located])
            if not negative and closing is None:
                reached = (after <= self.slack).nonzero()[0].tolist()
                return [k for k in events if k == latest or k in reached]
            events += [k for k in negative if k not in events]
            fraction = {k: before[k] / (before[k] - after[k]) for k in negative}
            row = min(negative, key=fraction.__getitem__, default=0)
            if closing is not None and (not negative or closing[1] <= h * fraction[row]):
                latest, h = len(shift) + closing[0], closing[1]
                located.append(latest)
                events.append(latest)
                continue

            def value(step: float, row: int = row) -> float:
                self.step_to(step)
                return float(self.values[row] + shift[row])

            ends = float(before[row]), float(after[row])
            h = find_root(value, 0.0, h, ends, self.near, 1e-3 * float(self.slack[row]))
            located.append(row)
            latest = row

    def move(self) -> Any:
        """Integrate until the contact rule ends the motion; returns how it ends."""
        while True:
            while self.times[0] <= self.t:
                self.times.popleft()
            t = self.try_step(min(self.stop, self.times[0]))
            if rows := self.locate(t):
                self.keep(self.t + float(self.s.inputs.h[0]))
                ending = self.handle(rows)
            else:
                self.keep(t)
                ending = self.pass_break() if t == self.stop else None
            if ending is not None:
                return ending

    def begin_step(self) -> None:
        """Start the next step: its initial event values are the present ones."""
        self.start = self.values

    def try_step(self, target: float) -> float:
        """Make a step within the tolerance, at most to `target` [s]; returns its end [s]."""
        remaining, time = target - self.t, self.system.scales.time
        self.begin_step()
        shortest = SHORTEST_STEP * max(time, abs(self.t))
        while True:
            h = min(self.h, self.longest)
            is_last = h >= 0.999 * remaining
            h = remaining if is_last else min(h, remaining / 2)
            self.s.inputs.h[:] = h
            self.s.step()
            error = float(self.s.outputs.error[0])
            if error <= 1:
                self.values = self.measure()
                # Growth by 40 at order 8 corresponds to an error of 1e-13 of the tolerance.
                longer = h * min(40.0, 0.9 * max(error, 1e-300) ** (-1 / ORDER))
                self.h = longer if h >= self.h else max(self.h, longer)
                self.steps += 1
                return target if is_last else self.t + h
            self.rejected += 1
            if h < shortest:
                raise StuckError
            self.h = h * max(0.2, 0.9 * error ** (-1 / ORDER)) if error < math.inf else 0.2 * h

    def wait(self, stop: float) -> None:
        """Advance time to `stop` [s] at rest."""
        while self.times[0] <= stop:
            self.t = max(self.t, self.times.popleft())
            self.record(still=True)
        self.t = stop
        self.record(still=True)

    def when(self) -> str:
        """Text of the present time."""
        return f"at t = {self.t:.6g} s"

    def note(
        self, kind: EventKind, text: str, contact: str = "", value: float = math.nan, tail: str = ""
    ) -> str:
        """Append an event; returns its text with the present time and a `tail`."""
        text = f"{text} {self.when()}{tail}"
        self.events.append(Event(self.t, self.phase_index, kind, text, contact, value))
        return text

    def record(self, still: bool = False) -> None:
        """Record the present instant from the outputs of the steps.

        At rest accelerations are zero, and forces are NaN (indeterminate).
        """
        if not still:
            self.records.append(self.read_outputs(self.t))
            return
        nan_forces, tau = np.full(len(self.modes.kept), math.nan), self.tau(self.t)
        values = self.y.copy(), np.zeros(self.system.n), tau, nan_forces, nan_forces
        self.records.append(Record(self.t, self.phase_index, self.modes.kept, self.impact, *values))

    def read_outputs(self, t: float) -> Record:
        """The outputs of the steps as a record at time `t` [s]."""
        values: Any = (part.copy() for part in self.s.outputs[:5])
        return Record(t, self.phase_index, self.modes.kept, self.impact, *values)


@runtime_checkable
class Law(Protocol):
    """Torques as a function of the measurements of a controller."""

    @property
    def period(self) -> float:
        """Time between two samples [s]."""

    @property
    def delay(self) -> float:
        """Delay between a sample and its effect; zero for the first one [s]."""

    def held(
        self, t: float, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> ArrayLike:
        """Torques, shape (2,) [N m], held from time `t` [s] on, from angles and rates, (2,) each.

        `forces` [N] are the c_n of contacts that press, by name; NaN at rest, empty at the start.
        """


class Feedback:
    """Sampled torques of a law up to time `until` [s]; future pieces of `torque` are zero."""

    def __init__(self, law: Law, until: float) -> None:
        self.law = law
        period = require_number(law.period, "period", positive=True)
        delay = require_number(law.delay, "delay", nonnegative=True)
        ticks = period * np.arange(int(np.ceil(until / period - TIME_TOLERANCE)))
        times = np.sort(np.concatenate([ticks, ticks[1:] + delay]))
        times = times[times < until - TIME_TOLERANCE * period]
        times = times[np.diff(times, prepend=-np.inf) > TIME_TOLERANCE * period]
        self._samples = np.zeros((len(ticks), 2))
        # Rounding must not place an instant before its own sample.
        self._latest = np.floor(times / period + TIME_TOLERANCE).astype(int)
        self._source = np.floor((times - delay) / period + TIME_TOLERANCE).astype(int).clip(0)
        self.torque = TorqueProfile(np.append(times, until), np.zeros((len(times), 2, 1)))

    def begin(
        self, piece: int, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> None:
        """Sample if due at the start of a piece, and set the torques of the piece."""
        latest = self._latest[piece]
        if piece == 0 or latest > self._latest[piece - 1]:
            t = float(self.torque.breaks[piece])
            tau = np.asarray(self.law.held(t, theta, theta_dot, forces), dtype=float)
            if tau.shape != (2,) or not np.isfinite(tau).all():
                text = f"{tau.tolist()} at t = {t:.6g} s; two finite numbers are needed"
                raise SimulationError(f"the law of the torques gives {text}")
            self._samples[latest] = tau
        self.torque.coefficients[piece, :, 0] = self._samples[self._source[piece]]
