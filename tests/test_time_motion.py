from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from plane import measure_gaps, unbalance
from planned import CosineMotion
from timed import drive, fastest_landing, instants
from wholearm.contacts.formation import Formation
from wholearm.geometry.curve import Curve
from wholearm.mechanics.dynamics import Directions
from wholearm.planning.time_domain.collocation import make_scheme
from wholearm.planning.time_domain.time_motion import StageMotion, TimeMotion


@pytest.fixture(scope="module")
def motions() -> list[TimeMotion]:
    return fastest_landing()


@pytest.fixture(scope="module")
def stages(motions: list[TimeMotion]) -> list[StageMotion]:
    return [stage for motion in motions for stage in motion.stages]


def test_the_equations_of_motion_hold_at_any_instant(stages: list[StageMotion]) -> None:
    rng = np.random.default_rng(8)
    for stage in stages:
        samples = stage.evaluate(np.sort(rng.uniform(0, stage.duration, 25)))
        sigma = np.tile(stage.directions.sigma, (25, 1))
        residual, size = unbalance(stage.formation, samples, sigma)
        # Rounding of sums of a few terms.
        assert (np.abs(residual) < 1e-11 * size).all()
        law = -stage.formation.friction * stage.directions.Xi * samples.c_n
        np.testing.assert_allclose(samples.c_t, law, rtol=1e-12)


def test_contacts_are_closed_and_stay_so_at_any_instant(stages: list[StageMotion]) -> None:
    rng = np.random.default_rng(9)
    for stage in stages:
        formation = stage.formation
        samples = stage.evaluate(rng.uniform(0, stage.duration, 40))
        assert np.abs(measure_gaps(formation, samples.z)).max() < 1e-14
        kinematics = formation.evaluate(samples.z, samples.z_dot)
        opening = np.einsum("nij,nj->ni", kinematics.A, samples.z_dot)
        change = np.einsum("nij,nj->ni", kinematics.A, samples.z_ddot) + kinematics.A_dot_v
        # Rounding, of speeds of some m/s and accelerations of some 100 m/s^2.
        assert np.abs(opening).max() < 1e-13 and np.abs(change).max() < 1e-9


def test_velocities_are_derivatives(stages: list[StageMotion]) -> None:
    for stage in stages:
        t, h = instants(stage, 10), 1e-3 * stage.duration / len(stage.points.fractions)
        around = [stage.evaluate(t + k * h) for k in (-2, -1, 1, 2)]
        z_dot, z_ddot = (
            (before2 - 8 * before + 8 * after - after2) / (12 * h)
            for before2, before, after, after2 in (
                [part.z for part in around],
                [part.z_dot for part in around],
            )
        )
        samples = stage.evaluate(t)
        # Pulling onto the contacts is no part of the derivative, nor is the error of collocation
        # that is spread over an interval part of the forces.
        assert np.abs(z_dot - samples.z_dot).max() < 1e-6 * np.abs(samples.z_dot).max()
        assert np.abs(z_ddot - samples.z_ddot).max() < 1e-3 * np.abs(samples.z_ddot).max()


def test_torques_are_polynomials_between_the_nodes(stages: list[StageMotion]) -> None:
    for stage in stages:
        part = stage.points
        x = np.array([0.1, 0.5, 0.9])
        t = (stage.duration * part.places(x)).ravel()
        shares = np.stack([(1 - x) ** 2, 2 * x * (1 - x), x**2], axis=1)
        expected = shares @ part.tau
        np.testing.assert_allclose(stage.torque.at(t), expected.reshape(-1, 2), atol=1e-11)
        np.testing.assert_array_equal(stage.evaluate(t).tau, stage.torque.at(t))
        assert stage.torque.duration == pytest.approx(stage.duration, rel=1e-14)
        assert stage.torque.coefficients.shape == (len(part.fractions), 2, 3)


def test_motions_pass_through_their_nodes(stages: list[StageMotion]) -> None:
    for stage in stages:
        hair = 1e-12 * stage.duration
        for t in (np.maximum(stage.breaks - hair, 0.0), stage.breaks):
            samples = stage.evaluate(t)
            # The solver's own tolerance, which pulling onto the contacts removes.
            np.testing.assert_allclose(samples.z, stage.points.nodes[:, 0], atol=1e-8)
            np.testing.assert_allclose(samples.z_dot, stage.points.nodes[:, 1], atol=1e-6)


def test_stages_and_phases_pass_into_one_another(motions: list[TimeMotion]) -> None:
    every = [stage for motion in motions for stage in motion.stages]
    state = np.stack([every[0].points.nodes[0, 0], np.zeros(5)])
    for stage in every:
        # Rounding of velocities that count in the durations of two stages, and the tolerance of
        # the solver.
        np.testing.assert_allclose(stage.points.nodes[0], state, atol=1e-6)
        state = stage.points.nodes[-1]
    np.testing.assert_allclose(state[1], 0.0, atol=1e-6)


def test_a_phase_is_its_stages_one_after_the_other(motions: list[TimeMotion]) -> None:
    for motion in motions:
        durations = [stage.duration for stage in motion.stages]
        assert motion.duration == pytest.approx(sum(durations), rel=1e-14)
        assert motion.contacts == motion.stages[0].formation.names
        rng = np.random.default_rng(10)
        for start, stage in zip(motion.starts, motion.stages, strict=False):
            t = rng.uniform(0.01, 0.99, 7) * stage.duration
            whole, own = motion.evaluate(start + t), stage.evaluate(t)
            for given, got in zip(own, whole, strict=True):
                # The clock of the phase rounds differently from that of the stage.
                np.testing.assert_allclose(got, given, rtol=1e-8, atol=1e-8)
            np.testing.assert_allclose(motion.torque.at(start + t), own.tau, atol=1e-9)
        shuffled = rng.permutation(np.linspace(0.0, motion.duration, 30))
        for given, got in zip(
            motion.evaluate(np.sort(shuffled)), motion.evaluate(shuffled), strict=True
        ):
            np.testing.assert_array_equal(got, given[np.argsort(np.argsort(shuffled))])


@lru_cache(maxsize=16)
def drive_and_return(curve: Curve, name: str, degree: int, count: int) -> tuple[float, float]:
    """What a motion that is known misses in z and in c_n when only its points are given."""
    formation, segment = curve.formation, curve.segments[0]
    start = CosineMotion(curve, 0.2, 15.0).evaluate(np.zeros(1))
    formation = Formation(formation.scene, formation.contacts[:3])
    directions = Directions(segment.Xi[:3], segment.sigma)
    tau = np.stack([start.tau[0], 0.9 * start.tau[0]])
    sample = drive(formation, start.z[0], tau, directions, 0.06)
    dense = sample(make_scheme("legendre", 7), 8)
    scheme = make_scheme(name, degree)
    motion = StageMotion(formation, directions, scheme, sample(scheme, count), np.zeros(0))
    t = 0.06 * dense.places(make_scheme("legendre", 7).points).ravel()
    got = motion.evaluate(t)
    z, forces = dense.z.reshape(-1, 5), dense.forces.reshape(-1, 3)
    return float(np.abs(got.z - z).max()), float(np.abs(got.c_n - forces).max())


@pytest.mark.parametrize("name, degree", [("radau", 2), ("radau", 3), ("legendre", 3)])
def test_a_known_motion_is_given_back(curves: tuple[Curve, ...], name: str, degree: int) -> None:
    # Torques are known exactly, so what they lead to is, whatever the points were.
    place, force = drive_and_return(curves[3], name, degree, 12)
    assert place < 1e-9 and force < 1e-5
