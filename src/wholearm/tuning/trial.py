"""Trials of constant torques on one phase from rest, and what a tuner sees of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from ..common.arrays import Array
from ..common.errors import JammingError, SimulationError
from ..problem.definition import End, Phase, Problem
from ..results.torque import TorqueProfile
from ..simulation.events import EventKind, OutcomeKind, Simulation
from ..simulation.simulate import simulate
from ..simulation.tolerances import measure_units
from ..verification.tuning import measure_way
from ..verification.verdict import measure_speed

LONGEST = 100.0
"""How long a trial lasts at most, over the scene's time."""


class Sight(Enum):
    """What becomes of the object."""

    HELD = "does not slide"
    STOPS = "stops short"
    RETURNS = "turns back"
    REACHES = "reaches the end"
    LOSES = "loses a contact"


@dataclass(frozen=True)
class Outcome:
    """What a trial has shown.

    Attributes
    ----------
    sight : Sight
    text : str
        How it ended, in words.
    time : float, [s]
        When.
    speed : float, [m/s]
        What is left at the end of the phase; angular speeds count times the scene's length.
    least : float, [N]
        The least normal force while it moved; infinite if it did not.
    z : ndarray, shape (5,)
        Where it ended.
    """

    sight: Sight
    text: str
    time: float
    speed: float
    least: float
    z: Array = field(repr=False)


class Bench:
    """One phase, from rest, on which torques are tried; counts how often.

    Attributes
    ----------
    problem : Problem
        Of that phase alone.
    simulations : int
    """

    def __init__(self, problem: Problem, phase: Phase, z: Array) -> None:
        alone = replace(phase, index=0, end=End.REST)
        self.problem = replace(problem, start=z, phases=(alone,))
        self.simulations = 0

    @property
    def phase(self) -> Phase:
        """The phase."""
        return self.problem.phases[0]

    def try_out(self, steps: Sequence[tuple[float, Array]]) -> Outcome:
        """Apply torques, shape (2,) [N m], each from its time on [s]."""
        scene = self.problem.scene
        self.simulations += 1
        profile = _lay_out(steps, steps[-1][0] + LONGEST * scene.scales.time)
        try:
            seen = simulate(self.problem, profile)
        except (JammingError, SimulationError) as error:
            start = self.problem.start
            return Outcome(Sight.LOSES, str(error), 0.0, 0.0, -np.inf, start)
        speed = measure_speed(scene, seen.z_dot[-1])
        known = seen.c_n[np.isfinite(seen.c_n)]
        least = float(known.min()) if len(known) else np.inf
        text, sight = seen.outcome.text.removesuffix(", phase 1"), self._classify(seen)
        return Outcome(sight, text, float(seen.t[-1]), speed, least, seen.z[-1])

    def follow_free(self, steps: Sequence[tuple[float, Array]], outcome: Outcome) -> float:
        """How far a simulation that finds its contacts ends from an outcome.

        Positions over the scene's length, angles in rad.
        """
        from ..free_simulation.simulate import simulate_free

        self.simulations += 1
        start, units = self.problem.start, measure_units(self.problem.scene)[:5]
        seen = simulate_free(self.problem, _lay_out(steps, outcome.time), start=start)
        return float(np.abs((seen.z[-1] - outcome.z) / units).max())

    def _classify(self, seen: Simulation) -> Sight:
        kind = seen.outcome.kind
        if kind is OutcomeKind.GOAL_REACHED:
            return Sight.REACHES
        v, started = seen.z_dot[-1:], bool(seen.find(EventKind.START))
        if kind in (OutcomeKind.GOAL_MISSED, OutcomeKind.HELD):
            return Sight.STOPS if started else Sight.HELD
        if started and not v.any():
            # A contact that is lost as it comes to rest is one that the way back would lose.
            return Sight.STOPS
        way = measure_way(self.phase, seen.z[-1:], v)
        opens = way is not None and float(way[1][0] @ v[0]) > 0
        return Sight.RETURNS if opens else Sight.LOSES


def _lay_out(steps: Sequence[tuple[float, Array]], end: float) -> TorqueProfile:
    """Torques, each from its time on, up to an end [s]."""
    breaks = np.array([*(start for start, _ in steps), end])
    return TorqueProfile(breaks, np.array([tau for _, tau in steps])[..., None])
