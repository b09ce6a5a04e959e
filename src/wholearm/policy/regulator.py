"""Time-varying linear-quadratic regulator along phases with several degrees of freedom.

Displacements N xi that the contacts leave free are measured by the joints as theta = Theta xi; xi
are the best conditioned coordinates of z. About the plan xi'' = A1 xi + A2 xi' + B tau.
Displacements and accelerations are weighted by the metric of arc length, torques also by the
relative contact forces that they cause; the Riccati equation is integrated backwards. The inverse
of Theta is damped: where joints hardly move with the object, errors of geometry would pass for
large displacements. Phases without a margin of forces and torques for feedback are planned again.
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

END_TOLERANCE = 1e-5  # of the distance from the plan's end, over the scene's length and in rad
APPROACH_RATIO = 4.0  # joint speed beyond the end, over the speed of rest
REST_SPEED = 1e-3  # largest speed of rest, over the scene's
Planner = Callable[[Problem], Trajectory]  # plan of a problem
RATE = 100.0  # rate at which errors decay if torques change no contact force [1/s]
SIGNS = {"+": 1.0, "-": -1.0, "rolls": 0.0}
# Largest gap that torques at an end close, over the scene's length. Case: with a fifth of it query
# 48, phase 6.
GAP = 0.015
ANGLE_COST = 0.02  # angle error that costs as much as a torque equal to its limit [rad]
DAMPING = 0.3  # of the inverse of Theta, which is 1 where the joints alone move. Case: heptagon
# Margin for feedback: normal force over the scene's unit, torque over its limit. Case: heptagon.
FORCE_MARGIN, TORQUE_MARGIN = 0.6, 0.1
# Options for blocks that are planned again; the first one with a plan is used. Fraction of the path
# to the block's end at which the policy stops for a release whose place the planner chose (None: no
# stop); fraction of the margin; largest ratio of durations. Cases: heptagon, where the released v3
# touches finger 1 again; last one: query 18, and query 12, which loses a contact at a ratio of 1.4.
REPLAN_OPTIONS = (
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
    slack: Array  # (n, m, 5): slack over margins, coefficients as of `forces`

    def scale(self, b: float) -> tuple[float, Array, Array]:
        """Least slack, c, (n, n_c + R) [N], and tau, (n, 2) [N m], at `b` times the squared speed.

        The internal force is optimized: with that of the plan a rolling contact would slip at
        another speed. Case: query 1, phase 5.
        """
        zero, squares = np.zeros(len(self.z)), np.full(len(self.z), b)
        slack, internal = find_internal_force(self.slack, zero, squares)
        motion = zero, squares, internal
        return float(slack.min()), self.forces.c(*motion), self.forces.tau(*motion)


def find_internal_force(slack: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """Max-min normalized slack for a motion, and the internal force that has it, shape (n,).

    `slack`, (n, m, 5), is linear in (1, a, b, s', internal force).
    """
    base = apply(slack, a, b, np.zeros_like(b))
    lines = np.stack([base, slack[..., LAMBDA]], axis=2).tolist()
    least, internal = np.array([choose_internal_force(line) for line in lines]).T
    return least, internal


def track(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, t: Array
) -> tuple[float, Array, Array, bool]:
    """Squared speed over the plan's, tau, (n, 2) [N m], and gains, (n, 2, 4), at n even times.

    The speed is that with the largest least slack of normal forces and torques. The last value is
    whether the last torques press all contacts in a slow motion.
    """
    starts, step = plan.phase_starts, float(t[1] - t[0])

    def divide(t: Array) -> list[RegulatedStretch]:
        phase_index = np.searchsorted(starts, t, side="right") - 1
        phase_index = phase_index.clip(phases[0].index, phases[-1].index)
        times = [(phase, t[phase_index == phase.index]) for phase in phases]
        return [part for phase, instants in times for part in split_modes(phase, plan, instants)]

    parts = divide(t)
    speeds = (1 - 0.05 * k for k in range(11))
    b = max(speeds, key=lambda b: min(part.scale(b)[0] for part in parts))
    linearizations = [row for part in parts for row in _linearise(problem, part, b)]
    # Mean torques of a period have the plan's impulse, also where it steps.
    instants = np.clip(t[:, None] + step * (np.arange(8) - 3.5) / 8, t[0], t[-1]).ravel()
    torques = np.concatenate([part.scale(b)[2] for part in divide(instants)])
    tau = torques.reshape(-1, 8, 2).mean(axis=1)
    # Beyond the end the motion goes on slowly, if that presses all contacts.
    _, c, rest_torque = parts[-1].scale(0.0)
    presses = c[-1, : parts[-1].formation.n_contacts].min() > 0.0
    if presses:
        tau[-1] = rest_torque[-1]
    return b, tau, regulate(linearizations, step / np.sqrt(b)), bool(presses)


def split_modes(phase: Phase, plan: Trajectory, t: Array) -> Iterator[RegulatedStretch]:
    """Stretches with constant contact modes at instants `t` of a phase of a plan.

    Accelerations and forces follow from the torques: interpolated ones of a loaded plan miss the
    steps at changes of modes.

    InputError if the plan has no spans of contact modes of the phase, as one along a curve.
    """
    phases, names = plan.meta.get("modes", []), phase.formation.names
    spans = phases[phase.index] if phase.index < len(phases) else ()
    if not spans:
        text = f"has no spans of phase {phase.number}, which the policy follows over time"
        raise InputError("", "meta.modes", text)
    starts = [span["start"] for span in spans[1:]]
    span_index = np.searchsorted(starts, t - plan.phase_starts[phase.index], side="right")
    for k in sorted(set(span_index.tolist())):
        modes = [spans[k]["contacts"][name] for name in names]
        pairs = zip(phase.formation.contacts, modes, strict=True)
        rolling = tuple(contact for contact, mode in pairs if mode == "rolls")
        formation, times = replace(phase.formation, rolling=rolling), t[span_index == k]
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
        margins = np.where(torque, TORQUE_MARGIN, FORCE_MARGIN * weights)
        values = find_value_rows(limits, forces, v[:, 3:])
        slack = find_slack_rows(limits, values) / margins[:, None]
        yield RegulatedStretch(formation, z, v, directions, forces, slack)


def _linearise(problem: Problem, part: RegulatedStretch, b: float) -> list[Linear]:
    """Linearization of a part of a plan at `b` times its squared speed, by finite differences."""
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
    force_gains = np.zeros((n, formation.n_contacts, 2))
    for k in range(2):
        shifted, shifted_forces = move(z, v, tau + np.eye(2)[k])
        B[:, :, k] = (shifted - rest)[:, rows]
        force_gains[:, :, k] = shifted_forces - forces
    for k in range(f):
        moved = z + step * N[:, :, k]
        basis = _span(formation, formation.evaluate(moved, v).P)
        basis = basis @ np.linalg.inv(basis[:, rows])
        shifted, _ = move(moved, np.einsum("nif,nf->ni", basis, speed), tau)
        A[:, f:, k] = (shifted - rest)[:, rows] / step
        rate = step / scales.time
        shifted, _ = move(z, v + rate * N[:, :, k], tau)
        A[:, f:, f + k] = (shifted - rest)[:, rows] / rate
    # Doubling a contact force of at least 0.05 units costs as much as 0.1 units of acceleration.
    relative = force_gains / np.maximum(np.abs(forces), 0.05 * scales.force)[:, :, None]
    unit = 0.1 * scales.acceleration / scales.length
    cost = B.transpose(0, 2, 1) @ metric @ B + unit**2 * relative.transpose(0, 2, 1) @ relative
    cost += np.diag((RATE**2 * ANGLE_COST / problem.scene.torque_limit) ** 2)
    return [Linear(rows, *arrays) for arrays in zip(N, metric, A, B, cost, strict=True)]


def _span(formation: Formation, P: Array) -> Array:
    """Basis of the null space of constraints, orthonormal in arc length, shape (n, 5, f)."""
    lengths = np.sqrt(metric_weights(formation.scene))
    free = np.linalg.svd(P / lengths)[2][:, P.shape[1] :]
    return np.asarray(free.transpose(0, 2, 1) / lengths[:, None])


def regulate(linearizations: list[Linear], step: float) -> Array:
    """Gains (n, 2, 4) by the discrete Riccati equation, integrated back from the end."""
    from scipy.linalg import cholesky, solve_continuous_are

    gains, P, next_rows = np.zeros((len(linearizations), 2, 4)), np.zeros((0, 0)), list[int]()
    for k, linear in reversed(list(enumerate(linearizations))):
        N, f = linear.N, linear.N.shape[1]
        Q = np.kron(np.diag([RATE**4, 2 * RATE**2]), linear.metric)
        inputs = np.vstack([np.zeros((f, 2)), linear.B])
        if not P.size:
            P = solve_continuous_are(linear.A, inputs, Q, linear.cost)
        elif next_rows != linear.rows:
            transform = np.kron(np.eye(2), N[next_rows])
            P = transform.T @ P @ transform
        next_rows = linear.rows
        A_d = np.eye(2 * f) + step * linear.A + (step * linear.A) @ (step * linear.A) / 2
        B_d = (step * np.eye(2 * f) + step**2 * linear.A / 2) @ inputs
        K = np.linalg.solve(step * linear.cost + B_d.T @ P @ B_d, B_d.T @ P @ A_d)
        P = step * Q + A_d.T @ P @ (A_d - B_d @ K)
        P = (P + P.T) / 2
        # Damped inverse of Theta, in coordinates in which lengths are arc lengths.
        to_length = np.linalg.inv(cholesky(linear.metric))
        Theta = N[3:] @ to_length
        inverse = to_length @ Theta.T @ np.linalg.inv(Theta @ Theta.T + DAMPING**2 * np.eye(2))
        gains[k] = K @ np.kron(np.eye(2), inverse)
    return gains


def tabulate_motion(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, period: float
) -> dict[str, Array]:
    """Arrays of `TimeLaw`."""
    starts = plan.phase_starts[phases[0].index : phases[-1].index + 2].copy()
    starts[-1] = plan.t[(plan.phase == phases[-1].index) & ~plan.held][-1]
    count = max(int(np.ceil((starts[-1] - starts[0]) / period)), 2)
    # At the very end the contacts of the next phase hold.
    latest = np.nextafter(plan.phase_starts[phases[-1].index + 1], 0.0)
    t = np.minimum(np.linspace(starts[0], starts[-1], count + 1), latest)
    samples, last = plan.at(t), phases[-1]
    hold = hold_end(problem, last, samples.z[-1])
    inertia = np.diag([finger.inertia for finger in problem.scene.fingers])
    # At the end each joint is critically damped, in contact or not.
    final = np.hstack([RATE**2 * inertia, 2 * RATE * inertia])
    b, tau, gains, presses = track(problem, phases, plan, t)
    speed = np.sqrt(b)
    rest_speed = REST_SPEED * problem.scene.scales.rate
    # Orthonormal basis of the joint displacements that the contacts at the end leave free.
    closed = last.formation.add(last.until.contact)
    free = _span(closed, closed.evaluate(samples.z[-1:], np.zeros((1, 5))).P)[0].T
    basis, sizes, _ = np.linalg.svd(free[:, 3:].T, full_matrices=False)
    directions = basis.T[sizes > 1e-3 / np.sqrt(metric_weights(problem.scene))[3]]
    # Direction of approach: the last motion of the joints across the free displacements.
    approach = samples.z[-1, 3:] - samples.z[-2, 3:]
    approach = approach - directions.T @ (directions @ approach)
    size = np.linalg.norm(approach) if presses and last.until.contact is not None else 0.0
    return {
        "approach": approach * (APPROACH_RATIO * rest_speed / size if size else 0.0),
        "starts": (starts[:-1] - starts[0]) / speed,
        "step": np.array([(t[1] - t[0]) / speed]),
        "theta": samples.z[:, 3:],
        "rates": samples.z_dot[:, 3:] * speed,
        "tau": tau,
        "gain": np.concatenate([gains[:-1], final[None]]),
        "push": samples.tau[-1] if hold is None else hold,
        "still": np.array([rest_speed]),
        "ways": directions,
    }


def hold_end(problem: Problem, phase: Phase, z: Array) -> Array | None:
    """Torques that hold all contacts at the end of a phase at rest, or None."""
    standstill, gap = find_standstill(problem, phase, z), GAP * problem.scene.scales.length
    hold = find_hold(standstill, problem.epsilon, gap)
    return None if hold is None else hold.tau


PhaseParts = tuple[Motion, TorqueProfile, Any]
"""Motion of a phase, torques from its start on, and spans of its contact modes."""


def list_phases(plan: Trajectory) -> list[PhaseParts]:
    """The phases of a plan."""
    torques = [plan.torque.cut(*span) for span in pairwise(plan.phase_starts.tolist())]
    torques = [replace(torque, breaks=torque.breaks - torque.breaks[0]) for torque in torques]
    return list(zip(plan.motions, torques, plan.meta["modes"], strict=True))


def replan(planner: Planner, problem: Problem, plan: Trajectory) -> tuple[Problem, Trajectory]:
    """Phases and plan, with blocks over time planned again with a margin, where possible."""
    blocks, phases, parts = split_blocks(problem), list[Phase](), list[PhaseParts]()
    while blocks:
        (block, *following), replacement = blocks, list[PhaseParts]()
        if not runs_on_curves(block) and _lacks_margin(problem, block, plan):
            for stop, part, ratio in REPLAN_OPTIONS:
                if split := _stop_at_release(block, plan, stop):
                    candidate = [*split, *following]
                    replacement = _replan_blocks(planner, problem, candidate, plan, part, ratio)
                if replacement:
                    blocks = candidate
                    break
        parts += replacement or list_phases(plan)[block[0].index : block[-1].index + 1]
        while blocks and blocks[0][0].index < len(parts):
            phases += blocks.pop(0)
    samples = int(np.bincount(plan.phase).max())
    motions, torques, modes = zip(*parts, strict=True)
    meta = {**plan.meta, "modes": [*modes]}
    new_plan = assemble(motions, TorqueProfile.chain(torques), meta, samples)
    return replace(problem, phases=tuple(phases)), new_plan


def _stop_at_release(
    block: tuple[Phase, ...], plan: Trajectory, fraction: float | None
) -> list[tuple[Phase, ...]]:
    """The block with a stop in place of its release; empty if it does not begin with a release."""
    first = block[0]
    if fraction is None:
        return [block]
    if not first.until.is_release or first.formation.n_constraints != 4:
        return []
    rows = (plan.phase >= first.index) & (plan.phase <= block[-1].index)
    start, end = plan.z[rows][[0, -1]]
    name = "phi" if abs(end[2] - start[2]) > END_TOLERANCE else "x"
    row = ROWS[name]
    value = float(start[row] + fraction * (end[row] - start[row]))
    until = replace(first.until, coordinate=name, value=value)
    return [(replace(first, end=End.REST, until=until),), block[1:]]


def _lacks_margin(problem: Problem, phases: Sequence[Phase], plan: Trajectory) -> bool:
    """Whether a normal force or a torque in these phases has less than the margin."""
    rows = (plan.phase >= phases[0].index) & (plan.phase <= phases[-1].index)
    scene = problem.scene
    torque_use = (np.abs(plan.tau[rows]) / scene.torque_limit).max()
    least_force = np.nanmin(plan.c_n[rows]) / scene.scales.force
    return bool(least_force < 0.99 * FORCE_MARGIN or 1 - torque_use < 0.99 * TORQUE_MARGIN)


def _replan_blocks(
    planner: Planner,
    problem: Problem,
    blocks: Sequence[tuple[Phase, ...]],
    plan: Trajectory,
    fraction: float,
    max_ratio: float,
) -> list[PhaseParts]:
    """Phases with a fraction of the margin until the plan is reached again, or none.

    Phases with several freedoms last at most `max_ratio` times as long as in the plan.
    """
    starts, phases, scene = plan.phase_starts, list[PhaseParts](), problem.scene
    z = plan.z[np.flatnonzero(plan.phase == blocks[0][0].index)[0]]
    blocks = [*blocks[:-1], (*blocks[-1][:-1], _fix_end(blocks[-1][-1], plan.z[-1]))]
    for block in blocks:
        curve = runs_on_curves(block)
        margin = 0.0 if curve else fraction
        scale = 1 - margin * TORQUE_MARGIN
        finger1, finger2 = (replace(f, torque_limit=scale * f.torque_limit) for f in scene.fingers)
        tightened = replace(
            problem,
            start=z,
            epsilon=max(problem.epsilon, margin * FORCE_MARGIN * scene.scales.force),
            scene=replace(scene, fingers=(finger1, finger2)),
            phases=tuple(replace(phase, index=k) for k, phase in enumerate(block)),
        )
        try:
            part = planner(tightened)
        except WholearmError:
            return []
        planned_duration = starts[block[-1].index + 1] - starts[block[0].index]
        if not curve and part.duration > max_ratio * planned_duration:
            return []
        phases += list_phases(part)
        z = part.z[-1]
        distance = np.abs(z - plan.z[np.flatnonzero(plan.phase == block[-1].index)[-1]])
        distance[:2] /= scene.scales.length
        if distance.max() < END_TOLERANCE:
            return phases
    return []


def _fix_end(phase: Phase, z: Array) -> Phase:
    """The phase with terminal constraints on the free coordinates of the pose of z, shape (5,)."""
    until, fixed = phase.until, dict(phase.until.coordinates)
    n_closed = len(phase.formation.contacts) + (until.contact is not None)
    freedoms = len(z) - n_closed - len(fixed)
    names = [name for name in ("x", "phi") if name not in fixed][: max(freedoms, 0)]
    pins = tuple((name, float(z[ROWS[name]])) for name in names)
    return replace(phase, until=replace(until, pins=until.pins + pins))
