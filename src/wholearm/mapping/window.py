"""Which part of the (x, phi) plane a map shows, and what touches on its grid."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..contacts.closing import Numbers, close_fingers, lower
from ..problem.definition import Problem
from ..scene.model import Scene
from .borders import Window, label_closed
from .route import trace_problem

BEYOND = np.radians(6.0)
"""Reach of the window beyond the flush angles next to the plan [rad]."""
BESIDE = 0.25
"""The same over half the distance of these angles, at most."""


@exclusive
def choose_window(problem: Problem, phi_deg: tuple[float, float] | None = None) -> Window:
    """All x that both fingers reach, and phi one flush angle beyond what the phases cover.

    Parameters
    ----------
    problem : Problem
    phi_deg : (float, float), [deg]
        Take this range of phi instead.

    Raises
    ------
    InputError
        If both fingers reach the object nowhere.
    """
    scene = problem.scene
    low, high = _cover_phases(problem) if phi_deg is None else np.radians(phi_deg).tolist()
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    reach = [size + f.length + f.radius for f in scene.fingers]
    bases = [float(np.asarray(f.base)[0]) for f in scene.fingers]
    left = max(base - r for base, r in zip(bases, reach, strict=True))
    right = min(base + r for base, r in zip(bases, reach, strict=True))
    grid = np.linspace(left, max(left, right), 60)
    _, obstacle = label_grid(scene, grid, np.linspace(low, high, 60))
    reached = grid[(obstacle == 0).any(axis=0)]
    if not len(reached):
        raise InputError(problem.source, "fingers", "nowhere do both reach the object")
    step = grid[1] - grid[0]
    return Window((float(reached[0] - step), float(reached[-1] + step)), (low, high))


def _cover_phases(problem: Problem) -> tuple[float, float]:
    """Range of phi [rad] that reaches a little beyond the flush angles next to the phases."""
    angles = [float(problem.start[2])]
    angles += [float(phi) for path in trace_problem(problem) for phi in path[[0, -1], 1]]
    for phase in problem.phases:
        if phase.until.coordinate == "phi" and phase.until.value is not None:
            angles.append(phase.until.value)
    angles += [goal.find_angle(problem.scene, angles[-1]) for goal in problem.goals]
    low, high = min(angles), max(angles)
    around = Window((0.0, 0.0), (low - 2 * np.pi, high + 2 * np.pi)).flush_angles(problem.scene)
    flush = np.array([angle for angle, _ in around])
    # What is flush at an end of the plan is not yet the next edge.
    before, after = float(flush[flush < low - 1e-6].max()), float(flush[flush > high + 1e-6].min())
    # The next edge but one is not of interest, however many there are.
    beyond = min(BEYOND, BESIDE * (after - before) / 2)
    return before - beyond, after + beyond


def label_grid(scene: Scene, x: Array, phi: Array) -> tuple[Numbers, Numbers]:
    """Labels (n_phi, n_x, 6) and obstacles (n_phi, n_x), 0 or as in `FormationMap.cell`."""
    x, phi = (part.ravel() for part in np.meshgrid(x, phi))
    closed = close_fingers(scene, x, phi)
    labels = label_closed(closed, lower(scene, phi)[1])
    both = closed.obstacle
    codes = np.where(both > 0, 2 * both - 1 + np.array([0, 1]), 0)
    obstacle = np.where(codes[:, 0] > 0, codes[:, 0], codes[:, 1])
    shape = (len(np.unique(phi)), -1)
    return labels.reshape(*shape, 6), obstacle.reshape(shape)
