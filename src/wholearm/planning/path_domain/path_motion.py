"""Motion along a curve as a function of time, from the profile at the nodes of a grid.

Inside an element a = s'' and the internal force are polynomials, and so is b = s'^2; s(t) follows
by Gauss quadrature of 1 / s'. z, tau and the contact forces follow from s, s' and s'' by inverse
dynamics: the equations of motion hold at every instant. Torques as a function of time are
piecewise polynomials through those (`fit_torque`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray

from ...common.arrays import Array
from ...common.errors import SolverError
from ...geometry.curve import Curve, directions_of
from ...mechanics.dynamics import Directions, inverse, split_forces
from ...results.torque import TorqueProfile
from ...results.trajectory import Samples
from .elements import NODES, Elements, Grid, Profile
from .path_data import PhaseData, Places

_POINTS = 12  # Gauss points for the time in an interval between nodes
_STALLED = 100.0  # speed interpolated from an interval's ends over the one inside when it stalls
_TINY = 1e-100  # least speed [m/s] that is divided by
PLACES = 13  # interpolation points where that is exceeded
LOOKS = 21  # samples of torque rates in each interval


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
        s = self.grid.s[k] + done * self.grid.steps[k]
        return s, self.grid.segment[k], here

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


def fit_torque(data: PhaseData, motion: PathMotion) -> tuple[TorqueProfile, float]:
    """Torque of a motion, one polynomial in time per interval, and its effort [(N m)^2 s].

    Through the knots, or through `PLACES` points if that misses the torque between them.
    """
    knots, checks = data.sampling
    torque = _fit(data, motion, data.knots, knots)
    times = motion.times[data.grid.nonempty, None] + motion.durations(checks)
    wanted = data.checks.forces.tau(*data.interpolate(motion.profile, checks))
    inner = np.tile((checks > 0) & (checks < 1), len(data.grid.nonempty))
    misfit = torque.at(times.ravel()[inner]) - wanted[inner]
    if np.abs(misfit / data.torque_limit).max() > 5e-7:  # largest relative error
        every = (len(checks) - 1) // (PLACES - 1)
        rows = np.tile(np.arange(len(checks)) % every == 0, len(data.grid.nonempty))
        torque = _fit(data, motion, data.checks.pick(rows), checks[::every])
    return torque, torque.integrate_squares()


def _fit(data: PhaseData, motion: PathMotion, places: Places, fractions: Array) -> TorqueProfile:
    """Polynomials through the torques at `fractions` of every solid interval."""
    k = data.grid.nonempty
    values = places.forces.tau(*data.interpolate(motion.profile, fractions))
    spans = motion.durations(fractions)
    if motion.stalls or not (np.diff(spans, axis=1) > 0).all():
        raise SolverError("the motion all but stops between two nodes; plan with more intervals")
    x = 2 * spans / spans[:, -1:] - 1
    vandermonde = x[..., None] ** np.arange(len(fractions))
    coefficients = np.linalg.solve(vandermonde, values.reshape(len(k), len(fractions), 2))
    breaks = np.append(motion.times[k], motion.times[-1])
    return TorqueProfile(breaks, np.asarray(coefficients.transpose(0, 2, 1), dtype=float))


def find_torques(
    data: PhaseData, profile: Profile, motions: Sequence[PathMotion]
) -> tuple[Array, Array]:
    """Torques and their rates, (n_solid, LOOKS, 2) [N m, N m/s], at evenly spaced times.

    By Chebyshev interpolation in time through torques within each interval.
    """
    checks = data.sampling.checks
    every = (len(checks) - 1) // (PLACES - 1)
    picked = np.arange(len(checks)) % every == 0
    fractions, count = checks[picked], len(data.grid.nonempty)
    places = data.checks.pick(np.tile(picked, count))
    values = places.forces.tau(*data.interpolate(profile, fractions)).reshape(count, -1, 2)
    spans = np.concatenate([motion.durations(fractions) for motion in motions])
    degree, lasts = len(fractions) - 1, np.maximum(spans[:, -1], np.finfo(float).tiny)
    through = chebyshev.chebvander(2 * spans / lasts[:, None] - 1, degree)
    # Where two places fall on one instant no polynomial goes through both.
    modes = np.linalg.solve(through + 1e-300, values)
    looks = np.linspace(-1, 1, LOOKS)
    slopes = chebyshev.chebder(np.eye(degree + 1), axis=0)
    torques = chebyshev.chebvander(looks, degree) @ modes
    rates = chebyshev.chebvander(looks, degree - 1) @ slopes @ modes
    return np.asarray(torques), np.asarray(rates * (2 / lasts)[:, None, None])
