"""Plan of a problem: all blocks, replay, savings by impacts, bounds, statistics."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from .. import __version__
from ..common.arrays import Array
from ..common.errors import AmbiguityError, InfeasibleError, SolverError
from ..common.sharing import exclusive
from ..common.signals import OutOfTime, Reporter, interruptible, limit_time
from ..geometry.curve import describe_pose
from ..geometry.tracing import trace_phases
from ..mechanics.dynamics import measure_speed
from ..mechanics.statics import SURE
from ..mechanics.uniqueness import describe_uniqueness
from ..problem.definition import PARAMETERS, Problem
from ..problem.read import require_phases
from ..results.report import Certificate, RangeFigures, TimeBound, Transition, UniquenessMargin
from ..results.trajectory import Trajectory
from ..verification.verify import EXACT_REST, find_stuck, find_uniqueness_margin
from .blocks import BlockPlan, ImpactSequence, Planning, plan_blocks
from .lower_bound import bound_least_time
from .nlp import assign_costs, collect_costs
from .options import Objective, PlanOptions
from .path_domain.path_motion import PathMotion
from .path_domain.path_plan import plan_curves
from .phase_plan import PlanPart, Plans, combine, plan_stops
from .result import Plan, PlannedPhase, Status, Timings, write_meta
from .robust.robust_rows import Reference, list_holds, measure_holds


def solve(
    problem: Problem,
    objective: str = "time",
    *,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
    **options: Any,
) -> Plan:
    """Plan joint torques that carry the object through every phase of a problem.

    Parameters
    ----------
    problem : Problem
    objective : {"time", "effort", "margin"}
        Least duration; least integral of tau^T tau plus `time_weight` times the duration; or the
        largest least normal force within `duration`.
    progress : callable, optional
        Takes progress messages.
    time_limit : float, optional, [s]
        Longest time that planning may take.
    **options : Any
        Fields of `PlanOptions`, which says what they are.

    Returns
    -------
    Plan  its motions satisfy the equations of motion at any instant

    Raises
    ------
    InputError  if an option is out of its range or the problem's phases cannot be traced
    InfeasibleError, JammingError, SolverError, ReplayError  if there is no plan, or none that holds
        in its replay; names phase, limit, place and time. A SolverError says at which step the
        time limit was reached.
    """
    return solve_with(problem, PlanOptions(objective=objective, **options), progress, time_limit)


def plan_anew(problem: Problem, progress: Callable[[str], None] | None = None) -> Trajectory:
    """The plan of a problem for a policy: without a replay, and without advice if it fails."""
    from .explain import unadvised

    with unadvised():
        return solve(problem, progress=progress, replay=False).trajectory


@exclusive
def solve_with(
    problem: Problem,
    options: PlanOptions,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
) -> Plan:
    """Plan with `options` given as one object; see `solve`."""
    require_phases(problem)
    report = Reporter(progress)
    try:
        with interruptible(), limit_time(time_limit):
            return _solve(problem, options, report)
    except OutOfTime:
        if time_limit is None:
            raise
        text = f"the time limit of {time_limit:g} s is over, and there is no plan yet"
        raise SolverError(f"{text}; what it was at: {report.last}") from None


def _solve(problem: Problem, options: PlanOptions, report: Callable[[str], None]) -> Plan:
    """Plan of a problem with phases, with verification, savings by impacts and bounds."""
    options = options.scale_ranges(problem.ranges)
    if problem.scene.control_period:
        options = replace(options, transcription="time")
    with collect_costs() as costs:
        t_start = time.perf_counter()
        report("tracing the phases")
        curves = trace_phases(problem)
        t_trace = time.perf_counter()
        try:
            planning = plan_blocks(problem, curves, options, report)
        except InfeasibleError as error:
            # The motion of an error carries its problem, like that of a plan.
            if error.motion is not None:
                meta = {"name": problem.name, "epsilon": problem.epsilon, "problem": problem.table}
                error.motion = replace(error.motion, meta=error.motion.meta | meta)
            raise
        margins = check_uniqueness(problem, planning.trajectory, options.uniqueness_margin)
        t_plan, figures = time.perf_counter(), None
        if options.replay:
            from .replay_check import replay_plan

            initial = planning
            planning, figures = replay_plan(planning, report)
            if planning is not initial:
                margins = check_uniqueness(problem, planning.trajectory, options.uniqueness_margin)
        t_replay = time.perf_counter()
        transitions = _assess(planning, report)
        t_assess = time.perf_counter()
        ranges = assess_ranges(planning, report) if options.robust else None
        certificate = certify(planning, report) if options.certify else None
        gaps = certificate.gaps if certificate else {}
        phases = tuple(
            PlannedPhase(
                phase.number,
                costs[phase.number],
                plan.value,
                plan.motion.duration,
                tuple(contact.name for contact in phase.formation.rolling),
                getattr(plan.motion, "modes", ()),
                plan.sequences,
                plan.complete,
                plan.attempt,
                gaps.get(phase.number, plan.error),
                *margins[phase.index],
                plan.settling,
                None if math.isnan(plan.unheld) else plan.unheld,
            )
            for phase, plan in zip(problem.phases, planning.plans_with_dwell, strict=True)
        )
        plan = Plan(
            problem,
            options,
            Status.of(phases),
            combine(options.goal, [phase.value for phase in phases]),
            planning.trajectory,
            phases,
            tuple(transitions),
            figures,
            Timings(
                t_trace - t_start,
                sum(phase.statistics.build_time for phase in phases),
                sum(phase.statistics.solve_time for phase in phases),
                t_plan - t_start,
                t_replay - t_plan,
                t_assess - t_replay,
            ),
            {
                "wholearm": __version__,
                "casadi": ca.__version__,
                "numpy": np.__version__,
                "python": ".".join(map(str, sys.version_info[:3])),
            },
            certificate,
            ranges,
        )
        return replace(plan, trajectory=replace(plan.trajectory, meta=write_meta(plan)))


def _assess(planning: Planning, report: Callable[[str], None]) -> list[Transition]:
    """Transitions of all impacts, and what each saves over a stop."""
    transitions: list[Transition] = []
    for block in planning.blocks:
        if len(block.phases) == 1:
            continue
        if block.chain is None:
            from .time_domain.time_plan import list_impacts, plan_part

            impacts = list_impacts(block.phases, block.plans)
            planner = partial(plan_part, planning.problem, block.phases)
        else:
            impacts = block.chain.list_impacts(block.plans)
            planner = partial(_plan_part, block.chain, planning.problem.epsilon)
        first = block.phases[0].index
        stops = [0, *(i.phase - first for i in impacts if not i.possible), len(block.phases)]
        for impact in impacts:
            # Planning with control periods starts from a plan with a stop, which does not exist.
            if impact.possible and not planning.problem.scene.control_period:
                report(f"phase {impact.phase}: what its impact saves")
                end = impact.phase - first
                bounds = max(k for k in stops if k < end), end, min(k for k in stops if k > end)
                with assign_costs(impact.phase):
                    impact = impact._replace(saves=_find_saving(planning, block, bounds, planner))
            transitions.append(impact)
    return transitions


def _plan_part(
    chain: ImpactSequence, epsilon: float, start: int, stop: int, z: Array, *arguments: Any
) -> Plans:
    """Plan phases `start` to `stop` of a chain, from rest at its start: a `PlanPart`."""
    return [*plan_curves(chain.part(start, stop).make_task(epsilon, *arguments), explained=False)]


def _find_saving(
    planning: Planning, block: BlockPlan, bounds: tuple[int, int, int], plan_part: PlanPart
) -> float:
    """Cost of a stop at the middle one of `bounds` of moving phases; NaN without a plan."""
    span, options = slice(bounds[0], bounds[-1]), planning.options
    moving = block.plans[span]
    duration = planning.sum_durations(block.phases[span])
    z = moving[0].motion.evaluate(np.zeros(1)).z[0]
    try:
        stopped = plan_stops(plan_part, bounds, z, options, duration)
    except (InfeasibleError, SolverError):
        return math.nan
    values = [combine(options.goal, [plan.value for plan in plans]) for plans in (stopped, moving)]
    saving = values[0] - values[1]
    return -saving if options.goal is Objective.MARGIN else saving


Uniqueness = tuple[UniquenessMargin | None, float | None]
"""Uniqueness margin of a phase, and the time for which it may be stuck; see `PlannedPhase`."""


def check_uniqueness(problem: Problem, trajectory: Trajectory, least: float) -> list[Uniqueness]:
    """Uniqueness of the contact forces in every phase; AmbiguityError below the `least` margin."""
    uniqueness = list[Uniqueness]()
    for phase in problem.phases:
        rows = np.flatnonzero(trajectory.phase == phase.index)
        margin = find_uniqueness_margin(phase, trajectory, rows)
        if margin is not None and margin.value < least:
            place = describe_pose(trajectory.z[np.searchsorted(trajectory.t, margin.time)])
            text = describe_uniqueness(margin.value, margin.contacts, place, least)
            raise AmbiguityError(f"phase {phase.number}: {text}")
        # Torques may change at rest before the motion begins.
        begin = trajectory.phase_starts[phase.index]
        begin += getattr(trajectory.motions[phase.index], "begin", 0.0)
        uniqueness.append((margin, find_stuck(problem, phase, trajectory, EXACT_REST, begin)))
    return uniqueness


def certify(planning: Planning, report: Callable[[str], None]) -> Certificate:
    """Lower bounds of the least time of each part of a plan from rest to rest."""
    report("bounding the least time from below")
    bounds = list[TimeBound]()
    for block in planning.blocks:
        times = [plan.motion.duration for plan in block.plans]
        numbers = tuple(phase.number for phase in block.phases)
        if block.chain is None:
            bounds.append(TimeBound(numbers, sum(times), None, None, "planned over time"))
        for part in block.chain.split() if block.chain else ():
            phases = tuple(phase.number for phase in part.phases)
            duration = sum(times[number - numbers[0]] for number in phases)
            bound = bound_least_time(part.continuous_curves, planning.problem.epsilon)
            reason = "the sweep over the phase plane finds no motion"
            bounds.append(TimeBound(phases, duration, *(bound or (None, None, reason))))
    return Certificate(tuple(bounds))


def assess_ranges(planning: Planning, report: Callable[[str], None]) -> RangeFigures:
    """Cost of the ranges, and with `largest` the widest feasible ranges along curves."""
    options, problem = planning.options, planning.problem
    scales = problem.scene.scales
    report("planning without ranges")
    nominal_planning = plan_blocks(problem, planning.curves, replace(options, ranges={}), report)
    nominal = combine(options.goal, [plan.value for plan in nominal_planning.plans])
    stuck = list[int]()  # phases that friction within the ranges may hold at rest at their start
    for phase, plan in zip(problem.phases, planning.plans, strict=True):
        first = plan.motion.evaluate(np.zeros(1))
        if measure_speed(problem.scene, first.z_dot[0]) <= EXACT_REST * scales.speed:
            holds = list_holds(phase.formation, first.z[0], options.ranges)
            stuck += [phase.number] * (measure_holds(holds, first.tau[0]) < SURE * scales.torque)
    figures = RangeFigures(dict(options.ranges), nominal, held=tuple(stuck))
    if not options.largest:
        return figures
    ranges = options.scale_ranges(problem.ranges, 1.0).ranges
    relative = [ranges[parameter.name] for parameter in PARAMETERS if not parameter.unit]
    # Relative ranges up to 0.95, and up to a thousand times the problem's.
    limit, factors = min(0.95 / max(*relative, 1e-300), 1e3), dict[int, float]()
    chains = [block.chain for block in planning.blocks if block.chain is not None]
    for part in (part for chain in chains for part in chain.split()):
        numbers = [phase.number for phase in part.phases]
        motions = (planning.plans[number - 1].motion for number in numbers)
        references = [Reference(m.grid.s, *m.profile) for m in motions if isinstance(m, PathMotion)]
        report(f"looking for the widest ranges of phase {numbers[0]}")
        factors |= dict.fromkeys(numbers, _find_widest(planning, part, references, limit))
    if not factors:
        return figures
    by_phase, least = tuple(factors.get(p.number) for p in problem.phases), min(factors.values())
    return figures._replace(largest=least, phases=by_phase, capped=least >= limit)


def _find_widest(
    planning: Planning, part: ImpactSequence, references: list[Reference], limit: float
) -> float:
    """The largest factor on ranges, up to `limit`, with which phases have a plan; 0 without one.

    By bisection with the minimum-time sweep; then plans with decreasing factors confirm it.
    `references` are a motion along each curve.
    """
    first = part.make_task(planning.problem.epsilon, planning.options)

    def scale(factor: float) -> PlanOptions:
        return planning.options.scale_ranges(planning.problem.ranges, factor).for_least_time()

    low, high, middle = 0.0, np.inf, min(1.0, limit)
    while low < limit and (np.isinf(high) or high - low > 0.01 * high):  # relatively
        task = replace(first, options=scale(middle), references=tuple(references))
        fastest = task.find_fastest()
        if fastest is None:
            high = middle
        else:
            # The minimum-time profile along each curve.
            low, start, references = middle, 0.0, []
            for curve in first.curves:
                s = np.linspace(0.0, curve.length, len(fastest.s))
                b, zero = np.interp(s + start, fastest.s, fastest.b), np.zeros_like(s)
                references.append(Reference(s, zero, b, zero))
                start += curve.length
        middle = min(2 * low, limit) if np.isinf(high) else (low + high) / 2
    for _ in range(8):  # most plans that are tried
        try:
            plan_curves(replace(first, options=scale(low).roughen()), explained=False)
            return low
        except (InfeasibleError, SolverError):
            low *= 0.98  # from one plan to the next
    return 0.0
