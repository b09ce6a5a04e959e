"""Deviation of a replay from the plan, and its cause.

The cause is the first deviation in contacts that lasts until the error of the pose exceeds its
limit: a contact opens, sticks, slips, or one that is not planned has force.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array, find_runs
from ..problem.definition import Phase, Problem
from ..results.trajectory import Samples, Trajectory
from .stretch import EngineRun, EngineStretch

OPEN = 0.1  # gap of an open contact, over the allowed error
SLOW = 0.1  # share of the planned sliding speed below which a contact sticks
MOVES = 2e-3  # sliding speed of a contact that slides, over the scene's speed
PRESS = 0.25  # least normal force that counts, over the scene's force: 0.5 N in `problems/`
_INSTANTS = 2000  # samples of a phase over which planned forces are averaged


class Force(NamedTuple):
    """The normal force of a contact, averaged over a phase [N]."""

    phase: int
    contact: str
    planned: float
    found: float

    @property
    def off(self) -> float:
        """Error relative to the planned one."""
        return (self.found - self.planned) / self.planned


class Departure(NamedTuple):
    """A stretch, compared with the plan."""

    t: Array  # (n,) [s]: from the start of the plan
    position: Array  # (n,) [m]: error of the object's position
    angle: Array  # (n,) [rad]: error of its angle
    forces: tuple[Force, ...]
    time: float | None  # [s]: when the error exceeds its limit
    reason: str  # the cause; empty without one


class _PressChange(NamedTuple):
    """A deviation of a contact and its interval [s]."""

    start: float
    stop: float
    what: str


class _Part(NamedTuple):
    """A phase of a stretch: its rows of the run, and the plan there."""

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
    changes = [c for part in parts for c in _list_changes(problem, part, run, allowed * length)]
    before = [change for change in changes if change.start <= time]
    # The first one that lasts until then, or else the last one before.
    lasting = [change for change in before if change.stop >= time]
    reason = "every contact is as planned"
    if before:
        cause = min(lasting) if lasting else max(before, key=lambda change: change.stop)
        reason = f"{cause.what} at t = {cause.start:.5g} s"
    return Departure(run.t, position, angle, forces, time, reason)


def _divide(
    problem: Problem, plan: Trajectory, stretch: EngineStretch, run: EngineRun
) -> list[_Part]:
    """The phases of a stretch; each includes the row at its end."""
    starts, parts = plan.phase_starts, []
    owner = np.searchsorted(starts[1:-1], run.t, side="left")
    owner = np.clip(owner, stretch.phases[0], stretch.phases[-1])
    owner[0] = stretch.phases[0]
    for index in stretch.phases:
        rows, motion = np.flatnonzero(owner == index), plan.motions[index]
        want = motion.evaluate(np.clip(run.t[rows] - starts[index], 0.0, motion.duration))
        parts.append(_Part(problem.phases[index], motion.contacts, rows, want))
    return parts


def _average(plan: Trajectory, part: _Part, run: EngineRun) -> list[Force]:
    """Planned and found normal forces of a phase, averaged until the gained contact closes.

    Its gap closes at a vanishing speed: a small error of the pose closes it early.
    """
    motion, scene = plan.motions[part.phase.index], part.phase.formation.scene
    every = part.rows[part.rows > 0]
    ends = run.cut(every, part.phase.until.contact, scene)
    ends = ends if len(ends) else every[:1]
    time = run.t[ends[-1]] - plan.phase_starts[part.phase.index]
    middles = (np.arange(_INSTANTS) + 0.5) * min(time, motion.duration) / _INSTANTS
    planned = np.nanmean(motion.evaluate(middles).c_n, axis=0).tolist()
    share = np.diff(run.t)[ends - 1]
    press = share @ run.press[ends - 1] / share.sum()
    found = [float(press[run.find_columns(name, scene)].sum()) for name in part.contacts]
    rows = zip(part.contacts, planned, found, strict=True)
    return [Force(part.phase.number, *row) for row in rows]


def _list_changes(
    problem: Problem, part: _Part, run: EngineRun, reach: float
) -> Iterator[_PressChange]:
    """Deviations of contacts from the plan in a phase."""
    scales, formation, rows = problem.scene.scales, part.phase.formation, part.rows
    actual = formation.evaluate(run.z[rows], run.z_dot[rows])
    planned = formation.evaluate(part.want.z, part.want.z_dot)
    slides = np.einsum("nij,nj->ni", actual.A_t, run.z_dot[rows])
    meant = np.einsum("nij,nj->ni", planned.A_t, part.want.z_dot)
    pressing = run.press[rows[rows > 0] - 1].copy()
    for k, name in enumerate(formation.names):
        pressing[:, run.find_columns(name, problem.scene)] = 0.0
        yield from _find_runs(run.t[rows], actual.C[:, k] > OPEN * reach, f"{name} opens")
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
    """Intervals in which a flag is set."""
    for run in find_runs(happens):
        yield _PressChange(float(t[run.start]), float(t[run.stop - 1]), what)
