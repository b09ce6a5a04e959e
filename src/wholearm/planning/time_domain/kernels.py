"""The equations of the time-domain NLP: at a point, over an interval, from stage to stage."""

from __future__ import annotations

from functools import lru_cache

import casadi as ca

from ...common.arrays import Expression
from ...contacts.elemental import Contact, build_features, build_gap
from ...contacts.formation import Formation
from ...mechanics.dynamics import build_force_rows
from ...problem.definition import Until
from .assembly import Kernel, build_kernel
from .collocation import Scheme, make_scheme

NOTHING = ca.SX(0, 1)


@lru_cache(maxsize=32)
def point_kernel(formation: Formation) -> Kernel:
    """Equations and inequalities at a collocation point.

    x is (z, z', z'', forces, tau at the start and the end of the interval), and z at the start of
    the interval if a contact rolls. p is (Xi, sigma, the point's place in the interval, the least
    rate). y is the contacts' constraints, in position, velocity and acceleration, the five
    equations of motion, and what must not be negative: the senses of friction of the sliding
    contacts.
    """
    scene, n_c, n_p = formation.scene, formation.n_contacts, formation.n_constraints
    z, v, a = (ca.SX.sym(name, 5) for name in ("z", "v", "a"))
    forces, tau = ca.SX.sym("forces", n_p), ca.SX.sym("tau", 4)
    first = ca.SX.sym("first", 5 if formation.rolling else 0)
    Xi, sigma, place = ca.SX.sym("Xi", n_c), ca.SX.sym("sigma", 2), ca.SX.sym("place")
    least = ca.SX.sym("least")
    gaps, P, P_dot_v, A_t = formation.build_constraints(z, v)
    if formation.rolling:
        gaps[n_c:] -= formation.roll_function(first, v)[0]
    applied = (
        ca.DM(scene.applied_force)
        + ca.vertcat(0, 0, 0, tau[:2] * (1 - place) + tau[2:] * place)
        - ca.DM(scene.dry) * ca.vertcat(0, 0, 0, sigma)
        + build_force_rows(formation, P, A_t, Xi).T @ forces
    )
    balance = ca.DM(scene.mass_diagonal) * a + ca.DM(scene.viscous) * v - applied
    sliding = [k for k in range(n_c) if k not in formation.rolling_rows]
    # With `:`, no rows of a single one are no rows, and not a row without columns.
    senses = (Xi * (A_t @ v) - least)[sliding, :]
    y = ca.vertcat(gaps, P @ v, P @ a + P_dot_v, balance, senses)
    return build_kernel(
        ca.vertcat(z, v, a, forces, tau, first), ca.vertcat(Xi, sigma, place, least), y
    )


@lru_cache(maxsize=32)
def end_kernel(formation: Formation) -> Kernel:
    """Contacts at the end of an interval without a point there, of x = (z, z', z at its start)."""
    z, v = ca.SX.sym("z", 5), ca.SX.sym("v", 5)
    first = ca.SX.sym("first", 5 if formation.rolling else 0)
    gaps, P, _, _ = formation.build_constraints(z, v)
    if formation.rolling:
        gaps[formation.n_contacts :] -= formation.roll_function(first, v)[0]
    return build_kernel(ca.vertcat(z, v, first), NOTHING, ca.vertcat(gaps, P @ v))


@lru_cache(maxsize=32)
def collocation_kernel(name: str, degree: int, freedoms: int) -> Kernel:
    """Collocation along the tangent space: N^T (s_j - s_0 - h sum_l a_jl r_l).

    x is (s at the start, at the points and, if no point is there, at the end; the rates r at the
    points; h), p the columns of N, and y a row for each freedom at each point and end.
    """
    scheme: Scheme = make_scheme(name, degree)
    rungs = degree + (not scheme.ends)
    table = scheme.integrals.tolist() + ([] if scheme.ends else [scheme.weights.tolist()])
    start, h = ca.SX.sym("start", 5), ca.SX.sym("h")
    here, rates = ca.SX.sym("here", 5, rungs), ca.SX.sym("rates", 5, degree)
    N = ca.SX.sym("N", 5, freedoms)
    steps = here - ca.repmat(start, 1, rungs) - h * (rates @ ca.DM(table).T)
    x = ca.vertcat(start, ca.vec(here), ca.vec(rates), h)
    return build_kernel(x, ca.vec(N), ca.vec(N.T @ steps))


@lru_cache(maxsize=64)
def monitor_kernel(formation: Formation, monitored: tuple[int, ...]) -> Kernel:
    """Limits of a formation, of x = z."""
    values = ca.vertcat(*(formation.limits[k].value for k in monitored))
    return build_kernel(build_features(formation.scene).z, NOTHING, values)


@lru_cache(maxsize=64)
def opening_kernel(formation: Formation, contact: Contact) -> Kernel:
    """Second derivative of a contact's gap, of x = (z, z', z'')."""
    z, v, a = (ca.SX.sym(name, 5) for name in ("z", "v", "a"))
    _, A, _, A_dot_v = Formation(formation.scene, (contact,)).function(z, v)
    return build_kernel(ca.vertcat(z, v, a), NOTHING, A @ a + A_dot_v)


def goal_kernel(
    formation: Formation, until: Until | None, turns: tuple[int, ...], gained: Formation | None
) -> Kernel | None:
    """What is zero at the end of a stage, of x = (z, z'); None if nothing is.

    The end of the phase is reached, rates turn, and what is gained is approached without speed.
    """
    scene = formation.scene
    z, v = build_features(scene).z, ca.SX.sym("v", 5)
    parts: list[Expression] = []
    if until is not None and until.contact is not None:
        parts.append(build_gap(until.contact, scene))
    elif until is not None and until.value is not None:
        parts.append((z[0] if until.coordinate == "x" else z[2]) - until.value)
    if turns:
        rates = ca.vertcat(formation.function(z, v)[2] @ v, v[3:])
        # A flush edge has one rate, and equations said twice spoil the solver's steps.
        parts += [rates[k] for k in {formation.turn_with(k): k for k in turns}.values()]
    if gained is not None:
        P = gained.build_constraints(z, v)[1]
        parts += [P[i, :] @ v for i in new_rows(formation, gained)]
    return build_kernel(ca.vertcat(z, v), NOTHING, ca.vertcat(*parts)) if parts else None


def new_rows(formation: Formation, following: Formation) -> list[int]:
    """Constraint rows of a formation that the one before does not have."""
    fresh = [i for i, c in enumerate(following.contacts) if c not in formation.contacts]
    rolling = [following.contacts[row] for row in following.rolling_rows]
    n_c = following.n_contacts
    return fresh + [n_c + i for i, c in enumerate(rolling) if c not in formation.rolling]


@lru_cache(maxsize=1)
def effort_kernel() -> Kernel:
    """Integral of tau^T tau over an interval, of x = (tau, h)."""
    tau, h = ca.SX.sym("tau", 4), ca.SX.sym("h")
    first, last = tau[:2], tau[2:]
    squares = ca.sumsqr(first) + ca.dot(first, last) + ca.sumsqr(last)
    return build_kernel(ca.vertcat(tau, h), NOTHING, h * squares / 3)


@lru_cache(maxsize=1)
def stretch_kernel() -> Kernel:
    """What it costs to change the duration of an interval, of x = h, p = (weight, h before)."""
    h, p = ca.SX.sym("h"), ca.SX.sym("p", 2)
    return build_kernel(h, p, p[0] * (h / p[1] - 1) ** 2)


def find_leaving(formation: Formation, following: Formation) -> list[int]:
    """Contacts of a formation that the next one does not have."""
    return [i for i, c in enumerate(formation.contacts) if c not in following.contacts]


@lru_cache(maxsize=32)
def impact_kernel(formation: Formation, following: Formation) -> Kernel:
    """A plastic impact M5 (v+ - v-) = G+^T p, P+ v+ = 0 onto the next formation.

    x is (z' after, z' before, z, impulses), p the sliding directions after it. y is zero
    in its first 5 + n_c + R rows; then come what must not be negative: the rates of the gaps that
    open, and the friction cones of rolling contacts.
    """
    scene, n_c = following.scene, following.n_contacts
    after, before = ca.SX.sym("after", 5), ca.SX.sym("before", 5)
    z, impulses = ca.SX.sym("z", 5), ca.SX.sym("impulses", following.n_constraints)
    Xi = ca.SX.sym("Xi", n_c)
    _, P, _, A_t = following.build_constraints(z, after)
    push = build_force_rows(following, P, A_t, Xi).T @ impulses
    jump = ca.DM(scene.mass_diagonal) * (after - before) - push
    A = formation.function(z, after)[1]
    rolling = list(following.rolling_rows)
    grip = ca.DM(following.friction)[rolling, :] * impulses[rolling, :]
    y = ca.vertcat(
        jump,
        P @ after,
        A[find_leaving(formation, following), :] @ after,
        grip - impulses[n_c:, :],
        grip + impulses[n_c:, :],
    )
    return build_kernel(ca.vertcat(after, before, z, impulses), Xi, y)
