"""Plans of phases in the time domain by direct collocation, from a sequence of initial guesses.

Phases joined in motion are one NLP, first solved on few intervals in the sliding directions of the
guess; contact modes and intervals are then refined (`attempts.solve_attempt`). Where no guess leads
to a plan, the elastic problem (least violation of limits) gives a better guess or the reason.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, InputError, SolverError
from ...geometry.arcs import CostToGo
from ...geometry.curve import describe_pose
from ...geometry.path_guess import find_end
from ...mechanics.dynamics import Directions, measure_speed
from ...mechanics.impact import Impact, compute_impact
from ...mechanics.limits import CONE, PRESS, make_limits
from ...problem.definition import ROWS, End, Phase, Problem
from ...results.trajectory import Motion
from ...sensitivity.slopes import find_slopes_at
from ..advice import describe_shortfalls, name_phases, rank_shortfalls
from ..options import Objective, PlanOptions
from ..path_domain.impact_sequence import PER_SPEED, BlockImpact
from ..phase_plan import PhasePlan
from ..robust.robust_rows import find_edges
from ..stops import PlanPart, Plans, end_of, plan_stops
from .attempts import FEW, NEAREST, Attempt, Attempts, solve_attempt
from .intersample import CHECKS, MISS, CheckPlaces, IntersampleLimits, check_between, find_misses
from .mode_search import LEAST_INTERVALS, improve
from .search import TimeSearch, TimeSolution
from .stage import Stage, halve, in_own_units, resample, to_si, unit_of
from .time_motion import TimeMotion, make_motions, make_phase_motions

if TYPE_CHECKING:
    from .time_explain import Replan

_ROUNDS = 20  # most solves for ranges
_PARAMETRIC = 5  # the first of them, in which limits are raised by what ranges change alone
_OVER = 1.2  # factor on the misses by which limits are raised after that
MOVED = "a plan that chooses where it ends"  # name of the guess
FURTHER = 4  # guesses, beyond the first one, for a plan with free end
PATIENCE = 50  # most solver iterations for one continuation step
SHORTEST = 1 / 16  # shortest continuation step
NEARER = (0.3, 0.1)  # shares of the remaining continuation at which violations are looked for
CONVINCING = 2  # infeasible elastic solutions, from different guesses, that end the search
BUDGET = 400  # solver iterations of one block after which no further guess is tried
ROUGH = 1e-2  # least accuracy where only the existence of a plan matters
AT_REST = 1e-4  # speed below which an impact counts as a stop, in the scene's own units


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
    *,
    to_go: CostToGo | None = None,
    ample: float = math.inf,
    fastest: Sequence[PhasePlan[Motion]] = (),
    pinned: bool = False,
    begun: Sequence[PhasePlan[Motion]] = (),
    only_begin: bool = False,
    explained: bool = True,
    patient: bool = True,
) -> list[PhasePlan[TimeMotion]]:
    """Plan phases that are one NLP, from rest at `z` to rest.

    Parameters
    ----------
    phases, z : (5,)  all but the last phase end in motion
    duration : [s]    longest duration of all these phases, for `margin`
    to_go             cost-to-go at a free end
    ample : [N]       saturation of the objective `margin`, as other phases keep less anyway
    fastest           time-optimal plans from `z`, as guess and fallback for `margin`
    pinned            whether the motion ends where these do
    begun             coarse plans (`only_begin`) from nearly the same `z`, to start from
    only_begin        whether to find modes on few intervals alone, without limits between points
    explained         whether to look for a change of the problem that makes a plan possible
    patient           whether to try further guesses after the first

    Raises
    ------
    InputError, InfeasibleError, SolverError  if a phase's contacts do not touch, its end cannot be
        reached, or there is no plan
    """
    from .time_explain import refuse

    search = TimeSearch.of(problem, options, duration, to_go, ample, only_begin)
    attempts = Attempts(problem, phases, z, search, to_go, patient)
    resumed = _resume(search, attempts, begun[0]) if begun else None
    if resumed is not None:
        return list_plans(problem, search, phases, resumed, begun[0].attempt)
    guesses = attempts.begin()
    for attempt in guesses:
        first, name = _solve_first(search, attempt, fastest, pinned)
        if first.success:
            break
    # Straight to a pinned end modes may be found that are not the best: phase 3 of query 33.
    enough = first.success and (len(guesses) == 1 or bool(fastest))
    moved = ContinuedEnd() if enough else approach(search, problem, phases, z)
    plans = [(first, name)] if first.success else []
    plans += [(moved.solution, MOVED)] if moved.solution else []
    if plans:
        solution, name = min(plans, key=lambda pair: pair[0].cost)
        return list_plans(problem, search, phases, solution, name)

    def replan(other: Problem) -> object:
        rough = replace(options, accuracy=max(options.accuracy, ROUGH))
        same = [other.phases[phase.index] for phase in phases]
        return plan_phases(other, same, z, rough, explained=False, patient=False)

    refuse(search, problem, phases, attempts.first.stages, replan if explained else None)
    outcomes = _try_all(search, problem, attempts, first)
    name, solution, _ = outcomes[-1]
    if solution.success:
        return list_plans(problem, search, phases, solution, name)
    if not any(short for *_, short in outcomes):
        refuse_pinned(search, problem, phases, moved)
    raise explain_lost(search, problem, attempts, outcomes, replan if explained else None)


def try_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    goal: Array | None = None,
    further: int = 0,
    single_guess: bool = False,
) -> list[PhasePlan[TimeMotion]] | None:
    """Coarse plans of phases (`only_begin` of `plan_phases`), without a mode search or reasons.

    Parameters
    ----------
    goal : (5,)  end of the first, straight guess of a single phase; otherwise its nearest end
    further      number of further guesses
    single_guess      whether to solve from one guess alone, for few iterations
    """
    search = TimeSearch.of(problem, replace(options, mode_search=False), only_begins=True)
    attempts = Attempts(problem, phases, z, search, None, further > 0)
    guesses = attempts.begin(goal)[: None if further else 1]
    if single_guess:
        # The nearest end is another guess than a straight path that limits exclude.
        guesses = [own._replace(most=FEW) for own in guesses if goal is None or own.name != NEAREST]
    for attempt in chain(guesses, attempts.list_further(further)):
        solution, name = solve_attempt(search, attempt), attempt.name
        if solution.success:
            break
    else:
        moved = None if single_guess else approach(search, problem, phases, z).solution
        if moved is None:
            return None
        solution, name = moved, MOVED
    first, *others = list_plans(problem, search, phases, solution, name)
    return [first._replace(complete=not options.mode_search), *others]


def _solve_first(
    search: TimeSearch, first: Attempt, fastest: Sequence[PhasePlan[Motion]], pinned: bool
) -> tuple[TimeSolution, str]:
    """Solution from the first guess, or for `margin` from time-optimal plans, and its name."""
    slows = search.goal is Objective.MARGIN
    stages = [stage for plan in fastest for stage in plan.stages if isinstance(stage, Stage)]
    if stages and slows:
        usual = fastest[0].attempt == first.name
        slowed = _slow_down(search, stages, first, usual, pinned)
        if slowed is not None:
            return slowed, fastest[0].attempt
    solution = solve_attempt(search, first)
    if slows and not solution.success:
        quick = solve_attempt(search.aiming(Objective.TIME), first)
        if quick.success:
            solution = _slow_down(search, quick.stages, first, False, pinned) or solution
    return solution, first.name


def _resume(
    search: TimeSearch, attempts: Attempts, coarse: PhasePlan[Motion]
) -> TimeSolution | None:
    """Solution from a coarse plan, in its modes; None without success."""
    if not isinstance(coarse.solution, TimeSolution):
        return None
    if coarse.complete or coarse.sequences > 1:
        search.tried.sequences, search.tried.complete = coarse.sequences, coarse.complete
        search = replace(search, options=replace(search.options, mode_search=False))
    solution = solve_attempt(search, attempts.resume(coarse.solution))
    return solution if solution.success else None


_Outcome = tuple[str, TimeSolution, list[Stage]]
"""Result of an attempt: its name, the solution, and the elastic one if that violates limits."""


def _try_all(
    search: TimeSearch, problem: Problem, attempts: Attempts, first: TimeSolution
) -> list[_Outcome]:
    """Solve from one guess after the other until one succeeds or enough are infeasible.

    `first` is the solution from the first guess.
    """
    stop = search.tried.iterations + BUDGET
    far, count, outcomes = False, 0, list[_Outcome]()
    for attempt in attempts:
        far = far or (not attempt.homotopy and attempts.are_far)
        # Far from any plan, or after a violation, the elastic problem is solved at once.
        elastic = far or count or attempt is attempts.first
        solved = first if elastic and not attempt.homotopy else None
        solution, short = _try(search, problem, attempt, solved)
        outcomes.append((attempt.name, solution, short))
        count += bool(short)
        late = search.tried.iterations > stop
        if solution.success or late or count == (1 if far else CONVINCING):
            break
    looked = not first.is_lost and any(name == NEAREST for name, *_ in outcomes)
    if not (looked or count or outcomes[-1][1].success):
        outcomes.append((NEAREST, first, find_short(search, problem, attempts.first.stages)[1]))
    return outcomes


def _try(
    search: TimeSearch, problem: Problem, attempt: Attempt, solved: TimeSolution | None
) -> tuple[TimeSolution, list[Stage]]:
    """Solve, unless `solved`; without success solve the elastic problem, and again from there."""
    solution = solve_attempt(search, attempt) if solved is None else solved
    if solution.success or attempt.homotopy:
        return solution, []
    # Finer intervals may show violations that coarse ones do not.
    lost = solution.is_lost
    stages = halve(solution.stages, search.scheme) if lost else attempt.stages
    elastic, short = find_short(search, problem, stages)
    if elastic is not None and not short and not lost:
        solution = solve_attempt(search, attempt._replace(stages=elastic))
        if not solution.success:
            short = find_short(search, problem, halve(elastic, search.scheme))[1]
    return solution, short


def find_short(
    search: TimeSearch, problem: Problem, stages: list[Stage]
) -> tuple[list[Stage] | None, list[Stage]]:
    """The elastic solution, if there is one, and again if it violates limits."""
    from .time_explain import list_shortfalls, solve_elastic

    elastic = solve_elastic(search, stages)
    if elastic is None or not list_shortfalls(problem, elastic, search.scheme):
        return elastic, []
    return elastic, elastic


def explain_lost(
    search: TimeSearch,
    problem: Problem,
    attempts: Attempts,
    outcomes: Sequence[_Outcome],
    replan: Replan | None,
) -> InfeasibleError | SolverError:
    """Error that says why no attempt has led to a plan; `replan` as for `explain`."""
    from .time_explain import explain, refuse_ways

    count = len({NEAREST, *(name for name, *_ in outcomes)})
    reason = (
        "the solver found neither a plan nor a motion that misses limits least, from "
        f"{count} guess{'es' * (count > 1)} of the motion"
    )
    short = [stages for *_, stages in outcomes if stages]
    if not short:
        refuse_ways(problem, attempts.phases[0], attempts.ways)
    return explain(search, problem, attempts.phases, short, reason, replan)


def _slow_down(
    search: TimeSearch, fastest: list[Stage], attempt: Attempt, usual: bool, pinned: bool
) -> TimeSolution | None:
    """Solve for the largest margin from time-optimal stages, `pinned` to where these end.

    The `usual` guess comes first if it has led to these. They keep epsilon within any duration that
    is no shorter, and are the plan if no better is found. None if they take longer.
    """
    lasts, most = sum(stage.guess.duration for stage in fastest), search.duration
    if most is None or lasts > most:
        return None
    first, coarse = attempt.stages, list[Stage]()
    count = sum(stage.intervals for stage in first) / len({stage.phase for stage in fastest})
    for stage in fastest:
        phase = sum(each.guess.duration for each in fastest if each.phase == stage.phase)
        intervals = max(LEAST_INTERVALS, round(count * stage.guess.duration / phase))
        breaks = np.linspace(0.0, 1.0, intervals + 1)
        coarse.append(replace(stage, guess=resample(stage.guess, search.scheme, breaks)))
    end = coarse[-1].guess.nodes[-1, 0] if pinned else None
    tries = ((first, False), (coarse, False)) if usual else ((coarse, False), (first, True))
    for stages, homotopy in tries:
        stages = [*stages[:-1], replace(stages[-1], stop=end)]
        solution = solve_attempt(search, attempt._replace(stages=stages, homotopy=homotopy))
        if solution.success:
            return solution
    search.tried.complete = False
    return TimeSolution(fastest, 0.0, 0.0, solution.status, True, search.build(fastest), {})


def list_plans(
    problem: Problem,
    search: TimeSearch,
    phases: Sequence[Phase],
    solution: TimeSolution,
    attempt: str,
) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase, with limits within the ranges if there are any (`keep_within`)."""
    if search.options.ranges and not search.only_begins:
        solution = keep_within(search, solution, phases)

    def evaluate(solution: TimeSolution) -> list[tuple[TimeMotion, float]]:
        """Motion and share of the objective of each phase."""
        stages, scales = [to_si(stage, problem) for stage in solution.stages], problem.scene.scales
        motions = make_phase_motions(stages, search.scheme, phases)
        if search.goal is Objective.MARGIN:
            value = problem.epsilon + unit_of(search.goal, scales) * solution.margin
            return [(motion, value) for motion in motions]
        if search.goal is Objective.TIME:
            return [(motion, motion.duration) for motion in motions]
        weight = search.options.time_weight * scales.torque**2
        return [(m, weight * m.duration + m.torque.integrate_squares()) for m in motions]

    free = [value for _, value in evaluate(solution.free)] if solution.free else []
    plans, tried = list[PhasePlan[TimeMotion]](), search.tried
    for k, (phase, (motion, value)) in enumerate(zip(phases, evaluate(solution), strict=True)):
        stages = [stage for stage in solution.stages if stage.phase == phase.index]
        plan = PhasePlan(motion, motion.torque, value, attempt=attempt, stages=stages)
        plans.append(plan._replace(error=solution.error, unheld=free[k] if free else plan.unheld))
    plans[0] = plans[0]._replace(sequences=tried.sequences, complete=tried.complete)
    if search.only_begins:
        plans[0] = plans[0]._replace(solution=solution)
    return plans


class ContinuedEnd(NamedTuple):
    """Result of moving ends to where they are pinned, by continuation."""

    solution: TimeSolution | None = None  # a plan that ends there; None if there is none
    nearest: TimeSolution | None = None  # the plan that comes nearest instead
    ends: Mapping[int, Array] = MappingProxyType({})  # where each phase, by its index, ended free
    share: float = 0.0  # of the continuation from there, that the nearest plan has reached


def approach(
    search: TimeSearch, problem: Problem, phases: Sequence[Phase], z: Array
) -> ContinuedEnd:
    """Plan phases with free ends, then move these to where they are pinned, by continuation.

    `search` is for the phases as they are, which start at `z`, shape (5,).
    """
    free = [_set_free(phase) for phase in phases]
    if all(one is other for one, other in zip(free, phases, strict=True)):
        return ContinuedEnd()
    freed = replace(problem, phases=tuple(_set_free(phase) for phase in problem.phases))
    goal = find_end(phases[0], z) if len(phases) == 1 else None
    solution = _plan_free_end(search, freed, free, z, goal)
    if solution is None:
        return ContinuedEnd()
    ends = {stage.phase: stage.guess.nodes[-1, 0] for stage in solution.stages}
    reached, step = 0.0, 1.0
    while reached < 1.0:
        share = min(1.0, reached + step)
        stages = [_pin(search, stage, ends[stage.phase], share) for stage in solution.stages]
        moved = search.solve(stages, solution, most=search.wait(PATIENCE))
        if moved.success:
            final = share == 1.0 or not search.options.mode_search
            solution, reached = moved if final else improve(search, moved), share
        elif (step := step / 4) < SHORTEST:
            return ContinuedEnd(None, solution, ends, reached)
    if search.only_begins:
        return ContinuedEnd(solution)
    halvings = Attempts(problem, phases, z, search, None, False).first.halvings
    last = solve_attempt(search, Attempt(MOVED, halvings, solution.stages, before=solution))
    return ContinuedEnd(last) if last.success else ContinuedEnd(None, solution, ends, reached)


def refuse_pinned(
    search: TimeSearch, problem: Problem, phases: Sequence[Phase], moved: ContinuedEnd
) -> None:
    """Raise an error with the limits that an elastic motion to the pinned end violates.

    Without one, a motion that ends nearer to it than any plan says why.
    """
    from .time_explain import list_shortfalls, solve_elastic

    if moved.nearest is None:
        return
    for part in (1.0, *NEARER):
        share = moved.share + part * (1.0 - moved.share)
        nearest = moved.nearest.stages
        stages = [_pin(search, stage, moved.ends[stage.phase], share) for stage in nearest]
        elastic = solve_elastic(search, stages)
        ranked = rank_shortfalls(list_shortfalls(problem, elastic or [], search.scheme))
        if ranked and elastic:
            lasts = (to_si(own[-1], problem) for own in (nearest, elastic))
            ends = [describe_pose(last.guess.nodes[-1, 0]) for last in lasts]
            text = name_phases([phase.number for phase in phases], "infeasible")
            raise InfeasibleError(
                f"{text}: a plan ends at {ends[0]} at the nearest, and at {ends[1]} "
                f"{describe_shortfalls(ranked)}",
                ranked,
            )


def _plan_free_end(
    search: TimeSearch, free: Problem, phases: Sequence[Phase], z: Array, goal: Array | None
) -> TimeSolution | None:
    """A coarse plan that chooses where it ends."""
    scaled = in_own_units(free)
    search = replace(search, problem=scaled, only_begins=True, to_go=None, price=None)
    attempts = Attempts(free, phases, z, search, None, True)
    try:
        for attempt in chain(attempts.begin(goal), attempts.list_further(FURTHER)):
            solution = solve_attempt(search, attempt)
            if solution.success:
                return solution
    except InputError:
        pass  # A free end may be out of reach of the initial paths.
    return None


def _set_free(phase: Phase) -> Phase:
    """The phase without pins; unchanged where they have no effect."""
    if not phase.until.pins or phase.formation.n_constraints >= 4:
        return phase
    return replace(phase, until=replace(phase.until, pins=()))


def _pin(search: TimeSearch, stage: Stage, end: Array, share: float) -> Stage:
    """A stage with its pins moved by a share of the continuation from its free `end`."""
    until = search.problem.phases[stage.phase].until
    if stage.until is None or not until.pins:
        return stage
    pins = tuple(
        (name, value + (1.0 - share) * (float(end[ROWS[name]]) - value))
        for name, value in until.pins
    )
    return replace(stage, until=replace(until, pins=pins))


def keep_within(
    search: TimeSearch, solution: TimeSolution, phases: Sequence[Phase]
) -> TimeSolution:
    """Tighten limits until they hold, to first order, within the ranges of the options.

    `solution` is accurate, with limits that hold between points; SolverError without a plan.
    """
    raised = [IntersampleLimits.none(stage) for stage in solution.stages]
    error, epsilon, ranges = solution.error, search.problem.epsilon, search.options.ranges
    where = name_phases([phase.number for phase in phases])
    for iterate in range(_ROUNDS):
        deviations, misses = list[Array](), list[IntersampleLimits]()
        motions = make_motions(solution.stages, search.scheme)
        for stage, motion in zip(solution.stages, motions, strict=True):
            check = check_between(stage, motion)
            deviation = find_deviations(stage, check, epsilon, ranges)
            misses.append(find_misses(stage, check, epsilon, solution.margin, deviation))
            table = deviation.reshape(stage.intervals, CHECKS, -1).max(axis=1)
            deviations.append(np.where(table > MISS, table, 0.0))
        if iterate and max(miss.worst for miss in misses) <= 1:
            return solution._replace(error=error)
        if iterate < _PARAMETRIC:
            raised = [
                old._replace(held=deviation, gap=old.gap + miss.gap)
                for old, deviation, miss in zip(raised, deviations, misses, strict=True)
            ]
        else:
            raised = [
                IntersampleLimits(*(a + _OVER * b for a, b in zip(old, miss, strict=True)))
                for old, miss in zip(raised, misses, strict=True)
            ]
        solution = search.run(
            solution.nlp, solution.stages, raised, solution.multipliers, solution.margin
        )
        if not solution.success:
            text = f"limits cannot be kept within the ranges: {solution.status}"
            raise SolverError(f"{where}: {text}")
    raise SolverError(f"{where}: limits are still missed within the ranges after {_ROUNDS} solves")


def find_deviations(
    stage: Stage, check: CheckPlaces, epsilon: float, ranges: Mapping[str, float]
) -> Array:
    """Change of each side of the limits by all ranges, relative to its scale, (n, n_sides)."""
    formation, count = stage.formation, len(check.places)
    names = [name for name, radius in ranges.items() if radius > 0 and name != "delay"]
    limits = make_limits(formation, epsilon)
    forces = limits.of(PRESS, CONE)
    rows = limits.rows[forces][:, : formation.n_constraints]
    signs = (np.broadcast_to(part, (count, *part.shape)) for part in stage.directions)
    slopes = find_slopes_at(formation, check.samples, Directions(*signs), names)
    c_t = check.samples.c_t[:, list(formation.rolling_rows)]
    c = np.hstack([check.samples.c_n, c_t])
    total = np.zeros((count, len(limits.low)))
    for k, name in enumerate(names):
        change = slopes[:, :, k] @ rows.T
        edges = find_edges(formation, rows, name)
        if edges is not None:
            change = change + c @ edges.T - epsilon * edges.sum(axis=1)
        total[:, forces] += ranges[name] * np.abs(change)
    sides = limits.sides[0]
    return np.asarray(total[:, sides] / limits.scales[sides])


def plan_with_impacts(
    problem: Problem,
    block: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None,
    to_go: CostToGo | None = None,
    ample: float = math.inf,
    fastest: Plans | None = None,
    pinned: bool = False,
    begun: Plans | None = None,
    only_begin: bool = False,
) -> Plans:
    """Plan a block with the impacts that are possible, or else with stops.

    The arguments are those of `plan_phases`; after `ample` they are for blocks without impacts.
    """
    ends = _find_impacts(block)
    if not ends:
        plan = partial(plan_phases, to_go=to_go, ample=ample, pinned=pinned, only_begin=only_begin)
        plan = partial(plan, fastest=fastest or (), begun=begun or ())
        return [*plan(problem, block, z, options, duration)]
    explained = plan_parts_of(problem, block, ample, explained=True)
    if duration is not None and fastest and all(_is_stop(problem, fastest[k - 1]) for k in ends):
        # Without an impact in least time there is none in a longer duration.
        return plan_stops(explained, [0, *ends, len(block)], z, options, duration)
    # A duration that is too short for stops need not be so without them.
    probe = (
        options if duration is None else replace(options, objective=Objective.TIME, duration=None)
    )
    stopped = plan_stops(explained, [0, *ends, len(block)], z, probe)
    blocked = [
        k for k in ends if _impact_at_stop(block[k - 1], block[k], stopped[k - 1]).violations
    ]
    if len(blocked) < len(ends):
        bounds = [0, *blocked, len(block)]
        try:
            return plan_stops(plan_parts_of(problem, block, ample), bounds, z, options, duration)
        except (InfeasibleError, SolverError):
            pass
    if duration is None:
        return stopped
    return plan_stops(explained, [0, *ends, len(block)], z, options, duration)


def plan_parts_of(
    problem: Problem, block: Sequence[Phase], ample: float = math.inf, explained: bool = False
) -> PlanPart:
    """Planner of parts of a block: from all guesses with reasons (`explained`) or the first one."""

    def plan_part(
        start: int, stop: int, z: Array, options: PlanOptions, duration: float | None
    ) -> Plans:
        plan = partial(plan_phases, ample=ample, explained=explained, patient=explained)
        return [*plan(problem, block[start:stop], z, options, duration)]

    return plan_part


def list_impacts(block: Sequence[Phase], plans: Sequence[PhasePlan[Motion]]) -> list[BlockImpact]:
    """The impacts of a block, at speed or with a stop."""
    found = []
    for k in _find_impacts(block):
        (z, v), scene, reason = end_of(plans[k - 1]), block[0].formation.scene, ""
        speed = measure_speed(scene, v)
        if speed < AT_REST * scene.scales.speed:
            speed, impact = 0.0, _impact_at_stop(block[k - 1], block[k], plans[k - 1])
            reason = "no plan passes it at speed"
            if impact.violations:
                reason = impact.violations[0].describe(PER_SPEED)
        else:
            impact = compute_impact(block[k - 1].formation, block[k].formation, z, v / speed)
        ratio = measure_speed(scene, impact.v)
        found.append(BlockImpact(k - 1, impact, ratio, reason, speed))
    return found


def _is_stop(problem: Problem, plan: PhasePlan[Motion]) -> bool:
    """Whether a plan ends at rest."""
    speed = measure_speed(problem.scene, end_of(plan)[1])
    return speed < AT_REST * problem.scene.scales.speed


def _find_impacts(block: Sequence[Phase]) -> list[int]:
    """Indices in the block of the phases after impacts."""
    return [k + 1 for k, phase in enumerate(block) if phase.end is End.IMPACT]


def _impact_at_stop(phase: Phase, following: Phase, plan: PhasePlan[Motion]) -> Impact:
    """The impact for unit speed in the direction in which a phase comes to its stop."""
    v = plan.motion.evaluate(np.array([plan.motion.duration * (1 - 1e-3)])).z_dot[0]
    v = v / measure_speed(phase.formation.scene, v)
    return compute_impact(phase.formation, following.formation, end_of(plan)[0], v)
