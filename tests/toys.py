"""Straight lines with simple forces, whose best motions are known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from wholearm import pathplan
from wholearm.dynamics import PathForces
from wholearm.model import Array
from wholearm.options import PlanOptions
from wholearm.path import Curve, Segment
from wholearm.pathdata import KNOTS, LOOKS, PhaseData, Places
from wholearm.pathmotion import Grid
from wholearm.pathplan import PathPlan, plan_path

Law = Callable[[Array, NDArray[np.int64]], tuple[Array, ...]]
"""Coefficients (Ta, Tl, Tv), each (n, 2), at n arc lengths of given segments."""


@dataclass(frozen=True)
class Toy:
    """A point on a line with one contact: c_n = squeeze and tau = Ta a + Tl squeeze + Tv v.

    The joints move at the rates `rates` per metre and are held to `limit` and `speed_limit`.
    """

    law: Law
    length: float = 1.0
    breaks: tuple[float, ...] = ()
    limit: tuple[float, float] = (2.0, 1e3)
    speed_limit: tuple[float, float] = (np.inf, np.inf)
    epsilon: float = 0.05

    @property
    def curve(self) -> Curve:
        ends = [0.0, *self.breaks, self.length]
        scene = SimpleNamespace(
            gravity=9.81,
            torque_limit=np.array(self.limit),
            speed_limit=np.array(self.speed_limit),
        )
        segments = [
            Segment(*pair, np.ones(1), np.ones(2)) for pair in zip(ends[:-1], ends[1:], strict=True)
        ]
        formation = SimpleNamespace(scene=scene, n_contacts=1, names=("v0-palm",))
        stub: Any = SimpleNamespace(length=self.length, segments=segments, formation=formation)
        stub.evaluate = lambda s: SimpleNamespace(z=np.zeros((len(s), 5)) + s[:, None])
        curve: Curve = stub
        return curve

    def places(self, s: Array, segment: NDArray[np.int64]) -> Places:
        none, one = np.zeros((len(s), 1)), np.ones((len(s), 1))
        flat = np.zeros((len(s), 2))
        Ta, Tl, Tv = self.law(s, segment)
        forces = PathForces(none, none, none, one, flat, Ta, flat, Tl, Tv)
        return Places(forces, np.ones((len(s), 2)))

    def prepare(self, curve: Curve, epsilon: float, grid: Grid, phase: int) -> PhaseData:
        solid = np.flatnonzero(grid.steps > 0)

        def inside(fractions: Array) -> Places:
            s = grid.s[solid, None] + fractions * grid.steps[solid, None]
            return self.places(s.ravel(), np.repeat(grid.segment[solid], len(fractions)))

        nodes = self.places(grid.s, grid.segment)
        return PhaseData(curve, epsilon, grid, nodes, inside(KNOTS), inside(LOOKS), solid)

    def plan(self, duration: float | None = None, **options: Any) -> PathPlan:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pathplan, "prepare", self.prepare)
            return plan_path(self.curve, self.epsilon, PlanOptions(**options), 1, duration)


def constant(Ta: float, Tl: float = 0.0, Tv: float = 0.0) -> Law:
    """tau_1 = Ta a + Tl squeeze + Tv v; tau_2 the same with a of the other sign."""

    def law(s: Array, segment: NDArray[np.int64]) -> tuple[Array, ...]:
        one = np.ones(len(s))
        columns = [(Ta, -Ta), (Tl, Tl), (Tv, -Tv)]
        return tuple(np.column_stack([left * one, right * one]) for left, right in columns)

    return law
