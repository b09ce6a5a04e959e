"""Planning a problem, phase by phase.

Phases joined at rest are problems of their own; those joined smoothly or by impacts are one. Phases
with one freedom are planned along their curves, unless they pass smoothly into another, and
anything else in the time domain.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import casadi as ca
import numpy as np

from . import __version__
from .chain import Chain, make_chain
from .chainplan import add_up, assess, combine, plan_chain
from .errors import InfeasibleError, InputError
from .options import Objective, PlanOptions
from .path import runs_on_curve, trace_phase, trace_phases
from .phaseplan import PhasePlan
from .problem import End, Phase, Problem
from .torque import TorqueProfile
from .trajectory import Motion, Trajectory, assemble

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
        Other fields of `PlanOptions`: `intervals`, `time_weight`, `duration`, `samples`.

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
    """
    return solve_with(problem, PlanOptions(objective=objective, **options), progress)


def solve_with(
    problem: Problem, options: PlanOptions, progress: Callable[[str], None] | None = None
) -> Trajectory:
    """Plan with `options` given as one object; see `solve`."""
    started = time.perf_counter()
    report = progress or (lambda _: None)
    report("tracing the phases")
    _check_impacts(problem, options)
    trace_phases(problem)
    traced = time.perf_counter()
    least: list[PhasePlan[Motion]] = []
    allowed: list[float | None] = [None] * len(problem.phases)
    if options.goal is Objective.MARGIN:
        fastest = replace(options, objective=Objective.TIME, duration=None)
        least, _ = _plan_blocks(problem, fastest, allowed, report)
        allowed = _share_duration(least, options.duration)
    plans, chains = _plan_blocks(problem, options, allowed, report)
    planned = time.perf_counter()
    transitions = assess(chains, plans, problem.epsilon, options, allowed, report)
    assessed = time.perf_counter()
    motions = [plan.motion for plan in plans]
    values = [plan.value for plan in plans]
    every = [*least, *plans]
    nlps = {plan.build_time for plan in every}
    meta = {
        "status": "solved",
        "name": problem.name,
        "objective": options.goal.value,
        "value": combine(options.goal, values),
        "value_unit": UNITS[options.goal],
        "epsilon": problem.epsilon,
        "phase_values": values,
        "rolling": [[c.name for c in phase.formation.rolling] for phase in problem.phases],
        "phase_durations": [motion.duration for motion in motions],
        "transitions": [transition.to_dict() for transition in transitions],
        "intervals": options.intervals,
        "transcription": options.transcription,
        "time_weight": options.time_weight,
        "timings": {
            "trace": traced - started,
            "build": sum(nlps),
            "solve": sum(plan.solve_time for plan in every),
            "plan": planned - started,
            "assess": assessed - planned,
        },
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
    report("sampling")
    return assemble(
        motions, TorqueProfile.chain([plan.torque for plan in plans]), meta, options.samples
    )


def split_blocks(problem: Problem) -> list[tuple[Phase, ...]]:
    """Phases that have to be planned together: those joined smoothly or by impacts."""
    blocks: list[tuple[Phase, ...]] = []
    block: tuple[Phase, ...] = ()
    for phase in problem.phases:
        block = (*block, phase)
        if phase.end is End.REST:
            blocks.append(block)
            block = ()
    return blocks


def _plan_blocks(
    problem: Problem,
    options: PlanOptions,
    allowed: Sequence[float | None],
    report: Callable[[str], None],
) -> tuple[list[PhasePlan[Motion]], list[Chain]]:
    """Plan block after block, each from where the one before ends; also what ran along curves.

    `allowed` holds the longest duration of each phase [s].
    """
    plans: list[PhasePlan[Motion]] = []
    chains: list[Chain] = []
    curves, z = trace_phases(problem), problem.start
    for block in split_blocks(problem):
        numbers = "-".join(str(phase.number) for phase in block)
        report(f"phase {numbers} of {len(problem.phases)}: {options.goal.value}")
        if _run_on_curves(block, options):
            own = []
            for phase in block:
                known = phase.index < len(curves)
                own.append(curves[phase.index] if known else trace_phase(problem, phase, z))
                z = own[-1].end
            chains.append(make_chain(block, own))
            for part in chains[-1].split():
                duration = add_up(part.phases, allowed)
                plans += plan_chain(part, problem.epsilon, options, duration)
        else:
            from .timeplan import plan_phases

            plans += plan_phases(problem, block, z, options, add_up(block, allowed))
            motion = plans[-1].motion
            z = motion.evaluate(np.array([motion.duration])).z[0]
    return plans, chains


def _run_on_curves(block: Sequence[Phase], options: PlanOptions) -> bool:
    """Whether phases are planned along their curves: a single one, or several that slide."""
    if options.transcription != "auto" or not all(map(runs_on_curve, block)):
        return False
    return len(block) == 1 or not any(phase.formation.rolling for phase in block)


def _check_impacts(problem: Problem, options: PlanOptions) -> None:
    """Raise an error for an impact that would have to be planned in the time domain."""
    others = (block for block in split_blocks(problem) if not _run_on_curves(block, options))
    for phase in chain.from_iterable(others):
        if phase.end is End.IMPACT:
            raise InputError(
                problem.source,
                f"phases[{phase.number}].end",
                "'impact' given, but impacts are planned only along curves: between phases with "
                "four sliding contacts, none of them joined smoothly to another",
            )


def _share_duration(
    least: Sequence[PhasePlan[Motion]], duration: float | None
) -> list[float | None]:
    """Longest duration of each phase [s]: the whole, shared in proportion to the least times."""
    times = [plan.motion.duration for plan in least]
    total = 2 * sum(times) if duration is None else duration
    if total <= sum(times):
        raise InfeasibleError(
            f"duration = {total:g} s is not longer than the least time, {sum(times):.6g} s"
        )
    return [total / sum(times) * own for own in times]
