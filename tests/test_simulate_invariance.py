"""What a simulation says does not depend on units, mirroring and numbering of its problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import pytest

from planned import plan, plan_landing
from pushing import pushed, rocking
from wholearm.common.arrays import Array
from wholearm.contacts.elemental import parse_contact
from wholearm.contacts.formation import Formation
from wholearm.problem.definition import Problem, Until
from wholearm.results.torque import TorqueProfile
from wholearm.scene.model import Friction, Scene
from wholearm.simulation.events import Event, Simulation
from wholearm.simulation.simulate import simulate


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


TELLINGS = {
    "7 lengths, 3 masses": partial(in_units, length=7.0, mass=3.0),
    "small": partial(in_units, length=0.02, mass=5e-4),
    "large": partial(in_units, length=200.0, mass=5e3),
    "mirrored": mirror,
    "renumbered": partial(renumber, by=2),
}
Told = tuple[Problem, TorqueProfile]
Telling = Callable[[Problem, TorqueProfile], Retold]


def box() -> Told:
    """A box that is pushed, sticks and slips, beside a finger that swings."""
    return pushed(), rocking()


def landing() -> Told:
    """A release and a landing in which a vertex sticks twice."""
    problem, trajectory = plan_landing(squeeze=3.0)
    return problem, trajectory.torque


def slide() -> Told:
    """The first phases of the heptagon on four contacts."""
    problem, trajectory = plan()
    return dataclasses.replace(problem, phases=problem.phases[:2]), trajectory.torque


@cache
def begin(make: Callable[[], Told]) -> tuple[Told, Simulation]:
    """A problem with its torques, and what becomes of it as it is told first."""
    problem, torque = make()
    return (problem, torque), simulate(problem, torque, tolerance=1e-11)


@pytest.mark.parametrize("telling", TELLINGS.values(), ids=TELLINGS)
@pytest.mark.parametrize("make", [box, landing, slide])
def test_answers_agree(make: Callable[[], Told], telling: Telling) -> None:
    (problem, torque), first = begin(make)
    retold = telling(problem, torque)
    other = simulate(retold.problem, retold.torque, tolerance=1e-11)
    assert other.outcome.kind is first.outcome.kind

    def tell(event: Event) -> tuple[str, str]:
        return event.kind.value, retold.name(event.contact) if event.contact else ""

    names = [tell(event) for event in first.events if event.contact[:1] in ("", "v", "j")]
    told = [(event.kind.value, event.contact) for event in other.events]
    # Events of one instant have no order.
    assert sorted(names) == sorted(told)
    times = np.sort([event.time for event in first.events])
    assert np.sort([event.time for event in other.events]) / retold.time == pytest.approx(
        times, rel=1e-8
    )
    length = problem.scene.scales.length
    units = np.array([length, length, 1.0, 1.0, 1.0])
    ends = np.concatenate([first.z[-1], first.z_dot[-1]])
    state = retold.back(np.concatenate([other.z[-1], other.z_dot[-1]]))
    assert np.abs((state - ends)[:5] / units).max() < 1e-8
    assert other.steps == pytest.approx(first.steps, abs=3)
    assert np.abs(other.energies.residual).max() < 1e-9 * np.abs(other.energies.work).max()
