"""Straight ways through cells, from rest to rest: what they lead to, and about how long they take.

In a cell three contacts touch, which leaves two freedoms. From a place rays set out over the plane
of x and phi; where they come to a border another contact is gained. Motions that bend, or set out
in motion, are faster: that is the planner's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import contact_table
from ..contacts.elemental import Contact
from ..contacts.explicit import place as place_at
from ..contacts.formation import Formation
from ..mapping.borders import label_cells
from .places import Place, unit_steps
from .rays import shoot
from .ways import list_middles, time_ways

NEAREST = 0.02
"""Length of the shortest way to a pose, in radii of gyration or radians."""

TIED = 1 - 1e-9
"""Part of another time below which a time is less: of mirrored ways the first is the fastest."""


class Crossing(NamedTuple):
    """A straight way through a cell.

    Attributes
    ----------
    source : int
        Which of the places it starts from.
    contacts : tuple of Contact
        What touches on the way.
    gained : Contact or None
        What is gained at its end; None where it ends at a pose that was given.
    z : ndarray, shape (5,)
        Its end.
    duration : float, [s]
    """

    source: int
    contacts: tuple[Contact, ...]
    gained: Contact | None
    z: Array
    duration: float


def cross(places: Sequence[Place], epsilon: float) -> list[Crossing]:
    """The fastest straight way through each cell to each contact, from each of some places.

    Parameters
    ----------
    places : sequence of Place
        Of one scene.
    epsilon : float, [N]
    """
    scene = places[0].scene
    rays = shoot(places, epsilon)
    times = time_ways(scene, epsilon, rays.labels, rays.starts, rays.ends)
    best: dict[tuple[int, ...], int] = {}
    for k in np.flatnonzero(np.isfinite(times)).tolist():
        key = int(rays.sources[k]), *rays.labels[k].tolist(), int(rays.gained[k])
        if key not in best or times[k] < TIED * times[best[key]]:
            best[key] = k
    chosen = [best[key] for key in sorted(best)]
    z, table = place_at(scene, rays.labels[chosen], rays.ends[chosen]), contact_table(scene)
    return [
        Crossing(
            int(rays.sources[k]),
            tuple(table[c] for c in rays.labels[k]),
            table[rays.gained[k]],
            end,
            float(times[k]),
        )
        for k, end in zip(chosen, z, strict=True)
    ]


def go_to(start: Place, formation: Formation, poses: Array, epsilon: float) -> Crossing | None:
    """The fastest straight way from a place to one of some poses (x, phi) inside a cell."""
    scene = start.scene
    index = {contact: k for k, contact in enumerate(contact_table(scene))}
    own = np.array([index[contact] for contact in formation.contacts])
    begin = np.broadcast_to(start.z[[0, 2]], poses.shape)
    middles = list_middles(begin, poses)
    places = np.concatenate([middles, poses[:, None]], axis=1)
    labels = label_cells(scene, *places.reshape(-1, 2).T)[:, [0, 2, 4]]
    inside = (labels == own).all(axis=1).reshape(places.shape[:2]).all(axis=1)
    inside &= np.abs((poses - begin) / unit_steps(scene)).max(axis=1) > NEAREST
    if not inside.any():
        return None
    ends = poses[inside]
    labels = np.broadcast_to(own, (len(ends), 3))
    times = time_ways(scene, epsilon, labels, begin[inside], ends)
    k = int(times.argmin())
    if not np.isfinite(times[k]):
        return None
    (z,) = place_at(scene, labels[:1], ends[k : k + 1])
    return Crossing(0, formation.contacts, None, z, float(times[k]))
