"""Motions known by samples: quintic in time for z, linear for torques and forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array, sort_unique
from .trajectory import Samples


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """A phase known by its samples: quintic in time for z, linear for tau and forces."""

    t: Array
    contacts: tuple[str, ...]
    samples: Samples

    @property
    def duration(self) -> float:
        """How long the phase lasts [s]."""
        return float(self.t[-1] - self.t[0])

    def evaluate(self, t: Array) -> Samples:
        """Samples at times `t` from the start of the phase, shape (n,) [s]."""
        grid, known = self.t - self.t[0], self.samples
        k = np.clip(np.searchsorted(grid, t, side="right") - 1, 0, len(grid) - 2)
        h, run = grid[k + 1] - grid[k], np.asarray(t) - grid[k]
        z, z_dot, z_ddot = interpolate_quintic(h, run, known[:3], k)
        x = (run / h)[:, None]
        forces = [(1 - x) * f[k] + x * f[k + 1] for f in (known.tau, known.c_n, known.c_t)]
        return Samples(z, z_dot, z_ddot, *forces)


def interpolate_quintic(
    h: Array, run: Array, knots: Sequence[Array], left: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Quintic through z, z' and z'' at two knots, with its first two derivatives.

    Parameters
    ----------
    h, run : (n,) [s]  time between the two knots, and since the first of them
    knots : (m, 5)     z, z' and z'' at all knots
    left : (n,)        the first of the two knots
    """
    h, x = h[:, None], (run / h)[:, None]
    z, v, a = knots
    z0, v0, a0 = z[left], h * v[left], h**2 * a[left]
    rise = z[left + 1] - z0 - v0 - a0 / 2
    speed = h * v[left + 1] - v0 - a0
    bend = h**2 * a[left + 1] - a0
    c3 = 10 * rise - 4 * speed + bend / 2
    c4 = -15 * rise + 7 * speed - bend
    c5 = 6 * rise - 3 * speed + bend / 2
    return (
        z0 + x * (v0 + x * (a0 / 2 + x * (c3 + x * (c4 + x * c5)))),
        (v0 + x * (a0 + x * (3 * c3 + x * (4 * c4 + x * 5 * c5)))) / h,
        (a0 + x * (6 * c3 + x * (12 * c4 + x * 20 * c5))) / h**2,
    )


def sample_phases(
    arrays: Mapping[str, Any], contacts: tuple[str, ...]
) -> tuple[SampledMotion, ...]:
    """The motion of each phase, from the arrays of a trajectory by name."""
    return tuple(_sample(arrays, contacts, index) for index in sort_unique(arrays["phase"]))


def _sample(arrays: Mapping[str, Any], contacts: tuple[str, ...], index: float) -> SampledMotion:
    rows = arrays["phase"] == index
    held = ~np.isnan(arrays["c_n"][rows]).all(axis=0)
    parts = {name: array[rows] for name, array in arrays.items()}
    samples = Samples(
        np.hstack([parts["q"], parts["theta"]]),
        np.hstack([parts["q_dot"], parts["theta_dot"]]),
        np.hstack([parts["q_ddot"], parts["theta_ddot"]]),
        parts["tau"],
        parts["c_n"][:, held],
        parts["c_t"][:, held],
    )
    names = tuple(name for name, here in zip(contacts, held, strict=True) if here)
    return SampledMotion(parts["t"], names, samples)
