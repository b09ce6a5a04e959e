from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wholearm.common.errors import InputError
from wholearm.problem.definition import Problem
from wholearm.problem.read import read_problem
from wholearm.problem.uncertainty import NAMES, PARAMETERS
from wholearm.results.torque import TorqueProfile
from wholearm.robustness.error_model import Uncertainty, change_problem, change_torques

PROBLEM = Path(__file__).parents[1] / "problems" / "heptagon_four_contacts.toml"


@pytest.fixture(scope="module")
def problem() -> Problem:
    return read_problem(str(PROBLEM))


@pytest.fixture
def torque() -> TorqueProfile:
    """A line and a parabola, with a step at 0.3 s."""
    breaks = np.array([0.0, 0.3, 0.5])
    first = [[1.0, 0.5, 0.0], [0.2, 0.0, 0.0]]
    return TorqueProfile(breaks, np.array([first, [[2.0, 0.0, -0.3], [0.0, 0.1, 0.2]]]))


def test_samples_have_one_in_every_slice_of_every_range() -> None:
    own = Uncertainty({"mass": 0.2, "geometry": 0.0, "delay": 2e-3})
    names = [parameter.name for parameter in own.varied]
    assert not {"length1", "base2_y"} & set(names) and len(names) == len(NAMES) - 6
    samples = own.draw(50, seed=3)
    assert samples.shape == (50, len(names) + 1)
    for name, column in zip([*names, "offset"], samples.T, strict=True):
        low, high = {"delay": (0.0, 2e-3), "offset": (0.0, 1.0)}.get(
            name, (-own.widths.get(name, 0.0), own.widths.get(name, 0.0))
        )
        slices = np.floor((column - low) / (high - low) * 50).astype(int)
        assert sorted(slices) == list(range(50)), name


@pytest.mark.parametrize(
    "widths, text",
    [
        (
            {"weight": 0.1},
            "range of weight: is unknown; allowed are friction, geometry, gain, mass",
        ),
        ({"mass": -0.1}, "range of mass: "),
        ({"friction": 1.0}, "range of friction: 1 given; a relative range is below 1"),
        ({"delay": float("nan")}, "range of delay: "),
    ],
)
def test_ranges_that_make_no_sense_are_refused(widths: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        Uncertainty(widths)


@pytest.mark.parametrize("name", [*NAMES[: NAMES.index("start_x")]])
def test_each_parameter_changes_its_own_number(problem: Problem, name: str) -> None:
    def list_numbers(own: Problem) -> dict[str, float]:
        scene = own.scene
        assert scene.polygon.inertia is not None
        found = {"mass": scene.polygon.mass, "inertia": scene.polygon.inertia}
        for key in ("palm", "finger1", "finger2"):
            found[f"friction_{key}"] = getattr(scene.friction, key)
        for k, finger in enumerate(scene.fingers, 1):
            base = np.asarray(finger.base)
            found |= {f"length{k}": finger.length, f"base{k}_x": base[0], f"base{k}_y": base[1]}
        return found

    before, after = list_numbers(problem), list_numbers(change_problem(problem, {name: 1e-3}))
    relative = not next(own.unit for own in PARAMETERS if own.name == name)
    change = before[name] * 1e-3 if relative else 1e-3
    assert after.pop(name) == pytest.approx(before.pop(name) + change, rel=1e-14)
    assert after == pytest.approx(before, rel=1e-14)


def test_torques_are_scaled_and_late(torque: TorqueProfile) -> None:
    late = change_torques(torque, {"gain1": 0.01, "gain2": -0.02, "delay": 0.02})
    times = np.array([0.01, 0.02, 0.1, 0.31, 0.33, 0.5])
    expected = torque.at(times - 0.02) * [1.01, 0.98]
    np.testing.assert_allclose(late.at(times), expected, rtol=1e-12)
    assert late.duration == pytest.approx(0.52)
    same = change_torques(torque, {})
    assert (same.at(times) == torque.at(times)).all() and same.duration == torque.duration


@pytest.mark.parametrize("offset", [0.0, 0.25])
def test_torques_are_sampled_and_held(torque: TorqueProfile, offset: float) -> None:
    held = change_torques(torque, {}, sample_rate=10.0, offset=offset)
    ticks = np.clip((np.arange(6) - offset) / 10, 0, None)
    ticks = np.unique(ticks[ticks < 0.5])
    for start, stop in zip(ticks, [*ticks[1:], 0.5], strict=True):
        within = np.linspace(start, stop, 5)[:-1] + 1e-9
        np.testing.assert_allclose(
            held.at(within), np.tile(torque.at(ticks[ticks <= start][-1:]), (4, 1)), rtol=1e-12
        )


def test_a_problem_brings_its_own_ranges(problem: Problem) -> None:
    own = problem.with_(uncertainty={"friction": 0.2, "friction_palm": 0.3, "start_x": 5e-4})
    assert own.table["uncertainty"] == own.uncertainty
    widths = Uncertainty(own.uncertainty or {}).widths
    expected = {"friction_palm": 0.3, "friction_finger2": 0.2, "start_x": 5e-4, "mass": 0.05}
    assert {key: widths[key] for key in expected} == expected
    assert replace(own, uncertainty=None).table == problem.table
    assert replace(problem, uncertainty={"mass": 0.1}).table["uncertainty"] == {"mass": 0.1}


@pytest.mark.parametrize(
    "ranges, text",
    [
        ({"mas": 0.1}, "uncertainty.mas: unknown key; did you mean 'mass'? allowed are base1_x"),
        ({"gain": 1}, "uncertainty.gain: 1 given; a relative range is below 1"),
        ({"start_x": -1e-3}, "uncertainty.start_x: -0.001 is not a number >= 0"),
        (0.1, "uncertainty: 0.1 is not a table"),
    ],
)
def test_ranges_of_a_problem_are_checked(problem: Problem, ranges: object, text: str) -> None:
    with pytest.raises(InputError, match=re.escape(text)):
        problem.with_(uncertainty=ranges)
