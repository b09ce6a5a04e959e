"""Where a motion so slow that inertia does not count keeps every contact pressed.

At vanishing speed and acceleration the object's balance g_obj + (W_n - W_t U Xi) c_n = 0 and the
joints' tau = D sigma - (J_n - J_t U Xi)^T c_n, in this package's signs the rows of -G^T c_n, hold
with the friction that the direction of travel gives. Three contacts leave no choice; four leave the
squeeze free, an interval of which may satisfy c_n >= epsilon and the torque limits. What could be
balanced so, but not by these forces alone (`mechanics.uniqueness`), is ambiguous; so is what jams.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers
from ..contacts.formation import Formation, Kinematics
from ..contacts.many import evaluate_each, group_alike
from ..mechanics.dynamics import Directions, force_rows, inverse
from ..mechanics.metric import metric_weights
from ..mechanics.uniqueness import UNIQUENESS_MARGIN, find_minors
from ..quasistatic.squeeze import Squeezing
from ..scene.model import Scene

WAYS = ("+x", "-x", "+phi", "-phi")
"""Directions of travel inside a cell."""
REGULAR = 1e-9
"""Least ratio of singular values of A at which contacts count as independent; least determinant of
their wrenches, in radii of gyration, likewise."""
_WAYS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def check_border(
    scene: Scene,
    epsilon: float,
    label: Numbers,
    z: Array,
    coordinate: int | Numbers,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
) -> tuple[Flags, Flags, Flags]:
    """Whether a quasistatic motion along a border is possible, each way.

    Parameters
    ----------
    epsilon : float, [N]
        Least normal force.
    label : ndarray of int, shape (4,) or (n, 4)
        The four contacts, as indices into `closing.contact_table`: one border's, or each place's.
    z : ndarray, shape (n, 5)
        Configurations on borders.
    coordinate : {0, 2} or ndarray of int, shape (n,)
        x or phi, whichever increases along the border.
    uniqueness_margin : float
        Least uniqueness margin, as of `find_minors`.

    Returns
    -------
    forth, back : ndarray of bool, shape (n,)
        For travel with the coordinate increasing, and decreasing.
    ambiguous : ndarray of bool, shape (n,)
        Whether it would be, one way or the other, if contact forces were the only ones.
    """
    labels = np.broadcast_to(label, (len(z), 4))
    kinematics = evaluate_each(scene, labels, z)
    weights = np.sqrt(metric_weights(scene))
    _, sizes, rows = np.linalg.svd(kinematics.A / weights)
    z_s = rows[:, -1] / weights
    along = z_s[np.arange(len(z)), coordinate]
    z_s *= np.where(along < 0, -1.0, 1.0)[:, None]
    regular = sizes[:, -1] > REGULAR * sizes[:, 0]
    held, unique = (np.zeros((2, len(z)), dtype=bool) for _ in range(2))
    for formation, mine in group_alike(scene, labels):
        (own,) = np.nonzero(mine & regular)
        part = Kinematics(*(array[own] for array in kinematics))
        for row, sole, way in zip(held, unique, (z_s[own], -z_s[own]), strict=True):
            row[own] = _check_path(formation, part, epsilon, z[own], way)
            sole[own[row[own]]] = _are_unique(formation, part, way, row[own], uniqueness_margin)
    return held[0] & unique[0], held[1] & unique[1], np.any(held & ~unique, axis=0)


def check_cell(
    scene: Scene,
    epsilon: float,
    label: Numbers,
    z: Array,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
) -> tuple[Flags, Flags]:
    """Whether a quasistatic motion from inside a cell is possible towards each of `WAYS`.

    Parameters
    ----------
    epsilon : float, [N]
        Least normal force.
    label : ndarray of int, shape (3,) or (n, 3)
        The three contacts, as indices into `closing.contact_table`: palm, finger 1, finger 2.
    z : ndarray, shape (n, 5)
        Configurations in cells.
    uniqueness_margin : float
        As of `check_border`.

    Returns
    -------
    possible : ndarray of bool, shape (n, 4)
    ambiguous : ndarray of bool, shape (n,)
        Whether one more of them would be, if contact forces were the only ones.
    """
    labels = np.broadcast_to(label, (len(z), 3))
    kinematics = evaluate_each(scene, labels, z)
    held, unique = (np.zeros((len(z), len(WAYS)), dtype=bool) for _ in range(2))
    rows = np.zeros((2, 5))
    rows[[0, 1], [0, 2]] = 1.0
    matrix = np.concatenate([kinematics.A, np.broadcast_to(rows, (len(z), 2, 5))], axis=1)
    regular = np.abs(np.linalg.det(matrix)) > REGULAR * scene.scales.length**2
    part = Kinematics(*(array[regular] for array in kinematics))
    for formation, _ in group_alike(scene, labels):
        for k, way in enumerate(_WAYS):
            right = np.zeros((regular.sum(), 5, 1))
            right[:, 3:, 0] = way
            z_s = np.linalg.solve(matrix[regular], right)[..., 0]
            held[regular, k] = _check_balance(formation, part, epsilon, z_s)
            own = _are_unique(formation, part, z_s, held[regular, k], uniqueness_margin)
            unique[held[:, k], k] = own
    return held & unique, np.any(held & ~unique, axis=1)


def _check_path(
    formation: Formation, kinematics: Kinematics, epsilon: float, z: Array, z_s: Array
) -> Flags:
    directions = Directions.of(kinematics, z_s)
    forces = inverse(formation, z, z_s, np.zeros_like(z_s), directions, kinematics)
    squeezing, still = Squeezing.of(formation, forces, z_s[:, 3:]), np.zeros(len(z))
    low, high = squeezing.find_span(still, still, epsilon)
    return np.asarray(low <= high)


def _check_balance(
    formation: Formation, kinematics: Kinematics, epsilon: float, z_s: Array
) -> Flags:
    scene, directions = formation.scene, Directions.of(kinematics, z_s)
    G = force_rows(formation, kinematics, directions)
    wrench = G[:, :, :3].transpose(0, 2, 1)
    regular = np.abs(np.linalg.det(wrench)) > REGULAR * scene.scales.length
    wrench[~regular] = np.eye(3)
    right = np.broadcast_to(-scene.applied_force[:3, None], (len(G), 3, 1))
    c_n = np.linalg.solve(wrench, right)[..., 0]
    tau = scene.dry[3:] * directions.sigma - np.einsum("nij,ni->nj", G[:, :, 3:], c_n)
    held = (c_n >= epsilon).all(axis=1) & (np.abs(tau) <= scene.torque_limit).all(axis=1)
    return np.asarray(held & regular)


def _are_unique(
    formation: Formation, kinematics: Kinematics, z_s: Array, rows: Flags, uniqueness_margin: float
) -> Flags:
    """Whether contact forces of travel along `z_s` are the only ones, at those of the `rows`."""
    part = Kinematics(*(array[rows] for array in kinematics))
    Xi = Directions.of(part, z_s[rows]).Xi
    return np.asarray(find_minors(formation, part, Xi).ratios >= uniqueness_margin)
