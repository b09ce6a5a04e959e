"""Random scenes, random routes through their maps, and the problems made of them.

The same state of the generator gives the same scene and the same route; each case is drawn by its
own generator from a seed and a number.
"""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..contacts.closing import close_fingers
from ..contacts.formation import Formation, find_touching
from ..mapping.borders import NOWHERE, Piece, Window, cut, label_cells, list_tracks
from ..mapping.formation_list import Stretch, format_route, list_formations, tolerance
from ..problem.definition import Problem
from ..problem.read import build_problem
from ..verification.newton_euler import locate
from .refusals import slow_margin

Random = np.random.Generator
Table = dict[str, Any]
PLACES = 60  # places along a border at which a route looks for its ends


def pick(rng: Random, options: Sequence[Any]) -> Any:
    """One of some options."""
    return options[int(rng.integers(len(options)))]


def random_scene(rng: Random) -> Table:
    """Draw the nested tables of a problem file whose fingers close on the object at the start.

    The object has 3 to 12 vertices and is anything from a needle to a disc; the only phase names
    what touches at the start and is there to be replaced.
    """
    while True:
        size, mass = 10.0 ** rng.uniform(-3.0, 1.0), 10.0 ** rng.uniform(-4.0, 3.0)
        corners = _draw_polygon(rng, size)
        body = {"vertices": corners.tolist(), "mass": mass}
        for _ in range(200):
            table = _draw_hand(rng, body, size)
            try:
                names = name_first(table)
                table["phases"] = [{"contacts": names, "until": {"x": table["start"]["x"]}}]
                build_problem(table)
            except InputError:
                continue
            return table


def _draw_polygon(rng: Random, size: float) -> Array:
    """Corners of a convex polygon within `size` of its middle, shape (n_v, 2) [m]."""
    count, regular = int(rng.integers(3, 13)), rng.uniform() < 0.25
    apart = 0.0 if regular else rng.uniform(0.1, 0.45)
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-apart, apart, count)) / count
    flat = 1.0 if regular else 10.0 ** rng.uniform(-1.5, 0.0)
    turn = rng.uniform(0, 2 * np.pi)
    across, along = np.cos(angles), flat * np.sin(angles)
    c, s = np.cos(turn), np.sin(turn)
    return size * np.column_stack([c * across - s * along, s * across + c * along])


def _draw_hand(rng: Random, body: Table, size: float) -> Table:
    """A problem with fingers, friction, and a start that may turn out to be impossible."""
    mass, gravity = body["mass"], 9.81
    reach = rng.uniform(1.2, 5.0)
    pointed = rng.uniform() < 0.5
    weight = mass * gravity
    fingers = {}
    for key, side in (("1", 1.0), ("2", -1.0)):
        length = size * reach * rng.uniform(0.8, 1.2)
        inertia, drag, dry = 10.0 ** rng.uniform(-6.0, 0.0, 3)
        fingers[key] = {
            "base": [side * size * rng.uniform(0.3, 2.5), size * rng.uniform(-0.5, 0.3)],
            "length": length,
            "radius": 0.0 if pointed else size * 10.0 ** rng.uniform(-2.0, -0.5),
            "inertia": 10.0 * inertia * mass * size**2,
            "viscous": drag * mass * size * math.sqrt(gravity * size),
            "dry": dry * weight * size,
            "torque_limit": weight * length * rng.uniform(0.5, 10.0),
        }
    friction = rng.uniform(0.0, 1.0, 3) * (rng.uniform(size=3) < 0.9)
    if rng.uniform() < 0.7:
        friction *= 0.3
    parts = dict(zip(("palm", "finger1", "finger2"), friction.tolist(), strict=True))
    x = size * float(rng.uniform(-1.5, 1.5))
    return {
        "name": "random",
        "epsilon": weight * 10.0 ** rng.uniform(-3.0, -1.0),
        "gravity": gravity,
        "object": body,
        "fingers": fingers,
        "friction": parts,
        "start": {"flush": int(rng.integers(len(body["vertices"]))), "x": x},
    }


def name_first(table: Table) -> list[str]:
    """Names of the contacts that touch at the start."""
    problem = build_problem({key: entry for key, entry in table.items() if key != "phases"})
    return [contact.name for contact in find_touching(problem.scene, problem.start)]


def random_route(rng: Random, problem: Problem) -> list[tuple[float, float]]:
    """Draw poses (x, phi) [m, rad] of a route through the map, from the problem's start.

    Legs follow borders, turn back on them, end at crossings, lead through cells from border to
    border and run right beside curved borders. Many lead to where a finger cannot follow.
    """
    here = problem.start[[0, 2]]
    poses = [here]
    pieces = _find_pieces(problem)
    fuzz = float(rng.choice([0.0, 0.0, 0.2])) * np.array([0.01, 0.005])
    for _ in range(int(rng.integers(1, 5))):
        kind = rng.choice(["along", "along", "end", "back", "cell", "border", "beside"])
        there = _draw_leg(rng, problem, pieces, poses, str(kind))
        if there is None:
            continue
        size = problem.scene.scales.length
        there = there + rng.uniform(-1.0, 1.0, 2) * fuzz * np.array([size, 1.0])
        if (np.abs(there - poses[-1]) > tolerance(problem.scene)).any():
            poses.append(there)
    if len(poses) == 1:
        poses.append(here + np.array([0.3 * problem.scene.scales.length, 0.0]))
    return [(float(x), float(phi)) for x, phi in poses]


@lru_cache(maxsize=8)
def _find_pieces(problem: Problem) -> list[Piece]:
    """Borders of the problem's map where an edge is flush, about its start."""
    scene, here = problem.scene, problem.start[[0, 2]]
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    reach = max(size + f.length + f.radius for f in scene.fingers)
    around = Window((0.0, 0.0), (here[1] - 7.0, here[1] + 7.0))
    angles = [phi for phi, _ in around.flush_angles(scene)]
    low = max(phi for phi in angles if phi < here[1] - 1e-6)
    high = min(phi for phi in angles if phi > here[1] + 1e-6)
    window = Window((here[0] - reach, here[0] + reach), (low - 0.05, high + 0.05))
    flush = (track for track in list_tracks(scene, window, PLACES) if track.flush is not None)
    tracks = [replace(t, places=np.linspace(t.places[0], t.places[-1], PLACES)) for t in flush]
    return cut(scene, tracks, window)


def _draw_leg(
    rng: Random, problem: Problem, pieces: list[Piece], poses: list[Array], kind: str
) -> Array | None:
    """End of a leg of one kind, or None where there is no such leg."""
    scene, here = problem.scene, poses[-1]
    size = np.array([scene.scales.length, 1.0])
    if kind == "back":
        return here + rng.uniform(0.1, 1.2) * (poses[-2] - here) if len(poses) > 1 else None
    if kind == "cell":
        there = here + rng.normal(0.0, 0.5, 2) * size
        inside = label_cells(scene, there)[0] != NOWHERE
        return there if inside else None
    near = [piece for piece in pieces if _distance(piece, here, size) < 0.02]
    choice = pieces if kind == "border" else near
    if not choice:
        return None
    piece = pick(rng, choice)
    ends = piece.places[[0, -1]]
    place = rng.uniform(*ends)
    if kind == "end":
        place = pick(rng, ends)
    there = np.array(piece.track.pose(np.array([place]))).ravel()
    if kind == "beside":
        there = there + rng.normal(0.0, 0.02, 2) * size
    return np.asarray(there)


def _distance(piece: Piece, here: Array, size: Array) -> float:
    """Distance of a pose from a border, x over the radius of gyration, phi in radians."""
    places = np.linspace(piece.places[0], piece.places[-1], 3 * PLACES)
    points = np.column_stack(piece.track.pose(places))
    return float(np.hypot(*((points - here) / size).T).min())


@dataclass(frozen=True)
class DrawnScene:
    """A problem of the study."""

    kind: str  # what is special about it
    table: Table  # the contents of a problem file
    stops: list[tuple[float, float]]  # [m, rad]: where its phases end according to the map


@lru_cache(maxsize=2)
def draw_case(seed: int, number: int) -> DrawnScene:
    """Draw case `number` of a seed: always the same one, whichever others are drawn."""
    rng = np.random.default_rng([seed, number])
    kind = pick(rng, list(TWISTS))
    willing, last = rng.uniform() < 0.7, None
    for _ in range(6):
        try:
            table = TWISTS[kind](rng, random_scene(rng))
            table = {**table, "phases": [{"contacts": name_first(table), "until": {"x": 0.0}}]}
            problem = build_problem(table)
        except InputError:
            continue
        for _ in range(4):
            try:
                stretches = list_formations(problem, *random_route(rng, problem))
            except InputError:
                continue
            phases = tomllib.loads(format_route(stretches))["phases"]
            stops = [(float(part.stop[0]), float(part.stop[1])) for part in stretches]
            moves = can_move(problem, stretches)
            phases, stops, name = pick(rng, ROUTES)(rng, problem, phases, stops)
            plain = json.loads(json.dumps({**table, "phases": phases}, default=float))
            last = DrawnScene(f"{kind}, {name}", plain, stops)
            if moves or not willing:
                return last
    if last is None:
        raise InputError("", f"scene {number}", "no route was found")
    return last


def can_move(problem: Problem, stretches: Sequence[Stretch]) -> bool:
    """Whether a slow motion keeps all limits at a few places of every stretch of a route."""
    scene = problem.scene
    for stretch in stretches:
        share = np.linspace(0.0, 1.0, 6)[1:-1, None] + np.array([0.0, 1e-4])
        poses = stretch.start + share.ravel()[:, None] * (stretch.stop - stretch.start)
        z = close_fingers(scene, *poses.T).z
        if np.isnan(z).any():
            return False
        formation = Formation(scene, stretch.contacts)
        for place, following in zip(z[::2], z[1::2], strict=True):
            way = np.array([following - place] * 2)
            pair = np.array([place, following])
            if slow_margin(formation, problem.epsilon, pair, way) < 0:
                return False
    return True


def _near_end(rng: Random, table: Table) -> Table:
    """A link that touches the object near its tip, or near its base."""
    key = str(rng.integers(1, 3))
    finger, problem = dict(table["fingers"][key]), build_problem(table)
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


def _mirror(rng: Random, table: Table) -> Table:
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
    changed = {"object": body, "fingers": {"1": right, "2": left}, "friction": friction}
    return {**table, **changed, "start": {"flush": 0, "x": x}}


def _rough(rng: Random, table: Table) -> Table:
    """Friction near one and joints heavy against the object: contacts jam."""
    parts = {part: float(rng.uniform(0.6, 1.0)) for part in table["friction"]}
    heavy = {
        key: dict(finger, inertia=finger["inertia"] * 10.0 ** float(rng.uniform(0.0, 3.0)))
        for key, finger in table["fingers"].items()
    }
    return {**table, "friction": parts, "fingers": heavy}


def _smooth(rng: Random, table: Table) -> Table:
    """Little friction, so that much is possible."""
    parts = {part: float(rng.uniform(0.0, 0.15)) for part in table["friction"]}
    return {**table, "friction": parts}


TWISTS: dict[str, Callable[[Random, Table], Table]] = {
    "any": lambda rng, table: table,
    "near a link's end": _near_end,
    "mirrored": _mirror,
    "rough": _rough,
    "smooth": _smooth,
}

Phases = list[dict[str, Any]]
Stops = list[tuple[float, float]]
Route = tuple[Phases, Stops, str]


def _at_rest(rng: Random, problem: Problem, phases: Phases, stops: Stops) -> Route:
    return phases, stops, "from the map"


def _joined(rng: Random, problem: Problem, phases: Phases, stops: Stops, end: str) -> Route:
    """Impacts wherever the next phase has the gained contact, or smooth ends where it has less."""
    changed = []
    for phase, following in itertools.pairwise(phases):
        gained = {phase["until"]} if isinstance(phase["until"], str) else set()
        before, after = {*phase["contacts"], *gained}, set(following["contacts"])
        less = len(after) < len(phase["contacts"]) + len(gained) and len(phases) < 5
        fits = bool(gained) and gained <= after if end == "impact" else less
        changed.append(dict(phase, end=end) if fits and after <= before else phase)
    return [*changed, phases[-1]], stops, "impacts" if end == "impact" else end


def _split(rng: Random, problem: Problem, phases: Phases, stops: Stops) -> Route:
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


def _rolled(rng: Random, problem: Problem, phases: Phases, stops: Stops) -> Route:
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


_struck, _smoothed = (partial(_joined, end=end) for end in ("impact", "smooth"))
ROUTES = (_at_rest, _at_rest, _struck, _smoothed, _split, _rolled)
"""Problems that are made of a list from the map."""
