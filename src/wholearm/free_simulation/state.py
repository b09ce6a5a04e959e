"""State, torques and records of a running free simulation; torques of a feedback law."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.arrays import Array
from ..common.errors import SimulationError, require_number
from ..results.torque import TorqueProfile
from ..simulation.events import Event, EventKind
from ..simulation.layout import evaluate_piece, find_torque_steps
from ..simulation.tolerances import STEP_OF_TORQUE
from .free_stepper import LOSSES, FreeStepper, Modes, build_stepper
from .system import System

SAME = 1e-9  # distance of two instants that counts as none, relative to the period
CLOSED = 1e-10  # gap that counts as closed at an event, relative to the scene's length
SUNK = 1e-6  # overlap up to which features touch, over the scene's length; else they are behind
ARMED = 1e-13  # gap from which on a pair has been apart, relative to the scene's length
CHATTER = 1e-6  # speed of the last impact, over the scene's: separation stays below rounding
COARSE = 1e3  # the same over the tolerance, where that is coarser than impacts need
BURST = 3e-4
"""Time, relative to the scene's, in which `MANY` impacts raise `CHATTER` tenfold, and twice as many
a hundredfold: fingers may knock an object to and fro for ever."""
MANY = 20
AHEAD = 2e-5  # delay at which modes are evaluated, over the scene's time: a force's trend counts
NO_PROGRESS = 60  # most decisions in a row without any time passing


class Record(NamedTuple):
    """One instant; `impact` is the energy lost to impacts so far [J], `kept` the closed pairs."""

    t: float
    y: Array
    acceleration: Array
    tau: Array
    kept: tuple[int, ...]
    c_n: Array
    c_t: Array
    impact: float


class FreeRun:
    """A running free simulation.

    Attributes
    ----------
    y : (2 n + LOSSES,)  state and energies at time t [s]
    armed : (N,)         pairs that have been apart, so that their closing is an event
    unique               whether the present modes were certainly the only solution
    impact : [J]         energy lost to impacts so far
    watches              event values of each of the modes so far
    rub : (k,)           c_t over c_n of the present kept pairs, zero where they stick
    """

    def __init__(
        self,
        system: System,
        torque: TorqueProfile | Feedback,
        z: Array,
        v: Array,
        restitution: float = 0.0,
        tolerance: float = 1e-9,
        hint: Modes | None = None,
    ) -> None:
        self.feedback = torque if isinstance(torque, Feedback) else None
        self.system, self.torque = system, torque.torque if isinstance(torque, Feedback) else torque
        self.restitution, self.tolerance = restitution, tolerance
        self.t, self.piece = float(self.torque.breaks[0]), 0
        self.y = np.concatenate([z, v, np.zeros(LOSSES)])
        self.modes = hint or Modes(sigma=(0.0,) * system.n)
        self.armed = np.zeros(len(system.names), dtype=bool)
        self.h = 0.02 * system.scales.time
        self.impact = 0.0
        self.decisions, self.decided_at = 0, -math.inf
        self.steps = self.rejected = 0
        self.resting = self.unique = False
        self.residual = 0.0
        self.records: list[Record] = []
        self.events: list[Event] = []
        self.watches: dict[Modes, Any] = {}
        self.rub = np.zeros(0)
        parts, self.torque_step = self.torque.coefficients, STEP_OF_TORQUE * system.scales.torque
        self._steps = find_torque_steps(parts[:-1], parts[1:], self.torque_step).tolist()
        self._begin_piece()

    @property
    def z(self) -> Array:
        """Coordinates, shape (n,)."""
        return self.y[: self.system.n]

    @property
    def v(self) -> Array:
        """Velocities, shape (n,)."""
        return self.y[self.system.n : 2 * self.system.n]

    @property
    def chatter(self) -> float:
        """Speed of impacts that count as the last one [m/s]."""
        since, recent = self.t - BURST * self.system.scales.time, 0
        for event in reversed(self.events):
            if event.time < since:
                break
            recent += event.kind is EventKind.IMPACT
        least = max(CHATTER, COARSE * self.tolerance)
        return least * self.system.scales.speed * 10.0 ** min(recent // MANY, 2)

    @property
    def end(self) -> float:
        """When the torques end [s]."""
        return float(self.torque.breaks[-1])

    @property
    def stop(self) -> float:
        """When the present piece of the torques ends [s]."""
        return float(self.torque.breaks[self.piece + 1])

    def next_piece(self) -> bool:
        """Go on to the next piece of the torques, if there is one."""
        if self.piece + 2 >= len(self.torque.breaks):
            return False
        self.piece += 1
        self._begin_piece()
        return True

    def _begin_piece(self) -> None:
        """Sample the feedback law, if there is one."""
        if self.feedback is None:
            return
        theta, theta_dot = (part[list(self.system.driven)] for part in (self.z, self.v))
        forces = {}
        if self.records:
            last = self.records[-1]
            names = (self.system.names[pair] for pair in last.kept)
            forces = dict(zip(names, last.c_n.tolist(), strict=True))
        self.feedback.begin(self.piece, theta, theta_dot, forces)

    def tau(self, t: float) -> Array:
        """Torques of the present piece at `t`, also beyond its end, shape (2,) [N m]."""
        return evaluate_piece(self.torque, self.piece, t)

    def torque_steps(self) -> bool:
        """Whether the torques step at the start of the present piece."""
        if self.feedback is not None:
            before, after = self.torque.coefficients[self.piece - 1 : self.piece + 1]
            return bool(find_torque_steps(before[None], after[None], self.torque_step)[0])
        return bool(self._steps[self.piece - 1])

    def face(self, z: Array, v: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Gaps of all pairs at a state, and which of them face each other, shape (N,) each."""
        scales = self.system.scales
        gaps, ranges = self.system.look(z)
        near = CLOSED * scales.length
        faces = ranges > near
        at_end = (ranges > -near) & ~faces
        if np.count_nonzero(at_end):
            faces |= at_end & (self.system.look(z + AHEAD * scales.time * v)[1] >= ranges)
        return gaps, faces

    def take_impulse(self, v: Array) -> None:
        """Change the velocity; its kinetic energy is lost to impacts."""
        before = self.system.stored(self.z, self.v)
        self.y[self.system.n : 2 * self.system.n] = v
        self.impact += float(before - self.system.stored(self.z, self.v))

    def load(self) -> FreeStepper:
        """The steps of the present modes, with their inputs set to the present state."""
        system, modes = self.system, self.modes
        degree = self.torque.coefficients.shape[2] - 1
        s = build_stepper(system.structure, modes._replace(Xi=(), sigma=()), degree)
        inputs, at = s.inputs, s.at
        inputs[at.tolerance] = self.tolerance
        inputs[at.Xi], inputs[at.sigma] = modes.Xi, modes.sigma
        inputs[at.geometry], inputs[at.lift] = system.geometry, 1 / system.mass
        inputs[at.applied], inputs[at.viscous] = system.applied, system.viscous
        inputs[at.dry], inputs[at.mu] = system.dry, system.friction[list(modes.kept)]
        inputs[at.units], inputs[at.force] = system.units, system.scales.force
        inputs[at.friction_units] = system.friction_units
        self.rub = inputs[at.mu] * -inputs[at.Xi]
        self.feed(s)
        return s

    def feed(self, s: FreeStepper) -> None:
        """Hand the present state and torques to the steps."""
        inputs, at = s.inputs, s.at
        inputs[at.y], inputs[at.t] = self.y, self.t
        inputs[at.piece] = self.torque.breaks[self.piece : self.piece + 2]
        inputs[at.torque] = self.torque.coefficients[self.piece].ravel()

    def stay(self, s: FreeStepper) -> None:
        """Keep from here on what sticks and is held."""
        if self.modes.stuck or self.modes.held:
            stuck = self.system.evaluate_slip(self.z, self.modes.stuck)
            s.inputs[s.at.stay] = np.concatenate([stuck, self.z[list(self.modes.held)]])

    def note(self, kind: EventKind, text: str, contact: str = "", value: float = math.nan) -> None:
        """Record an event."""
        text = f"{text} at t = {self.t:.6g} s"
        self.events.append(Event(self.t, 0, kind, text, contact, value))

    def record(self, s: FreeStepper | None, out: Array | None = None) -> None:
        """Record the present instant from a stepper's outputs, or at rest."""
        kept, y, acceleration = self.modes.kept, self.y.copy(), np.zeros(self.system.n)
        if s is None or out is None:
            c_n = c_t = np.full(len(kept), np.nan)
            tau = self.tau(self.t)
        else:
            y, acceleration, tau, c_n = (
                out[k] for k in (s.to.y, s.to.acceleration, s.to.tau, s.to.c_n)
            )
            c_t = c_n * self.rub
            for place, pair in enumerate(self.modes.stuck):
                c_t[kept.index(pair)] = out[s.to.f.start + place]
        self.records.append(Record(self.t, y, acceleration, tau, kept, c_n, c_t, self.impact))


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
