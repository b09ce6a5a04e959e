"""Where stages end, if that is left open: where they and what follows cost least together."""

from __future__ import annotations

from dataclasses import replace

from ...common.errors import WholearmError
from ...contacts.elemental import Contact
from .search import Price, Search, Solution
from .stage import Stage

ROUNDS = 4
"""Most times that the cost-to-go is expanded."""
GAIN = 1e-4
"""Least gain of moving the end, over the cost of the stages."""


def choose_end(search: Search, solution: Solution) -> tuple[Search, Solution]:
    """Add the cost-to-go at the end, expanded to first order, and solve again while that gains.

    Returns the search with the price of the last end, too.
    """
    best, least, to_go = (search, solution), None, search.to_go
    if to_go is None:
        return best
    for _ in range(ROUNDS):
        try:
            value, gradient = to_go(solution.end)
        except WholearmError:
            break
        total = solution.cost - search.charge(solution.end) + value
        if least is not None and total > least - GAIN * abs(least):
            break
        least, best = total, (search, solution)
        search = replace(search, price=Price(gradient, solution.end))
        solution = search.solve(solution.stages, solution)
        if not solution.success:
            break
    return best


def keep_apart(stage: Stage, contact: Contact | None) -> Stage:
    """The stage, clear of the contact that ends what comes next: that has a way to go."""
    own = [k for k, limit in enumerate(stage.formation.limits) if limit.gains(contact)]
    return replace(stage, apart=tuple(own), monitored=tuple(sorted({*stage.monitored, *own})))
