"""Starts of replays at which contacts, which give way in engines, press as the plan says."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation, find_touching
from ..policy.closed_loop import ClosedLoop
from ..problem.definition import Problem
from ..scene.model import Scene
from .stretch import EngineStretch

CREEP = 10.0
"""Speed from which on dry friction is all there, over that which it takes away in a step."""
LOOSE = 3e-7  # Gap of what touches without a force, over the scene's length
_APART = 0.1
"""Share of a contact's row that no other contact has, from which on it is another place."""


def press_in(problem: Problem, stretch: EngineStretch, stiffness: Mapping[str, float]) -> Array:
    """The planned start, with contacts pressed in as far as the planned forces press them.

    What touches elsewhere without a force, as a contact that has just been let go, is loose: it
    would be hit by what swings at the start.

    Parameters
    ----------
    stiffness  that of each contact [N/m]

    Returns
    -------
    ndarray, shape (5,)
        The nearest such configuration, by the kinetic energy of getting there.
    """
    scene, formation = problem.scene, problem.phases[stretch.phases[0]].formation
    touching = find_touching(scene, stretch.z)
    contacts = formation.contacts + tuple(c for c in touching if c not in formation.contacts)
    A = Formation(scene, contacts).evaluate(stretch.z[None], stretch.z_dot[None]).A[0]
    weight = 1 / np.sqrt(scene.mass_diagonal)
    rows = _drop_repeated(A * weight, formation.n_contacts)
    depth = np.full(len(contacts), -LOOSE * scene.scales.length)
    for k, name in enumerate(formation.names):
        depth[k] = stretch.c_n[name] / stiffness[name]
    return np.asarray(stretch.z - weight * (np.linalg.pinv((A * weight)[rows]) @ depth[rows]))


def _drop_repeated(rows: Array, kept: int) -> list[int]:
    """The first rows, and of the others those that are not at the place of one before."""
    unit, chosen = rows / np.linalg.norm(rows, axis=1)[:, None], list(range(kept))
    for row in range(kept, len(rows)):
        known = unit[chosen]
        rest = unit[row] - np.linalg.pinv(known) @ (known @ unit[row])
        if np.linalg.norm(rest) > _APART:
            chosen.append(row)
    return chosen


class EngineDrive:
    """The torques that a policy applies in an engine.

    Parameters
    ----------
    h : [s]  time between two calls

    Attributes
    ----------
    over  whether the motion is
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
