"""Cutting curves of the (x, phi) plane where what touches changes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Closed, Flags, Numbers, close_fingers
from ..scene.model import Scene
from .borders import NOWHERE, Piece, Track, Window

PARTS, DIVISIONS = 16, 13
"""An interval in which the label changes is cut into so many parts, so often: to rounding."""
CROWDED = 8
"""Most changes that are told apart between two neighbouring places."""


class _Tracks(NamedTuple):
    """Tracks that are looked at together: closing fingers at few poses takes as long as at many."""

    scene: Scene
    tracks: Sequence[Track]
    window: Window | None

    def label(self, owners: Numbers, places: Array) -> Numbers:
        """Labels, shape (n, 6), of places on tracks; the tracks' indices `owners` increase."""
        x, phi = np.empty((2, len(places)))
        groups = [slice(a, b) for a, b in pairwise(np.searchsorted(owners, _list_ends(owners)))]
        for own in groups:
            x[own], phi[own] = self.tracks[owners[own.start]].pose(places[own])
        inside = np.isfinite(x)
        if self.window is not None:
            inside &= (x >= self.window.x[0]) & (x <= self.window.x[1])
        labels = np.full((len(places), 6), NOWHERE)
        closed = close_fingers(self.scene, x[inside], phi[inside])
        rows = np.cumsum(inside) - 1
        for own in groups:
            (within,) = np.nonzero(inside[own])
            if len(within):
                at = own.start + within
                part = Closed(*(values[rows[at]] for values in closed))
                labels[at] = self.tracks[owners[own.start]].label(x[at], phi[at], part)
        return labels


def cut(scene: Scene, tracks: Sequence[Track], window: Window | None = None) -> list[Piece]:
    """Cut tracks into pieces with one label each, in the order of tracks and their parameters.

    Parameters
    ----------
    scene : Scene
    tracks : sequence of Track
    window : Window, optional
        Leave out what is outside of it.
    """
    every = _Tracks(scene, tracks, window)
    sizes = [len(track.places) for track in tracks]
    owners = np.repeat(np.arange(len(tracks)), sizes)
    places = np.concatenate([track.places for track in tracks]) if tracks else np.empty(0)
    labels = every.label(owners, places)
    changes = _find_changes(every, owners, places, labels)
    pieces, first = [], 0
    for index, (track, size) in enumerate(zip(tracks, sizes, strict=True)):
        own, first = slice(first, first + size), first + size
        if (labels[own] == NOWHERE).all():
            continue
        start, held = float(places[own][0]), labels[own][0]
        parts = []
        for before, after, following in changes.get(index, ()):
            parts.append((start, before, held))
            start, held = after, following
        parts.append((start, float(places[own][-1]), held))
        pieces += [
            Piece(track, _fill(track, low, high), label)
            for low, high, label in parts
            if label[0] != NOWHERE and high > low
        ]
    return pieces


def _list_ends(owners: Numbers) -> Numbers:
    """Each owner once, and one beyond the last."""
    return np.append(
        owners[np.flatnonzero(np.diff(owners, prepend=-1))], np.iinfo(owners.dtype).max
    )


def _find_changes(
    every: _Tracks, owners: Numbers, places: Array, labels: Numbers
) -> dict[int, list[tuple[float, float, Numbers]]]:
    """Where labels change, by track, in the order of its parameter.

    The last place with the old one, the first with the new, and the new.
    """
    within = owners[1:] == owners[:-1]
    changed = np.flatnonzero(_differ(labels[1:], labels[:-1]) & within)
    low, high, old, last = (
        places[changed],
        places[changed + 1],
        labels[changed],
        labels[changed + 1],
    )
    owner = owners[changed]
    found: dict[int, list[tuple[float, float, Numbers]]] = {}
    for _ in range(CROWDED):
        if not len(low):
            break
        stop = high
        for _ in range(DIVISIONS):
            inner = low[:, None] + (high - low)[:, None] * np.arange(1, PARTS) / PARTS
            seen = every.label(np.repeat(owner, PARTS - 1), inner.ravel())
            same = (seen.reshape(*inner.shape, -1) == old[:, None]).all(axis=2)
            first = np.where(same.all(axis=1), PARTS - 1, same.argmin(axis=1))
            ends = np.column_stack([low, inner, high])
            rows = np.arange(len(ends))
            low, high = ends[rows, first], ends[rows, first + 1]
        new = every.label(owner, high)
        for index, change in zip(
            owner.tolist(), zip(low.tolist(), high.tolist(), new, strict=True), strict=True
        ):
            found.setdefault(index, []).append(change)
        # A second change may hide behind the first.
        more = _differ(new, last) & (high < stop)
        low, high, old, last = high[more], stop[more], new[more], last[more]
        owner = owner[more]
    return {index: sorted(own, key=lambda change: change[0]) for index, own in found.items()}


def _differ(labels: Numbers, others: Numbers) -> Flags:
    return np.asarray((labels != others).any(axis=1))


def _fill(track: Track, low: float, high: float) -> Array:
    """Places from `low` to `high`, close enough together to draw the curve."""
    inner = track.places[(track.places > low) & (track.places < high)]
    places = np.array([low, *inner, high])
    for _ in range(8):
        wide = np.flatnonzero(np.abs(np.diff(track.pose(places)[0])) > track.step)
        if not len(wide):
            break
        places = np.sort(np.append(places, (places[wide] + places[wide + 1]) / 2))
    return places
