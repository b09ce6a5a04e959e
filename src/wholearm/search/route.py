"""From a problem with goals to a plan: search, planning of what is found, and what bounds it."""

from __future__ import annotations

import json
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InfeasibleError, InputError, SolverError
from ..common.interrupts import yielding
from ..common.pulse import OutOfTime, Reporter, limited
from ..common.sharing import exclusive
from ..common.shortfalls import Change
from ..planning.options import Objective, PlanOptions
from ..problem.definition import Problem
from ..problem.goal import name_goal
from ..problem.table import describe_scene
from .candidates import Failure
from .chart import Chart
from .choosing import Chooser
from .find import Route, Search
from .goals import is_at
from .opening import explain, find_opening
from .places import make_place
from .reach import require_reach
from .result import Alternative, Answer, describe_block
from .store import load_chart, require_folder, store_chart

CHARTS = 4
"""Scenes whose charts are kept."""
_charts: OrderedDict[object, Chart] = OrderedDict()


def find_route(
    problem: Problem,
    objective: str = "time",
    *,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
    cache: str | Path | None = None,
    jobs: int = 1,
    time_limit: float | None = None,
    **options: Any,
) -> Answer:
    """Find the contact formations that lead from a problem's start to its goals, and a plan.

    Parameters
    ----------
    problem : Problem
        With goals.
    objective : {"time", "effort", "margin"}
        Routes are looked for by their least time; plans along them are of this objective.
    alternatives : int
        How many routes of other formations are planned beside the best one.
    progress : callable, optional
        Told in a few words what is being done.
    cache : path-like, optional
        Folder where what is known of the scene is kept, for other processes. Its files are pickles:
        it has to be one that nobody else writes to.
    jobs : int
        Most processes at the same time; others than this one are forked. What is found does not
        depend on it.
    time_limit : float, optional, [s]
        Longest time that the search may take; then the best route so far is returned.
    **options
        As `wholearm.solve` takes them.

    Raises
    ------
    InputError
        If the problem has no goals, or an option is out of its range.
    InfeasibleError
        If nothing leads to a goal; names what blocks the way.
    SolverError
        If the time is over before there is a plan; names what is missing.
    """
    if jobs < 1:
        raise InputError("", "jobs", f"{jobs} given; allowed is 1 or more")
    own = PlanOptions(objective=objective, **options)
    folder = None if cache is None else Path(cache)
    given = problem, own, alternatives, progress, folder, jobs
    return find_route_with(*given, time_limit=time_limit)


@exclusive
def find_route_with(
    problem: Problem,
    options: PlanOptions,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
    cache: Path | None = None,
    jobs: int = 1,
    *,
    time_limit: float | None = None,
    hurry: Callable[[], None] | None = None,
) -> Answer:
    """Find a route with `options` given as one object; see `find_route`.

    With `hurry` an interrupt ends the search alone: the best route so far is returned, or planned,
    which `hurry` is called before. Without it KeyboardInterrupt is raised.
    """
    with limited(time_limit):
        return _find(problem, options, alternatives, Reporter(progress), cache, jobs, hurry)


def _find(
    problem: Problem,
    options: PlanOptions,
    alternatives: int,
    report: Reporter,
    cache: Path | None,
    jobs: int,
    hurry: Callable[[], None] | None,
) -> Answer:
    """Find a route from goal to goal."""
    if not problem.goals:
        raise InputError(problem.source, "goal", "is missing; allowed is flush or phi_deg, and x")
    if cache is not None:
        require_folder(cache)
    chart, before = get_chart(problem, options, cache), list[Route]()
    for index, goal in enumerate(problem.goals):
        start = problem.start if not before else before[-1].links[-1].stop.z
        place = make_place(problem.scene, start)
        if is_at(place, goal):
            key = name_goal(problem.goals, index, problem.table)
            raise InputError(problem.source, key, f"{goal} holds already where the motion starts")
        require_reach(problem.scene, goal, float(start[2]))
        search = Search(chart, place, goal)
        wanted = alternatives if index + 1 == len(problem.goals) else 0
        answer = _choose(problem, before, search, options, wanted, report, jobs, hurry)
        before = [*before, answer.route]
    if cache is not None:
        try:
            store_chart(cache, key_chart(problem, options), chart)
        except InputError as error:
            # What was found counts, with or without a copy for later searches.
            warnings.warn(str(error), stacklevel=2)
    return answer


def key_chart(problem: Problem, options: PlanOptions) -> str:
    """What a chart depends on, in words."""
    known = describe_scene(problem.scene) | {"": (problem.epsilon, options.uniqueness_margin)}
    return json.dumps(known, sort_keys=True)


def get_chart(problem: Problem, options: PlanOptions, cache: Path | None = None) -> Chart:
    """The chart of a problem's scene, kept from one search to the next, in a folder if asked."""
    key = key_chart(problem, options)
    chart = _charts.pop(key, None)
    if chart is None and cache is not None:
        chart = load_chart(cache, key)
    chart = chart or Chart(problem, options.uniqueness_margin)
    _charts[key] = chart
    while len(_charts) > CHARTS:
        _charts.popitem(last=False)
    return chart


def forget_charts() -> None:
    """Forget what is known of scenes."""
    _charts.clear()


def _refuse(
    problem: Problem,
    search: Search,
    options: PlanOptions,
    failures: list[Failure],
    seconds: float,
    report: Reporter,
    hurry: Callable[[], None] | None,
) -> InfeasibleError:
    """Why nothing leads to a goal, which took so many seconds to see, and what opens the way."""
    opening, changes, why = "", tuple[Change, ...](), partial(explain, problem, options)
    try:
        with yielding():
            opening, changes = find_opening(search, problem, options, seconds, report)
            text = describe_block(search, failures, opening, why)
    except KeyboardInterrupt as error:
        if hurry is None and not isinstance(error, OutOfTime):
            raise
        # That nothing leads there is known; what would help, and why, is not looked for any more.
        text = describe_block(search, failures, opening)
    return InfeasibleError(text, changes=changes)


def _describe_missing(chooser: Chooser, doing: str) -> str:
    """What a search that is out of time has found, and what it was at."""
    text = f"the time limit is over, and there is no plan yet: {chooser.search.settled} places"
    text += " looked at"
    if chooser.found:
        best = min(chooser.found, key=chooser.estimate)
        count = sum(len(link.steps) for link in best.links)
        text += f", a route of {count} phases found, of about {chooser.estimate(best):.3g} s"
    return f"{text}; what it was at: {doing}"


def _choose(
    problem: Problem,
    before: list[Route],
    search: Search,
    options: PlanOptions,
    alternatives: int,
    report: Reporter,
    jobs: int,
    hurry: Callable[[], None] | None,
) -> Answer:
    """Plan routes to one goal, and say how good the best one is."""
    begun = time.process_time()
    chooser, complete = Chooser(problem, before, search, options, jobs), True
    try:
        with yielding():
            report("looking for routes")
            chooser.run(1 + alternatives, report)
    except OutOfTime:
        if not chooser.made:
            raise SolverError(_describe_missing(chooser, report.last)) from None
        complete = False
    except KeyboardInterrupt:
        if hurry is None or not (chooser.made or chooser.found):
            raise
        complete = False
        if not chooser.made:
            hurry()
            chooser.hurried = True
            chooser.plan(1, report)
    except np.linalg.LinAlgError:
        # Contacts depend on each other at a place that the search came to.
        complete = False
        if not chooser.made:
            chooser.plan(1, report)
    made, margin = chooser.made, options.goal is Objective.MARGIN
    if not made:
        spent = time.process_time() - begun
        raise _refuse(problem, search, options, chooser.failures, spent, report, hurry)
    made.sort(key=lambda own: -own[0].value if margin else own[0].value)
    plan, route = made[0]
    bound = None
    if complete and not before:
        try:
            with yielding():
                bound = chooser.bound(plan.duration, route.in_cells)
        except KeyboardInterrupt as error:
            if hurry is None and not isinstance(error, OutOfTime):
                raise
            complete = False
    return Answer(
        plan,
        plan.problem,
        route,
        bound,
        tuple(Alternative(own[0], own[0].problem) for own in made[1 : 1 + alternatives]),
        tuple(chooser.failures),
        tuple(search.blocked),
        search.settled,
        complete,
    )
