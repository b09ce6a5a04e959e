"""Torques as engines get them: those of the plan less the dry friction of its joints.

Engines have no dry joint friction as rigid bodies need it: MuJoCo's gives way a little, Drake has
none. On the plan it is known, D sgn(theta'), and so is part of the torque that is applied. A replay
that turns a joint the other way than planned gets the wrong friction.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array, sort_unique
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..scene.model import Scene

_LOOKS = 2000
"""Instants of each phase at which the sign of a joint's speed is looked at."""


def apply_friction(scene: Scene, plan: Trajectory) -> TorqueProfile:
    """The torques of a plan less D sgn(theta') of its own joint velocities, with its steps."""
    torque = plan.torque
    cuts = sort_unique(np.concatenate([torque.breaks, *_find_reversals(plan)]))
    cuts = cuts[np.append(True, np.diff(cuts) > 1e-12 * torque.duration)]
    cuts[-1] = torque.breaks[-1]
    turns = np.sign(plan.at((cuts[1:] + cuts[:-1]) / 2).z_dot[:, 3:]) * scene.dry[3:]

    def evaluate(t: Array) -> Array:
        piece = np.searchsorted(cuts, t, side="right") - 1
        return np.asarray(torque.at(t) - turns[piece])

    return TorqueProfile.fit(cuts, evaluate, torque.coefficients.shape[2] - 1)


def _find_reversals(plan: Trajectory) -> list[Array]:
    """Instants at which a joint turns back within a phase, for each phase and joint [s]."""
    found = []
    for start, motion in zip(plan.phase_starts[:-1], plan.motions, strict=True):
        t = np.linspace(0.0, motion.duration, _LOOKS)
        for speed in motion.evaluate(t).z_dot[:, 3:].T:
            back = np.flatnonzero(speed[1:-2] * speed[2:-1] < 0) + 1
            share = speed[back] / (speed[back] - speed[back + 1])
            found.append(start + t[back] + share * (t[back + 1] - t[back]))
    return found
