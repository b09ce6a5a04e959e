"""Routes as problems with phases, and their plans, which are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, WholearmError
from ..contacts.formation import Formation
from ..geometry.explore import STILL
from ..geometry.path_guess import find_end
from ..geometry.tracing import trace_phase
from ..mechanics.metric import metric_weights
from ..planning.advice import unadvised
from ..planning.lower_bound.lower_bound import look_along
from ..planning.lower_bound.sweep import NoMotionError
from ..planning.options import Objective, PlanOptions
from ..planning.plan import solve_with
from ..planning.result import Plan
from ..problem.definition import End, Phase, Problem, Until
from .find import Route
from .links import INTERVALS, Blocked, Link, Measured, Step, describe_steps, point_out

FURTHER = 2
"""Guesses of a phase that is planned alone, beyond the first one."""
ROUGH = 1e-2
"""Accuracy of plans of which only matters about how long they take."""

SINGULAR = "its contacts depend on each other"
"""Why there is no plan where the equations of motion have no single solution."""


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
    phases = [
        Phase(index + k, Formation(problem.scene, step.contacts), step.until, step.end)
        for k, step in enumerate(link.steps)
    ]
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
    length = link.stop.scene.scales.length
    return last and bool(np.abs((end - link.stop.z) / [length, length, 1, 1, 1]).max() > 1e-4)


def measure_link(
    problem: Problem, link: Link, steps: tuple[Step, ...], options: PlanOptions
) -> Measured | str:
    """Plan a link through a cell for itself, on few intervals and from one guess.

    Parameters
    ----------
    problem : Problem
    link : Link
    steps : tuple of Step
        Its own, or others that lead the same way.
    options : PlanOptions

    Returns
    -------
    Measured, or why there is no plan.
    """
    from ..planning.time_domain.plan import try_phases

    rough = replace(
        options, objective=Objective.TIME, duration=None, accuracy=ROUGH, mode_search=False
    )
    blank = replace(problem, goals=(), phases=())
    z, spent = link.start.z, 0.0
    try:
        phases, _ = _make_phases(problem, 0, replace(link, steps=steps), z)
        own = replace(blank, phases=tuple(phases))
        if len(phases) > 1 and phases[0].end is End.REST:
            ahead = look_along((trace_phase(phases[0], z),), problem.epsilon, INTERVALS)
            spent, z, phases = ahead.duration, find_end(phases[0], z), phases[1:]
        moved = find_end(phases[0], z, phases[1:]) - z
        if metric_weights(problem.scene) @ moved**2 < (STILL * problem.scene.scales.length) ** 2:
            return f"{phases[0].until} holds already where it starts"
        plans = try_phases(own, phases, z, rough, FURTHER if len(phases) == 1 else 0)
    except NoMotionError:
        return "no motion keeps its limits along the border"
    except WholearmError as error:
        return str(error)
    except np.linalg.LinAlgError:
        return SINGULAR
    if plans is None:
        return "no guess leads to a plan"
    return Measured(spent + sum(plan.motion.duration for plan in plans), steps)


def leave_in_motion(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Phases that leave a border in motion, at a place that the planner chooses."""
    first, *rest = steps
    return (Step(first.contacts, Until(), End.SMOOTH), *rest)


def explain_border(problem: Problem, blocked: Blocked, options: PlanOptions) -> str:
    """What keeps a border from being followed, and what single change would let it be."""
    (step,) = blocked.steps
    phase = Phase(0, Formation(problem.scene, step.contacts), step.until)
    own = replace(problem, start=blocked.start.z, phases=(phase,), goals=())
    try:
        solve_with(own, replace(options, replay=False))
    except WholearmError as error:
        return f"from {blocked.start} {error}"
    except np.linalg.LinAlgError:
        return f"from {blocked.start} {SINGULAR}"
    return ""


def plan_candidate(
    candidate: Candidate, options: PlanOptions, kept: dict[object, Plan | str]
) -> Plan | str:
    """The plan of a candidate, or why there is none; `kept` has those that were made before."""
    phases = tuple(
        (phase.formation.names, str(phase.until), phase.until.value, phase.end)
        for phase in candidate.problem.phases
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
