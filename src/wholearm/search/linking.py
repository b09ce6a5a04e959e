"""Links planned from rest to rest, and kept."""

from __future__ import annotations

import math
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, WholearmError, name_source
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.path_guess import count_freedoms
from ..geometry.tracing import trace_phase
from ..planning.block_plan import BEGUN, BlockPlan, Planning
from ..planning.blocks import plan_next
from ..planning.options import PlanOptions
from ..planning.splitting import split_blocks
from ..planning.stops import end_of
from ..problem.definition import ROWS, End, Phase, Problem
from ..scene.model import Scene
from ..solvers.statistics import SolverStatistics, open_ledger
from .links import Link, Step, describe_steps, find_headings, point_out
from .measure import SINGULAR, Measured, make_phases
from .places import measure_apart

OFF = 1e-4
"""Distance from the end of a border's link from which on it is another end, in radii of gyration or
radians."""
PINNED = 1e-9
"""Coordinates at which landings are pinned are rounded to this, in the same unit."""
SAME = 9
"""Decimals of configurations that are one, in the same unit."""

Key = tuple[object, ...]


@dataclass(frozen=True, eq=False)
class PlannedLink:
    """A link as it is planned.

    Attributes
    ----------
    phases : tuple of Phase
        Counted from the first of the link.
    blocks : tuple of BlockPlan
    costs : tuple of SolverStatistics
        What solving has cost, for each phase.
    """

    phases: tuple[Phase, ...]
    blocks: tuple[BlockPlan, ...]
    costs: tuple[SolverStatistics, ...]

    @property
    def end(self) -> Array:
        """Where it ends, shape (5,)."""
        return self.blocks[-1].end

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return sum(plan.motion.duration for own in self.blocks for plan in own.plans)


Kept = MutableMapping[Key, PlannedLink | str]
"""Plans of links, or why there are none."""


def key_configuration(scene: Scene, z: Array) -> tuple[float, ...]:
    """The same for configurations that are one."""
    length = scene.scales.length
    return tuple(np.round(z / [length, length, 1, 1, 1], SAME).tolist())


def key_steps(steps: Sequence[Step]) -> Key:
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
    follows: Sequence[Step],
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
    phase : Phase
    z : ndarray, shape (5,)
        Where it ends.
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
