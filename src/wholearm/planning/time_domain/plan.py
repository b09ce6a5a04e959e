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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...geometry.cost_to_go import CostToGo
from ...problem.definition import Phase, Problem
from ..options import Objective, PlanOptions
from ..phase_plan import PhasePlan
from .ending import choose_end, keep_apart
from .mode_search import adapt, improve
from .motion import TimeMotion, make_motions
from .own_units import to_si, unit_of
from .refinement import bisect_intervals
from .search import Search, Solution
from .stage import Stage
from .staging import guess_stages
from .way_guess import PacedWay, list_ways

FIRST = 10
"""Most intervals of a phase to start with."""
CONVINCING = 2
"""Motions that miss limits least, from different guesses, after which there seems to be no plan."""
BUDGET = 300
"""Iterations of the solver after which no further guess is begun: of one block."""
ATTEMPT = 100
"""Most iterations of the first run of the solver from a guess."""
NEAREST = "the nearest end"
"""Name of the first guess."""
NEAR = -0.3
"""Margin of a way from which on a motion beside it may keep its limits."""
WAYS = 3
"""Most ways along which a motion is guessed."""
_EXACT = 3
"""Points of an interval beyond which collocation is so exact that intervals would stay as they are,
too long for torques that are linear in each."""
_PACES = (2.0, 4.0, 1.0)
"""Guessed durations to try, in units of that of a fall."""


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
    *,
    to_go: CostToGo | None = None,
    explained: bool = True,
    patient: bool = True,
) -> list[PhasePlan[TimeMotion]]:
    """Plan phases that are one NLP, from rest at `z` to rest.

    Parameters
    ----------
    problem : Problem
    phases : sequence of Phase
        All but the last one end in motion.
    z : ndarray, shape (5,)
    options : PlanOptions
    duration : float, optional, [s]
        Longest duration of all these phases, for the objective `margin`.
    to_go : CostToGo, optional
        What follows, where the phases leave open where they end.
    explained : bool
        Whether to look for a change that would make a plan possible, where there is none.
    patient : bool
        Whether to try further guesses where the first one leads nowhere.

    Raises
    ------
    InputError
        If a phase's contacts do not touch or its end cannot be reached.
    InfeasibleError, SolverError
        If there is no plan.
    """
    search = Search.of(problem, options, duration, to_go)
    wanted = options.time_intervals or _choose_intervals(phases)
    halvings = max(0, math.ceil(math.log2(wanted / FIRST)))

    def outline(
        times: int, pace: float, onwards: bool = False, way: PacedWay | None = None
    ) -> list[Stage]:
        count = math.ceil(wanted / 2**times)
        stages = guess_stages(problem, phases, z, search.scheme, count, pace, onwards, way=way)
        opening, clearance = options.opening, options.clearance
        stages = [replace(stage, opening=opening, clearance=clearance) for stage in stages]
        if to_go is not None:
            stages[-1] = keep_apart(stages[-1], to_go.phase.until.contact)
        return stages

    first = outline(halvings, _PACES[0])
    solution = _solve(search, first, halvings)
    if solution.success:
        return _summarise(problem, search, phases, solution)
    from .explain import explain, refuse

    def replan(other: Problem) -> object:
        own = [other.phases[phase.index] for phase in phases]
        return plan_phases(other, own, z, options, explained=False, patient=False)

    refuse(search, problem, phases, first, replan if explained else None)
    spent = search.tried.iterations
    ways = list_ways(problem, phases[0], z, WAYS) if patient and len(phases) == 1 else []
    guesses = _list_guesses(first, halvings, outline if patient else None, ways, len(phases) > 1)
    found = _try_guesses(search, problem, (first, solution), guesses, ways, spent + BUDGET)
    if found.solution.success:
        return _summarise(problem, search, phases, found.solution)
    reason = f"none was found, also of least shortfalls, from {', '.join(found.tried)}"
    raise explain(search, problem, phases, found.short, reason, replan if explained else None)


class _Found(NamedTuple):
    """What has come of guesses: a solution, or motions that are short of something."""

    solution: Solution
    short: list[list[Stage]]
    tried: list[str]


def _try_guesses(
    search: Search,
    problem: Problem,
    begun: tuple[list[Stage], Solution],
    guesses: Iterator[tuple[str, int, list[Stage]]],
    ways: Sequence[PacedWay],
    stop: int,
) -> _Found:
    """Solve from one guess after the other, and for least shortfalls where that leads nowhere.

    Parameters
    ----------
    begun : (list of Stage, Solution)
        The first guess, which is one of them, and what it has led to.
    ways : sequence of PacedWay
    stop : int
        Iterations of the solver after which no other guess is begun.
    """
    from .explain import list_shortfalls, solve_elastic

    # What is far from keeping limits along any way shows at once what is short.
    far = bool(ways) and all(way.margin <= NEAR for way in ways)
    first, solution = begun
    short, tried = list[list[Stage]](), dict.fromkeys([NEAREST])
    for name, halvings, guess in guesses:
        tried[name] = None
        if guess is not first and not far:
            solution = _solve(search, guess, halvings)
        elastic = None
        if not solution.success:
            # What coarse intervals are not short of, finer ones may be.
            elastic = solve_elastic(
                search, _halve(search, solution.stages) if solution.is_lost else guess
            )
        if (
            not solution.is_lost
            and elastic is not None
            and not list_shortfalls(problem, elastic, search.scheme)
        ):
            solution = _solve(search, elastic, halvings)
            elastic = None if solution.success else solve_elastic(search, _halve(search, elastic))
        if elastic is not None and list_shortfalls(problem, elastic, search.scheme):
            short.append(elastic)
        late = search.tried.iterations > stop
        if solution.success or late or len(short) == (1 if far else CONVINCING):
            break
    if not solution.success and not short and (elastic := solve_elastic(search, first)) is not None:
        short = [elastic] if list_shortfalls(problem, elastic, search.scheme) else []
    return _Found(solution, short, list(tried))


def _list_guesses(
    first: list[Stage],
    halvings: int,
    outline: Callable[..., list[Stage]] | None,
    ways: Sequence[PacedWay],
    onwards: bool,
) -> Iterator[tuple[str, int, list[Stage]]]:
    """Guesses by name, with how often their intervals are halved; only the first without others.

    Parameters
    ----------
    first : list of Stage
        What has been tried.
    halvings : int
    outline : callable or None
        Makes guesses.
    ways : sequence of PacedWay
    onwards : bool
        Whether there are phases that go on in motion.
    """
    if outline is not None:
        for way in [way for way in ways if way.margin > NEAR] or ways[:1]:
            stages = outline(halvings, _PACES[0], way=way)
            yield f"a way with the margin {way.margin:.3g}", halvings, stages
    yield NEAREST, halvings, first
    if outline is None:
        return
    for times in dict.fromkeys((halvings, 0)):
        for pace in _PACES:
            if onwards or times != halvings or pace != _PACES[0]:
                name = f"{'an end ahead' if onwards else NEAREST} at {pace:g}"
                yield f"{name} times the duration of a fall", times, outline(times, pace, onwards)


def _choose_intervals(phases: Sequence[Phase]) -> int:
    """Intervals of each phase: a phase with one freedom has fewer unknowns in each."""
    return 32 if len(phases) == 1 and phases[0].formation.n_constraints == 4 else 10


def _solve(search: Search, stages: list[Stage], halvings: int) -> Solution:
    """Solve, find modes and intervals, halve these, and make limits hold in between."""
    solution = search.solve(stages, most=ATTEMPT)
    if not solution.success:
        return solution
    plain = not search.options.mode_search or search.is_enough(solution)
    better = solution if plain else improve(search, solution)
    search, solution = choose_end(search, adapt(search, better))
    for _ in range(max(halvings, search.scheme.degree > _EXACT)):
        if solution.success:
            solution = search.solve(_halve(search, solution.stages), solution)
    return search.hold(solution) if solution.success else solution


def _halve(search: Search, stages: list[Stage]) -> list[Stage]:
    """Stages with all intervals halved."""
    every = [np.ones(stage.intervals, dtype=int) for stage in stages]
    return bisect_intervals(stages, search.scheme, every)


def _summarise(
    problem: Problem, search: Search, phases: Sequence[Phase], solution: Solution
) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase; the sequences of modes that were tried count for the first."""
    plans, tried = [], search.tried
    unit, margin = unit_of(search.goal, problem.scene.scales), solution.margin
    weight = search.options.time_weight * problem.scene.scales.torque**2
    solved = [to_si(stage, problem) for stage in solution.stages]
    motions = make_motions(solved, search.scheme)
    for phase in phases:
        stages = zip(motions, solved, strict=True)
        motion = TimeMotion([own for own, stage in stages if stage.phase == phase.index])
        torque = motion.torque
        value = {
            Objective.TIME: motion.duration,
            Objective.EFFORT: weight * motion.duration + torque.integrate_squares(),
            Objective.MARGIN: problem.epsilon + unit * margin,
        }[search.goal]
        plans.append(PhasePlan(motion, torque, value))
    plans[0] = plans[0]._replace(sequences=tried.sequences, complete=tried.complete)
    return plans
