"""Planning phases in the time domain: guesses, friction, intervals and limits between points.

Phases that pass into one another in motion are one NLP. It starts from the phases' outlines, with
the directions of friction that these have, on few intervals; these are then halved, each time
starting from the solution before. Where the solution would rather slide the other way (a sense of
friction is at its least over a stretch), the stage is split and the NLP solved again. Limits are
looked at between points: intervals that miss them by much are halved, and what is then left is
added to the limits. Where no guess leads to a plan, the motion that misses limits least is found:
it is a better guess, or says why there is no plan.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, InputError, SolverError
from ...geometry.cost_to_go import CostToGo
from ...geometry.curve import describe_pose
from ...geometry.path_guess import find_end
from ...mechanics.dynamics import Directions
from ...mechanics.limits import CONE, PRESS, make_limits
from ...problem.definition import ROWS, Phase, Problem
from ...results.trajectory import Motion
from ...sensitivity.slopes import find_slopes_at
from ..advice import describe_shortfalls, name_phases, rank_shortfalls
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from ..robust.robust_rows import find_edges
from .attempts import FEW, NEAREST, Attempt, Attempts, solve_attempt
from .intersample import CHECKS, MISS, CheckPlaces, IntersampleLimits, check_between, find_misses
from .mode_search import improve
from .search import TimeSearch, TimeSolution
from .stage import Stage
from .stage_modes import LEAST_INTERVALS
from .time_mesh import halve, resample
from .time_motion import StageMotion, TimeMotion, make_motions
from .units import to_si, unit_of

if TYPE_CHECKING:
    from .time_explain import Replan


_ROUNDS = 20  # most solves
_SWINGS = 5  # the first of them, in which limits are raised by what ranges change, and not by more
_OVER = 1.2  # factor on what is missed after that
MOVED = "a plan that chooses where it ends"  # name of the guess
FURTHER = 4  # guesses, beyond the first one, from which such a plan is looked for
PATIENCE = 50  # most iterations of the solver for one step
SHORTEST = 1 / 16  # shortest step of the end, over its whole way
NEARER = (0.3, 0.1)
"""Shares of the way that is left, after which it is asked what motions are short of."""
CONVINCING = 2
"""Motions that miss limits least, from different guesses, after which there seems to be no plan."""
BUDGET = 400  # iterations of the solver after which no further guess is begun: of one block
ROUGH = 1e-2  # least accuracy of plans of which only matters that there are any


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
    to_go             what follows, where the phases leave open where they end
    ample : [N]       least normal force from which on more decides nothing, as other phases keep
                      less anyway
    fastest           plans of least time from `z`, for `margin`: it starts from them, or is them
    pinned            whether it ends there
    begun             what has come of them when they were only begun, from nearly the same `z`
    only_begin        whether to find modes on few intervals alone: limits may be missed between
                      points
    explained         whether to look for a change that would make a plan possible, where there is
                      none
    patient           whether to try further guesses where the first one leads nowhere

    Raises
    ------
    InputError, InfeasibleError, SolverError  if a phase's contacts do not touch, its end cannot be
        reached, or there is no plan
    """
    search = TimeSearch.of(problem, options, duration, to_go, ample, only_begin)
    attempts = Attempts(problem, phases, z, search, to_go, patient)
    known = _go_on(search, attempts, begun[0]) if begun else None
    if known is not None:
        return list_plans(problem, search, phases, known, begun[0].attempt)
    begin = attempts.begin()
    for attempt in begin:
        first, name = _begin(search, attempt, fastest, pinned)
        if first.success:
            break
    # Straight to a pinned end modes may be found that are not the best: phase 3 of query 33.
    enough = first.success and (len(begin) == 1 or bool(fastest))
    moved = ContinuedEnd() if enough else approach(search, problem, phases, z)
    found = [(own, how) for own, how in ((first, name), (moved.solution, MOVED)) if own]
    if any(own.success for own, _ in found):
        best = min((own for own in found if own[0].success), key=lambda own: own[0].cost)
        return list_plans(problem, search, phases, *best)
    return _look_further(search, attempts, problem, phases, first, moved, explained)


def try_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    goal: Array | None = None,
    further: int = 0,
    hurried: bool = False,
) -> list[PhasePlan[TimeMotion]] | None:
    """Begin to plan phases from the first guesses, and from a few further ones if these fail.

    As `plan_phases` with `only_begin`, without a search for contact modes; None where these lead
    nowhere, without looking for reasons.

    Parameters
    ----------
    goal : (5,)  a single phase is first guessed to go straight there; otherwise to its nearest end
    further      how many guesses are looked at beyond
    hurried      whether there is one guess alone, straight to the goal if there is one, for few
                 iterations
    """
    own = replace(options, mode_search=False)
    search = TimeSearch.of(problem, own, None, None, math.inf, True)
    attempts = Attempts(problem, phases, z, search, None, further > 0)
    begin = attempts.begin(goal)[: None if further else 1]
    if hurried:
        begin = [own._replace(most=FEW) for own in begin]
    for attempt in chain(begin, attempts.list_further(further)):
        solution = solve_attempt(search, attempt)
        if solution.success:
            return _list_begun(problem, search, phases, solution, attempt.name, options)
    moved = None if hurried else approach(search, problem, phases, z).solution
    return moved and _list_begun(problem, search, phases, moved, MOVED, options)


def _list_begun(
    problem: Problem,
    search: TimeSearch,
    phases: Sequence[Phase],
    solution: TimeSolution,
    name: str,
    options: PlanOptions,
) -> list[PhasePlan[TimeMotion]]:
    """The plans of phases whose contact modes may yet have to be looked for."""
    first, *others = list_plans(problem, search, phases, solution, name)
    return [first._replace(complete=not options.mode_search), *others]


def _look_further(
    search: TimeSearch,
    attempts: Attempts,
    problem: Problem,
    phases: Sequence[Phase],
    first: TimeSolution,
    moved: ContinuedEnd,
    explained: bool,
) -> list[PhasePlan[TimeMotion]]:
    """Make further attempts where the first one has led nowhere, or say why there is no plan."""
    from .time_explain import refuse

    def replan(other: Problem) -> object:
        own = [other.phases[phase.index] for phase in phases]
        rough = replace(search.options, accuracy=max(search.options.accuracy, ROUGH))
        return plan_phases(other, own, attempts.z, rough, explained=False, patient=False)

    refuse(search, problem, phases, attempts.first.stages, replan if explained else None)
    *_, last = outcomes = _try_all(search, problem, attempts, first)
    if last.solution.success:
        return list_plans(problem, search, phases, last.solution, last.name)
    if not any(own.short for own in outcomes):
        refuse_pinned(search, problem, phases, moved)
    raise explain_lost(search, problem, attempts, outcomes, replan if explained else None)


def _begin(
    search: TimeSearch, first: Attempt, fastest: Sequence[PhasePlan[Motion]], pinned: bool
) -> tuple[TimeSolution, str]:
    """What the first guess leads to, or for a margin plans of least time, and the guess's name."""
    slows = search.goal is Objective.MARGIN
    known = [stage for plan in fastest for stage in plan.stages if isinstance(stage, Stage)]
    if known and slows:
        usual = fastest[0].attempt == first.name
        slowed = _slow_down(search, known, first, usual, pinned)
        if slowed is not None:
            return slowed, fastest[0].attempt
    begun = solve_attempt(search, first)
    if slows and not begun.success:
        quick = solve_attempt(search.aiming(Objective.TIME), first)
        if quick.success:
            begun = _slow_down(search, quick.stages, first, False, pinned) or begun
    return begun, first.name


def _go_on(search: TimeSearch, attempts: Attempts, begun: PhasePlan[Motion]) -> TimeSolution | None:
    """Go on from plans that were only begun, in their modes; None if that leads to nothing."""
    if not isinstance(begun.solution, TimeSolution):
        return None
    own = search
    if begun.complete or begun.sequences > 1:
        search.tried.sequences, search.tried.complete = begun.sequences, begun.complete
        own = replace(search, options=replace(search.options, mode_search=False))
    solution = solve_attempt(own, attempts.resume(begun.solution))
    return solution if solution.success else None


class _Outcome(NamedTuple):
    """What has come of an attempt."""

    name: str
    solution: TimeSolution
    short: list[Stage]  # the motion that misses limits least, if it misses any; empty otherwise


def _try_all(
    search: TimeSearch, problem: Problem, attempts: Attempts, begun: TimeSolution
) -> list[_Outcome]:
    """Make one attempt after the other, until one leads to a plan or there seems to be none.

    Parameters
    ----------
    begun  what the first attempt has led to
    """
    stop = search.tried.iterations + BUDGET
    far, count, outcomes = False, 0, list[_Outcome]()
    for attempt in attempts:
        far = far or (not attempt.gradual and attempts.are_far)
        # What is far from any plan, or like what is short, is first asked what it is short of.
        plain = far or count or attempt is attempts.first
        known = begun if plain and not attempt.gradual else None
        outcomes.append(_try(search, problem, attempt, known))
        count += bool(outcomes[-1].short)
        late = search.tried.iterations > stop
        if outcomes[-1].solution.success or late or count == (1 if far else CONVINCING):
            break
    looked = not begun.is_lost and any(own.name == NEAREST for own in outcomes)
    if not (looked or outcomes[-1].solution.success or any(own.short for own in outcomes)):
        short = find_short(search, problem, attempts.first.stages)[1]
        outcomes.append(_Outcome(NEAREST, begun, short))
    return outcomes


def _try(
    search: TimeSearch, problem: Problem, attempt: Attempt, known: TimeSolution | None
) -> _Outcome:
    """Solve, and for least shortfalls where that leads nowhere: from there, too.

    Parameters
    ----------
    known  what solving leads to, if it is known
    """
    solution = solve_attempt(search, attempt) if known is None else known
    if solution.success or attempt.gradual:
        return _Outcome(attempt.name, solution, [])
    # What coarse intervals are not short of, finer ones may be.
    lost = solution.is_lost
    stages = halve(solution.stages, search.scheme) if lost else attempt.stages
    elastic, short = find_short(search, problem, stages)
    if elastic is not None and not short and not lost:
        solution = solve_attempt(search, attempt._replace(stages=elastic))
        if not solution.success:
            short = find_short(search, problem, halve(elastic, search.scheme))[1]
    return _Outcome(attempt.name, solution, short)


def find_short(
    search: TimeSearch, problem: Problem, stages: list[Stage]
) -> tuple[list[Stage] | None, list[Stage]]:
    """The motion with the least shortfalls, if one is found, and again if it is short at all."""
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
    """Why none of the attempts has led to a plan; `replan` as for `explain`."""
    from .time_explain import explain, refuse_ways

    tried = dict.fromkeys([NEAREST, *(own.name for own in outcomes)])
    reason = (
        "the solver found neither a plan nor a motion that misses limits least, from "
        f"{len(tried)} guess{'es' * (len(tried) > 1)} of the motion"
    )
    short = [own.short for own in outcomes if own.short]
    if not short:
        refuse_ways(problem, attempts.phases[0], attempts.ways)
    return explain(search, problem, attempts.phases, short, reason, replan)


def _slow_down(
    search: TimeSearch, fastest: list[Stage], attempt: Attempt, usual: bool, pinned: bool
) -> TimeSolution | None:
    """Solve for the largest margin from the stages of least time, `pinned` to where these end.

    Before that from the `usual` guess, if that has led to them.

    Those keep epsilon within any duration that is no shorter, and are a plan if nothing better is
    found. None if they take longer.
    """
    lasts, most = sum(stage.guess.duration for stage in fastest), search.duration
    if most is None or lasts > most:
        return None
    whole, first = len({stage.phase for stage in fastest}), attempt.stages
    count = sum(stage.intervals for stage in first) / whole
    coarse = list[Stage]()
    for stage in fastest:
        shares = [own.guess.duration for own in fastest if own.phase == stage.phase]
        own = max(LEAST_INTERVALS, round(count * stage.guess.duration / sum(shares)))
        breaks = np.linspace(0.0, 1.0, own + 1)
        coarse.append(replace(stage, guess=resample(stage.guess, search.scheme, breaks)))
    end = coarse[-1].guess.nodes[-1, 0]
    # What has led to the least time is tried first.
    tries = ((first, False), (coarse, False)) if usual else ((coarse, False), (first, True))
    for stages, gradual in tries:
        given = [*stages[:-1], replace(stages[-1], stop=end if pinned else None)]
        solution = solve_attempt(search, attempt._replace(stages=given, gradual=gradual))
        if solution.success:
            return solution
    search.tried.complete = False
    nlp = search.build(fastest)
    return TimeSolution(fastest, 0.0, 0.0, solution.status, True, nlp, {})


def list_plans(
    problem: Problem,
    search: TimeSearch,
    phases: Sequence[Phase],
    solution: TimeSolution,
    attempt: str,
) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase; the sequences of modes that were tried count for the first.

    Where there are ranges, one that keeps its limits within them: see `widening`.
    """
    if search.options.ranges and not search.only_begins:
        solution = keep_within(search, solution, phases)
    plans, tried = [], search.tried
    motions = _list_motions(problem, search, phases, solution)
    free = solution.free and _list_motions(problem, search, phases, solution.free)
    for k, (phase, motion) in enumerate(zip(phases, motions, strict=True)):
        value = _measure(problem, search, solution, motion)
        own = [stage for stage in solution.stages if stage.phase == phase.index]
        plan = PhasePlan(motion, motion.torque, value, attempt=attempt, stages=own)
        if free and solution.free:
            plan = plan._replace(unheld=_measure(problem, search, solution.free, free[k]))
        plans.append(plan._replace(error=solution.error))
    plans[0] = plans[0]._replace(sequences=tried.sequences, complete=tried.complete)
    if search.only_begins:
        plans[0] = plans[0]._replace(solution=solution)
    return plans


def _list_motions(
    problem: Problem, search: TimeSearch, phases: Sequence[Phase], solution: TimeSolution
) -> list[TimeMotion]:
    """The motion of each phase, in SI units."""
    solved = [to_si(stage, problem) for stage in solution.stages]
    made = list(zip(make_motions(solved, search.scheme), solved, strict=True))
    return [
        TimeMotion([own for own, stage in made if stage.phase == phase.index]) for phase in phases
    ]


def _measure(
    problem: Problem, search: TimeSearch, solution: TimeSolution, motion: TimeMotion
) -> float:
    """A phase's share of the objective."""
    scales = problem.scene.scales
    if search.goal is Objective.MARGIN:
        return problem.epsilon + unit_of(search.goal, scales) * solution.margin
    if search.goal is Objective.TIME:
        return motion.duration
    weight = search.options.time_weight * scales.torque**2
    return weight * motion.duration + motion.torque.integrate_squares()


class ContinuedEnd(NamedTuple):
    """What moving ends to where they are pinned has led to."""

    # a plan that ends there; None where nothing is pinned, or the place is not reached so
    solution: TimeSolution | None = None
    nearest: TimeSolution | None = (
        None  # otherwise the plan that comes nearest to it, if there is any
    )
    # where each phase ended at first, by its index
    ends: Mapping[int, Array] = MappingProxyType({})
    share: float = 0.0  # how far the nearest plan has moved from there


def approach(
    search: TimeSearch, problem: Problem, phases: Sequence[Phase], z: Array
) -> ContinuedEnd:
    """Plan phases with ends that are left open, then move these to where they are pinned.

    Parameters
    ----------
    search            for the phases as they are
    phases, z : (5,)  planned as one, from `z`
    """
    free = [_set_free(phase) for phase in phases]
    if all(own is phase for own, phase in zip(free, phases, strict=True)):
        return ContinuedEnd()
    every = [_set_free(phase) for phase in problem.phases]
    goal = find_end(phases[0], z) if len(phases) == 1 else None
    begun = _plan_free_end(search, replace(problem, phases=tuple(every)), free, z, goal)
    if begun is None:
        return ContinuedEnd()
    ends = {stage.phase: stage.guess.nodes[-1, 0] for stage in begun.stages}
    solution, reached, step = begun, 0.0, 1.0
    while reached < 1.0:
        share = min(1.0, reached + step)
        stages = [_pin(search, stage, ends[stage.phase], share) for stage in solution.stages]
        moved = search.solve(stages, solution, most=search.wait(PATIENCE))
        if moved.success:
            plain = share == 1.0 or not search.options.mode_search
            solution, reached = moved if plain else improve(search, moved), share
        elif (step := step / 4) < SHORTEST:
            return ContinuedEnd(None, solution, ends, reached)
    if search.only_begins:
        return ContinuedEnd(solution)
    halvings = Attempts(problem, phases, z, search, None, False).first.halvings
    last = solve_attempt(search, Attempt(MOVED, halvings, solution.stages, before=solution))
    return ContinuedEnd(last) if last.success else ContinuedEnd(None, solution, ends, reached)


def refuse_pinned(
    search: TimeSearch, problem: Problem, phases: Sequence[Phase], found: ContinuedEnd
) -> None:
    """Raise an error on what motions are short of whose ends are moved on to where they are pinned.

    Where none is found that ends there, one that ends nearer to it than any plan says why.

    Raises
    ------
    InfeasibleError  with the limits that are missed, and where the motion ends
    """
    from .time_explain import list_shortfalls, solve_elastic

    if found.nearest is None:
        return
    for part in (1.0, *NEARER):
        share = found.share + part * (1.0 - found.share)
        stages = [_pin(search, own, found.ends[own.phase], share) for own in found.nearest.stages]
        elastic = solve_elastic(search, stages)
        ranked = rank_shortfalls(list_shortfalls(problem, elastic or [], search.scheme))
        if ranked and elastic:
            lasts = (to_si(own[-1], problem) for own in (found.nearest.stages, elastic))
            ends = [describe_pose(own.guess.nodes[-1, 0]) for own in lasts]
            text = name_phases([phase.number for phase in phases], "infeasible")
            raise InfeasibleError(
                f"{text}: a plan ends at {ends[0]} at the nearest, and at {ends[1]} "
                f"{describe_shortfalls(ranked)}",
                ranked,
            )


def _plan_free_end(
    search: TimeSearch, free: Problem, phases: Sequence[Phase], z: Array, goal: Array | None
) -> TimeSolution | None:
    """A plan on few intervals that chooses where it ends."""
    own = replace(
        search,
        problem=TimeSearch.of(free, search.options).problem,
        only_begins=True,
        to_go=None,
        price=None,
    )
    attempts = Attempts(free, phases, z, own, None, True)
    try:
        for attempt in chain(attempts.begin(goal), attempts.list_further(FURTHER)):
            solution = solve_attempt(own, attempt)
            if solution.success:
                return solution
    except InputError:
        pass  # An end that is left open may be out of reach from the outlines.
    return None


def _set_free(phase: Phase) -> Phase:
    """The phase with what its contacts leave open, if it has pins that mean anything."""
    if not phase.until.pins or phase.formation.n_constraints >= 4:
        return phase
    return replace(phase, until=replace(phase.until, pins=()))


def _pin(search: TimeSearch, stage: Stage, end: Array, share: float) -> Stage:
    """A stage whose pins are a share of the way from where it ended at first."""
    until = search.problem.phases[stage.phase].until
    if stage.until is None or not until.pins:
        return stage
    pins = tuple(
        (name, value + (1.0 - share) * (float(end[ROWS[name]]) - value))
        for name, value in until.pins
    )
    return replace(stage, until=replace(until, pins=pins))


class _Look(NamedTuple):
    """What ranges change in each interval, over what is much, and what is missed with that."""

    swings: Array
    misses: IntersampleLimits


def keep_within(
    search: TimeSearch, solution: TimeSolution, phases: Sequence[Phase]
) -> TimeSolution:
    """Go on from a plan until its limits hold within the ranges of its options.

    Parameters
    ----------
    solution  accurate, with limits that hold between points

    Raises
    ------
    SolverError  if there is no such plan
    """
    found = _widen(search, solution)
    if not found.success:
        raise SolverError(f"{name_phases([own.number for own in phases])}: {found.status}")
    return found


def _widen(search: TimeSearch, solution: TimeSolution) -> TimeSolution:
    raised = [IntersampleLimits.none(stage) for stage in solution.stages]
    error = solution.error
    for turn in range(_ROUNDS):
        motions = make_motions(solution.stages, search.scheme)
        pairs = zip(solution.stages, motions, strict=True)
        looks = [_look(search, solution, *pair) for pair in pairs]
        if turn and max(own.misses.worst for own in looks) <= 1:
            return solution._replace(error=error)
        if turn < _SWINGS:
            raised = [
                old._replace(held=own.swings, gap=old.gap + own.misses.gap)
                for old, own in zip(raised, looks, strict=True)
            ]
        else:
            pairs_of = zip(raised, looks, strict=True)
            raised = [
                IntersampleLimits(*(a + _OVER * b for a, b in zip(old, own.misses, strict=True)))
                for old, own in pairs_of
            ]
        given = solution.nlp, solution.stages, raised, solution.multipliers, solution.margin
        solution = search.run(*given)
        if not solution.success:
            text = f"limits cannot be kept within the ranges: {solution.status}"
            return solution._replace(status=text)
    text = f"limits are still missed within the ranges after {_ROUNDS} solves"
    return solution._replace(status=text, success=False)


def _look(search: TimeSearch, solution: TimeSolution, stage: Stage, motion: StageMotion) -> _Look:
    epsilon, check = search.problem.epsilon, check_between(stage, motion)
    swings = find_swings_at(stage, check, epsilon, search.options.ranges)
    misses = find_misses(stage, check, epsilon, solution.margin, swings)
    table = swings.reshape(stage.intervals, CHECKS, -1).max(axis=1)
    return _Look(np.where(table > MISS, table, 0.0), misses)


def find_swings_at(
    stage: Stage, check: CheckPlaces, epsilon: float, ranges: Mapping[str, float]
) -> Array:
    """What all ranges together change of each side of the limits, over what is much, (n, n_sides).

    Parameters
    ----------
    epsilon : [N]
    """
    formation, count = stage.formation, len(check.places)
    names = [name for name, radius in ranges.items() if radius > 0 and name != "delay"]
    limits = make_limits(formation, epsilon)
    own = limits.of(PRESS, CONE)
    rows = limits.rows[own][:, : formation.n_constraints]
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
        total[:, own] += ranges[name] * np.abs(change)
    sides = limits.sides[0]
    return np.asarray(total[:, sides] / limits.scales[sides])
