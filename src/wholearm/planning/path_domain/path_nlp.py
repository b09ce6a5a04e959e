"""The planning NLP in the path domain: building, parameters, bounds, packing.

`terms` has its expressions. Built once for some contacts, intervals and an objective, it serves
every phase: grid, coefficients and limits are its parameters and bounds.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import Array, Expression
from ...common.errors import Parameter
from ...mechanics.dynamics import LAMBDA, ONE, A, B, V
from ...mechanics.limits import LimitSet
from ...solvers.ipopt import SolverStatistics, book, build_solver
from ..options import Objective
from .elements import Grid, Profile, follow
from .path_data import PhaseData
from .terms import CHAINED, LEAST_B, SOFT, LimitShape, NLPColumns, list_columns, write_terms

if TYPE_CHECKING:
    from .unique_start import SureStart

_MU, _INSIDE = 1e-4, 1e-3  # complementarity of first multipliers, and the least slack in it


class Units(NamedTuple):
    """Units of the NLP, in which its numbers are near 1 whatever the scene's size and mass are."""

    length: float  # [m]
    time: float  # [s]
    force: float  # [N]
    torque: Array  # (2,) [N m]: of each joint
    power: float  # [(N m)^2]: of the effort's integrand
    press: float  # [N]: typical internal force, in the regularization

    @property
    def profile(self) -> Array:
        """Units of (b, a, internal force), shape (3,)."""
        speed = self.length / self.time
        return np.array([speed**2, speed / self.time, self.force])

    def of(self, limits: LimitSet) -> Array:
        """Units of each row of limits, shape (m,)."""
        of_torque = np.abs(limits.columns[1])
        return np.where(of_torque.any(axis=1), of_torque @ self.torque, self.force)


class Relaxation(NamedTuple):
    """The relaxed parameter, and its change per unit relaxation of the NLP."""

    parameter: Parameter
    step: float  # in its unit; that of a speed is of its square, relatively

    def move(self, relaxed: float) -> float:
        """The parameter when relaxed so far."""
        value, sign = self.parameter.value, self.parameter.sign
        if self.parameter.is_speed:
            return float(value * (1 + relaxed) ** 0.5)
        return float(value + sign * self.step * relaxed)


class Tightening(NamedTuple):
    """Tightening of limits at the nodes so that they hold between nodes too."""

    limits: Array  # (N + 1, n_sides) [N, N m]: of each side of the limits
    speed_share: Array  # (N + 1,): factor on the largest b
    duration: float | None  # [s]: longest duration, if there is one
    missed: Array  # (N + 1, n_sides) [N, N m]: the part of `limits` beyond the slack at nodes
    motors: Array  # (N + 1, 2, 2): factors on torque rate limits and on the largest commands

    @staticmethod
    def none(data: PhaseData, duration: float | None) -> Tightening:
        """Limits as they are."""
        count = len(data.grid.s)
        limits = np.zeros((count, len(data.spans)))
        return Tightening(limits, np.ones(count), duration, limits, np.ones((count, 2, 2)))


@dataclass(frozen=True, eq=False)
class PathNLP:
    """A built NLP."""

    solver: Expression  # takes x0, p, bounds and multipliers; see `build_path_nlp` for their order
    shape: LimitShape
    intervals: int
    columns: NLPColumns
    objective: Objective

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Which entries of the (N + 1, columns) array of unknowns are not b at an end."""
        mask = np.ones((self.intervals + 1, self.columns.node.count), dtype=bool)
        mask[[0, -1], self.columns.node["b"]] = False
        return mask


@lru_cache(maxsize=16)
def build_path_nlp(shape: LimitShape, intervals: int, objective: Objective) -> PathNLP:
    """Build the NLP for every phase with limits of a shape; see `terms`."""
    started = time.perf_counter()
    nlp = write_terms(shape, intervals, objective)
    book(SolverStatistics(build_time=time.perf_counter() - started))
    # Soft NLPs start far from their optimum, and need the more robust strategy.
    strategy: dict[str, Any]
    strategy = {"mu_strategy": "monotone"} if objective in SOFT else {"mu_oracle": "probing"}
    if shape.motors.slow:
        # Large gradients of the time next to rest would scale the objective down.
        strategy |= {"nlp_scaling_method": "none"}
    solver = build_solver("path_nlp", nlp, 1e-9, max_iter=300, **strategy)
    columns = list_columns(shape, intervals, objective)
    return PathNLP(solver, shape, intervals, columns, objective)


def parameters(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    time_weight: float,
    relaxation: Relaxation | None = None,
) -> Array:
    """Parameters of the NLP, in its units."""
    terms, unit, (b_unit, a_unit, force) = data.find_terms(), units.of(data.limits), units.profile
    blocks = {
        "a": terms[..., A] * a_unit / unit,
        "b": terms[..., B] * b_unit / unit,
        "lam": terms[..., LAMBDA] * force / unit,
        "speed": (terms[..., V] * np.sqrt(b_unit) / unit)[:, nlp.shape.fast],
    }
    torque, motors = unit[list(nlp.shape.torques)], nlp.shape.motors
    if nlp.objective is Objective.EFFORT or motors.slow:
        blocks["torque"] = data.nodes.forces.of_tau[..., ONE] / torque
    if nlp.objective is Objective.EFFORT:
        blocks["joints"] = torque**2 / units.power
    if motors.slow:
        scene, (rates, commands) = data.curve.formation.scene, map(list, motors)
        blocks["quick"] = (torque / units.time / data.rate_limit)[rates]
        blocks["lags"] = scene.actuator_lag[commands] / units.time
        blocks |= {"bends": data.grid.bends, "sizes": data.grid.sizes}
    if relaxation is not None:
        parameter, step = relaxation
        gives = data.limits.weigh(parameter) * step / unit
        blocks["gives"] = np.append(gives, parameter.is_speed)
        blocks["rates"] = data.relative_rates(data.nodes, parameter) ** 2 * b_unit
    return np.asarray(
        nlp.columns.p.join(
            ends=np.zeros(2),
            steps=data.grid.steps / units.length,
            weight=[time_weight / units.power],
            calm=[force / units.press],
            **{name: block.ravel("F") for name, block in blocks.items()},
        )
    )


def make_bounds(
    nlp: PathNLP,
    data: PhaseData,
    units: Units,
    tightening: Tightening,
    relaxation: Relaxation | None = None,
    start: SureStart | None = None,
    pins: tuple[float | None, float | None] = (None, None),
) -> dict[str, Array]:
    """Bounds of the NLP, with every limit tightened."""
    tight, speed_share, duration, *_ = tightening
    n, node = len(data.grid.s), nlp.columns.node
    low, high = np.full((n, node.count), -np.inf), np.full((n, node.count), np.inf)
    b_max = data.largest_b(data.nodes, relaxation.parameter if relaxation else None)
    # Next to rest b is 2 s times the least s''.
    s, length = data.grid.s, data.grid.s[-1]
    low[:, 0] = LEAST_B * np.minimum(s, length - s) / length
    high[:, 0] = np.maximum(b_max * speed_share / units.profile[0], 2 * LEAST_B)
    if data.grid.held:
        low[:, 0], high[:, 0] = LEAST_B, high[:, 0] / data.grid.sizes
    # From rest to rest, without reversal.
    if nlp.shape.motors.slow:
        low[[0, -1], node["a"]] = high[[0, -1], node["a"]] = 0.0
    else:
        low[0, node["a"]], high[-1, node["a"]] = LEAST_B, -LEAST_B
    if start is not None:
        _, a_unit, force = units.profile
        low[0, node["a"]] = max(start.least_a / a_unit, LEAST_B)
        low[0, node["lam"]], high[0, node["lam"]] = start.low / force, start.high / force
    for place, pin in zip((0, -1), pins, strict=True):
        if pin is not None:
            low[place, node["lam"]] = high[place, node["lam"]] = pin / units.profile[2]
    low[:, node["extra"]] = -np.inf if nlp.objective is Objective.MARGIN else 0.0
    rows, signs, bounds = data.limits.sides
    sides = bounds + signs * tight - data.find_terms()[:, rows, ONE]
    sides /= units.of(data.limits)[rows]
    side = np.arange(len(rows)) if nlp.objective in SOFT else rows
    width = nlp.columns.g.sizes["limits"] // n
    rows_low, rows_high = np.full((n, width), -np.inf), np.full((n, width), np.inf)
    rows_low[:, side[signs > 0]] = sides[:, signs > 0]
    rows_high[:, side[signs < 0]] = sides[:, signs < 0]
    if nlp.objective is Objective.RELAX:
        rows_high[:, -1] = 1.0
    late = nlp.columns.g.sizes["duration"]
    equal = np.zeros(nlp.columns.g["limits"].start)
    longest = np.full(late, (duration or np.inf) / units.time)
    rates, commands = map(list, nlp.shape.motors)
    torque, sizes = units.of(data.limits)[list(nlp.shape.torques)], nlp.columns.g.sizes
    quickest, most = tightening.motors[:, 0], tightening.motors[:, 1] * data.torque_limit / torque
    joins, begins = np.zeros(sizes["joins"]), np.full(sizes["begins"] // 2, LEAST_B)
    within = np.concatenate([quickest[:, rates].ravel("F"), most[:, commands].ravel("F")])
    motors_low = -within, joins, begins, -np.inf * begins
    motors_high = within, joins, np.inf * begins, -begins
    return {
        "lbx": low[nlp.free],
        "ubx": high[nlp.free],
        "lbg": np.concatenate([equal, rows_low.ravel(), np.full(late, -np.inf), *motors_low]),
        "ubg": np.concatenate([equal, rows_high.ravel(), longest, *motors_high]),
    }


def center(
    nlp: PathNLP, data: PhaseData, units: Units, profile: Profile, margin: float
) -> dict[str, Array]:
    """Multipliers with which a motion is near the central path."""
    (rows, signs, _), sizes = data.limits.sides, nlp.columns.g.sizes
    slack = data.slack(data.nodes, profile, margin) / units.of(data.limits)[rows]
    on_sides, on_rows = _MU / np.maximum(slack, _INSIDE), np.zeros((len(slack), nlp.shape.rows))
    for side, row in enumerate(rows.tolist()):
        on_rows[:, row] -= signs[side] * on_sides[:, side]
    on_x = np.zeros(nlp.free.shape)
    on_x[:, 0] = -_MU / np.maximum(profile.b / units.profile[0], _INSIDE)
    # The chain's multiplier at a node is the sum of those of normal forces from there on.
    chain = -1 - np.cumsum(on_rows[:, list(nlp.shape.presses)].sum(axis=1))[:-1]
    known = {"limits": on_rows.ravel(), "chain": chain[: sizes["chain"]]}
    on_g = nlp.columns.g.join(**{name: np.zeros(sizes[name]) for name in sizes} | known)
    return {"lam_x0": on_x[nlp.free], "lam_g0": on_g}


def pack(
    nlp: PathNLP,
    profile: Profile,
    units: Units,
    extra: float | Array,
    sizes: Array | float = 1.0,
) -> Array:
    """Unknowns of the NLP, in its units, from a profile, with the `sizes` of b on its grid.

    `extra` is the least margin [N], the relaxation, or shortfalls in the units of the limits.
    """
    table = np.empty(nlp.free.shape)
    table[:, nlp.columns.node["extra"]] = extra / _margin_unit(nlp, units)
    table[:, :3] = np.column_stack([profile.b, profile.a, profile.lam]) / units.profile
    table[:, 0] /= sizes
    return np.asarray(table[nlp.free])


def _margin_unit(nlp: PathNLP, units: Units) -> float:
    return units.force if nlp.objective is Objective.MARGIN else 1.0


def unpack(nlp: PathNLP, grid: Grid, x: Array, units: Units) -> tuple[Profile, float]:
    """Profile of a solution, and the least margin [N] or the relaxation, if any.

    b is integrated again from a: b' = 2 a to rounding, not to Ipopt's tolerance.
    """
    table = np.zeros(nlp.free.shape)
    table[nlp.free] = x
    a, lam = table[:, 1] * units.profile[1], table[:, 2] * units.profile[2]
    margin = x[-1] * _margin_unit(nlp, units) if nlp.objective in CHAINED else 0.0
    return follow(grid, a, lam), float(margin)
