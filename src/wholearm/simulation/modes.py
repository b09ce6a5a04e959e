"""Contact modes of a formation: in motion, at the start from rest, and held at rest.

**In motion.** A stuck contact has the equations of a rolling one, v_t = 0 with c_t unknown; a held
joint has theta_i' = 0 with an unknown friction torque f:

    P = [A; A_t(rolling); A_t(stuck); e(held)],    |c_t| <= mu c_n,    |f| <= D.

Vertices of a flush edge slide and stick together, with one friction force T (`system`), |T| <=
sum mu c_n. A contact flush with a rolling one has no friction of its own.

**At rest.** A start mode assigns signs, or sticking, to all contacts and joints. Accelerations and
contact forces are then affine in the torques. A start mode is consistent if contacts and joints
accelerate with its signs, friction holds those that stick, every contact presses and no closed gap
of another contact closes further. With one degree of freedom the modes are its two directions. If
no mode is consistent the formation sticks. Contact forces are then indeterminate; the torque
polygon (`mechanics.statics`) decides whether some forces in the friction cones balance. On a
polynomial piece of the torques both change at roots of polynomials.

**Held.** A motion that should stop at a contact may end slightly short of it. Constant torques that
close the contact and then hold all touching contacts at rest have to

* be in static balance with all touching contacts, with every c_n at least epsilon and
  |c_t| <= mu (c_n - epsilon), and start no motion that opens one of them;
* accelerate the formation from rest towards the contact while its gap is open, against friction at
  rest.

All conditions are affine in the torques. The largest minimum of their margins, each relative to its
saturation value, is a linear programme in three unknowns. Contacts of the formation may open
meanwhile: torques that keep them closed are so small that impacts on arrival outlast the motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval

from ..common.arrays import Array, Flags, sort_unique
from ..common.errors import SimulationError
from ..contacts.elemental import Contact
from ..contacts.formation import Formation
from ..mechanics.dynamics import close_all, solve_min_norm
from ..mechanics.impact import ViolationKind, compute_impact
from ..mechanics.statics import GRAZE, SURE, Statics, TorquePolygon
from ..problem.definition import Phase, Problem
from .system import ROUNDING_FORCE, ZERO_ACCEL, ContactRows, Modes, build_system

_JOINTS = np.eye(5)[3:]  # rows that give the rates of the joints from z'


class Unit(NamedTuple):
    """Contacts or a joint that slide or turn, and stick or are held, together."""

    rows: tuple[int, ...]  # among the contacts and then the joints
    frictional: bool  # whether it has friction


@lru_cache(maxsize=64)
def list_units(formation: Formation) -> tuple[Unit, ...]:
    """Units that may slide or turn, contacts first, except those flush with a rolling contact."""
    friction = np.concatenate([formation.friction, formation.scene.dry[3:]])
    groups = dict.fromkeys(formation.turn_with(row) for row in range(len(friction)))
    return tuple(
        Unit(rows, bool(friction[rows[0]] > 0))
        for rows in groups
        if not set(rows) & set(formation.rolling_rows)
    )


@dataclass(frozen=True, eq=False)
class Mode:
    """Contact mode of a formation: rolling, sticking and held units, and signs of the others."""

    formation: Formation
    signs: Array  # (n_c + 2,): of sliding velocities and joint rates, zero if rolling or held
    holders: tuple[tuple[int, ...], ...]  # rows of `signs` held by each force after c_n

    @cached_property
    def n_constraints(self) -> int:
        """Number of constraints, and of independent forces c = [c_n; c_t or T; f]."""
        return self.formation.n_contacts + len(self.holders)

    @property
    def first_rows(self) -> list[int]:
        """First row of each contact, flush edge or joint that rolls, sticks or is held."""
        return [rows[0] for rows in self.holders]

    def find_modes(self) -> Modes:
        """The mode by pairs of features of the scene, without signs."""
        # Coordinates 3 and 4 are those of the joints.
        n_contacts = self.formation.n_contacts
        holders = (rows if rows[0] < n_contacts else (rows[0] + 3,) for rows in self.holders)
        return Modes(_list_pairs(self.formation), tuple(holders))

    def is_rolling(self, holder: int) -> bool:
        """Whether the `holder`-th force after c_n holds a contact that rolls in the phase."""
        return self.holders[holder][0] in self.formation.rolling_rows


def find_mode(formation: Formation, signs: Array) -> Mode:
    """Mode with sticking where `signs`, (n_c + 2,), are zero; with one freedom none sticks."""
    holders: list[tuple[int, ...]] = [(row,) for row in formation.rolling_rows]
    if formation.n_constraints < 4:
        holders += [unit.rows for unit in list_units(formation) if signs[unit.rows[0]] == 0]
    return Mode(formation, signs, tuple(sorted(holders)))


def list_modes(
    formation: Formation, signs: Array, units: Sequence[Unit], sticking: bool = True
) -> Iterator[Mode]:
    """Modes with a remaining degree of freedom, for all combinations of signs of some units.

    They replace those in `signs`, (n_c + 2,). Units with friction also get the sign zero if
    `sticking`.
    """
    options = [(1.0, -1.0, 0.0) if sticking and unit.frictional else (1.0, -1.0) for unit in units]
    for choice in product(*options):
        candidate = signs.copy()
        for unit, sign in zip(units, choice, strict=True):
            candidate[list(unit.rows)] = sign
        mode = find_mode(formation, candidate)
        if mode.n_constraints <= 4:
            yield mode


def _list_pairs(formation: Formation) -> tuple[int, ...]:
    """Pairs of features of the scene that touch in a formation."""
    names = build_system(formation.scene).names
    return tuple(names.index(name) for name in formation.names)


def evaluate_rows(formation: Formation, z: Array, v: Array) -> ContactRows:
    """Constraint rows of a formation at one state, with its contacts closed.

    A_t, (n_c + 2, 5), and A_t_dot_v, (n_c + 2,), have rows of the contacts, then of the joints.
    """
    rows = build_system(formation.scene).evaluate(z, v, _list_pairs(formation))
    return rows._replace(
        A_t=np.vstack([rows.A_t, _JOINTS]), A_t_dot_v=np.append(rows.A_t_dot_v, [0, 0])
    )


class Response(NamedTuple):
    """Response of a mode to torques; quantities are rows @ (1, tau_1, tau_2)."""

    mode: Mode
    c: Array  # (n_c + K, 3) [N, N m]: normal forces, then forces of `Mode.holders`
    acceleration: Array  # (5, 3)
    rates: Array  # (n_c + 2, 3): accelerations of the contacts' sliding and of the joints
    ratio: float  # reduced inertia over that without friction; not positive: jammed

    @property
    def force_limits(self) -> Array:
        """Scaled margins of forces, positive if the mode holds, (n_c + 2 K, 3).

        Every c_n, then both sides of the K friction cones (see `EventRows.cone`).
        """
        formation, count = self.mode.formation, self.mode.formation.n_contacts
        scales, (c_n, forces) = formation.scene.scales, np.split(self.c, [count])
        bounds, units = np.zeros(forces.shape), np.full((len(forces), 1), scales.force)
        for k, rows in enumerate(self.mode.holders):
            if rows[0] < count:
                bounds[k] = formation.friction[list(rows)] @ c_n[list(rows)]
            else:
                bounds[k, 0] = formation.scene.dry[3 + rows[0] - count]
                units[k] = scales.torque
        cones = (bounds - forces) / units, (bounds + forces) / units
        return np.vstack([c_n / scales.force, *cones])

    @property
    def c_t(self) -> Array:
        """Friction of the contacts, (n_c, 3) [N]; NaN on a flush edge that sticks."""
        formation, count = self.mode.formation, self.mode.formation.n_contacts
        c_t = -(formation.sliding_friction * self.mode.signs[:count])[:, None] * self.c[:count]
        for force, rows in zip(self.c[count:], self.mode.holders, strict=True):
            if rows[0] < count:
                c_t[list(rows)] = force if len(rows) == 1 else np.nan
        return c_t


def respond(mode: Mode, rows: ContactRows, v: Array) -> Response | None:
    """Solve the equations of motion at velocity v, (5,); None for dependent constraints."""
    scene, count, first_rows = mode.formation.scene, mode.formation.n_contacts, mode.first_rows
    slip_rows = (mode.formation.sliding_friction * mode.signs[:count])[:, None] * rows.A_t[:count]
    P, G = (np.vstack([part, rows.A_t[first_rows]]) for part in (rows.A, rows.A - slip_rows))
    inverse_mass = 1 / scene.mass_diagonal
    if mode.n_constraints > mode.formation.n_constraints:
        unit_rows = P * np.sqrt(inverse_mass)
        unit_rows /= np.linalg.norm(unit_rows, axis=1)[:, None]
        if len(P) > 5 or np.linalg.svd(unit_rows, compute_uv=False)[-1] <= 1e-9:
            return None
    applied = np.zeros((5, 3))
    applied[:, 0] = scene.applied_force - scene.viscous * v
    applied[3:, 0] -= scene.dry[3:] * mode.signs[count:]
    applied[:, 1:] = _JOINTS.T
    PM = P * inverse_mass
    K = PM @ G.T
    ratio = float(np.linalg.det(K) / np.linalg.det(PM @ P.T))
    c = np.zeros((len(P), 3))
    if abs(ratio) > 1e-12:
        rhs = -PM @ applied
        rhs[:, 0] -= np.append(rows.A_dot_v, rows.A_t_dot_v[first_rows])
        c = np.asarray(np.linalg.solve(K, rhs), dtype=float)
    acceleration = inverse_mass[:, None] * (applied + G.T @ c)
    rates = rows.A_t @ acceleration
    rates[:, 0] += rows.A_t_dot_v
    return Response(mode, c, acceleration, rates, ratio)


def find_fixed(mode: Mode, rows: ContactRows) -> Flags:
    """Whether a mode fixes each contact, then joint, (n_c + 2,)."""
    root_mass = np.sqrt(mode.formation.scene.mass_diagonal)
    P, A_t = np.vstack([rows.A, rows.A_t[mode.first_rows]]) / root_mass, rows.A_t / root_mass
    length = np.linalg.norm(A_t, axis=1)
    basis = np.linalg.svd(P / np.linalg.norm(P, axis=1)[:, None], full_matrices=False)[2]
    return np.asarray(np.linalg.norm(A_t - (A_t @ basis.T) @ basis, axis=1) < 1e-7 * length)


class StartDeparture(NamedTuple):
    """Start of a motion at `x` in [-1, 1] of a piece of the torques."""

    x: float
    heading: Array  # (5,): direction of motion, of length one in the metric M5
    mode: Mode


class Collapse(NamedTuple):
    """Loss of balance at `x` of a piece without a consistent start mode."""

    x: float
    contact: str  # the contact with the largest tension, or that slips
    c_n: float  # [N]
    jammed: bool  # whether friction jams a direction of motion
    c_t: float | None = None  # [N]: of a rolling contact that slips under `c_n`
    closing: str = ""  # the limit without which the formation would start


class StartMode(NamedTuple):
    """Start mode; quantities at rest are rows @ (1, tau_1, tau_2), in the scene's units."""

    response: Response
    # (n_c + 2 R, 3): force limits H c of the contacts (`mechanics.limits`)
    force_limits: Array
    # (k, 3): accelerations along the signs of sliding and turning, or along the only freedom
    slips: Array
    # not negative, up to rounding, if the mode is consistent: force limits, slips, friction margins
    # of sticking units, and opening accelerations of closed gaps
    margins: Array
    heading: Array | None  # (5,): with one freedom, the direction
    rest: Rest

    def drive(self, tau: Array) -> float:
        """Acceleration in the metric M5."""
        mass = self.rest.scene.mass_diagonal
        return float(np.sqrt(mass @ (self.response.acceleration @ [1.0, *tau]) ** 2))

    def slides(self, tau: Array) -> bool:
        """Whether the formation accelerates in this mode with contacts that press or pull."""
        load = np.array([1.0, *tau])
        return (
            self.response.ratio > 0
            and self.drive(tau) > ZERO_ACCEL * self.rest.unit
            and bool((self.margins[len(self.force_limits) :] @ load >= 0).all())
            and self.rest.opens(self.response.acceleration @ load)
        )

    def moves(self, tau: Array) -> bool:
        """Whether the formation starts in this mode under torques `tau`, shape (2,)."""
        return bool((self.margins @ [1.0, *tau] >= 0).all()) and self.slides(tau)

    def depart(self, x: float, tau: Array) -> StartDeparture:
        """Start at `x` of a piece, where the torques are `tau`."""
        heading = self.response.acceleration @ [1.0, *tau] / self.drive(tau)
        return StartDeparture(x, heading, self.response.mode)


class Rest(Statics):
    """Statics with start modes.

    Raises a `SimulationError` for dependent contacts or no freedom.
    """

    def __init__(self, formation: Formation, z: Array) -> None:
        super().__init__(formation, z)
        freedoms, scales = self.freedoms.shape[1], self.scene.scales
        if freedoms > 5 - formation.n_constraints or not freedoms:
            raise SimulationError(
                f"{' '.join(formation.names)} leaves {freedoms} freedoms, and no forces that are "
                "determined; it cannot start from rest"
            )
        # (5,): with one freedom the direction, of length one in the metric M5
        self.heading = self.freedoms[:, 0] if freedoms == 1 else None
        # [kg^(1/2) m/s^2]: of accelerations in the metric M5
        self.unit = math.sqrt(scales.mass) * scales.acceleration

    @cached_property
    def sliding(self) -> tuple[StartMode, ...]:
        """Start modes without sticking: two with one freedom, all sign patterns otherwise."""
        if self.heading is None:
            return self._list_patterns(sticking=False)
        pairs = zip(self._find_signs(self.heading), (self.heading, -self.heading), strict=True)
        modes = [self._build(find_mode(self.formation, signs), heading) for signs, heading in pairs]
        return tuple(mode for mode in modes if mode is not None)

    @cached_property
    def sticking(self) -> tuple[StartMode, ...]:
        """Start modes with sticking contacts or joints, in rising order of their number."""
        return () if self.heading is not None else self._list_patterns(sticking=True)

    def list_modes(self) -> Iterator[StartMode]:
        """All start modes; those with sticking are built on demand, as they are rarely needed."""
        yield from self.sliding
        yield from self.sticking

    @cached_property
    def touching(self) -> Statics:
        """Statics of all touching contacts, also outside the formation."""
        gained = [self.formation.limits[k].gained for k in np.flatnonzero(self.near)]
        contacts = *self.formation.contacts, *(contact for contact in gained if contact)
        return Statics(Formation(self.scene, contacts), self.z)

    @cached_property
    def holding_polygon(self) -> TorquePolygon:
        """Torques that friction can hold, up to rounding."""
        polygon = self.touching.torque_polygon()
        return polygon._replace(bounds=polygon.bounds + 1e-6 * self.scene.scales.torque)

    def _list_patterns(self, sticking: bool) -> tuple[StartMode, ...]:
        """Start modes with several freedoms: those with sticking, or those without."""
        formation, zeros = self.formation, np.zeros(self.formation.n_contacts + 2)
        options = list_modes(formation, zeros, list_units(formation), sticking)
        chosen = [mode for mode in options if (len(mode.holders) > formation.n_rolling) == sticking]
        modes = map(self._build, sorted(chosen, key=lambda mode: len(mode.holders)))
        return tuple(mode for mode in modes if mode is not None)

    def _find_signs(self, heading: Array) -> Array:
        """Directions of contacts and joints along the only freedom and back, (2, n_c + 2).

        A rate that vanishes at rest has the sign that it has just after, zero if it stays zero.
        """
        scene = self.scene
        # Time of a motion by one unit; signs are evaluated after 1e-5 of it.
        time = 1 / np.abs(heading / build_system(scene).units[:5]).max()
        units = np.repeat([scene.scales.length, 1.0], [self.formation.n_contacts, 2]) / time
        kinematics = self.formation.evaluate(self.z[None], heading[None])
        acceleration = -solve_min_norm(kinematics.P, kinematics.P_dot_v, scene.mass_diagonal)[0]
        rows = evaluate_rows(self.formation, self.z, heading)
        rate_changes = 1e-5 * time * (rows.A_t @ acceleration + rows.A_t_dot_v)
        rates = np.outer([1.0, -1.0], rows.A_t @ heading) + rate_changes
        rates[:, list(self.formation.rolling_rows)] = 0.0
        return np.sign(np.where(np.abs(rates) > 1e-12 * units, rates, 0.0))

    def _build(self, mode: Mode, heading: Array | None = None) -> StartMode | None:
        """Start mode of a mode; None if its forces are indeterminate."""
        mass, scales, count = self.scene.mass_diagonal, self.scene.scales, self.formation.n_contacts
        zeros, A_t = np.zeros(count + 2), np.vstack([self.A_t, _JOINTS])
        rows = ContactRows(self.A, A_t, zeros[:count], zeros, zeros)
        response = respond(mode, rows, np.zeros(5))
        if response is None:
            return None
        is_rolling = [mode.is_rolling(k) for k in range(len(mode.holders))]
        planned, limits = np.array([True] * count + is_rolling + is_rolling), response.force_limits
        units = np.repeat([scales.acceleration, scales.rate / scales.time], [count, 2])
        slips = (mode.signs / units)[:, None] * response.rates
        # Opening accelerations; closing ones up to grazing count as zero.
        openings = self.opening[0] @ response.acceleration / scales.acceleration
        openings += GRAZE * slips.sum(axis=0)
        # Difference quotients have errors of 1e-7.
        slip_slack, gap_slack = ZERO_ACCEL, 1e-7
        if heading is not None:
            # All accelerations are multiples of this one.
            slips = (heading * mass @ response.acceleration)[None] / self.unit
            slip_slack, gap_slack = -ZERO_ACCEL, 0.0
        margins = np.vstack([limits[planned], slips, limits[~planned], openings])
        sizes = [planned.sum(), len(slips), (~planned).sum(), len(openings)]
        margins[:, 0] += np.repeat([ROUNDING_FORCE, slip_slack, ROUNDING_FORCE, gap_slack], sizes)
        return StartMode(response, limits[planned], slips, margins, heading, self)

    def wait(self, coefficients: Array, x: float) -> StartDeparture | Collapse | None:
        """End of rest after `x` on a torque piece, (2, d + 1) [N m] in powers of x; or None."""
        tau = polyval(np.asarray(x), coefficients.T)
        for mode in self.list_modes():
            if mode.moves(tau):
                return mode.depart(x, tau)
        # First place without static balance; infinite if there is none.
        normals, bounds = self.holding_polygon
        loss = x
        if np.isfinite(bounds).all():
            slacks = -normals @ coefficients
            slacks[:, 0] += bounds
            loss = find_breach(slacks, x)
        start_modes = list(self.list_modes())
        margins = [mode.margins for mode in start_modes]
        rows = np.vstack(margins)
        offsets = np.cumsum([0, *(len(part) for part in margins[:-1])])
        # Sign changes of margins; the set of consistent modes is constant between them.
        polynomials = rows[:, 1:] @ coefficients
        polynomials[:, 0] += rows[:, 0]
        starts, middles = _split(polynomials, x)
        torques = polyval(middles, coefficients.T)
        values = rows[:, :1] + rows[:, 1:] @ torques
        consistent = np.logical_and.reduceat(values >= 0, offsets, axis=0).T
        for start, tau, is_consistent in zip(starts.tolist(), torques.T, consistent, strict=True):
            if start > loss + START_DELAY:
                break
            modes = [start_modes[k] for k in np.flatnonzero(is_consistent)]
            for mode in sorted(modes, key=lambda mode: -mode.drive(tau)):
                if mode.drive(tau) > 1e3 * ZERO_ACCEL * self.unit and mode.moves(tau):
                    return mode.depart(start, tau)
        return self._collapse(coefficients, loss) if loss <= 1 else None

    def _collapse(self, coefficients: Array, x: float) -> Collapse:
        """The contact that is lost or slips at `x`."""
        tau, rolls = polyval(np.asarray(x), coefficients.T), self.formation.n_rolling
        count = self.formation.n_contacts
        jammed = [mode.response.ratio <= 0 for mode in self.sliding]
        jams = any(jammed) if self.heading is not None else all(jammed)
        moving = [mode for mode in self.list_modes() if mode.slides(tau)]
        pulls = self.touching.find_pulls(tau, count)
        if moving or np.isinf(pulls).all():
            load = np.array([1.0, *tau])
            weakest = min((mode.force_limits @ load for mode in moving or self.sliding), key=np.min)
            weakest = weakest * self.scene.scales.force
            normal, *cones = np.split(weakest, np.cumsum([count, rolls]))
            row, c_t = int(normal.argmin()), None
            if normal[row] >= 0 and rolls:
                k = int(np.minimum(*cones).argmin())
                row, c_t = self.formation.rolling_rows[k], float(cones[1][k] - cones[0][k]) / 2
            return Collapse(x, self.formation.names[row], float(normal[row]), jams, c_t)
        row, closing, n_open = int(pulls.argmax()), "", len(self.opening[0])
        near = np.setdiff1d(np.flatnonzero(self.near), self.opening[1])
        for mode in self.list_modes() if n_open else ():
            others, openings = np.split(mode.margins @ [1.0, *tau], [-n_open])
            if mode.response.ratio > 0 and (others >= 0).all():
                closing = self.formation.limits[near[openings.argmin()]].text
        pull = -float(pulls[row])
        return Collapse(x, self.formation.names[row], pull, jams, closing=closing)


def _split(polynomials: Array, x: float) -> tuple[Array, Array]:
    """Starts and middles of the intervals of [x, 1] without sign changes of the rows."""
    if polynomials.shape[1] == 2:
        constant, slope = polynomials[polynomials[:, 1] != 0].T
        roots = -constant / slope
    else:
        rows = set(map(tuple, polynomials.tolist()))
        roots = np.array([root for row in rows for root in _find_roots(np.array(row))])
    starts = np.array([x, *sort_unique(roots[(x < roots) & (roots < 1)])])
    return starts, (starts + np.append(starts[1:], 1.0)) / 2


def find_breach(polynomials: Array, x: float) -> float:
    """First x in [x, 1] with a negative polynomial among rows (n, d + 1); infinity if none."""
    starts, middles = _split(polynomials, x)
    is_negative = (polyval(middles, polynomials.T) < 0).any(axis=0)
    return float(starts[is_negative.argmax()]) if is_negative.any() else np.inf


def _find_roots(polynomial: Array) -> list[float]:
    """Real roots of a polynomial given by ascending coefficients."""
    significant = np.flatnonzero(np.abs(polynomial) > 1e-14 * np.abs(polynomial).max())
    if not len(significant) or significant[-1] == 0:
        return []
    roots = np.roots(polynomial[significant[-1] :: -1])
    return [float(root.real) for root in roots if abs(root.imag) < 1e-9]


def require_closed(formation: Formation, z: Array, max_gap: float = np.inf) -> Array:
    """Nearest configuration, in the metric M5, with every contact of the formation closed.

    Gaps up to `max_gap` [m] are closed. A `SimulationError` says which contact cannot be closed.
    """
    gaps, mass = formation.evaluate(z[None], z[None]).C[0], formation.scene.mass_diagonal
    worst = int(np.abs(gaps).argmax())
    text = f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m,"
    if np.abs(gaps[worst]) > max_gap:
        raise SimulationError(f"{text} does not touch")
    closed = close_all(replace(formation, rolling=()), z[None], np.zeros(0), metric=mass)[0]
    if not np.isfinite(closed).all():
        raise SimulationError(f"{text} cannot be closed")
    return np.asarray(closed)


MIN_MARGIN = 1e-2  # smallest relative margin of torques that hold or close
SATURATION = 0.1  # saturation of margins, over the scene's units
# Largest delay of a start after the loss of balance, in half pieces of torques, as accelerations
# have to exceed rounding. Case: phase 1 of query 50 with limited rates.
START_DELAY = 1e-6
A_MIN = 0.02  # smallest closing acceleration, over the scene's
ZERO_RATE = 1e-9  # relative opening rate that counts as zero


class Standstill(NamedTuple):
    """Configuration and contacts at the end of a motion."""

    z: Array  # (5,)
    formation: Formation  # contacts of the motion
    gained: Contact | None  # contact that ends the motion
    touching: Formation  # all touching contacts


def find_standstill(problem: Problem, phase: Phase, z: Array) -> Standstill:
    """Standstill of a phase at z, (5,). Candidates are contacts of this and the next phase.

    Contacts beyond the end of a link or an edge do not touch: phase 4 of query 61 gains an edge
    under the name of its vertex, which is 65 mm beyond the tip.
    """
    gained, following = phase.until.contact, problem.phases[phase.number : phase.number + 1]
    contacts = list(phase.formation.add(gained).contacts)
    contacts += [contact for phase_after in following for contact in phase_after.formation.contacts]
    system = build_system(problem.scene)
    margins = dict(zip(system.names, system.measure_at(z)[1].tolist(), strict=True))
    touching = [c for c in dict.fromkeys(contacts) if margins[c.name] > -problem.scene.touching]
    return Standstill(z, phase.formation, gained, Formation(problem.scene, tuple(touching)))


class Hold(NamedTuple):
    """Constant torques for a standstill."""

    tau: Array  # (2,) [N m]
    margin: float  # smallest margin, relative to saturation
    # [m/s]: upper bound of the closing speed from rest, if all other contacts stay closed; zero
    # if no contact has to close, or no torques close it
    speed: float = 0.0
    # contacts with tension in the closing impact: they open for a moment
    parts: tuple[str, ...] = ()


def find_hold(stop: Standstill, epsilon: float, gap: float) -> Hold | None:
    """Torques with the largest margin for a standstill; None if none hold c_n >= `epsilon` [N].

    A gained contact, open by up to `gap` [m], is closed with an acceleration of at least
    `A_MIN` if torques for it exist.
    """
    holding_rows = _build_holding_rows(stop, epsilon)
    best = maximise_margin(stop.formation.scene.torque_limit, holding_rows)
    if best is None or best[1] < MIN_MARGIN:
        return None
    opening = find_opening(stop)
    closing = None if opening is None else _find_closing(stop, holding_rows, opening, gap)
    return closing or Hold(*best)


def _build_holding_rows(stop: Standstill, epsilon: float) -> Array:
    """Rows that have to be positive at rest, relative to saturation, shape (k, 3)."""
    statics, contacts = Statics(stop.touching, stop.z), stop.touching.contacts
    sides, scene = statics.torque_polygon(epsilon), statics.scene
    rows = [np.column_stack([sides.bounds, -sides.normals]) / (SATURATION * scene.scales.torque)]
    for subset in combinations(contacts, 4) if not statics.freedoms.size else ():
        others = [k for k, contact in enumerate(contacts) if contact not in subset]
        # Motions that open the other contacts.
        rows += [
            -mode.slips / SATURATION
            for mode in _list_sliding(Formation(scene, subset), stop.z)
            if mode.heading is not None and (statics.A[others] @ mode.heading >= -ZERO_RATE).all()
        ]
    return np.vstack(rows)


def _list_sliding(formation: Formation, z: Array) -> tuple[StartMode, ...]:
    """Start modes without sticking or jamming; none if contacts are dependent."""
    try:
        return tuple(mode for mode in Rest(formation, z).sliding if mode.response.ratio > 0)
    except SimulationError:
        return ()


def find_opening(standstill: Standstill) -> Array | None:
    """Rate of z per metre of the gained contact's gap, shape (5,); None if no motion opens it."""
    if standstill.gained is None:
        return None
    scene = standstill.formation.scene
    normal = Statics(Formation(scene, (standstill.gained,)), standstill.z).A[0]
    N = Statics(standstill.formation, standstill.z).freedoms
    projection = N.T @ normal
    rate = float(projection @ projection)
    if rate <= 3e-5 * float(normal**2 @ (1 / scene.mass_diagonal)):
        return None
    return np.asarray(N @ projection / rate)


def _find_closing(stop: Standstill, holding_rows: Array, opening: Array, gap: float) -> Hold | None:
    """Torques of largest margin that accelerate the formation towards a contact open by `gap`."""
    assert stop.gained is not None
    scene, z = stop.formation.scene, stop.z + gap * opening
    normal = Statics(Formation(scene, (stop.gained,)), z).A[0]
    scales, polygon = scene.scales, Statics(stop.formation, z).torque_polygon()
    best: Hold | None = None
    for mode in _list_sliding(stop.formation, z):
        rows, closing = holding_rows, -normal @ mode.response.acceleration
        if mode.heading is None:
            rows = np.vstack([holding_rows, mode.slips[mode.response.mode.signs != 0] / A_MIN])
        elif normal @ mode.heading >= 0:
            continue
        closing_bound = closing - [A_MIN * scales.acceleration, 0.0, 0.0]
        solution = maximise_margin(scene.torque_limit, rows, closing_bound[None])
        if solution is None or solution[1] < max(MIN_MARGIN, best.margin if best else 0.0):
            continue
        tau, margin = solution
        # Friction must not hold the formation at rest before the contact closes.
        if polygon.measure(tau[None])[0] <= SURE * scales.torque:
            continue
        a = float(closing @ [1.0, *tau])
        v = mode.response.acceleration @ [1.0, *tau] * math.sqrt(2 * gap / a)
        separating: tuple[str, ...] = ()
        with suppress(np.linalg.LinAlgError):
            impact = compute_impact(stop.formation, stop.touching, stop.z, v)
            separating = tuple(v.name for v in impact.violations if v.kind is ViolationKind.PULL)
        best = Hold(tau, margin, math.sqrt(2 * a * gap), separating)
    return best


def maximise_margin(
    limits: Array, rows: Array, bounds: Array | None = None
) -> tuple[Array, float] | None:
    """Largest margin m <= 1000 by torques up to `limits`, (2,): (tau, m), or None.

    Linear programme: rows @ (1, tau) >= m and bounds @ (1, tau) >= 0, of shapes (k, 3) and (l, 3).
    """
    from scipy.optimize import linprog

    constraints = np.vstack([rows, np.zeros((0, 3)) if bounds is None else bounds])
    if not np.isfinite(constraints).all():
        return None  # no balance: new polygon 35, phase 3
    constraints = np.column_stack([constraints, np.arange(len(constraints)) < len(rows)])
    constraints /= np.abs(constraints).max(axis=1)[:, None]
    solution: Any = linprog(
        [0.0, 0.0, -1.0],
        A_ub=constraints[:, 1:] * [-1.0, -1.0, 1.0],
        b_ub=constraints[:, 0],
        bounds=[*((-limit, limit) for limit in limits.tolist()), (None, 1e3)],
    )
    return (solution.x[:2], float(solution.x[2])) if solution.status == 0 else None
