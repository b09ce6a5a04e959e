"""Plans in the time domain that keep their limits of forces within ranges (`robust`).

From a plan without ranges on, limits are raised in every interval by what ranges change of them
there, and the NLP is solved again from where it was, a few times. Then what is still missed is
added, until nothing is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import SolverError
from ...mechanics.dynamics import Directions
from ...mechanics.limits import CONE, PRESS, make_limits
from ...problem.definition import Phase
from ...sensitivity.slopes import find_slopes_at
from ..advice import name_phases
from ..robust.rows import find_edges
from .between import CHECKS, MISS, CheckPlaces, Limits, check_between, find_misses
from .motion import StageMotion, make_motions
from .search import Search, Solution
from .stage import Stage

_ROUNDS = 20
"""Most solves."""
_SWINGS = 5
"""The first of them, in which limits are raised by what ranges change, and not by more."""
_OVER = 1.2
"""Factor on what is missed after that."""


class _Look(NamedTuple):
    """What ranges change in each interval, over what is much, and what is missed with that."""

    swings: Array
    misses: Limits


def keep_within(search: Search, solution: Solution, phases: Sequence[Phase]) -> Solution:
    """Go on from a plan until its limits hold within the ranges of its options.

    Parameters
    ----------
    search : Search
    solution : Solution
        Accurate, with limits that hold between points.
    phases : sequence of Phase

    Raises
    ------
    SolverError
        If there is no such plan.
    """
    found = _widen(search, solution)
    if not found.success:
        raise SolverError(f"{name_phases([own.number for own in phases])}: {found.status}")
    return found


def _widen(search: Search, solution: Solution) -> Solution:
    raised = [Limits.none(stage) for stage in solution.stages]
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
                Limits(*(a + _OVER * b for a, b in zip(old, own.misses, strict=True)))
                for old, own in pairs_of
            ]
        given = solution.nlp, solution.stages, raised, solution.multipliers, solution.margin
        solution = search.run(*given)
        if not solution.success:
            text = f"limits cannot be kept within the ranges: {solution.status}"
            return solution._replace(status=text)
    text = f"limits are still missed within the ranges after {_ROUNDS} solves"
    return solution._replace(status=text, success=False)


def _look(search: Search, solution: Solution, stage: Stage, motion: StageMotion) -> _Look:
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
    stage : Stage
    check : CheckPlaces
    epsilon : float, [N]
    ranges : mapping of str to float
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
