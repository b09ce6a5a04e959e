"""Plans of the edges of routes, and of the phases that are printed.

Edges through cells are first planned alone, on few intervals, for their times and initial guesses.
A route is planned in parts that end with a border, as it ends at the same place from wherever it
starts. Where an edge through a cell lands on a border is optimized together with the first phase of
the next edge.
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
from ..geometry.path_guess import STILL, count_freedoms, find_end
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
from ..planning.options import Objective, PlanOptions
from ..planning.phase_plan import PhasePlan, end_of, runs_along_curves
from ..planning.plan import solve_with
from ..planning.result import Plan
from ..planning.time_domain.time_motion import TimeMotion
from ..problem.definition import ROWS, End, ModeGuess, Phase, Problem
from ..problem.read import read_phase
from ..problem.table import DIGITS, describe_phase
from ..results.trajectory import ROLLS
from ..scene.model import Scene
from .edges import DEPENDENT, Edge, EdgeStep, describe_steps, point_out
from .places import RoadmapPlace, close_place

ROUGH = 1e-2  # accuracy of plans that only estimate durations
# Distances are in radii of gyration and radians.
OFF = 1e-4  # distance of a traced end from a border's end that makes it another one
GUESSED = 1e-6  # guesses are rounded to this, in the same unit, or over the duration
SIGNS = {"+": 1.0, "-": -1.0, ROLLS: 0.0}
POSES = 10  # least number of them, as intervals of a first guess
SLOW = 1.1  # ratio of durations to the coarse plan's that shows another local optimum; query 19
PINNED = 1e-9  # pinned coordinates of landings are rounded to this, in the same unit


class CoarsePlan(NamedTuple):
    """The plan of one edge through a cell."""

    duration: float  # [s]
    steps: tuple[EdgeStep, ...]  # its phases as planned
    # initial guesses: plans in the cell and of a border that is left in motion, on few intervals
    begun: list[PhasePlan[TimeMotion]]


RoutePart = Sequence[tuple[Edge, CoarsePlan | None]]
"""Edges of a route, with plans of those through cells."""
PartPlan = list[tuple[Phase, TimeMotion | None]]
"""Planned phases of a part of a route, with pinned landings, and the motions of those over time."""


def coarsen(options: PlanOptions) -> PlanOptions:
    """Options of coarse plans, which do not depend on the objective and the accuracy."""
    return replace(options, objective=Objective.TIME, duration=None, accuracy=ROUGH, certify=False)


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
    straight: bool = True,
    first_only: bool = False,
    stopped: CoarsePlan | None = None,
    thorough: bool = False,
) -> CoarsePlan | None:
    """Plan an edge through a cell alone, on few intervals; None if there is no plan.

    Parameters
    ----------
    steps       the edge's, or others between the same places
    straight    first guess: straight through the cell; otherwise to the nearest end of the phase
    first_only  whether only the first guess is tried; otherwise all those of a single phase are
    stopped     a plan that stops where it leaves the border, as guess of one that does not
    thorough    whether all guesses of several phases are tried, too
    """
    from ..planning.time_domain.time_plan import try_phases

    rough = coarsen(options)
    phases, z, spent = make_phases(problem, steps), edge.start.z, 0.0
    try:
        single = replace(problem, goals=(), phases=tuple(phases))
        if len(phases) > 1 and phases[0].end is End.REST:
            curve = trace_phase(phases[0], z)
            spent = ImpactSequence(phases[:1], [curve]).estimate(problem.epsilon)
            z, phases = curve.end, phases[1:]
        alone = len(phases) == 1
        closed = close_place(edge.stop) if alone else None
        goal = closed.z if closed else find_end(phases[0], z, phases[1:])
        if measure_speed(problem.scene, goal - z) < STILL * problem.scene.scales.length:
            return None  # `until` holds already where it starts.
        towards = goal if straight and alone else None
        given = list[PhasePlan[TimeMotion]]()
        if stopped is not None:
            (first,) = make_phases(problem, stopped.steps[:1])
            before = try_phases(replace(single, phases=(first,)), [first], z, rough)
            if before is None:
                return None
            given = [*before, *stopped.begun]
        further = (alone or thorough) and not first_only
        plans = try_phases(single, phases, z, rough, towards, further, first_only, given)
    except (WholearmError, np.linalg.LinAlgError):
        return None
    if plans is None:
        return None
    return CoarsePlan(spent + sum(plan.motion.duration for plan in plans), steps, plans)


class Lost(str):
    """Why a route or a part of it has no plan."""

    phases: Sequence[int] = ()  # numbers of its phases that have none, where that is known
    edges: tuple[Edge, ...] = ()  # those of the route for which that is so on every route


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
            cache[key] = lost = Lost(error)
            lost.phases = error.phases
        except np.linalg.LinAlgError:
            cache[key] = DEPENDENT
    return cache[key]


def list_printed(
    scene: Scene, planned: Iterable[tuple[Phase, TimeMotion | None]], guesses: bool
) -> tuple[Phase, ...]:
    """Planned phases as they are printed and read again.

    With `guesses` phases over time begin with the modes and poses of their motions, rounded.
    """
    phases = list[Phase]()
    for phase, motion in planned:
        if guesses and motion:
            phase = replace(phase, guess=_list_modes(motion, scene.scales.length))
        phases.append(read_phase(scene, len(phases), describe_phase(phase, DIGITS)))
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
            t, x = round_to(time, GUESSED * motion.duration), round_to(x, GUESSED * length)
            # In degrees, as it is printed.
            phi = math.radians(round_to(math.degrees(phi), math.degrees(GUESSED)))
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
) -> PartPlan | Lost:
    """Plan edges one after the other from the problem's start, on few intervals; or why not.

    Coarse plans of edges through cells are the initial guesses. Under rate limits torques have to
    hold the object at all ends: case query 26, whose plans with free torques end where none do.
    """
    owners, borders = list[int](), dict[int, Edge]()  # the latter by their phase
    steps = [step for edge, coarse in edges for step in (coarse or edge).steps]
    guesses = dict[int, list[PhasePlan[TimeMotion]]]()  # by the last phase of their block
    for number, (edge, coarse) in enumerate(edges):
        owners += [number] * len((coarse or edge).steps)
        if coarse:
            guesses[len(owners) - 1] = coarse.begun
        elif len(edge.steps) == 1 and not edge.in_cell:
            borders[len(owners) - 1] = edge
    single = replace(problem, phases=tuple(make_phases(problem, steps)), goals=())
    planning, phases = Planning(single, (), options.roughen(), ()), PartPlan()
    try:
        with unadvised(), name_source(problem.source):
            for block in split_blocks(single):
                start = planning.blocks[-1].end if planning.blocks else problem.start
                if block[0].index in borders:
                    # From where the edge before lands: goal 18 of the corpus.
                    block = (_aim(block[0], start, borders[block[0].index]),)
                along = runs_along_curves(block, options)
                if along and not problem.scene.has_slow_motors:
                    chain = trace_block(planning, block, start)
                    chain.estimate(problem.epsilon)  # An error where no motion keeps the limits.
                    phases += [(phase, None) for phase in block]
                    made = BlockPlan(block, start, [], chain)
                    planning = replace(planning, blocks=(*planning.blocks, made))
                    continue
                known, guess = None, guesses.get(block[-1].index)
                if guess:
                    known = BlockPlan(block, start, list(guess), None, coarse=True)
                planning = plan_next(planning, known, report, coarse=True)
                for phase, plan in zip(block, planning.blocks[-1].plans, strict=True):
                    motion = None if along else cast(TimeMotion, plan.motion)
                    phases.append((pin_landing(phase, end_of(plan)[0]), motion))
    except (WholearmError, np.linalg.LinAlgError) as error:
        failed = owners[len(phases)]
        tried = [step for step, owner in zip(steps, owners, strict=True) if owner <= failed]
        reason = str(error) if isinstance(error, WholearmError) else DEPENDENT
        lost = Lost(f"{describe_steps(tried)}: {reason}")
        lost.phases = [len(phases) + 1]
        return lost
    return phases


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
    value = round_to(float(z[ROWS[name]]), PINNED * digits)
    return replace(phase, until=replace(until, pins=((name, value),)))


def free_landings(problem: Problem, numbers: Sequence[int]) -> Problem | None:
    """The problem where landings of phases, by their numbers, end anywhere; None without any.

    The last phase has to end at the goal.
    """
    phases = list(problem.phases)
    for k, phase in enumerate(phases[:-1]):
        if phase.number in numbers and phase.until.contact and phase.until.pins:
            phases[k] = replace(phase, until=replace(phase.until, pins=()), guess=None)
    return replace(problem, phases=tuple(phases)) if phases != [*problem.phases] else None


def list_slow(plan: Plan, planned: PartPlan) -> list[int]:
    """Numbers of a plan's phases that take far longer than the coarse plans that they begin from.

    Case: phase 3 of query 19, whose plan from the coarse one's landing takes 0.28 s, or is none by
    rounding; with a free landing it takes 0.17 s.
    """
    pairs = zip(plan.phases[-len(planned) :], planned, strict=True)
    return [
        phase.number
        for phase, (_, motion) in pairs
        if motion and phase.value > SLOW * motion.duration
    ]


def _aim(phase: Phase, z: Array, edge: Edge) -> Phase:
    """The phase of a border's edge from `z`, which ends where the edge does.

    A contact may be gained both ways along a border; then the end is given by x or phi.
    """
    try:
        away, scene = trace_phase(phase, z).end - edge.stop.z, edge.stop.scene
        if measure_speed(scene, away) <= OFF * scene.scales.length:
            return phase
    except InputError:
        pass
    return replace(phase, until=point_out(phase.formation.contacts, edge.stop.z))


def look_ahead(problem: Problem, edge: Edge, place: RoadmapPlace) -> CostToGo | None:
    """Least time [s] along a border's edge of one phase, as a function of where it begins.

    It begins about at `place`; None if that is where the border ends.
    """
    (phase,) = make_phases(problem, edge.steps)
    try:
        z = (close_place(place) or place).z
        phase = _aim(phase, z, edge)
        trace_phase(phase, z)
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
