"""Changes of the torques at an instant with which limits hold there that are missed.

Everything is affine in both torques, so that a limit is a half plane of their changes.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..mechanics.limits import LimitSet
from ..results.tuning import TorqueChange

KEPT = 1e-9
"""Shortfall of a limit that counts as none, over what is much for it."""
FLAT = 1e-9
"""What a limit's slack changes with a torque below which it does not depend on it, in what is much
for each."""


def find_changes(
    limits: LimitSet, sides: Array, missed: NDArray[np.bool_], tau: Array, much: float
) -> tuple[TorqueChange, ...]:
    """Least changes of each torque alone that mend some limits, and of both where those spoil some.

    Other limits have to be kept; what they miss already they must not miss by more.

    Parameters
    ----------
    limits : LimitSet
    sides : ndarray, shape (n_sides, 3)
        Slack of its one-sided limits is sides @ (1, tau_1, tau_2).
    missed : ndarray of bool, shape (n_sides,)
        Which sides are to be mended.
    tau : ndarray, shape (2,), [N m]
    much : float, [N m]
        What is much for a torque.
    """
    owners = limits.owners[limits.sides[0]]
    scale = limits.scales[limits.sides[0]]
    slack, slope = normalise(sides, scale, tau, much)
    slack = np.where(missed, slack, np.maximum(slack, 0.0))

    def describe(change: Array) -> TorqueChange:
        short = -(slack + slope @ change)
        worst, but = int(short.argmax()), ""
        if short[worst] > KEPT:
            limit = limits.limits[owners[worst]]
            but = f"{limit.text} is {short[worst] * scale[worst]:.3g} {limit.unit} short"
        return tell(much * change, tau, but)

    singles = [change_one(slack, slope, joint) for joint in range(2)]
    found = [describe(one) for one in singles if one is not None]
    both = change_both(slack, slope) if all(change.but for change in found) else None
    found += [] if both is None else [describe(both)]
    return tuple(sorted(found, key=lambda change: (bool(change.but), np.hypot(*change.change))))


def normalise(sides: Array, scale: Array, tau: Array, much: float) -> tuple[Array, Array]:
    """Slack under torques `tau` and its slope, (n,) and (n, 2), in what is much for each."""
    slack = sides @ np.array([1.0, *tau]) / scale
    return np.asarray(slack), sides[:, 1:] * (much / scale)[:, None]


def tell(change: Array, tau: Array, but: str = "", holds: bool = False) -> TorqueChange:
    """A change of torques `tau`, shape (2,) [N m]."""
    (first, second), (one, other) = change.tolist(), (tau + change).tolist()
    return TorqueChange((first, second), (one, other), but, holds)


def change_one(slack: Array, slope: Array, joint: int) -> Array | None:
    """The least change of one torque with which slack + slope @ change >= 0 where slack < 0.

    None if there is none; others than these may then be missed.
    """
    short = slack < 0
    slack, along = slack[short], slope[short, joint]
    if (np.abs(along) < FLAT).any() or ((along > 0).any() and (along < 0).any()):
        return None
    change = np.zeros(2)
    steps = -slack / along
    change[joint] = steps[np.abs(steps).argmax()] if len(steps) else 0.0
    return change


def change_both(slack: Array, slope: Array) -> Array | None:
    """The shortest change with slack + slope @ change >= 0: on a side, or in a corner of two."""
    sizes = np.linalg.norm(slope, axis=1)
    steep = sizes > FLAT
    normal, reach = slope[steep] / sizes[steep, None], slack[steep] / sizes[steep]
    found = [-own * normal[k] for k, own in enumerate(reach)]
    for i, j in combinations(range(len(reach)), 2):
        pair = normal[[i, j]]
        if abs(np.linalg.det(pair)) > FLAT:
            found.append(np.linalg.solve(pair, -reach[[i, j]]))
    kept = [change for change in found if (slack + slope @ change >= -KEPT).all()]
    return min(kept, key=np.linalg.norm, default=None)
