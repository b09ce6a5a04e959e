from __future__ import annotations

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wholearm
from conftest import HEPTAGON
from wholearm.benchmark.scenes import random_route, random_scene
from wholearm.curve import Curve
from wholearm.errors import InputError
from wholearm.mapping.route import Route, format_route, list_formations
from wholearm.problem import Problem, build_problem

TABLE = tomllib.loads(HEPTAGON.read_text(encoding="utf-8"))
FLAT = -1.984


def write_table(table: dict[str, Any], path: str = "") -> str:
    """A problem file's tables as TOML, without its phases."""
    plain = {k: v for k, v in table.items() if not isinstance(v, dict) and k != "phases"}
    lines = [f"{key} = {json.dumps(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += [f"[{path}{key}]", write_table(value, f"{path}{key}.")]
    return "\n".join(lines) + "\n"


def load_pasted(table: dict[str, Any], route: Route, folder: Path) -> Problem:
    """What loading gives when the list replaces what it names in a problem file."""
    text = format_route(route)
    kept = {key: value for key, value in table.items() if key not in tomllib.loads(text)}
    path = folder / "pasted.toml"
    path.write_text(write_table(kept) + text, encoding="utf-8")
    return wholearm.load(str(path))


def list_degrees(problem: Problem, *poses: tuple[float, float]) -> Route:
    return list_formations(problem, *((x, np.radians(phi)) for x, phi in poses))


def test_slide_is_listed_as_in_the_problem_file(heptagon: Problem) -> None:
    text = format_route(list_degrees(heptagon, (0.045, FLAT), (-0.0637, FLAT)))
    assert tomllib.loads(text)["phases"] == TABLE["phases"][:3]
    assert "[start]" not in text
    assert [line.split("#")[1][:5] for line in text.splitlines() if "[[" in line] == [
        " 1: t",
        " 2: t",
        " 3: t",
    ]


def test_route_along_curved_borders_is_the_whole_plan(
    heptagon: Problem, curves: tuple[Curve, ...], tmp_path: Path
) -> None:
    # Poses as read off the map: to a tenth of a millimetre and of a degree.
    poses = [(0.045, -2.0), (-0.0637, -2.0), (-0.0505, -23.4), (0.0078, -50.0)]
    route = list_degrees(heptagon, *poses)
    assert tomllib.loads(format_route(route))["phases"] == TABLE["phases"]
    for stretch, curve in zip(route, curves, strict=True):
        # Ends are those of the traced curves, but for the last, which the user gives.
        np.testing.assert_allclose(stretch.start, curve.start[[0, 2]], atol=1e-9)
    assert len(load_pasted(TABLE, route, tmp_path).phases) == 5


def test_turn_back_on_a_border_is_a_phase(heptagon: Problem, tmp_path: Path) -> None:
    route = list_degrees(heptagon, (0.045, FLAT), (0.03, FLAT), (0.04, FLAT))
    assert [str(stretch.until) for stretch in route] == ["x = 0.03 m", "x = 0.04 m"]
    assert set(route[0].contacts) == set(route[1].contacts)
    assert len(load_pasted(TABLE, route, tmp_path).phases) == 2
    onwards = list_degrees(heptagon, (0.045, FLAT), (0.04, FLAT), (0.03, FLAT))
    assert [str(stretch.until) for stretch in onwards] == ["x = 0.03 m"]


def test_route_that_starts_elsewhere_brings_its_start(heptagon: Problem, tmp_path: Path) -> None:
    route = list_degrees(heptagon, (-0.05, FLAT + 0.2), (0.03, FLAT))
    assert [str(stretch.until) for stretch in route] == ["v5-finger2", "v2-finger1", "x = 0.03 m"]
    text = format_route(route)
    assert tomllib.loads(text)["start"] == {"flush": 0, "x": -0.05}
    assert "takes the place of the problem's own" in text
    assert load_pasted(TABLE, route, tmp_path).start[0] == -0.05


def test_route_that_starts_in_a_cell_is_led_there(heptagon: Problem, tmp_path: Path) -> None:
    route = list_degrees(heptagon, (0.03, -8.0), (0.01, -12.0))
    assert route.start is None and "from the problem's start" in format_route(route)
    np.testing.assert_allclose(route[0].start, heptagon.start[[0, 2]], rtol=1e-12)
    assert len(load_pasted(TABLE, route, tmp_path).phases) == len(route)


def test_routes_that_cannot_be_followed_are_named(heptagon: Problem) -> None:
    start = (float(heptagon.start[0]), float(heptagon.start[2]))
    with pytest.raises(InputError, match=r"leg 1 cannot be followed .* finger 2 is too short"):
        list_formations(heptagon, start, (0.2, 0.2))
    with pytest.raises(InputError, match="two or more"):
        list_formations(heptagon, start)
    with pytest.raises(InputError, match="same place"):
        list_formations(heptagon, start, start)
    with pytest.raises(InputError, match=r"cannot start at .*: finger 1 is too short"):
        list_formations(heptagon, (0.4, start[1]), start)


def test_lists_do_not_depend_on_units(heptagon: Problem) -> None:
    size = 700.0
    table = copy.deepcopy(TABLE)
    table["object"]["vertices"] = (size * np.array(table["object"]["vertices"])).tolist()
    for finger in table["fingers"].values():
        finger |= {key: size * finger[key] for key in ("length", "radius")}
        finger["base"] = [size * value for value in finger["base"]]
    table["start"]["x"] *= size
    table["phases"][-1]["until"] = {"x": 0.0}
    large = build_problem(table)
    poses = [(0.045, -2.0), (-0.0637, -2.0), (-0.0505, -23.4), (0.03, 3.0)]
    one = list_degrees(heptagon, *poses)
    two = list_degrees(large, *((size * x, phi) for x, phi in poses))
    assert [s.contacts for s in one] == [s.contacts for s in two]
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a.stop * [size, 1.0], b.stop, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_lists_of_random_scenes_load(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng([11, seed])
    table = random_scene(rng)
    problem = build_problem(table)
    listed = 0
    for _ in range(6):
        try:
            route = list_formations(problem, *random_route(rng, problem))
        except InputError as error:
            assert error.key == "route"
            continue
        assert len(load_pasted(table, route, tmp_path).phases) == len(route)
        listed += 1
        if listed == 2:
            break
    assert listed
