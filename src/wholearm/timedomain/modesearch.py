"""The search for the modes of stages: moves, each solved, until none makes the plan better."""

from __future__ import annotations

from .modes import sign_sequence
from .moves import list_moves
from .timesearch import Search, Solution

MOST = 12
"""Most sequences of modes to try from one start."""
PATIENCE = 100
"""Most iterations of one of them."""
WORTH = 1e-5
"""Least gain of a move, over the cost."""


def improve(search: Search, solution: Solution) -> Solution:
    """Change the modes of a solution for as long as that makes it better."""
    known = {sign_sequence(solution.stages)}
    problem, going = search.problem, True
    while going and len(known) <= MOST:
        going = False
        own = [problem.phases[stage.phase].formation for stage in solution.stages]
        for moved in list_moves(solution.stages, search.scheme, own, problem.epsilon):
            signs = sign_sequence(moved)
            if signs in known or len(known) > MOST:
                continue
            known.add(signs)
            other = search.solve(moved, most=PATIENCE)
            if other.success and other.cost < solution.cost - WORTH * abs(solution.cost):
                solution, going = other, True
                break
    return solution
