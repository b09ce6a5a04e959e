"""Planning a problem, phase by phase.

Phases joined at rest are problems of their own; those joined smoothly are one. A phase with one
freedom between two rests is planned along its curve, anything else in the time domain.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from . import __version__
from .errors import InfeasibleError
from .options import Objective, PlanOptions
from .path import runs_on_curve, trace_phase, trace_phases
from .pathplan import plan_path
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
    trace_phases(problem)
    traced = time.perf_counter()
    blocks = split_blocks(problem)
    least: list[PhasePlan[Motion]] = []
    allowed: list[float | None] = [None] * len(blocks)
    if options.goal is Objective.MARGIN:
        fastest = replace(options, objective=Objective.TIME, duration=None)
        least = _plan_blocks(problem, blocks, fastest, allowed, report)
        allowed = _share_duration(blocks, least, options.duration)
    plans = _plan_blocks(problem, blocks, options, allowed, report)
    planned = time.perf_counter()
    motions = [plan.motion for plan in plans]
    values = [plan.value for plan in plans]
    every = [*least, *plans]
    nlps = {plan.build_time for plan in every}
    meta = {
        "status": "solved",
        "name": problem.name,
        "objective": options.goal.value,
        "value": min(values) if options.goal is Objective.MARGIN else sum(values),
        "value_unit": UNITS[options.goal],
        "epsilon": problem.epsilon,
        "phase_values": values,
        "rolling": [[c.name for c in phase.formation.rolling] for phase in problem.phases],
        "phase_durations": [motion.duration for motion in motions],
        "intervals": options.intervals,
        "transcription": options.transcription,
        "solver": options.solver,
        "time_weight": options.time_weight,
        "timings": {
            "trace": traced - started,
            "build": sum(nlps),
            "solve": sum(plan.solve_time for plan in every),
            "plan": planned - started,
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
    """Phases that have to be planned together: those joined smoothly."""
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
    blocks: Sequence[tuple[Phase, ...]],
    options: PlanOptions,
    allowed: Sequence[float | None],
    report: Callable[[str], None],
) -> list[PhasePlan[Motion]]:
    """Plan block after block, each from where the one before ends."""
    plans: list[PhasePlan[Motion]] = []
    curves, z = trace_phases(problem), problem.start
    for block, duration in zip(blocks, allowed, strict=True):
        numbers = "-".join(str(phase.number) for phase in block)
        report(f"phase {numbers} of {len(problem.phases)}: {options.goal.value}")
        phase = block[0]
        if runs_on_curve(phase) and options.transcription == "auto":
            known = phase.index < len(curves)
            curve = curves[phase.index] if known else trace_phase(problem, phase, z)
            plans.append(plan_path(curve, problem.epsilon, options, phase.number, duration))
            z = curve.end
        else:
            from .timeplan import plan_phases

            plans += plan_phases(problem, block, z, options, duration)
            motion = plans[-1].motion
            z = motion.evaluate(np.array([motion.duration])).z[0]
    return plans


def _share_duration(
    blocks: Sequence[tuple[Phase, ...]], least: Sequence[PhasePlan[Motion]], duration: float | None
) -> list[float | None]:
    """Longest duration of each block [s]: the whole, shared in proportion to the least times."""
    times = [sum(least[phase.index].motion.duration for phase in block) for block in blocks]
    total = 2 * sum(times) if duration is None else duration
    if total <= sum(times):
        from .advice import Change, Limit, describe_changes, round_outwards

        # The least-time plan shows it; a little more leaves something to choose.
        enough = Change(Limit("duration", total, "s", 1), round_outwards(1.005 * sum(times), 1))
        raise InfeasibleError(
            f"duration = {total:g} s is not longer than the least time, {sum(times):.6g} s; "
            f"{describe_changes([enough])}"
        )
    return [total / sum(times) * own for own in times]
