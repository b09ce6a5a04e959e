"""Motion limits, low <= rows (c, tau, theta') <= high: contact forces, torques and joint speeds.

`README.md` lists them. A further limit is one function in `MAKERS`: planners, checks between
nodes, tightening and advice use a `LimitSet`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.arrays import Array, Numbers
from ..common.errors import Parameter
from ..contacts.formation import Formation

PRESS, CONE, TORQUE, SPEED = "press", "cone", "torque", "speed"
"""Kinds of limits: least normal forces, friction cones, torques and speeds of the joints."""
EPSILON = "epsilon"  # key of the least normal force


@dataclass(frozen=True, eq=False)
class MotionLimit:
    """One limit, low <= rows y <= high, with y = (c, tau, theta')."""

    kind: str  # key for selection from a `LimitSet`
    part: str  # the contact or finger
    text: str  # the limit in words, with its value
    unit: str  # of its rows
    rows: Array  # (r, n_c + R + 4)
    low: Array  # low, high (r,): bounds, infinite if there is none
    high: Array
    scale: float  # unit of shortfalls
    parameter: Parameter  # the number whose change relaxes the limit
    weight: Array  # (r,): relaxation of the bounds per unit of the parameter


@dataclass(frozen=True, eq=False)
class LimitSet:
    """Limits with stacked rows, selected by kind."""

    limits: tuple[MotionLimit, ...]

    @cached_property
    def rows(self) -> Array:
        """Rows of all limits, shape (m, n_c + R + 4)."""
        return np.vstack([limit.rows for limit in self.limits])

    @cached_property
    def low(self) -> Array:
        """Lower bounds, shape (m,)."""
        return np.concatenate([limit.low for limit in self.limits])

    @cached_property
    def high(self) -> Array:
        """Upper bounds, shape (m,)."""
        return np.concatenate([limit.high for limit in self.limits])

    @cached_property
    def owners(self) -> Numbers:
        """Index of the limit of each row, shape (m,)."""
        return np.repeat(np.arange(len(self.limits)), [len(limit.low) for limit in self.limits])

    @cached_property
    def scales(self) -> Array:
        """Units of the shortfalls of each row, shape (m,)."""
        return np.array([self.limits[k].scale for k in self.owners])

    @cached_property
    def sides(self) -> tuple[Numbers, Array, Array]:
        """Rows, signs, bounds (n,) of one-sided limits, sign (row y - bound) >= 0; lower first."""
        lows, highs = (np.flatnonzero(np.isfinite(bound)) for bound in (self.low, self.high))
        signs = np.repeat([1.0, -1.0], [len(lows), len(highs)])
        bounds = np.concatenate([self.low[lows], self.high[highs]])
        return np.concatenate([lows, highs]), signs, bounds

    @cached_property
    def side_scales(self) -> Array:
        """Units of the shortfalls of one-sided limits, shape (n,)."""
        return np.asarray(self.scales[self.sides[0]])

    def of(self, *kinds: str) -> Numbers:
        """Rows of the limits of some kinds."""
        return np.flatnonzero([self.limits[k].kind in kinds for k in self.owners])

    def only(self, *kinds: str) -> LimitSet:
        """The limits of some kinds."""
        return LimitSet(tuple(limit for limit in self.limits if limit.kind in kinds))

    def without(self, *kinds: str) -> LimitSet:
        """The limits of other kinds."""
        return LimitSet(tuple(limit for limit in self.limits if limit.kind not in kinds))

    def split(self, last: int) -> tuple[LimitSet, LimitSet]:
        """The limits that depend on columns before the `last` ones, and the others.

        The last two columns are joint speeds, the two before them torques.
        """
        dependent = [limit for limit in self.limits if limit.rows[:, :-last].any()]
        others = [limit for limit in self.limits if limit not in dependent]
        return LimitSet(tuple(dependent)), LimitSet(tuple(others))

    def weigh(self, key: str) -> Array:
        """Relaxation of the bounds of each row per unit of a parameter, shape (m,)."""
        weights = [(limit.parameter.key == key) * limit.weight for limit in self.limits]
        return np.concatenate(weights)

    def find_slack(self, values: Array) -> Array:
        """Slack of one-sided limits, shape (..., n), from rows y, (..., m)."""
        rows, signs, bounds = self.sides
        return np.asarray(signs * (values[..., rows] - bounds))

    def find_slack_rows(self, values: Array) -> Array:
        """Coefficients of `find_slack`, (..., n, k), from those of rows y, (..., m, k): 1 first."""
        rows, signs, bounds = self.sides
        slack = signs[:, None] * values[..., rows, :]
        slack[..., 0] -= signs * bounds
        return np.asarray(slack)

    def fold(self, values: Array) -> Array:
        """Largest value of the one or two sides of each row, shape (..., m), from (..., n)."""
        largest = np.full((*values.shape[:-1], len(self.low)), -np.inf)
        for k, row in enumerate(self.sides[0]):
            largest[..., row] = np.maximum(largest[..., row], values[..., k])
        return largest

    def list_violated(self, values: Array, tol: float) -> Iterator[tuple[MotionLimit, float, int]]:
        """Limits that rows y, (n, m), violate by `tol` of their scale; the amount and the row."""
        violation, owners = -self.find_slack(values), self.owners[self.sides[0]]
        for k, limit in enumerate(self.limits):
            amounts = violation[:, owners == k].max(axis=1, initial=-np.inf)
            worst = int(amounts.argmax())
            if amounts[worst] > tol * limit.scale:
                yield limit, float(amounts[worst]), worst

    @property
    def parameters(self) -> list[Parameter]:
        """Parameters whose change relaxes limits, each once, those of fingers first."""
        parameters = {limit.parameter.key: limit.parameter for limit in self.limits}
        return sorted(
            parameters.values(), key=lambda parameter: not parameter.key.startswith("finger")
        )


Maker = Callable[[Formation, float], Sequence[MotionLimit]]
"""Makes limits of a formation and epsilon [N]."""


def make_limits(formation: Formation, epsilon: float) -> LimitSet:
    """Make the limits of a formation and a least normal force [N]."""
    limits = [limit for maker in MAKERS for limit in maker(formation, epsilon)]
    return LimitSet(tuple(limit for limit in limits if len(limit.low)))


def _make_force_limits(formation: Formation, epsilon: float) -> list[MotionLimit]:
    """Limits of normal forces, and friction cones of rolling contacts."""
    parameter = Parameter(EPSILON, epsilon, "N", -1, EPSILON)
    force, n_c, R = formation.scene.scales.force, formation.n_contacts, formation.n_rolling
    H = force_limit_rows(formation)
    H = np.hstack([H, np.zeros((len(H), 4))])

    def make(kind: str, part: str, text: str, rows: Array, weight: Array) -> MotionLimit:
        low, high = epsilon * weight, np.full(len(rows), np.inf)
        return MotionLimit(kind, part, text, "N", rows, low, high, force, parameter, weight)

    bound_text = f"epsilon = {epsilon:g} N"
    limits = [
        make(PRESS, name, f"c_n of {name} >= {bound_text}", H[k : k + 1], np.ones(1))
        for k, name in enumerate(formation.names)
    ]
    for k, row in enumerate(formation.rolling_rows):
        mu, name = formation.friction[row], formation.names[row]
        text = f"friction cone of {name}, |c_t| <= {mu:g} (c_n - {epsilon:g} N),"
        limits.append(make(CONE, name, text, H[[n_c + k, n_c + R + k]], np.full(2, mu)))
    return limits


def _make_joint_limits(formation: Formation, _: float) -> list[MotionLimit]:
    """Finite limits of torques and speeds of the joints."""
    scene, width = formation.scene, formation.n_contacts + formation.n_rolling + 4
    joint_limits = []
    for kind, unit, first, limits in (
        (TORQUE, "N m", width - 4, scene.torque_limit),
        (SPEED, "rad/s", width - 2, scene.speed_limit),
    ):
        for k, limit in enumerate(limits.tolist()):
            if not np.isfinite(limit):
                continue
            part, key = f"finger {k + 1}", f"fingers.{k + 1}.{kind}_limit"
            name = f"{kind} limit of {part}"
            parameter = Parameter(name, limit, unit, 1, key)
            rows, high = np.eye(width)[[first + k]], np.array([limit])
            text = f"{name} = {limit:g} {unit}"
            joint_limits.append(
                MotionLimit(kind, part, text, unit, rows, -high, high, limit, parameter, np.ones(1))
            )
    return joint_limits


MAKERS: list[Maker] = [_make_force_limits, _make_joint_limits]
"""Functions that make the limits of a formation."""


def force_limit_rows(formation: Formation) -> Array:
    """H, shape (n_c + 2 R, n_c + R): every c_n, then both sides of every rolling contact's cone."""
    unit = np.eye(formation.n_constraints)
    normal, tangential = unit[: formation.n_contacts], unit[formation.n_contacts :]
    rolling = list(formation.rolling_rows)
    edge = formation.friction[rolling, None] * normal[rolling]
    return np.vstack([normal, edge - tangential, edge + tangential])
