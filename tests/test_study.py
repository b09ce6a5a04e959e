"""What every study has: processes, records that it goes on with, a table, a command."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from misbehaving import allow, misbehave
from wholearm.benchmark import STUDIES
from wholearm.benchmark.pool import run_tasks
from wholearm.benchmark.study import Study, digest_source
from wholearm.cli.bench import load_study
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.common.journal import Journal


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tiny study is one of those that there are."""
    monkeypatch.setitem(STUDIES, "steps", ("tiny_study", "count steps to one"))


@pytest.mark.usefixtures("steps")
def test_a_study_is_a_command_with_records_and_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    command = ["bench", "steps", "-o", str(folder), "--jobs", "2"]
    assert main([*command, "--most", "4"]) == 1
    text = capsys.readouterr().out
    assert text.startswith("# Steps to one\n\nwholearm ") and "| 3 | 7 |" in text
    assert "* no natural one" in text and f"wrote {folder / 'bench_steps.md'}" in text
    records = (folder / "bench_steps.jsonl").read_text(encoding="utf-8")
    assert len(records.splitlines()) == 1 + 4
    # It goes on with what there is; a case that raises is a finding with its reason.
    assert main([*command, "--most", "6"]) == 1
    after = (folder / "bench_steps.jsonl").read_text(encoding="utf-8")
    assert after.startswith(records) and len(after.splitlines()) == 1 + 6
    text = (folder / "bench_steps.md").read_text(encoding="utf-8")
    assert "| 4 | 2 |" in text and "* 5: traceback after " in text and "ValueError: five" in text
    table = (folder / "bench_steps.csv").read_text(encoding="utf-8").splitlines()
    assert table[:3] == ["number,steps", "0,0", "1,0"]
    # What had findings is run again, and everything where that is asked for.
    assert main([*command, "--most", "5", "--again"]) == 1
    lines = (folder / "bench_steps.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["case"] for line in lines[1:]][-1] == [0]
    main([*command, "--most", "1", "--fresh"])
    assert len((folder / "bench_steps.jsonl").read_text(encoding="utf-8").splitlines()) == 2


@pytest.mark.usefixtures("steps")
def test_records_of_other_code_do_not_count_where_that_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = load_study("steps")
    monkeypatch.setattr(study, "of_code", True, raising=False)
    command = ["bench", "steps", "-o", str(tmp_path), "--jobs", "1", "--most", "2"]
    path = tmp_path / "bench_steps.jsonl"
    main(command)
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    assert json.loads(head)["source"] == digest_source()
    path.write_text("\n".join([head, *rows[:1], ""]), encoding="utf-8")
    main(command)
    assert path.read_text(encoding="utf-8").splitlines()[:2] == [head, rows[0]]
    path.write_text(
        head.replace(digest_source(), "other") + "\n" + rows[0] + "\n", encoding="utf-8"
    )
    main(command)
    assert path.read_text(encoding="utf-8").splitlines()[0] == head


def test_every_study_is_listed_and_has_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench"]) == 0
    text = capsys.readouterr().out
    for name, (_, about) in STUDIES.items():
        assert re.search(rf"^{name} +{re.escape(about)}$", text, re.M)
        study = load_study(name)
        assert isinstance(study, Study) and study.name == name and study.title
        with pytest.raises(SystemExit):
            main(["bench", name, "--help"])
        assert ("--output DIR" in capsys.readouterr().out) is study.keeps


@pytest.mark.parametrize("option", ["--scenes", "--files", "--seed", "--jobs", "--only"])
def test_numbers_out_of_range_are_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "stress", option, "-1"]) == 2
    assert capsys.readouterr().err.startswith(f"wholearm: {option}: -1 given")


@pytest.mark.usefixtures("steps")
def test_a_folder_that_cannot_be_made_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    assert main(["bench", "steps", "-o", str(tmp_path / "file" / "folder")]) == 2
    assert "cannot be made" in capsys.readouterr().err


def test_a_worker_that_hangs_or_dies_is_replaced() -> None:
    tasks = ["fine", "hang", "die", "raise", "warn", "print", "well"]
    answers = {answer.task: answer for answer in run_tasks(misbehave, tasks, 1, allow)}
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
    answers = run_tasks(misbehave, tasks, 1, allow, lambda task: task[0])
    assert [answer.task for answer in answers] == ["a1", "a2", "a3", "b1", "b2", "c1"]


def test_what_a_task_takes_is_its_own() -> None:
    answers = {
        own.task: own for own in run_tasks(misbehave, ["fine", "large"], 1, allow, alone=True)
    }
    assert 40 < answers["large"].memory < 100 and answers["fine"].memory < 10
    assert 0 < answers["large"].seconds < answers["large"].elapsed + 1


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
