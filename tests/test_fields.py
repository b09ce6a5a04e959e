"""A key that is declared once is known to all that has to do with keys and options."""

from __future__ import annotations

import argparse
import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from shipped import HEPTAGON
from wholearm.cli.command import build_parser
from wholearm.common.errors import InputError
from wholearm.common.fields import (
    NONNEGATIVE,
    Range,
    declare,
    key,
    keys_of,
    read_keys,
    read_options,
)
from wholearm.planning.options import CHOICES, Objective, PlanOptions
from wholearm.problem import keys, read
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem, read_problem
from wholearm.results.adopt import save
from wholearm.scene.model import Finger

STIFF = Range(1e-3, 2.0, lambda _, own: own.torque_limit, "times the torque limit")
STIFFNESS = key("stiffness", "Spring of the joint [N m/rad].", NONNEGATIVE, "torque", STIFF)


@declare(*keys_of(Finger).values(), STIFFNESS)
@dataclass(frozen=True, eq=False)
class SprungFinger(Finger):
    """A finger with a spring."""

    stiffness: float = 0.0


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(read, "Finger", SprungFinger)
    monkeypatch.setitem(keys.FINGER, "stiffness", keys_of(SprungFinger)["stiffness"])
    return copy.deepcopy(dict(read_problem(str(HEPTAGON)).table))


def get_stiffness(problem: Problem) -> list[Any]:
    return [getattr(finger, "stiffness") for finger in problem.scene.fingers]  # noqa: B009


def test_a_new_key_is_read_and_left_out(table: dict[str, Any]) -> None:
    assert get_stiffness(build_problem(table)) == [0.0, 0.0]
    table["fingers"]["2"]["stiffness"] = 1
    assert get_stiffness(build_problem(table)) == [0.0, 1.0]


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("stiffness", -1.0, "fingers.1.stiffness: -1.0 is not a number >= 0"),
        ("stiffness", "soft", "fingers.1.stiffness: 'soft' is not a number"),
        (
            "stiffness",
            5.0,
            r"5 given; allowed are 0.002 to 4 N m/rad \(0.001 to 2 times the torque limit\)",
        ),
        ("stifness", 1.0, "fingers.1.stifness: unknown key; did you mean 'stiffness'?"),
    ],
)
def test_messages_know_it(table: dict[str, Any], name: str, value: object, text: str) -> None:
    table["fingers"]["1"][name] = value
    with pytest.raises(InputError, match=text):
        build_problem(table)


def test_schema_page_and_docstring_know_it(table: dict[str, Any]) -> None:
    assert keys.build_schema()["definitions"]["finger"]["properties"]["stiffness"] == {
        "type": "number",
        "minimum": 0,
        "default": 0.0,
        "description": "Spring of the joint [N m/rad].",
    }
    row = "| `stiffness` | N m/rad | 0 | 0.001 to 2 times the torque limit | Spring of the joint. |"
    assert row in keys.write_page()
    assert "Spring of the joint" in (SprungFinger.__doc__ or "")


def test_changes_by_name_and_files_know_it(table: dict[str, Any], tmp_path: Path) -> None:
    problem = build_problem(table)
    assert get_stiffness(problem.with_(stiffness=0.5)) == [0.5, 0.5]
    changed = problem.with_(stiffness2=0.7)
    assert get_stiffness(changed) == [0.0, 0.7]
    save(changed, str(tmp_path / "sprung.toml"))
    assert get_stiffness(read_problem(str(tmp_path / "sprung.toml"))) == [0.0, 0.7]


TABLE = """\
problem             problem file
[files PLAN ...]    more files
-o --output FILE    what to write (required)
--most-rounds N     how often it is tried = 3 in 1..9
--share             of the way, which is
    a number = 0.5 in 0.0..1
--scheme NAME       of points = radau among radau|legendre
--robust [FACTOR]   within ranges = 0 in 0.0..1000
--fresh             begin anew
--no-replay         return it without a replay
"""
OPTIONS = {option.field.name: option for option in read_options(TABLE)}


@declare(*(OPTIONS[name].field for name in ("most_rounds", "share", "scheme", "replay")))
@dataclass(frozen=True)
class Given:
    """Options of a class."""

    most_rounds: int = OPTIONS["most_rounds"].field.default
    share: float = OPTIONS["share"].field.default
    scheme: str = OPTIONS["scheme"].field.default
    replay: bool = OPTIONS["replay"].field.default

    def __post_init__(self) -> None:
        read_keys(self)


def parse(*given: str) -> dict[str, Any]:
    parser = argparse.ArgumentParser(exit_on_error=False)
    for option in OPTIONS.values():
        option.add(parser)
    return vars(parser.parse_args(["a.toml", *given, "-o", "b"]))


def test_options_have_the_defaults_of_their_table() -> None:
    left_out = {"problem": "a.toml", "files": [], "output": "b", "scheme": "radau", "share": 0.5}
    left_out |= {"most_rounds": 3, "robust": 0.0, "fresh": False, "replay": True}
    assert parse() == left_out
    assert Given() == Given(3, 0.5, "radau", True)
    named = {"files": ["c", "d"], "most_rounds": 9, "share": 1.0, "fresh": True, "replay": False}
    given = ("c", "d", "--most-rounds", "9", "--share", "1", "--fresh", "--no-replay")
    assert parse(*given) == left_out | named
    assert parse("--robust")["robust"] == 1.0 and parse("--robust", "2")["robust"] == 2.0


def test_options_and_arguments_have_the_same_ranges() -> None:
    text = "10 given; allowed are whole numbers from 1 to 9"
    with pytest.raises(argparse.ArgumentError, match=text):
        parse("--most-rounds", "10")
    with pytest.raises(InputError, match=f"most_rounds: {text}"):
        Given(most_rounds=10)
    with pytest.raises(InputError, match="scheme: 'gauss' given; allowed are 'radau' and"):
        Given(scheme="gauss")
    with pytest.raises(InputError, match="replay: 0 given; allowed are true and false"):
        Given(replay=0)  # type: ignore[arg-type]


@pytest.mark.parametrize("choice", ["time", "effort", "margin"])
def test_objectives_are_given_by_name_or_as_members(choice: str) -> None:
    assert PlanOptions(objective=choice).goal is Objective(choice)
    assert PlanOptions(objective=Objective(choice)) == PlanOptions(objective=choice)
    assert choice in CHOICES


BAD: dict[str, list[Any]] = {
    "objective": ["speed", "elastic", Objective.ELASTIC, None, 3],
    "intervals": [9, -80, 80.0, True, "80"],
    "samples": [1, 2.5],
    "time_weight": [0.0, -1.0, math.nan, math.inf, "1"],
    "duration": [0.0, -0.1, math.nan],
    "time_intervals": [3, 10.0, True, "10"],
    "degree": [1, 7, 3.0, False],
    "transcription": ["path", "", None],
    "certify": [1],
}


@pytest.mark.parametrize("key, given", [(key, own) for key, every in BAD.items() for own in every])
def test_bad_options_are_named(key: str, given: Any) -> None:
    options = {"objective": "margin"} | {key: given}
    with pytest.raises(InputError) as caught:
        PlanOptions(**options)
    assert caught.value.key == key and caught.value.exit_status == 2
    assert repr(given) in str(caught.value)


@pytest.mark.parametrize("objective", ["time", "effort"])
def test_only_the_margin_has_a_duration(objective: str) -> None:
    with pytest.raises(InputError, match="duration: is for the objective margin only"):
        PlanOptions(objective=objective, duration=1.0)


@pytest.mark.parametrize("objective", ["effort", "margin"])
def test_only_the_least_time_has_a_bound(objective: str) -> None:
    with pytest.raises(InputError, match="certify: is for the objective time only"):
        PlanOptions(objective=objective, certify=True)


def list_numbers(parser: argparse.ArgumentParser) -> list[tuple[str, argparse.Action]]:
    """Every option of every command that takes a number."""
    found = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for own in action.choices.values():
                found += list_numbers(own)
        elif action.type is not None:
            found.append((parser.prog, action))
    return found


def test_every_number_among_the_options_has_a_range() -> None:
    numbers = list_numbers(build_parser())
    assert len(numbers) > 40
    for _, action in numbers:
        assert callable(action.type) and action.type not in (int, float)
        for wrong in ("1e300", "1" + 40 * "0", "-1e300", "nan", "inf", "much"):
            with pytest.raises(argparse.ArgumentTypeError, match="given; allowed are"):
                action.type(wrong)
        if isinstance(action.default, int | float):
            assert action.type(str(action.default)) == action.default


@pytest.mark.parametrize(
    "key", [key for key, own in keys_of(PlanOptions).items() if isinstance(own.kind, Range)]
)
def test_what_would_take_all_memory_is_refused(key: str) -> None:
    given: dict[str, Any] = {key: 10**400}
    with pytest.raises(InputError, match=f"^{key}: .* given; allowed are"):
        PlanOptions(**given)
