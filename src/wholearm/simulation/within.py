"""What is to be seen within steps: the same steps, ended earlier.

A step ends where the integration or an event says so, not where somebody wants to look.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from .events import Section, Step
from .replay import Replay
from .stepper import Stepper
from .tolerances import ROUNDING_LIMIT, STANDING, measure_until


def look_within(run: Replay, times: Array) -> list[float]:
    """Record the states at increasing instants, shape (n,) [s], within steps that have been made.

    Instants that lie within none are left out.

    Returns
    -------
    list of float, [s]
        Where something has happened that the steps missed.
    """
    missed: list[float] = []
    for section, stepper in zip(run.sections, run.steppers, strict=True):
        if not section.steps:
            continue
        at, slack = stepper.at, _measure_slack(run, section, stepper)
        begins = np.array([step.t for step in section.steps])
        owners = np.searchsorted(begins, times, side="left") - 1
        for time, owner in zip(times.tolist(), owners.tolist(), strict=True):
            step = section.steps[max(owner, 0)]
            h = time - step.t
            if owner < 0 or h >= step.h:
                continue
            stepper.inputs[:] = step.inputs
            stepper.inputs[at.h] = h
            stepper.step()
            section.times.append(time)
            section.rows.append(stepper.outputs.copy())
            section.impacts.append(step.impact)
            if shows(step, stepper, slack):
                missed.append(time)
    return missed


def _measure_slack(run: Replay, section: Section, stepper: Stepper) -> Array:
    """How far below zero each event value counts as rounding within a step."""
    rows, slack, scales = stepper.rows, stepper.slack.copy(), run.problem.scene.scales
    slack[rows.slide] = slack[rows.speed] = STANDING * scales.speed
    slack[rows.speed] *= scales.mass**0.5
    slack[rows.joint] = STANDING / scales.time
    slack[rows.until] = ROUNDING_LIMIT * measure_until(run.problem.scene, section.phase.until)
    return slack


def shows(step: Step, stepper: Stepper, slack: Array) -> bool:
    """Whether something happens in a step up to the place just looked at.

    One that ends with the phase may have passed its end, and turned back.
    """
    short = stepper.outputs[stepper.to.events] + slack < 0
    if step.arrives:
        rows = stepper.rows
        short[rows.until] = short[rows.speed] = short[rows.slide] = short[rows.joint] = False
    return bool(short.any())
