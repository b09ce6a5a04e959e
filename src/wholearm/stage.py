"""Stages: stretches of a motion in the time domain, on one formation with fixed friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .dynamics import Directions
from .formation import Formation
from .model import Array
from .problem import Until


@dataclass(frozen=True, eq=False)
class Stage:
    """A stretch on one formation with fixed directions of friction.

    Attributes
    ----------
    phase : int
        Index of the phase it belongs to.
    formation : Formation
    directions : Directions
    z : ndarray, shape (K d + 1, 5)
        Guess, at the start and at every collocation point.
    duration : float, [s]
        Guess.
    until : Until or None
        What is reached at the end; None if the stage ends by a reversal or a release.
    turns : tuple of int
        Rows of (contacts, joints) whose rate is zero at the end.
    gained : Formation or None
        The next stage's formation where that has a contact more, which is gained softly.
    watched : tuple of int
        Limits of the formation that are kept positive at every point.
    follows : bool
        Whether it goes on from another stage by a release.
    known : StagePoints or None
        All unknowns, where an earlier solution gives a better guess than `z` alone.
    """

    phase: int
    formation: Formation
    directions: Directions
    z: Array
    duration: float
    until: Until | None = None
    turns: tuple[int, ...] = ()
    gained: Formation | None = None
    watched: tuple[int, ...] = ()
    follows: bool = False
    known: StagePoints | None = None


class StagePoints(NamedTuple):
    """A stage's unknowns at its K d points.

    Attributes
    ----------
    duration : float, [s]
    z, v, a : ndarray, shape (K d, 5)
    c_n : ndarray, shape (K d, n_c), [N]
    tau : ndarray, shape (K d, 2), [N m]
    """

    duration: float
    z: Array
    v: Array
    a: Array
    c_n: Array
    tau: Array

    def pack(self) -> Array:
        """The unknowns as one vector, point by point."""
        table = np.hstack([self.z, self.v, self.a, self.c_n, self.tau])
        return np.append(self.duration, table.ravel())

    @staticmethod
    def unpack(x: Array, n_c: int) -> StagePoints:
        """The unknowns from one vector."""
        table = x[1:].reshape(-1, 17 + n_c)
        parts = np.split(table, [5, 10, 15, 15 + n_c], axis=1)
        return StagePoints(float(x[0]), *parts)
