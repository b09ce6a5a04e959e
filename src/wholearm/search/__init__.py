"""From a start to goals: the roadmap of borders and cells, its shortest routes, their plans."""

from __future__ import annotations

from functools import update_wrapper
from typing import Any

from ..planning import plan as planning
from ..planning.result import Plan
from ..problem.definition import Problem


def solve(problem: Problem, objective: str = "time", **options: Any) -> Plan:
    """Plan along the formations that a problem names, or that lead to its goals."""
    if problem.goals:
        from .find_route import find_route

        return find_route(problem, objective, **options).plan
    return planning.solve(problem, objective, **options)


update_wrapper(solve, planning.solve)
