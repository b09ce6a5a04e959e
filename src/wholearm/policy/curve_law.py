"""The law of a phase along a curve: joints say where on it the hand is, and how fast.

A table over the arc length s has the joint angles, the reference b = s'^2, torques and limits; the
last two are affine in a, b, s' and the squeeze (`curve_rows`). A step

* projects the joint angles onto the table, next to where they were, and the joint speeds along it;
* predicts both for the middle of the time in which its torques hold;
* asks for a = the reference's mean a over that time + gains on the reference's speed less s';
* takes the squeeze with the largest least level of all limits, and where that is below `LEVEL`
  goes back from a towards the reference as far as it takes.

At the end the motion goes on at touching speed, a little faster the longer it takes, until the
joints stop and stay so while the drive rises, or until they are well beyond: the contact is made.
From then on torques are those of the next law with no speed wanted, until the joints have stood
still. Without a next law along a curve, torques that were found before hold in the same way.

Plain numbers and lists are several times as fast as arrays that are as short as these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import Any

from .pace import Pace
from .sensing import Sensing
from .squeeze import choose_squeeze, find_motion

LEVEL, PART = 1.0, 0.5
"""Level of limits below which feedback gives way, in reserves: at most the first, and at most the
second times that of the reference, which may have less."""
LEAST = 0.3
"""Level of limits at an arrival, of all contacts, that is worth another squeeze."""
IGNORED = 1e6
"""Level from which on a limit is none."""
CORRECTION = 0.25
"""Gain on the speed, times the period and the delay."""
MEMORY = 0.2
"""Gain on the integral of the speed, over the square of that on the speed."""
LEAST_SPEED = 0.4
"""Part of the touching speed below which braking never aims: friction turns round with motion."""
SLOW = 0.5
"""Part of the reference's speed below which the motion does not brake with it."""
LAST = 0.02
"""Part of the curve, at its end, on which standing still counts as having arrived."""
STARTING = 10
"""Periods in which the motion may start before standing still counts."""
THERE = 1e-3
"""How much before its end the curve counts as run through, over its length."""
NEAR = 0.1
"""Part of the curve, at its end, in which an impact may be, where the end is passed at speed."""
LATE = 5.0
"""Periods after which it counts as over, where the joints do not show it."""
SHORT = 4.0
"""How many times as long the joints have to stand still short of that."""
CATCH = 10.0
"""Way in which the reference's place becomes the motion's, over how far off the start is."""
GROWTH, FASTEST = 0.01, 4.0
"""Time over which the wanted speed grows with the way beyond the end [s], up to so many times the
touching speed."""
STOPPED = 0.3
"""Part of the touching speed below which the joints have been stopped."""
DRIVE, RISE = 0.3, 2
"""Drive that joints withstand where a contact is made, over the largest a of the integral, and the
periods in which it rises to that."""
LONGEST = 3.0
"""Times the least time of standing still after which joints are let creep."""
BARRED = 0.1
"""Deceleration along the next curve, likewise, from which on a contact stops the joints."""
SOON, AHEAD, FAR = 0.02, 0.05, 0.3
"""How far beyond the end a contact is surely made, in the way at touching speed in these times [s]:
one that does not stop the joints, one that is there at the beginning, one that stops them."""


Rows = list[list[float]]


class CurveLaw:
    """The law of one phase, of which none is passed before it is over.

    Parameters
    ----------
    tables : mapping of str to ndarray
        `s`, (n,); `theta`, (n, 2); `b`, (n,), at nodes; `levels`, (n - 1, 2, m, 5), and `torque`,
        (n - 1, 2, 2, 5), at both ends of the intervals; `push`, (2,); `passes`, (1,), not zero
        where the end is passed at speed; `keeps`, (1,), not zero where `push` is held until the
        next law begins; `arrival`, (k, 5), levels of all contacts where they are made.
    pace : Pace

    Attributes
    ----------
    over, pushes : bool
        Whether the next phase may begin, and whether the contact is being pressed.
    after : CurveLaw or None
        The law of the next phase, if it is along a curve.
    s, v, level : float
        Place and speed along the curve, and the least level, at the last step.
    """

    count, passed = 1, 0

    def __init__(self, tables: Mapping[str, Any], pace: Pace) -> None:
        self.passes = bool(tables["passes"][0])
        self.pace, self.nodes = pace, tables["s"].tolist()
        self.length = self.nodes[-1]
        self.theta, self.b = tables["theta"].tolist(), tables["b"].tolist()
        self.push = tuple(tables["push"].tolist())
        self.keeps = bool(tables.get("keeps", [0.0])[0])
        self.arrival = tables["arrival"].tolist()
        pairs = list(zip(self.nodes, self.nodes[1:], strict=False))
        self.steps = [after - before for before, after in pairs]
        self.chords = [
            (after[0] - before[0], after[1] - before[1])
            for before, after in zip(self.theta, self.theta[1:], strict=False)
        ]
        self.squares = [one * one + two * two or 1e-30 for one, two in self.chords]
        self.levels, self.level_rises = _split(tables["levels"], IGNORED)
        self.torque, self.torque_rises = _split(tables["torque"])
        self.floor = self._find_floor()
        self.gain = CORRECTION / (pace.period + pace.delay)
        self.memory = MEMORY * self.gain**2 * pace.period
        self.turn: tuple[float, float] | None = None
        self.after: CurveLaw | None = None
        self.beyond = 0.0
        self.sensing: Sensing | None = None
        self.begin()

    def lead_to(self, after: CurveLaw) -> None:
        """Let another law follow.

        Where the torques with which a contact is made would go on along the next curve, the joints
        are not stopped by it, and the way beyond the end that tells it is short.
        """
        if self.passes:
            self.turn = after.chords[0]
        if self.passes or self.keeps:
            return
        self.after = after
        tau = self._act(len(self.steps) - 1, 1.0, 0.0, 0.0, self.gain * self.pace.touch, True)
        a, _ = find_motion(after.torque[0], tau)
        self.beyond = (FAR if a < -BARRED * self.pace.most else SOON) * self.pace.touch

    def begin(self, at_end: bool = False) -> None:
        """Start anew, at the beginning or just before the end."""
        self.j = len(self.steps) - 1 if at_end else 0
        self.over = self.pushes = False
        self.sum = self.a = self.ran = self.rested = self.drive = self.held = 0.0
        self.limit = AHEAD * self.pace.touch if at_end else self.beyond
        self.s, self.v, self.level = self.nodes[self.j], 0.0, 0.0
        self.off, self.fresh = 0.0, not at_end
        if self.sensing is not None:
            self.sensing.begin()

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        self._measure(float(theta[0]), float(theta[1]), float(rates[0]), float(rates[1]))
        pace, s, v, j = self.pace, self.s, self.v, self.j
        if self.pushes:
            return self._press(theta, rates)
        if self.sensing is not None:
            self.sensing.measure(forces)
        if self.fresh:
            self.fresh, self.off = False, s
        self.ran += pace.period
        half = 0.5 * pace.period
        lead = pace.delay + half
        s += lead * (v + 0.5 * lead * self.a)
        v += lead * self.a
        if self.passes:
            self.over = self._has_turned(rates)
            if self.over:
                return self.push
        if self._is_made(s, v) or (self.sensing and self.sensing.feels):
            self.pushes, self.a = True, 0.0
            return self._press(theta, rates)
        # The reference begins where the motion does.
        off = self.off
        place = s - off * max(1.0 - (s - off) / (CATCH * abs(off)), 0.0) if off else s
        b = self._look(j, place)
        wanted = max(sqrt(b) if b > 0.0 else 0.0, pace.touch)
        if self.after is not None:
            wanted += min(max(s - self.length, 0.0) / GROWTH, FASTEST * pace.touch)
        error = wanted - v
        way = half * max(v, pace.touch)
        planned = (self._look(j, place + way) - self._look(j, place - way)) / (4.0 * way)
        j, share = self._locate(j, s)
        if planned < 0.0 and v < SLOW * wanted:
            planned = 0.0
        self.sum = min(max(self.sum + self.memory * error, -pace.most), pace.most)
        a = planned + self.gain * error + self.sum + self.drive
        slowest = (LEAST_SPEED * pace.touch - (v - half * self.a)) / (pace.period + pace.delay)
        return self._act(j, share, v, planned, max(a, slowest), s >= self.length)

    def hold(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques that press this law's contacts and bring the joints to rest [N m]."""
        self._measure(float(theta[0]), float(theta[1]), float(rates[0]), float(rates[1]))
        v = self.v + (self.pace.delay + 0.5 * self.pace.period) * self.a
        j, share = self._locate(self.j, self.s)
        return self._act(j, share, v, 0.0, -self.gain * v)

    def _is_made(self, s: float, v: float) -> bool:
        """Whether the contact is made, or the end is reached; `s` and `v` are predicted."""
        touch, near = self.pace.touch, s > (1.0 - LAST) * self.length
        started = self.ran > STARTING * self.pace.period
        if self.after is None:
            slow = started and near and self.v < self.pace.still
            return slow or (s >= self.length and v < 3.0 * touch)
        rise = DRIVE * self.pace.most
        if started and near and self.v < STOPPED * touch:
            self.drive += rise / RISE
        else:
            self.drive = 0.0
        limit, self.limit = self.limit, self.beyond
        return self.drive > rise or self.s > self.length + limit

    def _measure(self, one: float, two: float, rate_one: float, rate_two: float) -> None:
        """Place and speed: the joints' projection on the chords next to the last one."""
        j, last, way = self.j, len(self.chords) - 1, 0
        while True:
            node, (e, f), square = self.theta[j], self.chords[j], self.squares[j]
            share = ((one - node[0]) * e + (two - node[1]) * f) / square
            # At a bend two chords may point at one another: none is looked at twice.
            if share > 1.0 and j < last and way >= 0:
                j, way = j + 1, 1
            elif share < 0.0 and j > 0 and way <= 0:
                j, way = j - 1, -1
            else:
                break
        h = self.steps[j]
        self.j, self.s = j, self.nodes[j] + share * h
        self.v = (rate_one * e + rate_two * f) / square * h

    def _has_turned(self, rates: Sequence[float]) -> bool:
        """Whether an impact has turned the joints' motion to where the next curve leads them."""
        if self.s < (1.0 - NEAR) * self.length or self.turn is None:
            return False
        if self.s > self.length + LATE * self.pace.period * self.v:
            return True
        (e, f), (g, h), (one, two) = self.chords[-1], self.turn, rates
        across = abs(one * f - two * e) / sqrt(self.squares[-1])
        return bool(abs(one * h - two * g) / sqrt(g * g + h * h) < across)

    def _locate(self, j: int, s: float) -> tuple[int, float]:
        """Interval of a place, looked for from interval `j` on, and the share of it, 0 to 1."""
        nodes, last = self.nodes, len(self.steps) - 1
        while j < last and s > nodes[j + 1]:
            j += 1
        while j > 0 and s < nodes[j]:
            j -= 1
        return j, min(max((s - nodes[j]) / self.steps[j], 0.0), 1.0)

    def _look(self, j: int, s: float) -> float:
        """The reference's b at a place near interval `j`."""
        j, share = self._locate(j, s)
        return float(self.b[j] + share * (self.b[j + 1] - self.b[j]))

    def _find_floor(self) -> list[float]:
        """Level on each interval below which feedback gives way."""
        found = []
        for j, h in enumerate(self.steps):
            b, after = self.b[j], self.b[j + 1]
            a, level = (after - b) / (2 * h), 1e30
            for share, own in ((0.0, b), (1.0, after)):
                level = min(level, choose_squeeze(*self._list_levels(j, share, sqrt(own)), a)[0])
            found.append(min(LEVEL, PART * level))
        return found

    def _list_levels(
        self, j: int, share: float, v: float
    ) -> tuple[list[float], list[float], list[float]]:
        """Levels at a place and a speed without a and squeeze, and their changes with these."""
        b = v * v
        base, rates, press = [], [], []
        for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in zip(
            self.levels[j], self.level_rises[j], strict=True
        ):
            base.append(c + share * d + (cb + share * db) * b + (cv + share * dv) * v)
            rates.append(ca + share * da)
            press.append(cl + share * dl)
        return base, rates, press

    def _act(
        self, j: int, share: float, v: float, planned: float, a: float, beyond: bool = False
    ) -> tuple[float, float]:
        """Torques for an acceleration, as far as limits allow it; those of the arrival `beyond`."""
        b = v * v
        base, rates, press = self._list_levels(j, share, v)
        level, squeeze = choose_squeeze(base, rates, press, a)
        floor = self.floor[j]
        if level < floor:
            safe, other = choose_squeeze(base, rates, press, planned)
            if safe > floor:
                # Least levels are concave in a: this part of the way keeps the level.
                a = planned + (safe - floor) / (safe - level) * (a - planned)
                level, squeeze = choose_squeeze(base, rates, press, a)
            elif safe > level:
                a, level, squeeze = planned, safe, other
        elif beyond:
            for c, cb, cv, ca, cl in self.arrival:
                base.append(c + cb * b + cv * v)
                rates.append(ca)
                press.append(cl)
            both, other = choose_squeeze(base, rates, press, a)
            if both > LEAST:
                level, squeeze = both, other
        self.a, self.level = a, level
        tau, low, high = list[tuple[float, float]](), -1e30, 1e30
        for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in zip(
            self.torque[j], self.torque_rises[j], strict=True
        ):
            moving = c + share * d + (cb + share * db) * b + (cv + share * dv) * v
            tau.append((moving + (ca + share * da) * a, cl + share * dl))
        one, two = self.pace.limit
        if self.sensing is not None and self.sensing.heard and not beyond:
            for (moving, by), most in zip(tau, (one, two), strict=True):
                if by:
                    ends = sorted(((-most - moving) / by, (most - moving) / by))
                    low, high = max(low, ends[0] - squeeze), min(high, ends[1] - squeeze)
            if low <= high:
                squeeze += self.sensing.shift((j, share, v, a, squeeze), low, high)
        first, second = (moving + by * squeeze for moving, by in tau)
        return min(max(first, -one), one), min(max(second, -two), two)

    def _press(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """The torques at the end, until the joints have stood still."""
        pace, tau, v, dwell = self.pace, self.push, self.v, self.pace.dwell
        if self.after is not None:
            tau = self.after.hold(theta, rates)
            # Where friction is less than it may be, the joints creep on.
            self.held += pace.period
            v = 0.0 if self.held > LONGEST * dwell else self.after.v
        elif self.s < (1.0 - THERE) * self.length:
            dwell *= SHORT
        self.rested = self.rested + pace.period if abs(v) < pace.still else 0.0
        self.over = self.rested > dwell + pace.delay
        return tau


def _split(table: Any, most: float | None = None) -> tuple[list[Rows], list[Rows]]:
    """Rows at the start of each interval and what they rise by, without those that never count."""
    first, rises = table[:, 0], table[:, 1] - table[:, 0]
    if most is None:
        return first.tolist(), rises.tolist()
    counts = table[:, :, :, 0].min(axis=1) < most
    pairs = zip(first, rises, counts, strict=True)
    kept = [(rows[own].tolist(), rise[own].tolist()) for rows, rise, own in pairs]
    return [rows for rows, _ in kept], [rise for _, rise in kept]
