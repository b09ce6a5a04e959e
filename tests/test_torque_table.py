from __future__ import annotations

import math

import numpy as np
import pytest

from planned import plan
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.results.torque import TorqueProfile
from wholearm.results.torque_table import ERROR, place_rows, read_rows, sample_rows
from wholearm.verification.verify import verify


def bent() -> TorqueProfile:
    """Smooth torques of about 2 N m with a step, in pieces of very different lengths."""

    def torque(t: Array) -> Array:
        return np.column_stack([2 * np.sin(9 * t), np.cos(25 * t) + np.where(t < 0.4, 0.0, 0.7)])

    return TorqueProfile.fit(np.array([0.0, 0.1, 0.101, 0.4, 0.5, 0.75, 1.0]), torque, 12)


@pytest.mark.parametrize("error", [1e-3, ERROR, 1e-6])
def test_rows_give_the_torques_back(error: float) -> None:
    torque = bent()
    rows = place_rows(torque, error)
    t = np.random.default_rng(1).uniform(0, 1, 4000)
    missed = np.abs(read_rows(rows).at(t) - torque.at(t)).max()
    assert missed < 3 * error * np.abs(torque.at(t)).max()
    assert (np.diff(rows[:, 0]) >= 0).all() and np.isin(torque.breaks, rows[:, 0]).all()
    # One step, where the torques have it.
    assert rows[np.flatnonzero(np.diff(rows[:, 0]) == 0), 0].tolist() == [0.4]


@pytest.mark.parametrize("error", [1e-3, ERROR])
def test_rows_are_no_steeper_than_the_torques_may_be(error: float) -> None:
    def ramp(t: Array) -> Array:
        bend = np.maximum(t - 0.5, 0.0)
        return np.column_stack([4 * t - 20 * bend**2, 1 - 4 * t + 26 * bend**2])

    torque = TorqueProfile.fit(np.linspace(0, 0.65, 14), ramp, 4)
    limits = np.full(2, 4.0)
    slopes = [
        np.abs(np.diff(rows[:, 1:], axis=0) / np.diff(rows[:, 0])[:, None])
        for rows in (place_rows(torque, error), place_rows(torque, error, limits))
    ]
    assert slopes[0].max() > 4 * (1 + 1e-6)
    assert slopes[1].max() < 4 * (1 + 1e-9)


def test_what_lines_miss_has_no_mean_and_no_moment() -> None:

    def rising(t: Array) -> Array:
        return np.column_stack([np.exp(3 * t), t**4 + np.where(t < 0.4, 0.0, 0.7)])

    torque = TorqueProfile.fit(np.array([0.0, 0.1, 0.4, 1.0]), rising, 8)
    table = read_rows(place_rows(torque, 1e-3))
    points, weights = np.polynomial.legendre.leggauss(8)
    breaks = np.union1d(torque.breaks, table.breaks)
    start, h = breaks[:-1, None], np.diff(breaks)[:, None]
    t = (start + h * (points + 1) / 2).ravel()
    w = (weights * h / 2).ravel()
    for part in t < 0.4, t > 0.4:
        missed = (table.at(t) - torque.at(t))[part]
        for moment in np.ones_like(t), t:
            total = np.abs((w * moment)[part] @ missed)
            assert (total < 1e-9 * (w[part] @ np.abs(missed)) + 1e-15).all()


def test_linear_torques_take_no_rows_between_breaks() -> None:
    t, tau = np.array([0.0, 0.3, 0.3, 1.0]), np.array([[0, 1], [1, 0], [3, 0], [2, 2.0]])
    rows = place_rows(TorqueProfile.join_rows(t, tau))
    np.testing.assert_allclose(rows, np.column_stack([t, tau]), atol=1e-14)


def test_rows_keep_torque_limits() -> None:
    """Torques that run into a limit and stay there."""
    t = np.array([0.0, 0.3, 0.6])

    def torque(x: Array) -> Array:
        rising = 2 - 20 * np.minimum(x - 0.3, 0.0) ** 2
        return np.column_stack([rising, -rising])

    rows = place_rows(TorqueProfile.fit(t, torque, 4), 1e-3)
    assert np.abs(rows[:, 1:]).max() < 2 * (1 + 1e-12)


def test_rows_carry_a_motion_as_its_torques_do() -> None:
    problem, trajectory = plan()
    report = verify(problem, read_rows(place_rows(trajectory.torque)))
    assert report.ok, report.to_text()
    for phase, arrival in zip(report.phases, trajectory.phase_starts[1:], strict=True):
        assert phase.arrival == pytest.approx(arrival, abs=1e-5)


@pytest.mark.parametrize("rate", [10.0, 1000.0, 31.7])
def test_samples(rate: float) -> None:
    torque = bent()
    linear, hold = (sample_rows(torque, rate, kind) for kind in ("linear", "hold"))
    count = math.ceil(rate - 1e-9) + 1
    np.testing.assert_allclose(linear[:, 0], np.arange(count) / rate, atol=1e-13)
    np.testing.assert_allclose(linear[:, 1:], torque.at(linear[:, 0] + 1e-15), atol=1e-12)
    assert linear[-1, 0] >= torque.duration > linear[-2, 0]
    staircase = read_rows(hold)
    middle = linear[:-1, 0] + 0.5 / rate
    np.testing.assert_array_equal(staircase.at(middle), linear[:-1, 1:])
    assert len(hold) == 2 * (count - 1) and hold[-1, 0] == linear[-1, 0]


@pytest.mark.parametrize("rate", [0.0, -1.0, math.nan, math.inf, 0.5, 1e8])
def test_rates_out_of_range(rate: float) -> None:
    with pytest.raises(InputError) as caught:
        sample_rows(bent(), rate, "linear")
    assert caught.value.key == "sample_rate"
