"""The result of planning: a plan, what it was asked, what it has cost and what its replay shows."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import reduce
from operator import add
from typing import Any, NamedTuple

from numpy.typing import ArrayLike

from ..common.document import Document, Drawn, Result
from ..problem.definition import Problem
from ..results.certificate import Certificate
from ..results.modes import ModeSpan
from ..results.range_figures import RangeFigures
from ..results.replay_figures import ReplayFigures
from ..results.report import UniquenessMargin
from ..results.settling import Settling
from ..results.trajectory import Samples, Trajectory
from ..results.transition import Transition
from ..solvers.statistics import SolverStatistics
from .options import Objective, PlanOptions

UNITS = {Objective.TIME: "s", Objective.EFFORT: "(N m)^2 s", Objective.MARGIN: "N"}
"""Units of objectives."""


class Status(Enum):
    """How planning has ended."""

    SOLVED = "solved"
    BEST = "solved, best of several sequences of contact modes"
    STOPPED = "stopped early, with the best so far"
    """The search for contact modes has tried as many sequences as it may, with more to try, or no
    larger margin was found than that of a plan of least time."""

    @staticmethod
    def of(phases: tuple[PlannedPhase, ...]) -> Status:
        """The status of a plan of these phases."""
        if not all(phase.complete for phase in phases):
            return Status.STOPPED
        return Status.BEST if any(phase.sequences > 1 for phase in phases) else Status.SOLVED


class PlannedPhase(NamedTuple):
    """One phase of a plan.

    Attributes
    ----------
    number : int
        From 1.
    value : float
        Its share of the objective: s, (N m)^2 s or N.
    duration : float, [s]
    rolling : tuple of str
        Contacts that the problem lets roll.
    modes : tuple of ModeSpan
        Contact modes in the time domain; none along a curve.
    sequences : int
        Sequences of modes that were tried; of phases planned as one booked to the first.
    complete : bool
        Whether every sequence of modes that promised to be better was tried.
    attempt : str
        The guess that it was found from, in the time domain.
    error : float
        Estimate of how far the value of the phases planned as one with this one is from their best,
        relative to it.
    statistics : SolverStatistics
        Everything that was solved for this phase, or for phases planned as one from this one on:
        for the plan itself and on the way to it, for its refinement and to assess its impacts.
    uniqueness_margin : UniquenessMargin or None
        Of its contact forces; None in files of earlier versions.
    wedged : float or None, [s]
        For how long friction could hold everything at rest; None if it does not begin so.
    settling : Settling or None
        How its end is held, if it is to be; `duration` includes that.
    unheld : float or None
        `value` with torques that are not held over control periods, if they are.
    """

    number: int
    value: float
    duration: float
    rolling: tuple[str, ...]
    modes: tuple[ModeSpan, ...]
    sequences: int
    complete: bool
    attempt: str
    error: float
    statistics: SolverStatistics
    uniqueness_margin: UniquenessMargin | None = None
    wedged: float | None = None
    settling: Settling | None = None
    unheld: float | None = None


class Timings(NamedTuple):
    """Seconds that planning took.

    Attributes
    ----------
    trace, plan, replay, assess : float
        Tracing curves; everything up to the first plan; its replay, with what that made plan again,
        which is in `plan` where a search has replayed the parts of a route; what impacts save.
    build, solve : float
        Building NLPs and solving them, in all of these.
    """

    trace: float
    build: float
    solve: float
    plan: float
    replay: float
    assess: float


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Drawn, Result):
    """A planned motion with what it was asked and what is known about it.

    Attributes
    ----------
    problem : Problem
    options : PlanOptions
    status : Status
    value : float
        Of the objective, in `unit`.
    trajectory : Trajectory
        The motion. Its `meta` says the same as the plan in plain values, for files.
    phases : tuple of PlannedPhase
    transitions : tuple of Transition
        Impacts that the problem asks for.
    replay : ReplayFigures or None
        None if the plan was not replayed.
    timings : Timings
    versions : mapping of str
        Of this package and those that it plans with.
    certificate : Certificate or None
        Lower bounds of the durations, if they were asked for.
    ranges : RangeFigures or None
        What ranges cost, for a robust plan.
    """

    problem: Problem
    options: PlanOptions
    status: Status
    value: float
    trajectory: Trajectory = field(repr=False)
    phases: tuple[PlannedPhase, ...]
    transitions: tuple[Transition, ...]
    replay: ReplayFigures | None
    timings: Timings
    versions: Mapping[str, str]
    certificate: Certificate | None = None
    ranges: RangeFigures | None = None

    @property
    def headline(self) -> str:
        """Name, value and status, in a line."""
        value = f"{self.options.goal.value} = {self.value:.6g} {self.unit}"
        return f"{self.problem.name!r}, {value}, {self.status.value}"

    @property
    def unit(self) -> str:
        """Unit of the objective."""
        return UNITS[self.options.goal]

    @property
    def error(self) -> float:
        """Estimate of how far the value is from the best, relative to it; NaN where it is unknown.

        It says what finer grids would gain for these contact modes, not what other modes would.
        """
        if self.options.goal is Objective.MARGIN:
            return min(self.phases, key=lambda phase: phase.value).error
        values = [abs(phase.value) for phase in self.phases]
        shares = zip(values, self.phases, strict=True)
        return sum(value * phase.error for value, phase in shares) / sum(values)

    @property
    def duration(self) -> float:
        """How long the motion lasts [s]."""
        return self.trajectory.duration

    @property
    def statistics(self) -> SolverStatistics:
        """What solving has cost in all."""
        return reduce(add, (phase.statistics for phase in self.phases))

    @property
    def meta(self) -> Mapping[str, Any]:
        """The plan in plain values, as its file has them."""
        return self.trajectory.meta

    @property
    def values(self) -> Mapping[str, Any]:
        """The same, for JSON."""
        return self.meta

    @property
    def document(self) -> Document:
        """Phases, what the replay has shown and what is known of the value."""
        from .plan_report import describe_plan

        return describe_plan(self)

    def at(self, t: ArrayLike) -> Samples:
        """The motion at some times [s]; see `Trajectory.at`."""
        return self.trajectory.at(t)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to a ``.npz`` file, which `load_plan` reads; see `Trajectory.save`."""
        self.trajectory.save(path)

    def save_torques(self, path: str | os.PathLike[str]) -> None:
        """Write the torques as CSV; see `Trajectory.save_torques`."""
        self.trajectory.save_torques(path)
