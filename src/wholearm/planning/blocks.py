"""Blocks of phases that are planned together, and how they are planned one after the other.

Phases joined smoothly or by impacts are one block. With one freedom they are planned along their
curves, unless they are joined to others with more, and anything else in the time domain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InfeasibleError, InputError, SolverError, name_source
from ..geometry.cost_to_go import CostToGo
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phase
from ..mechanics.metric import measure_speed
from ..problem.definition import Phase, Problem
from ..results.trajectory import Motion
from ..scene.model import Scene
from ..solvers.statistics import charge
from .durations import share_again, share_duration
from .options import Objective, PlanOptions
from .path_domain.impact_sequence import ImpactSequence, make_sequence
from .path_domain.sequence_plan import plan_sequence
from .phase_plan import add_up
from .splitting import leads_on, runs_along_curves, split_blocks
from .stops import Plans, end_of

PLAIN = -1
"""Number of doublings that stands for as many intervals as at first, and no search for modes."""
COARSE = 80
"""Intervals along a curve that refining doubles where none are asked for."""
FINEST = 64
"""Most intervals of a phase in the time domain that refining asks for."""
AMPLE = 1.1
"""Ratio to the least normal force of other phases from which on more decides nothing."""
MOVED = 1e-9
"""Distance from which on a block starts somewhere else, in radii of gyration or radians."""
APART = 1e-6
"""The same, from which on its plans of least duration are others."""
SHORT = 5e-7
"""Largest shortfall of a margin below epsilon by rounding, over the scene's force."""


@dataclass(frozen=True, eq=False)
class BlockPlan:
    """A block as it is planned.

    Attributes
    ----------
    phases : tuple of Phase
    start : ndarray, shape (5,)
        Where it starts.
    finer : int
        How often its intervals are doubled, or `PLAIN`.
    duration : float or None, [s]
        Its longest duration, for the objective `margin`.
    fastest : list of PhasePlan
        Plans of least duration from this start, if they were made for it.
    plans : list of PhasePlan
        One for each of its phases.
    chain : ImpactSequence or None
        Its curves; None if it is planned in the time domain.
    """

    phases: tuple[Phase, ...]
    start: Array
    finer: int
    duration: float | None
    fastest: Plans
    plans: Plans
    chain: ImpactSequence | None

    @property
    def end(self) -> Array:
        """Where the block ends, shape (5,)."""
        if self.chain is not None:
            return self.chain.curves[-1].end
        return end_of(self.plans[-1])[0]

    @property
    def intervals(self) -> int:
        """Most intervals of a phase in the time domain: each is a piece of the torques."""
        return max(len(plan.torque.coefficients) for plan in self.plans)

    @property
    def has_searched(self) -> bool:
        """Whether more than one sequence of contact modes was tried."""
        return any(plan.sequences > 1 for plan in self.plans)

    @property
    def is_finest(self) -> bool:
        """Whether it is planned in the time domain with all the intervals that it may have."""
        return self.chain is None and self.intervals >= FINEST


@dataclass(frozen=True, eq=False)
class Planning:
    """The plans of all phases of a problem.

    Attributes
    ----------
    problem : Problem
    curves : tuple of Curve
        Those of the first phases: as far as geometry alone says where phases end.
    options : PlanOptions
    blocks : tuple of BlockPlan
    shares, allowed : list of float or None, [s]
        The longest duration of each phase, for the objective `margin`: in proportion to plans of
        least duration, and as used, where a block turned out to start from somewhere else.
    least : list of PhasePlan
        Those plans of least duration; empty for other objectives.
    pinned : bool
        Whether blocks end where those plans do.
    ahead : bool
        Whether blocks end with regard to what follows them. Plans that durations are shared out
        by do not, as blocks for the objective `margin` cannot.
    """

    problem: Problem
    curves: tuple[Curve, ...]
    options: PlanOptions
    blocks: tuple[BlockPlan, ...]
    shares: list[float | None]
    allowed: list[float | None]
    least: Plans = field(default_factory=list)
    pinned: bool = False
    ahead: bool = True

    @property
    def plans(self) -> Plans:
        """One for each phase."""
        return [plan for block in self.blocks for plan in block.plans]

    def find_block(self, number: int) -> int:
        """Index of the block with the phase of a number, counted from 1."""
        ends = [block.phases[-1].number for block in self.blocks]
        return next(k for k, end in enumerate(ends) if number <= end)


def plan_blocks(
    problem: Problem,
    curves: tuple[Curve, ...],
    options: PlanOptions,
    report: Callable[[str], None],
) -> Planning:
    """Plan every block of a problem, each from where the one before ends.

    Parameters
    ----------
    problem : Problem
    curves : tuple of Curve
        Those of its first phases, as `trace_phases` finds them.
    options : PlanOptions
    report : callable
        Told in a few words what is being done.

    Raises
    ------
    InputError, InfeasibleError, JammingError, SolverError
        If there is no plan.
    """
    finer, none = [0] * len(split_blocks(problem)), list[float | None]([None] * len(problem.phases))
    planning = Planning(problem, curves, options, (), none, none)
    if options.goal is Objective.MARGIN:
        first = replace(planning, options=_for_time(options), ahead=False)
        least = plan_each(first, finer, report).plans
        planning = replace(planning, shares=share_duration(least, options.duration), least=least)
        try:
            return _require_margin(plan_each(planning, finer, report))
        except (InfeasibleError, InputError, SolverError):
            # From where blocks of the largest margin end the next ones need not go on.
            planning = replace(planning, pinned=True)
    return _require_margin(plan_each(planning, finer, report))


def plan_alone(planning: Planning, report: Callable[[str], None]) -> Planning | None:
    """Plan without regard to what follows a block; None if that has made no difference."""
    problem, options = planning.problem, planning.options
    blocks = split_blocks(problem)
    if not planning.ahead or all(_look_ahead(planning, own, options) is None for own in blocks):
        return None
    alone = replace(planning, blocks=(), ahead=False)
    return _require_margin(plan_each(alone, [0] * len(blocks), report))


def refine_block(
    planning: Planning, index: int, report: Callable[[str], None], plain: bool = False
) -> Planning:
    """Plan one block anew, and those after it that then start elsewhere.

    It has twice the intervals, or if it is to be `plain`, no search for modes.
    """
    finer = [block.finer for block in planning.blocks]
    finer[index] = PLAIN if plain else finer[index] + 1
    return _require_margin(plan_each(planning, finer, report))


def plan_each(planning: Planning, finer: Sequence[int], report: Callable[[str], None]) -> Planning:
    """Plan block after block, but for those that are planned as wanted.

    Where a block starts from somewhere else than in the plans of least duration, the allowed
    durations are shared out again.
    """
    problem, options, least = planning.problem, planning.options, planning.least
    allowed = list(planning.shares)
    blocks: list[BlockPlan] = []
    z = problem.start
    for index, phases in enumerate(split_blocks(problem)):
        known = planning.blocks[index] if planning.blocks else None
        moved = known is None or _distance(problem.scene, known.start, z) > MOVED
        fastest: Plans = [] if moved or known is None else known.fastest
        if moved and least and _starts_off(problem.scene, least[phases[0].index].motion, z):
            fastest = _plan_block(planning, phases, z, _for_time(options), None)[0]
        if fastest:
            share_again(allowed, phases, least, fastest)
        duration = add_up(phases, allowed)
        wanted = finer[index], duration
        if known is None or moved or (known.finer, known.duration) != wanted:
            numbers = "-".join(str(phase.number) for phase in phases)
            report(f"phase {numbers} of {len(problem.phases)}: {options.goal.value}")
            own = _refine(options, known, finer[index])
            to_go = _look_ahead(planning, phases, own) if planning.ahead else None
            with name_source(problem.source):
                quick = fastest or [least[phase.index] for phase in phases if least]
                ample = find_ample(blocks)
                made = _plan_block(planning, phases, z, own, allowed, to_go, ample, quick)
            known = BlockPlan(phases, z, *wanted, fastest, *made)
        blocks.append(known)
        z = known.end
    return replace(planning, blocks=tuple(blocks), allowed=allowed)


def find_ample(blocks: Sequence[BlockPlan]) -> float:
    """Least normal force [N] that decides nothing in a block, as blocks before it keep less."""
    return AMPLE * min((plan.value for block in blocks for plan in block.plans), default=math.inf)


def _refine(options: PlanOptions, known: BlockPlan | None, finer: int) -> PlanOptions:
    """Options for a block whose intervals are doubled `finer` times."""
    if finer == 0:
        return options
    if finer == PLAIN:
        return replace(options, mode_search=False)
    wanted = options.time_intervals
    if known is not None and known.chain is None:
        wanted = min(known.intervals * 2 ** (finer - known.finer), FINEST)
    along = (options.intervals or COARSE) * 2**finer
    return replace(options, intervals=along, time_intervals=wanted)


def _plan_block(
    planning: Planning,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    allowed: Sequence[float | None] | None,
    to_go: CostToGo | None = None,
    ample: float = math.inf,
    fastest: Plans | None = None,
) -> tuple[Plans, ImpactSequence | None]:
    """Plan a block from `z`, along its curves or in the time domain; also its curves."""
    plans: Plans = []
    problem, known = planning.problem, planning.curves
    allowed = [None] * len(problem.phases) if allowed is None else allowed
    if not runs_along_curves(block, options):
        from .time_domain.impacts import plan_with_impacts

        with charge(block[0].number):
            duration = add_up(block, allowed)
            given = (problem, block, z, options, duration, to_go, ample, fastest)
            pinned = planning.pinned or leads_on(problem, block, options)
            plans += plan_with_impacts(*given, pinned=pinned)
        return plans, None
    curves = []
    for phase in block:
        traced, later = phase.index < len(known), problem.phases[phase.index + 1 :]
        curves.append(known[phase.index] if traced else trace_phase(phase, z, later))
        z = curves[-1].end
    chain = make_sequence(block, curves)
    for part in chain.split():
        with charge(part.phases[0].number):
            plans += plan_sequence(part, problem.epsilon, options, add_up(part.phases, allowed))
    return plans, chain


def _look_ahead(
    planning: Planning, block: Sequence[Phase], options: PlanOptions
) -> CostToGo | None:
    """What follows a block in the time domain, if that decides where on a curve it should end."""
    problem = planning.problem
    index = block[-1].index + 1
    if runs_along_curves(block, options) or index == len(problem.phases):
        return None
    phase, ending = problem.phases[index], block[-1]
    until = ending.until.contact
    gained = set(phase.formation.contacts) - set(ending.formation.contacts)
    following = next(own for own in split_blocks(problem) if own[0] is phase)
    if (
        options.goal is Objective.MARGIN
        or until is None
        or gained != {until}
        or not runs_along_curves(following, options)
    ):
        return None

    def value(z: Array) -> float:
        return sum(plan.value for plan in _plan_block(planning, following, z, options, None)[0])

    return CostToGo(phase, value)


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


def _for_time(options: PlanOptions) -> PlanOptions:
    return replace(options, objective=Objective.TIME, duration=None)


def _distance(scene: Scene, one: Array, other: Array) -> float:
    """Distance of two configurations, in radii of gyration or radians."""
    return measure_speed(scene, one - other) / scene.scales.length


def _starts_off(scene: Scene, motion: Motion, z: Array) -> bool:
    """Whether a motion starts somewhere else than at `z`."""
    return _distance(scene, motion.evaluate(np.zeros(1)).z[0], z) > APART
