"""What keeps a search from its goal, in words, and the change of one number that opens the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..common.errors import InfeasibleError, InputError, WholearmError
from ..common.shortfalls import Change
from ..contacts.formation import Formation
from ..planning.advice import unadvised
from ..planning.options import Objective, PlanOptions
from ..planning.plan import solve_with
from ..problem.definition import Phase, Problem
from .chart import Chart
from .choosing import Chooser
from .find import Search
from .gates import Gate, Opening, list_gates, list_openings, pass_gate
from .links import Blocked, point_out
from .measure import ROUGH, SINGULAR

TRIED = 3
"""Most numbers with which the goal is looked for."""

Try = Callable[[Change, Sequence[int], bool], tuple[float, Sequence[int]] | None]
"""Looks for the goal with a change, beyond some borders: about how long the route takes [s], which
is planned if that is asked for, and over which of the borders it leads."""


def find_opening(
    search: Search, problem: Problem, options: PlanOptions
) -> tuple[str, tuple[Change, ...]]:
    """The change of a single number with which the goal is reached, in words and as such.

    It is looked for on the borders that are shut, and tried by a search beyond those that it opens.
    """
    gates = list_gates(search)

    def find(
        change: Change, beyond: Sequence[int], planned: bool
    ) -> tuple[float, Sequence[int]] | None:
        own = {k: gates[k] for k in beyond}
        return _look_beyond(search, problem, options, change, own, planned)

    return choose_opening(list_openings(gates), find)


def choose_opening(openings: Sequence[Opening], find: Try) -> tuple[str, tuple[Change, ...]]:
    """The first number with which the goal is reached, and the least change of it that does."""
    tried = list[str]()
    for opening in openings[:TRIED]:
        most = opening.open_all()
        beyond = opening.list_open(most)
        seen = find(most, beyond, False)
        # What else it opens may be needed beyond those borders over which the way leads.
        least = most if seen is None else opening.open_all(seen[1])
        for change in dict.fromkeys((least, most)) if seen else ():
            found = find(change, opening.list_open(change), True)
            if found is not None:
                text = f"with {change} the goal is reached, in about {found[0]:.3g} s"
                return text, (change,)
        tried.append(str(most))
    return f"the goal is not reached with {', nor with '.join(tried)}" if tried else "", ()


def _look_beyond(
    search: Search,
    problem: Problem,
    options: PlanOptions,
    change: Change,
    gates: dict[int, Gate],
    planned: bool,
) -> tuple[float, list[int]] | None:
    """Look for the goal in a changed scene, beyond borders that are open there."""
    try:
        changed = problem.with_({change.parameter.key: change.value})
    except InputError:
        return None
    changed = replace(changed, start=search.start.z)
    ways = {k: pass_gate(search, gate, change) for k, gate in gates.items()}
    sources = [way for way in ways.values() if way is not None]
    if not sources:
        return None
    start = replace(search.start, scene=changed.scene)
    beyond = Search(Chart(changed, options.uniqueness_margin), start, search.goal, sources=sources)
    rough = replace(options, objective=Objective.TIME, duration=None, accuracy=ROUGH, robust=0.0)
    rough = replace(rough, mode_search=False, certify=False, replay=False)
    chooser = Chooser(changed, [], beyond, rough, hurried=True)
    try:
        route = chooser.glance(lambda _: None)
        if planned:
            chooser.plan(1, lambda _: None)
    except np.linalg.LinAlgError:
        return None
    if route is None or (planned and not chooser.made):
        return None
    duration = chooser.made[0][0].duration if planned else route.duration
    return duration, [k for k, way in ways.items() if way and way.links[-1] in route.links]


def explain(problem: Problem, options: PlanOptions, blocked: Blocked) -> str:
    """What a motion along a border of the cut is short of, in words."""
    (step,) = blocked.steps
    # A contact may touch at the start already, or be gained both ways; a place says which is meant.
    for until in (step.until, point_out(step.contacts, blocked.stop.z)):
        phase = Phase(0, Formation(problem.scene, step.contacts), until)
        own = replace(problem, start=blocked.start.z, phases=(phase,), goals=())
        try:
            with unadvised():
                solve_with(own, replace(options, replay=False))
        except InputError:
            continue
        except InfeasibleError as error:
            if error.shortfalls:
                short = error.shortfalls[0]
                return f"{short.limit} is {short.amount:.3g} {short.unit} short"
        except WholearmError:
            break
        except np.linalg.LinAlgError:
            return SINGULAR
        break
    return blocked.reason
