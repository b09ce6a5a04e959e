"""Integrating a motion up to its next event."""

from __future__ import annotations

import math
from operator import mul
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..results.sampled import interpolate_quintic
from ..simulation.locate import find_crossing, find_root
from ..simulation.runge_kutta import ORDER
from .state import AHEAD, ARMED, CLOSED, SUNK, Run
from .watch import build_watch

GROWTH = 10.0
"""Largest growth of a step."""
SHORTEST = 1e-13
"""Step below which the integration gives up, relative to the scene's time and the time gone by."""
LOOKS = 8
"""Instants of the longest step at which gaps are looked at, its end among them."""
REACH = 0.3
"""Farthest that a step may go, in units of the scene: gaps are seen every `REACH` / `LOOKS`."""
EXACT = 1e-14
"""Gap at which a contact is found closed, relative to the scene's length: some ten roundings."""


class StuckError(ArithmeticError):
    """Steps become too short to get anywhere."""


class View(NamedTuple):
    """What is looked at of a step.

    Attributes
    ----------
    out : ndarray
        Outputs at its end.
    values : ndarray
        Forces, reserves of friction, speeds and ranges at its end, each positive until something
        happens, in units of the scene.
    times : ndarray, shape (m,), [s]
        Instants since its start.
    gaps, ranges : ndarray, shape (m, N), [m]
        Of all pairs then.
    """

    out: Array
    values: Array
    times: Array
    gaps: Array
    ranges: Array


class Closing(NamedTuple):
    """A pair whose gap falls below a level [m] between two instants since a step's start [s]."""

    pair: int
    level: float
    left: float
    right: float


def move(run: Run) -> None:
    """Integrate until something happens or the torques step or end."""
    _Motion(run).move()


class _Motion:
    """A motion with given contact modes."""

    def __init__(self, run: Run) -> None:
        self.run, self.s = run, run.load()
        system = run.system
        self.unit, self.per_unit = system.scales.length, (1 / system.units[: system.n]).tolist()
        if run.modes not in run.watches:
            run.watches[run.modes] = build_watch(system, run.modes, self.s.to)
        self.watch = run.watches[run.modes]
        self.slack, self.watched = self.watch.slack, self.watch.pairs
        self.time = system.scales.time
        self.near = 1e-3 * SHORTEST * max(self.time, abs(run.t))

    def move(self) -> None:
        """Integrate until something happens or the torques step or end."""
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
        """Whether the modes are the only answer after a step of the torques, by more than rounding.

        Everything that touches has to press and slide, as it did before.
        """
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
        least = SHORTEST * max(self.time, abs(run.t))
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
                h = self._find_value(
                    row, float(floor[row]), float(first[row]), float(values[row]), h
                )
                floor = np.where(np.arange(len(floor)) == row, np.inf, floor)
                found = True
            self._step_to(h)
            end = self.view(start.out, h)

    def _find_value(self, row: int, floor: float, first: float, last: float, h: float) -> float:
        """When one of the values falls below its floor."""

        def value(step: float) -> float:
            self._step_to(step)
            return float(self.watch.measure(self.s.outputs)[row]) + floor

        return find_root(value, h, first, last, self.near, 1e-3 * floor)

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
        n = self.run.system.n
        v = out[n : 2 * n]
        return float(self.run.system.evaluate(out[:n], v, (pair,)).A[0] @ v)

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
        """The first pair that comes into range as it touches or is apart, and overlaps after that.

        A gap means nothing out of range, so that it may be negative at every look.
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
