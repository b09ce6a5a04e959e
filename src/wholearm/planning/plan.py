"""Planning a problem: its blocks one after the other, their replay, and what impacts save."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from .. import __version__
from ..common.sharing import exclusive
from ..geometry.tracing import trace_phases
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Trajectory, assemble
from ..results.transition import Transition
from .blocks import Planning, plan_blocks
from .impacts import assess_impacts
from .options import Objective, PlanOptions
from .phase_plan import PhasePlan, combine

_SETTINGS = (
    "intervals", "transcription", "time_weight", "duration", "time_intervals", "degree", "scheme",
    "opening", "clearance",
)  # fmt: skip
"""Options that `meta` says what a plan was made with."""
UNITS = {Objective.TIME: "s", Objective.EFFORT: "(N m)^2 s", Objective.MARGIN: "N"}


def solve(
    problem: Problem,
    objective: str = "time",
    *,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Trajectory:
    """Plan joint torques that carry the object through every phase of a problem.

    Parameters
    ----------
    problem : Problem
    objective : {"time", "effort", "margin"}
        Least duration; least integral of tau^T tau plus `time_weight` times the duration; or the
        largest least normal force within `duration`.
    progress : callable, optional
        Told in a few words what is being done.
    **options
        Other fields of `PlanOptions`, such as `intervals`, `time_weight`, `duration`, `samples` and
        `replay`.

    Returns
    -------
    Trajectory
        Its motions satisfy the equations of motion at any instant.

    Raises
    ------
    InputError
        If an option is out of its range or the problem's phases cannot be traced.
    InfeasibleError, JammingError, SolverError
        If there is no plan; the message names the phase, the limit, the place and the time.
    ReplayError
        If a plan does not hold when it is replayed; the message says where.
    """
    return solve_with(problem, PlanOptions(objective=objective, **options), progress)


@exclusive
def solve_with(
    problem: Problem, options: PlanOptions, progress: Callable[[str], None] | None = None
) -> Trajectory:
    """Plan with `options` given as one object; see `solve`."""
    started = time.perf_counter()
    report = progress or (lambda _: None)
    report("tracing the phases")
    trace_phases(problem)
    traced = time.perf_counter()
    planning = plan_blocks(problem, options, report)
    trajectory = assemble_plan(planning)
    planned = time.perf_counter()
    figures = None
    if options.replay:
        from .self_check import replay_plan

        planning, trajectory, figures = replay_plan(planning, trajectory, assemble_plan, report)
    replayed = time.perf_counter()
    transitions = _assess(planning, report)
    every = [*planning.least, *planning.plans]
    meta = _describe(planning) | {
        "transitions": [transition.to_dict() for transition in transitions],
        "replay": figures,
        "timings": {
            "trace": traced - started,
            "build": sum({plan.build_time for plan in every}),
            "solve": sum(plan.solve_time for plan in every),
            "plan": planned - started,
            "replay": replayed - planned,
            "assess": time.perf_counter() - replayed,
        },
    }
    return replace(trajectory, meta=meta)


def assemble_plan(planning: Planning) -> Trajectory:
    """The trajectory of a planning, but for its `meta`."""
    torque = TorqueProfile.chain([plan.torque for plan in planning.plans])
    motions = [plan.motion for plan in planning.plans]
    # What rolls is a part of the trajectory that is kept in `meta`.
    meta = {
        "rolling": _list_rolling(planning.problem),
        "modes": _list_modes(planning.plans),
        "phase_durations": [motion.duration for motion in motions],
    }
    return assemble(motions, torque, meta, planning.options.samples)


def _list_rolling(problem: Problem) -> list[list[str]]:
    """Names of the rolling contacts of each phase."""
    return [[c.name for c in phase.formation.rolling] for phase in problem.phases]


def _list_modes(plans: Sequence[PhasePlan[Motion]]) -> list[list[dict[str, Any]]]:
    """Contact modes of each phase, with times from its start; none where it runs on a curve."""
    return [getattr(plan.motion, "modes", []) for plan in plans]


def _describe(planning: Planning) -> dict[str, Any]:
    """What `meta` says of the problem, the options and the plans."""
    problem, options, plans = planning.problem, planning.options, planning.plans
    values = [plan.value for plan in plans]
    return {
        "status": "solved",
        "name": problem.name,
        "objective": options.goal.value,
        "value": combine(options.goal, values),
        "value_unit": UNITS[options.goal],
        "epsilon": problem.epsilon,
        "phase_values": values,
        "rolling": _list_rolling(problem),
        "modes": _list_modes(plans),
        "sequences": [plan.sequences for plan in plans],
        "phase_durations": [plan.motion.duration for plan in plans],
        **{name: getattr(options, name) for name in _SETTINGS},
        "iterations": [plan.iterations for plan in plans],
        "solves": [plan.solves for plan in plans],
        "versions": {
            "wholearm": __version__,
            "casadi": ca.__version__,
            "numpy": np.__version__,
            "python": ".".join(map(str, sys.version_info[:3])),
        },
        "problem": problem.table,
    }


def _assess(planning: Planning, report: Callable[[str], None]) -> list[Transition]:
    """Assess the impacts of every block, as its domain knows them."""
    found: list[Transition] = []
    for block in planning.blocks:
        if len(block.phases) == 1:
            continue
        if block.chain is None:
            from .time_domain.impacts import list_impacts, plan_parts_of

            impacts = list_impacts(block.phases, block.plans)
            plan_part = plan_parts_of(planning.problem, block.phases)
        else:
            from .path_domain import sequence_plan

            impacts = sequence_plan.list_impacts(block.chain, block.plans)
            plan_part = sequence_plan.plan_parts_of(block.chain, planning.problem.epsilon)
        given = block.phases, impacts, block.plans, plan_part
        found += assess_impacts(*given, planning.options, planning.allowed, report)
    return found
