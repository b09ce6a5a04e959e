from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from shipped import HEPTAGON, plan_of, problem_of
from wholearm.cli.command import main
from wholearm.common.errors import InputError
from wholearm.engines.mjcf import write_mjcf
from wholearm.engines.replay import list_settings, replay_in
from wholearm.engines.report_text import to_dict, write
from wholearm.engines.stretch import Setting
from wholearm.planning.plan import solve
from wholearm.problem.definition import Problem
from wholearm.results.narrow import require_same_phases
from wholearm.results.trajectory import Trajectory

EXTRAS = {"mujoco": "mujoco", "drake": "pydrake"}
COARSE = Setting(6.4e-4)


@cache
def slide() -> tuple[Problem, Trajectory]:
    """The first phase of the heptagon's slide, alone."""
    whole = problem_of(HEPTAGON)
    problem = replace(whole, phases=whole.phases[:1])
    return problem, solve(problem).trajectory


@pytest.mark.parametrize("engine", EXTRAS)
def test_an_engine_keeps_to_the_plan(engine: str) -> None:
    pytest.importorskip(EXTRAS[engine], reason=f"wholearm[{engine}] is not installed")
    problem, plan = slide()
    report = replay_in(engine, problem, plan, setting=COARSE)
    assert report.ok and report.exit_status == 0, write(report)
    (found,) = report.levels[0].departures
    assert found.position.max() < 1e-4 and found.angle.max() < 3.5e-3
    assert max(abs(force.off) for force in found.forces if force.planned > 0.5) < 0.02
    figures = to_dict(report)
    assert json.loads(json.dumps(figures)) == figures
    (stretch,) = figures["levels"][0]["stretches"]
    assert stretch["phases"] == [1] and len(stretch["t"]) == len(stretch["position"])


def test_what_mujoco_opens_plays_the_plan() -> None:
    mujoco = pytest.importorskip("mujoco", reason="wholearm[mujoco] is not installed")
    problem, plan = slide()
    step = COARSE.step * problem.scene.scales.time
    model = mujoco.MjModel.from_xml_string(write_mjcf(problem, plan, step=step))
    data = mujoco.MjData(model)
    begun = data.qpos.copy()
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    np.testing.assert_allclose(begun, data.qpos, atol=1e-15)
    while data.time < plan.duration - step / 2:
        mujoco.mj_step(model, data)
    error = data.qpos[:3] - plan.at(min(data.time, plan.duration)).z[0, :3]
    assert np.hypot(*error[:2]) < 1e-4 and abs(error[2]) < 3.5e-3
    assert np.hypot(*(plan.z[-1] - plan.z[0])[:2]) > 1e-2


@pytest.mark.parametrize("engine", EXTRAS)
def test_an_engine_with_other_friction_departs(engine: str) -> None:
    pytest.importorskip(EXTRAS[engine], reason=f"wholearm[{engine}] is not installed")
    problem, plan = slide()
    report = replay_in(engine, problem.with_(friction=0.2), plan, setting=COARSE)
    assert report.exit_status == 1
    lines = write(report).splitlines()
    assert "DEPARTS" in lines[0] and lines[1].startswith("phase 1 departs at t = ")


def test_settings_get_finer() -> None:
    assert list_settings(Setting(1.0), 2) == [
        Setting(1.0),
        Setting(0.5),
        Setting(0.25),
        Setting(0.5, 2.0),
        Setting(0.25, 4.0),
    ]


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
