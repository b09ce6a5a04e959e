"""Bounds of a plan's first node with which static friction cannot hold the start.

At rest the torques are affine in s'' and internal force, tau = T0 + Ta s'' + Tl lambda. Those that
friction can hold are a polygon (`mechanics.statics`). A plan that starts inside it is planned again
with its first node beyond one of the sides: at the nearest place that keeps every limit, or beyond.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...mechanics.dynamics import LAMBDA, ONE, A
from ...mechanics.limits import PRESS
from ...mechanics.statics import SURE
from ..robust.robust_rows import RobustHold, list_holds, measure_holds
from .elements import Profile
from .path_data import PhaseData

BEYOND = 10.0  # distance of the first node beyond the side, over the least sure one
WORTH = 0.02  # largest relative cost of such a start
_SHARES = (0.0, 0.002, 0.005, 0.01, WORTH)  # shares of a margin given up for it, in this order
_KEPT = 1e-9  # violation of a limit that is rounding, over its scale


class SureStart(NamedTuple):
    """Bounds of the first node: s'' from `least_a` up, internal force from `low` to `high`."""

    least_a: float
    low: float
    high: float


def find_sure_start(
    data: PhaseData, profile: Profile, margin: float, ranges: Mapping[str, float]
) -> SureStart | None:
    """Bounds with which a motion leaves rest; None if it does anyway, or if nothing helps.

    Parameters
    ----------
    margin : [N]  of normal forces over epsilon
    ranges        of parameters, within all of which it has to leave rest
    """
    formation, forces = data.curve.formation, data.nodes.forces
    holds = list_holds(formation, data.curve.start, ranges)
    here = np.array([profile.a[0], profile.lam[0]])
    T0, T = forces.of_tau[0, :, ONE], forces.of_tau[0][:, [A, LAMBDA]]
    unit = formation.scene.scales.torque
    if measure_holds(holds, T0 + T @ here) > SURE * unit:
        return None
    presses = np.isin(data.limits.sides[0], data.limits.of(PRESS))
    rows = data.find_limits(data.nodes.pick(slice(0, 1))).rows[0] * data.spans[:, None]
    slopes = rows[:, [A, LAMBDA]]
    scales = formation.scene.scales
    units = np.array([scales.acceleration, scales.force])
    for share in _SHARES if margin > 0 else _SHARES[:1]:
        offsets = rows[:, ONE] - (1 - share) * margin * presses
        best, start = np.inf, None
        for side, bound in _list_sides(holds, BEYOND * SURE * unit):
            normal = side @ T
            if normal[0] <= 0:
                continue
            level = float(bound - side @ T0)
            for place in _list_places(normal, level, slopes, offsets, here, units):
                kept = ((offsets + slopes @ place) / data.spans).min() >= -_KEPT and place[0] > 0
                kept = kept and measure_holds(holds, T0 + T @ place) > SURE * unit
                away = float(np.abs(T @ (place - here)).max())
                if kept and away < best:
                    ends = (place[1], np.inf) if normal[1] > 0 else (-np.inf, place[1])
                    best, start = away, SureStart(float(place[0]), *map(float, ends))
        if start is not None:
            return start
    return None


def _list_sides(holds: Sequence[RobustHold], beyond: float) -> Iterator[tuple[Array, float]]:
    """Sides of the torques that can be held, each with its bound and a distance beyond [N m]."""
    for static, gains in holds:
        for normal, bound in zip(static.normals, static.bounds, strict=True):
            yield normal * gains, float(bound) + beyond


def _list_places(
    normal: Array, bound: float, slopes: Array, offsets: Array, here: Array, units: Array
) -> list[Array]:
    """Places on the line normal @ x = bound: nearest to `here`, and where limits cross it."""
    along = np.array([-normal[1], normal[0]])
    foot = here + units**2 * normal * (bound - normal @ here) / (units**2 @ normal**2)
    rates, rest = slopes @ along, offsets + slopes @ foot
    crossings = -rest[rates != 0] / rates[rates != 0]
    return [foot, *(foot + share * along for share in crossings)]
