"""The result of planning: a plan with its problem, options, statistics and replay."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import reduce
from math import nan
from operator import add
from typing import Any, NamedTuple, get_type_hints

from numpy.typing import ArrayLike

from ..common.document import Document, Drawn, Result, plain, restore
from ..common.errors import InputError
from ..problem.definition import Problem
from ..problem.read import read_own_problem
from ..results.dwell_record import Settling
from ..results.plan_record import Certificate, ModeSpan, RangeFigures, ReplayFigures, Transition
from ..results.report import UniquenessMargin
from ..results.trajectory import Samples, Trajectory, load_trajectory
from ..solvers.ipopt import SolverStatistics
from .options import Objective, PlanOptions

_OPTIONS = (
    "intervals", "transcription", "time_weight", "duration", "time_intervals", "degree", "scheme",
    "opening", "clearance", "samples", "mode_search", "certify", "accuracy", "uniqueness_margin",
    "robust", "largest",
)  # fmt: skip
"""Options that stand in `meta` by themselves; `objective` and `replay` do in other ways."""
_PHASES: Mapping[str, tuple[str, Any]] = {
    "phase_values": ("value", 0.0), "phase_durations": ("duration", 0.0),
    "rolling": ("rolling", ()), "modes": ("modes", ()), "sequences": ("sequences", 0),
    "complete": ("complete", True), "attempts": ("attempt", ""), "phase_errors": ("error", nan),
    "uniqueness_margins": ("uniqueness_margin", None), "wedged": ("wedged", None),
    "settling": ("settling", None), "unheld": ("unheld", None),
}  # fmt: skip
"""Lists of `meta` with a value for each phase: what that is, and as what it counts where it is
missing, in files of earlier versions."""
_STATISTICS = {
    "iterations": "iterations", "solves": "solves", "build_times": "build_time",
    "solve_times": "solve_time",
}  # fmt: skip
"""Likewise of solving; missing ones are zero."""
_UNITS = ("m", "rad", "s")  # what files call the fields of deviations
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
    """One phase of a plan."""

    number: int  # from 1
    value: float  # its share of the objective: s, (N m)^2 s or N
    duration: float  # [s]
    rolling: tuple[str, ...]  # contacts that the problem lets roll
    modes: tuple[ModeSpan, ...]  # contact modes in the time domain; none along a curve
    sequences: int  # of modes that were tried; of phases in one NLP booked to the first
    complete: bool  # whether every sequence of modes that promised to be better was tried
    attempt: str  # the guess that it was found from, in the time domain
    error: float  # estimated relative error of the value, of all phases in one NLP with this one
    statistics: SolverStatistics  # of all solves for this phase, or for a block from this one on
    # of its contact forces; None in files of earlier versions
    uniqueness_margin: UniquenessMargin | None = None
    # [s]: for how long friction could hold everything at rest; None if it does not begin so
    wedged: float | None = None
    settling: Settling | None = None  # dwell at its end, included in `duration`
    unheld: float | None = None  # `value` with free torques, if they are held over periods


class Timings(NamedTuple):
    """Seconds that planning took."""

    # trace, plan, replay, assess: tracing curves; everything up to the first plan; its replay with
    # refinements (in `plan` where a search has replayed parts of a route); gains of impacts
    trace: float
    build: float  # build, solve: building NLPs and solving them, in all of these
    solve: float
    plan: float
    replay: float
    assess: float


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Drawn, Result):
    """A planned motion with what it was asked and what is known about it."""

    problem: Problem
    options: PlanOptions
    status: Status
    value: float  # of the objective, in `unit`
    # the motion. Its `meta` says the same as the plan in plain values, for files.
    trajectory: Trajectory = field(repr=False)
    phases: tuple[PlannedPhase, ...]
    transitions: tuple[Transition, ...]  # impacts that the problem asks for
    replay: ReplayFigures | None  # none if the plan was not replayed
    timings: Timings
    versions: Mapping[str, str]  # of this package and those that it plans with
    certificate: Certificate | None = None  # lower bounds of the durations, if they were asked for
    ranges: RangeFigures | None = None  # what ranges cost, for a robust plan

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


def write_meta(plan: Plan) -> dict[str, Any]:
    """All of a plan but its motion, in plain values."""
    phases, options = plan.phases, plan.options
    values: dict[str, Any] = plain(
        {
            "status": plan.status,
            "name": plan.problem.name,
            "objective": options.goal,
            "value": plan.value,
            "value_unit": plan.unit,
            "error": plan.error,
            "epsilon": plan.problem.epsilon,
            **{key: [getattr(own, name) for own in phases] for key, (name, _) in _PHASES.items()},
            **{
                key: [getattr(own.statistics, name) for own in phases]
                for key, name in _STATISTICS.items()
            },
            **{name: getattr(options, name) for name in _OPTIONS},
            "versions": plan.versions,
            "transitions": plan.transitions,
            "replay": plan.replay,
            "certificate": plan.certificate,
            "timings": plan.timings,
            "ranges": plan.ranges,
        }
    )
    # Deviations have the names of their units in files.
    for own in values["replay"]["phases"] if plan.replay else ():
        for key in ("end_deviation", "deviation"):
            own[key] = own[key] and dict(zip(_UNITS, own[key].values(), strict=True))
    return values | {"problem": plan.problem.table}


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Read the plan of a trajectory file, with defaults for values that older files do not have.

    Raises
    ------
    InputError  if the file cannot be read, or is no plan: a replay, or one without its problem
    """
    trajectory = load_trajectory(path)
    source = str(path)
    problem = read_own_problem(trajectory.meta, source)
    try:
        return _read(trajectory, problem)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        what = f"does not describe a plan: {type(error).__name__} {error}"
        raise InputError(source, "meta", what) from None
    except InputError as error:
        raise InputError(source, f"meta.{error.key}", error.problem) from None


def _read_replay(given: Mapping[str, Any]) -> ReplayFigures:
    """The replay, whose deviations have the names of their units in files."""

    def rename(own: Mapping[str, Any]) -> dict[str, Any]:
        # Files of earlier versions do not say when.
        return {"position": own["m"], "angle": own["rad"], "time": own.get("s")}

    phases = [
        {**own, **{key: own[key] and rename(own[key]) for key in ("end_deviation", "deviation")}}
        for own in given["phases"]
    ]
    found: ReplayFigures = restore(ReplayFigures, {**given, "phases": phases})
    return found


def _read(trajectory: Trajectory, problem: Problem) -> Plan:
    meta = trajectory.meta
    count = len(trajectory.motions)
    given = {name: meta[name] for name in _OPTIONS if name in meta}
    options = PlanOptions(meta["objective"], **given, replay=meta.get("replay") is not None)
    options = options.scale_ranges(problem.ranges)

    def column(key: str, kind: Any, missing: Any) -> list[Any]:
        values = meta.get(key)
        if values is None:
            return [missing] * count
        if len(values) != count:
            raise InputError("", key, f"{len(values)} values given, {count} needed")
        return [restore(kind, value) for value in values]

    kinds, costs = get_type_hints(PlannedPhase), get_type_hints(SolverStatistics)
    known = {name: column(key, kinds[name], miss) for key, (name, miss) in _PHASES.items()}
    spent = {name: column(key, costs[name], 0) for key, name in _STATISTICS.items()}
    phases = tuple(
        PlannedPhase(
            number=k + 1,
            statistics=SolverStatistics(**{name: values[k] for name, values in spent.items()}),
            **{name: values[k] for name, values in known.items()},
        )
        for k in range(count)
    )
    replay, timings = meta.get("replay"), meta.get("timings", {})
    return Plan(
        problem,
        options,
        Status(meta["status"]),
        float(meta["value"]),
        trajectory,
        phases,
        restore(tuple[Transition, ...], meta.get("transitions", ())),
        None if replay is None else _read_replay(replay),
        Timings(*(float(timings.get(name, 0.0)) for name in Timings._fields)),
        dict(meta.get("versions", {})),
        restore(Certificate | None, meta.get("certificate")),
        restore(RangeFigures | None, meta.get("ranges")),
    )
