"""How fast a motion can run along a given way, and by how much it keeps its limits.

Along a way z(s) the square b = s'^2 of the speed, s'' = b_s / 2 and the contact forces enter the
equations of motion linearly, but for viscous friction, which is left out,

    M5 (z_s s'' + z_ss b) + D sigma = g + S tau + G^T c,

so that the largest share `margin` by which all limits can be kept,

    c_n >= epsilon + margin m g,  |tau| <= (1 - margin) limit,

is a linear programme over all intervals of the way. Contacts that roll keep within their cones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...common.arrays import Array
from ...geometry.path_guess import PathGuess
from ...mechanics.dynamics import force_rows
from ...mechanics.limits import CONE, PRESS, TORQUE
from ...mechanics.metric import metric_weights

FASTEST = 9.0
"""Largest square of the speed, over gravity times the radius of gyration."""
BRISK = 0.5
"""Share of a positive margin that a brisk motion keeps."""
GIVES = 0.02
"""What a brisk motion may lose of a negative margin."""
LEAST = 1e-4
"""Least square of the speed, in the same unit, that a duration is taken from."""


class Pace(NamedTuple):
    """When a motion is where on a way.

    Attributes
    ----------
    t : ndarray, shape (n,), [s]
    s : ndarray, shape (n,)
        Share of the length.
    v : ndarray, shape (n,), [1/s]
        Its rate, which is linear in time in between.
    forces : ndarray, shape (n - 1, n_c + R)
        In between, over the weight of the object.
    """

    t: Array
    s: Array
    v: Array
    forces: Array


class WayForces:
    """The linear programme of one way: x = (b at nodes, c in intervals, margin), over scales.

    Attributes
    ----------
    kinds : list of (str, str)
        Kind of the limit that each row belongs to, and the contact or finger.
    """

    def __init__(self, way: Sequence[PathGuess], epsilon: float) -> None:
        formation, scene = way[0].formation, way[0].formation.scene
        z = np.concatenate([way[0].z[:1], *(part.z[1:] for part in way)])
        dz = np.diff(z, axis=0)
        self.runs = np.sqrt(dz**2 @ metric_weights(scene))
        self.n_c, m = formation.n_contacts, len(dz)
        z_s = dz / self.runs[:, None]
        middles = np.cumsum(self.runs) - self.runs / 2
        z_ss = np.gradient(z_s, middles, axis=0) if m > 1 else 0 * z_s
        kinematics = formation.evaluate((z[1:] + z[:-1]) / 2, z_s)
        parts = np.cumsum([0, *(len(part.z) - 1 for part in way)])
        G = np.concatenate(
            [
                force_rows(formation, kinematics, part.directions)[begin:stop]
                for part, begin, stop in zip(way, parts[:-1], parts[1:], strict=True)
            ]
        )
        sigma = np.repeat([part.directions.sigma for part in way], np.diff(parts), axis=0)
        force, length, square = scene.scales.force, scene.scales.length, scene.scales.speed**2
        width = G.shape[1]
        self.square, self.size = square, m + 1 + m * width + 1
        drive = np.zeros((m, 5, self.size))
        k = np.arange(m)
        mass = scene.mass_diagonal * square
        drive[k, :, k] = mass * (z_ss / 2 - z_s / (2 * self.runs[:, None]))
        drive[k, :, k + 1] = mass * (z_ss / 2 + z_s / (2 * self.runs[:, None]))
        own = m + 1 + k[:, None] * width + np.arange(width)
        drive[k[:, None], :, own] = -force * G
        drive[:, 3:] /= scene.torque_limit[:, None]
        drive[:, :3] /= force * np.array([1.0, 1.0, length])[:, None]
        load = scene.applied_force[:3] / (force * np.array([1.0, 1.0, length]))
        self.equal = drive[:, :3].reshape(-1, self.size)
        self.equal_to = np.tile(load, m)
        torque = drive[:, 3:].reshape(-1, self.size)
        dry = (scene.dry[3:] * sigma / scene.torque_limit).ravel()
        press = -np.eye(self.size)[own[:, : self.n_c].ravel()]
        rows, most = (
            [torque, -torque, press],
            [1 - dry, 1 + dry, np.full(len(press), -epsilon / force)],
        )
        self.kinds = [(TORQUE, "finger 1"), (TORQUE, "finger 2")] * (2 * m)
        self.kinds += [(PRESS, name) for name in formation.names] * m
        for i, row in enumerate(formation.rolling_rows):
            grip, slip = np.eye(self.size)[own[:, row]], np.eye(self.size)[own[:, self.n_c + i]]
            mu = formation.friction[row]
            rows += [slip - mu * grip, -slip - mu * grip]
            most += 2 * [np.full(m, -mu * epsilon / force)]
            self.kinds += [(CONE, formation.names[row])] * (2 * m)
        self.rows, self.most = np.concatenate(rows), np.concatenate(most)
        self.rows[:, -1] = 1.0
        with np.errstate(divide="ignore"):
            quick = ((scene.speed_limit / np.abs(z_s[:, 3:])) ** 2).min(axis=1) / square
        top = np.minimum(FASTEST, np.minimum(np.append(quick, np.inf), np.append(np.inf, quick)))
        self.top = [0.0, *top[1:-1].tolist(), 0.0]

    def find_margin(self) -> float:
        """The largest margin of any motion; -inf if there is none."""
        answer = self._maximise(np.eye(self.size)[-1], -np.inf)
        return -np.inf if answer is None else float(answer.x[-1])

    def find_critical(self) -> tuple[str, str]:
        """Kind of the limit that most keeps the margin from being larger, and what it limits."""
        answer = self._maximise(np.eye(self.size)[-1], -np.inf)
        shares = dict.fromkeys(self.kinds, 0.0)
        for kind, share in zip(self.kinds, np.abs(answer.ineqlin.marginals), strict=True):
            shares[kind] += float(share)
        return max(shares, key=lambda kind: shares[kind])

    def find_pace(self, margin: float) -> Pace | None:
        """A brisk motion whose margin is not much less than the largest one, `margin`."""
        speed = np.zeros(self.size)
        speed[: len(self.top)] = 1.0
        answer = self._maximise(speed, min(BRISK * margin, margin - GIVES))
        if answer is None:
            return None
        x = answer.x
        v = np.sqrt(self.square * np.maximum(x[: len(self.top)], 0.0))
        steps = 2 * self.runs / np.maximum(v[1:] + v[:-1], np.sqrt(LEAST * self.square))
        length = np.append(0.0, np.cumsum(self.runs))
        forces = x[len(self.top) : -1].reshape(len(steps), -1)
        t = np.append(0.0, np.cumsum(steps))
        return Pace(t, length / length[-1], v / length[-1], forces)

    def _maximise(self, gain: Array, least: float) -> Any:
        """What SciPy finds, None if that is no solution."""
        from scipy.optimize import linprog

        forces = self.size - len(self.top) - 1
        bounds: list[tuple[float | None, float | None]] = [(0.0, top) for top in self.top]
        bounds += [(None, None)] * forces + [(None if least == -np.inf else least, 1.0)]
        answer = linprog(
            -gain, self.rows, self.most, self.equal, self.equal_to, bounds, method="highs"
        )
        return answer if answer.status == 0 else None
