"""The plan of one phase in either domain, and objective and duration of several."""

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
    sequences: int = (
        0  # sequences of contact modes tried, of the first phase in one NLP; 0 on curves
    )
    complete: bool = True  # whether the mode search has tried all neighbours
    attempt: str = ""  # name of its initial guess; none along curves
    stages: Sequence[object] = ()  # of the NLP, in the scene's units; none along curves
    error: float = math.nan  # estimated relative error of the value of all phases in one NLP
    solution: object = None  # of the NLP, in the first of coarse plans
    unheld: float = math.nan  # value with free torques, where they are held over control periods


class Settled(NamedTuple):
    """Plans of all phases with their dwells; None at ends without one."""

    plans: list[PhasePlan[Motion]]
    settlings: tuple[Settling | None, ...]


@dataclass
class Tried:
    """Statistics of a mode search."""

    sequences: int = 1  # of modes that were tried
    complete: bool = True  # whether none was left
    iterations: int = 0  # of the solver


def add_up(phases: Sequence[Phase], allowed: Sequence[float | None]) -> float | None:
    """Longest duration of some phases in all [s]; `allowed` is of all phases."""
    own = [allowed[phase.index] for phase in phases]
    return sum(time for time in own if time is not None) if None not in own else None


def combine(goal: Objective, values: Sequence[float]) -> float:
    """Objective value of some phases, given that of each."""
    return min(values) if goal is Objective.MARGIN else sum(values)
