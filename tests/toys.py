"""Straight lines with simple forces, whose best motions are known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq

from wholearm.common.arrays import Array
from wholearm.geometry.curve import Curve, CurvePoint, Segment
from wholearm.mechanics.dynamics import LAMBDA, A, Directions, PathForces, V
from wholearm.planning import lower_bound
from wholearm.planning.options import PlanOptions
from wholearm.planning.path_domain import path_data, path_motion, path_plan
from wholearm.planning.path_domain.path_motion import PathMotion
from wholearm.planning.path_domain.path_plan import Task, plan_curves
from wholearm.planning.phase_plan import PhasePlan
from wholearm.scene.model import Scales

Law = Callable[[Array, NDArray[np.bool_]], tuple[Array, ...]]
"""Coefficients (Ta, Tl, Tv), each (n, 2), at n arc lengths, before or after the break."""


LIMIT = 2.0
"""Largest torque of a toy [N m]."""


def plan_path(
    curve: Curve, epsilon: float, options: PlanOptions, phase: int, duration: float | None = None
) -> PhasePlan[PathMotion]:
    """The plan of one phase along a curve, from rest to rest."""
    return plan_curves(Task((curve,), epsilon, options, (phase,), duration))[0]


@dataclass(frozen=True)
class Toy:
    """A point on a line with one contact: c_n = squeeze and tau = Ta a + Tl squeeze + Tv v.

    The joints move one radian per metre and are held to `limit` and `speed_limit`.
    """

    law: Law
    length: float = 1.0
    breaks: tuple[float, ...] = ()
    limit: tuple[float, float] = (LIMIT, LIMIT)
    speed_limit: tuple[float, float] = (np.inf, np.inf)
    epsilon: float = 0.05
    rate_limit: tuple[float, float] = (np.inf, np.inf)
    lag: tuple[float, float] = (0.0, 0.0)

    @property
    def curve(self) -> Curve:
        ends = [0.0, *self.breaks, self.length]
        scene = SimpleNamespace(
            gravity=9.81,
            scales=Scales.of(1.0, 2.0, 2.0),
            torque_limit=np.array(self.limit),
            speed_limit=np.array(self.speed_limit),
            torque_rate_limit=np.array(self.rate_limit),
            actuator_lag=np.array(self.lag),
            has_slow_motors=bool(np.isfinite(self.rate_limit).any() or any(self.lag)),
        )
        segments = [
            Segment(start, stop, np.ones(1), np.full(2, float(index)))
            for index, (start, stop) in enumerate(pairwise(ends))
        ]
        formation = SimpleNamespace(
            scene=scene,
            n_contacts=1,
            n_rolling=0,
            n_constraints=1,
            names=("v0-palm",),
            rolling=(),
            rolling_rows=(),
            friction=np.zeros(1),
            sliding_friction=np.zeros(1),
        )
        stub: Any = SimpleNamespace(length=self.length, segments=segments, formation=formation)
        stub.evaluate = _evaluate
        curve: Curve = stub
        return curve

    def plan(self, duration: float | None = None, **options: Any) -> PhasePlan[PathMotion]:
        with self.in_place():
            return plan_path(self.curve, self.epsilon, PlanOptions(**options), 1, duration)

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Let the planner and the lower bound see this toy's forces."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lower_bound, "inverse", self._inverse)
            patch.setattr(path_data, "inverse", self._inverse)
            patch.setattr(path_motion, "inverse", self._inverse)
            patch.setattr(path_data, "reduced_inertia", lambda *_: np.ones(1))
            # A toy has no shape that friction could hold at rest.
            patch.setattr(path_plan, "find_moving_start", lambda *_: None)
            yield

    def _inverse(self, _: Any, point: CurvePoint, directions: Directions) -> PathForces:
        C, T = (np.zeros((len(point.z), count, 5)) for count in (1, 2))
        C[..., LAMBDA] = 1.0
        # The segment's number stands in for the directions of its joints.
        T[..., A], T[..., LAMBDA], T[..., V] = self.law(point.z[:, 0], directions.sigma[:, 0] > 0)
        return PathForces(C, T)


def _evaluate(s: Array) -> CurvePoint:
    z = np.outer(s, [1.0, 0.0, 0.0, 1.0, 1.0])
    kinematics: Any = None
    return CurvePoint(z, np.ones_like(z), 0 * z, kinematics)


def constant(Ta: float, Tl: float = 0.0, Tv: float = 0.0) -> Law:
    """tau_1 = Ta a + Tl squeeze + Tv v; tau_2 the same with the other sign of a and v."""

    def law(s: Array, later: NDArray[np.bool_]) -> tuple[Array, ...]:
        one = np.ones(len(s))
        columns = [(Ta, -Ta), (Tl, Tl), (Tv, -Tv)]
        return tuple(np.column_stack([left * one, right * one]) for left, right in columns)

    return law


def inertia(of: Callable[[Array, NDArray[np.bool_]], Array]) -> Law:
    """tau_1 = inertia a and tau_2 = 0, with an inertia that depends on the place."""

    def law(s: Array, later: NDArray[np.bool_]) -> tuple[Array, ...]:
        flat = np.zeros((len(s), 2))
        return np.column_stack([of(s, later), 0 * s]), flat, flat

    return law


def find_time_viscous(drag: float) -> float:
    """Time of a way of 1 m with v' = F - B v, then v' = -F - B v."""

    def rise(t: float) -> float:
        return LIMIT / drag * (t + math.expm1(-drag * t) / drag)

    def fall(t: float) -> float:
        return LIMIT / drag * (math.expm1(drag * t) / drag - t)

    def brake(t: float) -> float:
        return math.log(1 - math.expm1(-drag * t)) / drag

    start = brentq(lambda t: rise(t) + fall(brake(t)) - 1, 1e-3, 20)
    return float(start + brake(start))


def find_time_growing() -> float:
    """(1 + s) |a| <= F: b is 2 F log(1 + s) from the start, 2 F log(2 / (1 + s)) to the end."""
    switch = math.sqrt(2) - 1

    def slow(u: float, b: float) -> float:
        return 2 * u / math.sqrt(2 * LIMIT * b)

    first = quad(lambda u: slow(u, math.log1p(u * u)), 0, math.sqrt(switch))[0]
    last = quad(lambda u: slow(u, -math.log1p(-u * u / 2)), 0, math.sqrt(1 - switch))[0]
    return float(first + last)
