"""Making a policy of a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError
from ..common.require import require_number
from ..contacts.formation import Formation
from ..geometry.tracing import runs_on_curve
from ..mechanics.arrival import Standstill, find_hold
from ..mechanics.metric import metric_weights
from ..problem.definition import End, Phase, Problem
from ..results.narrow import Moved, adopt_motion
from ..results.trajectory import Trajectory
from .curve_rows import find_forces, leave_one
from .pace import Pace
from .policy import Policy
from .push import find_arrival, find_push, find_still
from .reference import TOUCH, Piece, Reserve, trace_pieces
from .regulator import RATE, end_within, follow
from .replan import Planner, replan

STILL = 1e-3
"""Speed along curves that counts as none, over the scene's."""
USUAL = 2.5
"""Reserve of normal forces where no ranges are known, in those of `curve_rows`."""
DWELL = 3e-3
"""How long joints stand still before the next phase begins [s]."""
CLOSING = 0.02
"""Time in which held torques are to close a contact [s]."""
SHOWN = 1e-3
"""Part of a displacement that joints have to show, over what they show at most."""
WEAK = 10.0
"""Torques over the dry friction of the joints, below which it decides what is at rest."""
MOST = 0.5
"""Largest acceleration of the integral, over the scene's."""


def make_policy(
    problem: Problem,
    plan: Trajectory | Moved,
    *,
    reserve: float | None = None,
    period: float = 1e-3,
    delay: float = 5e-4,
    torque_limit: float | None = None,
    planner: Planner | None = None,
) -> Policy:
    """Make a policy that carries out a plan by feedback from the joints.

    Parameters
    ----------
    problem : Problem
    plan : Plan or Trajectory
    reserve : float, optional
        How much normal force is kept in reserve along the way. Where the plan was made for ranges
        of numbers, or the problem has them: for so many times these ranges (1). Otherwise in what
        numbers that are 5 % (masses), 10 % (friction) and 1 % (torques) off take away, one by one
        and summed as squares (2.5). Where the plan leaves less, the motion is slower; with 0 it is
        the plan's.
    period : float, [s]
        Of the control loop.
    delay : float, [s]
        Time from measuring to when torques take effect, as far as it is known.
    torque_limit : float, optional, [N m]
        Of both fingers, if it is not the problem's: what a plan leaves to feedback, where it was
        made with less than the hand has.
    planner : callable, optional
        Makes a trajectory of a problem: phases with more freedoms are planned anew with it, where
        the plan leaves no reserve, unless `reserve` is 0; as they are if it is left out.

    Raises
    ------
    InputError
        If a number is out of its range, or the plan is of another problem.
    """
    problem, plan = adopt_motion(problem, plan)
    ranges = find_ranges(problem, plan)
    reserve = (USUAL if ranges is None else 1.0) if reserve is None else reserve
    reserve = require_number(reserve, "reserve", nonnegative=True)
    period = require_number(period, "period", positive=True)
    delay = require_number(delay, "delay", nonnegative=True)
    if len(plan.phase_starts) != len(problem.phases) + 1:
        given = f"{len(plan.phase_starts) - 1} given; the problem has {len(problem.phases)}"
        raise InputError("", "phases of the plan", given)
    scales, limit = problem.scene.scales, problem.scene.torque_limit.tolist()
    if torque_limit is not None:
        limit = [require_number(torque_limit, "torque_limit", positive=True)] * 2
    speeds = TOUCH * scales.speed, STILL * scales.speed
    most = MOST * scales.acceleration
    pace = Pace(period, delay, *speeds, DWELL, most, (limit[0], limit[1]))
    blocks = split(problem.phases)
    curves = [len(own) == 1 and runs_on_curve(own[0]) for own in blocks]
    starts = plan.phase_starts
    if reserve and planner is not None:
        plan = replan(planner, problem, blocks, curves, plan)
    along = [own[0] if curve else None for own, curve in zip(blocks, curves, strict=True)]
    pieces = trace_pieces(problem, along, plan, Reserve(reserve, ranges, delay))
    tables, about = list[dict[str, Array]](), list[dict[str, Any]]()
    for own, piece, after in zip(blocks, pieces, [*pieces[1:], None], strict=True):
        lasts = {phase.number: float(np.diff(starts)[phase.index]) for phase in own}
        found: list[dict[str, Any]] = [
            {"number": k, "plan": t, "duration": t, "share": 0.0} for k, t in lasts.items()
        ]
        if piece is None:
            tables.append(_follow_motion(problem, own, plan, period))
            ends = [*tables[-1]["starts"], tables[-1]["step"][0] * (len(tables[-1]["theta"]) - 1)]
            for one, span in zip(found, np.diff(ends).tolist(), strict=True):
                one["duration"] = span
        else:
            tables.append(_tabulate(piece, own[0], _end(problem, own[0], plan, piece, after)))
            found[0].update(duration=piece.duration, share=piece.share, reserves=piece.reserves)
            gained = own[0].until.contact
            found[0]["gained"] = "" if gained is None else gained.name
        if piece is None or not piece.passes:
            found[-1]["duration"] += DWELL + delay
        about += found
    whole = sum(own["duration"] for own in about)
    known: dict[str, Any] = {"name": problem.name, "duration": whole, "phases": about}
    known["problem"] = problem.table
    if ranges is not None and reserve:
        known.update(ranges=dict(ranges), reserve=reserve)
    return Policy(tables, pace, known)


def split(phases: Sequence[Phase]) -> list[tuple[Phase, ...]]:
    """Phases that pass into one another in motion belong together, but for impacts along curves."""
    blocks: list[list[Phase]] = []
    for phase in phases:
        before = blocks[-1][-1] if blocks else None
        impact = before is not None and before.end is End.IMPACT
        joined = before is not None and before.end is End.SMOOTH
        if joined or (impact and not (runs_on_curve(phase) and len(blocks[-1]) == 1)):
            blocks[-1].append(phase)
        else:
            blocks.append([phase])
    return [tuple(own) for own in blocks]


def _end(
    problem: Problem, phase: Phase, plan: Trajectory, piece: Piece, after: Piece | None
) -> Array:
    """Torques at the end of a curve: those that the plan holds there, if it does."""
    last = int(np.flatnonzero(plan.phase == phase.index)[-1])
    if np.isnan(plan.c_n[last]).all():
        return np.asarray(plan.tau[last])
    contact, push = phase.until.contact, None
    if contact is not None:
        push = find_push(piece.curve, contact, piece.rows, None if after is None else after.rows)
        push = hold_end(problem, phase, piece.curve.end) if push is None else push
    return find_still(piece.curve) if push is None else push


def hold_end(problem: Problem, phase: Phase, z: Array) -> Array | None:
    """Torques that hold all that touches where a phase ends, None if there are none."""
    contact = phase.until.contact
    gained = () if contact is None else (contact,)
    touching = Formation(problem.scene, (*phase.formation.contacts, *gained))
    place = Standstill(z, phase.formation, contact, touching)
    hold = find_hold(place, problem.epsilon, problem.gap, CLOSING)
    return None if hold is None else hold.tau


def _follow_motion(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, period: float
) -> dict[str, Array]:
    """Arrays of `MotionLaw`."""
    starts = plan.phase_starts[phases[0].index : phases[-1].index + 2].copy()
    starts[-1] = plan.t[(plan.phase == phases[-1].index) & ~plan.held][-1]
    count = max(int(np.ceil((starts[-1] - starts[0]) / period)), 2)
    t = np.linspace(starts[0], starts[-1], count + 1)
    samples, last = plan.at(end_within(phases, plan, t)), phases[-1]
    hold = hold_end(problem, last, samples.z[-1])
    found = follow(problem, phases, plan, t)
    speed = np.sqrt(found.b)
    return {
        "starts": (starts[:-1] - starts[0]) / speed,
        "step": np.array([(t[1] - t[0]) / speed]),
        "theta": samples.z[:, 3:],
        "rates": samples.z_dot[:, 3:] * speed,
        "tau": found.tau,
        "gain": np.concatenate([found.gains[:-1], _hold_joints(problem)[None]]),
        "push": samples.tau[-1] if hold is None else hold,
        "still": np.array([STILL * problem.scene.scales.rate]),
        "ways": _list_ways(problem, last, samples.z[-1:]),
    }


def _hold_joints(problem: Problem) -> Array:
    """Gains that lead each joint to its place, in contact or not, critically damped, (2, 4)."""
    inertia = np.diag([own.inertia for own in problem.scene.fingers])
    return np.hstack([RATE**2 * inertia, 2 * RATE * inertia])


def _list_ways(problem: Problem, phase: Phase, z: Array) -> Array:
    """What joints show of displacements that all contacts at the end leave, orthonormal, (f, 2)."""
    own, contact = phase.formation, phase.until.contact
    contacts = own.contacts if contact is None else (*own.contacts, contact)
    both = Formation(problem.scene, contacts, own.rolling)
    units = np.sqrt(metric_weights(problem.scene))
    P = both.evaluate(z, np.zeros_like(z)).P[0] / units
    left = np.linalg.svd(P)[2][len(P) :] / units
    basis, sizes, _ = np.linalg.svd(left[:, 3:].T, full_matrices=False)
    return np.asarray(basis.T[sizes > SHOWN * (1.0 / units[3])])


def _tabulate(piece: Piece, phase: Phase, push: Array) -> dict[str, Array]:
    """Arrays of `CurveLaw`."""
    rows, levels, contact = piece.rows, piece.rows.levels, phase.until.contact
    arrival, dry = np.zeros((0, 5)), phase.formation.scene.dry[3:]
    if contact is not None and not piece.passes:
        arrival = find_arrival(piece.curve, contact, rows)
    return {
        "s": rows.s,
        "theta": piece.curve.evaluate(rows.s).z[:, 3:],
        "b": piece.b,
        "levels": leave_one(np.stack([levels[:-1], levels[1:]], axis=1)),
        "torque": np.stack([rows.torque[:-1], rows.torque[1:]], axis=1),
        "push": push,
        "passes": np.array([piece.passes]),
        "arrival": arrival,
        "keeps": np.array([float((np.abs(push) < WEAK * dry).all())]),
        "forces": find_forces(piece.curve, rows.s, np.sqrt(piece.b)),
    }


def find_ranges(problem: Problem, plan: Trajectory) -> Mapping[str, float] | None:
    """Half widths that the plan was made for, or those of the problem; None if there are none."""
    figures = plan.meta.get("ranges")
    if figures:
        return dict(figures["radii"])
    return None if problem.uncertainty is None else problem.ranges
