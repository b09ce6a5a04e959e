"""Control laws of a policy: along a curve, over time, and with measured contact forces.

Along a curve a table over the arc length s has joint angles, the reference b = s'^2, torques and
limits, affine in a, b, s' and the internal force (`make`). Each period of `CurveLaw`

* projects joint angles and speeds onto the table: s and s';
* predicts both for the middle of the interval in which its torques are held;
* asks for a = mean reference a + proportional and integral feedback on the speed;
* takes the internal force with the largest least level of all limits and, if that level is below
  its floor, moves a towards the reference until it is kept.

At the end the motion continues at touching speed until the joints stop while the drive rises, or
until they are well beyond the end: the contact is made. The torques of the next law then hold the
joints at rest; without one along a curve, stored torques do.

Plain numbers and lists are several times as fast as arrays of this size.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf, isfinite, sqrt
from typing import Any, NamedTuple

import numpy as np

SAME = 1e-12  # difference of levels that counts as none


@dataclass(frozen=True)
class LawSettings:
    """Gains and thresholds of the laws along a curve, over time and with measured forces."""

    # Gain on the speed, times the sum of period and delay; on its integral, over the square of that
    # on the speed; largest feedback torque over time, over the torque limit.
    gain: float = 0.25
    integral: float = 0.2
    share: float = 0.3
    # Level of limits below which feedback is reduced: absolute, and over that of the reference.
    # Case: phase 2 of heptagon_four_contacts, which loses v0-palm where braking begins.
    level: float = 1.5
    part: float = 0.75
    last: float = 0.02  # last part of the curve, on which standing still counts as arrival
    near: float = 0.1  # last part of the curve in which an impact is expected
    late: float = 5.0  # periods after which an impact counts as over, if the joints do not show it
    catch: float = 10.0  # distance over which the reference is shifted, over the error of the start
    growth: float = 0.01  # time over which the touching speed grows beyond the end [s], ...
    fastest: float = 4.0  # ... and how many times by at most
    # Drive that stopped joints have to withstand, over the largest a of the integral. Case: phase 2
    # of heptagon_four_contacts, which does not end without it. Six times as much lifts what slides
    # easily: a pentagon of 0.3 kg with friction of 0.05 (in the tests).
    drive: float = 0.05
    creep: float = 3.0  # dwell times after which joints may creep: with low friction they do
    # Distance beyond the end at which a contact counts as made although it has not stopped the
    # joints, as time at touching speed [s]: 0.5 mm, as errors of geometry at worst. Case: hexagon,
    # phase 2, which loses v0-palm in an eighth of the samples with 0.2 mm.
    beyond: float = 0.3
    # Over time: periods of standing still after which a contact counts as made, and for how long
    # the joints go on beyond the end [s]. Case: hexagon, phase 7, ends 0.3 mm before its contact.
    stop: float = 10.0
    reach: float = 0.1
    # Of measured forces: weight of the last sample in the bias; force of a closed contact and least
    # reference force, over the mean of all.
    smooth: float = 0.3
    felt: float = 0.1
    few: float = 0.2


LAW = LawSettings()
Row = tuple[float, ...]  # a limit or a torque, and its coefficients of a and internal force
Ends = list[list[list[float]]]
"""Of each row of an interval the five coefficients at its start, and their change to its end."""


class CurveLaw:
    """Control law along a curve, of one phase or of several in which contacts change their names.

    Parameters
    ----------
    tables  `starts`, (k,), places where phases begin; `s`, (n,); `theta`, (n, 2); `b`, (n,), at
            nodes; `levels`, (n - 1, 2, m, 5), and `torque`, (n - 1, 2, 2, 5), at both ends of the
            intervals; `push`, (2,), final torques;
            `passes`, (1,): the end is passed at speed; `keeps`, (1,): `push` is held until the next
            law begins

    Attributes
    ----------
    over, pushes  whether the next phase may begin, and whether the contact has been made
    passed        how many of the phases have been passed
    turn          first chord of the next law, if it is along a curve and entered in motion
    brake, after  the next law, if it is along a curve: while `push` is held, or otherwise
    s, v          arc length and speed at the last step
    """

    def __init__(
        self, tables: Mapping[str, Any], settings: LoopSettings, following: Law | None = None
    ) -> None:
        self.passes = bool(tables["passes"][0])
        self.settings, self.nodes = settings, tables["s"].tolist()
        self.starts = tables["starts"].tolist()
        self.length = self.nodes[-1]
        self.theta, self.b = tables["theta"].tolist(), tables["b"].tolist()
        self.push = tuple(tables["push"].tolist())
        self.keeps = bool(tables["keeps"][0])
        self.steps = [after - before for before, after in pairwise(self.nodes)]
        self.borders = [self.nodes.index(start) for start in self.starts[1:]]
        self.chords = [(c - a, d - b) for (a, b), (c, d) in pairwise(self.theta)]
        self.squares = [one * one + two * two or 1e-30 for one, two in self.chords]
        # Speeds by chords would step at nodes where joint angles bend. Case: hexagon, phase 5.
        self.slopes = np.gradient(tables["theta"], tables["s"], axis=0).tolist()
        self.levels, self.torque = _split(tables["levels"], most=1e6), _split(tables["torque"])
        # Level on each interval below which feedback is reduced.
        self.floor = list[float]()
        for j, (h, ends) in enumerate(zip(self.steps, pairwise(self.b), strict=True)):
            rows = [_evaluate(self.levels[j], k, sqrt(b)) for k, b in enumerate(ends)]
            level = min(_choose_at(each, (ends[1] - ends[0]) / (2 * h))[0] for each in rows)
            self.floor.append(min(LAW.level, LAW.part * level))
        self.gain = LAW.gain / (settings.period + settings.delay)
        self.memory = LAW.integral * self.gain**2 * settings.period
        self.beyond = LAW.beyond * settings.touch
        follower = following if isinstance(following, CurveLaw) else None
        self.turn = follower.chords[0] if follower and self.passes else None
        self.brake = follower if self.keeps and not self.passes else None
        self.after = follower if not self.keeps and not self.passes else None
        self.sensing: Sensing | None = None
        self.begin()

    def begin(self, at_end: bool = False) -> None:
        """Start anew, at the beginning or just before the end."""
        self.j = len(self.steps) - 1 if at_end else 0
        self.passed = len(self.starts) - 1 if at_end else 0
        self.over = self.pushes = False
        self.sum = self.a = self.ran = self.rested = self.drive = self.held = 0.0
        self.s, self.v = self.nodes[self.j], 0.0
        self.off, self.fresh = 0.0, not at_end
        if self.sensing is not None:
            self.sensing.begin()

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        self._measure(theta, rates)
        settings, s, v = self.settings, self.s, self.v
        if self.pushes:
            return self._press(theta, rates)
        if self.sensing is not None:
            self.sensing.measure(forces, self.passed)
        if self.fresh:
            self.fresh, self.off = False, s
        self.ran += settings.period
        half = 0.5 * settings.period
        lead = settings.delay + half
        s += lead * (v + 0.5 * lead * self.a)
        v += lead * self.a
        if self.passes:
            self.over = self._has_turned(rates)
            if self.over:
                return self.push
        # A gained contact is felt if it has force in two consecutive samples.
        if self._is_made(s, v) or (self.sensing and self.sensing.felt > 1):
            self.pushes, self.a = True, 0.0
            return self._press(theta, rates)
        # The reference begins where the motion does.
        off = self.off
        place = s - off * max(1.0 - (s - off) / (LAW.catch * abs(off)), 0.0) if off else s
        b = self._look(place)
        wanted = max(sqrt(b) if b > 0.0 else 0.0, settings.touch)
        if self.after is not None:
            wanted += min(max(s - self.length, 0.0) / LAW.growth, LAW.fastest * settings.touch)
        error = wanted - v
        reach = half * max(v, settings.touch)
        planned = (self._look(place + reach) - self._look(place - reach)) / (4.0 * reach)
        j, share = self._locate(s)
        # Much slower than the reference the motion does not brake with it.
        if planned < 0.0 and v < 0.5 * wanted:
            planned = 0.0
        self.sum = min(max(self.sum + self.memory * error, -settings.most), settings.most)
        a = planned + self.gain * error + self.sum + self.drive
        # Faster than 0.4 of the touching speed, so that no friction reverses while braking.
        slowest = (0.4 * settings.touch - (v - half * self.a)) / (settings.period + settings.delay)
        # Over a border the mean of the reference is that of no place. Case: query 32, phase 6.
        sides = [j, *(k - (j >= k) for k in self.borders if abs(self.nodes[k] - s) < reach)][:2]
        local = [(self.b[k + 1] - self.b[k]) / (2.0 * self.steps[k]) for k in sides]
        across = sides[1] if sides[1:] else None
        return self._act(j, share, v, [planned, *local], max(a, slowest), s >= self.length, across)

    def hold(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques that press this law's contacts and bring the joints to rest [N m]."""
        self._measure(theta, rates)
        v = self.v + (self.settings.delay + 0.5 * self.settings.period) * self.a
        j, share = self._locate(self.s)
        return self._act(j, share, v, [0.0], -self.gain * v)

    def slow_down(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques that bring the joints to rest, without those that press contacts [N m]."""
        self._measure(theta, rates)
        j, share = self._locate(self.s)
        (_, one, _), (_, two, _) = _evaluate(self.torque[j], share, self.v)
        return -self.gain * self.v * one, -self.gain * self.v * two

    def _is_made(self, s: float, v: float) -> bool:
        """Whether the contact is made, or the end is reached; `s` and `v` are predicted."""
        # Standing still counts from some periods after the start on.
        touch, near = self.settings.touch, s > (1.0 - LAW.last) * self.length
        started = self.ran > 10 * self.settings.period
        if self.after is None:
            slow = started and near and self.v < self.settings.still
            return slow or (s >= self.length and v < 3.0 * touch)
        rise = LAW.drive * self.settings.most
        if started and near and self.v < 0.3 * touch:
            self.drive += rise / 2
        else:
            self.drive = 0.0
        return self.drive > rise or self.s > self.length + self.beyond

    def _measure(self, theta: Sequence[float], rates: Sequence[float]) -> None:
        """Place and speed: the joints' projection on the chords next to the last one."""
        one, two, j, last, sign = float(theta[0]), float(theta[1]), self.j, len(self.chords) - 1, 0
        while True:
            node, (e, f), square = self.theta[j], self.chords[j], self.squares[j]
            share = ((one - node[0]) * e + (two - node[1]) * f) / square
            # At a bend two chords may point at one another: the search keeps its direction.
            if share > 1.0 and j < last and sign >= 0:
                j, sign = j + 1, 1
            elif share < 0.0 and j > 0 and sign <= 0:
                j, sign = j - 1, -1
            else:
                break
        self.j, self.s = j, self.nodes[j] + share * self.steps[j]
        (e, f), (g, h), share = self.slopes[j], self.slopes[j + 1], min(max(share, 0.0), 1.0)
        e, f = e + share * (g - e), f + share * (h - f)
        self.v = (float(rates[0]) * e + float(rates[1]) * f) / (e * e + f * f or 1e-30)
        while self.passed + 1 < len(self.starts) and self.s >= self.starts[self.passed + 1]:
            self.passed += 1

    def _has_turned(self, rates: Sequence[float]) -> bool:
        """Whether an impact has turned the joint velocity to the direction of the next curve."""
        if self.s < (1.0 - LAW.near) * self.length or self.turn is None:
            return False
        if self.s > self.length + LAW.late * self.settings.period * self.v:
            return True
        (e, f), (g, h), (one, two) = self.chords[-1], self.turn, rates
        across = abs(one * f - two * e) / sqrt(self.squares[-1])
        return bool(abs(one * h - two * g) / sqrt(g * g + h * h) < across)

    def _locate(self, s: float) -> tuple[int, float]:
        """Interval of a place, and the share of it, 0 to 1."""
        j = min(max(bisect_left(self.nodes, s) - 1, 0), len(self.steps) - 1)
        return j, min(max((s - self.nodes[j]) / self.steps[j], 0.0), 1.0)

    def _look(self, s: float) -> float:
        """The reference's b at a place."""
        j, share = self._locate(s)
        return float(self.b[j] + share * (self.b[j + 1] - self.b[j]))

    def _list_levels_across(
        self, torques: Sequence[Row], j: int, share: float, v: float
    ) -> list[Row]:
        """Levels at another place under torques that are affine in this one's a."""
        (p, d, e), (q, f, g) = _evaluate(self.torque[j], share, v)
        size = d * g - e * f
        if abs(size) <= SAME * (abs(d * g) + abs(e * f)):
            return []
        # a and internal force there, of 1, a and internal force here
        (first, *rest) = zip(*torques, strict=True)
        pairs = [(first[0] - p, first[1] - q), *rest]
        motions = [((g * t - e * u) / size, (d * u - f * t) / size) for t, u in pairs]
        return [
            tuple((k == 0) * level + rate * a + by * press for k, (a, press) in enumerate(motions))
            for level, rate, by in _evaluate(self.levels[j], share, v)
        ]

    def _act(
        self,
        j: int,
        share: float,
        v: float,
        planned: Sequence[float],
        a: float,
        beyond: bool = False,
        across: int | None = None,
    ) -> tuple[float, float]:
        """Torques for an acceleration within limits; `beyond` the end no forces are planned.

        Where it keeps them too little it is moved towards that of some `planned` that keeps them
        best. Limits of the interval `across` a border are kept by the same torques.
        """
        rows, torques = (_evaluate(table[j], share, v) for table in (self.levels, self.torque))
        wanted, floor = a, self.floor[j]
        a, _, internal = _choose_motion(rows, planned, wanted, floor)
        if across is not None:
            rows += self._list_levels_across(torques, across, float(across < j), v)
            both = _choose_motion(rows, planned, wanted, floor)
            # Where none keep both, the longer part counts. Case: query 32, phase 6.
            if both[1] > 0.0:
                a, _, internal = both
        self.a = a
        tau = [(moving + by_a * a, by) for moving, by_a, by in torques]
        low, high = -1e30, 1e30
        one, two = self.settings.limit
        if self.sensing is not None and self.sensing.heard and not beyond:
            for (moving, by), most in zip(tau, (one, two), strict=True):
                if by:
                    ends = sorted(((-most - moving) / by, (most - moving) / by))
                    low, high = max(low, ends[0] - internal), min(high, ends[1] - internal)
            if low <= high:
                internal += self.sensing.shift((j, share, v, a, internal), low, high)
        first, second = (moving + by * internal for moving, by in tau)
        return min(max(first, -one), one), min(max(second, -two), two)

    def _press(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques at the end, until the joints have been at rest for the dwell time."""
        settings, tau, v, dwell = self.settings, self.push, self.v, self.settings.dwell
        if self.after is not None:
            tau = self.after.hold(theta, rates)
            # With low friction the joints creep on.
            self.held += settings.period
            v = 0.0 if self.held > LAW.creep * dwell else self.after.v
        elif self.brake is not None:
            pairs = zip(self.push, self.brake.slow_down(theta, rates), strict=True)
            tau = tuple(press + brake for press, brake in pairs)
            v = self.brake.v
        elif self.s < (1.0 - 1e-3) * self.length:
            # The joints have stopped before the end.
            dwell *= 4.0
        self.rested = self.rested + settings.period if abs(v) < settings.still else 0.0
        self.over = self.rested > dwell + settings.delay
        return tau


def _evaluate(rows: Ends, share: float, v: float) -> list[Row]:
    """Rows of an interval at a share of it and a speed."""
    b = v * v
    return [
        (
            c + share * d + (cb + share * db) * b + (cv + share * dv) * v,
            ca + share * da,
            cl + share * dl,
        )
        for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in rows
    ]


def _choose_at(rows: Sequence[Row], a: float) -> tuple[float, float]:
    """Max-min level for an acceleration, and its internal force."""
    return choose_internal_force([(base + by_a * a, by) for base, by_a, by in rows])


def _choose_motion(
    rows: Sequence[Row], planned: Sequence[float], a: float, floor: float
) -> tuple[float, float, float]:
    """a, the least level and the internal force, with a moved to one planned below the floor."""
    level, internal = _choose_at(rows, a)
    if level >= floor:
        return a, level, internal
    (safe, other), best = max((_choose_at(rows, one), one) for one in planned)
    if safe > floor:
        # The least level is concave in a: this interpolation keeps the floor.
        a = best + (safe - floor) / (safe - level) * (a - best)
        return (a, *_choose_at(rows, a))
    return (best, safe, other) if safe > level else (a, level, internal)


def _split(table: Any, most: float = inf) -> list[Ends]:
    """Rows of each interval at its start and their changes to its end, without ignored ones.

    Coefficients of the internal force that are 0 but for rounding are 0.
    """
    size, table = abs(table[..., 4]), table.copy()
    table[..., 4][size <= 1e-9 * size.max(initial=0.0)] = 0.0
    pairs = np.stack([table[:, 0], table[:, 1] - table[:, 0]], axis=2)
    kept = table[..., 0].min(axis=1) < most
    return [rows[k].tolist() for rows, k in zip(pairs, kept, strict=True)]


class LoopSettings(NamedTuple):
    """Settings that the laws of all phases share."""

    period: float  # [s]: of the control loop
    delay: float  # [s]: from measuring to applying torques, as far as known
    touch: float  # [m/s]: speed s' at which contacts are made
    still: float  # [m/s]: speed s' that counts as none
    dwell: float  # [s]: time at rest before the next phase begins
    most: float  # [m/s^2]: largest a of the integral
    limit: tuple[float, float]  # [N m]: of the torques


class MotionLaw:
    """Control law of phases that pass into one another in motion: tracking over time.

    Parameters
    ----------
    tables  `starts`, (m,), of the phases [s]; `step`, (1,), of the samples that follow [s];
            `theta`, `rates`, `tau`, (n, 2); `gain`, (n, 2, 4), on errors of angles and speeds, the
            last one to hold the end; `push`, (2,), torques there; `still`, (1,), joint speed that
            counts as none [rad/s]; `ways`, (f, 2), orthonormal basis of free joint displacements at
            the end; `approach`, (2,), joint speeds at which the contact is looked for beyond the
            end, with the last of `tau` [rad/s]; zero if it is not

    Attributes
    ----------
    over, pushes, passed  as of `CurveLaw`
    """

    passes = False

    def __init__(
        self, tables: Mapping[str, Any], settings: LoopSettings, following: Law | None = None
    ) -> None:
        self.settings, self.starts = settings, tables["starts"].tolist()
        self.every, self.still = float(tables["step"][0]), float(tables["still"][0])
        self.theta, self.rates = tables["theta"].tolist(), tables["rates"].tolist()
        self.tau, self.gain = tables["tau"].tolist(), tables["gain"].tolist()
        self.push, self.approach = tables["push"].tolist(), tables["approach"].tolist()
        self.ways = tables["ways"].tolist()
        self.end = self.every * (len(self.theta) - 1)
        self.lands = len(self.ways) < 2  # a contact that is gained leaves less free
        # It presses its contacts before it begins.
        self.after = following if isinstance(following, CurveLaw) else None
        self.begin()

    def begin(self, at_end: bool = False) -> None:
        """Start anew, at the beginning or at the end."""
        # The motion begins when its first torques take effect.
        self.clock = self.end if at_end else -self.settings.delay
        self.passed = len(self.starts) - 1 if at_end else 0
        self.over = self.pushes = False
        self.rested = self.held = 0.0

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        settings, now = self.settings, self.clock
        self.clock = now + settings.period
        lead = settings.delay + 0.5 * settings.period
        last = self.passed + 1
        # A phase begins with its torques: these are interpolated.
        if last < len(self.starts) and now + lead + self.every >= self.starts[last]:
            self.passed = last
        if now >= self.end:
            stands = max(abs(rates[0]), abs(rates[1])) < self.still
            self.held += settings.period if self.pushes else 0.0
            stands = stands or self.held > LAW.creep * settings.dwell
            self.rested = self.rested + settings.period if stands else 0.0
            made = self.rested > LAW.stop * settings.period or not self.lands
            if made and not self.pushes:
                self.pushes, self.rested = True, 0.0
            self.over = self.pushes and self.rested > settings.dwell + settings.delay
            if self.pushes and self.after is not None:
                return self.after.hold(theta, rates)
        k, share = self._locate(now)
        (p, q), (u, w) = self.theta[k], self.theta[k + 1]
        (f, g), (c, d) = self.rates[k], self.rates[k + 1]
        fast_one = rates[0] - f - share * (c - f)
        fast_two = rates[1] - g - share * (d - g)
        one = theta[0] - p - share * (u - p) + lead * fast_one
        two = theta[1] - q - share * (w - q) + lead * fast_two
        k, share = self._locate(now + lead)
        torques = []
        beyond = min(max(now - self.end, 0.0), LAW.reach)
        closes = self.pushes or (now >= self.end and not any(self.approach))
        if self.pushes:
            one, two = self._hold(one, two)
        elif closes:
            one = two = 0.0
        else:
            one, two = one - beyond * self.approach[0], two - beyond * self.approach[1]
        for row in (0, 1):
            first, after = self.tau[k][row], self.tau[k + 1][row]
            if now >= self.end:
                first = after = (self.push if closes else self.tau[-1])[row]
            a, b, c, d = self.gain[-1 if now >= self.end else k][row]
            feedback = a * one + b * two + c * fast_one + d * fast_two
            most = settings.limit[row]
            feedback = min(max(feedback, -LAW.share * most), LAW.share * most)
            tau = first + share * (after - first) - feedback
            torques.append(min(max(tau, -most), most))
        return torques[0], torques[1]

    def _hold(self, one: float, two: float) -> tuple[float, float]:
        """Angle errors along displacements that are free at the end.

        Those across them are errors of geometry. Integrals would grow as long as friction holds
        any error, until it slips.
        """
        parts = [(p * one + q * two, p, q) for p, q in self.ways]
        return sum(off * p for off, p, _ in parts), sum(off * q for off, _, q in parts)

    def _locate(self, t: float) -> tuple[int, float]:
        """Sample before a time, and the share of the interval after it."""
        place = min(max(t, 0.0), self.end) / self.every
        k = min(int(place), len(self.theta) - 2)
        return k, min(place - k, 1.0)


Law = CurveLaw | MotionLaw


class Sensing:
    """Filtered errors of the predicted contact forces of a phase.

    Parameters
    ----------
    names                       contacts of each phase, in the order of the table
    gained                      the contact that the phase ends with, if it does
    table : (n, 2, n_c, 5) [N]  forces at both ends of intervals, of 1, s'^2, s', a, internal force
    late                        delay of the torques, in periods
    """

    def __init__(
        self, names: Sequence[Sequence[str]], gained: str, table: Any, late: float
    ) -> None:
        self.names, self.gained = tuple(names), gained
        self.forces = _split(table)
        self.lag = max(ceil(late - 1e-9), 1)
        self.begin()

    def begin(self) -> None:
        """Forget what was measured."""
        self.bias, self.phase = [0.0] * len(self.names[0]), 0
        self.expected: deque[list[float]] = deque(maxlen=self.lag)
        self.heard, self.felt = False, 0

    def measure(self, forces: Mapping[str, float] | None, phase: int) -> None:
        """Process a sample in a phase; contacts that are missing or NaN have no sensor."""
        if phase != self.phase:
            self.begin()
            self.phase = phase
        self.heard = bool(forces)
        if not forces or len(self.expected) < self.lag:
            return
        names = self.names[phase]
        mean = sum(self.expected[0]) / len(names)
        presses = forces.get(self.gained, 0.0) > LAW.felt * mean
        self.felt = self.felt + 1 if presses else 0
        for k, (name, expected) in enumerate(zip(names, self.expected[0], strict=True)):
            force = forces.get(name)
            if force is not None and isfinite(force):
                self.bias[k] += LAW.smooth * (force - expected - self.bias[k])

    def shift(
        self, place: tuple[int, float, float, float, float], low: float, high: float
    ) -> float:
        """Change of the internal force within `low` and `high` that corrects measured errors.

        `place` has the interval, the share of it, s', a and the internal force of the law.
        """
        j, share, v, a, internal = place
        rows = _evaluate(self.forces[j], share, v)
        plain = [base + by_a * a + by * internal for base, by_a, by in rows]
        press = [by for _, _, by in rows]
        least = LAW.few * sum(abs(f) for f in plain) / len(plain)
        sizes = [max(f, least) or 1.0 for f in plain]
        entries = zip(plain, press, self.bias, sizes, strict=True)
        ratios = [((f + off) / size, by / size) for f, by, off, size in entries]
        # The least change with which all ratios are at least 1, or else the max-min one.
        lower = max([(1.0 - part) / rate for part, rate in ratios if rate > 0.0], default=-1e30)
        upper = min([(1.0 - part) / rate for part, rate in ratios if rate < 0.0], default=1e30)
        nearest = min(max(0.0, lower), upper)
        change = nearest if lower <= upper else choose_internal_force(ratios)[1]
        change = min(max(change, low), high)
        self.expected.append([f + by * change for f, by in zip(plain, press, strict=True)])
        return change


def choose_internal_force(lines: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Max-min level of limits p + q lambda, given as (p, q), and its internal force lambda.

    Active-set method: the optimum is where a rising and a falling line meet; the least line there
    replaces one of them until none is less. Limits that lambda does not change bound the level
    only: lambda is the same whether they are active or not.
    """
    ups = [line for line in lines if line[1] > 0.0]
    downs = [line for line in lines if line[1] < 0.0]
    flat = min([p for p, q in lines if q == 0.0], default=1e30)
    lines = ups + downs
    if not ups or not downs:
        return flat, 0.0
    (p, q), (u, w) = min(ups), min(downs)
    level, internal = 1e30, 0.0
    while True:
        meets = (u * q - p * w) / (q - w)
        if meets >= level:
            break
        level, internal = meets, (u - p) / (q - w)
        least = level
        for c, d in lines:
            value = c + d * internal
            if value < least:
                least, last = value, (c, d)
        if least > level - SAME * (1.0 + abs(level)):
            break
        if last[1] > 0.0:
            p, q = last
        else:
            u, w = last
    return min(level, flat), internal
