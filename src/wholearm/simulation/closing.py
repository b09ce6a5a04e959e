"""The nearest configuration in which every contact of a formation is closed."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..common.errors import SimulationError
from ..contacts.formation import Formation

_CLOSED = 3e-15
"""Gap that counts as rounding, relative to the scene's length."""


def close_contacts(
    formation: Formation, z: Array, within: float = np.inf, slip: Array | None = None
) -> Array:
    """Nearest configuration, in the metric M5, with every contact of the formation closed.

    Parameters
    ----------
    z : ndarray, shape (5,)
    within : float, [m]
        Largest gap to close.
    slip : ndarray, shape (R,), optional, [m]
        Slip coordinates to give to rolling contacts; without them these start to roll where they
        are.

    Raises
    ------
    SimulationError
        If a gap is larger, or the contacts cannot be closed from `z`.
    """
    inverse_mass = 1 / formation.scene.mass_diagonal
    closed = _CLOSED * formation.scene.scales.length
    for _ in range(8):
        kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        gaps, rows = kinematics.C[0], kinematics.A[0]
        worst = int(np.abs(gaps).argmax())
        if np.abs(gaps[worst]) > within:
            raise SimulationError(
                f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m, does not touch"
            )
        slid = np.zeros(0) if slip is None else formation.evaluate_slip(z[None])[0] - slip
        if np.abs(gaps[worst]) < closed and (np.abs(slid) < closed).all():
            break
        rows = rows if slip is None else kinematics.P[0]
        lift = inverse_mass[:, None] * rows.T
        try:
            z = z - lift @ np.linalg.solve(rows @ lift, np.concatenate([gaps, slid]))
        except np.linalg.LinAlgError:
            raise SimulationError(f"{' '.join(formation.names)} depend on one another") from None
    if not np.abs(gaps[worst]) < formation.scene.touching * 1e-3:
        raise SimulationError(
            f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m, cannot be closed"
        )
    return z
