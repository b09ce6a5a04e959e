"""Goals at which the hand cannot close: no search is needed to refuse them."""

from __future__ import annotations

import numpy as np

from ..common.errors import InfeasibleError
from ..contacts.closing import close_fingers, describe_obstacle
from ..contacts.reach import name_reach
from ..problem.goal import Goal
from ..scene.model import Scene

NEAR = 1e-4
"""How far beside a goal the hand may close instead, in radii of gyration."""


def require_reach(scene: Scene, goal: Goal, near: float) -> None:
    """Check that both fingers close on an object that lies at a goal.

    Parameters
    ----------
    scene : Scene
    goal : Goal
    near : float, [rad]
        Angle of the object before.

    Raises
    ------
    InfeasibleError
        If they do not; says where they would.
    """
    if goal.x is None:
        return
    phi = goal.find_angle(scene, near)
    x = goal.x + NEAR * scene.scales.length * np.array([0.0, -1.0, 1.0])
    closed = close_fingers(scene, x, np.full(3, phi))
    if (closed.obstacle > 0).any(axis=1).all():
        why, where = describe_obstacle(closed), name_reach(scene, phi)
        raise InfeasibleError(f"nothing leads to {goal}: {why} there; {where}")
