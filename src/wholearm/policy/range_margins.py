"""Reference of a curve's law and its limits within known parameter ranges.

Limits hold in the worst corner of the ranges (`corners`), both under nominal torques and with
feedback that tracks the reference. Fixed-point iteration between worst corners and motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..geometry.curve import Curve
from ..mechanics.dynamics import Directions, inverse
from ..mechanics.limits import CONE, PRESS, make_limits
from ..scene.model import Scene
from .curve_rows import (
    LATE,
    LEAST,
    NEAR,
    NEVER,
    SPARE,
    Corners,
    CurveLimitRows,
    Motion,
    blend_directions,
    find_corners,
    find_internal_force,
    list_scenes,
)
from .retiming import Reach, retime

ROUNDS = 3  # iterations between worst corners and motion
KEPT = 1.3  # margin of the reference's forces, in units: feedback may use what is above one
ENOUGH = 0.5  # least share of these margins; with less the ranges are too wide
LESS = 0.8  # factor by which ranges shrink while they are too wide
CLOSE, NONE = 0.03, 0.02  # relative accuracy of the widest ranges, and the least share of them
WIDEST = 0.9  # largest relative range
WIDER = 1.01  # least width of a reversal, over the distance to the next node
STEP = 1e-4  # step of differences along a curve, over its length
AUTHORITY = 2.0  # margin of torques for feedback, in those of `curve_rows`


class Within(NamedTuple):
    """Limits along a curve within ranges, at n places."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    left: Array  # (n, 4, 5) [N m]: distances of torques from their limits
    sides: tuple[Corners, Corners]  # with friction before and after the nearest reversal
    same: Array  # (n,): where these are equal
    unit: Array  # (m + 4,): margins at level 1, of forces and torques
    scenes: tuple[Scene, ...]  # in the corners of the ranges

    def at(self, motion: Motion) -> tuple[CurveLimitRows, Array, Array]:
        """The law's limits near a motion; those of the reference, and their margins."""
        motions = self._spread(motion)
        forces = self._pick(self.sides, motions)
        closed = self._pick([side.close(self.left) for side in self.sides], motions)
        count, n = len(self.unit) - 4, len(self.s)
        slack = np.concatenate([forces, self.left], axis=1)
        copies = forces.shape[1] // count
        unit = np.concatenate([np.tile(self.unit[:count], copies), self.unit[count:]])
        table, ends = np.tile(unit, (n, 1)), self.sides[0].rows[:, -1]
        rows = CurveLimitRows(self.s, self.torque, slack, table, forces.shape[1], ends, self.scenes)
        kept = np.concatenate([KEPT * self.unit[:count], AUTHORITY * self.unit[count:]])
        again = np.tile(kept, 2 * len(motions))
        wanted = np.concatenate([np.tile(kept[:count], copies), kept[count:], again])
        whole = np.concatenate([slack, closed], axis=1)
        return rows, whole, np.tile(wanted, (n, 1))

    def _pick(self, sides: tuple[Corners, ...] | list[Corners], motions: list[Motion]) -> Array:
        """Limits on both sides of reversals in the worst corners of motions, (n, rows, 5)."""
        found = [
            np.concatenate([side.pick(motion) for motion in motions], axis=1) for side in sides
        ]
        found[1][self.same] = np.array([NEVER, 0.0, 0.0, 0.0, 0.0])
        return np.concatenate(found, axis=1)

    def _spread(self, motion: Motion) -> list[Motion]:
        """A motion with its internal force, and with the least and largest one within torques."""
        a, b, internal = motion
        values = np.column_stack([np.ones_like(a), b, np.sqrt(b), a])
        base, press = np.einsum("nmq,nq->nm", self.left[..., :4], values), self.left[..., 4]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = -base / press
        low = np.where(press > 0, ends, -np.inf).max(axis=1)
        high = np.where(press < 0, ends, np.inf).min(axis=1)
        low, high = (np.where(np.isfinite(end), end, internal) for end in (low, high))
        return [motion, (a, b, np.minimum(low, internal)), (a, b, np.maximum(high, internal))]


def find_within(
    curve: Curve, s: Array, speed: Array, widths: Mapping[str, float], least: float
) -> Within:
    """Limits along a curve within ranges, with forces of at least so much [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    # Limits are interpolated: nodes next to a reversal need both directions.
    gaps = np.pad(np.diff(s), 1)
    width = np.maximum(speed * NEAR, WIDER * np.maximum(gaps[1:], gaps[:-1]))
    mean, *sides = blend_directions(curve, s, width)
    late = s - (LATE + widths.get("delay", 0.0)) * speed
    nominal, step = _find_torques(curve, s, mean), STEP * curve.length
    before, after = (_find_torques(curve, s + sign * step, mean) for sign in (-1, 1))
    change = (after - before) / (2 * step)
    torques = nominal, _find_torques(curve, late, mean), change
    corners = [find_corners(formation, point, side, torques, widths) for side in sides]
    most = np.tile(formation.scene.torque_limit, 2)
    left = np.concatenate([-torques[0], torques[0]], axis=1)
    left[:, :, 0] += most
    same = (sides[0].Xi == sides[1].Xi).all(axis=1) & (sides[0].sigma == sides[1].sigma).all(axis=1)
    scales = make_limits(formation, 0.0).only(PRESS, CONE).scales
    unit = np.concatenate([np.maximum(LEAST * scales, least), SPARE * most])
    scenes = list_scenes(formation.scene, widths)
    return Within(s, torques[0], left, (corners[0], corners[1]), same, unit, scenes)


def _find_torques(curve: Curve, s: Array, directions: Directions) -> Array:
    """Torques at n places, shape (n, 2, 5)."""
    point = curve.evaluate(np.clip(s, 0.0, curve.length))
    forces = inverse(curve.formation, *point[:3], directions, point.kinematics)
    return np.stack([forces.T0, forces.Tb, forces.Tv, forces.Ta, forces.Tl], axis=2)


def retime_within(
    curve: Curve,
    s: Array,
    plan: Motion,
    widths: Mapping[str, float],
    least: float,
    end: tuple[float, float] | None = None,
) -> tuple[tuple[CurveLimitRows, Reach] | None, float]:
    """The fastest motion that keeps its limits within the largest feasible share of ranges.

    Parameters
    ----------
    s : (n,) [m]  nodes
    plan : (n,)   a, b and internal force of a plan there; no motion is faster
    widths        half widths of the ranges; that of the delay is its unknown part
    least : [N]   least normal force within them
    end           as of `retime`

    Returns
    -------
    tuple  the law's limits and the motions, None if there are none; and the share of the ranges
    """

    def find(share: float) -> tuple[CurveLimitRows, Reach] | None:
        scaled = {name: min(share * width, WIDEST) for name, width in widths.items()}
        within, motion = find_within(curve, s, np.sqrt(plan[1]), scaled, least), plan
        for _ in range(ROUNDS):
            rows, whole, wanted = within.at(motion)
            found = retime(s, whole, wanted, plan[1], end, ())
            b = found.run(float(found.most[0]))
            if found.share.min() < ENOUGH:
                return None
            a = np.gradient(b, s) / 2
            motion = a, b, find_internal_force(rows, a, b)
        return within.at(motion)[0], found

    low, high, best = 0.0, 1.0, find(1.0)
    if best is not None:
        return best, 1.0
    # Downwards first: most ranges are only a little too wide.
    while high - low > CLOSE * high and high > NONE:
        share = LESS * high if best is None else (low + high) / 2
        found = find(share)
        if found is None:
            high = share
        else:
            low, best = share, found
    return best, low
