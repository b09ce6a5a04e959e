"""What every study has (processes, records, a table, a command), and each study."""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tiny_study
import wholearm
from rows import each
from shipped import FOLDER, HEPTAGON, SQUARE, problem_of, solved, text_of
from tiny_study import allow, measure, misbehave
from wholearm import Finger, Friction, InputError, Plan, Polygon, Problem, Scene, TorqueProfile
from wholearm.benchmark import STUDIES, corpus, precision
from wholearm.benchmark.corpus import STUDY as CORPUS
from wholearm.benchmark.corpus import answer, compare, count, list_cases
from wholearm.benchmark.growth import STUDY as GROWTH
from wholearm.benchmark.growth import WORK, run_work
from wholearm.benchmark.skip import STUDY as SKIP
from wholearm.benchmark.skip import list_pairs
from wholearm.benchmark.study import Case, Row, Study, digest_source, name_case
from wholearm.cli.command import load_study, main
from wholearm.common.document import Document, Table
from wholearm.common.parallel import Journal, Processes, run_all
from wholearm.planning.nlp import collect_costs
from wholearm.problem.read import build_problem, read_problem


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tiny study is one of those that there are."""
    monkeypatch.setitem(STUDIES, "steps", "count steps to one")
    monkeypatch.setitem(sys.modules, "wholearm.benchmark.steps", tiny_study)


@pytest.mark.usefixtures("steps")
def test_a_study_is_a_command_with_records_and_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    command = ["bench", "steps", "-o", str(folder), "--jobs", "1"]
    assert main([*command, "--most", "4", "--jobs", "2"]) == 1
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
    assert main(["bench", "steps", "-o", str(folder / "bench_steps.md" / "folder")]) == 2
    assert "cannot be made" in capsys.readouterr().err


@pytest.mark.usefixtures("steps")
def test_records_of_other_code_do_not_count_where_that_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = load_study("steps")
    monkeypatch.setattr(study, "stamp", lambda options: {"source": digest_source()})
    command = ["bench", "steps", "-o", str(tmp_path), "--jobs", "1", "--most", "2"]
    path = tmp_path / "bench_steps.jsonl"
    main(command)
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    assert json.loads(head)["source"] == digest_source()
    path.write_text("\n".join([head, *rows[:1], ""]), encoding="utf-8")
    main(command)
    assert path.read_text(encoding="utf-8").splitlines()[:2] == [head, rows[0]]
    path.write_text(f"{head.replace(digest_source(), 'other')}\n{rows[0]}\n", encoding="utf-8")
    main(command)
    assert path.read_text(encoding="utf-8").splitlines()[0] == head
    path.write_text('{"my": "data"}\n', encoding="utf-8")
    assert main(command) == 2 and path.read_text(encoding="utf-8") == '{"my": "data"}\n'


def test_every_study_is_listed_and_has_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench"]) == 0
    text = capsys.readouterr().out
    for name, about in STUDIES.items():
        assert re.search(rf"^{name} +{re.escape(about)}$", text, re.M)
        study = load_study(name)
        assert isinstance(study, Study) and study.name == name and study.title
        with pytest.raises(SystemExit):
            main(["bench", name, "--help"])
        assert "--output DIR" in capsys.readouterr().out


def test_options_out_of_range_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--scenes", "--files", "--seed", "--jobs", "--only"):
        assert main(["bench", "stress", option, "-1"]) == 2
        assert capsys.readouterr().err.startswith(f"wholearm: {option}: -1 given")
    assert main(["bench", "precision", "--problems", str(FOLDER), "--peers", "fastest"]) == 2
    assert "--peers: 'fastest' given; allowed are wholearm;" in capsys.readouterr().err


def test_a_process_that_hangs_or_dies_is_replaced() -> None:
    tasks = ["fine", "hang", "die", "raise", "well"]
    answers: dict[str, Any] = dict(run_all(misbehave, tasks, Processes(1, allow), max_pending=1))
    assert (answers["fine"], answers["well"]) == ("fine", "well")
    assert answers["hang"].timed_out and str(answers["hang"]).startswith("time limit after ")
    assert not answers["die"].timed_out and str(answers["die"]).endswith(" s: exit status 3")
    assert isinstance(answers["raise"], KeyError)
    assert "raise KeyError(how)" in answers["raise"].__notes__[0]


def test_what_a_case_prints_and_takes_is_recorded() -> None:
    rows = dict(run_all(measure, ["fine", "print", "warn", "large"], Processes(1, fresh=True)))
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


def test_the_table_has_every_measurement_and_exponent() -> None:
    """Times that grow with the square of sizes, and memory in proportion to them."""
    measured: list[Row] = [
        {"grows": grows, "work": work, "size": k, "seconds": 1e-3 * k**2, "memory": 0.1 * k}
        for grows, (works, sizes) in WORK.items()
        for work in works
        for k in sizes
    ]
    text = Document("", parts=GROWTH.report(measured, argparse.Namespace())[0]).to_markdown()
    rows = iter(line for line in text.splitlines() if " [s] | " in line)
    for grows, (works, sizes) in WORK.items():
        assert f"## {grows.capitalize()}" in text
        for work in works:
            row = next(rows)
            assert row.startswith(f"| {work} [s] | ") and row.endswith(" 2.00 |")
            assert row.count("|") == len(sizes) + 3
    count = sum(len(works) for works, _ in WORK.values())
    assert text.count("[MB]") == text.count(" 1.00 |") == count
    # One size has no exponent, and has its column.
    (_, _, table, *_), _ = GROWTH.report(measured[3:4], argparse.Namespace())
    assert isinstance(table, Table) and [*table.cells[0]][4:] == ["160", "-", "-", "-", "-"]


def test_work_is_as_large_as_is_asked() -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    # Five nodes for each element of four intervals, of which there are more than switches.
    for size, nodes in ((40, 50), (80, 100)):
        with collect_costs() as ledger:
            run_work(table, "intervals", "least time", size)
        assert ledger.runs[0].unknowns == 3 * nodes - 2
    with collect_costs() as ledger:
        # Another ledger with the same runs, none, ends before.
        with collect_costs() as other:
            pass
        run_work(table, "intervals", "margin", 40)
    assert max(run.unknowns for run in ledger.runs) > 3 * 50 - 2 and not other.runs
    for size in (5, 6):
        run_work(table, "vertices", "reading", size)


INTERVALS, TIME_INTERVALS, POINTS, TOUCHING = 12, 4, 3, 4
ABSENT = ("friction of joints", "speed limits that never bind")
"""Parts that are coefficients and bounds, where they are."""
Pairs = dict[str, tuple[partial[Row], partial[Row]]]


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    options = {"intervals": INTERVALS, "time_intervals": TIME_INTERVALS, "mode_search": False}
    return list_pairs(str(FOLDER), **options)


def assert_bare(cost: Row, contacts: int, rolling: int) -> None:
    """Along a curve from rest to rest nothing but what each node needs."""
    # Unknowns are speed, acceleration and squeeze, but for the speed at both ends, where it is 0.
    # Rows are how the speed goes on, and at each node contact forces, both sides of the cones of
    # rolling contacts, and torques.
    nodes, rest = divmod(cost["unknowns"] + 2, 3)
    # Five nodes for each element of four intervals, of which switches may ask for more.
    assert rest == nodes % 5 == 0 and nodes >= 5 * INTERVALS // 4
    assert cost["rows"] == nodes - 1 + (contacts + 2 * rolling + 2) * nodes


@pytest.mark.parametrize("part", ["friction of contacts", *ABSENT])
def test_friction_and_limits_are_free_along_curves(pairs: Pairs, part: str) -> None:
    for case in pairs[f"{part}, along curves"]:
        assert_bare(case(), TOUCHING, 0)


def test_over_time_friction_adds_a_sense_for_each_contact_and_point(pairs: Pairs) -> None:
    own = [pairs[f"{part}, over time"] for part in ("friction of contacts", *ABSENT)]
    full, smooth, free, limited = (case() for case in (own[0][1], own[0][0], own[1][0], own[2][1]))
    # What else there is, are coefficients and bounds.
    assert {own["unknowns"] for own in (full, free, limited)} == {smooth["unknowns"]}
    assert {own["rows"] for own in (full, free, limited)} == {full["rows"]}
    intervals, rest = divmod(full["rows"] - smooth["rows"], TOUCHING * POINTS)
    # Where a direction turns, a stage ends and an interval is divided.
    assert TIME_INTERVALS <= intervals < 2 * TIME_INTERVALS and rest == 0


def test_a_rolling_contact_has_two_rows_more_than_a_sliding_one_along_a_curve(pairs: Pairs) -> None:
    tip = pairs["a second freedom"][0]
    (phase,) = tip.args[0].phases
    assert (phase.formation.n_contacts, phase.formation.n_rolling) == (3, 1)
    assert_bare(tip(), 3, 1)


def test_the_table_has_a_row_for_each_part(pairs: Pairs) -> None:
    rows = [
        {"part": "a figure", "having": having, **plan()}
        for having, plan in zip((False, True), pairs["a figure"], strict=True)
    ]
    *_, table = SKIP.report(rows, argparse.Namespace())[0]
    assert isinstance(table, Table)
    ((name, *cells),) = table.cells
    assert name == "a figure" and len(cells) == 8
    assert cells[0] == cells[1] and cells[2] == cells[3]
    # Drawing costs, and nothing of it is run where no figure is wanted.
    assert int(cells[5]) > int(cells[4])


def test_counts_of_one_phase_are_those_of_theory() -> None:
    nodes, contacts = 60, 4  # five nodes for each of twelve elements; sliding contacts
    found = count(build_problem(tomllib.loads(text_of())))
    # Speed, acceleration and squeeze at each node, but for the speed at both ends, where it is 0.
    assert found["phase 1 of 1: unknowns"] == 3 * nodes - 2
    # How the speed goes on, and the forces and torques at each node.
    assert found["phase 1 of 1: rows"] == nodes - 1 + (contacts + 2) * nodes
    assert found["panels of curves"] >= 1 and set(corpus.BANDS) < set(found)
    assert found["iterations"] > 1 and found["evaluations of the replay"] > 12


@each(
    "change, text",
    [
        ({}, ""),
        ({"rows": 6, "iterations": 12}, ""),
        ({"rows": 8}, "rows has grown from 7 to 8"),
        ({"iterations": 13}, "iterations has grown from 10 to 13 (allowed: 12)"),
        ({"unknowns": 3}, "unknowns is counted in one of them alone"),
    ],
)
def test_counts_may_not_grow(change: dict[str, int], text: str) -> None:
    stored = {"rows": 7, "iterations": 10}
    expected = ("differs", [text]) if text else ("same", [])
    assert compare("counts", stored | change, stored) == expected


STORED = json.loads((FOLDER.with_name("results") / "corpus.json").read_text(encoding="utf-8"))
QUICK: tuple[Case, ...] = (
    ("plan", "heptagon_four_contacts", "time"),
    ("goal", 20),
    ("scene", 2, "margin"),
    ("leg", 36, "time"),
    ("free", "heptagon_four_contacts"),
    ("compare", "heptagon_four_contacts"),
    *(("list", number) for number in range(4)),
    ("predict", "box_rolling"),
)
"""The study of the corpus asks all others, too."""
REFUSED = ("input", "option", "torque file")
"""Families whose cases cost next to nothing."""


@pytest.mark.parametrize("case", QUICK, ids=name_case)
def test_answers_are_as_stored(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = wholearm.solve

    def look_up(problem: Problem, objective: str = "time", **options: Any) -> Plan:
        """The plan of the whole test run, where it is that of a problem file."""
        if options or problem.table != problem_of(HEPTAGON).table:
            return plan(problem, objective, **options)
        return solved(HEPTAGON, objective)

    monkeypatch.setattr(wholearm, "solve", look_up)
    found = json.loads(json.dumps(answer(case, FOLDER)))
    kind, texts = compare(case[0], found, STORED[name_case(case)])
    assert kind != "differs", texts


def list_words(found: Any) -> list[str]:
    """Words of an answer in any order, as two ways may be equal; numbers to six digits."""
    text = re.sub(r"\d+\.\d+(e-?\d+)?", lambda m: f"{float(m[0]):.6g}", json.dumps(found))
    return sorted(re.findall(r"[^\s,\"{}]+", text))


def test_bad_input_is_refused_as_ever() -> None:
    for case in list_cases():
        if case[0] in REFUSED:
            assert list_words(answer(case, FOLDER)) == list_words(STORED[name_case(case)]), case


def test_every_case_has_a_stored_answer() -> None:
    cases = list(list_cases())
    assert {name_case(case) for case in cases} == set(STORED)
    assert {case[0] for case in cases} == set(corpus.FAMILIES)


PLANNED: dict[str, Any] = {
    "objective": "time", "value": 1.0, "durations": [0.4, 0.6], "modes": [["+"], ["-"]],
    "replay": {"ok": True, "events": [0.1, 0.5]},
}  # fmt: skip


@each(
    "change, kind",
    [
        ({}, "same"),
        ({"value": 1 + 5e-7, "durations": [0.40002, 0.59998]}, "same"),
        ({"value": 1.0 + 5e-6}, "differs"),
        ({"value": 1.0 + 5e-5}, "differs"),
        ({"value": 0.999, "modes": [["-"], ["-"]]}, "better"),
        ({"value": 0.999, "replay": {"ok": False, "events": []}}, "differs"),
        ({"objective": "margin", "value": 0.999}, "differs"),
        ({"modes": [["+"], ["-", "+"]]}, "differs"),
        ({"replay": {"ok": True, "events": [0.1, 0.50001]}}, "same"),
        ({"replay": {"ok": True, "events": [0.1, 0.501]}}, "differs"),
        ({"replay": {"ok": True, "events": [0.1]}}, "differs"),
        ({"text": "by another name"}, "other words"),
    ],
)
def test_what_counts_as_a_difference(change: dict[str, Any], kind: str) -> None:
    assert compare("plan", PLANNED | change, PLANNED)[0] == kind
    # Local optima agree within the accuracy of plans.
    assert compare("goal", PLANNED | {"value": 1.0 + 5e-5}, PLANNED)[0] == "same"


def test_refusals_agree_in_kind_and_in_what_is_short() -> None:
    refused = {"refused": "InfeasibleError", "amount": 0.1, "advice": {"a": 1.0}, "text": "why"}
    assert compare("leg", refused, PLANNED)[0] == "differs"
    assert compare("leg", refused | {"text": "because", "advice": {}}, refused)[0] == "other words"
    assert compare("leg", refused | {"amount": 0.2}, refused)[0] == "differs"
    assert compare("leg", {"refused": "InputError"}, refused)[0] == "differs"
    fails = PLANNED | {"replay": {"ok": False, "events": []}}
    assert compare("leg", fails, refused)[0] == "differs"
    assert compare("leg", PLANNED, refused)[0] == "better"
    assert compare("leg", refused, None)[0] == "differs"


GOOD: dict[str, Any] = {"objective": "time", "value": 2.0, "modes": [["+"]], "replay": {"ok": True}}


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes have the numbers that they are given again at the end."""
    for kind in (Polygon, Finger, Friction, Scene):
        monkeypatch.setattr(kind, "__post_init__", kind.__post_init__)


@pytest.mark.usefixtures("exact")
def test_other_roundings_have_the_same_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CORPUS, "rounding", 3)
    found = CORPUS.run(("plan", "heptagon_four_contacts", "time"))["answer"]
    assert found["value"] == pytest.approx(solved(HEPTAGON).value, rel=1e-6)


def test_the_command_fails_where_answers_differ(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer_all(_: object, cases: list[Case], *__: object) -> Iterator[tuple[Case, Row]]:
        return ((case, {"answer": GOOD | {"durations": [2.0]}, "seconds": 1.0}) for case in cases)

    monkeypatch.setattr("wholearm.benchmark.study.run_all", answer_all)
    stored = tmp_path / "answers.json"
    command = ["bench", "corpus", "--only", "plan square *", "--answers", str(stored)]
    command += ["-o", str(tmp_path), "--fresh", "--problems", str(FOLDER)]
    assert main(command) == 2 and f"{stored}: cannot be read: " in capsys.readouterr().err
    known = {f"plan square {goal}": GOOD for goal in ("time", "effort", "margin")}
    stored.write_text(json.dumps(known), encoding="utf-8")
    assert main(command) == 1
    assert "plan square time: durations: [2.0], stored null" in capsys.readouterr().out
    assert main([*command, "--values"]) == 0 and "| plan | 3 | 3 |" in capsys.readouterr().out
    known["plan square time"] = GOOD | {"value": 1.0}
    stored.write_text(json.dumps(known), encoding="utf-8")
    assert main([*command, "--values"]) == 1
    assert "plan square time: value: 2.0, stored 1.0, off by 1" in capsys.readouterr().out


@pytest.mark.usefixtures("exact")
def test_numbers_change_in_the_last_bits_and_stay_so() -> None:
    exact = problem_of(SQUARE)
    corpus.perturb_scenes(2**20)
    once = read_problem(str(SQUARE))
    again = once.with_(name="again")
    pairs = [
        (np.asarray(own.scene.polygon.points), own.scene.torque_limit, own.scene.gravity)
        for own in (exact, once, again)
    ]
    for one, other, third in zip(*pairs, strict=True):
        change = np.abs(np.subtract(other, one))
        assert (change <= (2 * corpus.LARGEST + 1) * 2.0**-52 * np.abs(one)).all()
        np.testing.assert_array_equal(other, third)
    assert (pairs[0][0] != pairs[1][0]).any()
    with pytest.raises(InputError, match=r"object\.mass"):
        once.with_(mass=-1.0)


FILES = (str(HEPTAGON),)
LEAST = {precision.LEAST_TIME: 0.0666298, precision.NO_DRAG: 0.0663431}
"""Least times of the fourth phase, within 1e-5."""
TRIED = {"wholearm, curve": "1e-3", "yapss": "20", "toppra": "100"}


@lru_cache
def phase(number: int, drag: bool = True) -> precision.Instance:
    return precision.list_instances(FILES, drag)[number - 1]


@pytest.mark.parametrize("method", TRIED)
def test_every_planner_comes_near_the_least_time(method: str) -> None:
    if module := precision.PLANNERS[method].module:
        pytest.importorskip(module, reason=f"{method}: pip install 'wholearm[bench]'")
    (study, *_) = precision.PLANNERS[method].choices
    instance = phase(4, study != precision.NO_DRAG)
    found = precision.run_setting(instance, study, method, TRIED[method])
    error, end, violation = found["errors"]
    assert found["outcome"] == precision.SOLVED and abs(error) < 2e-2
    assert end < 1e-2 and violation < 2.6e-2
    assert precision.find_least_time(instance) == pytest.approx(LEAST[study], rel=1e-5)


def test_what_a_replay_does_not_keep_is_no_solution() -> None:
    plan = precision.PLANNERS["wholearm, curve"].build(phase(4), "1e-3")()
    end, _, outcome = precision.check_plan(phase(4), plan)
    assert outcome == precision.SOLVED and end < 1e-8
    weak = TorqueProfile(plan.breaks, 0.98 * plan.coefficients)
    assert precision.check_plan(phase(4), weak)[0] > 1e-3
    zero = TorqueProfile(plan.breaks, 0.0 * plan.coefficients)
    _, violation, outcome = precision.check_plan(phase(4), zero)
    assert "contact is lost" in outcome and violation > 0.02
    assert precision.check_plan(phase(4), "stopped")[2] == "stopped"


@lru_cache
def course() -> precision.Course:
    """The heptagon's first phase, with a reversal on its way."""
    found = precision.make_course(phase(1), precision.FEW)
    assert found is not None
    return found


def test_reference_is_exact_and_meets_the_reversal() -> None:
    problem, torque, stretches, end = course()
    rough, *_ = precision.integrate(problem, torque, phase(1).curve, 2.3e-12)
    assert precision.measure_error(problem, rough, end) < 1e-12
    assert len({tuple(stretch[:6]) for stretch in stretches}) == 2  # Xi and sigma
    starts, ends = np.array(stretches)[:, -2:].T
    assert (starts[1:] == ends[:-1]).all() and starts[0] == 0.0


@pytest.mark.parametrize("method", precision.SIMULATORS)
def test_every_simulator_converges_to_the_reference(method: str) -> None:
    build, (problem, _, _, end) = precision.SIMULATORS[method].build, course()
    states = [build(course(), tolerance)() for tolerance in ("1e-5", "1e-9")]
    errors = [precision.measure_error(problem, state, end) for state in states]
    assert errors[1] < 2e-7 and errors[1] < max(0.3 * errors[0], 1e-10)
