"""Static equilibrium of a formation, and the mode and instant at which it starts to move.

Every start mode (`start_modes`) is consistent if the formation then accelerates in it, presses on
every contact and closes no other. If none is, it sticks; contact forces are then indeterminate, and
a linear programme says whether any inside the friction cones balance. Accelerations and normal
forces at rest are affine in the torques, so on a polynomial piece of them the formation starts at
a root of a polynomial.
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
from ..contacts.formation import Formation
from ..mechanics.dynamics import Directions
from ..scene.model import Scene
from .modes import share_mode
from .root_finding import find_root
from .start_modes import RestDirection, StartDeparture, StartMode, find_patterns, respond_at_rest
from .tolerances import find_tolerances, measure_units

BALANCED = 1e-6  # pull that counts as none, over the scene's force: accuracy of the LP
_CLOSED = 3e-15  # gap that counts as rounding, relative to the scene's length
_AHEAD = 1e-5  # step along the free direction for signs and gaps, in units of the scene
_NARROW = 1e-10  # width of the bracket of a loss of balance, over half a piece of the torques
_CHECKS = 9  # samples of a nonlinear piece at which balance is checked
_CLEAR = 1e3  # least starting acceleration halfway to the next change, over rounding


class Collapse(NamedTuple):
    """Loss of balance at `x` of a piece without a consistent start mode."""

    x: float
    contact: str  # the contact that would have to pull most, or that slips
    c_n: float  # [N]
    jammed: bool  # whether friction jams one of the directions
    c_t: float | None = None  # [N]: of a rolling contact that slips, although it presses with `c_n`


@dataclass(frozen=True, eq=False)
class Rest:
    """A formation at rest at a configuration."""

    formation: Formation
    z: Array  # (5,)
    # start modes without sticking: two with one freedom, all sign patterns with more
    sliding: tuple[StartMode, ...]
    touching: tuple[Contact, ...]  # every contact that touches, in the formation or not
    near: NDArray[np.bool_]  # (n_limits,): which limits of the formation are zero here

    @cached_property
    def modes(self) -> tuple[StartMode, ...]:
        """All start modes, with those in which friction holds some contact or joint."""
        return tuple(self._list_modes())

    @cached_property
    def _sticking(self) -> tuple[list[StartMode], Iterator[StartMode]]:
        """Start modes with sticking: those built so far, and the others."""
        if self.formation.n_constraints >= 4:
            return [], iter(())
        return [], find_patterns(self.formation, self.z, self.near, held=True)

    def _list_modes(self) -> Iterator[StartMode]:
        """Yield all start modes, built when first needed: most never are."""
        built, others = self._sticking
        yield from self.sliding
        yield from built
        for mode in others:
            built.append(mode)
            yield mode

    def wait(self, coefficients: Array, x: float) -> StartDeparture | Collapse | None:
        """End of the rest on a piece of torques, (2, d + 1) [N m] in powers of x, or None."""
        tau = _evaluate(coefficients, x)
        for mode in self._list_modes():
            if mode.moves(tau):
                return mode.depart(x, tau)
        least = _CLEAR * find_tolerances(self.formation.scene).drive
        loss = self._bracket_loss(coefficients, x)
        # Where a margin changes sign; in between, no mode changes.
        rows, offsets, starts = self._margins
        polynomials = rows[:, 1:] @ coefficients
        polynomials[:, 0] += rows[:, 0] + offsets
        if polynomials.shape[1] == 2:
            level, slope = polynomials[polynomials[:, 1] != 0].T
            roots = set((-level / slope).tolist())
        else:
            roots = {root for one in np.unique(polynomials, axis=0) for root in _roots(one)}
        ends = [x, *sorted(root for root in roots if x < root < 1)]
        torques = _evaluate(coefficients, (np.array(ends) + np.array([*ends[1:], 1.0])) / 2)
        values = rows[:, :1] + rows[:, 1:] @ torques + offsets[:, None]
        consistent = np.logical_and.reduceat(values >= 0, starts, axis=0).T
        for start, tau, chosen in zip(ends, torques.T, consistent, strict=True):
            if loss is not None and start > loss[0]:
                loss = self._narrow(coefficients, *loss)
                if start > loss[1]:
                    break
            modes = [self.modes[k] for k in np.flatnonzero(chosen)]
            for mode in sorted(modes, key=lambda mode: -mode.drive(tau)):
                if mode.drive(tau) > least and mode.moves(tau):
                    return mode.depart(start, tau)
        if loss is None:
            return None
        return self._collapse(coefficients, self._narrow(coefficients, *loss)[1])

    @cached_property
    def _margins(self) -> tuple[Array, Array, NDArray[np.int64]]:
        """Rows and offsets of the margins of all start modes, and the first row of each mode."""
        parts = [mode.margins for mode in self.modes]
        rows = np.array([row for part in parts for row, _ in part])
        offsets = np.array([offset for part in parts for _, offset in part])
        return rows, offsets, np.cumsum([0, *(len(part) for part in parts[:-1])])

    def _balances(self, coefficients: Array, x: float) -> bool:
        tau = _evaluate(coefficients, x)
        return balances(self.formation.scene, self.touching, self.z, tau)

    def _bracket_loss(self, coefficients: Array, x: float) -> tuple[float, float] | None:
        """Bracket of the first loss of balance from `x` on; None if there is none.

        Torques that balance form a convex set, so two samples decide a linear piece.
        """
        count, low = _CHECKS if coefficients[:, 2:].any() else 2, x
        for high in np.linspace(x, 1.0, count).tolist():
            if not self._balances(coefficients, high):
                return low, high
            low = high
        return None

    def _narrow(self, coefficients: Array, low: float, high: float) -> tuple[float, float]:
        """Bracket of a loss of balance, narrowed by Newton's method: the pull is convex in tau."""
        scene = self.formation.scene
        while high - low > _NARROW:
            tau = _evaluate(coefficients, high)
            lack, rise = measure_lack(scene, self.touching, self.z, tau)
            if lack <= 0:
                return high, min(high + _NARROW / 2, 1.0)
            middle = (low + high) / 2
            if np.isfinite(lack):

                def spare(
                    x: float, lack: float = lack, rise: Array = rise, tau: Array = tau
                ) -> float:
                    return -lack - float(rise @ (_evaluate(coefficients, x) - tau))

                middle = find_root(spare, high, spare(low), -lack, 1e-3 * _NARROW, 0.0, low)
            elif self._balances(coefficients, middle):
                low = middle
                continue
            if high - middle <= _NARROW:
                return middle, high
            high = middle
        return low, high

    def _collapse(self, coefficients: Array, high: float) -> Collapse:
        """The contact that gives way at `high`."""
        tau = _evaluate(coefficients, high)
        jammed = [mode.ratio <= 0 for mode in self.sliding]
        jams = all(jammed) if self.formation.n_constraints < 4 else any(jammed)
        free = [mode for mode in self.modes if mode.slides(tau)]
        pulls = find_pulls(self.formation.scene, self.touching, self.z, tau)
        if free or np.isinf(pulls).all():
            load = np.array([1.0, *tau])
            weakest = min((mode.force_limits @ load for mode in free or self.sliding), key=np.min)
            row, least, c_t = find_weakest(self.formation, weakest)
            return Collapse(high, self.formation.names[row], least, jams, c_t)
        name, least = self.touching[int(pulls.argmax())].name, -float(pulls.max())
        return Collapse(high, name, least, jams)


def find_rest(formation: Formation, z: Array) -> Rest:
    """Formation at rest at `z`, (5,); `SimulationError` for dependent contacts or no freedom."""
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
    scene = formation.scene
    near = np.abs(formation.evaluate_limits(z[None])[0]) < scene.touching
    gained = [formation.limits[k].gained for k in np.flatnonzero(near)]
    touching = (*formation.contacts, *(contact for contact in gained if contact is not None))
    if rank < 4:
        patterns = tuple(find_patterns(formation, z, near, held=False))
        return Rest(formation, z, patterns, touching, near)
    heading = right[4] / root
    units = measure_units(scene)[:5]
    step = _AHEAD / np.abs(heading / units).max()
    limits = formation.evaluate_limits(z + step * np.array([[0.0], [1.0], [-1.0]]) * heading)
    # The curvature of the path cancels in the central difference. A limit that opens in both
    # directions, as of a pointed tip at a vertex, has no slope but a kink.
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
        # What is stationary here has the direction that it has just after.
        ahead = [_rates(formation, z, step, sign * heading) for sign in (1, -1)]
        signs = np.where(still, np.where(np.abs(ahead) > 1e-12 * scale, np.sign(ahead), 0.0), signs)
    directions, tolerances = [], find_tolerances(scene)
    for side, sign, close in zip((1.0, -1.0), signs, closes, strict=True):
        answer = respond_at_rest(share_mode(formation), sign, kinematics)
        assert answer is not None
        drive = side * heading * scene.mass_diagonal @ answer.acceleration
        friction = Directions(sign[:-2], sign[-2:])
        limits, ratio = answer.force_limits, answer.ratio
        directions.append(
            RestDirection(side * heading, friction, drive, limits, ratio, close, tolerances)
        )
    return Rest(formation, z, tuple(directions), touching, near)


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

    Gaps up to `within` [m] are closed; rolling contacts take coordinates `slip`, (R,) [m], if any.
    A `SimulationError` says which contact cannot be closed.
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
    """Sum of `find_pulls` beyond rounding [N], infinite if none balance, and a subgradient.

    The subgradient by the torques, shape (2,) [1/m], is the dual solution; the sum is convex.
    """
    answer, scales = _solve(scene, contacts, z, tau), scene.scales
    if answer.status:
        return np.inf, np.zeros(2)
    lack = scales.force * (answer.fun - BALANCED)
    return float(lack), -np.asarray(answer.eqlin.marginals)[3:] / scales.length


def find_pulls(scene: Scene, contacts: tuple[Contact, ...], z: Array, tau: Array) -> Array:
    """Least pulls p with which contact forces balance gravity, (n_c,) [N], infinite if none do.

    A linear programme in c_n >= 0, c_t within U c_n, dry joint friction within D and p >= 0: least
    sum of p with g + S (tau - friction) + A^T (c_n - p) + A_t^T c_t = 0.
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
