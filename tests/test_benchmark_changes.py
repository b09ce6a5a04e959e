from __future__ import annotations

from dataclasses import replace

import pytest

from shipped import HEPTAGON
from wholearm.benchmark import changes
from wholearm.benchmark.changes import measure_stress
from wholearm.geometry.path_guess import load
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem


def slide() -> Problem:
    """The heptagon's first phase alone."""
    table = dict(load(str(HEPTAGON)).table)
    return build_problem(table | {"phases": table["phases"][:1]})


def test_small_changes_leave_a_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes, "TRIALS", 2)
    monkeypatch.setattr(changes, "CHANGES", (0.05,))
    (row,) = measure_stress(slide())
    assert row.error == 0.0 and row.note == "2 of 2 planned and verified"


@pytest.mark.usefixtures("unadvised")
def test_what_has_no_plan_is_counted_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes, "TRIALS", 1)
    monkeypatch.setattr(changes, "CHANGES", (0.05,))
    (row,) = measure_stress(slide().with_(epsilon=50.0))
    assert row.error == 1.0 and row.note.startswith("0 of 1 planned and verified; time: phase ")


def test_a_problem_that_was_not_read_has_nothing_to_change() -> None:
    assert measure_stress(replace(slide(), table={})) == []
