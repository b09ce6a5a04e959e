"""Piecewise polynomial torque in time of a motion along a curve."""

from __future__ import annotations

import numpy as np

from ...common.arrays import Array
from ...common.errors import SolverError
from ...results.torque import TorqueProfile
from .path_data import PhaseData, Places
from .path_motion import PathMotion

TORQUE_ERROR = 5e-7  # largest error of the polynomials between knots, over the torque limit
PLACES = 13  # interpolation points where that is exceeded


class StalledError(SolverError):
    """The motion nearly stops, or takes no time, between two nodes: the grid is too coarse."""


def fit_torque(data: PhaseData, motion: PathMotion) -> tuple[TorqueProfile, float]:
    """Torque of a motion, one polynomial in time per interval, and its effort [(N m)^2 s].

    Through the knots, or through `PLACES` points if that misses the torque between them.
    """
    knots, checks = data.sampling
    torque = _fit(data, motion, data.knots, knots)
    times = motion.times[data.nonempty, None] + motion.durations(checks)
    wanted = data.checks.forces.tau(*data.interpolate(motion.profile, checks))
    inner = np.tile((checks > 0) & (checks < 1), len(data.nonempty))
    misfit = torque.at(times.ravel()[inner]) - wanted[inner]
    if np.abs(misfit / data.torque_limit).max() > TORQUE_ERROR:
        every = (len(checks) - 1) // (PLACES - 1)
        rows = np.tile(np.arange(len(checks)) % every == 0, len(data.nonempty))
        torque = _fit(data, motion, data.checks.pick(rows), checks[::every])
    return torque, torque.integrate_squares()


def _fit(data: PhaseData, motion: PathMotion, places: Places, fractions: Array) -> TorqueProfile:
    """Polynomials through the torques at `fractions` of every solid interval."""
    k = data.nonempty
    values = places.forces.tau(*data.interpolate(motion.profile, fractions))
    spans = motion.durations(fractions)
    if motion.stalls or not (np.diff(spans, axis=1) > 0).all():
        raise StalledError("the motion all but stops between two nodes; plan with more intervals")
    x = 2 * spans / spans[:, -1:] - 1
    vandermonde = x[..., None] ** np.arange(len(fractions))
    coefficients = np.linalg.solve(vandermonde, values.reshape(len(k), len(fractions), 2))
    breaks = np.append(motion.times[k], motion.times[-1])
    return TorqueProfile(breaks, np.asarray(coefficients.transpose(0, 2, 1), dtype=float))
