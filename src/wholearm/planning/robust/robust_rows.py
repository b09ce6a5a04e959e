"""Limits of contact forces that hold whatever numbers are within their ranges, along curves.

With the radius r_p of each range, a force limit h c >= low becomes, at the same s and s' and under
the same torques,

    h c - sum over p of |d(h c - low)/dp| r_p >= low.

What is inside the bars is affine in 1, a = s'', b = s'^2, the squeeze and s': the swings, see
`sensitivity.slopes`. So the left side is the least of rows that are affine too, one for each choice
of signs. At a place with a known b, what all of them allow is a polygon of a and the squeeze. A
fastest motion is in its corner with the largest a or in the one with the least. The rows that meet
in these two are found by adding, corner by corner, the row that is missed most. They are `COPIES`
rows for each limit, which all that knows of limits takes like any others; the bars themselves are
what `PhaseData` evaluates, so that tightening makes up for signs that are others in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...geometry.curve import Curve, CurvePoint
from ...mechanics.dynamics import Directions, PathForces, inverse
from ...mechanics.limits import CONE, PRESS, SPEED, LimitSet, SideTerms, make_limits
from ...mechanics.wedging import StaticTorques, find_static_torques
from ...problem.uncertainty import PARAMETERS
from ...scene.model import Friction, Scene
from ...sensitivity.slopes import COUNT, find_force_slopes
from ..lower_bound.rows import PathLimitRows, eliminate

COPIES = 5  # rows for each force limit: two for each corner, and one for the motion that is known
_LOOKS = 97  # places of a stretch without reversals at which signs are found
_ROUNDS = 8  # rounds in which corners and rows are made to agree
_LOWER = 0.5  # factor on b where limits leave no corners
_SAME = 1e-9  # miss of a row that is none, over what is much for it


class Guide(NamedTuple):
    """A motion along a curve near which one is planned: places [m], s'', s'^2 and squeeze there."""

    s: Array
    a: Array
    b: Array
    squeeze: Array

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """The motion at some places."""
        a, b, squeeze = (np.interp(s, self.s, column) for column in self[1:])
        return a, b, squeeze


class Spread(NamedTuple):
    """What ranges make of the force limits of a curve."""

    names: tuple[str, ...]  # numbers with a range that counts
    radii: Array  # (p,)
    rows: Array  # (m, n_c + R): those of the force limits, h
    s: Array  # (n,) [m]: places at which signs are known, segment by segment
    segment: NDArray[np.int64]  # (n,)
    signs: NDArray[np.int8]  # (n, m, COPIES, p)

    def find_swings(
        self,
        formation: Formation,
        point: CurvePoint,
        directions: Directions,
        forces: PathForces,
        epsilon: float,
    ) -> Array:
        """What each range changes of each force limit, shape (n, m, p, COUNT)."""
        slopes = find_force_slopes(formation, point, directions, forces, self.names)
        swings = np.einsum("mi,nipq->nmpq", self.rows, slopes)
        c = _stack(forces)
        for k, name in enumerate(self.names):
            edges = find_edges(formation, self.rows, name)
            if edges is not None:
                swings[:, :, k] += np.einsum("mi,niq->nmq", edges, c)
                swings[:, :, k, 0] -= epsilon * edges.sum(axis=1)
        return np.asarray(swings * self.radii[:, None])

    def pick_signs(self, s: Array, segment: NDArray[np.int64]) -> NDArray[np.int8]:
        """Signs at some places, each of a segment, shape (n, m, COPIES, p)."""
        rows = np.zeros(len(s), dtype=np.int64)
        for own in set(segment.tolist()):
            here, known = np.flatnonzero(segment == own), np.flatnonzero(self.segment == own)
            places = self.s[known]
            rows[here] = known[np.searchsorted((places[1:] + places[:-1]) / 2, s[here])]
        return self.signs[rows]

    def extend(self, forces: PathForces, swings: Array, signs: NDArray[np.int8]) -> PathForces:
        """Forces with one more column for each copy of each limit, of what that is."""
        spread = np.einsum("nmkp,nmpq->nmkq", signs, swings)
        copies = spread.shape[2]
        own = np.repeat(np.einsum("mi,niq->nmq", self.rows, _stack(forces)), copies, axis=1)
        added = own - spread.reshape(own.shape)
        names = ("C0", "Ca", "Cb", "Cl", "Cv")
        wider = {
            name: np.hstack([getattr(forces, name), added[..., q]]) for q, name in enumerate(names)
        }
        return forces._replace(**wider)

    def evaluate(
        self, forces: PathForces, swings: Array, motion: tuple[Array, Array, Array]
    ) -> Array:
        """The left sides of the limits, with their bars, shape (n, m) [N]."""
        own = forces.c(*motion)[:, : self.rows.shape[1]] @ self.rows.T
        return np.asarray(own - np.abs(measure(swings, motion)).sum(axis=2))


def find_edges(formation: Formation, rows: Array, name: str) -> Array | None:
    """The part of force limits that is in proportion to a friction; None if there is none.

    A cone's edge is mu (c_n - epsilon); c_n >= epsilon knows no friction.

    Parameters
    ----------
    rows : (m, n_c + R)  of the limits
    name                 of the number that is off
    """
    if not name.startswith("friction") or not formation.rolling:
        return None
    part = {"palm": None, "finger1": 0, "finger2": 1}[name.partition("_")[2]]
    count = formation.n_contacts
    cones = (rows[:, count:] != 0).any(axis=1)
    edges = np.where(cones[:, None], rows, 0.0)
    edges[:, count:] = 0.0
    edges[:, :count] *= [contact.finger == part for contact in formation.contacts]
    return edges


def measure(swings: Array, motion: tuple[Array, Array, Array]) -> Array:
    """Swings of a motion, shape (n, m, p) [N]."""
    a, b, squeeze = motion
    columns = np.stack([np.ones_like(a), a, b, squeeze, np.sqrt(np.maximum(b, 0.0))], axis=-1)
    return np.asarray(np.einsum("nmpq,nq->nmp", swings, columns))


def spread_limits(limits: LimitSet) -> LimitSet:
    """Limits with `COPIES` rows for each of the forces', in the columns that `extend` adds."""
    width = len(limits.of(PRESS, CONE)) * COPIES
    found, first = [], 0
    for own in limits.limits:
        forces, joints = own.rows[:, :-4], own.rows[:, -4:]
        rows = np.hstack([forces, np.zeros((len(forces), width)), joints])
        if own.kind not in (PRESS, CONE):
            found.append(replace(own, rows=rows))
            continue
        count, begin = len(rows) * COPIES, forces.shape[1] + first
        rows = np.eye(rows.shape[1])[begin : begin + count]
        low, high, weight = (np.repeat(part, COPIES) for part in (own.low, own.high, own.weight))
        text = f"{own.text} within all ranges,"
        found.append(
            replace(own, rows=rows, low=low, high=high, weight=weight, text=text, drags=True)
        )
        first += count
    return LimitSet(tuple(found))


def spread(curve: Curve, guide: Guide, epsilon: float, widths: Mapping[str, float]) -> Spread:
    """What ranges make of the force limits of a curve, for motions near one that is known.

    Parameters
    ----------
    epsilon : [N]
    widths         radii of ranges by name; a delay does not count here
    """
    names = [own.name for own in PARAMETERS if widths.get(own.name, 0.0) > 0]
    names = [name for name in names if name != "delay"]
    formation, segments = curve.formation, curve.segments
    angles = np.linspace(0.0, np.pi, _LOOKS)
    share = (1 - np.cos(angles)) / 2
    s = np.concatenate([own.start + share * (own.stop - own.start) for own in segments])
    segment = np.repeat(np.arange(len(segments)), _LOOKS)
    point = curve.evaluate(s)
    signs = ([getattr(part, name) for part in segments] for name in ("Xi", "sigma"))
    directions = Directions(*(np.array(sign)[segment] for sign in signs))
    forces = inverse(formation, *point[:3], directions, point.kinematics)
    limits = make_limits(formation, epsilon).without(SPEED)
    rows = limits.only(PRESS, CONE).rows[:, :-4]
    none = np.zeros((len(s), len(rows), COPIES, len(names)), dtype=np.int8)
    radii = np.array([widths[name] for name in names])
    bare = Spread(tuple(names), radii, rows, s, segment, none)
    swings = bare.find_swings(formation, point, directions, forces, epsilon)
    found = _find_signs(bare, limits, forces, swings, point.z_s[:, 3:], guide.at(s))
    return bare._replace(signs=found)


def _find_signs(
    bare: Spread,
    limits: LimitSet,
    forces: PathForces,
    swings: Array,
    rates: Array,
    motion: tuple[Array, Array, Array],
) -> NDArray[np.int8]:
    """Signs of the rows that meet in the corners with the largest and the least a."""
    wider, signs, b = spread_limits(limits), bare.signs.copy(), motion[1].copy()
    signs[:, :, 4] = np.sign(measure(swings, motion))
    low = limits.only(PRESS, CONE).low
    scale = limits.only(PRESS, CONE).scales
    for turn in range(_ROUNDS):
        extended = bare.extend(forces, swings, signs)
        terms = SideTerms.of(wider, extended, rates)
        cap = np.full(len(b), np.inf)
        rows = eliminate(terms.press, terms.rate, terms.bend, terms.drag, terms.rest, cap)
        ends = [_find_corner(terms, rows, b, largest) for largest in (True, False)]
        with np.errstate(invalid="ignore"):
            b = np.where(ends[0][0] < ends[1][0], _LOWER * b, b)
        for end, (a, squeeze) in enumerate(ends):
            here = np.nan_to_num(a), b, np.nan_to_num(squeeze)
            slack = bare.evaluate(forces, swings, here) - low
            known = extended.c(*here)[:, bare.rows.shape[1] :].reshape(*slack.shape, -1)
            missed = slack < known.min(axis=2) - low - _SAME * scale
            better = np.sign(measure(swings, here)).astype(np.int8)
            slots = (2 * end, 2 * end + 1) if turn == 0 else (2 * end + turn % 2,)
            for slot in slots:
                signs[:, :, slot] = np.where(missed[..., None], better, signs[:, :, slot])
    return signs


def _find_corner(
    terms: SideTerms, rows: PathLimitRows, b: Array, largest: bool
) -> tuple[Array, Array]:
    """The corner with the largest or the least a at some b: a and the squeeze there."""
    row = rows.extreme(b, largest).row
    k, pair = np.arange(len(b))[:, None], np.stack(np.triu_indices(terms.press.shape[1], 1), 1)[row]
    at_rest = terms.at(np.zeros_like(b), b)
    (one, other), (r1, r2), (p1, p2) = (
        part[k, pair].T for part in (at_rest, terms.rate, terms.press)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        det = r1 * p2 - r2 * p1
        return (other * p1 - one * p2) / det, (one * r2 - other * r1) / det


def _stack(forces: PathForces) -> Array:
    """Coefficients of the contact forces, shape (n, n_c + R, COUNT)."""
    parts = np.stack([forces.C0, forces.Ca, forces.Cb, forces.Cl, forces.Cv], axis=-1)
    assert parts.shape[-1] == COUNT
    return parts


class RobustHold(NamedTuple):
    """What friction can hold at rest: torques times `gains`, shape (2,), within a polygon."""

    static: StaticTorques
    gains: Array

    def measure(self, tau: Array) -> float:
        """How far torques, shape (2,), are beyond it [N m]."""
        return float(self.static.measure((self.gains * tau)[None])[0])


def list_holds(formation: Formation, z: Array, ranges: Mapping[str, float]) -> list[RobustHold]:
    """What friction can hold at `z`, at the corners of ranges that hold most.

    Those have all the friction that there may be. Polygons grow in proportion to the mass, so that
    torques beyond the same side for the least and the largest are beyond it for all in between.
    """
    fingers = (ranges.get("gain1", 0.0), ranges.get("gain2", 0.0))
    gains = list(product(*(_spread(width) for width in fingers)))
    found = []
    for mass in _spread(ranges.get("mass", 0.0)):
        own = replace(formation, scene=_change(formation.scene, ranges, mass))
        static = find_static_torques([own], z)
        found += [RobustHold(static, np.array(gain)) for gain in gains]
    return found


def measure_holds(holds: Sequence[RobustHold], tau: Array) -> float:
    """How far torques are beyond what friction can hold in any corner [N m]."""
    return min(hold.measure(tau) for hold in holds)


def _spread(width: float) -> tuple[float, ...]:
    return (1 - width, 1 + width) if width else (1.0,)


def _change(scene: Scene, ranges: Mapping[str, float], mass: float) -> Scene:
    parts = ("palm", "finger1", "finger2")
    more = {part: 1 + ranges.get(f"friction_{part}", 0.0) for part in parts}
    friction = Friction(**{part: getattr(scene.friction, part) * more[part] for part in parts})
    polygon = replace(scene.polygon, mass=scene.polygon.mass * mass)
    return replace(scene, polygon=polygon, friction=friction)
