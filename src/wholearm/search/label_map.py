"""What touches, all over the plane of x and phi, on a grid.

Rays through cells are followed on it before anything is looked at closely.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Numbers
from ..mapping.borders import label_cells
from ..scene.model import Scene
from .places import unit_steps

AROUND = 64
"""Places of the grid around a turn; as far apart in x, in radii of gyration, as they are in phi."""


class LabelMap(NamedTuple):
    """Labels on a grid of poses.

    Attributes
    ----------
    least : float, [m]
        Least x.
    steps : ndarray, shape (2,), [m, rad]
        Distances of places in x and phi.
    labels : ndarray of int, shape (n, 3)
        Every label that there is: indices of the contacts with palm and fingers, or
        `borders.NOWHERE` where a finger cannot close.
    which : ndarray of int, shape (n_x, AROUND)
        Which of these is where. phi starts from zero.
    """

    least: float
    steps: Array
    labels: Numbers
    which: Numbers

    def look_up(self, poses: Array) -> Numbers:
        """Which label the nearest places of the grid have, shape (...), for poses (..., 2)."""
        row = np.rint((poses[..., 0] - self.least) / self.steps[0]).astype(np.int64)
        column = np.rint(poses[..., 1] / self.steps[1]).astype(np.int64)
        # The first and the last row are beyond the reach of a finger.
        return np.asarray(self.which[np.clip(row, 0, len(self.which) - 1), column % AROUND])

    def find(self, labels: Numbers) -> Numbers:
        """Which of the labels some are, shape (m,); -1 for those that are nowhere on the grid."""
        same = (labels[:, None] == self.labels).all(axis=2)
        return np.where(same.any(axis=1), same.argmax(axis=1), -1)


@lru_cache(maxsize=16)
def map_labels(scene: Scene) -> LabelMap:
    """Labels wherever both fingers reach the object."""
    steps: Array = 2 * np.pi / AROUND * unit_steps(scene)
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    bases = np.array([np.asarray(link.base)[0] for link in scene.fingers])
    reach = np.array([link.length + link.radius + size for link in scene.fingers])
    least, most = (bases - reach).max() - steps[0], (bases + reach).min() + steps[0]
    x = least + steps[0] * np.arange(max(2, np.ceil((most - least) / steps[0]) + 1))
    phi = steps[1] * np.arange(AROUND)
    labels = label_cells(scene, np.repeat(x, len(phi)), np.tile(phi, len(x)))[:, [0, 2, 4]]
    every, which = np.unique(labels, axis=0, return_inverse=True)
    return LabelMap(float(least), steps, every, which.reshape(len(x), len(phi)))
