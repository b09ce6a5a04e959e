"""Plans of the edges of routes, and of the printed phases.

Edges through cells are first planned alone, on few intervals, for their times and initial guesses.
A route is planned in parts that end with a border, whose end does not depend on its start. The
landing of an edge through a cell on a border is optimized together with the first phase of the next
edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from ..common.arrays import Array, round_to
from ..common.errors import InputError, SolverError, WholearmError, name_source
from ..common.sharing import exclusive
from ..contacts.formation import Formation
from ..geometry.path_guess import MIN_DISTANCE, count_freedoms, find_end
from ..geometry.tracing import CostToGo, find_headings, split_blocks, trace_phase
from ..mechanics.dynamics import measure_speed
from ..planning.blocks import (
    BlockPlan,
    ImpactSequence,
    Planning,
    estimate_time_to_go,
    plan_next,
    trace_block,
)
from ..planning.explain import unadvised
from ..planning.options import PlanOptions
from ..planning.phase_plan import PhasePlan, end_of, runs_along_curves
from ..planning.plan import solve_with
from ..planning.result import Plan
from ..planning.time_domain.time_motion import TimeMotion
from ..problem.definition import ROWS, End, ModeGuess, Phase, Problem
from ..problem.read import read_phase
from ..problem.table import DIGITS, describe_phase
from ..results.trajectory import ROLLS
from ..scene.model import Scene
from .edges import DEPENDENT, Edge, EdgeStep, describe_steps, end_at_pose
from .places import RoadmapPlace, close_place

COARSE = 1e-2  # accuracy of plans that only estimate durations
# Distances are in radii of gyration and radians.
END_TOLERANCE = 1e-4  # distance beyond which a traced end is not the end of the border
GUESS_STEP = 1e-6  # rounding of guesses, in the same unit, or over the duration
SIGNS = {"+": 1.0, "-": -1.0, ROLLS: 0.0}
MIN_POSES = 10  # least number of poses of a motion in guesses
SLOW_RATIO = 1.1  # ratio of a duration to the coarse plan's of another local optimum; query 19
PIN_STEP = 1e-9  # rounding of pinned coordinates of landings, in the same unit


class CoarsePlan(NamedTuple):
    """The plan of one edge through a cell."""

    duration: float  # [s]
    steps: tuple[EdgeStep, ...]  # its phases as planned
    # initial guesses: plans in the cell and of a border left without a stop, on few intervals
    guesses: list[PhasePlan[TimeMotion]]


RoutePart = Sequence[tuple[Edge, CoarsePlan | None]]
"""Edges of a route, with plans of those through cells."""
PartPlan = list[tuple[Phase, TimeMotion | None]]
"""Planned phases of a part of a route, with pinned landings, and motions in the time domain."""


def coarsen(options: PlanOptions) -> PlanOptions:
    """Options of coarse plans, which do not depend on the objective and the accuracy."""
    return replace(options.for_least_time(), accuracy=COARSE, certify=False)


def make_phases(problem: Problem, steps: Sequence[EdgeStep]) -> list[Phase]:
    """Phases of steps."""
    return [
        Phase(k, Formation(problem.scene, step.contacts), step.until, step.end)
        for k, step in enumerate(steps)
    ]


def plan_coarsely(
    problem: Problem,
    edge: Edge,
    steps: tuple[EdgeStep, ...],
    options: PlanOptions,
    straight: bool = True,
    first_only: bool = False,
    stop_plan: CoarsePlan | None = None,
    all_guesses: bool = False,
) -> CoarsePlan | None:
    """Plan an edge through a cell alone, on few intervals; None if there is no plan.

    Parameters
    ----------
    steps        steps of the edge, or others between the same places
    straight     first guess: straight through the cell; otherwise to the nearest end of the phase
    first_only   whether only the first guess is tried; otherwise all guesses of a single phase are
    stop_plan    plan that stops on the border, as guess of one that leaves it without a stop
    all_guesses  whether all guesses of several phases are tried, too
    """
    from ..planning.time_domain.time_plan import try_phases

    coarse_options = coarsen(options)
    phases, z, border_time = make_phases(problem, steps), edge.start.z, 0.0
    try:
        single = replace(problem, goals=(), phases=tuple(phases))
        if len(phases) > 1 and phases[0].end is End.REST:
            curve = trace_phase(phases[0], z)
            border_time = ImpactSequence(phases[:1], [curve]).estimate(problem.epsilon)
            z, phases = curve.end, phases[1:]
        one_phase = len(phases) == 1
        closed = close_place(edge.stop) if one_phase else None
        goal = closed.z if closed else find_end(phases[0], z, phases[1:])
        if measure_speed(problem.scene, goal - z) < MIN_DISTANCE * problem.scene.scales.length:
            return None  # `until` holds already at the start.
        target = goal if straight and one_phase else None
        guesses = list[PhasePlan[TimeMotion]]()
        if stop_plan is not None:
            (first,) = make_phases(problem, stop_plan.steps[:1])
            border_plans = try_phases(replace(single, phases=(first,)), [first], z, coarse_options)
            if border_plans is None:
                return None
            guesses = [*border_plans, *stop_plan.guesses]
        try_all = (one_phase or all_guesses) and not first_only
        plans = try_phases(single, phases, z, coarse_options, target, try_all, first_only, guesses)
    except (WholearmError, np.linalg.LinAlgError):
        return None
    if plans is None:
        return None
    return CoarsePlan(border_time + sum(plan.motion.duration for plan in plans), steps, plans)


class PlanFailure(str):
    """Reason why a route or a part of it has no plan."""

    phases: Sequence[int] = ()  # numbers of its phases without a plan, if known
    edges: tuple[Edge, ...] = ()  # edges that have no plan on any route


def plan_phases(
    problem: Problem,
    options: PlanOptions,
    cache: dict[object, Plan | str],
    report: Callable[[str], None],
) -> Plan | str:
    """The plan of a route's phases, or why there is none; `cache` stores both."""
    phases = tuple((p.formation.names, p.until, p.end, p.guess) for p in problem.phases)
    key = (tuple(np.round(problem.start, 12).tolist()), phases, repr(options))
    if key not in cache:
        try:
            with unadvised():
                cache[key] = solve_with(problem, options, report)
        except WholearmError as error:
            cache[key] = failure = PlanFailure(error)
            failure.phases = error.phases
        except np.linalg.LinAlgError:
            cache[key] = DEPENDENT
    return cache[key]


def round_phases(
    scene: Scene, planned: Iterable[tuple[Phase, TimeMotion | None]], guesses: bool
) -> tuple[Phase, ...]:
    """Planned phases with the rounding of printed ones.

    With `guesses`, those over time have modes and poses of their motions as initial guesses.
    """
    phases = list[Phase]()
    for phase, motion in planned:
        if guesses and motion:
            phase = replace(phase, guess=_list_modes(motion, scene.scales.length))
        phases.append(read_phase(scene, len(phases), describe_phase(phase, DIGITS)))
    return tuple(phases)


def _list_modes(motion: TimeMotion, length: float) -> tuple[ModeGuess, ...]:
    """Contact modes of a motion, divided so that there are `MIN_POSES` poses or more."""
    modes = list[ModeGuess]()
    for span in motion.modes:
        signs = tuple(SIGNS[sign] for sign in (*span.contacts.values(), *span.joints))
        # The distances are those of the intervals of a first guess.
        count = math.ceil(MIN_POSES * (span.stop - span.start) / motion.duration)
        for time in np.linspace(span.start, span.stop, count + 1)[1:].tolist():
            x, _, phi, *_ = motion.evaluate(np.array([time])).z[0].tolist()
            t, x = round_to(time, GUESS_STEP * motion.duration), round_to(x, GUESS_STEP * length)
            # Rounded in degrees, as printed.
            phi = math.radians(round_to(math.degrees(phi), math.degrees(GUESS_STEP)))
            modes.append(ModeGuess(t, x, phi, signs))
    return tuple(modes)


def split_route(edges: Sequence[Edge]) -> list[list[Edge]]:
    """Parts of a route, each but the last with one edge along borders, its last."""
    parts = [list[Edge]()]
    for edge in edges:
        if parts[-1] and not parts[-1][-1].in_cell:
            parts.append([])
        parts[-1].append(edge)
    return parts


@exclusive
def plan_part(
    problem: Problem, edges: RoutePart, options: PlanOptions, report: Callable[[str], None]
) -> PartPlan | PlanFailure:
    """Plan edges one after the other from the problem's start, on few intervals, or return why not.

    Coarse plans of edges through cells are the initial guesses. With rate limits, torques have to
    hold the object at all ends. Case: query 26, whose plans with free torques end where none do.
    """
    owners, borders = list[int](), dict[int, Edge]()  # edge of each phase; borders by phase
    steps = [step for edge, coarse in edges for step in (coarse or edge).steps]
    guesses = dict[int, list[PhasePlan[TimeMotion]]]()  # by the last phase of their block
    for number, (edge, coarse) in enumerate(edges):
        owners += [number] * len((coarse or edge).steps)
        if coarse:
            guesses[len(owners) - 1] = coarse.guesses
        elif len(edge.steps) == 1 and not edge.in_cell:
            borders[len(owners) - 1] = edge
    single = replace(problem, phases=tuple(make_phases(problem, steps)), goals=())
    planning, phases = Planning(single, (), options.roughen(), ()), PartPlan()
    try:
        with unadvised(), name_source(problem.source):
            for block in split_blocks(single):
                start = planning.blocks[-1].end if planning.blocks else problem.start
                if block[0].index in borders:
                    # From the landing of the edge before. Case: goal 18 of the corpus.
                    block = (_adapt_end(block[0], start, borders[block[0].index]),)
                on_curves = runs_along_curves(block, options)
                if on_curves and not problem.scene.has_slow_motors:
                    chain = trace_block(planning, block, start)
                    chain.estimate(problem.epsilon)  # An error if no motion keeps the limits.
                    phases += [(phase, None) for phase in block]
                    block_plan = BlockPlan(block, start, [], chain)
                    planning = replace(planning, blocks=(*planning.blocks, block_plan))
                    continue
                initial, guess = None, guesses.get(block[-1].index)
                if guess:
                    initial = BlockPlan(block, start, list(guess), None, coarse=True)
                planning = plan_next(planning, initial, report, coarse=True)
                for phase, plan in zip(block, planning.blocks[-1].plans, strict=True):
                    motion = None if on_curves else cast(TimeMotion, plan.motion)
                    phases.append((pin_landing(phase, end_of(plan)[0]), motion))
    except (WholearmError, np.linalg.LinAlgError) as error:
        failed = owners[len(phases)]
        failed_steps = [step for step, owner in zip(steps, owners, strict=True) if owner <= failed]
        reason = str(error) if isinstance(error, WholearmError) else DEPENDENT
        failure = PlanFailure(f"{describe_steps(failed_steps)}: {reason}")
        failure.phases = [len(phases) + 1]
        return failure
    return phases


def pin_landing(phase: Phase, z: Array) -> Phase:
    """The phase with a terminal constraint on x or phi, if it lands on a border with two freedoms.

    The constraint is on the coordinate that changes most along the border, at z (5,), rounded.
    """
    until, formation = phase.until, phase.formation
    if until.contact is None or until.pins or count_freedoms(formation, z) < 2:
        return phase
    length = formation.scene.scales.length
    x, _, phi, *_ = np.abs(find_headings(formation.add(until.contact), z) or np.eye(5))[0]
    name, digits = ("x", length) if x > length * phi else ("phi", 1.0)
    value = round_to(float(z[ROWS[name]]), PIN_STEP * digits)
    return replace(phase, until=replace(until, pins=((name, value),)))


def free_landings(problem: Problem, numbers: Sequence[int]) -> Problem | None:
    """The problem without terminal constraints on landings of phases `numbers`; None if unchanged.

    The last phase has to end at the goal.
    """
    phases = list(problem.phases)
    for k, phase in enumerate(phases[:-1]):
        if phase.number in numbers and phase.until.contact and phase.until.pins:
            phases[k] = replace(phase, until=replace(phase.until, pins=()), guess=None)
    return replace(problem, phases=tuple(phases)) if phases != [*problem.phases] else None


def list_slow_phases(plan: Plan, planned: PartPlan) -> list[int]:
    """Numbers of a plan's phases that take far longer than in the coarse plans.

    Case: phase 3 of query 19. With the landing of the coarse plan it takes 0.28 s, or (by rounding)
    has no plan; with a free landing it takes 0.17 s.
    """
    pairs = zip(plan.phases[-len(planned) :], planned, strict=True)
    return [
        phase.number
        for phase, (_, motion) in pairs
        if motion and phase.value > SLOW_RATIO * motion.duration
    ]


def _adapt_end(phase: Phase, z: Array, edge: Edge) -> Phase:
    """The phase of an edge along a border, from `z`, with the same end as the edge.

    If the contact would be gained elsewhere (in the other direction), the end is at x or phi.
    """
    try:
        deviation, scene = trace_phase(phase, z).end - edge.stop.z, edge.stop.scene
        if measure_speed(scene, deviation) <= END_TOLERANCE * scene.scales.length:
            return phase
    except InputError:
        pass
    return replace(phase, until=end_at_pose(phase.formation.contacts, edge.stop.z))


def find_time_to_go(problem: Problem, edge: Edge, place: RoadmapPlace) -> CostToGo | None:
    """Cost-to-go: least time [s] along an edge of one phase on a border, as function of its start.

    The start is near `place`; None if the border ends there.
    """
    (phase,) = make_phases(problem, edge.steps)
    try:
        z = (close_place(place) or place).z
        phase = _adapt_end(phase, z, edge)
        trace_phase(phase, z)
    except InputError:
        return None
    return estimate_time_to_go(phase, problem.epsilon)


def add_time_to_go(to_go: CostToGo | None, plan: CoarsePlan) -> float:
    """Duration [s] of a plan through a cell plus the cost-to-go; infinite if that has no value."""
    try:
        return plan.duration + (to_go.value(end_of(plan.guesses[-1])[0]) if to_go else 0.0)
    except InputError:
        return plan.duration  # It lands at the end of the border.
    except SolverError:
        return math.inf
