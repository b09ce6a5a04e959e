"""Plan of a problem: all blocks, replay, gains of impacts, bounds, statistics."""

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
from ..verification.verify import EXACT_REST, find_uniqueness_margin, find_wedged
from .blocks import BlockPlan, ImpactSequence, Planning, plan_blocks
from .lower_bound import bound_least_time
from .nlp import charge, open_ledger
from .options import Objective, PlanOptions
from .path_domain.path_motion import PathMotion
from .path_domain.path_plan import plan_curves
from .phase_plan import PlanPart, Plans, combine, plan_stops
from .result import Plan, PlannedPhase, Status, Timings, write_meta
from .robust.robust_rows import Guide, list_holds, measure_holds


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
        Told what is being done.
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
        in its replay; names phase, limit, place and time. A SolverError says what was being done
        when the time was over.
    """
    return solve_with(problem, PlanOptions(objective=objective, **options), progress, time_limit)


def plan_anew(problem: Problem, progress: Callable[[str], None] | None = None) -> Trajectory:
    """The plan of a problem for a policy: not replayed, and without advice where there is none."""
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
    """Plan a problem with phases, verify the plan by simulation and assess it."""
    options = options.scale_ranges(problem.ranges)
    if problem.scene.control_period:
        options = replace(options, transcription="time")
    with open_ledger() as ledger:
        started = time.perf_counter()
        report("tracing the phases")
        curves = trace_phases(problem)
        traced = time.perf_counter()
        try:
            planning = plan_blocks(problem, curves, options, report)
        except InfeasibleError as error:
            # The motion of an error carries its problem, like that of a plan.
            if error.motion is not None:
                about = {"name": problem.name, "epsilon": problem.epsilon, "problem": problem.table}
                error.motion = replace(error.motion, meta=error.motion.meta | about)
            raise
        unique = check_uniqueness(problem, planning.trajectory, options.uniqueness_margin)
        planned, figures = time.perf_counter(), None
        if options.replay:
            from .replay_check import replay_plan

            first = planning
            planning, figures = replay_plan(planning, report)
            if planning is not first:
                unique = check_uniqueness(problem, planning.trajectory, options.uniqueness_margin)
        replayed = time.perf_counter()
        transitions = _assess(planning, report)
        assessed = time.perf_counter()
        ranges = assess_ranges(planning, report) if options.robust else None
        certificate = certify(planning, report) if options.certify else None
        gaps = certificate.gaps if certificate else {}
        phases = tuple(
            PlannedPhase(
                phase.number,
                ledger[phase.number],
                plan.value,
                plan.motion.duration,
                tuple(contact.name for contact in phase.formation.rolling),
                getattr(plan.motion, "modes", ()),
                plan.sequences,
                plan.complete,
                plan.attempt,
                gaps.get(phase.number, plan.error),
                *unique[phase.index],
                plan.settling,
                None if math.isnan(plan.unheld) else plan.unheld,
            )
            for phase, plan in zip(problem.phases, planning.settled, strict=True)
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
                traced - started,
                sum(phase.statistics.build_time for phase in phases),
                sum(phase.statistics.solve_time for phase in phases),
                planned - started,
                replayed - planned,
                assessed - replayed,
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
    """Transitions of all impacts, as the block's domain knows them, and what each saves."""
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
            # Torques held over periods start from a plan that stops, which there is not.
            if impact.possible and not planning.problem.scene.control_period:
                report(f"phase {impact.phase}: what its impact saves")
                at = impact.phase - first
                bounds = max(k for k in stops if k < at), at, min(k for k in stops if k > at)
                with charge(impact.phase):
                    impact = impact._replace(saves=_find_saving(planning, block, bounds, planner))
            transitions.append(impact)
    return transitions


def _plan_part(
    chain: ImpactSequence, epsilon: float, start: int, stop: int, z: Array, *others: Any
) -> Plans:
    """Plan phases `start` to `stop` of a chain, from rest at their curve's start: a `PlanPart`."""
    return [*plan_curves(chain.part(start, stop).make_task(epsilon, *others), explained=False)]


def _find_saving(
    planning: Planning, block: BlockPlan, bounds: tuple[int, int, int], plan_part: PlanPart
) -> float:
    """Cost of a stop at the middle one of `bounds` in phases in motion; NaN without a plan."""
    inside, options = slice(bounds[0], bounds[-1]), planning.options
    moving = block.plans[inside]
    duration = planning.allow(block.phases[inside])
    z = moving[0].motion.evaluate(np.zeros(1)).z[0]
    try:
        stopped = plan_stops(plan_part, bounds, z, options, duration)
    except (InfeasibleError, SolverError):
        return math.nan
    values = [combine(options.goal, [plan.value for plan in plans]) for plans in (stopped, moving)]
    gain = values[0] - values[1]
    return -gain if options.goal is Objective.MARGIN else gain


Uniqueness = tuple[UniquenessMargin | None, float | None]
"""Uniqueness margin of a phase, and for how long it is possibly stuck; see `PlannedPhase`."""


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
        uniqueness.append((margin, find_wedged(problem, phase, trajectory, EXACT_REST, begin)))
    return uniqueness


def certify(planning: Planning, report: Callable[[str], None]) -> Certificate:
    """Bound the least time of every part of a planning that is run through from rest to rest."""
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
    """Plan without ranges, and if asked for find the widest ranges along curves."""
    options, problem = planning.options, planning.problem
    scales = problem.scene.scales
    report("planning without ranges")
    bare = plan_blocks(problem, planning.curves, replace(options, ranges={}), report)
    nominal = combine(options.goal, [plan.value for plan in bare.plans])
    held = list[int]()  # phases that friction within the ranges may hold at rest at their start
    for phase, plan in zip(problem.phases, planning.plans, strict=True):
        first = plan.motion.evaluate(np.zeros(1))
        if measure_speed(problem.scene, first.z_dot[0]) <= EXACT_REST * scales.speed:
            holds = list_holds(phase.formation, first.z[0], options.ranges)
            held += [phase.number] * (measure_holds(holds, first.tau[0]) < SURE * scales.torque)
    figures = RangeFigures(dict(options.ranges), nominal, held=tuple(held))
    if not options.largest:
        return figures
    unit = options.scale_ranges(problem.ranges, 1.0).ranges
    relative = [unit[parameter.name] for parameter in PARAMETERS if not parameter.unit]
    # Relative ranges up to 0.95, and up to a thousand times the problem's own.
    most, widest = min(0.95 / max(*relative, 1e-300), 1e3), dict[int, float]()
    chains = [block.chain for block in planning.blocks if block.chain is not None]
    for part in (part for chain in chains for part in chain.split()):
        numbers = [phase.number for phase in part.phases]
        motions = (planning.plans[number - 1].motion for number in numbers)
        guides = [Guide(m.grid.s, *m.profile) for m in motions if isinstance(m, PathMotion)]
        report(f"looking for the widest ranges of phase {numbers[0]}")
        widest |= dict.fromkeys(numbers, _find_widest(planning, part, guides, most))
    if not widest:
        return figures
    each, least = tuple(widest.get(phase.number) for phase in problem.phases), min(widest.values())
    return figures._replace(largest=least, phases=each, capped=least >= most)


def _find_widest(
    planning: Planning, part: ImpactSequence, guides: list[Guide], most: float
) -> float:
    """The largest factor on ranges, up to `most`, with which phases have a plan; zero for none.

    The minimum-time sweep decides each step of a bisection; then plans are tried with ever smaller
    factors. `guides` are a motion along each curve.
    """
    first = part.make_task(planning.problem.epsilon, planning.options)

    def scale(factor: float) -> PlanOptions:
        wider = planning.options.scale_ranges(planning.problem.ranges, factor)
        return replace(wider, objective=Objective.TIME, duration=None)

    low, high, middle = 0.0, np.inf, min(1.0, most)
    while low < most and (np.isinf(high) or high - low > 0.01 * high):  # relatively
        task = replace(first, options=scale(middle), guides=tuple(guides))
        fastest = task.find_fastest()
        if fastest is None:
            high = middle
        else:
            # The minimum-time profile along each curve.
            low, start, guides = middle, 0.0, []
            for curve in first.curves:
                s = np.linspace(0.0, curve.length, len(fastest.s))
                b, none = np.interp(s + start, fastest.s, fastest.b), np.zeros_like(s)
                guides.append(Guide(s, none, b, none))
                start += curve.length
        middle = min(2 * low, most) if np.isinf(high) else (low + high) / 2
    for _ in range(8):  # most plans that are tried
        try:
            plan_curves(replace(first, options=scale(low).roughen()), explained=False)
            return low
        except (InfeasibleError, SolverError):
            low *= 0.98  # factor from one tried plan to the next
    return 0.0
