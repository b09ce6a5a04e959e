"""What contact forces have to exceed for a formation to hold, friction cones included.

A sliding contact has to press with c_n >= epsilon. A rolling one must not slip either, |c_t| <= mu
c_n, which is kept as if the contact pressed with epsilon less: what c_n may lose before the contact
is lost it may lose before the contact slips.

    c_n >= epsilon,    mu c_n - c_t >= mu epsilon,    mu c_n + c_t >= mu epsilon.

On the contact forces c = [c_n; c_t(rolling)] these are the rows of H c >= least.
"""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from .formation import Formation


def hold_rows(formation: Formation) -> Array:
    """H, shape (n_c + 2 R, n_c + R): every c_n, then both sides of every rolling contact's cone."""
    unit = np.eye(formation.n_constraints)
    normal, tangential = unit[: formation.n_contacts], unit[formation.n_contacts :]
    rolling = list(formation.rolling_rows)
    edge = formation.friction[rolling, None] * normal[rolling]
    return np.vstack([normal, edge - tangential, edge + tangential])


def hold_least(formation: Formation, epsilon: float) -> Array:
    """The least that each row of H c may be, shape (n_c + 2 R,) [N]."""
    mu = formation.friction[list(formation.rolling_rows)]
    return epsilon * np.concatenate([np.ones(formation.n_contacts), mu, mu])


def name_holds(formation: Formation, epsilon: float) -> list[str]:
    """What each row of H c >= least asks for, in words."""
    names = [f"c_n of {name} >= epsilon = {epsilon:g} N" for name in formation.names]
    for side in ("c_t <= ", "-c_t <= "):
        for row in formation.rolling_rows:
            bound = f"{formation.friction[row]:g} (c_n - {epsilon:g} N)"
            names.append(f"friction cone of {formation.names[row]}, {side}{bound},")
    return names


def find_weakest(formation: Formation, held: Array) -> tuple[int, float, float | None]:
    """The contact that gives way first, by pulling or else by slipping.

    Parameters
    ----------
    held : ndarray, shape (n_c + 2 R,), [N]
        H c.

    Returns
    -------
    row : int
        The contact.
    c_n : float, [N]
    c_t : float or None, [N]
        If it slips.
    """
    count, rolls = formation.n_contacts, formation.n_rolling
    row = int(held[:count].argmin())
    if held[row] < 0 or not rolls:
        return row, float(held[row]), None
    k = int(held[count:].argmin()) % rolls
    row = formation.rolling_rows[k]
    return row, float(held[row]), float(held[count + rolls + k] - held[count + k]) / 2


def slip_margins(formation: Formation, c_n: Array, c_t: Array) -> Array:
    """Margin of each rolling contact to slipping, mu c_n - |c_t|, shape (..., R) [N].

    Parameters
    ----------
    c_n, c_t : ndarray, shape (..., n_c), [N]
        Of every contact.
    """
    rolling = list(formation.rolling_rows)
    return np.asarray(formation.friction[rolling] * c_n[..., rolling] - np.abs(c_t[..., rolling]))
