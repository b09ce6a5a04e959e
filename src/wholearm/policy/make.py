"""Policies from plans: control laws of all phases, their references and margins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, WholearmError, require_number
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..geometry.tracing import runs_on_curve
from ..mechanics.dynamics import (
    LAMBDA,
    ONE,
    A,
    B,
    Directions,
    V,
    force_rows,
    inverse,
    metric_weights,
)
from ..mechanics.limits import PRESS, TORQUE, make_limits
from ..mechanics.path_limits import PathLimits
from ..problem.definition import PARAMETERS, ROWS, End, Phase, Problem
from ..results.adopt import Moved, adopt_motion
from ..results.dwell_record import assemble
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Trajectory
from ..simulation.modes import Standstill, find_hold
from .curve_law import LoopSettings, choose_internal_force
from .playback import Policy
from .reference import (
    SETTINGS,
    CurveLimitRows,
    ReferencePiece,
    find_forces,
    leave_one,
    scale_ranges,
    trace_pieces,
)
from .regulator import RATE, ROOM, end_within, follow

SAME = 1e-5  # distance from the plan's end that counts as none, over the scene's length and in rad
STILL = 1e-3  # speed that counts as none, over the scene's
Planner = Callable[[Problem], Trajectory]  # makes a plan of a problem
COLUMNS = [ONE, B, V, A, LAMBDA]  # order of coefficients in the tables of a policy


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
    reserve               margin of normal forces. With ranges of numbers in plan or problem: factor
                          on these ranges (1). Otherwise in units of the errors from masses that are
                          5 %, friction that is 10 % and torques that are 1 % off, root sum square
                          (2.5). Where the plan leaves less, the motion is slower; 0: as the plan
    period : [s]          of the control loop
    delay : [s]           from measuring to applying torques, as far as known
    torque_limit : [N m]  of both fingers, if the plan was made with less than the hand has
    planner               replans phases with more degrees of freedom that leave no margin, unless
                          `reserve` is 0

    Raises
    ------
    InputError  if a number is out of its range, or the plan is of another problem
    """
    problem, plan = adopt_motion(problem, plan)
    ranges = find_ranges(problem, plan)
    reserve = (2.5 if ranges is None else 1.0) if reserve is None else reserve
    reserve = require_number(reserve, "reserve", nonnegative=True)
    period = require_number(period, "period", positive=True)
    delay = require_number(delay, "delay", nonnegative=True)
    if len(plan.phase_starts) != len(problem.phases) + 1:
        given = f"{len(plan.phase_starts) - 1} given; the problem has {len(problem.phases)}"
        raise InputError("", "phases of the plan", given)
    scales, limit = problem.scene.scales, problem.scene.torque_limit.tolist()
    if torque_limit is not None:
        limit = [require_number(torque_limit, "torque_limit", positive=True)] * 2
    settings = LoopSettings(
        period=period,
        delay=delay,
        touch=SETTINGS.touch * scales.speed,
        still=STILL * scales.speed,
        dwell=3e-3,
        most=0.5 * scales.acceleration,
        limit=(limit[0], limit[1]),
    )
    blocks = split(problem.phases)
    along = [_find_curve(block) for block in blocks]
    starts = plan.phase_starts
    if reserve and planner is not None:
        curves = [phase is not None for phase in along]
        plan = replan(planner, problem, blocks, curves, plan)
    widths = None if ranges is None else scale_ranges(ranges, reserve, delay)
    pieces = trace_pieces(problem, along, plan, reserve, widths)
    tables, about = list[dict[str, Array]](), list[dict[str, Any]]()
    for block, piece in zip(blocks, pieces, strict=True):
        lasts = {phase.number: float(np.diff(starts)[phase.index]) for phase in block}
        found: list[dict[str, Any]] = [
            {"number": k, "plan": t, "duration": t, "share": 0.0} for k, t in lasts.items()
        ]
        if piece is None:
            tables.append(_tabulate_motion(problem, block, plan, period))
            ends = [*tables[-1]["starts"], tables[-1]["step"][0] * (len(tables[-1]["theta"]) - 1)]
            for one, span in zip(found, np.diff(ends).tolist(), strict=True):
                one["duration"] = span
        else:
            phase = block[0]
            push = _find_end_torques(problem, phase, plan, piece)
            tables.append(_tabulate_curve(piece, phase, push))
            found[0].update(duration=piece.duration, share=piece.share, reserves=piece.reserves)
            gained = phase.until.contact
            found[0]["gained"] = "" if gained is None else gained.name
        if piece is None or not piece.passes:
            found[-1]["duration"] += settings.dwell + delay
        about += found
    duration = sum(phase["duration"] for phase in about)
    whole: dict[str, Any] = {"name": problem.name, "duration": duration, "phases": about}
    whole["problem"] = problem.table
    if ranges is not None and reserve:
        whole.update(ranges=dict(ranges), reserve=reserve)
    return Policy(tables, settings, whole)


def split(phases: Sequence[Phase]) -> list[tuple[Phase, ...]]:
    """Blocks of phases that pass into one another in motion, except by impacts along curves."""
    blocks: list[list[Phase]] = []
    for phase in phases:
        before = blocks[-1][-1] if blocks else None
        impact = before is not None and before.end is End.IMPACT
        joined = before is not None and before.end is End.SMOOTH
        if joined or (impact and not (runs_on_curve(phase) and len(blocks[-1]) == 1)):
            blocks[-1].append(phase)
        else:
            blocks.append([phase])
    return [tuple(block) for block in blocks]


def _find_curve(block: Sequence[Phase]) -> Phase | None:
    """The phase of a block that is one along a curve."""
    return block[0] if len(block) == 1 and runs_on_curve(block[0]) else None


def _find_end_torques(
    problem: Problem, phase: Phase, plan: Trajectory, piece: ReferencePiece
) -> Array:
    """Torques that hold the end of a curve: the plan's if it has any."""
    last = int(np.flatnonzero(plan.phase == phase.index)[-1])
    if np.isnan(plan.c_n[last]).all():
        return np.asarray(plan.tau[last])
    gained = phase.until.contact is not None
    push = hold_end(problem, phase, piece.curve.end) if gained else None
    return find_still(piece.curve) if push is None else push


def hold_end(problem: Problem, phase: Phase, z: Array) -> Array | None:
    """Torques that hold all contacts at the end of a phase at rest, or None."""
    contact = phase.until.contact
    touching = replace(phase.formation.add(contact), rolling=())
    place = Standstill(z, phase.formation, contact, touching)
    hold = find_hold(place, problem.epsilon, problem.gap, 0.02)
    return None if hold is None else hold.tau


def _tabulate_motion(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, period: float
) -> dict[str, Array]:
    """Arrays of `MotionLaw`."""
    starts = plan.phase_starts[phases[0].index : phases[-1].index + 2].copy()
    starts[-1] = plan.t[(plan.phase == phases[-1].index) & ~plan.held][-1]
    count = max(int(np.ceil((starts[-1] - starts[0]) / period)), 2)
    t = np.linspace(starts[0], starts[-1], count + 1)
    samples, last = plan.at(end_within(phases, plan, t)), phases[-1]
    hold = hold_end(problem, last, samples.z[-1])
    inertia = np.diag([finger.inertia for finger in problem.scene.fingers])
    # At the end each joint is critically damped, in contact or not.
    final = np.hstack([RATE**2 * inertia, 2 * RATE * inertia])
    b, tau, gains = follow(problem, phases, plan, t)
    speed = np.sqrt(b)
    return {
        "starts": (starts[:-1] - starts[0]) / speed,
        "step": np.array([(t[1] - t[0]) / speed]),
        "theta": samples.z[:, 3:],
        "rates": samples.z_dot[:, 3:] * speed,
        "tau": tau,
        "gain": np.concatenate([gains[:-1], final[None]]),
        "push": samples.tau[-1] if hold is None else hold,
        "still": np.array([STILL * problem.scene.scales.rate]),
        "ways": _list_free_joints(problem, last, samples.z[-1:]),
    }


def _list_free_joints(problem: Problem, phase: Phase, z: Array) -> Array:
    """Orthonormal basis of joint displacements that the contacts at the end leave free, (f, 2)."""
    both = phase.formation.add(phase.until.contact)
    units = np.sqrt(metric_weights(problem.scene))
    P = both.evaluate(z, np.zeros_like(z)).P[0] / units
    left = np.linalg.svd(P)[2][len(P) :] / units
    basis, sizes, _ = np.linalg.svd(left[:, 3:].T, full_matrices=False)
    return np.asarray(basis.T[sizes > 1e-3 / units[3]])


def _tabulate_curve(piece: ReferencePiece, phase: Phase, push: Array) -> dict[str, Array]:
    """Arrays of `CurveLaw`."""
    rows, levels, contact = piece.rows, piece.rows.levels, phase.until.contact
    arrival, dry = np.zeros((0, 5)), phase.formation.scene.dry[3:]
    if contact is not None and not piece.passes:
        arrival = find_arrival(piece.curve, contact, rows)
    return {
        "s": rows.s,
        "theta": piece.curve.evaluate(rows.s).z[:, 3:],
        "b": piece.b,
        "levels": leave_one(np.stack([levels[:-1], levels[1:]], axis=1))[..., COLUMNS],
        "torque": np.stack([rows.torque[:-1], rows.torque[1:]], axis=1)[..., COLUMNS],
        "push": push,
        "passes": np.array([piece.passes]),
        "arrival": arrival[..., COLUMNS],
        # Friction of the joints decides on rest where torques are not much larger.
        "keeps": np.array([float((np.abs(push) < 10 * dry).all())]),
        "forces": find_forces(piece.curve, rows.s, np.sqrt(piece.b))[..., COLUMNS],
    }


def find_ranges(problem: Problem, plan: Trajectory) -> Mapping[str, float] | None:
    """Half widths of the ranges of a plan, or else of its problem, or None."""
    figures = plan.meta.get("ranges")
    if figures:
        return dict(figures["radii"])
    return None if problem.uncertainty is None else problem.ranges


def find_arrival(curve: Curve, gained: Contact, rows: CurveLimitRows) -> Array:
    """Levels of all contacts, with the gained one, at rest at the end of a curve, (k, 5).

    Empty where forces at rest are not unique.
    """
    both, own = curve.formation.add(gained), curve.formation.scene
    if both.n_constraints != 5:
        return np.zeros((0, 5))
    # Torques have to balance with other friction, too, and in corners of the ranges.
    cases = [(own, factor) for factor in (0.7, 1.0, 1.2)]
    cases += [(scene, 1.0) for scene in rows.scenes if scene != own]
    try:
        balances = [_balance(curve, replace(both, scene=scene), mu) for scene, mu in cases]
    except np.linalg.LinAlgError:
        return np.zeros((0, 5))
    margins, found = rows.unit[-1, : curve.formation.n_contacts], list[Array]()
    for balance in balances:
        forces = balance[: both.n_contacts, 1:] @ rows.torque[-1]
        forces[:, ONE] += balance[: both.n_contacts, 0]
        found.append(forces / np.append(margins, margins.max())[:, None])
    return np.vstack(found)


def _balance(curve: Curve, both: Formation, factor: float) -> Array:
    """Constraint forces of (1, tau) at rest at the end of a curve, shape (5, 3)."""
    scene, last = both.scene, curve.segments[-1]
    point = curve.evaluate(np.array([curve.length]))
    kinematics = both.evaluate(point.z, point.z_s)
    slides = np.sign(kinematics.A_t[0] @ point.z_s[0])
    Xi = np.append(last.Xi, slides[-1])[None]
    G = force_rows(both, kinematics, Directions(factor * Xi, last.sigma[None]))[0]
    right = np.zeros((5, 3))
    right[:, 0] = -scene.applied_force
    right[3:, 0] += scene.dry[3:] * last.sigma
    right[3:, 1:] = -np.eye(2)
    return np.asarray(np.linalg.solve(G.T, right))


def find_still(curve: Curve) -> Array:
    """Torques that hold the end of a curve at rest without friction, (2,)."""
    formation, point = curve.formation, curve.evaluate(np.array([curve.length]))
    still = Directions(np.zeros((1, formation.n_contacts)), np.zeros((1, 2)))
    forces = inverse(formation, *point[:3], still, point.kinematics)
    limits = make_limits(formation, 0.0).only(PRESS, TORQUE)
    rows = PathLimits.of(limits, forces, point.z_s[:, 3:]).rows[0]
    base, press = rows[:, ONE].tolist(), rows[:, LAMBDA].tolist()
    _, internal = choose_internal_force(base, [0.0] * len(base), press, 0.0)
    return np.asarray(forces.of_tau[0, :, ONE] + internal * forces.of_tau[0, :, LAMBDA])


def replan(
    planner: Planner,
    problem: Problem,
    blocks: Sequence[tuple[Phase, ...]],
    curves: Sequence[bool],
    plan: Trajectory,
) -> Trajectory:
    """A plan whose blocks off curves are replanned with a margin where possible."""
    motions, k = list(plan.motions), 0
    while k < len(blocks):
        after = k + 1
        if not curves[k] and _lacks_margin(problem, blocks[k], plan):
            for share in (1.0, 0.5, 0.25):
                found = _replan_blocks(planner, problem, blocks[k:], curves[k:], plan, share)
                if found is not None:
                    new, after = found[0], k + found[1]
                    first = blocks[k][0].index
                    motions[first : first + len(new)] = new
                    break
        k = after
    if all(new is old for new, old in zip(motions, plan.motions, strict=True)):
        return plan
    samples = int(np.bincount(plan.phase).max())
    still = TorqueProfile(np.array([0.0, plan.duration]), np.zeros((1, 2, 1)))
    rows = assemble(motions, still, plan.meta, samples)
    return replace(rows, torque=TorqueProfile.join_rows(rows.t, rows.tau))


def _lacks_margin(problem: Problem, phases: Sequence[Phase], plan: Trajectory) -> bool:
    """Whether a normal force or torque in some phases is nearer to its limit than the margin."""
    rows = (plan.phase >= phases[0].index) & (plan.phase <= phases[-1].index)
    scene = problem.scene
    most = (np.abs(plan.tau[rows]) / scene.torque_limit).max()
    least = np.nanmin(plan.c_n[rows]) / scene.scales.force
    return bool(min(least, 1 - most) < 0.99 * ROOM)


def _replan_blocks(
    planner: Planner,
    problem: Problem,
    blocks: Sequence[tuple[Phase, ...]],
    curves: Sequence[bool],
    plan: Trajectory,
    share: float,
) -> tuple[list[Motion], int] | None:
    """Motions with a share of the margin until the plan is reached again, and their blocks."""
    starts, found = plan.phase_starts, list[Motion]()
    z = plan.z[np.flatnonzero(plan.phase == blocks[0][0].index)[0]]
    blocks = [*blocks[:-1], (*blocks[-1][:-1], _pin(blocks[-1][-1], plan.z[-1]))]
    for count, (block, curve) in enumerate(zip(blocks, curves, strict=True), start=1):
        part = _solve(planner, problem, block, z, 0.0 if curve else share)
        lasts = starts[block[-1].index + 1] - starts[block[0].index]
        if part is None or (not curve and part.duration > 1.5 * lasts):
            return None
        found += part.motions
        z = part.z[-1]
        away = np.abs(z - plan.z[np.flatnonzero(plan.phase == block[-1].index)[-1]])
        away[:2] /= problem.scene.scales.length
        if away.max() < SAME:
            return found, count
    return None


def _solve(
    planner: Planner, problem: Problem, phases: Sequence[Phase], z: Array, share: float
) -> Trajectory | None:
    """Plan of phases from a configuration at rest, with a share of the margin."""
    scene, room = problem.scene, share * ROOM
    one, two = (
        replace(link, torque_limit=(1 - room) * link.torque_limit) for link in scene.fingers
    )
    tightened = replace(
        problem,
        start=z,
        epsilon=max(problem.epsilon, room * scene.scales.force),
        scene=replace(scene, fingers=(one, two)),
        phases=tuple(replace(phase, index=k) for k, phase in enumerate(phases)),
    )
    try:
        return planner(tightened)
    except WholearmError:
        return None


def _pin(phase: Phase, z: Array) -> Phase:
    """The phase with terminal constraints on the free coordinates of the pose of z, shape (5,)."""
    until = phase.until
    fixed = {row for row, _ in until.poses}
    gained = until.contact is not None
    freedoms = len(z) - len(phase.formation.contacts) - gained - len(fixed)
    names = [name for name in ("x", "phi") if ROWS[name] not in fixed][: max(freedoms, 0)]
    pins = tuple((name, float(z[ROWS[name]])) for name in names)
    return replace(phase, until=replace(until, pins=until.pins + pins))


def find_widest(problem: Problem, plan: Trajectory, delay: float) -> dict[int, float]:
    """The largest factor on the ranges of each phase along a curve, by its number.

    It is at most 64, and no relative range exceeds `SETTINGS.widest`. The delay [s] is
    that of the torques, as far as known. InputError if neither plan nor problem have ranges.
    """
    ranges = find_ranges(problem, plan)
    if ranges is None:
        raise InputError("", "uncertainty", "is missing; without ranges none is the widest")
    relative = max(ranges.get(p.name, 0.0) for p in PARAMETERS if not p.unit)
    most = min(SETTINGS.widest / relative, 64.0) if relative > 0 else 64.0
    along = [_find_curve(block) for block in split(problem.phases)]
    pieces = trace_pieces(problem, along, plan, most, scale_ranges(ranges, most, delay))
    return {
        phase.number: most * piece.share
        for phase, piece in zip(along, pieces, strict=True)
        if phase is not None and piece is not None
    }
