"""Event-driven integration with contact modes from complementarity problems, impacts included."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from operator import mul
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..results.trajectory import interpolate_quintic
from ..simulation.events import EventKind
from ..simulation.root_finding import find_crossing, find_root
from ..simulation.runge_kutta import ORDER
from ..simulation.tolerances import ROUNDING_FORCE, SHORTEST_STEP, STANDING, STILL
from .contact_modes import ClosedContacts, Pattern, decide, find_closed, stands
from .contact_problem import (
    APART,
    MODES,
    STICKS,
    ContactAnswer,
    ContactProblem,
    read,
    solve,
    try_modes,
)
from .free_stepper import FreeOutputs, Modes
from .state import AHEAD, ARMED, CLOSED, NO_PROGRESS, SUNK, FreeRun
from .system import System

SPEED_ROUNDING = 1e-12  # sliding or turning speed that counts as rounding, over the scene's
TURNING = 1e-4  # speed, over the scene's, below which a reversal may be near
GROWTH = 10.0  # largest growth of a step
LOOKS = 8  # instants of the longest step at which gaps are looked at, its end among them
REACH = 0.3  # longest step, in units of the scene: gaps are sampled every `REACH` / `LOOKS`
EXACT = 1e-14  # gap of a closed contact, over the scene's length: some ten roundings
CHATTER_PAUSE = 1e-3  # time between two notes of chatter of a pair, over the scene's
SLIDES = 1e-3  # least sliding after an impact, over that before and the impact speed
ROUNDS = 30  # most impacts at one instant; what is left after them is plastic


def play(run: FreeRun, touching: float, halt: Callable[[FreeRun], bool] | None = None) -> None:
    """Simulate until the torques end or `halt`, called at events; `touching` [m]: gaps to close."""
    _close(run, touching)
    while run.t < run.end and not (halt is not None and halt(run)):
        if run.t >= run.stop:
            run.next_piece()
        found = collide(run)
        moved = not stands(run)
        rests = decide(run, found)
        if moved and stands(run):
            rests = decide(run)
        run.decisions = run.decisions + 1 if run.t == run.decided_at else 0
        run.decided_at = run.t
        if run.decisions > NO_PROGRESS:
            run.note(EventKind.GIVEN_UP, "decisions do not end")
            return
        if rests is None:
            if not jolt(run):
                run.note(EventKind.GIVEN_UP, "no motion obeys the laws of contact")
                if not run.records:
                    run.record(None)
                return
            continue
        run.resting = rests
        if rests:
            run.take_impulse(np.zeros(run.system.n))
            hold(run)
            continue
        try:
            _Motion(run).move()
        except StuckError:
            # Forces grow without bound where the motion jams.
            if not jolt(run):
                run.note(EventKind.GIVEN_UP, "steps become too short")
                return


def _close(run: FreeRun, touching: float) -> None:
    """Project the start onto what touches, in the metric of masses."""
    system = run.system
    root = np.sqrt(system.mass)
    for _ in range(5):
        gaps, ranges = system.measure(run.z[None])
        near = np.flatnonzero((np.abs(gaps[0]) < touching) & (ranges[0] > -touching)).tolist()
        if not near:
            break
        rows = system.evaluate(run.z, run.v, near).A / root
        step = np.linalg.lstsq(rows, gaps[0, near], rcond=1e-9)[0]
        run.y[: system.n] -= step / root
    gaps, _ = system.measure(run.z[None])
    run.armed = gaps[0] > ARMED * system.scales.length


def hold(run: FreeRun) -> None:
    """Let time pass at rest until forces leave their bounds, or the torques end."""
    run.record(None)
    while True:
        start, stop = run.torque.breaks[run.piece : run.piece + 2]
        x = float(2 * run.t - start - stop) / float(stop - start)
        breach = _find_breach(_list_margins(run), x)
        run.t = float(start + stop + breach * (stop - start)) / 2 if breach < 1 else float(stop)
        run.record(None)
        if breach < 1 or not run.next_piece():
            return


def _list_margins(run: FreeRun) -> Array:
    """Margins at rest, polynomials of x in [-1, 1] on the present piece, (m, d + 1), scaled."""
    system, modes = run.system, run.modes
    scales, n = system.scales, system.n
    rows = system.evaluate(run.z, run.v, modes.kept)
    mu, stuck = system.friction[list(modes.kept)], [modes.kept.index(k) for k in modes.stuck]
    held = np.eye(n)[list(modes.held)].reshape(-1, n)
    P = np.vstack([rows.A, rows.A_t[stuck], held])
    G = np.vstack([rows.A - (mu * np.array(modes.Xi))[:, None] * rows.A_t, rows.A_t[stuck], held])
    degree = run.torque.coefficients.shape[2]
    drive = np.zeros((n, degree))
    drive[:, 0] = system.applied - system.dry * np.array(modes.sigma)
    drive[list(system.driven)] += run.torque.coefficients[run.piece][: len(system.driven)]
    lift = 1 / system.mass
    c = -np.linalg.solve((P * lift) @ G.T, (P * lift) @ drive) if len(P) else np.zeros((0, degree))
    acceleration = lift[:, None] * (drive + G.T @ c)
    k = len(modes.kept)
    bound = np.zeros((len(P) - k, degree))
    bound[: len(stuck)] = mu[stuck, None] * c[stuck]
    bound[len(stuck) :, 0] = system.dry[list(modes.held)]
    unit = np.full(len(P), scales.force)
    unit[k + len(stuck) :] = system.friction_units[list(modes.held)]
    margins = np.vstack([c[:k], bound - c[k:], bound + c[k:]])
    margins /= np.concatenate([unit, unit[k:]])[:, None]
    margins[:, 0] += ROUNDING_FORCE
    rates = acceleration / (system.units[n:] / scales.time)[:, None]
    creeps = np.vstack([-rates, rates])
    creeps[:, 0] += 10 * STILL
    return np.vstack([margins, creeps])


def _find_breach(margins: Array, x: float) -> float:
    """First `x` at which a polynomial turns negative; at least 1 if none does before."""
    if margins.shape[1] == 1:
        return x if (margins < 0).any() else 2.0
    first = 2.0
    for row in margins:
        if row @ x ** np.arange(len(row)) < 0:
            return x
        bent = np.trim_zeros(row, "b")
        if len(bent) < 2:
            continue
        roots = np.roots(bent[::-1])
        real = roots.real[np.abs(roots.imag) < 1e-9]
        for root in np.sort(real[(real > x) & (real < min(first, 1.0))]):
            slope = sum(k * c * root ** (k - 1) for k, c in enumerate(row) if k)
            if slope < 0:
                first = float(root)
                break
    return first


def collide(run: FreeRun) -> ClosedContacts:
    """Resolve impacts until no closed gap closes further; what is closed then."""
    limit = STANDING * run.system.scales.speed
    for count in range(ROUNDS + 1):
        closed = find_closed(run)
        rates = closed.rows.A @ run.v
        if not (rates < -limit).any():
            return closed
        _collide(run, closed, rates, -rates.min() > run.chatter and count < ROUNDS)
    return find_closed(run)


def _collide(run: FreeRun, closed: ClosedContacts, rates: Array, bouncing: bool) -> None:
    problem = _pose(run, closed, run.v)
    answer = _slide_on(problem) or solve(problem)
    if answer is None:
        raise ArithmeticError("the plastic impact has no solution")
    run.residual = max(run.residual, answer.residual)
    v = run.v + answer.change
    if bouncing and run.restitution:
        v = _expand(run, closed, answer, v, run.restitution)
    pause = CHATTER_PAUSE * run.system.scales.time
    for k, pair in enumerate(closed.pairs):
        if rates[k] >= -STANDING * run.system.scales.speed or answer.c_n[k] <= 0:
            continue
        name, text = run.system.names[pair], run.system.structure.pairs[pair].text
        noted = [e.time for e in run.events if (e.kind, e.contact) == (EventKind.CHATTER, name)]
        if bouncing:
            note = f"{text or name} at {-rates[k]:.4g} m/s"
            run.note(EventKind.IMPACT, note, name, float(-rates[k]))
        elif not noted or run.t - noted[-1] >= pause:
            note = f"the impacts of {name} come ever closer and are over"
            run.note(EventKind.CHATTER, note, name, float(-rates[k]))
    run.take_impulse(v)


def _slide_on(p: ContactProblem) -> ContactAnswer | None:
    """Impact after which every sliding sign is that before, if there is one.

    Of several solutions it is the nearest, and without sticking the problem is small.
    """
    k, none = len(p.b_n), np.zeros(0)
    signs, pushes = np.sign(p.b_t), p.A.copy()
    pushes[p.owner] -= (p.mu * signs)[:, None] * p.T
    slides = ContactProblem(p.lift, p.A, pushes, p.b_n, p.T[:0], none, p.owner[:0], none, none)
    answer = solve(slides) if k and slides.is_unique and signs.all() else None
    if answer is None:
        return None
    rates = p.b_t + p.T @ answer.change
    least = SLIDES * np.maximum(np.abs(p.b_t), np.abs(p.b_n).max())
    if ((rates * signs <= least) & (answer.c_n[p.owner] > 0)).any():
        return None
    return read(p, answer.c_n, -p.mu * signs * answer.c_n[p.owner], answer.residual)


def _pose(run: FreeRun, closed: ClosedContacts, v: Array) -> ContactProblem:
    """Contact problem of velocities: whatever has friction may stick."""
    system, rows = run.system, closed.rows
    mu = system.friction[list(closed.pairs)]
    rubs = np.flatnonzero(mu > 0)
    T = rows.A_t[rubs]
    none = np.zeros(len(rubs))
    return ContactProblem(
        1 / system.mass, rows.A, rows.A, rows.A @ v, T, T @ v, rubs, mu[rubs], none
    )


def _expand(
    run: FreeRun, closed: ClosedContacts, plastic: ContactAnswer, v: Array, restitution: float
) -> Array:
    """Velocity after expansion with Poisson's restitution, which may not gain energy."""
    system = run.system
    before = float(run.v**2 @ system.mass)
    while restitution > 1e-3:
        impulse = restitution * plastic.c_n
        problem = _pose(run, closed, v)
        pushed = v + problem.lift * (problem.A.T @ impulse)
        bound = problem.mu * impulse[problem.owner]
        problem = replace(_pose(run, closed, pushed), bound=bound)
        answer = solve(problem)
        if answer is not None:
            after = pushed + answer.change
            if float(after**2 @ system.mass) <= before * (1 + 1e-12):
                return np.asarray(after)
        restitution /= 2
    return v


def jolt(run: FreeRun) -> bool:
    """Impact without collision (Painleve), the limit of time stepping; whether there is one."""
    system, scales = run.system, run.system.scales
    closed = find_closed(run)
    pattern = Pattern(run, closed)
    later = AHEAD * scales.time
    free = system.push(run.v, run.tau(run.t), pattern.sigma) / system.mass
    answer = solve(_pose(run, closed, run.v + later * free))
    if answer is None:
        return False
    # With the modes that it ends in, the impact at the instant itself is linear.
    problem = _pose(run, closed, run.v)
    choice = [STICKS if c > 0 else APART for c in answer.c_n]
    for contact, sign in zip(problem.owner, answer.sign, strict=True):
        choice[contact] = MODES[float(sign)] if choice[contact] != APART else APART
    exact = try_modes(problem, choice)
    units = system.units[system.n :]
    if exact is None or (np.abs(exact.change) < STANDING * units).all():
        return False
    names = " ".join(system.names[pair] for pair in pattern.closed)
    run.note(
        EventKind.INCONSISTENT,
        f"no finite forces keep {names} closed: an impact without a collision",
        names,
    )
    run.take_impulse(run.v + exact.change)
    return True


class StuckError(ArithmeticError):
    """Steps become too short to get anywhere."""


class View(NamedTuple):
    """Event values of a step."""

    out: Array  # outputs at its end
    values: Array  # values of `Watch` there
    times: Array  # (m,) [s]: instants since its start
    gaps: Array  # gaps, ranges (m, N) [m]: of all pairs then
    ranges: Array


class Closing(NamedTuple):
    """A pair whose gap falls below a level [m] between two instants since a step's start [s]."""

    pair: int
    level: float
    left: float
    right: float


class _Motion:
    """Integration with given contact modes."""

    def __init__(self, run: FreeRun) -> None:
        self.run, self.s = run, run.load()
        system = run.system
        self.unit, self.per_unit = system.scales.length, (1 / system.units[: system.n]).tolist()
        if run.modes not in run.watches:
            run.watches[run.modes] = build_watch(system, run.modes, self.s.to)
        self.watch = run.watches[run.modes]
        self.slack, self.watched = self.watch.slack, self.watch.pairs
        self.time = system.scales.time
        self.near = 1e-3 * SHORTEST_STEP * max(self.time, abs(run.t))

    def move(self) -> None:
        """Integrate until an event or until the torques step or end."""
        run, s = self.run, self.s
        run.stay(s)
        s.look()
        start = self.view(None, 0.0)
        run.record(s, start.out)
        # What touches already may sink by rounding; what is behind something else never closes.
        shallow = start.gaps[-1] > -SUNK * self.unit
        sunk = np.minimum(start.gaps[-1], 0.0) - 0.5 * CLOSED * self.unit
        self.level = np.where(shallow, sunk, -np.inf)
        # Values that start below zero may stay there: modes are judged a moment later.
        floor = np.maximum(self.slack, self.slack - start.values)
        run.h = min(run.h, self._time_to_return(start))
        while True:
            h, whole, end = self._try_step(start)
            found, end = self._stop_at_event(start, floor, h, end)
            run.t = run.t + float(s.inputs[s.at.h]) if found or not whole else run.stop
            run.y = end.out[s.to.y].copy()
            run.steps += 1
            run.record(s, end.out)
            run.armed = end.gaps[-1] > ARMED * self.unit
            if found:
                return
            floor = np.where(end.values > 0, self.slack, floor)
            if run.t >= run.stop:
                if not run.next_piece():
                    return
                run.feed(s)
                if run.torque_steps():
                    s.look()
                    end = self.view(None, 0.0)
                    if not self._holds(end):
                        return
                    run.record(s, end.out)
            else:
                run.feed(s)
            start = end

    def _holds(self, end: View) -> bool:
        """Whether the modes are the only solution after a torque step, by more than rounding."""
        clear = np.count_nonzero(end.values > self.watch.clear) == len(end.values)
        if not (self.run.unique and self.watch.plain and clear):
            return False
        near = CLOSED * self.unit
        touches = (np.abs(end.gaps[-1]) < near) & (end.ranges[-1] > -near)
        return not np.count_nonzero(touches & self.watched)

    def _try_step(self, start: View) -> tuple[float, bool, View]:
        """Make a step within the tolerance; its length, and whether it ends the torques' piece."""
        run, s = self.run, self.s
        inputs, outputs, at, to = s.inputs, s.outputs, s.at, s.to
        n, remaining = run.system.n, run.stop - run.t
        speed = self._find_most(start.out[n : 2 * n])
        push = self._find_most(start.out[to.acceleration])
        reach = 2 * REACH / (speed + math.sqrt(speed**2 + 2 * push * REACH) + 1e-300)
        least = SHORTEST_STEP * max(self.time, abs(run.t))
        while True:
            h = min(run.h, reach)
            whole = h >= 0.999 * remaining
            h = remaining if whole else min(h, remaining / 2)
            inputs[at.h] = h
            s.step()
            error = float(outputs[to.error])
            if error <= 1:
                view = self.view(start.out, h)
                sudden = outputs[to.dip] < -1e-6 and h > AHEAD * self.time
                if not sudden or (view.values < -self.slack).any():
                    grown = h * min(GROWTH, 0.9 * max(error, 1e-300) ** (-1 / ORDER))
                    run.h = grown if h >= run.h else max(run.h, grown)
                    return h, whole, view
            run.rejected += 1
            if not error < np.inf or h < least:
                raise StuckError
            run.h = h * (max(0.1, 0.9 * error ** (-1 / ORDER)) if error > 1 else 0.5)

    def _find_most(self, motion: Array) -> float:
        """Largest of coordinates or their rates, in units of the scene."""
        return float(max(map(abs, map(mul, motion.tolist(), self.per_unit))))

    def view(self, before: Array | None, h: float) -> View:
        """Look at the step just made, of length h from the outputs `before`, if any."""
        n, to = self.run.system.n, self.s.to
        out = self.s.outputs.copy()
        values = self.watch.measure(out)
        times, gaps, ranges = np.array([h]), out[None, to.gaps], out[None, to.ranges]
        if before is None:
            return View(out, values, times, gaps, ranges)
        gone = np.abs(out[: 2 * n] - before[: 2 * n])
        most = self._find_most(gone[:n] + h * gone[n:])
        count = 1 + int(LOOKS * min(1.0, most / REACH))
        if count > 1:
            times = h * np.arange(1, count + 1) / count
            ends = np.array([before, out])
            knots = ends[:, :n], ends[:, n : 2 * n], ends[:, to.acceleration]
            first = np.zeros(count - 1, dtype=np.int64)
            z = interpolate_quintic(np.full(count - 1, h), times[:-1], knots, first)[0]
            both = zip(self.run.system.measure(z), (gaps, ranges), strict=True)
            gaps, ranges = (np.vstack([within, last]) for within, last in both)
        return View(out, values, times, gaps, ranges)

    def _step_to(self, h: float) -> None:
        if self.s.inputs[self.s.at.h] != h:
            self.s.inputs[self.s.at.h] = h
            self.s.step()

    def _stop_at_event(self, start: View, floor: Array, h: float, end: View) -> tuple[bool, View]:
        """Shorten the step just made to the first event within it; whether there is one."""
        passed: set[int] = set()
        found = False
        first = np.maximum(start.values + floor, 0)
        while True:
            values = end.values + floor
            closing = self._find_closing(start, end, passed)
            closing = closing or self._find_entering(start, end, passed)
            low = (values < 0).nonzero()[0]
            if not len(low) and closing is None:
                return found, end
            shares = first[low] / (first[low] - values[low])
            if closing is not None and (not len(low) or closing.left <= h * shares.min()):
                root = self._find_contact(start, h, closing)
                passed.add(closing.pair)
                h, found = (h, found) if root is None else (root, True)
            else:
                row = int(low[np.argmin(shares)])
                least = float(floor[row])

                def value(step: float, row: int = row, least: float = least) -> float:
                    self._step_to(step)
                    return float(self.watch.measure(self.s.outputs)[row]) + least

                ends = float(first[row]), float(values[row])
                h = find_root(value, h, *ends, self.near, 1e-3 * least)
                floor = np.where(np.arange(len(floor)) == row, np.inf, floor)
                found = True
            self._step_to(h)
            end = self.view(start.out, h)

    def _find_contact(self, start: View, h: float, closing: Closing) -> float | None:
        """When a pair closes within a step; None if it does not, or where the two do not face."""
        pair, level, left, right = closing
        s, place, n = self.s, self.s.to.gaps.start + pair, self.run.system.n

        def look(step: float) -> tuple[float, float]:
            self._step_to(step)
            return float(s.outputs[place]) - level, self._approach(s.outputs, pair)

        first = float(start.gaps[-1, pair]) - level, self._approach(start.out, pair)
        first = look(left) if left > 0 else first
        last = look(right)
        if last[0] >= 0 and right < h:
            # The bracket is that of an interpolation, which grazing may mislead.
            right, last = h, look(h)
        if last[0] >= 0:
            return None
        near, exact = self.near, EXACT * self.unit
        root = find_crossing(look, (left, *first), (right, *last), near, exact)
        self._step_to(root)
        return root if self.run.face(s.outputs[:n], s.outputs[n : 2 * n])[1][pair] else None

    def _approach(self, out: Array, pair: int) -> float:
        """Rate of a pair's gap at a state [m/s]."""
        z, v, _ = np.split(out, [self.run.system.n, 2 * self.run.system.n])
        return float(self.run.system.evaluate(z, v, (pair,)).A[0] @ v)

    def _find_closing(self, start: View, end: View, passed: set[int]) -> Closing | None:
        """The first pair that closes within the step, and a bracket of when."""
        armed = self.run.armed[None]
        if len(end.times) > 1:
            # What comes apart within the step may close again within it.
            apart = end.gaps[:-1] > ARMED * self.unit
            armed = np.logical_or.accumulate(np.vstack([armed, apart]), axis=0)
        level = np.where(armed, 0.0, self.level)
        below = (end.gaps < level) & self.watched
        if not np.count_nonzero(below):
            return None
        earlier = [start.gaps[-1:], start.ranges[-1:]]
        if len(end.times) > 1:
            both = zip(earlier, (end.gaps, end.ranges), strict=True)
            earlier = [np.vstack([first, later[:-1]]) for first, later in both]
        crosses = below & (earlier[0] >= level)
        if not np.count_nonzero(crosses):
            return None
        crosses &= np.maximum(end.ranges, earlier[1]) > -1e-3 * self.unit
        crosses[:, list(passed)] = False
        rows, pairs = np.nonzero(crosses)
        if not len(rows):
            return None
        row, pair = int(rows[0]), int(pairs[0])
        left = 0.0 if row == 0 else float(end.times[row - 1])
        return Closing(pair, float(level[row, pair]), left, float(end.times[row]))

    def _find_entering(self, start: View, end: View, passed: set[int]) -> Closing | None:
        """The first pair that comes into range apart or touching, and overlaps after that.

        Out of range a gap has no meaning and may be negative throughout.
        """
        earlier = start.ranges[-1:]
        if len(end.times) > 1:
            earlier = np.vstack([earlier, end.ranges[:-1]])
        turns = (end.ranges > 0) & (earlier <= 0)
        if not np.count_nonzero(turns):
            return None
        turns &= self.watched & (end.gaps < -CLOSED * self.unit) & (end.gaps > -REACH * self.unit)
        h, found = float(self.s.inputs[self.s.at.h]), None
        for row, pair in zip(*(part.tolist() for part in turns.nonzero()), strict=True):
            if pair in passed or found is not None:
                continue
            left, right = float(end.times[row - 1]) if row else 0.0, float(end.times[row])
            entry, gap = self._find_entry(pair, left, right, -float(earlier[row, pair]))
            if gap > -SUNK * self.unit:
                found = Closing(pair, min(gap, 0.0) - 0.5 * CLOSED * self.unit, entry, right)
        self._step_to(h)
        return found

    def _find_entry(
        self, pair: int, left: float, right: float, outside: float
    ) -> tuple[float, float]:
        """When a pair comes into range between two instants of a step, and its gap then."""
        s = self.s

        def value(step: float) -> float:
            self._step_to(step)
            return -float(s.outputs[s.to.ranges.start + pair])

        within, flat = value(right), CLOSED * self.unit
        entered = right
        if within < 0 <= outside:
            entered = find_root(value, right, outside, within, self.near, flat, left)
        self._step_to(entered)
        return entered, float(s.outputs[s.to.gaps.start + pair])

    def _time_to_return(self, start: View) -> float:
        """Half the time in which the nearest pair that has just parted would close again [s]."""
        run, s = self.run, self.s
        near = self.watched & ~run.armed & (np.abs(start.gaps[-1]) < CLOSED * self.unit)
        if not np.count_nonzero(near):
            return math.inf
        rows = run.system.evaluate(run.z, run.v, near.nonzero()[0].tolist())
        rate = rows.A @ run.v
        bend = rows.A @ s.outputs[s.to.acceleration] + rows.bend
        # What parts more slowly was closed when the modes were chosen.
        back = (rate >= run.chatter) & (bend < 0)
        return float((-rate[back] / bend[back]).min(initial=np.inf))


class Watch(NamedTuple):
    """Event values, positive until an event, in units of the scene.

    In this order: c_n; friction margins of both signs; sliding and turning speeds; ranges.
    """

    columns: NDArray[np.int64]  # (c,): outputs of a step that they depend on
    rows: Array  # rows, constant (m, c) and (m,): they are rows @ outputs[columns] + constant
    constant: Array
    slack: Array  # slack, clear (m,): what counts as rounding, and what is more than that for sure
    clear: Array
    pairs: NDArray[np.bool_]  # (N,): those that are not kept, and may close
    plain: bool  # whether friction holds nothing

    def measure(self, out: Array) -> Array:
        """Values of the outputs of a step, shape (m,)."""
        return np.asarray(self.rows @ out[self.columns] + self.constant)


def build_watch(system: System, modes: Modes, to: FreeOutputs) -> Watch:
    """What is looked at with some modes."""
    scales, n, k = system.scales, system.n, len(modes.kept)
    stuck, held = [modes.kept.index(pair) for pair in modes.stuck], list(modes.held)
    slides, turning = np.flatnonzero(modes.Xi), np.flatnonzero(modes.sigma)
    holds = len(stuck) + len(held)
    counts = [k + 2 * holds, len(slides) + len(turning), k]
    rows, constant = np.zeros((sum(counts), to.size)), np.zeros(sum(counts))
    i = np.arange(sum(counts))
    rows[i[:k], to.c_n.start + i[:k]] = 1 / scales.force
    for j, (one, sign) in enumerate(product(range(holds), (-1.0, 1.0)), start=k):
        unit, row = scales.force, rows[j]
        if one < len(stuck):
            row[to.c_n.start + stuck[one]] = system.friction[modes.stuck[one]] / unit
        else:
            unit = float(system.friction_units[held[one - len(stuck)]])
            constant[j] = system.dry[held[one - len(stuck)]] / unit
        row[to.f.start + one] = sign / unit
    at = i[counts[0] :]
    rows[at[: len(slides)], to.v_t.start + slides] = np.array(modes.Xi)[slides] / scales.speed
    at = at[len(slides) :]
    signs = np.array(modes.sigma)[turning] / system.units[n + turning]
    rows[at[: len(turning)], n + turning] = signs
    ranges = to.ranges.start + np.array(modes.kept, dtype=int)
    rows[at[len(turning) :], ranges] = 1 / scales.length
    columns = np.flatnonzero(rows.any(axis=0))
    pairs = np.ones(len(system.names), dtype=bool)
    pairs[list(modes.kept)] = False
    return Watch(
        columns,
        np.ascontiguousarray(rows[:, columns]),
        constant,
        np.repeat([ROUNDING_FORCE, SPEED_ROUNDING, CLOSED], counts),
        np.repeat([10 * ROUNDING_FORCE, TURNING, 10 * CLOSED], counts),
        pairs,
        not holds,
    )
