"""Time-varying linear-quadratic regulator along phases with several degrees of freedom.

Displacements N xi that the contacts leave free are seen by the joints as theta = Theta xi; N is
scaled so that xi are the joint angles (two degrees of freedom), or their arc length (one). About
the plan xi'' = A1 xi + A2 xi' + B tau. Torques are weighted by the accelerations and the relative
contact forces that they cause; the Riccati equation is integrated backwards.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.sharing import Batch
from ..contacts.formation import Formation
from ..mechanics.dynamics import (
    LAMBDA,
    Directions,
    PathForces,
    build_forward,
    inverse,
    metric_weights,
)
from ..problem.definition import Phase, Problem
from ..results.trajectory import Trajectory

RATE = 100.0  # rate at which errors decay if torques change no contact force [1/s]
ROOM = 0.1  # margin for feedback: normal force over the scene's unit, share of a torque limit


class Linear(NamedTuple):
    """Linearization of a plan at an instant."""

    joints: Array  # (2, f): Theta
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
    internal: Array  # internal force of the plan

    def find_forces(self, b: float) -> Array:
        """Contact forces of the plan with its squared speed times `b`, (n, n_c + R) [N]."""
        return self.forces.c(np.zeros(len(self.z)), np.full(len(self.z), b), self.internal)

    def find_torques(self, b: float) -> Array:
        """Torques of the same, shape (n, 2) [N m]."""
        return self.forces.tau(np.zeros(len(self.z)), np.full(len(self.z), b), self.internal)


def end_within(phases: tuple[Phase, ...], plan: Trajectory, t: Array) -> Array:
    """Times in phases, kept below the end, at which the contacts of the next phase hold."""
    end = plan.phase_starts[phases[-1].index + 1]
    return np.asarray(np.minimum(t, np.nextafter(end, 0.0)))


def follow(
    problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, t: Array
) -> tuple[float, Array, Array]:
    """Squared speed over the plan's, torques and gains at even times in phases of a plan, (n,).

    The speed is that with the largest least margin of normal forces and torques.

    Returns
    -------
    b : float
    tau, gains : (n, 2) [N m] and (n, 2, 4)
    """
    starts, t = plan.phase_starts, end_within(phases, plan, t)
    owner = np.searchsorted(starts, t, side="right") - 1
    owner = owner.clip(phases[0].index, phases[-1].index)
    parts = [
        _stretch(formation, plan, times)
        for phase in phases
        for formation, times in _split_modes(phase, plan, t[owner == phase.index])
    ]
    scene = problem.scene
    unit, limit = ROOM * scene.scales.force, scene.torque_limit

    def find_margin(b: float) -> float:
        forces = [part.find_forces(b)[:, : part.formation.n_contacts].min() for part in parts]
        loads = [(np.abs(part.find_torques(b)) / limit).max() for part in parts]
        return float(min(min(forces) / unit, (1 - max(loads)) / ROOM))

    b = max((1 - 0.05 * k for k in range(11)), key=find_margin)
    found = [row for part in parts for row in _linearise(problem, part, b)]
    tau = np.concatenate([part.find_torques(b) for part in parts])
    return b, tau, regulate(found, float(t[1] - t[0]) / np.sqrt(b))


def _stretch(formation: Formation, plan: Trajectory, t: Array) -> RegulatedStretch:
    """A part of a plan at some instants."""
    samples = plan.at(t)
    z, v = samples.z, samples.z_dot
    kinematics = formation.evaluate(z, v)
    Xi, sigma = np.sign(np.einsum("nij,nj->ni", kinematics.A_t, v)), np.sign(v[:, 3:])
    # At rest directions are those of the nearest instant in motion.
    moves = np.flatnonzero(np.abs(v[:, 3:]).max(axis=1) > 1e-6 * formation.scene.scales.rate)
    near = moves[np.abs(moves[None] - np.arange(len(t))[:, None]).argmin(axis=1)]
    directions = Directions(Xi[near], sigma[near])
    forces = inverse(formation, z, v, samples.z_ddot, directions, kinematics)
    internal = find_planned_internal_force(formation, forces, plan, samples.c_n, samples.c_t)
    return RegulatedStretch(formation, z, v, directions, forces, internal)


def find_planned_internal_force(
    formation: Formation, forces: PathForces, plan: Trajectory, c_n: Array, c_t: Array
) -> Array:
    """Internal force of a plan at n instants, (n,) [N], from its contact forces c_n, c_t (n, m)."""
    columns = [plan.contacts.index(name) for name in formation.names]
    rolls = [columns[row] for row in formation.rolling_rows]
    c = np.hstack([c_n[:, columns], c_t[:, rolls]])
    # The other parts of the forces are orthogonal to that of the internal force.
    return np.asarray(np.einsum("ni,ni->n", c, forces.of_c[..., LAMBDA]))


def _split_modes(phase: Phase, plan: Trajectory, t: Array) -> list[tuple[Formation, Array]]:
    """Intervals of times in which the same contacts roll, with their formations."""
    mine = np.flatnonzero(plan.phase == phase.index)
    nearest = mine[np.abs(plan.t[mine][None] - t[:, None]).argmin(axis=1)]
    columns = [plan.contacts.index(name) for name in phase.formation.names]
    rolls = plan.rolling[nearest][:, columns]
    edges = [0, *(np.flatnonzero((rolls[1:] != rolls[:-1]).any(axis=1)) + 1).tolist(), len(t)]
    found = []
    for first, after in pairwise(edges):
        if after > first:
            pairs = zip(phase.formation.contacts, rolls[first], strict=True)
            rolling = tuple(contact for contact, rolls_now in pairs if rolls_now)
            found.append((replace(phase.formation, rolling=rolling), t[first:after]))
    return found


def _linearise(problem: Problem, part: RegulatedStretch, b: float) -> list[Linear]:
    """Linearization of a part of a plan at a squared speed `b` over the plan's, by differences."""
    formation, scales, n = part.formation, problem.scene.scales, len(part.z)
    z, v, tau = part.z, part.z_dot * np.sqrt(b), part.find_torques(b)
    (Xi, sigma), kinematics = part.directions, formation.evaluate(z, v)
    forward, step = Batch(build_forward(formation)), 1e-6

    def move(z: Array, v: Array, tau: Array) -> tuple[Array, Array]:
        acceleration, c, _ = forward(z, v, tau, Xi, sigma)
        return acceleration[:, 3:, 0], c[:, : formation.n_contacts, 0]

    N = _span(formation, kinematics.P)
    joints = N[:, 3:]
    back = np.linalg.pinv(joints)
    speed = np.einsum("nfi,ni->nf", back, v[:, 3:])
    rest, forces = move(z, v, tau)
    f = N.shape[2]
    A, B = np.zeros((n, 2 * f, 2 * f)), np.zeros((n, f, 2))
    A[:, :f, f:] = np.eye(f)
    press = np.zeros((n, formation.n_contacts, 2))
    for k in range(2):
        shifted, pressed = move(z, v, tau + np.eye(2)[k])
        B[:, :, k] = np.einsum("nfi,ni->nf", back, shifted - rest)
        press[:, :, k] = pressed - forces
    for k in range(f):
        place = z + step * N[:, :, k]
        other = _span(formation, formation.evaluate(place, v).P)
        other *= np.sign(np.einsum("nif,nif->nf", other, N))[:, None, :] if f == 1 else 1.0
        shifted, _ = move(place, np.einsum("nif,nf->ni", other, speed), tau)
        A[:, f:, k] = np.einsum("nfi,ni->nf", back, shifted - rest) / step
        rate = step / scales.time
        shifted, _ = move(z, v + rate * N[:, :, k], tau)
        A[:, f:, f + k] = np.einsum("nfi,ni->nf", back, shifted - rest) / rate
    # Doubling a contact force, at least 0.05 units, costs as much as 0.1 units of acceleration.
    share = press / np.maximum(np.abs(forces), 0.05 * scales.force)[:, :, None]
    unit = 0.1 * scales.acceleration / scales.length
    cost = B.transpose(0, 2, 1) @ B + unit**2 * share.transpose(0, 2, 1) @ share
    # An angle error of 0.02 rad is worth a whole torque limit: it bounds gains where joints hardly
    # show, or torques hardly change, the motion of the object.
    cost += np.diag((RATE**2 * 0.02 / problem.scene.torque_limit) ** 2)
    return [Linear(*row) for row in zip(joints, A, B, cost, strict=True)]


def _span(formation: Formation, P: Array) -> Array:
    """Basis of the null space of constraints, shape (n, 5, f), scaled by its joint angles."""
    metric = np.sqrt(metric_weights(formation.scene))
    free = 5 - P.shape[1]
    N = np.linalg.svd(P / metric)[2][:, 5 - free :].transpose(0, 2, 1) / metric[:, None]
    if free == 2:
        return np.asarray(N @ np.linalg.inv(N[:, 3:]))
    N = N / np.linalg.norm(N[:, 3:], axis=1, keepdims=True)
    for k in range(1, len(N)):
        N[k] *= np.sign((N[k, 3:] * N[k - 1, 3:]).sum()) or 1.0
    return np.asarray(N)


def regulate(found: list[Linear], step: float) -> Array:
    """Gains (n, 2, 4) by the discrete Riccati equation, integrated back from the end."""
    from scipy.linalg import solve_continuous_are

    gains, P, shown = np.zeros((len(found), 2, 4)), np.zeros((0, 0)), np.zeros((2, 0))
    for k in range(len(found) - 1, -1, -1):
        linear = found[k]
        f = linear.joints.shape[1]
        Q = np.diag(np.repeat([RATE**4, 2 * RATE**2], f))
        inputs = np.vstack([np.zeros((f, 2)), linear.B])
        if not P.size:
            P = solve_continuous_are(linear.A, inputs, Q, linear.cost)
        elif shown.shape[1] != f or (f == 1 and (shown * linear.joints).sum() < 0):
            same = np.linalg.pinv(shown) @ linear.joints
            turn = np.kron(np.eye(2), same)
            P = turn.T @ P @ turn
        shown = linear.joints
        rate = np.eye(2 * f) + step * linear.A + (step * linear.A) @ (step * linear.A) / 2
        drive = (step * np.eye(2 * f) + step**2 * linear.A / 2) @ inputs
        K = np.linalg.solve(step * linear.cost + drive.T @ P @ drive, drive.T @ P @ rate)
        P = step * Q + rate.T @ P @ (rate - drive @ K)
        P = (P + P.T) / 2
        gains[k] = K @ np.kron(np.eye(2), np.linalg.pinv(linear.joints))
    return gains
