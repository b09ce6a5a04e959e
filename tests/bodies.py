"""Rigid bodies whose corners may touch straight lines, for motions known in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from wholearm.common.arrays import Array
from wholearm.free_simulation.free_events import play
from wholearm.free_simulation.state import FreeRun
from wholearm.free_simulation.system import ContactPair, Structure, System
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Scales

G = 9.81


def make_body(
    corners: Sequence[Sequence[float]],
    lines: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 1.0),),
    *,
    mu: float = 0.0,
    inertia: float = 1.0,
    mass: float = 1.0,
    weight: tuple[float, float] = (0.0, -G),
) -> System:
    """One body (x, y, phi), whose corners are given about its centroid.

    A line is given by its distance from the origin and its normal, which points to the body.
    """
    z = ca.SX.sym("z", 3)
    c, s = ca.cos(z[2]), ca.sin(z[2])
    pairs = []
    for k, (distance, nx, ny) in enumerate(lines):
        for i, (a, b) in enumerate(corners):
            x, y = z[0] + c * a - s * b, z[1] + s * a + c * b
            gap, slip = nx * x + ny * y - distance, ny * x - nx * y
            pairs.append(ContactPair(f"v{i}-line{k}", gap, slip))
    none = np.zeros(3)
    structure = Structure(z, ca.SX.sym("geometry", 0), tuple(pairs), (), (False, False, True))
    return System(
        structure,
        np.zeros(0),
        np.array([mass, mass, inertia]),
        mass * np.array([*weight, 0.0]),
        none,
        none,
        np.full(len(pairs), mu),
        Scales(np.sqrt(inertia / mass), mass, mass * G),
    )


def simulate(
    system: System, z: Sequence[float], v: Sequence[float], until: float, restitution: float = 0.0
) -> FreeRun:
    """Let a system go without torques."""
    torque = TorqueProfile(np.array([0.0, until]), np.zeros((1, 2, 1)))
    run = FreeRun(system, torque, np.array(z, float), np.array(v, float), restitution)
    play(run, 1e-9 * system.scales.length)
    return run


def rotate(angle: float, points: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]), dtype=float)


def measure_energy(run: FreeRun) -> float:
    """What the balance of energy leaves at the end, over the sum of all that is in it."""
    first, last, n = run.records[0].y, run.records[-1].y, run.system.n
    impact = run.records[-1].impact - run.records[0].impact
    work, *losses = last[2 * n :] - first[2 * n :]
    kinetic = (last[n : 2 * n] ** 2 - first[n : 2 * n] ** 2) @ run.system.mass / 2
    potential = (first[:n] - last[:n]) @ run.system.applied
    terms = np.array([work, -kinetic, -potential, -impact, *(-loss for loss in losses)])
    return float(terms.sum() / (np.abs(terms).sum() or 1.0))
