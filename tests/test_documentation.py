"""Every Python and shell line of the documentation: run, or where that takes long, parsed."""

from __future__ import annotations

import ast
import inspect
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

import wholearm
from shipped import FOLDER, HEPTAGON, LANDING, chart, problem_of, solved
from wholearm.cli.arguments import name_simulator
from wholearm.cli.command import build_parser, main
from wholearm.cli.map import protect
from wholearm.planning.result import Plan
from wholearm.problem.definition import Problem

ROOT = FOLDER.parent
PAGES = [ROOT / "README.md", *FOLDER.rglob("README.md"), *sorted((ROOT / "results").glob("*.md"))]
QUICK = ("new", "schema", "export", "verify", "plot")
"""Commands that are run; the others plan, search, draw movies or sample, which tests of their own
do with less: of these the real parser reads the lines."""


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def list_lines(path: Path) -> list[str]:
    """Commands of a page, indented or in backticks."""
    indented = re.findall(r"^    ((?:\.venv/bin/)?(?:wholearm|python).*)$", read(path), re.M)
    parts = [part.strip() for line in indented for part in line.split("&&")]
    spans = re.findall(r"`((?:wholearm|python -m wholearm)[^`]*)`", read(path))
    found = [*parts, *(" ".join(span.split()) for span in spans)]
    own = (re.sub(r"^.*?/?(wholearm |python -m wholearm)", r"\1", line) for line in found)
    return [line for line in own if line.startswith(("wholearm ", "python -m wholearm"))]


LINES = list(dict.fromkeys(line for path in PAGES for line in list_lines(path)))
BLOCKS = re.findall(r"^```python\n(.*?)^```", read(ROOT / "README.md"), re.M | re.S)
CALLS = re.findall(r"`(wholearm\.\w[\w.]*\([^`]*\))`", read(ROOT / "README.md"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with the files that the lines name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "problems").symlink_to(FOLDER)
    (tmp_path / "results").mkdir()
    solved(LANDING).save("results/heptagon.npz")
    solved(HEPTAGON).save("plan.npz")
    tuned = read(FOLDER / "torques" / "heptagon_tuned.csv")
    (tmp_path / "tuned.csv").write_text(tuned, encoding="utf-8")
    block = re.findall(r"^```toml\n(.*?)^```", read(FOLDER / "README.md"), re.M | re.S)[0]
    (tmp_path / "flip.toml").write_text(block, encoding="utf-8")
    return tmp_path


def test_python_blocks_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = solved(HEPTAGON)
    wholearm.make_policy(problem_of(HEPTAGON), plan, reserve=0.0).save("policy.npz")
    solve, known = wholearm.solve, {"heptagon, landing on edge 1": solved(LANDING)}

    def look_up(problem: Problem, **options: Any) -> Plan:
        return known.get(problem.name) or solve(problem, **options)

    monkeypatch.setattr(wholearm, "solve", look_up)
    names: dict[str, Any] = {}
    assert len(BLOCKS) >= 4
    for block in BLOCKS:
        exec(block, names)
    assert {path.name for path in folder.iterdir()} >= {"plan.pdf", "replay.npz", "heavier.toml"}
    assert wholearm.load("heavier.toml").table == problem_of(LANDING).with_(mass=0.25).table


@pytest.mark.parametrize("text", CALLS)
def test_python_calls_fit_their_functions(text: str) -> None:
    call = ast.parse(text, mode="eval").body
    assert isinstance(call, ast.Call)
    function = eval(ast.unparse(call.func), {"wholearm": wholearm})
    inspect.signature(function).bind(*call.args, **{str(key.arg): 0 for key in call.keywords})


@pytest.mark.parametrize("line", LINES)
def test_shell_lines_are_read(line: str, folder: Path) -> None:
    words = shlex.split(line, comments=True)
    if words[0] == "wholearm" and "COMMAND" not in words:
        if len(words) == 2:
            words.append("--help")
        try:
            build_parser().parse_args(protect(name_simulator(words[1:])))
        except SystemExit as error:
            assert error.code == 0


@pytest.mark.parametrize("path", [ROOT / "README.md", FOLDER / "README.md"], ids=str)
def test_quick_shell_lines_run(
    path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    solved(LANDING).save("pent.npz")
    run = 0
    for line in dict.fromkeys(list_lines(path)):
        words = shlex.split(line)
        if (
            len(words) < 3
            or words[1] not in QUICK
            or not {"--policy", "--free", "free"}.isdisjoint(words)
        ):
            continue
        run += 1
        assert main(words[1:]) == 0, (line, capsys.readouterr().err)
    assert run >= 2


def test_results_are_one_line_and_motions_a_picture() -> None:
    problem, plan = problem_of(HEPTAGON), solved(HEPTAGON)
    results = [
        plan,
        plan.trajectory,
        wholearm.simulate(problem, plan),
        wholearm.verify(problem, plan),
        wholearm.make_policy(problem, plan, reserve=0.0),
        chart(),
        problem,
    ]
    for result in results:
        text = repr(result)
        assert len(text) <= 100 and "\n" not in text
        assert text.startswith(f"{type(result).__name__}(")
    assert "<svg" in plan._repr_html_() and "<svg" in chart()._repr_html_()
