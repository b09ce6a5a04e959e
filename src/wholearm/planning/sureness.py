"""What a plan says of itself: contact forces that are the only ones, starts that are sure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..common.errors import AmbiguityError
from ..geometry.curve import describe_pose
from ..mechanics.uniqueness import describe_uniqueness
from ..problem.definition import Problem
from ..results.report import UniquenessMargin
from ..results.trajectory import Trajectory
from ..verification.sureness import find_uniqueness_margin, find_wedged

_STILL = 1e-9
"""Speed of a plan that is rest but for rounding, relative to the scene's."""


class Sureness(NamedTuple):
    """The uniqueness margin of a phase, and for how long it may stay wedged; see `PlannedPhase`."""

    uniqueness_margin: UniquenessMargin | None
    wedged: float | None


def check_sureness(problem: Problem, trajectory: Trajectory, least: float) -> list[Sureness]:
    """Measure every phase of a plan.

    Parameters
    ----------
    problem : Problem
    trajectory : Trajectory
    least : float
        Least uniqueness margin (`mechanics.uniqueness`).

    Raises
    ------
    AmbiguityError
        If a phase has a lesser one.
    """
    found = []
    for phase in problem.phases:
        rows = np.flatnonzero(trajectory.phase == phase.index)
        margin = find_uniqueness_margin(phase, trajectory, rows)
        if margin is not None and margin.value < least:
            place = describe_pose(trajectory.z[np.searchsorted(trajectory.t, margin.time)])
            text = describe_uniqueness(margin.value, margin.contacts, place, least)
            raise AmbiguityError(f"phase {phase.number}: {text}")
        found.append(Sureness(margin, find_wedged(problem, phase, trajectory, rows, _STILL)))
    return found
