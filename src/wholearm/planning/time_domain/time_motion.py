"""Motion of a phase in the time domain as a function of time, integrated from its torques."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.elemental import Contact
from ...contacts.formation import Formation
from ...mechanics.dynamics import Directions, forward, metric_weights, solve_min_norm, split_forces
from ...results.torque import TorqueProfile
from ...results.trajectory import ROLLS, ModeSpan, Samples
from .stage import Scheme, Stage, StagePoints, bernstein

_NODES = 8  # nodes per interval at which the equations of motion are solved


class MotionResponse(NamedTuple):
    """State and limited quantities at n instants, and derivatives of y and z'' by the torques."""

    z: Array  # z, v (n, 5)
    v: Array
    y: Array  # (n, m): limited quantities (c, tau, theta'), affine in the torques like z''
    y_by_torque: Array  # (n, m, 2)
    a_by_torque: Array  # (n, 5, 2)


@dataclass(frozen=True, eq=False)
class StageMotion:
    """One stage as a function of time.

    tau is a polynomial in each interval. z is integrated from it and projected onto the contacts,
    z' is its derivative; z'' and the forces follow by forward dynamics. The equations of motion and
    the contacts hold at any instant.
    """

    formation: Formation
    directions: Directions
    scheme: Scheme
    points: StagePoints
    slip: Array  # (R,) [m]: slip coordinates of the rolling contacts

    @property
    def duration(self) -> float:
        """Duration of the stage [s]."""
        return self.points.duration

    @property
    def breaks(self) -> Array:
        """Start times of the intervals and end of the last [s]."""
        return self.duration * self.points.breaks

    @cached_property
    def torque(self) -> TorqueProfile:
        """Torque over the time from the start of the stage, a polynomial in each interval."""
        controls = self.points.tau.shape[1]
        grid = np.linspace(0.0, 1.0, controls)
        values = bernstein(grid, controls) @ self.points.tau
        return TorqueProfile(self.breaks, _fit(2 * grid - 1, values))

    @property
    def defects(self) -> Array:
        """Collocation error of z and z' at the end of each interval, shape (K, 2, 5)."""
        return self._integrated[1]

    @cached_property
    def _integrated(self) -> tuple[Array, Array]:
        """Power series of z in x from -1 to 1 over each interval, (K, 5, n), and the defects.

        By Picard iteration: accelerations are integrated twice and replaced by forward dynamics.
        Where it diverges, as B h / J is large, the iterate of least residual counts. The defect at
        the end is distributed over the interval.
        """
        nodes, half = self.points.nodes, np.diff(self.breaks)[:, None, None] / 2
        z, v = nodes[:, 0], nodes[:, 1]
        x = -np.cos(np.pi * np.arange(_NODES) / (_NODES - 1))
        powers = x[:, None] ** np.arange(_NODES + 2)
        torque = self.torque.coefficients
        tau = np.einsum("kjd,nd->knj", torque, powers[:, : torque.shape[2]])
        count = len(half)
        a = np.zeros((count, 5, _NODES))
        a[..., : len(self.scheme.points)] = _fit(2 * self.scheme.points - 1, self.points.a)
        weights = np.sqrt(metric_weights(self.formation.scene))[:, None]
        best, best_residual = a, np.full((count, 1, 1), np.inf)
        for _ in range(6):  # Picard iterations, each of which gains one to two digits
            velocity = _integrate(a, half, v[:-1])
            position = _integrate(velocity, half, z[:-1])
            positions, rates = (
                np.einsum("kjd,nd->knj", part, powers[:, : part.shape[2]]).reshape(-1, 5)
                for part in (position, velocity)
            )
            terms = self.formation.evaluate(positions, rates)
            z_ddot, _ = forward(self.formation, terms, rates, tau.reshape(-1, 2), self.directions)
            accelerations = _fit(x, z_ddot.reshape(count, _NODES, 5))
            residual = np.abs(weights * (accelerations - a)).max(axis=(1, 2), keepdims=True)
            improved = residual < best_residual
            best, best_residual = np.where(improved, a, best), np.where(improved, residual, 0.0)
            a = np.where(improved, accelerations, best)
        velocity = _integrate(a, half, v[:-1])
        position = _integrate(velocity, half, z[:-1])
        jump = (z[1:] - position.sum(axis=2))[..., None], (v[1:] - velocity.sum(axis=2))[..., None]
        position[..., :4] += jump[0] * [0.5, 0.75, 0.0, -0.25]
        position[..., :4] += half * jump[1] * [-0.25, -0.25, 0.25, 0.25]
        return position, np.concatenate(jump, axis=2).transpose(0, 2, 1)

    def _interpolate(self, t: Array) -> tuple[Array, Array]:
        """Position z and velocity z' at times `t`, (n,), by the polynomials of the intervals."""
        breaks = self.breaks
        piece = np.clip(np.searchsorted(breaks, t, side="right") - 1, 0, len(breaks) - 2)
        half = np.diff(breaks)[piece] / 2
        x = (t - breaks[piece]) / half - 1
        polynomials = self._integrated[0][piece]
        derivatives = np.polynomial.polynomial.polyder(polynomials, axis=2) / half[:, None, None]
        powers = x[:, None] ** np.arange(polynomials.shape[2])
        z = np.einsum("njd,nd->nj", polynomials, powers)
        return z, np.einsum("njd,nd->nj", derivatives, powers[:, :-1])

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the stage, shape (n,) [s]."""
        formation = self.formation
        z, v = self._interpolate(t)
        metric = metric_weights(formation.scene)
        for _ in range(3):
            kinematics = formation.evaluate(z, v)
            gaps = np.hstack([kinematics.C, formation.evaluate_slip(z) - self.slip])
            z = z - solve_min_norm(kinematics.P, gaps, metric)
        kinematics = formation.evaluate(z, v)
        v = v - solve_min_norm(kinematics.P, np.einsum("nij,nj->ni", kinematics.P, v), metric)
        tau = self.torque.at(t)
        a, c = forward(formation, formation.evaluate(z, v), v, tau, self.directions)
        return Samples(z, v, a, tau, *split_forces(formation, c, self.directions.Xi))

    def respond(self, t: Array) -> MotionResponse:
        """State and limited quantities at times `t`, (n,), with derivatives by the torques."""
        samples, formation = self.evaluate(t), self.formation
        kinematics = formation.evaluate(samples.z, samples.z_dot)
        responses = [
            forward(formation, kinematics, samples.z_dot, samples.tau + step, self.directions)
            for step in (np.zeros(2), *np.eye(2))
        ]
        a, c = (np.stack(parts, axis=-1) for parts in zip(*responses, strict=True))
        y = np.hstack([c[..., 0], samples.tau, samples.z_dot[:, 3:]])
        y_by_torque = np.zeros((*y.shape, 2))
        y_by_torque[:, : c.shape[1]] = c[..., 1:] - c[..., :1]
        y_by_torque[:, c.shape[1] : -2] = np.eye(2)
        return MotionResponse(samples.z, samples.z_dot, y, y_by_torque, a[..., 1:] - a[..., :1])


def _fit(x: Array, values: Array) -> Array:
    """Power series, (K, 5, n), of polynomials through values, (K, n, 5), at `x`, (n,)."""
    inverse = np.linalg.inv(x[:, None] ** np.arange(len(x)))
    return np.asarray(np.einsum("dn,knj->kjd", inverse, values))


def _integrate(powers: Array, scale: Array, start: Array) -> Array:
    """`start`, (K, 5), plus `scale` times the integral from x = -1 of polynomials, (K, 5, n)."""
    integral = scale * np.polynomial.polynomial.polyint(powers, lbnd=-1, axis=2)
    integral[..., 0] += start
    return np.asarray(integral)


@dataclass(frozen=True, eq=False)
class TimeMotion:
    """A phase of one or more stages as a function of time."""

    stages: Sequence[StageMotion]

    @property
    def duration(self) -> float:
        """Duration of the phase [s]."""
        return float(self.starts[-1])

    @cached_property
    def starts(self) -> Array:
        """Start times of the stages and end of the last [s]."""
        return np.concatenate([[0.0], np.cumsum([stage.duration for stage in self.stages])])

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.stages[0].formation.names

    @property
    def torque(self) -> TorqueProfile:
        """Torque over the time from the start of the phase."""
        return TorqueProfile.chain([stage.torque for stage in self.stages])

    @property
    def modes(self) -> tuple[ModeSpan, ...]:
        """Contact modes of the stages with their times in the phase."""
        spans = []
        for stage, start in zip(self.stages, self.starts[:-1].tolist(), strict=True):
            signs = ["+" if sign > 0 else "-" for sign in np.concatenate(stage.directions)]
            rolls = {contact.name: ROLLS for contact in stage.formation.rolling}
            contacts = dict(zip(stage.formation.names, signs, strict=False)) | rolls
            spans.append(ModeSpan(start, start + stage.duration, contacts, tuple(signs[-2:])))
        return tuple(spans)

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        t = np.asarray(t, dtype=float)
        owner = np.searchsorted(self.starts[1:-1], t, side="right")
        parts = [
            self.stages[k].evaluate(t[owner == k] - self.starts[k])
            for k in sorted({*owner.tolist()})
        ]
        inverse = np.argsort(np.argsort(owner, kind="stable"))
        return Samples(*(np.concatenate(tables)[inverse] for tables in zip(*parts, strict=True)))


def make_phase_motions(stages: Sequence[Stage], scheme: Scheme) -> list[TimeMotion]:
    """The motion of each phase from the stages' guesses."""
    pairs = zip(stages, make_motions(stages, scheme), strict=True)
    groups = groupby(pairs, key=lambda pair: pair[0].phase)
    return [TimeMotion([motion for _, motion in group]) for _, group in groups]


def make_motions(stages: Sequence[Stage], scheme: Scheme) -> list[StageMotion]:
    """The stages' guesses as functions of time."""
    motions: list[StageMotion] = []
    slips: dict[Contact, float] = {}
    phase = -1
    for stage in stages:
        formation = stage.formation
        slip = formation.evaluate_slip(stage.guess.nodes[0, :1])[0]
        rolling = [formation.contacts[row] for row in formation.rolling_rows]
        # Contacts that rolled in the previous stage of this phase keep their coordinate.
        previous = slips if stage.phase == phase else {}
        slips = {c: previous.get(c, s) for c, s in zip(rolling, slip.tolist(), strict=True)}
        slip, phase = np.array([slips[c] for c in rolling]), stage.phase
        motions.append(StageMotion(formation, stage.directions, scheme, stage.guess, slip))
    return motions
