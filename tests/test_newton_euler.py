from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from plane import make_formation, make_scene
from planned import plan, plan_landing
from tipping import box, tipped
from wholearm.benchmark.stress.plan_check import check_plan, check_rates
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.problem.definition import Problem
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import Motion, Samples, Trajectory
from wholearm.scene.model import Friction, Scene
from wholearm.verification.newton_euler import BODIES, Balance, balance

CONTACTS = "v0-palm v1-finger1 v3-finger2 e2-tip1 v2-tip2"


def scene_of(mu: float = 0.3) -> Scene:
    scene = make_scene(friction=mu)
    right, left = (replace(link, viscous=0.02, dry=0.03) for link in scene.fingers)
    return Scene(scene.polygon, (right, left), Friction(mu, 0.8 * mu, 0.6 * mu))


def random_samples(formation: Formation, count: int = 30) -> Samples:
    """States and forces that obey no equation, but friction that opposes the sliding."""
    rng = np.random.default_rng(5)
    z = rng.uniform(-1, 1, (count, 5)) * [0.05, 0.05, 1.0, 0.5, 0.5] + [0, 0.05, 0, 1.2, 1.9]
    v, a = rng.uniform(-1, 1, (count, 5)), rng.uniform(-5, 5, (count, 5))
    c_n = rng.uniform(0.1, 3.0, (count, formation.n_contacts))
    v_t = np.einsum("nij,nj->ni", formation.evaluate(z, v).A_t, v)
    tau = rng.uniform(-1, 1, (count, 2))
    return Samples(z, v, a, tau, c_n, -formation.friction * np.sign(v_t) * c_n)


def check(formation: Formation, samples: Samples) -> Balance:
    return balance(formation.scene, formation.contacts, formation.rolling, samples)


def units(scene: Scene) -> Array:
    return np.array([scene.scales.force] * 2 + [scene.scales.torque] * 3)


def test_virtual_power() -> None:
    """Contacts do the power of c_n on gaps that open and of c_t on what slides, for any motion."""
    scene = scene_of()
    formation = make_formation(scene, CONTACTS)
    samples = random_samples(formation)
    z, v, a, tau, c_n, c_t = samples
    found = check(formation, samples)
    rows = formation.evaluate(z, v)
    np.testing.assert_allclose(found.gaps * scene.scales.length, rows.C, atol=1e-14)
    rates = np.einsum("nij,nj->ni", rows.A, v)
    np.testing.assert_allclose(found.rates * scene.scales.speed, rates, atol=1e-13)
    w = np.random.default_rng(6).uniform(-1, 1, z.shape)
    power = -(scene.mass_diagonal * a * w).sum(axis=1) + w @ scene.applied_force
    power += ((tau - scene.viscous[3:] * v[:, 3:]) * w[:, 3:]).sum(axis=1)
    power -= (scene.dry[3:] * np.sign(v[:, 3:]) * w[:, 3:]).sum(axis=1)
    power += (c_n * np.einsum("nij,nj->ni", rows.A, w)).sum(axis=1)
    power += (c_t * np.einsum("nij,nj->ni", rows.A_t, w)).sum(axis=1)
    expected = (found.forces * units(scene) * w).sum(axis=1)
    np.testing.assert_allclose(expected, power, rtol=1e-11, atol=1e-12)
    assert not found.against.any()


def phases_of(problem: Problem, trajectory: Trajectory) -> list[tuple[Formation, Samples]]:
    found = []
    for phase, motion in zip(problem.phases, trajectory.motions, strict=True):
        t = np.linspace(0.0, motion.duration, 301)[1:-1]
        found.append((phase.formation, motion.evaluate(t)))
    return found


@pytest.mark.parametrize("case", [plan, plan_landing, lambda: (box(), tipped())])
def test_motions_with_their_forces_balance(case: object) -> None:
    """By inverse dynamics along curves and with three contacts, and a plan with a rolling one."""
    assert callable(case)
    for formation, samples in phases_of(*case()):
        found = check(formation, samples)
        assert not found.against.any()
        size, _, text = found.find_worst()
        # Configurations of the landing are closed to 1e-12.
        assert size < 1e-9, text


def test_friction_the_wrong_way_is_named() -> None:
    formation, samples = phases_of(*plan())[1]
    column = formation.names.index("v3-finger1")
    c_t = samples.c_t.copy()
    c_t[100:110, column] *= -1
    found = check(formation, samples._replace(c_t=c_t))
    assert found.against[100:110, column].all() and found.against.sum() == 10
    # Friction is taken from the velocities, so that what balances is still the motion itself.
    assert found.find_worst()[0] < 1e-9


@pytest.mark.parametrize("joint", [0, 1])
def test_dry_friction_the_wrong_way_is_named(joint: int) -> None:
    formation, samples = phases_of(*plan())[1]
    dry, tau = formation.scene.dry[3 + joint], samples.tau.copy()
    rows = slice(120, 123)
    tau[rows, joint] -= 2 * dry * np.sign(samples.z_dot[rows, 3 + joint])
    size, row, text = check(formation, samples._replace(tau=tau)).find_worst()
    assert size == pytest.approx(2 * dry / formation.scene.scales.torque, rel=1e-6)
    assert 120 <= row < 123
    assert text.startswith(f"the equation of motion of {BODIES[3 + joint]} misses ")
    assert text.endswith(f"joint {joint + 1} moves against the sense that its friction assumes")


def test_at_rest_friction_may_be_anything_in_its_cone() -> None:
    """An object that lies on the palm between two fingers that press it sideways."""
    scene = scene_of()
    formation = make_formation(scene, "v0-palm v1-palm")
    rest = np.zeros((3, 5))
    z = np.tile([0.0, 0.03, 0.0, 0.5, 2.6], (3, 1))
    weight = scene.polygon.mass * scene.gravity
    c_n = np.full((3, 2), weight / 2)
    push = np.array([0.0, 0.9, 1.1]) * 0.3 * weight / 2
    # One vertex is pushed one way and the other one the other way, as far as the cone and farther.
    c_t = np.column_stack([push, -push])
    tau = np.array([[0.03, -0.03], [-0.02, 0.0], [0.04, 0.0]])
    found = check(formation, Samples(z, rest, rest, tau, c_n, c_t))
    left = found.forces * units(scene)
    np.testing.assert_allclose(left[:2], 0.0, atol=1e-13)
    # Beyond the dry friction of joint 1, which is 0.03 N m.
    np.testing.assert_allclose(left[2], [0, 0, 0, 0.01, 0], atol=1e-13)
    uneven = np.column_stack([push, 0 * push])
    forces = check(formation, Samples(z, rest, rest, 0 * tau, c_n, uneven)).forces
    cone = 0.3 * weight / 2
    np.testing.assert_allclose(forces[:, 0] * scene.scales.force, np.minimum(push, cone))


def test_rolling_contacts_that_slip_are_named() -> None:
    formation, samples = phases_of(box(), tipped())[1]
    assert formation.rolling
    v = samples.z_dot.copy()
    v[50, 0] += 0.01 * formation.scene.scales.speed
    found = check(formation, samples._replace(z_dot=v))
    column = formation.names.index("v1-palm")
    assert abs(found.rates[50, column]) == pytest.approx(0.01, rel=1e-6)
    assert np.abs(np.delete(found.rates, 50, axis=0)).max() < 1e-9


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
