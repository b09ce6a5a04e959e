from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.results.torque import (
    ERROR,
    TorqueProfile,
    place_rows,
    read_rows,
    read_torque_csv,
    sample_rows,
)

GOOD = "t,tau1,tau2\n0,1,-1\n0.5,2,-2\n0.5,4,0\n2,1,3\n"


def write(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    return str(path)


def at(profile: TorqueProfile, t: ArrayLike) -> list[list[float]]:
    values: list[list[float]] = profile.at(np.asarray(t, dtype=float)).tolist()
    return values


def test_linear_rows_with_a_step(tmp_path: Path) -> None:
    profile = read_torque_csv(write(tmp_path / "a.csv", GOOD))
    assert profile.breaks.tolist() == [0.0, 0.5, 2.0]
    assert profile.duration == 2.0
    assert at(profile, [0.0, 0.25]) == [[1.0, -1.0], [1.5, -1.5]]
    # Just before the step and at it, where the later row holds.
    np.testing.assert_allclose(profile.at(np.array([0.5 - 1e-12])), [[2, -2]], atol=1e-10)
    assert at(profile, [0.5]) == [[4.0, 0.0]]
    assert at(profile, [1.25, 2.0]) == [[2.5, 1.5], [1.0, 3.0]]


@pytest.mark.parametrize(
    "text",
    [
        "tau2, note ,t,tau1\n-1,a,0,1\n-2,b,0.5,2\n0,c,0.5,4\n3,,2,1\n",
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\n\n"),
        "\ufeff" + GOOD,
        GOOD.replace("0.5", "5e-1").replace(",", " , "),
    ],
    ids=["other columns", "CRLF", "blank lines", "byte-order mark", "spaces"],
)
def test_the_same_file_in_other_words(tmp_path: Path, text: str) -> None:
    profile = read_torque_csv(write(tmp_path / "a.csv", text))
    plain = read_torque_csv(write(tmp_path / "b.csv", GOOD))
    np.testing.assert_array_equal(profile.breaks, plain.breaks)
    np.testing.assert_array_equal(profile.coefficients, plain.coefficients)


@pytest.mark.parametrize(
    "text, key, problem",
    [
        ("", "t", "an empty file"),
        ("\n\n", "t", "an empty file"),
        ("t,tau1\n0,1\n1,1\n", "tau2", "column is missing; t,tau1 given"),
        ("0,1,1\n1,1,1\n", "t", "column is missing"),
        ("t,tau1,tau2\n", "t", "0 rows"),
        ("t,tau1,tau2\n0,1,1\n", "t", "1 rows"),
        (GOOD.replace("2,-2", "two,-2"), "tau1", "'two' on line 3"),
        (GOOD.replace("2,-2", "2,nan"), "tau2", "'nan' on line 3"),
        (GOOD.replace("2,-2", "inf,2"), "tau1", "'inf' on line 3"),
        (GOOD.replace("2,-2", "2"), "tau2", "'' on line 3"),
        (GOOD.replace("2,-2", "2,").replace("\n0,", "\n\n\n0,"), "tau2", "'' on line 5"),
        (GOOD.replace("2,1,3", "0.4,1,3"), "t", "goes back from 0.5 to 0.4"),
        (GOOD.replace("2,1,3", "0.5,1,3"), "t", "three times"),
        (GOOD.replace("\n0,1", "\n0.1,1"), "t", "first time is 0.1"),
        (GOOD.replace("\n0,1", "\n-0.1,1"), "t", "first time is -0.1"),
        ("t,tau1,tau2\n0,1,1\n0,2,2\n", "t", "every time is 0"),
    ],
)
def test_bad_csv_names_file_column_and_line(
    tmp_path: Path, text: str, key: str, problem: str
) -> None:
    path = write(tmp_path / "bad.csv", text)
    with pytest.raises(InputError) as caught:
        read_torque_csv(path)
    assert (caught.value.source, caught.value.key) == (path, key)
    assert problem in caught.value.problem


@pytest.mark.parametrize("content", [b"\xff\xfe\x00t", b"t,tau1,tau2\n0,\x00,1\n1,1,1\n"])
def test_not_text(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"bad\.csv"):
        read_torque_csv(str(path))


@pytest.mark.parametrize("degree", [0, 1, 3, 8])
def test_fit_is_exact_for_polynomials(degree: int) -> None:
    rng = np.random.default_rng(degree)
    coefficients = rng.uniform(-1, 1, (2, degree + 1))

    def function(t: Array) -> Array:
        return np.column_stack([np.polyval(row, t) for row in coefficients])

    profile = TorqueProfile.fit(np.array([0.0, 0.3, 1.0]), function, degree)
    t = np.linspace(0, 1, 31)
    # Rounding of a Vandermonde inverse of degree 8.
    np.testing.assert_allclose(profile.at(t), function(t), atol=1e-12)


def test_fit_keeps_a_step_at_a_break() -> None:
    def function(t: Array) -> Array:
        return np.column_stack([np.where(t < 0.3, 1.0, 5.0), t])

    profile = TorqueProfile.fit(np.array([0.0, 0.3, 1.0]), function, 4)
    np.testing.assert_allclose(profile.at(np.array([0.3 - 1e-9, 0.3])), [[1, 0.3], [5, 0.3]], 1e-8)


def test_chain_puts_profiles_one_after_the_other() -> None:
    one = TorqueProfile(np.array([0.0, 1.0]), np.array([[[1.0], [2.0]]]))
    two = TorqueProfile(np.array([0.0, 0.5, 2.0]), np.array([[[3.0, 1.0], [4.0, 0.0]]] * 2))
    both = TorqueProfile.chain([one, two])
    np.testing.assert_array_equal(both.breaks, [0.0, 1.0, 1.5, 3.0])
    t = np.array([0.1, 0.4, 1.9])
    # Shifting the times costs rounding only.
    np.testing.assert_allclose(both.at(1.0 + t), two.at(t), atol=1e-14)
    np.testing.assert_array_equal(both.at(np.array([0.7])), [[1.0, 2.0]])


def test_numbers_that_overflow_are_named(tmp_path: Path) -> None:
    path = tmp_path / "torques.csv"
    path.write_text("t,tau1,tau2\n0,0,0\n1,-1e308,0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"tau1: -1e308 on line 3 given; allowed are -1e\+30"):
        read_torque_csv(str(path))


def test_a_stretch_of_torques_is_the_same_torques() -> None:
    breaks = np.array([0.0, 0.3, 0.5])
    profile = TorqueProfile(breaks, np.random.default_rng(0).normal(size=(2, 2, 4)))
    part = profile.cut(0.1, 0.4)
    assert part.breaks.tolist() == [0.1, 0.3, 0.4]
    times = np.linspace(0.1, 0.4, 50)[:-1]
    np.testing.assert_allclose(part.at(times), profile.at(times), atol=1e-13)
    longer = profile.cut(-0.1, 0.7)
    for time, end in ((-0.05, 0.0), (0.6, 0.5)):
        at, held = longer.at(np.array([time])), profile.at(np.array([end]))
        np.testing.assert_allclose(at, held, atol=1e-13)


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
