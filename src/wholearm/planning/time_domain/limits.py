"""Rows of the time-domain NLP that limits make: least normal forces, friction cones, torques."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .assembly import Indices
from .collocation import Scheme
from .layout import MARGIN, StageLayout
from .rows import Rows
from .stage import Stage


class LimitRelaxation(NamedTuple):
    """Which limits give way by a common amount, and how much of it each.

    Attributes
    ----------
    c_n : float, [N]
        Of the least normal force; negative if that is raised.
    tau : tuple of float, [N m]
        Of the two torque limits.
    """

    c_n: float
    tau: tuple[float, float] = (0.0, 0.0)


class LimitRows(NamedTuple):
    """Rows of one stage that must not be less than their bounds.

    Attributes
    ----------
    presses : ndarray of int, shape (K, m, n_c)
        c_n, at the start of each interval, where torques may step, and wherever a bound of the
        unknown itself does not do.
    cones : ndarray of int, shape (K, d, 2 R)
        mu c_n less c_t, then plus c_t, of rolling contacts.
    """

    presses: Indices
    cones: Indices


def add_limits(
    rows: Rows,
    stage: Stage,
    layout: StageLayout,
    scheme: Scheme,
    relaxation: LimitRelaxation | None,
) -> LimitRows:
    """Add rows for the limits of a stage.

    Parameters
    ----------
    relaxation : LimitRelaxation, optional
        What gives way by the unknown that every node has a copy of.
    """
    formation = stage.formation
    c_n = layout.forces[:, :, : formation.n_contacts]
    K, n_c = len(c_n), formation.n_contacts
    soft = layout.short.size > 0
    places = np.zeros(1) if scheme.ends else np.array([0.0, 1.0])
    if soft or (relaxation is not None and relaxation.c_n):
        places = np.append(places, scheme.points)
    presses = rows.linear(K, len(places), n_c, high=np.inf)
    for i, row in enumerate(scheme.interpolate(places)):
        for j in np.flatnonzero(np.abs(row) > 1e-12):
            rows.add_entries(presses[:, i], c_n[:, j], row[j])
    cones = _add_cones(rows, stage, layout)
    if soft:
        short_c, short_tau, short_cone = np.split(layout.short, [n_c, n_c + 2], axis=1)
        rows.add_entries(presses, short_c[:, None], 1.0)
        rows.add_entries(cones, np.tile(short_cone, 2)[:, None], 1.0)
        _soften_torques(rows, stage, layout, short_tau, (1.0, 1.0))
    elif relaxation is not None:
        extra = layout.nodes[:-1, MARGIN]
        if relaxation.c_n:
            rows.add_entries(presses, extra[:, None, None], relaxation.c_n)
        if any(relaxation.tau):
            _soften_torques(rows, stage, layout, np.column_stack([extra, extra]), relaxation.tau)
    return LimitRows(presses, cones)


def _add_cones(rows: Rows, stage: Stage, layout: StageLayout) -> Indices:
    formation, (K, d) = stage.formation, layout.z.shape[:2]
    rolling, R = list(formation.rolling_rows), formation.n_rolling
    cones = rows.linear(K, d, 2 * R, high=np.inf)
    if R:
        c_n, c_t = layout.forces[..., rolling], layout.forces[..., formation.n_contacts :]
        rows.add_entries(
            cones, np.concatenate([c_n, c_n], axis=2), np.tile(formation.friction[rolling], 2)
        )
        rows.add_entries(cones, np.concatenate([c_t, c_t], axis=2), np.repeat([-1.0, 1.0], R))
    return cones


def _soften_torques(
    rows: Rows, stage: Stage, layout: StageLayout, short: Indices, weights: tuple[float, float]
) -> None:
    """Torque limits that `short`, shape (K, 2), is added to; bounds of tau do for the others."""
    tau = layout.tau.reshape(-1, 2, 2)
    for joint in np.flatnonzero(weights):
        limit = stage.formation.scene.torque_limit[joint]
        for sign in (1.0, -1.0):
            own = rows.linear(len(tau), 2, low=-limit, high=np.inf)
            rows.add_entries(own, tau[..., joint], sign)
            rows.add_entries(own, short[:, joint, None], weights[joint])
