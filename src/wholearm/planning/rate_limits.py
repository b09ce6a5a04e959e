"""Restrictions with rate-limited or held torques, and errors that compare with free ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ..common.errors import InfeasibleError, InputError, SolverError, WholearmError
from ..problem.definition import Phase, Problem
from ..scene.model import Scene
from .advice import name_phases
from .options import PlanOptions
from .stops import Plans, runs_along_curves, split_blocks

if TYPE_CHECKING:
    from .blocks import Planning

FREE = {"torque_rate_limit": None, "actuator_lag": None, "control_period": None}  # free torques
_ROUGH = 1e-2  # least accuracy where only the existence of a plan matters


def require_steps(problem: Problem, options: PlanOptions) -> None:
    """Raise an InputError for combinations with rate-limited or held torques without a planner."""
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


def free_torques(problem: Problem, options: PlanOptions) -> tuple[Problem, PlanOptions]:
    """The same with free torques."""
    scene = problem.scene
    if scene.control_period:
        options = replace(options, transcription="auto")
    if scene.has_slow_motors or scene.control_period:
        problem = problem.with_(FREE)
    return problem, options


def name_motors(scene: Scene) -> str:
    """The keys that limit rates or hold torques, with their values."""
    given = list[str]()
    if scene.control_period:
        given.append(f"control_period = {scene.control_period:g} s ({scene.control_hold})")
    kinds = (("torque_rate_limit", "N m/s", math.inf), ("actuator_lag", "s", 0.0))
    for key, unit, free in kinds:
        values = list(dict.fromkeys(getattr(finger, key) for finger in scene.fingers))
        if values != [free]:
            texts = dict.fromkeys(f"{value:g}" for value in values)
            given.append(f"{key} = {' and '.join(texts)} {unit}")
    return " and ".join(given)


def explain_motors(
    planning: Planning,
    block: Sequence[Phase],
    options: PlanOptions,
    error: InfeasibleError | SolverError,
    plan_block: Callable[[Planning, Sequence[Phase], PlanOptions], Plans],
) -> InfeasibleError | SolverError:
    """The error with whether the phases have a plan with free torques, found by `plan_block`."""
    keys = name_motors(planning.problem.scene)
    if not keys:
        return error
    where = name_phases([phase.number for phase in block])
    if isinstance(error, InfeasibleError):
        where += f" ({'; '.join(' '.join(phase.formation.names) for phase in block)})"
    free, own = free_torques(planning.problem, options)
    own = replace(own, accuracy=max(own.accuracy, _ROUGH))
    try:
        phases = [free.phases[phase.index] for phase in block]
        found = plan_block(replace(planning, problem=free, curves=()), phases, own)
    except WholearmError as other:
        text = f"{error}; without {keys} none was found either: {other}"
    else:
        lasts = sum(plan.motion.duration for plan in found)
        text = f"without {keys} there is a plan of {lasts:.4g} s for {where}; with that, {error}"
    if not isinstance(error, InfeasibleError):
        return SolverError(text)
    extended = InfeasibleError(text, error.shortfalls, error.changes)
    extended.motion = error.motion
    return extended
