"""State, torques and records of a running simulation, and its steps; torques of a feedback law."""

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
    LOSSES,
    ORDER,
    SHORTEST_STEP,
    STANDING,
    Modes,
    ModeStepper,
    System,
    build_stepper,
)

SAME = 1e-9  # distance of two instants that counts as none, relative to the period


class StuckError(ArithmeticError):
    """Steps become too short to get anywhere."""


class Run(ABC):
    """A running simulation; the rule that decides on contacts is that of the class."""

    t: float  # t, h [s]: present time, and the step to try next
    h: float
    y: Array  # (2 n + LOSSES,): z, z', then work, viscous, dry and contact losses
    modes: Modes
    s: ModeStepper  # steps of the present modes
    piece: int  # of the torques, which the present time belongs to
    steps_at: list[bool]  # whether the torques step at the start of each piece
    impact: float  # [J]: energy lost to impacts so far
    wanted: deque[float]  # [s]: later instants at which steps have to end; infinity is last
    # values, start: event values after the step just made and before it, in units of the scene: an
    # event is where one falls below zero
    values: Array
    start: Array
    slack: Array  # how far below zero each of them counts as rounding
    longest = math.inf  # [s]: longest step from the present state

    def __init__(
        self,
        system: System,
        torque: TorqueProfile | Feedback,
        z: Array,
        v: Array,
        tolerance: float = 1e-9,
        wanted: Sequence[float] | Array = (),
    ) -> None:
        self.feedback = torque if isinstance(torque, Feedback) else None
        torque = torque.torque if isinstance(torque, Feedback) else torque
        self.system, self.torque, self.tolerance = system, torque, tolerance
        self.breaks: list[float] = torque.breaks.tolist()
        self.t, self.piece = self.breaks[0], 0
        self.steps_at = [True, *self.find_torque_steps(torque.jumps).tolist()]
        self.y = np.concatenate([z, v, np.zeros(LOSSES)])
        self.h = FIRST_STEP * system.scales.time
        self.impact = 0.0
        self.phase_index = self.steps = self.rejected = 0
        self.records: list[Record] = []
        self.events: list[Event] = []
        within = (t for t in wanted if self.breaks[0] <= t <= self.breaks[-1])
        self.wanted = deque([*map(float, within), math.inf])
        self.residual = 0.0
        self.sample()
        self.decisions, self.decided_at = 0, -math.inf

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
        """When the present piece of the torques ends [s]."""
        return self.breaks[self.piece + 1]

    @property
    def near(self) -> float:
        """Width of the bracket of an event that is narrow enough [s]."""
        return 1e-3 * SHORTEST_STEP * max(self.system.scales.time, abs(self.t))

    @abstractmethod
    def measure(self) -> Array:
        """Event values after the step just made."""

    @property
    @abstractmethod
    def shift(self) -> Array:
        """How far below zero each event value has to fall, by its value before the step."""

    def locate(self, t: float) -> list[int]:
        """Shorten the step just made, to time `t` [s], to its first events; their rows."""
        return self.find_first()

    def find_closing(self, h: float, done: Sequence[int]) -> tuple[int, float] | None:
        """The first pair that closes within the step just made, of length `h`, and when [s].

        Those `done` do not count.
        """
        return None

    def handle(self, found: list[int]) -> Any:
        """How events, by their rows, end the motion; None if it goes on."""
        return True

    @abstractmethod
    def pass_break(self) -> Any:
        """Go on to the next piece of the torques; how that ends the motion, if it does."""

    @property
    def stands(self) -> bool:
        """Whether nothing moves."""
        return self.system.is_slower(self.v, STANDING)

    def gets_on(self) -> bool:
        """Count a decision on contact modes; whether some time passes within 60 in a row."""
        least = 100 * SHORTEST_STEP * self.system.scales.time
        self.decisions = self.decisions + 1 if self.t - self.decided_at <= least else 0
        self.decided_at = self.t
        return self.decisions <= 60

    def tau(self, t: float) -> Array:
        """Torques at `t`, held from where they step next, shape (2,) [N m]."""
        piece = self.piece
        # Ramps between contact modes may be shorter than the time by which modes are judged ahead.
        # Polynomials do not go on beyond their pieces, which may be shorter still after a step.
        while t > self.breaks[piece + 1] and piece + 2 < len(self.breaks):
            if self.feedback is not None or self.steps_at[piece + 1]:
                break
            piece += 1
        t = min(t, self.breaks[piece + 1])
        coefficients, x = self.torque.coefficients[piece], self.fraction(t, piece)
        return np.asarray(coefficients @ x ** np.arange(coefficients.shape[1]))

    def fraction(self, t: float, piece: int | None = None) -> float:
        """Coordinate of time `t` on the present piece of the torques, from -1 to 1 within it."""
        first = self.piece if piece is None else piece
        start, stop = self.breaks[first : first + 2]
        return (2 * t - start - stop) / (stop - start)

    def time(self, x: float) -> float:
        """Time at `x` of the present piece [s]."""
        start, stop = self.breaks[self.piece : self.piece + 2]
        return (start + stop + x * (stop - start)) / 2

    def find_torque_steps(self, jumps: Array) -> Flags:
        """Whether torques step, by their differences between pieces, shape (k, 2) [N m]."""
        return np.asarray(np.abs(jumps).max(axis=1) > 2e-8 * self.system.scales.torque)

    def set_velocity(self, v: Array | float) -> None:
        """Change the velocity, shape (n,); its kinetic energy is lost to impacts."""
        before = self.system.stored(self.z, self.v)
        self.y[self.system.n : 2 * self.system.n] = v
        self.impact += float(before - self.system.stored(self.z, self.v))

    def project_velocity(self, rows: Array) -> None:
        """Project the velocity onto rows v = 0, (m, n), in the metric of masses."""
        root = np.sqrt(self.system.mass)
        scaled = rows / root
        scaled /= np.sqrt((scaled**2).sum(axis=1))[:, None]
        speed = root * self.v
        along = scaled @ speed
        if np.abs(along).max(initial=0.0) > 1e-15 * np.abs(speed).max():
            self.set_velocity(self.v - np.linalg.lstsq(scaled, along, rcond=1e-9)[0] / root)

    def load(self, modes: Modes) -> None:
        """Take the steps of some modes from here on, with their signs where they have any."""
        self.modes, degree = modes, self.torque.coefficients.shape[2] - 1
        self.s = build_stepper(self.system.structure, modes._replace(Xi=(), sigma=()), degree)
        self.s.load(self.system, self.tolerance, self.z)
        if modes.sigma:
            self.s.inputs.Xi[:], self.s.inputs.sigma[:] = modes.Xi, modes.sigma
        self.feed()

    def feed(self) -> None:
        """Hand the present state and torques to the steps."""
        inputs = self.s.inputs
        inputs.y[:], inputs.t[:] = self.y, self.t
        inputs.piece[:] = self.torque.breaks[self.piece : self.piece + 2]
        inputs.torque[:] = self.torque.coefficients[self.piece].ravel()

    def next_piece(self) -> bool:
        """Go on to the next piece of the torques, if there is one."""
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
            held = self.torque.coefficients[self.piece - 1 : self.piece + 1, :, 0]
            self.steps_at[self.piece] = bool(self.find_torque_steps(np.diff(held, axis=0))[0])

    def step_to(self, h: float) -> None:
        """Repeat the step with another length."""
        self.s.inputs.h[:] = h
        self.s.step()
        self.values = self.measure()

    def look(self) -> None:
        """Evaluate the present state."""
        self.s.inputs.y[:], self.s.inputs.t[:] = self.y, self.t
        self.s.look()
        self.values = self.measure()

    def keep(self, t: float) -> None:
        """Take the step just made, to time `t` [s], and record its end."""
        self.t, self.y[:] = t, self.s.outputs.y
        self.s.inputs.y[:], self.s.inputs.t[:] = self.y, t
        self.record()

    def find_first(self, among: slice = slice(None)) -> list[int]:
        """Shorten the step just made to its first event; rows of `values`.

        `among` are the rows to look at. That of a pair that closes is its number after these.
        """
        shift, h = self.shift, float(self.s.inputs.h[0])
        before, places = np.maximum(self.start + shift, 0.0), np.arange(len(shift))[among]
        seen, done = list[int](), list[int]()
        last = -1
        while True:
            if h != self.s.inputs.h[0]:
                self.step_to(h)
            after = self.values + shift
            low = [k for k in places[after[places] < 0].tolist() if k not in done]
            closing = self.find_closing(h, [k - len(shift) for k in done])
            if not low and closing is None:
                shown = (after <= self.slack).nonzero()[0].tolist()
                return [k for k in seen if k == last or k in shown]
            seen += [k for k in low if k not in seen]
            share = {k: before[k] / (before[k] - after[k]) for k in low}
            row = min(low, key=share.__getitem__, default=0)
            if closing is not None and (not low or closing[1] <= h * share[row]):
                last, h = len(shift) + closing[0], closing[1]
                done.append(last)
                seen.append(last)
                continue

            def value(step: float, row: int = row) -> float:
                self.step_to(step)
                return float(self.values[row] + shift[row])

            ends = float(before[row]), float(after[row])
            h = find_root(value, 0.0, h, ends, self.near, 1e-3 * float(self.slack[row]))
            done.append(row)
            last = row

    def move(self) -> Any:
        """Integrate with the present modes until the contact rule ends the motion; how it does."""
        while True:
            while self.wanted[0] <= self.t:
                self.wanted.popleft()
            t = self.try_step(min(self.stop, self.wanted[0]))
            if rows := self.locate(t):
                self.keep(self.t + float(self.s.inputs.h[0]))
                ending = self.handle(rows)
            else:
                self.keep(t)
                ending = self.pass_break() if t == self.stop else None
            if ending is not None:
                return ending

    def begin_step(self) -> None:
        """Start the next step from the state whose event values are known."""
        self.start = self.values

    def try_step(self, target: float) -> float:
        """Make a step within the tolerance, to `target` [s] at most; when it ends [s]."""
        remaining, time = target - self.t, self.system.scales.time
        self.begin_step()
        least = SHORTEST_STEP * max(time, abs(self.t))
        while True:
            h = min(self.h, self.longest)
            whole = h >= 0.999 * remaining
            h = remaining if whole else min(h, remaining / 2)
            self.s.inputs.h[:] = h
            self.s.step()
            error = float(self.s.outputs.error[0])
            if error <= 1:
                self.values = self.measure()
                # A growth of 40 at order 8 is that of an error of 1e-13 of the tolerance.
                grown = h * min(40.0, 0.9 * max(error, 1e-300) ** (-1 / ORDER))
                self.h = grown if h >= self.h else max(self.h, grown)
                self.steps += 1
                return target if whole else self.t + h
            self.rejected += 1
            if h < least:
                raise StuckError
            self.h = h * max(0.2, 0.9 * error ** (-1 / ORDER)) if error < math.inf else 0.2 * h

    def wait(self, stop: float) -> None:
        """Let time pass at rest."""
        while self.wanted[0] <= stop:
            self.t = max(self.t, self.wanted.popleft())
            self.record(still=True)
        self.t = stop
        self.record(still=True)

    def when(self) -> str:
        """Present time, in a sentence."""
        return f"at t = {self.t:.6g} s"

    def note(
        self, kind: EventKind, text: str, contact: str = "", value: float = math.nan, more: str = ""
    ) -> str:
        """Append an event at present; its text, which says when, and then `more`."""
        text = f"{text} {self.when()}{more}"
        self.events.append(Event(self.t, self.phase_index, kind, text, contact, value))
        return text

    def record(self, still: bool = False) -> None:
        """Record the present instant from the outputs of the steps.

        At rest accelerations are zero, and forces are NaN, as they are indeterminate.
        """
        if not still:
            self.records.append(self.read_outputs(self.t))
            return
        none, tau = np.full(len(self.modes.kept), math.nan), self.tau(self.t)
        seen = self.y.copy(), np.zeros(self.system.n), tau, none, none
        self.records.append(Record(self.t, self.phase_index, self.modes.kept, self.impact, *seen))

    def read_outputs(self, t: float) -> Record:
        """The outputs of the steps as a record at time `t` [s]."""
        seen: Any = (part.copy() for part in self.s.outputs[:5])
        return Record(t, self.phase_index, self.modes.kept, self.impact, *seen)


@runtime_checkable
class Law(Protocol):
    """Torques as a function of what a controller measures."""

    @property
    def period(self) -> float:
        """Time between two samples [s]."""

    @property
    def delay(self) -> float:
        """Time after which a sample takes effect; the first one does at once [s]."""

    def held(
        self, t: float, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> ArrayLike:
        """Torques, shape (2,) [N m], held from time `t` [s] on, from angles and rates, (2,) each.

        `forces` [N] are the c_n of contacts that press, by name; NaN at rest, empty at the start.
        """


class Feedback:
    """Sampled torques of a law up to time `until` [s]: `torque` is zero from the present on."""

    def __init__(self, law: Law, until: float) -> None:
        self.law = law
        period = require_number(law.period, "period", positive=True)
        delay = require_number(law.delay, "delay", nonnegative=True)
        ticks = period * np.arange(int(np.ceil(until / period - SAME)))
        times = np.sort(np.concatenate([ticks, ticks[1:] + delay]))
        times = times[times < until - SAME * period]
        times = times[np.diff(times, prepend=-np.inf) > SAME * period]
        self._samples = np.zeros((len(ticks), 2))
        # Rounding must not put an instant before its own sample.
        self._latest = np.floor(times / period + SAME).astype(int)
        self._source = np.floor((times - delay) / period + SAME).astype(int).clip(0)
        self.torque = TorqueProfile(np.append(times, until), np.zeros((len(times), 2, 1)))

    def begin(
        self, piece: int, theta: Array, theta_dot: Array, forces: Mapping[str, float]
    ) -> None:
        """Sample where one is due at the start of a piece, and set the torques of the piece."""
        latest = self._latest[piece]
        if piece == 0 or latest > self._latest[piece - 1]:
            t = float(self.torque.breaks[piece])
            tau = np.asarray(self.law.held(t, theta, theta_dot, forces), dtype=float)
            if tau.shape != (2,) or not np.isfinite(tau).all():
                text = f"{tau.tolist()} at t = {t:.6g} s; two finite numbers are needed"
                raise SimulationError(f"the law of the torques gives {text}")
            self._samples[latest] = tau
        self.torque.coefficients[piece, :, 0] = self._samples[self._source[piece]]
