"""The search for the modes of stages: moves, each solved, until none makes the plan better."""

from __future__ import annotations

from .modes import sign_sequence
from .moves import WORTH, list_dropped, list_moves
from .search import Search, Solution
from .stage import Stage

MOST = 12
"""Most sequences of modes to try from one start."""
LOST = 3
"""Sequences that led to nothing since the last gain after which no more are tried."""
PATIENCE = 50
"""Most iterations of one of them."""


def improve(search: Search, solution: Solution) -> Solution:
    """Change the modes of a solution for as long as that makes it better."""
    known = {sign_sequence(solution.stages)}
    waiting, tried, lost = list_neighbours(search, solution), 1, 0
    beside = set[tuple[object, ...]]()
    while waiting and tried < MOST and lost < LOST:
        moved = waiting.pop(0)
        signs = sign_sequence(moved)
        # A stage that has shrunk to nothing may have gained by the intervals beside it alone.
        if signs in known and (signs in beside or len(moved) >= len(solution.stages)):
            continue
        known.add(signs)
        beside.add(signs)
        tried += 1
        other = search.solve(moved, most=PATIENCE)
        search.tried.sequences += 1
        if not other.success:
            lost += 1
            continue
        gain = solution.cost - other.cost
        least = WORTH if len(moved) >= len(solution.stages) else -WORTH
        if gain > least * abs(solution.cost):
            solution, waiting, lost = other, list_neighbours(search, other), 0
            beside = set()
        elif _rolls(moved) > _rolls(solution.stages):
            # No better by itself, but it tells which way its contacts would slide.
            waiting = [*list_neighbours(search, other, leaning=True), *waiting]
    search.tried.complete = all(sign_sequence(moved) in known for moved in waiting)
    return solution


def drop_gone(search: Search, solution: Solution) -> Solution:
    """Leave out stages that have shrunk to nothing on finer intervals: replays of them diverge."""
    for moved in list_dropped(solution.stages):
        other = search.solve(moved, most=PATIENCE)
        if other.success and other.cost - solution.cost < WORTH * abs(solution.cost):
            return drop_gone(search, other)
    return solution


def list_neighbours(search: Search, solution: Solution, leaning: bool = False) -> list[list[Stage]]:
    """Sequences of stages that one move leads to from those of a solution."""
    own = [search.problem.phases[stage.phase].formation for stage in solution.stages]
    worth = [solution.price_friction(k) / abs(solution.cost) for k in range(len(own))]
    given = (solution.stages, search.scheme, own, search.problem.epsilon, leaning)
    return list(list_moves(*given, savings=worth))


def _rolls(stages: list[Stage]) -> int:
    return sum(stage.formation.n_rolling for stage in stages)
