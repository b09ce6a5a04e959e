"""The same problem told in other words: units, mirrored, renumbered, contacts in another order.

What a problem says in units of its scene has to agree, whatever it is told in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from wholearm import Contact, Friction, Objective, Phase, Problem, Scene, TorqueProfile
from wholearm.common.arrays import Array
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem


class Units(NamedTuple):
    """How many of the new units make up one of the old: of length, mass and time."""

    length: float = 1.0
    mass: float = 1.0
    time: float = 1.0

    @property
    def force(self) -> float:
        """The same for forces."""
        return self.mass * self.length / self.time**2

    @property
    def torque(self) -> float:
        """The same for torques."""
        return self.force * self.length

    @staticmethod
    def of(length: float, mass: float) -> Units:
        """Units of length and mass, with that of time in which gravity has the same number."""
        return Units(length, mass, float(np.sqrt(length)))


SAME = Units()


@dataclass(frozen=True)
class Retelling:
    """Other words for a problem."""

    name: str
    units: Units = SAME
    mirrored: bool = False  # whether left and right are exchanged
    shift: int = 0  # of the numbers of the vertices
    seed: int | None = None  # of another order of the contacts of each phase

    def apply(self, problem: Problem) -> Problem:
        """The problem in these words."""
        (length, mass, time), units = self.units, self.units
        flip, scene = np.array([-1.0 if self.mirrored else 1.0, 1.0]), problem.scene
        points = length * flip * np.asarray(scene.polygon.points)
        points = np.roll(points[:: int(flip[0])], self.shift, axis=0)
        assert scene.polygon.inertia is not None
        inertia = scene.polygon.inertia * mass * length**2
        body = replace(
            scene.polygon, points=points, mass=scene.polygon.mass * mass, inertia=inertia
        )
        right, left = (
            replace(
                link,
                base=length * flip * np.asarray(link.base),
                length=link.length * length,
                radius=link.radius * length,
                inertia=link.inertia * mass * length**2,
                viscous=link.viscous * units.torque * time,
                dry=link.dry * units.torque,
                torque_limit=link.torque_limit * units.torque,
                speed_limit=link.speed_limit / time,
            )
            for link in scene.fingers[:: int(flip[0])]
        )
        palm, *others = (scene.friction.of(part) for part in (None, 0, 1))
        friction = Friction(palm, *others[:: int(flip[0])])
        told = replace(
            scene,
            polygon=body,
            fingers=(right, left),
            friction=friction,
            gravity=scene.gravity * length / time**2,
        )
        rng = np.random.default_rng(self.seed)
        return replace(
            problem,
            scene=told,
            start=self.tell(np.append(problem.start, np.zeros(5)))[:5],
            epsilon=problem.epsilon * units.force,
            phases=tuple(self._tell_phase(phase, told, rng) for phase in problem.phases),
        )

    def _tell_phase(self, phase: Phase, scene: Scene, rng: np.random.Generator) -> Phase:
        own, until = phase.formation, phase.until
        order = np.arange(own.n_contacts) if self.seed is None else rng.permutation(own.n_contacts)
        contacts = tuple(self.rename(own.contacts[k], scene) for k in order)
        rolling = tuple(self.rename(contact, scene) for contact in own.rolling)
        sizes = {"x": self.units.length * (-1) ** self.mirrored, "phi": (-1) ** self.mirrored}
        if until.contact is not None:
            until = replace(until, contact=self.rename(until.contact, scene))
        elif until.value is not None:
            until = replace(until, value=until.value * sizes[until.coordinate])
        formation = replace(own, scene=scene, contacts=contacts, rolling=rolling)
        return replace(phase, formation=formation, until=until)

    def rename(self, contact: Contact, scene: Scene) -> Contact:
        """What a contact is called in the scene as it is told."""
        index, finger, count = contact.index, contact.finger, scene.polygon.n_vertices
        if self.mirrored:
            index = count - (1 if contact.feature == "v" else 2) - index
            finger = None if finger is None else 1 - finger
        return replace(contact, index=(index + self.shift) % count, finger=finger)

    def tell(self, state: Array) -> Array:
        """A state (z, z') in these words, shape (10,)."""
        if self.mirrored:
            order = np.array([0, 1, 2, 4, 3])
            signs = np.array([-1.0, 1.0, -1.0, -1.0, -1.0])
            z = signs * state[order] + np.pi * np.array([0, 0, 0, 1, 1])
            state = np.append(z, signs * state[5 + order])
        place = np.array([self.units.length, self.units.length, 1.0, 1.0, 1.0])
        return np.asarray(state * np.append(place, place / self.units.time))

    def tell_torque(self, torque: TorqueProfile) -> TorqueProfile:
        """Torques in these words."""
        coefficients = -torque.coefficients[:, ::-1] if self.mirrored else torque.coefficients
        return TorqueProfile(torque.breaks * self.units.time, coefficients * self.units.torque)


RETELLINGS = (
    Retelling("7 lengths, 3 masses", Units.of(7.0, 3.0)),
    Retelling("0.02 lengths, 0.001 masses", Units.of(0.02, 1e-3)),
    Retelling("100 lengths, 10000 masses", Units.of(100.0, 1e4)),
    Retelling("mm and g", Units(1e3, 1e3, 1.0)),
    Retelling("mirrored", mirrored=True),
    Retelling("renumbered by 2", shift=2),
    Retelling("contacts in another order", seed=0),
)


class Answer(NamedTuple):
    """A plan in units of the scene it was told in.

    Its value, the breaks of its torques over its duration, shape (k + 1,), and their coefficients
    over the torque limits, shape (k, 2, d + 1), in the order of the first telling.
    """

    value: float
    breaks: Array
    torques: Array


def answer(problem: Problem, objective: str, telling: Retelling, **options: Any) -> Answer:
    """Plan a problem that is read from the table of how it is told."""
    told, units = build_problem(telling.apply(problem).table), telling.units
    if objective == Objective.EFFORT.value:
        options["time_weight"] = units.torque**2
    plan = solve(told, objective, **options)
    cost = {"time": units.time, "effort": units.torque**2 * units.time, "margin": units.force}
    profile = plan.trajectory.torque
    torques = profile.coefficients / told.scene.torque_limit[:, None]
    if telling.mirrored:
        torques = -torques[:, ::-1]
    return Answer(plan.value / cost[objective], profile.breaks / profile.duration, torques)
