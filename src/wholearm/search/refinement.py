"""Edge refinement: plans of links through cells; a pattern search for where they leave borders."""

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

FURTHER = 2  # further guesses of a path through a cell, if the first ones lead to no plan
FINEST = 0.03  # finest step of the place where a border is left, over the border's length
STEPS = (4, 2, 1)  # steps of the pattern search, in the finest one
ELSEWHERE = (0.15, -0.15)  # shifts of the place, over that length, if there is no plan from it
GAIN = 0.998  # largest ratio of durations that counts as a gain
INSIDE = 0.02  # least distance of the place from both ends of the border, over its length

Found = Measured | str
T = TypeVar("T")


class EdgeRefiner:
    """Plans of links through cells, kept in a roadmap, with at most `jobs` processes."""

    def __init__(
        self, problem: Problem, roadmap: Roadmap, options: PlanOptions, jobs: int = 1
    ) -> None:
        self.problem, self.roadmap, self.options, self.jobs = problem, roadmap, options, jobs
        self._prefetched: dict[Link, Found] = {}

    def prefetch(self, links: Sequence[Link]) -> None:
        """Plan links in parallel, for later calls of `measure`."""
        waiting = [link for link in links if link not in self._prefetched]
        if self.jobs > 1 and len(waiting) > 1:
            found = self._share([partial(self._measure, link) for link in waiting])
            self._prefetched.update(zip(waiting, found, strict=True))

    def measure(self, link: Link) -> Found:
        """Plan a link through a cell, from other places of its border if that fails."""
        return self._prefetched.pop(link) if link in self._prefetched else self._measure(link)

    def refine(self, route: RoadmapRoute, report: Callable[[str], None]) -> None:
        """Optimize the places where a route leaves borders for cells."""
        roadmap = self.roadmap
        links = [link for link in route.links if link.left and link not in roadmap.refined]
        roadmap.refined.update(links)
        for link in links:
            report(f"planning {describe_steps(link.steps)} in other ways")
        plans = {link: roadmap.measured[link] for link in links}
        searches = [
            ReleaseSearch(partial(self._release, link), plan)
            for link, plan in plans.items()
            if isinstance(plan, Measured)
        ]
        if self.jobs > 1 and len(searches) == 1:
            searches[0].prefetch(self._share)
        found = self._share([search.run for search in searches])
        for link, (best, *others) in zip(links, found, strict=True):
            roadmap.measured[link] = best
            roadmap.others.setdefault(link, []).extend(others)

    def _share(self, tasks: Sequence[Task[T]]) -> list[T]:
        return share(tasks, self.jobs, (self.problem, self.problem.scene))

    def _measure(self, link: Link) -> Found:
        found = measure_link(self.problem, link, link.steps, self.options, further=FURTHER)
        for move in ELSEWHERE if link.left else ():
            place = link.share + move
            if not isinstance(found, str):
                break
            if INSIDE < place < 1 - INSIDE:
                found = measure_link(self.problem, link, leave_at(link, place), self.options)
        return found

    def _release(self, link: Link, path: RefinedPath) -> Found:
        """Plan a link that leaves its border at another place, or in motion."""
        steps = leave_in_motion(link.steps)
        if path.move is not None:
            place = link.share + FINEST * path.move
            if not INSIDE < place < 1 - INSIDE:
                return "it is too near to the end of the border"
            steps = leave_at(link, place)
        return measure_link(
            self.problem, link, steps, self.options, straight=path.straight, first_only=True
        )


class RefinedPath(NamedTuple):
    """Where a link leaves its border, and the guess of its path through the cell."""

    move: int | None  # shift of the place in finest steps; None: the border is left in motion
    straight: bool = True  # guess: straight through the cell, or to the nearest end of the phase


@dataclass
class ReleaseSearch:
    """Pattern search for the place where a link leaves a border for a cell."""

    plan: Callable[[RefinedPath], Found]
    best: Measured
    _others: list[Measured] = field(default_factory=list)
    _prefetched: dict[RefinedPath, Found] = field(default_factory=dict)
    _tried: set[RefinedPath] = field(default_factory=lambda: {RefinedPath(0)})

    def prefetch(self, execute: Callable[[Sequence[Task[Found]]], list[Found]]) -> None:
        """Plan the first candidates in parallel."""
        paths = RefinedPath(None), RefinedPath(-STEPS[0]), RefinedPath(STEPS[0])
        found = execute([partial(self.plan, path) for path in paths])
        self._prefetched = dict(zip(paths, found, strict=True))

    def run(self) -> list[Measured]:
        """The fastest plan, followed by the others."""
        path = self._move(RefinedPath(0), STEPS[:1])
        # In motion the planner chooses the place: tried first where no shift has gained anything.
        if path.move or not self._try(RefinedPath(None)):
            path = self._move(path, STEPS[1:])
            if self._try(path._replace(straight=False)):
                self._move(path._replace(straight=False), STEPS[1:])
        return [self.best, *self._others]

    def _move(self, path: RefinedPath, steps: Sequence[int]) -> RefinedPath:
        """Shift the place for as long as that gains; first towards the start of the border."""
        place, sign = path.move or 0, -1
        for step in steps:
            moves = (sign * step, -sign * step)
            while moved := next((m for m in moves if self._try(path._replace(move=place + m))), 0):
                place, sign = place + moved, 1 if moved > 0 else -1
                moves = (moved, -moved)
        return path._replace(move=place)

    def _try(self, path: RefinedPath) -> bool:
        """Plan a path that has not been tried; whether it is the fastest one."""
        if path in self._tried:
            return False
        self._tried.add(path)
        found = self._prefetched[path] if path in self._prefetched else self.plan(path)
        if isinstance(found, str):
            return False
        better = found.duration < GAIN * self.best.duration
        self._others.append(self.best if better else found)
        self.best = found if better else self.best
        return better
