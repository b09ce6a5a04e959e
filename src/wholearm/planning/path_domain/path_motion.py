"""Motion along a curve: elements with polynomials of s'' and internal force, and s(t).

An element has `NODES` nodes, the Lobatto points of a local variable y from 0 to 1, and a map: s is
a polynomial of y. Inside a motion it is linear. Next to rest it is quadratic, measured from the
place of rest: the speed, and viscous friction with it, is the root of s there, and smooth in y.
Where torques may not step, the motion starts and ends without acceleration and s is cubic in y.
Elements after such a start are bent: s is (1 - c) y + c y^2 of the length, with c such that the
root of the distance from a virtual start with acceleration is linear in y; c is negative before
such an end. With b = s'^2 and b' = 2 s'' (dash: d/ds), b is a polynomial in y too.

Inside an element s(t) follows by Gauss quadrature of 1 / s'. z, tau and the contact forces follow
from s, s' and s'' by inverse dynamics: the equations of motion hold at every instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from ...common.arrays import Array, Flags, Numbers, jacobi_nodes
from ...geometry.curve import Curve, directions_of
from ...mechanics.dynamics import Directions, inverse, split_forces
from ...results.trajectory import Samples

DEGREE = 4  # degree of the polynomials
NODES = DEGREE + 1  # of an element
POWERS = np.arange(NODES)
# Maps, by the coefficients of y, y^2 and y^3: amid a motion, after rest, and so without
# acceleration; and what runs a map through backwards, 1 - map(1 - y).
INSIDE, FROM_REST, FROM_HOLD = np.eye(3)
BACKWARDS = np.array([[1.0, 2.0, 3.0], [0.0, -1.0, -3.0], [0.0, 0.0, 1.0]])


class Basis(NamedTuple):
    """Polynomial basis of an element, from values at its nodes."""

    y: Array  # (p + 1,): the nodes, from 0 to 1
    to_powers: Array  # (p + 1, p + 1): coefficients of powers of y
    slopes: Array  # (p + 1, p + 1): derivatives over y at the nodes
    # (3, p, p + 1): rise of b between nodes, over the element's length, from s'', for each power of
    # y in the map
    links: Array
    weights: Array  # (p + 1,): of Lobatto's quadrature over y
    modes: Array  # (p + 1, p + 1): Legendre coefficients


@cache
def find_basis() -> Basis:
    """The basis of all elements."""
    x = np.concatenate([[-1.0], jacobi_nodes(DEGREE - 1, 1, 1), [1.0]])
    y, power = (x + 1) / 2, np.arange(1, 4)[:, None, None]
    to_powers = np.asarray(np.linalg.inv(y[:, None] ** POWERS), dtype=float)
    slopes = POWERS * y[:, None] ** np.maximum(POWERS - 1, 0) @ to_powers
    rises = np.diff(y[:, None] ** (POWERS + power), axis=1) * 2 * power / (POWERS + power)
    weights = (1 / (POWERS + 1)) @ to_powers
    modes = np.asarray(np.linalg.inv(legendre.legvander(x, DEGREE)), dtype=float)
    return Basis(y, to_powers, slopes, rises @ to_powers, weights, modes)


class Grid(NamedTuple):
    """Nodes on a curve."""

    s: Array  # (N + 1,) [m]: element by element, equal where two elements meet
    segment: Numbers  # (N + 1,): of the curve, for each node's forces
    maps: Array  # (E, 3): s over y in each element, over its length

    @property
    def held(self) -> bool:
        """Whether the motion starts and ends without acceleration."""
        return bool(self.maps[0, 2])

    @property
    def steps(self) -> Array:
        """Lengths of the intervals between nodes, shape (N,) [m]."""
        return np.diff(self.s)

    @property
    def nonempty(self) -> Numbers:
        """The intervals inside elements."""
        k = np.arange(len(self.s) - 1)
        return k[k % NODES < DEGREE]

    @property
    def edges(self) -> Array:
        """Start and stop of each element, shape (E, 2) [m]."""
        return self.s.reshape(-1, NODES)[:, [0, -1]]

    @property
    def sizes(self) -> Array:
        """Scale of b at the nodes over the largest, shape (N + 1,): 1 unless motions are `held`.

        Proportional to the distance from rest, and to y^4 in elements next to rest.
        """
        sizes = np.ones_like(self.s)
        if not self.held:
            return sizes
        for end, distance in ((0, self.s - self.s[0]), (-1, self.s[-1] - self.s)):
            first = np.diff(self.edges)[end, 0]
            b = np.where(distance < first, first * (distance / first) ** (4 / 3), distance)
            sizes = np.minimum(sizes, 2 * b / (self.s[-1] - self.s[0]))
        # The two ends are no unknowns.
        return np.pad(sizes[1:-1], 1, "edge")

    def shrink(self, distance: float) -> Array:
        """The nodes, those at the ends of elements moved inwards a little [m]."""
        s = self.s.copy().reshape(-1, NODES)
        s[:, 0] += distance
        s[:, -1] -= distance
        return s.ravel()

    def integrate(self, a: Array) -> Array:
        """B at the nodes for s'' there, from rest, shape (N + 1,)."""
        lengths, links = np.diff(self.edges), np.tensordot(self.maps, find_basis().links, 1)
        rises = lengths * (links @ a.reshape(-1, NODES, 1))[..., 0]
        return np.cumsum(np.hstack([np.zeros_like(lengths), rises]).ravel())


def lay_out(edges: Array, segment: Numbers, rests: tuple[bool, bool], held: bool = False) -> Grid:
    """The grid of elements with these edges, shape (E, 2) [m], on segments of shape (E,).

    `rests` is whether the motion starts and ends at rest, with `held` without acceleration.
    """
    bends = _find_bends(edges, rests) if held else np.zeros(len(edges))
    maps, y = list_maps(bends, rests, held), find_basis().y
    s = edges[:, :1] + np.diff(edges) * (maps @ [y, y**2, y**3])
    s[:, -1] = edges[:, 1]
    return Grid(s.ravel(), np.repeat(segment, NODES), maps)


def list_maps(bends: Array, rests: tuple[bool, bool] = (True, True), held: bool = False) -> Array:
    """Maps of elements with such bends amid a motion, shape (E, 3)."""
    start = FROM_HOLD if held else FROM_REST
    maps = INSIDE + bends[:, None] * (FROM_REST - INSIDE)
    if rests[0]:
        maps[0] = start
    if rests[1]:
        maps[-1] = BACKWARDS @ start
    return maps


def _find_bends(edges: Array, rests: tuple[bool, bool]) -> Array:
    """Bends of elements with these edges, each for the nearer one of the ends at rest."""
    length, bends = edges[-1, 1] - edges[0, 0], np.zeros(len(edges))
    first_half = edges.mean(axis=1) - edges[0, 0] < length / 2
    for sign, end, rows in ((1, 0, first_half), (-1, -1, ~first_half)):
        if rests[end]:
            # A ramp of s'' takes 4/3 of the distance of constant s'' to the same speed.
            distance = np.abs(edges[rows] - edges[end, end]) - np.diff(edges)[end, 0] / 4
            near, far = np.sqrt(np.maximum(distance, 0.0))[:, ::sign].T
            bends[rows] = sign * (far - near) / (far + near)
    return bends


class Profile(NamedTuple):
    """Motion at n places of a curve: a = s'' [m/s^2], b = s'^2 [m^2/s^2], internal force [N]."""

    a: Array
    b: Array
    lam: Array


def follow(grid: Grid, a: Array, lam: Array) -> Profile:
    """The motion with these s'' and internal forces, s'' corrected so that it ends at rest."""
    weight = np.ones_like(a)
    if grid.held:
        weight = np.cbrt(np.maximum(grid.s * (grid.s[-1] - grid.s), 0.0))
    a = a - grid.integrate(a)[-1] / grid.integrate(weight)[-1] * weight
    # At junctions with nearly no speed b may round to less than zero.
    b = np.maximum(grid.integrate(a), 0.0)
    b[-1] = 0.0
    return Profile(a, b, lam)


class Elements:
    """The polynomials of a profile at the nodes of a grid.

    Where a map grows flatter y is measured backwards: so b is exact to rounding next to rest.
    """

    def __init__(self, grid: Grid, profile: Profile) -> None:
        self.grid, basis, flipped = grid, find_basis(), grid.maps[:, 1] < 0
        column = flipped[:, None]
        self._maps = np.where(column, grid.maps @ BACKWARDS.T, grid.maps)
        self._y = np.where(column, 1 - basis.y, basis.y).ravel()
        self._parts = self.find_part(np.arange(len(grid.s)), self._y)
        self._starts = np.where(flipped, *grid.edges.T[::-1])
        self._lengths = np.where(flipped, -1.0, 1.0) * np.diff(grid.edges)[:, 0]
        table = np.stack([profile.a, profile.lam], axis=-1).reshape(len(flipped), NODES, 2)
        self._motion = basis.to_powers @ np.where(column[..., None], table[:, ::-1], table)
        # b' = 2 a, from where y is zero: for each power of the map one further power of y.
        count = 3 if grid.maps[:, 2].any() else 2
        self._b = np.zeros((len(flipped), NODES + count))
        self._b[:, 0] = np.where(flipped, *profile.b.reshape(-1, NODES)[:, [-1, 0]].T)
        a = 2 * self._lengths[:, None] * self._motion[..., 0]
        for power in range(1, count + 1):
            rises = power * self._maps[:, [power - 1]] * a / (POWERS + power)
            self._b[:, power : power + NODES] += rises

    def find_part(self, k: Numbers, y: Array) -> Array:
        """Part of the element before places y of intervals k."""
        slope, bend, cubic = self._maps[k // NODES].T
        return np.asarray(y * (slope + y * (bend + y * cubic)))

    def find_s(self, k: Numbers, y: Array) -> Array:
        """Places y of intervals k on the curves [m]."""
        element = k // NODES
        return np.asarray(self._starts[element] + self._lengths[element] * self.find_part(k, y))

    def find_stretch(self, k: Numbers, y: Array) -> Array:
        """Slope ds/dy at places y of intervals k [m]."""
        slope, bend, cubic = self._maps[k // NODES].T
        return np.asarray(self._lengths[k // NODES] * (slope + y * (2 * bend + 3 * y * cubic)))

    def find_y(self, k: Numbers, before: Array, after: Array) -> Array:
        """Local variable where parts of an interval, which add up to 1, are before and after."""
        part = np.maximum(after * self._parts[k] + before * self._parts[k + 1], 0.0)
        slope, bend, cubic = self._maps[k // NODES].T
        root = slope + np.sqrt(slope**2 + 4 * bend * part) + cubic
        y = 2 * part / np.maximum(root, np.finfo(float).tiny)
        return np.where(cubic > 0, np.cbrt(part), y) if cubic.any() else y

    def find_ramps(self, k: Numbers) -> tuple[Flags, Array, Array]:
        """Which of the intervals k are next to rest, y at their starts, and its rise there."""
        return self._maps[k // NODES, 0] == 0, self._y[k], self._y[k + 1] - self._y[k]

    def evaluate(self, k: Numbers, y: Array) -> tuple[Profile, Array]:
        """Profile and speed [m/s] at places y of intervals k."""
        element = k // NODES
        motion, b = self._motion[element, -1].T, self._b[element, -1]
        for power in reversed(range(DEGREE)):
            motion = motion * y + self._motion[element, power].T
        for power in reversed(range(self._b.shape[1] - 1)):
            b = b * y + self._b[element, power]
        speed = np.sqrt(np.maximum(b, 0.0))
        return Profile(motion[0], speed**2, motion[1]), speed

    def at(self, fractions: Array) -> Profile:
        """Profile at `fractions` of every interval inside elements, interval by interval."""
        k = np.repeat(self.grid.nonempty, len(fractions))
        x = np.tile(fractions, len(self.grid.nonempty))
        return self.evaluate(k, self.find_y(k, x, 1 - x))[0]

    def move(self, grid: Grid) -> Profile:
        """The profile at the nodes of another grid of the same curves."""
        source = self.grid
        # Of two nodes at one place, each belongs to the side of its element.
        gap = 1e-9 * (source.s[-1] - source.s[0])
        k = np.searchsorted(source.shrink(gap), grid.shrink(2 * gap), side="right") - 1
        k = np.minimum(k + (k % NODES == DEGREE), len(source.s) - 2)
        part = np.clip((grid.s - source.s[k]) / np.maximum(source.steps[k], 1e-300), 0.0, 1.0)
        return self.evaluate(k, self.find_y(k, part, 1 - part))[0]


_POINTS = 12  # Gauss points for the time in an interval between nodes
_STALLED = 100.0  # speed interpolated from an interval's ends over the one inside when it stalls
_TINY = 1e-100  # least speed [m/s] that is divided by


# Gauss points, and the matrix from values there to Legendre coefficients of the integral.
_GAUSS, _WEIGHTS = legendre.leggauss(_POINTS)
_MODES = legendre.legvander(_GAUSS, _POINTS - 1) * _WEIGHTS[:, None]
_INTEGRAL = legendre.legint(_MODES * ((2 * np.arange(_POINTS) + 1) / 2), lbnd=-1, axis=1)


@dataclass(frozen=True, eq=False)
class PathMotion:
    """A phase on a curve as a function of time; it satisfies the equations of motion exactly."""

    curve: Curve
    grid: Grid
    profile: Profile  # at the nodes

    @cached_property
    def elements(self) -> Elements:
        """The polynomials of the motion."""
        return Elements(self.grid, self.profile)

    @cached_property
    def times(self) -> Array:
        """When each node is passed, shape (N + 1,) [s]."""
        spans = np.zeros(len(self.grid.steps))
        spans[self.grid.nonempty] = self.durations(np.ones(1))[:, 0]
        return np.concatenate([[0.0], np.cumsum(spans)])

    @cached_property
    def _ends(self) -> tuple[Array, Array]:
        """Speeds at both ends of the intervals inside elements."""
        speed, k = np.sqrt(self.profile.b), self.grid.nonempty
        return speed[k], speed[k + 1]

    def _find_y(self, n: Numbers, w: Array) -> Array:
        """Local variable y at places w from 0 to 1, shape (m,), of n-th intervals inside elements.

        Amid a motion the speed at constant s'' is linear in w; next to rest y is.
        """
        k, (v0, v1) = self.grid.nonempty[n], (speed[n] for speed in self._ends)
        total = np.maximum(v0 + v1, _TINY)
        before = w * (v0 * (2 - w) + v1 * w) / total
        after = (1 - w) * (v1 * (1 + w) + v0 * (1 - w)) / total
        ramps, first, rise = self.elements.find_ramps(k)
        return np.where(ramps, first + w * rise, self.elements.find_y(k, before, after))

    @cached_property
    def _time_slopes(self) -> Array:
        """Slope of time over w and mean time, at Gauss points in each solid interval, (n, m)."""
        count = len(self.grid.nonempty)
        n, w = np.repeat(np.arange(count), _POINTS), np.tile((1 + _GAUSS) / 2, count)
        k, y, (v0, v1) = self.grid.nonempty[n], self._find_y(n, w), (v[n] for v in self._ends)
        ramps, _, rise = self.elements.find_ramps(k)
        linear = rise * self.elements.find_stretch(k, y) * (v0 + v1) / (2 * self.grid.steps[k])
        linear = np.where(ramps, linear, v0 * (1 - w) + v1 * w)
        speed = np.maximum(self.elements.evaluate(k, y)[1], np.maximum(linear / _STALLED, _TINY))
        return np.asarray((linear / speed).reshape(count, -1))

    @property
    def stalls(self) -> bool:
        """Whether the motion nearly stops between two nodes."""
        v0, v1 = self._ends
        return bool((v0 + v1 <= _TINY).any() or self._time_slopes.max() >= _STALLED)

    @cached_property
    def _time_series(self) -> Array:
        """Legendre coefficients in 2 w - 1 of the time since each interval's start, (n, m + 1)."""
        v0, v1 = self._ends
        mean = self.grid.steps[self.grid.nonempty] / np.maximum(v0 + v1, _TINY)
        return np.asarray(mean[:, None] * (self._time_slopes @ _INTEGRAL))

    def durations(self, fractions: Array) -> Array:
        """Time from the start of each interval inside elements to a fraction of it, (n, m) [s]."""
        v0, v1 = (speed[:, None] for speed in self._ends)
        speed = np.sqrt(v0**2 * (1 - fractions) + v1**2 * fractions)
        w = fractions * (v0 + v1) / np.maximum(v0 + speed, _TINY)
        k, part = np.repeat(self.grid.nonempty, len(fractions)), np.tile(fractions, len(w))
        ramps, first, rise = self.elements.find_ramps(k)
        linear = np.clip((self.elements.find_y(k, part, 1 - part) - first) / rise, 0.0, 1.0)
        w = np.where(ramps, linear, w.ravel()).reshape(w.shape)
        powers = legendre.legvander(2 * w - 1, _POINTS)
        return np.asarray(np.einsum("nmp,np->nm", powers, self._time_series))

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return float(self.times[-1])

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.curve.formation.names

    def locate(self, t: Array) -> tuple[Array, Numbers, Profile]:
        """Arc length [m], segment and profile at times `t`, each of shape (n,)."""
        nonempty = self.grid.nonempty
        n = np.clip(np.searchsorted(self.times[nonempty], t, side="right") - 1, 0, None)
        k = nonempty[n]
        local = np.clip(t, 0.0, self.duration) - self.times[k]
        w, series = local / (self.times[k + 1] - self.times[k]), self._time_series[n]
        slope = legendre.legder(series, axis=1)
        for _ in range(5):  # iterations from a time to a place
            x = 2 * w - 1
            residual = np.einsum("np,np->n", legendre.legvander(x, _POINTS), series) - local
            rate = 2 * np.einsum("np,np->n", legendre.legvander(x, _POINTS - 1), slope)
            w = np.clip(w - residual / rate, 0.0, 1.0)
        y = self._find_y(n, w)
        return self.elements.find_s(k, y), self.grid.segment[k], self.elements.evaluate(k, y)[0]

    @property
    def spans(self) -> list[tuple[float, float, Directions]]:
        """Start and end [s] of each part with the same sliding directions, and these."""
        k = self.grid.nonempty
        changes = np.flatnonzero(np.diff(self.grid.segment[k], prepend=-1))
        edges = [*self.times[k[changes]].tolist(), self.duration]
        parts = (self.curve.segments[j] for j in self.grid.segment[k[changes]])
        signs = (Directions(part.Xi, part.sigma) for part in parts)
        return list(zip(edges, edges[1:], signs, strict=False))

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        s, segment, (a, b, lam) = self.locate(np.asarray(t, dtype=float))
        point = self.curve.evaluate(s)
        directions = directions_of(self.curve, segment)
        formation = self.curve.formation
        forces = inverse(formation, point, directions)
        c_n, c_t = split_forces(formation, forces.c(a, b, lam), directions.Xi)
        acceleration = point.z_s * a[:, None] + point.z_ss * b[:, None]
        motion = point.z, point.z_s * np.sqrt(b)[:, None], acceleration
        return Samples(*motion, forces.tau(a, b, lam), c_n, c_t)
