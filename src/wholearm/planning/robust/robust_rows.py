"""Robust limits of contact forces along curves: worst case over ranges of uncertain parameters.

In h c - sum over p of |d(h c - low)/dp| r_p >= low (README) the derivatives times r_p, the
parametric bounds, are affine in 1, a = s'', b = s'^2, the internal force lambda and s'
(`mechanics.sensitivity`). So the left side is the least of affine rows, one for each choice of
signs. At a place with a known b they allow a polygon of a and lambda; a minimum-time
motion is at its vertex of largest or least a. The rows that meet at these two are found by cutting
planes: the most violated row is added. These `COPIES` rows for each limit are taken like any other
limits. `PhaseData` evaluates the absolute values, so that tightening covers other signs between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Numbers
from ...contacts.formation import Formation
from ...geometry.curve import Curve, CurvePoint, directions_of
from ...mechanics.dynamics import Directions, PathForces, apply, inverse
from ...mechanics.limits import CONE, PRESS, LimitSet, make_limits
from ...mechanics.path_limits import PathLimits, find_slack_rows, find_value_rows
from ...mechanics.sensitivity import Sensitivity
from ...mechanics.statics import Statics, TorquePolygon
from ...problem.definition import PARAMETERS, change_scene

COPIES = 5  # rows for each force limit: two for each vertex, and one for the reference
_LOOKS = 97  # places of a segment at which signs are found


class Guide(NamedTuple):
    """Reference motion along a curve: places [m], s'', s'^2 and internal force [N] there."""

    s: Array
    a: Array
    b: Array
    lam: Array


class RobustLimits(NamedTuple):
    """Robust force limits of a curve."""

    names: tuple[str, ...]  # parameters with a range that counts
    radii: Array  # (p,)
    rows: Array  # (m, n_c + R): those of the force limits, h
    s: Array  # (n,) [m]: places of the signs, segment by segment
    segment: Numbers  # (n,)
    signs: NDArray[np.int8]  # (n, m, COPIES, p)

    def find_variations(
        self,
        formation: Formation,
        point: CurvePoint,
        directions: Directions,
        forces: PathForces,
        epsilon: float,
    ) -> Array:
        """Each force limit's rows h c, and their parametric bounds, shape (n, m, 1 + p, COUNT)."""
        slopes = Sensitivity.of_curve(formation, point, directions, forces).find_slopes(self.names)
        given = formation, self.rows, self.names, slopes, forces.of_c, epsilon
        bounds, nominal = find_variations(*given) * self.radii[:, None], self.rows @ forces.of_c
        return np.concatenate([nominal[:, :, None], bounds], axis=2)

    def pick_signs(self, s: Array, segment: Numbers) -> NDArray[np.int8]:
        """Signs at some places, each of a segment, shape (n, m, COPIES, p)."""
        rows = np.zeros(len(s), dtype=np.int64)
        for number in set(segment.tolist()):
            here, table = (np.flatnonzero(each == number) for each in (segment, self.segment))
            places = self.s[table]
            rows[here] = table[np.searchsorted((places[1:] + places[:-1]) / 2, s[here])]
        return self.signs[rows]


def find_variations(
    formation: Formation,
    rows: Array,
    names: Sequence[str],
    slopes: Array,
    of_c: Array,
    epsilon: float,
) -> Array:
    """Derivatives of force limits by p parameters, shape (n, m, p, k) [N per unit].

    From rows h, (m, n_c + R), and k coefficients, the first of 1, of the slopes (n, n_c + R, p, k)
    of forces and of these, (n, n_c + R, k). A cone's edge, mu (c_n - epsilon), is proportional to
    its friction; c_n >= epsilon is free of that.
    """
    variations, count = np.einsum("mi,nipq->nmpq", rows, slopes), formation.n_contacts
    cones = (rows[:, count:] != 0).any(axis=1)[:, None]
    for k, name in enumerate(names):
        if name.startswith("friction"):
            part = {"palm": None, "finger1": 0, "finger2": 1}[name.partition("_")[2]]
            mine = [contact.finger == part for contact in formation.contacts]
            edges = cones * rows[:, :count] * mine
            variations[:, :, k] += edges @ of_c[:, :count]
            variations[:, :, k, 0] -= epsilon * edges.sum(axis=1)
    return np.asarray(variations)


def find_least(variations: Array, motion: tuple[Array, Array, Array]) -> Array:
    """The left sides of the robust limits, shape (n, m) [N]."""
    amounts = apply(variations, *motion)
    return np.asarray(amounts[..., 0] - np.abs(amounts[..., 1:]).sum(axis=2))


def spread_limits(limits: LimitSet) -> LimitSet:
    """Limits with `COPIES` rows for each of the forces'."""
    wider = []
    for limit in limits.limits:
        if limit.kind in (PRESS, CONE):
            changes: dict[str, Any] = {"text": f"{limit.text} within all ranges,"}
            repeated = ("rows", "low", "high", "weight")
            changes |= {name: np.repeat(getattr(limit, name), COPIES, axis=0) for name in repeated}
            limit = replace(limit, **changes)
        wider.append(limit)
    return LimitSet(tuple(wider))


def widen(limits: LimitSet, values: Array, variations: Array, signs: NDArray[np.int8]) -> Array:
    """Coefficients of the values of `spread_limits`, from those of limits, (n, m, 5)."""
    forced = np.isin(np.arange(len(limits.low)), limits.of(PRESS, CONE))
    counts = np.where(forced, COPIES, 1)
    wide, bounds = np.repeat(values, counts, axis=1), variations[:, :, 1:]
    copies = np.einsum("nmkp,nmpq->nmkq", signs, bounds).reshape(len(wide), -1, wide.shape[2])
    wide[:, np.repeat(forced, counts)] -= copies
    return wide


def spread(curve: Curve, guide: Guide, epsilon: float, widths: Mapping[str, float]) -> RobustLimits:
    """Robust force limits of a curve near a reference, for ranges of some radii but the delay."""
    names = [each.name for each in PARAMETERS if widths.get(each.name, 0.0) > 0]
    names = [name for name in names if name != "delay"]
    formation, segments = curve.formation, curve.segments
    share = (1 - np.cos(np.linspace(0.0, np.pi, _LOOKS))) / 2
    s = np.concatenate([part.start + share * (part.stop - part.start) for part in segments])
    segment = np.repeat(np.arange(len(segments)), _LOOKS)
    point = curve.evaluate(s)
    directions = directions_of(curve, segment)
    forces = inverse(formation, point, directions)
    limits = make_limits(formation, epsilon).split(2)[0]
    rows = limits.only(PRESS, CONE).rows[:, :-4]
    none = np.zeros((len(s), len(rows), COPIES, len(names)), dtype=np.int8)
    radii = np.array([widths[name] for name in names])
    bare = RobustLimits(tuple(names), radii, rows, s, segment, none)
    variations = bare.find_variations(formation, point, directions, forces, epsilon)
    a, b, lam = (np.interp(s, guide.s, column) for column in guide[1:])
    values = find_value_rows(limits, forces, point.z_s[:, 3:])
    return bare._replace(signs=_find_signs(limits, values, variations, none, (a, b, lam)))


def _find_signs(
    limits: LimitSet,
    values: Array,
    variations: Array,
    signs: NDArray[np.int8],
    motion: tuple[Array, Array, Array],
) -> NDArray[np.int8]:
    """Signs, from none, of the rows that meet at the vertices of largest and least a."""
    wider, signs, b = spread_limits(limits), signs.copy(), motion[1].copy()
    bounds, copies, forced = variations[:, :, 1:], wider.of(PRESS, CONE), limits.only(PRESS, CONE)
    signs[:, :, 4] = np.sign(apply(bounds, *motion))
    for turn in range(8):  # cutting planes
        wide = widen(limits, values, variations, signs)
        sides = PathLimits(find_slack_rows(wider, wide), np.full(len(b), np.inf))
        rows = sides.eliminate()
        extremes = (rows.extreme(b, largest).row for largest in (True, False))
        ends = [sides.meet(b, sides.pair(row)) for row in extremes]
        with np.errstate(invalid="ignore"):
            b = np.where(ends[0][0] < ends[1][0], 0.5 * b, b)  # no polygon there
        for end, (a, lam) in enumerate(ends):
            here = np.nan_to_num(a), b, np.nan_to_num(lam)
            slack = find_least(variations, here) - forced.low
            rowed = apply(wide[:, copies], *here).reshape(*slack.shape, -1)
            missed = slack < rowed.min(axis=2) - forced.low - 1e-9 * forced.scales  # rounding
            better = np.sign(apply(bounds, *here)).astype(np.int8)
            slots = (2 * end, 2 * end + 1) if turn == 0 else (2 * end + turn % 2,)
            for slot in slots:
                signs[:, :, slot] = np.where(missed[..., None], better, signs[:, :, slot])
    return signs


RobustHold = tuple[TorquePolygon, Array]
"""Torques that friction can hold at rest: times gains, shape (2,), within a polygon."""


def list_holds(formation: Formation, z: Array, ranges: Mapping[str, float]) -> list[RobustHold]:
    """Torques that friction can hold at `z`, with the largest friction, at corners of the ranges.

    Polygons are proportional to the mass: torques beyond the same side for its least and largest
    value are beyond it for all in between.
    """
    fingers = (ranges.get("gain1", 0.0), ranges.get("gain2", 0.0))
    gains = list(product(*(_spread(width) for width in fingers)))
    largest, holds = {key: ranges[key] for key in ranges if key.startswith("friction")}, []
    for mass in _spread(ranges.get("mass", 0.0)):
        scene = change_scene(formation.scene, largest | {"mass": mass - 1})
        corner = replace(formation, scene=scene)
        static = Statics(corner, z).torque_polygon()
        holds += [(static, np.array(gain)) for gain in gains]
    return holds


def measure_holds(holds: Sequence[RobustHold], tau: Array) -> float:
    """Distance of torques, (2,), beyond those that friction can hold in any corner [N m]."""
    return min(float(static.measure((gains * tau)[None])[0]) for static, gains in holds)


def _spread(width: float) -> tuple[float, ...]:
    return (1 - width, 1 + width) if width else (1.0,)
