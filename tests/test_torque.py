from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.results.torque import TorqueProfile, read_torque_csv

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


def test_step_at_the_very_start() -> None:
    t, tau = np.array([0.0, 0.0, 1.0]), np.array([[9.0, 9.0], [1.0, 1.0], [2.0, 2.0]])
    assert at(TorqueProfile.join_rows(t, tau), [0.0, 1.0]) == [[1.0, 1.0], [2.0, 2.0]]


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
