"""Sweeps: rows are what planning says, and depend on nothing but their point."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from wholearm import InfeasibleError, InputError, Problem, Sweep
from wholearm.cli.command import main
from wholearm.design.sweep import Planner, describe_failure, read_vary, sweep
from wholearm.problem.definition import Goal

ONE: Callable[[], Executor] = partial(ThreadPoolExecutor, 1)
GRID = {"torque_limit": [0.02, 1.0, 2.0], "mass": [0.2, 0.25]}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sweep") / "sweep.jsonl"


@pytest.fixture(scope="module")
def result(box: Problem, path: Path) -> Sweep:
    return sweep(box, GRID, path=path, start=ONE, checks=("verify",))


def test_rows_are_plans(box: Problem, result: Sweep) -> None:
    assert [(row["torque_limit"], row["mass"]) for row in result.rows] == [*product(*GRID.values())]
    plan, row = wholearm.solve(box.with_(torque_limit=1.0, mass=0.25)), result.rows[3]
    assert row["value"] == plan.value and row["duration1"] == plan.phases[0].duration
    assert row["status"] == "planned" and row["verify"] == "ok"
    assert row["margin"] == pytest.approx(0.0, abs=1e-6)
    # Least time: stronger fingers are faster, and a heavier box is slower.
    assert result.rows[5]["value"] < row["value"] and result.rows[2]["value"] < row["value"]
    assert result.best == 4 and result.ok


def test_the_limit_is_the_one_that_is_active(box: Problem) -> None:
    """A slow joint turns as fast as it may but for start and stop, which take next to no time."""
    (row,) = sweep(box, {"speed_limit": [0.05]}, start=ONE, replay=False).rows
    assert row["limit"].startswith("speed limit of finger") and 0.95 < row["share"] <= 1.0


def test_points_without_a_plan_say_why_and_what_would_help(box: Problem, result: Sweep) -> None:
    row = result.rows[0]
    with pytest.raises(InfeasibleError) as caught:
        wholearm.solve(box.with_(torque_limit=0.02, mass=0.2))
    least = min(caught.value.changes, key=lambda change: change.relative)
    assert row["status"] == "infeasible" and row["message"] == str(caught.value)
    assert row["change"] == str(least)
    # The same reason at both masses, though the message has other numbers.
    assert row["reason"] == result.rows[1]["reason"] and re.search("in phase 1$", row["reason"])
    assert row["message"] != result.rows[1]["message"]
    assert result.reasons == {row["reason"]: 2}
    text = result.to_text()
    assert "4 of 6 points planned" in text and "best: time [s] = " in text


def test_tables_say_the_same(result: Sweep) -> None:
    rows, values = [*csv.DictReader(result.to_csv().splitlines())], result.to_dict()
    for row, entry, kept in zip(rows, values["rows"], result.rows, strict=True):
        assert entry.items() >= {k: v for k, v in kept.items()}.items()
        assert float(row["torque_limit"]) == entry["torque_limit"]
        assert row["value"] == ("" if kept["value"] is None else repr(kept["value"]))
    assert values["vary"] == GRID and values["best"] == 4
    json.dumps(values)


def test_a_sweep_that_was_stopped_ends_the_same(
    box: Problem, result: Sweep, path: Path, tmp_path: Path
) -> None:
    part, calls = tmp_path / "part.jsonl", list[str]()
    lines = path.read_text().splitlines(keepends=True)
    assert len(lines) == 7
    part.write_text("".join(lines[:5]) + lines[5][:20])
    again = sweep(box, GRID, path=part, start=ONE, checks=("verify",), progress=calls.append)
    assert len(calls) == 2 and re.match(r"\[#{20}\] 6 of 6 points, 0 s left", calls[-1])
    assert again.to_csv() == result.to_csv()
    assert sorted(part.read_text().splitlines()[1:]) == sorted(path.read_text().splitlines()[1:])
    with pytest.raises(InputError, match=r"another study: .*vary.mass"):
        sweep(box, {**GRID, "mass": [0.2, 0.3]}, path=part, start=ONE, checks=("verify",))


def test_a_row_that_crashes_is_done_again(box: Problem, tmp_path: Path) -> None:
    class Broken(ThreadPoolExecutor):
        def submit(self, *_: Any, **__: Any) -> Any:
            return super().submit(lambda: 1 / 0)

    path, vary = tmp_path / "sweep.jsonl", {"mass": [0.2]}
    broken = sweep(box, vary, path=path, start=Broken)
    assert broken.rows[0]["status"] == "failed" and not broken.ok
    assert "most often because of: division by zero" in broken.to_text()
    assert sweep(box, vary, path=path, start=ONE).ok


def test_samples_are_a_latin_hypercube(box: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        Planner, "run", lambda *_: {"status": "failed", "value": None, "reason": ""}
    )
    drawn = partial(sweep, box, {"mass": (0.1, 0.3), "epsilon": (0.0, 0.1)}, start=ONE, samples=8)
    rows = drawn(seed=1).rows
    for name, low, high in (("mass", 0.1, 0.3), ("epsilon", 0.0, 0.1)):
        assert sorted(int(8 * (row[name] - low) / (high - low)) for row in rows) == [*range(8)]
    assert rows == drawn(seed=1).rows != drawn(seed=2).rows


def test_goals_and_words_are_varied_too(box: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    goals = Problem(box.name, box.scene, box.epsilon, box.start, (), goals=(Goal(flush=1, x=0.0),))
    seen = list[tuple[Any, ...]]()

    def refuse(problem: Problem, **_: Any) -> None:
        seen.append((problem.goals[0].flush, problem.goals[0].x))
        raise InfeasibleError(f"nothing leads to x = {problem.goals[0].x} at x = 3 mm")

    monkeypatch.setattr("wholearm.design.sweep.solve", refuse)
    result = sweep(goals, read_vary(["goal.flush=1,2", "goal.x=0:0.01:2"]), start=ONE)
    assert seen == [(1, 0.0), (1, 0.01), (2, 0.0), (2, 0.01)]
    assert result.reasons == {"nothing leads to x = \u2026": 4}
    assert result.titles["goal.x"] == "goal.x [m]"


@pytest.mark.parametrize(
    "text", ["mass", "mass=", "=1", "mass=1:2", "mass=2:1:3", "mass=1:2:1", "mass=a:b:3", "x=1,2:3"]
)
def test_values_are_read(text: str) -> None:
    with pytest.raises(InputError, match="--vary"):
        read_vary([text])
    values = read_vary(["x=1:2:3", "flush=0,1", "control_hold=linear"])
    assert values == {"x": (1.0, 1.5, 2.0), "flush": (0, 1), "control_hold": ("linear",)}
    assert read_vary(["x=.5:2"], samples=5) == {"x": (0.5, 2.0)}
    assert read_vary(["fingers_collide=true,false"]) == {"fingers_collide": (True, False)}


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({"mas": [0.1, 0.2]}, "--vary mas: unknown name; did you mean 'mass'"),
        ({"fingers.1.lenth": [0.1]}, "--vary fingers.1.lenth: unknown key; did you mean 'length'"),
        ({"finger.1.length": [0.1]}, "there is no 'finger'; did you mean 'fingers'"),
        ({"phases[2].until.x": [0.1]}, "there is no number 2; the list has 1"),
        ({"goal.x": [0.1]}, "--vary goal.x: there is no 'goal'"),
        ({"mass": [0.2, np.nan, 0.3]}, "--vary mass: nan is not a positive number (finite)"),
        ({"friction_palm": [0.1, 20.0]}, "--vary friction_palm: 20 given; allowed are 0 to 10"),
        ({"control_hold": ["linear", "cubic"]}, "--vary control_hold: 'cubic' given; allowed are"),
    ],
)
def test_bad_parameters_are_refused(box: Problem, vary: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        sweep(box, vary, start=ONE)


def test_reasons_of_neighbours_are_alike() -> None:
    texts = [
        f"phase {{}} = -{x} deg is never reached: going one way v3 runs off at x = {x} mm"
        for x in (1, 2.5)
    ]
    rows = [describe_failure(InputError("a.toml", "phases[2].until", text)) for text in texts]
    reasons = [row["reason"] for row in rows]
    assert reasons == 2 * ["phases[2].until: phase {} = \u2026 deg is never reached"]
    assert rows[0]["status"] == "impossible"


def make(vary: dict[str, Any], problem: Problem | list[Problem], samples: int = 0) -> Sweep:
    """A sweep that is made up: no plan where the first parameter is largest."""

    def run(_: Planner, task: tuple[int, tuple[Any, ...]]) -> dict[str, Any]:
        number, point = task
        if point[1] > 0.28:
            return {"status": "failed", "value": None, "reason": "too heavy"}
        return {"status": "planned", "value": 1.0 + 0.1 * number, "limit": "epsilon", "share": 0.5}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Planner, "run", run)
        return sweep(problem, vary, samples=samples, start=ONE)


def test_figures(box: Problem) -> None:
    mass, hold = np.linspace(0.1, 0.3, 5), ["constant", "linear"]
    curve = wholearm.draw_sweep(make({"mass": mass}, box)).axes
    assert len(curve) == 1 and curve[0].get_ylabel() == "time [s]"
    (y,) = (np.asarray(line.get_ydata()) for line in curve[0].get_lines())
    assert y[:4] == pytest.approx([1.0, 1.1, 1.2, 1.3]) and np.isnan(y[4])
    assert [text.get_text() for text in curve[0].texts] == ["too heavy"]
    words = make({"mass": mass, "control_hold": hold, "fingers_collide": [False]}, box)
    assert re.search(r"0.1 +constant +false +planned", words.to_text())
    lines = wholearm.draw_sweep(words).axes[0]
    legend = lines.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [f"control_hold = {k}" for k in hold]
    # Reasons have other colours than the two curves.
    assert {k.get_color() for k in lines.get_lines() if k.get_marker() == "x"} == {"#009E73"}
    twice = make({"mass": mass}, [box, box.with_(epsilon=0.1)])
    assert twice.problems == (f"{box.source} (1)", f"{box.source} (2)")
    assert len(wholearm.draw_sweep(twice).axes[0].get_legend_handles_labels()[1]) == 2
    plane = wholearm.draw_sweep(make({"mass": mass[::-1], "epsilon": [0.0, 0.1]}, box))
    cells = plane.axes[0].collections[0].get_array()
    # Rows are numbered in the order of the grid: the largest mass, which has no plan, comes first.
    assert cells is not None and np.ma.filled(cells, 9.0).tolist() == [
        [pytest.approx(value) for value in line]
        for line in ([1.8, 1.6, 1.4, 1.2, 9.0], [1.9, 1.7, 1.5, 1.3, 9.0])
    ]
    assert [axes.get_xlabel() for axes in plane.axes] == ["mass [kg]", ""]
    assert np.size(plane.axes[0].collections[1].get_facecolor()) == 0  # contours are lines
    assert plane.legends[0].get_texts()[0].get_text() == "too heavy: 2"
    vary = {"mass": mass, "epsilon": [0.0, 0.1], "x": [0.0, 0.001, 0.002]}
    panels = wholearm.draw_sweep(make(vary, box)).axes
    assert [axes.get_title() for axes in panels[:3]] == ["x = 0", "x = 0.001", "x = 0.002"]
    # One column has plans: there are no contour lines, nor lines for them at the colour bar.
    vary = {"mass": [0.1, 0.285, 0.3], "epsilon": [0, 0.05, 0.1, 0.2]}
    column, bar = wholearm.draw_sweep(make(vary, box)).axes
    assert column.texts[0].get_position() == pytest.approx((0.269375, 0.0875))
    assert not bar.yaxis.get_gridlines()[0].get_visible()
    # Nor is there a scale of values where no point has a plan.
    for more in ({}, {"epsilon": [0.0, 1.0]}):
        (bare,) = wholearm.draw_sweep(make({"mass": [0.29, 0.3], **more}, box)).axes
        assert bare.get_ylabel() != "time [s]"
    samples = wholearm.draw_sweep(make({"mass": (0.001, 0.003), "epsilon": (0, 1)}, box, 4)).axes
    samples[0].figure.canvas.draw()
    assert max(len(label.get_text()) for label in samples[0].get_xticklabels()) <= 4
    assert [axes.get_xlabel() for axes in samples] == ["mass [kg]", "epsilon [N]"]


def test_the_command_writes_table_and_figure(
    box: Problem,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("wholearm.common.parallel.Processes", lambda jobs: ThreadPoolExecutor(1))
    given = ["sweep", box.source, "--vary", "mass=0.2:0.3:2", "--no-replay"]
    assert main([*given, "--figure", "mass.png"]) == 0
    names = sorted(file.name for file in tmp_path.iterdir())
    assert names == ["box_sweep_mass.csv", "box_sweep_mass.jsonl", "mass.png"]
    assert "2 of 2 points planned" in capsys.readouterr().out
    table = Path("box_sweep_mass.csv").read_text()
    assert main([*given, "--json"]) == 0
    assert [row["mass"] for row in json.loads(capsys.readouterr().out)["rows"]] == [0.2, 0.3]
    assert Path("box_sweep_mass.csv").read_text() == table
    assert main([*given, "--vary", "phases[1].until.x=0.2,0.3", "-o", "none.csv"]) == 1
    assert "no point has a plan" in capsys.readouterr().out
    four = ["mass=1,2", "x=1,2", "epsilon=1,2", "gravity=1,2", "--figure", "mass.png"]
    Path("own.csv").write_text("t,tau1,tau2\n0,0,0\n")
    for more, text in (
        (["--vary", *four], "--figure: drawn are 1 to 3 parameters"),
        (["--with", "verify,fre"], "--with: 'fre' given"),
        (["-o", "own.csv"], "own.csv: holds no table of a sweep; --fresh replaces it"),
    ):
        assert main([*given, *more]) == 2 and text in capsys.readouterr().err
    assert main([*given[:2], *given[-1:], "-o", "own.csv", "--fresh"]) == 0
    assert re.search(r"best: time \[s\] = [0-9.]+\nwrote own.csv", capsys.readouterr().out)
