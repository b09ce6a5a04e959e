"""Problem files to begin with, and goals."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from shipped import HEPTAGON, plan_of, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.comparison.metrics import compare
from wholearm.geometry.path_guess import load
from wholearm.mapping.formation_list import write_template
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.problem.goal import Goal
from wholearm.problem.read import adopt_phases, build_problem


def least_time(folder: Path, corners: int, size: float, mass: float | None = None) -> float:
    path = folder / "own.toml"
    path.write_text(write_template("own", corners, size, mass), encoding="utf-8")
    return solve(load(str(path))).value


@pytest.mark.parametrize("corners", [3, 4, 5, 6, 7, 12])
def test_a_template_plans_as_it_is(corners: int, tmp_path: Path) -> None:
    assert least_time(tmp_path, corners, 0.05) > 0


def test_templates_are_alike_in_every_size(tmp_path: Path) -> None:
    # Under gravity times go with the root of lengths, whatever the mass; numbers have four digits.
    small, large = least_time(tmp_path, 7, 0.05), least_time(tmp_path, 7, 5.0, mass=3.0)
    assert large / small == pytest.approx(math.sqrt(100.0), rel=1e-2)


@pytest.mark.parametrize(
    ("given", "key"),
    [((2, 0.05, None), "--polygon"), ((7, -1.0, None), "--size"), ((7, 0.05, 0.0), "--mass")],
)
def test_what_makes_no_scene_is_refused(given: tuple[int, float, float | None], key: str) -> None:
    with pytest.raises(InputError, match=key):
        write_template("own", *given)


def test_new_writes_a_file_and_keeps_one_that_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.toml"
    assert main(["new", str(tmp_path / "mine"), "--polygon", "5"]) == 0
    text = path.read_text(encoding="utf-8")
    assert load(str(path)).name == "mine"
    assert load(str(path)).scene.polygon.n_vertices == 5
    assert main(["new", str(path)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == text


TABLE = {k: v for k, v in tomllib.loads(HEPTAGON.read_text()).items() if k != "phases"}


def read(goal: object) -> Problem:
    return build_problem({**TABLE, "goal": goal})


@pytest.mark.parametrize(
    ("given", "goals"),
    [
        ({"flush": 6}, (Goal(flush=6),)),
        ({"phi_deg": -50.0, "x": 0.02}, (Goal(phi=math.radians(-50.0), x=0.02),)),
        ([{"flush": 6, "x": 0.0}, {"flush": 0}], (Goal(flush=6, x=0.0), Goal(flush=0))),
    ],
)
def test_goals_are_read_and_written(given: object, goals: tuple[Goal, ...]) -> None:
    problem = read(given)
    assert problem.goals == goals and not problem.phases
    assert replace(problem, epsilon=0.1).table["goal"] == given
    other = replace(problem, goals=(Goal(flush=1, x=0.01),))
    assert other.table["goal"] == {"flush": 1, "x": 0.01}
    assert build_problem(other.table).goals == other.goals
    # What a search finds takes the place of goals.
    found = replace(problem, goals=(), phases=problem_of(HEPTAGON).phases)
    assert "goal" not in found.table and len(found.table["phases"]) == 5


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"x": 0.0}, "goal: neither flush nor phi_deg given"),
        ({"flush": 1, "phi_deg": 3.0}, "goal: flush and phi_deg are both given"),
        ({"flush": 7}, "goal.flush: 7 is not an edge; allowed are 0 to 6"),
        ({"flush": 1.5}, "goal.flush: 1.5 is not an edge"),
        ([{"flush": 1}, {"flush": 2, "x": 1e6}], r"goal\[2\].x: 1e+"),
        ({"flush": 1, "y": 0.0}, "goal.y: unknown key"),
        ("edge 6", "goal: 'edge 6' given"),
    ],
)
def test_other_goals_are_refused(given: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        read(given)


def test_phases_and_goals_exclude_each_other() -> None:
    table = tomllib.loads(HEPTAGON.read_text())
    with pytest.raises(InputError, match=r"goal: given with \[\[phases\]\]"):
        build_problem({**table, "goal": {"flush": 6}})


def test_a_plan_brings_the_phases_that_lead_to_its_goal(tmp_path: Path) -> None:
    plan, planned = plan_of(HEPTAGON), problem_of(HEPTAGON)
    phi = math.degrees(plan.q[-1, 2])
    problem = read({"phi_deg": phi})
    found = adopt_phases(problem, plan.meta, plan.q[-1])
    assert found.table["phases"] == planned.table["phases"] and not found.goals
    assert adopt_phases(planned, plan.meta, plan.q[-1]) is planned
    plan.save(tmp_path / "plan.npz")
    (own,) = compare(problem, [str(tmp_path / "plan.npz")]).contenders
    assert own.ok and len(own.lasts) == 5
    for goal in ({"phi_deg": phi + 1.0}, {"phi_deg": phi, "x": plan.q[-1, 0] + 1e-3}, {"flush": 6}):
        with pytest.raises(InputError, match=r"goal: the plan ends at .*, and not with"):
            adopt_phases(read(goal), plan.meta, plan.q[-1])
