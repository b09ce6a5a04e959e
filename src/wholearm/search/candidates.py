"""Routes without a plan, and a cache of plans of routes whose phases all have given ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..common.errors import WholearmError
from ..planning.advice import unadvised
from ..planning.options import PlanOptions
from ..planning.plan import solve_with
from ..planning.result import Plan
from ..problem.definition import Problem
from .astar import RoadmapRoute
from .edges import Link
from .feasibility import SINGULAR


@dataclass(frozen=True, eq=False)
class FailedCandidate:
    """A route that has no plan."""

    route: RoadmapRoute
    reason: str


class Lost(str):
    """Why a route has no plan, with the links for which that is so on every route."""

    # the one whose planning or replay fails, after the one that lands at its start, if any
    links: tuple[Link, ...] = ()

    @classmethod
    def at(cls, links: tuple[Link, ...], reason: str) -> Lost:
        """A reason together with the links that cause it."""
        lost = cls(reason)
        lost.links = links
        return lost


def plan_phases(
    problem: Problem, options: PlanOptions, cache: dict[object, Plan | str]
) -> Plan | str:
    """The plan of a route's phases, or why there is none; `cache` has those made before."""
    phases = tuple((phase.formation.names, phase.until, phase.end) for phase in problem.phases)
    key = (tuple(np.round(problem.start, 12).tolist()), phases, repr(options))
    if key not in cache:
        try:
            with unadvised():
                cache[key] = solve_with(problem, options)
        except WholearmError as error:
            cache[key] = str(error)
        except np.linalg.LinAlgError:
            cache[key] = SINGULAR
    return cache[key]
