"""Waiting at rest until the torques set something in motion."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from .state import STILL, Run
from .watch import ROUNDING


def hold(run: Run) -> None:
    """Let time pass at rest until forces leave their bounds, or the torques end."""
    run.record(None)
    while True:
        start, stop = run.torque.breaks[run.piece : run.piece + 2]
        x = float(2 * run.t - start - stop) / float(stop - start)
        breach = _find_breach(_list_margins(run), x)
        run.t = float(start + stop + breach * (stop - start)) / 2 if breach < 1 else float(stop)
        run.record(None)
        if breach < 1 or not run.next_piece():
            return


def _list_margins(run: Run) -> Array:
    """What has to be positive at rest, as polynomials on the present piece, shape (m, d + 1).

    Ascending powers of x in [-1, 1]; forces and accelerations in units of the scene.
    """
    system, modes = run.system, run.modes
    scales, n = system.scales, system.n
    rows = system.evaluate(run.z, run.v, modes.kept)
    mu, stuck = system.friction[list(modes.kept)], [modes.kept.index(k) for k in modes.stuck]
    held = np.eye(n)[list(modes.held)].reshape(-1, n)
    P = np.vstack([rows.A, rows.A_t[stuck], held])
    G = np.vstack([rows.A - (mu * np.array(modes.Xi))[:, None] * rows.A_t, rows.A_t[stuck], held])
    degree = run.torque.coefficients.shape[2]
    drive = np.zeros((n, degree))
    drive[:, 0] = system.applied - system.dry * np.array(modes.sigma)
    drive[list(system.driven)] += run.torque.coefficients[run.piece][: len(system.driven)]
    lift = 1 / system.mass
    c = -np.linalg.solve((P * lift) @ G.T, (P * lift) @ drive) if len(P) else np.zeros((0, degree))
    acceleration = lift[:, None] * (drive + G.T @ c)
    k = len(modes.kept)
    bound = np.zeros((len(P) - k, degree))
    bound[: len(stuck)] = mu[stuck, None] * c[stuck]
    bound[len(stuck) :, 0] = system.dry[list(modes.held)]
    unit = np.full(len(P), scales.force)
    unit[k + len(stuck) :] = system.friction_units[list(modes.held)]
    margins = np.vstack([c[:k], bound - c[k:], bound + c[k:]])
    margins /= np.concatenate([unit, unit[k:]])[:, None]
    margins[:, 0] += ROUNDING
    rates = acceleration / (system.units[n:] / scales.time)[:, None]
    creeps = np.vstack([-rates, rates])
    creeps[:, 0] += 10 * STILL
    return np.vstack([margins, creeps])


def _find_breach(margins: Array, x: float) -> float:
    """Where from `x` on the first polynomial turns negative; at least 1 if none does before."""
    if margins.shape[1] == 1:
        return x if (margins < 0).any() else 2.0
    first = 2.0
    for row in margins:
        if row @ x ** np.arange(len(row)) < 0:
            return x
        bent = np.trim_zeros(row, "b")
        if len(bent) < 2:
            continue
        roots = np.roots(bent[::-1])
        real = roots.real[np.abs(roots.imag) < 1e-9]
        for root in np.sort(real[(real > x) & (real < min(first, 1.0))]):
            slope = sum(k * c * root ** (k - 1) for k, c in enumerate(row) if k)
            if slope < 0:
                first = float(root)
                break
    return first
