"""Independent methods: statics by linear programmes, Moreau's impacts, SciPy's integrators."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

from plane import stack_rows
from wholearm import Problem, TorqueProfile
from wholearm.benchmark.precision import solve_motion
from wholearm.common.arrays import Array
from wholearm.contacts.formation import Formation
from wholearm.mechanics.dynamics import Directions

PULL = 1e-6  # sum of pulls that counts as none, over the scene's force


def balances(touching: Formation, z: Array, tau: Array, least: float = 0.0) -> bool:
    """Whether forces with c_n >= least and |c_t| <= mu (c_n - least) balance everything at rest.

    Contacts pull as little as possible besides, which counts as rounding up to `PULL`.
    """
    scene, count = touching.scene, touching.n_contacts
    at = touching.evaluate(z[None], np.zeros((1, 5)))
    joints = np.eye(5)[:, 3:]
    dry = zip(-scene.dry[3:], scene.dry[3:], strict=True)
    cone, one, none = np.diag(touching.friction), np.eye(count), np.zeros((count, count + 2))
    answer = linprog(
        np.repeat([0.0, 1.0], [2 * count + 2, count]),
        A_ub=np.vstack([np.hstack([-cone, way * one, none]) for way in (1.0, -1.0)]),
        b_ub=np.tile(-touching.friction * least, 2),
        A_eq=np.hstack([at.A[0].T, at.A_t[0].T, -joints, -at.A[0].T]),
        b_eq=-(scene.applied_force + joints @ tau),
        bounds=[*[(least, None)] * count, *[(None, None)] * count, *dry, *[(0, None)] * count],
    )
    return bool(answer.status == 0 and answer.fun <= PULL * scene.scales.force)


class Collision(NamedTuple):
    """Velocity after an impact, and what each contact does."""

    v: Array  # (5,)
    rates: Array  # rates, slips (n_c,) [m/s]: how fast contacts part and slide
    slips: Array
    normal: Array  # (n_c,) [N s]: impulses


def collide(formation: Formation, z: Array, v: Array) -> Collision:
    """Impact of all that touch, vertex contacts, which press or part, slide or stick.

    At every contact 0 <= p_n, 0 <= u_n, p_n u_n = 0 and Coulomb's law between p_t and u_t. Nothing
    is assumed about which contacts press or which way they slide.
    """
    mass, (N, T) = formation.scene.mass_diagonal, stack_rows(formation, z)
    rows = np.vstack([N, T, np.eye(5)[3:]])
    # Joints take no impulse.
    none = np.zeros(len(rows))
    p = _solve((rows / mass) @ rows.T, rows @ v, formation.friction, none[:2], none)
    after = v + rows.T @ p / mass
    return Collision(after, N @ after, T @ after, p[: len(N)])


def march(
    formation: Formation, z: Array, v: Array, torque: TorqueProfile, stop: float, n: int
) -> tuple[Array, Array]:
    """States after each of n equal steps from time 0, shape (n, 5) each.

    All that touch are vertex contacts; whether they roll or slide is not looked at.
    """
    scene, h = formation.scene, stop / n
    mass = scene.mass_diagonal
    p = np.zeros(2 * formation.n_contacts + 2)
    states = []
    instants = np.asarray((np.arange(n) + 0.5) * h, dtype=np.float64)
    for tau in torque.at(instants):
        middle = z + h / 2 * v
        N, T = stack_rows(formation, middle)
        rows = np.vstack([N, T, np.eye(5)[3:]])
        push = scene.applied_force - scene.viscous * v
        push[3:] += tau
        free = v + h * push / mass
        p = _solve((rows / mass) @ rows.T, rows @ free, formation.friction, h * scene.dry[3:], p)
        v = free + rows.T @ p / mass
        z = middle + h / 2 * v
        states.append(np.concatenate([z, v]))
    z_all, v_all = np.split(np.array(states), 2, axis=1)
    return z_all, v_all


def _solve(W: Array, b: Array, mu: Array, most: Array, p: Array) -> Array:
    """Impulses p with u = W p + b: contacts press, and friction is within its bounds and opposes.

    Each condition is p = its projection of p - r u, as of Alart and Curnier.
    """
    count = len(mu)
    r = 1 / np.diag(W)
    for turn in range(200):
        wanted = p - r * (W @ p + b)
        shift = np.eye(len(p)) - r[:, None] * W
        pressing = wanted[:count] > 0
        normal = np.where(pressing, wanted[:count], 0.0)
        d_normal = np.where(pressing[:, None], shift[:count], 0.0)
        bound = np.concatenate([mu * normal, most])
        d_bound = np.vstack([mu[:, None] * d_normal, np.zeros((2, len(p)))])
        free, d_free = wanted[count:], shift[count:]
        inside = np.abs(free) <= bound
        sign = np.sign(free)
        target = np.concatenate([normal, np.where(inside, free, sign * bound)])
        slope = np.vstack([d_normal, np.where(inside[:, None], d_free, sign[:, None] * d_bound)])
        miss = p - target
        # A flush edge leaves it open how its vertices share their friction.
        step = np.linalg.lstsq(np.eye(len(p)) - slope, miss, rcond=1e-12)[0]
        # Full steps may go round in circles.
        p = p - step * (1.0 if turn < 20 else 0.3)
        if np.abs(step).max() <= 1e-13 * max(np.abs(p).max(), 1e-12):
            return p
    raise AssertionError("the complementarity problem was not solved")


class Integrated(NamedTuple):
    """The time and the state (z, z') that a run ends at, and the index of the contact it lost."""

    t: float
    state: Array
    lost: int | None


def integrate_phase(
    problem: Problem,
    index: int,
    torque: TorqueProfile,
    state: Array,
    directions: Directions,
    span: tuple[float, float],
    *,
    accuracy: float = 1e-12,
) -> Integrated:
    """Integrate a phase until `span` ends or the first c_n falls to zero, directions as they are.

    `state` is (z, z') at its start, and `accuracy` relative and absolute for each step.
    """
    formation, own = problem.phases[index].formation, torque

    def forces(t: float, y: Array) -> tuple[Array, Array]:
        tau = own.at(np.array([t]))[0]
        return solve_motion(formation, y[:5], y[5:], tau, *directions)

    def derivative(t: float, y: Array) -> Array:
        return np.concatenate([y[5:], forces(t, y)[0]])

    def falls(k: int) -> Callable[[float, Array], float]:
        def event(t: float, y: Array) -> float:
            return float(forces(t, y)[1][k])

        event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
        return event

    events, lost = [falls(k) for k in range(formation.n_contacts)], None
    inner = torque.breaks[(torque.breaks > span[0]) & (torque.breaks < span[1])]
    for start, stop in pairwise([span[0], *inner.tolist(), span[1]]):
        # A whole piece, which stays as it is to the last bit.
        piece = min(np.searchsorted(torque.breaks, (start + stop) / 2), len(torque.breaks) - 1)
        own = torque.cut(*torque.breaks[piece - 1 : piece + 1].tolist())
        run = solve_ivp(
            derivative, (start, stop), state, "DOP853", rtol=accuracy, atol=accuracy, events=events
        )
        state = run.y[:, -1]
        if run.status == 1:
            lost = next(k for k, times in enumerate(run.t_events) if len(times))
            break
    return Integrated(float(run.t[-1]), state, lost)
