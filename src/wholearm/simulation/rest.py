"""Formations at rest: start modes, and the instant at which balance is lost or a motion begins.

Each choice of signs of sliding and turning, and of what sticks, makes accelerations and contact
forces affine in the torques. Such a start mode is consistent if contacts and joints accelerate with
its signs, friction can hold the others, every contact presses and nothing that touches closes
further. With one freedom these are both directions along it. If none is consistent the formation
sticks; contact forces are then indeterminate, and the torque polygon (`mechanics.statics`) says
whether any inside the friction cones balance. On a polynomial piece of the torques both change at
roots of polynomials.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import SimulationError
from ..contacts.cones import find_weakest
from ..contacts.formation import Formation
from ..mechanics.statics import GRAZE, Statics, TorquePolygon
from ..scene.model import Scene
from .hand import build_system
from .modes import Mode, Response, find_mode, list_modes, list_units, respond
from .system import ContactRows
from .tolerances import ROUNDING_FORCE, STILL

_AHEAD = 1e-5  # step along the free direction for the signs of what is stationary, in scene units


class StartDeparture(NamedTuple):
    """The formation starts to move, or goes on, at `x` in [-1, 1] of a piece of the torques."""

    x: float
    heading: Array  # (5,): where to, of length one in the metric M5
    signs: Array  # (n_c + 2,): of sliding and turning, zero for what friction holds


class Collapse(NamedTuple):
    """Loss of balance at `x` of a piece without a consistent start mode."""

    x: float
    contact: str  # the contact that would have to pull most, or that slips
    c_n: float  # [N]
    jammed: bool  # whether friction jams one of the directions
    c_t: float | None = None  # [N]: of a rolling contact that slips, although it presses with `c_n`


class StartMode(NamedTuple):
    """Start mode; quantities at rest are rows @ (1, tau_1, tau_2)."""

    response: Response
    # (n_c + 2 R, 3) [N]: what has to be positive for the contacts to hold, H c (`contacts.cones`)
    force_limits: Array
    # (k, 3): accelerations of sliding and turning along the signs, or along the only freedom
    slips: Array
    # not negative, but for rounding, where the mode is consistent: force limits, slips, limits of
    # friction that holds what has no sign, and accelerations that open closed gaps
    margins: Array
    heading: Array | None  # (5,): with one freedom, the direction
    statics: Statics

    def drive(self, tau: Array) -> float:
        """Acceleration in the metric M5."""
        mass = self.statics.scene.mass_diagonal
        return float(np.sqrt(mass @ (self.response.acceleration @ [1.0, *tau]) ** 2))

    def slides(self, tau: Array) -> bool:
        """Whether the formation accelerates in this mode if every contact can press or pull."""
        load, least = np.array([1.0, *tau]), _measure_drive(self.statics.scene)
        return (
            self.response.ratio > 0
            and self.drive(tau) > least
            and bool((self.margins[len(self.force_limits) :] @ load >= 0).all())
            and self.statics.opens(self.response.acceleration @ load)
        )

    def moves(self, tau: Array) -> bool:
        """Whether the formation starts in this mode under torques `tau`, shape (2,)."""
        return bool((self.margins @ [1.0, *tau] >= 0).all()) and self.slides(tau)

    def depart(self, x: float, tau: Array) -> StartDeparture:
        """Start at `x` of a piece, where the torques are `tau`."""
        heading = self.response.acceleration @ [1.0, *tau] / self.drive(tau)
        return StartDeparture(x, heading, self.response.signs)


@dataclass(frozen=True, eq=False)
class Rest:
    """A formation at rest at a configuration."""

    formation: Formation
    z: Array  # (5,)
    statics: Statics  # of the formation
    heading: Array | None  # (5,): with one freedom the direction, of length one in the metric M5

    @cached_property
    def sliding(self) -> tuple[StartMode, ...]:
        """Start modes without sticking: two with one freedom, all sign patterns with more."""
        if self.heading is not None:
            ways = ((self._find_signs(h), h) for h in (self.heading, -self.heading))
            modes = (self._build(find_mode(self.formation, signs), signs, h) for signs, h in ways)
            return tuple(mode for mode in modes if mode is not None)
        return self._list_patterns(held=False)

    @cached_property
    def sticking(self) -> tuple[StartMode, ...]:
        """Start modes in which friction holds some contact or joint, the least first."""
        return () if self.heading is not None else self._list_patterns(held=True)

    @property
    def modes(self) -> tuple[StartMode, ...]:
        """All start modes."""
        return self.sliding + self.sticking

    def _list_modes(self) -> Iterator[StartMode]:
        # Those with sticking are built when first needed: most never are.
        yield from self.sliding
        yield from self.sticking

    @cached_property
    def touching(self) -> Statics:
        """That of every contact that touches, in the formation or not."""
        gained = [self.formation.limits[k].gained for k in np.flatnonzero(self.statics.near)]
        others = (contact for contact in gained if contact is not None)
        contacts = *self.formation.contacts, *others
        return Statics(Formation(self.formation.scene, contacts), self.z)

    @cached_property
    def held(self) -> TorquePolygon:
        """Torques that friction can hold, and those beyond by no more than rounding."""
        polygon = self.touching.torque_polygon()
        rounding = 1e-6 * self.formation.scene.scales.torque
        return polygon._replace(bounds=polygon.bounds + rounding)

    def _list_patterns(self, held: bool) -> tuple[StartMode, ...]:
        """Start modes with more freedoms: only those with sticking, or only the others."""
        formation, units = self.formation, list_units(self.formation)
        options = [(1.0, -1.0, 0.0) if held and unit.grips else (1.0, -1.0) for unit in units]
        patterns = list_modes(formation, np.zeros(formation.n_contacts + 2), units, options)
        found = [
            (mode, signs)
            for signs, mode in patterns
            if (len(mode.holders) > formation.n_rolling) == held
        ]
        found.sort(key=lambda pattern: len(pattern[0].holders))
        modes = (self._build(*pattern) for pattern in found)
        return tuple(mode for mode in modes if mode is not None)

    def _find_signs(self, heading: Array) -> Array:
        """Directions of contacts and joints along the only freedom, (n_c + 2,); zero for none."""
        formation, scales = self.formation, self.formation.scene.scales
        step = _AHEAD / np.abs(heading / build_system(formation.scene).units[:5]).max()
        rates = np.concatenate([self.statics.A_t @ heading, heading[3:]])
        rates[list(formation.rolling_rows)] = 0.0
        # How fast each slides or turns over how fast anything moves.
        scale = _AHEAD / step * np.repeat([scales.length, 1.0], [formation.n_contacts, 2])
        still = np.abs(rates) < 1e-9 * scale
        still[list(formation.rolling_rows)] = False
        if still.any():
            # What is stationary here has the direction that it has just after.
            ahead = _find_rates(formation, self.z, step, heading)
            rates = np.where(still, np.where(np.abs(ahead) > 1e-12 * scale, ahead, 0.0), rates)
        return np.asarray(np.sign(rates))

    def _build(self, mode: Mode, signs: Array, heading: Array | None = None) -> StartMode | None:
        """The start mode of some signs, (n_c + 2,); None if its forces are not determined."""
        scene, count = self.formation.scene, self.formation.n_contacts
        rows = ContactRows(self.statics.A, self.statics.A_t, np.zeros(count), np.zeros(count))
        response = respond(mode, signs, rows, np.zeros(5))
        if response is None:
            return None
        declared = [mode.declares(k) for k in range(len(mode.holders))]
        kept = np.array([True] * count + declared + declared)
        scales, length = scene.scales, scene.scales.length
        slips = signs[:, None] * response.rates
        # What opens, or closes by no more than counts as grazing.
        graze = GRAZE * np.repeat([1.0, length], [count, 2]) @ slips
        openings = self.statics.opening[0] @ response.acceleration + graze
        still = STILL * np.repeat([scales.acceleration, scales.rate / scales.time], [count, 2])
        # Difference quotients are as good as 1e-7.
        closing = np.full(len(openings), 1e-7 * scales.acceleration)
        if heading is not None:
            # All accelerations are multiples of this one.
            slips = (heading * scene.mass_diagonal @ response.acceleration)[None]
            still, closing = np.array([-_measure_drive(scene)]), np.zeros(len(openings))
        rounding, limits = ROUNDING_FORCE * mode.force_limit_units, response.force_limits
        margins = np.vstack([limits[kept], slips, limits[~kept], openings])
        margins[:, 0] += np.concatenate([rounding[kept], still, rounding[~kept], closing])
        return StartMode(response, limits[kept], slips, margins, heading, self.statics)

    def wait(self, coefficients: Array, x: float) -> StartDeparture | Collapse | None:
        """End of the rest on a piece of torques, (2, d + 1) [N m] in powers of x, or None."""
        tau = _evaluate(coefficients, x)
        for mode in self._list_modes():
            if mode.moves(tau):
                return mode.depart(x, tau)
        loss = self._find_loss(coefficients, x)
        least = 1e3 * _measure_drive(self.formation.scene)
        margins = [mode.margins for mode in self.modes]
        rows = np.vstack(margins)
        first = np.cumsum([0, *(len(part) for part in margins[:-1])])
        # Where a margin changes sign; in between, no mode changes.
        polynomials = rows[:, 1:] @ coefficients + _constant(rows[:, 0], coefficients)
        starts, middles = _split(polynomials, x)
        torques = _evaluate(coefficients, middles)
        values = rows[:, :1] + rows[:, 1:] @ torques
        consistent = np.logical_and.reduceat(values >= 0, first, axis=0).T
        for start, tau, chosen in zip(starts.tolist(), torques.T, consistent, strict=True):
            if start > loss:
                break
            modes = [self.modes[k] for k in np.flatnonzero(chosen)]
            for mode in sorted(modes, key=lambda mode: -mode.drive(tau)):
                if mode.drive(tau) > least and mode.moves(tau):
                    return mode.depart(start, tau)
        return self._collapse(coefficients, loss) if loss <= 1 else None

    def _find_loss(self, coefficients: Array, x: float) -> float:
        """Where torques cannot be held any more, from `x` on; infinite if they can all along."""
        normals, bounds = self.held
        if not np.isfinite(bounds).all():
            return x
        return find_breach(_constant(bounds, coefficients) - normals @ coefficients, x)

    def _collapse(self, coefficients: Array, x: float) -> Collapse:
        """The contact that gives way at `x`."""
        tau = _evaluate(coefficients, x)
        jammed = [mode.response.ratio <= 0 for mode in self.sliding]
        jams = any(jammed) if self.heading is not None else all(jammed)
        free = [mode for mode in self.modes if mode.slides(tau)]
        pulls = self.touching.find_pulls(tau)
        if free or np.isinf(pulls).all():
            load = np.array([1.0, *tau])
            weakest = min((mode.force_limits @ load for mode in free or self.sliding), key=np.min)
            row, least, c_t = find_weakest(self.formation, weakest)
            return Collapse(x, self.formation.names[row], least, jams, c_t)
        return Collapse(
            x, self.touching.formation.names[int(pulls.argmax())], -float(pulls.max()), jams
        )


def find_rest(formation: Formation, z: Array) -> Rest:
    """Formation at rest at `z`, (5,); `SimulationError` for dependent contacts or no freedom."""
    statics = Statics(formation, z)
    freedoms = statics.freedoms.shape[1]
    if freedoms > 5 - formation.n_constraints or not freedoms:
        raise SimulationError(
            f"{' '.join(formation.names)} leaves {freedoms} freedoms, and no forces that are "
            "determined; it cannot start from rest"
        )
    return Rest(formation, z, statics, statics.freedoms[:, 0] if freedoms == 1 else None)


def _find_rates(formation: Formation, z: Array, step: float, heading: Array) -> Array:
    """Sliding and joint rates a `step` from `z` along the free direction, shape (n_c + 2,)."""
    slip = formation.evaluate_slip(z[None])[0]
    ahead = close_contacts(formation, z + step * heading, slip=slip)
    kinematics = formation.evaluate(ahead[None], heading[None])
    P, inverse_mass = kinematics.P[0], 1 / formation.scene.mass_diagonal
    lift = inverse_mass[:, None] * P.T
    tangent = heading - lift @ np.linalg.solve(P @ lift, P @ heading)
    return np.concatenate([kinematics.A_t[0] @ tangent, tangent[3:]])


def _measure_drive(scene: Scene) -> float:
    """Acceleration in the metric M5 that counts as rounding [kg^(1/2) m/s^2]."""
    return STILL * float(scene.scales.mass**0.5) * scene.scales.acceleration


def _evaluate(coefficients: Array, x: float | Array) -> Array:
    """Torques at one place of a piece, shape (2,), or at n places, shape (2, n)."""
    powers = np.power.outer(np.asarray(x), np.arange(coefficients.shape[1]))
    return np.asarray(coefficients @ powers.T)


def _constant(values: Array, coefficients: Array) -> Array:
    """Values, shape (m,), as polynomials of as many coefficients as those of a piece."""
    return np.pad(values[:, None], ((0, 0), (0, coefficients.shape[1] - 1)))


def _split(polynomials: Array, x: float) -> tuple[Array, Array]:
    """Starts and middles of the parts of [x, 1] in which none of the rows changes its sign."""
    if polynomials.shape[1] == 2:
        level, slope = polynomials[polynomials[:, 1] != 0].T
        roots = -level / slope
    else:
        roots = np.array([r for row in np.unique(polynomials, axis=0) for r in find_roots(row)])
    starts = np.array([x, *np.unique(roots[(x < roots) & (roots < 1)])])
    return starts, (starts + np.append(starts[1:], 1.0)) / 2


def find_breach(polynomials: Array, x: float) -> float:
    """First place in [x, 1] at which a polynomial of some, (n, d + 1), turns negative; infinity."""
    starts, middles = _split(polynomials, x)
    low = (_evaluate(polynomials, middles) < 0).any(axis=0)
    return float(starts[low.argmax()]) if low.any() else np.inf


def find_roots(polynomial: Array) -> list[float]:
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
    closed = 3e-15 * formation.scene.scales.length
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
