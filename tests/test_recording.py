"""Replays as trajectories: saved, loaded, verified and drawn like plans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from planned import plan
from shipped import HEPTAGON, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.figures import plots
from wholearm.results.adopt import save
from wholearm.results.torque import TorqueProfile, read_torque_csv
from wholearm.results.trajectory import Trajectory
from wholearm.results.trajectory_file import load_trajectory
from wholearm.simulation.events import Simulation
from wholearm.simulation.simulate import simulate
from wholearm.verification.verify import verify


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
