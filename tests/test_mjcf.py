from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import pytest

from plane import point_to_segment, rotate
from shipped import HEPTAGON, plan_of, problem_of
from wholearm.cli.command import main
from wholearm.common.arrays import Array
from wholearm.common.errors import InputError
from wholearm.engines.mjcf import write_mjcf

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
