"""Plans to a given place, from plans that choose where they end: that end is moved to the place.

The nearest way to a place is often one that contacts cannot push along, while a plan that may end
anywhere is soon found. In steps that are as long as the solver can follow its end is moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, islice

from ...common.arrays import Array
from ...common.errors import InputError
from ...problem.definition import ROWS, Phase, Problem
from .attempts import Attempt, Attempts, solve_attempt
from .mode_search import improve
from .search import Search, Solution
from .stage import Stage

MOVED = "a plan that chooses where it ends"
"""Name of the guess."""
FURTHER = 4
"""Guesses, beyond the first one, from which such a plan is looked for."""
SHORTEST = 1 / 16
"""Shortest step of the end, over its whole way."""


def approach(
    search: Search, problem: Problem, phases: Sequence[Phase], z: Array
) -> Solution | None:
    """Plan phases with ends that are left open, then move these to where they are pinned.

    Parameters
    ----------
    search : Search
        For the phases as they are.
    problem : Problem
    phases, z : sequence of Phase, ndarray of shape (5,)
        Planned as one, from `z`.

    Returns
    -------
    Solution, or None where nothing is pinned, or the place is not reached so.
    """
    free = [_set_free(phase) for phase in phases]
    if all(own is phase for own, phase in zip(free, phases, strict=True)):
        return None
    every = [_set_free(phase) for phase in problem.phases]
    begun = _begin(search, replace(problem, phases=tuple(every)), free, z)
    if begun is None:
        return None
    ends = {stage.phase: stage.guess.nodes[-1, 0] for stage in begun.stages}
    solution, reached, step = begun, 0.0, 1.0
    while reached < 1.0:
        share = min(1.0, reached + step)
        stages = [_pin(search, stage, ends[stage.phase], share) for stage in solution.stages]
        moved = search.solve(stages, solution)
        if moved.success:
            plain = share == 1.0 or not search.options.mode_search
            solution, reached = moved if plain else improve(search, moved), share
        elif (step := step / 4) < SHORTEST:
            return None
    if search.only_begins:
        return solution
    halvings = Attempts(problem, phases, z, search, None, False).first.halvings
    last = solve_attempt(search, Attempt(MOVED, halvings, solution.stages, before=solution))
    return last if last.success else None


def _begin(search: Search, free: Problem, phases: Sequence[Phase], z: Array) -> Solution | None:
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
        for attempt in chain([attempts.first], islice(attempts, FURTHER)):
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
