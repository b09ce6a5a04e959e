"""Random objects that are thrown into a hand, which moves by random torques.

A run may end in any way, but it must not gain energy, and nothing may overlap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wholearm.common.arrays import Array
from wholearm.free_simulation.free_simulate import simulate_free
from wholearm.free_simulation.hand import measure_gaps
from wholearm.free_simulation.result import FreeSimulation
from wholearm.problem.definition import Problem
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Finger, Friction, Scene
from wholearm.scene.polygon import Polygon

DURATION = 0.4
"""Of a random run [s]."""


class Draw(NamedTuple):
    """A random scene with a state and torques to start from."""

    problem: Problem
    state: Array
    torque: TorqueProfile
    restitution: float


class Figures(NamedTuple):
    """What must not be, of one run.

    Attributes
    ----------
    gained : float
        Largest gain of energy over what the torques did, relative to all that has moved.
    unexplained : float
        Largest residual of the balance of energy, likewise.
    overlap : float
        Largest overlap of two bodies, relative to the scene's length.
    """

    gained: float
    unexplained: float
    overlap: float


def draw_run(seed: int) -> Draw:
    """A random object that is thrown into a hand, which moves by random torques."""
    rng = np.random.default_rng([17, seed])
    count, size = int(rng.integers(3, 8)), 0.05
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    corners = size * np.column_stack([np.cos(angles), rng.uniform(0.4, 1.0) * np.sin(angles)])
    radius = float(rng.choice([0.0, 0.005]))
    fingers = tuple(
        Finger(
            base=[side * rng.uniform(0.07, 0.12), -0.01],
            length=rng.uniform(0.1, 0.2),
            radius=radius,
            inertia=rng.uniform(1e-4, 5e-3),
            viscous=rng.choice([0.0, 0.01]),
            dry=rng.choice([0.0, 0.02]),
            torque_limit=2.0,
        )
        for side in (1.0, -1.0)
    )
    mu = rng.uniform(0, 1, 3) * rng.choice([0.0, 1.0], p=[0.2, 0.8])
    scene = Scene(Polygon(corners, 0.2), (fingers[0], fingers[1]), Friction(*mu.tolist()))
    z = np.zeros(5)
    while measure_gaps(scene, z[None]).min() < 1e-3:
        turn = rng.uniform(-np.pi, np.pi)
        z[:3] = rng.uniform(-0.05, 0.05), rng.uniform(0.05, 0.25), turn
        z[3:] = rng.uniform(0, np.pi / 2), rng.uniform(np.pi / 2, np.pi)
    v = rng.choice([0.0, 1.0]) * rng.normal(size=5) * [0.5, 0.5, 5.0, 3.0, 3.0]
    breaks = np.linspace(0, DURATION, 5)
    coefficients = rng.normal(size=(4, 2, 2)) * rng.choice([0.0, 0.05, 0.5])
    problem = Problem("random", scene, 0.05, z, (), checked=True)
    restitution = float(rng.choice([0.0, rng.uniform(0, 0.9)]))
    return Draw(problem, np.concatenate([z, v]), TorqueProfile(breaks, coefficients), restitution)


def run_draw(draw: Draw) -> FreeSimulation:
    """Simulate one."""
    return simulate_free(draw.problem, draw.torque, start=draw.state, restitution=draw.restitution)


def judge_run(run: FreeSimulation) -> Figures:
    """Measure what must not be."""
    energies = run.energies
    kinetic = 0.5 * (run.z_dot**2) @ run.problem.scene.mass_diagonal
    left = energies.stored - energies.work
    size = kinetic.max() + np.abs(energies.stored).max() + np.abs(energies.work).max()
    depth = -measure_gaps(run.problem.scene, run.z).min()
    return Figures(
        float((left - np.minimum.accumulate(left)).max() / size),
        float(np.abs(energies.residual).max() / size),
        float(max(depth, 0.0) / run.problem.scene.scales.length),
    )
