"""How far a replay is from the plan, and where and why it departs.

What makes a replay depart is looked for in its contacts, up to the row at which it is beyond what
is allowed: one that opens, one that sticks where it should slide or slides where it should roll,
or one that presses and is not planned. The reason is the first of those that last until then.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..problem.definition import Phase, Problem
from ..results.trajectory import Samples, Trajectory
from .stretch import EngineRun, EngineStretch

OPEN = 0.1  # Gap at which a contact is open, over the departure that is allowed
SLOW = 0.1  # Share of the planned sliding speed below which a contact sticks
MOVES = 2e-3  # Sliding speed from which on a contact is known to slide, over the scene's speed
PRESS = 0.25
"""Normal force above which a contact that is not planned presses, and from which on forces are
compared, over the scene's force: 0.5 N in the scenes of `problems/`."""
_INSTANTS = 2000  # Instants of a phase over which planned forces are averaged


class Force(NamedTuple):
    """The normal force of a contact, averaged over a phase [N]."""

    phase: int
    contact: str
    planned: float
    found: float

    @property
    def off(self) -> float:
        """How far it is off, over the planned one."""
        return (self.found - self.planned) / self.planned


class Departure(NamedTuple):
    """A stretch, compared with the plan."""

    # t, position, angle (n,) [s], [m] and [rad]: error of the object's pose over time, from the
    # start of the plan
    t: Array
    position: Array
    angle: Array
    forces: tuple[Force, ...]
    time: float | None  # [s]: when it is beyond what is allowed
    reason: str  # what made it depart; empty where it does not


class _PressChange(NamedTuple):
    """A contact that is not as planned, from when until when [s]."""

    start: float
    stop: float
    what: str


class _Part(NamedTuple):
    """A phase of a stretch: which rows of the run are its own, and the plan there."""

    phase: Phase
    contacts: tuple[str, ...]
    rows: NDArray[np.int64]
    want: Samples


def compare(
    problem: Problem, plan: Trajectory, stretch: EngineStretch, run: EngineRun, allowed: float
) -> Departure:
    """Compare a replay with the plan.

    Parameters
    ----------
    allowed  largest error of the position over the scene's length, and of the angle in rad
    """
    length = problem.scene.scales.length
    parts = _divide(problem, plan, stretch, run)
    error = run.z - np.concatenate([part.want.z for part in parts])
    position, angle = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    forces = tuple(force for part in parts for force in _average(plan, part, run))
    beyond = np.flatnonzero(~(np.maximum(position / length, angle) <= allowed))
    if not len(beyond):
        return Departure(run.t, position, angle, forces, None, "")
    time = float(run.t[beyond[0]])
    changes = [
        each for part in parts for each in _list_changes(problem, part, run, allowed * length)
    ]
    return Departure(run.t, position, angle, forces, time, _choose_reason(changes, time))


def _choose_reason(changes: list[_PressChange], time: float) -> str:
    """The first change that lasts until the replay departs, or else the last one before."""
    before = [each for each in changes if each.start <= time]
    lasting = [each for each in before if each.stop >= time]
    if not before:
        return "every contact is as planned"
    reason = min(lasting) if lasting else max(before, key=lambda each: each.stop)
    return f"{reason.what} at t = {reason.start:.5g} s"


def _divide(
    problem: Problem, plan: Trajectory, stretch: EngineStretch, run: EngineRun
) -> list[_Part]:
    """The phases of a stretch; the row at which one ends is its own."""
    starts, parts = plan.phase_starts, []
    owner = np.searchsorted(starts[1:-1], run.t, side="left")
    owner = np.clip(owner, stretch.phases[0], stretch.phases[-1])
    owner[0] = stretch.phases[0]
    for index in stretch.phases:
        rows, motion = np.flatnonzero(owner == index), plan.motions[index]
        want = motion.evaluate(np.clip(run.t[rows] - starts[index], 0.0, motion.duration))
        parts.append(_Part(problem.phases[index], motion.contacts, rows, want))
    return parts


def find_pairs(contact: str, corners: int) -> tuple[str, ...]:
    """Pairs of shapes that make up a contact: a vertex on a tip's arc also ends two edges."""
    corner, part = contact.split("-")
    if corner[0] == "e" or not part.startswith("tip"):
        return (contact,)
    index, finger = int(corner[1:]), part[3:]
    edges = [f"e{k % corners}-tip{finger}" for k in (index - 1, index)]
    return (f"{corner}-finger{finger}", *edges)


def _find_columns(contact: str, part: _Part, run: EngineRun) -> list[int]:
    pairs = find_pairs(contact, part.phase.formation.scene.polygon.n_vertices)
    return [run.pairs.index(name) for name in pairs]


def _average(plan: Trajectory, part: _Part, run: EngineRun) -> list[Force]:
    """Planned and found normal forces of a phase, averaged over its time.

    That is until the contact that ends the phase presses: its gap closes at a speed that vanishes,
    so that it is closed early by what is little in the pose.
    """
    motion, until = plan.motions[part.phase.index], part.phase.until.contact
    # What presses before a row is in the row before it.
    ends = part.rows[part.rows > 0]
    if until is not None:
        gained = run.press[ends - 1][:, _find_columns(until.name, part, run)].any(axis=1)
        ends = ends[: max(1, int(np.argmax(np.append(gained, True))))]
    time = run.t[ends[-1]] - plan.phase_starts[part.phase.index]
    middles = (np.arange(_INSTANTS) + 0.5) * min(time, motion.duration) / _INSTANTS
    planned = np.nanmean(motion.evaluate(middles).c_n, axis=0).tolist()
    share = np.diff(run.t)[ends - 1]
    press = share @ run.press[ends - 1] / share.sum()
    found = [float(press[_find_columns(name, part, run)].sum()) for name in part.contacts]
    rows = zip(part.contacts, planned, found, strict=True)
    return [Force(part.phase.number, *row) for row in rows]


def _list_changes(
    problem: Problem, part: _Part, run: EngineRun, reach: float
) -> Iterator[_PressChange]:
    """When the contacts of a phase are not as planned, and how."""
    scales, formation, rows = problem.scene.scales, part.phase.formation, part.rows
    own = formation.evaluate(run.z[rows], run.z_dot[rows])
    planned = formation.evaluate(part.want.z, part.want.z_dot)
    slides = np.einsum("nij,nj->ni", own.A_t, run.z_dot[rows])
    meant = np.einsum("nij,nj->ni", planned.A_t, part.want.z_dot)
    pressing = run.press[rows[rows > 0] - 1].copy()
    for k, name in enumerate(formation.names):
        pressing[:, _find_columns(name, part, run)] = 0.0
        yield from _find_runs(run.t[rows], own.C[:, k] > OPEN * reach, f"{name} opens")
        moves = MOVES * scales.speed
        if k in formation.rolling_rows:
            yield from _find_runs(run.t[rows], np.abs(slides[:, k]) > moves, f"{name} slips")
            continue
        held = (np.abs(meant[:, k]) > moves) & (np.abs(slides[:, k]) < SLOW * np.abs(meant[:, k]))
        yield from _find_runs(run.t[rows], held, f"{name} sticks")
    for column in np.flatnonzero((pressing > PRESS * scales.force).any(axis=0)):
        hits = pressing[:, column] > PRESS * scales.force
        times = run.t[rows[rows > 0]]
        yield from _find_runs(times, hits, f"{run.pairs[column]} presses, which is not planned,")


def _find_runs(t: Array, happens: NDArray[np.bool_], what: str) -> Iterator[_PressChange]:
    """Times from when until when something happens."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], happens, [False]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2] - 1, strict=True):
        yield _PressChange(float(t[first]), float(t[last]), what)
