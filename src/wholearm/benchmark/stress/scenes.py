"""Random scenes, and random routes through their maps, from a seeded generator.

The same state of the generator gives the same scene and the same route.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from ...common.arrays import Array
from ...common.errors import InputError
from ...contacts.closing import close_finger, place_flush
from ...contacts.formation import find_touching
from ...mapping.borders import NOWHERE, Piece, Window, flush_track, label_cells, palm_track
from ...mapping.nearby import tolerance
from ...mapping.pieces import cut
from ...problem.definition import Problem
from ...problem.read import build_problem
from ...scene.model import Finger, Friction, Scene
from ...scene.polygon import Polygon

Table = dict[str, Any]

SIZES, MASSES = (-3.0, 1.0), (-4.0, 3.0)
"""Powers of ten: radius of the object [m], and its mass [kg]."""
DECADES = (-6.0, 0.0)
"""Powers of ten: joint inertia, viscous and dry friction, over what the object has of them."""
POINTED = 0.5
"""Share of the scenes whose fingers have no thickness."""
TRIES = 200
"""Hands that are drawn for one object before another object is."""
PLACES = 60
"""Places along a border at which a route looks for its ends."""


def random_scene(rng: np.random.Generator) -> Table:
    """Draw the nested tables of a problem file whose fingers close on the object at the start.

    The object has 3 to 12 vertices and is anything from a needle to a disc; the only phase names
    what touches at the start and is there to be replaced.
    """
    while True:
        size, mass = 10.0 ** rng.uniform(*SIZES), 10.0 ** rng.uniform(*MASSES)
        corners = _draw_polygon(rng, size)
        body = {"vertices": corners.tolist(), "mass": mass}
        for _ in range(TRIES):
            table = _draw_hand(rng, body, size)
            try:
                names = name_first(table)
                table["phases"] = [{"contacts": names, "until": {"x": table["start"]["x"]}}]
                build_problem(table)
            except InputError:
                continue
            return table


def _draw_polygon(rng: np.random.Generator, size: float) -> Array:
    """Corners of a convex polygon within `size` of its middle, shape (n_v, 2) [m]."""
    count, regular = int(rng.integers(3, 13)), rng.uniform() < 0.25
    apart = 0.0 if regular else rng.uniform(0.1, 0.45)
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-apart, apart, count)) / count
    flat = 1.0 if regular else 10.0 ** rng.uniform(-1.5, 0.0)
    turn = rng.uniform(0, 2 * np.pi)
    across, along = np.cos(angles), flat * np.sin(angles)
    c, s = np.cos(turn), np.sin(turn)
    return size * np.column_stack([c * across - s * along, s * across + c * along])


def _draw_hand(rng: np.random.Generator, body: Table, size: float) -> Table:
    """A problem with fingers, friction, and a start that may turn out to be impossible."""
    mass, gravity = body["mass"], 9.81
    reach = rng.uniform(1.2, 5.0)
    pointed = rng.uniform() < POINTED
    weight = mass * gravity
    fingers = {}
    for key, side in (("1", 1.0), ("2", -1.0)):
        length = size * reach * rng.uniform(0.8, 1.2)
        inertia, drag, dry = 10.0 ** rng.uniform(*DECADES, 3)
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
    body, fingers = table["object"], table["fingers"]
    polygon = Polygon(body["vertices"], body["mass"])
    right, left = (Finger(**fingers[key]) for key in ("1", "2"))
    scene = Scene(polygon, (right, left), Friction(**table["friction"]))
    q = place_flush(scene, table["start"]["flush"], table["start"]["x"])
    z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
    return [contact.name for contact in find_touching(scene, z)]


def random_route(rng: np.random.Generator, problem: Problem) -> list[tuple[float, float]]:
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
    tracks = [
        palm_track(scene, edge, phi, np.linspace(*window.x, PLACES))
        for phi, edge in window.flush_angles(scene)
    ]
    for first, last, vertex in window.bands(scene):
        for finger in (0, 1):
            for edge in range(scene.polygon.n_vertices):
                places = np.linspace(first, last, PLACES)
                tracks.append(flush_track(scene, finger, edge, vertex, places))
    return cut(scene, tracks, window)


def _draw_leg(
    rng: np.random.Generator, problem: Problem, pieces: list[Piece], poses: list[Array], kind: str
) -> Array | None:
    """End of a leg of one kind, or None where there is no such leg."""
    scene, here = problem.scene, poses[-1]
    size = np.array([scene.scales.length, 1.0])
    if kind == "back":
        if len(poses) < 2:
            return None
        share = rng.uniform(0.1, 1.2)
        return here + share * (poses[-2] - here)
    if kind == "cell":
        there = here + rng.normal(0.0, 0.5, 2) * size
        inside = label_cells(scene, there[:1], there[1:])[0, 0] != NOWHERE
        return there if inside else None
    own = [piece for piece in pieces if _distance(piece, here, size) < 0.02]
    if kind == "border":
        own = pieces
    if not own:
        return None
    piece = own[int(rng.integers(len(own)))]
    track, (low, high) = piece.track, piece.places[[0, -1]]
    place = rng.uniform(low, high)
    if kind == "end":
        place = [low, high][int(rng.integers(2))]
    there = np.array(track.pose(np.array([place]))).ravel()
    if kind == "beside":
        there = there + rng.normal(0.0, 0.02, 2) * size
    return np.asarray(there)


def _distance(piece: Piece, here: Array, size: Array) -> float:
    """Distance of a pose from a border, x over the radius of gyration, phi in radians."""
    points = np.column_stack(
        piece.track.pose(np.linspace(piece.places[0], piece.places[-1], 3 * PLACES))
    )
    return float(np.hypot(*((points - here) / size).T).min())
