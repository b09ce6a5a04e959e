"""Rays that set out from places into the cells around them, up to where contacts are gained.

They are followed on the grid of `label_map`. Where that says that a contact is gained, its gap
along the ray is followed to zero, and what touches just before and after is looked up.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers, contact_table
from ..contacts.elemental import Contact
from ..contacts.explicit import measure_gap, place
from ..mapping.borders import NOWHERE, label_cells
from ..scene.model import Scene
from .label_map import AROUND, map_labels
from .places import Place, list_formations_at, unit_steps
from .ways import MIDDLES, can_set_out, list_middles

HEADINGS = 36
"""Ways in which motions may set out from a place."""
SPACING, REACH = 2 * np.pi / AROUND, 3.0
"""Distance of places looked at along a ray, and its length, in radii of gyration and radians."""
FIRST = 0.02
"""Where a ray has to be inside a cell, in the same unit; no way is shorter."""
OUTSIDE = 4
"""At how many places of a ray outside of its cell contacts that come into view count."""
CLOSER = 0.05
"""Distance of places at which a gap is evaluated, around where a contact is gained."""
AROUND_END = 6
"""How many of these there are before and after."""
BESIDE = 4e-4
"""How far before and after a border what touches is looked up."""


class Rays(NamedTuple):
    """Straight ways through cells, up to where contacts are gained.

    Attributes
    ----------
    sources : ndarray of int, shape (n,)
        Which places they start from.
    labels : ndarray of int, shape (n, 3)
        What touches along them: indices into `closing.contact_table`.
    gained : ndarray of int, shape (n,)
    starts, ends : ndarray, shape (n, 2), [m, rad]
        Poses (x, phi).
    """

    sources: Numbers
    labels: Numbers
    gained: Numbers
    starts: Array
    ends: Array

    def pick(self, kept: Flags | Numbers) -> Rays:
        """Some of the rays."""
        of_starts = self.sources[kept], self.labels[kept], self.gained[kept]
        return Rays(*of_starts, self.starts[kept], self.ends[kept])

    @property
    def ways(self) -> Array:
        """From starts to ends, shape (n, 2)."""
        return self.ends - self.starts


def shoot(places: Sequence[Place], epsilon: float) -> Rays:
    """Rays from places of one scene along which a motion can set out and that gain a contact."""
    scene = places[0].scene
    cells, held = _list_cells(places)
    angles = 2 * np.pi * (np.arange(HEADINGS) + 0.5) / HEADINGS
    ways = np.column_stack([np.cos(angles), np.sin(angles)]) * unit_steps(scene)
    sources = np.repeat(np.arange(len(places)), HEADINGS)
    starts = np.array([place.z[[0, 2]] for place in places])[sources]
    ways = np.tile(ways, (len(places), 1))
    labels = label_cells(scene, *(starts + FIRST * ways).T)[:, [0, 2, 4]]
    kept = (labels[:, None] == cells[sources]).all(axis=2).any(axis=1)
    rays = Rays(sources, labels, labels[:, 0], starts, starts + ways).pick(kept)
    ray, gained, about = _look_ahead(scene, rays, held)
    used, ray = np.unique(ray, return_inverse=True)
    rays = rays.pick(used)
    if not len(used):
        return rays
    kept = can_set_out(scene, epsilon, rays.labels, rays.starts, rays.ways)[ray]
    return _end(scene, rays.pick(ray[kept])._replace(gained=gained[kept]), about[kept])


def _list_cells(places: Sequence[Place]) -> tuple[Numbers, Numbers]:
    """Labels of the cells around places, (n, f, 3), and all that touches there, shape (n, c)."""
    index = {contact: k for k, contact in enumerate(contact_table(places[0].scene))}
    cells = [[cell.contacts for cell in list_formations_at(own, 3)] for own in places]
    labels = np.full((len(places), max(map(len, cells)), 3), NOWHERE - 1)
    held = np.full((len(places), max(len(own.contacts) for own in places)), NOWHERE - 1)
    for k, own in enumerate(places):
        for row, contacts in enumerate(cells[k]):
            labels[k, row] = [index[contact] for contact in contacts]
        held[k, : len(own.contacts)] = [index[contact] for contact in own.contacts]
    return labels, held


def _look_ahead(scene: Scene, rays: Rays, held: Numbers) -> tuple[Numbers, Numbers, Array]:
    """Contacts that rays may gain: which rays, the contacts, and about where [-], shape (k,).

    As the nearest place of the grid may be in another cell, contacts that come into view at the
    first few places outside of the ray's cell all count.
    """
    grid = map_labels(scene)
    away = SPACING * np.arange(1, round(REACH / SPACING))
    seen = grid.look_up(rays.starts[:, None] + away[:, None] * rays.ways[:, None])
    # What a label says is the same for all rays from a place into a cell.
    cell = np.column_stack([rays.sources, rays.labels])
    cell, group = np.unique(cell, axis=0, return_inverse=True)
    own, beside = cell[:, None, 1:], held[cell[:, 0], None, None]
    other = (grid.labels != own) & ~(grid.labels[:, :, None] == beside).any(axis=3)
    new = other & ~_list_renamed(scene)[grid.labels, own] & (grid.labels != NOWHERE)
    outside = other.any(axis=2)[group[:, None], seen]
    outside &= outside.cumsum(axis=1) <= OUTSIDE
    ray, step = np.nonzero(outside)
    entry, part = np.nonzero(new[group[ray], seen[ray, step]])
    ray, step = ray[entry], step[entry]
    gained = grid.labels[seen[ray, step], part]
    _, once = np.unique(ray * len(contact_table(scene)) + gained, return_index=True)
    return ray[once], gained[once], np.asarray(away[step[once]])


def _end(scene: Scene, rays: Rays, about: Array) -> Rays:
    """Rays that end right before what they gain touches, near where it is about to."""
    places = np.maximum(about - CLOSER * AROUND_END, 0.0)[:, None]
    end = _find_root(scene, rays, places + CLOSER * np.arange(2 * AROUND_END + 1))
    kept = end > FIRST + BESIDE
    rays, end = rays.pick(kept), end[kept, None]
    before, after = (rays.starts + (end + aside) * rays.ways for aside in (-BESIDE / 2, BESIDE / 2))
    rays = rays._replace(ends=before)
    return rays.pick(_is_inside(scene, rays, end, after))


def _find_root(scene: Scene, rays: Rays, places: Array) -> Array:
    """Where what rays gain first touches, near some places (n, m) [-]; NaN where it does not."""
    gaps, rows = _measure_gaps(scene, rays, places), np.arange(len(places))
    with np.errstate(invalid="ignore"):
        falls = (gaps[:, :-1] > 0) & (gaps[:, 1:] <= 0)
    first = falls.argmax(axis=1)
    near = np.clip(first - 1, 0, places.shape[1] - 4)[:, None] + np.arange(4)
    around = first[:, None] + np.arange(2)
    left, right = np.take_along_axis(places, around, 1).T
    own, values = (np.take_along_axis(part, near, 1) for part in (places, gaps))
    inner = _interpolate(own, values, left, right)
    inner_gap = _measure_gaps(scene, rays, inner[:, None])[:, 0]
    own = np.column_stack([left, inner, right])
    values = np.insert(np.take_along_axis(gaps, around, 1), 1, inner_gap, axis=1)
    left, right = np.where(inner_gap > 0, (inner, right), (left, inner))
    root = _interpolate(own, values, left, right)
    return np.where(falls[rows, first], root, np.nan)


def _measure_gaps(scene: Scene, rays: Rays, places: Array) -> Array:
    """Gaps [m] of what rays gain, with their cells' contacts closed, at places (n, m) [-]."""
    poses = rays.starts[:, None] + places[..., None] * rays.ways[:, None]
    each = np.repeat(np.arange(len(places)), places.shape[1])
    z = place(scene, rays.labels[each], poses.reshape(-1, 2))
    return measure_gap(scene, rays.gained[each], z).reshape(places.shape)


def _interpolate(s: Array, f: Array, left: Array, right: Array) -> Array:
    """Zeros of the inverse polynomials of values (n, m); the middle if they are not in between."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = f[:, None, :] / (f[:, None, :] - f[:, :, None])
        ratios[:, np.arange(s.shape[1]), np.arange(s.shape[1])] = 1.0
        root = (s * ratios.prod(axis=2)).sum(axis=1)
        return np.asarray(np.where((root >= left) & (root <= right), root, (left + right) / 2))


def _is_inside(scene: Scene, rays: Rays, end: Array, after: Array) -> Flags:
    """Whether rays are in their cells up to their ends, and gain what they should right after.

    Next to their ends, which are looked at closely, nothing else is looked for.
    """
    every, grid = np.arange(len(after)), map_labels(scene)
    poses = list_middles(rays.starts, rays.ends)
    away = end * np.minimum(MIDDLES, 1 - MIDDLES)
    unsure = grid.look_up(poses) != grid.find(rays.labels)[:, None]
    row, step = np.nonzero(unsure & (away > SPACING / 2))
    rows = np.concatenate([row, every, every])
    expected = rays.labels[rows]
    part = _list_parts(scene)[rays.gained]
    expected[len(rows) - len(after) + every, part] = rays.gained
    poses = np.concatenate([poses[row, step], rays.ends, after])
    wrong = (label_cells(scene, *poses.T)[:, [0, 2, 4]] != expected).any(axis=1)
    return np.asarray(np.bincount(rows, wrong, len(after)) == 0)


@lru_cache(maxsize=8)
def _list_parts(scene: Scene) -> Numbers:
    """0, 1, 2 for contacts with palm, finger 1 and finger 2, for all of `contact_table`."""
    return np.array([0 if c.finger is None else 1 + c.finger for c in contact_table(scene)])


@lru_cache(maxsize=8)
def _list_renamed(scene: Scene) -> Flags:
    """Whether one contact is another one that has changed its name, for all of `contact_table`."""
    table = contact_table(scene)
    return np.array([[_is_renamed(own, other) for other in table] for own in table])


def _is_renamed(contact: Contact, held: Contact) -> bool:
    """Whether one contact is another one that has changed its name, with no edge lying flush."""
    if contact.finger != held.finger or contact.finger is None:
        return False
    return "tip" in (contact.surface, held.surface) and (
        contact.surface == held.surface or contact.feature == held.feature
    )
