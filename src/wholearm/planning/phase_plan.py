"""The plan of one phase, whichever NLP found it, and figures of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from ..problem.definition import Phase
from ..results.dwell_record import Settling
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion
from .options import Objective

M_co = TypeVar("M_co", bound=Motion, covariant=True)


class PhasePlan(NamedTuple, Generic[M_co]):
    """The plan of one phase."""

    motion: M_co
    torque: TorqueProfile  # from the start of the phase
    value: float  # the phase's share of the objective: s, (N m)^2 s or N
    # sequences of contact modes that were tried, of phases in one NLP booked to the first; none
    # along curves
    sequences: int = 0
    # whether the search for contact modes has tried all that promised to be better
    complete: bool = True
    attempt: str = ""  # name of the guess that led to it; none along curves
    # the stages that it was solved on, in the scene's own units; none along curves
    stages: Sequence[object] = ()
    # estimate of how far the value of all phases in one NLP is from their best, relative to it
    error: float = math.nan
    # what the solver has found, of the first of the phases in one NLP that are only begun
    solution: object = None
    # its value with torques that are not held over control periods, if they are
    unheld: float = math.nan


class Settled(NamedTuple):
    """Plans of all phases with their ends held, and how; None where an end is not to be held."""

    plans: list[PhasePlan[Motion]]
    settlings: tuple[Settling | None, ...]


@dataclass
class Tried:
    """What a search for contact modes has done."""

    sequences: int = 1  # of modes that were tried
    complete: bool = True  # whether none was left to try
    iterations: int = 0  # of the solver


def add_up(phases: Sequence[Phase], allowed: Sequence[float | None]) -> float | None:
    """Longest duration of some phases in all [s], given that of each of the problem's phases."""
    own = [allowed[phase.index] for phase in phases]
    return sum(time for time in own if time is not None) if None not in own else None


def combine(goal: Objective, values: Sequence[float]) -> float:
    """Objective value of some phases, given that of each."""
    return min(values) if goal is Objective.MARGIN else sum(values)
