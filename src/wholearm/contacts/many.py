"""Many formations at once, each at few configurations: by contact, and by what they have alike."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..common.arrays import Array
from ..scene.model import Scene
from .closing import Flags, Numbers, contact_table, evaluate_contacts
from .formation import Formation, Kinematics


def evaluate_each(scene: Scene, labels: Numbers, z: Array, v: Array | None = None) -> Kinematics:
    """Rows of n formations of contacts that slide, each at a configuration of its own.

    Parameters
    ----------
    scene : Scene
    labels : ndarray of int, shape (n, n_c)
        Contacts, as indices into `closing.contact_table`.
    z, v : ndarray, shape (n, 5)
        Configurations, and the velocities for A' v, `z` if left out.
    """
    v = z if v is None else v
    C, A_dot_v = np.empty((2, *labels.shape))
    A, A_t = np.empty((2, *labels.shape, 5))
    for index in np.unique(labels).tolist():
        rows, places = np.nonzero(labels == index)
        own = evaluate_contacts(scene, [index], z[rows], v[rows])
        C[rows, places], A_dot_v[rows, places] = own.C[:, 0], own.A_dot_v[:, 0]
        A[rows, places], A_t[rows, places] = own.A[:, 0], own.A_t[:, 0]
    return Kinematics(C, A, A_t, A_dot_v, A, A_dot_v)


def group_alike(scene: Scene, labels: Numbers) -> Iterator[tuple[Formation, Flags]]:
    """Groups of formations with the same friction at each contact, one of which stands for all.

    All else that the mechanics takes of a formation is in its rows.
    """
    table = contact_table(scene)
    fingers = np.array([-1 if own.finger is None else own.finger for own in table])[labels]
    for kind in np.unique(fingers, axis=0):
        rows = (fingers == kind).all(axis=1)
        contacts = tuple(table[k] for k in labels[int(rows.argmax())].tolist())
        yield Formation(scene, contacts), rows
