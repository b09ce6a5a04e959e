"""Routes without a plan, and plans of phases whose landings are known, which are kept."""

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
    """A route that has no plan after all."""

    route: RoadmapRoute
    reason: str


class Lost(str):
    """Why a route has no plan, with the links for which that is so on every route."""

    # the one that has no plan, or whose plan does not hold, behind the one that lands where it
    # starts, if any
    links: tuple[Link, ...] = ()

    @classmethod
    def at(cls, links: tuple[Link, ...], reason: str) -> Lost:
        """A reason that some links are to blame for."""
        lost = cls(reason)
        lost.links = links
        return lost


def plan_phases(
    problem: Problem, options: PlanOptions, kept: dict[object, Plan | str]
) -> Plan | str:
    """The plan of a route's phases, or why there is none; `kept` has those made before."""
    phases = tuple((phase.formation.names, phase.until, phase.end) for phase in problem.phases)
    key = (tuple(np.round(problem.start, 12).tolist()), phases, repr(options))
    if key not in kept:
        try:
            with unadvised():
                kept[key] = solve_with(problem, options)
        except WholearmError as error:
            kept[key] = str(error)
        except np.linalg.LinAlgError:
            kept[key] = SINGULAR
    return kept[key]
