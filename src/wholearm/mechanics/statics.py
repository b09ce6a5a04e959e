"""Statics at rest with Coulomb friction: torques that hold, missing forces, and starts of motion.

With contact forces c_n, c_t, friction d of the joints and accelerations a, at rest

    M5 a = g + S (tau - d) + A^T c_n + A_t^T c_t,   A a = 0,   |c_t| <= mu c_n,   |d| <= D.

Without acceleration this is balance. Its projection onto the torques is a convex polygon, perhaps
unbounded: by duality, its sides are extreme rays of the polar of the cone of contact forces. Beyond
it a motion begins in any case; within it friction may hold everything (static indeterminacy).

In a contact mode friction follows from the acceleration: a contact slides with c_t = -mu Xi c_n and
Xi A_t a > 0, or sticks with A_t a = 0; closed gaps of other contacts can only open. With two
degrees of freedom the modes are the sectors and rays between a few lines. Whether a motion can
begin is one linear programme for each of them. For a motion that comes to rest the acceleration is
against its direction. Forces may be indeterminate here, as where only a finger starts; the start
modes of `simulation.modes` are those with forces that torques determine.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, Flags, Numbers, sort_unique
from ..contacts.formation import Formation
from .dynamics import find_freedoms, null_vector

SURE = 1e-3  # distance from torques that friction can hold, over the scene's, at which it moves
_TINY = 1e-9  # what counts as zero of numbers of the order of one
GRAZE = 1e-3  # largest closing acceleration of a gap that grazes, over sliding and turning
_STEP = 3e-5  # step that slopes of limits are taken over, in radii of gyration and rad
_KINK = 1e-2  # difference of slopes on both sides, in radii of gyration, from which there is a kink
_TORQUES = np.hstack([np.eye(5)[:, 3:], -np.eye(5)[:, 3:]])  # as two positive parts, (5, 4)


class TorquePolygon(NamedTuple):
    """The polygon normals @ tau <= bounds, with normals of length one."""

    normals: Array  # (m, 2)
    bounds: Array  # (m,) [N m]: a single one of minus infinity where nothing can be held

    def measure(self, tau: Array) -> Array:
        """How far torques, shape (n, 2), are beyond a side; negative inside, (n,) [N m]."""
        return np.asarray((tau @ self.normals.T - self.bounds).max(axis=1, initial=-np.inf))

    def is_empty(self, limit: Array) -> bool:
        """Whether no torques up to `limit`, shape (2,) [N m], maybe infinite, are inside."""
        from scipy.optimize import linprog

        if not np.isfinite(self.bounds).all():
            return True
        box = np.stack([-limit, limit], axis=1)
        return bool(linprog(np.zeros(2), self.normals, self.bounds, bounds=box).status == 2)


class BlockedStart(NamedTuple):
    """The contact with the largest tension, in the mode where that is least."""

    contact: str  # empty if torques alone prevent a motion
    short: float  # [N]: least shortfall of c_n below epsilon


class _Mode(NamedTuple):
    """Motions that begin or end at rest with the same friction: accelerations are N y."""

    N: Array  # (5, f)
    rates: Array  # (n_c + 2, f): of sliding and turning
    opens: Array  # (k, f): of closed gaps, that can only open
    signs: Array  # (n_c + 2,): of sliding and turning, zero for what sticks or is held


class _Answer(NamedTuple):
    """Solution of a linear programme, in SI units."""

    c_n: Array  # c_n, c_t (n_c,) [N]
    c_t: Array
    x: Array  # (k,): amounts of the given forces


class Statics:
    """A formation, usually of all contacts that touch, at rest at a configuration."""

    def __init__(self, formation: Formation, z: Array) -> None:
        self.formation, self.z, self.scene = formation, z, formation.scene
        self.kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        self.A, self.A_t = self.kinematics.A[0], self.kinematics.A_t[0]
        scales = self.scene.scales
        # Forces on z count in the scene's force and, as torques, in its torque.
        self._units = scales.force * np.array([1.0, 1.0, *[scales.length] * 3])

    def torque_polygon(self, least: float = 0.0) -> TorquePolygon:
        """Torques with which contact forces and friction of the joints can balance gravity.

        The apex of every cone is `least` [N]: c_n >= least and |c_t| <= mu (c_n - least).
        """
        scales, slip = self.scene.scales, self.formation.friction[:, None] * self.A_t
        edges = scales.force * np.concatenate([self.A - slip, self.A + slip]) / self._units
        load = (self.scene.applied_force + least * self.A.sum(axis=0)) / self._units
        # Without friction the edges may leave a direction of the load out.
        _, values, basis = np.linalg.svd(edges[:, :3])
        basis = basis[: int((values > _TINY * values[0]).sum())]
        nothing = TorquePolygon(np.array([[1.0, 0.0]]), np.array([-np.inf]))
        if np.abs(load[:3] - load[:3] @ basis.T @ basis).max() > _TINY:
            return nothing
        edges, load = (
            np.hstack([part[..., :3] @ basis.T, part[..., 3:]]) for part in (edges, load)
        )
        # Rays u with edges @ u >= 0 give u @ (load, tau) <= 0. Friction of the joints moves a side
        # out, and adds sides along the axes.
        size = edges.shape[1]
        rows = np.concatenate([edges, np.eye(size)[-2:]])
        rays = null_vector(rows[_choose(len(rows), size - 1)], _TINY)
        rays = np.concatenate([rays, -rays])
        rays = rays[(rays @ edges.T >= -_TINY).all(axis=1)]
        lengths, bounds = np.linalg.norm(rays[:, -2:], axis=1), -rays @ load
        sides = lengths > _TINY
        if (bounds[~sides] < -_TINY).any():
            return nothing
        normals = rays[sides, -2:] / lengths[sides, None]
        bounds = scales.torque * bounds[sides] / lengths[sides]
        return TorquePolygon(normals, bounds + np.abs(normals) @ self.scene.dry[3:])

    def find_pulls(self, tau: Array) -> Array:
        """Pulls p >= 0 of the contacts, (n_c,) [N], of least sum with which forces balance.

        Contact forces are those of cones less p along the normals. Infinite if no pulls balance.
        """
        free = np.tile([0.0, np.inf], (len(self.A), 1))
        answer = self._solve(tau, -self.A.T, free, np.ones(len(self.A)))
        return np.full(len(self.A), np.inf) if answer is None else answer.x

    def find_holding_change(self, tau: Array, least: float, free: tuple[int, ...]) -> Array | None:
        """Change of the torques `free`, (2,) [N m], of least sum of sizes that holds, or None.

        Torques stay within their limits, with c_n >= least [N] and |c_t| <= mu c_n.
        """
        most = [np.maximum(self.scene.torque_limit + side * tau, 0.0) for side in (-1.0, 1.0)]
        bounds = np.stack([np.zeros(4), np.where(np.isin([0, 1], free), most, 0.0).ravel()], axis=1)
        answer = self._solve(tau, _TORQUES, bounds, np.ones(4), least)
        return None if answer is None else answer.x[:2] - answer.x[2:]

    def find_firmest_forces(self, tau: Array) -> Array:
        """Contact forces c_n and c_t with the largest least c_n, (2, n_c) [N]; NaN for none."""
        free = np.array([[-np.inf, np.inf]])
        answer = self._solve(tau, np.zeros((5, 1)), free, -np.ones(1), presses=True)
        return np.full((2, len(self.A)), np.nan) if answer is None else np.array(answer[:2])

    def find_block(self, epsilon: float, ends: bool) -> BlockedStart | None:
        """Why no motion begins from rest, or `ends` at rest; None if one may.

        Formations with more than two degrees of freedom always may.
        """
        best, modes = None, list(self._list_modes(ends))
        for mode in modes:
            answer = self._start(mode, epsilon)
            if answer is not None and answer.x[-1] >= 0:
                return None
            if answer is not None and (best is None or answer.x[-1] > best.x[-1]):
                best = answer
        if best is None:
            return BlockedStart("", 0.0) if modes else None
        # Contacts that lack equally much: the first, not the one that rounding chooses.
        equal = best.c_n <= best.c_n.min() + _TINY * self.scene.scales.force
        return BlockedStart(self.formation.names[int(equal.argmax())], -float(best.x[-1]))

    def list_continuous(
        self, epsilon: float, held: TorquePolygon | None = None
    ) -> list[tuple[float, tuple[float, ...]]] | None:
        """Modes in which a motion begins by continuous torques, or ends by torques that are `held`.

        Without acceleration at first, it begins on the verge: friction is that of the mode. It may
        end with an acceleration. Each has its margin of c_n over epsilon [N], and signs of sliding
        and turning, (n_c + 2,). None with more than two degrees of freedom.
        """
        possible = list[tuple[float, tuple[float, ...]]]()
        modes = list(self._list_modes(held is not None))
        for mode in modes:
            still = _Mode(mode.N[:, :0], mode.rates[:, :0], mode.opens[:0, :0], mode.signs)
            each = [self._start(mode, epsilon, within=held)]
            if held is None and each[0] is not None:
                each.append(self._start(still, epsilon))
            margins = [-np.inf if answer is None else float(answer.x[-1]) for answer in each]
            if min(margins) >= 0:
                possible.append((min(margins), tuple(mode.signs.tolist())))
        return possible if modes else None

    def find_epsilon(self, ends: bool) -> float | None:
        """The largest epsilon with which a motion can begin, or end here [N], or None."""
        answers = [self._start(mode, 0.0, cones=True) for mode in self._list_modes(ends)]
        values = [float(one.x[-1]) for one in answers if one is not None]
        return max((value for value in values if value >= 0), default=None)

    def find_torque_limit(self, epsilon: float, finger: int, ends: bool) -> float | None:
        """The least torque limit of a finger with which a motion can begin, or end here [N m]."""
        answers = [self._start(mode, epsilon, finger) for mode in self._list_modes(ends)]
        values = [float(one.x[[finger, 2 + finger]].sum()) for one in answers if one is not None]
        return min(values, default=None)

    @cached_property
    def freedoms(self) -> Array:
        """Basis of the accelerations that the contacts allow, shape (5, f)."""
        return find_freedoms(self.kinematics.P[0], self.scene.mass_diagonal, _TINY)

    @cached_property
    def near(self) -> Flags:
        """Which limits of the formation are zero here, shape (n_limits,)."""
        limits = self.formation.evaluate_limits(self.z[None])[0]
        return np.asarray(np.abs(limits) < self.scene.touching)

    @cached_property
    def opening(self) -> tuple[Array, Numbers]:
        """Slopes of the closed gaps, (k, 5), which can only open; which limits have kinks instead.

        So has a pointed fingertip at a vertex.
        """
        if not self.near.any():
            return np.zeros((0, 5)), np.zeros(0, dtype=np.int64)
        length, evaluate = self.scene.scales.length, self.formation.evaluate_limits
        steps = _STEP * np.array([length, length, 1.0, 1.0, 1.0])
        around = evaluate(self.z + np.vstack([np.diag(steps), -np.diag(steps)]))
        ahead, behind = np.split((around - evaluate(self.z[None]))[:, self.near], 2)
        kinked = (ahead + behind).max(axis=0) > _KINK * _STEP * length
        return (ahead - behind)[:, ~kinked].T / (2 * steps), np.flatnonzero(self.near)[kinked]

    def opens(self, acceleration: Array) -> bool:
        """Whether what has a kink does not close along an acceleration, shape (5,)."""
        kinked, length = self.opening[1], self.scene.scales.length
        if not len(kinked):
            return True
        step = _STEP / np.abs(acceleration / [length, length, 1.0, 1.0, 1.0]).max()
        places = self.z + np.array([[0.0], [step]]) * acceleration
        here, ahead = self.formation.evaluate_limits(places)[:, kinked]
        return bool((ahead - here >= -GRAZE * _STEP * length).all())

    def _list_modes(self, ends: bool) -> Iterator[_Mode]:
        """Every mode of a motion with one or two degrees of freedom; none with more."""
        N, side = self.freedoms, -1.0 if ends else 1.0
        if not 1 <= N.shape[1] <= 2:
            return
        rates = np.vstack([self.A_t @ N, N[3:]])
        opens = self.opening[0] @ N
        # No motion changes what is level.
        opens = opens[np.abs(opens).max(axis=1, initial=0.0) > 1e-6 * np.abs(N).max()]
        for y in list_sectors(rates):
            speed = rates @ y
            signs = np.sign(np.where(np.abs(speed) > _TINY * np.abs(rates).max(), speed, 0))
            signs[list(self.formation.rolling_rows)] = 0.0
            yield _Mode(side * N, rates, side * opens, signs)

    def _start(
        self,
        mode: _Mode,
        least: float,
        finger: int | None = None,
        cones: bool = False,
        within: TorquePolygon | None = None,
    ) -> _Answer | None:
        """A motion with c_n >= least + r, or None; x are both parts of the torques, then r.

        With the largest r; or of a `finger`, within no limit, the least torque, with r = 0. The
        apex of the cones of what sticks is `least`, and with `cones` r higher.
        """
        none, most, cost = np.zeros(2), self.scene.torque_limit.copy(), np.zeros(5)
        if finger is not None:
            most[finger], cost[[finger, 2 + finger]] = np.inf, 1.0
        else:
            cost[-1] = -1.0
        r = [-np.inf, np.inf] if finger is None else [0.0, 0.0]
        bounds = np.vstack([np.stack([np.zeros(4), np.tile(most, 2)], axis=1), r])
        forces = np.column_stack([_TORQUES, np.zeros(5)])
        return self._solve(none, forces, bounds, cost, least, mode, True, cones, within)

    def _solve(
        self,
        tau: Array,
        forces: Array,
        bounds: Array,
        cost: Array,
        least: float = 0.0,
        mode: _Mode | None = None,
        presses: bool = False,
        cones: bool = False,
        within: TorquePolygon | None = None,
    ) -> _Answer | None:
        """Linear programme: amounts x of given forces, (5, k), of least cost, (k,), that balance.

        They stay within `bounds`, (k, 2), with c_n >= least [N] and, of what sticks, |c_t| <=
        mu (c_n - least). All sticks, or a motion begins in a `mode`. The last of x adds to the
        former `least` if `presses`, and to the latter with `cones`. None if there are none.
        """
        from scipy.optimize import linprog

        scene, n_c, mu = self.scene, len(self.A), self.formation.friction
        force, torque = scene.scales.force, scene.scales.torque
        if mode is None:
            none = np.zeros((n_c + 2, 0))
            mode = _Mode(np.zeros((5, 0)), none, none[:0], np.zeros(n_c + 2))
        f, signs, still = mode.N.shape[1], mode.signs, mode.signs == 0
        # Unknowns y, c_n, c_t, friction d of the joints, and x, each in a unit of its own.
        sizes = np.abs(forces / self._units[:, None]).max(axis=0)
        unit = 1 / np.where(sizes > 0, sizes, 1 / force)
        units = np.concatenate([np.ones(f), np.full(2 * n_c, force), np.full(2, torque), unit])
        y, c_n, c_t, d, x = np.split(np.diag(units), np.cumsum([f, n_c, n_c, 2]))
        inertia = (scene.mass_diagonal[:, None] * mode.N) @ y
        pushes = self.A.T @ c_n + self.A_t.T @ c_t - np.eye(5)[:, 3:] @ d + forces @ x - inertia
        load = scene.applied_force + np.eye(5)[:, 3:] @ tau
        slides, sticks = ~still[:n_c], still[:n_c]
        friction = c_t[slides] + (mu * signs[:n_c])[slides, None] * c_n[slides]
        equal = np.vstack([pushes / self._units[:, None], friction / force, mode.rates[still] @ y])
        cone = mu[sticks, None] * (c_n[sticks] - cones * x[-1])
        edge, motion = least * mu[sticks], signs[~still, None] * mode.rates[~still] @ y
        rows = [(cone - c_t[sticks]) / force, (cone + c_t[sticks]) / force]
        lows = [edge / force, edge / force, np.zeros(len(motion) + len(mode.opens))]
        rows += [motion, mode.opens @ y]
        if f:
            rows, lows = [*rows, motion.sum(axis=0)[None]], [*lows, np.array([1e-5])]
        rows.append((c_n - presses * x[-1]) / force)
        lows.append(np.full(n_c, least / force))
        if within is not None:
            rows.append(-within.normals @ (forces[3:] @ x) / torque)
            lows.append((within.normals @ tau - within.bounds) / torque)
        dry = np.stack([-scene.dry[3:], scene.dry[3:]], axis=1)
        dry = np.where(still[n_c:, None], dry, (scene.dry[3:] * signs[n_c:])[:, None])
        unbounded = np.tile([-np.inf, np.inf], (f + 2 * n_c, 1))
        answer: Any = linprog(
            cost @ x,
            A_ub=-np.vstack(rows),
            b_ub=-np.concatenate(lows),
            A_eq=equal,
            b_eq=np.concatenate([-load / self._units, np.zeros(len(equal) - 5)]),
            bounds=np.vstack([unbounded, dry / torque, bounds / unit[:, None]]),
            # Forces that are missing just beyond balance are small.
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if answer.status != 0:
            return None
        return _Answer(c_n @ answer.x, c_t @ answer.x, x @ answer.x)


def list_sectors(rates: Array) -> list[Array]:
    """One acceleration, shape (f,), for each combination of signs of rates, shape (n, f)."""
    if rates.shape[1] == 1:
        return [np.ones(1), -np.ones(1)]
    rows = rates[np.abs(rates).max(axis=1) > _TINY * np.abs(rates).max()]
    across = np.arctan2(-rows[:, 0], rows[:, 1])
    angles = sort_unique(np.round(np.concatenate([across, across + np.pi]) % (2 * np.pi), 12))
    middles = (angles + np.append(angles[1:], angles[0] + 2 * np.pi)) / 2
    return [np.array([np.cos(t), np.sin(t)]) for t in np.concatenate([middles, angles])]


@lru_cache(maxsize=16)
def _choose(count: int, k: int) -> Numbers:
    """Every choice of k out of `count` rows, shape (m, k)."""
    return np.array(list(combinations(range(count), k)), dtype=np.int64).reshape(-1, k)


def pushes_one_way(formation: Formation, z: Array) -> bool:
    """Whether contact forces share a half-space at all of `z`, (n, 5): no motion comes to rest.

    So if w^T f > 0 for all edges f of friction cones, and w^T g >= 0: then w^T M q' only grows.
    """
    from scipy.optimize import linprog

    kinematics, mu = formation.evaluate(z, np.zeros_like(z)), formation.friction[:, None]
    edges = [kinematics.A + side * mu * kinematics.A_t for side in (-1.0, 1.0)]
    forces = np.concatenate(edges, axis=1)[..., :3].reshape(-1, 3)
    rows = np.column_stack([-forces, np.ones(len(forces))])
    gravity = np.append(-formation.scene.applied_force[:3], 0.0)
    bounds = [(-1.0, 1.0)] * 3 + [(0.0, 1.0)]
    answer = linprog(
        [0, 0, 0, -1], np.vstack([rows, gravity]), np.zeros(len(rows) + 1), bounds=bounds
    )
    return bool(answer.status == 0 and answer.x[-1] > 1e-3)
