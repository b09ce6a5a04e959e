"""The contact formations along a route through the (x, phi) plane, as phases of a problem file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..contact import Contact
from ..curve import describe_pose
from ..errors import InputError
from ..links import FINGERS_TOUCH
from ..model import Array, Scene
from ..outline import outline_phase
from ..path import trace_phases
from ..problem import Problem, Until
from ..sharing import exclusive
from .borders import (
    Piece,
    Track,
    Window,
    flush_track,
    label_cells,
    name_contacts,
    palm_track,
)
from .closing import FINGERS_CROSS, JOINT_COVERED, TOO_SHORT, close, contact_table
from .pieces import cut

NEAR = np.array([5e-4, np.radians(0.5)])
"""Distance in x [m] and phi [rad] within which a route snaps to borders and crossings."""
SAME_PLACE = 1e-3
"""Length of a stretch over `NEAR` below which its ends are one crossing."""
PLACES = 401
"""Places along a leg at which contacts are looked up."""
BESIDE = 1e-7
"""Gap in the parameter of a leg above which part of it cannot be reached."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A stretch of a route with one contact formation.

    Attributes
    ----------
    contacts : tuple of Contact
    until : Until
        The contact that is gained at its end, or the coordinate of the pose there.
    start, stop : ndarray, shape (2,), [m, rad]
        x and phi at its ends.
    """

    contacts: tuple[Contact, ...]
    until: Until
    start: Array
    stop: Array

    def to_toml(self) -> str:
        """The stretch as one ``[[phases]]`` table of a problem file."""
        names = ", ".join(f'"{contact}"' for contact in self.contacts)
        until = self.until
        end = f'"{until.contact}"'
        if until.value is not None:
            angle = until.coordinate == "phi"
            value = round(np.degrees(until.value), 4) if angle else round(until.value, 6)
            end = f"{{ {'phi_deg' if angle else 'x'} = {float(value) + 0.0} }}"
        return f"[[phases]]\ncontacts = [{names}]\nuntil = {end}\n"


@exclusive
def list_formations(problem: Problem, *poses: Sequence[float]) -> list[Stretch]:
    """List the contact formations along a route of straight legs.

    A leg with both ends within `NEAR` of one border follows the border, and ends that near a
    change of contacts are moved to it.

    Parameters
    ----------
    problem : Problem
    *poses : (x, phi), [m, rad]
        Two or more: where the route starts, turns and stops.

    Raises
    ------
    InputError
        If part of the route cannot be reached, or it runs through a crossing of borders.
    """
    if len(poses) < 2:
        raise InputError("", "route", f"{len(poses)} pose given; two or more are needed")
    stretches: list[Stretch] = []
    here = np.array(poses[0], dtype=float)
    for pose in poses[1:]:
        there = np.array(pose, dtype=float)
        if not (np.abs(there - here) > NEAR).any():
            raise InputError("", "route", f"two poses at {_describe(here)} are the same place")
        for stretch in _list_leg(problem.scene, here, there):
            if stretches and stretches[-1].contacts == stretch.contacts:
                stretch = replace(stretch, start=stretches.pop().start)
            stretches.append(stretch)
        here = stretches[-1].stop
    return stretches


def format_route(stretches: Sequence[Stretch]) -> str:
    """The stretches as ``[[phases]]`` with comments, ready to paste into a problem file."""
    first, last = _describe(stretches[0].start), _describe(stretches[-1].stop)
    return "\n".join([f"# from {first} to {last}", *(s.to_toml() for s in stretches)])


def trace_problem(problem: Problem) -> list[Array]:
    """Path of each of the problem's phases, (n, 2) [m, rad], as far as geometry gives them."""
    paths: list[Array] = []
    z = problem.start
    try:
        for curve in trace_phases(problem):
            paths.append(curve.evaluate(np.linspace(0.0, curve.length, 60)).z[:, [0, 2]])
            z = curve.end
        for phase in problem.phases[len(paths) :]:
            parts = [part.z for part in outline_phase(problem, phase, z)]
            paths.append(np.concatenate(parts)[:, [0, 2]])
            z = parts[-1][-1]
    except InputError:
        pass  # The map is how phases that cannot be carried out are mended.
    return paths


def _list_leg(scene: Scene, start: Array, stop: Array) -> list[Stretch]:
    track, low, high, near = _choose_track(scene, start, stop)
    forwards = low <= high
    pieces = cut(track)
    low, high = min(low, high), max(low, high)
    ends = np.array([[piece.places[0], piece.places[-1]] for piece in pieces]).reshape(-1, 2)
    kept = [
        piece
        for piece, (first, last) in zip(pieces, ends.tolist(), strict=True)
        if last > low + near and first < high - near
    ]
    _require_reached(scene, track, kept, low, high, near)
    table = contact_table(scene)
    if not forwards:
        kept, pieces = kept[::-1], pieces[::-1]
    stretches = []
    for piece in kept:
        first, last = piece.places[0], piece.places[-1]
        # The track goes on a little beyond the leg; a change of contacts that near ends the leg.
        first = low if first < low - near or first == track.places[0] else first
        last = high if last > high + near or last == track.places[-1] else last
        index = pieces.index(piece)
        following = pieces[index + 1] if index + 1 < len(pieces) else None
        mine = name_contacts(table, piece.label)
        if not forwards:
            first, last = last, first
        at_change = last == (piece.places[-1] if forwards else piece.places[0])
        begin, end = (np.array(track.pose(np.array([s]))).ravel() for s in (first, last))
        if (np.abs(end - begin) < SAME_PLACE * NEAR).all():
            raise _crossing(end, mine)
        until = _until(mine, following, table, end) if at_change and following else None
        stretches.append(Stretch(mine, until or _coordinate(track, begin, end), begin, end))
    return stretches


def _choose_track(scene: Scene, start: Array, stop: Array) -> tuple[Track, float, float, float]:
    """The border that both ends are near, or a straight line; both ends on it, and `NEAR` there."""
    line = np.stack([start, stop])
    x, phi = (sorted(column) for column in line.T.tolist())
    wide = Window((x[0], x[1]), (phi[0] - 2 * NEAR[1], phi[1] + 2 * NEAR[1]))

    def spread(low: float, high: float, near: float) -> Array:
        return np.linspace(low - near, high + near, PLACES)

    for angle, edge in wide.flush_angles(scene):
        if (np.abs(line[:, 1] - angle) < NEAR[1]).all() and x[1] - x[0] > NEAR[0]:
            places = spread(x[0], x[1], NEAR[0])
            return palm_track(scene, edge, angle, places), start[0], stop[0], NEAR[0]
    far = Window((x[0], x[1]), (phi[0] - np.pi, phi[1] + np.pi))
    for low, high, vertex in far.bands(scene):
        if not (low - NEAR[1] < phi[0] and phi[1] < high + NEAR[1]) or phi[1] - phi[0] < NEAR[1]:
            continue
        places = np.clip(spread(phi[0], phi[1], NEAR[1]), low, high)
        for finger in (0, 1):
            for edge in range(scene.polygon.n_vertices):
                track = flush_track(scene, finger, edge, vertex, np.unique(places))
                ends = np.clip(line[:, 1], low, high)
                if (np.abs(track.pose(ends)[0] - line[:, 0]) < NEAR[0]).all() and cut(track):
                    return track, float(ends[0]), float(ends[1]), NEAR[1]

    def pose(s: Array) -> tuple[Array, Array]:
        points = start + s[:, None] * (stop - start)
        return points[:, 0], points[:, 1]

    near = float(1 / (np.abs(stop - start) / NEAR).max())
    places = spread(0.0, 1.0, near)
    track = Track(pose, lambda x, phi: label_cells(scene, x, phi), places)
    return track, 0.0, 1.0, near


def _require_reached(
    scene: Scene, track: Track, kept: list[Piece], low: float, high: float, near: float
) -> None:
    ends = [low + near, *(s for piece in kept for s in piece.places[[0, -1]]), high - near]
    for before, after in zip(ends[::2], ends[1::2], strict=True):
        if after - before > BESIDE:
            pose = track.pose(np.array([(before + after) / 2]))
            closed = close(scene, *pose)
            text = "there the border has ended"
            for finger, obstacle in enumerate(closed.obstacle[0].tolist()):
                if obstacle:
                    text = {
                        TOO_SHORT: f"finger {finger + 1} is too short",
                        JOINT_COVERED: f"the joint of finger {finger + 1} is in the object",
                        FINGERS_CROSS: FINGERS_TOUCH,
                    }[obstacle]
            where = _describe(np.array(pose).ravel())
            raise InputError("", "route", f"cannot be followed at {where}: {text}")


def _until(
    mine: tuple[Contact, ...], following: Piece, table: tuple[Contact, ...], place: Array
) -> Until:
    gained = [c for c in name_contacts(table, following.label) if c not in mine]
    if len(gained) != 1:
        raise _crossing(place, gained)
    return Until(contact=gained[0])


def _crossing(place: Array, contacts: Sequence[Contact]) -> InputError:
    names = ", ".join(contact.name for contact in contacts)
    text = f"runs through a crossing of borders at {_describe(place)}, at {names}"
    return InputError("", "route", f"{text}; go around it, or stop there")


def _coordinate(track: Track, start: Array, stop: Array) -> Until:
    """The coordinate at `stop` that changes most, or the one that a border is followed by."""
    index = int((np.abs(stop - start) / NEAR).argmax())
    if track.flush is not None:
        index = 0 if track.flush[0] is None else 1
    return Until(coordinate=("x", "phi")[index], value=float(stop[index]))


def _describe(point: Array) -> str:
    return describe_pose(np.array([point[0], 0.0, point[1]]))
