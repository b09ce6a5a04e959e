"""Forces at an instant of a replay, as affine functions of the torques at that instant.

With the state and the directions of friction given, M5 z'' = g + S tau + G^T c - b and
P z'' + P' z' = 0 make z'' and c affine in tau.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.formation import Formation
from ..mechanics.limits import LimitSet
from ..simulation.choosing import evaluate_rows, measure_rates
from ..simulation.modes import find_grips, list_units, respond, share_mode

SLOW = 1e-6
"""Speed below which the direction of friction is looked for, relative to the scene's speed."""


class Instant(NamedTuple):
    """Forces and accelerations at one state; each is rows @ (1, tau_1, tau_2).

    Attributes
    ----------
    formation : Formation
    z, v : ndarray, shape (5,)
    acceleration : ndarray, shape (5, 3)
    c_n, c_t : ndarray, shape (n_c, 3), [N]
        NaN for c_t of a flush edge that friction holds although it may slide: it is not determined.
    """

    formation: Formation
    z: Array
    v: Array
    acceleration: Array
    c_n: Array
    c_t: Array

    def find_sides(self, limits: LimitSet) -> Array:
        """Slack of one-sided limits, rows @ (1, tau_1, tau_2), shape (n_sides, 3)."""
        c = np.vstack([self.c_n, self.c_t[list(self.formation.rolling_rows)]])
        of_c, of_tau, of_rates = limits.columns
        values = of_c @ c
        values[:, 1:] += of_tau
        values[:, 0] += of_rates @ self.v[3:]
        rows, signs, bounds = limits.sides
        sides = np.asarray(signs[:, None] * values[rows])
        sides[:, 0] -= signs * bounds
        return sides


def find_moving(
    formation: Formation, z: Array, v: Array, tau: Array, acceleration: Array
) -> Instant | None:
    """The instant of a motion; where something stands still, with the friction that it had.

    That is the friction with which torques `tau` give the recorded `acceleration`, shape (5,).
    """
    scene, rows = formation.scene, evaluate_rows(formation, z, v)
    speeds = np.concatenate([rows.A_t @ v, v[3:]])
    slow = np.abs(speeds) < SLOW * measure_rates(scene, formation.n_contacts)
    signs = np.sign(speeds)
    signs[list(formation.rolling_rows)] = 0.0
    still = [unit for unit in list_units(formation) if slow[list(unit.rows)].all()]
    holds = formation.n_constraints < 4
    options = [(1.0, -1.0, 0.0) if holds and unit.grips else (1.0, -1.0) for unit in still]
    found: list[tuple[float, Instant]] = []
    for choice in product(*options):
        for unit, sign in zip(still, choice, strict=True):
            signs[list(unit.rows)] = sign
        instant = answer(formation, z, v, signs)
        if instant is not None:
            misfit = instant.acceleration @ [1.0, *tau] - acceleration
            found.append((float(scene.mass_diagonal @ misfit**2), instant))
    return min(found, key=lambda pair: pair[0])[1] if found else None


def answer(formation: Formation, z: Array, v: Array, signs: Array) -> Instant | None:
    """The instant at a state with the friction of `signs`, shape (n_c + 2,).

    Signs are zero for what rolls or friction holds. None if forces are not determined.
    """
    mode = share_mode(formation, find_grips(formation, signs))
    response = respond(mode, signs, evaluate_rows(formation, z, v), v)
    if response is None:
        return None
    count, held = formation.n_contacts, len(mode.holders)
    c_n, cones = response.force_limits[:count], response.force_limits[count:]
    c_t = -(mode.rolled.sliding_friction * signs[:count])[:, None] * c_n
    for k, rows in enumerate(mode.holders):
        if rows[0] < count:
            # The sides of a cone are mu c_n - c_t and mu c_n + c_t.
            c_t[list(rows)] = (cones[held + k] - cones[k]) / 2 if len(rows) == 1 else np.nan
    return Instant(formation, z, v, response.acceleration, c_n, c_t)
