"""Kernels of the time-domain NLP: at a point, over an interval, between stages.

Their columns have names. Formations with the same equations share kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from math import comb
from typing import Any, TypeVar

import casadi as ca

from ...common.arrays import Expression
from ...contacts.contact_limits import build_limits
from ...contacts.elemental import Contact, build_features, build_gap
from ...contacts.formation import Formation
from ...mechanics.dynamics import build_force_rows
from ...problem.definition import Until
from ..columns import Columns, Symbols
from .collocation import Scheme, make_scheme
from .nlp_layout import Kernel, build_kernel

_K = TypeVar("_K")
_NOTHING = Columns().make_symbols()


@dataclass(frozen=True, eq=False)
class NamedKernel(Kernel):
    """A kernel whose x, p and y consist of named blocks."""

    x: Columns
    p: Columns
    y: Columns


def share(size: int) -> Callable[[Callable[..., _K]], Callable[..., _K]]:
    """Keep the last `size` kernels, each for all formations with the same equations."""

    def decorate(build: Callable[..., _K]) -> Callable[..., _K]:
        kept = dict[tuple[Any, ...], _K]()

        @wraps(build)
        def find(*args: Any) -> _K:
            key = tuple(arg.equations if isinstance(arg, Formation) else arg for arg in args)
            # The latest are last.
            kept[key] = kept.pop(key) if key in kept else build(*args)
            if len(kept) > size:
                del kept[next(iter(kept))]
            return kept[key]

        return find

    return decorate


def name_kernel(x: Symbols, p: Symbols, **y: Expression) -> NamedKernel:
    """Build the kernel of named expressions `y` of symbols."""
    columns = Columns(**{name: int(block.numel()) for name, block in y.items()})
    own = build_kernel(x.every, p.every, columns.write(**y))
    return NamedKernel(**vars(own), x=x.columns, p=p.columns, y=columns)


@share(32)
def point_kernel(formation: Formation, controls: int, homotopy: bool = False) -> NamedKernel:
    """Contact constraints, equations of motion, and rates of sliding contacts at a point.

    `tau` are the control points of the torques, `shares` their Bernstein polynomials, `first` is z
    at the start of the interval if a contact rolls, `least` are the least rates. In the `homotopy`
    friction is regularized by tanh(rate / onset).
    """
    scene, n_c, rolls = formation.scene, formation.n_contacts, bool(formation.rolling)
    x = Columns(z=5, v=5, a=5, forces=formation.n_constraints, tau=2 * controls, first=5 * rolls)
    s = x.make_symbols()
    p = Columns(Xi=n_c, sigma=2, shares=controls, least=n_c, onset=1 * homotopy).make_symbols()
    gaps, P, P_dot_v, A_t = formation.build_constraints(s.z, s.v)
    Xi, sigma = p.Xi, p.sigma
    if homotopy:
        Xi, sigma = ca.tanh(A_t @ s.v / p.onset), ca.tanh(s.v[3:] / p.onset)
    if rolls:
        gaps[n_c:] -= formation.roll_function(s.first, s.v)[0]
    applied = (
        ca.DM(scene.applied_force)
        + ca.vertcat(0, 0, 0, ca.reshape(s.tau, 2, controls) @ p.shares)
        - ca.DM(scene.dry) * ca.vertcat(0, 0, 0, sigma)
        + build_force_rows(formation, P, A_t, Xi).T @ s.forces
    )
    return name_kernel(
        s,
        p,
        gaps=gaps,
        rates=P @ s.v,
        bends=P @ s.a + P_dot_v,
        balance=ca.DM(scene.mass_diagonal) * s.a + ca.DM(scene.viscous) * s.v - applied,
        # With `:`, no rows of a single one are no rows, and not a row without columns.
        senses=(p.Xi * (A_t @ s.v) - p.least)[list(formation.rubbing_rows), :],
    )


@share(32)
def end_kernel(formation: Formation) -> NamedKernel:
    """Contacts at the end of an interval without a point there; `first` is z at its start."""
    x = Columns(z=5, v=5, first=5 * bool(formation.rolling)).make_symbols()
    gaps, P, _, _ = formation.build_constraints(x.z, x.v)
    if formation.rolling:
        gaps[formation.n_contacts :] -= formation.roll_function(x.first, x.v)[0]
    return name_kernel(x, _NOTHING, gaps=gaps, rates=P @ x.v)


@lru_cache(maxsize=32)
def collocation_kernel(name: str, degree: int, freedoms: int) -> NamedKernel:
    """Collocation along the tangent space: N^T (s_j - s_0 - h sum_l a_jl r_l).

    s are the states at the `start`, the points and, if no point is there, the `end`; r are `rates`.
    """
    scheme: Scheme = make_scheme(name, degree)
    table, rungs = scheme.rungs, len(scheme.rungs)
    x = Columns(start=5, points=5 * degree, end=5 * (rungs - degree), rates=5 * degree, h=1)
    s, p = x.make_symbols(), Columns(N=5 * freedoms).make_symbols()
    here = ca.reshape(ca.vertcat(s.points, s.end), 5, rungs)
    rates, N = ca.reshape(s.rates, 5, degree), ca.reshape(p.N, 5, freedoms)
    steps = here - ca.repmat(s.start, 1, rungs) - s.h * (rates @ ca.DM(table).T)
    return name_kernel(s, p, steps=N.T @ steps)


@share(64)
def monitor_kernel(formation: Formation, monitored: tuple[int, ...]) -> NamedKernel:
    """Limits of a formation."""
    x = Columns(z=5).make_symbols(z=build_features(formation.scene).z)
    values = ca.vertcat(*(formation.limits[k].value for k in monitored))
    return name_kernel(x, _NOTHING, values=values)


@share(64)
def opening_kernel(formation: Formation, contact: Contact) -> NamedKernel:
    """Second derivative of a contact's gap."""
    x = Columns(z=5, v=5, a=5).make_symbols()
    _, A, _, A_dot_v = Formation(formation.scene, (contact,)).function(x.z, x.v)
    return name_kernel(x, _NOTHING, opening=A @ x.a + A_dot_v)


@share(64)
def goal_kernel(
    formation: Formation, until: Until | None, turns: tuple[int, ...], gained: Formation | None
) -> NamedKernel | None:
    """End of a phase, zero rates of reversals, and zero speeds of contacts gained; None if none."""
    scene = formation.scene
    x = Columns(z=5, v=5).make_symbols(z=build_features(scene).z)
    z, v = x.z, x.v
    parts: list[Expression] = []
    if until is not None and until.contact is not None:
        # Where a contact changes its name its gap has no gradient, but the end of its range has.
        ranges = [limit for c in formation.contacts for limit in build_limits(c, scene)]
        ends = [limit.value for limit in ranges if limit.gains(until.contact)]
        parts.append(ends[0] if len(ends) == 1 else build_gap(until.contact, scene))
    if until is not None:
        parts += [z[row] - value for row, value in until.poses]
    if turns:
        rates = ca.vertcat(formation.function(z, v)[2] @ v, v[3:])
        parts += [rates[k] for k in turns]
    if gained is not None:
        P = gained.build_constraints(z, v)[1]
        parts += [P[i, :] @ v for i in new_rows(formation, gained)]
    return name_kernel(x, _NOTHING, goals=ca.vertcat(*parts)) if parts else None


def new_rows(formation: Formation, following: Formation) -> list[int]:
    """Constraint rows of a formation that the one before does not have."""
    fresh = [i for i, c in enumerate(following.contacts) if c not in formation.contacts]
    rolling = [following.contacts[row] for row in following.rolling_rows]
    n_c = following.n_contacts
    return fresh + [n_c + i for i, c in enumerate(rolling) if c not in formation.rolling]


@lru_cache(maxsize=8)
def effort_kernel(controls: int) -> NamedKernel:
    """Integral of tau^T tau over an interval, by the control points of tau."""
    x, n = Columns(tau=2 * controls, h=1).make_symbols(), controls - 1
    products = [
        [comb(n, i) * comb(n, j) / comb(2 * n, i + j) / (2 * n + 1) for j in range(controls)]
        for i in range(controls)
    ]
    tau = ca.reshape(x.tau, 2, controls)
    return name_kernel(x, _NOTHING, effort=x.h * ca.trace(tau @ ca.DM(products) @ tau.T))


@lru_cache(maxsize=8)
def bend_kernel(controls: int) -> NamedKernel:
    """Cost of second differences of the control points of torques."""
    x, p = Columns(tau=2 * controls, h=1).make_symbols(), Columns(weight=2).make_symbols()
    tau = ca.reshape(x.tau, 2, controls)
    bends = tau[:, 2:] - 2 * tau[:, 1:-1] + tau[:, :-2]
    return name_kernel(x, p, cost=x.h * ca.dot(p.weight, ca.sum2(bends**2)))


def find_leaving(formation: Formation, following: Formation) -> list[int]:
    """Contacts of a formation that the next one does not have."""
    return [i for i, c in enumerate(formation.contacts) if c not in following.contacts]


@share(32)
def impact_kernel(formation: Formation, following: Formation) -> NamedKernel:
    """A plastic impact M5 (v+ - v-) = G+^T p, P+ v+ = 0 onto the next formation, `Xi` after it.

    Rates of gaps that open, and friction cones of rolling contacts, are nonnegative.
    """
    scene, n_c = following.scene, following.n_contacts
    x = Columns(after=5, before=5, z=5, impulses=following.n_constraints).make_symbols()
    p = Columns(Xi=n_c).make_symbols()
    _, P, _, A_t = following.build_constraints(x.z, x.after)
    push = build_force_rows(following, P, A_t, p.Xi).T @ x.impulses
    A = formation.function(x.z, x.after)[1]
    rolling = list(following.rolling_rows)
    grip = ca.DM(following.friction)[rolling, :] * x.impulses[rolling, :]
    return name_kernel(
        x,
        p,
        jump=ca.DM(scene.mass_diagonal) * (x.after - x.before) - push,
        held=P @ x.after,
        leaving=A[find_leaving(formation, following), :] @ x.after,
        cones=ca.vertcat(grip - x.impulses[n_c:, :], grip + x.impulses[n_c:, :]),
    )
