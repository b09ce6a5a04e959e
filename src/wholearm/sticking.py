"""A formation with one freedom at rest: which way it starts to move, and when.

At rest friction can take either sign, so each of the two ways along the free direction is tried
with the friction that would oppose it. The formation moves that way if it then accelerates that
way, presses on every contact and closes no other. If neither way does, it sticks; its forces are
then indeterminate, and all that can be asked is whether any inside the friction cones balance.
Accelerations and normal forces at rest are affine in the torques, so on one polynomial piece of
them the instant of starting is a root of a polynomial.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .contact import Contact
from .dynamics import Directions, reduced_inertia
from .errors import SimulationError
from .formation import TOUCHING, Formation, Kinematics
from .model import Array, Scene
from .stepper import SLACK_FORCE, SLACK_LIMIT

STILL = 1e-9
"""Acceleration, in the metric M5, that counts as rounding."""
BALANCED = 1e-6
"""Pull that counts as none: the accuracy of the linear programme [N]."""
_AHEAD = 1e-5
"""How far ahead along the free direction signs and gaps are looked for [m, rad]."""


@dataclass(frozen=True, eq=False)
class RestDirection:
    """One way in which a formation at rest could move.

    Attributes
    ----------
    heading : ndarray, shape (5,)
        The direction, of length one in the metric M5.
    directions : Directions
        The friction that opposes it.
    acceleration : ndarray, shape (3,)
        Acceleration along `heading` is acceleration @ (1, tau_1, tau_2).
    c_n : ndarray, shape (n_c, 3)
        Likewise the normal forces [N].
    ratio : float
        Reduced inertia over that without friction; jammed at zero and below.
    closes : bool
        Whether it would push features that touch already into one another.
    """

    heading: Array
    directions: Directions
    acceleration: Array
    c_n: Array
    ratio: float
    closes: bool

    def moves(self, tau: Array) -> bool:
        """Whether the formation starts to move this way under torques `tau`, shape (2,)."""
        load = np.array([1.0, *tau])
        return (
            self.ratio > 0
            and not self.closes
            and float(self.acceleration @ load) > STILL
            and float((self.c_n @ load).min()) >= -SLACK_FORCE
        )


@dataclass(frozen=True, eq=False)
class Departure:
    """The formation starts to move at `x` in [-1, 1] of a piece of the torques."""

    x: float
    direction: RestDirection


@dataclass(frozen=True)
class Collapse:
    """No forces balance any more at `x` of a piece, and no way presses on every contact.

    Attributes
    ----------
    x : float
    contact : str
        The contact that would have to pull most.
    c_n : float, [N]
    jammed : bool
        Whether friction jams one of the ways.
    """

    x: float
    contact: str
    c_n: float
    jammed: bool


@dataclass(frozen=True, eq=False)
class Rest:
    """A formation at rest at a configuration.

    Attributes
    ----------
    formation : Formation
    z : ndarray, shape (5,)
    ways : tuple of RestDirection
        The two ways it could move.
    touching : tuple of Contact
        Every contact that touches, in the formation or not.
    """

    formation: Formation
    z: Array
    ways: tuple[RestDirection, ...]
    touching: tuple[Contact, ...]

    def wait(self, coefficients: Array, x: float) -> Departure | Collapse | None:
        """Find what ends the rest on one piece of the torques, from `x` on.

        Parameters
        ----------
        coefficients : ndarray, shape (2, d + 1), [N m]
            Torques in ascending powers of x in [-1, 1].
        x : float
            Where to begin.

        Returns
        -------
        Departure, Collapse or None
            None if the formation rests to the end of the piece.
        """
        for way in self.ways:
            if way.moves(_evaluate(coefficients, x)):
                return Departure(x, way)
        ends = self._changes(coefficients, x)
        for start, stop in zip(ends, [*ends[1:], 1.0], strict=True):
            middle = (start + stop) / 2
            tau = _evaluate(coefficients, middle)
            ways = sorted(self.ways, key=lambda way: -float(way.acceleration @ [1.0, *tau]))
            for way in ways:
                if way.moves(tau):
                    return Departure(start, way)
            # Torques that balance form a convex set: the ends of a linear piece speak for it all.
            linear = coefficients.shape[1] <= 2
            for place in (start, stop) if linear else (start, middle, stop):
                if not self._balances(coefficients, place):
                    return self._collapse(coefficients, start, place)
        return None

    def _changes(self, coefficients: Array, x: float) -> list[float]:
        """Where on the piece an acceleration or a normal force changes sign, from `x` on."""
        places = {x}
        for way in self.ways:
            for row, offset in [(way.acceleration, -STILL), *((f, SLACK_FORCE) for f in way.c_n)]:
                polynomial = row[1:] @ coefficients
                polynomial[0] += row[0] + offset
                places |= {root for root in _roots(polynomial) if x < root < 1}
        return sorted(places)

    def _balances(self, coefficients: Array, x: float) -> bool:
        tau = _evaluate(coefficients, x)
        return balances(self.formation.scene, self.touching, self.z, tau)

    def _collapse(self, coefficients: Array, low: float, high: float) -> Collapse:
        if not self._balances(coefficients, low):
            high = low
        while high - low > 1e-10:
            middle = (low + high) / 2
            low, high = (middle, high) if self._balances(coefficients, middle) else (low, middle)
        tau = _evaluate(coefficients, high)
        load = np.array([1.0, *tau])
        free = [way for way in self.ways if way.acceleration @ load > STILL and not way.closes]
        pulls = find_pulls(self.formation.scene, self.touching, self.z, tau)
        if free or np.isinf(pulls).all():
            forces = np.array([way.c_n @ load for way in free or self.ways])
            name = self.formation.names[int(forces.min(axis=0).argmin())]
            least = float(forces.min())
        else:
            name, least = self.touching[int(pulls.argmax())].name, -float(pulls.max())
        jammed = any(way.ratio <= 0 for way in self.ways)
        return Collapse(high, name, least, jammed)


def find_rest(formation: Formation, z: Array) -> Rest:
    """Return a formation at rest at `z`, shape (5,).

    Raises
    ------
    SimulationError
        If the contacts do not leave exactly one freedom.
    """
    root = np.sqrt(formation.scene.mass_diagonal)
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    A = kinematics.A[0]
    _, values, right = np.linalg.svd(A / root)
    rank = int((values > 1e-9 * values[0]).sum())
    if rank != 4:
        raise SimulationError(
            f"{' '.join(formation.names)} leaves {5 - rank} freedoms; only a formation with one "
            "can start from rest"
        )
    heading = right[4] / root
    step = _AHEAD / np.abs(heading).max()
    limits = formation.evaluate_limits(z + step * np.array([[0.0], [1.0], [-1.0]]) * heading)
    near = np.abs(limits[0]) < TOUCHING
    # The curvature of the path cancels in the difference of both ways.
    rise = (limits[1, near] - limits[2, near]) / 2
    closes = [bool((sign * rise < -SLACK_LIMIT).any()) for sign in (1.0, -1.0)]
    rates = np.concatenate([kinematics.A_t[0] @ heading, heading[3:]])
    still = np.abs(rates) < 1e-9
    signs = np.sign([rates, -rates])
    if still.any():
        # What is stationary here has the direction that it takes up just after.
        ahead = [_rates(formation, z + sign * step * heading, sign * heading) for sign in (1, -1)]
        signs = np.where(still, np.where(np.abs(ahead) > 1e-12, np.sign(ahead), 0.0), signs)
    ways = tuple(
        _build_way(formation, side * heading, Directions(s[:-2], s[-2:]), kinematics, close)
        for side, s, close in zip((1.0, -1.0), signs, closes, strict=True)
    )
    gained = [formation.limits[k].gained for k in np.flatnonzero(near)]
    extra = tuple(contact for contact in gained if contact is not None)
    return Rest(formation, z, ways, formation.contacts + extra)


def _build_way(
    formation: Formation,
    heading: Array,
    directions: Directions,
    kinematics: Kinematics,
    closes: bool,
) -> RestDirection:
    scene, A = formation.scene, kinematics.A[0]
    G = A - (formation.friction * directions.Xi)[:, None] * kinematics.A_t[0]
    inverse_mass = 1 / scene.mass_diagonal
    applied = np.zeros((5, 3))
    applied[:, 0] = scene.applied_force
    applied[3:, 0] -= scene.dry[3:] * directions.sigma
    applied[3:, 1:] = np.eye(2)
    ratio = float(reduced_inertia(formation, kinematics, directions)[0])
    c_n = np.zeros((len(A), 3))
    if abs(ratio) > 1e-12:
        c_n = np.linalg.solve((A * inverse_mass) @ G.T, -(A * inverse_mass) @ applied)
    return RestDirection(heading, directions, heading @ (applied + G.T @ c_n), c_n, ratio, closes)


def _rates(formation: Formation, z: Array, heading: Array) -> Array:
    """Sliding and joint rates along the free direction nearest to `heading`, shape (n_c + 2,)."""
    kinematics = formation.evaluate(close_contacts(formation, z)[None], heading[None])
    A, inverse_mass = kinematics.A[0], 1 / formation.scene.mass_diagonal
    lift = inverse_mass[:, None] * A.T
    tangent = heading - lift @ np.linalg.solve(A @ lift, A @ heading)
    return np.concatenate([kinematics.A_t[0] @ tangent, tangent[3:]])


def close_contacts(formation: Formation, z: Array, within: float = np.inf) -> Array:
    """Nearest configuration, in the metric M5, with every contact of the formation closed.

    Parameters
    ----------
    z : ndarray, shape (5,)
    within : float, [m]
        Largest gap to close.

    Raises
    ------
    SimulationError
        If a gap is larger, or the contacts cannot be closed from `z`.
    """
    inverse_mass = 1 / formation.scene.mass_diagonal
    for _ in range(8):
        kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        gaps, A = kinematics.C[0], kinematics.A[0]
        worst = int(np.abs(gaps).argmax())
        if np.abs(gaps[worst]) > within:
            raise SimulationError(
                f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m, does not touch"
            )
        if np.abs(gaps[worst]) < 1e-16:
            break
        lift = inverse_mass[:, None] * A.T
        try:
            z = z - lift @ np.linalg.solve(A @ lift, gaps)
        except np.linalg.LinAlgError:
            raise SimulationError(f"{' '.join(formation.names)} depend on one another") from None
    if not np.abs(gaps[worst]) < TOUCHING * 1e-3:
        raise SimulationError(
            f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m, cannot be closed"
        )
    return z


def balances(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> bool:
    """Whether contact forces inside the friction cones balance gravity and torques at rest."""
    return not find_pulls(scene, contacts, z, tau).max() > BALANCED


def find_pulls(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> Array:
    """Least pulls with which contact forces balance gravity and torques at rest.

    A linear programme in c_n >= 0, c_t within U c_n, dry joint friction within D and a pull p >= 0
    of each contact: least sum of p with g + S (tau - friction) + A^T (c_n - p) + A_t^T c_t = 0.

    Parameters
    ----------
    contacts : tuple of Contact
        All that touch.
    z : ndarray, shape (5,)
    tau : ndarray, shape (2,), [N m]

    Returns
    -------
    ndarray, shape (n,), [N]
        Pull of each contact, infinite if none balance; all zero if no contact has to pull.
    """
    from scipy.optimize import linprog

    touching = _formation(scene, contacts)
    kinematics = touching.evaluate(z[None], np.zeros((1, 5)))
    n_c = touching.n_contacts
    normal, joints = kinematics.A[0].T, np.eye(5)[:, 3:]
    balance = np.hstack([normal, kinematics.A_t[0].T, -joints, -normal])
    cone, unit, none = -np.diag(touching.friction), np.eye(n_c), np.zeros((n_c, 2 + n_c))
    within = np.vstack([np.hstack([cone, sign * unit, none]) for sign in (1.0, -1.0)])
    free, pressing = [(None, None)] * n_c, [(0.0, None)] * n_c
    answer = linprog(
        np.repeat([0.0, 1.0], [2 * n_c + 2, n_c]),
        A_ub=within,
        b_ub=np.zeros(2 * n_c),
        A_eq=balance,
        b_eq=-(scene.applied_force + joints @ tau),
        bounds=[*pressing, *free, *((-d, d) for d in scene.dry[3:]), *pressing],
        method="highs",
    )
    return np.asarray(answer.x[-n_c:]) if answer.status == 0 else np.full(n_c, np.inf)


@lru_cache(maxsize=64)
def _formation(scene: Scene, contacts: tuple[Contact, ...]) -> Formation:
    return Formation(scene, contacts)


def _evaluate(coefficients: Array, x: float) -> Array:
    return np.asarray(coefficients @ x ** np.arange(coefficients.shape[1]))


def _roots(polynomial: Array) -> list[float]:
    """Real roots of a polynomial given by ascending coefficients."""
    significant = np.flatnonzero(np.abs(polynomial) > 1e-14 * np.abs(polynomial).max())
    if not len(significant) or significant[-1] == 0:
        return []
    roots = np.polynomial.polynomial.polyroots(polynomial[: significant[-1] + 1])
    return [float(root.real) for root in roots if abs(root.imag) < 1e-9]
