"""The same problem told in other words: units, mirrored, renumbered, contacts in another order.

Each retelling turns the table of a problem file into another one, and says what becomes of its
answers. Answers in units of the scene (`Answer`) have to agree, whatever a problem is told in.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from wholearm.common.arrays import Array
from wholearm.contacts.elemental import Contact
from wholearm.planning.options import Objective
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.problem.read import ROLLING, build_problem
from wholearm.results.trajectory import Trajectory

Table = Mapping[str, Any]
_NAME = re.compile(r"([ve])(\d+)-(palm|finger|tip)([12]?)")


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


_SAME = Units()


@dataclass(frozen=True)
class Retelling:
    """A problem in other words.

    Attributes
    ----------
    name : str
    table : callable
        The table of a problem file in these words.
    units : Units
    mirrored : bool
        Whether left and right are exchanged.
    """

    name: str
    table: Callable[[Table], dict[str, Any]]
    units: Units = _SAME
    mirrored: bool = False

    def apply(self, problem: Problem) -> Problem:
        """The problem in these words."""
        return build_problem(self.table(problem.table))


class Answer(NamedTuple):
    """What a plan says, in units of the scene it was told in.

    Attributes
    ----------
    value : float
    breaks : ndarray, shape (k + 1,)
        Over the duration of the plan.
    torques : ndarray, shape (k, 2, d + 1)
        Coefficients over the torque limits.
    """

    value: float
    breaks: Array
    torques: Array


class Difference(NamedTuple):
    """By how much two answers differ, relatively: in value and in their torques.

    The latter is infinite where one plan has more pieces of torque than the other.
    """

    value: float
    torques: float


def in_units(units: Units, name: str = "") -> Retelling:
    """Tell a problem in other units."""

    def change(table: Table) -> dict[str, Any]:
        new: dict[str, Any] = copy.deepcopy(dict(table))
        length, mass, time = units
        body = new["object"]
        body["vertices"] = (length * np.array(body["vertices"], dtype=float)).tolist()
        body["mass"] *= mass
        if "inertia" in body:
            body["inertia"] *= mass * length**2
        factors = {
            "length": length,
            "radius": length,
            "inertia": mass * length**2,
            "viscous": units.torque * time,
            "dry": units.torque,
            "torque_limit": units.torque,
            "speed_limit": 1 / time,
        }
        for finger in new["fingers"].values():
            finger["base"] = (length * np.array(finger["base"], dtype=float)).tolist()
            for key in factors.keys() & finger.keys():
                finger[key] *= factors[key]
        new["gravity"] = new.get("gravity", 9.81) * length / time**2
        new["epsilon"] *= units.force
        new["start"]["x"] *= length
        for until in _untils(new):
            if "x" in until:
                until["x"] *= length
        return new

    return Retelling(name or f"{units.length:g} lengths, {units.mass:g} masses", change, units)


def mirrored() -> Retelling:
    """Tell a problem as a mirror shows it: x becomes -x, and the fingers change places."""

    def change(table: Table) -> dict[str, Any]:
        new: dict[str, Any] = copy.deepcopy(dict(table))
        body = new["object"]
        count = len(body["vertices"])
        body["vertices"] = [[-x, y] for x, y in reversed(body["vertices"])]

        def rename(contact: Contact) -> Contact:
            last = count - 1 if contact.feature == "v" else count - 2
            finger = None if contact.finger is None else 1 - contact.finger
            return Contact(contact.feature, (last - contact.index) % count, contact.surface, finger)

        new["fingers"] = {"1": new["fingers"]["2"], "2": new["fingers"]["1"]}
        for finger in new["fingers"].values():
            finger["base"] = [-finger["base"][0], finger["base"][1]]
        friction = new["friction"]
        friction["finger1"], friction["finger2"] = friction["finger2"], friction["finger1"]
        new["start"] = {"flush": (count - 2 - new["start"]["flush"]) % count} | {
            "x": -new["start"]["x"]
        }
        for until in _untils(new):
            for key in until:
                until[key] = -until[key]
        return _rename(new, rename)

    return Retelling("mirrored", change, mirrored=True)


def renumbered(by: int) -> Retelling:
    """Tell a problem with vertices that are counted from another one."""

    def change(table: Table) -> dict[str, Any]:
        new: dict[str, Any] = copy.deepcopy(dict(table))
        body = new["object"]
        count = len(body["vertices"])
        body["vertices"] = [body["vertices"][(k - by) % count] for k in range(count)]
        new["start"]["flush"] = (new["start"]["flush"] + by) % count

        def rename(contact: Contact) -> Contact:
            index = (contact.index + by) % count
            return Contact(contact.feature, index, contact.surface, contact.finger)

        return _rename(new, rename)

    return Retelling(f"renumbered by {by}", change)


def reordered(seed: int) -> Retelling:
    """Tell a problem with the contacts of each phase in another order."""

    def change(table: Table) -> dict[str, Any]:
        new: dict[str, Any] = copy.deepcopy(dict(table))
        generator = np.random.default_rng(seed)
        for phase in new["phases"]:
            order = generator.permutation(len(phase["contacts"]))
            phase["contacts"] = [phase["contacts"][k] for k in order]
        return new

    return Retelling(f"contacts in another order ({seed})", change)


RETELLINGS = (
    in_units(Units.of(7.0, 3.0)),
    in_units(Units.of(0.02, 1e-3)),
    in_units(Units.of(100.0, 1e4)),
    in_units(Units(1e3, 1e3, 1.0), "mm and g"),
    mirrored(),
    renumbered(2),
    reordered(0),
)
"""What the study tells every problem in."""


def answer(
    problem: Problem, objective: str, telling: Retelling | None = None, **options: Any
) -> Answer:
    """Plan a problem that was told so, and give the answer in units of the first telling."""
    units = telling.units if telling else _SAME
    if objective == Objective.EFFORT.value:
        options["time_weight"] = units.torque**2
    plan = solve(problem, objective, **options)
    cost = {"time": units.time, "effort": units.torque**2 * units.time, "margin": units.force}
    return Answer(plan.value / cost[objective], *_torques(problem, plan.trajectory, telling))


def _torques(
    problem: Problem, trajectory: Trajectory, telling: Retelling | None
) -> tuple[Array, Array]:
    profile = trajectory.torque
    torques = profile.coefficients / problem.scene.torque_limit[:, None]
    if telling is not None and telling.mirrored:
        torques = -torques[:, ::-1]
    return profile.breaks / profile.duration, torques


def compare(one: Answer, other: Answer) -> Difference:
    """By how much two answers differ."""
    value = abs(other.value / one.value - 1)
    if one.torques.shape != other.torques.shape:
        return Difference(value, np.inf)
    torques = max(
        float(np.abs(other.breaks - one.breaks).max()),
        float(np.abs(other.torques - one.torques).max()),
    )
    return Difference(value, torques)


def _untils(table: Table) -> list[dict[str, float]]:
    """The `until` of every phase that ends at a coordinate."""
    untils = (phase.get("until") for phase in table["phases"])
    return [until for until in untils if isinstance(until, dict)]


def _rename(table: dict[str, Any], rename: Callable[[Contact], Contact]) -> dict[str, Any]:
    """Rename every contact of a table, which is changed."""

    def new_name(name: str) -> str:
        stem = name.removesuffix(ROLLING)
        match = _NAME.fullmatch(stem)
        assert match is not None, name
        feature, index, surface, finger = match.groups()
        contact = Contact(feature, int(index), surface, int(finger) - 1 if finger else None)
        return rename(contact).name + name[len(stem) :]

    for phase in table["phases"]:
        phase["contacts"] = [new_name(name) for name in phase["contacts"]]
        if isinstance(phase.get("until"), str):
            phase["until"] = new_name(phase["until"])
    return table
