"""Motion with contacts from complementarity problems: events, contact modes, impacts.

At every event the contact modes solve a linear complementarity problem (Stewart and Trinkle, "An
implicit time-stepping scheme for rigid body dynamics with inelastic collisions and Coulomb
friction", 1996; exact in the plane). Of several solutions the one that changes the fewest modes is
used. Unknowns are normal forces c_n >= 0 and friction forces f of contacts and joints at rest.
Normal rates r_n and sliding rates r_t are linear in them,

    r_n = b_n + A M^-1 (G^T c_n + T^T f),      r_t = b_t + T M^-1 (G^T c_n + T^T f),

with r_n >= 0, c_n r_n = 0 and abs(f) <= bound. If r_t is not zero, f is opposite to it and at its
bound: mu c_n of a contact, D of a joint. Rates are accelerations while forces act, and velocities
in an impact. Friction of a sliding contact is part of G = A - mu Xi A_t. The problem is linear in
the positive and negative parts of f.

Problems are posed a short time later, at the extrapolated state, as forces may leave their bounds
by then. The last modes are tried first, then Lemke's method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product, takewhile
from typing import Any, NamedTuple

import numpy as np

from ..common.arrays import Array, Flags, IndependentRows, Numbers, find_root
from ..results.trajectory import interpolate_quintic
from .events import EventKind, Outcome, OutcomeKind, describe_change
from .modes import find_breach
from .run import Run, StuckError
from .system import EVENT_DELAY, ROUNDING_FORCE, ZERO_ACCEL, ZERO_SPEED, ContactRows, Modes, System

FRICTION_MARGIN = 1e-9  # friction margin that counts as zero, over its bound or the largest force
RATE_TOLERANCE = 1e-6  # difference of equal rates, over the largest rate without contact forces
MIN_DETERMINANT = 1e-9  # determinant of a scaled system that counts as zero
MAX_CHOICES = 600  # most mode choices that are enumerated; 576 for 3 contacts and 2 joints
SEPARATED, STICKING, POSITIVE, NEGATIVE = range(4)
"""Modes of a contact; joints have the last three. A frictionless contact that presses sticks."""
MODE_OF_SIGN = {0.0: STICKING, 1.0: POSITIVE, -1.0: NEGATIVE}  # by sliding sign
CLOSED_GAP = 1e-10  # gap that counts as closed at an event, over the scene's length
MAX_OVERLAP = 1e-6  # largest overlap of a contact, over the scene's length
CHATTER_SPEED = 1e-6  # speed of the last impact, over the scene's; it separates by rounding only
MIN_SINE = 1e-7  # sine of the angle between constraint rows below which they are dependent
MIN_GAP = 1e-13  # smallest gap of a separated pair, over the scene's length
GAP_SAMPLES = 8  # gap samples in the longest step, its end included
MAX_STEP = 0.3  # longest step, in units of the scene; gaps: every `MAX_STEP` / `GAP_SAMPLES`


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Contact problem of k contacts, s contacts and joints at rest, and n coordinates."""

    inverse_mass: Array  # (n,): diagonal of M^-1
    A: Array  # A, G (k, n):
    G: Array
    b_n: Array  # (k,): normal rates without forces
    T: Array  # (s, n)
    b_t: Array  # (s,): sliding rates without forces
    owner: Numbers  # (s,): the contact whose normal force bounds friction; -1 for a joint
    mu: Array  # mu, bound (s,): abs(f) <= mu c_n + bound
    bound: Array

    @cached_property
    def scaled(self) -> tuple[Array, Array, Array, Array]:
        """Scaling to a unit diagonal: units of c_n and f, matrix K, and rates q without forces."""
        rows, force_rows = (np.concatenate([part, self.T]) for part in (self.A, self.G))
        weighted, k = rows * self.inverse_mass, len(self.b_n)
        units = 1 / np.sqrt((weighted * rows).sum(axis=1))
        K = (weighted @ force_rows.T) * (units[:, None] * units)
        return units[:k], units[k:], K, units * np.concatenate([self.b_n, self.b_t])

    def find_choice(self, solution: ContactSolution) -> list[int]:
        """Modes of a solution, as the `choice` of `list_solutions`."""
        choice = [STICKING if c > 0 else SEPARATED for c in solution.c_n]
        for owner, sign in zip(self.owner.tolist(), solution.sign.tolist(), strict=True):
            if owner < 0:
                choice.append(MODE_OF_SIGN[sign])
            elif choice[owner] != SEPARATED:
                choice[owner] = MODE_OF_SIGN[sign]
        return choice


class ContactSolution(NamedTuple):
    """A solution of a contact problem."""

    c_n: Array  # (k,)
    f: Array  # (s,)
    r_n: Array  # (k,)
    ratios: Array  # (s,): friction over its bound
    sign: Array  # (s,): sliding sign if friction is at its bound, otherwise 0
    change: Array  # (n,): M^-1 (G^T c_n + T^T f)
    residual: float  # over the largest rate without contacts, 1e-8 at most


def solve_problem(p: ContactProblem) -> ContactSolution | None:
    """A solution by Lemke's method; None if it fails."""
    s_n, s_t, K, q = p.scaled
    k, s = len(s_n), len(s_t)
    rows = (p.owner >= 0).nonzero()[0]
    # Unknowns: c_n, positive and negative parts of f, and absolute sliding rates.
    M, negative, slip = np.zeros((k + 3 * s, k + 3 * s)), k + s, k + 2 * s
    M[:negative, :negative] = K
    M[:negative, negative:slip] = -K[:, k:]
    M[negative:slip, :slip] = -M[k:negative, :slip]
    i = np.arange(s)
    M[k + i, slip + i] = M[negative + i, slip + i] = 1.0
    M[slip + i, k + i] = M[slip + i, negative + i] = -1.0
    M[slip + rows, p.owner[rows]] = p.mu[rows] * s_n[p.owner[rows]] / s_t[rows]
    z, residual = solve_lcp(M, np.concatenate([q, -q[k:], p.bound / s_t]))
    scale = float(np.abs(q).max(initial=0.0)) or 1.0
    if not residual <= 1e-8 * max(scale, float((p.bound / s_t).max(initial=0.0))):
        return None
    return evaluate(p, s_n * z[:k], s_t * (z[k:negative] - z[negative:slip]), residual / scale)


def evaluate(
    problem: ContactProblem, c_n: Array, f: Array, residual: float = 0.0
) -> ContactSolution:
    """Rates, sliding signs and friction ratios under given forces."""
    p = problem
    change, size = p.inverse_mass * (c_n @ p.G + f @ p.T), np.abs(f)
    limit = p.bound + p.mu * np.append(c_n, 0.0)[p.owner]
    # A contact without normal force is at its bound.
    at_bound = limit - size <= FRICTION_MARGIN * np.maximum(limit, 1e-3 * size.max(initial=0.0))
    slip = np.where(f != 0, -f, p.b_t + p.T @ change)
    sign, ratios = np.where(at_bound, np.sign(slip), 0.0), size / np.maximum(limit, 1e-300)
    return ContactSolution(c_n, f, p.b_n + p.A @ change, ratios, sign, change, residual)


@lru_cache(maxsize=256)
def _list_choices(
    k: int, n: int, owner: tuple[int, ...], choice: tuple[int, ...] | None
) -> tuple[Array, Flags]:
    """One `choice` of modes, or all, of k contacts and n coordinates, with at most n conditions.

    Returns sliding signs of contacts and joints at rest, zero if sticking, (m, s), and masks of the
    forces with a condition, (m, k + s). Empty with more than `MAX_CHOICES` choices.
    """
    owners = np.array(owner, dtype=int)
    options: list[tuple[int, ...]]
    options = [
        (SEPARATED, STICKING, POSITIVE, NEGATIVE) if i in owner else (SEPARATED, STICKING)
        for i in range(k)
    ]
    options += [(STICKING, POSITIVE, NEGATIVE) for _ in range(owner.count(-1))]
    selected = [] if choice is None else [choice]
    if choice is None and math.prod(len(option) for option in options) <= MAX_CHOICES:
        selected = list(product(*options))
    choices = np.array(selected, dtype=int).reshape(len(selected), len(options))
    mode = np.empty((len(choices), len(owners)), dtype=int)
    mode[:, owners >= 0], mode[:, owners < 0] = choices[:, owners[owners >= 0]], choices[:, k:]
    active = np.hstack([choices[:, :k] != SEPARATED, mode == STICKING])
    mask = active.sum(axis=1) <= n
    return np.where(mode == POSITIVE, 1.0, np.where(mode == NEGATIVE, -1.0, 0.0))[mask], active[
        mask
    ]


def list_solutions(p: ContactProblem, choice: Sequence[int] | None = None) -> list[ContactSolution]:
    """Solutions with distinct rates, or only the one with modes `choice` of contacts, then joints.

    Enumeration of modes; empty with more than `MAX_CHOICES` of them.
    """
    modes = None if choice is None else tuple(choice)
    signs, active = _list_choices(len(p.b_n), len(p.inverse_mass), tuple(p.owner.tolist()), modes)
    s_n, s_t, K, q = p.scaled
    k = len(s_n)
    # Friction is proportional to c_n of a sliding contact, and constant in a turning joint.
    rows = (p.owner >= 0).nonzero()[0]
    owner, bound = p.owner[rows], signs * (p.bound / s_t)
    ratios, friction_rows = np.zeros((len(signs), len(q))), np.arange(len(q))
    ratios[:, owner] = p.mu[rows] * s_n[owner] / s_t[rows] * signs[:, rows]
    friction_rows[owner] = k + rows
    lhs, rhs = K - ratios[:, None, :] * K[:, friction_rows], bound @ K[:, k:].T - q
    # Forces without a condition are zero: rows of the unit matrix.
    lhs = np.where(active[:, :, None] & active[:, None, :], lhs, np.eye(len(q)))
    regular = np.abs(np.linalg.det(lhs)) > MIN_DETERMINANT
    forces = np.linalg.solve(lhs[regular], np.where(active, rhs, 0.0)[regular][:, :, None])[:, :, 0]
    forces[:, k:] -= bound[regular]
    forces[:, k + rows] -= ratios[regular][:, owner] * forces[:, owner]
    rates = q + forces @ K.T
    scale = float(np.abs(q).max(initial=0.0)) or 1.0
    slack = FRICTION_MARGIN * scale
    pair = forces[:, :k], rates[:, :k]
    valid = (np.minimum(*pair) >= -slack) & (np.abs(pair[0] * pair[1]) <= slack * scale)
    feasible = np.logical_and.reduce(valid, axis=1)
    forces, rates = forces[feasible], rates[feasible]
    limit = np.maximum(forces[:, :k] * s_n, 0.0)
    limit = np.hstack([limit, np.zeros((len(limit), 1))])[:, p.owner] * p.mu + p.bound
    f, r = forces[:, k:], rates[:, k:]
    margin = limit / s_t - np.abs(f)
    # Zero rate, or friction at its bound and opposite to the rate; zero friction has no sign.
    slides = (margin <= slack) & ((f * r <= 0) | (np.abs(f) <= slack))
    feasible = np.logical_and.reduce((margin >= -slack) & (slides | (np.abs(r) <= slack)), axis=1)
    distinct: list[int] = []
    for row in feasible.nonzero()[0].tolist():
        if all(np.abs(rates[row] - rates[j]).max() > RATE_TOLERANCE * scale for j in distinct):
            distinct.append(row)
    return [
        evaluate(p, np.maximum(s_n * forces[i, :k], 0.0), s_t * forces[i, k:]) for i in distinct
    ]


def solve_lcp(M: Array, q: Array) -> tuple[Array, float]:
    """Solve w = M z + q, z >= 0, w >= 0, z w = 0 by Lemke's method; M, (n, n), is scaled.

    Returns z, (n,), and the largest violation of these conditions, infinite on a ray.
    """
    n = len(q)
    if (q >= 0).all():
        return np.zeros(n), 0.0
    # Columns: the right-hand side, w, z and z_0.
    tableau = np.empty((n, 2 * n + 2))
    tableau[:, 0], tableau[:, 1 : n + 1] = q / float(np.abs(q).max()), np.eye(n)
    tableau[:, n + 1 : -1], tableau[:, -1] = -M, -1.0
    basis = np.arange(1, n + 1)
    row, entering = _select_row(tableau, np.arange(n), -np.ones(n)), 2 * n + 1
    for _ in range(60 * n):
        leaving = int(basis[row])
        tableau[row] /= tableau[row, entering]
        factors = tableau[:, entering].copy()
        factors[row] = 0.0
        tableau -= factors[:, None] * tableau[row]
        basis[row] = entering
        if leaving == 2 * n + 1:
            # Solve again with the original matrix.
            basic = basis[basis > n] - n - 1
            z = np.zeros(n)
            z[basic] = np.linalg.lstsq(M[np.ix_(basic, basic)], -q[basic], rcond=None)[0]
            w = M @ z + q
            residual = max(part.max(initial=0.0) for part in (np.abs(w[basic]), -z, -w))
            return np.maximum(z, 0.0), float(residual)
        entering = leaving + n if leaving <= n else leaving - n
        column = tableau[:, entering]
        # Smaller pivots are rounding errors of redundant rows.
        rows = (column > 1e-8).nonzero()[0]
        if not len(rows):
            break
        # Among ties the artificial unknown leaves first: it is the infeasibility.
        ratios = tableau[rows, 0] / column[rows]
        ties = rows[ratios <= ratios.min() + 1e-12]
        z_0 = ties[basis[ties] == 2 * n + 1]
        row = int(z_0[0]) if len(z_0) else _select_row(tableau, rows, column[rows])
    return np.full(n, np.nan), np.inf


def _select_row(tableau: Array, rows: Numbers, pivots: Array) -> int:
    """Pivot row by the lexicographic minimum ratio test among `rows`, (m,), with their pivots."""
    magnitudes = np.abs(pivots)
    ratios = tableau[rows, 0] / magnitudes
    tied = (ratios == ratios.min()).nonzero()[0]
    if len(tied) > 1:
        candidates = rows[tied]
        tie_ratios = tableau[candidates, 1 : len(tableau) + 1] / magnitudes[tied, None]
        return int(candidates[np.lexsort(tie_ratios.T[::-1])[0]])
    return int(rows[tied[0]])


class StepEnd(NamedTuple):
    """State at one end of a step."""

    motion: Array  # (3, n): z, z' and z''
    gaps: Array  # gaps, ranges (N,) [m]: of all pairs
    ranges: Array


class ClosedContacts:
    """Independent closed contacts, their sliding signs, and contacts and joints at rest."""

    def __init__(self, system: System, pairs: tuple[int, ...], rows: ContactRows, v: Array) -> None:
        self.system, self.pairs, self.rows, v_t = system, pairs, rows, rows.A_t @ v
        self.mu = system.friction[list(pairs)]
        frictional = self.mu > 0
        is_slow = np.abs(v_t) < ZERO_SPEED * system.scales.speed
        self.Xi = np.where(frictional & ~is_slow, np.sign(v_t), 0.0)
        self.static = (frictional & is_slow).nonzero()[0]
        is_slow = np.abs(v) < ZERO_SPEED * system.units[system.n :]
        self.sigma = np.where((system.dry > 0) & ~is_slow, np.sign(v), 0.0)
        self.joints = ((system.dry > 0) & is_slow).nonzero()[0]

    def impact_problem(self, v: Array) -> ContactProblem:
        """Contact problem of an impact at velocity v, (n,): any contact with friction may stick."""
        rows, frictional = self.rows, self.mu.nonzero()[0]
        T, mu = rows.A_t[frictional], self.mu[frictional]
        return ContactProblem(
            1 / self.system.mass, rows.A, rows.A, rows.A @ v, T, T @ v, frictional, mu, 0 * mu
        )

    def force_problem(self, a_free: Array, rows: ContactRows) -> ContactProblem:
        """Contact problem of accelerations; `a_free`, (n,): those without contact forces."""
        system, static, zeros = self.system, self.static, np.zeros(len(self.joints))
        G, b_n = rows.A - (self.mu * self.Xi)[:, None] * rows.A_t, rows.A @ a_free + rows.A_dot_v
        T = np.vstack([rows.A_t[static], np.eye(system.n)[self.joints]])
        b_t = T @ a_free + np.append(rows.A_t_dot_v[static], zeros)
        owner, mu = np.append(static, zeros - 1).astype(int), np.append(self.mu[static], zeros)
        bound = np.append(0 * self.mu[static], system.dry[self.joints])
        return ContactProblem(1 / system.mass, rows.A, G, b_n, T, b_t, owner, mu, bound)

    def encode(self, modes: Modes) -> list[int]:
        """Modes as the `choice` of `list_solutions`."""
        signs = dict(zip(modes.kept, modes.Xi, strict=True))
        static = set(self.static.tolist())
        choice = [
            MODE_OF_SIGN[signs[pair] if k in static else 0.0] if pair in signs else SEPARATED
            for k, pair in enumerate(self.pairs)
        ]
        return choice + [MODE_OF_SIGN[modes.sigma[joint]] for joint in self.joints]

    def make_modes(self, solution: ContactSolution, state: ContactRows) -> Modes:
        """Modes with independent constraints, of rows `state`, and the motion of a solution."""
        system, closed = self.system, self.pairs
        scale = max(float(np.abs(solution.r_n).max(initial=0.0)), system.scales.acceleration)
        r_max, loaded = 1e-3 * RATE_TOLERANCE * scale, solution.c_n > 0
        order = sorted(range(len(closed)), key=lambda k: -solution.c_n[k])
        add_row, root_mass = IndependentRows(MIN_SINE).add, np.sqrt(system.mass)
        A, A_t = state.A / root_mass, state.A_t / root_mass
        kept = {k for k in order if loaded[k] and add_row(A[k])}
        count, sticking, Xi, sigma = len(closed), list[int](), self.Xi.copy(), self.sigma.copy()
        sigma[self.joints] = solution.sign[len(self.static) :]
        rows, owners = np.vstack([A_t, np.eye(system.n)]), [*self.static, *(count + self.joints)]
        # Of contacts that stick together, such as a flush edge's, the largest ratio comes first.
        # Case: the least-time policy of the square, where mode selection does not end otherwise.
        for j in np.argsort(-solution.ratios, kind="stable").tolist():
            row, sign = int(owners[j]), solution.sign[j]
            if row in kept:
                Xi[row] = sign
            if sign == 0 and (row in kept or row >= count) and add_row(rows[row]):
                sticking.append(row)
        # Contacts without force that do not open remain closed.
        kept |= {k for k in order if not loaded[k] and solution.r_n[k] <= r_max and add_row(A[k])}
        order = sorted(kept)
        row_order = [*order, *range(count, count + system.n)]
        holders = tuple((row_order.index(row),) for row in sorted(sticking))
        signs = tuple(Xi[order].tolist()), tuple(sigma.tolist())
        return Modes(tuple(closed[k] for k in order), holders, *signs)


class FreeRun(Run):
    """A running simulation without prescribed contacts; other arguments are those of `Run`."""

    resting: bool  # whether all bodies are at rest
    unique: bool  # whether the present modes are known to be the only solution
    residual: float  # largest residual of a contact problem so far
    monitored: Flags  # (N,): pairs without contact forces
    closing_gaps: Array  # (N,) [m]: gaps at which touching pairs close
    step_start: StepEnd
    step_end: StepEnd
    shift = np.zeros(0)  # (m,): threshold of each event value below zero

    def __init__(
        self,
        system: System,
        *start: Any,
        restitution: float = 0.0,
        hint: Modes | None = None,
        **options: Any,
    ) -> None:
        super().__init__(system, *start, **options)
        self.restitution = restitution
        self.modes = hint or Modes(sigma=(0.0,) * system.n)
        self.unit = system.scales.length
        self.resting = self.unique = False

    def play(self, max_gap: float, halt: Callable[[FreeRun], bool] | None = None) -> Outcome:
        """Close gaps below `max_gap` [m]; simulate until `halt` at an event or the torques' end."""
        system, root_mass = self.system, np.sqrt(self.system.mass)
        for _ in range(5):
            # Project onto the closed contacts, in the metric M.
            gaps, ranges = system.measure_at(self.z)
            pairs = np.flatnonzero((np.abs(gaps) < max_gap) & (ranges > -max_gap)).tolist()
            if np.abs(gaps[pairs]).max(initial=0.0) < 1e-15 * system.scales.length:
                break
            rows = system.evaluate(self.z, self.v, pairs).A / root_mass
            self.y[: system.n] -= np.linalg.lstsq(rows, gaps[pairs], rcond=1e-9)[0] / root_mass
        while self.t < self.breaks[-1] and not (halt is not None and halt(self)):
            if self.t >= self.stop:
                self.next_piece()
            closed = self._resolve_impacts()
            was_moving = not self.is_at_rest
            at_rest = self._select_modes(closed)
            if was_moving and self.is_at_rest:
                at_rest = self._select_modes(self._find_closed())
            if not self.makes_progress():
                names = " ".join(self.system.names[pair] for pair in closed.pairs)
                return self._give_up(f"decisions on {names or 'joints'} do not end")
            failure = "no motion obeys the laws of contact" if at_rest is None else ""
            self.resting = self.resting if at_rest is None else at_rest
            if at_rest:
                self.set_velocity(0.0)
                self._wait_at_rest()
            elif not failure:
                try:
                    self.move()
                except StuckError:
                    # Forces grow without bound if the motion jams.
                    failure = "steps become too short"
            if failure and not self._apply_frictional_impulse():
                return self._give_up(failure)
        return Outcome(OutcomeKind.ENDED, f"the simulation ends at t = {self.t:.5g} s")

    def _give_up(self, failure: str) -> Outcome:
        if not self.records:
            self.record(still=True)
        return Outcome(OutcomeKind.GIVEN_UP, self.note(EventKind.GIVEN_UP, failure))

    # Events: impacts and modes.

    @property
    def chatter_speed(self) -> float:
        """Impact speed at and below which a contact stays closed [m/s].

        Impacts between three bodies may not end. The speed rises tenfold after 20 and 40 impacts in
        a short time, and after every 200. Case: scene 37 of seed 5 of the stress study, with finger
        1 reversed from half time on.
        """
        start = self.t - 3e-4 * self.system.scales.time
        latest = takewhile(lambda event: event.time >= start, reversed(self.events))
        count = sum(event.kind is EventKind.IMPACT for event in latest)
        # Not below the errors of steps.
        min_speed = max(CHATTER_SPEED, 1e3 * self.tolerance)
        exponent = min(count // 20, 2) + count // 200
        return min_speed * self.system.scales.speed * 10.0**exponent

    def _is_still(self, acceleration: Array) -> bool:
        return self.system.is_slower(acceleration * self.system.scales.time, ZERO_ACCEL)

    def _find_facing(self, z: Array, v: Array) -> tuple[Array, Flags]:
        """Gaps of all pairs at a state [m], and whether they are in range, shape (N,) each."""
        scales = self.system.scales
        gaps, ranges = self.system.measure_at(z)
        tolerance = CLOSED_GAP * scales.length
        faces = ranges > tolerance
        edge = (ranges > -tolerance) & ~faces
        if np.count_nonzero(edge):
            faces |= edge & (self.system.measure_at(z + EVENT_DELAY * scales.time * v)[1] >= ranges)
        return gaps, faces

    def _find_closed(self) -> ClosedContacts:
        system, unit = self.system, self.system.scales.length
        gaps, faces = self._find_facing(self.z, self.v)
        is_touching = (gaps < CLOSED_GAP * unit) & (gaps > -MAX_OVERLAP * unit) & faces
        touching: list[int] = is_touching.nonzero()[0].tolist()
        rows = system.evaluate(self.z, self.v, touching)
        is_slow = (rows.A @ self.v < self.chatter_speed).tolist()
        unit_rows = rows.A / np.sqrt(system.mass)
        unit_rows /= np.sqrt((unit_rows**2).sum(axis=1))[:, None]
        independent = (np.abs(unit_rows[:, None] - unit_rows).max(axis=2) > MIN_SINE).tolist()
        chosen: list[int] = []
        for k in sorted(range(len(touching)), key=lambda k: touching[k] not in self.modes.kept):
            if is_slow[k] and all(independent[k][j] for j in chosen):
                chosen.append(k)
        chosen.sort()
        pairs = tuple(touching[k] for k in chosen)
        rows = ContactRows(*(part[chosen] for part in rows))
        return ClosedContacts(system, pairs, rows, self.v)

    def _resolve_impacts(self) -> ClosedContacts:
        """Compute impacts until no closed gap closes further; returns the closed contacts."""
        tolerance = ZERO_SPEED * self.system.scales.speed
        # After 30 impacts at one instant the last one is plastic.
        for count in range(31):
            closed = self._find_closed()
            rates = closed.rows.A @ self.v
            if not (rates < -tolerance).any():
                return closed
            self._apply_impact(closed, rates, -rates.min() > self.chatter_speed and count < 30)
        return self._find_closed()

    def _apply_impact(self, closed: ClosedContacts, rates: Array, rebounds: bool) -> None:
        solution = solve_problem(closed.impact_problem(self.v))
        if solution is None:
            raise ArithmeticError("the plastic impact has no solution")
        self.residual = max(self.residual, solution.residual)
        mass, v = self.system.mass, self.v + solution.change
        if rebounds and self.restitution:
            # Poisson's restitution, unless it adds energy.
            impulse = self.restitution * solution.c_n
            v_normal = v + closed.rows.A.T @ impulse / mass
            problem = closed.impact_problem(v_normal)
            expansion = solve_problem(replace(problem, bound=problem.mu * impulse[problem.owner]))
            v_rebound = v if expansion is None else v_normal + expansion.change
            v = v_rebound if v_rebound**2 @ mass <= self.v**2 @ mass * (1 + 1e-12) else v
        interval = 1e-3 * self.system.scales.time
        for k, pair in enumerate(closed.pairs):
            if rates[k] >= -ZERO_SPEED * self.system.scales.speed or solution.c_n[k] <= 0:
                continue
            name, text = self.system.names[pair], self.system.structure.pairs[pair].text
            kind, note = EventKind.CHATTER, f"the impacts of {name} come ever closer and are over"
            if rebounds:
                kind, note = EventKind.IMPACT, f"{text or name} at {-rates[k]:.4g} m/s"
            # Chatter of a contact is noted once per interval.
            earlier = (e for e in self.events if e.kind is kind and e.contact == name)
            if rebounds or all(self.t - e.time >= interval for e in earlier):
                self.note(kind, note, name, float(-rates[k]))
        self.set_velocity(v)

    def _apply_frictional_impulse(self) -> bool:
        """Apply an impact without collision (Painleve paradox); returns whether there is one."""
        system = self.system
        closed = self._find_closed()
        a = system.sum_forces(self.v, self.tau(self.t), closed.sigma) / system.mass
        impact = solve_problem(closed.impact_problem(self.v + EVENT_DELAY * system.scales.time * a))
        if impact is None:
            return False
        # The same impact without the delay, in the modes of its solution.
        problem = closed.impact_problem(self.v)
        solutions = list_solutions(problem, problem.find_choice(impact))
        if not solutions or system.is_slower(solutions[0].change, ZERO_SPEED):
            return False
        names = " ".join(system.names[pair] for pair in closed.pairs)
        text = f"no finite forces keep {names} closed: an impact without a collision"
        self.note(EventKind.INCONSISTENT, text, names)
        self.set_velocity(self.v + solutions[0].change)
        return True

    def _select_modes(self, closed: ClosedContacts) -> bool | None:
        """Set the contact modes; returns whether all is at rest, None without consistent modes."""
        system, inverse_mass = self.system, 1 / self.system.mass
        if (np.abs(closed.rows.A @ self.v) > ZERO_SPEED * system.scales.speed).any():
            # Closed contacts that open more slowly than `chatter_speed` remain closed.
            pairs, rows = closed.pairs, closed.rows
            is_slow = np.abs(rows.A_t @ self.v) < self.chatter_speed
            is_slow &= closed.mu > 0
            self.project_velocity(np.vstack([rows.A, rows.A_t[is_slow]]))
            rows = system.evaluate(self.z, self.v, pairs)
            closed = ClosedContacts(system, pairs, rows, self.v)
        delay, least_delay = EVENT_DELAY * system.scales.time, ROUNDING_FORCE * system.scales.time
        a_free = inverse_mass * system.sum_forces(self.v, self.tau(self.t), closed.sigma)
        problem = closed.force_problem(a_free, closed.rows)
        present = self._solve(problem, closed.encode(self.modes))
        if present is None:
            return None
        acceleration = a_free + present.change
        while True:
            v = self.v + delay * acceleration
            rows = system.evaluate(self.z + delay * (self.v + v) / 2, v, closed.pairs)
            a_later = inverse_mass * system.sum_forces(v, self.tau(self.t + delay), closed.sigma)
            solution = self._select(closed, closed.force_problem(a_later, rows), a_later, present)
            if solution is None:
                return None
            # Trends decide only between modes that are consistent at present. Torques may ramp
            # within the delay: in 4 ns for a light hexagon under a rate limit.
            choice = problem.find_choice(solution)
            is_present = choice == problem.find_choice(present)
            if is_present or delay < least_delay or list_solutions(problem, choice):
                break
            delay /= 10
        # At rest the last modes may be left by rounding, for others that are also at rest.
        is_still = self.resting or self._is_still(acceleration)
        at_rest = self.is_at_rest and is_still and self._is_still(a_later + solution.change)
        modes = closed.make_modes(solution, rows)
        self._note_changes(closed.pairs, modes, at_rest)
        self.modes = modes
        # Remove rounding errors of zero speeds.
        kept = [k for k, pair in enumerate(closed.pairs) if pair in modes.kept]
        joints = np.eye(system.n)[closed.joints]
        stationary_rows = [closed.rows.A[kept], closed.rows.A_t[closed.static], joints]
        self.project_velocity(np.vstack(stationary_rows))
        return at_rest

    def _solve(self, problem: ContactProblem, *choices: Sequence[int]) -> ContactSolution | None:
        """Solution in the first consistent one of some mode choices, or another one."""
        for choice in choices:
            if solutions := list_solutions(problem, choice):
                return solutions[0]
        solution = solve_problem(problem)
        if solution is None:
            return next(iter(list_solutions(problem)), None)
        self.residual = max(self.residual, solution.residual)
        return solution

    def _select(
        self, closed: ClosedContacts, problem: ContactProblem, a_free: Array, guess: ContactSolution
    ) -> ContactSolution | None:
        """Solution with the fewest mode changes; rest continues if possible.

        `a_free`, (n,): accelerations without contact forces; `guess`: solution a little earlier.
        """
        last = closed.encode(self.modes)
        # The solution is unique if all contacts slide and K + K^T is positive definite.
        K = problem.scaled[2]
        slip = not len(problem.b_t)
        self.unique = slip and bool(np.linalg.eigvalsh(K + K.T).min(initial=1.0) > MIN_DETERMINANT)
        solutions = [] if self.unique else list_solutions(problem)
        if len(solutions) > 1:
            choices = [problem.find_choice(solution) for solution in solutions]
            if self.modes.kept or len(problem.b_n):
                self._note_ambiguity(closed, choices)
            moves = [self.resting and not self._is_still(a_free + a.change) for a in solutions]
            count = [sum(a != b for a, b in zip(choice, last, strict=True)) for choice in choices]
            return solutions[min(range(len(solutions)), key=lambda k: (moves[k], count[k]))]
        candidates = last, problem.find_choice(guess)
        if solutions and problem.find_choice(solutions[0]) in candidates:
            return solutions[0]
        return self._solve(problem, *candidates)

    def _note_changes(self, closed: Sequence[int], modes: Modes, at_rest: bool) -> None:
        if at_rest and self.resting:
            # Another distribution of forces at rest is no event.
            return
        system, previous = self.system, self.modes
        names = system.names
        lost = [pair for pair in previous.kept if pair not in modes.kept]
        gained = [pair for pair in modes.kept if pair not in previous.kept]
        tolerance = CLOSED_GAP * system.scales.length
        for pair in lost:
            gaps, ranges = system.measure_at(self.z)
            # A closed contact at the end of its range continues on a neighbouring feature.
            successors = [p for p in gained if names[p][-1:] == names[pair][-1:]]
            if successors and abs(gaps[pair]) < tolerance and ranges[pair] < tolerance:
                text = f"{names[pair]} goes on as {names[successors[0]]}"
                self.note(EventKind.PASS, text, names[successors[0]])
                gained.remove(successors[0])
            elif pair not in closed or self.records:
                self.note(EventKind.CONTACT_LOST, f"{names[pair]} is lost", names[pair])
        for pair in gained if self.records else ():
            self.note(EventKind.GAINED, f"{names[pair]} presses", names[pair])
        if not self.records:
            previous = modes
        old_signs = dict(zip(previous.kept, previous.Xi, strict=True))
        changes = [
            (names[pair], old_signs[pair], Xi, "slides")
            for pair, Xi in zip(modes.kept, modes.Xi, strict=True)
            if pair in old_signs and system.friction[pair] > 0
        ]
        joints = zip(previous.sigma, modes.sigma, strict=True)
        changes += [(_name(system, k), old, new, "turns") for k, (old, new) in enumerate(joints)]
        for name, old, now, verb in changes:
            if old != now:
                self.note(*describe_change(name, old, now, verb), name)
        if at_rest:
            self.note(EventKind.REST, "everything rests")
        elif self.resting:
            self.note(EventKind.START, "the motion begins")

    def _note_ambiguity(self, closed: ClosedContacts, choices: Sequence[Sequence[int]]) -> None:
        """Record that there are several solutions, once for each set of contacts."""
        names = [self.system.names[pair] for pair in closed.pairs]
        contact_texts = {
            SEPARATED: "parts",
            STICKING: "presses",
            POSITIVE: "slides +",
            NEGATIVE: "slides -",
        }
        joint_texts = {STICKING: "is held", POSITIVE: "turns +", NEGATIVE: "turns -"}
        labels = [(name, contact_texts) for name in names]
        for k in closed.static.tolist():
            labels[k] = names[k], contact_texts | {STICKING: "sticks"}
        labels += [(_name(self.system, joint), joint_texts) for joint in closed.joints.tolist()]
        differs = [len(set(modes)) > 1 for modes in zip(*choices, strict=True)]
        texts = []
        for choice in choices:
            modes = zip(labels, choice, differs, strict=True)
            parts = [f"{name} {words[mode]}" for (name, words), mode, other in modes if other]
            texts.append(", ".join(parts) or "the rest accelerates otherwise")
        text = f"{len(choices)} motions are possible with {', '.join(names) or 'no contact'} closed"
        text += f" ({'; or '.join(texts)})"
        earlier = [event for event in self.events if event.kind is EventKind.AMBIGUOUS]
        if not earlier or earlier[-1].text.split(" at t =")[0] != text:
            self.note(EventKind.AMBIGUOUS, text, " ".join(names))

    # Rest.

    def _wait_at_rest(self) -> None:
        """Advance time at rest until forces leave their bounds, or the torques end."""
        self.record(still=True)
        at_rest = True
        while True:
            breach = find_breach(self._list_margins(at_rest), self.fraction(self.t))
            at_rest = False
            self.wait(self.time(breach) if breach < 1 else self.stop)
            if breach < 1 or not self.next_piece():
                return

    def _list_margins(self, at_rest: bool) -> Array:
        """Scaled margins of rest, polynomials of x in [-1, 1] on the present piece, (m, d + 1).

        All are affine in the torques, and computed from the forces under three torques. If the
        object is known to be `at_rest`, present accelerations and violations count as rounding.
        """
        self.load(self.modes)
        s, torque, samples = self.s, self.s.inputs.torque, []
        for tau in np.vstack([np.zeros(2), self.system.scales.torque * np.eye(2)]):
            torque[:] = 0.0
            torque[:: self.torque.coefficients.shape[2]] = tau
            s.evaluate_state()
            rates = s.outputs.acceleration * self.system.scales.time
            margins = s.outputs.values[: s.rows.cone.stop]
            samples.append(np.concatenate([margins, rates / self.system.units[self.system.n :]]))
        slopes = np.array([part - samples[0] for part in samples[1:]]).T / self.system.scales.torque
        values = slopes @ self.torque.coefficients[self.piece]
        values[:, 0] += samples[0]
        count = s.rows.cone.stop
        margins, rates = values[:count], values[count:]
        rate_margins = np.vstack([-rates, rates])
        powers = self.fraction(self.t) ** np.arange(values.shape[1]) * at_rest
        # Contacts may be nearly dependent. Cases: two fingers that rest on each other; hexagon with
        # v0 below finger 2's joint.
        margins[:, 0] += np.maximum(ROUNDING_FORCE, -2 * margins @ powers)
        rate_margins[:, 0] += np.maximum(10 * ZERO_ACCEL, 2 * np.abs(rate_margins @ powers))
        return np.vstack([margins, rate_margins])

    # Motion.

    def move(self) -> None:
        """Integrate with the present modes until an event, or until the torques step or end."""
        self.load(self.modes)
        slices, self.kept = self.s.rows, list(self.modes.kept)
        self.monitored = ~np.isin(range(len(self.system.names)), self.kept)
        self.counts = [slices.cone.stop, slices.turn.stop - slices.cone.stop, len(self.kept)]
        self.slack = np.repeat([ROUNDING_FORCE, 1e-12, CLOSED_GAP], self.counts)
        self.evaluate_state()
        # Touching pairs may overlap by rounding; pairs with a larger overlap never close.
        gaps = self.step_end.gaps
        levels = np.minimum(gaps, 0.0) - 0.5 * CLOSED_GAP * self.unit
        self.closing_gaps = np.where(gaps > -MAX_OVERLAP * self.unit, levels, -np.inf)
        # Values may start below zero, as modes are selected a short time later.
        self.shift = np.maximum(self.slack, self.slack - self.values)
        is_near = self.monitored & (gaps <= MIN_GAP * self.unit) & (gaps > -CLOSED_GAP * self.unit)
        if is_near.any():
            # Half the time after which a pair that has just opened closes; slower ones are closed.
            rows = self.system.evaluate(self.z, self.v, is_near.nonzero()[0].tolist())
            rate, growth = rows.A @ self.v, rows.A @ self.s.outputs.acceleration + rows.A_dot_v
            closing = (rate >= self.chatter_speed) & (growth < 0)
            self.h = float((-rate[closing] / growth[closing]).min(initial=self.h))
        self.record()
        super().move()

    def begin_step(self) -> None:
        """Start the next step, of at most `MAX_STEP`, from the end of the last one."""
        super().begin_step()
        self.step_start = self.step_end
        self.shift = np.where(self.values > 0, self.slack, self.shift)
        _, speed, a = np.abs(self.step_end.motion / self.system.units[: self.system.n]).max(axis=1)
        end_speed = math.sqrt(speed**2 + 2 * a * MAX_STEP)
        self.longest = float(2 * MAX_STEP / (speed + end_speed + 1e-300))

    def measure(self) -> Array:
        """Event values of the steps, then ranges of kept pairs."""
        outputs = self.s.outputs
        motion = np.concatenate([outputs.y[: 2 * self.system.n], outputs.acceleration])
        motion = motion.reshape(3, self.system.n)
        self.step_end = StepEnd(motion, *self.system.measure_at(motion[0]))
        return np.concatenate([outputs.values, self.step_end.ranges[self.kept] / self.unit])

    def pass_break(self) -> bool | None:
        """Enter the next piece of the torques; True if they end or modes may change."""
        if not self.next_piece():
            return True
        if self.steps_at[self.piece]:
            self.evaluate_state()
            if not self._modes_persist():
                return True
            self.record()
        return None

    def _modes_persist(self) -> bool:
        """Whether the modes are the unique solution after a torque step, with clear margins."""
        modes, rows, state = self.s.modes, self.s.rows, self.step_end
        if not self.unique or modes.holders:
            return False
        min_values = np.repeat([10 * ROUNDING_FORCE, 1e-4, 10 * CLOSED_GAP], self.counts)
        # Zero signs have no speed that could reverse.
        signs = np.array([*self.modes.Xi, *self.modes.sigma])
        min_values[rows.slide.start : rows.turn.stop][signs == 0] = -1
        tolerance = CLOSED_GAP * self.unit
        touching = (np.abs(state.gaps) < tolerance) & (state.ranges > -tolerance) & self.monitored
        return bool((self.values > min_values).all()) and not touching.any()

    def find_closing(self, h: float, done: Sequence[int]) -> tuple[int, float] | None:
        """First pair in range that closes within the last step, not in `done`, and its time [s]."""
        n, excluded = self.system.n, [pair for pair in done if pair >= 0]
        while bracket := self._find_bracket(h, excluded):
            pair, level, left, right = bracket

            def value(step: float, pair: int = pair, level: float = level) -> float:
                self.step_to(step)
                return float(self.step_end.gaps[pair]) - level

            first = value(left) if left > 0 else float(self.step_start.gaps[pair]) - level
            last = value(right)
            if last >= 0 and right < h:
                # The interpolated bracket may be wrong for a grazing contact.
                right, last = h, value(h)
            if last < 0:
                # Tolerance: about ten rounding errors of the gap.
                root = find_root(value, left, right, (first, last), self.near, 1e-14 * self.unit)
                self.step_to(root)
                y = self.s.outputs.y
                if self._find_facing(y[:n], y[n : 2 * n])[1][pair]:
                    return pair, root
            excluded.append(pair)
            self.step_to(h)
        return None

    def _find_bracket(
        self, h: float, excluded: Sequence[int]
    ) -> tuple[int, float, float, float] | None:
        """First pair whose gap falls below a level, this level [m], and a bracket of the time."""
        unit, start, end = self.unit, self.step_start, self.step_end
        z, v, _ = np.abs(end.motion - start.motion)
        travel = float(((z + h * v) / self.system.units[: self.system.n]).max())
        count = 1 + int(GAP_SAMPLES * min(1.0, travel / MAX_STEP))
        times = h * np.arange(count + 1) / count
        samples = [start.gaps, end.gaps], [start.ranges, end.ranges]
        if count > 1:
            knots = tuple(np.stack([start.motion, end.motion], axis=1))
            first = np.zeros(count - 1, dtype=np.int64)
            z = interpolate_quintic(np.full(count - 1, h), times[1:-1], knots, first)[0]
            samples[0][1:1], samples[1][1:1] = self.system.measure(z)
        gaps, ranges = map(np.array, samples)
        # A pair that opens within the step may close again within it.
        separated = np.logical_or.accumulate(gaps[:-1] > MIN_GAP * unit, axis=0)
        level = np.where(separated, 0.0, self.closing_gaps)
        crosses = (gaps[1:] < level) & (gaps[:-1] >= level) & self.monitored
        crosses[:, excluded] = False
        crosses &= np.maximum(ranges[1:], ranges[:-1]) > -1e-3 * unit
        rows, pairs = crosses.nonzero()
        if len(rows):
            row, pair = int(rows[0]), int(pairs[0])
            return pair, float(level[row, pair]), *times[row : row + 2].tolist()
        # Otherwise the first pair that enters its range and overlaps; gaps out of range are void.
        enters = (ranges[1:] > 0) & (ranges[:-1] <= 0) & self.monitored
        enters &= (gaps[1:] < -CLOSED_GAP * unit) & (gaps[1:] > -MAX_STEP * unit)
        enters[:, excluded] = False
        for row, pair in zip(*(part.tolist() for part in enters.nonzero()), strict=True):
            left, right = times[row : row + 2].tolist()

            def outside(step: float, pair: int = pair) -> float:
                self.step_to(step)
                return -float(self.step_end.ranges[pair])

            # Time at which the pair comes into range.
            ends, entry = (-float(ranges[row, pair]), outside(right)), right
            if ends[1] < 0 <= ends[0]:
                tolerance = CLOSED_GAP * unit
                entry = find_root(outside, left, right, ends, self.near, tolerance)
            self.step_to(entry)
            gap = float(self.step_end.gaps[pair])
            if gap > -MAX_OVERLAP * unit:
                return pair, min(gap, 0.0) - 0.5 * CLOSED_GAP * unit, entry, right
            self.step_to(h)
        return None


def _name(system: System, joint: int) -> str:
    driven = system.structure.driven
    return f"joint {driven.index(joint) + 1}" if joint in driven else f"coordinate {joint + 1}"
