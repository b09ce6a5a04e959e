"""What a simulation says does not depend on units, mirroring and numbering of its problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from planned import plan, plan_landing
from pushing import pushed, rocking
from retelling import RETELLINGS, Retelling
from wholearm.contacts.elemental import parse_contact
from wholearm.problem.definition import Problem
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import Event, Simulation
from wholearm.simulation.simulate import simulate

Told = tuple[Problem, TorqueProfile]


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


@pytest.mark.parametrize("telling", RETELLINGS, ids=lambda telling: telling.name)
@pytest.mark.parametrize("make", [box, landing, slide])
def test_answers_agree(make: Callable[[], Told], telling: Retelling) -> None:
    (problem, torque), first = begin(make)
    told = telling.apply(problem)
    other = simulate(told, telling.tell_torque(torque), tolerance=1e-11)
    assert other.outcome.kind is first.outcome.kind

    def tell(event: Event) -> tuple[str, str]:
        name = event.contact
        if name.startswith("joint"):
            name = f"joint {3 - int(name[-1])}" if telling.mirrored else name
        elif name:
            name = telling.rename(parse_contact(name, problem.scene), told.scene).name
        return event.kind.value, name

    names = [tell(event) for event in first.events if event.contact[:1] in ("", "v", "j")]
    # Events of one instant have no order.
    assert sorted(names) == sorted((event.kind.value, event.contact) for event in other.events)
    times = telling.units.time * np.sort([event.time for event in first.events])
    assert np.sort([event.time for event in other.events]) == pytest.approx(times, rel=1e-8)
    length = told.scene.scales.length
    ends = telling.tell(np.append(first.z[-1], first.z_dot[-1]))[:5]
    assert np.abs((other.z[-1] - ends) / [length, length, 1.0, 1.0, 1.0]).max() < 1e-8
    assert other.steps == pytest.approx(first.steps, abs=3)
    assert np.abs(other.energies.residual).max() < 1e-9 * np.abs(other.energies.work).max()
