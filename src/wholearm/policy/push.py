"""Torques at the end of a phase: they press the contact that is gained, or hold what is reached."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..common.arrays import Array
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..mechanics.dynamics import Directions, force_rows, inverse
from ..mechanics.limits import PRESS, TORQUE, make_limits
from ..mechanics.sides import SideTerms
from .curve_rows import Rows
from .squeeze import choose_squeeze

ENOUGH = 5.0
"""Reserves beyond which more normal force is not asked for."""
LEAST = 0.3
"""Fewest reserves with which a contact counts as pressed."""
DRIVE = 0.15
"""Least acceleration with which a contact that is still open is closed, over the scene's unit."""
BRAKE = 0.3
"""Deceleration along the next curve for each reserve, over the scene's unit: the contact that is
gained need not be in the way of the motion."""
FRICTION = (0.7, 1.0, 1.2)
"""Parts of all friction with which the torques have to balance."""
FULL = 0.98
"""Part of the torque limits that is used."""


def find_arrival(curve: Curve, gained: Contact, rows: Rows) -> Array:
    """Levels of all contacts, the gained one too, that balance at the end of a curve, (k, 5).

    Affine as torques are there; there are none where forces at rest are not the only ones.
    """
    formation = curve.formation
    both = Formation(formation.scene, (*formation.contacts, gained), formation.rolling)
    reserves = rows.unit[-1, : formation.n_contacts]
    reserves, found = np.append(reserves, reserves.max()), [np.zeros((0, 5))]
    for own in _list_balances(curve, both, rows):
        forces = own[: both.n_contacts, 1:] @ rows.torque[-1]
        forces[:, 0] += own[: both.n_contacts, 0]
        found.append(forces / reserves[:, None])
    return np.vstack(found)


def find_push(curve: Curve, gained: Contact, rows: Rows, after: Rows | None) -> Array | None:
    """Torques that balance at rest with the gained contact and drive on without it, shape (2,).

    They are those for which the least normal force of all contacts is largest, in reserves; in the
    balance friction is as it was in the motion. None where no torques do all of it, or forces at
    rest are not the only ones.

    Parameters
    ----------
    curve : Curve
    gained : Contact
    rows : Rows
        Along the curve.
    after : Rows, optional
        Along the next one.
    """
    formation, scene = curve.formation, curve.formation.scene
    both = Formation(scene, (*formation.contacts, gained), formation.rolling)
    balances = _list_balances(curve, both, rows)
    if not balances:
        return None
    count, unit = both.n_contacts, scene.scales.acceleration
    reserves = rows.unit[-1, : formation.n_contacts]
    reserves = np.append(reserves, reserves.max())
    # Rows of (1, tau, level) >= 0: forces with all contacts, a without the gained one, forces then.
    to_motion = _invert(rows.torque[-1])
    forces = rows.ends.reshape(-1, 5)
    open_forces = forces[:, 3:] @ to_motion
    open_forces[:, 0] += forces[:, 0]
    open_reserves = np.tile(reserves[:-1], len(rows.ends))
    found = [
        *(np.column_stack([own[:count], -reserves]) for own in balances),
        np.append(to_motion[0] - [DRIVE * unit, 0.0, 0.0], 0.0)[None],
        np.column_stack([open_forces, -open_reserves]),
    ]
    # Where no torques do all of it, the next motion may be in the way.
    tables = [found]
    if after is not None:
        tables.insert(0, [*found, np.append(-_invert(after.torque[0])[0], -BRAKE * unit)[None]])
    for own in tables:
        tau = _find_best(np.vstack(own), scene.torque_limit)
        if tau is not None:
            return tau
    return None


def _find_best(rows: Array, limit: Array) -> Array | None:
    """Torques with the largest level, and least effort among them; rows (1, tau, level) >= 0."""
    from scipy.optimize import linprog

    # Effort, the largest torque over its limit, decides among equally good ones.
    most = FULL * limit
    table = np.pad(rows, ((0, 0), (0, 1)))
    efforts = np.zeros((4, 5))
    efforts[:, 1:3] = np.vstack([np.diag(1 / most), np.diag(-1 / most)])
    efforts[:, 4] = 1.0
    table = np.vstack([table, efforts])
    bounds = [*((-own, own) for own in most), (LEAST, ENOUGH), (0.0, 1.0)]
    answer = linprog([0, 0, -1, 1], A_ub=-table[:, 1:], b_ub=table[:, 0], bounds=bounds)
    return np.asarray(answer.x[:2]) if answer.status == 0 else None


def _list_balances(curve: Curve, both: Formation, rows: Rows) -> list[Array]:
    """Balances with friction, or scenes, that may be; none where forces are not the only ones."""
    if both.n_constraints != 5:
        return []
    try:
        found = [_balance(curve, both, part) for part in FRICTION]
        scenes = [own for own in rows.scenes if own != curve.formation.scene]
        return found + [_balance(curve, replace(both, scene=own), 1.0) for own in scenes]
    except np.linalg.LinAlgError:
        return []


def _balance(curve: Curve, both: Formation, part: float) -> Array:
    """Forces of five constraints at the end of a curve, at rest, of (1, tau), shape (5, 3).

    With a part of all friction.
    """
    scene, last = curve.formation.scene, curve.segments[-1]
    point = curve.evaluate(np.array([curve.length]))
    kinematics = both.evaluate(point.z, point.z_s)
    slides = np.sign(kinematics.A_t[0] @ point.z_s[0])
    Xi = np.append(last.Xi, slides[-1])[None]
    G = force_rows(both, kinematics, Directions(part * Xi, last.sigma[None]))[0]
    known = np.zeros((5, 3))
    known[:, 0] = -scene.applied_force
    known[3:, 0] += scene.dry[3:] * last.sigma
    known[3:, 1:] = -np.eye(2)
    return np.asarray(np.linalg.solve(G.T, known))


def _invert(torque: Array) -> Array:
    """Acceleration and squeeze at rest of (1, tau), shape (2, 3), from rows of torques, (2, 5)."""
    back = np.linalg.inv(torque[:, 3:])
    return np.column_stack([-back @ torque[:, 0], back])


def find_still(curve: Curve) -> Array:
    """Torques that hold the end of a curve at rest, in the middle of what friction bears, (2,)."""
    formation, point = curve.formation, curve.evaluate(np.array([curve.length]))
    still = Directions(np.zeros((1, formation.n_contacts)), np.zeros((1, 2)))
    forces = inverse(formation, *point[:3], still, point.kinematics)
    limits = make_limits(formation, 0.0).only(PRESS, TORQUE)
    sides = SideTerms.of(limits, forces, point.z_s[:, 3:])
    base, press = sides.rest[0].tolist(), sides.press[0].tolist()
    _, squeeze = choose_squeeze(base, [0.0] * len(base), press, 0.0)
    return np.asarray((forces.T0 + squeeze * forces.Tl)[0])
