"""References along curves: a plan's motion, or a slower one, with something in reserve."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phase
from ..mechanics.dynamics import inverse
from ..mechanics.limits import CONE, PRESS, make_limits
from ..mechanics.metric import metric_weights
from ..problem.definition import End, Phase, Problem
from ..results.trajectory import Trajectory
from .curve_rows import Rows, find_directions, find_squeeze, make_rows, measure_levels
from .retime import ENOUGH, retime
from .within import retime_within

INTERVALS = 120
"""Intervals of a curve's table, dense at its ends."""
PLACES = 400
"""Places of a curve at which a plan's place is looked for first."""
NEWTON = 4
AUTHORITY = 2.0
"""Reserve of torques along the way, in those of `curve_rows`: feedback adds to the motion."""
TOUCH = 3e-3
"""Speed along curves at which contacts are made, over the scene's."""
ARRIVAL = 3e-3
"""Time in which the rest of the way is run through at the end, a motion that fades away [s]."""
SLOWER = (1.0, 0.5, 0.25, 0.12, 0.06)
"""Squares of speeds over the plan's that are tried, the fastest first, until there is a reserve, or
less of it: torques that are off by a part of themselves matter less where they are small."""
REFINE = 2
"""How often a slower motion's squeeze and what is in reserve for it are found from one another."""


class Piece(NamedTuple):
    """A phase along a curve.

    Its rows, the reference's b at their places, the least part of the reserve that it keeps, the
    least level of each contact, in reserves of level 1, and whether the end is passed at speed.
    """

    curve: Curve
    rows: Rows
    b: Array
    share: float
    reserves: dict[str, float]
    passes: bool


class Reserve(NamedTuple):
    """What is kept in reserve: as `make_policy` says, for torques that are late as it knows [s]."""

    size: float
    ranges: Mapping[str, float] | None
    delay: float


def trace_piece(problem: Problem, phase: Phase, plan: Trajectory, reserve: Reserve) -> Piece:
    """A phase's curve, with the motion that keeps a reserve, or most of it if none keeps enough."""
    own = np.flatnonzero((plan.phase == phase.index) & ~plan.held)
    curve = trace_phase(phase, plan.z[own[0]], problem.phases[phase.index + 1 :])
    places, *values = _follow(curve, plan, own)
    s = _place_nodes(curve)
    a, b, squeeze = (np.interp(s, places, value) for value in values)
    if phase.end is not End.IMPACT:
        touch = TOUCH * problem.scene.scales.speed
        b = np.minimum(b, (touch + (curve.length - s) / ARRIVAL) ** 2)
    passes = phase.end is End.IMPACT
    if reserve.ranges is not None and reserve.size:
        widths = {name: reserve.size * width for name, width in reserve.ranges.items()}
        widths["delay"] = max(widths.get("delay", 0.0) - reserve.delay, 0.0)
        within, share = retime_within(curve, s, (a, b, squeeze), widths, problem.epsilon)
        if within is not None:
            return Piece(curve, *within, share, _list_reserves(curve, *within), passes)
    best: tuple[float, Rows, Array] | None = None
    for part in SLOWER:
        motion = part * a, part * b
        rows = make_rows(curve, s, (*motion, squeeze))
        for _ in range(REFINE if part < 1.0 else 0):
            rows = make_rows(curve, s, (*motion, find_squeeze(rows, *motion)))
        wanted = reserve.size * rows.unit
        wanted[:, rows.presses :] = AUTHORITY * rows.unit[:, rows.presses :]
        found = retime(s, rows.slack, wanted, motion[1])
        share = float(found.share.min())
        if best is not None and share <= best[0]:
            break
        best = share, rows, found.b
        if share >= ENOUGH:
            break
    assert best is not None
    share, rows, b = best
    return Piece(curve, rows, b, share, _list_reserves(curve, rows, b), passes)


def _list_reserves(curve: Curve, rows: Rows, b: Array) -> dict[str, float]:
    """Least level of each contact's normal force along a motion."""
    a = np.diff(b) / (2 * np.diff(rows.s))
    a = np.append(a, a[-1])
    names = curve.formation.names
    count = len(make_limits(curve.formation, 0.0).of(PRESS, CONE))
    levels = measure_levels(rows, a, b)[:, : rows.presses]
    least = levels.min(axis=0).reshape(-1, count).min(axis=0)
    return dict(zip(names, least[: len(names)].tolist(), strict=True))


def _follow(
    curve: Curve, plan: Trajectory, own: NDArray[np.int64]
) -> tuple[Array, Array, Array, Array]:
    """Places s, a, b and squeeze of a plan's rows along a curve."""
    formation, metric = curve.formation, metric_weights(curve.formation.scene)
    z, grid = plan.z[own], np.linspace(0.0, curve.length, PLACES)
    away = (z[:, None] - curve.evaluate(grid).z[None]) ** 2 @ metric
    s = grid[away.argmin(axis=1)]
    for _ in range(NEWTON):
        point = curve.evaluate(s)
        s = np.clip(s + ((z - point.z) * point.z_s) @ metric, 0.0, curve.length)
    point = curve.evaluate(s)
    v = (point.z_s * plan.z_dot[own]) @ metric
    a = (point.z_s * plan.z_ddot[own]) @ metric
    forces = inverse(formation, *point[:3], find_directions(curve, s), point.kinematics)
    columns = [plan.contacts.index(name) for name in formation.names]
    rolls = [columns[row] for row in formation.rolling_rows]
    c = np.hstack([plan.c_n[own][:, columns], plan.c_t[own][:, rolls]])
    # The other parts of the forces are orthogonal to that of the squeeze.
    return s, a, v**2, np.asarray(np.einsum("ni,ni->n", c, forces.Cl))


def _place_nodes(curve: Curve) -> Array:
    """Places of a table, with all reversals."""
    s = curve.length * (1 - np.cos(np.pi * np.linspace(0, 1, INTERVALS + 1))) / 2
    s = np.sort(np.concatenate([s, [part.stop for part in curve.segments[:-1]]]))
    return np.asarray(s[np.diff(s, prepend=-1.0) > 1e-7 * curve.length])
