"""What a plan says of itself: contact forces that are the only ones, starts that are sure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.errors import AmbiguityError
from ..geometry.curve import describe_pose
from ..mechanics.uniqueness import describe_minor
from ..problem.definition import Problem
from ..results.report import LeastMinor
from ..results.trajectory import Trajectory
from ..verification.sureness import find_least_minor, find_wedged

_STILL = 1e-9
"""Speed of a plan that is rest but for rounding, relative to the scene's."""


class Sureness(NamedTuple):
    """The least minor of a phase, and for how long it may stay wedged; see `PlannedPhase`."""

    minor: LeastMinor | None
    wedged: float | None


def check_sureness(problem: Problem, trajectory: Trajectory, least: float) -> list[Sureness]:
    """Measure every phase of a plan.

    Parameters
    ----------
    problem : Problem
    trajectory : Trajectory
    least : float
        Least ratio of a principal minor to that without friction.

    Raises
    ------
    AmbiguityError
        If a phase has a lesser one.
    """
    found = []
    for phase in problem.phases:
        rows = np.flatnonzero(trajectory.phase == phase.index)
        minor = find_least_minor(phase, trajectory, rows)
        if minor is not None and minor.ratio < least:
            place = describe_pose(trajectory.z[np.searchsorted(trajectory.t, minor.time)])
            text = describe_minor(minor.ratio, minor.contacts, place, least)
            raise AmbiguityError(f"phase {phase.number}: {text}")
        found.append(Sureness(minor, find_wedged(problem, phase, trajectory, rows, _STILL)))
    return found
