"""Links through cells as they are planned for themselves, and those that leave a border otherwise.

A border is left elsewhere, or in motion, where that is faster.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, TypeVar

from ..common.workers import Task, share
from ..planning.options import PlanOptions
from ..problem.definition import Problem
from .astar import RoadmapRoute
from .edges import Link, describe_steps, leave_at
from .feasibility import Measured, leave_in_motion, measure_link
from .roadmap import Roadmap

FURTHER = 2
"""Guesses of a way through a cell, beyond the first ones, that are looked at for any plan."""
FINEST = 0.03  # Share of a border by which the place where it is left is moved in the end
STEPS = (4, 2, 1)  # How often that, one after the other
ELSEWHERE = (0.15, -0.15)  # The same where a way from the first place has no plan
GAIN = 0.998  # Largest share of a link's time that is worth another plan
INSIDE = 0.02  # Least share of a border before and after the place where it is left

Found = Measured | str
T = TypeVar("T")


class Polisher:
    """Plans of links through cells, and better ones.

    Parameters
    ----------
    chart  which keeps them
    jobs   most processes at the same time
    """

    def __init__(
        self, problem: Problem, chart: Roadmap, options: PlanOptions, jobs: int = 1
    ) -> None:
        self.problem, self.chart, self.options, self.jobs = problem, chart, options, jobs
        self._begun: dict[Link, Found] = {}

    def begin(self, links: Sequence[Link]) -> None:
        """Plan links at the same time, to have them at hand when they are measured."""
        waiting = [own for own in links if own not in self._begun]
        if self.jobs > 1 and len(waiting) > 1:
            found = self._share([partial(self._measure, link) for link in waiting])
            self._begun.update(zip(waiting, found, strict=True))

    def measure(self, link: Link) -> Found:
        """Plan a link through a cell, from other places of its border if that fails."""
        return self._begun.pop(link) if link in self._begun else self._measure(link)

    def polish(self, route: RoadmapRoute, report: Callable[[str], None]) -> None:
        """Leave borders for cells otherwise along a route, and take what is faster."""
        chart = self.chart
        links = [own for own in route.links if own.left and own not in chart.polished]
        chart.polished.update(links)
        for link in links:
            report(f"planning {describe_steps(link.steps)} in other ways")
        found = {link: chart.measured[link] for link in links}
        leaving = [
            Leaving(partial(self._leave, link), best)
            for link, best in found.items()
            if isinstance(best, Measured)
        ]
        if self.jobs > 1 and len(leaving) == 1:
            leaving[0].look_ahead(self._share)
        for link, ways in zip(links, self._share([own.run for own in leaving]), strict=True):
            chart.measured[link], *others = ways
            chart.others.setdefault(link, []).extend(others)

    def _share(self, tasks: Sequence[Task[T]]) -> list[T]:
        return share(tasks, self.jobs, (self.problem, self.problem.scene))

    def _measure(self, link: Link) -> Found:
        given = self.problem, link
        found = measure_link(*given, link.steps, self.options, further=FURTHER)
        for move in ELSEWHERE if link.left else ():
            place = link.share + move
            if not isinstance(found, str):
                break
            if INSIDE < place < 1 - INSIDE:
                found = measure_link(*given, leave_at(link, place), self.options)
        return found

    def _leave(self, link: Link, way: RefinedPath) -> Found:
        """Plan a link that leaves its border in another way."""
        steps = leave_in_motion(link.steps)
        if way.move is not None:
            place = link.share + FINEST * way.move
            if not INSIDE < place < 1 - INSIDE:
                return "it is too near to the end of the border"
            steps = leave_at(link, place)
        given = self.problem, link, steps, self.options
        return measure_link(*given, straight=way.straight, hurried=True)


class RefinedPath(NamedTuple):
    """A way to leave a border for a cell."""

    # how often the place is moved by the finest step; None stands for one left in motion
    move: int | None
    straight: bool = True  # whether it is guessed to cross the cell straight, or to its nearest end


@dataclass
class Leaving:
    """Ways to leave a border for a cell."""

    plan: Callable[[RefinedPath], Found]  # plans a way
    best: Measured  # the plan of what was found at first
    _others: list[Measured] = field(default_factory=list)
    _known: dict[RefinedPath, Found] = field(default_factory=dict)
    _taken: set[RefinedPath] = field(default_factory=lambda: {RefinedPath(0)})

    def look_ahead(self, do: Callable[[Sequence[Task[Found]]], list[Found]]) -> None:
        """Plan what is looked at first in any case, by what does several tasks at the same time."""
        ways = RefinedPath(None), RefinedPath(-STEPS[0]), RefinedPath(STEPS[0])
        found = do([partial(self.plan, own) for own in ways])
        self._known = dict(zip(ways, found, strict=True))

    def run(self) -> list[Measured]:
        """The best way, and others."""
        here = self._move(RefinedPath(0), STEPS[:1])
        # The planner chooses the place of a border that is left in motion: there it may be better
        # where no other place is.
        if here.move or not self._take(RefinedPath(None)):
            here = self._move(here, STEPS[1:])
            if self._take(here._replace(straight=False)):
                self._move(here._replace(straight=False), STEPS[1:])
        return [self.best, *self._others]

    def _move(self, way: RefinedPath, steps: Sequence[int]) -> RefinedPath:
        """Leave the border elsewhere for as long as that is better: most often, sooner."""
        here, towards = way.move or 0, -1
        for step in steps:
            moves = (towards * step, -towards * step)
            while moved := next((m for m in moves if self._take(way._replace(move=here + m))), 0):
                here, towards = here + moved, 1 if moved > 0 else -1
                moves = (moved, -moved)
        return way._replace(move=here)

    def _take(self, way: RefinedPath) -> bool:
        """Look at a way that has not been looked at; whether it is the best one."""
        if way in self._taken:
            return False
        self._taken.add(way)
        found = self._known[way] if way in self._known else self.plan(way)
        if isinstance(found, str):
            return False
        better = found.duration < GAIN * self.best.duration
        self._others.append(self.best if better else found)
        self.best = found if better else self.best
        return better
