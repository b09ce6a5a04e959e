"""Event-driven integration with contact modes from complementarity problems, impacts included."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from operator import mul
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..results.trajectory import interpolate_quintic
from .contact_modes import ClosedContacts, Pattern, decide, find_closed, stands
from .contact_problem import (
    APART,
    MODES,
    STICKS,
    ContactAnswer,
    ContactProblem,
    solve,
    try_modes,
)
from .events import EventKind
from .free_run import AHEAD, CLOSED, SUNK, FreeRun
from .root_finding import find_root
from .run import StuckError
from .tolerances import ROUNDING_FORCE, SHORTEST_STEP, STANDING, STILL

SPEED_ROUNDING = 1e-12  # sliding or turning speed that counts as rounding, over the scene's
TURNING = 1e-4  # speed, over the scene's, below which a reversal may be near
ARMED = 1e-13  # gap from which on a pair has been apart, relative to the scene's length
NO_PROGRESS = 60  # most decisions in a row without any time passing
LOOKS = 8  # instants of the longest step at which gaps are looked at, its end among them
REACH = 0.3  # longest step, in units of the scene: gaps are sampled every `REACH` / `LOOKS`
EXACT = 1e-14  # gap of a closed contact, over the scene's length: some ten roundings
CHATTER_PAUSE = 1e-3  # time between two notes of chatter of a pair, over the scene's
ROUNDS = 30  # most impacts at one instant; what is left after them is plastic


def play(run: FreeRun, touching: float, halt: Callable[[FreeRun], bool] | None = None) -> None:
    """Simulate until the torques end or `halt`, called at events; `touching` [m]: gaps to close."""
    _close(run, touching)
    while run.t < run.breaks[-1] and not (halt is not None and halt(run)):
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
            run.note_at(EventKind.GIVEN_UP, "decisions do not end")
            return
        if rests is None:
            if not jolt(run):
                run.note_at(EventKind.GIVEN_UP, "no motion obeys the laws of contact")
                if not run.records:
                    run.record(still=True)
                return
            continue
        run.resting = rests
        if rests:
            run.set_velocity(0.0)
            hold(run)
            continue
        try:
            _Motion(run).move()
        except StuckError:
            # Forces grow without bound where the motion jams.
            if not jolt(run):
                run.note_at(EventKind.GIVEN_UP, "steps become too short")
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
    run.record(still=True)
    while True:
        breach = _find_breach(_list_margins(run), run.fraction(run.t))
        run.t = run.time(breach) if breach < 1 else run.stop
        run.record(still=True)
        if breach < 1 or not run.next_piece():
            return


def _list_margins(run: FreeRun) -> Array:
    """Margins at rest, polynomials of x in [-1, 1] on the present piece, (m, d + 1), scaled."""
    system, modes = run.system, run.modes
    scales, n = system.scales, system.n
    rows = system.evaluate(run.z, run.v, modes.kept)
    mu, stuck = system.friction[list(modes.kept)], [modes.kept.index(k) for (k,) in modes.stuck]
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
    answer = solve(problem)
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
            run.note_at(EventKind.IMPACT, note, name, float(-rates[k]))
        elif not noted or run.t - noted[-1] >= pause:
            note = f"the impacts of {name} come ever closer and are over"
            run.note_at(EventKind.CHATTER, note, name, float(-rates[k]))
    run.set_velocity(v)


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
    run.note_at(
        EventKind.INCONSISTENT,
        f"no finite forces keep {names} closed: an impact without a collision",
        names,
    )
    run.set_velocity(run.v + exact.change)
    return True


class View(NamedTuple):
    """Event values at the end of a step, and gaps within it."""

    out: Array  # outputs at its end
    values: Array  # values of `_Motion.measure` there
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
        run.load(run.modes)
        self.run, self.s = run, run.s
        system, modes, rows = run.system, run.modes, run.s.rows
        self.unit, self.per_unit = system.scales.length, (1 / system.units[: system.n]).tolist()
        self.time = system.scales.time
        self.near = 1e-3 * SHORTEST_STEP * max(self.time, abs(run.t))
        self.kept = list(modes.kept)
        self.watched = np.ones(len(system.names), dtype=bool)
        self.watched[self.kept] = False
        counts = [rows.cone.stop, rows.size - rows.cone.stop, len(self.kept)]
        self.slack = np.repeat([ROUNDING_FORCE, SPEED_ROUNDING, CLOSED], counts)
        self.clear = np.repeat([10 * ROUNDING_FORCE, TURNING, 10 * CLOSED], counts)
        # What has no direction has no speed that could reverse.
        self.clear[rows.slide.start : rows.turn.stop][np.array([*modes.Xi, *modes.sigma]) == 0] = -1

    def move(self) -> None:
        """Integrate until an event or until the torques step or end."""
        run, s = self.run, self.s
        s.stay(run.system, run.z)
        s.look()
        start = self.view(None, 0.0)
        run.record()
        # What touches already may sink by rounding; what is behind something else never closes.
        shallow = start.gaps[-1] > -SUNK * self.unit
        sunk = np.minimum(start.gaps[-1], 0.0) - 0.5 * CLOSED * self.unit
        self.level = np.where(shallow, sunk, -np.inf)
        # Values that start below zero may stay there: modes are judged a moment later.
        floor = np.maximum(self.slack, self.slack - start.values)
        run.h = min(run.h, self._time_to_return(start))
        while True:
            h, whole = run.try_step(run.stop, self._happens, self._find_reach(start.out))
            found, end = self._stop_at_event(start, floor, h, self.view(start.out, h))
            run.t = run.t + float(s.inputs[s.at.h]) if found or not whole else run.stop
            run.y = end.out[s.to.y].copy()
            run.record()
            run.armed = end.gaps[-1] > ARMED * self.unit
            if found:
                return
            floor = np.where(end.values > 0, self.slack, floor)
            if run.t >= run.stop:
                if not run.next_piece():
                    return
                run.feed()
                if run.torque_steps():
                    s.look()
                    end = self.view(None, 0.0)
                    if not self._holds(end):
                        return
                    run.record()
            else:
                run.feed()
            start = end

    def _holds(self, end: View) -> bool:
        """Whether the modes are the only solution after a torque step, by more than rounding."""
        if not self.run.unique or self.s.modes.stuck or self.s.modes.held:
            return False
        near = CLOSED * self.unit
        touches = (np.abs(end.gaps[-1]) < near) & (end.ranges[-1] > -near)
        return bool((end.values > self.clear).all()) and not (touches & self.watched).any()

    def _find_reach(self, out: Array) -> float:
        """Longest step after the outputs at its start: one of `REACH`, in units of the scene."""
        n = self.run.system.n
        speed, push = self._find_most(out[n : 2 * n]), self._find_most(out[self.s.to.acceleration])
        return 2 * REACH / (speed + math.sqrt(speed**2 + 2 * push * REACH) + 1e-300)

    def _find_most(self, motion: Array) -> float:
        """Largest of coordinates or their rates, in units of the scene."""
        return float(max(map(abs, map(mul, motion.tolist(), self.per_unit))))

    def measure(self, ranges: Array | None = None) -> Array:
        """Values that are positive until an event: those of the steps, then ranges of kept pairs.

        Of all pairs, `ranges` (N,) [m] are computed if left out.
        """
        out, to = self.s.outputs, self.s.to
        if ranges is None:
            ranges = self.run.system.look(out[: self.run.system.n])[1]
        return np.concatenate([out[to.values], ranges[self.kept] / self.unit])

    def _happens(self) -> bool:
        return bool((self.measure() < -self.slack).any())

    def view(self, before: Array | None, h: float) -> View:
        """Look at the step just made, of length h from the outputs `before`, if any."""
        n, out = self.run.system.n, self.s.outputs.copy()
        count = 1
        if before is not None:
            gone = np.abs(out[: 2 * n] - before[: 2 * n])
            most = self._find_most(gone[:n] + h * gone[n:])
            count += int(LOOKS * min(1.0, most / REACH))
        times = h * np.arange(1, count + 1) / count
        if count == 1 or before is None:
            gaps, ranges = (part[None] for part in self.run.system.look(out[:n]))
        else:
            ends = np.array([before, out])
            knots = ends[:, :n], ends[:, n : 2 * n], ends[:, self.s.to.acceleration]
            first = np.zeros(count - 1, dtype=np.int64)
            z = interpolate_quintic(np.full(count - 1, h), times[:-1], knots, first)[0]
            gaps, ranges = self.run.system.measure(np.vstack([z, out[:n]]))
        return View(out, self.measure(ranges[-1]), times, gaps, ranges)

    def _gap(self, pair: int) -> float:
        """Gap of a pair at the end of the step just made [m]."""
        return float(self.run.system.look(self.s.outputs[: self.run.system.n])[0][pair])

    def _step_to(self, h: float) -> None:
        if self.s.inputs[self.s.at.h] != h:
            self.run.step_to(h)

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
                    return float(self.measure()[row]) + least

                ends = float(first[row]), float(values[row])
                h = find_root(value, h, *ends, self.near, 1e-3 * least)
                floor = np.where(np.arange(len(floor)) == row, np.inf, floor)
                found = True
            self._step_to(h)
            end = self.view(start.out, h)

    def _find_contact(self, start: View, h: float, closing: Closing) -> float | None:
        """When a pair closes within a step; None if it does not, or where the two do not face."""
        pair, level, left, right = closing
        s, n = self.s, self.run.system.n

        def value(step: float) -> float:
            self._step_to(step)
            return self._gap(pair) - level

        first = value(left) if left > 0 else float(start.gaps[-1, pair]) - level
        last = value(right)
        if last >= 0 and right < h:
            # The bracket is that of an interpolation, which grazing may mislead.
            right, last = h, value(h)
        if last >= 0:
            return None
        root = find_root(value, right, first, last, self.near, EXACT * self.unit, left)
        self._step_to(root)
        return root if self.run.face(s.outputs[:n], s.outputs[n : 2 * n])[1][pair] else None

    def _list_bounds(self, start: View, end: View) -> tuple[Array, Array, Array]:
        """Gaps and ranges at the beginning of each part of a step, (m, N) each, and its time."""
        gaps = np.vstack([start.gaps[-1:], end.gaps[:-1]])
        return gaps, np.vstack([start.ranges[-1:], end.ranges[:-1]]), np.append(0.0, end.times[:-1])

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
        gaps, ranges, times = self._list_bounds(start, end)
        crosses = below & (gaps >= level) & (np.maximum(end.ranges, ranges) > -1e-3 * self.unit)
        crosses[:, list(passed)] = False
        rows, pairs = np.nonzero(crosses)
        if not len(rows):
            return None
        row, pair = int(rows[0]), int(pairs[0])
        return Closing(pair, float(level[row, pair]), float(times[row]), float(end.times[row]))

    def _find_entering(self, start: View, end: View, passed: set[int]) -> Closing | None:
        """The first pair that comes into range apart or touching, and overlaps after that.

        Out of range a gap has no meaning and may be negative throughout.
        """
        overlaps = (end.ranges > 0) & (end.gaps < -CLOSED * self.unit) & self.watched
        if not np.count_nonzero(overlaps):
            return None
        _, ranges, times = self._list_bounds(start, end)
        turns = overlaps & (ranges <= 0) & (end.gaps > -REACH * self.unit)
        turns[:, list(passed)] = False
        h = float(self.s.inputs[self.s.at.h])
        try:
            for row, pair in zip(*(part.tolist() for part in turns.nonzero()), strict=True):
                left, right = float(times[row]), float(end.times[row])
                entry = self._find_entry(pair, left, right, -float(ranges[row, pair]))
                gap = self._gap(pair)
                if gap > -SUNK * self.unit:
                    return Closing(pair, min(gap, 0.0) - 0.5 * CLOSED * self.unit, entry, right)
            return None
        finally:
            self._step_to(h)

    def _find_entry(self, pair: int, left: float, right: float, outside: float) -> float:
        """When a pair comes into range between two instants of a step, to which the step is set."""

        def value(step: float) -> float:
            self._step_to(step)
            return -float(self.run.system.look(self.s.outputs[: self.run.system.n])[1][pair])

        within = value(right)
        if within < 0 <= outside:
            flat = CLOSED * self.unit
            right = find_root(value, right, outside, within, self.near, flat, left)
        self._step_to(right)
        return right

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
