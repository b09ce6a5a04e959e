"""Force limits of a formation: normal forces and friction cones, as rows and margins."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from .formation import Formation


def force_limit_rows(formation: Formation) -> Array:
    """H, shape (n_c + 2 R, n_c + R): every c_n, then both sides of every rolling contact's cone."""
    unit = np.eye(formation.n_constraints)
    normal, tangential = unit[: formation.n_contacts], unit[formation.n_contacts :]
    rolling = list(formation.rolling_rows)
    edge = formation.friction[rolling, None] * normal[rolling]
    return np.vstack([normal, edge - tangential, edge + tangential])


def find_weakest(formation: Formation, held: Array) -> tuple[int, float, float | None]:
    """Row, c_n and c_t (if it slips) of the contact that gives way first; H c (n_c + 2 R,) [N]."""
    count, rolls = formation.n_contacts, formation.n_rolling
    row = int(held[:count].argmin())
    if held[row] < 0 or not rolls:
        return row, float(held[row]), None
    k = int(held[count:].argmin()) % rolls
    row = formation.rolling_rows[k]
    return row, float(held[row]), float(held[count + rolls + k] - held[count + k]) / 2


def slip_margins(formation: Formation, c_n: Array, c_t: Array) -> Array:
    """Slip margins mu c_n - |c_t| of rolling contacts, (..., R) [N], from c_n, c_t (..., n_c)."""
    rolling = list(formation.rolling_rows)
    return np.asarray(formation.friction[rolling] * c_n[..., rolling] - np.abs(c_t[..., rolling]))
