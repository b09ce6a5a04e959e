"""Starts of replays with penetrations that give the planned forces; torques of policies."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation, find_touching
from ..policy.playback import ClosedLoop
from ..problem.definition import Problem
from ..scene.model import Scene
from .stretch import EngineStretch

CREEP = 10.0
"""regularization speed of dry friction, over its change of speed in a step."""
LOOSE = 3e-7  # gap of contacts without a force, over the scene's length
_APART = 0.1
"""Share of a contact's row that no other contact has, from which on it is another place."""


def press_in(problem: Problem, stretch: EngineStretch, stiffness: Mapping[str, float]) -> Array:
    """The planned start with penetrations of planned force over stiffness [N/m], shape (5,).

    It is the nearest such configuration in the metric of the kinetic energy. Contacts without a
    force, such as released ones, get a small gap: oscillations at the start would hit them.
    """
    scene, formation = problem.scene, problem.phases[stretch.phases[0]].formation
    touching = find_touching(scene, stretch.z)
    contacts = formation.contacts + tuple(c for c in touching if c not in formation.contacts)
    A = Formation(scene, contacts).evaluate(stretch.z[None], stretch.z_dot[None]).A[0]
    weight = 1 / np.sqrt(scene.mass_diagonal)
    rows = _list_independent(A * weight, formation.n_contacts)
    depth = np.full(len(contacts), -LOOSE * scene.scales.length)
    for k, name in enumerate(formation.names):
        depth[k] = stretch.c_n[name] / stiffness[name]
    return np.asarray(stretch.z - weight * (np.linalg.pinv((A * weight)[rows]) @ depth[rows]))


def _list_independent(rows: Array, kept: int) -> list[int]:
    """The first `kept` rows, and those of the others that are independent of the rows before."""
    unit, chosen = rows / np.linalg.norm(rows, axis=1)[:, None], list(range(kept))
    for row in range(kept, len(rows)):
        basis = unit[chosen]
        rest = unit[row] - np.linalg.pinv(basis) @ (basis @ unit[row])
        if np.linalg.norm(rest) > _APART:
            chosen.append(row)
    return chosen


class EngineDrive:
    """Torques of a policy in an engine, sampled, delayed, and less regularized dry friction.

    Parameters
    ----------
    h : [s]  time between two calls

    Attributes
    ----------
    over  whether the motion is over
    """

    def __init__(self, scene: Scene, loop: ClosedLoop, h: float) -> None:
        self.loop, self.h = loop, h
        self.dry = scene.dry[3:]
        inertia = np.array([finger.inertia for finger in scene.fingers])
        self.creep = np.maximum(CREEP * self.dry * h / inertia, np.finfo(float).tiny)
        self.samples, self.tau = 0, np.zeros(2)
        self.coming: deque[tuple[float, Array]] = deque()
        self.over = False

    def step(self, t: float, theta: Array, theta_dot: Array) -> Array:
        """Applied torques at a time, shape (2,) [N m]; times increase from zero."""
        t += 0.5 * self.h
        if t >= self.samples * self.loop.period:
            at = self.samples * self.loop.period
            tau = np.array(self.loop.held(at, theta, theta_dot, {}))
            self.coming.append((at + self.loop.delay if self.samples else 0.0, tau))
            self.samples += 1
            self.over = self.loop.over
        while self.coming and t >= self.coming[0][0]:
            self.tau = self.coming.popleft()[1]
        return np.asarray(self.tau - self.dry * np.clip(theta_dot / self.creep, -1.0, 1.0))
