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
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import InfeasibleError, SolverError
from ...geometry.cost_to_go import CostToGo
from ...problem.definition import Phase, Problem
from ...results.trajectory import Motion
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from .attempts import FEW, NEAREST, Attempt, Attempts, solve_attempt
from .mesh import resample
from .modes import LEAST_INTERVALS
from .motion import TimeMotion
from .phase_plans import list_plans
from .pinning import MOVED, Approach, approach, refuse_pinned
from .refinement import halve
from .search import Search, Solution
from .stage import Stage

if TYPE_CHECKING:
    from .explain import Replan

CONVINCING = 2
"""Motions that miss limits least, from different guesses, after which there seems to be no plan."""
BUDGET = 400
"""Iterations of the solver after which no further guess is begun: of one block."""
ROUGH = 1e-2
"""Least accuracy of plans of which only matters that there are any."""


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
    problem, options : Problem, PlanOptions
    phases, z : sequence of Phase, ndarray of shape (5,)
        All but the last phase end in motion.
    duration : float, optional, [s]
        Longest duration of all these phases, for `margin`.
    to_go : CostToGo, optional
        What follows, where the phases leave open where they end.
    ample : float, [N]
        Least normal force from which on more decides nothing, as other phases keep less anyway.
    fastest : sequence of PhasePlan
        Plans of least time from `z`, for `margin`: it starts from them, or is them.
    pinned : bool
        Whether it ends there.
    begun : sequence of PhasePlan
        What has come of them when they were only begun, from nearly the same `z`.
    only_begin : bool
        Whether to find modes on few intervals alone: limits may be missed between points.
    explained : bool
        Whether to look for a change that would make a plan possible, where there is none.
    patient : bool
        Whether to try further guesses where the first one leads nowhere.

    Raises
    ------
    InputError, InfeasibleError, SolverError
        If a phase's contacts do not touch, its end cannot be reached, or there is no plan.
    """
    search = Search.of(problem, options, duration, to_go, ample, only_begin)
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
    moved = Approach() if enough else approach(search, problem, phases, z)
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
    goal : ndarray, shape (5,), optional
        A single phase is first guessed to go straight there; otherwise to its nearest end.
    further : int
        How many guesses are looked at beyond.
    hurried : bool
        Whether there is one guess alone, straight to the goal if there is one, for few iterations.
    """
    own = replace(options, mode_search=False)
    search = Search.of(problem, own, None, None, math.inf, True)
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
    search: Search,
    phases: Sequence[Phase],
    solution: Solution,
    name: str,
    options: PlanOptions,
) -> list[PhasePlan[TimeMotion]]:
    """The plans of phases whose contact modes may yet have to be looked for."""
    first, *others = list_plans(problem, search, phases, solution, name)
    return [first._replace(complete=not options.mode_search), *others]


def _look_further(
    search: Search,
    attempts: Attempts,
    problem: Problem,
    phases: Sequence[Phase],
    first: Solution,
    moved: Approach,
    explained: bool,
) -> list[PhasePlan[TimeMotion]]:
    """Make further attempts where the first one has led nowhere, or say why there is no plan."""
    from .explain import refuse

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
    search: Search, first: Attempt, fastest: Sequence[PhasePlan[Motion]], pinned: bool
) -> tuple[Solution, str]:
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


def _go_on(search: Search, attempts: Attempts, begun: PhasePlan[Motion]) -> Solution | None:
    """Go on from plans that were only begun, in their modes; None if that leads to nothing."""
    if not isinstance(begun.solution, Solution):
        return None
    own = search
    if begun.complete or begun.sequences > 1:
        search.tried.sequences, search.tried.complete = begun.sequences, begun.complete
        own = replace(search, options=replace(search.options, mode_search=False))
    solution = solve_attempt(own, attempts.resume(begun.solution))
    return solution if solution.success else None


class _Outcome(NamedTuple):
    """What has come of an attempt.

    Attributes
    ----------
    name : str
    solution : Solution
    short : list of Stage
        The motion that misses limits least, if it misses any; empty otherwise.
    """

    name: str
    solution: Solution
    short: list[Stage]


def _try_all(
    search: Search, problem: Problem, attempts: Attempts, begun: Solution
) -> list[_Outcome]:
    """Make one attempt after the other, until one leads to a plan or there seems to be none.

    Parameters
    ----------
    begun : Solution
        What the first attempt has led to.
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


def _try(search: Search, problem: Problem, attempt: Attempt, known: Solution | None) -> _Outcome:
    """Solve, and for least shortfalls where that leads nowhere: from there, too.

    Parameters
    ----------
    known : Solution or None
        What solving leads to, if it is known.
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
    search: Search, problem: Problem, stages: list[Stage]
) -> tuple[list[Stage] | None, list[Stage]]:
    """The motion with the least shortfalls, if one is found, and again if it is short at all."""
    from .explain import list_shortfalls, solve_elastic

    elastic = solve_elastic(search, stages)
    if elastic is None or not list_shortfalls(problem, elastic, search.scheme):
        return elastic, []
    return elastic, elastic


def explain_lost(
    search: Search,
    problem: Problem,
    attempts: Attempts,
    outcomes: Sequence[_Outcome],
    replan: Replan | None,
) -> InfeasibleError | SolverError:
    """Why none of the attempts has led to a plan; `replan` as for `explain`."""
    from .explain import explain, refuse_ways

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
    search: Search, fastest: list[Stage], attempt: Attempt, usual: bool, pinned: bool
) -> Solution | None:
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
    return Solution(fastest, 0.0, 0.0, solution.status, True, nlp, {})
