"""Routes put together from their links, each planned once from rest to rest, and kept.

What ends at rest says nothing of what follows but where that starts, so that links are planned one
by one. Where a link lands on a border is left open: it is chosen with regard to the next link.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, ReplayError, WholearmError, name_source
from ..common.sharing import exclusive
from ..common.workers import Task, share
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.path_guess import count_freedoms
from ..geometry.tracing import trace_phase
from ..planning.advice import unadvised
from ..planning.block_plan import BEGUN, BlockPlan, Planning
from ..planning.blocks import plan_next
from ..planning.options import PlanOptions
from ..planning.plan import assemble_plan, finish_plan
from ..planning.replay_check import Checked
from ..planning.result import Plan
from ..planning.stops import end_of, split_blocks
from ..problem.definition import ROWS, End, Phase, Problem
from ..scene.model import Scene
from ..solvers.statistics import SolverStatistics, open_ledger
from .candidates import Lost
from .edges import EdgeStep, Link, describe_steps, find_headings, point_out
from .feasibility import SINGULAR, Measured, make_phases
from .places import measure_apart

OFF = 1e-4
"""Distance from the end of a border's link from which on it is another end, in radii of gyration or
radians."""
PINNED = 1e-9  # Coordinates at which landings are pinned are rounded to this, in the same unit
SAME = 9  # Decimals of configurations that are one, in the same unit
Key = tuple[object, ...]
MET = 1e-8
"""Largest distance of a border's end as planned from the same end as found, in radii of gyration or
radians."""
T = TypeVar("T")
Links = Sequence[tuple[Link, Sequence[Measured]]]
"""Links of a route, with the ways in which those through cells can be gone."""
Chosen = tuple[Link, Measured | None]  # A link, and what is begun of it


@dataclass
class Aside(Generic[T]):
    """What is done beside planning, where there is a process for it, and else is not."""

    task: Task[T]  # without arguments
    result: T | None = None  # what it has returned


def can_join(problem: Problem, options: PlanOptions) -> bool:
    """Whether plans from rest to rest make the plan that is asked for.

    Only of least time, where torques may change at any instant, and at once.
    """
    scene = problem.scene
    return options.goal.value == "time" and not (scene.has_slow_motors or scene.control_period)


@exclusive
def join_route(
    problem: Problem,
    links: Links,
    options: PlanOptions,
    kept: Kept,
    report: Callable[[str], None],
    jobs: int = 1,
    aside: Aside[Any] | None = None,
) -> Plan | str:
    """The plan of a route, from plans of its links, or why there is none.

    Parameters
    ----------
    links  one after the other from the problem's start, with the ways in which those through cells
           can be gone, the best first. Where a plan does not hold, or nothing leads on from where
           it lands, the next one is taken, and at last one that is planned from guesses of its own,
           with regard to the link after it.
    kept   plans of links that were made before, to which others are added
    jobs   most processes that plan links at the same time
    aside  what else is to be done then
    """
    options = options.scale_ranges(problem.ranges)
    begun = time.perf_counter()
    ways, culprit = [[*measured, None] for _, measured in links], None
    try:
        with unadvised():
            first = [(link, way[0]) for (link, _), way in zip(links, ways, strict=True)]
            _plan_ahead(problem, first, options, kept, report, jobs, aside)
            while True:
                own = [(link, way[0]) for (link, _), way in zip(links, ways, strict=True)]
                planned, reason = _plan_links(problem, own, options, kept, report)
                if reason:
                    culprit = len(planned)
                    if _try_other(links, ways, culprit):
                        continue
                    return Lost.at(_blame(links, culprit), reason)
                made, checked = _put_together(problem, planned, options), None
                if options.replay:
                    report("replaying the plan")
                    checked = Checked.of(made.problem, assemble_plan(made))
                    owners = [k for k, own in enumerate(planned) for _ in own.phases]
                    culprit = None if checked.culprit is None else owners[checked.culprit - 1]
                    holds = checked.usually.failure is None
                    if culprit is not None and not holds and len(ways[culprit]) > 1:
                        ways[culprit].pop(0)
                        continue
                try:
                    with open_ledger() as ledger:
                        for number, cost in enumerate((c for own in planned for c in own.costs), 1):
                            ledger.add(number, cost)
                        return finish_plan(made, report, ledger, (begun, begun), checked)
                except ReplayError:
                    if culprit is None or not _land_anew(links, ways, culprit):
                        raise
    except WholearmError as error:
        return str(error) if culprit is None else Lost.at(_blame(links, culprit), str(error))
    except np.linalg.LinAlgError:
        return SINGULAR


def _blame(links: Links, culprit: int) -> tuple[Link, ...]:
    """A link that has no plan, behind the one that lands where it starts, if any."""
    first = culprit - 1 if culprit and links[culprit - 1][0].in_cell else culprit
    return tuple(link for link, _ in links[first : culprit + 1])


def _try_other(links: Links, ways: list[list[Measured | None]], culprit: int) -> bool:
    """Go on to another way of a link that has no plan, or of the one that lands where it starts."""
    for k in range(culprit, culprit - len(_blame(links, culprit)), -1):
        if len(ways[k]) > 1:
            ways[k].pop(0)
            return True
    return False


def _land_anew(links: Links, ways: list[list[Measured | None]], culprit: int) -> bool:
    """Choose a landing with regard to the border after it, whose plan does not hold, if one is."""
    landing = culprit - 1
    if len(_blame(links, culprit)) == 1 or len(ways[landing]) == 1:
        return False
    del ways[landing][:-1]
    return True


def _plan_ahead(
    problem: Problem,
    links: Sequence[Chosen],
    options: PlanOptions,
    kept: Kept,
    report: Callable[[str], None],
    jobs: int,
    aside: Aside[Any] | None,
) -> None:
    """Keep plans of all links whose starts are known, and of those after them, at the same time."""
    if jobs == 1:
        return
    starts = [0, *(k + 1 for k, (link, _) in enumerate(links[:-1]) if not link.in_cell)]
    parts = [range(*ends) for ends in zip(starts, [*starts[1:], len(links)], strict=True)]
    # What takes longest comes first.
    cells = [own for own in parts if any(links[k][0].in_cell for k in own)]
    parts = [*cells, *(own for own in parts if own not in cells)]
    report(f"planning {len(links)} parts of the route")
    tasks: list[Task[Any]]
    tasks = [partial(_plan_part, problem, links, own, options, kept) for own in parts]
    if aside:
        tasks.insert(len(cells), aside.task)
    found = share(tasks, jobs, (problem, problem.scene))
    if aside:
        aside.result = found.pop(len(cells))
    for own in found:
        kept.update(own)


def _plan_part(
    problem: Problem, links: Sequence[Chosen], part: Sequence[int], options: PlanOptions, kept: Kept
) -> dict[Key, PlannedLink | str]:
    """What there is to keep of links, by their numbers, planned one after the other."""
    # What is planned here is kept at once: an interrupt loses none of it.
    before, z = set(kept), links[part[0]][0].start.z if part[0] else problem.start
    for k in part:
        planned = _plan_one(problem, links, k, z, options, kept, lambda _: None)
        if isinstance(planned, str):
            break
        z = planned.end
    return {key: kept[key] for key in set(kept) - before}


def _plan_links(
    problem: Problem,
    links: Sequence[Chosen],
    options: PlanOptions,
    kept: Kept,
    report: Callable[[str], None],
) -> tuple[list[PlannedLink], str]:
    """Plans of links one after the other, from what is begun of them, and why the next has none."""
    z, found = problem.start, list[PlannedLink]()
    for k, (link, _) in enumerate(links):
        apart = measure_apart(problem.scene, z, link.start.z)
        if k and not links[k - 1][0].in_cell and apart < MET:
            # Wherever it began, a border ends at the same place.
            z = link.start.z
        planned = _plan_one(problem, links, k, z, options, kept, report)
        if isinstance(planned, str):
            return found, f"{describe_steps(link.steps)}: {planned}"
        found.append(planned)
        z = planned.end
    return found, ""


def _plan_one(
    problem: Problem,
    links: Sequence[Chosen],
    k: int,
    z: Array,
    options: PlanOptions,
    kept: Kept,
    report: Callable[[str], None],
) -> PlannedLink | str:
    """The plan of one of some links, from `z`."""
    link, measured = links[k]
    ahead = links[k + 1][0] if k + 1 < len(links) else None
    own = link if measured is None else replace(link, steps=measured.steps)
    return keep_link(problem, own, ahead, measured, z, options, kept, report)


def _put_together(problem: Problem, links: Sequence[PlannedLink], options: PlanOptions) -> Planning:
    """The planning of a route whose links are planned."""
    phases, blocks = list[Phase](), list[BlockPlan]()
    for link in links:
        moved = [replace(own, index=own.index + len(phases)) for own in link.phases]
        for block in link.blocks:
            own = tuple(moved[phase.index] for phase in block.phases)
            blocks.append(replace(block, phases=own))
        phases += moved
    whole = replace(problem, phases=tuple(phases), goals=())
    none = list[float | None]([None] * len(phases))
    return Planning(whole, (), options, tuple(blocks), none, none, ahead=False)


@dataclass(frozen=True, eq=False)
class PlannedLink:
    """A link as it is planned."""

    phases: tuple[Phase, ...]  # counted from the first of the link
    blocks: tuple[BlockPlan, ...]
    costs: tuple[SolverStatistics, ...]  # what solving has cost, for each phase

    @property
    def end(self) -> Array:
        """Where it ends, shape (5,)."""
        return self.blocks[-1].end

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return sum(plan.motion.duration for own in self.blocks for plan in own.plans)


Kept = MutableMapping[Key, PlannedLink | str]  # Plans of links, or why there are none


def key_configuration(scene: Scene, z: Array) -> tuple[float, ...]:
    """The same for configurations that are one."""
    length = scene.scales.length
    return tuple(np.round(z / [length, length, 1, 1, 1], SAME).tolist())


def key_steps(steps: Sequence[EdgeStep]) -> Key:
    """The same for phases that are the same."""
    return tuple((tuple(c.name for c in own.contacts), own.until, own.end.value) for own in steps)


def keep_link(
    problem: Problem,
    link: Link,
    ahead: Link | None,
    begun: Measured | None,
    z: Array,
    options: PlanOptions,
    kept: Kept,
    report: Callable[[str], None],
) -> PlannedLink | str:
    """The plan of a link from `z`, made now, from what is begun, if it is not kept."""
    # Where a link lands, the next one goes on along a border, looked at as if it stopped there.
    lands = link.in_cell and ahead is not None and not ahead.in_cell
    follows = (ahead.steps[0]._replace(end=End.REST),) if ahead is not None and lands else ()
    place, own = key_configuration(problem.scene, z), repr(replace(options, samples=2))
    key = (place, key_steps(link.steps), key_steps(follows), begun is None, own)
    if key not in kept:
        report(f"planning {describe_steps(link.steps)}")
        try:
            kept[key] = _plan_link(problem, link, follows, begun, z, options, report)
        except WholearmError as error:
            kept[key] = str(error)
        except np.linalg.LinAlgError:
            kept[key] = SINGULAR
    return kept[key]


def _plan_link(
    problem: Problem,
    link: Link,
    follows: Sequence[EdgeStep],
    measured: Measured | None,
    z: Array,
    options: PlanOptions,
    report: Callable[[str], None],
) -> PlannedLink:
    steps = (*link.steps, *follows)
    phases, curves = make_phases(problem, steps), list[Curve]()
    if not link.in_cell and len(phases) == 1:
        phases[0], curve = _aim(phases[0], z, link)
        curves.append(curve)
    own = replace(problem, start=z, phases=tuple(phases), goals=())
    count = len(phases) - len(follows)
    none = list[float | None]([None] * len(phases))
    made = Planning(own, tuple(curves), options, (), none, none, sketches=True)
    with open_ledger(apart=True) as ledger, name_source(problem.source):
        for part in split_blocks(own):
            if part[0].index >= count:
                break
            begun = None
            if (
                measured
                and measured.begun
                and (part[0].end is not End.REST or part[0].index == count - 1)
            ):
                start = made.blocks[-1].end if made.blocks else z
                begun = BlockPlan(part, start, BEGUN, None, [], list(measured.begun), None)
            made = plan_next(made, 0, begun, report)
    costs = tuple(ledger.of(phase.number) for phase in phases[:count])
    pinned = [
        pin_landing(phase, end_of(plan)[0])
        for phase, plan in zip(phases[:count], made.plans, strict=True)
    ]
    return PlannedLink(tuple(pinned), made.blocks, costs)


def pin_landing(phase: Phase, z: Array) -> Phase:
    """The phase with a coordinate of the pose at its end, where a contact leaves that open.

    That is the one which changes most along the border on which a phase with two freedoms lands. It
    is rounded as a problem file has it.

    Parameters
    ----------
    z : (5,)  where it ends
    """
    until, formation = phase.until, phase.formation
    if until.contact is None or until.pins or count_freedoms(formation, z) < 2:
        return phase
    length = formation.scene.scales.length
    border = Formation(formation.scene, (*formation.contacts, until.contact), formation.rolling)
    x, _, phi, *_ = np.abs(find_headings(border, z) or np.eye(5))[0]
    name, digits = ("x", length) if x > length * phi else ("phi", 1.0)
    value = round(float(z[ROWS[name]]), math.ceil(-math.log10(PINNED * digits)))
    return replace(phase, until=replace(until, pins=((name, value),)))


def _aim(phase: Phase, z: Array, link: Link) -> tuple[Phase, Curve]:
    """The phase of a border's link from `z`, so that it ends where the link does, and its curve.

    A contact may be gained both ways along a border; x or phi tells which is meant.
    """
    try:
        curve = trace_phase(phase, z)
        if measure_apart(link.stop.scene, curve.end, link.stop.z) <= OFF:
            return phase, curve
    except InputError:
        pass
    until = point_out(phase.formation.contacts, link.stop.z)
    other = replace(phase, until=until)
    return other, trace_phase(other, z)
