"""A box tipped over a vertex that rolls on the palm: the problem file, and a falling box alone."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from plane import make_formation, make_scene, rotate
from shipped import BOX, plan_of, problem_of
from wholearm import Formation, Friction, Phase, Problem, Scene, TorqueProfile, Trajectory, Until
from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve
from wholearm.geometry.tracing import trace_phases

POINTS = [[-0.02, -0.05], [0.02, -0.05], [0.02, 0.05], [-0.02, 0.05]]
"""A slender box; fallen over vertex 1, its centroid is ever farther right of it."""


def box() -> Problem:
    return problem_of(BOX)


def tipped() -> Trajectory:
    """The plan of the box for least time."""
    return plan_of(BOX)


PALM = box().scene.friction.palm
"""Friction with the palm."""


def tip() -> Curve:
    """The curve of the phase in which the box tips over vertex 1."""
    return trace_phases(box())[1]


@lru_cache(maxsize=1)
def tilting() -> Problem:
    """That phase alone, in which the vertex may slide as well."""
    problem = box().with_(friction_palm=0.5, torque_limit=2.0)
    formation = replace(problem.phases[1].formation, rolling=())
    phase = Phase(0, formation, problem.phases[1].until)
    return replace(problem, start=trace_phases(problem)[0].end, phases=(phase,))


def roll(formation: Formation, *names: str) -> Formation:
    """The formation with some of its contacts rolling."""
    rolling = tuple(contact for contact in formation.contacts if contact.name in names)
    assert len(rolling) == len(names)
    return replace(formation, rolling=rolling)


def falling(mu: float, lean: float) -> Problem:
    """A box that falls over vertex 1, with both fingers far away and without friction.

    Parameters
    ----------
    mu : float
        Friction with the palm.
    lean : float, [rad]
        Of the line from vertex 1 to the centroid, to the right of upright, at the start.
    """
    scene = make_scene(POINTS, base=0.4)
    free = [replace(link, viscous=0.0, dry=0.0) for link in scene.fingers]
    scene = Scene(scene.polygon, (free[0], free[1]), Friction(mu, 0.1, 0.1))
    phi = -lean - np.arctan2(0.02, 0.05)
    start = np.array([*-rotate(phi, POINTS[1]), phi, np.pi / 2, np.pi / 2])
    formation = roll(make_formation(scene, "v1-palm"), "v1-palm")
    phase = Phase(0, formation, Until(coordinate="phi", value=phi - 1.4))
    return Problem("falling box", scene, 0.0, start, (phase,))


def scale(joint: int, factor: float, start: float, stop: float) -> TorqueProfile:
    """The plan's torques with those of one joint multiplied from `start` to `stop` [s]."""
    torque = tipped().torque
    coefficients = torque.coefficients.copy()
    first = torque.breaks[:-1]
    coefficients[(first >= start - 1e-9) & (first < stop - 1e-9), joint] *= factor
    return TorqueProfile(torque.breaks, coefficients)


def constant(tau: tuple[float, float], duration: float) -> TorqueProfile:
    return TorqueProfile(np.array([0.0, duration]), np.array([[[tau[0]], [tau[1]]]]))


def ramp(start: tuple[float, float], rate: tuple[float, float], duration: float) -> TorqueProfile:
    """Torques that start and rise evenly [N m, N m/s]."""
    half: Array = np.array(rate) * duration / 2
    return TorqueProfile(
        np.array([0.0, duration]), np.column_stack([np.array(start) + half, half])[None]
    )
