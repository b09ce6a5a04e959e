"""Why there is no plan with motors that are not quick."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...common.errors import InfeasibleError, WholearmError
from ...geometry.curve import Curve
from ..advice import name_phases
from .data import PhaseData
from .joint import require_hold
from .task import Task

_TRIED = (2.0, 10.0, 100.0)
"""Factors on the rates of motors with which a plan is looked for."""


def explain_motors(
    task: Task, parts: Sequence[PhaseData], reason: str, plan: Callable[..., Any]
) -> WholearmError:
    """The error for phases that `plan`, which is `plan_curves`, has found no plan for.

    It is that of quick motors if these have none either. Otherwise quicker ones are tried.
    """
    given = task.epsilon, task.options, task.phases, task.duration
    try:
        require_hold(parts[0], task.phases[0], 0)
        require_hold(parts[-1], task.phases[-1], -1)
        plan([_quicken(curve, np.inf) for curve in task.curves], *given)
    except WholearmError as error:
        return error
    for factor in _TRIED:
        try:
            plan([_quicken(own, factor) for own in task.curves], *given, False, task.pins)
        except WholearmError:
            continue
        change = f"feasible with motors {factor:g} times as quick"
        break
    else:
        change = "a plan was found for motors without limits"
    text = (
        "torques may not change as quickly as they would have to (torque_rate_limit, actuator_lag)"
    )
    return InfeasibleError(f"{name_phases(task.phases, 'infeasible')}: {text}; {change}; {reason}")


def _quicken(curve: Curve, factor: float) -> Curve:
    """The curve in a scene whose motors are quicker by a factor."""
    formation, scene = curve.formation, curve.formation.scene
    right, left = (
        replace(
            finger,
            torque_rate_limit=finger.torque_rate_limit * factor,
            actuator_lag=finger.actuator_lag / factor,
        )
        for finger in scene.fingers
    )
    scene = replace(scene, fingers=(right, left))
    return replace(curve, formation=replace(formation, scene=scene))
