"""Rates of torques along a motion, and what motors miss of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import chebyshev

from ...common.arrays import Array
from .data import PhaseData
from .elements import DEGREE, Elements, Profile
from .fitting import PLACES
from .motion import PathMotion
from .motor_terms import list_slopes

_LOOKS = 21
"""Instants of each interval at which rates are looked at."""


def find_torques(
    data: PhaseData, profile: Profile, motions: Sequence[PathMotion]
) -> tuple[Array, Array]:
    """Torques and their rates, shape (n_solid, looks, 2) [N m, N m/s], at evenly spaced instants.

    Of the polynomials in time through torques within each interval.
    """
    checks = data.sampling.checks
    every = (len(checks) - 1) // (PLACES - 1)
    picked = np.arange(len(checks)) % every == 0
    fractions, count = checks[picked], len(data.nonempty)
    places = data.checks.pick(np.tile(picked, count))
    values = places.forces.tau(*data.interpolate(profile, fractions)).reshape(count, -1, 2)
    spans = np.concatenate([motion.durations(fractions) for motion in motions])
    degree, lasts = len(fractions) - 1, np.maximum(spans[:, -1], np.finfo(float).tiny)
    through = chebyshev.chebvander(2 * spans / lasts[:, None] - 1, degree)
    # Where two places fall on one instant no polynomial goes through both.
    modes = np.linalg.solve(through + 1e-300, values)
    looks = np.linspace(-1, 1, _LOOKS)
    slopes = chebyshev.chebder(np.eye(degree + 1), axis=0)
    torques = chebyshev.chebvander(looks, degree) @ modes
    rates = chebyshev.chebvander(looks, degree - 1) @ slopes @ modes
    return np.asarray(torques), np.asarray(rates * (2 / lasts)[:, None, None])


def find_hurry(data: PhaseData, profile: Profile, motions: Sequence[PathMotion]) -> Array:
    """By how much rates and commands are beyond their limits in each interval, relatively.

    Shape (n_solid, 2, 2): of rates, then of commands, of each joint.
    """
    scene = data.curve.formation.scene
    if not data.grid.held:
        return np.zeros((len(data.nonempty), 2, 2))
    torques, rates = find_torques(data, profile, motions)
    rate = np.abs(rates).max(axis=1) / data.rate_limit
    lags = scene.actuator_lag
    command = np.abs(torques + lags * rates).max(axis=1) / data.torque_limit
    return np.asarray(np.maximum(np.stack([rate, command * (lags > 0)], axis=1) - 1, 0.0))


def exceeds_rates(data: PhaseData, profile: Profile) -> bool:
    """Whether torques change too fast, or commands are too large, at the nodes of a motion."""
    scene = data.curve.formation.scene
    if not data.grid.held:
        return False
    grid, nodes = data.grid, DEGREE + 1
    kinds, stretch = grid.kinds, Elements(grid, profile).stretch
    speed = np.sqrt(profile.b).reshape(-1, nodes)
    pace = speed / np.maximum(stretch, 1e-6) / np.diff(grid.edges)
    tau = data.nodes.forces.tau(*profile).reshape(-1, nodes, 2)
    rates = np.stack(list_slopes())[kinds] @ tau * pace[..., None]
    command = np.abs(tau + scene.actuator_lag * rates)
    quick = (np.abs(rates) > data.rate_limit).any()
    return bool(quick or (command * (scene.actuator_lag > 0) > data.torque_limit).any())
