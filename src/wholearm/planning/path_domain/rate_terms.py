"""Rows of the planning NLP for torque rate limits and actuator lag.

With the local variable y of an element (`elements`), d tau / dt = (d tau / dy) (dy / dt). At the
nodes d tau / dy is that of the polynomial through the torques there. Torques are continuous where
two elements meet; there, and where a direction reverses, s'' and the internal force may step.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np
from numpy.polynomial import chebyshev

from ...common.arrays import Array, Expression
from ...scene.model import Scene
from .elements import (
    DEGREE,
    FROM_HOLD,
    FROM_REST,
    INSIDE,
    SIGNS,
    TO_HOLD,
    TO_REST,
    Elements,
    Profile,
    find_basis,
)
from .path_data import PhaseData
from .path_mesh import share_out
from .path_motion import PLACES, PathMotion

if TYPE_CHECKING:
    from ..columns import Symbols


_LOOKS = 21  # samples of the rates in each interval
_NODES = DEGREE + 1


class MotorShape(NamedTuple):
    """Joints with a torque rate limit, and those whose torques lag behind a command."""

    rates: tuple[int, ...] = ()
    commands: tuple[int, ...] = ()

    @staticmethod
    def of(scene: Scene) -> MotorShape:
        """The shape of a scene's motors."""
        if not scene.has_slow_motors:
            return UNLIMITED
        limited, lags = np.isfinite(scene.torque_rate_limit), scene.actuator_lag > 0
        return MotorShape(*(tuple(np.flatnonzero(mask).tolist()) for mask in (limited, lags)))

    @property
    def slow(self) -> tuple[int, ...]:
        """Joints whose torques may not step."""
        return tuple(sorted({*self.rates, *self.commands}))

    def list_sizes(self, intervals: int) -> dict[str, int]:
        """Numbers of rows of each kind."""
        n, joints = intervals + 1, len(self.slow)
        return {
            "rates": n * len(self.rates),
            "commands": n * len(self.commands),
            "joins": (n // _NODES - 1) * joints,
            "begins": 2 * bool(joints),
        }


UNLIMITED = MotorShape()  # motors whose torques may step


def list_kinds(count: int, held: bool) -> list[int]:
    """Kinds of `count` elements from rest to rest."""
    start, stop = (FROM_HOLD, TO_HOLD) if held else (FROM_REST, TO_REST)
    return [start, *[INSIDE] * (count - 2), stop]


def find_first_slopes(a: Expression) -> tuple[Expression, Expression]:
    """Slopes of s'' over y at the start, and at the end backwards."""
    basis = find_basis()
    start = ca.DM(basis.to_powers[FROM_HOLD][1]).T @ a[:_NODES]
    return start, ca.DM(basis.to_powers[TO_HOLD][1]).T @ a[-_NODES:]


def write_motor_rows(
    shape: MotorShape,
    symbols: Symbols,
    torques: Expression,
    a: Expression,
    paces: Expression,
    lengths: Expression,
) -> dict[str, Expression]:
    """Rows of each kind of `MotorShape.list_sizes`.

    Parameters
    ----------
    symbols                              parameters `quick`, 1 / rate limit, and `lags`
    torques, a : (n, 2), (n,)
    paces, lengths : (p + 1, E), (1, E)  dy/dt times the element's length, and that
    """
    if not shape.slow:
        return dict.fromkeys(shape.list_sizes(0), ca.SX(0, 1))
    rates = {joint: _differentiate(torques[:, joint], paces, lengths) for joint in shape.slow}
    rows = [symbols.quick[k] * rates[joint] for k, joint in enumerate(shape.rates)]
    lagged = [
        torques[:, joint] + symbols.lags[k] * rates[joint] for k, joint in enumerate(shape.commands)
    ]
    joins = [torques[_NODES::_NODES, j] - torques[DEGREE:-1:_NODES, j] for j in shape.slow]
    return {
        "rates": ca.vertcat(ca.SX(0, 1), *rows),
        "commands": ca.vertcat(ca.SX(0, 1), *lagged),
        "joins": ca.vertcat(*joins),
        "begins": ca.vertcat(*find_first_slopes(a)),
    }


def _differentiate(values: Expression, paces: Expression, lengths: Expression) -> Expression:
    """Time derivative at the nodes of what has these values there, shape (n,)."""
    table, count = ca.reshape(values, _NODES, -1), lengths.numel()
    slopes = [ca.DM(slope) for slope in list_slopes()]
    columns = [slopes[kind] @ table[:, e] for e, kind in enumerate(list_kinds(count, True))]
    return ca.vec(ca.horzcat(*columns) * paces / ca.repmat(lengths, _NODES, 1))


def list_slopes() -> list[Array]:
    """Differentiation matrices at the nodes of each kind of element, over y in forward time."""
    basis, powers = find_basis(), np.arange(_NODES)
    return [
        sign * (powers * y[:, None] ** np.maximum(powers - 1, 0)) @ to_powers
        for sign, y, to_powers in zip(SIGNS, basis.y, basis.to_powers, strict=True)
    ]


def find_torques(
    data: PhaseData, profile: Profile, motions: Sequence[PathMotion]
) -> tuple[Array, Array]:
    """Torques and their rates, (n_solid, _LOOKS, 2) [N m, N m/s], at evenly spaced times.

    By Chebyshev interpolation in time through torques within each interval.
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
    """Relative violations of rates and commands of each joint in each interval, (n_solid, 2, 2)."""
    if not data.grid.held:
        return np.zeros((len(data.nonempty), 2, 2))
    torques, rates = find_torques(data, profile, motions)
    rate = np.abs(rates).max(axis=1) / data.rate_limit
    lags = data.curve.formation.scene.actuator_lag
    command = np.abs(torques + lags * rates).max(axis=1) / data.torque_limit
    return np.asarray(np.maximum(np.stack([rate, command * (lags > 0)], axis=1) - 1, 0.0))


def exceeds_rates(data: PhaseData, profile: Profile) -> bool:
    """Whether torque rates or commands are beyond their limits at the nodes of a motion."""
    grid, lags = data.grid, data.curve.formation.scene.actuator_lag
    if not grid.held:
        return False
    speed = np.sqrt(profile.b).reshape(-1, _NODES)
    y_t = speed / np.maximum(Elements(grid, profile).stretch, 1e-6) / np.diff(grid.edges)
    tau = data.nodes.forces.tau(*profile).reshape(-1, _NODES, 2)
    rates = np.stack(list_slopes())[grid.kinds] @ tau * y_t[..., None]
    command = np.abs(tau + lags * rates) * (lags > 0)
    return bool((np.abs(rates) > data.rate_limit).any() or (command > data.torque_limit).any())


def equidistribute(part: PhaseData, motion: PathMotion, elements: int) -> Array:
    """Breaks between elements that share changes of torque rates evenly [m] (de Boor).

    Half of the density over time is even, half the root of the variation of the rates.
    """
    rates = find_torques(part, motion.profile, [motion])[1]
    most = np.maximum(np.abs(rates).max(axis=(0, 1)), part.torque_limit / motion.duration)
    changes = np.abs(np.diff((rates / most).reshape(-1, 2), axis=0, prepend=0.0)).sum(axis=1)
    variation = changes.reshape(len(part.grid.edges), -1).sum(axis=1)
    ends = motion.times.reshape(-1, _NODES)
    spans = ends[:, -1] - ends[:, 0]
    density = np.sqrt(variation * spans)
    shares = density / density.sum() + spans / motion.duration
    done, t = np.append(0.0, np.cumsum(shares)), np.append(ends[:, 0], ends[-1, -1])
    stops = part.grid.edges[:, 1]
    fixed = np.array([0.0, *(done[1:][stops == own.stop][0] for own in part.curve.segments)])
    inner = [
        np.linspace(*pair, count + 1)[1:-1]
        for pair, count in zip(pairwise(fixed), share_out(elements, np.diff(fixed)), strict=True)
    ]
    return motion.locate(np.interp(np.concatenate(inner), done, t))[0]
