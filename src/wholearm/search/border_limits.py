"""Limits of motions along a border, at one place of each interval, shared by all edges along it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Kinematics
from ..geometry.curve import Curve, CurvePoint, describe_pose, directions_of
from ..mechanics.dynamics import metric_weights, reduced_inertia
from ..mechanics.path_limits import PathLimits
from ..mechanics.speed_sweep import NoMotionError, find_duration, speed_sweep
from ..mechanics.uniqueness import find_minors
from ..planning.lower_bound import PathTerms, find_limits

INTERVALS = 24  # intervals of the speed sweep along a border
CHECKED = 12  # further places of each segment that are checked for jamming and uniqueness
INDEPENDENT = 1e-12  # least Gram determinant of unit rows of independent contacts
DEPENDENT = "its contacts depend on each other"


class Unstopped(str):
    """Reason why no motion along curves ends at rest; one that passes on may be possible."""


class BorderLimits(NamedTuple):
    """Limits of motions along a border or its first part; reasons are empty without one."""

    closed: str  # why nothing passes: friction jams it, or contact forces are not unique
    clear: float  # [m]: length of the first part that is not closed
    begins: str  # why no motion begins at rest at the start
    ends: str  # why no motion ends at rest at the end
    z: Array  # (n, 5): a place in each interval
    limits: PathLimits  # limits there, without the internal force
    steps: Array  # (n,) [m]: lengths of the intervals
    part: Array  # (n,): share of each interval before its place

    def with_speed_ratio(self, ratio: float) -> BorderLimits:
        """The same with the path parameter scaled by `ratio`."""
        return self._replace(limits=self.limits.scale(ratio), steps=self.steps / ratio)


def find_border_limits(
    curve: Curve, epsilon: float, uniqueness_margin: float, intervals: int = INTERVALS
) -> BorderLimits:
    """Limits along a curve with arc length as parameter; epsilon [N] is the least normal force."""
    terms = PathTerms((curve,), epsilon)
    grid = terms.make_grid(intervals)
    nodes, count = terms.place(grid.angles), len(grid.owners) + 2
    middles = terms.place((grid.angles[1:] + grid.angles[:-1]) / 2)
    last = len(curve.segments) - 1
    checked = [
        np.linspace(part.start, min(part.stop, curve.length), CHECKED) for part in curve.segments
    ]
    s = np.concatenate([[0.0, curve.length], middles, *checked])
    owners = np.concatenate([[0, last], grid.owners, np.repeat(np.arange(last + 1), CHECKED)])
    steps = np.diff(nodes)
    try:
        at = curve.evaluate(s)
        closed, clear = _find_ambiguity(curve, s, at, owners, uniqueness_margin)
        first = Kinematics(*(array[:count] for array in at.kinematics))
        nodes_at = CurvePoint(at.z[:count], at.z_s[:count], at.z_ss[:count], first)
        limits = find_limits(curve, epsilon, nodes_at, owners[:count])
    except np.linalg.LinAlgError:
        z, none = np.zeros((len(steps), 5)), np.zeros(len(steps))
        limits = PathLimits(np.zeros((len(steps), 1, 4)), none)
        return BorderLimits(DEPENDENT, 0.0, "", "", z, limits, steps, none)
    begins, ends = (
        "" if limits.pick(k).can_rest(sign) else f"no motion {what} at rest at {place}"
        for k, sign, what, place in (
            (0, 1.0, "begins", describe_pose(at.z[0])),
            (1, -1.0, "ends", describe_pose(at.z[1])),
        )
    )
    inner = slice(2, count)
    part = (middles - nodes[:-1]) / steps
    return BorderLimits(closed, clear, begins, ends, at.z[inner], limits.pick(inner), steps, part)


def estimate_duration(limits: Sequence[BorderLimits]) -> float | str:
    """Estimated duration [s] of a motion along borders from rest to rest, or why there is none.

    Speed sweep with the limits of one place in each interval. `limits` have such speed ratios that
    the speed is continuous where two borders meet.
    """
    rows, cap = (np.concatenate(column) for column in zip(*(b.limits for b in limits), strict=True))
    steps, part, z = (
        np.concatenate([getattr(b, key) for b in limits]) for key in ("steps", "part", "z")
    )
    try:
        motion = speed_sweep(PathLimits(rows, cap), steps, part)
        return float(find_duration(motion.b, steps))
    except NoMotionError as error:
        return f"no motion keeps its limits at {describe_pose(z[min(error.interval, len(z) - 1)])}"


def _find_ambiguity(
    curve: Curve, s: Array, at: CurvePoint, owners: NDArray[np.int64], least: float
) -> tuple[str, float]:
    """Why contact forces along a curve are not unique (else empty), and up to where they are [m].

    Parameters
    ----------
    s, at : (n,)   places, and the curve there
    owners : (n,)  the segment of each place
    least          uniqueness margin (P-matrix)
    """
    formation = curve.formation
    directions = directions_of(curve, owners)
    rows = at.kinematics.P / np.sqrt(metric_weights(formation.scene))
    rows = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    volumes = np.linalg.det(rows @ rows.transpose(0, 2, 1))
    inertia = reduced_inertia(formation, at.kinematics, directions)
    minors = find_minors(formation, at.kinematics, directions.Xi)
    lost = ~(np.isfinite(inertia) & (volumes > INDEPENDENT))
    bad = lost | (inertia <= 0) | (minors.ratios < least)
    if not bad.any():
        return "", curve.length
    first = s[bad].min()
    least_place = int(np.where(bad, s, np.inf).argmin())
    clear = float(s[s < first].max(initial=0.0))
    if lost[s == first].any():
        z = at.z[least_place]
        values = formation.evaluate_limits(z[None])[0]
        met = [
            f": {limit.text}"
            for limit, value in zip(formation.limits, values, strict=True)
            if abs(value) < formation.scene.touching
        ]
        return f"{DEPENDENT} at {describe_pose(z)}{''.join(met[:1])}", clear
    if inertia[~lost].min() <= 0:
        return "friction jams it", clear
    ratio, names, row = minors.find_least()
    return f"{names} ambiguous: uniqueness margin {ratio:.2f} at {describe_pose(at.z[row])}", clear
