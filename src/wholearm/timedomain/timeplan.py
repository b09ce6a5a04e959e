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

import numpy as np

from ..model import Array
from ..options import Objective, PlanOptions
from ..phaseplan import PhasePlan
from ..problem import Phase, Problem
from .modesearch import adapt, improve
from .ownunits import to_si, unit_of
from .revising import halve
from .stage import Stage
from .staging import outline_stages
from .timemotion import TimeMotion, make_motions
from .timesearch import Search, Solution

FIRST = 10
"""Most intervals of a phase to start with."""
CONVINCING = 2
"""Motions that miss limits least, from different guesses, after which there seems to be no plan."""
PATIENCE = 600
"""Most iterations of further attempts before there seems to be no plan."""
_PACES = (2.0, 4.0, 1.0)
"""Guessed durations to try, in units of that of a fall."""


def plan_phases(
    problem: Problem,
    phases: Sequence[Phase],
    z: Array,
    options: PlanOptions,
    duration: float | None = None,
    *,
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
    search = Search.of(problem, options, duration)
    wanted = options.time_intervals or _choose_intervals(phases)
    halvings = max(0, math.ceil(math.log2(wanted / FIRST)))

    def outline(times: int, pace: float, onwards: bool = False) -> list[Stage]:
        count = math.ceil(wanted / 2**times)
        stages = outline_stages(problem, phases, z, search.scheme, count, pace, onwards)
        opening, clearance = options.opening, options.clearance
        return [replace(stage, opening=opening, clearance=clearance) for stage in stages]

    first = outline(halvings, _PACES[0])
    solution = _solve(search, first, halvings)
    if solution.success:
        return _summarise(problem, search, phases, solution)
    from .timeexplain import ease, explain, list_shortfalls, refuse

    refuse(search, problem, phases[0], first[0])
    status, short = solution.status, list[list[Stage]]()
    spent = search.effort.iterations
    for times, guess in _list_guesses(first, halvings, outline if patient else None):
        if guess is not first:
            solution = _solve(search, guess, times)
        eased = None if solution.success else ease(search, guess)
        if eased is not None and list_shortfalls(problem, eased):
            short.append(eased)
        elif eased is not None:
            solution = _solve(search, eased, times)
        if solution.success:
            return _summarise(problem, search, phases, solution)
        if len(short) == CONVINCING or search.effort.iterations - spent > PATIENCE:
            break

    def replan(other: Problem) -> object:
        own = [other.phases[phase.index] for phase in phases]
        return plan_phases(other, own, z, options, explained=False, patient=False)

    raise explain(search, problem, phases, short, status, replan if explained else None)


def _list_guesses(
    first: list[Stage], halvings: int, outline: Callable[..., list[Stage]] | None
) -> Iterator[tuple[int, list[Stage]]]:
    """Guesses, with how often their intervals are to be halved; only the first without others."""
    yield halvings, first
    if outline is not None:
        for times in dict.fromkeys((halvings, 0)):
            for pace in _PACES:
                yield times, outline(times, pace, onwards=True)


def _choose_intervals(phases: Sequence[Phase]) -> int:
    """Intervals of each phase: a phase with one freedom has fewer unknowns in each."""
    return 32 if len(phases) == 1 and phases[0].formation.n_constraints == 4 else 10


def _solve(search: Search, stages: list[Stage], halvings: int) -> Solution:
    """Solve, find modes and intervals, halve these, and make limits hold in between."""
    solution = search.solve(stages)
    if not solution.success:
        return solution
    solution = adapt(search, improve(search, solution))
    for _ in range(halvings):
        if solution.success:
            every = [np.ones(stage.intervals, dtype=bool) for stage in solution.stages]
            solution = search.solve(halve(solution.stages, search.scheme, every), solution)
    return search.hold(solution) if solution.success else solution


def _summarise(
    problem: Problem, search: Search, phases: Sequence[Phase], solution: Solution
) -> list[PhasePlan[TimeMotion]]:
    """The plan of each phase; what solving has cost counts for the first."""
    plans, effort = [], search.effort
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
        plans.append(PhasePlan(motion, torque, value, 0, 0, 0.0, 0.0))
    plans[0] = plans[0]._replace(
        iterations=effort.iterations,
        solves=effort.solves,
        build_time=effort.build_time,
        solve_time=effort.solve_time,
        sequences=effort.sequences,
    )
    return plans
