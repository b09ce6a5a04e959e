"""Where a hand can close on an object that lies at an angle."""

from __future__ import annotations

import math

import numpy as np

from ..scene.model import Scene
from .closing import close_fingers

_PLACES = 1000
"""Places along x that are tried."""


def name_reach(scene: Scene, phi: float) -> str:
    """For which x [m] both fingers close, and not into each other, as part of a message."""
    size = float(np.hypot(*scene.polygon.vertices.T).max())
    reach = [size + finger.length + finger.radius for finger in scene.fingers]
    bases = [float(np.asarray(finger.base)[0]) for finger in scene.fingers]
    low = max(base - own for base, own in zip(bases, reach, strict=True))
    high = min(base + own for base, own in zip(bases, reach, strict=True))
    x = np.linspace(low, max(low, high), _PLACES)
    closes = (close_fingers(scene, x, np.full(len(x), phi)).obstacle == 0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], closes.astype(int), [0]])))
    spans = [
        _round(float(x[first]), float(x[end - 1]))
        for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        if end - first > 1
    ]
    if not spans:
        return "at that angle the hand closes at no x"
    every = " and ".join(f"from {first:g} to {last:g}" for first, last in spans)
    return f"at that angle the hand closes for x {every}"


def _round(low: float, high: float) -> tuple[float, float]:
    """Ends of a span in few digits, inside of it."""
    digits = 2 - math.floor(math.log10(high - low))
    step = 10.0**-digits
    return round(math.ceil(low / step) * step, digits), round(
        math.floor(high / step) * step, digits
    )
