from __future__ import annotations

import numpy as np
import pytest

from plane import measure_gaps, measure_slip, unbalance
from planned import CosineMotion
from timed import fastest_landing, instants, integrate
from wholearm.collocation import radau
from wholearm.curve import Curve
from wholearm.dynamics import Directions
from wholearm.stage import StagePoints
from wholearm.timemotion import StageMotion, Start, TimeMotion
from wholearm.trajectory import Samples


@pytest.fixture(scope="module")
def motions() -> list[TimeMotion]:
    return fastest_landing()


@pytest.fixture(scope="module")
def stages(motions: list[TimeMotion]) -> list[StageMotion]:
    return [stage for motion in motions for stage in motion.stages]


def collocate(motion: CosineMotion, degree: int, count: int) -> StageMotion:
    """An exact motion by what it is at collocation points."""
    scheme = radau(degree)
    t = (np.arange(count)[:, None] + scheme.points).ravel() * motion.duration / count
    # Inside the motion: at its very end the torque of a next segment would answer.
    z, v, a, tau, c_n, _ = motion.evaluate(t)
    segment = motion.curve.segments[0]
    start = Start(motion.curve.evaluate(np.zeros(1)).z[0], np.zeros(5))
    points = StagePoints(motion.duration, z, v, a, c_n, tau)
    directions = Directions(segment.Xi, segment.sigma)
    return StageMotion(motion.curve.formation, directions, scheme, start, points)


def test_the_equations_of_motion_hold_at_any_instant(stages: list[StageMotion]) -> None:
    rng = np.random.default_rng(8)
    for stage in stages:
        samples = stage.evaluate(np.sort(rng.uniform(0, stage.duration, 25)))
        for k in range(25):
            row = Samples(*(part[k] for part in samples))
            residual, size = unbalance(stage.formation, row, stage.directions.sigma)
            # Rounding of sums of a few terms.
            assert (np.abs(residual) < 1e-11 * size).all()
            law = -stage.formation.friction * stage.directions.Xi * row.c_n
            np.testing.assert_allclose(row.c_t, law, rtol=1e-12)


def test_contacts_are_closed_and_stay_so_at_any_instant(stages: list[StageMotion]) -> None:
    rng = np.random.default_rng(9)
    for stage in stages:
        formation = stage.formation
        samples = stage.evaluate(rng.uniform(0, stage.duration, 40))
        assert max(np.abs(measure_gaps(formation, z)).max() for z in samples.z) < 1e-14
        kinematics = formation.evaluate(samples.z, samples.z_dot)
        opening = np.einsum("nij,nj->ni", kinematics.A, samples.z_dot)
        change = np.einsum("nij,nj->ni", kinematics.A, samples.z_ddot) + kinematics.A_dot_v
        # Rounding, of speeds of some m/s and accelerations of some 100 m/s^2.
        assert np.abs(opening).max() < 1e-13 and np.abs(change).max() < 1e-9


def test_velocities_are_derivatives(stages: list[StageMotion]) -> None:
    for stage in stages:
        t, h = instants(stage, 10), 1e-3 * stage.duration / stage.intervals
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


def test_torques_pass_through_the_points(stages: list[StageMotion]) -> None:
    for stage in stages:
        scheme, count = stage.scheme, stage.intervals
        places = np.arange(count)[:, None] + scheme.points
        # A hair early, so that the interval answers whose end it is.
        t = places.ravel() * stage.duration / count * (1 - 1e-12)
        # Slopes of some 1000 N m/s over that hair.
        np.testing.assert_allclose(stage.torque.at(t), stage.points.tau, atol=1e-9)
        np.testing.assert_array_equal(stage.evaluate(t).tau, stage.torque.at(t))
        assert stage.torque.duration == pytest.approx(stage.duration, rel=1e-14)
        assert stage.torque.coefficients.shape == (count, 2, scheme.degree)


def test_stages_start_and_end_at_their_points(stages: list[StageMotion]) -> None:
    for stage in stages:
        ends = stage.evaluate(np.array([0.0, stage.duration]))
        for row, z, v in (
            (0, *stage.start),
            (1, stage.points.z[-1], stage.points.v[-1]),
        ):
            # The solver's own tolerance, which pulling onto the contacts removes.
            np.testing.assert_allclose(ends.z[row], z, atol=1e-9)
            np.testing.assert_allclose(ends.z_dot[row], v, atol=1e-7)


def test_position_and_velocity_are_continuous_over_intervals(stages: list[StageMotion]) -> None:
    for stage in stages:
        breaks = stage.torque.breaks[1:-1]
        hair = 1e-12 * stage.duration
        before, after = stage.evaluate(breaks - hair), stage.evaluate(breaks + hair)
        np.testing.assert_allclose(before.z, after.z, atol=1e-9)
        np.testing.assert_allclose(before.z_dot, after.z_dot, atol=1e-7)


def test_stages_and_phases_pass_into_one_another(motions: list[TimeMotion]) -> None:
    end = Start(motions[0].stages[0].start.z, np.zeros(5))
    for motion in motions:
        for stage in motion.stages:
            np.testing.assert_array_equal(stage.start.z, end.z)
            np.testing.assert_array_equal(stage.start.v, end.v)
            end = Start(stage.points.z[-1], stage.points.v[-1])
        np.testing.assert_array_equal(motion.end.z, end.z)
        np.testing.assert_array_equal(motion.end.v, end.v)
        samples = motion.evaluate(np.array([motion.duration]))
        np.testing.assert_allclose(samples.z[0], end.z, atol=1e-9)


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


def test_friction_opposes_sliding(stages: list[StageMotion]) -> None:
    for stage in stages:
        samples = stage.evaluate(instants(stage, 8))
        states = zip(samples.z, samples.z_dot, strict=True)
        slip = np.array([measure_slip(stage.formation, z, v) for z, v in states])
        power = samples.c_t * slip
        # Near a reversal slip is known to the error of collocation, 1e-5 of the largest.
        assert power.max() < 1e-4 * np.abs(power).max()


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_an_exact_motion_is_given_back(curves: tuple[Curve, ...], degree: int) -> None:
    exact = CosineMotion(curves[3], 0.2, 15.0)
    t = np.linspace(0.0, exact.duration, 101)[1:-1]
    truth, errors = exact.evaluate(t), []
    for count in (6, 12):
        samples = collocate(exact, degree, count).evaluate(t)
        errors.append(np.abs(samples.z - truth.z).max())
        assert np.abs(samples.tau - truth.tau).max() < 4.0 * (1.2 / count) ** degree
    # Torques between points are known to order d, and what they lead to, twice integrated and with
    # its ends in place, to two orders more.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(degree + 2, abs=0.6)
    assert errors[1] < 1e-4


def test_forward_integration_of_the_torques_reaches_the_end(stages: list[StageMotion]) -> None:
    for stage in stages:
        z, v = integrate(stage, *stage.start)
        # What planned and simulated states may differ by at the end of a phase [m, rad].
        np.testing.assert_allclose(z, stage.points.z[-1], atol=1e-5)
        fastest = np.abs(stage.points.v).max()
        np.testing.assert_allclose(v, stage.points.v[-1], atol=1e-4 * fastest)
