"""Plans of the edges of routes, each from rest to rest, and of the phases that are printed.

Edges through cells are first planned alone, on few intervals, for their times and initial guesses.
The plan of an edge depends on the others only by the configurations at its ends. Where an edge
through a cell lands on a border is optimized together with the first phase of the next edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, SolverError, WholearmError, name_source
from ..common.parallel import Task, share
from ..common.sharing import exclusive
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.path_guess import STILL, count_freedoms, find_end
from ..geometry.tracing import CostToGo, split_blocks, trace_phase
from ..mechanics.dynamics import metric_weights
from ..mechanics.speed_sweep import NoMotionError
from ..planning.blocks import BlockPlan, Planning, estimate_time_to_go, plan_next
from ..planning.explain import unadvised
from ..planning.lower_bound import look_along
from ..planning.options import Objective, PlanOptions
from ..planning.phase_plan import PhasePlan, end_of
from ..planning.plan import solve_with
from ..planning.result import Plan
from ..planning.time_domain.time_motion import TimeMotion
from ..problem.definition import ROWS, End, ModeGuess, Phase, Problem
from ..problem.read import read_phase
from ..problem.table import SAME as PRINTED_ANGLE
from ..problem.table import describe_phase
from ..results.plan_record import ROLLS
from ..scene.model import Scene
from .edges import (
    DEPENDENT,
    INTERVALS,
    Edge,
    EdgeStep,
    describe_steps,
    find_headings,
    point_out,
)
from .places import RoadmapPlace, close_place, measure_apart

ROUGH = 1e-2  # accuracy of plans that only estimate durations
# Distances are in radii of gyration and radians.
OFF = 1e-4  # distance of a traced end from a border's end that makes it another one
GUESSED = 1e-6  # guesses are rounded to this, in the same unit, or over the duration
SIGNS = {"+": 1.0, "-": -1.0, ROLLS: 0.0}
POSES = 10  # least number of them, as intervals of a first guess
PINNED = 1e-9  # pinned coordinates of landings are rounded to this, in the same unit
SAME = 9  # decimals of configurations that count as equal, in the same unit
MET = 1e-8  # distance of planned from traced ends of borders that count as equal, in the same unit
Key = tuple[object, ...]
T = TypeVar("T")


class CoarsePlan(NamedTuple):
    """The plan of one edge through a cell."""

    duration: float  # [s]
    steps: tuple[EdgeStep, ...]  # its phases as planned
    # initial guesses: plans in the cell and of a border that is left in motion, on few intervals
    begun: list[PhasePlan[TimeMotion]]


def make_phases(problem: Problem, steps: Sequence[EdgeStep]) -> list[Phase]:
    """Steps as phases."""
    return [
        Phase(k, Formation(problem.scene, step.contacts), step.until, step.end)
        for k, step in enumerate(steps)
    ]


def plan_coarsely(
    problem: Problem,
    edge: Edge,
    steps: tuple[EdgeStep, ...],
    options: PlanOptions,
    further: bool = False,
    straight: bool = True,
    first_only: bool = False,
    to_go: CostToGo | None = None,
) -> CoarsePlan | None:
    """Plan an edge through a cell alone, on few intervals; None if there is no plan.

    Parameters
    ----------
    steps       the edge's, or others between the same places
    further     whether other guesses are tried if the first ones fail
    straight    first guess: straight through the cell; otherwise to the nearest end of the phase
    first_only  whether only the first guess is tried
    to_go       cost of what follows, with regard to which the end is chosen
    """
    from ..planning.time_domain.time_plan import try_phases

    rough = replace(options, objective=Objective.TIME, duration=None, accuracy=ROUGH)
    phases, z, spent = make_phases(problem, steps), edge.start.z, 0.0
    try:
        single = replace(problem, goals=(), phases=tuple(phases))
        if len(phases) > 1 and phases[0].end is End.REST:
            curve = trace_phase(phases[0], z)
            spent = look_along((curve,), problem.epsilon, INTERVALS)
            z, phases = curve.end, phases[1:]
        goal = close_place(edge.stop) if len(phases) == 1 else None
        if goal is None:
            goal = replace(edge.stop, z=find_end(phases[0], z, phases[1:]))
        moved = metric_weights(problem.scene) @ (goal.z - z) ** 2
        if moved < (STILL * problem.scene.scales.length) ** 2:
            return None  # `until` holds already where it starts.
        alone = len(phases) == 1
        towards = goal.z if straight and alone else None
        plans = try_phases(single, phases, z, rough, towards, further and alone, first_only, to_go)
    except (NoMotionError, WholearmError, np.linalg.LinAlgError):
        return None
    if plans is None:
        return None
    return CoarsePlan(spent + sum(plan.motion.duration for plan in plans), steps, plans)


class Lost(str):
    """Why a route has no plan, with the edges for which that is so on every route."""

    # the one whose planning fails, after the one that lands at its start, if any
    edges: tuple[Edge, ...] = ()


def plan_phases(
    problem: Problem,
    options: PlanOptions,
    cache: dict[object, Plan | str],
    report: Callable[[str], None],
) -> Plan | str:
    """The plan of a route's phases, or why there is none; `cache` has those made before."""
    phases = tuple((p.formation.names, p.until, p.end, p.guess) for p in problem.phases)
    key = (tuple(np.round(problem.start, 12).tolist()), phases, repr(options))
    if key not in cache:
        try:
            with unadvised():
                cache[key] = solve_with(problem, options, report)
        except WholearmError as error:
            cache[key] = str(error)
        except np.linalg.LinAlgError:
            cache[key] = DEPENDENT
    return cache[key]


def list_printed(scene: Scene, edges: Sequence[PlannedEdge], guesses: bool) -> tuple[Phase, ...]:
    """The phases of planned edges as they are printed and read again.

    With `guesses` phases over time begin with the modes and poses of their plans, rounded.
    """
    phases = list[Phase]()
    for edge in edges:
        plans = (plan for block in edge.blocks for plan in block.plans)
        for phase, plan in zip(edge.phases, plans, strict=True):
            if guesses and isinstance(plan.motion, TimeMotion):
                phase = replace(phase, guess=_list_modes(plan.motion, scene.scales.length))
            phases.append(read_phase(scene, len(phases), describe_phase(phase, PRINTED_ANGLE)))
    return tuple(phases)


def _list_modes(motion: TimeMotion, length: float) -> tuple[ModeGuess, ...]:
    """Contact modes of a motion, with the poses at their ends and some between."""
    modes = list[ModeGuess]()
    for span in motion.modes:
        signs = tuple(SIGNS[sign] for sign in (*span.contacts.values(), *span.joints))
        # As near to each other as the intervals of a first guess.
        count = math.ceil(POSES * (span.stop - span.start) / motion.duration)
        for time in np.linspace(span.start, span.stop, count + 1)[1:].tolist():
            x, _, phi, *_ = motion.evaluate(np.array([time])).z[0].tolist()
            t, x = _round(time, GUESSED * motion.duration), _round(x, GUESSED * length)
            # In degrees, as it is printed.
            phi = math.radians(_round(math.degrees(phi), math.degrees(GUESSED)))
            modes.append(ModeGuess(t, x, phi, signs))
    return tuple(modes)


def _round(value: float, unit: float) -> float:
    """A value with the decimals of a unit, and no negative zero."""
    return round(value, math.ceil(-math.log10(unit))) + 0.0


Edges = Sequence[tuple[Edge, Sequence[CoarsePlan]]]
"""Edges of a route, each with the plans of it that are known, the fastest first."""
Chosen = tuple[Edge, CoarsePlan | None]  # an edge, and a plan of it as initial guess


@dataclass
class BackgroundTask(Generic[T]):
    """A task that runs beside planning if there is more than one process, and else not at all."""

    task: Task[T]  # without arguments
    result: T | None = None  # what it has returned


@exclusive
def plan_edges(
    problem: Problem,
    edges: Edges,
    options: PlanOptions,
    cache: Cache,
    report: Callable[[str], None],
    jobs: int = 1,
    background: BackgroundTask[Any] | None = None,
) -> list[PlannedEdge] | Lost:
    """Plans of the edges of a route, or why there are none.

    Parameters
    ----------
    edges       one after the other from the problem's start. Where a guess of an edge has no plan,
                or nothing leads on from where it lands, the next one is tried, and at last none,
                with regard to the edge after it.
    cache       plans of edges that were made before, to which others are added
    jobs        most processes that plan edges at the same time
    background  a task for one of these processes
    """
    planner = _EdgePlanner(problem, options.scale_ranges(problem.ranges), cache, report)
    guesses = [[*measured, None] for _, measured in edges]
    with unadvised():
        while True:
            chosen = [(edge, plans[0]) for (edge, _), plans in zip(edges, guesses, strict=True)]
            if jobs > 1:
                planner.plan_parallel(chosen, jobs, background)
                jobs = 1
            planned, reason = planner.plan(chosen)
            if not reason:
                return planned
            # The edge that lands where the culprit starts may have landed at another place.
            first = len(planned)
            first -= first > 0 and edges[first - 1][0].in_cell
            blamed = range(len(planned), first - 1, -1)
            other = next((k for k in blamed if len(guesses[k]) > 1), None)
            if other is None:
                lost = Lost(reason)
                lost.edges = tuple(edge for edge, _ in edges[first : len(planned) + 1])
                return lost
            guesses[other].pop(0)


@dataclass(frozen=True, eq=False)
class _EdgePlanner:
    """Plans the edges of a route, and keeps their plans in a cache."""

    problem: Problem
    options: PlanOptions
    cache: Cache
    report: Callable[[str], None]

    def plan_parallel(
        self, edges: Sequence[Chosen], jobs: int, background: BackgroundTask[Any] | None
    ) -> None:
        """Plan edges in parallel: each part begins with an edge whose start is known."""
        starts = [0, *(k + 1 for k, (edge, _) in enumerate(edges[:-1]) if not edge.in_cell)]
        parts = [range(*ends) for ends in zip(starts, [*starts[1:], len(edges)], strict=True)]
        # The longest tasks first.
        cells = [part for part in parts if any(edges[k][0].in_cell for k in part)]
        parts = [*cells, *(part for part in parts if part not in cells)]
        self.report(f"planning {len(edges)} parts of the route")
        quiet = replace(self, report=lambda _: None)
        tasks: list[Task[Any]] = [partial(quiet._plan_part, edges, part) for part in parts]
        if background:
            tasks.insert(len(cells), background.task)
        results = share(tasks, jobs, (self.problem, self.problem.scene))
        if background:
            background.result = results.pop(len(cells))
        for plans in results:
            self.cache.update(plans)

    def _plan_part(
        self, edges: Sequence[Chosen], part: Sequence[int]
    ) -> dict[Key, PlannedEdge | str]:
        """New entries of the cache after planning some edges one after the other."""
        # Each plan is stored at once, so that an interrupt loses none.
        before = set(self.cache)
        z = edges[part[0]][0].start.z if part[0] else self.problem.start
        for k in part:
            planned = self._plan_cached(edges, k, z)
            if isinstance(planned, str):
                break
            z = planned.end
        return {key: self.cache[key] for key in set(self.cache) - before}

    def plan(self, edges: Sequence[Chosen]) -> tuple[list[PlannedEdge], str]:
        """Plans of edges one after the other, and why the next one has none, if so."""
        z, plans = self.problem.start, list[PlannedEdge]()
        for k, (edge, _) in enumerate(edges):
            apart = measure_apart(self.problem.scene, z, edge.start.z)
            if k and not edges[k - 1][0].in_cell and apart < MET:
                z = edge.start.z  # A border ends at the same place from wherever it starts.
            planned = self._plan_cached(edges, k, z)
            if isinstance(planned, str):
                return plans, f"{describe_steps(edge.steps)}: {planned}"
            plans.append(planned)
            z = planned.end
        return plans, ""

    def _plan_cached(self, edges: Sequence[Chosen], k: int, z: Array) -> PlannedEdge | str:
        """The plan of edge number k from `z`, from the cache if it is there."""
        edge, guess = edges[k]
        following = edges[k + 1][0] if k + 1 < len(edges) else None
        edge = edge if guess is None else replace(edge, steps=guess.steps)
        # A landing is planned with the border that follows, as if that ended at rest.
        lands = edge.in_cell and following is not None and not following.in_cell
        follows = (following.steps[0]._replace(end=End.REST),) if following and lands else ()
        length = self.problem.scene.scales.length
        place = tuple(np.round(z / [length, length, 1, 1, 1], SAME).tolist())
        # Neither samples nor checks of whole plans matter to those of edges.
        settings = repr(replace(self.options, samples=2, replay=False, certify=False))
        key = (place, key_steps(edge.steps), key_steps(follows), guess is None, settings)
        if key not in self.cache:
            self.report(f"planning {describe_steps(edge.steps)}")
            try:
                self.cache[key] = self._plan_edge(edge, follows, guess, z)
            except WholearmError as error:
                self.cache[key] = str(error)
            except np.linalg.LinAlgError:
                self.cache[key] = DEPENDENT
        return self.cache[key]

    def _plan_edge(
        self, edge: Edge, follows: Sequence[EdgeStep], measured: CoarsePlan | None, z: Array
    ) -> PlannedEdge:
        """Plan an edge and the phases that follow, of which only the edge is kept."""
        steps = (*edge.steps, *follows)
        phases, curves = make_phases(self.problem, steps), list[Curve]()
        if not edge.in_cell and len(phases) == 1:
            phases[0], curve = _aim(phases[0], z, edge)
            curves.append(curve)
        single = replace(self.problem, start=z, phases=tuple(phases), goals=())
        count = len(phases) - len(follows)
        planning = Planning(single, tuple(curves), self.options, (), sketches=True)
        with name_source(self.problem.source):
            for part in split_blocks(single):
                first, guess = part[0], None
                if first.index >= count:
                    break
                ends = first.end is not End.REST or first.index == count - 1
                if measured and measured.begun and ends:
                    start = planning.blocks[-1].end if planning.blocks else z
                    guess = BlockPlan(part, start, list(measured.begun), None, coarse=True)
                planning = plan_next(planning, guess, self.report)
        pinned = [
            pin_landing(phase, end_of(plan)[0])
            for phase, plan in zip(phases[:count], planning.plans, strict=True)
        ]
        return PlannedEdge(tuple(pinned), planning.blocks)


@dataclass(frozen=True, eq=False)
class PlannedEdge:
    """The plan of an edge."""

    phases: tuple[Phase, ...]  # counted from the first of the edge
    blocks: tuple[BlockPlan, ...]

    @property
    def end(self) -> Array:
        """Configuration at the end, shape (5,)."""
        return self.blocks[-1].end

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return sum(plan.motion.duration for block in self.blocks for plan in block.plans)


Cache = MutableMapping[Key, PlannedEdge | str]  # plans of edges, or why there are none


def key_steps(steps: Sequence[EdgeStep]) -> Key:
    """Contacts and ends of phases."""
    return tuple((tuple(c.name for c in s.contacts), s.until, s.end.value) for s in steps)


def pin_landing(phase: Phase, z: Array) -> Phase:
    """Add a terminal constraint on x or phi to a phase with two freedoms that lands on a border.

    It is the coordinate that changes most along the border, at the end z (5,), rounded.
    """
    until, formation = phase.until, phase.formation
    if until.contact is None or until.pins or count_freedoms(formation, z) < 2:
        return phase
    length = formation.scene.scales.length
    x, _, phi, *_ = np.abs(find_headings(formation.add(until.contact), z) or np.eye(5))[0]
    name, digits = ("x", length) if x > length * phi else ("phi", 1.0)
    value = _round(float(z[ROWS[name]]), PINNED * digits)
    return replace(phase, until=replace(until, pins=((name, value),)))


def _aim(phase: Phase, z: Array, edge: Edge) -> tuple[Phase, Curve]:
    """The phase of a border's edge from `z` and its curve, which ends where the edge does.

    A contact may be gained both ways along a border; then the end is given by x or phi.
    """
    try:
        curve = trace_phase(phase, z)
        if measure_apart(edge.stop.scene, curve.end, edge.stop.z) <= OFF:
            return phase, curve
    except InputError:
        pass
    other = replace(phase, until=point_out(phase.formation.contacts, edge.stop.z))
    return other, trace_phase(other, z)


def look_ahead(problem: Problem, edge: Edge, place: RoadmapPlace) -> CostToGo | None:
    """Least time [s] along a border's edge of one phase, as a function of where it begins.

    It begins about at `place`; None if that is where the border ends.
    """
    (phase,) = make_phases(problem, edge.steps)
    try:
        phase, _ = _aim(phase, (close_place(place) or place).z, edge)
    except InputError:
        return None
    return estimate_time_to_go(phase, problem.epsilon)


def time_with(to_go: CostToGo | None, plan: CoarsePlan) -> float:
    """Duration [s] of a plan through a cell and of what follows; infinite if nothing does."""
    try:
        return plan.duration + (to_go.value(end_of(plan.begun[-1])[0]) if to_go else 0.0)
    except InputError:
        return plan.duration  # It lands where the border ends.
    except SolverError:
        return math.inf
