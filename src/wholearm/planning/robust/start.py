"""Starts that friction cannot hold, whatever numbers are within their ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...contacts.formation import Formation
from ...mechanics.wedging import StaticTorques, find_static_torques
from ...scene.model import Friction, Scene


class Hold(NamedTuple):
    """What friction can hold at rest: torques times `gains`, shape (2,), within a polygon."""

    static: StaticTorques
    gains: Array

    def measure(self, tau: Array) -> float:
        """How far torques, shape (2,), are beyond it [N m]."""
        return float(self.static.measure((self.gains * tau)[None])[0])


def list_holds(formation: Formation, z: Array, ranges: Mapping[str, float]) -> list[Hold]:
    """What friction can hold at `z`, at the corners of ranges that hold most.

    Those have all the friction that there may be. Polygons grow in proportion to the mass, so that
    torques beyond the same side for the least and the largest are beyond it for all in between.
    """
    fingers = (ranges.get("gain1", 0.0), ranges.get("gain2", 0.0))
    gains = list(product(*(_spread(width) for width in fingers)))
    found = []
    for mass in _spread(ranges.get("mass", 0.0)):
        own = replace(formation, scene=_change(formation.scene, ranges, mass))
        static = find_static_torques([own], z)
        found += [Hold(static, np.array(gain)) for gain in gains]
    return found


def measure_holds(holds: Sequence[Hold], tau: Array) -> float:
    """How far torques are beyond what friction can hold in any corner [N m]."""
    return min(hold.measure(tau) for hold in holds)


def _spread(width: float) -> tuple[float, ...]:
    return (1 - width, 1 + width) if width else (1.0,)


def _change(scene: Scene, ranges: Mapping[str, float], mass: float) -> Scene:
    parts = ("palm", "finger1", "finger2")
    more = {part: 1 + ranges.get(f"friction_{part}", 0.0) for part in parts}
    friction = Friction(**{part: getattr(scene.friction, part) * more[part] for part in parts})
    polygon = replace(scene.polygon, mass=scene.polygon.mass * mass)
    return replace(scene, polygon=polygon, friction=friction)
