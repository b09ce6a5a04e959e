"""Straight ways through cells, from rest to rest: what they lead to, and about how long they take.

In a cell three contacts touch, which leaves two freedoms. From a place rays set out over the plane
of x and phi; where they come to a border another contact is gained. Along a straight way forces and
torques follow from speed and acceleration, as three contacts leave no squeeze, and a sweep over the
phase plane gives the least time. Motions that bend, or set out in motion, are faster: that is the
planner's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import (
    Flags,
    Numbers,
    close_fingers,
    contact_table,
    evaluate_contacts,
)
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..mapping.borders import label_cells
from ..mechanics.dynamics import Directions, inverse
from ..mechanics.limits import make_limits
from ..planning.lower_bound.rows import Rows, limit
from ..scene.model import Scene
from .places import unit_steps
from .sweep import find_durations

HEADINGS = 36
"""Ways in which motions may set out from a place."""
SPACING, REACH = 0.2, 3.0
"""Distance of places looked at along a ray, and its length, in radii of gyration and radians."""
PARTS, ROUNDS = 8, 3
"""How a place where contacts change is narrowed down: parts of an interval, and how often."""
NODES = 12
"""Intervals of a way."""
NEAREST = 0.02
"""Length of the shortest way, in the same unit."""


class Crossing(NamedTuple):
    """A straight way through a cell.

    Attributes
    ----------
    source : int
        Which of the places it starts from.
    gained : Contact or None
        What is gained at its end; None where it ends at a pose that was given.
    z : ndarray, shape (5,)
        Its end.
    duration : float, [s]
    """

    source: int
    gained: Contact | None
    z: Array
    duration: float


def cross(
    formation: Formation, starts: Array, epsilon: float, touching: Sequence[Contact] = ()
) -> list[Crossing]:
    """The fastest straight way to each contact that can be gained, from each of some places.

    Parameters
    ----------
    formation : Formation
        Of the cell.
    starts : ndarray, shape (n, 5)
        Where its contacts touch.
    epsilon : float, [N]
    touching : sequence of Contact
        What touches at the start; to gain one of these again leads nowhere new.
    """
    best: dict[tuple[int, Contact], Crossing] = {}
    for contact, sources, ends in _shoot(formation, starts, epsilon):
        if contact in touching:
            continue
        times = time_ways(formation, starts[sources], ends, epsilon)
        for k in np.flatnonzero(np.isfinite(times)):
            own = Crossing(int(sources[k]), contact, ends[k], float(times[k]))
            key = own.source, contact
            if key not in best or own.duration < best[key].duration:
                best[key] = own
    return list(best.values())


def go_to(formation: Formation, start: Array, poses: Array, epsilon: float) -> Crossing | None:
    """The fastest straight way from a place to one of some poses (x, phi) inside its cell."""
    scene = formation.scene
    z = close_fingers(scene, *poses.T).z
    own = _index_contacts(scene, formation)
    inside = (label_cells(scene, *poses.T)[:, [0, 2, 4]] == own).all(axis=1)
    ends = z[inside & np.isfinite(z).all(axis=1)]
    if not len(ends):
        return None
    times = time_ways(formation, np.repeat(start[None], len(ends), axis=0), ends, epsilon)
    k = int(times.argmin())
    return Crossing(0, None, ends[k], float(times[k])) if np.isfinite(times[k]) else None


def _index_contacts(scene: Scene, formation: Formation) -> Numbers:
    table = {contact: k for k, contact in enumerate(contact_table(scene))}
    return np.array([table[c] for c in formation.contacts])


def _shoot(
    formation: Formation, starts: Array, epsilon: float
) -> Iterator[tuple[Contact, Array, Array]]:
    """Contacts gained, which start each ray came from, and where it ends next to the border (k, 5).

    Only rays along which a motion can set out.
    """
    scene, table = formation.scene, contact_table(formation.scene)
    own = _index_contacts(scene, formation)
    angles = 2 * np.pi * (np.arange(HEADINGS) + 0.5) / HEADINGS
    ways = np.column_stack([np.cos(angles), np.sin(angles)]) * unit_steps(scene)
    z, ways = np.repeat(starts, HEADINGS, axis=0), np.tile(ways, (len(starts), 1))
    sources = np.repeat(np.arange(len(starts)), HEADINGS)
    kept = _can_set_out(formation, z, ways, epsilon)
    z, ways, sources = z[kept], ways[kept], sources[kept]
    away = SPACING * np.append(0.1, np.arange(1, round(REACH / SPACING)))

    def label(away: Array) -> Numbers:
        """What touches at distances along each ray, shape (w, n, 3)."""
        poses = z[:, None, [0, 2]] + ways[:, None] * away[..., None]
        labels = label_cells(scene, *poses.reshape(-1, 2).T)[:, [0, 2, 4]]
        return labels.reshape(*poses.shape[:2], 3)

    if not len(z):
        return
    labels = label(np.tile(away, (len(z), 1)))
    same = (labels == own).all(axis=2)
    first = np.where(same.all(axis=1), 0, same.argmin(axis=1))
    kept = first > 0
    z, ways, sources, first = z[kept], ways[kept], sources[kept], first[kept]
    if not len(z):
        return
    rows = np.arange(len(z))
    low, high, after = away[first - 1], away[first], labels[kept][rows, first]
    for _ in range(ROUNDS):
        inner = low[:, None] + (high - low)[:, None] * np.arange(1, PARTS) / PARTS
        labels = np.concatenate([label(inner), after[:, None]], axis=1)
        first = (labels == own).all(axis=2).argmin(axis=1)
        every = np.column_stack([low, inner, high])
        low, high, after = every[rows, first], every[rows, first + 1], labels[rows, first]
    changed = after != own
    kept = (changed.sum(axis=1) == 1) & (after >= 0).all(axis=1)
    gained = after[rows, changed.argmax(axis=1)]
    poses = z[:, [0, 2]] + ways * low[:, None]
    for index in np.unique(gained[kept]):
        contact = table[int(index)]
        if not any(_is_renamed(contact, held) for held in formation.contacts):
            mine = kept & (gained == index)
            yield contact, sources[mine], close_fingers(scene, *poses[mine].T).z


def _can_set_out(formation: Formation, z: Array, ways: Array, epsilon: float) -> Flags:
    """Whether a motion along straight ways can begin from rest, shape (w,)."""
    rows = _evaluate(formation, epsilon, z, ways)
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = -rows.one / rows.a
        least = np.where(rows.a > 0, bounds, 0.0).max(axis=1)
        most = np.where(rows.a < 0, bounds, np.inf).min(axis=1)
    never = ((rows.a == 0) & (rows.one < 0)).any(axis=1)
    return np.asarray((np.maximum(least, 0.0) < most) & ~never)


def _is_renamed(contact: Contact, held: Contact) -> bool:
    """Whether one contact is another one that has changed its name, with no edge lying flush."""
    if contact.finger != held.finger or contact.finger is None:
        return False
    return "tip" in (contact.surface, held.surface) and (
        contact.surface == held.surface or contact.feature == held.feature
    )


def time_ways(formation: Formation, starts: Array, ends: Array, epsilon: float) -> Array:
    """Least times of straight ways in (x, phi) from rest to rest, infinite without, shape (w,)."""
    if not len(ends):
        return np.zeros(0)
    scene = formation.scene
    nodes = (1 - np.cos(np.linspace(0, np.pi, NODES + 1))) / 2
    middles = (nodes[1:] + nodes[:-1]) / 2
    ways = (ends - starts)[:, [0, 2]]
    poses = starts[:, None, [0, 2]] + middles[:, None] * ways[:, None]
    x, phi = poses.reshape(-1, 2).T
    own = _index_contacts(scene, formation)
    inside = (label_cells(scene, x, phi)[:, [0, 2, 4]] == own).all(axis=1)
    usable = inside.reshape(len(ways), -1).all(axis=1)
    usable &= np.abs(ways / unit_steps(scene)).max(axis=1) > NEAREST
    times = np.full(len(ways), np.inf)
    if not usable.any():
        return times
    pick = np.repeat(usable, NODES)
    z = close_fingers(scene, x[pick], phi[pick]).z
    rows = _evaluate(formation, epsilon, z, np.repeat(ways, NODES, axis=0)[pick])
    rows = Rows(*(part.reshape(-1, NODES, *part.shape[1:]) for part in rows))
    part = (middles - nodes[:-1]) / np.diff(nodes)
    times[usable] = find_durations(rows, np.diff(nodes), part)
    return times


def _evaluate(formation: Formation, epsilon: float, z: Array, ways: Array) -> Rows:
    """Limits at n places of straight ways, as what they are of acceleration and speed."""
    pose = np.zeros((len(z), 2, 5))
    pose[:, [0, 1], [0, 2]] = 1.0
    label = _index_contacts(formation.scene, formation).tolist()
    P = evaluate_contacts(formation.scene, label, z).P
    matrix = np.concatenate([P, pose], axis=1)
    right = np.zeros((len(z), 5, 1))
    right[:, 3:, 0] = ways
    z_u = np.linalg.solve(matrix, right)[..., 0]
    at = evaluate_contacts(formation.scene, label, z, z_u)
    right = np.zeros((len(z), 5, 1))
    right[:, :3, 0] = -at.P_dot_v
    z_uu = np.linalg.solve(matrix, right)[..., 0]
    try:
        forces = inverse(formation, z, z_u, z_uu, Directions.of(at, z_u), at)
    except np.linalg.LinAlgError:
        # Three contacts that do not hold the object let nothing through.
        none = np.zeros((len(z), 1))
        return Rows(none, none, none, none - 1, none[:, 0])
    return limit(make_limits(formation, epsilon), forces, z_u[:, 3:])
