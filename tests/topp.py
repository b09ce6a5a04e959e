"""Least time along a curve by dynamic programming over the phase plane, in plain NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve
from wholearm.mechanics.dynamics import PathForces, inverse
from wholearm.planning.path_domain.motion import directions_of


def _look(curve: Curve, steps: int) -> tuple[Array, PathForces]:
    """Steps of a curve, and the forces at their middles."""
    places, owners = [], []
    for index, segment in enumerate(curve.segments):
        count = max(2, round(steps * (segment.stop - segment.start) / curve.length))
        places.append(np.linspace(segment.start, segment.stop, count + 1))
        owners.append(np.full(count, index))
    middle = np.concatenate([(s[1:] + s[:-1]) / 2 for s in places])
    directions = directions_of(curve, np.concatenate(owners))
    forces = inverse(curve.formation, *curve.evaluate(middle)[:3], directions)
    return np.concatenate([np.diff(s) for s in places]), forces


class PhasePlane:
    """A curve in steps of constant a, with the limits kept at the middle of each step.

    Several curves are run through one after the other, with the speed going on.

    A step has rows p a + q squeeze >= r(b). Eliminating the squeeze between each pair of rows with
    q of opposite signs leaves bounds of a; the largest b from which the end can still be reached is
    found backwards, and then the largest a is taken forwards.
    """

    def __init__(self, curve: Curve | Sequence[Curve], epsilon: float, steps: int) -> None:
        curves = [curve] if isinstance(curve, Curve) else list(curve)
        parts = [_look(part, steps) for part in curves]
        self.h = np.concatenate([h for h, _ in parts])
        columns = zip(*(forces for _, forces in parts), strict=True)
        forces = PathForces(*(np.concatenate(column) for column in columns))
        formation = curves[0].formation
        limit, n_c = formation.scene.torque_limit, formation.n_contacts

        def hold(c: Array) -> Array:
            """Normal forces, then for each rolling contact mu c_n - c_t and mu c_n + c_t."""
            columns = [c[:, :n_c]]
            for k, row in enumerate(formation.rolling_rows):
                bound = formation.friction[row] * c[:, row]
                columns.append(np.column_stack([bound - c[:, n_c + k], bound + c[:, n_c + k]]))
            return np.hstack(columns)

        self.a = np.hstack([hold(forces.Ca), forces.Ta, -forces.Ta])
        self.b = np.hstack([hold(forces.Cb), forces.Tb, -forces.Tb])
        self.squeeze = np.hstack([hold(forces.Cl), forces.Tl, -forces.Tl])
        # Cones are kept as if every normal force were smaller by epsilon.
        less = forces.C0.copy()
        less[:, :n_c] -= epsilon
        held = hold(less)
        self.root = np.hstack([0 * held, forces.Tv, -forces.Tv])
        self.constant = np.hstack([held, forces.T0 + limit, limit - forces.T0])

    def accelerations(self, k: int, b: Array) -> tuple[Array, Array]:
        """Least and largest a of step k from each b, shape (n,); none where least > largest."""
        q = self.squeeze[k]
        p = self.a[k] + self.h[k] * self.b[k]
        rest = b[:, None] * self.b[k] + np.sqrt(b)[:, None] * self.root[k] + self.constant[k]
        up, down = np.flatnonzero(q > 1e-12), np.flatnonzero(q < -1e-12)
        # rest + p a >= 0 on each pair's combination that has no squeeze.
        slope = (p[up, None] * -q[down] + p[down] * q[up, None]).ravel()
        rows = rest[:, up, None] * -q[down] + rest[:, None, down] * q[up, None]
        rows = rows.reshape(len(b), -1)
        free = np.flatnonzero(np.abs(q) <= 1e-12)
        slope, rows = np.append(slope, p[free]), np.hstack([rows, rest[:, free]])
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = -rows / slope
        low = np.where(slope > 0, bound, -np.inf).max(axis=1)
        high = np.where(slope < 0, bound, np.inf).min(axis=1)
        high = np.where(((slope == 0) & (rows < 0)).any(axis=1), -np.inf, high)
        # b has to stay positive.
        return np.maximum(low, -b / (2 * self.h[k])), high

    def reachable(self) -> Array:
        """Largest b at the start of each step from which rest at the end can be reached."""
        count = len(self.h)
        largest = np.zeros(count + 1)
        top = 4.0 * 9.81 * self.h.sum() * 2**6
        for k in range(count - 1, -1, -1):
            low, high = 0.0, top
            # Each time the place is known 64 times as closely.
            for _ in range(6):
                b = np.linspace(low, high, 65)
                least, most = self.accelerations(k, b)
                most = np.minimum(most, (largest[k + 1] - b) / (2 * self.h[k]))
                good = np.flatnonzero(least <= most)
                if not len(good):
                    raise ValueError(f"no motion passes step {k}")
                low, high = b[good[-1]], b[min(good[-1] + 1, len(b) - 1)]
            largest[k] = low
        return largest

    def least_time(self) -> float:
        largest = self.reachable()
        b, time = 0.0, 0.0
        for k, h in enumerate(self.h):
            _, most = self.accelerations(k, np.array([b]))
            after = max(0.0, min(b + 2 * h * float(most[0]), float(largest[k + 1])))
            time += 2 * h / (np.sqrt(b) + np.sqrt(after))
            b = after
        return time
