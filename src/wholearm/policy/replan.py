"""Motions with more freedoms than a curve, planned anew with what feedback needs in reserve.

Along a curve a motion only has to be slower to leave normal forces and torques in reserve. With
more freedoms it has to be another motion: the least time leaves nothing, at any speed. What follows
is planned from the new end until the plan is met again; the last phase ends at the plan's pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..common.errors import WholearmError
from ..problem.definition import ROWS, Phase, Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Trajectory, assemble
from .regulator import ROOM

SHARES = (1.0, 0.5, 0.25)
"""Parts of the reserve that are tried, the largest first."""
SLOWER = 1.5
"""Duration over the plan's from which on a motion costs more than its reserve is worth."""
SAME = 1e-5
"""How far ends may be from the plan's to count as the same, over the scene's length and in rad."""

Planner = Callable[[Problem], Trajectory]
"""Makes a plan of a problem."""


def replan(
    planner: Planner,
    problem: Problem,
    blocks: Sequence[tuple[Phase, ...]],
    curves: Sequence[bool],
    plan: Trajectory,
) -> Trajectory:
    """A plan in which blocks that are not along curves have a reserve where there is one."""
    motions, k = list(plan.motions), 0
    while k < len(blocks):
        after = k + 1
        if not curves[k] and _lacks(problem, blocks[k], plan):
            for share in SHARES:
                found = _detour(planner, problem, blocks[k:], curves[k:], plan, share)
                if found is not None:
                    new, after = found[0], k + found[1]
                    first = blocks[k][0].index
                    motions[first : first + len(new)] = new
                    break
        k = after
    if all(new is old for new, old in zip(motions, plan.motions, strict=True)):
        return plan
    samples = int(np.bincount(plan.phase).max())
    still = TorqueProfile(np.array([0.0, plan.duration]), np.zeros((1, 2, 1)))
    rows = assemble(motions, still, plan.meta, samples)
    return replace(rows, torque=TorqueProfile.join_rows(rows.t, rows.tau))


def _lacks(problem: Problem, phases: Sequence[Phase], plan: Trajectory) -> bool:
    """Whether phases of a plan leave less than the reserve of a normal force or a torque."""
    own = (plan.phase >= phases[0].index) & (plan.phase <= phases[-1].index)
    scene = problem.scene
    most = (np.abs(plan.tau[own]) / scene.torque_limit).max()
    least = np.nanmin(plan.c_n[own]) / scene.scales.force
    return bool(min(least, 1 - most) < 0.99 * ROOM)


def _detour(
    planner: Planner,
    problem: Problem,
    blocks: Sequence[tuple[Phase, ...]],
    curves: Sequence[bool],
    plan: Trajectory,
    share: float,
) -> tuple[list[Motion], int] | None:
    """Motions with a part of the reserve until the plan is met again, and of how many blocks."""
    starts, found = plan.phase_starts, list[Motion]()
    z = plan.z[np.flatnonzero(plan.phase == blocks[0][0].index)[0]]
    blocks = [*blocks[:-1], (*blocks[-1][:-1], _pin(blocks[-1][-1], plan.z[-1]))]
    for count, (own, curve) in enumerate(zip(blocks, curves, strict=True), start=1):
        part = _solve(planner, problem, own, z, 0.0 if curve else share)
        lasts = starts[own[-1].index + 1] - starts[own[0].index]
        if part is None or (not curve and part.duration > SLOWER * lasts):
            return None
        found += part.motions
        z = part.z[-1]
        away = np.abs(z - plan.z[np.flatnonzero(plan.phase == own[-1].index)[-1]])
        away[:2] /= problem.scene.scales.length
        if away.max() < SAME:
            return found, count
    return None


def _solve(
    planner: Planner, problem: Problem, phases: Sequence[Phase], z: Array, share: float
) -> Trajectory | None:
    """Phases from a configuration at rest, with a part of the reserve."""
    scene, room = problem.scene, share * ROOM
    one, two = (replace(own, torque_limit=(1 - room) * own.torque_limit) for own in scene.fingers)
    own = replace(
        problem,
        start=z,
        epsilon=max(problem.epsilon, room * scene.scales.force),
        scene=replace(scene, fingers=(one, two)),
        phases=tuple(replace(phase, index=k) for k, phase in enumerate(phases)),
    )
    try:
        return planner(own)
    except WholearmError:
        return None


def _pin(phase: Phase, z: Array) -> Phase:
    """The phase with the pose of z, shape (5,), pinned where its end leaves it open."""
    until = phase.until
    given = {row for row, _ in until.poses}
    gained = until.contact is not None
    freedoms = len(z) - len(phase.formation.contacts) - gained - len(given)
    names = [name for name in ("x", "phi") if ROWS[name] not in given][: max(freedoms, 0)]
    pins = tuple((name, float(z[ROWS[name]])) for name in names)
    return replace(phase, until=replace(until, pins=until.pins + pins))
