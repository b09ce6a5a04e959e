from __future__ import annotations

import dataclasses
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from shipped import HEPTAGON, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.comparison.metrics import compare
from wholearm.figures.comparison import draw_comparison
from wholearm.problem.definition import Problem
from wholearm.problem.keys import name_keys
from wholearm.problem.table import change_table
from wholearm.results.adopt import save
from wholearm.results.provenance import describe_origin
from wholearm.results.torque import TorqueProfile, read_notes, read_torque_csv
from wholearm.results.trajectory_file import load_trajectory
from wholearm.simulation.simulate import simulate
from wholearm.verification.verify import verify


@cache
def first_phase() -> Problem:
    problem = problem_of(HEPTAGON)
    return dataclasses.replace(problem, phases=problem.phases[:1])


def push(first: float = 0.3, second: float = 0.0) -> TorqueProfile:
    """Constant torques; the given ones drive the first phase through its end."""
    return TorqueProfile(np.array([0.0, 0.5]), np.array([[[first], [second]]]))


def write(folder: Path) -> list[str]:
    """A replay of `push`, its torques with a note, torques that let go, and such that hold."""
    paths = [str(folder / name) for name in ("moved.npz", "noted.csv", "lost.csv", "still.csv")]
    save(simulate(first_phase(), push()), paths[0])
    for path, torque in zip(paths[1:], (push(), push(0.05, 0.05), push(0.0, 0.0)), strict=True):
        save(torque, path)
    noted = Path(paths[1])
    noted.write_text("# simulations = 37\n" + noted.read_text(encoding="utf-8"), encoding="utf-8")
    return paths


def test_figures_are_those_of_verify(tmp_path: Path) -> None:
    problem, paths = first_phase(), write(tmp_path)
    found = compare(problem, paths)
    moved, noted, lost, still = found.contenders
    report = verify(problem, push())
    energy = report.energy
    assert moved.name == "moved.npz" and noted.simulations == 37 and moved.simulations is None
    for own in (moved, noted):
        assert own.reason == report.reason and own.ok == report.ok
        assert own.duration == pytest.approx(report.phases[0].arrival, abs=1e-7)
        assert own.lasts == pytest.approx([own.duration], abs=1e-7)
        assert own.effort == pytest.approx(0.09 * 0.5) and own.peaks == pytest.approx((0.3, 0.0))
        least = min(report.phases[0].contacts, key=lambda margin: margin.least)
        assert own.margin == pytest.approx(least.margin, abs=1e-6) and own.contact == least.contact
        dissipated = energy.viscous + energy.dry + energy.contact + energy.impact
        assert own.lost == pytest.approx(dissipated, abs=1e-6)
    assert lost.verdict == "FAILED" and "v5-finger2" in lost.reason and lost.duration == 0.5
    assert still.margin is None and "short of v3-finger1" in still.reason
    assert found.exit_status == 1
    text = found.to_text()
    assert "37" in text and "noted.csv" in text and lost.reason in text
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False)) == found.to_dict()
    figure = draw_comparison(found)
    assert len(figure.axes) == 3  # nothing has moved in lost.csv


def test_what_does_not_fit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem, (moved, *_) = first_phase(), write(tmp_path)
    for other, text in (
        (problem.with_(mass=0.3), r"object\.mass: 0\.\d+ in the trajectory, 0\.\d+ in the problem"),
        (problem_of(HEPTAGON), "phases: 1 entries in the trajectory, 5 in the problem"),
        (problem.with_({"phases[1].until": {"x": 0.02}}), r"phases\[1\]\.until"),
    ):
        with pytest.raises(InputError, match=text) as caught:
            compare(other, [moved])
        assert caught.value.source == moved
    compare(problem.with_(epsilon=0.01, name="other"), [moved])
    assert main(["compare", str(HEPTAGON), moved]) == 2
    assert "moved.npz: phases: 1 entries" in capsys.readouterr().err
    odd = tmp_path / "odd.csv"
    odd.write_text("# simulations = many\nt,tau1,tau2\n0,0,0\n1,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match="'many' given"):
        compare(problem, [str(odd)])


def test_comments_of_torques_are_read(tmp_path: Path) -> None:
    file = tmp_path / "noted.csv"
    file.write_text("# found by hand\n# a = 1\nt,tau1,tau2\n0,1,2\n# b= c d\n1,3,4\n")
    assert read_notes(str(file)) == {"a": "1", "b": "c d"}
    assert read_torque_csv(str(file)).at(np.array([0.5]))[0] == pytest.approx([2.0, 3.0])


def test_what_differs_from_the_problem_of_a_plan_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    problem, (moved, *_) = first_phase(), write(tmp_path)
    meta = load_trajectory(moved).meta
    assert describe_origin(problem, meta) == ""
    other = problem.with_(mass=0.3, length1=problem.scene.fingers[0].length * 1.01)
    text = describe_origin(other, meta)
    assert text.startswith("made for another problem: object.mass (0.2 in the plan, 0.3 here)")
    assert "fingers.1.length" in text
    vertices = [*problem.table["object"]["vertices"]]
    chipped = problem.table["object"] | {"vertices": vertices[:-1]}
    for senseless, key in (
        ({"length1": problem.scene.fingers[0].length * 1.5}, "fingers.1.length"),
        ({"base2": [-0.5, 0.1]}, r"fingers.2.base"),
    ):
        with pytest.raises(InputError, match=f"{key}.*another hand"):
            describe_origin(
                problem, {"problem": change_table(meta["problem"], senseless, name_keys())}
            )
    with pytest.raises(InputError, match=r"object\.vertices: 6 entries in the plan, 7 here"):
        describe_origin(problem, {"problem": meta["problem"] | {"object": chipped}})
    own = tmp_path / "own.toml"
    text = HEPTAGON.read_text(encoding="utf-8")
    first = "[[phases]]".join(text.split("[[phases]]")[:2])
    own.write_text(re.sub(r"(?m)^mass = .*", "mass = 0.21", first), encoding="utf-8")
    for command in (["verify"], ["verify", "--json"]):
        main([command[0], str(own), moved, *command[1:]])
        out = capsys.readouterr().out
        notes = json.loads(out)["notes"] if command[1:] else out.splitlines()[:1]
        assert notes == ["made for another problem: object.mass (0.2 in the plan, 0.21 here)"]
