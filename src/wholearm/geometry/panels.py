"""Panels of curves: polynomials through points of a one-freedom formation's curve.

The points whose projection on the panel's first tangent is a Chebyshev-Lobatto node are solved for
by Newton, all at once, and the arc length is integrated spectrally.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.metric import metric_weights
from .curve import Panel, border

NODES = 17
"""Nodes of a panel."""
RESOLVED = 1e-13
"""Largest trailing Chebyshev coefficient of a resolved panel, relative to the object's size."""
NEWTON = 3e-8
"""Last change of Newton's method, in radii of gyration: the next one would be about its square."""
SHORTER = 0.5
"""Factor on the length of a panel whose points are not found."""
AIM = 0.3
"""Trailing coefficient that the length of a panel is chosen for, over the largest one."""


class Guess(NamedTuple):
    """Points of a panel that is too long, as Chebyshev coefficients, shape (NODES, 5)."""

    step: float
    coefficients: Array

    def evaluate(self, step: float) -> Array:
        """Points at the nodes of a shorter panel, shape (NODES, 5)."""
        angles = np.arccos(2 * step / self.step * _chebyshev()[0] - 1)
        return np.asarray(np.cos(np.outer(angles, np.arange(NODES))) @ self.coefficients)


def build_panel(
    formation: Formation,
    slip: Array,
    z: Array,
    heading: Array,
    start: float,
    step: float,
    guess: Guess | None,
) -> tuple[Panel | None, float, Guess | None]:
    """Trace one panel of about `step` metres, or none when that is too far.

    Rolling contacts keep the slip coordinates `slip`, shape (R,) [m].

    Returns
    -------
    panel : Panel or None
    factor : float
        By which the next step is to differ.
    guess : Guess or None
        About where a shorter panel runs.
    """
    unit, integrate, analyse = _chebyshev()
    metric = metric_weights(formation.scene)
    projection = heading * metric
    u = step * unit
    points = z + u[:, None] * heading if guess is None else guess.evaluate(step)
    rho = formation.scene.polygon.gyration_radius
    kinematics, size = formation.evaluate(points, points), np.inf
    for count in range(12):
        slid = formation.evaluate_slip(points) - slip
        residual = np.column_stack([kinematics.C, slid, (points - z) @ projection - u])
        matrix = border(kinematics.P, projection)
        try:
            change = np.linalg.solve(matrix, -residual[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return None, SHORTER, None
        points = points + change
        kinematics = formation.evaluate(points, points)
        before, size = size, np.abs(change * np.sqrt(metric)).max()
        if size < NEWTON * rho or size > 10 * rho or (count > 2 and size > before / 2):
            break
    if not size < NEWTON * rho:
        return None, SHORTER, None
    z_u = np.linalg.solve(border(kinematics.P, projection), np.eye(5)[:, 4:])[..., 0]
    speed = np.sqrt(z_u**2 @ metric)
    scaled = np.column_stack([(points - z) * np.sqrt(metric) / rho, speed])
    tail = np.abs(analyse @ scaled)[-2:].max()
    factor = (AIM * RESOLVED / max(tail, 1e-3 * RESOLVED)) ** (1 / (NODES - 1))
    if speed.max() > 1.5 or tail > RESOLVED:
        return None, max(min(factor, 0.8), SHORTER**2), Guess(step, analyse @ points)
    return Panel(start + step * (integrate @ speed), points, z_u / speed[:, None]), factor, None


@lru_cache(maxsize=1)
def _chebyshev() -> tuple[Array, Array, Array]:
    """Lobatto nodes on [0, 1], the matrix of integrals from 0, and that of coefficients."""
    n = NODES - 1
    angles = np.pi * np.arange(NODES) / n
    unit = (1 - np.cos(angles)) / 2
    vandermonde = np.cos(np.outer(np.pi - angles, np.arange(NODES + 1)))
    analyse = np.linalg.inv(vandermonde[:, :NODES])
    integral = np.zeros((NODES, NODES))
    x = 2 * unit - 1
    integral[:, 0] = x + 1
    integral[:, 1] = (x**2 - 1) / 2
    for k in range(2, NODES):
        above, below = vandermonde[:, k + 1] / (k + 1), vandermonde[:, k - 1] / (k - 1)
        term = (above - below) / 2
        integral[:, k] = term - term[0]
    return unit, integral @ analyse / 2, analyse
