from __future__ import annotations

import json
import os
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from misbehaving import misbehave
from wholearm.benchmark.stress.cases import draw_case
from wholearm.benchmark.stress.files import look, run_file
from wholearm.benchmark.stress.mutation import BASE, draw_mutant
from wholearm.benchmark.stress.plans import Finding
from wholearm.benchmark.stress.problems import compare_values
from wholearm.benchmark.stress.report import format_summary
from wholearm.benchmark.stress.study import StressOptions, run_stress
from wholearm.benchmark.stress.toml import to_toml
from wholearm.benchmark.stress.trees import change_tree
from wholearm.benchmark.stress.workers import run_tasks
from wholearm.cli.bench import name_study
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.common.journal import Journal


def test_a_worker_that_hangs_or_dies_is_replaced() -> None:
    tasks = ["fine", "hang", "die", "raise", "warn", "print", "well"]
    answers = {answer.task: answer for answer in run_tasks(misbehave, tasks, 1, 1.0)}
    assert {task: answer.ended for task, answer in answers.items()} == {
        "fine": "done",
        "hang": "late",
        "die": "died",
        "raise": "raised",
        "warn": "raised",
        "print": "done",
        "well": "done",
    }
    assert "KeyError" in answers["raise"].result
    assert "RuntimeWarning" in answers["warn"].result
    assert answers["print"].printed == "CasADi - WARNING\n"
    assert answers["die"].result == 3


def test_tasks_of_one_kind_come_after_another_in_one_worker() -> None:
    """A worker keeps what it has drawn for a scene until another one comes."""
    tasks = ["a1", "b1", "a2", "b2", "c1", "a3"]
    answers = run_tasks(misbehave, tasks, 1, 20.0, lambda task: task[0])
    assert [answer.task for answer in answers] == ["a1", "a2", "a3", "b1", "b2", "c1"]


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
    record = run_file((6, number))
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


def test_a_journal_goes_on_after_half_a_line(tmp_path: Path) -> None:
    path, stamp = str(tmp_path / "records.jsonl"), {"study": "any", "seed": 1}
    with Journal(path, stamp) as journal:
        journal.add({"scene": [0, "time"]})
    with open(path, "a", encoding="utf-8") as stream:
        stream.write('{"scene": [1, "ti')
    with Journal(path, stamp) as again:
        again.add({"scene": [2, "time"]})
    with Journal(path, stamp) as journal:
        assert [r["scene"][0] for r in journal.records] == [0, 2]
        journal.add({"scene": [3, "time"], "findings": [["hang", ""]]})
        journal.add({"scene": [4, "time"], "findings": []})
    for drop in (True, False):
        with Journal(path, stamp, again=drop) as journal:
            assert [record["scene"][0] for record in journal.records] == [0, 2, 4]


@pytest.mark.parametrize(
    "given, text",
    [
        ('{"study": "any", "seed": 2}\n{"a": 1}\n', "holds another study: seed (2 in the file, 1"),
        ('{"my": "data"}\n', "holds no any study"),
        ("t,tau1,tau2\n", "holds no any study"),
        ("\0\xff", "holds no any study"),
    ],
)
def test_no_journal_overwrites_anything_else(given: str, text: str, tmp_path: Path) -> None:
    path, stamp = tmp_path / "records.jsonl", {"study": "any", "seed": 1}
    path.write_text(given, encoding="latin-1")
    with pytest.raises(InputError, match=re.escape(text)) as caught:
        Journal(str(path), stamp)
    assert caught.value.source == str(path) and "--fresh" in str(caught.value)
    assert path.read_text(encoding="latin-1") == given
    with Journal(str(path), stamp, fresh=True) as journal:
        assert journal.records == []
    assert path.read_text(encoding="utf-8") == json.dumps(stamp) + "\n"


def test_two_runs_do_not_write_to_one_file(tmp_path: Path) -> None:
    path, stamp = str(tmp_path / "records.jsonl"), {"study": "any"}
    with Journal(path, stamp) as journal:
        journal.add({"scene": 0})
        with pytest.raises(InputError, match="another run is writing to it"):
            Journal(path, stamp, fresh=True)
    with Journal(path, stamp) as journal:
        assert journal.records == [{"scene": 0}]


def test_values_that_noise_changes_are_found() -> None:
    def record(value: float | None, number: int, what: str = "noise") -> dict[str, Any]:
        return {"problem": ["a.toml", "time", what, number], "value": value, "findings": []}

    close = [record(1.0, 0), record(1.0 + 5e-7, 1), record(2.0, 0, "change"), record(None, 2)]
    assert compare_values(close) == []
    (finding,) = compare_values([*close, record(1.0 + 5e-6, 3)])
    assert "a.toml, time" in finding.text


def test_the_summary_counts_every_finding() -> None:
    scene = {"scene": [4, "time"], "kind": "any", "outcome": "planned", "verdict": "", "seconds": 1}
    records: list[dict[str, Any]] = [
        {**scene, "findings": [["hang", "after 9 s"], ["warning", "a | b"]]},
        {"file": 2, "kind": "torque", "status": None, "findings": [["traceback", "ValueError"]]},
        {"problem": ["p.toml", "time", "noise", 0], "value": 1.0, "findings": []},
    ]
    noise = [Finding("optimum that differs under noise", "p.toml")]
    text, count = format_summary(records, noise, {"seed": 0})
    assert count == 4
    assert "| hang | 1 |" in text and "| traceback | 1 |" in text and "a \\| b" in text
    assert "| optimum that differs under noise | 1 |" in text


def test_a_study_goes_on_where_it_was_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "out")
    arguments = ["bench", "stress", "--scenes", "0", "--seed", "2", "-o", folder, "--jobs", "1"]
    assert main([*arguments, "--files", "3"]) == 0
    with open(f"{folder}/bench_stress.jsonl", encoding="utf-8") as stream:
        before = stream.read()
    text, path, count = run_stress(StressOptions(scenes=0, files=3, seed=2), folder)
    assert count == 0 and "Damaged files" in text and os.path.isfile(path)
    with open(f"{folder}/bench_stress.jsonl", encoding="utf-8") as stream:
        assert stream.read() == before
    assert "Stress study" in capsys.readouterr().out


@pytest.mark.parametrize("option", ["--scenes", "--files", "--seed", "--jobs", "--only"])
def test_numbers_out_of_range_are_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "stress", option, "-1"]) == 2
    assert capsys.readouterr().err.startswith(f"wholearm: {option}: -1 given")


def test_the_name_of_the_study_may_be_left_out() -> None:
    assert name_study(["bench", "a.toml"]) == ["bench", "problem", "a.toml"]
    assert name_study(["bench", "-o", "x", "a.toml"]) == ["bench", "problem", "-o", "x", "a.toml"]
    for same in (["bench", "stress"], ["bench"], ["bench", "--help"], ["solve", "stress"]):
        assert name_study(same) == same


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be made"):
        run_stress(StressOptions(scenes=0), str(tmp_path / "file" / "folder"))
