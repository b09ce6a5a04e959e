"""Motion of a phase planned in the time domain, at any instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from .batch import Batch
from .collocation import Scheme
from .curve import metric_weights
from .dynamics import Directions, build_forward
from .formation import Formation
from .model import Array
from .timenlp import StagePoints
from .torque import TorqueProfile
from .trajectory import Samples, interpolate_quintic


class Start(NamedTuple):
    """State at the start of a stage: z and z', each of shape (5,)."""

    z: Array
    v: Array


@dataclass(frozen=True, eq=False)
class StageMotion:
    """One stage as a function of time.

    z is the quintic through z, z' and z'' of neighbouring points, pulled onto the contacts, and z'
    its derivative; tau is the polynomial through an interval's points, and z'' and c_n follow by
    forward dynamics. So the equations of motion and the contacts hold at any instant.

    Attributes
    ----------
    formation : Formation
    directions : Directions
    scheme : Scheme
    start : Start
    points : StagePoints
    """

    formation: Formation
    directions: Directions
    scheme: Scheme
    start: Start
    points: StagePoints

    @property
    def duration(self) -> float:
        """How long the stage lasts [s]."""
        return self.points.duration

    @property
    def intervals(self) -> int:
        """Number of intervals."""
        return len(self.points.z) // self.scheme.degree

    @cached_property
    def torque(self) -> TorqueProfile:
        """Torque from the start of the stage, one polynomial per interval."""
        breaks = np.linspace(0.0, self.duration, self.intervals + 1)
        values = self.points.tau.reshape(self.intervals, self.scheme.degree, 2)
        x = 2 * self.scheme.points - 1
        invert = np.linalg.inv(x[:, None] ** np.arange(self.scheme.degree))
        return TorqueProfile(breaks, np.einsum("dm,kmj->kjd", invert, values))

    @cached_property
    def _forward(self) -> Batch:
        return Batch(build_forward(self.formation))

    @cached_property
    def _knots(self) -> tuple[Array, Array, Array, Array]:
        """Times, z, z' and z'' at the start and the points of every interval, one after another.

        The torque may step where two intervals meet, so the start of each has its own z''.
        """
        count, degree = self.intervals, self.scheme.degree

        def begin_with(first: Array, values: Array) -> Array:
            blocks = values.reshape(count, degree, 5)
            ends = np.concatenate([first[None], blocks[:-1, -1]])[:, None]
            return np.concatenate([ends, blocks], axis=1)

        z, v = begin_with(self.start.z, self.points.z), begin_with(self.start.v, self.points.v)
        signs = (np.broadcast_to(part, (count, len(part))) for part in self.directions)
        tau = self.torque.at(self.torque.breaks[:-1])
        first = self._forward(z[:, 0], v[:, 0], tau, *signs)[0][..., 0]
        a = np.concatenate([first[:, None], self.points.a.reshape(count, degree, 5)], axis=1)
        places = np.arange(count)[:, None] + np.append(0.0, self.scheme.points)
        t = places * self.duration / count
        return t.ravel(), z.reshape(-1, 5), v.reshape(-1, 5), a.reshape(-1, 5)

    def _interpolate(self, t: Array) -> tuple[Array, Array]:
        """Z and z' by quintics between knots."""
        grid, z, v, a = self._knots
        left = np.searchsorted(grid, t, side="right") - 1
        left = np.clip(left, 0, len(grid) - 2)
        # The end of one interval and the start of the next are one instant.
        left -= grid[left + 1] == grid[left]
        h = grid[left + 1] - grid[left]
        state = interpolate_quintic(h, t - grid[left], (z, v, a), left)
        return state[0], state[1]

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the stage, shape (n,) [s]."""
        formation = self.formation
        z, v = self._interpolate(t)
        metric = metric_weights(formation.scene)
        for _ in range(3):
            kinematics = formation.evaluate(z, v)
            z = z - _lift(kinematics.A, metric, kinematics.C)
        kinematics = formation.evaluate(z, v)
        v = v - _lift(kinematics.A, metric, np.einsum("nij,nj->ni", kinematics.A, v))
        tau = self.torque.at(t)
        Xi, sigma = (np.broadcast_to(part, (len(t), len(part))) for part in self.directions)
        a, c_n, _ = self._forward(z, v, tau, Xi, sigma)
        c_t = -formation.friction * self.directions.Xi * c_n[..., 0]
        return Samples(z, v, a[..., 0], tau, c_n[..., 0], c_t)


def _lift(A: Array, metric: Array, residual: Array) -> Array:
    """Shortest changes of z, shape (n, 5), that change the gaps by `residual`, shape (n, n_c)."""
    spread = (A / metric).transpose(0, 2, 1)
    return np.asarray((spread @ np.linalg.solve(A @ spread, residual[..., None]))[..., 0])


@dataclass(frozen=True, eq=False)
class TimeMotion:
    """A phase of one or more stages as a function of time."""

    stages: Sequence[StageMotion]

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return float(self.starts[-1])

    @cached_property
    def starts(self) -> Array:
        """When each stage starts, and when the last one ends [s]."""
        return np.concatenate([[0.0], np.cumsum([stage.duration for stage in self.stages])])

    @property
    def contacts(self) -> tuple[str, ...]:
        """Names of the phase's contacts."""
        return self.stages[0].formation.names

    @property
    def torque(self) -> TorqueProfile:
        """Torque from the start of the phase."""
        breaks = [np.zeros(1)]
        for stage, start in zip(self.stages, self.starts[:-1], strict=True):
            breaks.append(start + stage.torque.breaks[1:])
        coefficients = np.concatenate([stage.torque.coefficients for stage in self.stages])
        return TorqueProfile(np.concatenate(breaks), coefficients)

    @property
    def end(self) -> Start:
        """State at the end of the phase."""
        last = self.stages[-1].points
        return Start(last.z[-1], last.v[-1])

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        t = np.asarray(t, dtype=float)
        owner = np.clip(np.searchsorted(self.starts, t, side="right") - 1, 0, len(self.stages) - 1)
        tables: list[Array] = []
        for index, stage in enumerate(self.stages):
            mine = owner == index
            if not mine.any():
                continue
            part = stage.evaluate(t[mine] - self.starts[index])
            if not tables:
                tables = [np.empty((len(t), table.shape[1])) for table in part]
            for table, values in zip(tables, part, strict=True):
                table[mine] = values
        return Samples(*tables)
