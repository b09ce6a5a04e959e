"""Initial guesses of phases in the time domain, their order, and the solution from each.

Contact modes come from the guess or from a homotopy in the friction, regularized by tanh(rate /
onset). Torques held over control periods are a second NLP, from the plan with free torques.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, islice, pairwise
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...common.errors import WholearmError
from ...contacts.elemental import Contact
from ...geometry.arcs import CostToGo
from ...geometry.curve import find_tied
from ...geometry.path_guess import find_end
from ...problem.definition import Phase, Problem
from .collocation import Scheme, make_scheme
from .initial_path import PacedWay, guess_stages, list_ways, pace_way
from .mode_search import (
    LEAST_INTERVALS,
    WORTH,
    StageMode,
    divide,
    drop_gone,
    improve,
    in_mode,
    link,
    merge,
    mode_of,
)
from .search import Price, TimeSearch, TimeSolution
from .stage import Stage, StagePoints, halve, resample, with_controls
from .tightening import DEARER, PATIENCE, enforce_between, is_hopeless

_TRIES = ((1.01, 2), (1.03, 2), (1.07, 3), (1.15, 4), (1.3, 6), (1.6, 8))
"""Durations with held torques to try, over those with free ones, and least numbers of periods."""
_PATIENCE = 80  # most solver iterations with held torques
_BRIEF = 1e-3  # duration, over a period, that counts as zero
_SHORTER = 4  # most times that a period is left out
ONSETS = (0.1, 0.03)  # rates of the friction homotopy, in the scene's unit
HOMOTOPY_ITERATIONS = 50  # most solver iterations for each of them
MOST = 9  # reversals beyond which modes are those of a chattering motion
SLOW = 1e-5  # rate over the largest at the same instant below which its sign is undetermined
STILL = 1e-4  # largest rate at an instant, over that of all, below which all signs are undetermined
BRIEF = 0.02  # least duration of a piece over that of its stage
ROUNDS = 4  # most expansions of the cost-to-go
GAIN = 1e-4  # least relative gain of moving the end
FIRST = 10  # most intervals of a phase to start with
NEAREST = "a motion to the nearest end of the phase"  # name of the first guess
GRADUAL = " with friction that sets in gradually"  # suffix of names where modes are found so
NEAR = -0.3  # margin of a path above which a motion near it may keep its limits
WAYS = 3  # most paths along which a motion is guessed
ATTEMPT = 50  # most iterations of the first solve from a guess; successes take up to 25
FEW = 35  # the same where a plan is known, of up to two phases
SPLIT = 80  # the same in modes of the homotopy and straight to a place; query 3, phase 4: 65
MUCH_DEARER = 3.0  # cost of a plan, over that of the friction homotopy, above which it is rejected
ROUNDING = 5e-7  # largest shortfall of a margin below epsilon by rounding, over the object's weight
FALLS = (2.0, 4.0, 1.0)  # guessed durations, over that of a fall over the path's length
_Turn = tuple[float, tuple[int, ...]]  # place of a reversal, and rows of (contacts, joints)


class Attempt(NamedTuple):
    """An initial guess."""

    name: str
    halvings: int  # of its intervals, after the first solve
    stages: list[Stage]
    homotopy: bool = False  # whether its modes come from the friction homotopy
    before: TimeSolution | None = None  # solution that the stages are from
    most: int = ATTEMPT  # most solver iterations of the first solve


@dataclass(frozen=True, eq=False)
class Attempts:
    """Initial guesses of phases that are one NLP, in their order."""

    problem: Problem
    phases: Sequence[Phase]
    z: Array  # (5,): start
    search: TimeSearch
    to_go: CostToGo | None
    patient: bool  # whether there are others after the first

    @cached_property
    def first(self) -> Attempt:
        """To the nearest end."""
        return Attempt(NEAREST, self._halvings, self._guess(self._halvings, FALLS[0]))

    def resume(self, solution: TimeSolution) -> Attempt:
        """From a solution with nearly the same start."""
        first, *others = solution.stages
        nodes = first.guess.nodes.copy()
        nodes[0, 0] = self.first.stages[0].guess.nodes[0, 0]
        stages = [replace(first, guess=first.guess._replace(nodes=nodes)), *others]
        return Attempt("", self._halvings, self._leave_room(stages), before=solution)

    def begin(self, goal: Array | None = None) -> list[Attempt]:
        """Straight to the given or pinned end of a single phase if limits allow; the nearest."""
        phase = self.phases[0]
        if len(self.phases) > 1 or (goal is None and not phase.until.pins):
            return [self.first]
        goal = find_end(phase, self.z) if goal is None else goal
        way = pace_way(self.problem, phase, self.z, goal)
        if way is None or way.margin <= NEAR:
            return [self.first]
        return [self._follow(way)._replace(most=SPLIT), self.first]

    def _follow(self, way: PacedWay) -> Attempt:
        """Along a path, in its modes."""
        name = f"a straight path that keeps limits with {way.margin:.3g} to spare"
        return Attempt(name, self._halvings, self._guess(self._halvings, FALLS[0], way=way))

    @cached_property
    def ways(self) -> list[PacedWay]:
        """Paths of a single phase, the best first."""
        if not self.patient or len(self.phases) > 1:
            return []
        return list_ways(self.problem, self.phases[0], self.z, WAYS)

    @property
    def are_far(self) -> bool:
        """Whether limits are missed by much along all paths."""
        return bool(self.ways) and all(way.margin <= NEAR for way in self.ways)

    def __iter__(self) -> Iterator[Attempt]:
        """To the nearest end by friction homotopy, and along paths that keep limits.

        Then along paths by friction homotopy, along others in their modes, to the nearest end, and
        there or further ahead with other durations.
        """
        if self.patient:
            yield self.first._replace(name=f"{self.first.name}{GRADUAL}", homotopy=True)
        near = [way for way in self.ways if way.margin > NEAR] or self.ways[:1]
        guesses = [self._follow(way) for way in near]
        sure = sum(way.margin > 0 for way in near)
        yield from guesses[:sure]
        for guess in [] if self.are_far else guesses:
            yield guess._replace(name=f"{guess.name}{GRADUAL}", homotopy=True)
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
        """At most so many of the guesses, without the first."""
        return (attempt for attempt in islice(self, most) if attempt is not self.first)

    @property
    def _intervals(self) -> int:
        """Intervals of each phase: more with one degree of freedom, which has fewer unknowns."""
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
        """The stages, with an end clear of the contact that ends what follows."""
        if self.to_go is None:
            return stages
        return [*stages[:-1], keep_apart(stages[-1], self.to_go.phase.until.contact)]


def solve_attempt(search: TimeSearch, attempt: Attempt) -> TimeSolution:
    """Solve, search modes, choose a free end, refine intervals, and enforce limits in between."""
    stages, least, patience = attempt.stages, math.nan, attempt.most
    if attempt.homotopy:
        solution = find_modes(search, stages)
        if not solution.success:
            return solution
        stages, least, patience = solution.stages, solution.cost, SPLIT
    solution = search.solve(stages, attempt.before, search.wait(patience))
    if not solution.success:
        return solution
    if solution.margin < -ROUNDING:
        # A motion that presses too little may be far from one that presses enough.
        return solution._replace(success=False, status="the largest c_n is below epsilon")
    if 0 < MUCH_DEARER * least < solution.cost or is_hopeless(search, solution):
        return solution._replace(success=False, status=DEARER)
    if search.options.mode_search and not search.has_ample(solution):
        solution = improve(search, solution)
    if search.only_begins:
        return solution
    search, solution = choose_end(search, solution)
    wanted = 2**attempt.halvings * sum(stage.intervals for stage in attempt.stages)
    for _ in range(attempt.halvings):
        # The mode search may have added intervals.
        if solution.success and sum(stage.intervals for stage in solution.stages) < wanted:
            finer = halve(solution.stages, search.scheme)
            solution = search.solve(finer, solution, most=search.wait(PATIENCE))
    solution = enforce_between(search, solution) if solution.success else solution
    fewer = drop_gone(search, solution) if solution.success else solution
    if fewer is not solution:
        # Phase 3 of query 57 does not hold in its replay otherwise.
        fewer = enforce_between(search, fewer)
        if fewer.success and fewer.cost - solution.cost < WORTH * abs(solution.cost):
            solution = fewer
    if solution.success and search.problem.scene.control_period:
        return hold_torques(search, solution)
    return solution


def choose_end(search: TimeSearch, solution: TimeSolution) -> tuple[TimeSearch, TimeSolution]:
    """Add the cost-to-go at the end, expanded to first order, and solve again while that gains.

    Also returns the search with the price of the last end.
    """
    best, least, to_go = (search, solution), None, search.to_go
    if to_go is None:
        return best
    for _ in range(ROUNDS):
        try:
            value, gradient = to_go(solution.end)
        except WholearmError:
            break
        total = solution.cost - search.charge(solution.end) + value
        if least is not None and total > least - GAIN * abs(least):
            break
        least, best = total, (search, solution)
        search = replace(search, price=Price(gradient, solution.end))
        solution = search.solve(solution.stages, solution)
        if not solution.success:
            break
    return best


def keep_apart(stage: Stage, contact: Contact | None) -> Stage:
    """The stage, with its end clear of the contact that ends the next one."""
    rows = [k for k, limit in enumerate(stage.formation.limits) if limit.gains(contact)]
    return replace(stage, apart=tuple(rows), monitored=tuple(sorted({*stage.monitored, *rows})))


def find_modes(search: TimeSearch, stages: Sequence[Stage]) -> TimeSolution:
    """Solution by friction homotopy, with stages in its modes."""
    modes = [mode_of(next(s for s in stages if s.phase == stage.phase)) for stage in stages]
    stages = link(merge([in_mode(*pair) for pair in zip(stages, modes, strict=True)]))
    solution: TimeSolution | None = None
    for onset in ONSETS:
        regular = [replace(stage, onset=onset) for stage in stages]
        solution = search.solve(regular, solution, most=HOMOTOPY_ITERATIONS)
        if not solution.success:
            return solution
        stages = solution.stages
    assert solution is not None
    exact = [replace(stage, onset=0.0) for stage in stages]
    split = link(
        merge([piece for stage in exact for piece in split_by_senses(stage, search.scheme)])
    )
    if len(split) > MOST + len(exact):
        status = "with friction that sets in gradually things turn too often"
        return solution._replace(status=status, success=False)
    return solution._replace(stages=split)


def split_by_senses(stage: Stage, scheme: Scheme) -> list[Stage]:
    """Pieces of a stage without reversals, which have to be linked."""
    part, given = stage.guess, np.array(mode_of(stage).signs)
    rates = stage.measure_senses(part.z.reshape(-1, 5), part.v.reshape(-1, 5))
    rates *= np.concatenate(stage.directions)
    signs, turns = _find_turns(stage, scheme, rates)
    signs[given == 0] = 0.0
    # Reversals that coincide are moved apart.
    widths = np.diff([0.0, *(place for place, _ in turns), 1.0])
    widths = np.maximum(widths, min(BRIEF, 0.5 / len(widths)))
    edges = [0.0, *np.cumsum(widths / widths.sum())[:-1].tolist(), 1.0]
    parts = list[tuple[StagePoints, StageMode]]()
    for (begin, stop), (_, rows) in zip(pairwise(edges), [*turns, (1.0, ())], strict=True):
        count = max(LEAST_INTERVALS, round((stop - begin) * stage.intervals))
        guess = resample(part, scheme, np.linspace(0.0, 1.0, count + 1), begin, stop)
        parts.append((guess, StageMode(tuple(signs.tolist()))))
        signs[list(rows)] *= -1
    return divide(stage, parts)


def _find_turns(stage: Stage, scheme: Scheme, rates: Array) -> tuple[Array, list[_Turn]]:
    """Initial signs of rates, shape (n, n_c + 2), and reversals in order of time.

    A reversal has its place, as share of the stage's duration, and the rows that reverse.
    """
    places, z = stage.guess.places(scheme.points).ravel(), stage.guess.z.reshape(-1, 5)
    sizes = np.abs(rates).max(axis=1)
    clear = (np.abs(rates) > SLOW * sizes[:, None]) & (sizes > STILL * sizes.max())[:, None]
    signs, zeros = np.concatenate(stage.directions), list[tuple[float, int]]()
    for row, rate in enumerate(rates.T):
        points = np.flatnonzero(clear[:, row])
        if not len(points) or row in stage.formation.rolling_rows:
            continue
        signs[row] = np.sign(rate[points[0]])
        for i, j in pairwise(points.tolist()):
            if rate[i] * rate[j] < 0:
                share = rate[i] / (rate[i] - rate[j])
                zeros.append((float(places[i] + share * (places[j] - places[i])), row))
    turns, near = list[_Turn](), 2 * float(np.diff(places).max())
    for place, row in sorted(zeros):
        before, rows = turns[-1] if turns else (-1.0, ())
        at = int(np.abs(places - place).argmin())
        together = find_tied(stage.formation, z[at], row)
        if place - before < near and set(rows) & set(together) - {row}:
            turns[-1] = before, (*rows, row)
        else:
            turns.append((place, (row,)))
    # Where all rows reverse near each other motion stops: that is one reversal.
    joined, count = list[_Turn](), rates.shape[1] - stage.formation.n_rolling
    while turns:
        close = [turn for turn in turns if turn[0] < turns[0][0] + near]
        rows = tuple(row for _, own in close for row in own)
        if len(rows) == len(set(rows)) == count:
            joined.append((close[len(close) // 2][0], rows))
            turns = turns[len(close) :]
        else:
            joined.append(turns.pop(0))
    return signs, joined


def hold_torques(search: TimeSearch, free: TimeSolution) -> TimeSolution:
    """Plan with torques held over control periods, from one with free torques."""
    scene, options = search.problem.scene, search.options
    controls = 2 if scene.control_hold == "linear" else 1
    held = replace(search, scheme=make_scheme(options.scheme, options.degree, controls))
    for stretch, least in _TRIES:
        periods = cut_periods(free.stages, held.scheme, stretch, least)
        solution = held.solve(periods, most=search.wait(_PATIENCE))
        if solution.success:
            solution = enforce_between(held, _leave_out(held, solution))
            if solution.success:
                return solution._replace(error=free.error, free=free)
    status = f"no torques held over {scene.control_hold} periods were found"
    return free._replace(status=status, success=False)


def _leave_out(held: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """The solution without last periods of phases whose duration has vanished."""
    for _ in range(_SHORTER):
        stages, changed = list(solution.stages), False
        for k, (stage, coming) in enumerate(zip(stages, [*stages[1:], None], strict=True)):
            last = coming is None or coming.phase != stage.phase
            part, period = stage.guess, stage.formation.scene.control_period
            brief = part.duration * part.fractions[-1] < _BRIEF * period
            if last and brief and stage.intervals > 1 and stage.periods[-1] != stage.periods[-2]:
                stages[k], changed = _drop_last(stage), True
        if not changed:
            return solution
        fewer = held.solve(stages, most=held.wait(_PATIENCE))
        if not fewer.success or fewer.cost > solution.cost:
            return solution
        solution = fewer
    return solution


def _drop_last(stage: Stage) -> Stage:
    """A stage without its last interval, whose end is that of the one before."""
    part = stage.guess
    left = 1 - part.fractions[-1]
    guess = part._replace(
        **{name: getattr(part, name)[:-1] for name in ("z", "v", "a", "forces", "tau")},
        duration=part.duration * left,
        fractions=part.fractions[:-1] / left,
        nodes=np.delete(part.nodes, -2, axis=0),
    )
    return replace(stage, guess=guess, periods=stage.periods[:-1])


def cut_periods(
    stages: Sequence[Stage], scheme: Scheme, stretch: float, least: int = 1
) -> list[Stage]:
    """Stages whose intervals are periods or parts of them, stretched in time.

    From rest to rest they last at least half a period less than `least` periods.
    """
    cut = list[Stage]()
    period = stages[0].formation.scene.control_period
    whole = sum(stage.guess.duration for stage in stages)
    stretch = max(stretch, (least - 0.5) * period / whole)
    for _, own in groupby(stages, key=lambda stage: stage.phase):
        start = 0.0
        for stage in own:
            stop = start + stretch * stage.guess.duration
            ticks = period * np.arange(math.floor(start / period), math.ceil(stop / period) + 1)
            near = _BRIEF * period
            edges = np.array([start, *ticks[(ticks > start + near) & (ticks < stop - near)], stop])
            numbers = tuple(math.floor((a + b) / 2 / period) for a, b in pairwise(edges.tolist()))
            part = resample(stage.guess, scheme, (edges - start) / (stop - start))
            guess = part._replace(
                duration=stop - start,
                nodes=part.nodes / np.array([[1.0], [stretch]]),
                v=part.v / stretch,
                a=part.a / stretch**2,
            )
            guess = with_controls(guess, scheme.controls)
            cut.append(replace(stage, guess=guess, periods=numbers))
            start = stop
    return cut
