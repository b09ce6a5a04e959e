"""Statics with Coulomb friction: holding torques, missing forces, and starts of motion.

With contact forces c_n, c_t, friction d of the joints and accelerations a, at rest

    M5 a = g + S (tau - d) + A^T c_n + A_t^T c_t,   A a = 0,   |c_t| <= mu c_n,   |d| <= D.

With a = 0 this is static balance. Torques that permit it form a convex polygon, maybe unbounded: by
duality, its sides are extreme rays of the polar of the cone of contact forces. Outside it a
motion begins in any case; inside it friction may hold the formation (static indeterminacy).

In a contact mode friction follows from the acceleration: a contact slides with c_t = -mu Xi c_n and
Xi A_t a > 0, or sticks with A_t a = 0; closed gaps of other contacts can only open. With two
degrees of freedom the modes are the sectors and rays between a few lines. One linear programme for
each mode decides whether a motion can begin. At the end of a motion the acceleration opposes its
direction. Forces may be indeterminate in these modes, for example if only a finger starts; torques
determine the forces in the start modes of `simulation.modes`.
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

SURE = 1e-3  # distance from the torque polygon, over the scene's, from which motion is certain
_TINY = 1e-9  # rounding of numbers of order one
GRAZE = 1e-3  # largest closing acceleration of a grazing gap, over that of sliding and turning
_STEP = 3e-5  # step of difference quotients of limits, in radii of gyration and rad
_KINK = 1e-2  # smallest difference of one-sided slopes of a kink, in radii of gyration
_TORQUES = np.hstack([np.eye(5)[:, 3:], -np.eye(5)[:, 3:]])  # torques of both signs, (5, 4)


class TorquePolygon(NamedTuple):
    """Polygon normals @ tau <= bounds, with unit normals."""

    normals: Array  # (m, 2)
    bounds: Array  # (m,) [N m]: a single minus infinity if the polygon is empty

    def measure(self, tau: Array) -> Array:
        """Distances of torques, (n, 2), from the polygon, negative inside, (n,) [N m]."""
        return np.asarray((tau @ self.normals.T - self.bounds).max(axis=1, initial=-np.inf))

    def is_empty(self, limit: Array) -> bool:
        """Whether no torques up to `limit`, (2,) [N m], maybe infinite, are in the polygon."""
        from scipy.optimize import linprog

        if not np.isfinite(self.bounds).all():
            return True
        box = np.stack([-limit, limit], axis=1)
        return bool(linprog(np.zeros(2), self.normals, self.bounds, bounds=box).status == 2)


class BlockedStart(NamedTuple):
    """The contact with the largest tension, in the mode that minimizes it."""

    contact: str  # empty if torque limits alone prevent a motion
    shortfall: float  # [N]: least shortfall of c_n below epsilon


class _Mode(NamedTuple):
    """Contact mode of a motion that begins or ends at rest; accelerations are N y."""

    N: Array  # (5, f)
    rates: Array  # (n_c + 2, f): of sliding and turning
    opens: Array  # (k, f): of closed gaps, which can only open
    signs: Array  # (n_c + 2,): of sliding and turning, zero if stuck or held


class _Solution(NamedTuple):
    """Solution of a linear programme, in SI units."""

    c_n: Array  # c_n, c_t (n_c,) [N]
    c_t: Array
    x: Array  # (k,): coefficients of the forces of the programme


class Statics:
    """A formation, usually of all touching contacts, at rest at a configuration."""

    def __init__(self, formation: Formation, z: Array) -> None:
        self.formation, self.z, self.scene = formation, z, formation.scene
        self.kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        self.A, self.A_t = self.kinematics.A[0], self.kinematics.A_t[0]
        scales = self.scene.scales
        # Forces on z count in the scene's force and, as torques, in its torque.
        self._units = scales.force * np.array([1.0, 1.0, *[scales.length] * 3])

    def torque_polygon(self, least: float = 0.0) -> TorquePolygon:
        """Polygon of torques that contact forces and joint friction can balance with gravity.

        The apex of every cone is `least` [N]: c_n >= least and |c_t| <= mu (c_n - least).
        """
        scales, slip = self.scene.scales, self.formation.friction[:, None] * self.A_t
        edges = scales.force * np.concatenate([self.A - slip, self.A + slip]) / self._units
        load = (self.scene.applied_force + least * self.A.sum(axis=0)) / self._units
        # Without friction the edges may not span all directions of the load.
        _, values, basis = np.linalg.svd(edges[:, :3])
        basis = basis[: int((values > _TINY * values[0]).sum())]
        empty = TorquePolygon(np.array([[1.0, 0.0]]), np.array([-np.inf]))
        if np.abs(load[:3] - load[:3] @ basis.T @ basis).max() > _TINY:
            return empty
        edges, load = (
            np.hstack([part[..., :3] @ basis.T, part[..., 3:]]) for part in (edges, load)
        )
        # Rays u with edges @ u >= 0 give u @ (load, tau) <= 0. Joint friction moves sides outwards
        # and adds sides along the axes.
        size = edges.shape[1]
        rows = np.concatenate([edges, np.eye(size)[-2:]])
        rays = null_vector(rows[_list_combinations(len(rows), size - 1)], _TINY)
        rays = np.concatenate([rays, -rays])
        rays = rays[(rays @ edges.T >= -_TINY).all(axis=1)]
        lengths, bounds = np.linalg.norm(rays[:, -2:], axis=1), -rays @ load
        sides = lengths > _TINY
        if (bounds[~sides] < -_TINY).any():
            return empty
        normals = rays[sides, -2:] / lengths[sides, None]
        bounds = scales.torque * bounds[sides] / lengths[sides]
        return TorquePolygon(normals, bounds + np.abs(normals) @ self.scene.dry[3:])

    def find_pulls(self, tau: Array, count: int) -> Array:
        """Tensions p >= 0 of the first `count` contacts, (n_c,) [N], of least sum in balance.

        They add to forces in the friction cones. Infinite if there is no balance.
        """
        bounds = np.tile([0.0, np.inf], (len(self.A), 1))
        bounds[count:] = 0.0
        solution = self._solve(tau, -self.A.T, bounds, np.ones(len(self.A)))
        return np.full(len(self.A), np.inf) if solution is None else solution.x

    def find_holding_change(self, tau: Array, least: float, free: tuple[int, ...]) -> Array | None:
        """Smallest change of the torques `free`, (2,) [N m], in the 1-norm, that holds; or None.

        Torques stay within their limits, with c_n >= least [N] and |c_t| <= mu c_n.
        """
        room = [np.maximum(self.scene.torque_limit + side * tau, 0.0) for side in (-1.0, 1.0)]
        bounds = np.stack([np.zeros(4), np.where(np.isin([0, 1], free), room, 0.0).ravel()], axis=1)
        solution = self._solve(tau, _TORQUES, bounds, np.ones(4), least)
        return None if solution is None else solution.x[:2] - solution.x[2:]

    def find_firmest_forces(self, tau: Array) -> Array:
        """Balancing forces c_n and c_t with the largest min(c_n), (2, n_c) [N]; NaN if none."""
        bounds = np.array([[-np.inf, np.inf]])
        solution = self._solve(tau, np.zeros((5, 1)), bounds, -np.ones(1), presses=True)
        return np.full((2, len(self.A)), np.nan) if solution is None else np.array(solution[:2])

    def find_block(self, epsilon: float, ends: bool) -> BlockedStart | None:
        """Cause that no motion begins from rest, or `ends` at rest; None if one can.

        With more than two degrees of freedom the result is None.
        """
        best, modes = None, list(self._list_modes(ends))
        for mode in modes:
            solution = self._start(mode, epsilon)
            if solution is not None and solution.x[-1] >= 0:
                return None
            if solution is not None and (best is None or solution.x[-1] > best.x[-1]):
                best = solution
        if best is None:
            return BlockedStart("", 0.0) if modes else None
        # Among equal shortfalls the first contact, not one selected by rounding.
        is_smallest = best.c_n <= best.c_n.min() + _TINY * self.scene.scales.force
        return BlockedStart(self.formation.names[int(is_smallest.argmax())], -float(best.x[-1]))

    def list_continuous(
        self, epsilon: float, held: TorquePolygon | None = None
    ) -> list[tuple[float, tuple[float, ...]]] | None:
        """Modes in which a motion begins by continuous torques, or ends with `held` torques.

        A motion begins without acceleration, with the limit friction of the mode; it may end with
        an acceleration. Returns margins of c_n over epsilon [N], and signs of sliding and turning,
        (n_c + 2,). None with more than two degrees of freedom.
        """
        candidates = list[tuple[float, tuple[float, ...]]]()
        modes = list(self._list_modes(held is not None))
        for mode in modes:
            impending = _Mode(mode.N[:, :0], mode.rates[:, :0], mode.opens[:0, :0], mode.signs)
            solutions = [self._start(mode, epsilon, polygon=held)]
            if held is None and solutions[0] is not None:
                solutions.append(self._start(impending, epsilon))
            margins = [-np.inf if part is None else float(part.x[-1]) for part in solutions]
            if min(margins) >= 0:
                candidates.append((min(margins), tuple(mode.signs.tolist())))
        return candidates if modes else None

    def find_epsilon(self, ends: bool) -> float | None:
        """Largest epsilon that permits a motion to begin, or end at rest [N]; or None."""
        solutions = [self._start(mode, 0.0, cones=True) for mode in self._list_modes(ends)]
        values = [float(part.x[-1]) for part in solutions if part is not None]
        return max((value for value in values if value >= 0), default=None)

    def find_torque_limit(self, epsilon: float, finger: int, ends: bool) -> float | None:
        """Smallest torque limit of a finger that permits a motion to begin, or end [N m]."""
        parts = [self._start(mode, epsilon, finger) for mode in self._list_modes(ends)]
        values = [float(part.x[[finger, 2 + finger]].sum()) for part in parts if part is not None]
        return min(values, default=None)

    @cached_property
    def freedoms(self) -> Array:
        """Basis of the accelerations compatible with the contacts, shape (5, f)."""
        return find_freedoms(self.kinematics.P[0], self.scene.mass_diagonal, _TINY)

    @cached_property
    def near(self) -> Flags:
        """Whether each limit of the formation is at zero, shape (n_limits,)."""
        limits = self.formation.evaluate_limits(self.z[None])[0]
        return np.asarray(np.abs(limits) < self.scene.touching)

    @cached_property
    def opening(self) -> tuple[Array, Numbers]:
        """Gradients of the closed gaps, (k, 5), and indices of closed limits with kinks.

        A pointed fingertip at a vertex has a kink.
        """
        if not self.near.any():
            return np.zeros((0, 5)), np.zeros(0, dtype=np.int64)
        length, evaluate = self.scene.scales.length, self.formation.evaluate_limits
        steps = _STEP * np.array([length, length, 1.0, 1.0, 1.0])
        values = evaluate(self.z + np.vstack([np.diag(steps), -np.diag(steps)]))
        forward, backward = np.split((values - evaluate(self.z[None]))[:, self.near], 2)
        kinked = (forward + backward).max(axis=0) > _KINK * _STEP * length
        return (forward - backward)[:, ~kinked].T / (2 * steps), np.flatnonzero(self.near)[kinked]

    def opens(self, acceleration: Array) -> bool:
        """Whether no limit with a kink closes along an acceleration, shape (5,)."""
        kinked, length = self.opening[1], self.scene.scales.length
        if not len(kinked):
            return True
        step = _STEP / np.abs(acceleration / [length, length, 1.0, 1.0, 1.0]).max()
        places = self.z + np.array([[0.0], [step]]) * acceleration
        before, after = self.formation.evaluate_limits(places)[:, kinked]
        return bool((after - before >= -GRAZE * _STEP * length).all())

    def _list_modes(self, ends: bool) -> Iterator[_Mode]:
        """All modes of motion with one or two degrees of freedom; none with more."""
        N, side = self.freedoms, -1.0 if ends else 1.0
        if not 1 <= N.shape[1] <= 2:
            return
        rates = np.vstack([self.A_t @ N, N[3:]])
        opens = self.opening[0] @ N
        # Gaps of zero slope do not change.
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
        polygon: TorquePolygon | None = None,
    ) -> _Solution | None:
        """Motion with c_n >= least + r, or None; x are both parts of the torques, then r.

        Maximizes r; or minimizes the unlimited torque of a `finger`, with r = 0. The apex of the
        cones of sticking contacts is `least`, or least + r with `cones`.
        """
        zero_torque, limits, cost = np.zeros(2), self.scene.torque_limit.copy(), np.zeros(5)
        if finger is not None:
            limits[finger], cost[[finger, 2 + finger]] = np.inf, 1.0
        else:
            cost[-1] = -1.0
        r = [-np.inf, np.inf] if finger is None else [0.0, 0.0]
        bounds = np.vstack([np.stack([np.zeros(4), np.tile(limits, 2)], axis=1), r])
        forces = np.column_stack([_TORQUES, np.zeros(5)])
        return self._solve(zero_torque, forces, bounds, cost, least, mode, True, cones, polygon)

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
        polygon: TorquePolygon | None = None,
    ) -> _Solution | None:
        """Minimize cost @ x in balance with x-multiples of `forces`, (5, k), by linear programming.

        Constraints: x in `bounds`, (k, 2); c_n >= least [N]; |c_t| <= mu (c_n - least) of sticking
        contacts. All contacts stick, or a motion begins in a `mode`. The last x adds to `least` of
        c_n if `presses`, and of the cones with `cones`. None if infeasible.
        """
        from scipy.optimize import linprog

        scene, n_c, mu = self.scene, len(self.A), self.formation.friction
        force, torque = scene.scales.force, scene.scales.torque
        if mode is None:
            no_rates = np.zeros((n_c + 2, 0))
            mode = _Mode(np.zeros((5, 0)), no_rates, no_rates[:0], np.zeros(n_c + 2))
        f, signs, stuck = mode.N.shape[1], mode.signs, mode.signs == 0
        # Unknowns y, c_n, c_t, joint friction d and x, each scaled by its unit.
        sizes = np.abs(forces / self._units[:, None]).max(axis=0)
        unit = 1 / np.where(sizes > 0, sizes, 1 / force)
        units = np.concatenate([np.ones(f), np.full(2 * n_c, force), np.full(2, torque), unit])
        y, c_n, c_t, d, x = np.split(np.diag(units), np.cumsum([f, n_c, n_c, 2]))
        inertia = (scene.mass_diagonal[:, None] * mode.N) @ y
        pushes = self.A.T @ c_n + self.A_t.T @ c_t - np.eye(5)[:, 3:] @ d + forces @ x - inertia
        load = scene.applied_force + np.eye(5)[:, 3:] @ tau
        slides, sticks = ~stuck[:n_c], stuck[:n_c]
        friction = c_t[slides] + (mu * signs[:n_c])[slides, None] * c_n[slides]
        equal = np.vstack([pushes / self._units[:, None], friction / force, mode.rates[stuck] @ y])
        cone = mu[sticks, None] * (c_n[sticks] - cones * x[-1])
        apex, motion = least * mu[sticks], signs[~stuck, None] * mode.rates[~stuck] @ y
        rows = [(cone - c_t[sticks]) / force, (cone + c_t[sticks]) / force]
        lower = [apex / force, apex / force, np.zeros(len(motion) + len(mode.opens))]
        rows += [motion, mode.opens @ y]
        if f:
            rows, lower = [*rows, motion.sum(axis=0)[None]], [*lower, np.array([1e-5])]
        rows.append((c_n - presses * x[-1]) / force)
        lower.append(np.full(n_c, least / force))
        if polygon is not None:
            rows.append(-polygon.normals @ (forces[3:] @ x) / torque)
            lower.append((polygon.normals @ tau - polygon.bounds) / torque)
        dry = np.stack([-scene.dry[3:], scene.dry[3:]], axis=1)
        dry = np.where(stuck[n_c:, None], dry, (scene.dry[3:] * signs[n_c:])[:, None])
        unbounded = np.tile([-np.inf, np.inf], (f + 2 * n_c, 1))
        result: Any = linprog(
            cost @ x,
            A_ub=-np.vstack(rows),
            b_ub=-np.concatenate(lower),
            A_eq=equal,
            b_eq=np.concatenate([-load / self._units, np.zeros(len(equal) - 5)]),
            bounds=np.vstack([unbounded, dry / torque, bounds / unit[:, None]]),
            # Shortfalls close to balance are small.
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if result.status != 0:
            return None
        return _Solution(c_n @ result.x, c_t @ result.x, x @ result.x)


def list_sectors(rates: Array) -> list[Array]:
    """One acceleration, shape (f,), for each combination of signs of rates, shape (n, f)."""
    if rates.shape[1] == 1:
        return [np.ones(1), -np.ones(1)]
    rows = rates[np.abs(rates).max(axis=1) > _TINY * np.abs(rates).max()]
    normals = np.arctan2(-rows[:, 0], rows[:, 1])
    angles = sort_unique(np.round(np.concatenate([normals, normals + np.pi]) % (2 * np.pi), 12))
    middles = (angles + np.append(angles[1:], angles[0] + 2 * np.pi)) / 2
    return [np.array([np.cos(t), np.sin(t)]) for t in np.concatenate([middles, angles])]


@lru_cache(maxsize=16)
def _list_combinations(count: int, k: int) -> Numbers:
    """All combinations of k out of `count` rows, shape (m, k)."""
    return np.array(list(combinations(range(count), k)), dtype=np.int64).reshape(-1, k)


def pushes_one_way(formation: Formation, z: Array) -> bool:
    """Whether contact forces share a half-space at all of `z`, (n, 5): no motion comes to rest.

    Then w^T f > 0 for all edges f of friction cones, and w^T g >= 0: w^T M q' only grows.
    """
    from scipy.optimize import linprog

    kinematics, mu = formation.evaluate(z, np.zeros_like(z)), formation.friction[:, None]
    edges = [kinematics.A + side * mu * kinematics.A_t for side in (-1.0, 1.0)]
    forces = np.concatenate(edges, axis=1)[..., :3].reshape(-1, 3)
    rows = np.column_stack([-forces, np.ones(len(forces))])
    gravity = np.append(-formation.scene.applied_force[:3], 0.0)
    bounds = [(-1.0, 1.0)] * 3 + [(0.0, 1.0)]
    result = linprog(
        [0, 0, 0, -1], np.vstack([rows, gravity]), np.zeros(len(rows) + 1), bounds=bounds
    )
    return bool(result.status == 0 and result.x[-1] > 1e-3)
