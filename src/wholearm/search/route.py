"""From a problem with goals to a plan: search, planning of what is found, and what bounds it."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from ..common.errors import InfeasibleError, InputError
from ..common.interrupts import yielding
from ..common.sharing import exclusive
from ..planning.options import Objective, PlanOptions
from ..planning.result import Plan
from ..problem.definition import Problem
from ..problem.goal import name_goal
from ..problem.table import describe_scene
from .bounds import bound_borders
from .candidates import (
    Candidate,
    Failure,
    explain_border,
    leave_in_motion,
    make_candidate,
    measure_link,
    plan_candidate,
)
from .chart import Chart
from .find import CAREFUL, EAGER, Route, Rule, Search
from .goals import is_at
from .links import Link, Measured, Step, describe_steps, leave_at
from .places import make_place
from .result import Alternative, Answer, describe_block, list_blocked

FASTER = 0.7
"""Share of the time of straight ways through cells that plans take at least, by experience."""
TRIED = 6
"""Most routes that are planned in vain by one rule, or beyond those that are asked for."""
BEYOND = 1.1
"""Times of routes, by the search, over that of the best plan, from which on they are left out."""
MOVE = 0.12
"""Share of a border by which the place where it is left is moved at first."""
ELSEWHERE = (0.15, -0.15)
"""The same where a way from the first place has no plan."""
GAIN = 0.998
"""Largest share of a link's time that is worth another plan."""
MEASURED, MORE = 12, 4
"""Most links through cells that are planned for themselves, until there is a plan and after it."""
CHARTS = 4
"""Scenes whose charts are kept."""
_charts: OrderedDict[object, Chart] = OrderedDict()


def find_route(
    problem: Problem,
    objective: str = "time",
    *,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
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
    **options
        As `wholearm.solve` takes them.

    Raises
    ------
    InputError
        If the problem has no goals, or an option is out of its range.
    InfeasibleError
        If nothing leads to a goal; names what blocks the way.
    """
    return find_route_with(
        problem, PlanOptions(objective=objective, **options), alternatives, progress
    )


@exclusive
def find_route_with(
    problem: Problem,
    options: PlanOptions,
    alternatives: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Answer:
    """Find a route with `options` given as one object; see `find_route`."""
    if not problem.goals:
        raise InputError(problem.source, "goal", "is missing; allowed is flush or phi_deg, and x")
    report = progress or (lambda _: None)
    chart, before = get_chart(problem, options), list[Route]()
    for index, goal in enumerate(problem.goals):
        start = problem.start if not before else before[-1].links[-1].stop.z
        place = make_place(problem.scene, start)
        if is_at(place, goal):
            key = name_goal(problem.goals, index, problem.table)
            raise InputError(problem.source, key, f"{goal} holds already where the motion starts")
        search = Search(chart, place, goal)
        wanted = alternatives if index + 1 == len(problem.goals) else 0
        answer = _choose(problem, before, search, options, wanted, report)
        before = [*before, answer.route]
    return answer


def get_chart(problem: Problem, options: PlanOptions) -> Chart:
    """The chart of a problem's scene, kept from one search to the next."""
    known = describe_scene(problem.scene) | {"": (problem.epsilon, options.least_minor)}
    key = json.dumps(known, sort_keys=True)
    chart = _charts.pop(key, None) or Chart(problem, options.least_minor)
    _charts[key] = chart
    while len(_charts) > CHARTS:
        _charts.popitem(last=False)
    return chart


def forget_charts() -> None:
    """Forget what is known of scenes."""
    _charts.clear()


class _Chooser:
    """Routes of a search that are planned, those first that seem best.

    Parameters
    ----------
    problem : Problem
    before : list of Route
        To the goals before.
    search : Search
    options : PlanOptions
    """

    def __init__(
        self, problem: Problem, before: list[Route], search: Search, options: PlanOptions
    ) -> None:
        self.problem, self.before, self.search = problem, before, search
        self.options, self.chart = options, search.chart
        self.made: list[tuple[Plan, Route, Candidate]] = []
        self.failures: list[Failure] = []
        self.measurements = 0

    def run(self, wanted: int, report: Callable[[str], None]) -> None:
        """Plan routes for as long as one may be better, or there are fewer than `wanted`."""
        self._run_by(EAGER, wanted, report)
        # Without a plan by then, the other rule leads elsewhere, and as far.
        most = CAREFUL.most if self.made else EAGER.most
        self._run_by(CAREFUL._replace(most=most), wanted, report)

    def _run_by(self, rule: Rule, wanted: int, report: Callable[[str], None]) -> None:
        """Plan routes as one rule of thumb leads to them."""
        failed = len(self.failures)
        for route in self.search.run(rule):
            if len(self.made) >= wanted and self._estimate(route) > self.best:
                return
            if len(self.failures) - failed >= TRIED or len(self.made) >= TRIED + wanted:
                return
            if not self._measure(route, report):
                continue
            if len(self.made) < wanted or self._estimate(route) < self.best:
                self._plan(route, wanted, report)

    def _polish(self, route: Route, report: Callable[[str], None]) -> None:
        """Leave the borders of a route elsewhere or in motion, where that gains."""
        for link in route.links:
            if link.left is None or link in self.chart.polished:
                continue
            self.chart.polished.add(link)
            report(f"planning {describe_steps(link.steps)} in other ways")
            known = self.chart.measured[link]
            assert isinstance(known, Measured)
            # The planner chooses the place itself where a border is left in motion.
            if not self._try(link, leave_in_motion(known.steps)):
                self._move(link)

    def _move(self, link: Link) -> None:
        """Leave a border elsewhere for as long as that is faster."""
        share, step, better = link.share, MOVE, False
        while abs(step) > MOVE / 3:
            moved = share + step
            if 0.02 < moved < 0.98 and self._try(link, leave_at(link, moved)):
                share, better = moved, True
            else:
                step = -step if step > 0 and not better else -step / 2

    def _try(self, link: Link, steps: tuple[Step, ...]) -> bool:
        """Plan a link with other phases, and take them if it is faster so."""
        found = measure_link(self.problem, link, steps, self.options)
        before = self.chart.measured[link]
        assert isinstance(before, Measured)
        if isinstance(found, Measured) and found.duration < GAIN * before.duration:
            self.chart.measured[link] = found
            return True
        return False

    @property
    def best(self) -> float:
        """Least duration so far [s]."""
        return min((own[0].duration for own in self.made), default=float("inf"))

    def _measure(self, route: Route, report: Callable[[str], None]) -> bool:
        """Plan the links of a route that lead through cells; whether all have a plan."""
        known = self.chart.measured
        for link in route.links:
            if not link.in_cell:
                continue
            if link not in known:
                if self.measurements >= (MORE if self.made else MEASURED):
                    return False
                self.measurements += 1
                report(f"planning {describe_steps(link.steps)}")
                known[link] = self._plan_link(link)
            if isinstance(known[link], str):
                return False
        return True

    def _plan_link(self, link: Link) -> Measured | str:
        """Plan a link through a cell, from other places of its border if that fails."""
        found = measure_link(self.problem, link, link.steps, self.options)
        for move in ELSEWHERE if link.left is not None else ():
            share = link.share + move
            if not isinstance(found, str):
                break
            if 0.02 < share < 0.98:
                steps = leave_at(link, share)
                found = measure_link(self.problem, link, steps, self.options)
        return found

    def _plan(self, route: Route, wanted: int, report: Callable[[str], None]) -> None:
        routes, known = [*self.before, route], self.chart.measured
        candidate = make_candidate(self.problem, routes, known)
        if isinstance(candidate, Candidate):
            self._polish(route, report)
            candidate = make_candidate(self.problem, routes, known)
        if isinstance(candidate, Failure):
            self.failures.append(candidate)
            return
        report(f"planning a route of {len(candidate.problem.phases)} phases")
        plan = plan_candidate(candidate, self.options, self.chart.plans)
        if isinstance(plan, str):
            self.failures.append(Failure(route, plan))
        else:
            self.made.append((plan, route, candidate))
            if len(self.made) >= wanted:
                self.search.limit = BEYOND * self.best

    def _estimate(self, route: Route) -> float:
        """About the least time that a plan along all routes may take [s]."""
        total = 0.0
        for link in (link for own in (*self.before, route) for link in own.links):
            known = self.chart.measured.get(link)
            if isinstance(known, Measured):
                total += known.duration
            else:
                total += FASTER * link.duration if link.in_cell else link.bound
        return total


def _advise(search: Search, problem: Problem, options: PlanOptions) -> str:
    """What single change would open the blocked way that is nearest to the goal."""
    border = next((own for own in list_blocked(search) if len(own.steps) == 1), None)
    return "" if border is None else explain_border(problem, border, options)


def _choose(
    problem: Problem,
    before: list[Route],
    search: Search,
    options: PlanOptions,
    alternatives: int,
    report: Callable[[str], None],
) -> Answer:
    """Plan routes to one goal, and say how good the best one is."""
    chooser, complete = _Chooser(problem, before, search, options), True
    try:
        with yielding():
            report("looking for routes")
            chooser.run(1 + alternatives, report)
    except KeyboardInterrupt:
        if not chooser.made:
            raise
        complete = False
    made, margin = chooser.made, options.goal is Objective.MARGIN
    if not made:
        advice = _advise(search, problem, options)
        raise InfeasibleError(describe_block(search, chooser.failures, advice))
    made.sort(key=lambda own: -own[0].value if margin else own[0].value)
    plan, route, candidate = made[0]
    bound = bound_borders(search, plan.duration) if complete and not before else None
    return Answer(
        plan,
        candidate.problem,
        route,
        bound,
        tuple(Alternative(own[0], own[2].problem) for own in made[1 : 1 + alternatives]),
        tuple(chooser.failures),
        tuple(search.blocked),
        search.settled,
        complete,
    )
