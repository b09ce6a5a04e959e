"""Borders of the cells of the (x, phi) plane, where four contacts touch.

With the vertex v_p on the palm, y is a function of phi, and every border is an explicit curve:

* an edge flush on the palm: phi is the edge's flush angle;
* edge j flush on a link: the joint is `radius` outside the edge's line, linear in x;
* a vertex passing from the side of a link to its tip: abs(p - base)^2 = length^2 + radius^2;
* the tip passing from a vertex to an edge: abs(p + radius m - base) = length, m the edge's outward
  normal. With a pointed tip this curve and the one before coincide: the tip is at the vertex.

Each curve is sampled, the samples are labelled with the touching contacts, and changes of the label
are found by multisection. Pieces with a valid label are borders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product

import numpy as np

from ..common.arrays import Array, Flags, Numbers
from ..contacts.closing import ClosedFinger, close_fingers, first_contact, lower, place_corners
from ..contacts.elemental import Contact
from ..scene.model import Scene

PARTS = 16  # parts of an interval in a step of the multisection
LONGEST = 0.06  # longest step in x between points of a border, in radii of gyration
NOWHERE = -1  # label of places that are no border


@dataclass(frozen=True, eq=False)
class Window:
    """A part of the (x, phi) plane: low and high of `x` [m] and `phi` [rad]."""

    x: tuple[float, float]
    phi: tuple[float, float]

    def bands(self, scene: Scene) -> list[tuple[float, float, int]]:
        """Ranges of phi with one vertex on the palm: low, high, vertex."""
        ends = [self.phi[0], *(phi for phi, _ in self.flush_angles(scene)), self.phi[1]]
        middles = np.array([(a + b) / 2 for a, b in pairwise(ends)])
        vertices = lower(scene, middles)[1]
        bands = zip(ends[:-1], ends[1:], vertices.tolist(), strict=True)
        return [band for band in bands if band[1] > band[0]]

    def flush_angles(self, scene: Scene) -> list[tuple[float, int]]:
        """Angles inside the window at which an edge lies on the palm, increasing, and the edge."""
        angles = []
        for edge in range(scene.polygon.n_vertices):
            angle = scene.polygon.flush_angle(edge)
            counts = np.arange(np.ceil((self.phi[0] - angle) / (2 * np.pi)), 1e3)
            inside = angle + 2 * np.pi * counts
            inside = inside[(inside > self.phi[0]) & (inside < self.phi[1])]
            angles += [(float(value), edge) for value in inside]
        return sorted(angles)


@dataclass(frozen=True, eq=False)
class Track:
    """A curve in the (x, phi) plane on which a border may lie."""

    # parameter of shape (n,) to (x, phi), each of shape (n,), NaN if there is none
    pose: Callable[[Array], tuple[Array, Array]]
    # (x, phi) and the hand closed there to labels, shape (n, 6): indices of two contacts each of
    # palm, finger 1 and finger 2; `NOWHERE` for a missing second one, or if there is no border
    label: Callable[[Array, Array, ClosedFinger], Numbers]
    places: Array  # (n,): parameters to sample at, increasing
    # the finger (None for the palm) and its flush edge; None if a contact changes its name
    flush: tuple[int | None, int] | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of a track with one set of contacts."""

    track: Track
    places: Array  # (n,): parameters of its points, increasing, ends included
    label: Numbers  # (6,)


def label_cells(scene: Scene, poses: Array) -> Numbers:
    """Labels at poses (x, phi) inside cells, shape (..., 3); `NOWHERE` if the hand cannot close."""
    labels = label_inside(scene, close_fingers(scene, *poses.reshape(-1, 2).T))
    return labels[:, [0, 2, 4]].reshape(*poses.shape[:-1], 3)


def label_inside(scene: Scene, closed: ClosedFinger) -> Numbers:
    """Labels of closed poses inside cells, shape (n, 6)."""
    return label_closed(closed, lower(scene, closed.z[:, 2])[1])


def label_closed(closed: ClosedFinger, vertex: int | Numbers) -> Numbers:
    """Labels of closed poses with `vertex` on the palm, shape (n, 6)."""
    labels = np.full((len(closed.z), 6), NOWHERE)
    labels[:, 0] = vertex
    labels[:, [2, 4]] = closed.contacts
    labels[(closed.obstacle != 0).any(axis=1)] = NOWHERE
    return labels


def list_tracks(scene: Scene, window: Window, samples: int) -> Iterator[Track]:
    """All curves of the window on which a border may lie, with about `samples` places each."""
    for phi, edge in window.flush_angles(scene):
        yield palm_track(scene, edge, phi, np.linspace(*window.x, samples))
    height = window.phi[1] - window.phi[0]
    count = scene.polygon.n_vertices
    for low, high, vertex in window.bands(scene):
        places = np.linspace(low, high, max(3, round(samples * (high - low) / height)))
        for finger, index in product((0, 1), range(count)):
            yield flush_track(scene, finger, index, vertex, places)
            edges = ((index - 1) % count, index) if scene.fingers[finger].radius > 0 else ()
            for branch, edge in product((-1.0, 1.0), (None, *edges)):
                yield _circle_track(scene, finger, index, edge, branch, vertex, places)


def palm_track(scene: Scene, edge: int, phi: float, places: Array) -> Track:
    """The line on which `edge` lies flush on the palm, by x [m]."""
    next_vertex = (edge + 1) % scene.polygon.n_vertices

    def pose(x: Array) -> tuple[Array, Array]:
        return x, np.full_like(x, phi)

    def label(x: Array, phi: Array, closed: ClosedFinger) -> Numbers:
        labels = label_closed(closed, edge)
        labels[labels[:, 0] != NOWHERE, 1] = next_vertex
        return labels

    return Track(pose, label, places, (None, edge))


def flush_track(scene: Scene, finger: int, edge: int, vertex: int, places: Array) -> Track:
    """The curve on which `edge` lies flush on a link with `vertex` on the palm, by phi [rad]."""
    link, base = scene.fingers[finger], np.asarray(scene.fingers[finger].base)
    count = scene.polygon.n_vertices
    after = (edge + 1) % count
    near, far = (edge, after) if finger == 0 else (after, edge)
    first = first_contact(scene, finger)

    def pose(phi: Array) -> tuple[Array, Array]:
        (corner,), m = _corners_at(scene, phi, vertex, edge), _outward(scene, edge, phi)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = (link.radius - m[:, 1] * (base[1] - corner[:, 1])) / m[:, 0]
        return base[0] - corner[:, 0] - offset, phi

    def label(x: Array, phi: Array, closed: ClosedFinger) -> Numbers:
        corners, m = _corners_at(scene, phi, vertex, near, far), _outward(scene, edge, phi)
        corners[..., 0] += x
        axis = (1.0 if finger == 0 else -1.0) * np.column_stack([-m[:, 1], m[:, 0]])
        near_position, far_position = ((corners - base) * axis).sum(axis=2)
        possible = (near_position > 0) & (near_position <= link.length)
        # The edge lies on the link up to its far vertex or up to the tip.
        ends = [first + edge, first + after], [first + near, first + count + edge]
        pair = np.where((far_position <= link.length)[:, None], *ends)
        angle = np.arctan2(axis[:, 1], axis[:, 0])
        return _label_pair(closed, vertex, finger, angle, pair, possible)

    return Track(pose, label, places, (finger, edge))


def _circle_track(
    scene: Scene,
    finger: int,
    index: int,
    edge: int | None,
    branch: float,
    vertex: int,
    places: Array,
) -> Track:
    """Vertex `index` at the end of a link's side, or (with an edge) at an end of that edge."""
    link, base = scene.fingers[finger], np.asarray(scene.fingers[finger].base)
    count, first = scene.polygon.n_vertices, first_contact(scene, finger)
    side, arc = first + index, first + 2 * count + index
    distance = np.hypot(link.length, link.radius) if edge is None else link.length

    def centre(phi: Array) -> Array:
        (corner,) = _corners_at(scene, phi, vertex, index)
        offset = 0.0 if edge is None else link.radius * _outward(scene, edge, phi)
        return np.asarray(corner + offset)

    def pose(phi: Array) -> tuple[Array, Array]:
        position = centre(phi)
        with np.errstate(invalid="ignore"):
            half_chord = np.sqrt(distance**2 - (position[:, 1] - base[1]) ** 2)
        return base[0] - position[:, 0] + branch * half_chord, phi

    def label(x: Array, phi: Array, closed: ClosedFinger) -> Numbers:
        position = centre(phi) + np.column_stack([x, np.zeros_like(x)]) - base
        angle = np.arctan2(position[:, 1], position[:, 0])
        sign = 1.0 if finger == 0 else -1.0
        if edge is None:
            angle = angle - sign * np.arctan2(link.radius, link.length)
            inwards = sign * np.column_stack([-np.sin(angle), np.cos(angle)])
            # All vertices are on one side of a line through a vertex if its neighbours are.
            neighbours = (index - 1) % count, (index + 1) % count
            corner, *others = _corners_at(scene, phi, vertex, index, *neighbours)
            distances = [((other - corner) * inwards).sum(axis=1) for other in others]
            supported = np.minimum(*distances) > -3e-11 * scene.scales.length
            pair = np.array([side, arc])
        else:
            axis = np.column_stack([np.cos(angle), np.sin(angle)])
            # The tip touches beyond its centre, and with the side that moves when it closes.
            m = _outward(scene, edge, phi)
            supported = (m * axis).sum(axis=1) <= 0
            supported &= sign * (m[:, 1] * axis[:, 0] - m[:, 0] * axis[:, 1]) <= 0
            pair = np.array([arc, first + count + edge])
        if link.radius == 0:
            shift = 3e-8 * scene.scales.length
            pairs = [close_fingers(scene, x + d, phi).contacts[:, finger] for d in (-shift, shift)]
            pair = np.sort(np.column_stack(pairs), axis=1)
            adjacent = np.isin(pair, [side, *(first + count + (index - k) % count for k in (0, 1))])
            supported = adjacent.all(axis=1) & (pair[:, 0] != pair[:, 1])
        return _label_pair(closed, vertex, finger, angle, pair, supported)

    return Track(pose, label, places)


def _corners_at(scene: Scene, phi: Array, vertex: int, *vertices: int) -> Array:
    """World vertices with `vertex` on the palm and the centroid at x = 0, shape (m, n, 2) [m]."""
    corner = scene.polygon.vertices[vertex]
    y = -(np.sin(phi) * corner[0] + np.cos(phi) * corner[1])
    return np.stack(place_corners(scene, 0 * phi, y, phi, np.array(vertices)[:, None]), axis=-1)


def _outward(scene: Scene, edge: int, phi: Array) -> Array:
    """Outward normal of an edge in the world, shape (n, 2)."""
    body = scene.polygon.vertices
    direction = body[(edge + 1) % len(body)] - body[edge]
    heading = np.arctan2(-direction[0], direction[1]) + phi
    return np.column_stack([np.cos(heading), np.sin(heading)])


def _label_pair(
    closed: ClosedFinger, vertex: int, finger: int, angle: Array, pair: Numbers, possible: Flags
) -> Numbers:
    """Labels of poses where a closed finger at `angle` touches a pair of contacts."""
    with np.errstate(invalid="ignore"):
        deviation = np.abs(np.mod(closed.z[:, 3 + finger] - angle + np.pi, 2 * np.pi) - np.pi)
        touches = (closed.contacts[:, [finger]] == pair).any(axis=1)
        # At the ends of a link angles are less accurate.
        possible = possible & ((deviation < 1e-11) | (touches & (deviation < 1e-7)))
    labels = label_closed(closed, vertex)
    labels[:, [2 + 2 * finger, 3 + 2 * finger]] = pair
    labels[~possible | (labels[:, 0] == NOWHERE)] = NOWHERE
    return labels


def name_contacts(table: tuple[Contact, ...], label: Numbers) -> tuple[Contact, ...]:
    """The contacts of one label."""
    return tuple(table[int(index)] for index in label if index != NOWHERE)


def _label(
    scene: Scene, tracks: Sequence[Track], window: Window | None, owners: Numbers, places: Array
) -> Numbers:
    """Labels, (n, 6), of places on tracks, all at once; the tracks' indices `owners` increase."""
    x, phi = np.empty((2, len(places)))
    starts = np.flatnonzero(np.diff(owners, prepend=-1)).tolist()
    groups = [slice(a, b) for a, b in pairwise([*starts, len(owners)])]
    for group in groups:
        x[group], phi[group] = tracks[owners[group.start]].pose(places[group])
    inside = np.isfinite(x)
    if window is not None:
        inside &= (x >= window.x[0]) & (x <= window.x[1])
    labels = np.full((len(places), 6), NOWHERE)
    closed = close_fingers(scene, x[inside], phi[inside])
    rows = np.cumsum(inside) - 1
    for group in groups:
        (columns,) = np.nonzero(inside[group])
        if len(columns):
            indices = group.start + columns
            part = ClosedFinger(*(values[rows[indices]] for values in closed))
            labels[indices] = tracks[owners[group.start]].label(x[indices], phi[indices], part)
    return labels


def cut(scene: Scene, tracks: Sequence[Track], window: Window | None = None) -> list[Piece]:
    """Cut tracks into pieces with one label each, by multisection; only those in the window."""
    label_places = partial(_label, scene, tracks, window)
    owners = np.repeat(np.arange(len(tracks)), [len(track.places) for track in tracks])
    places = np.concatenate([track.places for track in tracks]) if tracks else np.empty(0)
    labels = label_places(owners, places)
    firsts, lasts = np.diff(owners, prepend=-1) > 0, np.diff(owners, append=len(tracks)) > 0
    # Pieces begin and end at the ends of tracks, and on both sides of changes of labels.
    starts = [(owners[firsts], places[firsts], labels[firsts])]
    stops = [(owners[lasts], places[lasts])]
    changed = np.flatnonzero((labels[1:] != labels[:-1]).any(axis=1) & ~firsts[1:])
    low, high, owner = places[changed], places[changed + 1], owners[changed]
    old, last = labels[changed], labels[changed + 1]
    # At most eight changes between two neighbouring places.
    for _ in range(8):
        if not len(low):
            break
        stop = high
        for _ in range(13):
            inner = low[:, None] + (high - low)[:, None] * np.arange(1, PARTS) / PARTS
            inner_labels = label_places(np.repeat(owner, PARTS - 1), inner.ravel())
            same = (inner_labels.reshape(*inner.shape, -1) == old[:, None]).all(axis=2)
            first = np.where(same.all(axis=1), PARTS - 1, same.argmin(axis=1))
            ends = np.column_stack([low, inner, high])
            rows = np.arange(len(ends))
            low, high = ends[rows, first], ends[rows, first + 1]
        new = label_places(owner, high)
        starts.append((owner, high, new))
        stops.append((owner, low))
        # A second change may hide behind the first.
        unfinished = (new != last).any(axis=1) & (high < stop)
        low, high, old, last = high[unfinished], stop[unfinished], new[unfinished], last[unfinished]
        owner = owner[unfinished]
    indices, start, codes = (np.concatenate(column) for column in zip(*starts, strict=True))
    stop_owners, stop = (np.concatenate(column) for column in zip(*stops, strict=True))
    order, step = np.lexsort((start, indices)), LONGEST * scene.scales.length
    ends = np.column_stack([start[order], stop[np.lexsort((stop, stop_owners))]])
    return [
        Piece(tracks[k], _fill(tracks[k], low, high, step), label)
        for k, (low, high), label in zip(indices[order], ends.tolist(), codes[order], strict=True)
        if label[0] != NOWHERE and high > low
    ]


def _fill(track: Track, low: float, high: float, step: float) -> Array:
    """Places from `low` to `high` with steps in x of at most `step` [m], to draw the curve."""
    places = np.array([low, *track.places[(track.places > low) & (track.places < high)], high])
    for _ in range(8):
        long_steps = np.flatnonzero(np.abs(np.diff(track.pose(places)[0])) > step)
        if not len(long_steps):
            break
        places = np.sort(np.append(places, (places[long_steps] + places[long_steps + 1]) / 2))
    return places
