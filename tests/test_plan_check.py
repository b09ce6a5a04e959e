from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from wholearm.benchmark.stress.plan_check import check_plan, check_rates
from wholearm.common.arrays import Array
from wholearm.problem.definition import Problem
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Motion, Samples, Trajectory


@dataclass(frozen=True)
class Altered:
    """A motion with one of its fields altered."""

    motion: Motion
    field: str
    change: Array | float

    @property
    def duration(self) -> float:
        return self.motion.duration

    @property
    def contacts(self) -> tuple[str, ...]:
        return self.motion.contacts

    def evaluate(self, t: Array) -> Samples:
        rows = self.motion.evaluate(t)
        return rows._replace(**{self.field: getattr(rows, self.field) + self.change})


def test_a_good_plan_passes(heptagon: Problem, trajectory: Trajectory) -> None:
    assert check_plan(heptagon, trajectory) == []


@pytest.mark.parametrize(
    ("field", "change", "words"),
    [
        ("tau", np.array([0.01, 0.0]), "equation of theta_1 misses"),
        ("c_n", np.array([0.01, 0.0, 0.0, 0.0]), "equation of y misses"),
        ("c_t", np.array([0.0, 0.0, 1e-3, 0.0]), "off Coulomb's"),
        ("c_t", np.array([0.0, 0.0, 10.0, 0.0]), "outside its friction cone"),
        ("z", np.array([0.0, -1e-5, 0.0, 0.0, 0.0]), "object and palm overlap"),
        ("z", np.array([0.0, 1e-5, 0.0, 0.0, 0.0]), "gap of v1-palm"),
        ("z_dot", np.array([0.01, 0.0, 0.0, 0.0, 0.0]), "z and its rate differ"),
        ("z_ddot", np.array([1.0, 0.0, 0.0, 0.0, 0.0]), "z' and its rate differ"),
        ("c_n", -0.2, "short of epsilon"),
        ("tau", 5.0, "exceeds its limit"),
    ],
)
def test_what_is_altered_is_named(
    heptagon: Problem, trajectory: Trajectory, field: str, change: Array | float, words: str
) -> None:
    motions = list(trajectory.motions)
    motions[3] = Altered(motions[3], field, change)
    found = check_plan(heptagon, replace(trajectory, motions=tuple(motions)))
    assert any(words in text and "phase 4" in text for text in found), found


def test_torques_that_are_not_the_motion_s_are_named(
    heptagon: Problem, trajectory: Trajectory
) -> None:
    own = trajectory.torque
    other = TorqueProfile(own.breaks, own.coefficients * 1.01)
    found = check_plan(heptagon, replace(trajectory, torque=other))
    assert any("torque profile" in text for text in found)


def test_an_end_elsewhere_is_named(heptagon: Problem, trajectory: Trajectory) -> None:
    phases = list(heptagon.phases)
    until = phases[-1].until
    assert until.value is not None
    phases[-1] = replace(phases[-1], until=replace(until, value=until.value + 1e-3))
    found = check_plan(replace(heptagon, phases=tuple(phases)), trajectory)
    assert any("ends 0.001 from phi" in text for text in found)


def test_a_kink_that_a_curvature_hides_is_no_difference(heptagon: Problem) -> None:
    """A rate that is the same at four instants about the kink; its integral is known."""
    t, step = np.linspace(-0.5, 0.5, 6, retstep=True)
    bend = 1 / (2 * step)

    def sample(x: Array, wrong: float = 0.0) -> Samples:
        rate = np.abs(x) - bend * x**2
        value = x * np.abs(x) / 2 - bend * x**3 / 3 + wrong * (x > 0)
        none = np.zeros((len(x), 5))
        tables = (np.repeat(column[:, None], 5, axis=1) for column in (value, rate))
        return Samples(none, *tables, *3 * [none[:, :2]])

    middles = sample((t[1:] + t[:-1]) / 2)
    right = check_rates(heptagon.scene, t, sample(t), middles)
    assert np.ptp(sample(t).z_ddot[1:5, 0]) < 1e-12
    assert not any(text.startswith("z' and") for text in right)
    wrong = check_rates(heptagon.scene, t, sample(t, step**2 / 2), middles)
    assert any(text.startswith("z' and its rate differ by") for text in wrong)
