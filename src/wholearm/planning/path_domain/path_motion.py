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
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre

from ...common.arrays import Array, Numbers, jacobi_nodes
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
    totals = powers + POWERS[:, None]
    rises = np.diff(y[..., None] ** totals[:, None], axis=1) / totals[:, None]
    rises *= 2 * (SIGNS * POWERS)[:, None, None]
    weights = (1 / (powers + 1)) @ to_powers[0]
    modes = np.asarray(np.linalg.inv(legendre.legvander(2 * x - 1, DEGREE)), dtype=float)
    return Basis(y, to_powers, rises @ to_powers, weights, modes)


class Grid(NamedTuple):
    """Nodes on a curve."""

    s: Array  # (N + 1,) [m]: element by element, equal where two elements meet
    segment: Numbers  # (N + 1,): of the curve, for each node's forces
    rests: tuple[bool, bool]  # whether the motion starts and ends at rest
    held: bool  # whether it does so without acceleration
    bends: Array  # (E,): c of the elements, zero but for the kind `INSIDE` of `held` motions

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
    def kinds(self) -> Numbers:
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

    def lean(self, by: float) -> Array:
        """The nodes, those at the ends of elements moved inwards a little [m]."""
        s = self.s.copy().reshape(-1, NODES)
        s[:, 0] += by
        s[:, -1] -= by
        return s.ravel()

    def integrate(self, a: Array) -> Array:
        """B at the nodes for s'' there, from rest, shape (N + 1,)."""
        lengths = np.diff(self.edges)
        table, links = a.reshape(-1, NODES, 1), find_basis().links
        bent = self.bends[:, None, None] * (links[FROM_REST] - links[INSIDE])
        rises = lengths * ((links[self.kinds] + bent) @ table)[..., 0]
        return np.cumsum(np.hstack([np.zeros_like(lengths), rises]).ravel())


def lay_out(edges: Array, segment: Numbers, rests: tuple[bool, bool], held: bool = False) -> Grid:
    """The grid of elements with these edges, shape (E, 2) [m], on segments of shape (E,)."""
    bends = np.zeros(len(edges))
    grid = Grid(np.repeat(edges[:, 0], NODES), np.repeat(segment, NODES), rests, held, bends)
    kinds = grid.kinds
    if held:
        bends = _find_bends(edges, rests) * (kinds == INSIDE)
    y, c = find_basis().y[kinds] ** POWERS[kinds, None], bends[:, None]
    share = np.where(SIGNS[kinds, None] > 0, (1 - c) * y + c * y**2, 1 - y)
    s = edges[:, :1] + share * np.diff(edges)
    s[:, -1] = edges[:, 1]
    return grid._replace(s=s.ravel(), bends=bends)


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
        self.grid, basis, kinds = grid, find_basis(), grid.kinds
        self._y, self._power = basis.y[kinds].ravel(), POWERS[kinds]
        table = np.stack([profile.a, profile.lam], axis=-1)
        self._motion = basis.to_powers[kinds] @ table.reshape(len(kinds), NODES, 2)
        a, powers = np.diff(grid.edges) * self._motion[..., 0], np.arange(NODES)
        # b over y^(2 power - 2); without acceleration at rest the first term would be rounding.
        power = self._power[:, None]
        rises = 2 * (power * SIGNS[kinds, None]) * a / (powers + power)
        first, none = profile.b.reshape(-1, NODES)[:, :1], np.zeros((len(kinds), 1))
        inside, rooted = np.hstack([first, rises]), np.hstack([rises, none])
        cubic = np.hstack([rises[:, 1:], none, none])
        self._b = np.where(power == 1, inside, np.where(power == 2, rooted, cubic))
        if grid.bends.any():
            c = grid.bends[:, None]
            self._b = np.hstack([self._b, none])
            self._b[:, 1:-1] *= 1 - c
            self._b[:, 2:] += 4 * c * a / (powers + 2)

    def find_y(self, k: Numbers, done: Array, left: Array) -> Array:
        """Local variable where parts of an interval, which add up to 1, are done and left."""
        power, c = self._power[k // NODES], self.grid.bends[k // NODES]
        y, later = self._y[k], self._y[k + 1]
        here = left * y + done * later
        for one in (2, 3):
            at = power == one
            part = left[at] * y[at] ** one + done[at] * later[at] ** one
            here[at] = np.maximum(part, 0.0) ** (1 / one)
        at = c != 0
        y, later, c = y[at], later[at], c[at]
        part = left[at] * ((1 - c) * y + c * y**2) + done[at] * ((1 - c) * later + c * later**2)
        root = np.sqrt(np.maximum((1 - c) ** 2 + 4 * c * part, 0.0))
        here[at] = 2 * part / np.maximum(1 - c + root, np.finfo(float).tiny)
        return here

    def find_ramps(self, k: Numbers) -> tuple[Any, Array, Array, Array]:
        """Which of the intervals k are next to rest, the power of y in s, y there and its rise."""
        rooted = np.flatnonzero(self._power[k // NODES] > 1)
        k = k[rooted]
        return rooted, self._power[k // NODES], self._y[k], self._y[k + 1] - self._y[k]

    def evaluate(self, k: Numbers, y: Array) -> tuple[Profile, Array]:
        """Profile and speed [m/s] at places y of intervals k."""
        element = k // NODES
        motion = self._motion[element, -1].T
        for power in reversed(range(DEGREE)):
            motion = motion * y + self._motion[element, power].T
        b = self._b[element, -1]
        for power in reversed(range(self._b.shape[1] - 1)):
            b = b * y + self._b[element, power]
        speed = np.sqrt(np.maximum(b, 0.0))
        for one in (2, 3):
            at = self._power[element] >= one
            speed[at] *= y[at]
        return Profile(motion[0], speed**2, motion[1]), speed

    def at(self, fractions: Array) -> Profile:
        """Profile at `fractions` of every interval inside elements, interval by interval."""
        k = np.repeat(self.grid.nonempty, len(fractions))
        x = np.tile(fractions, len(self.grid.nonempty))
        return self.evaluate(k, self.find_y(k, x, 1 - x))[0]

    def move(self, grid: Grid) -> Profile:
        """The profile at the nodes of another grid of the same curves."""
        old = self.grid
        # Of two nodes at one place, each belongs to the side of its element.
        hair = 1e-9 * (old.s[-1] - old.s[0])
        k = np.searchsorted(old.lean(hair), grid.lean(2 * hair), side="right") - 1
        k = np.minimum(k + (k % NODES == DEGREE), len(old.s) - 2)
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
        """Slope of time over w and the mean time, at Gauss points of each solid interval, (n, m).

        In the variable w from 0 to 1, amid a motion the speed at constant s'' is linear; next to
        rest y is.
        """
        k, (v0, v1) = self.grid.nonempty, (speed[:, None] for speed in self._ends)
        w = (1 + _GAUSS) / 2
        done, left = _share(v0, v1, w)
        every, plain = np.repeat(k, len(w)), v0 * (1 - w) + v1 * w
        y = self.elements.find_y(every, done.ravel(), left.ravel()).reshape(done.shape)
        rooted, *ramps = self.elements.find_ramps(k)
        power, first, rise = (part[:, None] for part in ramps)
        mean = self.grid.steps[k[rooted], None] / np.maximum(v0 + v1, _TINY)[rooted]
        length = np.diff(self.grid.edges)[k[rooted] // NODES]
        y[rooted] = first + w * rise
        plain[rooted] = power / 2 * np.abs(rise) * length * y[rooted] ** (power - 1) / mean
        speed = self.elements.evaluate(every, y.ravel())[1].reshape(done.shape)
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
        rooted, _, first, rise = self.elements.find_ramps(self.grid.nonempty)
        k = np.repeat(self.grid.nonempty[rooted], len(fractions))
        done = np.tile(fractions, len(rooted))
        y = self.elements.find_y(k, done, 1 - done).reshape(len(rooted), len(fractions))
        w[rooted] = np.clip((y - first[:, None]) / rise[:, None], 0.0, 1.0)
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

    def locate(self, t: Array) -> tuple[Array, Numbers, Profile]:
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
        rooted, power, first, rise = self.elements.find_ramps(k)
        y[rooted] = first + w[rooted] * rise
        whole = (first + rise) ** power - first**power
        done[rooted] = (y[rooted] ** power - first**power) / whole
        here, _ = self.elements.evaluate(k, y)
        return self.grid.s[k] + done * self.grid.steps[k], self.grid.segment[k], here

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
        forces = inverse(formation, *point[:3], directions, point.kinematics)
        c_n, c_t = split_forces(formation, forces.c(a, b, lam), directions.Xi)
        acceleration = point.z_s * a[:, None] + point.z_ss * b[:, None]
        motion = point.z, point.z_s * np.sqrt(b)[:, None], acceleration
        return Samples(*motion, forces.tau(a, b, lam), c_n, c_t)


def _share(v0: Array, v1: Array, w: Array) -> tuple[Array, Array]:
    """Parts of an interval done and left where the speed is v0 + w (v1 - v0) at constant s''."""
    total = np.maximum(v0 + v1, _TINY)
    done = w * (v0 * (2 - w) + v1 * w) / total
    return done, (1 - w) * (v1 * (1 + w) + v0 * (1 - w)) / total
