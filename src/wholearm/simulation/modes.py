"""Contact modes of a formation: in motion, at the start from rest, and held at rest.

**In motion.** A stuck contact is integrated like a rolling one, v_t = 0 with c_t free, and a held
joint with theta_i' = 0 and a free friction torque f:

    P = [A; A_t(rolling); A_t(stuck); e(held)],    |c_t| <= mu c_n,    |f| <= D.

Vertices of a flush edge slide and stick as one, with one force T of friction (`system`), |T| <=
sum mu c_n. A contact flush with a rolling one has no friction of its own.

**At rest.** Each choice of signs of sliding and turning, and of what sticks, makes accelerations
and contact forces affine in the torques. Such a start mode is consistent if contacts and joints
accelerate with its signs, friction can hold the others, every contact presses and nothing that
touches closes further. With one freedom these are both directions along it. If none is consistent
the formation sticks; contact forces are then indeterminate, and the torque polygon
(`mechanics.statics`) says whether any inside the friction cones balance. On a polynomial piece of
the torques both change at roots of polynomials.

**Held.** A motion that is to stop at a contact may end a little short of it. Constant torques that
close the contact and then hold still with everything that touches have to

* be in static balance with all that touches at the contact, every c_n at least epsilon and
  |c_t| <= mu (c_n - epsilon), and start no motion that gives up one of these contacts;
* from rest, with the contact still open by a gap, accelerate the formation towards it, beyond what
  friction can hold.

All of this is affine in the torques. Those with the largest least margin, each over its saturation
value, solve a linear programme in three unknowns. Contacts of the formation may open on the way:
torques that keep them closed are so weak that impacts on arrival last longer than the motion.
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
from .system import ROUNDING_FORCE, STILL, ContactRows, Modes, build_system

_JOINTS = np.eye(5)[3:]  # rows that give the rates of the joints from z'


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
    """A formation with what rolls or sticks and is held, and which way the rest goes."""

    formation: Formation
    signs: Array  # (n_c + 2,): of sliding and turning, zero for what is held or rolls
    holders: tuple[tuple[int, ...], ...]  # rows of `signs` that each force after c_n holds

    @cached_property
    def n_constraints(self) -> int:
        """Number of constraints, and of independent forces c = [c_n; c_t or T; f]."""
        return self.formation.n_contacts + len(self.holders)

    @property
    def held(self) -> list[int]:
        """First row of each contact, flush edge or joint that rolls, sticks or is held."""
        return [rows[0] for rows in self.holders]

    def find_modes(self) -> Modes:
        """The same of the pairs of features of the scene, without signs."""
        # Coordinates 3 and 4 are those of the joints.
        below = self.formation.n_contacts
        holders = (rows if rows[0] < below else (rows[0] + 3,) for rows in self.holders)
        return Modes(_list_pairs(self.formation), tuple(holders))

    def declares(self, holder: int) -> bool:
        """Whether the phase asks for what the `holder`-th force after c_n holds."""
        return self.holders[holder][0] in self.formation.rolling_rows


def find_mode(formation: Formation, signs: Array) -> Mode:
    """What rolls, and what sticks where `signs`, (n_c + 2,), are zero; with one freedom nothing."""
    held: list[tuple[int, ...]] = [(row,) for row in formation.rolling_rows]
    if formation.n_constraints < 4:
        held += [unit.rows for unit in list_units(formation) if signs[unit.rows[0]] == 0]
    return Mode(formation, signs, tuple(sorted(held)))


def list_modes(
    formation: Formation, signs: Array, units: Sequence[Unit], held: bool = True
) -> Iterator[Mode]:
    """The mode of each combination of signs of some units that leaves a freedom to move in.

    They replace those among `signs`, (n_c + 2,); zero is one of units with friction that may be
    `held`.
    """
    options = [(1.0, -1.0, 0.0) if held and unit.grips else (1.0, -1.0) for unit in units]
    for choice in product(*options):
        tried = signs.copy()
        for unit, sign in zip(units, choice, strict=True):
            tried[list(unit.rows)] = sign
        mode = find_mode(formation, tried)
        if mode.n_constraints <= 4:
            yield mode


def _list_pairs(formation: Formation) -> tuple[int, ...]:
    """Pairs of features of the scene that touch in a formation."""
    names = build_system(formation.scene).names
    return tuple(names.index(name) for name in formation.names)


def evaluate_rows(formation: Formation, z: Array, v: Array) -> ContactRows:
    """Constraint rows of a formation at one state, with its contacts closed.

    Those of sliding, A_t (n_c + 2, 5) and bend_t (n_c + 2,), have the joints below the contacts.
    """
    rows = build_system(formation.scene).evaluate(z, v, _list_pairs(formation))
    return rows._replace(A_t=np.vstack([rows.A_t, _JOINTS]), bend_t=np.append(rows.bend_t, [0, 0]))


class Response(NamedTuple):
    """How a mode answers to torques; quantities are rows @ (1, tau_1, tau_2)."""

    mode: Mode
    c: Array  # (n_c + K, 3) [N, N m]: normal forces, then those of what is held
    acceleration: Array  # (5, 3)
    rates: Array  # (n_c + 2, 3): accelerations of the contacts' sliding and of the joints
    ratio: float  # reduced inertia over that without friction; jammed at zero and below

    @property
    def force_limits(self) -> Array:
        """What has to be positive for everything to hold, scaled, (n_c + 2 K, 3).

        Every c_n, then both sides of the cones of the K that are held (see `EventRows.cone`).
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
        """Friction of the contacts, (n_c, 3) [N]; NaN where a flush edge sticks: it is shared."""
        formation, count = self.mode.formation, self.mode.formation.n_contacts
        c_t = -(formation.sliding_friction * self.mode.signs[:count])[:, None] * self.c[:count]
        for force, rows in zip(self.c[count:], self.mode.holders, strict=True):
            if rows[0] < count:
                c_t[list(rows)] = force if len(rows) == 1 else np.nan
        return c_t


def respond(mode: Mode, rows: ContactRows, v: Array) -> Response | None:
    """Solve the equations of motion at velocity v, (5,); None for dependent constraints."""
    scene, count, held = mode.formation.scene, mode.formation.n_contacts, mode.held
    slip = (mode.formation.sliding_friction * mode.signs[:count])[:, None] * rows.A_t[:count]
    P, G = (np.vstack([part, rows.A_t[held]]) for part in (rows.A, rows.A - slip))
    inverse_mass = 1 / scene.mass_diagonal
    if mode.n_constraints > mode.formation.n_constraints:
        lines = P * np.sqrt(inverse_mass)
        lines /= np.linalg.norm(lines, axis=1)[:, None]
        if len(P) > 5 or np.linalg.svd(lines, compute_uv=False)[-1] <= 1e-9:
            return None
    applied = np.zeros((5, 3))
    applied[:, 0] = scene.applied_force - scene.viscous * v
    applied[3:, 0] -= scene.dry[3:] * mode.signs[count:]
    applied[:, 1:] = _JOINTS.T
    drop = P * inverse_mass
    K = drop @ G.T
    ratio = float(np.linalg.det(K) / np.linalg.det(drop @ P.T))
    c = np.zeros((len(P), 3))
    if abs(ratio) > 1e-12:
        right = -drop @ applied
        right[:, 0] -= np.append(rows.bend, rows.bend_t[held])
        c = np.asarray(np.linalg.solve(K, right), dtype=float)
    acceleration = inverse_mass[:, None] * (applied + G.T @ c)
    rates = rows.A_t @ acceleration
    rates[:, 0] += rows.bend_t
    return Response(mode, c, acceleration, rates, ratio)


def find_fixed(mode: Mode, rows: ContactRows) -> Flags:
    """Which contacts, then joints, a mode keeps fixed, (n_c + 2,)."""
    root = np.sqrt(mode.formation.scene.mass_diagonal)
    P, free = np.vstack([rows.A, rows.A_t[mode.held]]) / root, rows.A_t / root
    length = np.linalg.norm(free, axis=1)
    basis = np.linalg.svd(P / np.linalg.norm(P, axis=1)[:, None], full_matrices=False)[2]
    return np.asarray(np.linalg.norm(free - (free @ basis.T) @ basis, axis=1) < 1e-7 * length)


class StartDeparture(NamedTuple):
    """The formation starts to move, or goes on, at `x` in [-1, 1] of a piece of the torques."""

    x: float
    heading: Array  # (5,): where to, of length one in the metric M5
    mode: Mode


class Collapse(NamedTuple):
    """Loss of balance at `x` of a piece without a consistent start mode."""

    x: float
    contact: str  # the contact that would have to pull most, or that slips
    c_n: float  # [N]
    jammed: bool  # whether friction jams one of the directions
    c_t: float | None = None  # [N]: of a rolling contact that slips, although it presses with `c_n`


class StartMode(NamedTuple):
    """Start mode; quantities at rest are rows @ (1, tau_1, tau_2), in the scene's units."""

    response: Response
    # (n_c + 2 R, 3): what has to be positive for the contacts to hold, H c (`mechanics.limits`)
    force_limits: Array
    # (k, 3): accelerations of sliding and turning along the signs, or along the only freedom
    slips: Array
    # not negative, but for rounding, where the mode is consistent: force limits, slips, limits of
    # friction that holds what has no sign, and accelerations that open closed gaps
    margins: Array
    heading: Array | None  # (5,): with one freedom, the direction
    rest: Rest

    def drive(self, tau: Array) -> float:
        """Acceleration in the metric M5."""
        mass = self.rest.scene.mass_diagonal
        return float(np.sqrt(mass @ (self.response.acceleration @ [1.0, *tau]) ** 2))

    def slides(self, tau: Array) -> bool:
        """Whether the formation accelerates in this mode if every contact can press or pull."""
        load = np.array([1.0, *tau])
        return (
            self.response.ratio > 0
            and self.drive(tau) > STILL * self.rest.unit
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
    """Statics with the modes in which a motion starts.

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
        """Start modes without sticking: two with one freedom, all sign patterns with more."""
        if self.heading is None:
            return self._list_patterns(held=False)
        ways = zip(self._find_signs(self.heading), (self.heading, -self.heading), strict=True)
        modes = [self._build(find_mode(self.formation, signs), way) for signs, way in ways]
        return tuple(mode for mode in modes if mode is not None)

    @cached_property
    def sticking(self) -> tuple[StartMode, ...]:
        """Start modes in which friction holds some contact or joint, the least first."""
        return () if self.heading is not None else self._list_patterns(held=True)

    def list_modes(self) -> Iterator[StartMode]:
        """All start modes; those with sticking are built when first needed: most never are."""
        yield from self.sliding
        yield from self.sticking

    @cached_property
    def touching(self) -> Statics:
        """That of every contact that touches, in the formation or not."""
        gained = [self.formation.limits[k].gained for k in np.flatnonzero(self.near)]
        contacts = *self.formation.contacts, *(contact for contact in gained if contact)
        return Statics(Formation(self.scene, contacts), self.z)

    @cached_property
    def held(self) -> TorquePolygon:
        """Torques that friction can hold, and those beyond by no more than rounding."""
        polygon = self.touching.torque_polygon()
        return polygon._replace(bounds=polygon.bounds + 1e-6 * self.scene.scales.torque)

    def _list_patterns(self, held: bool) -> tuple[StartMode, ...]:
        """Start modes with more freedoms: only those with sticking, or only the others."""
        formation, none = self.formation, np.zeros(self.formation.n_contacts + 2)
        every = list_modes(formation, none, list_units(formation), held)
        chosen = [mode for mode in every if (len(mode.holders) > formation.n_rolling) == held]
        modes = map(self._build, sorted(chosen, key=lambda mode: len(mode.holders)))
        return tuple(mode for mode in modes if mode is not None)

    def _find_signs(self, heading: Array) -> Array:
        """Directions of contacts and joints along the only freedom and back, (2, n_c + 2).

        What is stationary here has the direction that it has just after; zero if it stays so.
        """
        scene = self.scene
        # In which something moves by its unit; just after is 1e-5 of it later.
        time = 1 / np.abs(heading / build_system(scene).units[:5]).max()
        units = np.repeat([scene.scales.length, 1.0], [self.formation.n_contacts, 2]) / time
        at = self.formation.evaluate(self.z[None], heading[None])
        bend = -solve_min_norm(at.P, at.P_dot_v, scene.mass_diagonal)[0]
        rows = evaluate_rows(self.formation, self.z, heading)
        later = 1e-5 * time * (rows.A_t @ bend + rows.bend_t)
        rates = np.outer([1.0, -1.0], rows.A_t @ heading) + later
        rates[:, list(self.formation.rolling_rows)] = 0.0
        return np.sign(np.where(np.abs(rates) > 1e-12 * units, rates, 0.0))

    def _build(self, mode: Mode, heading: Array | None = None) -> StartMode | None:
        """The start mode of a mode; None if its forces are not determined."""
        mass, scales, count = self.scene.mass_diagonal, self.scene.scales, self.formation.n_contacts
        none, A_t = np.zeros(count + 2), np.vstack([self.A_t, _JOINTS])
        rows = ContactRows(self.A, A_t, none[:count], none, none)
        response = respond(mode, rows, np.zeros(5))
        if response is None:
            return None
        declared = [mode.declares(k) for k in range(len(mode.holders))]
        kept, limits = np.array([True] * count + declared + declared), response.force_limits
        units = np.repeat([scales.acceleration, scales.rate / scales.time], [count, 2])
        slips = (mode.signs / units)[:, None] * response.rates
        # What opens, or closes by no more than counts as grazing.
        openings = self.opening[0] @ response.acceleration / scales.acceleration
        openings += GRAZE * slips.sum(axis=0)
        # Difference quotients are as good as 1e-7.
        still, closing = STILL, 1e-7
        if heading is not None:
            # All accelerations are multiples of this one.
            slips = (heading * mass @ response.acceleration)[None] / self.unit
            still, closing = -STILL, 0.0
        margins = np.vstack([limits[kept], slips, limits[~kept], openings])
        sizes = [kept.sum(), len(slips), (~kept).sum(), len(openings)]
        margins[:, 0] += np.repeat([ROUNDING_FORCE, still, ROUNDING_FORCE, closing], sizes)
        return StartMode(response, limits[kept], slips, margins, heading, self)

    def wait(self, coefficients: Array, x: float) -> StartDeparture | Collapse | None:
        """End of the rest on a piece of torques, (2, d + 1) [N m] in powers of x, or None."""
        tau = polyval(np.asarray(x), coefficients.T)
        for mode in self.list_modes():
            if mode.moves(tau):
                return mode.depart(x, tau)
        # Where torques cannot be held any more; infinite if they can all along.
        normals, bounds = self.held
        loss = x
        if np.isfinite(bounds).all():
            reserves = -normals @ coefficients
            reserves[:, 0] += bounds
            loss = find_breach(reserves, x)
        every = list(self.list_modes())
        margins = [mode.margins for mode in every]
        rows = np.vstack(margins)
        first = np.cumsum([0, *(len(part) for part in margins[:-1])])
        # Where a margin changes sign; in between, no mode changes.
        polynomials = rows[:, 1:] @ coefficients
        polynomials[:, 0] += rows[:, 0]
        starts, middles = _split(polynomials, x)
        torques = polyval(middles, coefficients.T)
        values = rows[:, :1] + rows[:, 1:] @ torques
        consistent = np.logical_and.reduceat(values >= 0, first, axis=0).T
        for start, tau, chosen in zip(starts.tolist(), torques.T, consistent, strict=True):
            if start > loss + LATE:
                break
            modes = [every[k] for k in np.flatnonzero(chosen)]
            for mode in sorted(modes, key=lambda mode: -mode.drive(tau)):
                if mode.drive(tau) > 1e3 * STILL * self.unit and mode.moves(tau):
                    return mode.depart(start, tau)
        return self._collapse(coefficients, loss) if loss <= 1 else None

    def _collapse(self, coefficients: Array, x: float) -> Collapse:
        """The contact that gives way at `x`."""
        tau, rolls = polyval(np.asarray(x), coefficients.T), self.formation.n_rolling
        count = self.formation.n_contacts
        jammed = [mode.response.ratio <= 0 for mode in self.sliding]
        jams = any(jammed) if self.heading is not None else all(jammed)
        free = [mode for mode in self.list_modes() if mode.slides(tau)]
        pulls = self.touching.find_pulls(tau)
        if free or np.isinf(pulls).all():
            load = np.array([1.0, *tau])
            weakest = min((mode.force_limits @ load for mode in free or self.sliding), key=np.min)
            weakest = weakest * self.scene.scales.force
            normal, *cones = np.split(weakest, np.cumsum([count, rolls]))
            row, c_t = int(normal.argmin()), None
            if normal[row] >= 0 and rolls:
                k = int(np.minimum(*cones).argmin())
                row, c_t = self.formation.rolling_rows[k], float(cones[1][k] - cones[0][k]) / 2
            return Collapse(x, self.formation.names[row], float(normal[row]), jams, c_t)
        row = int(pulls.argmax())
        return Collapse(x, self.touching.formation.names[row], -float(pulls[row]), jams)


def _split(polynomials: Array, x: float) -> tuple[Array, Array]:
    """Starts and middles of the parts of [x, 1] in which none of the rows changes its sign."""
    if polynomials.shape[1] == 2:
        level, slope = polynomials[polynomials[:, 1] != 0].T
        roots = -level / slope
    else:
        rows = set(map(tuple, polynomials.tolist()))
        roots = np.array([root for row in rows for root in _find_roots(np.array(row))])
    starts = np.array([x, *sort_unique(roots[(x < roots) & (roots < 1)])])
    return starts, (starts + np.append(starts[1:], 1.0)) / 2


def find_breach(polynomials: Array, x: float) -> float:
    """First place in [x, 1] at which a polynomial of some, (n, d + 1), turns negative; infinity."""
    starts, middles = _split(polynomials, x)
    low = (polyval(middles, polynomials.T) < 0).any(axis=0)
    return float(starts[low.argmax()]) if low.any() else np.inf


def _find_roots(polynomial: Array) -> list[float]:
    """Real roots of a polynomial given by ascending coefficients."""
    significant = np.flatnonzero(np.abs(polynomial) > 1e-14 * np.abs(polynomial).max())
    if not len(significant) or significant[-1] == 0:
        return []
    roots = np.roots(polynomial[significant[-1] :: -1])
    return [float(root.real) for root in roots if abs(root.imag) < 1e-9]


def require_closed(formation: Formation, z: Array, within: float = np.inf) -> Array:
    """Nearest configuration, in the metric M5, with every contact of the formation closed.

    Gaps up to `within` [m] are closed. A `SimulationError` says which contact cannot be closed.
    """
    gaps, mass = formation.evaluate(z[None], z[None]).C[0], formation.scene.mass_diagonal
    worst = int(np.abs(gaps).argmax())
    text = f"{formation.names[worst]}, with a gap of {gaps[worst]:.3g} m,"
    if np.abs(gaps[worst]) > within:
        raise SimulationError(f"{text} does not touch")
    closed = close_all(replace(formation, rolling=()), z[None], np.zeros(0), metric=mass)[0]
    if not np.isfinite(closed).all():
        raise SimulationError(f"{text} cannot be closed")
    return np.asarray(closed)


LEAST = 1e-2  # least margin over saturation of torques that hold or close
AMPLE = 0.1  # saturation of margins of forces, torques, accelerations, over the scene's
# Of half a piece of torques: how long after balance is lost a start may show, as accelerations have
# to exceed rounding. Case: phase 1 of query 50 with limited rates.
LATE = 1e-6
DRIVE = 0.02  # least acceleration towards an open contact, ample sliding, over the scene's
_SMALL = 1e-9  # relative rate at which a contact does not part


class Standstill(NamedTuple):
    """Where a motion stops."""

    z: Array  # (5,)
    formation: Formation  # that it stops in
    gained: Contact | None  # what it stops at
    touching: Formation  # all that touches


def find_standstill(problem: Problem, phase: Phase, z: Array) -> Standstill:
    """Where a phase stops at z, (5,), and what touches: its contacts, the gained, the next phase's.

    What is beyond the end of a link or an edge does not: phase 4 of query 61 gains an edge under
    the name of its vertex, which is 65 mm beyond the tip.
    """
    gained, following = phase.until.contact, problem.phases[phase.number : phase.number + 1]
    contacts = list(phase.formation.add(gained).contacts)
    contacts += [contact for later in following for contact in later.formation.contacts]
    system = build_system(problem.scene)
    inside = dict(zip(system.names, system.look(z)[1].tolist(), strict=True))
    near = [c for c in dict.fromkeys(contacts) if inside[c.name] > -problem.scene.touching]
    return Standstill(z, phase.formation, gained, Formation(problem.scene, tuple(near)))


class Hold(NamedTuple):
    """Constant torques for a standstill."""

    tau: Array  # (2,) [N m]
    margin: float  # the least of the margins, over what is ample
    # [m/s]: at most, with which the contact is reached from rest, if all others stay closed till
    # then; zero where nothing has to close, or no torques would drive the formation on
    speed: float = 0.0
    # contacts that would have to pull in the impact of that arrival: they part for a moment
    parts: tuple[str, ...] = ()


def find_hold(place: Standstill, epsilon: float, gap: float) -> Hold | None:
    """Torques with the largest margin for a standstill; None if none hold c_n >= `epsilon` [N].

    A gained contact, open by up to `gap` [m], is closed with the least acceleration `DRIVE` if any
    torques do.
    """
    rest = _list_holding(place, epsilon)
    best = maximise_margin(place.formation.scene.torque_limit, rest)
    if best is None or best[1] < LEAST:
        return None
    opening = find_opening(place)
    closing = None if opening is None else _find_closing(place, rest, opening, gap)
    return closing or Hold(*best)


def _list_holding(place: Standstill, epsilon: float) -> Array:
    """Rows that have to be positive at rest, over their saturation values, shape (k, 3)."""
    statics, contacts = Statics(place.touching, place.z), place.touching.contacts
    held, scene = statics.torque_polygon(epsilon), statics.scene
    rows = [np.column_stack([held.bounds, -held.normals]) / (AMPLE * scene.scales.torque)]
    for kept in combinations(contacts, 4) if not statics.freedoms.size else ():
        others = [k for k, contact in enumerate(contacts) if contact not in kept]
        # Motions that give up the other contacts.
        rows += [
            -mode.slips / AMPLE
            for mode in _list_sliding(Formation(scene, kept), place.z)
            if mode.heading is not None and (statics.A[others] @ mode.heading >= -_SMALL).all()
        ]
    return np.vstack(rows)


def _list_sliding(formation: Formation, z: Array) -> tuple[StartMode, ...]:
    """Start modes without sticking that do not jam; none if contacts depend on each other."""
    try:
        return tuple(mode for mode in Rest(formation, z).sliding if mode.response.ratio > 0)
    except SimulationError:
        return ()


def find_opening(place: Standstill) -> Array | None:
    """Rate of z per metre of the gained contact's gap, shape (5,); None if nothing opens it."""
    if place.gained is None:
        return None
    scene = place.formation.scene
    normal = Statics(Formation(scene, (place.gained,)), place.z).A[0]
    N = Statics(place.formation, place.z).freedoms
    push = N.T @ normal
    rate = float(push @ push)
    if rate <= 3e-5 * float(normal**2 @ (1 / scene.mass_diagonal)):
        return None
    return np.asarray(N @ push / rate)


def _find_closing(place: Standstill, rest: Array, opening: Array, gap: float) -> Hold | None:
    """Torques of largest margin that accelerate the formation towards a contact open by `gap`."""
    assert place.gained is not None
    scene, z = place.formation.scene, place.z + gap * opening
    normal = Statics(Formation(scene, (place.gained,)), z).A[0]
    scales, held = scene.scales, Statics(place.formation, z).torque_polygon()
    best: Hold | None = None
    for mode in _list_sliding(place.formation, z):
        rows, closing = rest, -normal @ mode.response.acceleration
        if mode.heading is None:
            rows = np.vstack([rest, mode.slips[mode.response.mode.signs != 0] / DRIVE])
        elif normal @ mode.heading >= 0:
            continue
        enough = closing - [DRIVE * scales.acceleration, 0.0, 0.0]
        solution = maximise_margin(scene.torque_limit, rows, enough[None])
        if solution is None or solution[1] < max(LEAST, best.margin if best else 0.0):
            continue
        tau, margin = solution
        # Friction must not be able to hold the formation at rest before it is there.
        if held.measure(tau[None])[0] <= SURE * scales.torque:
            continue
        a = float(closing @ [1.0, *tau])
        v = mode.response.acceleration @ [1.0, *tau] * math.sqrt(2 * gap / a)
        parts: tuple[str, ...] = ()
        with suppress(np.linalg.LinAlgError):
            impact = compute_impact(place.formation, place.touching, place.z, v)
            parts = tuple(v.name for v in impact.violations if v.kind is ViolationKind.PULL)
        best = Hold(tau, margin, math.sqrt(2 * a * gap), parts)
    return best


def maximise_margin(
    limits: Array, rows: Array, bounds: Array | None = None
) -> tuple[Array, float] | None:
    """Torques up to `limits`, (2,), with the largest margin m <= 1000, and m; None without any.

    They keep rows @ (1, tau) >= m and bounds @ (1, tau) >= 0, of shapes (k, 3) and (l, 3).
    """
    from scipy.optimize import linprog

    sides = np.vstack([rows, np.zeros((0, 3)) if bounds is None else bounds])
    if not np.isfinite(sides).all():
        return None  # nothing can be held: new polygon 35, phase 3
    sides = np.column_stack([sides, np.arange(len(sides)) < len(rows)])
    sides /= np.abs(sides).max(axis=1)[:, None]
    answer: Any = linprog(
        [0.0, 0.0, -1.0],
        A_ub=sides[:, 1:] * [-1.0, -1.0, 1.0],
        b_ub=sides[:, 0],
        bounds=[*((-most, most) for most in limits.tolist()), (None, 1e3)],
    )
    return (answer.x[:2], float(answer.x[2])) if answer.status == 0 else None
