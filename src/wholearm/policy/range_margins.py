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
from ..mechanics.path_limits import PathLimits
from ..scene.model import Scene
from .curve_rows import (
    LATE,
    LEAST,
    NEAR,
    SPARE,
    UNLIMITED,
    Corners,
    CurveLimitRows,
    Motion,
    blend_directions,
    find_corners,
    find_internal_force,
    find_torques,
    have_same_signs,
    list_scenes,
    measure_slack,
    split_limits,
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
    left: Array  # (n, l, 5) [N m]: distances of torques from their limits
    sides: tuple[Corners, Corners]  # with friction before and after the nearest reversal
    same: Array  # (n,): where these are equal
    unit: Array  # (m + l,): margins at level 1, of forces and torques
    ends: Array  # (k, n_c, 5) [N]: normal forces at the last place, in each corner of the ranges
    scenes: tuple[Scene, ...]  # in these corners

    def at(self, motion: Motion) -> tuple[CurveLimitRows, Array, Array]:
        """The law's limits near a motion; those of the reference, and their margins."""
        motions = self._spread(motion)
        forces = self._pick(self.sides, motions)
        closed = self._pick([side.close(self.left) for side in self.sides], motions)
        count, n = len(self.unit) - self.left.shape[1], len(self.s)
        slack = np.concatenate([forces, self.left], axis=1)
        copies = forces.shape[1] // count
        unit = np.concatenate([np.tile(self.unit[:count], copies), self.unit[count:]])
        table, presses = np.tile(unit, (n, 1)), forces.shape[1]
        rows = CurveLimitRows(self.s, self.torque, slack, table, presses, self.ends, self.scenes)
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
        found[1][self.same] = UNLIMITED
        return np.concatenate(found, axis=1)

    def _spread(self, motion: Motion) -> list[Motion]:
        """A motion with its internal force, and with the least and largest one within torques."""
        a, b, internal = motion
        ends = PathLimits(self.left, b).find_internal_force_range(a, b)
        low, high = (np.where(np.isfinite(end), end, internal) for end in ends)
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
    nominal, step = find_torques(curve, s, mean), STEP * curve.length
    before, after = (find_torques(curve, s + sign * step, mean) for sign in (-1, 1))
    torques = nominal, find_torques(curve, late, mean), (after - before) / (2 * step)
    corners = [find_corners(formation, point, side, torques, widths) for side in sides]
    contact, joint = split_limits(formation)
    none = np.zeros((len(s), formation.n_constraints, 5))
    left = measure_slack(joint, none, nominal, point.z_s[:, 3:])
    scales, most = (each.scales[each.sides[0]] for each in (contact, joint))
    unit = np.concatenate([np.maximum(LEAST * scales, least), SPARE * most])
    ends, scenes = (
        corners[0].rows[:, -1, : formation.n_contacts],
        list_scenes(formation.scene, widths),
    )
    same = have_same_signs(*sides)
    return Within(s, nominal, left, (corners[0], corners[1]), same, unit, ends, scenes)


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
