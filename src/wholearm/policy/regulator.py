"""Gains of phases with more freedoms: a linear-quadratic regulator along a plan, over time.

What contacts leave free are displacements N xi of the configuration, of which the joints show
theta = Theta xi; N is scaled so that xi are the joint angles where two freedoms are left, and the
arc of both where one is. Linearised about the plan, xi'' = A1 xi + A2 xi' + B tau with the contacts
kept. Torques cost what they change of the accelerations, and of the contact forces over what they
are; the Riccati equation of that is integrated back from the end.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.batch import Batch
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions, PathForces, build_forward, inverse
from ..mechanics.metric import metric_weights
from ..problem.definition import Phase, Problem
from ..results.trajectory import Trajectory

RATE = 100.0  # Rate at which errors fade where torques change no contact force [1/s]
PRESSED = 0.1  # Acceleration, over the scene's unit, that costs as much as doubling a contact force
LEAST = 0.05  # Least contact force in that, over the scene's unit of force
STEP = 1e-6  # Step of differences, in rad and over the scene's unit of time
STANDS = 1e-6  # Joint speed that counts as none, over the scene's
SOFT = 0.02
"""Error of the angles for which a whole torque limit is worth it [rad]; it bounds gains where the
joints hardly show, or torques hardly change, how the object moves."""


SPEEDS = tuple(1 - 0.05 * k for k in range(11))
"""Squares of speeds over the plan's that are tried, the fastest first."""
ROOM = 0.1
"""Normal force, over the scene's unit, and part of a torque limit that are enough for feedback."""


class Linear(NamedTuple):
    """A plan at an instant, linearised: joints of freedoms (2, f), rates (2 f, 2 f), inputs, costs.

    `B` has shape (f, 2); `cost`, of torques, (2, 2).
    """

    joints: Array
    A: Array
    B: Array
    cost: Array


class RegulatedStretch(NamedTuple):
    """A stretch of a plan with the same contact modes, at n instants.

    `forces` are along the plan as a curve whose parameter is its time; the squeeze is the plan's.
    """

    formation: Formation
    z: Array
    z_dot: Array
    directions: Directions
    forces: PathForces
    squeeze: Array

    def find_forces(self, b: float) -> Array:
        """Contact forces of the plan with the square of its speed times `b`, (n, n_c + R) [N]."""
        return self.forces.c(np.zeros(len(self.z)), np.full(len(self.z), b), self.squeeze)

    def find_torques(self, b: float) -> Array:
        """Torques of that, shape (n, 2) [N m]."""
        return self.forces.tau(np.zeros(len(self.z)), np.full(len(self.z), b), self.squeeze)


class Followed(NamedTuple):
    """A motion to follow: the square of its speed over the plan's, torques and gains, (n, 2, 4)."""

    b: float
    tau: Array
    gains: Array


def end_within(phases: tuple[Phase, ...], plan: Trajectory, t: Array) -> Array:
    """Times in phases, before their very end: there the next phase answers, with its contacts."""
    end = plan.phase_starts[phases[-1].index + 1]
    return np.asarray(np.minimum(t, np.nextafter(end, 0.0)))


def follow(problem: Problem, phases: tuple[Phase, ...], plan: Trajectory, t: Array) -> Followed:
    """Torques and gains for phases of a plan at even times in them, shape (n,).

    The motion is as much slower as leaves most of normal forces and torques to feedback.
    """
    starts, t = plan.phase_starts, end_within(phases, plan, t)
    owner = np.searchsorted(starts, t, side="right") - 1
    owner = owner.clip(phases[0].index, phases[-1].index)
    parts = [
        _stretch(formation, plan, times)
        for phase in phases
        for formation, times in _split_modes(phase, plan, t[owner == phase.index])
    ]
    b = max(SPEEDS, key=lambda b: _find_room(problem, parts, b))
    found = [row for part in parts for row in _linearise(problem, part, b)]
    tau = np.concatenate([part.find_torques(b) for part in parts])
    return Followed(b, tau, regulate(found, float(t[1] - t[0]) / np.sqrt(b)))


def _find_room(problem: Problem, parts: list[RegulatedStretch], b: float) -> float:
    """What a motion leaves of normal forces and torques, over what is enough."""
    scene = problem.scene
    unit, limit = ROOM * scene.scales.force, scene.torque_limit
    room = [part.find_forces(b)[:, : part.formation.n_contacts].min() / unit for part in parts]
    room += [(1 - np.abs(part.find_torques(b)) / limit).min() / ROOM for part in parts]
    return float(min(room))


def _stretch(formation: Formation, plan: Trajectory, t: Array) -> RegulatedStretch:
    """A stretch of a plan."""
    samples = plan.at(t)
    z, v = samples.z, samples.z_dot
    kinematics = formation.evaluate(z, v)
    Xi, sigma = np.sign(np.einsum("nij,nj->ni", kinematics.A_t, v)), np.sign(v[:, 3:])
    # At rest directions are those a moment away from it.
    moves = np.flatnonzero(np.abs(v[:, 3:]).max(axis=1) > STANDS * formation.scene.scales.rate)
    near = moves[np.abs(moves[None] - np.arange(len(t))[:, None]).argmin(axis=1)]
    directions = Directions(Xi[near], sigma[near])
    forces = inverse(formation, z, v, samples.z_ddot, directions, kinematics)
    columns = [plan.contacts.index(name) for name in formation.names]
    rolls = [columns[row] for row in formation.rolling_rows]
    c = np.hstack([samples.c_n[:, columns], samples.c_t[:, rolls]])
    squeeze = np.einsum("ni,ni->n", c, forces.Cl)
    return RegulatedStretch(formation, z, v, directions, forces, np.asarray(squeeze))


def _split_modes(phase: Phase, plan: Trajectory, t: Array) -> list[tuple[Formation, Array]]:
    """Stretches of times in which the same contacts roll, with their formations."""
    mine = np.flatnonzero(plan.phase == phase.index)
    nearest = mine[np.abs(plan.t[mine][None] - t[:, None]).argmin(axis=1)]
    columns = [plan.contacts.index(name) for name in phase.formation.names]
    rolls = plan.rolling[nearest][:, columns]
    edges = [0, *(np.flatnonzero((rolls[1:] != rolls[:-1]).any(axis=1)) + 1).tolist(), len(t)]
    found = []
    for first, after in pairwise(edges):
        if after > first:
            pairs = zip(phase.formation.contacts, rolls[first], strict=True)
            rolling = tuple(contact for contact, own in pairs if own)
            formation = replace(phase.formation, rolling=rolling)
            found.append((formation, t[first:after]))
    return found


def _linearise(problem: Problem, part: RegulatedStretch, b: float) -> list[Linear]:
    """A stretch at a speed, linearised."""
    formation, scales, n = part.formation, problem.scene.scales, len(part.z)
    z, v, tau = part.z, part.z_dot * np.sqrt(b), part.find_torques(b)
    (Xi, sigma), kinematics = part.directions, formation.evaluate(z, v)
    forward = Batch(build_forward(formation))

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
        place = z + STEP * N[:, :, k]
        other = _span(formation, formation.evaluate(place, v).P)
        other *= np.sign(np.einsum("nif,nif->nf", other, N))[:, None, :] if f == 1 else 1.0
        shifted, _ = move(place, np.einsum("nif,nf->ni", other, speed), tau)
        A[:, f:, k] = np.einsum("nfi,ni->nf", back, shifted - rest) / STEP
        step = STEP / scales.time
        shifted, _ = move(z, v + step * N[:, :, k], tau)
        A[:, f:, f + k] = np.einsum("nfi,ni->nf", back, shifted - rest) / step
    share = press / np.maximum(np.abs(forces), LEAST * scales.force)[:, :, None]
    unit = PRESSED * scales.acceleration / scales.length
    cost = B.transpose(0, 2, 1) @ B + unit**2 * share.transpose(0, 2, 1) @ share
    cost += np.diag((RATE**2 * SOFT / problem.scene.torque_limit) ** 2)
    return [Linear(*own) for own in zip(joints, A, B, cost, strict=True)]


def _span(formation: Formation, P: Array) -> Array:
    """Displacements that constraints leave, shape (n, 5, f), by what the joints show of them."""
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
    """The Riccati equation back from the end; gains (n, 2, 4)."""
    from scipy.linalg import solve_continuous_are

    gains, P, shown = np.zeros((len(found), 2, 4)), np.zeros((0, 0)), np.zeros((2, 0))
    for k in range(len(found) - 1, -1, -1):
        own = found[k]
        f = own.joints.shape[1]
        Q = np.diag(np.repeat([RATE**4, 2 * RATE**2], f))
        inputs = np.vstack([np.zeros((f, 2)), own.B])
        if not P.size:
            P = solve_continuous_are(own.A, inputs, Q, own.cost)
        elif shown.shape[1] != f or (f == 1 and (shown * own.joints).sum() < 0):
            same = np.linalg.pinv(shown) @ own.joints
            turn = np.kron(np.eye(2), same)
            P = turn.T @ P @ turn
        shown = own.joints
        rate = np.eye(2 * f) + step * own.A + (step * own.A) @ (step * own.A) / 2
        drive = (step * np.eye(2 * f) + step**2 * own.A / 2) @ inputs
        K = np.linalg.solve(step * own.cost + drive.T @ P @ drive, drive.T @ P @ rate)
        P = step * Q + rate.T @ P @ (rate - drive @ K)
        P = (P + P.T) / 2
        gains[k] = K @ np.kron(np.eye(2), np.linalg.pinv(own.joints))
    return gains
