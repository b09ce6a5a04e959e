"""Cutting curves of the (x, phi) plane where what touches changes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..common.arrays import Array
from ..contacts.closing import Flags, Numbers
from .borders import NOWHERE, Piece, Track, Window

PARTS, DIVISIONS = 16, 13
"""An interval in which the label changes is cut into so many parts, so often: to rounding."""
CROWDED = 8
"""Most changes that are told apart between two neighbouring places."""

_Label = Callable[[Array], Numbers]


def cut(track: Track, window: Window | None = None) -> list[Piece]:
    """Cut a track into pieces with one label each, in the order of its parameter.

    Parameters
    ----------
    track : Track
    window : Window, optional
        Leave out what is outside of it.
    """

    def label(places: Array) -> Numbers:
        x, phi = track.pose(places)
        inside = np.isfinite(x)
        if window is not None:
            inside &= (x >= window.x[0]) & (x <= window.x[1])
        labels = np.full((len(places), 6), NOWHERE)
        if inside.any():
            labels[inside] = track.label(x[inside], phi[inside])
        return labels

    places = track.places
    labels = label(places)
    if (labels == NOWHERE).all():
        return []
    pieces, start, held = [], float(places[0]), labels[0]
    for before, after, following in _find_changes(label, places, labels):
        pieces.append((start, before, held))
        start, held = after, following
    pieces.append((start, float(places[-1]), held))
    return [
        Piece(track, _fill(track, low, high), own)
        for low, high, own in pieces
        if own[0] != NOWHERE and high > low
    ]


def _find_changes(
    label: _Label, places: Array, labels: Numbers
) -> list[tuple[float, float, Numbers]]:
    """Where the label changes: the last place with the old one, the first with the new, the new."""
    changed = np.flatnonzero(_differ(labels[1:], labels[:-1]))
    low, high, old, last = (
        places[changed],
        places[changed + 1],
        labels[changed],
        labels[changed + 1],
    )
    found = []
    for _ in range(CROWDED):
        if not len(low):
            break
        stop = high
        for _ in range(DIVISIONS):
            inner = low[:, None] + (high - low)[:, None] * np.arange(1, PARTS) / PARTS
            seen = label(inner.ravel()).reshape(*inner.shape, -1)
            same = (seen == old[:, None]).all(axis=2)
            first = np.where(same.all(axis=1), PARTS - 1, same.argmin(axis=1))
            every = np.column_stack([low, inner, high])
            rows = np.arange(len(every))
            low, high = every[rows, first], every[rows, first + 1]
        new = label(high)
        found += list(zip(low.tolist(), high.tolist(), new, strict=True))
        # A second change may hide behind the first.
        more = _differ(new, last) & (high < stop)
        low, high, old, last = high[more], stop[more], new[more], last[more]
    return sorted(found, key=lambda change: change[0])


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
