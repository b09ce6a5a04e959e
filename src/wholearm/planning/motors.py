"""What is not planned with motors that are not quick, or with torques held over periods."""

from __future__ import annotations

import math
from dataclasses import replace

from ..common.errors import InputError
from ..problem.definition import Problem
from .block_plan import Planning
from .options import PlanOptions
from .splitting import runs_along_curves, split_blocks


def require_steps(problem: Problem, options: PlanOptions) -> None:
    """Refuse what is not planned with torques that may not step, or may only at some times.

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
    scene, why = problem.scene, ""
    if scene.control_period:
        if options.ranges:
            why = "ranges (--robust) are not kept with it yet"
        elif given and scene.control_hold == "constant":
            why = f"torques held constant step, and {given[0][0]} is given; hold them linear"
        if why:
            raise InputError("", "control_period", f"{scene.control_period:g} given; {why}")
    along = all(runs_along_curves(block, options) for block in split_blocks(problem))
    if given and options.ranges and not along:
        why = "ranges (--robust) are not kept with it in phases over time yet"
        raise InputError("", given[0][0], f"{given[0][1]:g} given; {why}")


def free_torques(planning: Planning, options: PlanOptions) -> tuple[Planning, PlanOptions]:
    """The same with motors that are quick, and torques that are not held.

    How much more what follows a block costs from farther away is nearly the same, and known soon.
    """
    scene = planning.problem.scene
    if scene.control_period:
        options = replace(options, transcription="auto")
    if scene.has_slow_motors or scene.control_period:
        free = {"torque_rate_limit": None, "actuator_lag": None, "control_period": None}
        planning = replace(planning, problem=planning.problem.with_(free))
    return planning, options
