from __future__ import annotations

import argparse
import math
from typing import Any

import pytest

from wholearm.cli.command import build_parser
from wholearm.common.errors import InputError
from wholearm.common.fields import Range, keys_of
from wholearm.planning.options import CHOICES, Objective, PlanOptions


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
