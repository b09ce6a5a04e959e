"""Routes as problems with phases, and their plans, which are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, WholearmError
from ..geometry.path_guess import find_end
from ..planning.advice import unadvised
from ..planning.options import PlanOptions
from ..planning.plan import solve_with
from ..planning.result import Plan
from ..problem.definition import Phase, Problem
from .find import Route
from .links import Link, describe_steps, point_out
from .measure import SINGULAR, Measured, make_phases
from .places import measure_apart


@dataclass(frozen=True, eq=False)
class Candidate:
    """A route whose phases can be carried out geometrically.

    Attributes
    ----------
    route : Route
    problem : Problem
        With the phases of the route in place of its goals.
    end : ndarray, shape (5,)
        About where it ends.
    """

    route: Route
    problem: Problem
    end: Array


@dataclass(frozen=True, eq=False)
class Failure:
    """A route that has no plan after all.

    Attributes
    ----------
    route : Route
    reason : str
    """

    route: Route
    reason: str


class Lost(str):
    """Why a route has no plan, with the links for which that is so on every route.

    Attributes
    ----------
    links : tuple of Link
        The one that has no plan, or whose plan does not hold, behind the one that lands where it
        starts, if any.
    """

    links: tuple[Link, ...] = ()

    @classmethod
    def at(cls, links: tuple[Link, ...], reason: str) -> Lost:
        """A reason that some links are to blame for."""
        lost = cls(reason)
        lost.links = links
        return lost


def make_candidate(
    problem: Problem, routes: list[Route], known: Mapping[Link, Measured | str]
) -> Candidate | Failure:
    """The problem whose phases lead along routes, one after the other, from its start.

    Links that are `known` have the phases with which they were planned.
    """
    z, phases = problem.start, list[Phase]()
    links = [link for route in routes for link in route.links]
    whole = Route(tuple(links))
    for link in links:
        try:
            measured = known.get(link)
            own = (
                link if not isinstance(measured, Measured) else replace(link, steps=measured.steps)
            )
            made, z = _make_phases(problem, len(phases), own, z)
        except InputError as error:
            return Failure(whole, f"{describe_steps(link.steps)}: {error.problem}")
        phases += made
    return Candidate(whole, replace(problem, phases=tuple(phases), goals=()), z)


def _make_phases(problem: Problem, index: int, link: Link, z: Array) -> tuple[list[Phase], Array]:
    """The phases of a link that starts at `z`, and where they end."""
    phases = make_phases(problem, link.steps, index)
    here = z
    for k, phase in enumerate(phases):
        end = find_end(phase, here, phases[k + 1 :])
        if not link.in_cell and _misses(end, link, phase is phases[-1]):
            # A contact may be gained both ways along a border; x or phi tells which is meant.
            phases[k] = phase = replace(phase, until=point_out(link.steps[k].contacts, link.stop.z))
            end = find_end(phase, here, phases[k + 1 :])
        here = end
    return phases, here


def _misses(end: Array, link: Link, last: bool) -> bool:
    return last and measure_apart(link.stop.scene, end, link.stop.z) > 1e-4


def plan_candidate(
    candidate: Candidate, options: PlanOptions, kept: dict[object, Plan | str]
) -> Plan | str:
    """The plan of a candidate, or why there is none; `kept` has those that were made before."""
    phases = tuple(
        (phase.formation.names, phase.until, phase.end) for phase in candidate.problem.phases
    )
    start = tuple(np.round(candidate.problem.start, 12).tolist())
    key = (start, phases, repr(options))
    if key not in kept:
        try:
            with unadvised():
                kept[key] = solve_with(candidate.problem, options)
        except WholearmError as error:
            kept[key] = str(error)
        except np.linalg.LinAlgError:
            kept[key] = SINGULAR
    return kept[key]
