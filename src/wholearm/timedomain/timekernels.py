"""The equations of the time-domain NLP: at a point, at a stage's end, from stage to stage.

Unknowns are w = T z' and u = T^2 z'', so that collocation is linear; lengths count in radii of
gyration, forces in N.
"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca

from ..contact import Contact, Expression, build_features, build_gap
from ..dynamics import build_force_rows
from ..formation import Formation
from ..problem import Until
from .blocknlp import Kernel, build_kernel

NOTHING = ca.SX(0, 1)
LEVER = 0.1
"""Length that torques are divided by, to weigh them against forces [m]."""


@lru_cache(maxsize=32)
def point_kernel(formation: Formation) -> Kernel:
    """Equations and inequalities at a collocation point.

    x is (z, w, u, forces, tau at the start and the end of the interval, T), and z at the start of
    the interval if a contact rolls. p is (Xi, sigma, the point's place in the interval, the least
    rate [rad/s], a unit of time [s]). y is the contacts' constraints, in position, velocity and
    acceleration, the five equations of motion, and what must not be negative: the senses of
    friction of the sliding contacts.
    """
    scene, n_c, n_p = formation.scene, formation.n_contacts, formation.n_constraints
    rho = scene.polygon.gyration_radius
    z, w, u = (ca.SX.sym(name, 5) for name in ("z", "w", "u"))
    forces, tau, T = ca.SX.sym("forces", n_p), ca.SX.sym("tau", 4), ca.SX.sym("T")
    first = ca.SX.sym("first", 5 if formation.rolling else 0)
    Xi, sigma, place = ca.SX.sym("Xi", n_c), ca.SX.sym("sigma", 2), ca.SX.sym("place")
    least, unit = ca.SX.sym("least"), ca.SX.sym("unit")
    gaps, P, P_dot_w, A_t = formation.build_constraints(z, w)
    if formation.rolling:
        gaps[n_c:] -= formation.roll_function(first, w)[0]
    applied = (
        ca.DM(scene.applied_force)
        + ca.vertcat(0, 0, 0, tau[:2] * (1 - place) + tau[2:] * place)
        - ca.DM(scene.dry) * ca.vertcat(0, 0, 0, sigma)
        + build_force_rows(formation, P, A_t, Xi).T @ forces
    )
    moving = ca.DM(scene.mass_diagonal) * u + ca.DM(scene.viscous) * w * T - applied * T**2
    balance = moving / unit**2 / ca.DM([1.0, 1.0, rho, LEVER, LEVER])
    sliding = [k for k in range(n_c) if k not in formation.rolling_rows]
    # With `:`, no rows of a single one are no rows, and not a row without columns.
    senses = (Xi * (A_t @ w) / rho - least * T)[sliding, :]
    y = ca.vertcat(gaps / rho, P @ w / rho, (P @ u + P_dot_w) / rho, balance, senses)
    return build_kernel(
        ca.vertcat(z, w, u, forces, tau, T, first), ca.vertcat(Xi, sigma, place, least, unit), y
    )


@lru_cache(maxsize=32)
def end_kernel(formation: Formation) -> Kernel:
    """Contacts at the end of an interval without a point there: x is (z, w), and z at its start."""
    rho = formation.scene.polygon.gyration_radius
    z, w = ca.SX.sym("z", 5), ca.SX.sym("w", 5)
    first = ca.SX.sym("first", 5 if formation.rolling else 0)
    gaps, P, _, _ = formation.build_constraints(z, w)
    if formation.rolling:
        gaps[formation.n_contacts :] -= formation.roll_function(first, w)[0]
    return build_kernel(ca.vertcat(z, w, first), NOTHING, ca.vertcat(gaps, P @ w) / rho)


@lru_cache(maxsize=64)
def watch_kernel(formation: Formation, watched: tuple[int, ...]) -> Kernel:
    """Limits of a formation, of x = z."""
    rho = formation.scene.polygon.gyration_radius
    values = ca.vertcat(*(formation.limits[k].value for k in watched)) / rho
    return build_kernel(build_features(formation.scene).z, NOTHING, values)


@lru_cache(maxsize=64)
def opening_kernel(formation: Formation, contact: Contact) -> Kernel:
    """Second derivative of a contact's gap [m/s^2], of x = (z, w, u, T)."""
    z, w, u, T = (ca.SX.sym(*symbol) for symbol in (("z", 5), ("w", 5), ("u", 5), ("T",)))
    _, A, _, A_dot_w = Formation(formation.scene, (contact,)).function(z, w)
    return build_kernel(ca.vertcat(z, w, u, T), NOTHING, (A @ u + A_dot_w) / T**2)


def goal_kernel(
    formation: Formation, until: Until | None, turns: tuple[int, ...], gained: Formation | None
) -> Kernel | None:
    """What is zero at the end of a stage, of x = (z, w); None if nothing is.

    The end of the phase is reached, rates turn, and what is gained is approached without speed.
    """
    scene = formation.scene
    rho = scene.polygon.gyration_radius
    z, w = build_features(scene).z, ca.SX.sym("w", 5)
    parts: list[Expression] = []
    if until is not None and until.contact is not None:
        parts.append(build_gap(until.contact, scene) / rho)
    elif until is not None and until.value is not None:
        x = until.coordinate == "x"
        parts.append((z[0] - until.value) / rho if x else z[2] - until.value)
    if turns:
        rates = ca.vertcat(formation.function(z, w)[2] @ w / rho, w[3:])
        # A flush edge has one rate, and equations said twice spoil the solver's steps.
        parts += [rates[k] for k in {formation.turn_with(k): k for k in turns}.values()]
    if gained is not None:
        P = gained.build_constraints(z, w)[1]
        parts += [P[i, :] @ w / rho for i in new_rows(formation, gained)]
    return build_kernel(ca.vertcat(z, w), NOTHING, ca.vertcat(*parts)) if parts else None


def new_rows(formation: Formation, following: Formation) -> list[int]:
    """Constraint rows of a formation that the one before does not have."""
    fresh = [i for i, c in enumerate(following.contacts) if c not in formation.contacts]
    rolling = [following.contacts[row] for row in following.rolling_rows]
    n_c = following.n_contacts
    return fresh + [n_c + i for i, c in enumerate(rolling) if c not in formation.rolling]


@lru_cache(maxsize=1)
def join_kernel() -> Kernel:
    """The jump of w, in two units of time, of x = (after, before, T before, T after)."""
    after, before, T = ca.SX.sym("after", 5), ca.SX.sym("before", 5), ca.SX.sym("T", 2)
    return build_kernel(ca.vertcat(after, before, T), NOTHING, after - before * T[1] / T[0])


@lru_cache(maxsize=1)
def effort_kernel() -> Kernel:
    """Integral of tau^T tau over an interval, of x = (tau, T) and p = its share of T."""
    tau, T, share = ca.SX.sym("tau", 4), ca.SX.sym("T"), ca.SX.sym("share")
    first, last = tau[:2], tau[2:]
    squares = ca.sumsqr(first) + ca.dot(first, last) + ca.sumsqr(last)
    return build_kernel(ca.vertcat(tau, T), share, share * T * squares / 3)


def find_leaving(formation: Formation, following: Formation) -> list[int]:
    """Contacts of a formation that the next one does not have."""
    return [i for i, c in enumerate(formation.contacts) if c not in following.contacts]


@lru_cache(maxsize=32)
def impact_kernel(formation: Formation, following: Formation) -> Kernel:
    """A plastic impact M5 (v+ - v-) = G+^T p, P+ v+ = 0 onto the next formation.

    x is (w after, w before, T before, T after, z, p), p the sliding directions after it. y is zero
    in its first 5 + n_c + R rows; then come what must not be negative: the rates of the gaps that
    open, and the friction cones of rolling contacts.
    """
    scene, n_c = following.scene, following.n_contacts
    rho = scene.polygon.gyration_radius
    after, before, T = ca.SX.sym("after", 5), ca.SX.sym("before", 5), ca.SX.sym("T", 2)
    z, impulses = ca.SX.sym("z", 5), ca.SX.sym("impulses", following.n_constraints)
    Xi = ca.SX.sym("Xi", n_c)
    _, P, _, A_t = following.build_constraints(z, after)
    push = build_force_rows(following, P, A_t, Xi).T @ impulses
    jump = ca.DM(scene.mass_diagonal) * (after - before * T[1] / T[0]) - T[1] * push
    mass = scene.polygon.mass
    jump = jump / (mass * rho) / ca.DM([1.0, 1.0, rho, LEVER, LEVER])
    A = formation.function(z, after)[1]
    rolling = list(following.rolling_rows)
    grip = ca.DM(following.friction)[rolling, :] * impulses[rolling, :]
    y = ca.vertcat(
        jump,
        P @ after / rho,
        A[find_leaving(formation, following), :] @ after / rho,
        grip - impulses[n_c:, :],
        grip + impulses[n_c:, :],
    )
    return build_kernel(ca.vertcat(after, before, T, z, impulses), Xi, y)
