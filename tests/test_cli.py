from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from shipped import FOLDER, HEPTAGON, IMPACTS, plan_of, problem_of, solved, text_of
from wholearm import PlanOptions, load_trajectory
from wholearm.cli.command import build_parser, main
from wholearm.planning.result import describe_plan

Capture = pytest.CaptureFixture[str]


def write_problem(count: int, old: str = "", new: str = "") -> str:
    """A file in the current folder with the heptagon's first phases, and its name."""
    text = text_of(phases=count)
    assert old in text
    Path("problem.toml").write_text(text.replace(old, new), encoding="utf-8")
    return "problem.toml"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder that is also the current one."""
    place = tmp_path / "work"
    place.mkdir()
    monkeypatch.chdir(place)
    return place


def fails(capsys: Capture, status: int, *arguments: str) -> str:
    """Run a command that is to fail and return the one line it says."""
    assert main(arguments) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("wholearm: ")
    return lines[0].removeprefix("wholearm: ")


def test_solve_writes_the_plan(folder: Path, capsys: Capture) -> None:
    path = write_problem(2)
    arguments = ["solve", path, "-o", "a.npz", "--torques", "a.csv", "--samples", "21"]
    assert main(arguments) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = list(filter(None, out.splitlines()))
    assert len(lines) == 7 and lines[0].split()[:2] == ["phase", "duration"]
    plan = load_trajectory("a.npz")
    shown = [float(line.split()[1]) for line in lines[1:3]]
    np.testing.assert_allclose(shown, plan.meta["phase_durations"], atol=5e-7)
    assert min(float(line.split()[2]) for line in lines[1:3]) == pytest.approx(0.05, abs=1e-5)
    assert max(float(line.split()[3]) for line in lines[1:3]) <= 2.0
    assert lines[3].startswith("replayed: least c_n 0.0")
    # A parabola through three instants may dip a little below what the plan keeps.
    assert float(lines[3].split()[3]) > 0.0499
    assert lines[4].startswith("wrote a.csv: ") and " rows; its replay holds: " in lines[4]
    took = f"{plan.duration:.6f} s"
    error = f"{max(plan.meta['error'], 1e-9):.0e}"
    assert lines[5].startswith("contact forces unique: margin 0.")
    assert lines[6] == f"solved: time = {took} (to {error}), {took} in all; wrote a.npz"
    assert main(["verify", path, "a.csv"]) == 0 and len(plan.t) == 2 * 21
    assert Path("a.csv").read_text().startswith("t,tau1,tau2\n0.0,")
    assert sorted(path.name for path in folder.iterdir()) == ["a.csv", "a.npz", "problem.toml"]


@pytest.mark.parametrize("more", [["hold"], []])
def test_solve_writes_samples_and_what_becomes_of_them(
    folder: Path, capsys: Capture, more: list[str]
) -> None:
    path = write_problem(2)
    given = ["--intervals", "20", *(["--interpolation", *more] if more else [])]
    command = ["solve", path, "-o", "a.npz", "--torques", "a.csv", "--sample-rate", "200"]
    assert main([*command, *given, "--json"]) == 0
    plan = load_trajectory("a.npz")
    figures = json.loads(capsys.readouterr().out)["torques"]
    kind = more[0] if more else "linear"
    assert [figures[k] for k in ("file", "sample_rate", "interpolation")] == ["a.csv", 200.0, kind]
    planned = [row["planned_arrival"] for row in figures["replay"]["phases"]]
    np.testing.assert_allclose(planned, plan.phase_starts[1:])
    # What is lost is told, here and by verify, but is no error of solve.
    assert main(["verify", path, "a.csv"]) == (0 if figures["replay"]["ok"] else 1)
    first = capsys.readouterr().out.splitlines()[0]
    assert figures["replay"]["reason"].split(" at t = ")[0] in first
    assert main([*command, *given]) == 0
    lines = list(filter(None, capsys.readouterr().out.splitlines()))
    assert f"{kind} at 200 Hz; its replay " in lines[4]
    assert lines[5] == "phase  arrival [s]  planned [s]  least c_n [N]  planned [N]  contact"
    assert [line.split()[0] for line in lines[6:8]] == ["1", "2"]


@pytest.mark.parametrize(
    "given, message",
    [
        ("--sample-rate 100", "--sample-rate: needs --torques"),
        ("--torques a.csv --interpolation hold", "--interpolation: needs --sample-rate"),
        ("--torques a.csv --sample-rate -5", "--sample-rate: -5.0 given; allowed"),
        ("--torques a.csv --sample-rate 9 --interpolation cubic", "'cubic' given; allowed are"),
        ("--torques a.csv --sample-rate 0.01", "--sample-rate: 0.01 Hz given; "),
    ],
)
def test_bad_sampling(folder: Path, capsys: Capture, given: str, message: str) -> None:
    path = write_problem(1)
    assert message in fails(capsys, 2, "solve", path, "--intervals", "20", *given.split())
    assert [entry.name for entry in folder.iterdir()] == ["problem.toml"]


def test_solve_without_a_replay_and_a_name_of_its_output(folder: Path, capsys: Capture) -> None:
    command = ["solve", write_problem(1), "--intervals", "20", "--no-replay"]
    assert main([*command, "--torques", "a.csv"]) == 0
    lines = list(filter(None, capsys.readouterr().out.splitlines()))
    assert lines[2] == "the plan was not replayed" and lines[3].endswith(" rows")
    assert {path.name for path in folder.iterdir()} == {"problem.npz", "problem.toml", "a.csv"}
    assert load_trajectory("problem.npz").meta["replay"] is None
    assert main([*command, "-o", os.devnull]) == 0 and Path(os.devnull).is_char_device()


def test_solve_lists_the_impacts(folder: Path, capsys: Capture) -> None:
    plan = solved(IMPACTS)
    plan.save("a.npz")
    lines = describe_plan(plan, "a.npz").to_text().splitlines()
    assert lines[6] == lines[12] == ""
    assert lines[7].split("  ")[0].strip() == "after phase" and lines[7].endswith("saves [s]")
    rows = plan.meta["transitions"]
    for line, row in zip(lines[8:12], rows, strict=True):
        cells = line.split()
        assert int(cells[0]) == row["phase"]
        assert float(cells[1]) == pytest.approx(row["velocity_ratio"], abs=5e-7)
        assert float(cells[2]) == pytest.approx(row["least_impulse"], abs=5e-7)
        assert cells[3] == row["least_impulse_contact"]
        assert float(cells[4]) == pytest.approx(row["speed"], abs=5e-7)
        if row["possible"]:
            assert float(cells[5]) == pytest.approx(row["saves"], abs=5e-7)
        else:
            assert cells[5] == "-" and line.endswith(f"stops: {row['reason']}")
    assert main(["verify", str(IMPACTS), "a.npz"]) == 0
    assert "least impulse [N s]" in capsys.readouterr().out


def test_files_of_an_earlier_run_are_left_and_named(folder: Path, capsys: Capture) -> None:
    Path("a.npz").write_bytes(b"old")
    options = ["-o", "a.npz", "--torques", "a.csv", "--objective", "margin", "--duration", "1e-3"]
    assert main(["solve", write_problem(1), *options]) == 1
    stale, reason = capsys.readouterr().err.splitlines()
    assert stale == "wholearm: a.npz: left as it was, from an earlier run"
    assert "duration = 0.001 s" in reason
    assert Path("a.npz").read_bytes() == b"old" and not Path("a.csv").exists()


@pytest.mark.parametrize("objective", ["time", "effort", "margin"])
def test_solve_prints_json(folder: Path, capsys: Capture, objective: str) -> None:
    extra = {"effort": ["--time-weight", "2"], "margin": ["--duration", "0.2"]}
    options = ["--objective", objective, "--intervals", "20", *extra.get(objective, [])]
    path = write_problem(1)
    assert main(["solve", path, "-o", "a.npz", "--json", *options]) == 0
    meta = json.loads(capsys.readouterr().out)
    assert meta == load_trajectory("a.npz").meta
    assert meta["objective"] == objective and meta["intervals"] == 20
    if objective == "effort":
        assert meta["time_weight"] == 2.0
    if objective == "margin":
        assert 0.05 < meta["value"] < 1 and sum(meta["phase_durations"]) <= 0.2 * (1 + 1e-6)


@pytest.mark.usefixtures("unadvised")
@pytest.mark.parametrize(
    "old, new, status, words",
    [
        ("= 0.05 ", "= 50.0 ", 1, "phase 1 is infeasible: c_n of v1-palm >= epsilon = 50 N is "),
        ("= 0.05 ", "= true ", 2, "problem.toml: epsilon: true is not a number >= 0 (finite)"),
        ("mass", "mas", 2, "problem.toml: object.mas: unknown key; did you mean 'mass'?"),
    ],
)
def test_problems_without_a_plan(
    folder: Path, capsys: Capture, old: str, new: str, status: int, words: str
) -> None:
    """What is said of other ones is in the tests of the reader and of the planner."""
    path = write_problem(5, old, new)
    options = ["-o", "a.npz", "--torques", "a.csv", "--intervals", "10"]
    text = fails(capsys, status, "solve", path, *options)
    assert words in text and main(["solve", path, *options, "--json"]) == status
    told = json.loads(capsys.readouterr().out)
    assert (told["error"], told["status"]) == (text, status)
    assert told["shortfalls"][0]["place"]["phase"] == 1 if status == 1 else told["key"] in words
    assert [entry.name for entry in folder.iterdir()] == ["problem.toml"]


@pytest.mark.parametrize(
    "content, words",
    [
        (b"", "epsilon: is missing"),
        (b"epsilon = ", "is not TOML: "),
        (b"PK\x03\x04", "is no problem file but an archive"),
        (b"\xff\xfe\x00", "is not TOML: "),
        (None, "cannot be read: No such file or directory"),
    ],
)
@pytest.mark.parametrize("verb", ["solve", "verify", "bench growth"])
def test_unreadable_problems(
    folder: Path, capsys: Capture, verb: str, content: bytes | None, words: str
) -> None:
    if content is not None:
        Path("p.toml").write_bytes(content)
    Path("a.csv").write_text("t,tau1,tau2\n0,0,0\n0.5,0,0\n")
    arguments = ["a.csv"] if verb == "verify" else []
    message = fails(capsys, 2, *verb.split(), "p.toml", *arguments)
    assert message.startswith(f"p.toml: {words}")
    assert {path.name for path in folder.iterdir()} <= {"p.toml", "a.csv"}


@pytest.mark.parametrize("option", ["-o", "--torques"])
@pytest.mark.parametrize(
    "target, words",
    [("absent/out", "no folder"), (".", "is a folder"), ("file/out", "not a f"), ("link", "reads")],
)
def test_unwritable_outputs(
    folder: Path, capsys: Capture, option: str, target: str, words: str
) -> None:
    Path("file").write_text("kept")
    Path("link").symlink_to(HEPTAGON)
    output = [] if option == "-o" else ["-o", "a.npz"]
    message = fails(capsys, 2, "solve", str(HEPTAGON), option, target, *output)
    assert message.startswith(f"{target}: cannot be written: ") and words in message
    assert sorted(path.name for path in folder.iterdir()) == ["file", "link"]
    assert Path("file").read_text() == "kept"


@pytest.mark.parametrize(
    "arguments, words",
    [
        ([], "COMMAND"),
        (["slove"], "invalid choice: 'slove'"),
        (["solve"], "problem"),
        (["solve", "a", "--speed", "3"], "unrecognized arguments: --speed 3; see wholearm solve"),
        (["solve", str(HEPTAGON), "--intervals", "ten"], "'ten' given; allowed are whole numbers"),
        (["solve", str(HEPTAGON), "--time-weight", "nan"], "--time-weight: nan given; allowed are"),
        (["solve", str(HEPTAGON), "--time-weight", "2"], "--time-weight: is for the objective"),
        (["solve", str(HEPTAGON), "--cache", "found"], "--cache: is for problems with [goal]"),
        (["solve", str(HEPTAGON), "--duration", "1"], "--duration: is for the objective margin"),
        (["plot", "a.npz"], "-o/--output"),
        (["plot", "a.npz", "--simulate", "fre"], "--simulate: invalid choice: 'fre'"),
        (["verify", str(HEPTAGON), "a.npz", "-o", "./a.npz"], "./a.npz: cannot be written: this c"),
        (["map", str(HEPTAGON), "--plan", "a.png", "-o", "a.png"], "this command reads it"),
        (["verify", str(HEPTAGON), "a.npz", "--tolerance", "0"], "--tolerance: 0.0 given; allowed"),
        (["bench", "queries", "--problems", "a"], "a/heptagon.toml: cannot be read: "),
        (["bench", "corpus", "--problems", "a"], "a/box_rolling.toml: cannot be read: "),
        (["bench", "corpus", "--only", "a*", "--problems", str(FOLDER)], "--only: 'a*' given; no"),
        (["sweep", str(HEPTAGON), "--vary", "mass=1,2", "--seed", "1"], "--seed: 1 given; needs"),
    ],
)
def test_bad_arguments(folder: Path, capsys: Capture, arguments: list[str], words: str) -> None:
    assert words in fails(capsys, 2, *arguments) and list(folder.iterdir()) == []


def test_verify_torques_as_json(folder: Path, capsys: Capture) -> None:
    plan_of(HEPTAGON).save_torques("torques.csv")
    command = ["verify", str(HEPTAGON), "torques.csv", "--json"]
    assert main([*command, "--tolerance", "1e-8"]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    assert err == "" and report["ok"] and report["reached"] and report["exit_status"] == 0
    assert report["tolerance"] == 1e-8 and report["name"] == problem_of(HEPTAGON).name
    assert len(report["phases"]) == 5 and report["failures"] == []


def test_verify_names_a_missed_goal(folder: Path, capsys: Capture) -> None:
    Path("weak.csv").write_text("t,tau1,tau2\n0,0,0\n0.5,0,0\n")
    assert main(["verify", str(HEPTAGON), "weak.csv"]) == 1
    out, err = capsys.readouterr()
    assert err == "" and "FAILED: " in out
    assert "the torques end at t = 0.5 s, phase 1, 0.0236 m short of v3-finger1" in out
    Path("early.csv").write_text("t,tau1,tau2\n0,3,2.1\n0.5,3,2.1\n")
    assert main(["verify", str(HEPTAGON), "early.csv", "-o", "a.npz"]) == 1
    out, err = capsys.readouterr()
    assert err.startswith("wholearm: a.npz: is not written: there is no motion to keep: c_n of v5")
    assert "FAILED: c_n of v5-finger2" in out and not Path("a.npz").exists()


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("a.npz", None, "cannot be read: No such file"),
        ("a.npz", b"", "is not a trajectory file"),
        ("a.txt", b"", "ending '.txt' given; allowed: .npz, .csv"),
    ],
)
def test_bad_trajectory_files(
    folder: Path, capsys: Capture, name: str, content: bytes | None, words: str
) -> None:
    if content is not None:
        Path(name).write_bytes(content)
    message = fails(capsys, 2, "verify", str(HEPTAGON), name)
    assert message.startswith(f"{name}: {words}")
    if name.endswith(".npz"):
        assert fails(capsys, 2, "plot", name, "-o", "a.png") == message
    assert not Path("a.png").exists()


def run(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error", *arguments]
    return subprocess.run(command, capture_output=True, text=True, **options)


def test_version() -> None:
    result = run("-m", "wholearm", "--version")
    expected = 0, "", f"wholearm {wholearm.__version__}\n"
    assert (result.returncode, result.stderr, result.stdout) == expected


def test_solve_imports_only_what_it_needs(folder: Path) -> None:
    """What the process costs over importing casadi and numpy is its own work."""
    path = write_problem(1)
    code = (
        "import sys\nfrom wholearm.cli.command import main\n"
        "unwanted = ['scipy', 'matplotlib', 'wholearm.figures.plots']\n"
        "for more in ['--no-replay'], []:\n"
        f"    assert main(['solve', {path!r}, '-o', 'a.npz', *more]) == 0\n"
        "    named = [*unwanted, 'wholearm.simulation.simulate'] if more else unwanted\n"
        "    assert not [name for name in named if name in sys.modules]"
    )
    result = run("-c", code, cwd=folder)
    assert result.returncode == 0, result.stderr


def test_bad_input_is_told_before_anything_heavy_is_imported() -> None:
    code = (
        "import sys\nfrom wholearm.cli.command import main\n"
        "status = main(['solve'])\n"
        "print(status, [name for name in ('casadi', 'numpy') if name in sys.modules])"
    )
    assert run("-c", code).stdout == "2 []\n"


NEW = "new out.toml --polygon 4 --size 0.05"


@pytest.mark.skipif(os.name != "posix", reason="redirections of a POSIX shell")
@pytest.mark.parametrize(
    ("command", "redirection", "status", "message"),
    [
        ("help", ">&-", 0, ""),
        ("help", "2>&-", 0, ""),
        (NEW, "> /dev/full", 1, "cannot be written: No space left on device\n"),
    ],
)
def test_output_that_cannot_be_written_is_no_traceback(
    folder: Path, command: str, redirection: str, status: int, message: str
) -> None:
    shell = ["bash", "-c", f'"{sys.executable}" -m wholearm {command} {redirection}']
    done = subprocess.run(shell, capture_output=True, text=True)
    expected = message and f"wholearm: standard output: {message}"
    assert (done.returncode, done.stderr) == (status, expected)
    assert Path("out.toml").exists() is (command == NEW)


def test_a_closed_pipe_is_no_traceback(folder: Path) -> None:
    command = [sys.executable, "-m", "wholearm", *NEW.split()]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 1 and Path("out.toml").exists()


def list_parsers(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    inner = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    own = [parser] if not inner else []
    return own + [q for action in inner for p in action.choices.values() for q in list_parsers(p)]


def test_every_number_among_the_options_has_a_range() -> None:
    every = [action for parser in list_parsers(build_parser()) for action in parser._actions]
    numbers = [action for action in every if action.type is not None]
    assert len(numbers) > 40
    for action in numbers:
        assert callable(action.type) and action.type not in (int, float)
        for wrong in ("1e300", "1" + 40 * "0", "-1e300", "nan", "inf", "much"):
            with pytest.raises(argparse.ArgumentTypeError, match="given; allowed are"):
                action.type(wrong)
        if isinstance(action.default, int | float):
            assert action.type(str(action.default)) == action.default


def test_help_shows_every_default() -> None:
    solve = next(p for p in list_parsers(build_parser()) if p.prog == "wholearm solve")
    known = {action.dest: action.help or "" for action in solve._actions}
    for own in dataclasses.fields(PlanOptions):
        if isinstance(own.default, int | float | str) and not isinstance(own.default, bool):
            (given,) = re.findall(r"\(([^()]*)\)$", known[own.name])
            assert str(own.default) == given or float(given) == own.default


def test_shells_complete(capsys: Capture) -> None:
    assert main(["completion", "fish"]) == 2
    assert "allowed are 'bash', 'zsh', 'tcsh'" in capsys.readouterr().err
    pytest.importorskip("shtab", reason="wholearm[completion] is not installed")
    assert main(["completion", "bash"]) == 0
    text = capsys.readouterr().out
    assert "--time-weight" in text and "wholearm" in text
    # Studies add their options when they are used.
    assert "_shtab_wholearm_bench_stress___output_COMPGEN=_shtab_compgen_dirs" in text
    assert "_shtab_wholearm_bench_growth_pos_0_COMPGEN=_shtab_compgen_files" in text
