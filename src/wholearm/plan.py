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
from typing import Any

import casadi as ca
import numpy as np

from . import __version__
from .errors import InfeasibleError
from .model import Array
from .options import Objective, PlanOptions
from .path import runs_on_curve, trace_phase, trace_phases
from .pathdomain.chain import Chain, make_chain
from .pathdomain.chainplan import add_up, assess, combine, plan_chain
from .phaseplan import PhasePlan
from .problem import End, Phase, Problem
from .sharing import exclusive
from .torque import TorqueProfile
from .trajectory import Motion, Trajectory, assemble
from .transition import Transition

MOVED = 1e-9
"""Distance from which on a block starts somewhere else [m or rad]."""
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
    least: list[PhasePlan[Motion]] = []
    allowed: list[float | None] = [None] * len(problem.phases)
    if options.goal is Objective.MARGIN:
        least, _ = _plan_blocks(problem, _for_time(options), allowed, [], report)
        allowed = _share_duration(least, options.duration)
    plans, chains = _plan_blocks(problem, options, allowed, least, report)
    if options.goal is Objective.MARGIN:
        _require_margin(problem, plans, allowed)
    planned = time.perf_counter()
    transitions = assess(chains, plans, problem.epsilon, options, allowed, report)
    transitions += _assess_struck(problem, plans, options, allowed, report)
    transitions.sort(key=lambda transition: transition.phase)
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
    allowed: list[float | None],
    least: Sequence[PhasePlan[Motion]],
    report: Callable[[str], None],
) -> tuple[list[PhasePlan[Motion]], list[Chain]]:
    """Plan block after block, each from where the one before ends; also what ran along curves.

    `allowed` holds the longest duration of each phase [s], in proportion to the plans of `least`
    duration. Where a block starts from somewhere else than there it is shared out again.
    """
    plans: list[PhasePlan[Motion]] = []
    chains: list[Chain] = []
    z = problem.start
    for block in split_blocks(problem):
        numbers = "-".join(str(phase.number) for phase in block)
        report(f"phase {numbers} of {len(problem.phases)}: {options.goal.value}")
        if least and _distance(least[block[0].index].motion, z) > MOVED:
            fastest, _ = _plan_block(problem, block, z, _for_time(options), allowed)
            _share_again(allowed, block, least, fastest)
        own, chain = _plan_block(problem, block, z, options, allowed)
        plans += own
        chains += [chain] if chain else []
        motion = plans[-1].motion
        z = chain.curves[-1].end if chain else motion.evaluate(np.array([motion.duration])).z[0]
    return plans, chains


def _plan_block(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    allowed: Sequence[float | None],
) -> tuple[list[PhasePlan[Motion]], Chain | None]:
    """Plan a block from `z`, along its curves or in the time domain; also its curves."""
    plans: list[PhasePlan[Motion]] = []
    if not _run_on_curves(block, options):
        from .timedomain.timeimpacts import plan_struck

        plans += plan_struck(problem, block, z, options, add_up(block, allowed))
        return plans, None
    curves, known = [], trace_phases(problem)
    for phase in block:
        traced = phase.index < len(known)
        curves.append(known[phase.index] if traced else trace_phase(problem, phase, z))
        z = curves[-1].end
    chain = make_chain(block, curves)
    for part in chain.split():
        plans += plan_chain(part, problem.epsilon, options, add_up(part.phases, allowed))
    return plans, chain


def _assess_struck(
    problem: Problem,
    plans: Sequence[PhasePlan[Motion]],
    options: PlanOptions,
    allowed: Sequence[float | None],
    report: Callable[[str], None],
) -> list[Transition]:
    """Assess the impacts of blocks that were planned in the time domain."""
    found: list[Transition] = []
    for block in split_blocks(problem):
        if len(block) > 1 and not _run_on_curves(block, options):
            from .timedomain.timeimpacts import assess_struck

            report(f"phase {block[0].number}: what impacts save")
            own = [plans[phase.index] for phase in block]
            found += assess_struck(problem, block, own, options, add_up(block, allowed))
    return found


def _require_margin(
    problem: Problem, plans: Sequence[PhasePlan[Motion]], allowed: Sequence[float | None]
) -> None:
    """Raise an error for a phase that cannot keep epsilon in its duration."""
    for phase, plan in zip(problem.phases, plans, strict=True):
        if plan.value < problem.epsilon - 1e-6:
            raise InfeasibleError(
                f"phase {phase.number}: in its share of the duration, {allowed[phase.index]:.5g} s,"
                f" the largest least c_n is {plan.value:.4g} N, below epsilon = "
                f"{problem.epsilon:g} N; allow a longer duration"
            )


def _for_time(options: PlanOptions) -> PlanOptions:
    return replace(options, objective=Objective.TIME, duration=None)


def _distance(motion: Motion, z: Array) -> float:
    """How far from `z` a motion starts [m or rad]."""
    return float(np.abs(motion.evaluate(np.zeros(1)).z[0] - z).max())


def _share_again(
    allowed: list[float | None],
    block: Sequence[Phase],
    least: Sequence[PhasePlan[Motion]],
    fastest: Sequence[PhasePlan[Motion]],
) -> None:
    """Give a block its share for another least duration, at the cost of the phases after it."""
    later = range(block[-1].index + 1, len(allowed))
    rest = sum(allowed[k] or 0.0 for k in later)
    if not rest:
        return
    gain = 0.0
    for phase, plan in zip(block, fastest, strict=True):
        own = allowed[phase.index]
        if own is not None:
            ratio = plan.motion.duration / least[phase.index].motion.duration
            gain += own * (ratio - 1)
            allowed[phase.index] = own * ratio
    for k in later:
        own = allowed[k]
        allowed[k] = None if own is None else own * (1 - gain / rest)


def _run_on_curves(block: Sequence[Phase], options: PlanOptions) -> bool:
    """Whether phases are planned along their curves: a single one, or several that slide."""
    if options.transcription != "auto" or not all(map(runs_on_curve, block)):
        return False
    return len(block) == 1 or not any(phase.formation.rolling for phase in block)


def _share_duration(
    least: Sequence[PhasePlan[Motion]], duration: float | None
) -> list[float | None]:
    """Longest duration of each phase [s]: the whole, shared in proportion to the least times."""
    times = [plan.motion.duration for plan in least]
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
