from __future__ import annotations

import json
from pathlib import Path

import pytest

from shipped import FOLDER, HEPTAGON
from wholearm.benchmark.guard import BANDS, compare, count, read_stored
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.problem.read import build_problem, read_problem

STORED = FOLDER.with_name("results") / "bench_guard.json"
NODES, CONTACTS = 50, 4
"""Five nodes for each of ten elements; sliding contacts."""


def write_first_phase(folder: Path) -> str:
    lines = HEPTAGON.read_text(encoding="utf-8").split("[[phases]]")
    path = folder / "slide.toml"
    path.write_text("[[phases]]".join(lines[:2]), encoding="utf-8")
    return str(path)


def test_counts_of_one_phase_are_those_of_theory() -> None:
    table = dict(read_problem(str(HEPTAGON)).table)
    found = count(build_problem({**table, "phases": table["phases"][:1]}))
    # Speed, acceleration and squeeze at each node, but for the speed at both ends, where it is 0.
    assert found["phase 1 of 1: unknowns"] == 3 * NODES - 2
    # How the speed goes on, and the forces and torques at each node.
    assert found["phase 1 of 1: rows"] == NODES - 1 + (CONTACTS + 2) * NODES
    assert found["panels of curves"] >= 1 and set(BANDS) < set(found)
    assert found["iterations"] > 1 and found["evaluations of the replay"] > 12


@pytest.mark.parametrize(
    ("stored", "texts"),
    [
        ({"a: rows": 10, "iterations": 100}, []),
        ({"a: rows": 11, "iterations": 300}, []),
        ({"a: rows": 9, "iterations": 100}, ["p: a: rows has grown from 9 to 10"]),
        ({"a: rows": 10, "iterations": 81}, []),
        (
            {"a: rows": 10, "iterations": 79},
            ["p: iterations has grown from 79 to 100 (allowed: 99)"],
        ),
        ({"iterations": 100}, ["p: a: rows = 10 is new; --update stores it"]),
        ({"a: rows": 10, "iterations": 100, "b: rows": 3}, ["p: b: rows is not counted any more"]),
    ],
)
def test_what_has_grown_is_named(stored: dict[str, int], texts: list[str]) -> None:
    assert compare("p", {"a: rows": 10, "iterations": 100}, stored) == texts


def test_the_command_stores_counts_and_fails_where_they_grow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, counts = write_first_phase(tmp_path), tmp_path / "counts.json"
    command = ["bench", "guard", path, "--counts", str(counts)]
    assert main(command) == 2
    assert f"{counts}: cannot be read: " in capsys.readouterr().err
    counts.write_text('{"other": {"rows": 3}}')
    assert main([*command, "--update"]) == 0
    assert main(command) == 0
    assert "1 problems: no count has grown" in capsys.readouterr().out
    stored = read_stored(str(counts))
    assert set(stored) == {"other", "slide"}
    stored["slide"]["phase 1 of 1: rows"] -= 1
    counts.write_text(json.dumps(stored))
    assert main(command) == 1
    now = stored["slide"]["phase 1 of 1: rows"]
    line = f"* slide: phase 1 of 1: rows has grown from {now} to {now + 1}\n"
    assert capsys.readouterr().out.endswith(line)
    del stored["slide"]
    counts.write_text(json.dumps(stored))
    assert main(command) == 1
    assert "* slide: no counts are stored" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text", ["[", "[]", '{"a": 3}', '{"a": {"rows": 1.5}}', '{"a": {"b": true}}']
)
def test_bad_counts_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "counts.json").write_text(text)
    with pytest.raises(InputError, match=r"counts\.json"):
        read_stored(str(tmp_path / "counts.json"))


def test_every_problem_has_stored_counts() -> None:
    assert set(read_stored(str(STORED))) == {path.stem for path in FOLDER.glob("*.toml")}
