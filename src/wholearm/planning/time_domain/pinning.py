"""Plans to a given place, from plans that choose where they end: that end is moved to the place.

The nearest way to a place is often one that contacts cannot push along, while a plan that may end
anywhere is soon found. In steps that are as long as the solver can follow its end is moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from types import MappingProxyType
from typing import NamedTuple

from ...common.arrays import Array
from ...common.errors import InfeasibleError, InputError
from ...geometry.curve import describe_pose
from ...geometry.path_guess import find_end
from ...problem.definition import ROWS, Phase, Problem
from ..advice import describe_shortfalls, name_phases, rank_shortfalls
from .attempts import Attempt, Attempts, solve_attempt
from .mode_search import improve
from .own_units import to_si
from .search import Search, Solution
from .stage import Stage

MOVED = "a plan that chooses where it ends"
"""Name of the guess."""
FURTHER = 4
"""Guesses, beyond the first one, from which such a plan is looked for."""
PATIENCE = 50
"""Most iterations of the solver for one step."""
SHORTEST = 1 / 16
"""Shortest step of the end, over its whole way."""
NEARER = (0.3, 0.1)
"""Shares of the way that is left, after which it is asked what motions are short of."""


class Approach(NamedTuple):
    """What moving ends to where they are pinned has led to.

    Attributes
    ----------
    solution : Solution or None
        A plan that ends there; None where nothing is pinned, or the place is not reached so.
    nearest : Solution or None
        Otherwise the plan that comes nearest to it, if there is any.
    ends : dict
        Where each phase ended at first, by its index.
    share : float
        How far the nearest plan has moved from there.
    """

    solution: Solution | None = None
    nearest: Solution | None = None
    ends: Mapping[int, Array] = MappingProxyType({})
    share: float = 0.0


def approach(search: Search, problem: Problem, phases: Sequence[Phase], z: Array) -> Approach:
    """Plan phases with ends that are left open, then move these to where they are pinned.

    Parameters
    ----------
    search : Search
        For the phases as they are.
    problem : Problem
    phases, z : sequence of Phase, ndarray of shape (5,)
        Planned as one, from `z`.
    """
    free = [_set_free(phase) for phase in phases]
    if all(own is phase for own, phase in zip(free, phases, strict=True)):
        return Approach()
    every = [_set_free(phase) for phase in problem.phases]
    goal = find_end(phases[0], z) if len(phases) == 1 else None
    begun = _begin(search, replace(problem, phases=tuple(every)), free, z, goal)
    if begun is None:
        return Approach()
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
            return Approach(None, solution, ends, reached)
    if search.only_begins:
        return Approach(solution)
    halvings = Attempts(problem, phases, z, search, None, False).first.halvings
    last = solve_attempt(search, Attempt(MOVED, halvings, solution.stages, before=solution))
    return Approach(last) if last.success else Approach(None, solution, ends, reached)


def refuse_pinned(
    search: Search, problem: Problem, phases: Sequence[Phase], found: Approach
) -> None:
    """Raise an error on what motions are short of whose ends are moved on to where they are pinned.

    Where none is found that ends there, one that ends nearer to it than any plan says why.

    Raises
    ------
    InfeasibleError
        With the limits that are missed, and where the motion ends.
    """
    from .explain import list_shortfalls, solve_elastic

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


def _begin(
    search: Search, free: Problem, phases: Sequence[Phase], z: Array, goal: Array | None
) -> Solution | None:
    """A plan on few intervals that chooses where it ends."""
    own = replace(
        search,
        problem=Search.of(free, search.options).problem,
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


def _pin(search: Search, stage: Stage, end: Array, share: float) -> Stage:
    """A stage whose pins are a share of the way from where it ended at first."""
    until = search.problem.phases[stage.phase].until
    if stage.until is None or not until.pins:
        return stage
    pins = tuple(
        (name, value + (1.0 - share) * (float(end[ROWS[name]]) - value))
        for name, value in until.pins
    )
    return replace(stage, until=replace(until, pins=pins))
