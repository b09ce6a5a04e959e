"""Torques by feedback in an engine: sampled, late, and less the dry friction of the joints.

Engines have no dry joint friction as rigid bodies need it. Here it is D times the joint's speed
over a small one, at most D: a joint at rest creeps at a part of that small speed.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ..common.arrays import Array
from ..policy.closed_loop import ClosedLoop
from ..scene.model import Scene

CREEP = 10.0
"""Speed from which on dry friction is all there, over that which it takes away in a step."""


class Drive:
    """The torques that a policy applies in an engine.

    Parameters
    ----------
    scene : Scene
    loop : ClosedLoop
    h : float, [s]
        Time between two calls.

    Attributes
    ----------
    over : bool
        Whether the motion is.
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
