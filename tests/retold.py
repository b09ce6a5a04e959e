"""Problems and torques told in other words: other units, mirrored, renumbered, reordered.

For problems that have no file, and formations of vertex contacts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.problem.definition import Problem, Until
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Friction, Scene


class Retold(NamedTuple):
    """A problem and its torques in other words.

    Attributes
    ----------
    back : callable
        States (z, z'), shape (10,), as the first telling has them.
    time : float
        How many of the new units of time make one of the first.
    name : callable
        The new name of a contact or joint.
    """

    problem: Problem
    torque: TorqueProfile
    back: Callable[[Array], Array]
    time: float
    name: Callable[[str], str]


def in_units(problem: Problem, torque: TorqueProfile, length: float, mass: float) -> Retold:
    """With other numbers for lengths and masses, and for times so that gravity has the same."""
    scene, time = problem.scene, float(np.sqrt(length))
    force = mass * length / time**2
    inertia, work = mass * length**2, force * length
    body = dataclasses.replace(
        scene.polygon,
        points=np.asarray(scene.polygon.points) * length,
        mass=scene.polygon.mass * mass,
        inertia=(scene.polygon.inertia or 0.0) * inertia,
    )
    links = [
        dataclasses.replace(
            link,
            base=np.asarray(link.base) * length,
            length=link.length * length,
            radius=link.radius * length,
            inertia=link.inertia * inertia,
            viscous=link.viscous * work * time,
            dry=link.dry * work,
            torque_limit=link.torque_limit * work,
            speed_limit=link.speed_limit / time,
        )
        for link in scene.fingers
    ]
    new = dataclasses.replace(scene, polygon=body, fingers=(links[0], links[1]))
    place = np.array([length, length, 1.0, 1.0, 1.0])
    units = np.concatenate([place, place / time])

    def measure(until: Until) -> Until:
        scales = until.coordinate == "x" and until.value is not None
        return dataclasses.replace(until, value=until.value * length) if scales else until  # type: ignore[operator]

    retold = _rebuild(problem, new, problem.start * place, str, measure)
    profile = TorqueProfile(torque.breaks * time, torque.coefficients * work)
    retold = dataclasses.replace(retold, epsilon=problem.epsilon * force)
    return Retold(retold, profile, lambda state: state / units, time, str)


def mirror(problem: Problem, torque: TorqueProfile) -> Retold:
    """Left and right exchanged."""
    scene, count = problem.scene, problem.scene.polygon.n_vertices
    flip = np.array([-1.0, 1.0])
    body = dataclasses.replace(
        scene.polygon, points=(np.asarray(scene.polygon.points) * flip)[::-1]
    )
    right, left = (
        dataclasses.replace(link, base=np.asarray(link.base) * flip) for link in scene.fingers
    )
    friction = Friction(scene.friction.palm, scene.friction.finger2, scene.friction.finger1)
    new = dataclasses.replace(scene, polygon=body, fingers=(left, right), friction=friction)
    exchange = {"1": "2", "2": "1"}

    def rename(name: str) -> str:
        if name.startswith("joint"):
            return f"joint {exchange[name[-1]]}"
        vertex, part = name[1:].split("-")
        other = part if part == "palm" else f"finger{exchange[part[-1]]}"
        return f"v{count - 1 - int(vertex)}-{other}"

    def reflect(state: Array) -> Array:
        x, y, phi, first, second = state[:5]
        place = [-x, y, -phi, np.pi - second, np.pi - first]
        x, y, phi, first, second = state[5:]
        return np.array([*place, -x, y, -phi, -second, -first])

    def turn(until: Until) -> Until:
        return until if until.value is None else dataclasses.replace(until, value=-until.value)

    start = reflect(np.concatenate([problem.start, np.zeros(5)]))[:5]
    retold = _rebuild(problem, new, start, rename, turn)
    profile = TorqueProfile(torque.breaks, -torque.coefficients[:, ::-1])
    return Retold(retold, profile, reflect, 1.0, rename)


def renumber(problem: Problem, torque: TorqueProfile, by: int) -> Retold:
    """With the vertices counted from another one, and the contacts of each phase backwards."""
    scene, count = problem.scene, problem.scene.polygon.n_vertices
    points = np.roll(np.asarray(scene.polygon.points), by, axis=0)
    new = dataclasses.replace(scene, polygon=dataclasses.replace(scene.polygon, points=points))

    def rename(name: str) -> str:
        if name.startswith("joint"):
            return name
        vertex, part = name[1:].split("-")
        return f"v{(int(vertex) + by) % count}-{part}"

    retold = _rebuild(problem, new, problem.start, rename, lambda until: until, backwards=True)
    return Retold(retold, torque, lambda state: state, 1.0, rename)


def _rebuild(
    problem: Problem,
    scene: Scene,
    start: Array,
    rename: Callable[[str], str],
    measure: Callable[[Until], Until],
    backwards: bool = False,
) -> Problem:
    """The problem on another scene."""

    def read(names: Sequence[str]) -> tuple:  # type: ignore[type-arg]
        contacts = tuple(parse_contact(rename(name), scene) for name in names)
        return contacts[::-1] if backwards else contacts

    phases = []
    for phase in problem.phases:
        formation = Formation(scene, read(phase.formation.names))
        until = measure(phase.until)
        if until.contact is not None:
            until = dataclasses.replace(until, contact=read([until.contact.name])[0])
        phases.append(dataclasses.replace(phase, formation=formation, until=until))
    return dataclasses.replace(problem, scene=scene, start=start, phases=tuple(phases))
