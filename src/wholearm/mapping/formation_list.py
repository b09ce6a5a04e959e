"""The contact formations along a route through the (x, phi) plane, as phases of a problem file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import overload

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..contacts.closing import close_finger, place_flush
from ..contacts.elemental import Contact
from ..geometry.path_guess import guess_phase
from ..geometry.tracing import trace_phases
from ..problem.definition import Problem, Until
from ..scene.ranges import TURN, check_place
from .borders import Window
from .legs import (
    describe_miss,
    describe_place,
    find_miss,
    format_until,
    tolerance,
    walk_leg,
)


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


@dataclass(frozen=True, eq=False)
class Route(Sequence[Stretch]):
    """The stretches of a route, which are the phases of a problem file."""

    stretches: tuple[Stretch, ...]
    # flush edge and x [m] of the route's ``[start]``; None: the problem's own
    start: tuple[int, float] | None = None
    notes: tuple[str, ...] = ()  # such as borders that were missed by little

    def __len__(self) -> int:
        return len(self.stretches)

    @overload
    def __getitem__(self, index: int) -> Stretch: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Stretch, ...]: ...

    def __getitem__(self, index: int | slice) -> Stretch | tuple[Stretch, ...]:
        return self.stretches[index]


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
        miss = find_miss(problem.scene, here, there)
        note = "" if miss is None else describe_miss(problem.scene, miss)
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
    return Route(tuple(stretches), start, tuple(notes))


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
