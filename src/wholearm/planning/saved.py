"""Plans in files: what a plan is but for its motion, as the `meta` of its trajectory."""

from __future__ import annotations

import os
from collections.abc import Mapping
from math import isnan, nan
from typing import Any

from ..common.errors import InputError
from ..problem.definition import Problem
from ..problem.read import read_own_problem
from ..results.certificate import Certificate
from ..results.modes import ModeSpan
from ..results.range_figures import RangeFigures
from ..results.replay_figures import ReplayFigures
from ..results.report import UniquenessMargin
from ..results.settling import Settling
from ..results.trajectory import Trajectory
from ..results.trajectory_file import load_trajectory
from ..results.transition import Transition
from ..solvers.statistics import SolverStatistics
from .options import PlanOptions
from .result import Plan, PlannedPhase, Status, Timings

_OPTIONS = (
    "intervals", "transcription", "time_weight", "duration", "time_intervals", "degree", "scheme",
    "opening", "clearance", "samples", "mode_search", "certify", "accuracy", "uniqueness_margin",
    "robust", "largest",
)  # fmt: skip
"""Options that stand in `meta` by themselves; `objective` and `replay` do in other ways."""


def write_meta(plan: Plan) -> dict[str, Any]:
    """What a plan is but for its motion, in plain values for its file."""
    phases, options = plan.phases, plan.options
    return {
        "status": plan.status.value,
        "name": plan.problem.name,
        "objective": options.goal.value,
        "value": plan.value,
        "value_unit": plan.unit,
        "error": None if isnan(plan.error) else plan.error,
        "epsilon": plan.problem.epsilon,
        "phase_values": [phase.value for phase in phases],
        "rolling": [list(phase.rolling) for phase in phases],
        "modes": [[mode.to_dict() for mode in phase.modes] for phase in phases],
        "sequences": [phase.sequences for phase in phases],
        "complete": [phase.complete for phase in phases],
        "attempts": [phase.attempt for phase in phases],
        "phase_errors": [None if isnan(phase.error) else phase.error for phase in phases],
        "uniqueness_margins": [
            None if own.uniqueness_margin is None else own.uniqueness_margin._asdict()
            for own in phases
        ],
        "wedged": [phase.wedged for phase in phases],
        "settling": [own.settling and own.settling.to_dict() for own in phases],
        "unheld": [own.unheld for own in phases],
        "phase_durations": [phase.duration for phase in phases],
        **{name: getattr(options, name) for name in _OPTIONS},
        "iterations": [phase.statistics.iterations for phase in phases],
        "solves": [phase.statistics.solves for phase in phases],
        "build_times": [phase.statistics.build_time for phase in phases],
        "solve_times": [phase.statistics.solve_time for phase in phases],
        "versions": dict(plan.versions),
        "problem": plan.problem.table,
        "transitions": [transition.to_dict() for transition in plan.transitions],
        "replay": None if plan.replay is None else plan.replay.to_dict(),
        "certificate": None if plan.certificate is None else plan.certificate.to_dict(),
        "timings": plan.timings._asdict(),
        "ranges": None if plan.ranges is None else plan.ranges._asdict(),
    }


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Read the plan that a trajectory file holds.

    What files of earlier versions do not say is taken to be as by default: options, and numbers of
    what was solved as none.

    Raises
    ------
    InputError
        If the file cannot be read, or is no plan: a replay, or one without its problem.
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


def _read_uniqueness_margin(given: Mapping[str, Any] | None) -> UniquenessMargin | None:
    return None if given is None else UniquenessMargin(**given)


def _read_settling(given: Mapping[str, Any] | None) -> Settling | None:
    return None if given is None else Settling.of(given)


def _read_error(given: Any) -> float:
    return nan if given is None else float(given)


def _read(trajectory: Trajectory, problem: Problem) -> Plan:
    meta = trajectory.meta
    count = len(trajectory.motions)
    given = {name: meta[name] for name in _OPTIONS if name in meta}
    options = PlanOptions(meta["objective"], **given, replay=meta.get("replay") is not None)
    options = options.scale_ranges(problem.ranges)

    def column(key: str, missing: Any) -> list[Any]:
        values = meta.get(key, [missing] * count)
        if len(values) != count:
            raise InputError("", key, f"{len(values)} values given, {count} needed")
        return list(values)

    statistics = [
        SolverStatistics(int(iterations), int(solves), float(build), float(solve))
        for iterations, solves, build, solve in zip(
            column("iterations", 0),
            column("solves", 0),
            column("build_times", 0.0),
            column("solve_times", 0.0),
            strict=True,
        )
    ]
    phases = tuple(
        PlannedPhase(
            k + 1,
            float(column("phase_values", 0.0)[k]),
            float(column("phase_durations", 0.0)[k]),
            tuple(map(str, column("rolling", ())[k])),
            tuple(map(ModeSpan.of, column("modes", ())[k])),
            int(column("sequences", 0)[k]),
            bool(column("complete", True)[k]),
            str(column("attempts", "")[k]),
            _read_error(column("phase_errors", None)[k]),
            statistics[k],
            _read_uniqueness_margin(column("uniqueness_margins", None)[k]),
            column("wedged", None)[k],
            _read_settling(column("settling", None)[k]),
            column("unheld", None)[k],
        )
        for k in range(count)
    )
    replay, timings = meta.get("replay"), meta.get("timings", {})
    certificate, ranges = meta.get("certificate"), meta.get("ranges")
    return Plan(
        problem,
        options,
        Status(meta["status"]),
        float(meta["value"]),
        trajectory,
        phases,
        tuple(map(Transition.of, meta.get("transitions", ()))),
        None if replay is None else ReplayFigures.of(replay),
        Timings(*(float(timings.get(name, 0.0)) for name in Timings._fields)),
        dict(meta.get("versions", {})),
        None if certificate is None else Certificate.of(certificate),
        None if ranges is None else RangeFigures(**ranges),
    )
