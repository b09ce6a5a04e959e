"""State of a running simulation without prescribed contacts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..results.torque import TorqueProfile
from .events import EventKind
from .run import Feedback, Run, find_torque_steps
from .stepper import Modes
from .system import System

CLOSED = 1e-10  # gap that counts as closed at an event, relative to the scene's length
SUNK = 1e-6  # overlap up to which features touch, over the scene's length; else they are behind
CHATTER = 1e-6  # speed of the last impact, over the scene's: separation stays below rounding
COARSE = 1e3  # the same over the tolerance, where that is coarser than impacts need
BURST = 3e-4
"""Time, relative to the scene's, in which `MANY` impacts raise `CHATTER` tenfold, and twice as many
a hundredfold: fingers may knock an object to and fro for ever."""
MANY = 20
AHEAD = 2e-5  # delay at which modes are evaluated, over the scene's time: a force's trend counts


class FreeRun(Run):
    """A running free simulation.

    Attributes
    ----------
    armed : (N,)  pairs that have been apart, so that their closing is an event
    resting       whether everything rests
    unique        whether the present modes were certainly the only solution
    residual      largest residual of a contact problem so far
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
        torque = torque.torque if isinstance(torque, Feedback) else torque
        super().__init__(system, torque, z, v, tolerance)
        self.restitution = restitution
        self.modes = hint or Modes(sigma=(0.0,) * system.n)
        self.armed = np.zeros(len(system.names), dtype=bool)
        self.decisions, self.decided_at = 0, -math.inf
        self.resting = self.unique = False
        self.residual = 0.0
        self._begin_piece()

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

    def next_piece(self) -> bool:
        """Go on to the next piece of the torques, if there is one."""
        if self.piece + 2 >= len(self.breaks):
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

    def torque_steps(self) -> bool:
        """Whether the torques step at the start of the present piece."""
        before, after = self.torque.coefficients[self.piece - 1 : self.piece + 1]
        return bool(find_torque_steps(before[None], after[None], self.system)[0])

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

    def note_at(
        self, kind: EventKind, text: str, contact: str = "", value: float = math.nan
    ) -> None:
        """Append an event at present, whose text says when."""
        self.note(kind, f"{text} at t = {self.t:.6g} s", contact, value)
