from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shipped import SQUARE, problem_of, solved
from wholearm.benchmark.kernels import LARGEST, STUDY, Environment, compare, perturb_scenes
from wholearm.benchmark.study import Case, Row
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.problem.read import read_problem
from wholearm.scene.model import Finger, Friction, Polygon, Scene

GOOD: dict[str, Any] = {"value": 2.0, "modes": [["+ - -"]], "fault": ""}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, None),
        ({"value": 2.0 * (1 + 5e-7)}, None),
        ({"value": 2.0 * (1 + 2e-6)}, "value 2.000004 is off 2 by +2.0e-06"),
        ({"modes": [["+ + -"]]}, "contact modes [['+ + -']] are not [['+ - -']]"),
        ({"value": None, "fault": "phase 1 is infeasible"}, "phase 1 is infeasible"),
    ],
)
def test_what_differs_is_named(changes: dict[str, Any], text: str | None) -> None:
    assert compare(GOOD | changes, GOOD) == ([text] if text else [])


def test_answers_come_from_the_environment() -> None:
    found = STUDY.run((*Environment(seed=3), str(SQUARE), "time"))
    assert found["fault"] == ""
    assert found["value"] == pytest.approx(solved(SQUARE).value, rel=1e-6)
    absent = STUDY.run((*Environment(), "absent.toml", "time"))
    assert absent["value"] is None and "absent.toml: cannot be read" in absent["fault"]


def test_the_command_fails_where_answers_differ(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer_all(_: object, cases: list[Case], *__: object) -> list[tuple[Case, Row]]:
        return [(case, dict(GOOD)) for case in cases]

    monkeypatch.setattr("wholearm.benchmark.study.run_all", answer_all)
    stored, table = tmp_path / "answers.json", tmp_path / "table.md"
    command = ["bench", "kernels", "a.toml", "--answers", str(stored), "--jobs", "1"]
    assert main(command) == 2
    assert f"{stored}: cannot be read: " in capsys.readouterr().err
    known = {f"plan a {goal}": GOOD for goal in ("time", "effort", "margin")}
    stored.write_text(json.dumps(known), encoding="utf-8")
    assert main([*command, "--seeds", "0", "1", "-o", str(table)]) == 0
    text = table.read_text(encoding="utf-8")
    assert text.count("| 3 | 3 | 0.0e+00 |") == 2 and ", seed 1 |" in text
    stored.write_text(json.dumps(known | {"plan a time": GOOD | {"value": 1.0}}), encoding="utf-8")
    capsys.readouterr()
    assert main(command) == 1
    assert "plan a time: value 2 is off 1 by +1.0e+00" in capsys.readouterr().out


def test_numbers_change_in_the_last_bits_and_stay_so(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = problem_of(SQUARE)
    for kind in (Polygon, Finger, Friction, Scene):
        monkeypatch.setattr(kind, "__post_init__", kind.__post_init__)
    perturb_scenes(2**20)
    once = read_problem(str(SQUARE))
    again = once.with_(name="again")
    pairs = [
        (np.asarray(own.scene.polygon.points), own.scene.torque_limit, own.scene.gravity)
        for own in (exact, once, again)
    ]
    for one, other, third in zip(*pairs, strict=True):
        change = np.abs(np.subtract(other, one))
        assert (change <= (2 * LARGEST + 1) * 2.0**-52 * np.abs(one)).all()
        np.testing.assert_array_equal(other, third)
    assert (pairs[0][0] != pairs[1][0]).any()
    with pytest.raises(InputError, match=r"object\.mass"):
        once.with_(mass=-1.0)
