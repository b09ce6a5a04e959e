"""Whether motors can follow torques: their rates, their steps, and the commands that take."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..problem.definition import Problem
from ..results.torque import TorqueProfile

HURRIED = 1e-3
"""Largest relative miss of a torque's rate, or of a command, that is not reported."""
STEPPED = 1e-5
"""Largest step of a torque that is none, over its limit."""
_LOOKS = 33
"""Instants of each piece of the torques that are looked at."""


def find_commands(torque: TorqueProfile, lag: Array) -> TorqueProfile:
    """Commands that motors with some lags, shape (2,) [s], make torques of: tau + lag tau'."""
    order = np.arange(torque.coefficients.shape[2])
    slopes = np.zeros_like(torque.coefficients)
    slopes[..., :-1] = torque.coefficients[..., 1:] * order[1:]
    slopes *= (2 / np.diff(torque.breaks))[:, None, None]
    return TorqueProfile(torque.breaks, torque.coefficients + lag[:, None] * slopes)


def describe_motors(problem: Problem, torque: TorqueProfile) -> list[tuple[float, str]]:
    """What motors cannot follow, with the time of the worst place of each kind [s]."""
    scene = problem.scene
    if not scene.has_slow_motors:
        return []
    x = np.linspace(-1, 1, _LOOKS)[:, None] ** np.arange(torque.coefficients.shape[2])
    values = torque.coefficients @ x.T
    ones = find_commands(torque, np.ones(2)).coefficients @ x.T
    rates, commands = ones - values, values + scene.actuator_lag[:, None] * (ones - values)
    steps = np.abs(values[1:, :, 0] - values[:-1, :, -1])
    found = list[tuple[float, str]]()
    limits = zip(scene.torque_limit, scene.torque_rate_limit, scene.actuator_lag, strict=True)
    for joint, (limit, fastest, lag) in enumerate(limits):
        name = f"tau_{joint + 1}"
        if np.isinf(fastest) and not lag:
            continue
        worst = int(steps[:, joint].argmax()) if len(steps) else 0
        if len(steps) and steps[worst, joint] > STEPPED * limit:
            t = float(torque.breaks[worst + 1])
            text = f"{name} steps by {steps[worst, joint]:.3g} N m at t = {t:.5g} s"
            why = (
                f"its rate limit is {fastest:g} N m/s" if np.isfinite(fastest) else "its motor lags"
            )
            found.append((t, f"{text}, where {why}"))
        kinds = (
            (rates[:, joint], fastest, "changes at {:.4g} N m/s, above its rate limit {:g} N m/s"),
            (commands[:, joint], limit, "takes a command of {:.4g} N m, above its limit {:g} N m"),
        )
        for of, most, text in kinds:
            size = np.abs(of)
            piece, look = np.unravel_index(int(size.argmax()), size.shape)
            if size[piece, look] > most * (1 + HURRIED):
                start, stop = torque.breaks[[piece, piece + 1]]
                t = float(start + (stop - start) * look / (_LOOKS - 1))
                said = text.format(size[piece, look], most)
                found.append((t, f"{name} {said}, at t = {t:.5g} s"))
    return found
