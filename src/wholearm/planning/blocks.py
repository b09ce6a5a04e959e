"""Plans of all blocks of a problem, one after the other, in the path or the time domain.

Along curves the velocity at the end of a phase is z_s s'. An impact makes it a multiple of the next
curve's tangent at any speed: v+ = ratio s' z_s. So whether it is possible is known before planning,
and with a parameter that runs `ratio` times as fast on the next curve the speed is continuous: the
curves are planned as one. Otherwise the motion has to stop, and the sequence is split. A smooth end
is passed at speed where the tangents are the same. Under torque rate limits parts are planned one
after the other, with pauses between them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
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
from .lower_bound import look_along
from .nlp import charge
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

LONG = 4.0  # ratio of a longest duration to the least time above which shorter ones are tried
BEND = 1e-6  # largest 1 - cosine between tangents that count as the same


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """A planned block."""

    phases: tuple[Phase, ...]
    start: Array  # (5,)
    plans: Plans  # one for each of its phases
    chain: ImpactSequence | None  # its curves; None in the time domain
    coarse: bool = False  # whether its plans are a guess: they may miss limits between points

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
    curves: tuple[Curve, ...]  # of the first phases, as far as ends follow from geometry alone
    options: PlanOptions
    blocks: tuple[BlockPlan, ...]
    # [s]: longest duration of each phase for the objective `margin`, in proportion to time-optimal
    # plans
    allowed: Sequence[float] = ()
    least: Plans = field(default_factory=list)  # these plans; blocks end where they do
    ahead: bool = True  # whether blocks end by the cost-to-go, which `margin` and `least` do not
    # [N]: by how much c_n of blocks, by their indices, have to exceed epsilon, if at all
    more: dict[int, float] = field(default_factory=dict)

    @property
    def plans(self) -> Plans:
        """One for each phase."""
        return [plan for block in self.blocks for plan in block.plans]

    @cached_property
    def settled(self) -> Plans:
        """The plans with dwells at their ends, where the problem asks for these."""
        if all(self.problem.settles(phase) == 0 for phase in self.problem.phases):
            return self.plans
        from .dwell import settle_plans

        return settle_plans(self.problem, self.plans)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The motion with dwells; of its `meta` only rolling contacts and modes."""
        pairs = zip(self.settled, self.problem.phases, strict=True)
        pieces = ((plan.motion, plan.torque, phase.formation) for plan, phase in pairs)
        return assemble_motions(pieces, self.options.samples)

    def allow(self, phases: Sequence[Phase]) -> float | None:
        """Longest duration of some phases in all [s], for the objective `margin`."""
        return sum(self.allowed[phase.index] for phase in phases) if self.allowed else None


def plan_blocks(
    problem: Problem, curves: tuple[Curve, ...], options: PlanOptions, report: Callable[[str], None]
) -> Planning:
    """Plan every block of a problem, each from where the one before ends; raises without a plan.

    `curves` are those of the first phases (`trace_phases`); `report` is told what is being done.
    """
    with name_source(problem.source):
        require_steps(problem, options)
    planning = Planning(problem, curves, options, ())
    if options.goal is not Objective.MARGIN:
        return plan_each(planning, report)
    from .explain import unadvised

    fast = replace(options, objective=Objective.TIME, duration=None)
    first = replace(planning, options=fast, ahead=False)
    least = plan_each(first, report).plans
    times = [plan.motion.duration for plan in least]
    longest = 2 * sum(times) if options.duration is None else options.duration
    while True:
        allowed = replace(planning, allowed=share_duration(times, longest), least=least)
        # Slower motions than these keep hardly more, and the NLP may not converge. Case: phase 2 of
        # the rolling box in 2 s, which takes 0.45 s at least.
        long = longest > LONG * sum(times)
        try:
            with unadvised() if long else nullcontext():
                return plan_each(allowed, report)
        except (InfeasibleError, SolverError):
            if not long:
                raise
            longest /= 2


def plan_each(planning: Planning, report: Callable[[str], None]) -> Planning:
    """Plan block after block, but for those that are planned and not coarse.

    InfeasibleError if a phase cannot keep epsilon in its share of a longest duration.
    """
    made, count = replace(planning, blocks=()), len(split_blocks(planning.problem))
    for _, block in zip_longest(range(count), planning.blocks):
        made = plan_next(made, block, report)
    epsilon = planning.problem.epsilon
    rounding = 5e-7 * planning.problem.scene.scales.force
    late = planning.options.goal is Objective.MARGIN
    for phase, plan in zip(planning.problem.phases, made.plans, strict=True):
        if late and plan.value < epsilon - rounding:
            raise InfeasibleError(
                f"phase {phase.number}: in its share of the duration, "
                f"{planning.allowed[phase.index]:.5g} s, the largest least c_n is "
                f"{plan.value:.4g} N, below epsilon = {epsilon:g} N; allow a longer duration"
            )
    return made


def plan_next(
    planning: Planning, known: BlockPlan | None, report: Callable[[str], None], coarse: bool = False
) -> Planning:
    """Plan the next block, in the time domain coarsely if asked, unless `known` is its plan.

    A coarse one is the guess.
    """
    problem, options, least = planning.problem, planning.options, planning.least
    phases = split_blocks(problem)[len(planning.blocks)]
    z = planning.blocks[-1].end if planning.blocks else problem.start
    if problem.scene.control_period and planning.blocks and not runs_on_curves(phases):
        z = _replay(planning)
    coarse = coarse and not runs_along_curves(phases, options)
    rounding = 1e-9 * problem.scene.scales.length
    moved = known is not None and measure_speed(problem.scene, known.start - z) > rounding
    if known is None or moved or known.coarse:
        numbers = [phase.number for phase in phases]
        title = f"phase {'-'.join(map(str, numbers))} of {len(problem.phases)}"
        report(f"{title}: {options.goal.value}")
        with name_source(problem.source):
            more = planning.more.get(len(planning.blocks), 0.0)
            pressed = replace(problem, epsilon=problem.epsilon + more) if more else problem
            try:
                made = plan_block(
                    replace(planning, problem=pressed),
                    phases,
                    z,
                    to_go=look_ahead(planning, phases) if planning.ahead else None,
                    ample=1.1 * min((plan.value for plan in planning.plans), default=math.inf),
                    fastest=[least[phase.index] for phase in phases if least],
                    begun=known.plans if known and known.coarse else (),
                    only_begin=coarse,
                )
            except WholearmError as error:
                error.phases = numbers
                raise
        known = BlockPlan(phases, z, *made, coarse)
    return replace(planning, blocks=(*planning.blocks, known))


def _replay(planning: Planning) -> Array:
    """Where the planned blocks end in their replay, shape (5,); as planned if that fails.

    Motions with several freedoms are unstable in open loop. Case: query 9 with periods of 2 ms,
    where 2e-6 rad grow 900 times in phase 20.
    """
    from ..simulation.simulate import simulate

    phases = planning.problem.phases[: len(planning.plans)]
    torque = TorqueProfile.chain([plan.torque for plan in planning.plans])
    replay = simulate(replace(planning.problem, phases=phases), torque)
    return np.asarray(replay.z[-1]) if replay.outcome.reached else planning.blocks[-1].end


def plan_block(
    planning: Planning, block: Sequence[Phase], z: Array, **over_time: Any
) -> tuple[Plans, ImpactSequence | None]:
    """Plan a block from `z`, along its curves or in the time domain; also its curves.

    `over_time` are arguments of `plan_with_impacts`.
    """
    problem, options = planning.problem, planning.options
    if not runs_along_curves(block, options):
        return _plan_over_time(planning, block, z, over_time), None
    chain = trace_block(planning, block, z)
    if problem.scene.has_slow_motors:
        return plan_slowly(planning, chain), chain
    plans: Plans = []
    for part in chain.split():
        with charge(part.phases[0].number):
            longest = planning.allow(part.phases)
            plans += plan_curves(part.make_task(problem.epsilon, options, longest))
    return plans, chain


def trace_block(planning: Planning, block: Sequence[Phase], z: Array) -> ImpactSequence:
    """Curves of a block from `z`, of shape (5,)."""
    stored, curves = planning.curves, list[Curve]()
    for phase in block:
        known, later = phase.index < len(stored), planning.problem.phases[phase.index + 1 :]
        curves.append(stored[phase.index] if known else trace_phase(phase, z, later))
        z = curves[-1].end
    return ImpactSequence(block, curves)


def _plan_over_time(
    planning: Planning, block: Sequence[Phase], z: Array, over_time: dict[str, Any]
) -> Plans:
    """Plans of a block in the time domain, from those with free torques if these are limited.

    Under rate limits in the first modes with free torques, then in those of the search: phases 5
    and 6 of the heptagon have a plan from the former alone, phase 15 of query 28 from the latter.
    """
    from .time_domain.time_plan import plan_with_impacts

    problem, options, failure = planning.problem, planning.options, None
    slow, allowed = problem.scene.has_slow_motors, planning.allow(block)
    # Coarse plans of the edges of routes are of free torques, others of those of the block.
    coarse, begun = over_time.get("only_begin", False), over_time.pop("begun", ())
    of_free, of_block = (begun, ()) if slow and coarse else ((), begun)
    for complete in (False, True) if slow and options.mode_search else (options.mode_search,):
        first = replace(planning, options=replace(options, mode_search=complete))
        free = plan_free(first, block, z, begun=of_free, **over_time)
        plan: Callable[[float | None], Plans] = partial(
            plan_with_impacts, problem, block, z, options, free=free, begun=of_block, **over_time
        )
        with charge(block[0].number):
            try:
                if slow and not coarse:
                    return plan_with_pauses(planning, block, plan, allowed)
                return plan(allowed)
            except (InfeasibleError, SolverError) as error:
                failure = failure or error
    from .explain import explain_motors

    assert failure is not None
    raise explain_motors(problem.scene, block, free, failure) from None


def plan_with_pauses(
    planning: Planning,
    block: Sequence[Phase],
    plan: Callable[[float | None], Plans],
    duration: float | None,
) -> Plans:
    """Plans of a block in the time domain by `plan` for a longest duration [s], with pauses."""
    from .dwell import add_pause

    before, scene = planning.plans[-1:], planning.problem.scene

    def list_changes(plans: Plans) -> list[TorqueChange]:
        """From the torques before each phase to its first ones."""
        lasts = [plan.end_torques[1] for plan in [*before, *plans[:-1]]]
        firsts = [plan.end_torques[0] for plan in plans]
        lasts = lasts if before else [firsts[0], *lasts]
        return [change_torques(scene, *pair) for pair in zip(lasts, firsts, strict=True)]

    plans = plan(duration)
    changes = list_changes(plans)
    pause = sum(change.duration for change in changes)
    if duration is not None and pause:
        plans = plan(duration - pause)
        changes = list_changes(plans)
    return [
        add_pause(plan, change, phase.formation, planning.options)
        for plan, change, phase in zip(plans, changes, block, strict=True)
    ]


def plan_free(planning: Planning, block: Sequence[Phase], z: Array, **over_time: Any) -> Plans:
    """Plans of a block over time as it would be planned with free torques, maybe along its curves.

    None if it is planned so anyway, or asked for over time without a plan along curves.
    """
    problem, options = free_torques(planning.problem, planning.options)
    options = replace(options, transcription="auto")
    phases = [problem.phases[phase.index] for phase in block]
    freed = problem is not planning.problem
    if not (freed or runs_along_curves(phases, options)):
        return []
    over_time |= {"fastest": ()}
    if not planning.problem.scene.control_period:
        # What holding costs is the difference to an accurate plan.
        over_time["only_begin"], options = True, options.roughen()
    try:
        free = replace(planning, problem=problem, options=options, curves=())
        return plan_block(free, phases, z, **over_time)[0]
    except WholearmError as error:
        if not freed:
            return []
        from .explain import explain_motors

        raise explain_motors(planning.problem.scene, block, [], error) from None


def find_following(problem: Problem, block: Sequence[Phase]) -> Sequence[Phase]:
    """The block after another; none after the last one."""
    index = block[-1].index + 1
    return next((other for other in split_blocks(problem) if other[0].index == index), ())


def look_ahead(planning: Planning, block: Sequence[Phase]) -> CostToGo | None:
    """Cost-to-go of a block in the time domain with a free end on a curve.

    Without limits of motors: its gradient is nearly the same, and soon known.
    """
    problem, options = free_torques(planning.problem, planning.options)
    planning = replace(planning, problem=problem, options=options)
    following = find_following(problem, block)
    if runs_along_curves(block, options) or not following:
        return None
    phase, ending = following[0], block[-1]
    gained = set(phase.formation.contacts) - set(ending.formation.contacts)
    lands = gained == {ending.until.contact} and not ending.until.pins
    if options.goal is Objective.MARGIN or not lands or not runs_along_curves(following, options):
        return None
    if options.goal is Objective.TIME and len(following) == 1:
        return estimate_time_to_go(phase, problem.epsilon)

    def value(z: Array) -> float:
        return sum(plan.value for plan in plan_block(planning, following, z)[0])

    return CostToGo(phase, value)


def estimate_time_to_go(phase: Phase, epsilon: float) -> CostToGo:
    """Estimated least time [s] of a phase with one freedom, as a function of where it begins."""
    sequence = partial(ImpactSequence, [phase])
    return CostToGo(phase, lambda z: sequence([trace_phase(phase, z)]).estimate(epsilon))


def require_steps(problem: Problem, options: PlanOptions) -> None:
    """Raise an InputError for combinations with rate-limited or held torques without a planner."""
    settings = [
        (f"{finger.name}.{key}", getattr(finger, key))
        for finger in problem.scene.fingers
        for key, free in (("torque_rate_limit", math.inf), ("actuator_lag", 0.0))
        if getattr(finger, key) != free
    ]
    scene, why = problem.scene, ""
    if options.ranges:
        why = "ranges (--robust) are not kept with it yet"
    elif settings and scene.control_hold == "constant":
        why = f"torques held constant step, and {settings[0][0]} is given; hold them linear"
    if why and scene.control_period:
        raise InputError("", "control_period", f"{scene.control_period:g} given; {why}")
    along = all(runs_along_curves(block, options) for block in split_blocks(problem))
    if settings and options.ranges and not along:
        why = "ranges (--robust) are not kept with it in phases over time yet"
        raise InputError("", settings[0][0], f"{settings[0][1]:g} given; {why}")


def free_torques(problem: Problem, options: PlanOptions) -> tuple[Problem, PlanOptions]:
    """The same with free torques."""
    scene = problem.scene
    if scene.control_period:
        options = replace(options, transcription="auto")
    if scene.has_slow_motors or scene.control_period:
        free = replace(scene.quicken(math.inf), control_period=0.0)
        problem = replace(problem, scene=free)
    return problem, options


@dataclass(frozen=True, eq=False)
class CurveImpact:
    """Impact between two curves for unit speed along the first; none if they join smoothly."""

    phase: Phase  # the one that it ends
    impact: Impact  # velocities per m/s, hence without unit and in rad/m; impulses in N s per m/s
    ratio: float  # speed along the second curve; negative if the motion would turn back

    @property
    def possible(self) -> bool:
        """Whether the motion can go on at speed."""
        return self.impact.possible and self.ratio > 0

    @property
    def reason(self) -> str:
        """Why it cannot, empty if it can."""
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
        """The curves with such speed ratios that the speed is the same on both sides of a join."""
        ratios = np.cumprod([1.0, *(join.ratio for join in self.impacts)])
        pairs = zip(self.curves, ratios.tolist(), strict=True)
        return tuple(curve.with_speed_ratio(ratio) for curve, ratio in pairs)

    def make_task(
        self, epsilon: float, options: PlanOptions, duration: float | None = None
    ) -> Task:
        """Phases that possible impacts join, from rest to rest."""
        numbers = [phase.number for phase in self.phases]
        return Task(self.continuous_curves, epsilon, options, numbers, duration)

    def estimate(self, epsilon: float) -> float:
        """Estimated least time [s], with stops where impacts are not possible."""
        try:
            curves = (part.continuous_curves for part in self.split())
            return sum(look_along(each, epsilon, intervals=24) for each in curves)
        except NoMotionError:
            number = self.phases[0].number
            raise SolverError(f"phase {number}: no motion keeps the limits") from None

    def list_impacts(self, plans: Plans) -> list[Transition]:
        """The impacts, with the speeds that plans of the phases pass them at."""
        impacts = []
        for plan, join in zip(plans, self.impacts, strict=False):
            phase = join.phase
            if phase.end is End.IMPACT:
                speed = measure_speed(phase.formation.scene, end_of(plan)[1] * join.possible)
                impacts.append(make_transition(phase, join.impact, join.ratio, join.reason, speed))
        return impacts


def plan_slowly(planning: Planning, sequence: ImpactSequence) -> Plans:
    """Plan the parts of a block along curves under rate limits, with pauses between them.

    Torques change in pauses from those of the block before, and to those of the next one.
    """
    from .dwell import Junction, add_pause, choose_junction

    epsilon, options, parts = planning.problem.epsilon, planning.options, sequence.split()
    # Torques where blocks meet keep the larger epsilon of both. Case: query 41.
    more = [planning.more.get(len(planning.blocks) + k, 0.0) for k in (-1, 0, 1)]
    first_epsilon, last_epsilon = (epsilon + max(other - more[1], 0.0) for other in more[::2])
    before: Curve | Array | None = None
    if planning.blocks:
        chain, plans_before = planning.blocks[-1].chain, planning.blocks[-1].plans
        before = chain.curves[-1] if chain else plans_before[-1].end_torques[1]
    following = find_following(planning.problem, sequence.phases)
    beyond: Curve | Formation | None = following[0].formation if following else None
    if following and runs_along_curves(following, options):
        beyond = trace_block(planning, following[:1], sequence.curves[-1].end).curves[0]
    firsts = [*(part.curves[0] for part in parts[1:]), beyond]
    plans: Plans = []
    junction: Junction | None = None
    for part, after in zip(parts, firsts, strict=True):
        number, first, last = part.phases[0].number, part.curves[0], part.curves[-1]
        if before is not None and junction is None:
            junction = choose_junction(before, first, first.start, first_epsilon, number)
        coming = None
        if after is not None:
            least = last_epsilon if part is parts[-1] else epsilon
            coming = choose_junction(last, after, last.end, least, part.phases[-1].number + 1)
        pins = junction.begins if junction else None, coming.ends if coming else None
        duration = planning.allow(part.phases)
        if duration is not None and junction is not None:
            duration -= junction.change.duration
        task = replace(part.make_task(epsilon, options, duration), pins=pins)
        with charge(number):
            plan: Plans = [*plan_curves(task)]
        if junction is not None:
            plan[0] = add_pause(plan[0], junction.change, first.formation, options)
        plans += plan
        junction, before = coming, last
    return plans
