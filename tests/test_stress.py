"""The stress study: what it draws, and what counts as a finding."""

from __future__ import annotations

import argparse
import json
import tomllib
from typing import Any

import numpy as np
import pytest

from wholearm.benchmark.stress.damage import BASE, change_tree, draw_mutant, look, run_file, to_toml
from wholearm.benchmark.stress.scenes import draw_case
from wholearm.benchmark.stress.stress_study import STUDY, compare_values


def test_a_scene_is_drawn_alike_again_and_is_the_same_as_a_file() -> None:
    case, again = draw_case(0, 2), draw_case(0, 2)
    assert case == again
    assert case.table["phases"]
    assert tomllib.loads(to_toml(case.table)) == case.table


def test_mutants_are_reproducible_and_differ_from_what_they_come_from() -> None:
    for number in range(40):
        mutant = draw_mutant(1, number)
        assert mutant == draw_mutant(1, number)
        assert mutant.what
    table = json.loads(json.dumps(BASE))
    change_tree(np.random.default_rng(0), table)
    assert table != BASE


@pytest.mark.parametrize("number", range(12))
def test_damaged_files_end_clearly(number: int) -> None:
    record = run_file(6, number)
    assert record["findings"] == [] and record["status"] in (0, 1, 2)


@pytest.mark.parametrize(
    ("status", "out", "err", "written", "count"),
    [
        (2, "", "wholearm: mutant.toml: x\n", set(), 0),
        (2, "", "wholearm: x\n", set(), 1),
        (2, "", "wholearm: mutant.toml: x\nmore\n", set(), 1),
        (2, "", "", set(), 2),
        (2, "half a table", "wholearm: mutant.toml: x\n", set(), 1),
        (2, "", "wholearm: mutant.toml: x\n", {"out.npz"}, 1),
        (0, "fine", "", {"out.npz"}, 0),
        (0, "fine", "a warning\n", set(), 1),
        (3, "", "", set(), 1),
        (1, "a report", "", set(), 0),
        (1, "", "", set(), 1),
    ],
)
def test_what_counts_as_an_unclear_end(
    status: int, out: str, err: str, written: set[str], count: int
) -> None:
    assert len(look(["verify"], status, out, err, written)) == count


def test_values_that_noise_changes_are_found() -> None:
    def row(value: float | None, number: int, what: str = "noise") -> dict[str, Any]:
        return {"case": ["problem", "a.toml", "time", what, number], "value": value}

    close = [row(1.0, 0), row(1.0 + 5e-7, 1), row(2.0, 0, "change"), row(None, 2)]
    assert compare_values(close) == []
    ((name, *_),) = compare_values([*close, row(1.0 + 5e-6, 3)])
    assert name == "a.toml, time"


def test_the_table_counts_every_finding() -> None:
    scene = {"kind": "any", "outcome": "planned", "verdict": "", "seconds": 1.0}
    rows: list[dict[str, Any]] = [
        {"case": ["scene", 0, 4, "time"], **scene, "findings": [["no answer", "a | b"]]},
        {"case": ["file", 0, 2], "kind": "torque", "status": 1, "findings": [["traceback", "E"]]},
        {"case": ["problem", "p.toml", "time", "noise", 0], "value": 1.0, "findings": []},
    ]
    text, findings = STUDY.report(rows, argparse.Namespace())
    assert len(findings) == 2 and findings[0] == "scene 0 4 time: no answer: a | b"
    assert "| no answer | 1 |" in text and "| traceback | 1 |" in text
    assert "| p.toml | time | 1 | 1 | 0.0e+00 |" in text
