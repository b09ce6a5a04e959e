"""Plans of all blocks of a problem, one after the other, in the path or the time domain.

Phases joined smoothly or by impacts are one block. Blocks of phases with one degree of freedom are
planned along their curves, all others in the time domain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from ..common.arrays import Array
from ..common.errors import (
    Change,
    InfeasibleError,
    InputError,
    Parameter,
    SolverError,
    WholearmError,
    name_source,
)
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import measure_speed
from ..mechanics.speed_sweep import NoMotionError
from ..problem.definition import Phase, Problem
from ..results.trajectory import Motion
from .lower_bound import look_along
from .nlp import charge
from .options import Objective, PlanOptions
from .path_domain.impact_sequence import ImpactSequence, make_sequence, plan_sequence, plan_slowly
from .path_domain.path_motion import PathMotion
from .phase_plan import PhasePlan, Plans, Settled, add_up, end_of, runs_along_curves, split_blocks

if TYPE_CHECKING:
    from ..geometry.arcs import CostToGo

PLAIN = -1  # refinement level: first number of intervals, no search for modes
BEGUN = -2  # refinement level: coarse plans, which may miss limits between points
FINEST = 64  # most intervals of a phase in the time domain after refinement
SKETCH = 24  # intervals of the speed sweep for a least time-to-go
CLEAR = 0.05  # relative violation above which no better plan of earlier phases helps
COARSE = 80  # intervals along a curve that are doubled where none are given
AMPLE = 1.1  # saturation of the margin, over the least normal force of other phases
MOVED = 1e-9  # distance of two starts, in radii of gyration or radians
FREE = {"torque_rate_limit": None, "actuator_lag": None, "control_period": None}  # free torques
SHORT = 5e-7  # largest shortfall of a margin below epsilon by rounding, over the scene's force


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """A planned block."""

    phases: tuple[Phase, ...]
    start: Array  # (5,)
    finer: int  # refinement level: doublings of its intervals, or `PLAIN` or `BEGUN`
    plans: Plans  # one for each of its phases
    chain: ImpactSequence | None  # its curves; None in the time domain

    @property
    def end(self) -> Array:
        """Where the block ends, shape (5,)."""
        if self.chain is not None:
            return self.chain.curves[-1].end
        return end_of(self.plans[-1])[0]

    @property
    def intervals(self) -> int:
        """Most intervals of a phase in the time domain."""
        return max(len(plan.torque.coefficients) for plan in self.plans)


@dataclass(frozen=True, eq=False)
class Planning:
    """The plans of all phases of a problem."""

    problem: Problem
    curves: tuple[Curve, ...]  # of the first phases, as far as ends follow from geometry alone
    options: PlanOptions
    blocks: tuple[BlockPlan, ...]
    # [s]: longest duration of each phase for the objective `margin`, in proportion to time-optimal
    # plans
    allowed: list[float | None]
    least: Plans = field(default_factory=list)  # these plans; blocks end where they do
    ahead: bool = True  # whether blocks end by the cost-to-go, which `margin` and `least` do not
    sketches: bool = False  # whether least times-to-go are those of a speed sweep
    # [N]: by how much c_n of blocks, by their indices, have to exceed epsilon, if at all
    more: dict[int, float] = field(default_factory=dict)

    @property
    def plans(self) -> Plans:
        """One for each phase."""
        return [plan for block in self.blocks for plan in block.plans]

    @cached_property
    def settled(self) -> Settled:
        """The plans with dwells at their ends, where the problem asks for these."""
        plans, phases = self.plans, self.problem.phases
        if not self.problem.is_settled:
            return Settled(plans, (None,) * len(phases))
        from .dwell import settle_plans

        return settle_plans(self.problem, plans)

    def find_block(self, number: int) -> int:
        """Index of the block with the phase of a number, counted from 1."""
        ends = [block.phases[-1].number for block in self.blocks]
        return next(k for k, end in enumerate(ends) if number <= end)

    def find_before(self, phases: Sequence[Phase]) -> BlockPlan | None:
        """The planned block that ends where some phases begin."""
        index = phases[0].index
        return next((own for own in self.blocks if own.phases[-1].index + 1 == index), None)


def plan_blocks(
    problem: Problem, curves: tuple[Curve, ...], options: PlanOptions, report: Callable[[str], None]
) -> Planning:
    """Plan every block of a problem, each from where the one before ends; raises without a plan.

    `curves` are those of the first phases (`trace_phases`); `report` is told what is being done.
    """
    with name_source(problem.source):
        require_steps(problem, options)
    finer, none = [0] * len(split_blocks(problem)), list[float | None]([None] * len(problem.phases))
    planning = Planning(problem, curves, options, (), none)
    if options.goal is Objective.MARGIN:
        first = replace(
            planning, options=replace(options, objective=Objective.TIME, duration=None), ahead=False
        )
        least = plan_each(_begin_each(first, report), finer, report).plans
        planning = replace(planning, allowed=share_duration(least, options.duration), least=least)
        return plan_each(planning, finer, report)
    return plan_each(_begin_each(planning, report), finer, report)


def plan_each(planning: Planning, finer: Sequence[int], report: Callable[[str], None]) -> Planning:
    """Plan block after block at its refinement level, but for those that are planned so."""
    made = replace(planning, blocks=())
    for level, block in zip_longest(finer, planning.blocks):
        made = plan_next(made, level, block, report)
    return _require_margin(made)


def _begin_each(planning: Planning, report: Callable[[str], None]) -> Planning:
    """Coarse plans of the blocks as far as they exist, if one in the time domain is followed.

    An error is raised only if it does not depend on where exactly the block before ends.
    """
    blocks, begun = split_blocks(planning.problem), planning
    over_time = [not runs_along_curves(own, planning.options) for own in blocks]
    if not any(over_time[:-1]):
        return planning
    for index in range(len(blocks)):
        try:
            begun = plan_next(begun, BEGUN, None, report)
        except WholearmError as error:
            short = error.shortfalls if isinstance(error, InfeasibleError) else ()
            if not any(over_time[:index]) or any(own.share > CLEAR for own in short):
                raise
            break
    return begun


def plan_next(
    planning: Planning, finer: int, known: BlockPlan | None, report: Callable[[str], None]
) -> Planning:
    """Plan the next block at a refinement level, unless `known` is that.

    A coarse one (`BEGUN`) is the guess.
    """
    problem, options, least = planning.problem, planning.options, planning.least
    phases = split_blocks(problem)[len(planning.blocks)]
    z = planning.blocks[-1].end if planning.blocks else problem.start
    if finer == BEGUN and runs_along_curves(phases, options):
        finer = 0
    least_move = MOVED * problem.scene.scales.length
    moved = known is not None and measure_speed(problem.scene, known.start - z) > least_move
    if known is None or moved or known.finer != finer:
        numbers = "-".join(str(phase.number) for phase in phases)
        report(f"phase {numbers} of {len(problem.phases)}: {options.goal.value}")
        own = _refine(options, known, finer)
        with name_source(problem.source):
            more = planning.more.get(len(planning.blocks), 0.0)
            pressed = replace(problem, epsilon=problem.epsilon + more) if more else problem
            made = plan_block(
                replace(planning, problem=pressed),
                phases,
                z,
                own,
                to_go=look_ahead(planning, phases, own) if planning.ahead else None,
                ample=AMPLE * min((plan.value for plan in planning.plans), default=math.inf),
                fastest=[least[phase.index] for phase in phases if least],
                begun=known.plans if known and known.finer == BEGUN else (),
                only_begin=finer == BEGUN,
            )
        known = BlockPlan(phases, z, finer, *made)
    return replace(planning, blocks=(*planning.blocks, known))


def _refine(options: PlanOptions, known: BlockPlan | None, finer: int) -> PlanOptions:
    """Options for a block at a refinement level."""
    if finer in (0, BEGUN):
        return options
    if finer == PLAIN:
        return replace(options, mode_search=False)
    wanted = options.time_intervals
    if known is not None and known.chain is None:
        doublings = 0 if known.finer == BEGUN else finer - known.finer
        wanted = min(known.intervals * 2**doublings, FINEST)
    along = (options.intervals or COARSE) * 2**finer
    return replace(options, intervals=along, time_intervals=wanted)


def plan_block(
    planning: Planning,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    **over_time: Any,
) -> tuple[Plans, ImpactSequence | None]:
    """Plan a block from `z`, along its curves or in the time domain; also its curves.

    `over_time` are arguments of `plan_with_impacts`.
    """
    plans: Plans = []
    problem, known, allowed = planning.problem, planning.curves, planning.allowed
    if not runs_along_curves(block, options):
        from .time_domain.time_plan import plan_with_impacts

        along = partial(plan_along, planning, block, z, options)

        def plan(duration: float | None) -> Plans:
            pinned = block[-1].index + 1 < len(problem.phases)
            return plan_with_impacts(
                problem, block, z, options, duration, pinned=pinned, along=along, **over_time
            )

        def plan_other(other: Planning, phases: Sequence[Phase], own: PlanOptions) -> Plans:
            return plan_block(other, phases, z, own)[0]

        with charge(block[0].number):
            try:
                if problem.scene.has_slow_motors:
                    from .path_domain.junction import plan_with_pauses

                    return plan_with_pauses(planning, block, plan, add_up(block, allowed)), None
                return plan(add_up(block, allowed)), None
            except (InfeasibleError, SolverError) as error:
                from .explain import explain_motors

                raise explain_motors(planning, block, options, error, plan_other) from None
    curves = []
    for phase in block:
        traced, later = phase.index < len(known), problem.phases[phase.index + 1 :]
        curves.append(known[phase.index] if traced else trace_phase(phase, z, later))
        z = curves[-1].end
    chain = make_sequence(block, curves)
    parts = chain.split()
    if problem.scene.has_slow_motors:
        from .path_domain.junction import find_beside

        beside = find_beside(planning, block, chain.curves[-1].end, options)
        longest = [add_up(part.phases, allowed) for part in parts]
        return plan_slowly(parts, beside, problem.epsilon, options, longest), chain
    for part in parts:
        with charge(part.phases[0].number):
            plans += plan_sequence(part, problem.epsilon, options, add_up(part.phases, allowed))
    return plans, chain


def plan_along(
    planning: Planning,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
) -> list[PathMotion]:
    """Motions of a block along its curves with free torques, if it has some: an initial guess."""
    problem, own = free_torques(planning.problem, replace(options, transcription="auto"))
    phases = [problem.phases[phase.index] for phase in block]
    if not runs_along_curves(phases, own):
        return []
    try:
        free = replace(planning, problem=problem, curves=())
        plans, _ = plan_block(free, phases, z, own.roughen())
    except WholearmError:
        return []
    return [plan.motion for plan in plans if isinstance(plan.motion, PathMotion)]


def _require_margin(planning: Planning) -> Planning:
    """The planning, or an error for a phase that cannot keep epsilon in its duration."""
    if planning.options.goal is not Objective.MARGIN:
        return planning
    epsilon = planning.problem.epsilon
    for phase, plan in zip(planning.problem.phases, planning.plans, strict=True):
        if plan.value < epsilon - SHORT * planning.problem.scene.scales.force:
            raise InfeasibleError(
                f"phase {phase.number}: in its share of the duration, "
                f"{planning.allowed[phase.index]:.5g} s, the largest least c_n is "
                f"{plan.value:.4g} N, below epsilon = {epsilon:g} N; allow a longer duration"
            )
    return planning


def look_ahead(
    planning: Planning,
    block: Sequence[Phase],
    options: PlanOptions,
) -> CostToGo | None:
    """Cost-to-go of a block in the time domain with a free end on a curve.

    Without limits of motors: its gradient is nearly the same, and soon known.
    """
    problem, options = free_torques(planning.problem, options)
    planning, index = replace(planning, problem=problem), block[-1].index + 1
    if runs_along_curves(block, options) or index == len(problem.phases):
        return None
    phase, ending = problem.phases[index], block[-1]
    until = ending.until.contact
    gained = set(phase.formation.contacts) - set(ending.formation.contacts)
    following = next(own for own in split_blocks(problem) if own[0] is phase)
    if (
        options.goal is Objective.MARGIN
        or until is None
        or ending.until.pins
        or gained != {until}
        or not runs_along_curves(following, options)
    ):
        return None

    def value(z: Array) -> float:
        if planning.sketches and options.goal is Objective.TIME:
            try:
                return look_along((trace_phase(phase, z),), problem.epsilon, SKETCH)
            except NoMotionError:
                text = f"phase {phase.number}: no motion keeps the limits"
                raise SolverError(text) from None
        return sum(plan.value for plan in plan_block(planning, following, z, options)[0])

    from ..geometry.arcs import CostToGo

    return CostToGo(phase, value)


def share_duration(
    least: Sequence[PhasePlan[Motion]], duration: float | None
) -> list[float | None]:
    """Longest duration of each phase [s], in proportion to the least times."""
    times = [plan.motion.duration for plan in least]
    total = 2 * sum(times) if duration is None else duration
    if total <= sum(times):
        # The least-time plan shows it; a little more leaves something to choose.
        from .explain import describe_changes, round_outwards

        own = Parameter("duration", total, "s", 1, "duration")
        enough = Change(own, round_outwards(1.005 * sum(times), 1))
        raise InfeasibleError(
            f"duration = {total:g} s is not longer than the least time, {sum(times):.6g} s; "
            f"{describe_changes([enough])}",
            changes=[enough],
        )
    return [total / sum(times) * own for own in times]


def require_steps(problem: Problem, options: PlanOptions) -> None:
    """Raise an InputError for combinations with rate-limited or held torques without a planner."""
    given = [
        (f"{finger.name}.{key}", getattr(finger, key))
        for finger in problem.scene.fingers
        for key, free in (("torque_rate_limit", math.inf), ("actuator_lag", 0.0))
        if getattr(finger, key) != free
    ]
    scene, why = problem.scene, ""
    if scene.control_period:
        if options.ranges:
            why = "ranges (--robust) are not kept with it yet"
        elif given and scene.control_hold == "constant":
            why = f"torques held constant step, and {given[0][0]} is given; hold them linear"
        if why:
            raise InputError("", "control_period", f"{scene.control_period:g} given; {why}")
    along = all(runs_along_curves(block, options) for block in split_blocks(problem))
    if given and options.ranges and not along:
        why = "ranges (--robust) are not kept with it in phases over time yet"
        raise InputError("", given[0][0], f"{given[0][1]:g} given; {why}")


def free_torques(problem: Problem, options: PlanOptions) -> tuple[Problem, PlanOptions]:
    """The same with free torques."""
    scene = problem.scene
    if scene.control_period:
        options = replace(options, transcription="auto")
    if scene.has_slow_motors or scene.control_period:
        problem = problem.with_(FREE)
    return problem, options
