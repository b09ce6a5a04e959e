"""Robust limits of contact forces along curves: worst case over ranges of uncertain parameters.

In h c - sum over p of |d(h c - low)/dp| r_p >= low (README) the derivatives times r_p, the
parametric bounds, are affine in 1, a = s'', b = s'^2, the internal force lambda and s'
(`mechanics.sensitivity`). So the left side is the minimum of affine rows, one for each choice of
signs. At a place and with a value of b the rows bound a polygon of a and lambda; a minimum-time
motion is at its vertex of largest or least a. The rows that meet at these two vertices are found by
cutting planes: the most violated row is added. These `COPIES` rows for each limit are used like any
other limits. `PhaseData` evaluates the absolute values: tightening covers other signs between.
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
_PLACES = 97  # places of a segment at which signs are determined


class Reference(NamedTuple):
    """Reference motion along a curve: places [m], and s'', s'^2 and internal force [N] there."""

    s: Array
    a: Array
    b: Array
    lam: Array


class RobustLimits(NamedTuple):
    """Robust force limits of a curve."""

    names: tuple[str, ...]  # parameters with a range
    radii: Array  # (p,)
    rows: Array  # (m, n_c + R): rows h of the force limits
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
        bounds = find_variations(formation, self.rows, self.names, slopes, forces.of_c, epsilon)
        nominal = (self.rows @ forces.of_c)[:, :, None]
        return np.concatenate([nominal, bounds * self.radii[:, None]], axis=2)

    def pick_signs(self, s: Array, segment: Numbers) -> NDArray[np.int8]:
        """Signs at places `s` of segments `segment`, shape (n, m, COPIES, p)."""
        rows = np.zeros(len(s), dtype=np.int64)
        for number in set(segment.tolist()):
            targets, sources = (np.flatnonzero(x == number) for x in (segment, self.segment))
            places = self.s[sources]
            rows[targets] = sources[np.searchsorted((places[1:] + places[:-1]) / 2, s[targets])]
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

    Of rows h, (m, n_c + R). Slopes of the forces, (n, n_c + R, p, k), and the forces `of_c`,
    (n, n_c + R, k), have k coefficients, the first of 1. The edge of a cone, mu (c_n - epsilon), is
    proportional to friction; c_n >= epsilon does not depend on it.
    """
    variations, count = np.einsum("mi,nipq->nmpq", rows, slopes), formation.n_contacts
    cones = (rows[:, count:] != 0).any(axis=1)[:, None]
    for k, name in enumerate(names):
        if name.startswith("friction"):
            part = {"palm": None, "finger1": 0, "finger2": 1}[name.partition("_")[2]]
            is_part = [contact.finger == part for contact in formation.contacts]
            edges = cones * rows[:, :count] * is_part
            variations[:, :, k] += edges @ of_c[:, :count]
            variations[:, :, k, 0] -= epsilon * edges.sum(axis=1)
    return np.asarray(variations)


def evaluate_robust(variations: Array, motion: tuple[Array, Array, Array]) -> Array:
    """The left sides of the robust limits, shape (n, m) [N]."""
    values = apply(variations, *motion)
    return np.asarray(values[..., 0] - np.abs(values[..., 1:]).sum(axis=2))


def repeat_limits(limits: LimitSet) -> LimitSet:
    """Limits with `COPIES` rows for each force limit."""
    repeated = []
    for limit in limits.limits:
        if limit.kind in (PRESS, CONE):
            changes: dict[str, Any] = {"text": f"{limit.text} within all ranges,"}
            arrays = ("rows", "low", "high", "weight")
            changes |= {name: np.repeat(getattr(limit, name), COPIES, axis=0) for name in arrays}
            limit = replace(limit, **changes)
        repeated.append(limit)
    return LimitSet(tuple(repeated))


def widen(limits: LimitSet, values: Array, variations: Array, signs: NDArray[np.int8]) -> Array:
    """Coefficients of the values of `repeat_limits`, (n, m', 5), from those of `limits`."""
    is_force = np.isin(np.arange(len(limits.low)), limits.of(PRESS, CONE))
    counts = np.where(is_force, COPIES, 1)
    repeated, bounds = np.repeat(values, counts, axis=1), variations[:, :, 1:]
    total = np.einsum("nmkp,nmpq->nmkq", signs, bounds).reshape(len(values), -1, values.shape[2])
    repeated[:, np.repeat(is_force, counts)] -= total
    return repeated


def robustify(
    curve: Curve, reference: Reference, epsilon: float, widths: Mapping[str, float]
) -> RobustLimits:
    """Robust force limits of a curve near a reference, for radii `widths` but that of the delay."""
    names = [parameter.name for parameter in PARAMETERS if widths.get(parameter.name, 0.0) > 0]
    names = [name for name in names if name != "delay"]
    formation, segments = curve.formation, curve.segments
    fraction = (1 - np.cos(np.linspace(0.0, np.pi, _PLACES))) / 2
    s = np.concatenate([part.start + fraction * (part.stop - part.start) for part in segments])
    segment = np.repeat(np.arange(len(segments)), _PLACES)
    point = curve.evaluate(s)
    directions = directions_of(curve, segment)
    forces = inverse(formation, point, directions)
    limits = make_limits(formation, epsilon).split(2)[0]
    rows = limits.only(PRESS, CONE).rows[:, :-4]
    zero = np.zeros((len(s), len(rows), COPIES, len(names)), dtype=np.int8)
    radii = np.array([widths[name] for name in names])
    unsigned = RobustLimits(tuple(names), radii, rows, s, segment, zero)
    variations = unsigned.find_variations(formation, point, directions, forces, epsilon)
    a, b, lam = (np.interp(s, reference.s, column) for column in reference[1:])
    values = find_value_rows(limits, forces, point.z_s[:, 3:])
    return unsigned._replace(signs=_find_signs(limits, values, variations, zero, (a, b, lam)))


def _find_signs(
    limits: LimitSet,
    values: Array,
    variations: Array,
    signs: NDArray[np.int8],
    motion: tuple[Array, Array, Array],
) -> NDArray[np.int8]:
    """Signs of the rows that meet at the vertices of largest and least a, by cutting planes."""
    repeated, signs, b = repeat_limits(limits), signs.copy(), motion[1].copy()
    bounds, copies = variations[:, :, 1:], repeated.of(PRESS, CONE)
    forces = limits.only(PRESS, CONE)
    signs[:, :, 4] = np.sign(apply(bounds, *motion))
    for iteration in range(8):  # cutting planes
        coefficients = widen(limits, values, variations, signs)
        slack_rows = find_slack_rows(repeated, coefficients)
        path_limits = PathLimits(slack_rows, np.full(len(b), np.inf))
        rows = path_limits.eliminate()
        extremes = (rows.extreme(b, largest).row for largest in (True, False))
        ends = [path_limits.meet(b, path_limits.pair(row)) for row in extremes]
        with np.errstate(invalid="ignore"):
            b = np.where(ends[0][0] < ends[1][0], 0.5 * b, b)  # the polygon is empty
        for end, (a, lam) in enumerate(ends):
            vertex = np.nan_to_num(a), b, np.nan_to_num(lam)
            slack = evaluate_robust(variations, vertex) - forces.low
            modelled = apply(coefficients[:, copies], *vertex).reshape(*slack.shape, -1)
            violated = slack < modelled.min(axis=2) - forces.low - 1e-9 * forces.scales  # rounding
            vertex_signs = np.sign(apply(bounds, *vertex)).astype(np.int8)
            slots = (2 * end, 2 * end + 1) if iteration == 0 else (2 * end + iteration % 2,)
            for slot in slots:
                signs[:, :, slot] = np.where(violated[..., None], vertex_signs, signs[:, :, slot])
    return signs


RobustHold = tuple[TorquePolygon, Array]
"""Torques that friction can hold at rest: within a polygon after multiplication by gains, (2,)."""


def list_holds(formation: Formation, z: Array, ranges: Mapping[str, float]) -> list[RobustHold]:
    """Torques that friction can hold at `z`, with the largest friction, at corners of the ranges.

    Polygons are proportional to the mass: torques beyond the same side for the least and largest
    mass are beyond it for all masses between.
    """
    fingers = (ranges.get("gain1", 0.0), ranges.get("gain2", 0.0))
    gains = list(product(*(_bounds(width) for width in fingers)))
    largest, holds = {key: ranges[key] for key in ranges if key.startswith("friction")}, []
    for mass in _bounds(ranges.get("mass", 0.0)):
        scene = change_scene(formation.scene, largest | {"mass": mass - 1})
        static = Statics(replace(formation, scene=scene), z).torque_polygon()
        holds += [(static, np.array(gain)) for gain in gains]
    return holds


def measure_holds(holds: Sequence[RobustHold], tau: Array) -> float:
    """Least distance of torques, (2,), from those that friction can hold in a corner [N m]."""
    return min(float(static.measure((gains * tau)[None])[0]) for static, gains in holds)


def _bounds(width: float) -> tuple[float, ...]:
    return (1 - width, 1 + width) if width else (1.0,)
