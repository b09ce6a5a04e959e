"""The contact formations along a route through the (x, phi) plane, as phases of a problem file."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, require_number
from ..common.sharing import exclusive
from ..contacts.closing import close_finger, place_flush
from ..contacts.elemental import Contact
from ..geometry.path_guess import guess_phase
from ..geometry.tracing import trace_phases
from ..problem.definition import Problem, Until
from ..problem.read import build_problem
from ..problem.table import format_until
from ..scene.model import TURN, Polygon, check_place
from .borders import Window
from .legs import describe_miss, describe_place, tolerance, walk_leg

_MOST = 50  # Corners of a polygon that a file still shows well
_SIZE, _MASS = 0.05, 0.2  # radius [m] and mass [kg] of the reference object
# x of the left joint and of the start over the size, of polygons with five and more corners and of
# others; and the length of the slide. The right joint is at 1.6.
_LEFT, _START, _SLIDE = (-1.6, -0.2), (0.3, 1.2), 0.4
# Other hands and starts for given vertices.
_OTHERS = tuple(product((True, False), (1.2, 0.8, 0.3, 0.0)))
_COMMENTS = 31  # Column of the comments


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stretch of a route with one contact formation."""

    contacts: tuple[Contact, ...]
    until: Until  # the contact that is gained at its end, or the coordinate of the pose there
    start: Array  # start, stop (2,) [m, rad]: x and phi at its ends
    stop: Array

    def to_toml(self, number: int) -> str:
        """The stretch as one ``[[phases]]`` table of a problem file."""
        names = ", ".join(f'"{contact}"' for contact in self.contacts)
        return (
            f"[[phases]]                     # {number}: to {describe_place(self.stop)}\n"
            f"contacts = [{names}]\nuntil = {format_until(self.until)}\n"
        )


class Route(tuple[Stretch, ...]):
    """The stretches of a route, which are the phases of a problem file."""

    # flush edge and x [m] of the route's ``[start]``; None: the problem's own
    start: tuple[int, float] | None = None
    notes: tuple[str, ...] = ()  # such as borders that were missed by little


@exclusive
def list_formations(problem: Problem, *poses: Sequence[float]) -> Route:
    """List the contact formations along a route of straight legs.

    A leg with both ends near one border (`legs.NEAR`) follows the border; ends that near a change
    of contacts are moved to it. Phases are carried out as in a plan: on a border along its curve,
    in a cell to the nearest end, or to the pose at the end of the leg.

    Parameters
    ----------
    *poses : [m, rad]  two or more corners of the route. Unless it starts with an edge flush on the
                       palm, it is led from the problem's start to the first of them.

    Raises
    ------
    InputError  if part of the route cannot be reached, or it runs through a crossing of borders
    """
    if len(poses) < 2:
        raise InputError("", "route", f"{len(poses)} pose given; two or more are needed")
    corners = [np.array(pose, dtype=float) for pose in poses]
    for x, phi in corners:
        check_place(problem.scene, "route", float(x))
        TURN.check("route", math.degrees(phi), "degrees")
    near = tolerance(problem.scene)
    for one, two in pairwise(corners):
        if not (np.abs(two - one) > near).any():
            text = f"two poses at {describe_place(one)} are the same place"
            raise InputError("", "route", text)
    z, start, corners, notes = _begin(problem, corners)
    here, stretches, legs = z[[0, 2]], list[Stretch](), list[int]()
    origin = here
    for leg, there in enumerate(corners):
        note = describe_miss(problem.scene, here, there)
        try:
            walked = walk_leg(problem, len(stretches), z, here, there)
        except InputError as error:
            text = f"leg {leg + 1} {error.problem}" + (f"; {note}" if note else "")
            raise InputError("", "route", text) from None
        if note:
            notes.append(f"leg {leg + 1} goes through cells: {note}")
        for _, (contacts, until), end in walked:
            stretch = Stretch(contacts, until, z[[0, 2]], end[[0, 2]])
            before = stretches[-1] if stretches and legs[-1] != leg else None
            # On a border a leg may continue the one before; a reversal is a new phase.
            if before is not None and len(contacts) == 4 and set(before.contacts) == set(contacts):
                runs = (before.stop - before.start) * (stretch.stop - stretch.start)
                onwards = (runs / [problem.scene.scales.length**2, 1]).sum() > 0
                if onwards and before.until.contact is None:
                    stretches.pop()
                    stretch = replace(stretch, contacts=before.contacts, start=before.start)
            stretches.append(stretch)
            legs.append(leg)
            z = end
        here = z[[0, 2]]
    # The end of a leg may be moved to a change of contacts, but not the start.
    stretches[0] = replace(stretches[0], start=origin)
    route = Route(stretches)
    route.start, route.notes = start, tuple(notes)
    return route


def _begin(
    problem: Problem, corners: list[Array]
) -> tuple[Array, tuple[int, float] | None, list[Array], list[str]]:
    """Start configuration, its ``[start]``, the poses that follow and notes."""
    scene, near, first = problem.scene, tolerance(problem.scene), corners[0]
    if (np.abs(first - problem.start[[0, 2]]) < near).all():
        return problem.start, None, corners[1:], []
    around = Window((0.0, 0.0), (float(first[1] - near[1]), float(first[1] + near[1])))
    for angle, edge in around.flush_angles(scene):
        q = place_flush(scene, edge, float(first[0]))
        try:
            z = np.array([*q, close_finger(scene, q, 0), close_finger(scene, q, 1)])
        except InputError as error:
            text = f"cannot start at {describe_place(first)}: {error.problem}"
            raise InputError("", "route", text) from None
        # A problem starts with phi in one turn; so does the route.
        shift = np.array([0.0, float(q[2]) - angle])
        note = "the [start] below takes the place of the problem's own"
        return z, (edge, float(first[0])), [pose + shift for pose in corners[1:]], [note]
    note = (
        f"starts with leg 1 from the problem's start to {describe_place(first)}, "
        "where no edge is flush on the palm"
    )
    return problem.start, None, corners, [note]


def format_route(route: Route) -> str:
    """The route as ``[[phases]]`` with comments, ready to paste into a problem file."""
    first, last = describe_place(route[0].start), describe_place(route[-1].stop)
    lines = [f"# from {first} to {last}", *(f"# {note}" for note in route.notes)]
    if route.start is not None:
        edge, x = route.start
        lines.append(f"[start]\nflush = {edge}\nx = {x!r}\n")
    lines += [stretch.to_toml(number) for number, stretch in enumerate(route, start=1)]
    return "\n".join(lines)


def trace_problem(problem: Problem) -> list[Array]:
    """Path of each of the problem's phases, (n, 2) [m, rad], as far as geometry gives them."""
    paths: list[Array] = []
    z = problem.start
    try:
        for curve in trace_phases(problem):
            paths.append(curve.evaluate(np.linspace(0.0, curve.length, 60)).z[:, [0, 2]])
            z = curve.end
        for phase in problem.phases[len(paths) :]:
            later = problem.phases[phase.index + 1 :]
            parts = [part.z for part in guess_phase(phase, z, later)]
            paths.append(np.concatenate(parts)[:, [0, 2]])
            z = parts[-1][-1]
    except InputError:
        pass  # The map is drawn of infeasible phases, too.
    return paths


def write_template(
    name: str,
    corners: int = 7,
    size: float = _SIZE,
    mass: float | None = None,
    vertices: Array | None = None,
) -> str:
    """Write a problem file about a polygon that slides to the left on one edge.

    Parameters
    ----------
    size : [m]             from the centroid to the corners
    mass : [kg]            by default that of a plate as thick and heavy as those in `problems/`
    vertices : (n, 2) [m]  anticlockwise, in place of those of a regular polygon of that size

    Raises
    ------
    InputError  if a number is out of its range
    """
    given = vertices is not None
    if vertices is not None:
        body = Polygon(vertices, 1.0)
        corners, size = body.n_vertices, float(np.hypot(*body.vertices.T).max())
    if not 3 <= corners <= _MOST:
        raise InputError("", "--polygon", f"{corners} given; allowed are 3 to {_MOST}")
    scale = require_number(size, "--size", positive=True) / _SIZE
    weight = _MASS * scale**2 if mass is None else require_number(mass, "--mass", positive=True)
    if vertices is None:
        angles = -math.pi / 2 + math.pi * (2 * np.arange(corners) - 1) / corners
        # Rounded, so that a corner above the centroid is at zero.
        vertices = size * np.column_stack([np.cos(angles), np.sin(angles)]).round(12)
    few = corners < 5
    tried = [(few, _START[few]), *(_OTHERS if given else ())]
    for last, (wide, start) in zip([*tried[1:], None], tried, strict=True):
        try:
            return _write(name, vertices, size, weight, wide, start)
        except InputError:
            if last is None:
                raise
    raise AssertionError


def _write(name: str, vertices: Array, size: float, weight: float, few: bool, start: float) -> str:
    """The file for one hand and a start, over the size."""
    corners, scale, heavy = len(vertices), size / _SIZE, weight / _MASS
    finger = {
        "length": ((0.22 if few else 0.14) * scale, "m, joint to tip centre"),
        "radius": (0.005 * scale, "m, half thickness of the link"),
        "inertia": (0.005 * heavy * scale**2, "kg m^2, about the joint"),
        "viscous": (0.01 * heavy * scale**1.5, "N m s, friction of the joint"),
        "dry": (0.01 * heavy * scale, "N m, dry friction of the joint"),
        "torque_limit": (2.0 * heavy * scale, "N m"),
    }
    lines = [
        f"# A polygon with {corners} corners slides to the left on edge 0. Units: m, kg, s, rad.",
        _row("name", f'"{name}"', ""),
        _row("epsilon", _show(0.05 * heavy), "N, least normal force of every contact"),
        _row("gravity", "9.81", "m/s^2"),
        "\n[object]",
        f"# corners, anticlockwise [m]; the inertia is that of uniform density\n"
        f"vertices = [{', '.join(f'[{_show(x)}, {_show(y)}]' for x, y in vertices)}]",
        _row("mass", _show(weight), "kg"),
    ]
    for number, side, word in ((1, 1.6, "right"), (2, _LEFT[few], "left")):
        base = f"[{_show(side * size)}, {_show(-0.2 * size)}]"
        lines += [f"\n{f'[fingers.{number}]':<{_COMMENTS}}# {word}", _row("base", base, "m, joint")]
        lines += [_row(key, _show(value), text) for key, (value, text) in finger.items()]
    lines.append(f"\n{'[friction]':<{_COMMENTS}}# coefficient with the object")
    lines += [_row(part, "0.05", "") for part in ("palm", "finger1", "finger2")]
    lines += ["\n[start]", _row("flush", "0", "this edge lies on the palm")]
    lines += [_row("x", _show(start * size), "m, centroid; both fingers close on the object")]
    text = "\n".join(lines) + "\n"
    problem = build_problem(tomllib.loads(text))
    x, _, phi = (float(value) for value in problem.start[:3])
    route = list_formations(problem, (x, phi), ((start - _SLIDE) * size, phi))
    return text + "\n" + format_route(route)


def _row(key: str, value: str, comment: str) -> str:
    text = f"{key} = {value}"
    return f"{text:<{_COMMENTS}}# {comment}" if comment else text


def _show(value: float) -> str:
    """A number of four digits, as TOML has it."""
    return f"{float(f'{value:.4g}') + 0.0!r}"
