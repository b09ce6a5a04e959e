"""The gap between two links in plain NumPy, and hexagons between fingers that meet."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache

import numpy as np

from once import once
from shipped import HEXAGON, problem_of
from wholearm import End, Plan, Problem, Scene
from wholearm.benchmark.stress.newton import separate
from wholearm.common.arrays import Array
from wholearm.planning.plan import solve
from wholearm.problem.read import build_problem


@cache
def hexagon(
    lengths: tuple[float, float] = (0.18, 0.18), base: float = -0.08, solid: bool = True
) -> Problem:
    """The hexagon's problem; with links of equal length they touch halfway through the slide."""
    table = tomllib.loads(HEXAGON.read_text(encoding="utf-8"))
    for key, length in zip("12", lengths, strict=True):
        table["fingers"][key]["length"] = length
    table["fingers"]["2"]["base"][0] = base
    return build_problem(table | {"fingers_collide": solid})


@once
def slid() -> Plan:
    """The hexagon's phases before it tips, the last of them to rest."""
    whole = problem_of(HEXAGON)
    *moving, last = whole.phases[:3]
    phases = (*moving, replace(last, end=End.REST))
    return solve(replace(whole, phases=phases), intervals=20, replay=False)


def shorten(problem: Problem) -> Problem:
    """A problem like the hexagon's with the same phases only."""
    return replace(problem, phases=problem.phases[:3])


@cache
def make_way(solid: bool) -> Problem:
    """Finger 2 pushes the hexagon below a free finger 1, which has to make way for the other."""
    table = tomllib.loads(HEXAGON.read_text(encoding="utf-8"))
    for finger in table["fingers"].values():
        finger["length"] = 0.19
    table["fingers"]["2"]["base"][0] = -0.085
    table["start"]["x"] = -0.03
    push = {"contacts": ["v0-palm", "v1-palm", "v5-finger2"], "until": {"x": 0.0}}
    return build_problem(table | {"fingers_collide": solid, "phases": [push]})


def place_links(scene: Scene, z: Array) -> list[Array]:
    """Ends of both segments at n configurations, shape (n, 2, 2) each [m]."""
    ends = []
    for link, angle in zip(scene.fingers, z[:, 3:].T, strict=True):
        base = np.broadcast_to(np.asarray(link.base), (len(z), 2))
        tip = base + link.length * np.column_stack([np.cos(angle), np.sin(angle)])
        ends.append(np.stack([base, tip], axis=1))
    return ends


def measure_fingers(scene: Scene, z: Array) -> Array:
    """Gap between the links, shape (n,) [m]; negative: minus the least push that parts them."""
    return separate(*place_links(scene, z)) - sum(link.radius for link in scene.fingers)
