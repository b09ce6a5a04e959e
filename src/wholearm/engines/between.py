"""A plan between the rows of its file.

Accelerations and forces step with the torques, anywhere between two rows of a trajectory file, and
what is interpolated misses that by more than an engine is off. The replay of the plan has rows at
every step.
"""

from __future__ import annotations

import numpy as np

from ..common.errors import WholearmError
from ..problem.read import read_own_problem
from ..results.trajectory import Trajectory
from ..simulation.simulate import simulate

SAME = 1e-4
"""Largest difference between plan and replay, over the scene's length and in rad."""
LATE = 1e-3
"""Largest difference of the times at which phases end, over the scene's time: an end at rest is
reached so slowly that little in place is much in time."""
_ROWS = 400
"""Instants of each phase at which the replay is known, besides its steps."""


def find_between(plan: Trajectory) -> Trajectory:
    """The replay of a plan in its own problem, or the plan itself where that is not the same."""
    starts = plan.phase_starts
    times = np.linspace(starts[:-1], starts[1:], _ROWS)
    try:
        problem = read_own_problem(plan.meta)
        replay = simulate(problem, plan.torque, times=times.ravel()).trajectory
    except WholearmError:
        return plan
    if len(replay.motions) != len(plan.motions):
        return plan
    late = np.abs(replay.phase_starts - starts).max()
    inside = np.clip(plan.t, 0.0, replay.duration)
    error = np.abs(replay.at(inside).z - plan.z) / [*2 * [problem.scene.scales.length], 1, 1, 1]
    same = late < LATE * problem.scene.scales.time and error.max() < SAME
    return replay if same else plan
