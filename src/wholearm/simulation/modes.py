"""Contact modes of a moving formation: what slides, what sticks, and the equations of motion.

A stuck contact is integrated like a rolling one, v_t = 0 with c_t free, and a held joint with
theta_i' = 0 and a free friction torque f:

    P = [A; A_t(rolling); A_t(stuck); e(held)],    |c_t| <= mu c_n,    |f| <= D.

Vertices of a flush edge slide and stick as one. Only the sum T of their c_t is determined, with
|T| <= sum mu c_n; it is distributed in proportion to c_n, which does not affect the motion. A
contact flush with a rolling one has no friction of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..contacts.formation import Formation
from .hand import build_system
from .stepper import Modes
from .system import ContactRows


class Unit(NamedTuple):
    """What slides or turns, and sticks or is held, as one."""

    rows: tuple[int, ...]  # among the contacts and then the joints
    grips: bool  # whether there is friction to hold it


@lru_cache(maxsize=64)
def list_units(formation: Formation) -> tuple[Unit, ...]:
    """Everything that may slide or turn, contacts first; no contacts flush with a rolling one."""
    friction = np.concatenate([formation.friction, formation.scene.dry[3:]])
    groups = dict.fromkeys(formation.turn_with(row) for row in range(len(friction)))
    return tuple(
        Unit(rows, bool(friction[rows[0]] > 0))
        for rows in groups
        if not set(rows) & set(formation.rolling_rows)
    )


@dataclass(frozen=True, eq=False)
class Mode:
    """A formation with what rolls or sticks and is held.

    `holders` are the rows, among contacts and then joints, of what each force after c_n holds.
    """

    formation: Formation
    holders: tuple[tuple[int, ...], ...]

    @property
    def n_constraints(self) -> int:
        """Number of constraints, and of independent forces c = [c_n; c_t or T; f]."""
        return self.formation.n_contacts + len(self.holders)

    @property
    def held(self) -> tuple[list[int], list[int]]:
        """First row of each contact, or flush edge, that rolls or sticks; joints that are held."""
        first, count = [rows[0] for rows in self.holders], self.formation.n_contacts
        return [row for row in first if row < count], [row - count for row in first if row >= count]

    def find_modes(self) -> Modes:
        """The same of the pairs of features of the scene, without signs."""
        names, formation = build_system(self.formation.scene).names, self.formation
        pairs = tuple(names.index(name) for name in formation.names)
        stuck = [rows for rows in self.holders if rows[0] < len(pairs)]
        return Modes(
            pairs,
            tuple(tuple(pairs[row] for row in rows) for rows in stuck),
            tuple(3 + joint for joint in self.held[1]),
        )

    def declares(self, holder: int) -> bool:
        """Whether the phase asks for what the `holder`-th force after c_n holds."""
        return self.holders[holder][0] in self.formation.rolling_rows

    @cached_property
    def force_limit_rows(self) -> tuple[Array, Array]:
        """H, shape (n_c + 2 K, n_c + K), and h: the contacts hold where H c + h >= 0.

        Every c_n, then both sides of the cones of the K that are held (see `EventRows.cone`).
        """
        formation, count = self.formation, self.formation.n_contacts
        unit = np.eye(self.n_constraints)
        edge, most = np.zeros((len(self.holders), len(unit))), np.zeros(len(self.holders))
        for k, rows in enumerate(self.holders):
            if rows[0] < count:
                edge[k, list(rows)] = formation.friction[list(rows)]
            else:
                most[k] = formation.scene.dry[3 + rows[0] - count]
        normal, tangential = unit[:count], unit[count:]
        H = np.vstack([normal, edge - tangential, edge + tangential])
        return H, np.concatenate([np.zeros(count), most, most])

    @cached_property
    def force_limit_units(self) -> Array:
        """The scene's units of H c + h, shape (n_c + 2 K,) [N, N m]."""
        scales, count = self.formation.scene.scales, self.formation.n_contacts
        held = [scales.force if rows[0] < count else scales.torque for rows in self.holders]
        return np.array([scales.force] * count + held + held)


def find_mode(formation: Formation, signs: Array) -> Mode:
    """What rolls, and what sticks where `signs`, (n_c + 2,), are zero; with one freedom nothing."""
    held: list[tuple[int, ...]] = [(row,) for row in formation.rolling_rows]
    if formation.n_constraints < 4:
        held += [unit.rows for unit in list_units(formation) if signs[unit.rows[0]] == 0]
    return _share_mode(formation, tuple(sorted(held)))


_share_mode = lru_cache(maxsize=64)(Mode)


def list_modes(
    formation: Formation,
    signs: Array,
    units: Sequence[Unit],
    options: Iterable[Sequence[float]],
) -> Iterator[tuple[Array, Mode]]:
    """Each combination of signs of some units, zero where held, that leaves a freedom to move in.

    Parameters
    ----------
    signs : (n_c + 2,)  of contacts and joints; those of the units are replaced
    options             signs to try, for each unit
    """
    for choice in product(*options):
        tried = signs.copy()
        for unit, sign in zip(units, choice, strict=True):
            tried[list(unit.rows)] = sign
        mode = find_mode(formation, tried)
        if mode.n_constraints <= 4:
            yield tried, mode


def evaluate_rows(formation: Formation, z: Array, v: Array) -> ContactRows:
    """Constraint rows of a formation at one state, with its contacts closed."""
    system = build_system(formation.scene)
    return system.evaluate(z, v, [system.names.index(name) for name in formation.names])


class Response(NamedTuple):
    """How a mode answers to torques; quantities are rows @ (1, tau_1, tau_2)."""

    mode: Mode
    signs: Array  # (n_c + 2,): of sliding and turning, zero for what is held or rolls
    c: Array  # (n_c + K, 3) [N, N m]: normal forces, then those of what is held
    acceleration: Array  # (5, 3)
    rates: Array  # (n_c + 2, 3): accelerations of the contacts' sliding and of the joints
    ratio: float  # reduced inertia over that without friction; jammed at zero and below

    @property
    def force_limits(self) -> Array:
        """What has to be positive for everything to hold, H c + h, (n_c + 2 K, 3) [N, N m]."""
        H, h = self.mode.force_limit_rows
        force_limits = np.asarray(H @ self.c)
        force_limits[:, 0] += h
        return force_limits

    @property
    def c_t(self) -> Array:
        """Friction of the contacts, (n_c, 3) [N]; NaN where a flush edge sticks: it is shared."""
        count = self.mode.formation.n_contacts
        slip = self.mode.formation.sliding_friction * self.signs[:count]
        c_t = -slip[:, None] * self.c[:count]
        for force, rows in zip(self.c[count:], self.mode.holders, strict=True):
            if rows[0] < count:
                c_t[list(rows)] = force if len(rows) == 1 else np.nan
        return c_t


def respond(mode: Mode, signs: Array, rows: ContactRows, v: Array) -> Response | None:
    """Solve the equations of motion at velocity v, (5,); None for dependent constraints.

    `signs`, (n_c + 2,), are those of contacts and joints, zero for what is held or rolls.
    """
    scene, count = mode.formation.scene, mode.formation.n_contacts
    (stuck, held), slip = mode.held, mode.formation.sliding_friction * signs[:count]
    hold = np.vstack([rows.A_t[stuck], np.eye(5)[3:][held]])
    P, G = (np.vstack([part, hold]) for part in (rows.A, rows.A - slip[:, None] * rows.A_t))
    bend = np.concatenate([rows.bend, rows.bend_t[stuck], np.zeros(len(held))])
    inverse_mass = 1 / scene.mass_diagonal
    if mode.n_constraints > mode.formation.n_constraints:
        lines = P * np.sqrt(inverse_mass)
        lines /= np.linalg.norm(lines, axis=1)[:, None]
        if len(P) > 5 or np.linalg.svd(lines, compute_uv=False)[-1] <= 1e-9:
            return None
    applied = np.zeros((5, 3))
    applied[:, 0] = scene.applied_force - scene.viscous * v
    applied[3:, 0] -= scene.dry[3:] * signs[count:]
    applied[3:, 1:] = np.eye(2)
    drop = P * inverse_mass
    K = drop @ G.T
    ratio = float(np.linalg.det(K) / np.linalg.det(drop @ P.T))
    c = np.zeros((len(P), 3))
    if abs(ratio) > 1e-12:
        right = -drop @ applied
        right[:, 0] -= bend
        c = np.asarray(np.linalg.solve(K, right), dtype=float)
    acceleration = inverse_mass[:, None] * (applied + G.T @ c)
    rates = np.vstack([rows.A_t @ acceleration, acceleration[3:]])
    rates[:count, 0] += rows.bend_t
    return Response(mode, signs, c, acceleration, rates, ratio)


def find_fixed(mode: Mode, rows: ContactRows) -> NDArray[np.bool_]:
    """Which contacts, then joints, a mode keeps fixed, (n_c + 2,)."""
    A, A_t, joints = rows.A, rows.A_t, np.eye(5)[3:]
    root = np.sqrt(mode.formation.scene.mass_diagonal)
    held = [A, A_t[mode.held[0]], joints[mode.held[1]]]
    free = np.vstack([A_t, joints]) / root
    length = np.linalg.norm(free, axis=1)
    P = np.vstack(held) / root
    basis = np.linalg.svd(P / np.linalg.norm(P, axis=1)[:, None], full_matrices=False)[2]
    rest = free - (free @ basis.T) @ basis
    return np.asarray(np.linalg.norm(rest, axis=1) < 1e-7 * length)
