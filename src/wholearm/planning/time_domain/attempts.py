"""Guesses that phases are planned from, one after the other, and what each leads to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import NamedTuple

from ...common.arrays import Array
from ...geometry.cost_to_go import CostToGo
from ...geometry.path_guess import find_end
from ...problem.definition import Phase, Problem
from .ending import choose_end, keep_apart
from .enforcing import DEARER, PATIENCE, enforce_between, is_hopeless
from .mode_search import drop_gone, improve
from .refinement import halve
from .search import Search, Solution
from .stage import Stage
from .staging import guess_stages
from .way_guess import PacedWay, list_ways, pace_straight

FIRST = 10
"""Most intervals of a phase to start with."""
NEAREST = "a motion to the nearest end of the phase"
"""Name of the first guess."""
GRADUAL = " with friction that sets in gradually"
"""What is added to the name of a guess whose modes are found that way."""
NEAR = -0.3
"""Margin of a way from which on a motion beside it may keep its limits."""
WAYS = 3
"""Most ways along which a motion is guessed."""
ATTEMPT = 50
"""Most iterations of the first run of the solver from a guess: where it leads to a plan it takes 25
or less in one phase."""
FEW = 35
"""The same where a plan is known, and others may be better: of up to two phases."""
SPLIT = 80
"""The same in modes that friction has shown which sets in gradually, with many stages, and straight
to a place: phase 4 of query 3 (`benchmark.queries`) takes 65."""
MUCH_DEARER = 3.0
"""Cost of a plan, over that with friction that sets in gradually, with which it is none."""
ROUNDING = 5e-7
"""Largest shortfall of a margin below epsilon by rounding, over the weight of the object."""
FALLS = (2.0, 4.0, 1.0)
"""Guessed durations to try, over that of a fall over the length of the outlines."""


class Attempt(NamedTuple):
    """A guess to plan from.

    Attributes
    ----------
    name : str
    halvings : int
        How often its intervals are to be halved.
    stages : list of Stage
    gradual : bool
        Whether friction first sets in gradually, which shows its modes.
    before : Solution or None
        What has led to the stages.
    most : int
        Most iterations of the first run of the solver.
    """

    name: str
    halvings: int
    stages: list[Stage]
    gradual: bool = False
    before: Solution | None = None
    most: int = ATTEMPT


@dataclass(frozen=True, eq=False)
class Attempts:
    """The attempts to plan phases as one NLP, in their order.

    Attributes
    ----------
    problem : Problem
    phases : sequence of Phase
    z : ndarray, shape (5,)
        Where they start.
    search : Search
    to_go : CostToGo or None
        What follows them.
    patient : bool
        Whether there are others after the first.
    """

    problem: Problem
    phases: Sequence[Phase]
    z: Array
    search: Search
    to_go: CostToGo | None
    patient: bool

    @cached_property
    def first(self) -> Attempt:
        """To the nearest end."""
        return Attempt(NEAREST, self._halvings, self._guess(self._halvings, FALLS[0]))

    def resume(self, found: Solution) -> Attempt:
        """From what was found from nearly the same place."""
        first = found.stages[0].guess
        nodes = first.nodes.copy()
        nodes[0, 0] = self.first.stages[0].guess.nodes[0, 0]
        stages = [replace(found.stages[0], guess=first._replace(nodes=nodes)), *found.stages[1:]]
        return Attempt("", self._halvings, self._leave_room(stages), before=found)

    def begin(self, goal: Array | None = None) -> list[Attempt]:
        """Straight to the end of a single phase, shape (5,), given or pinned, and to the nearest.

        Not straight where no motion that way is near its limits.
        """
        phase = self.phases[0]
        if len(self.phases) > 1 or (goal is None and not phase.until.pins):
            return [self.first]
        goal = find_end(phase, self.z) if goal is None else goal
        way = pace_straight(self.problem, phase, self.z, goal)
        near = way is not None and way.margin > NEAR
        straight = [self._follow(way)._replace(most=SPLIT)] if way and near else []
        return [*straight, self.first]

    def _follow(self, way: PacedWay) -> Attempt:
        """Along a way, in its modes."""
        stages = self._guess(self._halvings, FALLS[0], way=way)
        return Attempt(
            f"a straight path that keeps limits with {way.margin:.3g} to spare",
            self._halvings,
            stages,
        )

    @cached_property
    def ways(self) -> list[PacedWay]:
        """Ways that a single phase may take, the best first."""
        if not self.patient or len(self.phases) > 1:
            return []
        return list_ways(self.problem, self.phases[0], self.z, WAYS)

    @property
    def are_far(self) -> bool:
        """Whether no way comes near to keeping limits, which shows at once what is short."""
        return bool(self.ways) and all(way.margin <= NEAR for way in self.ways)

    def __iter__(self) -> Iterator[Attempt]:
        """To the nearest end in modes that this leads to, and along ways that keep limits.

        Then along ways in modes that these lead to, along others in their own, to the nearest end,
        and there or further ahead of other durations.
        """
        if self.patient:
            yield self.first._replace(name=f"{self.first.name}{GRADUAL}", gradual=True)
        near = [way for way in self.ways if way.margin > NEAR] or self.ways[:1]
        guesses = [self._follow(way) for way in near]
        sure = sum(way.margin > 0 for way in near)
        yield from guesses[:sure]
        for guess in [] if self.are_far else guesses:
            yield guess._replace(name=f"{guess.name}{GRADUAL}", gradual=True)
        yield from guesses[sure:]
        yield self.first
        onwards = len(self.phases) > 1
        for halvings in dict.fromkeys((self._halvings, 0)) if self.patient else ():
            for falls in FALLS:
                if onwards or halvings != self._halvings or falls != FALLS[0]:
                    end = "one to an end of the phases further on" if onwards else NEAREST
                    name = f"{end}, {falls:g} times as long as a fall over that height"
                    yield Attempt(name, halvings, self._guess(halvings, falls, onwards))

    def list_further(self, most: int) -> Iterator[Attempt]:
        """So many of the attempts to be made after the first, which is not made again."""
        return (own for own in islice(self, most) if own is not self.first)

    @property
    def _intervals(self) -> int:
        """Intervals of each phase: a phase with one freedom has fewer unknowns in each."""
        alone = len(self.phases) == 1 and self.phases[0].formation.n_constraints == 4
        return self.search.options.time_intervals or (32 if alone else 10)

    @property
    def _halvings(self) -> int:
        return max(0, math.ceil(math.log2(self._intervals / FIRST)))

    def _guess(
        self, halvings: int, falls: float, onwards: bool = False, way: PacedWay | None = None
    ) -> list[Stage]:
        count, options = math.ceil(self._intervals / 2**halvings), self.search.options
        given = (self.problem, self.phases, self.z, self.search.scheme, count, falls, onwards)
        stages = [
            replace(stage, opening=options.opening, clearance=options.clearance)
            for stage in guess_stages(*given, way=way)
        ]
        return self._leave_room(stages)

    def _leave_room(self, stages: list[Stage]) -> list[Stage]:
        """The stages, with an end from which what follows has a way to go."""
        if self.to_go is None:
            return stages
        return [*stages[:-1], keep_apart(stages[-1], self.to_go.phase.until.contact)]


def solve_attempt(search: Search, attempt: Attempt) -> Solution:
    """Solve, find modes and intervals, halve these, and make limits hold in between."""
    stages, least = attempt.stages, math.nan
    if attempt.gradual:
        from .gradual import find_modes

        found = find_modes(search, stages)
        if not found.success:
            return found
        stages, least = found.stages, found.cost
    patience = SPLIT if attempt.gradual else attempt.most
    solution = search.solve(stages, attempt.before, search.wait(patience))
    if solution.success and solution.margin < -ROUNDING:
        # A way that presses too little may be far from one that presses enough.
        return solution._replace(success=False, status="the largest c_n is below epsilon")
    if not solution.success:
        return solution
    if 0 < MUCH_DEARER * least < solution.cost or is_hopeless(search, solution):
        return solution._replace(success=False, status=DEARER)
    plain = not search.options.mode_search or search.has_ample(solution)
    better = solution if plain else improve(search, solution)
    if search.only_begins:
        return better
    search, solution = choose_end(search, better)
    wanted = 2**attempt.halvings * sum(stage.intervals for stage in attempt.stages)
    for _ in range(attempt.halvings):
        # Modes that were found may have asked for more intervals than the guess has.
        if solution.success and sum(stage.intervals for stage in solution.stages) < wanted:
            finer = halve(solution.stages, search.scheme)
            solution = search.solve(finer, solution, most=search.wait(PATIENCE))
    solution = enforce_between(search, solution) if solution.success else solution
    fewer = drop_gone(search, solution) if solution.success else solution
    if fewer is not solution:
        # Phase 3 of query 57 does not hold in its replay otherwise.
        fewer = enforce_between(search, fewer)
        solution = fewer if fewer.success else solution
    if solution.success and search.problem.scene.control_period:
        from .held import hold_torques

        return hold_torques(search, solution)
    return solution
