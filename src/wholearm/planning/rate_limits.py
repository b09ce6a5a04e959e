"""What is not planned with motors that are not quick, or with torques held over periods."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from ..common.errors import InfeasibleError, InputError, SolverError, WholearmError
from ..problem.definition import Phase, Problem
from ..scene.model import Scene
from .advice import name_phases
from .block_plan import Planning
from .options import PlanOptions
from .stops import Plans, runs_along_curves, split_blocks

FREE = {"torque_rate_limit": None, "actuator_lag": None, "control_period": None}
"""Changes of a problem after which motors are quick, and torques are not held."""
_ROUGH = 1e-2  # least accuracy of plans of which only matters that there are any


def require_steps(problem: Problem, options: PlanOptions) -> None:
    """Refuse what is not planned with torques that may not step, or may only at some times.

    Raises
    ------
    InputError  names the key that is given, and why it cannot be
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


def free_torques(problem: Problem, options: PlanOptions) -> tuple[Problem, PlanOptions]:
    """The same with motors that are quick, and torques that are not held."""
    scene = problem.scene
    if scene.control_period:
        options = replace(options, transcription="auto")
    if scene.has_slow_motors or scene.control_period:
        problem = problem.with_(FREE)
    return problem, options


def name_motors(scene: Scene) -> str:
    """The keys that keep torques from stepping when they like, with their values."""
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
    """What an error says of phases without a plan, and whether they have one without these keys.

    Parameters
    ----------
    plan_block  plans the same phases of another problem; raises if there is no plan
    """
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
        return _say(error, f"{error}; without {keys} none was found either: {other}")
    lasts = sum(plan.motion.duration for plan in found)
    found_one = f"without {keys} there is a plan of {lasts:.4g} s for {where}"
    return _say(error, f"{found_one}; with that, {error}")


def _say(error: InfeasibleError | SolverError, text: str) -> InfeasibleError | SolverError:
    """An error with another text."""
    if not isinstance(error, InfeasibleError):
        return SolverError(text)
    other = InfeasibleError(text, error.shortfalls, error.changes)
    other.motion = error.motion
    return other
