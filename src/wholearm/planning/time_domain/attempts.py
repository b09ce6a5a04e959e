"""Guesses that phases are planned from, one after the other, and what each leads to."""

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
from ...geometry.cost_to_go import CostToGo
from ...geometry.curve import find_tied
from ...geometry.path_guess import find_end
from ...problem.definition import Phase, Problem
from .collocation import Scheme, make_scheme
from .initial_path import PacedWay, list_ways, pace_straight
from .mode_search import drop_gone, improve
from .search import Price, TimeSearch, TimeSolution
from .stage import Stage, StagePoints
from .stage_modes import LEAST_INTERVALS, StageMode, drop, in_mode, link, merge, mode_of
from .stages import guess_stages
from .tightening import DEARER, PATIENCE, enforce_between, is_hopeless
from .time_mesh import halve, resample, with_controls

_TRIES = ((1.01, 2), (1.03, 2), (1.07, 3), (1.15, 4), (1.3, 6), (1.6, 8))
"""Durations of phases with held torques to try, over those with free ones, and least periods."""
_PATIENCE = 80  # most iterations of one solve
_SLIVER = 0.5  # duration of a stage, over a period, below which it is first left out
_BRIEF = 1e-3  # share of a period below which it counts as nothing
_SHORTER = 4  # most times that a period is left out
ONSETS = (0.1, 0.03)  # rates at which friction sets in, one after the other, in the scene's unit
HOMOTOPY_ITERATIONS = 50  # most iterations of the solver for each of them
MOST = 9  # turns beyond which modes are those of a motion that trembles
SLOW = 1e-5  # rate over the largest one at the same instant below which its sign says nothing
STILL = 1e-4  # largest rate at an instant, over that of all, below which none of them says anything
BRIEF = 0.02  # least share of its stage's duration that a piece of it has
ROUNDS = 4  # most times that the cost-to-go is expanded
GAIN = 1e-4  # least gain of moving the end, over the cost of the stages
FIRST = 10  # most intervals of a phase to start with
NEAREST = "a motion to the nearest end of the phase"  # name of the first guess
GRADUAL = " with friction that sets in gradually"
"""What is added to the name of a guess whose modes are found that way."""
NEAR = -0.3  # margin of a way from which on a motion beside it may keep its limits
WAYS = 3  # most ways along which a motion is guessed
ATTEMPT = 50
"""Most iterations of the first run of the solver from a guess: where it leads to a plan it takes 25
or less in one phase."""
FEW = 35  # the same where a plan is known, and others may be better: of up to two phases
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
    """A guess to plan from."""

    name: str
    halvings: int  # how often its intervals are to be halved
    stages: list[Stage]
    gradual: bool = False  # whether friction first sets in gradually, which shows its modes
    before: TimeSolution | None = None  # what has led to the stages
    most: int = ATTEMPT  # most iterations of the first run of the solver


@dataclass(frozen=True, eq=False)
class Attempts:
    """The attempts to plan phases as one NLP, in their order."""

    problem: Problem
    phases: Sequence[Phase]
    z: Array  # (5,): where they start
    search: TimeSearch
    to_go: CostToGo | None  # what follows them
    patient: bool  # whether there are others after the first

    @cached_property
    def first(self) -> Attempt:
        """To the nearest end."""
        return Attempt(NEAREST, self._halvings, self._guess(self._halvings, FALLS[0]))

    def resume(self, found: TimeSolution) -> Attempt:
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


def solve_attempt(search: TimeSearch, attempt: Attempt) -> TimeSolution:
    """Solve, find modes and intervals, halve these, and make limits hold in between."""
    stages, least = attempt.stages, math.nan
    if attempt.gradual:
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
        return hold_torques(search, solution)
    return solution


def choose_end(search: TimeSearch, solution: TimeSolution) -> tuple[TimeSearch, TimeSolution]:
    """Add the cost-to-go at the end, expanded to first order, and solve again while that gains.

    Returns the search with the price of the last end, too.
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
    """The stage, clear of the contact that ends what comes next: that has a way to go."""
    own = [k for k, limit in enumerate(stage.formation.limits) if limit.gains(contact)]
    return replace(stage, apart=tuple(own), monitored=tuple(sorted({*stage.monitored, *own})))


def find_modes(search: TimeSearch, stages: Sequence[Stage]) -> TimeSolution:
    """Solve with friction that sets in gradually; a solution has stages in the modes of that."""
    mode = [mode_of(next(own for own in stages if own.phase == stage.phase)) for stage in stages]
    plain = [in_mode(stage, own) for stage, own in zip(stages, mode, strict=True)]
    joined = link(merge(plain))
    before: TimeSolution | None = None
    for onset in ONSETS:
        begun = joined if before is None else before.stages
        gradual = [replace(stage, onset=onset) for stage in begun]
        solution = search.solve(gradual, before, most=HOMOTOPY_ITERATIONS)
        if not solution.success:
            return solution
        before = solution
    settled = [replace(stage, onset=0.0) for stage in solution.stages]
    pieces = [piece for stage in settled for piece in split_by_senses(stage, search.scheme)]
    stages = link(merge(pieces))
    if len(stages) > MOST + len(settled):
        status = "with friction that sets in gradually things turn too often"
        return solution._replace(status=status, success=False)
    return solution._replace(stages=stages)


class _Turn(NamedTuple):
    """Rows of (contacts, joints) that turn, and at which share of the stage's duration."""

    place: float
    rows: tuple[int, ...]


def split_by_senses(stage: Stage, scheme: Scheme) -> list[Stage]:
    """Pieces of a stage in each of which everything moves one way, one turning after the other.

    They have to be linked.
    """
    part, given = stage.guess, np.array(mode_of(stage).signs)
    rates = stage.measure_senses(part.z.reshape(-1, 5), part.v.reshape(-1, 5))
    rates *= np.concatenate(stage.directions)
    signs, turns = _find_turns(stage, scheme, rates)
    signs[given == 0] = 0.0
    edges, pieces = _spread([turn.place for turn in turns]), list[Stage]()
    for k, (begin, stop) in enumerate(pairwise(edges)):
        count = max(LEAST_INTERVALS, round((stop - begin) * stage.intervals))
        guess = resample(part, scheme, np.linspace(0.0, 1.0, count + 1), begin, stop)
        opens = stage.opens and not pieces
        piece = replace(stage, guess=guess, until=None, ends_in_impact=False, opens=opens)
        pieces.append(in_mode(piece, StageMode(tuple(signs.tolist()))))
        if k < len(turns):
            signs[list(turns[k].rows)] *= -1
    pieces[-1] = replace(pieces[-1], until=stage.until, ends_in_impact=stage.ends_in_impact)
    return pieces


def _find_turns(stage: Stage, scheme: Scheme, rates: Array) -> tuple[Array, list[_Turn]]:
    """The signs of rates, shape (n, n_c + 2), at first, and what turns after that, in its order.

    Of rates that are next to nothing beside others at the same instant the sign says nothing.
    """
    places, z = stage.guess.places(scheme.points).ravel(), stage.guess.z.reshape(-1, 5)
    sizes = np.abs(rates).max(axis=1)
    clear = (np.abs(rates) > SLOW * sizes[:, None]) & (sizes > STILL * sizes.max())[:, None]
    signs, found = np.concatenate(stage.directions), list[tuple[float, int]]()
    for row, own in enumerate(rates.T):
        known = np.flatnonzero(clear[:, row])
        if not len(known) or row in stage.formation.rolling_rows:
            continue
        signs[row] = np.sign(own[known[0]])
        for one, other in pairwise(known.tolist()):
            if own[one] * own[other] < 0:
                share = own[one] / (own[one] - own[other])
                found.append((float(places[one] + share * (places[other] - places[one])), row))
    turns, near = list[_Turn](), 2 * float(np.diff(places).max())
    for place, row in sorted(found):
        last = turns[-1] if turns else None
        at = int(np.abs(places - place).argmin())
        together = find_tied(stage.formation, z[at], row)
        if last and place - last.place < near and set(last.rows) & set(together) - {row}:
            turns[-1] = last._replace(rows=(*last.rows, row))
        else:
            turns.append(_Turn(place, (row,)))
    return signs, _join_stops(turns, near, rates.shape[1] - stage.formation.n_rolling)


def _join_stops(turns: list[_Turn], near: float, count: int) -> list[_Turn]:
    """The turns, those as one where all `count` rows turn `near` each other: there motion stops."""
    joined = list[_Turn]()
    while turns:
        own = [turn for turn in turns if turn.place < turns[0].place + near]
        rows = tuple(row for turn in own for row in turn.rows)
        if len(rows) == len(set(rows)) == count:
            joined.append(_Turn(own[len(own) // 2].place, rows))
            turns = turns[len(own) :]
        else:
            joined.append(turns[0])
            turns = turns[1:]
    return joined


def _spread(places: Sequence[float]) -> list[float]:
    """Ends of pieces between 0 and 1 that turn at `places`, moved apart where these coincide."""
    widths = np.maximum(np.diff([0.0, *places, 1.0]), min(BRIEF, 0.5 / (len(places) + 1)))
    return [0.0, *np.cumsum(widths / widths.sum())[:-1].tolist(), 1.0]


def hold_torques(search: TimeSearch, free: TimeSolution) -> TimeSolution:
    """A plan with torques held over periods, from one with free torques.

    Where none is found the status says so.
    """
    scene = search.problem.scene
    options, count = search.options, 2 if scene.control_hold == "linear" else 1
    held = replace(search, scheme=make_scheme(options.scheme, options.degree, count))
    whole = drop_brief(free.stages)
    others = [free.stages] if len(whole) < len(free.stages) else []
    tries = [(known, *own) for known in (whole, *others) for own in _TRIES]
    for known, stretch, least in tries:
        stages = cut_periods(known, held.scheme, stretch, least)
        solution = held.solve(stages, most=search.wait(_PATIENCE))
        if not solution.success:
            continue
        kept = enforce_between(held, _leave_out(held, solution))
        if kept.success:
            return kept._replace(error=free.error, free=free)
    status = f"no torques held over {scene.control_hold} periods were found"
    return free._replace(status=status, success=False)


def _leave_out(held: TimeSearch, solution: TimeSolution) -> TimeSolution:
    """A solution with fewer periods, where the last one of a phase has shrunk to nothing."""
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
    nodes = part.nodes[:-1].copy()
    nodes[-1] = part.nodes[-1]
    left = 1 - part.fractions[-1]
    tables = {name: getattr(part, name)[:-1] for name in ("z", "v", "a", "forces", "tau")}
    guess = part._replace(
        duration=part.duration * left, fractions=part.fractions[:-1] / left, nodes=nodes, **tables
    )
    return replace(stage, guess=guess, periods=stage.periods[:-1])


def drop_brief(stages: Sequence[Stage]) -> list[Stage]:
    """Stages without those that are much shorter than a period, as far as phases have others."""
    left = list(stages)
    for stage in stages:
        if stage.guess.duration < _SLIVER * stage.formation.scene.control_period:
            fewer = drop(left, left.index(stage))
            left = left if fewer is None else fewer
    return link(merge(left)) if len(left) < len(stages) else left


def cut_periods(
    stages: Sequence[Stage], scheme: Scheme, stretch: float, least: int = 1
) -> list[Stage]:
    """Stages whose intervals are periods, or parts of them, at a duration that is stretched.

    From rest to rest they last at least as many periods as the `least` number, but for a half.
    """
    cut = list[Stage]()
    period = stages[0].formation.scene.control_period
    whole = sum(stage.guess.duration for stage in stages)
    stretch = max(stretch, (least - 0.5) * period / whole)
    for _, own in groupby(stages, key=lambda stage: stage.phase):
        start = 0.0
        for stage in own:
            stop = start + stretch * stage.guess.duration
            cut.append(_cut(stage, scheme, (start, stop), period, stretch))
            start = stop
    return cut


def _cut(
    stage: Stage, scheme: Scheme, span: tuple[float, float], period: float, stretch: float
) -> Stage:
    """One stage, from when to when in its phase."""
    start, stop = span
    ticks = period * np.arange(math.floor(start / period), math.ceil(stop / period) + 1)
    near = _BRIEF * period
    edges = np.array([start, *ticks[(ticks > start + near) & (ticks < stop - near)], stop])
    numbers = tuple(math.floor((a + b) / 2 / period) for a, b in pairwise(edges.tolist()))
    breaks = (edges - start) / (stop - start)
    part = resample(stage.guess, scheme, breaks)
    guess = _slow_down(part, stretch)._replace(duration=stop - start)
    return replace(stage, guess=with_controls(guess, scheme.controls), periods=numbers)


def _slow_down(part: StagePoints, stretch: float) -> StagePoints:
    rate: Array = np.array([[1.0], [stretch]])
    return part._replace(nodes=part.nodes / rate, v=part.v / stretch, a=part.a / stretch**2)
