from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from shipped import HEPTAGON, plan_of, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.engines.departure import Departure
from wholearm.engines.engine_replay import EngineReport, Level, replay_in, require_engine
from wholearm.engines.feedback import play_policy
from wholearm.engines.mjcf import write_mjcf
from wholearm.engines.pressing import EngineDrive
from wholearm.engines.stretch import Setting, list_stretches
from wholearm.planning.plan import solve
from wholearm.planning.result import Plan
from wholearm.policy.closed_loop import ClosedLoop
from wholearm.policy.make import make_policy
from wholearm.problem.definition import Problem
from wholearm.problem.read import build_problem
from wholearm.results.adopt import require_same_phases
from wholearm.search.find_route import find_route
from wholearm.verification.verify import verify

EXTRAS = {"mujoco": "mujoco", "drake": "pydrake"}
COARSE = Setting(6.4e-4)


@cache
def slide() -> tuple[Problem, Plan]:
    """The first phase of the heptagon's slide, alone."""
    whole = problem_of(HEPTAGON)
    problem = replace(whole, phases=whole.phases[:1])
    return problem, solve(problem)


@pytest.mark.parametrize("engine", EXTRAS)
def test_an_engine_keeps_to_the_plan(engine: str) -> None:
    pytest.importorskip(EXTRAS[engine], reason=f"wholearm[{engine}] is not installed")
    problem, plan = slide()
    report = replay_in(engine, problem, plan, setting=COARSE)
    assert report.ok and report.exit_status == 0, report.to_text()
    (found,) = report.levels[0].departures
    assert found.position.max() < 1e-4 and found.angle.max() < 3.5e-3
    assert max(abs(force.off) for force in found.forces if force.planned > 0.5) < 0.02
    figures = report.to_dict()
    assert json.loads(json.dumps(figures)) == figures
    (stretch,) = figures["levels"][0]["stretches"]
    assert stretch["phases"] == [1] and len(stretch["t"]) == len(stretch["position"])


@pytest.mark.parametrize("engine", EXTRAS)
def test_a_policy_moves_the_hand_in_an_engine(engine: str) -> None:
    pytest.importorskip(EXTRAS[engine], reason=f"wholearm[{engine}] is not installed")
    problem, plan = slide()
    policy = make_policy(problem, plan)
    report = play_policy(engine, problem, plan, policy, setting=COARSE)
    assert report.ok and report.exit_status == 0, report.to_text()
    (arrival,) = report.arrivals
    assert arrival.position < 1e-4 and arrival.gap < 1e-5
    assert json.loads(json.dumps(report.to_dict()))["stretches"][0]["phases"] == [1]
    # By feedback it ends where it is to end with other friction, too.
    other = play_policy(engine, problem.with_(friction=0.12), plan, policy, setting=COARSE)
    assert other.ok, other.to_text()


def test_torques_of_a_policy_are_held_and_late() -> None:
    class Loop(ClosedLoop):
        def __init__(self) -> None:
            self.period, self.delay, self.times = 1e-3, 4e-4, list[float]()

        def held(self, t: float, *_: object) -> tuple[float, float]:
            self.times.append(t)
            return 1e3 * t, -1.0

        over = False

    scene, h, still = slide()[0].scene, 1e-4, np.zeros(2)
    loop = Loop()
    drive = EngineDrive(scene, loop, h)
    tau = [drive.step(k * h, still, still).tolist() for k in range(30)]
    assert loop.times == pytest.approx([0.0, 1e-3, 2e-3])
    assert [own[0] for own in tau] == pytest.approx([0.0] * 14 + [1.0] * 10 + [2.0] * 6)
    assert {own[1] for own in tau} == {-1.0}
    # Dry friction is against the motion.
    fast = drive.step(30 * h, still, np.array([1.0, -1.0]))
    assert fast == pytest.approx([2.0 - scene.dry[3], -1.0 + scene.dry[4]])


def test_what_mujoco_opens_plays_the_plan() -> None:
    mujoco = pytest.importorskip("mujoco", reason="wholearm[mujoco] is not installed")
    problem, plan = slide()
    step = COARSE.step * problem.scene.scales.time
    model = mujoco.MjModel.from_xml_string(write_mjcf(problem, plan, step=step))
    data = mujoco.MjData(model)
    begun = data.qpos.copy()
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    np.testing.assert_allclose(begun, data.qpos, atol=1e-13)
    while data.time < plan.duration - step / 2:
        mujoco.mj_step(model, data)
    error = data.qpos[:3] - plan.at([min(data.time, plan.duration)]).z[0, :3]
    assert np.hypot(*error[:2]) < 1e-4 and abs(error[2]) < 3.5e-3
    assert np.hypot(*(plan.trajectory.z[-1] - plan.trajectory.z[0])[:2]) > 1e-2


@pytest.mark.parametrize("engine", EXTRAS)
def test_an_engine_with_other_friction_departs(engine: str) -> None:
    pytest.importorskip(EXTRAS[engine], reason=f"wholearm[{engine}] is not installed")
    problem, plan = slide()
    report = replay_in(engine, problem.with_(friction=0.2), plan, setting=COARSE)
    assert report.exit_status == 1
    lines = report.to_text().splitlines()
    assert "DEPARTS" in lines[0] and lines[1].startswith("phase 1 departs at t = ")


def test_contacts_of_light_links_are_no_stiffer_than_the_step_allows() -> None:
    pytest.importorskip("mujoco", reason="wholearm[mujoco] is not installed")
    side, joint = 1.0, {"length": 1.6, "radius": 0.06, "inertia": 3.0, "torque_limit": 400.0}
    table = {
        "epsilon": 5.0,
        "object": {"vertices": [[0, 0], [side, 0], [side, side], [0, side]], "mass": 20},
        "fingers": {"1": {"base": [1.1, -0.1], **joint}, "2": {"base": [-1.1, -0.1], **joint}},
        "friction": dict.fromkeys(("palm", "finger1", "finger2"), 0.2),
        "start": {"flush": 0, "x": 0.0},
        "goal": {"x": -0.3, "flush": 0},
    }
    problem = build_problem(table)
    plan = find_route(problem).plan
    # The problem with its goal, and a plan, go where phases and a motion do.
    report = replay_in("mujoco", problem, plan)
    assert report.ok and report.converged
    assert report.levels[0].departures[0].position.max() < 5e-4
    assert verify(problem, plan).ok


def test_what_departs_with_some_settings_only_has_not_converged() -> None:
    problem, plan = slide()
    (stretch,) = list_stretches(plan.trajectory, False)
    nothing = np.zeros(1)
    held = Departure(nothing, nothing, nothing, (), None, "")
    lost = held._replace(time=0.01, reason="v0-palm opens at t = 0.01 s")
    for finer, verdict in ((held, "NOT CONVERGED"), (lost, "DEPARTS")):
        levels = tuple(Level(COARSE, (own,)) for own in (lost, finer))
        report = EngineReport(problem, "MuJoCo", 3e-3, (stretch,), levels)
        assert report.exit_status == 1 and f": {verdict}: " in report.to_text().splitlines()[0]


def test_an_engine_that_is_installed_in_part_is_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mujoco.py").write_text("raise ImportError('core bindings are\\nmissing')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    with pytest.raises(InputError, match="--engine: mujoco: core bindings are missing"):
        require_engine("mujoco")


def test_an_engine_that_is_missing_or_unknown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["replay", str(HEPTAGON), "plan.npz", "--engine"]
    assert main([*command, "bullet"]) == 2
    assert capsys.readouterr().err == (
        "wholearm: --engine: 'bullet' given; allowed are mujoco, drake\n"
    )
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main([*command, "drake"]) == 2
    assert capsys.readouterr().err == (
        "wholearm: --engine: drake is not installed; pip install 'wholearm[drake]'\n"
    )


def test_what_cannot_be_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="not those of the problem"):
        require_same_phases(slide()[0], plan_of(HEPTAGON))
    command = ["export", str(HEPTAGON), "torques.csv", "--mjcf", str(tmp_path / "scene.xml")]
    assert main(command) == 2
    assert "torques alone have no motion" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
