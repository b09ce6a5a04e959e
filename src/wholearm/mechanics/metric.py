"""The metric in which lengths and angles of a configuration compare: angles count as arcs."""

from __future__ import annotations

import numpy as np

from ..common.arrays import Array
from ..scene.model import Scene


def metric_weights(scene: Scene) -> Array:
    """Diagonal of the metric of arc length, shape (5,): 1 for lengths, rho^2 for angles."""
    rho = scene.polygon.gyration_radius
    return np.array([1.0, 1.0, rho**2, rho**2, rho**2])


def measure_speed(scene: Scene, v: Array) -> float:
    """Speed of a velocity, shape (5,), in the metric of curves [m/s]."""
    return float(np.sqrt(metric_weights(scene) @ v**2))
