"""Time-varying linear-quadratic regulator along phases with several degrees of freedom.

Displacements N xi that the contacts leave free are measured by the joints as theta = Theta xi; xi
are the coordinates of z that determine them best. About the plan xi'' = A1 xi + A2 xi' + B tau.
Displacements and accelerations are weighted by the metric of arc length, torques also by the
relative contact forces that they cause; the Riccati equation is integrated backwards. The inverse
of Theta is damped: where joints hardly move with the object, errors of geometry would pass for
large displacements. Phases that leave the feedback no margin of forces and torques are planned anew
with one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, WholearmError
from ..contacts.formation import CurvePoint, Formation
from ..geometry.tracing import runs_on_curves, split_blocks
from ..mechanics.dynamics import (
    LAMBDA,
    Directions,
    PathForces,
    apply,
    forward,
    inverse,
    metric_weights,
)
from ..mechanics.limits import SPEED, TORQUE, make_limits
from ..mechanics.path_limits import find_slack_rows, find_value_rows
from ..problem.definition import ROWS, End, Phase, Problem
from ..results.dwell_record import assemble
from ..results.torque import TorqueProfile
from ..results.trajectory import Motion, Trajectory
from ..simulation.modes import find_hold, find_standstill
from .curve_law import choose_internal_force

SAME = 1e-5  # distance from the plan's end that counts as none, over the scene's length and in rad
APPROACH = 4.0  # joint speed beyond the end, over that which counts as none
STILL = 1e-3  # speed that counts as none, over the scene's
Planner = Callable[[Problem], Trajectory]  # makes a plan of a problem
RATE = 100.0  # rate at which errors decay if torques change no contact force [1/s]
SIGNS = {"+": 1.0, "-": -1.0, "rolls": 0.0}
# From how far open torques at an end close its contact, over the scene's length. Case: with a fifth
# of it query 48, phase 6.
GAP = 0.015
WORTH = 0.02  # angle error that is worth a whole torque limit in the cost [rad]
DAMPING = 0.3  # of the inverse of Theta, which is 1 where the joints alone move. Case: heptagon
# Margin for feedback: normal force over the scene's unit, share of a torque limit. Case: heptagon.
PRESS, ROOM = 0.6, 0.1
# Where a release has a place of the planner's choice, the policy stops for it, at such a share of
# the way to the block's end, or does not stop, keeps such a share of the margin, and takes at most
# so many times as long: the first that has a plan. Cases: heptagon, where the released v3 touches
# finger 1 again; for the last query 18, and query 12, which loses a contact in 1.4 times the time.
STOPS = (
    (0.8, 1.0, 1.5),
    (0.5, 1.0, 1.5),
    (None, 1.0, 1.5),
    (None, 0.5, 1.5),
    (None, 0.25, 1.5),
    (None, 0.125, 1.2),
)


class Linear(NamedTuple):
    """Linearization of a plan at an instant."""

    rows: list[int]  # of z: the coordinates xi
    N: Array  # (5, f)
    metric: Array  # (f, f): squared arc length of xi, 1 for a joint alone
    A: Array  # (2 f, 2 f)
    B: Array  # (f, 2)
    cost: Array  # (2, 2): of torques


class RegulatedStretch(NamedTuple):
    """A part of a plan with constant contact modes, at n instants."""

    formation: Formation
    z: Array
    z_dot: Array
    directions: Directions
    forces: PathForces  # with time as the path parameter
    levels: Array  # (n, m, 5): limits over their margins, coefficients as of `forces`

    def scale(self, b: float) -> tuple[float, Array, Array]:
        """Least level, c, (n, n_c + R) [N], and tau, (n, 2) [N m], at `b` times the squared speed.

        With the best internal force: that of the plan would let a rolling contact slip at another
        speed. Case: query 1, phase 5.
        """
        zero, b_of_all = np.zeros(len(self.z)), np.full(len(self.z), b)
        level, internal = find_internal_force(self.levels, zero, b_of_all)
        motion = zero, b_of_all, internal
        return float(level.min()), self.forces.c(*motion), self.forces.tau(*motion)


def find_internal_force(levels: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """The largest least level for a motion, and the internal force that has it, shape (n,).

    `levels`, (n, m, 5), are limits over their margins, linear in (1, a, b, s', internal force).
    """
    base = apply(levels, a, b, np.zeros_like(b))
    lines = np.stack([base, levels[..., LAMBDA]], axis=2).tolist()
    level, internal = np.array([choose_internal_force(each) for each in lines]).T
    return level, internal


def follow(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, t: Array
) -> tuple[float, Array, Array, bool]:
    """Squared speed over the plan's, tau, (n, 2) [N m], and gains, (n, 2, 4), at n even times.

    The speed is that with the largest least margin of normal forces and torques. Last comes whether
    the last torques press all contacts in a slow motion.
    """
    starts, step = plan.phase_starts, float(t[1] - t[0])

    def divide(t: Array) -> list[RegulatedStretch]:
        owner = np.searchsorted(starts, t, side="right") - 1
        owner = owner.clip(phases[0].index, phases[-1].index)
        times = [(phase, t[owner == phase.index]) for phase in phases]
        return [part for phase, each in times for part in split_modes(phase, plan, each)]

    parts = divide(t)
    speeds = (1 - 0.05 * k for k in range(11))
    b = max(speeds, key=lambda b: min(part.scale(b)[0] for part in parts))
    linearizations = [row for part in parts for row in _linearise(problem, part, b)]
    # Mean torques of a period have the plan's impulse, also where it steps.
    within = np.clip(t[:, None] + step * (np.arange(8) - 3.5) / 8, t[0], t[-1]).ravel()
    torques = np.concatenate([part.scale(b)[2] for part in divide(within)])
    tau = torques.reshape(-1, 8, 2).mean(axis=1)
    # Beyond the end the motion goes on slowly, where that presses all contacts.
    _, c, still = parts[-1].scale(0.0)
    slow = c[-1, : parts[-1].formation.n_contacts].min() > 0.0
    if slow:
        tau[-1] = still[-1]
    return b, tau, regulate(linearizations, step / np.sqrt(b)), bool(slow)


def split_modes(phase: Phase, plan: Trajectory, t: Array) -> Iterator[RegulatedStretch]:
    """Stretches with constant contact modes at instants of a phase of a plan.

    Accelerations and forces are those of the torques: between the samples of a loaded plan they
    step where modes change.

    InputError if the plan has no spans of contact modes of the phase, as one along a curve.
    """
    phases, names = plan.meta.get("modes", []), phase.formation.names
    spans = phases[phase.index] if phase.index < len(phases) else ()
    if not spans:
        text = f"has no spans of phase {phase.number}, which the policy follows over time"
        raise InputError("", "meta.modes", text)
    begins = [span["start"] for span in spans[1:]]
    owner = np.searchsorted(begins, t - plan.phase_starts[phase.index], side="right")
    for k in sorted(set(owner.tolist())):
        modes = [spans[k]["contacts"][name] for name in names]
        pairs = zip(phase.formation.contacts, modes, strict=True)
        rolling = tuple(contact for contact, mode in pairs if mode == "rolls")
        formation, times = replace(phase.formation, rolling=rolling), t[owner == k]
        signs = np.tile([SIGNS[mode] for mode in (*modes, *spans[k]["joints"])], (len(times), 1))
        directions = Directions(*np.split(signs, [formation.n_contacts], axis=1))
        samples = plan.at(times)
        z, v = samples.z, samples.z_dot
        kinematics = formation.evaluate(z, v)
        acceleration, _ = forward(formation, kinematics, v, plan.torque.at(times), directions)
        forces = inverse(formation, CurvePoint(z, v, acceleration, kinematics), directions)
        limits = make_limits(formation, 0.0).without(SPEED)
        weights = np.concatenate([limit.weight for limit in limits.limits])[limits.sides[0]]
        torque = np.isin(limits.sides[0], limits.of(TORQUE))
        margins = np.where(torque, ROOM, PRESS * weights)
        values = find_value_rows(limits, forces, v[:, 3:])
        levels = find_slack_rows(limits, values) / margins[:, None]
        yield RegulatedStretch(formation, z, v, directions, forces, levels)


def _linearise(problem: Problem, part: RegulatedStretch, b: float) -> list[Linear]:
    """Linearization of a part of a plan at a squared speed `b` over the plan's, by differences."""
    formation, scales, n = part.formation, problem.scene.scales, len(part.z)
    z, v, (_, _, tau) = part.z, part.z_dot * np.sqrt(b), part.scale(b)
    weights, step = metric_weights(formation.scene), 1e-6

    def move(z: Array, v: Array, tau: Array) -> tuple[Array, Array]:
        acceleration, c = forward(formation, formation.evaluate(z, v), v, tau, part.directions)
        return acceleration, c[:, : formation.n_contacts]

    N = _span(formation, formation.evaluate(z, v).P)
    f = N.shape[2]
    choices = [list(rows) for rows in combinations(range(5), f)]
    rows = max(choices, key=lambda rows: np.abs(np.linalg.det(N[:, rows])).min())
    N = N @ np.linalg.inv(N[:, rows])
    metric = np.einsum("nif,i,nig->nfg", N, weights / weights[3], N)
    speed = v[:, rows]
    rest, forces = move(z, v, tau)
    A, B = np.zeros((n, 2 * f, 2 * f)), np.zeros((n, f, 2))
    A[:, :f, f:] = np.eye(f)
    press = np.zeros((n, formation.n_contacts, 2))
    for k in range(2):
        shifted, pressed = move(z, v, tau + np.eye(2)[k])
        B[:, :, k] = (shifted - rest)[:, rows]
        press[:, :, k] = pressed - forces
    for k in range(f):
        place = z + step * N[:, :, k]
        other = _span(formation, formation.evaluate(place, v).P)
        other = other @ np.linalg.inv(other[:, rows])
        shifted, _ = move(place, np.einsum("nif,nf->ni", other, speed), tau)
        A[:, f:, k] = (shifted - rest)[:, rows] / step
        rate = step / scales.time
        shifted, _ = move(z, v + rate * N[:, :, k], tau)
        A[:, f:, f + k] = (shifted - rest)[:, rows] / rate
    # Doubling a contact force, at least 0.05 units, costs as much as 0.1 units of acceleration.
    share = press / np.maximum(np.abs(forces), 0.05 * scales.force)[:, :, None]
    unit = 0.1 * scales.acceleration / scales.length
    cost = B.transpose(0, 2, 1) @ metric @ B + unit**2 * share.transpose(0, 2, 1) @ share
    cost += np.diag((RATE**2 * WORTH / problem.scene.torque_limit) ** 2)
    return [Linear(rows, *arrays) for arrays in zip(N, metric, A, B, cost, strict=True)]


def _span(formation: Formation, P: Array) -> Array:
    """Basis of the null space of constraints, orthonormal in arc length, shape (n, 5, f)."""
    lengths = np.sqrt(metric_weights(formation.scene))
    free = np.linalg.svd(P / lengths)[2][:, P.shape[1] :]
    return np.asarray(free.transpose(0, 2, 1) / lengths[:, None])


def regulate(linearizations: list[Linear], step: float) -> Array:
    """Gains (n, 2, 4) by the discrete Riccati equation, integrated back from the end."""
    from scipy.linalg import cholesky, solve_continuous_are

    gains, P, after = np.zeros((len(linearizations), 2, 4)), np.zeros((0, 0)), list[int]()
    for k, linear in reversed(list(enumerate(linearizations))):
        N, f = linear.N, linear.N.shape[1]
        Q = np.kron(np.diag([RATE**4, 2 * RATE**2]), linear.metric)
        inputs = np.vstack([np.zeros((f, 2)), linear.B])
        if not P.size:
            P = solve_continuous_are(linear.A, inputs, Q, linear.cost)
        elif after != linear.rows:
            turn = np.kron(np.eye(2), N[after])
            P = turn.T @ P @ turn
        after = linear.rows
        rate = np.eye(2 * f) + step * linear.A + (step * linear.A) @ (step * linear.A) / 2
        drive = (step * np.eye(2 * f) + step**2 * linear.A / 2) @ inputs
        K = np.linalg.solve(step * linear.cost + drive.T @ P @ drive, drive.T @ P @ rate)
        P = step * Q + rate.T @ P @ (rate - drive @ K)
        P = (P + P.T) / 2
        # In coordinates in which lengths are arc lengths.
        unit = np.linalg.inv(cholesky(linear.metric))
        Theta = N[3:] @ unit
        inverse = unit @ Theta.T @ np.linalg.inv(Theta @ Theta.T + DAMPING**2 * np.eye(2))
        gains[k] = K @ np.kron(np.eye(2), inverse)
    return gains


def tabulate_motion(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, period: float
) -> dict[str, Array]:
    """Arrays of `MotionLaw`."""
    starts = plan.phase_starts[phases[0].index : phases[-1].index + 2].copy()
    starts[-1] = plan.t[(plan.phase == phases[-1].index) & ~plan.held][-1]
    count = max(int(np.ceil((starts[-1] - starts[0]) / period)), 2)
    # At the very end the contacts of the next phase hold.
    within = np.nextafter(plan.phase_starts[phases[-1].index + 1], 0.0)
    t = np.minimum(np.linspace(starts[0], starts[-1], count + 1), within)
    samples, last = plan.at(t), phases[-1]
    hold = hold_end(problem, last, samples.z[-1])
    inertia = np.diag([finger.inertia for finger in problem.scene.fingers])
    # At the end each joint is critically damped, in contact or not.
    final = np.hstack([RATE**2 * inertia, 2 * RATE * inertia])
    b, tau, gains, slow = follow(problem, phases, plan, t)
    speed = np.sqrt(b)
    still = STILL * problem.scene.scales.rate
    # Orthonormal basis of the joint displacements that the contacts at the end leave free.
    both = last.formation.add(last.until.contact)
    left = _span(both, both.evaluate(samples.z[-1:], np.zeros((1, 5))).P)[0].T
    basis, sizes, _ = np.linalg.svd(left[:, 3:].T, full_matrices=False)
    ways = basis.T[sizes > 1e-3 / np.sqrt(metric_weights(problem.scene))[3]]
    # Towards the contact, across what it leaves free.
    heading = samples.z[-1, 3:] - samples.z[-2, 3:]
    heading = heading - ways.T @ (ways @ heading)
    size = np.linalg.norm(heading) if slow and last.until.contact is not None else 0.0
    return {
        "approach": heading * (APPROACH * still / size if size else 0.0),
        "starts": (starts[:-1] - starts[0]) / speed,
        "step": np.array([(t[1] - t[0]) / speed]),
        "theta": samples.z[:, 3:],
        "rates": samples.z_dot[:, 3:] * speed,
        "tau": tau,
        "gain": np.concatenate([gains[:-1], final[None]]),
        "push": samples.tau[-1] if hold is None else hold,
        "still": np.array([still]),
        "ways": ways,
    }


def hold_end(problem: Problem, phase: Phase, z: Array) -> Array | None:
    """Torques that hold all contacts at the end of a phase at rest, or None."""
    place, gap = find_standstill(problem, phase, z), GAP * problem.scene.scales.length
    hold = find_hold(place, problem.epsilon, gap)
    return None if hold is None else hold.tau


PhaseParts = tuple[Motion, TorqueProfile, Any]
"""Motion of a phase, torques from its start on, and spans of its contact modes."""


def list_phases(plan: Trajectory) -> list[PhaseParts]:
    """The phases of a plan."""
    torques = [plan.torque.cut(*span) for span in pairwise(plan.phase_starts.tolist())]
    torques = [replace(torque, breaks=torque.breaks - torque.breaks[0]) for torque in torques]
    return list(zip(plan.motions, torques, plan.meta["modes"], strict=True))


def replan(planner: Planner, problem: Problem, plan: Trajectory) -> tuple[Problem, Trajectory]:
    """Phases and plan with blocks off curves planned anew, with a margin, where possible."""
    blocks, phases, parts = split_blocks(problem), list[Phase](), list[PhaseParts]()
    while blocks:
        (block, *later), replacement = blocks, list[PhaseParts]()
        if not runs_on_curves(block) and _lacks_margin(problem, block, plan):
            for stop, share, longest in STOPS:
                if stopped := _stop(block, plan, stop):
                    rest = [*stopped, *later]
                    replacement = _replan_blocks(planner, problem, rest, plan, share, longest)
                if replacement:
                    blocks = rest
                    break
        parts += replacement or list_phases(plan)[block[0].index : block[-1].index + 1]
        while blocks and blocks[0][0].index < len(parts):
            phases += blocks.pop(0)
    samples = int(np.bincount(plan.phase).max())
    motions, torques, modes = zip(*parts, strict=True)
    meta = {**plan.meta, "modes": [*modes]}
    whole = assemble(motions, TorqueProfile.chain(torques), meta, samples)
    return replace(problem, phases=tuple(phases)), whole


def _stop(
    block: tuple[Phase, ...], plan: Trajectory, share: float | None
) -> list[tuple[Phase, ...]]:
    """The block with a stop in place of its release, or nothing if it does not begin with one."""
    first = block[0]
    if share is None:
        return [block]
    if not first.until.is_release or first.formation.n_constraints != 4:
        return []
    rows = (plan.phase >= first.index) & (plan.phase <= block[-1].index)
    start, end = plan.z[rows][[0, -1]]
    name = "phi" if abs(end[2] - start[2]) > SAME else "x"
    row = ROWS[name]
    value = float(start[row] + share * (end[row] - start[row]))
    until = replace(first.until, coordinate=name, value=value)
    return [(replace(first, end=End.REST, until=until),), block[1:]]


def _lacks_margin(problem: Problem, phases: Sequence[Phase], plan: Trajectory) -> bool:
    """Whether a normal force or torque in some phases is nearer to its limit than the margin."""
    rows = (plan.phase >= phases[0].index) & (plan.phase <= phases[-1].index)
    scene = problem.scene
    most = (np.abs(plan.tau[rows]) / scene.torque_limit).max()
    least = np.nanmin(plan.c_n[rows]) / scene.scales.force
    return bool(least < 0.99 * PRESS or 1 - most < 0.99 * ROOM)


def _replan_blocks(
    planner: Planner,
    problem: Problem,
    blocks: Sequence[tuple[Phase, ...]],
    plan: Trajectory,
    share: float,
    longest: float,
) -> list[PhaseParts]:
    """Phases with a share of the margin until the plan is reached again; none if it is not.

    Those with several freedoms last at most `longest` times as long.
    """
    starts, phases, scene = plan.phase_starts, list[PhaseParts](), problem.scene
    z = plan.z[np.flatnonzero(plan.phase == blocks[0][0].index)[0]]
    blocks = [*blocks[:-1], (*blocks[-1][:-1], _pin(blocks[-1][-1], plan.z[-1]))]
    for block in blocks:
        curve = runs_on_curves(block)
        margin = 0.0 if curve else share
        ease = 1 - margin * ROOM
        one, two = (replace(f, torque_limit=ease * f.torque_limit) for f in scene.fingers)
        tightened = replace(
            problem,
            start=z,
            epsilon=max(problem.epsilon, margin * PRESS * scene.scales.force),
            scene=replace(scene, fingers=(one, two)),
            phases=tuple(replace(phase, index=k) for k, phase in enumerate(block)),
        )
        try:
            part = planner(tightened)
        except WholearmError:
            return []
        lasts = starts[block[-1].index + 1] - starts[block[0].index]
        if not curve and part.duration > longest * lasts:
            return []
        phases += list_phases(part)
        z = part.z[-1]
        away = np.abs(z - plan.z[np.flatnonzero(plan.phase == block[-1].index)[-1]])
        away[:2] /= scene.scales.length
        if away.max() < SAME:
            return phases
    return []


def _pin(phase: Phase, z: Array) -> Phase:
    """The phase with terminal constraints on the free coordinates of the pose of z, shape (5,)."""
    until, fixed = phase.until, dict(phase.until.coordinates)
    closed = len(phase.formation.contacts) + (until.contact is not None)
    freedoms = len(z) - closed - len(fixed)
    names = [name for name in ("x", "phi") if name not in fixed][: max(freedoms, 0)]
    pins = tuple((name, float(z[ROWS[name]])) for name in names)
    return replace(phase, until=replace(until, pins=until.pins + pins))
