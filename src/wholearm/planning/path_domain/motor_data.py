"""Rates of torques along a motion, and what motors miss of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import chebyshev

from ...common.arrays import Array
from .data import PhaseData
from .elements import DEGREE, POWERS, Elements, Profile
from .fitting import PLACES
from .motion import PathMotion
from .motor_terms import list_slopes

_LOOKS = 21
"""Instants of each interval at which rates are looked at."""
_SLOWEST = 400.0
"""Rate, over the torque limit in the time of the motion, from which on slower ones come first."""
_QUICKER = 6.0
"""Ratio of one of them to the one before."""


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
    if not scene.has_slow_motors:
        return np.zeros((len(data.nonempty), 2, 2))
    torques, rates = find_torques(data, profile, motions)
    rate = np.abs(rates).max(axis=1) / data.rate_limit
    lags = scene.actuator_lag
    command = np.abs(torques + lags * rates).max(axis=1) / data.torque_limit
    return np.asarray(np.maximum(np.stack([rate, command * (lags > 0)], axis=1) - 1, 0.0))


def exceeds_rates(data: PhaseData, profile: Profile) -> bool:
    """Whether torques change too fast, or commands are too large, at the nodes of a motion."""
    scene = data.curve.formation.scene
    if not scene.has_slow_motors:
        return False
    grid, nodes = data.grid, DEGREE + 1
    kinds, y = grid.kinds, Elements(grid, profile).local
    power, length = POWERS[kinds][:, None], np.diff(grid.edges)
    speed = np.sqrt(profile.b).reshape(-1, nodes)
    inside = np.maximum(y.reshape(-1, nodes), 1e-3) ** (power - 1)
    pace = speed / inside / power / length
    tau = data.nodes.forces.tau(*profile).reshape(-1, nodes, 2)
    rates = np.stack(list_slopes())[kinds] @ tau * pace[..., None]
    command = np.abs(tau + scene.actuator_lag * rates)
    quick = (np.abs(rates) > data.rate_limit).any()
    return bool(quick or (command * (scene.actuator_lag > 0) > data.torque_limit).any())


def list_quicknesses(data: PhaseData, lasts: float) -> list[float]:
    """Parts of the largest rates to plan with, one after the other, for a motion that lasts so [s].

    Where a torque takes its step in next to no time, that is found on the way from slower ones.
    """
    rates = data.rate_limit / data.torque_limit * lasts
    least = float(np.min(rates, initial=np.inf))
    steps = np.log(least / _SLOWEST) / np.log(_QUICKER) if np.isfinite(least) else 0.0
    count = max(0, int(np.ceil(steps)))
    return [_QUICKER**-k for k in reversed(range(count + 1))]
