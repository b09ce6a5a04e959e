"""Random scenes, random routes through their maps, and problems built from them.

The state of the generator determines scene and route; each case has its own generator, from a seed
and a number.
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
PLACES = 60  # places along a border for ends of routes


def pick(rng: Random, options: Sequence[Any]) -> Any:
    """One of some options."""
    return options[int(rng.integers(len(options)))]


def random_scene(rng: Random) -> Table:
    """Draw the nested tables of a problem file whose fingers close on the object at the start.

    The object has 3 to 12 vertices and an aspect ratio up to 30; the only phase names the touching
    contacts of the start and has to be replaced.
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
    """Corners of a convex polygon within a radius `size`, shape (n_v, 2) [m]."""
    count, regular = int(rng.integers(3, 13)), rng.uniform() < 0.25
    jitter = 0.0 if regular else rng.uniform(0.1, 0.45)
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-jitter, jitter, count)) / count
    ratio = 1.0 if regular else 10.0 ** rng.uniform(-1.5, 0.0)
    rotation = rng.uniform(0, 2 * np.pi)
    across, along = np.cos(angles), ratio * np.sin(angles)
    c, s = np.cos(rotation), np.sin(rotation)
    return size * np.column_stack([c * across - s * along, s * across + c * along])


def _draw_hand(rng: Random, body: Table, size: float) -> Table:
    """A problem with fingers, friction, and a start that may be infeasible."""
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

    Legs follow borders, reverse on them, end at crossings, pass through cells from border to
    border and run close to curved borders. Many leave the reach of a finger.
    """
    start = problem.start[[0, 2]]
    poses = [start]
    pieces = _find_pieces(problem)
    noise = float(rng.choice([0.0, 0.0, 0.2])) * np.array([0.01, 0.005])
    for _ in range(int(rng.integers(1, 5))):
        kind = rng.choice(["along", "along", "end", "back", "cell", "border", "beside"])
        target = _draw_leg(rng, problem, pieces, poses, str(kind))
        if target is None:
            continue
        size = problem.scene.scales.length
        target = target + rng.uniform(-1.0, 1.0, 2) * noise * np.array([size, 1.0])
        if (np.abs(target - poses[-1]) > tolerance(problem.scene)).any():
            poses.append(target)
    if len(poses) == 1:
        poses.append(start + np.array([0.3 * problem.scene.scales.length, 0.0]))
    return [(float(x), float(phi)) for x, phi in poses]


@lru_cache(maxsize=8)
def _find_pieces(problem: Problem) -> list[Piece]:
    """Borders of the problem's map with a flush edge, near its start."""
    scene, pose = problem.scene, problem.start[[0, 2]]
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    reach = max(size + f.length + f.radius for f in scene.fingers)
    around = Window((0.0, 0.0), (pose[1] - 7.0, pose[1] + 7.0))
    angles = [phi for phi, _ in around.flush_angles(scene)]
    lower = max(phi for phi in angles if phi < pose[1] - 1e-6)
    upper = min(phi for phi in angles if phi > pose[1] + 1e-6)
    window = Window((pose[0] - reach, pose[0] + reach), (lower - 0.05, upper + 0.05))
    flush = (track for track in list_tracks(scene, window, PLACES) if track.flush is not None)
    tracks = [replace(t, places=np.linspace(t.places[0], t.places[-1], PLACES)) for t in flush]
    return cut(scene, tracks, window)


def _draw_leg(
    rng: Random, problem: Problem, pieces: list[Piece], poses: list[Array], kind: str
) -> Array | None:
    """End of a leg of one kind, or None if there is no such leg."""
    scene, pose = problem.scene, poses[-1]
    size = np.array([scene.scales.length, 1.0])
    if kind == "back":
        return pose + rng.uniform(0.1, 1.2) * (poses[-2] - pose) if len(poses) > 1 else None
    if kind == "cell":
        target = pose + rng.normal(0.0, 0.5, 2) * size
        inside = label_cells(scene, target)[0] != NOWHERE
        return target if inside else None
    close_pieces = [piece for piece in pieces if _distance(piece, pose, size) < 0.02]
    choices = pieces if kind == "border" else close_pieces
    if not choices:
        return None
    piece = pick(rng, choices)
    ends = piece.places[[0, -1]]
    place = rng.uniform(*ends)
    if kind == "end":
        place = pick(rng, ends)
    target = np.array(piece.track.pose(np.array([place]))).ravel()
    if kind == "beside":
        target = target + rng.normal(0.0, 0.02, 2) * size
    return np.asarray(target)


def _distance(piece: Piece, pose: Array, size: Array) -> float:
    """Distance of a pose from a border, x over the radius of gyration, phi in radians."""
    places = np.linspace(piece.places[0], piece.places[-1], 3 * PLACES)
    points = np.column_stack(piece.track.pose(places))
    return float(np.hypot(*((points - pose) / size).T).min())


@dataclass(frozen=True)
class DrawnScene:
    """A problem of the study."""

    kind: str  # variant of scene and route
    table: Table  # the contents of a problem file
    stops: list[tuple[float, float]]  # [m, rad]: ends of its phases on the map


@lru_cache(maxsize=2)
def draw_case(seed: int, number: int) -> DrawnScene:
    """Draw case `number` of a seed, independent of other draws."""
    rng = np.random.default_rng([seed, number])
    kind = pick(rng, list(TWISTS))
    needs_motion, drawn = rng.uniform() < 0.7, None
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
            json_table = json.loads(json.dumps({**table, "phases": phases}, default=float))
            drawn = DrawnScene(f"{kind}, {name}", json_table, stops)
            if moves or not needs_motion:
                return drawn
    if drawn is None:
        raise InputError("", f"scene {number}", "no route was found")
    return drawn


def can_move(problem: Problem, stretches: Sequence[Stretch]) -> bool:
    """Whether a slow motion keeps all limits at a few places of every stretch of a route."""
    scene = problem.scene
    for stretch in stretches:
        fraction = np.linspace(0.0, 1.0, 6)[1:-1, None] + np.array([0.0, 1e-4])
        poses = stretch.start + fraction.ravel()[:, None] * (stretch.stop - stretch.start)
        z = close_fingers(scene, *poses.T).z
        if np.isnan(z).any():
            return False
        formation = Formation(scene, stretch.contacts)
        for place, following in zip(z[::2], z[1::2], strict=True):
            tangents = np.array([following - place] * 2)
            pair = np.array([place, following])
            if slow_margin(formation, problem.epsilon, pair, tangents) < 0:
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
        position = float(locate(problem.scene, name, problem.start[None]).low[0])
        fraction = 10.0 ** rng.uniform(-6.0, -1.0)
        if rng.uniform() < 0.5:
            finger["length"] = position * (1 + fraction)
        else:
            finger["base"] = (np.array(finger["base"]) + (1 - fraction) * position * axis).tolist()
    return {**table, "fingers": {**table["fingers"], key: finger}}


def _mirror(rng: Random, table: Table) -> Table:
    """A regular object between equal fingers: events of both coincide, or nearly."""
    count = int(rng.integers(3, 13))
    size = float(np.abs(np.array(table["object"]["vertices"])).max())
    angles = -np.pi / 2 + 2 * np.pi * (np.arange(count) - 0.5) / count
    corners = size * np.column_stack([np.cos(angles), np.sin(angles)])
    right = dict(table["fingers"]["1"])
    asymmetry = float(rng.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-3]))
    left = dict(right, base=[-right["base"][0] * (1 + asymmetry), right["base"][1]])
    friction = dict(table["friction"], finger2=table["friction"]["finger1"])
    x = 0.0 if rng.uniform() < 0.5 else table["start"]["x"]
    body = {"vertices": corners.tolist(), "mass": table["object"]["mass"]}
    changed = {"object": body, "fingers": {"1": right, "2": left}, "friction": friction}
    return {**table, **changed, "start": {"flush": 0, "x": x}}


def _rough(rng: Random, table: Table) -> Table:
    """Friction close to 1 and joints heavier than the object: contacts jam."""
    parts = {part: float(rng.uniform(0.6, 1.0)) for part in table["friction"]}
    heavy = {
        key: dict(finger, inertia=finger["inertia"] * 10.0 ** float(rng.uniform(0.0, 3.0)))
        for key, finger in table["fingers"].items()
    }
    return {**table, "friction": parts, "fingers": heavy}


def _smooth(rng: Random, table: Table) -> Table:
    """Low friction, so that more motions are feasible."""
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
    """Impacts if the next phase has the gained contact, or smooth ends if it has fewer contacts."""
    changed = []
    for phase, following in itertools.pairwise(phases):
        gained = {phase["until"]} if isinstance(phase["until"], str) else set()
        before, after = {*phase["contacts"], *gained}, set(following["contacts"])
        releases = len(after) < len(phase["contacts"]) + len(gained) and len(phases) < 5
        applies = bool(gained) and gained <= after if end == "impact" else releases
        changed.append(dict(phase, end=end) if applies and after <= before else phase)
    return [*changed, phases[-1]], stops, "impacts" if end == "impact" else end


def _split(rng: Random, problem: Problem, phases: Phases, stops: Stops) -> Route:
    """A stop shortly before the end of a phase: two events that nearly coincide."""
    k = int(rng.integers(len(phases)))
    begin = np.array(stops[k - 1] if k else problem.start[[0, 2]])
    end = np.array(stops[k])
    fraction = 1 - 10.0 ** rng.uniform(-5.0, -1.0)
    place: Array = begin + fraction * (end - begin)
    row = int(np.abs((end - begin) / [problem.scene.scales.length, 1.0]).argmax())
    value = float(place[row]) if row == 0 else math.degrees(float(place[row]))
    first = {"contacts": phases[k]["contacts"], "until": {("x", "phi_deg")[row]: value}}
    changed = [*phases[:k], first, *phases[k:]]
    new_stops = [*stops[:k], (float(place[0]), float(place[1])), *stops[k:]]
    return changed, new_stops, "stopped short"


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
"""Problem generators from a list of formations of the map."""
