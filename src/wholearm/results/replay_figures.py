"""What a plan keeps of its replay."""

from __future__ import annotations

from typing import NamedTuple

from .report import Deviation


class LeastForce(NamedTuple):
    """The least normal force of a replay [N]: of which contact, in which phase, and when [s]."""

    value: float
    contact: str
    phase: int
    time: float


class ReplayedPhase(NamedTuple):
    """One phase of the replay.

    Attributes
    ----------
    arrival : float or None, [s]
        When its end was reached.
    end_speed : float or None, [m/s]
        What is left at an end at rest.
    end_deviation, deviation : Deviation or None
        From the plan, at the end of the phase and at worst.
    """

    arrival: float | None
    end_speed: float | None
    end_deviation: Deviation | None
    deviation: Deviation | None


class ReplayFigures(NamedTuple):
    """The replay of a whole plan.

    Attributes
    ----------
    least_c_n : LeastForce
    phases : tuple of ReplayedPhase
    residual : float
        What the samples leave of the equations of motion, in the scene's own units.
    refinements : tuple of int
        How often the intervals of each phase were doubled for the replay to hold; -1 for a plan
        without a search for contact modes.
    steps : int
        Of the simulation.
    simulations : int or None
        How many replays were made before one held, that one included; None where a file of an
        earlier version does not say.
    """

    least_c_n: LeastForce
    phases: tuple[ReplayedPhase, ...]
    residual: float
    refinements: tuple[int, ...]
    steps: int
    simulations: int | None = None
