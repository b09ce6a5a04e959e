"""Stages that a solution asks for: limits watched, intervals halved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .collocation import Scheme
from .mesh import bisect
from .stage import Stage, StagePoints

_BROKEN = 1e-6
"""How far below zero a limit is broken, over the radius of gyration."""


def adopt(stages: Sequence[Stage], points: Sequence[StagePoints]) -> list[Stage]:
    """The same stages with a solution as their guess."""
    return [replace(stage, guess=part) for stage, part in zip(stages, points, strict=True)]


def halve(
    stages: Sequence[Stage], scheme: Scheme, marked: Sequence[NDArray[np.bool_]]
) -> list[Stage]:
    """Stages with the marked intervals halved, each of shape (K,)."""
    return [
        replace(stage, guess=bisect(stage.guess, scheme, mine)) if mine.any() else stage
        for stage, mine in zip(stages, marked, strict=True)
    ]


def watch_broken(stages: Sequence[Stage]) -> list[Stage] | None:
    """Stages that also watch the limits which their guesses break, or None if they break none."""
    changed = []
    for stage in stages:
        values = stage.formation.evaluate_limits(stage.guess.z.reshape(-1, 5))
        rho = stage.formation.scene.polygon.gyration_radius
        broken = np.flatnonzero(values.min(axis=0) < -_BROKEN * rho).tolist()
        changed.append(replace(stage, watched=tuple(sorted({*stage.watched, *broken}))))
    watched = [stage.watched for stage in stages]
    return changed if [stage.watched for stage in changed] != watched else None
