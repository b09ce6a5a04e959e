"""The scenes of the stress study, each drawn by its own generator from a seed and a number."""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from ...common.arrays import Array
from ...common.errors import InputError
from ...contacts.closing import close_fingers
from ...contacts.formation import Formation
from ...mapping.route import Stretch, format_route, list_formations
from ...problem.definition import Phase, Problem
from ...problem.read import build_problem
from .newton import locate
from .scenes import Table, random_route, random_scene
from .slow_motion import slow_margin

TRIES = 4
"""Routes that are drawn for one scene before another scene is."""
LOOKS = 4
"""Places of a stretch at which it is looked whether a slow motion is possible."""
WILLING = 0.7
"""Share of the cases whose route a slow motion can probably follow."""
SCENES = 6
"""Scenes that are drawn for one case before its last list is taken as it is."""


@dataclass(frozen=True)
class Case:
    """A problem of the study.

    Attributes
    ----------
    number : int
        Within its seed.
    kind : str
        What is special about it.
    table : dict
        The contents of a problem file.
    stops : list of (x, phi), [m, rad]
        Where its phases end according to the map.
    """

    number: int
    kind: str
    table: Table
    stops: list[tuple[float, float]]


@lru_cache(maxsize=2)
def draw_case(seed: int, number: int) -> Case:
    """Draw case `number` of a seed: always the same one, whichever others are drawn."""
    rng = np.random.default_rng([seed, number])
    kinds = list(TWISTS)
    kind = kinds[int(rng.integers(len(kinds)))]
    willing, last = rng.uniform() < WILLING, None
    for _ in range(SCENES):
        try:
            table = _refit(TWISTS[kind](rng, random_scene(rng)))
            problem = build_problem(table)
        except InputError:
            continue
        for _ in range(TRIES):
            try:
                stretches = list_formations(problem, *random_route(rng, problem))
            except InputError:
                continue
            phases = tomllib.loads(format_route(stretches))["phases"]
            stops = [(float(part.stop[0]), float(part.stop[1])) for part in stretches]
            moves = can_move(problem, stretches)
            route = ROUTES[int(rng.integers(len(ROUTES)))]
            phases, stops, name = route(rng, problem, phases, stops)
            plain = json.loads(json.dumps({**table, "phases": phases}, default=float))
            last = Case(number, f"{kind}, {name}", plain, stops)
            if moves or not willing:
                return last
    if last is None:
        raise InputError("", f"scene {number}", "no route was found")
    return last


def can_move(problem: Problem, stretches: Sequence[Stretch]) -> bool:
    """Whether a slow motion keeps all limits at a few places of every stretch of a route."""
    scene = problem.scene
    for stretch in stretches:
        share = np.linspace(0.0, 1.0, LOOKS + 2)[1:-1, None] + np.array([0.0, 1e-4])
        poses = stretch.start + share.ravel()[:, None] * (stretch.stop - stretch.start)
        z = close_fingers(scene, *poses.T).z
        if np.isnan(z).any():
            return False
        formation = Formation(scene, stretch.contacts)
        phase = Phase(0, formation, replace(stretch.until, pins=()))
        for place, following in zip(z[::2], z[1::2], strict=True):
            way = np.array([following - place] * 2)
            pair = np.array([place, following])
            if slow_margin(scene, phase, problem.epsilon, pair, way)[0] < 0:
                return False
    return True


def _refit(table: Table) -> Table:
    """A scene whose first phase names what touches at the start."""
    from .scenes import name_first

    return {**table, "phases": [{"contacts": name_first(table), "until": {"x": 0.0}}]}


def _keep(rng: np.random.Generator, table: Table) -> Table:
    return table


def _near_end(rng: np.random.Generator, table: Table) -> Table:
    """A link that touches the object near its tip, or near its base."""
    key = str(rng.integers(1, 3))
    finger, problem = table["fingers"][key], build_problem(table)
    finger = dict(finger)
    theta = float(problem.start[2 + int(key)])
    axis = np.array([math.cos(theta), math.sin(theta)])
    for name in problem.phases[0].formation.names:
        if not name.endswith(f"finger{key}"):
            continue
        run = float(locate(problem.scene, name, problem.start[None]).low[0])
        share = 10.0 ** rng.uniform(-6.0, -1.0)
        if rng.uniform() < 0.5:
            finger["length"] = run * (1 + share)
        else:
            finger["base"] = (np.array(finger["base"]) + (1 - share) * run * axis).tolist()
    return {**table, "fingers": {**table["fingers"], key: finger}}


def _mirror(rng: np.random.Generator, table: Table) -> Table:
    """A regular object between fingers alike: events of both coincide, or all but do."""
    count = int(rng.integers(3, 13))
    size = float(np.abs(np.array(table["object"]["vertices"])).max())
    angles = -np.pi / 2 + 2 * np.pi * (np.arange(count) - 0.5) / count
    corners = size * np.column_stack([np.cos(angles), np.sin(angles)])
    right = dict(table["fingers"]["1"])
    off = float(rng.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-3]))
    left = dict(right, base=[-right["base"][0] * (1 + off), right["base"][1]])
    friction = dict(table["friction"], finger2=table["friction"]["finger1"])
    x = 0.0 if rng.uniform() < 0.5 else table["start"]["x"]
    body = {"vertices": corners.tolist(), "mass": table["object"]["mass"]}
    return {
        **table,
        "object": body,
        "fingers": {"1": right, "2": left},
        "friction": friction,
        "start": {"flush": 0, "x": x},
    }


def _rough(rng: np.random.Generator, table: Table) -> Table:
    """Friction near one and joints heavy against the object: contacts jam."""
    parts = {part: float(rng.uniform(0.6, 1.0)) for part in table["friction"]}
    heavy = {
        key: dict(finger, inertia=finger["inertia"] * 10.0 ** float(rng.uniform(0.0, 3.0)))
        for key, finger in table["fingers"].items()
    }
    return {**table, "friction": parts, "fingers": heavy}


def _smooth(rng: np.random.Generator, table: Table) -> Table:
    """Little friction, so that much is possible."""
    parts = {part: float(rng.uniform(0.0, 0.15)) for part in table["friction"]}
    return {**table, "friction": parts}


TWISTS: dict[str, Callable[[np.random.Generator, Table], Table]] = {
    "any": _keep,
    "near a link's end": _near_end,
    "mirrored": _mirror,
    "rough": _rough,
    "smooth": _smooth,
}
"""Changes that make a scene special."""

Phases = list[dict[str, Any]]
Stops = list[tuple[float, float]]


def _at_rest(
    rng: np.random.Generator, problem: Problem, phases: Phases, stops: Stops
) -> tuple[Phases, Stops, str]:
    return phases, stops, "from the map"


def _struck(
    rng: np.random.Generator, problem: Problem, phases: Phases, stops: Stops
) -> tuple[Phases, Stops, str]:
    """Impacts wherever a contact is gained that the next phase has."""
    changed = [
        dict(phase, end="impact")
        if isinstance(phase["until"], str)
        and phase["until"] in following["contacts"]
        and set(following["contacts"]) <= {*phase["contacts"], phase["until"]}
        else phase
        for phase, following in itertools.pairwise(phases)
    ]
    return [*changed, phases[-1]], stops, "impacts"


def _joined(
    rng: np.random.Generator, problem: Problem, phases: Phases, stops: Stops
) -> tuple[Phases, Stops, str]:
    """Smooth ends wherever a phase passes into one with three contacts or fewer freedoms."""
    changed = []
    for phase, following in itertools.pairwise(phases):
        gained = {phase["until"]} if isinstance(phase["until"], str) else set()
        fits = set(following["contacts"]) <= {*phase["contacts"], *gained}
        less = len(following["contacts"]) < len(phase["contacts"]) + len(gained)
        changed.append(dict(phase, end="smooth") if fits and less and len(phases) < 5 else phase)
    return [*changed, phases[-1]], stops, "smooth"


def _split(
    rng: np.random.Generator, problem: Problem, phases: Phases, stops: Stops
) -> tuple[Phases, Stops, str]:
    """A stop right before the end of a phase: two events that all but coincide."""
    k = int(rng.integers(len(phases)))
    begin = np.array(stops[k - 1] if k else problem.start[[0, 2]])
    end = np.array(stops[k])
    share = 1 - 10.0 ** rng.uniform(-5.0, -1.0)
    place: Array = begin + share * (end - begin)
    row = int(np.abs((end - begin) / [problem.scene.scales.length, 1.0]).argmax())
    value = float(place[row]) if row == 0 else math.degrees(float(place[row]))
    first = {"contacts": phases[k]["contacts"], "until": {("x", "phi_deg")[row]: value}}
    changed = [*phases[:k], first, *phases[k:]]
    where = [*stops[:k], (float(place[0]), float(place[1])), *stops[k:]]
    return changed, where, "stopped short"


def _rolled(
    rng: np.random.Generator, problem: Problem, phases: Phases, stops: Stops
) -> tuple[Phases, Stops, str]:
    """A slide on the palm, then the object rolls over a vertex between two links."""
    first = phases[0]
    palm = [name for name in first["contacts"] if name.endswith("-palm")]
    links = [next((n for n in first["contacts"] if n.endswith(f"{k}")), "") for k in (1, 2)]
    if len(palm) != 2 or "" in links or problem.scene.friction.palm == 0:
        return phases, stops, "from the map"
    middle = (problem.start[0] + stops[0][0]) / 2
    right = rng.uniform() < 0.5
    corners = {n: locate(problem.scene, n, problem.start[None]).normal[0, 2] for n in palm}
    pivot = (max if right else min)(palm, key=lambda n: corners[n])
    turn = float(rng.uniform(1.0, 40.0)) * (-1.0 if right else 1.0)
    until = {"phi_deg": math.degrees(float(problem.start[2])) + turn}
    slide = {"contacts": first["contacts"], "until": {"x": float(middle)}}
    rolling = {"contacts": [f"{pivot} rolling", *links], "until": until}
    return [slide, rolling], [], "rolling"


ROUTES = (_at_rest, _at_rest, _struck, _joined, _split, _rolled)
"""Problems that are made of a list from the map."""
