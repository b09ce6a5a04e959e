"""The plan of one phase, whichever NLP found it."""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

from ..results.torque import TorqueProfile
from ..results.trajectory import Motion

M_co = TypeVar("M_co", bound=Motion, covariant=True)


class PhasePlan(NamedTuple, Generic[M_co]):
    """The plan of one phase.

    Attributes
    ----------
    motion : Motion
    torque : TorqueProfile
        From the start of the phase.
    value : float
        The phase's share of the objective: s, (N m)^2 s or N.
    iterations, solves : int
        Of the solver in all, and how often it ran. Of phases in one NLP only the first one counts.
    build_time, solve_time : float, [s]
        The same for them.
    sequences : int
        Sequences of contact modes that were tried; none along curves.
    """

    motion: M_co
    torque: TorqueProfile
    value: float
    iterations: int
    solves: int
    build_time: float
    solve_time: float
    sequences: int = 0
