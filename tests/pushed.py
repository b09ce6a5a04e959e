"""Accelerations and contact forces from joint torques, by the package's own forward dynamics."""

from __future__ import annotations

import numpy as np

from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.mechanics.dynamics import Directions, build_forward


def forward(
    formation: Formation, z: Array, v: Array, tau: Array, directions: Directions
) -> tuple[Array, Array]:
    """z'', shape (5,), and c, shape (n_c + R,), of one state."""
    acceleration, c, _ = build_forward(formation)(z, v, tau, *directions)
    return np.asarray(acceleration.full()[:, 0]), np.asarray(c.full()[:, 0])
