"""Curve z(s) of a one-freedom formation: panels, tangent, curvature, reversals.

The parameter is the arc length s in metres, in the metric

    ds^2 = dx^2 + dy^2 + rho^2 (dphi^2 + dtheta_1^2 + dtheta_2^2),

rho being the object's radius of gyration, unless the curve has a speed ratio of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..common.arrays import Array, Numbers, find_root
from ..contacts.formation import CurvePoint as CurvePoint
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, find_freedoms, metric_weights

_TOL = 1e-6  # relative error of proportional rates, and relative size of zero rates


@dataclass(frozen=True, eq=False)
class Panel:
    """A part of a curve, as the polynomial through its nodes."""

    s: Array  # (n,) [m]: arc lengths of the nodes, increasing
    z: Array  # z, z_s (n, 5): configurations and unit tangents there
    z_s: Array

    @cached_property
    def _weights(self) -> Array:
        # Barycentric weights; on an interval of length 4 their products stay near 1.
        x = 4 * (self.s - self.s[0]) / (self.s[-1] - self.s[0])
        difference = x[:, None] - x[None, :]
        np.fill_diagonal(difference, 1.0)
        return np.asarray(1 / difference.prod(axis=1))

    def interpolate(self, s: Array) -> tuple[Array, Array]:
        """Return z and z_s at the arc lengths `s`, each of shape (n, 5)."""
        difference = s[:, None] - self.s[None, :]
        at_node = difference == 0
        difference[at_node] = 1.0
        terms = self._weights / difference
        rows = at_node.any(axis=1)
        terms[rows] = at_node[rows]
        terms /= terms.sum(axis=1, keepdims=True)
        return terms @ self.z, terms @ self.z_s


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a curve without a reversal."""

    start: float  # start, stop [m]: arc lengths of its ends
    stop: float
    # (n_c,): sliding directions of the contacts for motion along +s, zero for rolling ones
    Xi: Array
    sigma: Array  # (2,): directions of the joints for motion along +s


@dataclass(frozen=True, eq=False)
class Curve:
    """The curve z(s) of a one-freedom formation, for s from 0 to `length`."""

    formation: Formation
    panels: tuple[Panel, ...]
    length: float  # [m]
    ending: str  # description of the end
    reached: bool  # whether the curve ends at the requested end
    # arc length per unit of the parameter s, hence the length of its tangents
    speed_ratio: float = 1.0

    def evaluate(self, s: Array) -> CurvePoint:
        """Return z, its tangent z_s and its curvature z_ss at the places `s`, shape (n,)."""
        z, tangent = self.interpolate(np.asarray(s, dtype=float))
        formation = self.formation
        kinematics = formation.evaluate(z, tangent)
        metric = metric_weights(formation.scene)
        z_s, z_ss = solve_tangent(kinematics.P, kinematics.P_dot_v, tangent, metric)
        return CurvePoint(z, z_s * self.speed_ratio, z_ss * self.speed_ratio**2, kinematics)

    def interpolate(self, s: Array) -> tuple[Array, Array]:
        """Return z and its unit tangent at the places `s`, shape (n, 5) each, from the panels."""
        starts = np.array([panel.s[0] for panel in self.panels])
        owner = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, None)
        z, tangent = np.empty((len(s), 5)), np.empty((len(s), 5))
        for index, panel in enumerate(self.panels):
            rows = owner == index
            if rows.any():
                z[rows], tangent[rows] = panel.interpolate(s[rows])
        return z, tangent

    def with_speed_ratio(self, ratio: float) -> Curve:
        """Return the same curve with another `speed_ratio` of its parameter."""
        if ratio == self.speed_ratio:
            return self
        factor = self.speed_ratio / ratio
        panels = tuple(Panel(factor * panel.s, panel.z, panel.z_s) for panel in self.panels)
        return replace(self, panels=panels, length=factor * self.length, speed_ratio=ratio)

    @property
    def start(self) -> Array:
        """Configuration at s = 0, shape (5,)."""
        return np.asarray(self.panels[0].z[0])

    @cached_property
    def end(self) -> Array:
        """Configuration at s = length, shape (5,)."""
        return np.asarray(self.interpolate(np.array([self.length]))[0][0])

    def sliding(self, s: Array) -> Array:
        """Sliding rates A_t z_s of the contacts and rates of the joints, shape (n, n_c + 2)."""
        point, rho = self.evaluate(s), self.formation.scene.polygon.gyration_radius
        slip = np.einsum("nij,nj->ni", point.kinematics.A_t, point.z_s)
        slip[:, list(self.formation.rolling_rows)] = 0.0
        return np.hstack([slip, rho * point.z_s[:, 3:]])

    @property
    def is_regular(self) -> bool:
        """Whether contacts are independent along the whole curve, as `segments` requires."""
        try:
            return bool(self.segments)
        except np.linalg.LinAlgError:
            return False

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """The curve split at its reversals; `LinAlgError` where contacts are dependent."""
        grids = [refine(panel.s, self.length) for panel in self.panels]
        grid = np.concatenate([grid[index > 0 :] for index, grid in enumerate(grids)])
        rates = self.sliding(grid)
        rates[np.abs(rates) < 1e-9] = 0.0
        breaks = []
        for column in range(rates.shape[1]):
            moving = np.flatnonzero(rates[:, column])
            for flip in np.flatnonzero(np.diff(np.sign(rates[moving, column]))):
                low, high = grid[moving[flip]], grid[moving[flip + 1]]

                def rate(s: float, k: int = column) -> float:
                    return float(self.sliding(np.array([s]))[0, k])

                breaks.append(find_root(rate, low, high))
        margin = 1e-7 * self.length
        inner = [s for s in sorted(breaks) if margin < s < self.length - margin]
        ends = [0.0, *(s for i, s in enumerate(inner) if i == 0 or s > inner[i - 1] + margin)]
        segments = []
        for start, stop in zip(ends, [*ends[1:], self.length], strict=True):
            inner_rates = rates[(grid > start) & (grid < stop)]
            if not len(inner_rates):
                inner_rates = self.sliding(np.array([(start + stop) / 2]))
            signs = np.sign(inner_rates[np.abs(inner_rates).argmax(axis=0), range(rates.shape[1])])
            segments.append(Segment(start, stop, signs[:-2], signs[-2:]))
        return tuple(segments)


def directions_of(curve: Curve, segment: Numbers) -> Directions:
    """Directions at n places of a curve, given the segment that each belongs to."""
    signs = ([getattr(part, name) for part in curve.segments] for name in ("Xi", "sigma"))
    return Directions(*(np.array(sign)[segment] for sign in signs))


def solve_tangent(P: Array, P_dot_v: Array, tangent: Array, metric: Array) -> tuple[Array, Array]:
    """Unit null vector of P nearest to `tangent`, and the curvature orthogonal to it."""
    matrix = border(P, tangent * metric)
    rhs = np.zeros((len(P), 5, 2))
    rhs[:, 4, 0] = 1.0
    rhs[:, :4, 1] = -P_dot_v
    solution = np.linalg.solve(matrix, rhs)
    z_s, z_ss = solution[..., 0], solution[..., 1]
    z_s = z_s / np.sqrt(z_s**2 @ metric)[:, None]
    z_ss = z_ss - ((z_ss * z_s) @ metric)[:, None] * z_s
    return z_s, z_ss


def border(P: Array, last: Array) -> Array:
    """Append a row to each P: (n, 4, 5) and (5,) or (n, 5) to (n, 5, 5)."""
    last = np.broadcast_to(last, (len(P), 5))
    return np.concatenate([P, last[:, None, :]], axis=1)


def tangent_basis(formation: Formation, z: Array) -> Array:
    """Orthonormal covectors N of the null space of P at `z`, shape (5, f), in radii of gyration."""
    metric = metric_weights(formation.scene)
    P = formation.evaluate(z[None], np.zeros((1, 5))).P[0]
    return np.asarray(metric[:, None] * find_freedoms(P, metric, 1e-9) / np.sqrt(metric[2]))


def find_tied(formation: Formation, z: Array, row: int) -> tuple[int, ...]:
    """Rows of (contacts, joints) that reverse with a row: proportional, or of a flush edge."""
    flush = formation.turn_with(row)
    if formation.n_constraints != 3:
        return flush
    rates = find_rates(formation, z)
    norms = np.linalg.norm(rates, axis=1)
    cross_products = np.abs(rates[row, 0] * rates[:, 1] - rates[row, 1] * rates[:, 0])
    tied = (cross_products < _TOL * norms * norms[row]) & (norms > _TOL) & (norms[row] > _TOL)
    return tuple(dict.fromkeys([row, *flush, *np.flatnonzero(tied).tolist()]))


def find_vanishing(formation: Formation, z: Array) -> tuple[int, ...]:
    """Rows of (contacts, joints) whose rates vanish at a place of a curve at any speed."""
    rates = find_rates(formation, z)
    return tuple(np.flatnonzero(np.abs(rates[:, 0]) < _TOL)) if rates.shape[1] == 1 else ()


def find_rates(formation: Formation, z: Array) -> Array:
    """Rates of (contacts, joints) in each free direction, (n_c + 2, n), over the largest one."""
    point, metric = (formation.evaluate(z[None], np.zeros((1, 5))), metric_weights(formation.scene))
    rows = np.vstack([point.A_t[0] / formation.scene.scales.length, np.eye(5)[3:]])
    rates = rows @ find_freedoms(point.P[0], metric, 1e-9)
    return np.asarray(rates / np.linalg.norm(rates, axis=1).max(initial=1e-300))


def refine(s: Array, stop: float) -> Array:
    """Samples along a panel with nodes `s`, up to `stop`: three for each node."""
    grid = np.interp(np.linspace(0, len(s) - 1, 3 * len(s)), np.arange(len(s)), s)
    return np.append(grid[grid < stop], min(stop, s[-1]))


def describe_pose(z: Array) -> str:
    """Pose of the object as text, from z, q or (x, phi)."""
    x, phi = 1e3 * float(z[0]), float(np.degrees(z[min(2, len(z) - 1)]))
    x, phi = round(x, 6) + 0.0, round(phi, 6) + 0.0
    return f"x = {x:.4g} mm, phi = {phi:.4g} deg"
