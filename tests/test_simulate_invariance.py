"""What a simulation says does not depend on the words in which its problem is told."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest

from planned import plan, plan_landing
from pushing import pushed, rocking
from retold import Retold, in_units, mirror, renumber
from wholearm.problem.definition import Problem
from wholearm.results.torque import TorqueProfile
from wholearm.simulation.events import Event, Simulation
from wholearm.simulation.simulate import simulate

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
