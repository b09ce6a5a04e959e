from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest

from plane import point_to_segment, rotate
from shipped import HEPTAGON, plan_of, problem_of
from wholearm import InputError, Plan, Problem, find_route, make_policy, verify, write_mjcf
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.engines import engine_replay
from wholearm.engines.engine_replay import EngineRun, list_pairs, list_steps, list_stretches
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem
from wholearm.results.adopt import adopt_motion
from wholearm.results.torque import TorqueProfile
from wholearm.results.trajectory import load_trajectory

STEP = 1e-5


@pytest.fixture(scope="module")
def root() -> Element:
    return ElementTree.fromstring(write_mjcf(problem_of(HEPTAGON), plan_of(HEPTAGON), step=STEP))


def numbers(element: Element | None, key: str) -> Array:
    assert element is not None
    return np.array(element.attrib[key].split(), dtype=float)


def find(root: Element, tag: str, name: str) -> Element:
    found = root.find(f".//{tag}[@name='{name}']")
    assert found is not None, name
    return found


def test_names_are_unique_and_known(root: Element) -> None:
    for tag in ("geom", "joint", "body", "pair", "key"):
        names = [each.get("name") for each in root.iter(tag) if each.get("name")]
        assert names and len(set(names)) == len(names)
    geoms = {each.get("name") for each in root.iter("geom")}
    pairs = list(root.iter("pair"))
    assert len(pairs) == 7 * 7 + 1
    assert all({pair.get("geom1"), pair.get("geom2")} <= geoms for pair in pairs)


def test_home_is_the_start_and_phases_have_keyframes(root: Element) -> None:
    plan = plan_of(HEPTAGON)
    home = find(root, "key", "home")
    np.testing.assert_allclose(numbers(home, "qpos")[:5], plan.z[0], atol=1e-13)
    joints = [find(root, "joint", name) for name in ("x", "y", "phi", "theta1", "theta2")]
    np.testing.assert_allclose([float(j.attrib["ref"]) for j in joints], plan.z[0], atol=1e-13)
    key = find(root, "key", "phase3")
    np.testing.assert_allclose(numbers(key, "qpos")[:5], plan.at(plan.phase_starts[2]).z[0])
    assert float(key.attrib["time"]) == plan.phase_starts[2]


def place(root: Element, name: str) -> tuple[Array, Array, float]:
    """Ends of a ball's or capsule's axis at the model's own position, and its radius."""
    for body in root.iter("body"):
        for geom in body.findall("geom"):
            if geom.get("name") == name:
                key = "fromto" if geom.get("type") == "capsule" else "pos"
                points = numbers(geom, key).reshape(-1, 3)[:, :2] + numbers(body, "pos")[:2]
                return points[0], points[-1], float(geom.attrib["size"])
    raise AssertionError(name)


def test_gaps_are_those_of_points_and_links(root: Element) -> None:
    scene, z = problem_of(HEPTAGON).scene, plan_of(HEPTAGON).z[0]
    corners = z[:2] + rotate(z[2], scene.polygon.vertices)
    close = 1e-9 * scene.scales.length
    low = numbers(find(root, "geom", "palm"), "pos")[1]
    for i, corner in enumerate(corners):
        centre, _, radius = place(root, f"v{i}")
        assert centre[1] - radius - low == pytest.approx(corner[1], abs=close)
        for k, link in enumerate(scene.fingers):
            base = np.asarray(link.base)
            tip = base + link.length * np.array([np.cos(z[3 + k]), np.sin(z[3 + k])])
            start, stop, thickness = place(root, f"finger{k + 1}")
            gap = point_to_segment(centre, start, stop) - radius - thickness
            true = point_to_segment(corner, base, tip) - link.radius
            assert gap == pytest.approx(true, abs=close)
            start, stop, radius = place(root, f"e{i}")
            end, _, thickness = place(root, f"tip{k + 1}")
            gap = point_to_segment(end, start, stop) - radius - thickness
            after = corners[(i + 1) % len(corners)]
            assert gap == pytest.approx(
                point_to_segment(tip, corner, after) - link.radius, abs=close
            )
    for name in problem_of(HEPTAGON).phases[0].formation.names:
        pair = find(root, "pair", name)
        assert numbers(pair, "friction")[0] == pytest.approx(0.1)


def play(root: Element, finger: int, clock: Array) -> Array:
    """Torques that a model's springs exert on a joint at some times of its clock [N m]."""
    tendon = find(root, "fixed", f"torque{finger + 1}")
    share = next(float(j.attrib["coef"]) for j in tendon if j.get("joint") != "clock")
    total = np.zeros(len(clock))
    for spring in root.iter("general"):
        if spring.get("tendon") == tendon.get("name"):
            offset, slope, _ = numbers(spring, "biasprm")
            force = offset + slope * clock
            if spring.get("forcerange"):
                force = np.clip(force, *numbers(spring, "forcerange"))
            total += share * force
    return total


def test_controls_are_the_torques_less_dry_friction(root: Element) -> None:
    plan, scene = plan_of(HEPTAGON), problem_of(HEPTAGON).scene
    starts = np.arange(0.0, plan.duration - STEP, 25 * STEP)
    inside = starts[:, None] + STEP * (np.arange(16) + 0.5) / 16
    given = plan.torque.at(inside.ravel()).reshape(*inside.shape, 2).mean(axis=1)
    given -= scene.fingers[0].dry * np.sign(plan.at(starts + STEP / 2).z_dot[:, 3:])
    largest = np.abs(given).max()
    for finger in range(2):
        off = play(root, finger, starts) - given[:, finger]
        assert np.quantile(np.abs(off), 0.99) < 2e-3 * largest
        assert abs(off.mean()) < 1e-4 * largest


def test_a_viewer_lists_the_motors_and_the_joints_of_the_scene_alone(root: Element) -> None:
    # Groups 0 to 2 are those that MuJoCo's viewer shows by default.
    shown = {
        own.get("name")
        for tag in ("actuator", "worldbody")
        for own in root.find(tag).iter()  # type: ignore[union-attr]
        if own.tag in ("joint", "motor", "general") and int(own.get("group", 0)) < 3
    }
    assert shown == {"motor1", "motor2", "x", "y", "phi", "theta1", "theta2"}


def test_links_without_thickness_are_refused() -> None:
    with pytest.raises(InputError, match=r"fingers.2.radius: 0 given"):
        write_mjcf(problem_of(HEPTAGON).with_(radius2=0.0))


def test_export_writes_a_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, plan = tmp_path / "scene.xml", tmp_path / "plan.npz"
    plan_of(HEPTAGON).save(plan)
    assert main(["export", str(HEPTAGON), str(plan), "--mjcf", str(file)]) == 0
    assert capsys.readouterr().out == f"wrote {file}\n"
    assert len(list(ElementTree.parse(file).iter("key"))) == 6
    assert main(["export", str(HEPTAGON), "--mjcf", str(file)]) == 0
    assert [key.get("name") for key in ElementTree.parse(file).iter("key")] == ["home"]
    assert main(["export", str(HEPTAGON), "--mjcf", str(tmp_path / "scene.urdf")]) == 2
    assert "scene.urdf" in capsys.readouterr().err


EXTRAS = {"mujoco": "mujoco", "drake": "pydrake"}
COARSE = engine_replay.Setting(6.4e-4)


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
    report = engine_replay.replay_in(engine, problem, plan, setting=COARSE)
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
    report = engine_replay.play_policy(engine, problem, plan, policy, setting=COARSE)
    assert report.ok and report.exit_status == 0, report.to_text()
    (arrival,) = report.arrivals
    assert arrival.position < 1e-4 and arrival.gap < 1e-5
    assert json.loads(json.dumps(report.to_dict()))["stretches"][0]["phases"] == [1]
    # By feedback it ends where it is to end with other friction, or none, too.
    other = engine_replay.play_policy(
        engine, problem.with_(friction=0.12, dry=0), plan, policy, setting=COARSE
    )
    assert other.ok, other.to_text()


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
    report = engine_replay.replay_in(engine, problem.with_(friction=0.2), plan, setting=COARSE)
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
    report = engine_replay.replay_in("mujoco", problem, plan)
    assert report.ok and report.converged
    assert report.levels[0].departures[0].position.max() < 5e-4 and verify(problem, plan).ok


def test_what_departs_with_some_settings_only_has_not_converged() -> None:
    problem, plan = slide()
    (stretch,) = list_stretches(plan.trajectory, [0])
    nothing = np.zeros(1)
    held = engine_replay.Departure(nothing, nothing, nothing, (), None, "")
    lost = held._replace(time=0.01, reason="v0-palm opens at t = 0.01 s")
    for finer, verdict in ((held, "NOT CONVERGED"), (lost, "DEPARTS")):
        levels = tuple(engine_replay.Level(COARSE, (own,)) for own in (lost, finer))
        report = engine_replay.EngineReport(problem, "MuJoCo", 3e-6, (stretch,), levels)
        text = report.to_text().splitlines()[0]
        assert report.exit_status == 1 and f": {verdict}: within 0.0000000 mm" in text


def test_an_engine_that_is_missing_or_unknown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["replay", str(HEPTAGON), "plan.npz", "--engine"]
    assert main([*command, "bullet"]) == 2
    words = "wholearm: --engine: 'bullet' given; allowed are 'mujoco' and 'drake'\n"
    assert capsys.readouterr().err == words
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main([*command, "drake"]) == 2
    assert capsys.readouterr().err == (
        "wholearm: --engine: drake is not installed; pip install 'wholearm[drake]'\n"
    )


def test_what_cannot_be_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="not those of the problem"):
        adopt_motion(slide()[0], plan_of(HEPTAGON))
    command = ["export", str(HEPTAGON), "torques.csv", "--mjcf", str(tmp_path / "scene.xml")]
    assert main(command) == 2
    assert "torques alone given; a motion is needed" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


ROWS = 201
PHASE = 1


def follow() -> EngineRun:
    """The second phase as planned, with the planned forces."""
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    motion, stretch = plan.motions[PHASE], list_stretches(plan, range(len(plan.motions)))[PHASE]
    t = np.linspace(0.0, motion.duration, ROWS)
    planned, names = motion.evaluate(t), tuple(pair.name for pair in list_pairs(problem.scene))
    press = np.zeros((ROWS - 1, len(names)))
    for k, name in enumerate(motion.contacts):
        press[:, names.index(name)] = planned.c_n[1:, k]
    return EngineRun(stretch.start + t, planned.z, planned.z_dot, names, press)


def judge(run: EngineRun) -> engine_replay.Departure:
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    return engine_replay.compare(
        problem, plan, list_stretches(plan, range(len(plan.motions)))[PHASE], run, 1e-3
    )


def test_what_goes_as_planned_does_not_depart() -> None:
    found = judge(follow())
    assert (found.time, found.reason) == (None, "")
    assert found.position.max() < 1e-12 and found.angle.max() < 1e-12
    assert [force.contact for force in found.forces] == list(plan_of(HEPTAGON).motions[1].contacts)
    # Forces step within rows.
    assert max(abs(force.off) for force in found.forces) < 2e-2


def test_a_contact_that_opens_is_the_reason() -> None:
    run = follow()
    length, late = problem_of(HEPTAGON).scene.scales.length, np.arange(ROWS) > 100
    run.z[:, 1] += np.where(late, 2e-3 * length, 0.0)
    found = judge(run)
    assert found.time == pytest.approx(run.t[101])
    assert found.reason.startswith("v0-palm opens at t = ")


def test_a_contact_that_sticks_is_the_reason() -> None:
    run = follow()
    length, late = problem_of(HEPTAGON).scene.scales.length, np.arange(ROWS) > 120
    run.z_dot[80:] = 0.0
    run.z[:, 0] += np.where(late, 2e-3 * length, 0.0)
    found = judge(run)
    assert found.time == pytest.approx(run.t[121])
    assert "sticks at t = " in found.reason and f"{run.t[80]:.5g}" in found.reason


def test_a_contact_that_is_not_planned_is_the_reason() -> None:
    run = follow()
    run.z[121:], run.z_dot[121:] = run.z[118:-3].copy(), run.z_dot[118:-3].copy()
    assert judge(run).reason == "every contact is as planned"
    run.press[60, run.pairs.index("v6-finger2")] = 1.0
    assert judge(run).reason.startswith("v6-finger2 presses, which is not planned, at t = ")


def test_steps_of_a_constant_force_are_exact() -> None:
    # Velocity by the force, then position by the velocity: half a step's start makes it exact.
    problem, plan = problem_of(HEPTAGON), plan_of(HEPTAGON)
    stretch = list_stretches(plan, [0])[0]._replace(z_dot=np.full(5, 0.3), z_ddot=np.full(5, 2.0))
    torque = TorqueProfile(np.array([0.0, 1.0]), np.full((1, 2, 1), 0.7))
    steps = list_steps(problem, stretch, torque, 0.01)
    assert steps.h <= 0.01 * problem.scene.scales.time and steps.ends[-1] == len(steps.tau)
    assert steps.h * len(steps.tau) == pytest.approx(stretch.stop - stretch.start)
    z, v = stretch.z.copy(), steps.v.copy()
    for _ in range(7):
        v += steps.h * 2.0
        z += steps.h * v
    t = 7 * steps.h
    np.testing.assert_allclose(z, stretch.z + 0.3 * t + t**2, rtol=1e-13)
    np.testing.assert_allclose(steps.tau, 0.7)


def test_a_plan_is_known_between_the_rows_of_its_file(tmp_path: Path) -> None:
    plan = plan_of(HEPTAGON)
    plan.save(tmp_path / "plan.npz")
    loaded = load_trajectory(tmp_path / "plan.npz")
    found, t = engine_replay.find_reference(loaded), np.linspace(0.0, plan.duration - 1e-9, 2001)
    off = [np.nanmean(np.abs(own.at(t).c_n - plan.at(t).c_n)) for own in (found, loaded)]
    assert off[0] < 0.1 * off[1]
    # What does not replay as planned is taken as it is.
    weaker = replace(loaded.torque, coefficients=0.9 * loaded.torque.coefficients)
    wrong = replace(loaded, torque=weaker)
    assert engine_replay.find_reference(wrong) is wrong
