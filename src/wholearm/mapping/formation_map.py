"""The contact-formation map: the (x, phi) plane as cells, borders and crossings.

With palm and both fingers touching, a configuration is a function of (x, phi). Inside a cell three
contacts touch (two freedoms), on its borders four (one freedom), at crossings five.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array
from ..common.document import Drawn
from ..common.errors import InputError
from ..common.sharing import exclusive
from ..contacts.closing import (
    Flags,
    Numbers,
    close_fingers,
    contact_table,
    evaluate_contacts,
)
from ..contacts.elemental import Contact
from ..mechanics.keys import UNIQUENESS
from ..mechanics.uniqueness import UNIQUENESS_MARGIN
from ..problem.definition import Problem
from ..scene.model import Scene
from .borders import NOWHERE, Piece, Window, label_cells, list_tracks, name_contacts
from .pieces import cut
from .quasistatic import check_border, check_cell
from .route import Stretch, list_formations
from .window import choose_window, label_grid

Flush = tuple[int | None, int]
"""A finger (None for the palm) and an edge that lies flush on it."""
SAMPLES = 100
"""Places per radian of the window, and least across it, at which borders are looked for."""
ARROWS = 24
"""Places across the map at which directions inside cells are checked."""
CROSSED = -5
"""Cell of the places where the closed fingers would overlap."""
SAME_PLACE = 3e-5
"""Distance, in radii of gyration and radians, below which ends of borders are one crossing."""


@dataclass(frozen=True, eq=False)
class Border:
    """A stretch of a cell border with one contact formation.

    Attributes
    ----------
    contacts : tuple of Contact
        The four that touch.
    flush : tuple (int or None, int), or None
        The finger (None for the palm) and the edge that lies flush on it. None where a contact
        passes from the side of a link to its tip or along the tip: there two names stand for one
        contact and nothing holds the motion to the border.
    along : {"x", "phi"}
        The coordinate that increases along the border.
    points : ndarray, shape (n, 2), [m, rad]
        x and phi.
    z : ndarray, shape (n, 5)
        Configurations there.
    forth, back : ndarray of bool, shape (n,)
        Whether a quasistatic motion is possible with the coordinate increasing, and decreasing;
        all False where nothing is flush.
    ambiguous : ndarray of bool, shape (n,)
        Whether it would be, one way or the other, if contact forces were the only ones.
    """

    contacts: tuple[Contact, ...]
    flush: Flush | None
    along: str
    points: Array
    z: Array
    forth: Flags
    back: Flags
    ambiguous: Flags

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the contacts."""
        return tuple(contact.name for contact in self.contacts)


@dataclass(frozen=True, eq=False)
class Crossing:
    """A place where borders meet and five or more contacts touch.

    Attributes
    ----------
    point : ndarray, shape (2,), [m, rad]
        x and phi.
    z : ndarray, shape (5,)
    contacts : tuple of Contact
    flush : tuple
        What lies flush on the borders that meet, as in `Border`. With two or more, five contacts
        press at places of their own; with one, a contact changes its name on a border.
    """

    point: Array
    z: Array
    contacts: tuple[Contact, ...]
    flush: tuple[Flush, ...]


@dataclass(frozen=True, eq=False, repr=False)
class FormationMap(Drawn):
    """The cells, borders and crossings of a window of the (x, phi) plane.

    Attributes
    ----------
    problem : Problem
    x, phi : ndarray, shape (n_x,) and (n_phi,), [m] and [rad]
        Grid.
    cell : ndarray of int, shape (n_phi, n_x)
        Index into `formations`; -1 and -2 where finger 1 and 2 is too short, -3 and -4 where the
        joint of finger 1 and 2 is in the object, `CROSSED` where the fingers would overlap.
    formations : tuple of tuple of Contact
        The three contacts of each cell.
    borders : tuple of Border
    crossings : tuple of Crossing
    places : ndarray, shape (m, 2), [m, rad]
        Where directions inside cells were checked.
    possible : ndarray of bool, shape (m, 4)
        Whether a quasistatic motion is possible there with x increasing, x decreasing, phi
        increasing and phi decreasing while the other stays.
    ambiguous : ndarray of bool, shape (m,)
        Whether one more of these would be possible, if contact forces were the only ones.
    """

    problem: Problem
    x: Array
    phi: Array
    cell: Numbers
    formations: tuple[tuple[Contact, ...], ...]
    borders: tuple[Border, ...]
    crossings: tuple[Crossing, ...]
    places: Array
    possible: Flags
    ambiguous: Flags

    @property
    def headline(self) -> str:
        """What there is, in a line."""
        return (
            f"{self.problem.name!r}, {len(self.formations)} formations, {len(self.borders)} "
            f"borders, {len(self.crossings)} crossings"
        )


@exclusive
def build_map(
    problem: Problem,
    resolution: int = 200,
    window: Window | None = None,
    progress: Callable[[str], None] | None = None,
    uniqueness_margin: float = UNIQUENESS_MARGIN,
) -> FormationMap:
    """Build the contact-formation map of a problem's scene.

    Parameters
    ----------
    problem : Problem
        Its phases only say which part of the plane is of interest.
    resolution : int
        Points of the grid each way, at least 10. Borders do not depend on it.
    window : Window, optional
        The part of the plane; by default all x at which both fingers reach the object, and phi
        from the flush angle below the plan to that above it.
    progress : callable, optional
        Receives a line of text now and then.
    uniqueness_margin : float
        Where the uniqueness margin of contact forces (`mechanics.uniqueness`) is less, motion is
        ambiguous.

    Raises
    ------
    InputError
        If a number is out of its range or nothing in the window can be reached.
    """
    if resolution < 10:
        raise InputError("", "resolution", f"{resolution!r} given; allowed is 10 or more")
    limit = UNIQUENESS.read(uniqueness_margin, UNIQUENESS.name)
    scene, report = problem.scene, progress or (lambda text: None)
    report("map: cells")
    window = window or choose_window(problem)
    x, phi = np.linspace(*window.x, resolution), np.linspace(*window.phi, resolution)
    labels, obstacle = label_grid(scene, x, phi)
    triples = labels[..., [0, 2, 4]]
    known, cell = np.unique(triples[obstacle == 0], axis=0, return_inverse=True)
    if not len(known):
        raise InputError(problem.source, "", "the fingers reach the object nowhere in the window")
    cells = -obstacle
    cells[obstacle == 0] = cell.ravel()
    table = contact_table(scene)
    report("map: borders")
    samples = round(SAMPLES * max(1.0, window.phi[1] - window.phi[0]))
    tracks = list(list_tracks(scene, window, samples))
    borders = _build_borders(problem, cut(scene, tracks, window), limit)
    report("map: crossings and directions")
    directions = _check_cells(problem, window, limit)
    return FormationMap(
        problem,
        x,
        phi,
        cells,
        tuple(name_contacts(table, row) for row in known),
        tuple(borders),
        _find_crossings(scene, borders),
        *directions,
    )


def _build_borders(problem: Problem, pieces: Sequence[Piece], limit: float) -> list[Border]:
    """Borders of pieces: what takes the same time for few places and many is done for all."""
    if not pieces:
        return []
    scene = problem.scene
    x, phi = (np.concatenate(part) for part in zip(*map(_place, pieces), strict=True))
    z = close_fingers(scene, x, phi).z
    labels = np.concatenate([np.tile(own.label, (len(own.places), 1)) for own in pieces])
    owner = np.repeat(np.arange(len(pieces)), [len(own.places) for own in pieces])
    # Right at an end, rounding may leave a finger no way to close.
    closed = np.isfinite(z).all(axis=1)
    x, phi, z = x[closed], phi[closed], z[closed]
    labels, owner = labels[closed], owner[closed]
    flush = np.array([own.track.flush is not None for own in pieces])[owner]
    ways = np.zeros((3, len(z)), dtype=bool)
    if flush.any():
        rows = np.array([0 if _along(own) == "x" else 2 for own in pieces])[owner[flush]]
        chosen = labels[flush][labels[flush] != NOWHERE].reshape(-1, 4)
        ways[:, flush] = check_border(scene, problem.epsilon, chosen, z[flush], rows, limit)
    table, found = contact_table(scene), []
    for index, piece in enumerate(pieces):
        mine = owner == index
        contacts = name_contacts(table, piece.label[piece.label != NOWHERE])
        points = np.column_stack([x[mine], phi[mine]])
        own = Border(contacts, piece.track.flush, _along(piece), points, z[mine], *ways[:, mine])
        found.append(own)
    return found


def _place(piece: Piece) -> tuple[Array, Array]:
    return piece.track.pose(piece.places)


def _along(piece: Piece) -> str:
    """The coordinate that increases along a piece."""
    flush = piece.track.flush
    return "x" if flush is not None and flush[0] is None else "phi"


def _find_crossings(scene: Scene, borders: list[Border]) -> tuple[Crossing, ...]:
    """Where ends of borders meet, with the contacts of all of them, if these are five or more."""
    ends = [(border, k) for border in borders for k in (0, -1)]
    points = np.array([border.points[k] for border, k in ends]).reshape(-1, 2)
    size = SAME_PLACE * np.array([scene.scales.length, 1.0])
    table = contact_table(scene)
    place = {contact: k for k, contact in enumerate(table)}
    crossings, free = [], np.ones(len(points), dtype=bool)
    for k in range(len(points)):
        if not free[k]:
            continue
        same = free & (np.abs(points - points[k]) < size).all(axis=1)
        free &= ~same
        meeting = [ends[i][0] for i in np.flatnonzero(same)]
        met = {contact for border in meeting for contact in border.contacts}
        if len(met) < 5:
            continue
        border, end = ends[k]
        z = border.z[end]
        # Borders also end where a finger's first touch jumps from one side of its joint to the
        # other; what they touch there is not touched at once.
        label = sorted(place[contact] for contact in met)
        gaps = np.abs(evaluate_contacts(scene, label, z[None]).C[0])
        contacts = tuple(table[k] for k in np.array(label)[gaps < scene.touching])
        if len(contacts) >= 5:
            edges = tuple(dict.fromkeys(b.flush for b in meeting if b.flush is not None))
            crossings.append(Crossing(points[k], z, contacts, edges))
    return tuple(crossings)


def _check_cells(problem: Problem, window: Window, limit: float) -> tuple[Array, Flags, Flags]:
    """Directions of possible motion at the points of a lattice inside cells."""
    scene = problem.scene
    x, phi = (np.linspace(*ends, ARROWS + 1) for ends in (window.x, window.phi))
    x, phi = np.meshgrid((x[1:] + x[:-1]) / 2, (phi[1:] + phi[:-1]) / 2)
    places = np.column_stack([x.ravel(), phi.ravel()])
    labels = label_cells(scene, *places.T)
    places, labels = places[labels[:, 0] != NOWHERE], labels[labels[:, 0] != NOWHERE]
    z, triples = close_fingers(scene, *places.T).z, labels[:, [0, 2, 4]]
    return places, *check_cell(scene, problem.epsilon, triples, z, limit)


__all__ = [
    "Border",
    "Crossing",
    "FormationMap",
    "Stretch",
    "Window",
    "build_map",
    "choose_window",
    "list_formations",
]
