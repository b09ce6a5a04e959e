from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from retelling import Units, in_units
from wholearm.common.errors import InputError
from wholearm.geometry.path_guess import load
from wholearm.problem.read import build_problem

PROBLEMS = sorted((Path(__file__).parents[1] / "problems").glob("*.toml"))
HEPTAGON = dict(load(str(PROBLEMS[0].with_name("heptagon_four_contacts.toml"))).table)


def edited(path: str, value: Any) -> dict[str, Any]:
    table = copy.deepcopy(HEPTAGON)
    *keys, last = path.split(".")
    part = table
    for key in keys:
        part = part[key]
    part[last] = value
    return table


@pytest.mark.parametrize(
    "path, value, text",
    [
        ("object.mass", 1e308, r"1e\+308 given; allowed are 1e-06 to 1e\+06 kg"),
        ("object.inertia", 1e-8, "times uniform density"),
        ("gravity", 1e-9, "allowed are 0.001 to"),
        ("friction.palm", 11.0, "11 given; allowed are 0 to 10"),
        ("fingers.1.length", 1e3, "times the object's size"),
        ("fingers.2.length", 1e-9, "times the object's size"),
        ("fingers.1.radius", 1e-9, r"allowed are 1.8e-05 to 0.18 m .* or 0"),
        ("fingers.1.radius", 0.2, r"allowed are 1.8e-05 to 0.18 m .* or 0"),
        ("fingers.1.base", [1e9, 0.0], "times the object's size"),
        ("fingers.1.inertia", 1e308, r"times m length\^2"),
        ("fingers.1.torque_limit", 1e308, "times m g length"),
        ("fingers.1.viscous", 1e308, r"allowed are 0 to 23.2 N m s"),
        ("fingers.1.dry", 1e308, r"allowed are 0 to 2e\+03 N m"),
        ("fingers.1.speed_limit", 1e-300, r"allowed are 0.017\d to 1.7\de\+07 rad/s"),
        ("epsilon", 1e308, "times what presses at most"),
        ("start.x", -1e308, "times the object's size"),
    ],
)
def test_numbers_beyond_all_reason_are_refused(path: str, value: Any, text: str) -> None:
    with pytest.raises(InputError, match=text) as caught:
        build_problem(edited(path, value))
    assert caught.value.key == path


@pytest.mark.parametrize("until", [{"x": 1e9}, {"phi_deg": 1e9}])
def test_an_end_beyond_all_reason_is_refused(until: dict[str, float]) -> None:
    table = edited("name", "far")
    table["phases"][-1]["until"] = until
    with pytest.raises(InputError, match=r"1e\+09 given; allowed are -") as caught:
        build_problem(table)
    assert caught.value.key == "phases[5].until"


def test_without_gravity_fingers_are_weighed_against_each_other() -> None:
    table = edited("gravity", 0.0)
    build_problem(table)
    table["fingers"]["1"]["torque_limit"] = 1e7
    with pytest.raises(InputError, match="times finger 2's strength"):
        build_problem(table)


@pytest.mark.parametrize("path", PROBLEMS, ids=lambda path: path.stem)
def test_ranges_follow_the_units(path: Path) -> None:
    """Millimetres and grams, and sizes and masses far from those of the shipped problems."""
    problem = load(str(path))
    for units in (Units(1e3, 1e3), Units.of(0.01, 1e-3), Units.of(100.0, 1e4)):
        in_units(units).apply(problem)
