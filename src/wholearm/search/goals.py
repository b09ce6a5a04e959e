"""Goals at places, along curves and inside cells of the roadmap."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..geometry.curve import Curve, find_root, refine
from ..geometry.tracing import HELD
from ..problem.definition import Until
from ..problem.goal import Goal
from ..scene.model import Scene
from .places import RoadmapPlace, unit_steps

ACROSS = np.linspace(-1.5, 1.5, 13)  # sampled x of goals without x, in radii of gyration


def is_flush(place: RoadmapPlace, edge: int) -> bool:
    """Whether an edge lies on the palm."""
    count = place.scene.polygon.n_vertices
    palm = {c.index for c in place.contacts if c.finger is None}
    return {edge, (edge + 1) % count} <= palm


def is_at(place: RoadmapPlace, goal: Goal) -> bool:
    """Whether a place is a goal."""
    scene = place.scene
    if goal.x is not None and abs(place.z[0] - goal.x) > HELD * scene.scales.length:
        return False
    if goal.flush is not None:
        return is_flush(place, goal.flush)
    assert goal.phi is not None
    return bool(abs(place.z[2] - goal.phi) < HELD)


def measure_along(curve: Curve, goal: Goal) -> tuple[float, Until] | None:
    """First place inside a curve at which a goal is met [m], and the end of a phase there.

    A flush goal without x is met only at the ends of curves.
    """
    scene = curve.formation.scene
    if goal.flush is not None:
        palm = {c.index for c in curve.formation.contacts if c.finger is None}
        count = scene.polygon.n_vertices
        if goal.x is None or {goal.flush, (goal.flush + 1) % count} != palm:
            return None
        s = _find_first(curve, 0, goal.x)
        return None if s is None else (s, Until(coordinate="x", value=goal.x))
    assert goal.phi is not None
    s = _find_first(curve, 2, goal.phi)
    if s is None:
        return None
    x = float(curve.interpolate(np.array([s]))[0][0, 0])
    if goal.x is not None and abs(x - goal.x) > HELD * scene.scales.length:
        return None
    return s, Until(coordinate="phi", value=goal.phi)


def _find_first(curve: Curve, row: int, value: float) -> float | None:
    """First place along a curve at which a coordinate takes a value, beyond its start."""
    grid = np.concatenate([refine(panel.s, curve.length) for panel in curve.panels])
    grid = np.unique(grid[grid <= curve.length])
    off = curve.interpolate(grid)[0][:, row] - value
    least = HELD * (curve.formation.scene.scales.length if row == 0 else 1.0)
    if abs(off[0]) < least:
        return None
    changes = np.flatnonzero(off[:-1] * off[1:] <= 0)
    if not len(changes):
        return None
    k = int(changes[0])
    if off[k + 1] == 0:
        return float(grid[k + 1])
    return find_root(
        lambda s: float(curve.interpolate(np.array([s]))[0][0, row]) - value,
        float(grid[k]),
        float(grid[k + 1]),
    )


def list_pins(goal: Goal) -> tuple[tuple[str, float], ...]:
    """Terminal constraints of a phase through a cell that ends at a goal."""
    return () if goal.x is None else (("x", goal.x),)


def list_poses(scene: Scene, z: Array, goal: Goal) -> Array:
    """Candidate poses (x, phi) of a goal inside a cell near a configuration, shape (n, 2)."""
    if goal.phi is None:
        return np.zeros((0, 2))
    if goal.x is not None:
        return np.array([[goal.x, goal.phi]])
    x = float(z[0]) + ACROSS * float(unit_steps(scene)[0])
    return np.column_stack([x, np.full(len(x), goal.phi)])


def measure_turn(place: RoadmapPlace, goal: Goal) -> float:
    """Least angle that the object has to turn to the goal [rad]."""
    phi = float(place.z[2])
    return abs(goal.find_angle(place.scene, phi) - phi)
