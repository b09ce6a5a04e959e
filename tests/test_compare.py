"""Replays as trajectories, saved, loaded, verified and drawn like plans, and compared."""

from __future__ import annotations

import dataclasses
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from planned import plan
from shipped import HEPTAGON, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.comparison.metrics import compare
from wholearm.figures import plots
from wholearm.figures.analysis_figures import draw_comparison
from wholearm.problem.definition import Problem
from wholearm.problem.keys import name_keys
from wholearm.problem.table import change_table
from wholearm.results.adopt import describe_origin, save
from wholearm.results.torque import TorqueProfile, read_notes, read_torque_csv
from wholearm.results.trajectory import Trajectory, load_trajectory
from wholearm.simulation.events import Simulation
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


@pytest.fixture(scope="module")
def torque() -> TorqueProfile:
    """Torques as they come from a table, that carry the heptagon through with steps."""
    return plan()[1].torque


@pytest.fixture(scope="module")
def simulation(torque: TorqueProfile) -> Simulation:
    return simulate(problem_of(HEPTAGON), torque, times=np.linspace(0, 2, 301))


def press(tau_1: float, tau_2: float) -> TorqueProfile:
    """Constant torques for a tenth of a second."""
    return TorqueProfile.join_rows(np.array([0.0, 0.1]), np.array([[tau_1, tau_2]] * 2))


def test_a_replay_is_a_trajectory(simulation: Simulation, torque: TorqueProfile) -> None:
    found = simulation.trajectory
    assert isinstance(found, Trajectory) and found.torque is torque
    assert found.contacts == simulation.contacts and len(found.motions) == 5
    assert found.duration == simulation.t[-1]
    inside = (np.diff(found.phase) == 0) & (np.diff(found.t) > 0)
    assert (np.diff(found.t)[inside] > 0).all() and (np.diff(found.t) >= 0).all()
    for t in np.linspace(0, 1.99, 57):
        # What was recorded at instants asked for is there between them, too.
        near = np.abs(found.t - t).argmin()
        assert found.at(found.t[near]).z[0] == pytest.approx(found.z[near], abs=1e-12)
    times = np.linspace(0.01, 1.95, 41)
    exact = simulate(simulation.problem, torque, times=times)
    np.testing.assert_allclose(
        found.at(times).z, [exact.at(t)[:5] for t in times], rtol=0, atol=1e-8
    )


def test_a_replay_survives_its_file(simulation: Simulation, tmp_path: Path) -> None:
    save(simulation, tmp_path / "a.npz")
    loaded, known = load_trajectory(tmp_path / "a.npz"), simulation.trajectory
    for name in ("t", "tau", "c_n", "phase", "z", "z_ddot"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(known, name))
    assert loaded.meta == known.meta and loaded.meta["status"] == "replayed"
    report = verify(simulation.problem, loaded)
    assert report.ok and report.phases[-1].deviation is not None
    assert report.phases[-1].deviation.position < 1e-8


def test_a_replay_that_fails_is_drawn_and_saved(tmp_path: Path) -> None:
    """It loses a contact on its way; another never moves, so that no force is known."""
    problem, trajectory = plan()
    weak = TorqueProfile(trajectory.torque.breaks, trajectory.torque.coefficients * 0.9)
    for torque in (weak, press(0.3, -0.8)):
        report = verify(problem, torque)
        assert not report.ok
        figure = plots.force_margins(report)
        assert any("replayed" in text.get_text() for text in figure.texts)
        report.trajectory.save(tmp_path / "a.npz")
        figure = plots.force_margins(load_trajectory(tmp_path / "a.npz"))
    plots.save(figure, tmp_path / "a.png")


def test_saving_goes_by_the_ending(simulation: Simulation, tmp_path: Path) -> None:
    save(simulation, tmp_path / "a.csv")
    torque = read_torque_csv(str(tmp_path / "a.csv"))
    t = np.linspace(0.001, 1.999, 301)
    np.testing.assert_allclose(torque.at(t), simulation.torque.at(t), atol=1e-5)
    save(torque, tmp_path / "b.csv")
    with pytest.raises(InputError, match="torques alone have no motion"):
        save(torque, tmp_path / "b.npz")
    with pytest.raises(InputError, match="ending"):
        save(simulation, tmp_path / "a.mat")
    with pytest.raises(InputError, match="no motion to draw"):
        plots.force_margins(torque)


def test_verify_writes_what_plot_draws(
    torque: TorqueProfile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(torque, tmp_path / "a.csv")
    out = str(tmp_path / "a.npz")
    assert main(["verify", str(HEPTAGON), str(tmp_path / "a.csv"), "-o", out]) == 0
    assert capsys.readouterr().out.endswith(f"wrote {out}\n")
    assert main(["plot", out, "--simulate", "-o", str(tmp_path / "a.svg")]) == 0
    drawn = (tmp_path / "a.svg").read_bytes()
    assert drawn.startswith(b"<?xml") and len(drawn) > 1e4
    assert main(["verify", str(HEPTAGON), out]) == 0
    wrong = str(tmp_path / "a.mat")
    assert main(["verify", str(HEPTAGON), out, "-o", wrong]) == 2
