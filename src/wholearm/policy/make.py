"""Making a policy of a plan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.require import require_number
from ..geometry.curve import Curve
from ..geometry.tracing import runs_on_curve, trace_phase
from ..mechanics.dynamics import inverse
from ..mechanics.metric import metric_weights
from ..problem.definition import End, Phase, Problem
from ..results.trajectory import Trajectory
from .curve_law import Pace
from .curve_rows import Rows, find_directions, make_rows
from .policy import Policy
from .push import find_hold, find_push
from .retime import retime

INTERVALS = 120
"""Intervals of a curve's table, dense at its ends."""
PLACES = 400
"""Places of a curve at which a plan's place is looked for first."""
NEWTON = 4
AUTHORITY = 2.0
"""Reserve of torques along the way, in those of `curve_rows`: feedback adds to the motion."""
TOUCH, STILL = 3e-3, 1e-3
"""Speeds along curves at which contacts are made, and that count as none, over the scene's."""
DWELL = 3e-3
"""How long joints stand still before the next phase begins [s]."""
ARRIVAL = 3e-3
"""Time in which the rest of the way is run through at the end, a motion that fades away [s]."""
MOST = 0.5
"""Largest acceleration of the integral, over the scene's."""


class Piece(NamedTuple):
    """A phase along a curve.

    Its rows, the reference's b at their places, and the least part of the reserve that it keeps.
    """

    curve: Curve
    rows: Rows
    b: Array
    share: float


def make_policy(
    problem: Problem,
    plan: Trajectory,
    *,
    reserve: float = 2.5,
    period: float = 1e-3,
    delay: float = 5e-4,
) -> Policy:
    """Make a policy that carries out a plan by feedback from the joints.

    Parameters
    ----------
    problem : Problem
    plan : Trajectory
    reserve : float
        How much normal force is kept in reserve along the way, over what numbers that are 5 %
        (masses), 10 % (friction) and 1 % (torques) off take away, one by one and summed as squares.
        Where the plan leaves less, the motion is slower; with 0 it is the plan's.
    period : float, [s]
        Of the control loop.
    delay : float, [s]
        Time from measuring to when torques take effect, as far as it is known.

    Raises
    ------
    InputError
        If a number is out of its range, the plan is of another problem, or a phase does not run
        along a curve.
    """
    reserve = require_number(reserve, "reserve", nonnegative=True)
    period = require_number(period, "period", positive=True)
    delay = require_number(delay, "delay", nonnegative=True)
    if len(plan.phase_starts) != len(problem.phases) + 1:
        given = f"{len(plan.phase_starts) - 1} given; the problem has {len(problem.phases)}"
        raise InputError("", "phases of the plan", given)
    pieces = [_trace(problem, phase, plan, reserve) for phase in problem.phases]
    tables = []
    for k, own in enumerate(pieces):
        contact = problem.phases[k].until.contact
        after = pieces[k + 1].rows if k + 1 < len(pieces) else None
        push = None if contact is None else find_push(own.curve, contact, own.rows, after)
        tables.append(_tabulate(own, find_hold(own.curve) if push is None else push))
    scales = problem.scene.scales
    one, two = problem.scene.torque_limit.tolist()
    pace = Pace(
        period,
        delay,
        TOUCH * scales.speed,
        STILL * scales.speed,
        DWELL,
        MOST * scales.acceleration,
        (one, two),
    )
    starts = plan.phase_starts
    about = [
        {
            "number": phase.number,
            "plan": float(starts[phase.number] - starts[phase.index]),
            "duration": _time(own) + DWELL + delay,
            "share": own.share,
        }
        for phase, own in zip(problem.phases, pieces, strict=True)
    ]
    whole = sum(own["duration"] for own in about)
    return Policy(tables, pace, {"name": problem.name, "duration": whole, "phases": about})


def _time(piece: Piece) -> float:
    """How long a reference takes [s]."""
    speeds = np.sqrt(piece.b)
    return float((2 * np.diff(piece.rows.s) / (speeds[1:] + speeds[:-1])).sum())


def _tabulate(piece: Piece, push: Array) -> dict[str, Array]:
    """Arrays of `CurveLaw`."""
    rows = piece.rows
    return {
        "s": rows.s,
        "theta": piece.curve.evaluate(rows.s).z[:, 3:],
        "b": piece.b,
        "levels": np.stack([rows.levels[:-1], rows.levels[1:]], axis=1),
        "torque": np.stack([rows.torque[:-1], rows.torque[1:]], axis=1),
        "push": push,
    }


def _trace(problem: Problem, phase: Phase, plan: Trajectory, reserve: float) -> Piece:
    """A phase's curve, with the motion that keeps a reserve."""
    if not runs_on_curve(phase):
        text = "does not run along a curve; policies are for phases with one freedom"
        raise InputError(problem.source, f"phases[{phase.number}]", text)
    own = np.flatnonzero((plan.phase == phase.index) & ~plan.held)
    curve = trace_phase(phase, plan.z[own[0]], problem.phases[phase.index + 1 :])
    places, *values = _follow(curve, plan, own)
    s = _place_nodes(curve)
    a, b, squeeze = (np.interp(s, places, value) for value in values)
    if phase.end is not End.IMPACT:
        touch = TOUCH * problem.scene.scales.speed
        b = np.minimum(b, (touch + (curve.length - s) / ARRIVAL) ** 2)
    rows = make_rows(curve, s, (a, b, squeeze))
    wanted = reserve * rows.unit
    wanted[:, rows.presses :] = AUTHORITY * rows.unit[:, rows.presses :]
    motion = retime(s, rows.slack, wanted, b)
    return Piece(curve, rows, motion.b, float(motion.share.min()))


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
