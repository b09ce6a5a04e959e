from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rows import each
from scenes import tipped
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.results.dwell_record import assemble
from wholearm.results.torque import ERROR, TorqueProfile, place_rows, read_torque_csv, sample_rows
from wholearm.results.trajectory import Samples, Trajectory, load_trajectory

ARRAYS = ["t", "q", "theta", "q_dot", "theta_dot", "q_ddot", "theta_ddot", "tau", "c_n", "c_t"]
TORQUE = ["torque_breaks", "torque_coefficients"]


@dataclass(frozen=True)
class Polynomials:
    """A motion of quintic coordinates and linear forces."""

    duration: float
    contacts: tuple[str, ...]
    seed: int

    def evaluate(self, t: Array) -> Samples:
        rng = np.random.default_rng(self.seed)
        z = [np.polynomial.Polynomial(c) for c in rng.uniform(-1, 1, (5, 6))]
        lines = rng.uniform(-1, 1, (2, 2 + 2 * len(self.contacts)))
        forces = lines[0] + np.asarray(t)[:, None] * lines[1]
        motion = [np.column_stack([own.deriv(k)(t) for own in z]) for k in range(3)]
        return Samples(*motion, *np.split(forces, [2, 2 + len(self.contacts)], axis=1))


MOTIONS = (
    Polynomials(0.7, ("v0-palm", "v1-palm", "v2-finger1"), 1),
    Polynomials(0.2, ("v1-palm", "e2-tip1", "v2-finger1"), 2),
)


@pytest.fixture
def trajectory() -> Trajectory:
    ends = [motion.evaluate(np.array([0.0, motion.duration])).tau for motion in MOTIONS]
    torque = TorqueProfile.join_rows(np.column_stack([[0.0, 0.7, 0.7, 0.9], np.vstack(ends)]))
    return assemble(MOTIONS, torque, {"status": "solved", "epsilon": 0.05}, samples=9)


def read_arrays(trajectory: Trajectory) -> dict[str, Any]:
    arrays: dict[str, Any] = {name: getattr(trajectory, name) for name in [*ARRAYS, "phase"]}
    arrays |= {
        "contacts": np.array(trajectory.contacts),
        "torque_breaks": trajectory.torque.breaks,
        "torque_coefficients": trajectory.torque.coefficients,
        "meta": np.array(json.dumps(dict(trajectory.meta))),
    }
    return arrays


def test_assemble_lays_phases_end_to_end(trajectory: Trajectory) -> None:
    assert trajectory.contacts == ("v0-palm", "v1-palm", "v2-finger1", "e2-tip1")
    expected = np.concatenate([np.linspace(0, 0.7, 9), 0.7 + np.linspace(0, 0.2, 9)])
    np.testing.assert_allclose(trajectory.t, expected, rtol=1e-13)
    assert trajectory.phase.tolist() == [0] * 9 + [1] * 9
    np.testing.assert_allclose(trajectory.phase_starts, [0.0, 0.7, 0.9])
    assert trajectory.duration == pytest.approx(0.9)
    second = MOTIONS[1].evaluate(np.linspace(0, 0.2, 9))
    for name in ("z", "z_dot", "z_ddot", "tau"):
        np.testing.assert_array_equal(getattr(trajectory, name)[9:], getattr(second, name))
    np.testing.assert_array_equal(trajectory.c_n[9:, [1, 3, 2]], second.c_n)
    np.testing.assert_array_equal(trajectory.c_t[9:, [1, 3, 2]], second.c_t)
    assert np.isnan(trajectory.c_n[9:, 0]).all() and np.isnan(trajectory.c_t[:9, 3]).all()


@pytest.mark.parametrize("t, phase, local", [(0.0, 0, 0.0), (0.3, 0, 0.3), (0.7, 1, 0.0)])
def test_at_asks_its_phase(trajectory: Trajectory, t: float, phase: int, local: float) -> None:
    """Forces of contacts of other phases are NaN."""
    motion = MOTIONS[phase]
    own = [trajectory.contacts.index(name) for name in motion.contacts]
    expected = motion.evaluate(np.array([local]))
    for k, (whole, wanted) in enumerate(zip(trajectory.at(t), expected, strict=True)):
        columns = np.arange(whole.shape[1]) if k < 4 else np.array(own)
        np.testing.assert_allclose(whole[:, columns], wanted, atol=1e-13)
        assert np.isnan(np.delete(whole, columns, axis=1)).all()


def test_at_reaches_the_end_and_no_farther(trajectory: Trajectory) -> None:
    end = trajectory.at(trajectory.duration)
    np.testing.assert_allclose(end.z, MOTIONS[1].evaluate(np.array([0.2])).z, atol=1e-14)
    for t in (-1e-9, trajectory.duration + 1e-9, float("nan")):
        with pytest.raises(InputError, match="outside the trajectory"):
            trajectory.at(t)


def test_file_keeps_every_bit(trajectory: Trajectory, tmp_path: Path) -> None:
    trajectory.save(tmp_path / "a.npz")
    loaded = load_trajectory(tmp_path / "a.npz")
    for name in [*ARRAYS, "phase"]:
        one, other = getattr(trajectory, name), getattr(loaded, name)
        assert one.dtype == other.dtype and one.tobytes() == other.tobytes()
    assert loaded.contacts == trajectory.contacts and loaded.meta == trajectory.meta
    np.testing.assert_array_equal(loaded.torque.breaks, trajectory.torque.breaks)
    np.testing.assert_array_equal(loaded.torque.coefficients, trajectory.torque.coefficients)
    # And the same file again from what was read.
    loaded.save(tmp_path / "b.npz")
    with np.load(tmp_path / "a.npz") as a, np.load(tmp_path / "b.npz") as b:
        assert a.files == b.files
        assert all(a[name].tobytes() == b[name].tobytes() for name in a.files)


def test_loaded_motions_reproduce_quintics(trajectory: Trajectory, tmp_path: Path) -> None:
    trajectory.save(tmp_path / "a.npz")
    loaded = load_trajectory(tmp_path / "a.npz")
    for motion, known in zip(loaded.motions, MOTIONS, strict=True):
        assert set(motion.contacts) == set(known.contacts)
        assert motion.duration == pytest.approx(known.duration)
        t = np.linspace(0, known.duration, 101)
        found, wanted = motion.evaluate(t), known.evaluate(t)
        # Second derivatives divide rounding by the square of the step, 1/40 s.
        for k, error in enumerate((1e-14, 1e-12, 1e-10, 1e-14)):
            np.testing.assert_allclose(found[k], wanted[k], atol=error)
        order = [known.contacts.index(name) for name in motion.contacts]
        np.testing.assert_allclose(found.c_n, wanted.c_n[:, order], atol=1e-13)
        np.testing.assert_allclose(found.c_t, wanted.c_t[:, order], atol=1e-13)


def changed(array: Any, change: str) -> Any:
    value = np.array(array)
    if change == "0-d":
        return np.array(1.0)
    if change == "short":
        return value[:-1]
    if change == "wide":
        return np.concatenate([value, value], axis=-1)
    if change == "text":
        return np.full(value.shape, "x")
    value = value.astype(float)
    value.flat[3 if value.size > 3 else 0] = {"nan": np.nan, "inf": np.inf}[change]
    return value


@each(
    "name, change",
    [(name, change) for name in [*ARRAYS, "phase"] for change in ("0-d", "inf", "text")]
    + [(name, "nan") for name in ARRAYS if name not in ("c_n", "c_t")]
    + [(name, "short") for name in [*ARRAYS[1:], "phase", "torque_coefficients"]]
    + [(name, "wide") for name in ARRAYS[1:]]
    + [(name, change) for name in TORQUE for change in ("0-d", "nan", "text")]
    + [("contacts", "0-d")]
    + [(name, "missing") for name in [*ARRAYS, "phase", "contacts", "meta", *TORQUE]],
)
def test_bad_array_is_named(trajectory: Trajectory, tmp_path: Path, name: str, change: str) -> None:
    arrays = read_arrays(trajectory)
    array = arrays.pop(name)
    if change != "missing":
        arrays[name] = changed(array, change)
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError) as caught:
        load_trajectory(tmp_path / "a.npz")
    assert caught.value.source == str(tmp_path / "a.npz")
    assert ("array is missing" in caught.value.problem) == (change == "missing")
    # A wrong length of t or of contacts shows in what depends on it.
    loose = {"t": {"t", "q"}, "contacts": {"contacts", "c_n"}}
    assert caught.value.key in loose.get(name, {name})


@each(
    "name, value, problem",
    [
        ("meta", np.array("{"), "is not JSON"),
        ("meta", np.array("[1]"), "not a JSON object"),
        ("meta", np.array(["{}", "{}"]), "is not JSON"),
        ("meta", np.array(1.0), "not a JSON object"),
        ("contacts", np.arange(4.0), "does not hold text"),
        ("t", np.linspace(1, 2, 18), "start at 0"),
        ("t", np.linspace(0, -1, 18), "increase"),
        ("t", np.zeros(18), "increase"),
        ("phase", np.array([0] * 9 + [2] * 9), "count up"),
        ("phase", np.array([1] * 9 + [0] * 9), "count up"),
        ("phase", np.array([0] * 17 + [1]), "two or more rows"),
        ("phase", np.array([0] * 9 + [10**12] * 9), "count up"),
        ("phase", np.array([0.0] * 9 + [1.0] * 9), "float64"),
        ("torque_breaks", np.array([0.0, 0.9, 0.7]), "increase"),
        ("torque_breaks", np.array([0.0, 0.9]), "needed"),
        ("q", np.full((18, 3), -1.1e6), r"beyond 1e\+06, the"),
        ("c_n", np.full((18, 4), -1.1e30), r"beyond 1e\+30, the"),
        ("torque_coefficients", np.full((2, 2, 4), -1.1e30), r"beyond 1e\+30, the"),
    ],
)
def test_bad_value_is_named(
    trajectory: Trajectory, tmp_path: Path, name: str, value: Any, problem: str
) -> None:
    np.savez(tmp_path / "a.npz", **(read_arrays(trajectory) | {name: value}))
    with pytest.raises(InputError, match=problem) as caught:
        load_trajectory(tmp_path / "a.npz")
    assert caught.value.key == ("torque_coefficients" if problem == "needed" else name)


@pytest.mark.parametrize("content", [b"", b"not an archive", b"PK\x03\x04 broken", None])
def test_not_a_trajectory_file(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.npz"
    if content is None:
        with path.open("wb") as stream:
            np.save(stream, np.zeros(3))
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match="is not a trajectory file") as caught:
        load_trajectory(path)
    assert caught.value.source == str(path)


def test_rolling_contacts_are_known_and_their_friction_is_interpolated(tmp_path: Path) -> None:
    plan = tipped()
    plan.save(tmp_path / "box.npz")
    loaded = load_trajectory(tmp_path / "box.npz")
    assert loaded.meta["rolling"] == [[], ["v1-palm"], []]
    column = plan.contacts.index("v1-palm")
    expected = np.zeros(plan.c_t.shape, dtype=bool)
    expected[plan.phase == 1, column] = True
    for trajectory in (plan, loaded):
        np.testing.assert_array_equal(trajectory.rolling, expected)
    t = np.linspace(0.01, plan.motions[1].duration - 0.01, 50)
    exact, interpolated = (one.motions[1].evaluate(t).c_t[:, 0] for one in (plan, loaded))
    assert np.ptp(exact) > 0.3
    # Straight lines, which a kink between two samples is some way off.
    assert np.quantile(np.abs(interpolated - exact), 0.9) < 2e-3
    np.testing.assert_allclose(interpolated, exact, atol=0.02)


@each(
    "key, text, values",
    [
        ("rolling", "not a list of names", [3, "v1-palm", ["v1-palm"], {"1": []}]),
        ("modes", "of spans", [3, [True], [[0.5]], [["a"]], [[{"start": 0.0, "stop": 1.0}]]]),
    ],
)
def test_bad_names_of_rolling_contacts_and_modes(
    trajectory: Trajectory, tmp_path: Path, key: str, text: str, values: list[Any]
) -> None:
    for value in values:
        replace(trajectory, meta={**trajectory.meta, key: value}).save(tmp_path / "plan.npz")
        with pytest.raises(InputError, match=text) as caught:
            load_trajectory(tmp_path / "plan.npz")
        assert caught.value.key == f"meta.{key}"


GOOD = "t,tau1,tau2\n0,1,-1\n0.5,2,-2\n0.5,4,0\n2,1,3\n"


def write(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_linear_rows_with_a_step(tmp_path: Path) -> None:
    profile = read_torque_csv(write(tmp_path / "a.csv", GOOD))
    assert profile.breaks.tolist() == [0.0, 0.5, 2.0]
    assert profile.duration == 2.0
    # Just before the step and at it, where the later row holds.
    np.testing.assert_allclose(profile.at(np.array([0.5 - 1e-12])), [[2, -2]], atol=1e-10)
    tau = profile.at(np.array([0.0, 0.25, 0.5, 1.25, 2.0]))
    assert tau.tolist() == [[1.0, -1.0], [1.5, -1.5], [4.0, 0.0], [2.5, 1.5], [1.0, 3.0]]


@each(
    "text",
    [
        "tau2, note ,t,tau1\n-1,a,0,1\n-2,b,0.5,2\n0,c,0.5,4\n3,,2,1\n",
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\n\n"),
        "\ufeff" + GOOD,
        GOOD.replace("0.5", "5e-1").replace(",", " , "),
    ],
)
def test_the_same_file_in_other_words(tmp_path: Path, text: str) -> None:
    profile = read_torque_csv(write(tmp_path / "a.csv", text))
    plain = read_torque_csv(write(tmp_path / "b.csv", GOOD))
    np.testing.assert_array_equal(profile.breaks, plain.breaks)
    np.testing.assert_array_equal(profile.coefficients, plain.coefficients)


@each(
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
        (GOOD.replace("2,-2", "0_2,2"), "tau1", "'0_2' on line 3"),
        (GOOD.replace("2,-2", "2,-2,9"), "", "4 values on line 3 given; the columns are t,tau1,"),
        (GOOD.replace("tau2", "tau2,tau2"), "tau2", "column is there twice; t,tau1,tau2,tau2 giv"),
        (GOOD.replace("2,-2", "2"), "tau2", "'' on line 3"),
        (GOOD.replace("2,-2", "2,").replace("\n0,", "\n\n\n0,"), "tau2", "'' on line 5"),
        (GOOD.replace("2,1,3", "0.4,1,3"), "t", "goes back from 0.5 to 0.4"),
        (GOOD.replace("2,1,3", "0.5,1,3"), "t", "0.5 s is given three times, again on line 5"),
        (GOOD.replace("\n0,1", "\n0.1,1"), "t", "first time is 0.1"),
        (GOOD.replace("\n0,1", "\n-0.1,1"), "t", "first time is -0.1"),
        ("t,tau1,tau2\n0,1,1\n0,2,2\n", "t", "every time is 0"),
        ("t,tau1,tau2\n0,0,0\n1,-1e308,0\n", "tau1", "-1e308 on line 3 given; allowed are -1e+30"),
        (b"\xff\xfe\x00t", "", ""),
        ("t,tau1,tau2\n0,\x00,1\n1,1,1\n", "tau1", ""),
    ],
)
def test_bad_csv_names_file_column_and_line(
    tmp_path: Path, text: str | bytes, key: str, problem: str
) -> None:
    path = str(tmp_path / "bad.csv")
    Path(path).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as caught:
        read_torque_csv(path)
    assert (caught.value.source, caught.value.key) == (path, key)
    assert problem in caught.value.problem


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


def test_chain_puts_profiles_one_after_the_other() -> None:
    one = TorqueProfile(np.array([0.0, 1.0]), np.array([[[1.0], [2.0]]]))
    two = TorqueProfile(np.array([0.0, 0.5, 2.0]), np.array([[[3.0, 1.0], [4.0, 0.0]]] * 2))
    both = TorqueProfile.chain([one, two])
    np.testing.assert_array_equal(both.breaks, [0.0, 1.0, 1.5, 3.0])
    t = np.array([0.1, 0.4, 1.9])
    # Shifting the times costs rounding only.
    np.testing.assert_allclose(both.at(1.0 + t), two.at(t), atol=1e-14)
    np.testing.assert_array_equal(both.at(np.array([0.7])), [[1.0, 2.0]])


def test_a_stretch_of_torques_is_the_same_torques() -> None:
    coefficients = np.random.default_rng(0).normal(size=(2, 2, 4))
    profile = TorqueProfile(np.array([0.0, 0.3, 0.5]), coefficients)
    part = profile.cut(0.1, 0.4)
    assert part.breaks.tolist() == [0.1, 0.3, 0.4]
    times = np.linspace(0.1, 0.4, 50)[:-1]
    np.testing.assert_allclose(part.at(times), profile.at(times), atol=1e-13)
    longer = profile.cut(-0.1, 0.7)
    # The ends are held.
    outside, ends = longer.at(np.array([-0.05, 0.6])), profile.at(np.array([0.0, 0.5]))
    np.testing.assert_allclose(outside, ends, atol=1e-13)


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
    missed = np.abs(TorqueProfile.join_rows(rows).at(t) - torque.at(t)).max()
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
    table = TorqueProfile.join_rows(place_rows(torque, 1e-3))
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
    staircase = TorqueProfile.join_rows(hold)
    middle = linear[:-1, 0] + 0.5 / rate
    np.testing.assert_array_equal(staircase.at(middle), linear[:-1, 1:])
    assert len(hold) == 2 * (count - 1) and hold[-1, 0] == linear[-1, 0]


@each("rate", [0.0, -1.0, math.nan, math.inf, 0.5, 1e8])
def test_rates_out_of_range(rate: float) -> None:
    with pytest.raises(InputError) as caught:
        sample_rows(bent(), rate, "linear")
    assert caught.value.key == "sample_rate"
