"""The contact formations along a route through the (x, phi) plane, as phases of a problem file."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product
from typing import NamedTuple

import numpy as np

from ..common.arguments import checked
from ..common.arrays import Array, Numbers, round_to
from ..common.errors import (
    InfeasibleError,
    InputError,
    WholearmError,
    require_number,
    require_vector,
)
from ..common.fields import keys_of
from ..common.sharing import exclusive
from ..contacts.closing import close_fingers, contact_table, describe_obstacle
from ..contacts.elemental import Contact
from ..contacts.formation import Formation, find_touching
from ..geometry.curve import describe_pose
from ..geometry.path_guess import MIN_DISTANCE, find_end, guess_phase, is_inside
from ..geometry.tracing import trace_phases
from ..mechanics.dynamics import measure_speed
from ..problem.definition import Phase, Problem, Until
from ..problem.read import build_problem, place_start
from ..problem.table import format_until, write_toml
from ..scene.model import PLACE, TURN, Polygon, Scene
from .borders import Piece, Track, Window, cut, flush_track, label_inside, name_contacts, palm_track

_SIZE, _MASS = 0.05, 0.2  # radius [m] and mass [kg] of the reference object
_COMMENTS = 31  # Column of the comments
NEAR = (0.015, float(np.radians(0.5)))  # tolerance of poses: x in radii of gyration, phi in rad
REPORTED = 4.0  # largest distance of a leg from a border that is reported, over `NEAR`
PLACES = 401  # samples of a leg
INSIDE = 0.2  # distance of a leg's end from an obstacle, over `NEAR`
DIGITS = 1e-5  # rounding of the coordinates that end phases, in radii of gyration and rad
Span = tuple[Numbers, float, float]  # a label, and the first and last parameter with this label
PhaseEnd = tuple["Stretch", Array]  # a phase, and the configuration at its end


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a route with one contact formation."""

    contacts: tuple[Contact, ...]
    until: Until  # terminal condition: contact gained, or coordinate of the pose
    start: Array  # start, stop (2,) [m, rad]: x and phi at its ends
    stop: Array


class Route(tuple[Stretch, ...]):
    """The stretches of a route, which are the phases of a problem file."""

    # flush edge and x [m] of the route's ``[start]``; None: the problem's own
    start: tuple[int, float] | None = None
    notes: tuple[str, ...] = ()  # comments, such as on borders near a leg


@exclusive
def list_formations(problem: Problem, *poses: Sequence[float]) -> Route:
    """List the contact formations along a route of straight legs.

    A leg with both ends near one border (`NEAR`) follows the border; ends near a change of contacts
    are moved to it. Ends of phases are computed as in a plan: on a border along its curve, in a
    cell to the nearest end, or to the pose at the end of the leg.

    Parameters
    ----------
    *poses : [m, rad]  two or more corners of the route. If no edge is flush on the palm at the
                       first one, the route leads there from the problem's start.

    Raises
    ------
    InputError  if part of the route cannot be reached, or it runs through a crossing of borders
    """
    if len(poses) < 2:
        raise InputError("", "route", f"{len(poses)} pose given; two or more are needed")
    corners = [require_vector(pose, "route", 2) for pose in poses]
    for x, phi in corners:
        PLACE.check("route", float(x), "m", problem.scene)
        TURN.check("route", math.degrees(phi), "degrees")
    tol = tolerance(problem.scene)
    for first, second in pairwise(corners):
        if not (np.abs(second - first) > tol).any():
            text = f"two poses at {describe_pose(first)} are the same place"
            raise InputError("", "route", text)
    z, start, corners, notes = _begin(problem, corners)
    origin, stretches = z[[0, 2]], list[Stretch]()
    for leg, corner in enumerate(corners, start=1):
        path = choose_leg(problem.scene, z[[0, 2]], corner)
        try:
            phase_ends = follow_leg(problem, len(stretches), z, path)
        except InputError as error:
            text = f"leg {leg} {error.problem}" + (f"; {path.note}" if path.note else "")
            raise InputError("", "route", text) from None
        if path.note:
            notes.append(f"leg {leg} goes through cells: {path.note}")
        for k, (stretch, end) in enumerate(phase_ends):
            contacts = set(stretch.contacts)
            previous = stretches[-1] if stretches and k == 0 else None
            # On a border a leg may continue the one before; a reversal is a new phase.
            if previous is not None and len(contacts) == 4 and set(previous.contacts) == contacts:
                products = (previous.stop - previous.start) * (stretch.stop - stretch.start)
                same_direction = (products / [problem.scene.scales.length**2, 1]).sum() > 0
                if same_direction and previous.until.contact is None:
                    stretches.pop()
                    stretch = replace(stretch, contacts=previous.contacts, start=previous.start)
            stretches.append(stretch)
            z = end
    # The end of a leg may be moved to a change of contacts, but not the start.
    stretches[0] = replace(stretches[0], start=origin)
    route = Route(stretches)
    route.start, route.notes = start, tuple(notes)
    return route


def _begin(
    problem: Problem, corners: list[Array]
) -> tuple[Array, tuple[int, float] | None, list[Array], list[str]]:
    """Start configuration, its ``[start]``, the poses that follow and notes."""
    scene, tol, corner = problem.scene, tolerance(problem.scene), corners[0]
    if (np.abs(corner - problem.start[[0, 2]]) < tol).all():
        return problem.start, None, corners[1:], []
    band = Window((0.0, 0.0), (float(corner[1] - tol[1]), float(corner[1] + tol[1])))
    for angle, edge in band.flush_angles(scene):
        try:
            z = place_start(scene, edge, float(corner[0]))
        except InputError as error:
            text = f"cannot start at {describe_pose(corner)}: {error.problem}"
            raise InputError("", "route", text) from None
        # The start of a problem has phi in (-pi, pi]; the route is shifted by multiples of 2 pi.
        shift = np.array([0.0, float(z[2]) - angle])
        note = "the [start] below takes the place of the problem's own"
        return z, (edge, float(corner[0])), [pose + shift for pose in corners[1:]], [note]
    note = (
        f"starts with leg 1 from the problem's start to {describe_pose(corner)}, "
        "where no edge is flush on the palm"
    )
    return problem.start, None, corners, [note]


@checked
def format_route(route: Route) -> str:
    """The route as ``[[phases]]`` with comments, ready to paste into a problem file."""
    first, last = describe_pose(route[0].start), describe_pose(route[-1].stop)
    lines = [f"# from {first} to {last}", *(f"# {note}" for note in route.notes)]
    if route.start is not None:
        edge, x = route.start
        lines.append(f"[start]\nflush = {edge}\nx = {x!r}\n")
    for number, stretch in enumerate(route, start=1):
        names = ", ".join(f'"{contact}"' for contact in stretch.contacts)
        lines.append(
            f"{'[[phases]]':<{_COMMENTS}}# {number}: to {describe_pose(stretch.stop)}\n"
            f"contacts = [{names}]\nuntil = {format_until(stretch.until)}\n"
        )
    return "\n".join(lines)


def trace_problem(problem: Problem) -> list[Array]:
    """Path of each phase of a problem, (n, 2) [m, rad], up to the first infeasible one."""
    paths: list[Array] = []
    z = problem.start
    try:
        for curve in trace_phases(problem):
            paths.append(curve.evaluate(np.linspace(0.0, curve.length, 60)).z[:, [0, 2]])
            z = curve.end
        for phase in problem.phases[len(paths) :]:
            parts = [part.z for part in guess_phase(phase, z, problem.phases[phase.index + 1 :])]
            paths.append(np.concatenate(parts)[:, [0, 2]])
            z = parts[-1][-1]
    except InputError:
        pass  # The map of a problem with infeasible phases is drawn, too.
    return paths


class Part(NamedTuple):
    """A part of a leg with one contact formation."""

    contacts: tuple[Contact, ...]
    start: Array  # start, stop (2,) [m, rad]: x and phi at its ends
    stop: Array
    gained: tuple[Contact, ...]  # at its end; empty if it ends inside a cell, or at an obstacle
    coordinate: int  # {0, 1}: x or phi, the one with the larger change


def follow_leg(problem: Problem, index: int, z: Array, leg: Leg) -> list[PhaseEnd]:
    """Phases along a leg from z, (5,), with their ends; an `InputError` if there are none.

    A phase with two degrees of freedom ends at the nearest place, not on the leg, except for the
    last one. The first phase has the number `index`.
    """
    phases: list[PhaseEnd] = []
    parts, tol = split_leg(problem.scene, leg), tolerance(problem.scene)
    while parts:
        while len(parts) > 1 and (np.abs(parts[0].stop - parts[0].start) < tol).all():
            # A first part within `NEAR` is skipped if the next one can start at z.
            if not _can_start(problem.scene, z, parts[1].contacts):
                break
            parts = parts[1:]
        phases += _follow_part(problem, index + len(phases), z, parts[:2])
        z, parts = phases[-1][1], parts[1:]
    return phases


def _list_missing(scene: Scene, z: Array, contacts: tuple[Contact, ...]) -> list[Contact]:
    """Contacts that do not touch at `z`."""
    gaps = Formation(scene, contacts).evaluate(z[None], z[None]).C[0]
    return [c for c, gap in zip(contacts, gaps, strict=True) if abs(gap) > scene.touching]


def _follow_part(problem: Problem, index: int, z: Array, parts: list[Part]) -> list[PhaseEnd]:
    """The first feasible phases through a part after which the next part can start."""
    fault: InputError | None = None
    scene, part = problem.scene, parts[0]
    for steps in _list_steps(scene, z, part, len(parts) == 1):
        end, phases = z, list[PhaseEnd]()
        try:
            for contacts, until in steps:
                start = end
                end = find_end(Phase(index + len(phases), Formation(scene, contacts), until), start)
                if measure_speed(scene, end - start) < MIN_DISTANCE * scene.scales.length:
                    text = f"{until} holds already at {describe_pose(start)}"
                    raise InputError("", "", text)
                stretch = Stretch(contacts, until, start[[0, 2]], end[[0, 2]])
                phases.append((stretch, end))
        except InputError as error:
            fault = fault or error
            continue
        if len(part.contacts) == 4:
            # A contact may be gained in both directions along a border.
            if not (np.abs(end[[0, 2]] - part.stop) < tolerance(scene)).all():
                text = f"{steps[-1][1]} is first reached at {describe_pose(end)}"
                fault = fault or InputError("", "", text)
                continue
        if len(parts) == 1 or _can_start(scene, end, parts[1].contacts):
            return phases
        names = ", ".join(contact.name for contact in parts[1].contacts)
        fault = fault or InputError("", "", f"cannot go on at {describe_pose(end)} with {names}")
    assert fault is not None
    raise fault


def _can_start(scene: Scene, z: Array, contacts: tuple[Contact, ...]) -> bool:
    """Whether a formation holds at `z`."""
    return not _list_missing(scene, z, contacts) and is_inside(Formation(scene, contacts), z)


def _list_steps(
    scene: Scene, z: Array, part: Part, last: bool
) -> Iterator[list[tuple[tuple[Contact, ...], Until]]]:
    """Candidate phases (contacts, terminal condition) for a part from `z`, the simplest first."""
    gain_steps = [[(part.contacts, Until(contact=c))] for c in part.gained]
    simple_steps = gain_steps or [[(part.contacts, end_at(scene, part.coordinate, part.stop))]]
    if last and len(part.contacts) == 3:
        # One phase with terminal constraints on the pose.
        pose = [end_at(scene, row, part.stop) for row in (0, 1)]
        pins = [end.coordinates for end in pose]
        for contact, pin in product(part.gained, pins):
            yield [(part.contacts, Until(contact=contact, pins=pin))]
        if not part.gained:
            row = part.coordinate
            yield [(part.contacts, replace(pose[row], pins=pins[1 - row]))]
    missing = _list_missing(scene, z, part.contacts)
    if len(missing) == 1 and len(part.contacts) == 4:
        # If `z` is beside the border, the border has to be reached first.
        closed = tuple(c for c in part.contacts if c not in missing)
        yield from ([(closed, Until(contact=missing[0])), *steps] for steps in simple_steps)
        return
    yield from simple_steps
    # Phases to x and phi, just short of the change of contacts, come before: from the start another
    # end may be nearer. Case: leg 3 of `list 1` of the corpus.
    rows = (part.coordinate,) if len(part.contacts) == 4 else (0, 1)
    target = part.start + (0.98 if part.gained else 1.0) * (part.stop - part.start)
    pose_steps = [(part.contacts, end_at(scene, row, target)) for row in rows]
    for count in range(1, len(rows) + 1):
        for selected in permutations(pose_steps, count):
            yield from ([*selected, *end] for end in gain_steps or [[]])


def end_at(scene: Scene, row: int, pose: Array) -> Until:
    """Terminal condition at x or phi of a pose, rounded as in problem files."""
    if row == 0:
        x = round_to(float(pose[0]), DIGITS * scene.scales.length)
        return Until(coordinate="x", value=x)
    degrees = round_to(math.degrees(pose[1]), math.degrees(DIGITS))
    return Until(coordinate="phi", value=math.radians(degrees))


def split_leg(scene: Scene, leg: Leg) -> list[Part]:
    """Split a leg into parts with one formation each.

    An end near a change of contacts (`NEAR`) is moved to it. Excursions of a straight leg from a
    cell within this tolerance are ignored.

    InputError if part of the leg cannot be reached, or it runs through a crossing of borders.
    """
    low, high = min(leg.start, leg.stop), max(leg.start, leg.stop)
    tol = min(leg.tol, 0.3 * (high - low))
    sign = 1 if leg.stop >= leg.start else -1
    # The start is the end of the previous leg, up to rounding.
    margins = (1e-4 * tol, tol)[::sign]
    spans = [(p.label, float(p.places[0]), float(p.places[-1])) for p in leg.pieces]
    spans = [span for span in spans if span[2] > low + margins[0] and span[1] < high - margins[1]]
    ends = [low + tol, *(s for _, *limits in spans for s in limits), high - tol]
    for before, after in zip(ends[::2], ends[1::2], strict=True):
        if after - before > 1e-6 * leg.tol:
            pose = leg.at((before + after) / 2)
            text = describe_obstacle(close_fingers(scene, pose[:1], pose[1:]))
            text = text or "there the border has ended"
            raise InputError("", "route", f"cannot be followed at {describe_pose(pose)}: {text}")
    # Shorter parts are within a crossing.
    spans = [span for span in spans if span[2] - span[1] > 1e-3 * leg.tol] or spans
    if sign < 0:
        spans = [(label, last, first) for label, first, last in spans[::-1]]
    # The track extends beyond the leg; a change of contacts within the tolerance ends the leg.
    label, first, last = spans[0]
    if abs(first - leg.start) > 0.99 * tol:
        spans[0] = (label, leg.start, last)
    label, first, last = spans[-1]
    at_change = sign * (last - leg.stop) < 0.99 * tol
    if not at_change:
        spans[-1] = (label, first, leg.stop)
    if leg.track.flush is None:
        spans = _drop_excursions(scene, leg, spans)
    table, parts = contact_table(scene), list[Part]()
    for index, (label, first, last) in enumerate(spans):
        contacts = name_contacts(table, label)
        begin, end = leg.at(first), leg.at(last)
        gained: tuple[Contact, ...] = ()
        if index + 1 < len(spans):
            following = name_contacts(table, spans[index + 1][0])
            gained = tuple(c for c in following if c not in contacts)
            if len(gained) != 1:
                names = ", ".join(c.name for c in dict.fromkeys((*contacts, *following)))
                text = f"runs through a crossing of borders at {describe_pose(end)}, of {names}"
                raise InputError("", "route", f"{text}; go around it, or stop there")
        elif at_change:
            z = close_fingers(scene, end[:1], end[1:]).z[0]
            touching = find_touching(scene, z) if np.isfinite(z).all() else ()
            gained = tuple(c for c in touching if c not in contacts)
            if not gained:
                end = leg.at(last + np.clip(first - last, -INSIDE * leg.tol, INSIDE * leg.tol))
        coordinate = int((np.abs(end - begin) / tolerance(scene)).argmax())
        if leg.track.flush is not None:
            coordinate = 0 if leg.on_palm else 1
        parts.append(Part(contacts, begin, end, gained, coordinate))
    return parts


def _drop_excursions(scene: Scene, leg: Leg, spans: list[Span]) -> list[Span]:
    """Spans without excursions within `NEAR`: a straight leg loses and regains a contact."""
    labels = np.array([label for label, _, _ in spans])
    box = np.array(list(product((-1, 0, 1), repeat=2))) * tolerance(scene)
    for column in (0, 2, 4):
        contacts = labels[:, column]
        for k in range(1, len(spans)):
            returns = np.flatnonzero(contacts[k:] == contacts[k - 1])
            if not len(returns) or returns[0] == 0:
                continue
            first, last = spans[k][1], spans[k + int(returns[0]) - 1][2]
            # Each place has to be within `NEAR` of a pose with this contact.
            x, phi = leg.track.pose(np.linspace(first, last, 9))
            poses = (np.column_stack([x, phi])[:, None] + box).reshape(-1, 2)
            nearby = label_inside(scene, close_fingers(scene, *poses.T))[:, column].reshape(9, -1)
            if (nearby == contacts[k - 1]).any(axis=1).all():
                contacts[k : k + int(returns[0])] = contacts[k - 1]
    merged: list[Span] = []
    for label, (_, first, last) in zip(labels, spans, strict=True):
        if merged and (merged[-1][0] == label).all():
            _, first, _ = merged.pop()
        merged.append((label, first, last))
    return merged


@dataclass(frozen=True, eq=False)
class Leg:
    """A curve in the (x, phi) plane."""

    track: Track
    start: float  # start, stop: parameters of the curve
    stop: float
    tol: float  # `NEAR` as a difference of the parameter
    pieces: list[Piece]  # of the curve
    note: str = ""  # the nearest border that it does not follow, and its distance

    @property
    def on_palm(self) -> bool:
        """Whether it is a border with an edge flush on the palm."""
        return self.track.flush is not None and self.track.flush[0] is None

    def at(self, place: float) -> Array:
        """The pose (x, phi) at a parameter, shape (2,) [m, rad]."""
        return np.array(self.track.pose(np.array([place]))).ravel()


def tolerance(scene: Scene) -> Array:
    """`NEAR` in the scene's units, shape (2,) [m, rad]."""
    return np.array([NEAR[0] * scene.scales.length, NEAR[1]])


def choose_leg(scene: Scene, start: Array, stop: Array) -> Leg:
    """Leg along the border within `NEAR` of both ends, or a straight leg if there is none."""
    candidates, neighbours = list[tuple[bool, float, Leg]](), list[tuple[float, Leg]]()
    for leg, distance in _list_near(scene, start, stop):
        # Each end has to be near a piece of the curve.
        ranges = [piece.places[[0, -1]] + np.array([-leg.tol, leg.tol]) for piece in leg.pieces]
        ends = leg.start, leg.stop
        on_pieces = all(any(low < place < high for low, high in ranges) for place in ends)
        if distance < 1 and (leg.on_palm or on_pieces):
            candidates.append((not leg.on_palm, distance, leg))
        if leg.pieces:
            neighbours.append((distance, leg))
    if candidates:
        return min(candidates, key=lambda entry: entry[:2])[2]
    distance, nearest = min(neighbours, key=lambda entry: entry[0], default=(0.0, None))
    note = "" if nearest is None or distance < 1 else _describe_miss(scene, nearest, start, stop)
    tol = tolerance(scene)

    def pose(s: Array) -> tuple[Array, Array]:
        points = start + s[:, None] * (stop - start)
        return points[:, 0], points[:, 1]

    margin = float(1 / (np.abs(stop - start) / tol).max())
    places = np.linspace(-margin, 1.0 + margin, PLACES)
    track = Track(pose, lambda x, phi, closed: label_inside(scene, closed), places)
    return Leg(track, 0.0, 1.0, margin, cut(scene, [track]), note)


def _list_near(scene: Scene, start: Array, stop: Array) -> Iterator[tuple[Leg, float]]:
    """Legs along borders within `REPORTED` of both ends, on the palm first.

    Each with the larger distance of the ends from the border, over `NEAR`.
    """
    tol = tolerance(scene)
    (left, low), (right, high) = np.sort([start, stop], axis=0).tolist()
    if right - left > tol[0]:
        reach, places = REPORTED * tol[1], np.linspace(left - tol[0], right + tol[0], PLACES)
        for angle, edge in Window((left, right), (low - reach, high + reach)).flush_angles(scene):
            gap = max(abs(low - angle), abs(high - angle)) / tol[1]
            if gap < REPORTED:
                track = palm_track(scene, edge, angle, places)
                yield Leg(track, float(start[0]), float(stop[0]), tol[0], cut(scene, [track])), gap
    for first, last, vertex in Window((left, right), (low - np.pi, high + np.pi)).bands(scene):
        if not (first - tol[1] < low and high < last + tol[1]):
            continue
        ends = np.clip([low - tol[1], high + tol[1]], first, last)
        for finger, edge in product((0, 1), range(scene.polygon.n_vertices)):
            track = flush_track(scene, finger, edge, vertex, ends)
            (a, off_a), (b, off_b) = (_locate(track, pose, tol) for pose in (start, stop))
            if max(off_a, off_b) < REPORTED and abs(a - b) > tol[1]:
                ends_on = np.clip([min(a, b) - tol[1], max(a, b) + tol[1]], first, last)
                track = replace(track, places=np.linspace(ends_on[0], ends_on[1], PLACES))
                yield Leg(track, a, b, tol[1], cut(scene, [track])), max(off_a, off_b)


def _locate(track: Track, pose: Array, tol: Array) -> tuple[float, float]:
    """Parameter of the nearest place on a track, and its distance over `NEAR`."""

    def measure(places: Array) -> Array:
        points = np.column_stack(track.pose(places))
        return np.asarray(np.nan_to_num((np.abs(points - pose) / tol).max(axis=1), nan=np.inf))

    low, high = float(track.places[0]), float(track.places[-1])
    places = np.append(np.clip(pose[1], low, high), np.linspace(low, high, PLACES))
    distances = measure(places)
    # The place of the same phi is preferred, if it is near.
    k = 0 if distances[0] < 1 else 1 + int(distances[1:].argmin())
    return float(places[k]), float(distances[k])


def _describe_miss(scene: Scene, leg: Leg, start: Array, stop: Array) -> str:
    """Message about a border beside a straight leg, with its distance and the tolerance."""
    assert leg.track.flush is not None
    finger, edge = leg.track.flush
    gaps = np.abs([leg.at(leg.start) - start, leg.at(leg.stop) - stop])
    dx, dphi = gaps.max(axis=0).tolist()
    part, distance = "the palm", f"{np.degrees(dphi):.3g} deg in phi"
    if finger is not None:
        part, distance = f"finger {finger + 1}", f"{1e3 * dx:.3g} mm in x and {distance}"
    x, phi = tolerance(scene)
    return (
        f"the nearest border, e{edge} flush on {part}, is up to {distance} away; "
        f"a leg follows it with both ends within {1e3 * x:.3g} mm and {np.degrees(phi):.3g} deg"
    )


def write_template(
    name: str,
    polygon: int = 7,
    size: float = _SIZE,
    mass: float | None = None,
    vertices: Array | None = None,
) -> str:
    """Text of a problem file in which a polygon slides to the left on one edge.

    Parameters
    ----------
    polygon                number of corners, 3 to 50
    size : [m]             from the centroid to the corners
    mass : [kg]            by default with the mass per area of the objects in `problems/`
    vertices : (n, 2) [m]  anticlockwise, in place of a regular polygon

    Raises
    ------
    InputError       if a number is out of its range
    InfeasibleError  if no tested combination of hand, start and friction has a plan for `vertices`
    """
    from ..planning.explain import unadvised
    from ..planning.plan import solve

    custom = vertices is not None
    if vertices is not None:
        shape = Polygon(vertices, 1.0)
        polygon, size = shape.n_vertices, float(np.hypot(*shape.vertices.T).max())
    if not 3 <= polygon <= 50:
        raise InputError("", "--polygon", f"{polygon} given; allowed are 3 to 50")
    scale = require_number(size, "--size", positive=True) / _SIZE
    weight = _MASS * scale**2 if mass is None else require_number(mass, "--mass", positive=True)
    if mass is None and keys_of(Polygon)["mass"].ranges[0].find_fault(weight):
        text = f"none given, and that by --size {size:g} would be {weight:.3g} kg"
        raise InputError("", "--mass", text)
    if vertices is None:
        angles = -math.pi / 2 + math.pi * (2 * np.arange(polygon) - 1) / polygon
        # Rounded, so that a corner above the centroid has x = 0.
        vertices = size * np.column_stack([np.cos(angles), np.sin(angles)]).round(12)
    few_corners = polygon < 5
    defaults = 0.05, few_corners, 1.2 if few_corners else 0.3
    if not custom:
        return _write(name, vertices, size, weight, *defaults)
    # For `vertices`, combinations of friction, hand and start are tested.
    failures = list[WholearmError]()
    for trial in [defaults, *product((0.05, 0.01), (True, False), (1.2, 0.8, 0.3, 0.0))]:
        try:
            text = _write(name, vertices, size, weight, *trial)
            with unadvised():
                solve(build_problem(tomllib.loads(text)), accuracy=1e-2, replay=False)
            return text
        except WholearmError as error:
            failures.append(error)
    reason = next((e for e in failures if not isinstance(e, InputError)), failures[-1])
    raise InfeasibleError(f"no hand and start that are tried have a plan: {reason}")


def _write(
    name: str, vertices: Array, size: float, weight: float, friction: float, few: bool, start: float
) -> str:
    """Text of the file for a coefficient of friction, a hand, and x at the start over the size."""
    scale, mass_ratio = size / _SIZE, weight / _MASS
    finger = f"""\
length = {_format((0.22 if few else 0.14) * scale)} # m, joint to tip centre
radius = {_format(0.005 * scale)} # m, half thickness of the link
inertia = {_format(0.005 * mass_ratio * scale**2)} # kg m^2, about the joint
viscous = {_format(0.01 * mass_ratio * scale**1.5)} # N m s, friction of the joint
dry = {_format(0.01 * mass_ratio * scale)} # N m, dry friction of the joint
torque_limit = {_format(2.0 * mass_ratio * scale)} # N m"""
    text = f"""\
# A polygon with {len(vertices)} corners slides to the left on edge 0. Units: m, kg, s, rad.
{write_toml({"name": name}).rstrip()}
epsilon = {_format(0.05 * mass_ratio)} # N, least normal force of every contact
gravity = 9.81 # m/s^2

[object]
# corners, anticlockwise [m]; the inertia is that of uniform density
vertices = [{", ".join(f"[{_format(x)}, {_format(y)}]" for x, y in vertices)}]
mass = {_format(weight)} # kg

[fingers.1] # right
base = [{_format(1.6 * size)}, {_format(-0.2 * size)}] # m, joint
{finger}

[fingers.2] # left
base = [{_format((-0.2 if few else -1.6) * size)}, {_format(-0.2 * size)}] # m, joint
{finger}

[friction] # coefficient with the object
palm = {friction}
finger1 = {friction}
finger2 = {friction}

[start]
flush = 0 # this edge lies on the palm
x = {_format(start * size)} # m, centroid; both fingers close on the object
"""
    text = re.sub('^([^"\n]+) # ', lambda row: f"{row[1]:<{_COMMENTS}}# ", text, flags=re.MULTILINE)
    problem = build_problem(tomllib.loads(text))
    x, _, phi = (float(value) for value in problem.start[:3])
    route = list_formations(problem, (x, phi), ((start - 0.4) * size, phi))
    return text + "\n" + format_route(route)


def _format(value: float) -> str:
    """A number with four digits as TOML."""
    return f"{float(f'{value:.4g}') + 0.0!r}"
