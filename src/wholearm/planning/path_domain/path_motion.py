"""Motion along a curve: elements with polynomials of s'' and internal force, and s(t).

An element has `NODES` nodes, the Lobatto points of a local variable y from 0 to 1. Inside a
motion s is linear in y. Next to rest s is quadratic in y, measured from the place of rest: the
speed, and viscous friction with it, is the root of s there, and smooth in y. Where torques may not
step, the motion starts and ends without acceleration and s is cubic in y. Elements after such a
start are bent: s is (1 - c) y + c y^2 of the length, with c such that the root of the distance from
a virtual start with acceleration is linear in y; c is negative before such an end. With b = s'^2
and b' = 2 s'' (dash: d/ds), b is a polynomial in y too.

Inside an element s(t) follows by Gauss quadrature of 1 / s'. z, tau and the contact forces follow
from s, s' and s'' by inverse dynamics: the equations of motion hold at every instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from ...common.arrays import Array, jacobi_nodes
from ...geometry.curve import Curve, directions_of
from ...mechanics.dynamics import Directions, inverse, split_forces
from ...results.trajectory import Samples

DEGREE = 4  # degree of the polynomials
NODES = DEGREE + 1  # of an element
# Kinds of elements: amid a motion, at its start and end, and there without acceleration.
INSIDE, FROM_REST, TO_REST, FROM_HOLD, TO_HOLD = range(5)
POWERS = np.array([1, 2, 2, 3, 3])  # power of y in s, of each kind
SIGNS = np.array([1.0, 1.0, -1.0, 1.0, -1.0])  # sign of dy/dt in each kind


class Basis(NamedTuple):
    """Polynomial basis of each kind of element, from values at its nodes."""

    y: Array  # (5, p + 1): the nodes, from 0 to 1; for `TO_REST` and `TO_HOLD` from 1 to 0
    to_powers: Array  # (5, p + 1, p + 1): coefficients of powers of y
    links: Array  # (5, p, p + 1): rise of b between nodes, over the element's length, from s''
    weights: Array  # (p + 1,): of Lobatto's quadrature over y
    modes: Array  # (p + 1, p + 1): Legendre coefficients in an element amid a motion


@cache
def find_basis() -> Basis:
    """The basis of all elements."""
    x = (np.concatenate([[-1.0], jacobi_nodes(DEGREE - 1, 1, 1), [1.0]]) + 1) / 2
    y = np.stack([x, x, 1 - x, x, 1 - x])
    powers = np.arange(DEGREE + 1)
    to_powers = np.asarray(np.linalg.inv(y[..., None] ** powers), dtype=float)
    plain = 2 * np.diff(y[0][:, None] ** (powers + 1), axis=0) / (powers + 1)
    rooted = 4 * np.diff(y[1:3, :, None] ** (powers + 2), axis=1) / (powers + 2)
    cubic = 6 * np.diff(y[3:, :, None] ** (powers + 3), axis=1) / (powers + 3)
    rises = np.stack([plain, rooted[0], -rooted[1], cubic[0], -cubic[1]])
    weights = (1 / (powers + 1)) @ to_powers[0]
    modes = np.asarray(np.linalg.inv(legendre.legvander(2 * x - 1, DEGREE)), dtype=float)
    return Basis(y, to_powers, rises @ to_powers, weights, modes)


class Grid(NamedTuple):
    """Nodes on a curve."""

    s: Array  # (N + 1,) [m]: element by element, equal where two elements meet
    segment: NDArray[np.int64]  # (N + 1,): of the curve, for each node's forces
    rests: tuple[bool, bool] = (True, True)  # whether the motion starts and ends at rest
    held: bool = False  # whether it does so without acceleration
    bends: Array | None = None  # (E,): c of the elements of the kind `INSIDE`; None for zeros

    @property
    def steps(self) -> Array:
        """Lengths of the intervals between nodes, shape (N,) [m]."""
        return np.diff(self.s)

    @property
    def nonempty(self) -> NDArray[np.int64]:
        """The intervals inside elements."""
        k = np.arange(len(self.s) - 1)
        return k[k % NODES < DEGREE]

    @property
    def edges(self) -> Array:
        """Start and stop of each element, shape (E, 2) [m]."""
        return self.s.reshape(-1, NODES)[:, [0, -1]]

    @property
    def kinds(self) -> NDArray[np.int64]:
        """Kind of each element, shape (E,)."""
        kinds = np.full(len(self.s) // NODES, INSIDE)
        ends = (FROM_HOLD, TO_HOLD) if self.held else (FROM_REST, TO_REST)
        for at in (0, -1):
            kinds[at] = ends[at] if self.rests[at] else kinds[at]
        return kinds

    @property
    def sizes(self) -> Array:
        """Scale of b at the nodes over the largest, shape (N + 1,): 1 unless motions are `held`.

        Proportional to the distance from rest, and to y^4 in elements next to rest.
        """
        sizes = np.ones_like(self.s)
        if not self.held:
            return sizes
        for rest, at, far in ((0, 0, self.s - self.s[0]), (1, -1, self.s[-1] - self.s)):
            if self.rests[rest]:
                first = np.diff(self.edges)[at, 0]
                b = np.where(far < first, first * (far / first) ** (4 / 3), far)
                sizes = np.minimum(sizes, 2 * b / (self.s[-1] - self.s[0]))
        # The two ends are no unknowns.
        return np.maximum(sizes, np.finfo(float).tiny)

    def interpolate(self, values: Array, other: Grid) -> Array:
        """Values at the nodes of another grid of the same curves, linear between those here."""
        # Of two nodes at one place, each belongs to the side of its element.
        hair = 1e-9 * (self.s[-1] - self.s[0])
        return np.interp(other._lean(2 * hair), self._lean(hair), values)

    def _lean(self, by: float) -> Array:
        """The nodes, those at the ends of elements moved inwards a little."""
        s = self.s.copy().reshape(-1, NODES)
        s[:, 0] += by
        s[:, -1] -= by
        return s.ravel()

    def integrate(self, a: Array) -> Array:
        """B at the nodes for s'' there, from rest, shape (N + 1,)."""
        lengths = np.diff(self.edges)
        table = a.reshape(-1, NODES, 1)
        links, kinds = find_basis().links, self.kinds
        rises = (links[kinds] @ table)[..., 0]
        if self.bends is not None:
            bends = (self.bends * (kinds == INSIDE))[:, None]
            rises += bends * ((links[FROM_REST] - links[INSIDE]) @ table)[..., 0]
        rises *= lengths
        return np.cumsum(np.hstack([np.zeros_like(lengths), rises]).ravel())


def lay_out(
    edges: Array, segment: NDArray[np.int64], rests: tuple[bool, bool], held: bool = False
) -> Grid:
    """The grid of elements with these edges, shape (E, 2) [m], on segments of shape (E,)."""
    grid = Grid(np.repeat(edges[:, 0], NODES), np.repeat(segment, NODES), rests, held)
    kinds, y = grid.kinds[:, None], find_basis().y[grid.kinds]
    share = y ** POWERS[kinds]
    share = np.where(SIGNS[kinds] > 0, share, 1 - share)
    if held:
        grid = grid._replace(bends=_find_bends(edges, rests))
        c = np.asarray(grid.bends)[:, None]
        share = np.where(kinds == INSIDE, (1 - c) * y + c * y**2, share)
    s = edges[:, :1] + share * np.diff(edges)
    s[:, -1] = edges[:, 1]
    return grid._replace(s=s.ravel())


def _find_bends(edges: Array, rests: tuple[bool, bool]) -> Array:
    """Bends of elements with these edges, each for the nearer one of the ends at rest."""
    length, bends = edges[-1, 1] - edges[0, 0], np.zeros(len(edges))
    early = edges.mean(axis=1) - edges[0, 0] < length / 2
    for sign, at, half in ((1, 0, early), (-1, -1, ~early)):
        if rests[at]:
            # A ramp of s'' takes 4/3 of the distance of constant s'' to the same speed.
            distance = np.abs(edges[half] - edges[at, at]) - np.diff(edges)[at, 0] / 4
            near, far = np.sqrt(np.maximum(distance, 0.0))[:, ::sign].T
            bends[half] = sign * (far - near) / (far + near)
    return bends


class Profile(NamedTuple):
    """Motion at n places of a curve: a = s'' [m/s^2], b = s'^2 [m^2/s^2], internal force [N]."""

    a: Array
    b: Array
    lam: Array


def follow(grid: Grid, a: Array, lam: Array) -> Profile:
    """The motion with these s'' and internal forces, s'' corrected so that it ends at rest."""
    spread = np.ones_like(a)
    if grid.held:
        spread = np.cbrt(np.maximum(grid.s * (grid.s[-1] - grid.s), 0.0))
    a = a - grid.integrate(a)[-1] / grid.integrate(spread)[-1] * spread
    # At junctions with nearly no speed b may round to less than zero.
    b = np.maximum(grid.integrate(a), 0.0)
    b[-1] = 0.0
    return Profile(a, b, lam)


class Elements:
    """The polynomials of a profile at the nodes of a grid."""

    def __init__(self, grid: Grid, profile: Profile) -> None:
        self.grid = grid
        basis, kinds = find_basis(), grid.kinds
        self._y = basis.y[kinds].ravel()
        self._rooted, self._power = kinds > 0, POWERS[kinds]
        table = np.stack([profile.a, profile.lam], axis=-1)
        table = table.reshape(len(kinds), NODES, 2)
        self._motion = basis.to_powers[kinds] @ table
        powers = np.arange(NODES)[:, None]
        a = np.diff(grid.edges)[:, :, None] * self._motion[..., :1]
        sign = SIGNS[kinds][:, None, None]
        first = profile.b.reshape(-1, NODES)[:, :1, None]
        plain = np.concatenate([first, 2 * a / (powers + 1)], axis=1)
        rooted = np.concatenate([4 * sign * a / (powers + 2), np.zeros_like(first)], axis=1)
        # A constant part of s'' in y would be rounding.
        later = 6 * sign * a[:, 1:] / (powers[:-1] + 4)
        cubic = np.concatenate([later, np.zeros_like(a[:, :2])], axis=1)
        rooted = np.where(self._power[:, None, None] == 3, cubic, rooted)
        b = np.where(self._rooted[:, None, None], rooted, plain)[..., 0]
        self._bends = None if grid.bends is None else grid.bends * (kinds == INSIDE)
        if self._bends is not None:
            c = self._bends[:, None]
            further = c * np.hstack([0 * first[..., 0], (4 * a / (powers + 2))[..., 0]])
            b[:, 1:] *= 1 - c
            b = np.hstack([b, np.zeros_like(c)])
            b[:, 1:] += further
        self._b = b

    @property
    def stretch(self) -> Array:
        """Slope ds/dy at the nodes over the element's length, (E, p + 1)."""
        y = self._y.reshape(-1, NODES)
        c = 0.0 if self._bends is None else self._bends[:, None]
        power = self._power[:, None]
        return np.asarray(power * y ** (power - 1) * (1 - c + 2 * c * y))

    def find_y(self, k: NDArray[np.int64], done: Array, left: Array) -> Array:
        """Local variable where parts of an interval, which add up to 1, are done and left."""
        element = k // NODES
        power = self._power[element]
        y, later = self._y[k], self._y[k + 1]
        squares = np.sqrt(np.maximum(left * y**2 + done * later**2, 0.0))
        here = np.where(power == 2, squares, left * y + done * later)
        if self._bends is not None:
            c = self._bends[element]
            part = left * ((1 - c) * y + c * y**2) + done * ((1 - c) * later + c * later**2)
            root = np.sqrt(np.maximum((1 - c) ** 2 + 4 * c * part, 0.0))
            bent = 2 * part / np.maximum(1 - c + root, np.finfo(float).tiny)
            here = np.where(c != 0, bent, here)
        if self.grid.held:
            here = np.where(power == 3, np.cbrt(left * y**3 + done * later**3), here)
        return here

    def find_cubic(self, k: NDArray[np.int64], w: Array) -> tuple[NDArray[np.bool_], Array, Array]:
        """Whether s is cubic in y in intervals k, y at a part w of its rise there, and the rise."""
        y, later = self._y[k], self._y[k + 1]
        return self._power[k // NODES] == 3, y + w * (later - y), later - y

    def evaluate(self, k: NDArray[np.int64], y: Array) -> tuple[Profile, Array]:
        """Profile and speed [m/s] at places y of intervals k."""
        element = k // NODES
        motion = self._motion[element, -1].T
        for power in reversed(range(DEGREE)):
            motion = motion * y + self._motion[element, power].T
        b = self._b[element, -1]
        for power in reversed(range(self._b.shape[1] - 1)):
            b = b * y + self._b[element, power]
        speed = np.sqrt(np.maximum(b, 0.0)) * np.where(self._rooted[element], y, 1.0)
        if self.grid.held:
            speed = speed * np.where(self._power[element] == 3, y, 1.0)
        return Profile(motion[0], speed**2, motion[1]), speed

    def at(self, fractions: Array) -> Profile:
        """Profile at `fractions` of every interval inside elements, interval by interval."""
        k = np.repeat(self.grid.nonempty, len(fractions))
        x = np.tile(fractions, len(self.grid.nonempty))
        return self.evaluate(k, self.find_y(k, x, 1 - x))[0]

    def move(self, grid: Grid) -> Profile:
        """The profile at the nodes of another grid of the same curves."""
        old = self.grid
        place = old.interpolate(np.arange(len(old.s), dtype=float), grid)
        k = np.clip(np.floor(place).astype(int), 0, len(old.s) - 2)
        k = np.where(k % NODES == DEGREE, k + 1, k)
        k = np.minimum(k, len(old.s) - 2)
        done = np.clip((grid.s - old.s[k]) / np.maximum(old.steps[k], 1e-300), 0.0, 1.0)
        return self.evaluate(k, self.find_y(k, done, 1 - done))[0]


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

    @cached_property
    def _slowness(self) -> Array:
        """Speed at constant s'' over the true one, at Gauss points of each solid interval, (n, m).

        Of the variable w from 0 to 1 in which the speed at constant s'' is linear.
        """
        k, (v0, v1) = self.grid.nonempty, (speed[:, None] for speed in self._ends)
        w = (1 + _GAUSS) / 2
        done, left = _share(v0, v1, w)
        every = np.repeat(k, len(w))
        y = self.elements.find_y(every, done.ravel(), left.ravel())
        plain = v0 * (1 - w) + v1 * w
        if self.grid.held:
            cubic, y_cubic, rise = self.elements.find_cubic(every, np.tile(w, len(k)))
            y = np.where(cubic, y_cubic, y)
            length = np.diff(self.grid.edges)[every // NODES, 0]
            mean = np.repeat(self.grid.steps[k] / np.maximum(v0 + v1, _TINY)[:, 0], len(w))
            slow = 1.5 * np.abs(rise) * length * y_cubic**2 / mean
            plain = np.where(cubic.reshape(done.shape), slow.reshape(done.shape), plain)
        speed = self.elements.evaluate(every, y)[1].reshape(done.shape)
        return np.asarray(plain / np.maximum(speed, np.maximum(plain / _STALLED, _TINY)))

    @property
    def stalls(self) -> bool:
        """Whether the motion nearly stops between two nodes."""
        v0, v1 = self._ends
        return bool((v0 + v1 <= _TINY).any() or self._slowness.max() >= _STALLED)

    @cached_property
    def _clock(self) -> Array:
        """Legendre coefficients in 2 w - 1 of the time since each interval's start, (n, m + 1)."""
        v0, v1 = self._ends
        mean = self.grid.steps[self.grid.nonempty] / np.maximum(v0 + v1, _TINY)
        return np.asarray(mean[:, None] * (self._slowness @ _INTEGRAL))

    def durations(self, fractions: Array) -> Array:
        """Time from the start of each interval inside elements to a fraction of it, (n, m) [s]."""
        v0, v1 = (speed[:, None] for speed in self._ends)
        here = np.sqrt(v0**2 * (1 - fractions) + v1**2 * fractions)
        w = fractions * (v0 + v1) / np.maximum(v0 + here, _TINY)
        if self.grid.held:
            # Where s is cubic in y, w is the part of y's rise.
            k = np.repeat(self.grid.nonempty, len(fractions))
            done = np.tile(fractions, len(w))
            cubic, start, rise = self.elements.find_cubic(k, np.zeros(len(k)))
            share = np.clip((self.elements.find_y(k, done, 1 - done) - start) / rise, 0.0, 1.0)
            w = np.where(cubic, share, w.ravel()).reshape(w.shape)
        powers = legendre.legvander(2 * w - 1, _POINTS)
        return np.asarray(np.einsum("nmp,np->nm", powers, self._clock))

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return float(self.times[-1])

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.curve.formation.names

    def locate(self, t: Array) -> tuple[Array, NDArray[np.int64], Profile]:
        """Arc length [m], segment and profile at times `t`, each of shape (n,)."""
        nonempty = self.grid.nonempty
        n = np.clip(np.searchsorted(self.times[nonempty], t, side="right") - 1, 0, None)
        k = nonempty[n]
        local = np.clip(t, 0.0, self.duration) - self.times[k]
        w, clock = local / (self.times[k + 1] - self.times[k]), self._clock[n]
        slope = legendre.legder(clock, axis=1)
        for _ in range(5):  # iterations from a time to a place
            x = 2 * w - 1
            late = np.einsum("np,np->n", legendre.legvander(x, _POINTS), clock) - local
            rate = 2 * np.einsum("np,np->n", legendre.legvander(x, _POINTS - 1), slope)
            w = np.clip(w - late / rate, 0.0, 1.0)
        v0, v1 = (speed[n] for speed in self._ends)
        done, left = _share(v0, v1, w)
        y = self.elements.find_y(k, done, left)
        if self.grid.held:
            cubic, y_cubic, rise = self.elements.find_cubic(k, w)
            start = y_cubic - w * rise
            part = (y_cubic**3 - start**3) / ((start + rise) ** 3 - start**3)
            done, y = np.where(cubic, part, done), np.where(cubic, y_cubic, y)
        here, _ = self.elements.evaluate(k, y)
        return self.grid.s[k] + done * self.grid.steps[k], self.grid.segment[k], here

    @property
    def spans(self) -> list[tuple[float, float, Directions]]:
        """Start and end [s] of each part with the same sliding directions, and these."""
        k = self.grid.nonempty
        changes = np.flatnonzero(np.diff(self.grid.segment[k], prepend=-1))
        edges = [*self.times[k[changes]].tolist(), self.duration]
        segments = self.grid.segment[k[changes]]
        signs = (
            Directions(*(part[0] for part in directions_of(self.curve, segments[j : j + 1])))
            for j in range(len(segments))
        )
        return list(zip(edges, edges[1:], signs, strict=False))

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        s, segment, (a, b, lam) = self.locate(np.asarray(t, dtype=float))
        point = self.curve.evaluate(s)
        directions = directions_of(self.curve, segment)
        formation = self.curve.formation
        forces = inverse(formation, *point[:3], directions, point.kinematics)
        c_n, c_t = split_forces(formation, forces.c(a, b, lam), directions.Xi)
        return Samples(
            point.z,
            point.z_s * np.sqrt(b)[:, None],
            point.z_s * a[:, None] + point.z_ss * b[:, None],
            forces.tau(a, b, lam),
            c_n,
            c_t,
        )


def _share(v0: Array, v1: Array, w: Array) -> tuple[Array, Array]:
    """Parts of an interval done and left where the speed is v0 + w (v1 - v0) at constant s''."""
    total = np.maximum(v0 + v1, _TINY)
    done = w * (v0 * (2 - w) + v1 * w) / total
    return done, (1 - w) * (v1 * (1 + w) + v0 * (1 - w)) / total
