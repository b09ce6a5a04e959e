"""Motion with contacts from complementarity problems: events, contact modes, impacts.

At every event the contact modes are the solution of a contact problem that changes the fewest
modes (Stewart and Trinkle, "An implicit time-stepping scheme for rigid body dynamics with inelastic
collisions and Coulomb friction", 1996; exact in the plane). With the forces c_n >= 0 of contacts
and f of everything that stands still and may stick (contacts and joints), rates r = (r_n, r_t)
follow linearly,

    r_n = b_n + A M^-1 (G^T c_n + T^T f),      r_t = b_t + T M^-1 (G^T c_n + T^T f),

and have to keep r_n >= 0 and c_n r_n = 0, abs(f) <= bound, and f opposite to r_t and at its bound
wherever r_t is not zero. The bound is mu c_n of a contact and D of a joint. Rates are accelerations
while forces act, and velocities in an impact. A contact that slides already has its friction in
G = A - mu Xi A_t. Splitting f into its parts of either sign makes the problem linear.

Problems are evaluated a short time later, at the state that present accelerations lead to: a
force's trend counts. The last modes are tried first, then Lemke's method.
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
from .system import ROUNDING_FORCE, SETTLING, STANDING, STILL, ContactRows, Modes, System

EDGE = 1e-9  # reserve of friction that counts as none, relative to its bound or the largest force
SAME = 1e-6  # difference of rates that is none, over the largest rate without contacts
SINGULAR = 1e-9  # determinant of a scaled system that counts as zero
MOST = 600  # most choices of modes that are enumerated: all of one to three contacts and two joints
APART, STICKS, FORTH, BACK = range(4)
"""Modes of a contact; of a joint all but the first. One without friction that presses sticks."""
MODES = {0.0: STICKS, 1.0: FORTH, -1.0: BACK}  # by sliding sign
CLOSED = 1e-10  # gap that counts as closed at an event, relative to the scene's length
SUNK = 1e-6  # overlap up to which features touch, over the scene's length; else they are behind
CHATTER = 1e-6  # speed of the last impact, over the scene's: separation stays below rounding
DEPENDENT = 1e-7  # share of a row that others leave, below which it is no constraint of its own
ARMED = 1e-13  # gap from which on a pair has been apart, relative to the scene's length
LOOKS = 8  # instants of the longest step at which gaps are looked at, its end among them
REACH = 0.3  # longest step, in units of the scene: gaps are sampled every `REACH` / `LOOKS`


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """k contacts, s of whatever stands still and may stick, n coordinates."""

    lift: Array  # (n,): diagonal of M^-1
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
        """Units of forces that make the diagonal one, the matrix in them, and the rates without."""
        rows, pushes = (np.concatenate([part, self.T]) for part in (self.A, self.G))
        lifted, k = rows * self.lift, len(self.b_n)
        units = 1 / np.sqrt((lifted * rows).sum(axis=1))
        K = (lifted @ pushes.T) * (units[:, None] * units)
        return units[:k], units[k:], K, units * np.concatenate([self.b_n, self.b_t])

    def describe(self, answer: ContactAnswer) -> list[int]:
        """Modes of an answer as `list_answers` has them."""
        choice = [STICKS if c > 0 else APART for c in answer.c_n]
        for owner, sign in zip(self.owner.tolist(), answer.sign.tolist(), strict=True):
            if owner < 0:
                choice.append(MODES[sign])
            elif choice[owner] != APART:
                choice[owner] = MODES[sign]
        return choice


class ContactAnswer(NamedTuple):
    """One solution."""

    c_n: Array  # (k,)
    f: Array  # (s,)
    r_n: Array  # (k,)
    shares: Array  # (s,): friction over the most that it may be
    sign: Array  # (s,): sliding sign where friction is at its bound, 0 where it holds
    change: Array  # (n,): M^-1 (G^T c_n + T^T f)
    residual: float  # over the largest rate without contacts, 1e-8 at most


def solve_problem(p: ContactProblem) -> ContactAnswer | None:
    """One solution by Lemke's method, or none."""
    s_n, s_t, K, q = p.scaled
    k, s = len(s_n), len(s_t)
    held = (p.owner >= 0).nonzero()[0]
    # Unknowns are c_n, both parts of f, and how fast each of them gives way.
    M, plus, minus = np.zeros((k + 3 * s, k + 3 * s)), k + s, k + 2 * s
    M[:plus, :plus] = K
    M[:plus, plus:minus] = -K[:, k:]
    M[plus:minus, :minus] = -M[k:plus, :minus]
    i = np.arange(s)
    M[k + i, minus + i] = M[plus + i, minus + i] = 1.0
    M[minus + i, k + i] = M[minus + i, plus + i] = -1.0
    M[minus + held, p.owner[held]] = p.mu[held] * s_n[p.owner[held]] / s_t[held]
    z, residual = solve_lcp(M, np.concatenate([q, -q[k:], p.bound / s_t]))
    size = float(np.abs(q).max(initial=0.0)) or 1.0
    if not residual <= 1e-8 * max(size, float((p.bound / s_t).max(initial=0.0))):
        return None
    return complete(p, s_n * z[:k], s_t * (z[k:plus] - z[plus:minus]), residual / size)


def complete(problem: ContactProblem, c_n: Array, f: Array, residual: float = 0.0) -> ContactAnswer:
    """Rates, signs and friction shares that forces give."""
    p = problem
    change, size = p.lift * (c_n @ p.G + f @ p.T), np.abs(f)
    most = p.bound + p.mu * np.append(c_n, 0.0)[p.owner]
    # Friction whose bound is zero by c_n has no margin in either direction.
    edge = most - size <= EDGE * np.maximum(most, 1e-3 * size.max(initial=0.0))
    slides = np.where(f != 0, -f, p.b_t + p.T @ change)
    sign, shares = np.where(edge, np.sign(slides), 0.0), size / np.maximum(most, 1e-300)
    return ContactAnswer(c_n, f, p.b_n + p.A @ change, shares, sign, change, residual)


@lru_cache(maxsize=256)
def _combine(
    k: int, n: int, owner: tuple[int, ...], choice: tuple[int, ...] | None
) -> tuple[Array, Flags]:
    """One choice of modes of k contacts and n coordinates, or all, with up to n conditions.

    Returns which way what may stick gives way, 0 where it does not, (m, s), and which forces are
    for a condition, (m, k + s). All choices are none if they are too many.
    """
    owners = np.array(owner, dtype=int)
    options: list[tuple[int, ...]]
    options = [(APART, STICKS, FORTH, BACK) if i in owner else (APART, STICKS) for i in range(k)]
    options += [(STICKS, FORTH, BACK) for _ in range(owner.count(-1))]
    every = [] if choice is None else [choice]
    if choice is None and math.prod(len(option) for option in options) <= MOST:
        every = list(product(*options))
    choices = np.array(every, dtype=int).reshape(len(every), len(options))
    modes = np.empty((len(choices), len(owners)), dtype=int)
    modes[:, owners >= 0], modes[:, owners < 0] = choices[:, owners[owners >= 0]], choices[:, k:]
    active = np.hstack([choices[:, :k] != APART, modes == STICKS])
    sound = active.sum(axis=1) <= n
    return np.where(modes == FORTH, 1.0, np.where(modes == BACK, -1.0, 0.0))[sound], active[sound]


def list_answers(p: ContactProblem, choice: Sequence[int] | None = None) -> list[ContactAnswer]:
    """All solutions with distinct rates, or that with the modes `choice` of contacts, then joints.

    Enumerates modes; none are listed where these are more than `MOST`.
    """
    modes = None if choice is None else tuple(choice)
    ways, active = _combine(len(p.b_n), len(p.lift), tuple(p.owner.tolist()), modes)
    s_n, s_t, K, q = p.scaled
    k = len(s_n)
    # A contact that slides brings its friction with it, what turns has a given one.
    held = (p.owner >= 0).nonzero()[0]
    owner, bound = p.owner[held], ways * (p.bound / s_t)
    rubs, partner = np.zeros((len(ways), len(q))), np.arange(len(q))
    rubs[:, owner] = p.mu[held] * s_n[owner] / s_t[held] * ways[:, held]
    partner[owner] = k + held
    left, right = K - rubs[:, None, :] * K[:, partner], bound @ K[:, k:].T - q
    # Forces without a condition are zero, by rows of the unit matrix.
    left = np.where(active[:, :, None] & active[:, None, :], left, np.eye(len(q)))
    sound = np.abs(np.linalg.det(left)) > SINGULAR
    forces = np.linalg.solve(left[sound], np.where(active, right, 0.0)[sound][:, :, None])[:, :, 0]
    forces[:, k:] -= bound[sound]
    forces[:, k + held] -= rubs[sound][:, owner] * forces[:, owner]
    rates = q + forces @ K.T
    size = float(np.abs(q).max(initial=0.0)) or 1.0
    slack = EDGE * size
    pair = forces[:, :k], rates[:, :k]
    obeys = (np.minimum(*pair) >= -slack) & (np.abs(pair[0] * pair[1]) <= slack * size)
    fine = np.logical_and.reduce(obeys, axis=1)
    forces, rates = forces[fine], rates[fine]
    most = np.maximum(forces[:, :k] * s_n, 0.0)
    most = np.hstack([most, np.zeros((len(most), 1))])[:, p.owner] * p.mu + p.bound
    f, r = forces[:, k:], rates[:, k:]
    spare = most / s_t - np.abs(f)
    # Friction holds, or it is at its bound and opposes; none that slides without a force errs.
    opposes = (spare <= slack) & ((f * r <= 0) | (np.abs(f) <= slack))
    fine = np.logical_and.reduce((spare >= -slack) & (opposes | (np.abs(r) <= slack)), axis=1)
    distinct: list[int] = []
    for row in fine.nonzero()[0].tolist():
        if all(np.abs(rates[row] - rates[other]).max() > SAME * size for other in distinct):
            distinct.append(row)
    return [
        complete(p, np.maximum(s_n * forces[i, :k], 0.0), s_t * forces[i, k:]) for i in distinct
    ]


def solve_lcp(M: Array, q: Array) -> tuple[Array, float]:
    """Solve w = M z + q, z >= 0, w >= 0, z w = 0 by Lemke's method; M (n, n) is near one.

    Complementary pivoting until the artificial unknown z_0 leaves the basis. Returns z, (n,), and
    the largest violation of these conditions, infinite on a ray.
    """
    n = len(q)
    if (q >= 0).all():
        return np.zeros(n), 0.0
    # Columns: the right-hand side, w, z and z_0.
    table = np.empty((n, 2 * n + 2))
    table[:, 0], table[:, 1 : n + 1] = q / float(np.abs(q).max()), np.eye(n)
    table[:, n + 1 : -1], table[:, -1] = -M, -1.0
    basis = np.arange(1, n + 1)
    row, entering = _choose(table, np.arange(n), -np.ones(n)), 2 * n + 1
    for _ in range(60 * n):
        leaving = int(basis[row])
        table[row] /= table[row, entering]
        factors = table[:, entering].copy()
        factors[row] = 0.0
        table -= factors[:, None] * table[row]
        basis[row] = entering
        if leaving == 2 * n + 1:
            # From the original matrix.
            chosen = basis[basis > n] - n - 1
            z = np.zeros(n)
            z[chosen] = np.linalg.lstsq(M[np.ix_(chosen, chosen)], -q[chosen], rcond=None)[0]
            w = M @ z + q
            residual = max(part.max(initial=0.0) for part in (np.abs(w[chosen]), -z, -w))
            return np.maximum(z, 0.0), float(residual)
        entering = leaving + n if leaving <= n else leaving - n
        column = table[:, entering]
        # Smaller pivots are rounding of redundant rows.
        rising = (column > 1e-8).nonzero()[0]
        if not len(rising):
            break
        # The artificial unknown goes as soon as it may: its level is what is missing.
        ratios = table[rising, 0] / column[rising]
        low = rising[ratios <= ratios.min() + 1e-12]
        last = low[basis[low] == 2 * n + 1]
        row = int(last[0]) if len(last) else _choose(table, rising, column[rising])
    return np.full(n, np.nan), np.inf


def _choose(table: Array, rows: Numbers, pivots: Array) -> int:
    """Row of the lexicographically least ratio to its pivot; first, of what falls most."""
    sizes = np.abs(pivots)
    ratios = table[rows, 0] / sizes
    least = (ratios == ratios.min()).nonzero()[0]
    if len(least) > 1:
        chosen = rows[least]
        ties = table[chosen, 1 : len(table) + 1] / sizes[least, None]
        return int(chosen[np.lexsort(ties.T[::-1])[0]])
    return int(rows[least[0]])


class StepEnd(NamedTuple):
    """One end of a step."""

    motion: Array  # (3, n): z, z' and z''
    gaps: Array  # gaps, ranges (N,) [m]: of all pairs
    ranges: Array


class ClosedContacts:
    """Pairs that touch and do not part, each constraint once; sliding signs, and what stands."""

    def __init__(self, system: System, pairs: tuple[int, ...], rows: ContactRows, v: Array) -> None:
        self.system, self.pairs, self.rows, v_t = system, pairs, rows, rows.A_t @ v
        self.mu = system.friction[list(pairs)]
        rubs = self.mu > 0
        slow = np.abs(v_t) < STANDING * system.scales.speed
        self.Xi = np.where(rubs & ~slow, np.sign(v_t), 0.0)
        self.standing = (rubs & slow).nonzero()[0]
        slow = np.abs(v) < STANDING * system.units[system.n :]
        self.sigma = np.where((system.dry > 0) & ~slow, np.sign(v), 0.0)
        self.joints = ((system.dry > 0) & slow).nonzero()[0]

    def pose_impact(self, v: Array) -> ContactProblem:
        """Contact problem of velocities: whatever has friction may stick."""
        at, rubs = self.rows, self.mu.nonzero()[0]
        T, mu = at.A_t[rubs], self.mu[rubs]
        return ContactProblem(
            1 / self.system.mass, at.A, at.A, at.A @ v, T, T @ v, rubs, mu, 0 * mu
        )

    def pose(self, free: Array, rows: ContactRows) -> ContactProblem:
        """Contact problem of rows, from accelerations without contacts, `free` (n,)."""
        system, standing, none = self.system, self.standing, np.zeros(len(self.joints))
        G, b_n = rows.A - (self.mu * self.Xi)[:, None] * rows.A_t, rows.A @ free + rows.bend
        T = np.vstack([rows.A_t[standing], np.eye(system.n)[self.joints]])
        b_t = T @ free + np.append(rows.bend_t[standing], none)
        owner, mu = np.append(standing, none - 1).astype(int), np.append(self.mu[standing], none)
        bound = np.append(0 * self.mu[standing], system.dry[self.joints])
        return ContactProblem(1 / system.mass, rows.A, G, b_n, T, b_t, owner, mu, bound)

    def recall(self, modes: Modes) -> list[int]:
        """Modes as `list_answers` has them."""
        signs = dict(zip(modes.kept, modes.Xi, strict=True))
        standing = set(self.standing.tolist())
        choice = [
            MODES[signs[pair] if k in standing else 0.0] if pair in signs else APART
            for k, pair in enumerate(self.pairs)
        ]
        return choice + [MODES[modes.sigma[joint]] for joint in self.joints]

    def make_modes(self, answer: ContactAnswer, at: ContactRows) -> Modes:
        """Independent constraints, of rows `at` a state, that give the answer's motion."""
        system, closed = self.system, self.pairs
        size = max(float(np.abs(answer.r_n).max(initial=0.0)), system.scales.acceleration)
        still, presses = 1e-3 * SAME * size, answer.c_n > 0
        order = sorted(range(len(closed)), key=lambda k: -answer.c_n[k])
        adds, root = IndependentRows(DEPENDENT).add, np.sqrt(system.mass)
        A, A_t = at.A / root, at.A_t / root
        kept = {k for k in order if presses[k] and adds(A[k])}
        count, held, Xi, sigma = len(closed), list[int](), self.Xi.copy(), self.sigma.copy()
        sigma[self.joints] = answer.sign[len(self.standing) :]
        rows, places = np.vstack([A_t, np.eye(system.n)]), [*self.standing, *(count + self.joints)]
        # Of what sticks as one, as the contacts of a flush edge do, what has to hold comes first:
        # decisions in the least-time policy of the square do not end else.
        for j in np.argsort(-answer.shares, kind="stable").tolist():
            row, sign = int(places[j]), answer.sign[j]
            if row in kept:
                Xi[row] = sign
            if sign == 0 and (row in kept or row >= count) and adds(rows[row]):
                held.append(row)
        # What touches without a force stays, for as long as it needs none.
        kept |= {k for k in order if not presses[k] and answer.r_n[k] <= still and adds(A[k])}
        order = sorted(kept)
        below = [*order, *range(count, count + system.n)]
        holders = tuple((below.index(row),) for row in sorted(held))
        signs = tuple(Xi[order].tolist()), tuple(sigma.tolist())
        return Modes(tuple(closed[k] for k in order), holders, *signs)


class FreeRun(Run):
    """A running simulation without prescribed contacts; other arguments are those of `Run`."""

    resting: bool  # whether everything rests
    unique: bool  # whether the present modes were certainly the only solution
    residual: float  # largest residual of a contact problem so far
    watched: Flags  # (N,): which pairs do not press
    level: Array  # (N,) [m]: gap at which a pair that touches closes
    before: StepEnd
    after: StepEnd
    shift = np.zeros(0)  # (m,): how far below zero each event value has to fall

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

    def play(self, touching: float, halt: Callable[[FreeRun], bool] | None = None) -> Outcome:
        """Simulate until the torques end or `halt`, called at events; how that ends.

        `touching` are gaps to close at the start [m].
        """
        system, root = self.system, np.sqrt(self.system.mass)
        for _ in range(5):
            # Project onto what touches, in the metric of masses.
            gaps, ranges = system.look(self.z)
            near = np.flatnonzero((np.abs(gaps) < touching) & (ranges > -touching)).tolist()
            if np.abs(gaps[near]).max(initial=0.0) < 1e-15 * system.scales.length:
                break
            rows = system.evaluate(self.z, self.v, near).A / root
            self.y[: system.n] -= np.linalg.lstsq(rows, gaps[near], rcond=1e-9)[0] / root
        while self.t < self.breaks[-1] and not (halt is not None and halt(self)):
            if self.t >= self.stop:
                self.next_piece()
            closed = self._collide()
            moved = not self.stands
            rests = self._decide(closed)
            if moved and self.stands:
                rests = self._decide(self._find_closed())
            if not self.gets_on():
                names = " ".join(self.system.names[pair] for pair in closed.pairs)
                return self._give_up(f"decisions on {names or 'joints'} do not end")
            failure = "no motion obeys the laws of contact" if rests is None else ""
            self.resting = self.resting if rests is None else rests
            if rests:
                self.set_velocity(0.0)
                self._hold()
            elif not failure:
                try:
                    self.move()
                except StuckError:
                    # Forces grow without bound where the motion jams.
                    failure = "steps become too short"
            if failure and not self._jolt():
                return self._give_up(failure)
        return Outcome(OutcomeKind.ENDED, f"the simulation ends at t = {self.t:.5g} s")

    def _give_up(self, failure: str) -> Outcome:
        if not self.records:
            self.record(still=True)
        return Outcome(OutcomeKind.GIVEN_UP, self.note(EventKind.GIVEN_UP, failure))

    # Instants: impacts and modes.

    @property
    def chatter(self) -> float:
        """Speed of impacts that count as the last one [m/s].

        Fingers may knock an object to and fro for ever, or be knocked so between two bodies: it
        rises tenfold after 20 and after 40 impacts in a short time, and after every 200: scene 37
        of seed 5 of the stress study does not end else, with finger 1 reversed from half time on.
        """
        since = self.t - 3e-4 * self.system.scales.time
        late = takewhile(lambda event: event.time >= since, reversed(self.events))
        recent = sum(event.kind is EventKind.IMPACT for event in late)
        # Impacts need no finer steps than these.
        least = max(CHATTER, 1e3 * self.tolerance)
        raised = min(recent // 20, 2) + recent // 200
        return least * self.system.scales.speed * 10.0**raised

    def _is_still(self, acceleration: Array) -> bool:
        return self.system.is_slower(acceleration * self.system.scales.time, STILL)

    def _face(self, z: Array, v: Array) -> tuple[Array, Flags]:
        """Gaps of all pairs at a state, and which of them face each other, shape (N,) each."""
        scales = self.system.scales
        gaps, ranges = self.system.look(z)
        near = CLOSED * scales.length
        faces = ranges > near
        at_end = (ranges > -near) & ~faces
        if np.count_nonzero(at_end):
            faces |= at_end & (self.system.look(z + SETTLING * scales.time * v)[1] >= ranges)
        return gaps, faces

    def _find_closed(self) -> ClosedContacts:
        system, unit = self.system, self.system.scales.length
        gaps, faces = self._face(self.z, self.v)
        near = (gaps < CLOSED * unit) & (gaps > -SUNK * unit) & faces
        touching: list[int] = near.nonzero()[0].tolist()
        rows = system.evaluate(self.z, self.v, touching)
        slow = (rows.A @ self.v < self.chatter).tolist()
        lines = rows.A / np.sqrt(system.mass)
        lines /= np.sqrt((lines**2).sum(axis=1))[:, None]
        independent = (np.abs(lines[:, None] - lines).max(axis=2) > DEPENDENT).tolist()
        chosen: list[int] = []
        for k in sorted(range(len(touching)), key=lambda k: touching[k] not in self.modes.kept):
            if slow[k] and all(independent[k][j] for j in chosen):
                chosen.append(k)
        chosen.sort()
        pairs = tuple(touching[k] for k in chosen)
        rows = ContactRows(*(part[chosen] for part in rows))
        return ClosedContacts(system, pairs, rows, self.v)

    def _collide(self) -> ClosedContacts:
        """Resolve impacts until no closed gap closes further; what is closed then."""
        limit = STANDING * self.system.scales.speed
        # After 30 impacts at one instant the last one is plastic.
        for count in range(31):
            closed = self._find_closed()
            rates = closed.rows.A @ self.v
            if not (rates < -limit).any():
                return closed
            self._strike(closed, rates, -rates.min() > self.chatter and count < 30)
        return self._find_closed()

    def _strike(self, closed: ClosedContacts, rates: Array, bouncing: bool) -> None:
        answer = solve_problem(closed.pose_impact(self.v))
        if answer is None:
            raise ArithmeticError("the plastic impact has no solution")
        self.residual = max(self.residual, answer.residual)
        mass, v = self.system.mass, self.v + answer.change
        if bouncing and self.restitution:
            # Poisson's expansion, unless it would gain energy.
            impulse = self.restitution * answer.c_n
            pushed = v + closed.rows.A.T @ impulse / mass
            problem = closed.pose_impact(pushed)
            expands = solve_problem(replace(problem, bound=problem.mu * impulse[problem.owner]))
            after = v if expands is None else pushed + expands.change
            v = after if after**2 @ mass <= self.v**2 @ mass * (1 + 1e-12) else v
        pause = 1e-3 * self.system.scales.time
        for k, pair in enumerate(closed.pairs):
            if rates[k] >= -STANDING * self.system.scales.speed or answer.c_n[k] <= 0:
                continue
            name, text = self.system.names[pair], self.system.structure.pairs[pair].text
            kind, note = EventKind.CHATTER, f"the impacts of {name} come ever closer and are over"
            if bouncing:
                kind, note = EventKind.IMPACT, f"{text or name} at {-rates[k]:.4g} m/s"
            # What chatters may do so again at once.
            told = (e for e in self.events if e.kind is kind and e.contact == name)
            if bouncing or all(self.t - e.time >= pause for e in told):
                self.note(kind, note, name, float(-rates[k]))
        self.set_velocity(v)

    def _jolt(self) -> bool:
        """Impact without collision (Painleve), the limit of time stepping; whether there is one."""
        system = self.system
        closed = self._find_closed()
        free = system.push(self.v, self.tau(self.t), closed.sigma) / system.mass
        answer = solve_problem(closed.pose_impact(self.v + SETTLING * system.scales.time * free))
        if answer is None:
            return False
        # With the modes that it ends in, the impact at the instant itself is linear.
        problem = closed.pose_impact(self.v)
        exact = list_answers(problem, problem.describe(answer))
        if not exact or system.is_slower(exact[0].change, STANDING):
            return False
        names = " ".join(system.names[pair] for pair in closed.pairs)
        text = f"no finite forces keep {names} closed: an impact without a collision"
        self.note(EventKind.INCONSISTENT, text, names)
        self.set_velocity(self.v + exact[0].change)
        return True

    def _decide(self, closed: ClosedContacts) -> bool | None:
        """Set the contact modes; whether everything rests, None where no modes are consistent."""
        system, lift = self.system, 1 / self.system.mass
        if (np.abs(closed.rows.A @ self.v) > STANDING * system.scales.speed).any():
            # What is closed and parts more slowly than chatter is closed at rest, all at once.
            pairs, rows = closed.pairs, closed.rows
            sticks = np.abs(rows.A_t @ self.v) < self.chatter
            sticks &= closed.mu > 0
            self.project_velocity(np.vstack([rows.A, rows.A_t[sticks]]))
            rows = system.evaluate(self.z, self.v, pairs)
            closed = ClosedContacts(system, pairs, rows, self.v)
        later = SETTLING * system.scales.time
        free = lift * system.push(self.v, self.tau(self.t), closed.sigma)
        first = self._answer(closed.pose(free, closed.rows), closed.recall(self.modes))
        if first is None:
            return None
        acceleration = free + first.change
        v = self.v + later * acceleration
        rows = system.evaluate(self.z + later * (self.v + v) / 2, v, closed.pairs)
        coming = lift * system.push(v, self.tau(self.t + later), closed.sigma)
        answer = self._choose(closed, closed.pose(coming, rows), coming, first)
        if answer is None:
            return None
        # What rests leaves its last modes by rounding, before it takes others in which it rests.
        still = self.resting or self._is_still(acceleration)
        rests = self.stands and still and self._is_still(coming + answer.change)
        modes = closed.make_modes(answer, rows)
        self._note_changes(closed.pairs, modes, rests)
        self.modes = modes
        # Rounding of speeds that are zero.
        kept = [k for k, pair in enumerate(closed.pairs) if pair in modes.kept]
        joints = np.eye(system.n)[closed.joints]
        at_rest = [closed.rows.A[kept], closed.rows.A_t[closed.standing], joints]
        self.project_velocity(np.vstack(at_rest))
        return rests

    def _answer(self, problem: ContactProblem, *likely: Sequence[int]) -> ContactAnswer | None:
        """The solution with some likely modes, or another."""
        for modes in likely:
            if answers := list_answers(problem, modes):
                return answers[0]
        answer = solve_problem(problem)
        if answer is None:
            return next(iter(list_answers(problem)), None)
        self.residual = max(self.residual, answer.residual)
        return answer

    def _choose(
        self, closed: ClosedContacts, problem: ContactProblem, free: Array, before: ContactAnswer
    ) -> ContactAnswer | None:
        """The answer nearest to the last one; what rests stays at rest if possible.

        `free` has the accelerations without contacts, shape (n,); `before` is an answer a little
        earlier.
        """
        last = closed.recall(self.modes)
        # There is surely one solution if nothing may stick and K + K^T is positive definite.
        K = problem.scaled[2]
        slides = not len(problem.b_t)
        self.unique = slides and bool(np.linalg.eigvalsh(K + K.T).min(initial=1.0) > SINGULAR)
        answers = [] if self.unique else list_answers(problem)
        if len(answers) > 1:
            modes = [problem.describe(answer) for answer in answers]
            if self.modes.kept or len(problem.b_n):
                self._note_ambiguity(closed, modes)
            starts = [self.resting and not self._is_still(free + a.change) for a in answers]
            away = [sum(a != b for a, b in zip(one, last, strict=True)) for one in modes]
            return answers[min(range(len(answers)), key=lambda k: (starts[k], away[k]))]
        likely = last, problem.describe(before)
        if answers and problem.describe(answers[0]) in likely:
            return answers[0]
        return self._answer(problem, *likely)

    def _note_changes(self, closed: Sequence[int], modes: Modes, rests: bool) -> None:
        if rests and self.resting:
            # Other forces that hold the same rest are no event.
            return
        system, before = self.system, self.modes
        names = system.names
        gone = [pair for pair in before.kept if pair not in modes.kept]
        new = [pair for pair in modes.kept if pair not in before.kept]
        near = CLOSED * system.scales.length
        for pair in gone:
            gaps, ranges = system.look(self.z)
            # What still touches, at the end of its range, is a neighbour's from there on.
            heirs = [p for p in new if names[p][-1:] == names[pair][-1:]]
            if heirs and abs(gaps[pair]) < near and ranges[pair] < near:
                text = f"{names[pair]} goes on as {names[heirs[0]]}"
                self.note(EventKind.PASS, text, names[heirs[0]])
                new.remove(heirs[0])
            elif pair not in closed or self.records:
                self.note(EventKind.CONTACT_LOST, f"{names[pair]} is lost", names[pair])
        for pair in new if self.records else ():
            self.note(EventKind.GAINED, f"{names[pair]} presses", names[pair])
        if not self.records:
            before = modes
        slid = dict(zip(before.kept, before.Xi, strict=True))
        changes = [
            (names[pair], slid[pair], Xi, "slides")
            for pair, Xi in zip(modes.kept, modes.Xi, strict=True)
            if pair in slid and system.friction[pair] > 0
        ]
        joints = zip(before.sigma, modes.sigma, strict=True)
        changes += [(_name(system, k), old, new, "turns") for k, (old, new) in enumerate(joints)]
        for name, old, now, verb in changes:
            if old != now:
                self.note(*describe_change(name, old, now, verb), name)
        if rests:
            self.note(EventKind.REST, "everything rests")
        elif self.resting:
            self.note(EventKind.START, "the motion begins")

    def _note_ambiguity(self, closed: ClosedContacts, answers: Sequence[Sequence[int]]) -> None:
        """Record that there are several answers, once for each set of contacts."""
        names = [self.system.names[pair] for pair in closed.pairs]
        slides = {APART: "parts", STICKS: "presses", FORTH: "slides +", BACK: "slides -"}
        turns = {STICKS: "is held", FORTH: "turns +", BACK: "turns -"}
        told = [(name, slides) for name in names]
        for k in closed.standing.tolist():
            told[k] = names[k], slides | {STICKS: "sticks"}
        told += [(_name(self.system, joint), turns) for joint in closed.joints.tolist()]
        differs = [len(set(modes)) > 1 for modes in zip(*answers, strict=True)]
        texts = []
        for answer in answers:
            modes = zip(told, answer, differs, strict=True)
            parts = [f"{name} {words[mode]}" for (name, words), mode, other in modes if other]
            texts.append(", ".join(parts) or "the rest accelerates otherwise")
        text = f"{len(answers)} motions are possible with {', '.join(names) or 'no contact'} closed"
        text += f" ({'; or '.join(texts)})"
        last = [event for event in self.events if event.kind is EventKind.AMBIGUOUS]
        if not last or last[-1].text.split(" at t =")[0] != text:
            self.note(EventKind.AMBIGUOUS, text, " ".join(names))

    # Rest.

    def _hold(self) -> None:
        """Let time pass at rest until forces leave their bounds, or the torques end."""
        self.record(still=True)
        decided = True
        while True:
            breach = find_breach(self._list_margins(decided), self.fraction(self.t))
            decided = False
            self.wait(self.time(breach) if breach < 1 else self.stop)
            if breach < 1 or not self.next_piece():
                return

    def _list_margins(self, decided: bool) -> Array:
        """Margins at rest, polynomials of x in [-1, 1] on the present piece, (m, d + 1), scaled.

        All are affine in the torques: they follow from the steps' forces under three torques. Where
        it is `decided` that everything rests at present, accelerations and breaches are rounding.
        """
        self.load(self.modes)
        s, torque, seen = self.s, self.s.inputs.torque, []
        for tau in np.vstack([np.zeros(2), self.system.scales.torque * np.eye(2)]):
            torque[:] = 0.0
            torque[:: self.torque.coefficients.shape[2]] = tau
            s.look()
            rates = s.outputs.acceleration * self.system.scales.time
            margins = s.outputs.values[: s.rows.cone.stop]
            seen.append(np.concatenate([margins, rates / self.system.units[self.system.n :]]))
        slopes = np.array([part - seen[0] for part in seen[1:]]).T / self.system.scales.torque
        values = slopes @ self.torque.coefficients[self.piece]
        values[:, 0] += seen[0]
        count = s.rows.cone.stop
        margins, rates = values[:count], values[count:]
        creeps = np.vstack([-rates, rates])
        powers = self.fraction(self.t) ** np.arange(values.shape[1]) * decided
        # Contacts are nearly dependent where two fingers come to rest on each other, or where the
        # only one that sticks hardly moves with the hand (hexagon with v0 below finger 2's joint).
        margins[:, 0] += np.maximum(ROUNDING_FORCE, -2 * margins @ powers)
        creeps[:, 0] += np.maximum(10 * STILL, 2 * np.abs(creeps @ powers))
        return np.vstack([margins, creeps])

    # Motion.

    def move(self) -> None:
        """Integrate with the present modes until an event, or until the torques step or end."""
        self.load(self.modes)
        rows, self.kept = self.s.rows, list(self.modes.kept)
        self.watched = ~np.isin(range(len(self.system.names)), self.kept)
        self.counts = [rows.cone.stop, rows.turn.stop - rows.cone.stop, len(self.kept)]
        self.slack = np.repeat([ROUNDING_FORCE, 1e-12, CLOSED], self.counts)
        self.look()
        # What touches already may sink by rounding; what is behind something else never closes.
        gaps = self.after.gaps
        sunk = np.minimum(gaps, 0.0) - 0.5 * CLOSED * self.unit
        self.level = np.where(gaps > -SUNK * self.unit, sunk, -np.inf)
        # Values that start below zero may stay there: modes are judged a moment later.
        self.shift = np.maximum(self.slack, self.slack - self.values)
        near = self.watched & (gaps <= ARMED * self.unit) & (gaps > -CLOSED * self.unit)
        if near.any():
            # Half the time in which the nearest pair that has just parted would close again. What
            # parts more slowly was closed when the modes were chosen.
            at = self.system.evaluate(self.z, self.v, near.nonzero()[0].tolist())
            rate, bend = at.A @ self.v, at.A @ self.s.outputs.acceleration + at.bend
            back = (rate >= self.chatter) & (bend < 0)
            self.h = float((-rate[back] / bend[back]).min(initial=self.h))
        self.record()
        super().move()

    def begin_step(self) -> None:
        """Start the next step, of `REACH` at most, from the end of the one just made."""
        super().begin_step()
        self.before = self.after
        self.shift = np.where(self.values > 0, self.slack, self.shift)
        _, speed, push = np.abs(self.after.motion / self.system.units[: self.system.n]).max(axis=1)
        root = math.sqrt(speed**2 + 2 * push * REACH)
        self.longest = float(2 * REACH / (speed + root + 1e-300))

    def measure(self) -> Array:
        """Event values of the steps, then ranges of kept pairs."""
        out = self.s.outputs
        motion = np.concatenate([out.y[: 2 * self.system.n], out.acceleration])
        motion = motion.reshape(3, self.system.n)
        self.after = StepEnd(motion, *self.system.look(motion[0]))
        return np.concatenate([out.values, self.after.ranges[self.kept] / self.unit])

    def pass_break(self) -> bool | None:
        """Go on to the next piece of the torques; the motion ends if they end or modes change."""
        if not self.next_piece():
            return True
        if self.steps_at[self.piece]:
            self.look()
            if not self._holds():
                return True
            self.record()
        return None

    def _holds(self) -> bool:
        """Whether the modes are the only solution after a torque step, by more than rounding."""
        modes, rows, at = self.s.modes, self.s.rows, self.after
        if not self.unique or modes.holders:
            return False
        clear = np.repeat([10 * ROUNDING_FORCE, 1e-4, 10 * CLOSED], self.counts)
        # What has no direction has no speed that could reverse.
        signs = np.array([*self.modes.Xi, *self.modes.sigma])
        clear[rows.slide.start : rows.turn.stop][signs == 0] = -1
        near = CLOSED * self.unit
        touches = (np.abs(at.gaps) < near) & (at.ranges > -near) & self.watched
        return bool((self.values > clear).all()) and not touches.any()

    def find_closing(self, h: float, done: Sequence[int]) -> tuple[int, float] | None:
        """The first pair that closes within the step just made, but those `done`, and when.

        Pairs that do not face each other there do not count.
        """
        n, passed = self.system.n, [pair for pair in done if pair >= 0]
        while bracket := self._find_bracket(h, passed):
            pair, level, left, right = bracket

            def value(step: float, pair: int = pair, level: float = level) -> float:
                self.step_to(step)
                return float(self.after.gaps[pair]) - level

            first = value(left) if left > 0 else float(self.before.gaps[pair]) - level
            last = value(right)
            if last >= 0 and right < h:
                # The bracket is that of an interpolation, which grazing may mislead.
                right, last = h, value(h)
            if last < 0:
                # Some ten roundings of the gap count as closed.
                root = find_root(value, left, right, (first, last), self.near, 1e-14 * self.unit)
                self.step_to(root)
                y = self.s.outputs.y
                if self._face(y[:n], y[n : 2 * n])[1][pair]:
                    return pair, root
            passed.append(pair)
            self.step_to(h)
        return None

    def _find_bracket(
        self, h: float, passed: Sequence[int]
    ) -> tuple[int, float, float, float] | None:
        """The first pair whose gap falls below a level [m], that, and a bracket of when [s]."""
        unit, start, end = self.unit, self.before, self.after
        z, v, _ = np.abs(end.motion - start.motion)
        travel = float(((z + h * v) / self.system.units[: self.system.n]).max())
        count = 1 + int(LOOKS * min(1.0, travel / REACH))
        times = h * np.arange(count + 1) / count
        seen = [start.gaps, end.gaps], [start.ranges, end.ranges]
        if count > 1:
            knots = tuple(np.stack([start.motion, end.motion], axis=1))
            first = np.zeros(count - 1, dtype=np.int64)
            z = interpolate_quintic(np.full(count - 1, h), times[1:-1], knots, first)[0]
            seen[0][1:1], seen[1][1:1] = self.system.measure(z)
        gaps, ranges = map(np.array, seen)
        # What comes apart within the step may close again within it.
        apart = np.logical_or.accumulate(gaps[:-1] > ARMED * unit, axis=0)
        level = np.where(apart, 0.0, self.level)
        crosses = (gaps[1:] < level) & (gaps[:-1] >= level) & self.watched
        crosses[:, passed] = False
        crosses &= np.maximum(ranges[1:], ranges[:-1]) > -1e-3 * unit
        rows, pairs = crosses.nonzero()
        if len(rows):
            row, pair = int(rows[0]), int(pairs[0])
            return pair, float(level[row, pair]), *times[row : row + 2].tolist()
        # The first one that comes into range apart or touching, and overlaps after that. Out of
        # range a gap has no meaning and may be negative throughout.
        turns = (ranges[1:] > 0) & (ranges[:-1] <= 0) & self.watched
        turns &= (gaps[1:] < -CLOSED * unit) & (gaps[1:] > -REACH * unit)
        turns[:, passed] = False
        for row, pair in zip(*(part.tolist() for part in turns.nonzero()), strict=True):
            left, right = times[row : row + 2].tolist()

            def outside(step: float, pair: int = pair) -> float:
                self.step_to(step)
                return -float(self.after.ranges[pair])

            # When the pair comes into range.
            ends, entry = (-float(ranges[row, pair]), outside(right)), right
            if ends[1] < 0 <= ends[0]:
                flat = CLOSED * unit
                entry = find_root(outside, left, right, ends, self.near, flat)
            self.step_to(entry)
            gap = float(self.after.gaps[pair])
            if gap > -SUNK * unit:
                return pair, min(gap, 0.0) - 0.5 * CLOSED * unit, entry, right
            self.step_to(h)
        return None


def _name(system: System, joint: int) -> str:
    driven = system.structure.driven
    return f"joint {driven.index(joint) + 1}" if joint in driven else f"coordinate {joint + 1}"
