"""The law of a phase along a curve: joints say where on it the hand is, and how fast.

A table over the arc length s has the joint angles, the reference b = s'^2, torques and limits; the
last two are affine in a, b, s' and the squeeze (`curve_rows`). A step

* projects the joint angles onto the table, next to where they were, and the joint speeds along it;
* predicts both for the middle of the time in which its torques hold;
* asks for a = the reference's mean a over that time + gains on the reference's speed less s';
* takes the squeeze with the largest least level of all limits, and where that is below `LEVEL`
  goes back from a towards the reference as far as it takes.

At the end, when the joints all but stand still at the place of the contact that is gained, torques
that balance with it and drive on without it hold until the joints have stood still for a while.

Plain numbers and lists are several times as fast as arrays that are as short as these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import Any, NamedTuple

LEVEL, PART = 1.0, 0.5
"""Level of limits below which feedback gives way, in reserves: at most the first, and at most the
second times that of the reference, which may have less."""
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
SAME = 1e-12
"""Difference of levels that is none."""


class Pace(NamedTuple):
    """What the laws of all phases have in common.

    Attributes
    ----------
    period : float, [s]
        Of the control loop.
    delay : float, [s]
        Time from measuring to when torques take effect, as far as it is known.
    touch : float, [m/s]
        Speed s' at which contacts are made.
    still : float, [m/s]
        Speed s' that counts as none.
    dwell : float, [s]
        How long the joints stand still before the next phase begins.
    most : float, [m/s^2]
        Largest a of the integral.
    limit : tuple of two float, [N m]
        Of the torques.
    """

    period: float
    delay: float
    touch: float
    still: float
    dwell: float
    most: float
    limit: tuple[float, float]


Rows = list[list[float]]


class CurveLaw:
    """The law of one phase, of which none is passed before it is over.

    Parameters
    ----------
    tables : mapping of str to ndarray
        `s`, (n,); `theta`, (n, 2); `b`, (n,), at nodes; `levels`, (n - 1, 2, m, 5), and `torque`,
        (n - 1, 2, 2, 5), at both ends of the intervals; `push`, (2,); `passes`, (1,), not zero
        where the end is passed at speed.
    pace : Pace

    Attributes
    ----------
    over : bool
        Whether the next phase may begin.
    pushes : bool
        Whether the contact is being pressed.
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
        self.begin()

    def begin(self, at_end: bool = False) -> None:
        """Start anew, at the beginning or just before the end."""
        self.j = len(self.steps) - 1 if at_end else 0
        self.over = self.pushes = False
        self.sum = self.a = self.ran = self.rested = 0.0
        self.s, self.v, self.level = self.nodes[self.j], 0.0, 0.0
        self.off, self.fresh = 0.0, not at_end

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        self._measure(float(theta[0]), float(theta[1]), float(rates[0]), float(rates[1]))
        pace, s, v, j = self.pace, self.s, self.v, self.j
        if self.pushes:
            return self._press()
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
        slow = self.v < pace.still and self.ran > STARTING * pace.period
        if (s >= self.length and v < 3.0 * pace.touch) or (slow and s > (1.0 - LAST) * self.length):
            self.pushes = True
            return self._press()
        # The reference begins where the motion does.
        off = self.off
        place = s - off * max(1.0 - (s - off) / (CATCH * abs(off)), 0.0) if off else s
        b = self._look(j, place)
        wanted = max(sqrt(b) if b > 0.0 else 0.0, pace.touch)
        error = wanted - v
        way = half * max(v, pace.touch)
        planned = (self._look(j, place + way) - self._look(j, place - way)) / (4.0 * way)
        j, share = self._locate(j, s)
        if planned < 0.0 and v < SLOW * wanted:
            planned = 0.0
        self.sum = min(max(self.sum + self.memory * error, -pace.most), pace.most)
        a = planned + self.gain * error + self.sum
        slowest = (LEAST_SPEED * pace.touch - (v - half * self.a)) / (pace.period + pace.delay)
        return self._act(j, share, v, planned, max(a, slowest))

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
                v, base, rates, press = sqrt(own), [], [], []
                for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in zip(
                    self.levels[j], self.level_rises[j], strict=True
                ):
                    base.append(c + share * d + (cb + share * db) * own + (cv + share * dv) * v)
                    rates.append(ca + share * da)
                    press.append(cl + share * dl)
                level = min(level, choose_squeeze(base, rates, press, a)[0])
            found.append(min(LEVEL, PART * level))
        return found

    def _act(self, j: int, share: float, v: float, planned: float, a: float) -> tuple[float, float]:
        """Torques for an acceleration, as far as limits allow it."""
        b = v * v
        base, rates, press = [], [], []
        for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in zip(
            self.levels[j], self.level_rises[j], strict=True
        ):
            base.append(c + share * d + (cb + share * db) * b + (cv + share * dv) * v)
            rates.append(ca + share * da)
            press.append(cl + share * dl)
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
        self.a, self.level = a, level
        tau = []
        for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in zip(
            self.torque[j], self.torque_rises[j], strict=True
        ):
            moving = c + share * d + (cb + share * db) * b + (cv + share * dv) * v
            tau.append(moving + (ca + share * da) * a + (cl + share * dl) * squeeze)
        one, two = self.pace.limit
        return min(max(tau[0], -one), one), min(max(tau[1], -two), two)

    def _press(self) -> tuple[float, float]:
        """The torques at the end, until the joints have stood still."""
        pace = self.pace
        self.a = 0.0
        self.rested = self.rested + pace.period if abs(self.v) < pace.still else 0.0
        there = self.s > (1.0 - THERE) * self.length
        self.over = self.rested > (1.0 if there else SHORT) * pace.dwell + pace.delay
        return self.push[0], self.push[1]


def _split(table: Any, most: float | None = None) -> tuple[list[Rows], list[Rows]]:
    """Rows at the start of each interval and what they rise by, without those that never count."""
    first, rises = table[:, 0], table[:, 1] - table[:, 0]
    if most is None:
        return first.tolist(), rises.tolist()
    counts = table[:, :, :, 0].min(axis=1) < most
    pairs = zip(first, rises, counts, strict=True)
    kept = [(rows[own].tolist(), rise[own].tolist()) for rows, rise, own in pairs]
    return [rows for rows, _ in kept], [rise for _, rise in kept]


def choose_squeeze(
    base: Sequence[float], rates: Sequence[float], press: Sequence[float], a: float
) -> tuple[float, float]:
    """The largest least level of limits base + rates a + press squeeze, and its squeeze.

    Of two limits that the squeeze moves to and fro, no squeeze has a larger least level than where
    they meet. The limit that is least there takes the place of one of them, until it is one.
    """
    lines = [(p + rate * a, q) for p, rate, q in zip(base, rates, press, strict=True)]
    ups, downs = [own for own in lines if own[1] > 0.0], [own for own in lines if own[1] < 0.0]
    flat = min([p for p, q in lines if q == 0.0], default=1e30)
    if not ups or not downs:
        return flat, 0.0
    # Begun with those that meet where the squeeze is what it would be without either.
    (p, q), (u, w) = min(ups), min(downs)
    level, squeeze = 1e30, 0.0
    while True:
        meets = (u * q - p * w) / (q - w)
        if meets >= level:
            break
        level, squeeze = meets, (u - p) / (q - w)
        least = level
        for c, d in lines:
            value = c + d * squeeze
            if value < least:
                least, last = value, (c, d)
        if least > level - SAME * (1.0 + abs(level)):
            break
        if last[1] > 0.0:
            p, q = last
        elif last[1] < 0.0:
            u, w = last
        else:
            break
    return min(level, flat), squeeze
