"""What motions along a border may do, looked at once, at a few places of it.

Whatever leads along a border, alone or as one of several that are passed without a stop, is timed
by the same limits at the same places.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation, Kinematics
from ..geometry.curve import Curve, CurvePoint, describe_pose
from ..mechanics.dynamics import Directions, reduced_inertia
from ..mechanics.metric import metric_weights
from ..mechanics.uniqueness import find_minors
from ..planning.lower_bound.path_terms import PathTerms
from ..planning.lower_bound.rows import PathLimitRows, limit_along
from ..planning.lower_bound.speed_sweep import NoMotionError, add_up, find_steady

INTERVALS = 24  # Intervals of the grid on which the fastest motion along a border is looked for
CHECKED = 12
"""Places of a segment at which jamming and ambiguous forces are looked for, besides those."""
INDEPENDENT = 1e-12  # Least Gram determinant of the rows of contacts, each of length one
DEPENDENT = "its contacts depend on each other"


class Unstopped(str):
    """Why no motion along curves ends at rest, though one that goes on beyond them may be."""


class Ground(NamedTuple):
    """Limits of motions along a border, or along the first part of one."""

    # why nothing passes it: friction jams it, or contact forces are not the only ones. Empty where
    # there is no such reason, as of the others.
    closed: str
    clear: float  # [m]: up to where there is none
    # begins, ends: why no motion begins at rest at its start, or ends at rest at its end
    begins: str
    ends: str
    z: Array  # (n, 5): a place in each of some intervals
    rows: PathLimitRows  # limits there
    # steps, part (n,): lengths of the intervals [m], and which part of each is before its place
    steps: Array
    part: Array

    def with_speed_ratio(self, ratio: float) -> Ground:
        """The same by a parameter that runs through it at another ratio."""
        a, b, v, one, cap = self.rows
        rows = PathLimitRows(a * ratio, b * ratio**2, v * ratio, one, cap / ratio**2)
        return self._replace(rows=rows, steps=self.steps / ratio)


def survey(curve: Curve, epsilon: float, uniqueness_margin: float) -> Ground:
    """Look at a border.

    Parameters
    ----------
    curve              by its arc length
    epsilon : [N]      least normal force
    uniqueness_margin  see `PlanOptions`
    """
    way = PathTerms((curve,), epsilon)
    grid = way.make_grid(INTERVALS)
    nodes, count = way.place(grid.angles), len(grid.owners) + 2
    middles = way.place((grid.angles[1:] + grid.angles[:-1]) / 2)
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
        rows = limit_along(curve, epsilon, _pick(at, slice(count)), owners[:count])
    except np.linalg.LinAlgError:
        none = np.zeros((len(steps), 1))
        rows = PathLimitRows(none, none, none, none - 1, none[:, 0])
        return Ground(DEPENDENT, 0.0, "", "", none, rows, steps, none[:, 0])
    begins, ends = (
        "" if _is_held(sign * rows.a[k], rows.one[k]) else f"no motion {what} at rest at {place}"
        for k, sign, what, place in (
            (0, 1.0, "begins", describe_pose(at.z[0])),
            (1, -1.0, "ends", describe_pose(at.z[1])),
        )
    )
    inner = slice(2, count)
    part = (middles - nodes[:-1]) / steps
    return Ground(closed, clear, begins, ends, at.z[inner], rows.pick(inner), steps, part)


def sketch(grounds: Sequence[Ground]) -> float | str:
    """About how long motions along borders take, from rest to rest, or why there is none [s].

    Parameters
    ----------
    grounds  with such speed ratios that the speed is the same on both sides of where two of them
             meet
    """
    rows = PathLimitRows(
        *(np.concatenate(part) for part in zip(*(own.rows for own in grounds), strict=True))
    )
    steps, part = (
        np.concatenate([getattr(own, key) for own in grounds]) for key in ("steps", "part")
    )
    caps: Array = np.minimum(np.append(rows.cap, np.inf), np.append(np.inf, rows.cap))
    try:
        return add_up(find_steady(rows, steps, part, caps).b, steps)
    except NoMotionError as error:
        place = np.concatenate([own.z for own in grounds])[min(error.interval, len(steps) - 1)]
        return f"no motion keeps its limits at {describe_pose(place)}"


def _pick(at: CurvePoint, rows: slice) -> CurvePoint:
    """Some places of a curve."""
    kinematics = Kinematics(*(part[rows] for part in at.kinematics))
    return CurvePoint(at.z[rows], at.z_s[rows], at.z_ss[rows], kinematics)


def _is_held(a: Array, one: Array) -> bool:
    """Whether limits a s'' + one >= 0, shape (m,), allow some s'' >= 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.where(a > 0, -one / a, 0.0).max()
        most = np.where(a < 0, -one / a, np.inf).min()
    return bool(max(least, 0.0) <= most and not ((a == 0) & (one < 0)).any())


def _find_ambiguity(
    curve: Curve, s: Array, at: CurvePoint, owners: NDArray[np.int64], least: float
) -> tuple[str, float]:
    """Why contact forces along a curve are not the only ones, and up to where they are [m].

    Empty, and the length of the curve, where they are.

    Parameters
    ----------
    s : (n,)       where to look
    at             the curve there
    owners : (n,)  which segment each place is looked at as part of
    least          least ratio of a minor
    """
    formation = curve.formation
    Xi, sigma = (
        np.array([getattr(own, key) for own in curve.segments])[owners] for key in ("Xi", "sigma")
    )
    rows = at.kinematics.P / np.sqrt(metric_weights(formation.scene))
    rows = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    volumes = np.linalg.det(rows @ rows.transpose(0, 2, 1))
    inertia = reduced_inertia(formation, at.kinematics, Directions(Xi, sigma))
    minors = find_minors(formation, at.kinematics, Xi)
    lost = ~(np.isfinite(inertia) & (volumes > INDEPENDENT))
    bad = lost | (inertia <= 0) | (minors.ratios < least)
    if not bad.any():
        return "", curve.length
    first = s[bad].min()
    least_place = int(np.where(bad, s, np.inf).argmin())
    clear = float(s[s < first].max(initial=0.0))
    if lost[s == first].any():
        return _describe_dependence(formation, at.z[least_place]), clear
    if inertia[~lost].min() <= 0:
        return "friction jams it", clear
    ratio, names, row = minors.find_least()
    return f"{names} ambiguous: uniqueness margin {ratio:.2f} at {describe_pose(at.z[row])}", clear


def _describe_dependence(formation: Formation, z: Array) -> str:
    """Where contacts depend on each other, and which limit of theirs is met there."""
    values = formation.evaluate_limits(z[None])[0]
    met = [
        limit.text
        for limit, value in zip(formation.limits, values, strict=True)
        if abs(value) < formation.scene.touching
    ]
    reason = f": {met[0]}" if met else ""
    return f"{DEPENDENT} at {describe_pose(z)}{reason}"
