"""Links that leave a border for a cell, left elsewhere or in motion where that is faster."""

from __future__ import annotations

from collections.abc import Callable

from ..planning.options import PlanOptions
from ..problem.definition import Problem
from .chart import Chart
from .find import Route
from .links import Link, Step, describe_steps, leave_at
from .measure import Measured, leave_in_motion, measure_link

FURTHER = 2
"""Guesses of a way through a cell, beyond the first ones, that are looked at for any plan."""
MOVE = 0.12
"""Share of a border by which the place where it is left is moved at first."""
FINEST = 0.025
"""Least share by which it is moved."""
ELSEWHERE = (0.15, -0.15)
"""The same where a way from the first place has no plan."""
GAIN = 0.998
"""Largest share of a link's time that is worth another plan."""
INSIDE = 0.02
"""Least share of a border before and after the place where it is left."""


class Polisher:
    """Plans of links through cells, and better ones.

    Parameters
    ----------
    problem : Problem
    chart : Chart
        Which keeps them.
    options : PlanOptions
    """

    def __init__(self, problem: Problem, chart: Chart, options: PlanOptions) -> None:
        self.problem, self.chart, self.options = problem, chart, options

    def measure(self, link: Link) -> Measured | str:
        """Plan a link through a cell, from other places of its border if that fails."""
        found = self._measure(link, link.steps, further=FURTHER)
        for move in ELSEWHERE if link.left is not None else ():
            share = link.share + move
            if not isinstance(found, str):
                break
            if INSIDE < share < 1 - INSIDE:
                found = self._measure(link, leave_at(link, share))
        return found

    def polish(self, route: Route, report: Callable[[str], None]) -> None:
        """Plan the ways of a route through cells otherwise, and take what is faster.

        From another guess, and with the border that they leave left in motion or elsewhere.
        """
        for link in route.links:
            if not link.in_cell or link in self.chart.polished:
                continue
            self.chart.polished.add(link)
            report(f"planning {describe_steps(link.steps)} in other ways")
            known = self.chart.measured[link]
            assert isinstance(known, Measured)
            other = self._measure(link, known.steps, False)
            self._take(link, other)
            # The planner chooses the place itself where a border is left in motion.
            moving = leave_in_motion(known.steps)
            if link.left is not None and not self._take(link, self._measure(link, moving)):
                self._move(link, (True,) if isinstance(other, str) else (True, False))

    def _move(self, link: Link, guesses: tuple[bool, ...]) -> None:
        """Leave a border elsewhere for as long as that is faster, by guesses that are straight."""
        share, step, better = link.share, MOVE, False
        while abs(step) > FINEST:
            moved = share + step
            inside, steps = INSIDE < moved < 1 - INSIDE, leave_at(link, moved)
            found = [self._measure(link, steps, own) for own in guesses] if inside else []
            if any([self._take(link, own) for own in found]):
                share, better = moved, True
            else:
                step = -step if step > 0 and not better else -step / 2

    def _take(self, link: Link, found: Measured | str) -> bool:
        """Take a plan of a link if it is faster."""
        before = self.chart.measured[link]
        assert isinstance(before, Measured)
        if isinstance(found, str):
            return False
        if found.duration >= GAIN * before.duration:
            self.chart.others.setdefault(link, []).append(found)
            return False
        self.chart.others.setdefault(link, []).append(before)
        self.chart.measured[link] = found
        return True

    def _measure(
        self, link: Link, steps: tuple[Step, ...], straight: bool = True, further: int = 0
    ) -> Measured | str:
        return measure_link(self.problem, link, steps, self.options, straight, further)
