"""Random objects and torques: the simulation against time stepping that is told no modes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from plane import convex_polygon, make_scene
from pushing import evaluate, linear
from stepping import march
from wholearm.contacts.closing import close_finger
from wholearm.contacts.formation import Formation, find_touching
from wholearm.problem.definition import Phase, Problem, Until
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Friction
from wholearm.simulation.simulate import simulate


def draw(rng: np.random.Generator) -> tuple[Problem, TorqueProfile] | None:
    """An object over one vertex on the palm, and squeezing torques; None if a tip touches it."""
    scene = make_scene(convex_polygon(rng, int(rng.integers(3, 8)), 0.045), base=0.1)
    links = [
        dataclasses.replace(
            link, dry=float(10 ** rng.uniform(-4, -1.5)), inertia=float(10 ** rng.uniform(-4, -2))
        )
        for link in scene.fingers
    ]
    scene = dataclasses.replace(
        scene,
        friction=Friction(*rng.uniform(0.02, 0.5, 3)),
        fingers=(links[0], links[1]),
        fingers_collide=False,
    )
    phi = rng.uniform(-np.pi, np.pi)
    low = (scene.polygon.vertices @ [np.sin(phi), np.cos(phi)]).min()
    q = np.array([rng.uniform(-0.03, 0.03), -low, phi])
    z = np.array([*q, *(close_finger(scene, q, k) for k in (0, 1))])
    contacts = find_touching(scene, z)
    if any(contact.surface == "tip" for contact in contacts) or len(contacts) > 3:
        return None
    phase = Phase(0, Formation(scene, contacts), Until(coordinate="x", value=-5.0))
    tau = 10 ** rng.uniform(-1.5, 0.2) * np.abs(rng.normal(size=(2, 6)))
    torque = linear(np.linspace(0.0, 0.3, 6), tau[0], (-tau[1]).tolist())
    return Problem("random", scene, 0.0, z, (phase,)), torque


@pytest.mark.parametrize("seed", [32, 79, 93])
def test_agrees_with_time_stepping(seed: int) -> None:
    drawn = draw(np.random.default_rng(seed))
    assert drawn is not None
    problem, torque = drawn
    whole = simulate(problem, torque, tolerance=1e-10)
    stop = 0.999 * float(whole.t[-1])
    end = simulate(problem, torque, tolerance=1e-10, times=[stop]).at(stop)
    moved, errors = np.abs(end[:5] - problem.start).max(), []
    assert moved > 1e-4
    for n in (100, 400):
        z, _ = march(
            problem.phases[0].formation, problem.start, np.zeros(5),
            lambda t: evaluate(torque, t), stop, n,
        )  # fmt: skip
        errors.append(float(np.abs(z[-1] - end[:5]).max() / moved))
    assert errors[1] < 0.5 * errors[0] or errors[1] < 1e-4
    assert errors[1] < 0.02
    assert np.abs(whole.energies.residual).max() < 1e-8 * np.abs(whole.energies.work).max()
