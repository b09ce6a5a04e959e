"""Plans in files: all of a plan but its motion, as the `meta` of its trajectory."""

from __future__ import annotations

import os
from collections.abc import Mapping
from math import nan
from typing import Any, get_type_hints

from ..common.errors import InputError
from ..common.plain import plain, restore
from ..problem.definition import Problem
from ..problem.read import read_own_problem
from ..results.plan_record import Certificate, RangeFigures, ReplayFigures, Transition
from ..results.trajectory import Trajectory
from ..results.trajectory_file import load_trajectory
from ..solvers.statistics import SolverStatistics
from .options import PlanOptions
from .result import Plan, PlannedPhase, Status, Timings

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
