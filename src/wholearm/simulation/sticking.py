"""A formation at rest: which way it starts to move, and when.

At rest friction can take either sign. With one freedom each of the two ways along the free
direction is tried with the friction that would oppose it; with more, every choice of directions
and of what friction holds is (`starting`). The formation moves that way if it then accelerates that
way, presses on every contact and closes no other. If no way does, it sticks; its forces are then
indeterminate, and all that can be asked is whether any inside the friction cones balance.
Accelerations and normal forces at rest are affine in the torques, so on one polynomial piece of
them the instant of starting is a root of a polynomial.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..common.errors import SimulationError
from ..contacts.cones import find_weakest
from ..contacts.elemental import Contact
from ..contacts.formation import Formation, Kinematics
from ..mechanics.dynamics import Directions
from ..scene.model import Scene
from .modes import Mode, share_mode
from .root_finding import find_root
from .start_modes import RestDirection, StartDeparture, StartPath, find_patterns, respond_at_rest
from .tolerances import find_tolerances, measure_units

BALANCED = 1e-6
"""Pull that counts as none, relative to the scene's force: the accuracy of the linear programme."""
_CLOSED = 3e-15
"""Gap that counts as rounding, relative to the scene's length."""
_AHEAD = 1e-5
"""Distance ahead along the free direction at which signs and gaps are found, in units of the
scene."""
_NARROW = 1e-10
"""Width to which the place of a loss of balance is narrowed, over half a piece of the torques."""
_CHECKS = 9
"""Number of places of a piece that is not linear at which forces at rest are checked."""
_CLEAR = 1e3
"""Acceleration halfway to the next change with which a motion starts, over that which is rounding:
where changes are that close nothing is decided but by rounding."""


class Collapse(NamedTuple):
    """No forces balance any more at `x` of a piece, and no way holds every contact."""

    x: float
    contact: str  # the contact that would have to pull most, or that slips
    c_n: float  # [N]
    jammed: bool  # whether friction jams one of the ways
    c_t: float | None = None  # [N]: of a rolling contact that slips, although it presses with `c_n`


@dataclass(frozen=True, eq=False)
class Rest:
    """A formation at rest at a configuration."""

    formation: Formation
    z: Array  # (5,)
    # the ways it could move with nothing held: two with one freedom, every choice of directions
    # with more
    ways: tuple[StartPath, ...]
    touching: tuple[Contact, ...]  # every contact that touches, in the formation or not
    near: NDArray[np.bool_]  # (n_limits,): which limits of the formation are zero here

    @cached_property
    def all_ways(self) -> tuple[StartPath, ...]:
        """The ways it could move, with those in which friction holds some contact or joint."""
        return tuple(self._find_ways())

    @cached_property
    def _held(self) -> tuple[list[StartPath], Iterator[StartPath]]:
        """Ways in which friction holds something: those found so far, and those still to find."""
        if self.formation.n_constraints >= 4:
            return [], iter(())
        return [], find_patterns(self.formation, self.z, self.near, held=True)

    def _find_ways(self) -> Iterator[StartPath]:
        """Yield the ways it could move as they are wanted, since most are never looked at."""
        found, others = self._held
        yield from self.ways
        yield from found
        for way in others:
            found.append(way)
            yield way

    def wait(self, coefficients: Array, x: float) -> StartDeparture | Collapse | None:
        """Find what ends the rest on one piece of the torques, from `x` on.

        Parameters
        ----------
        coefficients : (2, d + 1) [N m]  torques in ascending powers of x in [-1, 1]
        x  where to begin

        Returns
        -------
        Departure, Collapse or None
            None if the formation rests to the end of the piece.
        """
        tau = _evaluate(coefficients, x)
        for way in self._find_ways():
            if way.moves(tau):
                return way.depart(x, tau)
        least = _CLEAR * find_tolerances(self.formation.scene).drive
        doubt = self._find_doubt(coefficients, x)
        ends = self._changes(coefficients, x)
        torques = _evaluate(coefficients, (np.array(ends) + np.array([*ends[1:], 1.0])) / 2)
        for start, tau, moving in zip(ends, torques.T, self._list_moving(torques), strict=True):
            if doubt is not None and start > doubt[0]:
                doubt = self._narrow(coefficients, *doubt)
                if start > doubt[1]:
                    break
            ways = [self.all_ways[k] for k in np.flatnonzero(moving)]
            for way in sorted(ways, key=lambda way: -way.drive(tau)):
                if way.drive(tau) > least and way.moves(tau):
                    return way.depart(start, tau)
        if doubt is None:
            return None
        return self._collapse(coefficients, self._narrow(coefficients, *doubt)[1])

    @cached_property
    def _margins(self) -> tuple[Array, Array, NDArray[np.int64]]:
        """Rows and offsets of the margins of all ways, and where those of each way begin."""
        parts = [way.margins for way in self.all_ways]
        rows = np.array([row for part in parts for row, _ in part])
        offsets = np.array([offset for part in parts for _, offset in part])
        return rows, offsets, np.cumsum([0, *(len(part) for part in parts[:-1])])

    def _list_moving(self, torques: Array) -> NDArray[np.bool_]:
        """Which of all ways keep their margins under torques, shape (2, n); shape (n, n_ways)."""
        rows, offsets, starts = self._margins
        values = rows[:, :1] + rows[:, 1:] @ torques + offsets[:, None]
        return np.asarray(np.logical_and.reduceat(values >= 0, starts, axis=0).T)

    def _changes(self, coefficients: Array, x: float) -> list[float]:
        """Where on the piece an acceleration or a normal force changes sign, from `x` on."""
        rows, offsets, _ = self._margins
        polynomials = rows[:, 1:] @ coefficients
        polynomials[:, 0] += rows[:, 0] + offsets
        if polynomials.shape[1] == 2:
            level, slope = polynomials[polynomials[:, 1] != 0].T
            places = set((-level / slope).tolist())
        else:
            places = {root for one in np.unique(polynomials, axis=0) for root in _roots(one)}
        return [x, *sorted(place for place in places if x < place < 1)]

    def _balances(self, coefficients: Array, x: float) -> bool:
        tau = _evaluate(coefficients, x)
        return balances(self.formation.scene, self.touching, self.z, tau)

    def _find_doubt(self, coefficients: Array, x: float) -> tuple[float, float] | None:
        """Places from `x` on between which forces first fail to balance; None if nowhere.

        Torques that balance form a convex set: the ends of a linear piece speak for it all.
        """
        count = _CHECKS if coefficients[:, 2:].any() else 2
        places = np.linspace(x, 1.0, count).tolist()
        low = x
        for high in places:
            if not self._balances(coefficients, high):
                return low, high
            low = high
        return None

    def _narrow(self, coefficients: Array, low: float, high: float) -> tuple[float, float]:
        """Where balance is lost between two places, to within `_NARROW`.

        The pull that is needed is convex in the torques, so that where a supporting line of it
        says that none is, the loss is not later: Newton's method comes from above, and as the pull
        is linear but for a few kinks that takes few steps.
        """
        scene = self.formation.scene
        while high - low > _NARROW:
            tau = _evaluate(coefficients, high)
            lack, rise = measure_lack(scene, self.touching, self.z, tau)
            if lack <= 0:
                return high, min(high + _NARROW / 2, 1.0)
            place = (low + high) / 2
            if np.isfinite(lack):
                place = _find_loss(coefficients, low, high, lack, rise)
            elif self._balances(coefficients, place):
                low = place
                continue
            if high - place <= _NARROW:
                return place, high
            high = place
        return low, high

    def _collapse(self, coefficients: Array, high: float) -> Collapse:
        """Why nothing balances at a place of the piece."""
        tau = _evaluate(coefficients, high)
        free = [way for way in self.all_ways if way.slides(tau)]
        pulls = find_pulls(self.formation.scene, self.touching, self.z, tau)
        if free or np.isinf(pulls).all():
            load = np.array([1.0, *tau])
            weakest = min((way.force_limits @ load for way in free or self.ways), key=np.min)
            row, least, c_t = find_weakest(self.formation, weakest)
            return Collapse(high, self.formation.names[row], least, self._jams, c_t)
        name, least = self.touching[int(pulls.argmax())].name, -float(pulls.max())
        return Collapse(high, name, least, self._jams)

    @property
    def _jams(self) -> bool:
        """Whether friction jams one of the two ways, or every choice of directions."""
        jammed = [way.ratio <= 0 for way in self.ways]
        return all(jammed) if self.formation.n_constraints < 4 else any(jammed)


def _find_loss(coefficients: Array, low: float, high: float, lack: float, rise: Array) -> float:
    """Where the line that supports the pull at `high` says that it is none, at `low` or later."""
    tau = _evaluate(coefficients, high)

    def spare(x: float) -> float:
        return -lack - float(rise @ (_evaluate(coefficients, x) - tau))

    return find_root(spare, high, spare(low), -lack, 1e-3 * _NARROW, 0.0, low)


def find_rest(formation: Formation, z: Array) -> Rest:
    """Return a formation at rest at `z`, shape (5,).

    Raises
    ------
    SimulationError  if the contacts depend on one another, or leave no freedom
    """
    root = np.sqrt(formation.scene.mass_diagonal)
    kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
    P = kinematics.P[0]
    _, values, right = np.linalg.svd(P / root)
    rank = int((values > 1e-9 * values[0]).sum())
    if rank < len(P) or rank == 5:
        raise SimulationError(
            f"{' '.join(formation.names)} leaves {5 - rank} freedoms, and no forces that are "
            "determined; it cannot start from rest"
        )
    if rank < 4:
        near = np.abs(formation.evaluate_limits(z[None])[0]) < formation.scene.touching
        patterns = tuple(find_patterns(formation, z, near, held=False))
        return Rest(formation, z, patterns, formation.contacts + _gained(formation, near), near)
    heading = right[4] / root
    scene = formation.scene
    units = measure_units(scene)[:5]
    step = _AHEAD / np.abs(heading / units).max()
    limits = formation.evaluate_limits(z + step * np.array([[0.0], [1.0], [-1.0]]) * heading)
    near = np.abs(limits[0]) < scene.touching
    # The curvature of the path cancels in the difference of both ways. A limit that opens both
    # ways, as of a pointed tip at a vertex, has no slope but a kink.
    here, ahead, behind = limits[:, near]
    rise = (ahead - behind) / 2
    changes = np.maximum([rise, -rise], [ahead - here, behind - here])
    closes = [bool((change < -find_tolerances(scene).limit).any()) for change in changes]
    rates = np.concatenate([kinematics.A_t[0] @ heading, heading[3:]])
    rates[list(formation.rolling_rows)] = 0.0
    # How fast each slides or turns over how fast anything moves.
    scale = _AHEAD / step * np.repeat([scene.scales.length, 1.0], [formation.n_contacts, 2])
    still = np.abs(rates) < 1e-9 * scale
    signs = np.sign([rates, -rates])
    if still.any():
        # What is stationary here has the direction that it takes up just after.
        ahead = [_rates(formation, z, step, sign * heading) for sign in (1, -1)]
        signs = np.where(still, np.where(np.abs(ahead) > 1e-12 * scale, np.sign(ahead), 0.0), signs)
    mode = share_mode(formation)
    ways = tuple(
        _build_way(mode, side * heading, Directions(s[:-2], s[-2:]), kinematics, close)
        for side, s, close in zip((1.0, -1.0), signs, closes, strict=True)
    )
    return Rest(formation, z, ways, formation.contacts + _gained(formation, near), near)


def _gained(formation: Formation, near: NDArray[np.bool_]) -> tuple[Contact, ...]:
    """Contacts that touch but are not in the formation."""
    gained = [formation.limits[k].gained for k in np.flatnonzero(near)]
    return tuple(contact for contact in gained if contact is not None)


def _build_way(
    mode: Mode,
    heading: Array,
    directions: Directions,
    kinematics: Kinematics,
    closes: bool,
) -> RestDirection:
    answer = respond_at_rest(mode, np.concatenate(directions), kinematics)
    assert answer is not None
    scene = mode.formation.scene
    tolerances = find_tolerances(scene)
    drive = heading * scene.mass_diagonal @ answer.acceleration
    return RestDirection(
        heading, directions, drive, answer.force_limits, answer.ratio, closes, tolerances
    )


def _rates(formation: Formation, z: Array, step: float, heading: Array) -> Array:
    """Sliding and joint rates a `step` from `z` along the free direction, shape (n_c + 2,)."""
    slip = formation.evaluate_slip(z[None])[0]
    ahead = close_contacts(formation, z + step * heading, slip=slip)
    kinematics = formation.evaluate(ahead[None], heading[None])
    P, inverse_mass = kinematics.P[0], 1 / formation.scene.mass_diagonal
    lift = inverse_mass[:, None] * P.T
    tangent = heading - lift @ np.linalg.solve(P @ lift, P @ heading)
    return np.concatenate([kinematics.A_t[0] @ tangent, tangent[3:]])


def _evaluate(coefficients: Array, x: float | Array) -> Array:
    """Torques at one place of a piece, shape (2,), or at n places, shape (2, n)."""
    powers = np.power.outer(np.asarray(x), np.arange(coefficients.shape[1]))
    return np.asarray(coefficients @ powers.T)


def _roots(polynomial: Array) -> list[float]:
    """Real roots of a polynomial given by ascending coefficients."""
    significant = np.flatnonzero(np.abs(polynomial) > 1e-14 * np.abs(polynomial).max())
    if not len(significant) or significant[-1] == 0:
        return []
    roots = np.roots(polynomial[significant[-1] :: -1])
    return [float(root.real) for root in roots if abs(root.imag) < 1e-9]


def close_contacts(
    formation: Formation, z: Array, within: float = np.inf, slip: Array | None = None
) -> Array:
    """Nearest configuration, in the metric M5, with every contact of the formation closed.

    Parameters
    ----------
    z : (5,)
    within : [m]     largest gap to close
    slip : (R,) [m]  slip coordinates to give to rolling contacts; without them these start to roll
                     where they are

    Raises
    ------
    SimulationError  if a gap is larger, or the contacts cannot be closed from `z`
    """
    inverse_mass = 1 / formation.scene.mass_diagonal
    closed = _CLOSED * formation.scene.scales.length
    for _ in range(8):
        kinematics = formation.evaluate(z[None], np.zeros((1, 5)))
        gaps, rows = kinematics.C[0], kinematics.A[0]
        worst = int(np.abs(gaps).argmax())
        if np.abs(gaps[worst]) > within:
            raise SimulationError(
                f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m, does not touch"
            )
        slid = np.zeros(0) if slip is None else formation.evaluate_slip(z[None])[0] - slip
        if np.abs(gaps[worst]) < closed and (np.abs(slid) < closed).all():
            break
        rows = rows if slip is None else kinematics.P[0]
        lift = inverse_mass[:, None] * rows.T
        try:
            z = z - lift @ np.linalg.solve(rows @ lift, np.concatenate([gaps, slid]))
        except np.linalg.LinAlgError:
            raise SimulationError(f"{' '.join(formation.names)} depend on one another") from None
    if not np.abs(gaps[worst]) < formation.scene.touching * 1e-3:
        raise SimulationError(
            f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m, cannot be closed"
        )
    return z


def balances(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> bool:
    """Whether contact forces inside the friction cones balance gravity and torques at rest."""
    return measure_lack(scene, contacts, z, tau)[0] <= 0


def measure_lack(
    scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array
) -> tuple[float, Array]:
    """How much pull is needed beyond what counts as none, and its rise with the torques.

    See `find_pulls`. The sum of the pulls is convex in the torques: elsewhere it is at least what
    the rise, from the dual solution, makes of it.

    Returns
    -------
    lack : [N]         infinite if none balance
    rise : (2,) [1/m]
    """
    answer, scales = _solve(scene, contacts, z, tau), scene.scales
    if answer.status:
        return np.inf, np.zeros(2)
    lack = scales.force * (answer.fun - BALANCED)
    return float(lack), -np.asarray(answer.eqlin.marginals)[3:] / scales.length


def find_pulls(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> Array:
    """Least pulls with which contact forces balance gravity and torques at rest.

    A linear programme in c_n >= 0, c_t within U c_n, dry joint friction within D and a pull p >= 0
    of each contact: least sum of p with g + S (tau - friction) + A^T (c_n - p) + A_t^T c_t = 0.

    Parameters
    ----------
    contacts          all that touch
    z : (5,)
    tau : (2,) [N m]

    Returns
    -------
    ndarray, shape (n,), [N]
        Pull of each contact, infinite if none balance; all zero if no contact has to pull.
    """
    answer, n_c = _solve(scene, contacts, z, tau), len(contacts)
    return scene.scales.force * answer.x[-n_c:] if answer.status == 0 else np.full(n_c, np.inf)


def _solve(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> Any:
    """Solve the linear programme of `find_pulls`, with forces in the scene's force."""
    from scipy.optimize import linprog

    touching, scales = _formation(scene, contacts), scene.scales
    # Forces count in the scene's force, torques in its torque.
    units = np.array([1.0, 1.0, *[scales.length] * 3])
    kinematics = touching.evaluate(z[None], np.zeros((1, 5)))
    n_c = touching.n_contacts
    normal, tangential = ((rows / units).T for rows in (kinematics.A[0], kinematics.A_t[0]))
    joints = np.eye(5)[:, 3:]
    balance = np.hstack([normal, tangential, -joints, -normal])
    load = (scene.applied_force + joints @ tau) / (scales.force * units)
    cone, unit, none = -np.diag(touching.friction), np.eye(n_c), np.zeros((n_c, 2 + n_c))
    within = np.vstack([np.hstack([cone, sign * unit, none]) for sign in (1.0, -1.0)])
    free, pressing = [(None, None)] * n_c, [(0.0, None)] * n_c
    return linprog(
        np.repeat([0.0, 1.0], [2 * n_c + 2, n_c]),
        A_ub=within,
        b_ub=np.zeros(2 * n_c),
        A_eq=balance,
        b_eq=-load,
        bounds=[*pressing, *free, *((-d, d) for d in scene.dry[3:] / scales.torque), *pressing],
        method="highs",
    )


@lru_cache(maxsize=64)
def _formation(scene: Scene, contacts: tuple[Contact, ...]) -> Formation:
    return Formation(scene, contacts)
