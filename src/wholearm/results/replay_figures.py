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
    """One phase of the replay."""

    arrival: float | None  # [s]: when its end was reached
    end_speed: float | None  # [m/s]: what is left at an end at rest
    # end_deviation, deviation: from the plan, at the end of the phase and at worst
    end_deviation: Deviation | None
    deviation: Deviation | None


class ReplayFigures(NamedTuple):
    """The replay of a whole plan."""

    least_c_n: LeastForce
    phases: tuple[ReplayedPhase, ...]
    residual: float  # what the samples leave of the equations of motion, in the scene's own units
    # how often the intervals of each phase were doubled for the replay to hold; -1 for a plan
    # without a search for contact modes
    refinements: tuple[int, ...]
    steps: int  # of the simulation
    # how many replays were made before one held, that one included; None where a file of an earlier
    # version does not say
    simulations: int | None = None
