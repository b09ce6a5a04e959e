"""One trial: torques of one phase, simulated without telling which contacts hold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..free_simulation.hand import build_system
from ..free_simulation.result import FreeSimulation, list_pauses
from ..free_simulation.simulate import simulate_free
from ..free_simulation.state import Run
from ..problem.definition import Phase, Problem
from ..results.torque_table import read_rows
from ..simulation.events import Event, EventKind

LASTS = 40.0
"""How long a trial goes on after its last step of the torques, relative to the scene's time."""
_BACK = 1e-6
"""Share of the way by which the end is farther away than before once the motion has turned back."""


class Outcome(Enum):
    """What a trial comes to."""

    RESTS = "rests"
    """The object does not begin to slide, stops short of the end of the phase, or turns back."""
    ARRIVES = "arrives"
    """The end of the phase is reached."""
    LOSES = "loses"
    """A contact parts, or presses with less than epsilon."""
    LASTS = "lasts"
    """The object is still on its way when the trial is over."""


class Step(NamedTuple):
    """Torques that hold from an instant on.

    Attributes
    ----------
    time : float, [s]
        Since the start of the phase, or of all.
    tau : tuple of float, [N m]
    """

    time: float
    tau: tuple[float, float]


class Trial(NamedTuple):
    """What torques of a phase do.

    Attributes
    ----------
    steps : tuple of Step
        The torques.
    outcome : Outcome
    time : float, [s]
        When it came to that, since the start of the phase.
    contact : str
        The one that is lost, empty if none is.
    rate : float, [m/s or rad/s]
        How fast the end of the phase closes at that time.
    slowing : float, [m/s^2 or rad/s^2]
        By how much that becomes less then.
    short : float, [m or rad]
        How far away the end was when it was nearest.
    least : float, [N]
        The least normal force until then, of `weakest`; infinite if nothing moved.
    weakest : str
    z : ndarray, shape (5,)
        Where it was then.
    """

    steps: tuple[Step, ...]
    outcome: Outcome
    time: float
    contact: str
    rate: float
    slowing: float
    short: float
    least: float
    weakest: str
    z: Array

    def to_text(self) -> str:
        """The outcome in words."""
        text = self.outcome.value
        if self.outcome is Outcome.LOSES:
            return f"{text} {self.contact} at t = {self.time:.5g} s"
        if self.outcome is Outcome.ARRIVES:
            return f"{text} at t = {self.time:.5g} s, closing at {self.rate:.3g}"
        return f"{text}, {abs(self.short):.3g} away from it"


class Landing(NamedTuple):
    """What becomes of a phase whose end is reached.

    Attributes
    ----------
    z : ndarray, shape (5,)
        Where it is held.
    rests : bool
        Whether everything rests there in the end.
    parted : float, [s]
        For how long a contact of the phase, or of the next, parts meanwhile.
    contact : str
        That contact.
    """

    z: Array
    rests: bool
    parted: float
    contact: str


def make_rows(steps: Sequence[Step], end: float) -> Array:
    """A table of t and both torques, shape (n, 3), that steps from one constant to the next."""
    t = np.repeat([*(step.time for step in steps), end], 2)[1:-1]
    return np.column_stack([t, np.repeat([step.tau for step in steps], 2, axis=0)])


class Bench:
    """Makes trials of one phase from one start, and counts them.

    Parameters
    ----------
    problem : Problem
    phase : Phase
    z : ndarray, shape (5,)
        Where the phase starts, at rest.

    Attributes
    ----------
    trials : list of Trial
    simulations : int
        Trials, and landings.
    way : float, [m or rad]
        How far away the end of the phase is.
    """

    def __init__(self, problem: Problem, phase: Phase, z: Array) -> None:
        self.problem, self.phase, self.z = problem, phase, z
        self.system = build_system(problem.scene)
        self.names = phase.formation.names
        until = phase.until
        self.until = "" if until.contact is None else until.contact.name
        self.pair = self.system.names.index(self.until) if self.until else None
        self.column = 0 if until.coordinate == "x" else 2
        self.value = math.nan if until.value is None else until.value
        self.sign = float(np.sign(z[self.column] - self.value))
        self.way = float(self.measure(z[None])[0])
        self.trials: list[Trial] = []
        self.simulations = 0

    @property
    def is_angle(self) -> bool:
        """Whether the end of the phase is one of phi."""
        return self.pair is None and self.column == 2

    def measure(self, z: Array) -> Array:
        """How far away the end of the phase is, from (n, 5) to (n,) [m or rad]."""
        if self.pair is None:
            return self.sign * (z[:, self.column] - self.value)
        return np.asarray(self.system.measure(z)[0][:, self.pair])

    def run(self, steps: Sequence[Step]) -> Trial:
        """Simulate torques until the end of the phase, or what keeps it from coming."""
        end = steps[-1].time + LASTS * self.problem.scene.scales.time
        found = simulate_free(
            self.problem, read_rows(make_rows(steps, end)), start=self.z, halt=self._is_over
        )
        self.simulations += 1
        self.trials.append(self._judge(tuple(steps), found))
        return self.trials[-1]

    def land(
        self, steps: Sequence[Step], arrival: float, pause: float, after: Phase | None
    ) -> Landing:
        """Simulate torques that hold the object at the end of the phase.

        Parameters
        ----------
        steps : sequence of Step
        arrival : float, [s]
            When the end is reached.
        pause : float, [s]
            How long it is held.
        after : Phase or None
            The next one.
        """
        self.simulations += 1
        end = arrival + pause
        found = simulate_free(self.problem, read_rows(make_rows(steps, end)), start=self.z)
        names = set(self.names) if after is None else set(after.formation.names)
        pauses = {name: list_pauses(found.stretches, name, arrival, end) for name in names}
        parted = {name: max((b - a for a, b in own), default=0.0) for name, own in pauses.items()}
        worst = max(parted, key=parted.__getitem__)
        rests = not found.z_dot[-1].any() and found.t[-1] == end
        return Landing(found.z[-1], rests, parted[worst], worst)

    def _is_over(self, run: Run) -> bool:
        if run.t == 0:
            return False
        if run.resting or any(self._is_lost(e) or self._is_end(e) for e in run.events):
            return True
        gap = float(self.measure(run.z[None])[0])
        return gap > (1 + _BACK) * self.way or (self.pair is None and gap <= 0)

    def _is_lost(self, event: Event) -> bool:
        return event.kind is EventKind.CONTACT_LOST and event.contact in self.names

    def _is_end(self, event: Event) -> bool:
        return bool(self.until) and event.contact == self.until

    def _judge(self, steps: tuple[Step, ...], found: FreeSimulation) -> Trial:
        gaps = self.measure(found.z)
        arrival = min((e.time for e in found.events if self._is_end(e)), default=math.inf)
        if self.pair is None and gaps.min() <= 0:
            arrival = self._find_passing(found, int(np.flatnonzero(gaps <= 0)[0]))
        losses = [e for e in found.events if self._is_lost(e) and e.time < arrival]
        time = min(arrival, losses[0].time if losses else math.inf, float(found.t[-1]))
        at = int(np.searchsorted(found.t, time))
        own = [found.contacts.index(name) for name in self.names]
        c_n = np.nan_to_num(found.c_n[: at + 1, own], nan=math.inf)
        row, column = np.unravel_index(int(c_n.argmin()), c_n.shape)
        least, weakest, contact = float(c_n[row, column]), self.names[int(column)], ""
        short = float(gaps[: at + 1].min())
        if losses and losses[0].time == time:
            outcome, contact = Outcome.LOSES, losses[0].contact
        elif least < self.problem.epsilon:
            outcome, contact, time = Outcome.LOSES, weakest, float(found.t[row])
        elif arrival < math.inf:
            outcome = Outcome.ARRIVES
        else:
            turned = gaps[at] > short + _BACK * self.way
            rests = turned or not found.z_dot[at].any()
            outcome = Outcome.RESTS if rests else Outcome.LASTS
        rate, slowing, z = self._close(found, time, at)
        return Trial(steps, outcome, time, contact, rate, slowing, short, least, weakest, z)

    def _find_passing(self, found: FreeSimulation, row: int) -> float:
        """When a coordinate passes its value, before a row [s]."""
        from scipy.optimize import brentq

        motion = found.trajectory
        a, b = float(found.t[row - 1]), float(found.t[row])
        return float(brentq(lambda t: self.measure(motion.at([t]).z)[0], a, b, xtol=1e-14))

    def _close(self, found: FreeSimulation, time: float, at: int) -> tuple[float, float, Array]:
        """How fast the end closes, by how much that becomes less, and where."""
        if self.pair is None and time > 0:
            row = found.trajectory.at([time])
            v, a = row.z_dot[0, self.column], row.z_ddot[0, self.column]
            return -self.sign * float(v), self.sign * float(a), row.z[0]
        z, v, a = found.z[at], found.z_dot[at], found.z_ddot[at]
        if self.pair is None:
            return -self.sign * float(v[self.column]), self.sign * float(a[self.column]), z
        rows = self.system.evaluate(z, v, [self.pair])
        return -float(rows.A[0] @ v), float(rows.A[0] @ a + rows.bend[0]), z
