"""What every study has: processes, records that it goes on with, a table, a command."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from misbehaving import allow, misbehave
from wholearm.benchmark import STUDIES
from wholearm.benchmark.study import Case, Row, Study, digest_source, measure_case
from wholearm.cli.command import load_study, main
from wholearm.common.crowd import Processes, run_all
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


def ask(tasks: list[str], **options: Any) -> dict[str, Any]:
    return dict(run_all(misbehave, tasks, Processes(1, allow, **options), ahead=1))


def test_a_process_that_hangs_or_dies_is_replaced() -> None:
    answers = ask(["fine", "hang", "die", "raise", "well"])
    assert (answers["fine"], answers["well"]) == ("fine", "well")
    assert answers["hang"].late and str(answers["hang"]).startswith("time limit after ")
    assert not answers["die"].late and str(answers["die"]).endswith(" s: exit status 3")
    assert isinstance(answers["raise"], KeyError)
    assert "raise KeyError(how)" in answers["raise"].__notes__[0]


class Misbehaving(Study):
    strict = True

    def run(self, case: Case) -> Row:
        return {"how": misbehave(*case)}


def measure(how: str) -> Row:
    """Here a case is measured in a process of its own."""
    return measure_case(Misbehaving(), (how,))


def test_what_a_case_prints_and_takes_is_recorded() -> None:
    rows = dict(run_all(measure, ["fine", "print", "warn", "large"], Processes(1, alone=True)))
    assert "printed" not in rows["fine"] and rows["print"]["printed"] == "CasADi - WARNING"
    assert rows["warn"]["failed"].startswith("traceback after 0 s: ")
    assert "RuntimeWarning: careful" in rows["warn"]["failed"]
    assert 40 < rows["large"]["memory"] < 100 and rows["fine"]["memory"] < 10
    assert 0 < rows["large"]["seconds"] < 10


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
