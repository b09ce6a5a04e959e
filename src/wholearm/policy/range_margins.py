"""The reference of a curve's law and its limits where the ranges of numbers are known.

Limits hold in the worst corner of the ranges (`corners`) both under the torques of the motion and
under those by which feedback makes the motion what it is to be. The worst corners depend on the
motion, and how fast it may be depends on them: each is found from the other, a few times.
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
from .corners import Corners, Motion, find_corners, list_scenes
from .curve_rows import LATE, LEAST, NEAR, NEVER, SPARE, CurveLimitRows, find_squeeze, turn
from .retiming import Reach, retime

ROUNDS = 3  # How many times worst corners and motion are found from one another
KEPT = 1.3  # Reserve of forces of the reference, in units: feedback may use what is above one
ENOUGH = 0.5  # Part of these reserves without which ranges are too wide
LESS, CLOSE, NONE = 0.8, 0.03, 0.02
"""Factor by which ranges shrink where they are too wide, the error of how wide they may be, and a
part of them that is as good as none."""
WIDEST = 0.9  # Largest relative range
WIDER = 1.01  # Least width of a reversal, over the distance to the next node
STEP = 1e-4  # Step of differences along a curve, over its length
AUTHORITY = 2.0  # Reserve of torques, in those of `curve_rows`: feedback adds to the motion


class Within(NamedTuple):
    """Limits along a curve within ranges, at n places."""

    s: Array  # (n,) [m]
    torque: Array  # (n, 2, 5) [N m]
    left: Array  # (n, 4, 5) [N m]: how far torques are from their limits
    # with friction as it is before the nearest reversal and after it
    sides: tuple[Corners, Corners]
    same: Array  # (n,): where these do not differ
    unit: Array  # (m + 4,): reserves at level 1: of forces, and of torques
    scenes: tuple[Scene, ...]  # in the corners of the ranges

    def at(self, motion: Motion) -> tuple[CurveLimitRows, Array, Array]:
        """The law's limits near a motion; and those of a reference with their reserves."""
        motions = self._spread(motion)
        forces = self._pick(self.sides, motions)
        closed = self._pick([own.close(self.left) for own in self.sides], motions)
        count, n = len(self.unit) - 4, len(self.s)
        slack = np.concatenate([forces, self.left], axis=1)
        copies = forces.shape[1] // count
        unit = np.concatenate([np.tile(self.unit[:count], copies), self.unit[count:]])
        table, ends = np.tile(unit, (n, 1)), self.sides[0].rows[:, -1]
        rows = CurveLimitRows(self.s, self.torque, slack, table, forces.shape[1], ends, self.scenes)
        own = np.concatenate([KEPT * self.unit[:count], AUTHORITY * self.unit[count:]])
        wanted = np.concatenate(
            [np.tile(own[:count], copies), own[count:], np.tile(own, len(motions) * 2)]
        )
        whole = np.concatenate([slack, closed], axis=1)
        return rows, whole, np.tile(wanted, (n, 1))

    def _pick(self, sides: tuple[Corners, ...] | list[Corners], motions: list[Motion]) -> Array:
        """Limits on both sides of reversals in the corners worst for motions, (n, rows, 5)."""
        found = [np.concatenate([side.pick(own) for own in motions], axis=1) for side in sides]
        found[1][self.same] = np.array([NEVER, 0.0, 0.0, 0.0, 0.0])
        return np.concatenate(found, axis=1)

    def _spread(self, motion: Motion) -> list[Motion]:
        """A motion with its squeeze, and with the least and the largest one that torques allow."""
        a, b, squeeze = motion
        known = np.column_stack([np.ones_like(a), b, np.sqrt(b), a])
        base, press = np.einsum("nmq,nq->nm", self.left[..., :4], known), self.left[..., 4]
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = -base / press
        low = np.where(press > 0, ends, -np.inf).max(axis=1)
        high = np.where(press < 0, ends, np.inf).min(axis=1)
        low, high = (np.where(np.isfinite(own), own, squeeze) for own in (low, high))
        return [motion, (a, b, np.minimum(low, squeeze)), (a, b, np.maximum(high, squeeze))]


def find_within(
    curve: Curve, s: Array, speed: Array, widths: Mapping[str, float], least: float
) -> Within:
    """Limits along a curve within ranges, with forces of at least so much [N]."""
    formation, point = curve.formation, curve.evaluate(s)
    # Between nodes limits are mixed: those next to a reversal have to know both directions.
    gaps = np.pad(np.diff(s), 1)
    mean, *sides = turn(curve, s, np.maximum(speed * NEAR, WIDER * np.maximum(gaps[1:], gaps[:-1])))
    late = s - (LATE + widths.get("delay", 0.0)) * speed
    asked, step = _find_torques(curve, s, mean), STEP * curve.length
    ends = (_find_torques(curve, s + way * step, mean) for way in (-1, 1))
    change = (-next(ends) + next(ends)) / (2 * step)
    torques = asked, _find_torques(curve, late, mean), change
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
    own = inverse(curve.formation, *point[:3], directions, point.kinematics)
    return np.stack([own.T0, own.Tb, own.Tv, own.Ta, own.Tl], axis=2)


def retime_within(
    curve: Curve,
    s: Array,
    plan: Motion,
    widths: Mapping[str, float],
    least: float,
    end: tuple[float, float] | None = None,
) -> tuple[tuple[CurveLimitRows, Reach] | None, float]:
    """The fastest motion that keeps its limits within ranges, or as large a part of them as can be.

    Parameters
    ----------
    s : (n,) [m]  nodes
    plan : (n,)   a, b and squeeze of a plan there; no motion is faster
    widths        half widths of the ranges; the delay is what torques are late by without being
                  known to be
    least : [N]   least normal force within them
    end           as of `retime`

    Returns
    -------
    tuple  the law's limits and the motions, None if no part of the ranges has them; and that part
    """

    def find(share: float) -> tuple[CurveLimitRows, Reach] | None:
        own = {name: min(share * width, WIDEST) for name, width in widths.items()}
        return _retime(find_within(curve, s, np.sqrt(plan[1]), own, least), plan, end)

    low, high, best = 0.0, 1.0, find(1.0)
    if best is not None:
        return best, 1.0
    # Downwards first, as most that are too wide are so by little.
    while high - low > CLOSE * high and high > NONE:
        share = LESS * high if best is None else (low + high) / 2
        found = find(share)
        if found is None:
            high = share
        else:
            low, best = share, found
    return best, low


def _retime(
    within: Within, plan: Motion, end: tuple[float, float] | None
) -> tuple[CurveLimitRows, Reach] | None:
    """The motion within ranges, None if there is none."""
    motion = plan
    for _ in range(ROUNDS):
        rows, whole, wanted = within.at(motion)
        found = retime(within.s, whole, wanted, plan[1], end, ())
        b = found.run(float(found.most[0]))
        if found.share.min() < ENOUGH:
            return None
        a = np.gradient(b, within.s) / 2
        motion = a, b, find_squeeze(rows, a, b)
    return within.at(motion)[0], found
