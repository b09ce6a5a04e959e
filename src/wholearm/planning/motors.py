"""What is not planned with motors that are not quick."""

from __future__ import annotations

import math

from ..common.errors import InputError
from ..problem.definition import Problem
from .options import PlanOptions
from .splitting import runs_along_curves, split_blocks


def require_quick_motors(problem: Problem, options: PlanOptions) -> None:
    """Refuse what is not planned with torques that may not step.

    Raises
    ------
    InputError
        Names the key that is given, and why it cannot be.
    """
    given = [
        (f"{finger.name}.{key}", getattr(finger, key))
        for finger in problem.scene.fingers
        for key, free in (("torque_rate_limit", math.inf), ("actuator_lag", 0.0))
        if getattr(finger, key) != free
    ]
    if not given:
        return
    why = ""
    if options.ranges:
        why = "ranges (--robust) are not kept with it yet"
    elif problem.is_settled:
        why = "torques that settle the end of a phase (settle) step; leave one of the two out"
    else:
        for block in split_blocks(problem):
            if not runs_along_curves(block, options) and not why:
                why = f"phase {block[0].number} is planned over time, where torques may step"
    if why:
        raise InputError("", given[0][0], f"{given[0][1]:g} given; {why}")
