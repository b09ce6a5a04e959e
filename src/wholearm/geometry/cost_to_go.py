"""Cost-to-go of the phases after a block, as a function of where the block ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..common.arrays import Array
from ..mechanics.metric import metric_weights
from ..problem.definition import Phase
from .tracing import trace_phase

_STEP = 1e-2  # step of the difference quotient, over the length of the curve that follows


@dataclass(frozen=True, eq=False)
class CostToGo:
    """The cost of the phases that follow, the first of them with one freedom."""

    phase: Phase  # the first of them. Its curve is where the motion before it may end.
    # their least cost from a configuration z, shape (5,). Raises a `WholearmError` without a plan
    # from there.
    value: Callable[[Array], float]

    def expand(self, z: Array) -> tuple[float, Array]:
        """The cost from `z`, shape (5,), and its gradient along the curve, shape (5,)."""
        curve = trace_phase(self.phase, z)
        step = _STEP * curve.length
        point = curve.evaluate(np.array([0.0, step]))
        here, ahead = (self.value(place) for place in point.z)
        slope = (ahead - here) / step
        return here, slope * metric_weights(self.phase.formation.scene) * point.z_s[0]
