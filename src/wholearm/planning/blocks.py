"""Plans of all blocks of a problem, one after the other, in the path or the time domain.

Along curves the velocity at the end of a phase is z_s s'. An impact makes it a multiple of the next
curve's tangent at any speed: v+ = ratio s' z_s. Therefore it is known before planning whether the
impact is possible. If it is, the curves are planned as one: with a parameter that runs `ratio`
times as fast on the next curve, the speed is continuous. Otherwise the sequence is split by a stop.
A smooth end is passed at speed where the tangents are the same. Under torque rate limits parts are
planned one after the other, with pauses between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import zip_longest
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import InfeasibleError, InputError, SolverError, WholearmError, name_source
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.tracing import CostToGo, runs_on_curves, split_blocks, trace_phase
from ..mechanics.dynamics import measure_speed, metric_weights
from ..mechanics.impact import Impact, compute_impact
from ..mechanics.speed_sweep import NoMotionError
from ..problem.definition import End, Phase, Problem
from ..results.dwell_record import TorqueChange, change_torques
from ..results.report import Transition
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from .lower_bound import sweep_time
from .nlp import assign_costs
from .options import Objective, PlanOptions
from .path_domain.path_plan import Task, plan_curves
from .phase_plan import (
    PER_SPEED,
    Plans,
    assemble_motions,
    end_of,
    make_transition,
    runs_along_curves,
    share_duration,
)

LONG = 4.0  # multiple of the least time within which longer durations are planned, too
BEND = 1e-6  # largest 1 - cosine between tangents that count as the same


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """A planned block."""

    phases: tuple[Phase, ...]
    start: Array  # (5,)
    plans: Plans  # one for each of its phases
    chain: ImpactSequence | None  # its curves; None in the time domain
    coarse: bool = False  # whether its plans are a guess that may violate limits between points

    @property
    def end(self) -> Array:
        """Where the block ends, shape (5,)."""
        if self.chain is not None:
            return self.chain.curves[-1].end
        return end_of(self.plans[-1])[0]


@dataclass(frozen=True, eq=False)
class Planning:
    """The plans of all phases of a problem."""

    problem: Problem
    curves: tuple[Curve, ...]  # of the first phases, up to the first end that a plan chooses
    options: PlanOptions
    blocks: tuple[BlockPlan, ...]
    durations: Sequence[float] = ()  # [s]: longest one of each phase, for the objective `margin`
    fastest: Plans = field(default_factory=list)  # time-optimal plans; blocks end where they do
    free_ends: bool = True  # whether the cost-to-go chooses ends of blocks; not for `margin`
    extra_epsilon: dict[int, float] = field(default_factory=dict)  # [N]: by indices of blocks

    @property
    def plans(self) -> Plans:
        """The plans of all phases."""
        return [plan for block in self.blocks for plan in block.plans]

    @cached_property
    def plans_with_dwell(self) -> Plans:
        """The plans, with dwells at their ends if the problem has some."""
        if all(self.problem.settles(phase) == 0 for phase in self.problem.phases):
            return self.plans
        from .dwell import settle_plans

        return settle_plans(self.problem, self.plans)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The motion with dwells; its `meta` has only rolling contacts and modes."""
        pairs = zip(self.plans_with_dwell, self.problem.phases, strict=True)
        pieces = ((plan.motion, plan.torque, phase.formation) for plan, phase in pairs)
        return assemble_motions(pieces, self.options.samples)

    def sum_durations(self, phases: Sequence[Phase]) -> float | None:
        """Longest duration of successive phases [s], for the objective `margin`."""
        return sum(self.durations[phase.index] for phase in phases) if self.durations else None


def plan_blocks(
    problem: Problem, curves: tuple[Curve, ...], options: PlanOptions, report: Callable[[str], None]
) -> Planning:
    """Plans of all blocks of a problem, each from the end of the previous one; raises without one.

    `curves` are those of the first phases (`trace_phases`); `report` takes progress messages.
    """
    with name_source(problem.source):
        require_steps(problem, options)
    planning = Planning(problem, curves, options, ())
    if options.goal is not Objective.MARGIN:
        return plan_each(planning, report)
    from .explain import unadvised

    time_options = options.for_least_time()
    fastest = plan_each(replace(planning, options=time_options, free_ends=False), report).plans
    times = [plan.motion.duration for plan in fastest]
    duration = 2 * sum(times) if options.duration is None else options.duration
    # Even slower motions hardly press harder, and their NLPs may not converge. Case: phase 2 of the
    # rolling box in 20 s, which takes 0.45 s at least.
    candidates = list[Planning]()
    for longest in dict.fromkeys([min(duration, LONG * sum(times)), duration]):
        durations = share_duration(times, longest)
        slower = replace(planning, durations=durations, fastest=fastest)
        try:
            with unadvised() if candidates else nullcontext():
                candidates.append(plan_each(slower, report))
        except (InfeasibleError, SolverError):
            if not candidates:
                raise
    return max(candidates, key=lambda each: min(plan.value for plan in each.plans))


def plan_each(planning: Planning, report: Callable[[str], None]) -> Planning:
    """Plan block after block; blocks that already have plans that are not coarse keep these.

    InfeasibleError if a phase cannot keep epsilon in its part of the longest duration.
    """
    planned, count = replace(planning, blocks=()), len(split_blocks(planning.problem))
    for _, block in zip_longest(range(count), planning.blocks):
        planned = plan_next(planned, block, report)
    epsilon = planning.problem.epsilon
    rounding = 5e-7 * planning.problem.scene.scales.force
    bounded = planning.options.goal is Objective.MARGIN
    for phase, plan in zip(planning.problem.phases, planned.plans, strict=True):
        if bounded and plan.value < epsilon - rounding:
            raise InfeasibleError(
                f"phase {phase.number}: in its share of the duration, "
                f"{planning.durations[phase.index]:.5g} s, the largest least c_n is "
                f"{plan.value:.4g} N, below epsilon = {epsilon:g} N; allow a longer duration"
            )
    return planned


def plan_next(
    planning: Planning, block: BlockPlan | None, report: Callable[[str], None], coarse: bool = False
) -> Planning:
    """Plan the next block, if `coarse` roughly where it is planned over time.

    `block` is its plan if it begins in the same place and is not coarse; otherwise its guess.
    """
    problem, options, fastest = planning.problem, planning.options, planning.fastest
    phases = split_blocks(problem)[len(planning.blocks)]
    z = planning.blocks[-1].end if planning.blocks else problem.start
    if problem.scene.control_period and planning.blocks and not runs_on_curves(phases):
        z = _replay(planning)
    coarse = coarse and not runs_along_curves(phases, options)
    rounding = 1e-9 * problem.scene.scales.length
    moved = block is not None and measure_speed(problem.scene, block.start - z) > rounding
    if block is None or moved or block.coarse:
        numbers = [phase.number for phase in phases]
        title = f"phase {'-'.join(map(str, numbers))} of {len(problem.phases)}"
        report(f"{title}: {options.goal.value}")
        with name_source(problem.source):
            extra = planning.extra_epsilon.get(len(planning.blocks), 0.0)
            tightened = replace(problem, epsilon=problem.epsilon + extra) if extra else problem
            try:
                plans, chain = plan_block(
                    replace(planning, problem=tightened),
                    phases,
                    z,
                    cost_to_go=find_cost_to_go(planning, phases) if planning.free_ends else None,
                    saturation=1.1 * min((plan.value for plan in planning.plans), default=math.inf),
                    fastest=[fastest[phase.index] for phase in phases if fastest],
                    initial_plans=block.plans if block and block.coarse else (),
                    coarse=coarse,
                )
            except WholearmError as error:
                error.phases = numbers
                raise
        block = BlockPlan(phases, z, plans, chain, coarse)
    return replace(planning, blocks=(*planning.blocks, block))


def _replay(planning: Planning) -> Array:
    """Where the planned blocks end in their replay, shape (5,); as planned if the replay fails.

    Motions with several freedoms are unstable in open loop. Case: query 9 with periods of 2 ms,
    where an error of 2e-6 rad grows 900-fold in phase 20.
    """
    from ..simulation.simulate import simulate

    phases = planning.problem.phases[: len(planning.plans)]
    torque = TorqueProfile.chain([plan.torque for plan in planning.plans])
    replay = simulate(replace(planning.problem, phases=phases), torque)
    return np.asarray(replay.z[-1]) if replay.outcome.reached else planning.blocks[-1].end


def plan_block(
    planning: Planning, block: Sequence[Phase], z: Array, **arguments: Any
) -> tuple[Plans, ImpactSequence | None]:
    """Plans of a block from `z`, along its curves or in the time domain, and its curves.

    `arguments` are those of `plan_with_impacts`.
    """
    problem, options = planning.problem, planning.options
    if not runs_along_curves(block, options):
        return _plan_over_time(planning, block, z, arguments), None
    chain = trace_block(planning, block, z)
    if problem.scene.has_slow_motors:
        return plan_rate_limited(planning, chain), chain
    plans: Plans = []
    for part in chain.split():
        with assign_costs(part.phases[0].number):
            duration = planning.sum_durations(part.phases)
            task = part.make_task(problem.epsilon, options, duration)
            curves = enumerate(planning.curves, 1)
            others = {number: curve for number, curve in curves if number not in task.phases}
            plans += plan_curves(replace(task, others=others))
    return plans, chain


def trace_block(planning: Planning, block: Sequence[Phase], z: Array) -> ImpactSequence:
    """Curves of a block from `z`, of shape (5,)."""
    stored, curves = planning.curves, list[Curve]()
    for phase in block:
        is_stored, later = phase.index < len(stored), planning.problem.phases[phase.index + 1 :]
        curves.append(stored[phase.index] if is_stored else trace_phase(phase, z, later))
        z = curves[-1].end
    return ImpactSequence(block, curves)


def _plan_over_time(
    planning: Planning, block: Sequence[Phase], z: Array, arguments: dict[str, Any]
) -> Plans:
    """Plans of a block in the time domain, from those with free torques if motors limit these.

    Under rate limits first in the modes of a coarse plan with free torques, then in searched modes:
    phases 5 and 6 of the heptagon need the former, phase 15 of query 28 the latter.
    """
    from .time_domain.time_plan import plan_with_impacts

    problem, options, failure = planning.problem, planning.options, None
    limited, duration = problem.scene.has_slow_motors, planning.sum_durations(block)
    # Coarse plans of the edges of routes have free torques, others the torques of the block.
    coarse, initial_plans = arguments.get("coarse", False), arguments.pop("initial_plans", ())
    free_guess, guess = (initial_plans, ()) if limited and coarse else ((), initial_plans)
    for complete in (False, True) if limited and options.mode_search else (options.mode_search,):
        variant = replace(planning, options=replace(options, mode_search=complete))
        free_plans = plan_free(variant, block, z, initial_plans=free_guess, **arguments)
        guesses: Any = {"free_plans": free_plans, "initial_plans": guess}
        plan: Callable[[float | None], Plans] = partial(
            plan_with_impacts, problem, block, z, options, **guesses, **arguments
        )
        with assign_costs(block[0].number):
            try:
                if limited and not coarse:
                    return plan_with_pauses(planning, block, plan, duration)
                return plan(duration)
            except (InfeasibleError, SolverError) as error:
                failure = failure or error
    from .explain import explain_motors

    assert failure is not None
    raise explain_motors(problem.scene, block, free_plans, failure) from None


def plan_with_pauses(
    planning: Planning,
    block: Sequence[Phase],
    plan: Callable[[float | None], Plans],
    duration: float | None,
) -> Plans:
    """Plans of a block with pauses, by `plan` for a longest duration [s] of the motions."""
    from .dwell import add_pause

    previous, scene = planning.plans[-1:], planning.problem.scene

    def list_changes(plans: Plans) -> list[TorqueChange]:
        """Changes from the torques before each phase to its first torques."""
        ends = [plan.end_torques[1] for plan in [*previous, *plans[:-1]]]
        starts = [plan.end_torques[0] for plan in plans]
        ends = ends if previous else [starts[0], *ends]
        return [change_torques(scene, *pair) for pair in zip(ends, starts, strict=True)]

    pause, plans = 0.0, plan(duration)
    changes = list_changes(plans)
    while duration is not None and (pauses := sum(change.duration for change in changes)) > pause:
        # Other torques at rest may take longer to change: somewhat more is left for that.
        pause = pauses if not pause else 1.1 * pauses
        plans = plan(duration - pause)
        changes = list_changes(plans)
    return [
        add_pause(plan, change, phase.formation, planning.options)
        for plan, change, phase in zip(plans, changes, block, strict=True)
    ]


def plan_free(planning: Planning, block: Sequence[Phase], z: Array, **arguments: Any) -> Plans:
    """Plans with free torques, along curves if possible, of a block that is planned over time.

    An empty list if the block is planned so itself, or has no plan along curves.
    """
    problem, options = free_torques(planning.problem, planning.options)
    options = replace(options, transcription="auto")
    phases = [problem.phases[phase.index] for phase in block]
    limited = problem is not planning.problem
    if not (limited or runs_along_curves(phases, options)):
        return []
    arguments |= {"fastest": ()}
    if not planning.problem.scene.control_period:
        # The cost of held torques is the difference to an accurate plan.
        arguments["coarse"], options = True, options.roughen()
    try:
        free_planning = replace(planning, problem=problem, options=options, curves=())
        return plan_block(free_planning, phases, z, **arguments)[0]
    except WholearmError as error:
        if not limited:
            return []
        from .explain import explain_motors

        raise explain_motors(planning.problem.scene, block, [], error) from None


def find_following(problem: Problem, block: Sequence[Phase]) -> Sequence[Phase]:
    """The next block; empty after the last one."""
    index = block[-1].index + 1
    return next((other for other in split_blocks(problem) if other[0].index == index), ())


def find_cost_to_go(planning: Planning, block: Sequence[Phase]) -> CostToGo | None:
    """Cost-to-go at the end of a block in the time domain, if that is free on a curve.

    Without motor limits: its gradient is nearly the same, and takes less time.
    """
    problem, options = free_torques(planning.problem, planning.options)
    planning = replace(planning, problem=problem, options=options)
    following = find_following(problem, block)
    if runs_along_curves(block, options) or not following:
        return None
    phase, last = following[0], block[-1]
    gained = set(phase.formation.contacts) - set(last.formation.contacts)
    lands = gained == {last.until.contact} and not last.until.pins
    if options.goal is Objective.MARGIN or not lands or not runs_along_curves(following, options):
        return None
    if options.goal is Objective.TIME and len(following) == 1:
        return estimate_time_to_go(phase, problem.epsilon)

    def value(z: Array) -> float:
        return sum(plan.value for plan in plan_block(planning, following, z)[0])

    return CostToGo(phase, value)


def estimate_time_to_go(phase: Phase, epsilon: float) -> CostToGo:
    """Estimated least time [s] of a phase with one freedom, as a function of its start."""
    sequence = partial(ImpactSequence, [phase])
    return CostToGo(phase, lambda z: sequence([trace_phase(phase, z)]).estimate(epsilon))


def require_steps(problem: Problem, options: PlanOptions) -> None:
    """Raise an InputError for options that exclude rate-limited torques or control periods."""
    settings = [
        (f"{finger.name}.{key}", getattr(finger, key))
        for finger in problem.scene.fingers
        for key, default in (("torque_rate_limit", math.inf), ("actuator_lag", 0.0))
        if getattr(finger, key) != default
    ]
    scene, reason = problem.scene, ""
    if options.ranges:
        reason = "ranges (--robust) are not kept with it yet"
    elif settings and scene.control_hold == "constant":
        reason = f"torques held constant step, and {settings[0][0]} is given; hold them linear"
    if reason and scene.control_period:
        raise InputError("", "control_period", f"{scene.control_period:g} given; {reason}")
    on_curves = all(runs_along_curves(block, options) for block in split_blocks(problem))
    if settings and options.ranges and not on_curves:
        reason = "ranges (--robust) are not kept with it in phases over time yet"
        raise InputError("", settings[0][0], f"{settings[0][1]:g} given; {reason}")


def free_torques(problem: Problem, options: PlanOptions) -> tuple[Problem, PlanOptions]:
    """The problem and options with free torques."""
    scene = problem.scene
    if scene.control_period:
        options = replace(options, transcription="auto")
    if scene.has_slow_motors or scene.control_period:
        free_scene = replace(scene.quicken(math.inf), control_period=0.0)
        problem = replace(problem, scene=free_scene)
    return problem, options


@dataclass(frozen=True, eq=False)
class CurveImpact:
    """Impact between two curves at unit speed along the first; without impulses if smooth."""

    phase: Phase  # that ends
    impact: Impact  # velocities per m/s, hence without unit and in rad/m; impulses in N s per m/s
    ratio: float  # speed along the second curve; negative if the motion would turn back

    @property
    def possible(self) -> bool:
        """Whether the motion can go on at speed."""
        return self.impact.possible and self.ratio > 0

    @property
    def reason(self) -> str:
        """Why the motion has to stop, empty if not."""
        if self.impact.violations:
            return self.impact.violations[0].describe(PER_SPEED)
        return "" if self.possible else f"phase {self.phase.number + 1} would be run backwards"


def compute_curve_impact(phase: Phase, before: Curve, after: Curve) -> CurveImpact:
    """The impact at the end of a phase, from its curve to the next one's."""
    v = before.evaluate(np.array([before.length])).z_s[0] / before.speed_ratio
    heading = after.evaluate(np.zeros(1)).z_s[0] / after.speed_ratio
    metric = metric_weights(after.formation.scene)
    if phase.end is End.SMOOTH:
        none = np.zeros(after.formation.n_contacts)
        impact = Impact(after.formation, v, none, none, ())
        return CurveImpact(phase, impact, float(v * metric @ heading > 1 - BEND))
    impact = compute_impact(before.formation, after.formation, after.start, v)
    return CurveImpact(phase, impact, float(impact.v * metric @ heading))


@dataclass(frozen=True, eq=False)
class ImpactSequence:
    """One-freedom phases, each but the last ended by an impact or smoothly."""

    phases: Sequence[Phase]
    curves: Sequence[Curve]  # parametrised by arc length

    @cached_property
    def impacts(self) -> list[CurveImpact]:
        """Between one curve and the next."""
        return [*map(compute_curve_impact, self.phases[:-1], self.curves[:-1], self.curves[1:])]

    def part(self, start: int, stop: int) -> ImpactSequence:
        """Phases `start` to `stop`, without the latter."""
        return ImpactSequence(self.phases[start:stop], self.curves[start:stop])

    def split(self) -> list[ImpactSequence]:
        """Split where an impact is not possible."""
        ends = [k + 1 for k, join in enumerate(self.impacts) if not join.possible]
        bounds = zip([0, *ends], [*ends, len(self.phases)], strict=True)
        return [self.part(start, stop) for start, stop in bounds]

    @property
    def continuous_curves(self) -> tuple[Curve, ...]:
        """The curves with speed ratios by which the speed is continuous."""
        ratios = np.cumprod([1.0, *(join.ratio for join in self.impacts)])
        pairs = zip(self.curves, ratios.tolist(), strict=True)
        return tuple(curve.with_speed_ratio(ratio) for curve, ratio in pairs)

    def make_task(
        self, epsilon: float, options: PlanOptions, duration: float | None = None
    ) -> Task:
        """The planning task of phases without stops between, from rest to rest."""
        numbers = [phase.number for phase in self.phases]
        return Task(self.continuous_curves, epsilon, options, numbers, duration)

    def estimate(self, epsilon: float) -> float:
        """Estimated least time [s], with stops where impacts are not possible."""
        try:
            curves = (part.continuous_curves for part in self.split())
            return sum(sweep_time(each, epsilon, intervals=24) for each in curves)
        except NoMotionError:
            number = self.phases[0].number
            raise SolverError(f"phase {number}: no motion keeps the limits") from None

    def list_impacts(self, plans: Plans) -> list[Transition]:
        """The impacts, with their speeds in plans of the phases."""
        impacts = []
        for plan, join in zip(plans, self.impacts, strict=False):
            phase = join.phase
            if phase.end is End.IMPACT:
                speed = measure_speed(phase.formation.scene, end_of(plan)[1] * join.possible)
                impacts.append(make_transition(phase, join.impact, join.ratio, join.reason, speed))
        return impacts


def plan_margin_at_rest(planning: Planning, sequence: ImpactSequence) -> Plans:
    """Plan for the largest margin under rate limits, with torques at rest chosen by the NLPs.

    Those of the fastest changes would limit it. Case: the heptagon on four contacts with 500 N m/s,
    0.067 N in place of 0.390 N.
    """
    epsilon, options, parts = planning.problem.epsilon, planning.options, sequence.split()
    times = [planning.sum_durations(part.phases) or 0.0 for part in parts]

    def plan_part(part: ImpactSequence, duration: float) -> Plans:
        """Plan within a duration, or a shorter one: it need not be used up."""
        least = sum(planning.fastest[phase.index].motion.duration for phase in part.phases)
        failures = list[WholearmError]()
        # Case: phase 3 of the hexagon in 2 s with a lag of 5 ms.
        for power in (1.0, 0.5, 0.25):
            shorter = min(duration, least * (duration / least) ** power)
            task = part.make_task(epsilon, options, shorter)
            try:
                return [*plan_curves(task, explained=False)]
            except (InfeasibleError, SolverError) as error:
                failures.append(error)
        raise failures[0]

    def plan_parts(duration: float | None) -> Plans:
        scale = (duration or 0.0) / sum(times)
        plans: Plans = []
        for part, time in zip(parts, times, strict=True):
            with assign_costs(part.phases[0].number):
                plans += plan_part(part, scale * time)
        return plans

    return plan_with_pauses(planning, sequence.phases, plan_parts, sum(times))


def plan_rate_limited(planning: Planning, sequence: ImpactSequence) -> Plans:
    """Plan the parts of a block along curves under rate limits, with pauses between them.

    Torques also change in pauses from those of the previous block, and to those of the next one.
    """
    from .dwell import Junction, add_pause, choose_junction

    epsilon, options, parts = planning.problem.epsilon, planning.options, sequence.split()
    if options.goal is Objective.MARGIN:
        # Its changes may take too long in nearly the least time. Case: the heptagon on four
        # contacts with 300 N m/s in 0.55 s, where 0.526 s is the least.
        with suppress(InfeasibleError, SolverError):
            return plan_margin_at_rest(planning, sequence)
    # Torques between blocks keep the larger epsilon of both. Case: query 41.
    extra = [planning.extra_epsilon.get(len(planning.blocks) + k, 0.0) for k in (-1, 0, 1)]
    first_epsilon, last_epsilon = (epsilon + max(other - extra[1], 0.0) for other in extra[::2])
    previous: Curve | Array | None = None
    if planning.blocks:
        chain, plans_before = planning.blocks[-1].chain, planning.blocks[-1].plans
        # Of the largest margin the last torques may be those of an NLP.
        free_end = chain if options.goal is not Objective.MARGIN else None
        previous = free_end.curves[-1] if free_end else plans_before[-1].end_torques[1]
    following = find_following(planning.problem, sequence.phases)
    next_curve: Curve | Formation | None = following[0].formation if following else None
    if following and runs_along_curves(following, options):
        next_curve = trace_block(planning, following[:1], sequence.curves[-1].end).curves[0]
    firsts = [*(part.curves[0] for part in parts[1:]), next_curve]
    plans: Plans = []
    junction: Junction | None = None
    for part, after in zip(parts, firsts, strict=True):
        number, first, last = part.phases[0].number, part.curves[0], part.curves[-1]
        if previous is not None and junction is None:
            junction = choose_junction(previous, first, first.start, first_epsilon, number)
        ending = None
        if after is not None:
            least = last_epsilon if part is parts[-1] else epsilon
            ending = choose_junction(last, after, last.end, least, part.phases[-1].number + 1)
        pins = junction.start_force if junction else None, ending.end_force if ending else None
        duration = planning.sum_durations(part.phases)
        if duration is not None and junction is not None:
            duration -= junction.change.duration
        task = replace(part.make_task(epsilon, options, duration), pins=pins)
        with assign_costs(number):
            plan: Plans = [*plan_curves(task)]
        if junction is not None:
            plan[0] = add_pause(plan[0], junction.change, first.formation, options)
        plans += plan
        junction, previous = ending, last
    return plans
