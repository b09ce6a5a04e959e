"""Control laws of a policy: along a curve, over time, and with measured contact forces.

Along a curve a table over the arc length s has joint angles, the reference b = s'^2, torques and
limits, affine in a, b, s' and the internal force (`make`). Each period of `CurveLaw`

* projects joint angles and speeds onto the table: s and s';
* predicts both for the middle of the interval in which its torques are held;
* asks for a = mean reference a + proportional and integral feedback on the speed;
* takes the internal force with the largest least normalized slack (slack over robustness margin) of
  all limits and, if that is below its floor, moves a towards the reference until it is kept.

At the end the motion continues at touching speed until the joints stop while the drive rises, or
until they are well beyond the end: the contact is made. The torques of the next law then hold the
joints at rest. If that law is not along a curve, stored torques hold them.

Numbers and lists of Python are several times as fast as arrays of this size.
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

TOLERANCE = 1e-12  # relative tolerance of normalized slack and of determinants


@dataclass(frozen=True)
class LawSettings:
    """Gains and thresholds of the laws along a curve, over time and with measured forces."""

    # Gain on the speed, times the sum of period and delay; on its integral, over the square of that
    # on the speed; largest feedback torque of a law over time, over the torque limit.
    gain: float = 0.25
    integral: float = 0.2
    feedback: float = 0.3
    # Normalized slack below which feedback is reduced: absolute, and over that of the reference.
    # Case: phase 2 of heptagon_four_contacts, which loses v0-palm where braking begins.
    slack_floor: float = 1.5
    relative_floor: float = 0.75
    arrival: float = 0.02  # last fraction of the curve, in which standing still is an arrival
    impact: float = 0.1  # last fraction of the curve, in which an impact is expected
    timeout: float = 5.0  # periods after which an impact that joints do not show counts as over
    shift: float = 10.0  # distance over which the reference is shifted, over the start error
    rise_time: float = 0.01  # in which the speed beyond the end grows by the touching speed [s]
    growth: float = 4.0  # largest growth of the speed beyond the end, over the touching speed
    # Drive that stopped joints have to withstand, over the largest a of the integral. Case: phase 2
    # of heptagon_four_contacts, which does not end without it. Six times as much lifts an object
    # that slides easily: a pentagon of 0.3 kg with friction of 0.05 (in the tests).
    stall_drive: float = 0.05
    creep_dwells: float = 3.0  # dwell times after which joints may creep: with low friction they do
    # Distance beyond the end at which a contact counts as made although it has not stopped the
    # joints, as time at touching speed [s]: 0.5 mm, the largest effect of errors of geometry. Case:
    # hexagon, phase 2, which loses v0-palm in an eighth of the samples with 0.2 mm.
    overrun_time: float = 0.3
    # Laws over time: periods of standing still after which a contact counts as made, and time for
    # the search for it beyond the end [s]. Case: hexagon, phase 7, ends 0.3 mm before its contact.
    stop_periods: float = 10.0
    search_time: float = 0.1
    # Measured forces: weight of the last sample in the bias; force of a closed contact and least
    # reference force, over the mean of all contacts.
    bias_weight: float = 0.3
    contact_force: float = 0.1
    least_force: float = 0.2


LAW = LawSettings()
Row = tuple[float, ...]  # a slack or a torque: constant, coefficients of a and internal force
Ends = list[list[list[float]]]
"""Rows of an interval: of each the five coefficients at its start, and their change to its end."""


class CurveLaw:
    """Control law along a curve, of one phase or of several in which contacts change their names.

    Parameters
    ----------
    tables  `starts`, (k,), places where phases begin; `s`, (n,); `theta`, (n, 2); `b`, (n,), at
            nodes; `levels`, (n - 1, 2, m, 5), normalized slack of limits, and `torque`,
            (n - 1, 2, 2, 5), at both ends of the intervals; `push`, (2,), final torques;
            `passes`, (1,): the end is passed at speed; `keeps`, (1,): `push` is held until the next
            law begins

    Attributes
    ----------
    finished      whether the next phase may begin
    contact_made  whether the contact at the end has been made
    passed        number of passed phases
    next_chord    first chord of the next law along a curve, if that is entered in motion
    brake         next law along a curve, if `push` is held until it begins
    successor     next law along a curve, if it holds the joints at the end
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
        self.holds_push = bool(tables["keeps"][0])
        self.steps = [after - before for before, after in pairwise(self.nodes)]
        self.borders = [self.nodes.index(start) for start in self.starts[1:]]
        self.chords = [(c - a, d - b) for (a, b), (c, d) in pairwise(self.theta)]
        self.chord_squares = [one * one + two * two or 1e-30 for one, two in self.chords]
        # Speeds by chords would step at nodes where joint angles bend. Case: hexagon, phase 5.
        self.slopes = np.gradient(tables["theta"], tables["s"], axis=0).tolist()
        self.slack, self.torque = _split(tables["levels"], most=1e6), _split(tables["torque"])
        # Least normalized slack on each interval, below which feedback is reduced.
        self.floor = list[float]()
        for j, (h, b_ends) in enumerate(zip(self.steps, pairwise(self.b), strict=True)):
            ends = [_evaluate(self.slack[j], k, sqrt(b)) for k, b in enumerate(b_ends)]
            slack = min(_choose_at(rows, (b_ends[1] - b_ends[0]) / (2 * h))[0] for rows in ends)
            self.floor.append(min(LAW.slack_floor, LAW.relative_floor * slack))
        self.gain = LAW.gain / (settings.period + settings.delay)
        self.k_i = LAW.integral * self.gain**2 * settings.period
        self.overrun = LAW.overrun_time * settings.touch
        follower = following if isinstance(following, CurveLaw) else None
        self.next_chord = follower.chords[0] if follower and self.passes else None
        self.brake = follower if self.holds_push and not self.passes else None
        self.successor = follower if not self.holds_push and not self.passes else None
        self.filter: ForceFilter | None = None
        self.begin()

    def begin(self, at_end: bool = False) -> None:
        """Reset to the beginning or to just before the end."""
        self.j = len(self.steps) - 1 if at_end else 0
        self.passed = len(self.starts) - 1 if at_end else 0
        self.finished = self.contact_made = False
        self.integral = self.a = self.elapsed = self.rest_time = self.drive = self.dwell_time = 0.0
        self.s, self.v = self.nodes[self.j], 0.0
        self.start_error, self.first_step = 0.0, not at_end
        if self.filter is not None:
            self.filter.begin()

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        self._measure(theta, rates)
        settings, s, v = self.settings, self.s, self.v
        if self.contact_made:
            return self._dwell(theta, rates)
        if self.filter is not None:
            self.filter.measure(forces, self.passed)
        if self.first_step:
            self.first_step, self.start_error = False, s
        self.elapsed += settings.period
        half = 0.5 * settings.period
        lead = settings.delay + half
        s += lead * (v + 0.5 * lead * self.a)
        v += lead * self.a
        if self.passes:
            self.finished = self._has_turned(rates)
            if self.finished:
                return self.push
        # A gained contact counts as made if it has force in two consecutive samples.
        if self._detect_contact(s, v) or (self.filter and self.filter.contact_samples > 1):
            self.contact_made, self.a = True, 0.0
            return self._dwell(theta, rates)
        # The reference begins where the motion does.
        shift = self.start_error
        place = s - shift * max(1.0 - (s - shift) / (LAW.shift * abs(shift)), 0.0) if shift else s
        b = self._find_b(place)
        v_ref = max(sqrt(b) if b > 0.0 else 0.0, settings.touch)
        if self.successor is not None:
            v_ref += min(max(s - self.length, 0.0) / LAW.rise_time, LAW.growth * settings.touch)
        error = v_ref - v
        reach = half * max(v, settings.touch)
        a_ref = (self._find_b(place + reach) - self._find_b(place - reach)) / (4.0 * reach)
        j, fraction = self._locate(s)
        # A motion that is much slower than the reference does not brake with it.
        if a_ref < 0.0 and v < 0.5 * v_ref:
            a_ref = 0.0
        self.integral = min(max(self.integral + self.k_i * error, -settings.most), settings.most)
        a = a_ref + self.gain * error + self.integral + self.drive
        # Faster than 0.4 of the touching speed, so that no friction reverses while braking.
        least = (0.4 * settings.touch - (v - half * self.a)) / (settings.period + settings.delay)
        # A mean of the reference over a border holds on neither side. Case: query 32, phase 6.
        intervals = [j, *(k - (j >= k) for k in self.borders if abs(self.nodes[k] - s) < reach)][:2]
        local = [(self.b[k + 1] - self.b[k]) / (2.0 * self.steps[k]) for k in intervals]
        across = intervals[1] if intervals[1:] else None
        return self._limit(j, fraction, v, [a_ref, *local], max(a, least), s >= self.length, across)

    def hold(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques that press this law's contacts and bring the joints to rest [N m]."""
        self._measure(theta, rates)
        v = self.v + (self.settings.delay + 0.5 * self.settings.period) * self.a
        j, fraction = self._locate(self.s)
        return self._limit(j, fraction, v, [0.0], -self.gain * v)

    def slow_down(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques that bring the joints to rest, without those that press contacts [N m]."""
        self._measure(theta, rates)
        j, fraction = self._locate(self.s)
        (_, torque1, _), (_, torque2, _) = _evaluate(self.torque[j], fraction, self.v)
        return -self.gain * self.v * torque1, -self.gain * self.v * torque2

    def _detect_contact(self, s: float, v: float) -> bool:
        """Whether the contact is made, or the end is reached; `s` and `v` are predicted."""
        # Standing still counts from some periods after the start on.
        touch, near = self.settings.touch, s > (1.0 - LAW.arrival) * self.length
        started = self.elapsed > 10 * self.settings.period
        if self.successor is None:
            slow = started and near and self.v < self.settings.still
            return slow or (s >= self.length and v < 3.0 * touch)
        rise = LAW.stall_drive * self.settings.most
        if started and near and self.v < 0.3 * touch:
            self.drive += rise / 2
        else:
            self.drive = 0.0
        return self.drive > rise or self.s > self.length + self.overrun

    def _measure(self, theta: Sequence[float], rates: Sequence[float]) -> None:
        """Set s and s': projection of the joints onto the chords, from the last chord on."""
        theta1, theta2, last = float(theta[0]), float(theta[1]), len(self.chords) - 1
        j, step = self.j, 0
        while True:
            node, (e, f), square = self.theta[j], self.chords[j], self.chord_squares[j]
            fraction = ((theta1 - node[0]) * e + (theta2 - node[1]) * f) / square
            # At a bend two chords may point at one another: the search keeps its direction.
            if fraction > 1.0 and j < last and step >= 0:
                j, step = j + 1, 1
            elif fraction < 0.0 and j > 0 and step <= 0:
                j, step = j - 1, -1
            else:
                break
        self.j, self.s = j, self.nodes[j] + fraction * self.steps[j]
        (e, f), (g, h), fraction = self.slopes[j], self.slopes[j + 1], min(max(fraction, 0.0), 1.0)
        e, f = e + fraction * (g - e), f + fraction * (h - f)
        self.v = (float(rates[0]) * e + float(rates[1]) * f) / (e * e + f * f or 1e-30)
        while self.passed + 1 < len(self.starts) and self.s >= self.starts[self.passed + 1]:
            self.passed += 1

    def _has_turned(self, rates: Sequence[float]) -> bool:
        """Whether an impact has turned the joint velocity to the direction of the next curve."""
        if self.s < (1.0 - LAW.impact) * self.length or self.next_chord is None:
            return False
        if self.s > self.length + LAW.timeout * self.settings.period * self.v:
            return True
        (e, f), (g, h), (rate1, rate2) = self.chords[-1], self.next_chord, rates
        off_curve = abs(rate1 * f - rate2 * e) / sqrt(self.chord_squares[-1])
        return bool(abs(rate1 * h - rate2 * g) / sqrt(g * g + h * h) < off_curve)

    def _locate(self, s: float) -> tuple[int, float]:
        """Interval of a place, and the fraction of it before the place, 0 to 1."""
        j = min(max(bisect_left(self.nodes, s) - 1, 0), len(self.steps) - 1)
        return j, min(max((s - self.nodes[j]) / self.steps[j], 0.0), 1.0)

    def _find_b(self, s: float) -> float:
        """The reference's b at a place."""
        j, fraction = self._locate(s)
        return float(self.b[j] + fraction * (self.b[j + 1] - self.b[j]))

    def _slack_across(self, torques: Sequence[Row], j: int, fraction: float, v: float) -> list[Row]:
        """Slack at another place under the torques here, affine in a and internal force here."""
        (p, d, e), (q, f, g) = _evaluate(self.torque[j], fraction, v)
        determinant = d * g - e * f
        if abs(determinant) <= TOLERANCE * (abs(d * g) + abs(e * f)):
            return []
        # a and internal force there, of 1, a and internal force here
        (first, *rest) = zip(*torques, strict=True)
        pairs = [(first[0] - p, first[1] - q), *rest]
        motions = [((g * t - e * u) / determinant, (d * u - f * t) / determinant) for t, u in pairs]
        return [
            tuple((k == 0) * slack + by_a * a + by_l * lam for k, (a, lam) in enumerate(motions))
            for slack, by_a, by_l in _evaluate(self.slack[j], fraction, v)
        ]

    def _limit(
        self,
        j: int,
        fraction: float,
        v: float,
        reference: Sequence[float],
        a: float,
        at_end: bool = False,
        across: int | None = None,
    ) -> tuple[float, float]:
        """Torques for an acceleration, within limits [N m].

        Below the floor of the slack, a is moved towards the best of the `reference` accelerations.
        `across` is an interval beyond a border whose limits the same torques keep. `at_end` is
        whether the place is at or beyond the end, where there are no reference forces.
        """
        rows, torques = (_evaluate(table[j], fraction, v) for table in (self.slack, self.torque))
        requested, floor = a, self.floor[j]
        a, _, internal = _choose_motion(rows, reference, requested, floor)
        if across is not None:
            rows += self._slack_across(torques, across, float(across < j), v)
            candidate = _choose_motion(rows, reference, requested, floor)
            # If none keep both, the limits of the longer part are kept. Case: query 32, phase 6.
            if candidate[1] > 0.0:
                a, _, internal = candidate
        self.a = a
        tau = [(base + by_a * a, by_l) for base, by_a, by_l in torques]
        low, high = -1e30, 1e30
        limit1, limit2 = self.settings.limit
        if self.filter is not None and self.filter.available and not at_end:
            for (base, by_l), limit in zip(tau, (limit1, limit2), strict=True):
                if by_l:
                    bounds = sorted(((-limit - base) / by_l, (limit - base) / by_l))
                    low, high = max(low, bounds[0] - internal), min(high, bounds[1] - internal)
            if low <= high:
                internal += self.filter.shift((j, fraction, v, a, internal), low, high)
        first, second = (base + by_l * internal for base, by_l in tau)
        return min(max(first, -limit1), limit1), min(max(second, -limit2), limit2)

    def _dwell(self, theta: Sequence[float], rates: Sequence[float]) -> tuple[float, float]:
        """Torques at the end, until the joints have been at rest for the dwell time."""
        settings, tau, v, dwell = self.settings, self.push, self.v, self.settings.dwell
        if self.successor is not None:
            tau = self.successor.hold(theta, rates)
            # With low friction the joints creep on.
            self.dwell_time += settings.period
            v = 0.0 if self.dwell_time > LAW.creep_dwells * dwell else self.successor.v
        elif self.brake is not None:
            pairs = zip(self.push, self.brake.slow_down(theta, rates), strict=True)
            tau = tuple(torque + brake for torque, brake in pairs)
            v = self.brake.v
        elif self.s < (1.0 - 1e-3) * self.length:
            # The joints have stopped before the end.
            dwell *= 4.0
        self.rest_time = self.rest_time + settings.period if abs(v) < settings.still else 0.0
        self.finished = self.rest_time > dwell + settings.delay
        return tau


def _evaluate(rows: Ends, fraction: float, v: float) -> list[Row]:
    """Rows of an interval at a fraction of it and a speed."""
    b = v * v
    return [
        (
            c + fraction * d + (cb + fraction * db) * b + (cv + fraction * dv) * v,
            ca + fraction * da,
            cl + fraction * dl,
        )
        for (c, cb, cv, ca, cl), (d, db, dv, da, dl) in rows
    ]


def _choose_at(rows: Sequence[Row], a: float) -> tuple[float, float]:
    """Max-min slack for an acceleration, and the internal force that has it."""
    return choose_internal_force([(base + by_a * a, by_l) for base, by_a, by_l in rows])


def _choose_motion(
    rows: Sequence[Row], planned: Sequence[float], a: float, floor: float
) -> tuple[float, float, float]:
    """a, least slack and internal force; below the floor a moves to the best `planned` one."""
    slack, internal = _choose_at(rows, a)
    if slack >= floor:
        return a, slack, internal
    (safe_slack, safe_internal), safe_a = max((_choose_at(rows, each), each) for each in planned)
    if safe_slack > floor:
        # The least slack is concave in a: this interpolation keeps the floor.
        a = safe_a + (safe_slack - floor) / (safe_slack - slack) * (a - safe_a)
        return (a, *_choose_at(rows, a))
    return (safe_a, safe_slack, safe_internal) if safe_slack > slack else (a, slack, internal)


def _split(table: Any, most: float = inf) -> list[Ends]:
    """Rows of each interval at its start and their changes to its end; none of `most` or more.

    Coefficients of the internal force that are 0 but for rounding are set to 0.
    """
    magnitude, table = abs(table[..., 4]), table.copy()
    table[..., 4][magnitude <= 1e-9 * magnitude.max(initial=0.0)] = 0.0
    pairs = np.stack([table[:, 0], table[:, 1] - table[:, 0]], axis=2)
    active = table[..., 0].min(axis=1) < most
    return [rows[k].tolist() for rows, k in zip(pairs, active, strict=True)]


class LoopSettings(NamedTuple):
    """Settings that the laws of all phases share."""

    period: float  # [s]: of the control loop
    delay: float  # [s]: expected time from measuring to applying torques
    touch: float  # [m/s]: speed s' at which contacts are made
    still: float  # [m/s]: speed s' below which the motion is at rest
    dwell: float  # [s]: time at rest before the next phase begins
    most: float  # [m/s^2]: largest a of the integral feedback
    limit: tuple[float, float]  # [N m]: torque limits


class TimeLaw:
    """Control law of phases that pass into one another in motion: tracking over time.

    Parameters
    ----------
    tables  `starts`, (m,), of the phases [s]; `step`, (1,), of the samples that follow [s];
            `theta`, `rates`, `tau`, (n, 2); `gain`, (n, 2, 4), on errors of angles and speeds, the
            last one to hold the end; `push`, (2,), torques there; `still`, (1,), joint speed below
            which the joints are at rest [rad/s]; `ways`, (f, 2), orthonormal basis of free joint
            displacements at the end; `approach`, (2,), joint speeds of the search for the contact
            beyond the end, with the last of `tau` [rad/s]; zero without a search

    Attributes
    ----------
    finished, contact_made, passed  as of `CurveLaw`
    """

    passes = False

    def __init__(
        self, tables: Mapping[str, Any], settings: LoopSettings, following: Law | None = None
    ) -> None:
        self.settings, self.starts = settings, tables["starts"].tolist()
        self.interval, self.still = float(tables["step"][0]), float(tables["still"][0])
        self.theta, self.rates = tables["theta"].tolist(), tables["rates"].tolist()
        self.tau, self.gain = tables["tau"].tolist(), tables["gain"].tolist()
        self.push, self.approach = tables["push"].tolist(), tables["approach"].tolist()
        self.free_basis = tables["ways"].tolist()
        self.end = self.interval * (len(self.theta) - 1)
        self.gains_contact = len(self.free_basis) < 2  # a contact that is gained leaves less free
        # The next law along a curve presses its contacts before it begins.
        self.successor = following if isinstance(following, CurveLaw) else None
        self.begin()

    def begin(self, at_end: bool = False) -> None:
        """Reset to the beginning or to the end."""
        # The motion begins when its first torques take effect.
        self.time = self.end if at_end else -self.settings.delay
        self.passed = len(self.starts) - 1 if at_end else 0
        self.finished = self.contact_made = False
        self.rest_time = self.dwell_time = 0.0

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        settings, now = self.settings, self.time
        self.time = now + settings.period
        lead = settings.delay + 0.5 * settings.period
        following = self.passed + 1
        # A phase begins with its torques: these are interpolated.
        if following < len(self.starts) and now + lead + self.interval >= self.starts[following]:
            self.passed = following
        if now >= self.end:
            resting = max(abs(rates[0]), abs(rates[1])) < self.still
            self.dwell_time += settings.period if self.contact_made else 0.0
            resting = resting or self.dwell_time > LAW.creep_dwells * settings.dwell
            self.rest_time = self.rest_time + settings.period if resting else 0.0
            closed = self.rest_time > LAW.stop_periods * settings.period or not self.gains_contact
            if closed and not self.contact_made:
                self.contact_made, self.rest_time = True, 0.0
            self.finished = self.contact_made and self.rest_time > settings.dwell + settings.delay
            if self.contact_made and self.successor is not None:
                return self.successor.hold(theta, rates)
        k, fraction = self._locate(now)
        (p, q), (u, w) = self.theta[k], self.theta[k + 1]
        (f, g), (c, d) = self.rates[k], self.rates[k + 1]
        rate1 = rates[0] - f - fraction * (c - f)
        rate2 = rates[1] - g - fraction * (d - g)
        error1 = theta[0] - p - fraction * (u - p) + lead * rate1
        error2 = theta[1] - q - fraction * (w - q) + lead * rate2
        k, fraction = self._locate(now + lead)
        torques = []
        search = min(max(now - self.end, 0.0), LAW.search_time)
        closing = self.contact_made or (now >= self.end and not any(self.approach))
        if self.contact_made:
            error1, error2 = self._hold(error1, error2)
        elif closing:
            error1 = error2 = 0.0
        else:
            error1, error2 = error1 - search * self.approach[0], error2 - search * self.approach[1]
        for row in (0, 1):
            first, after = self.tau[k][row], self.tau[k + 1][row]
            if now >= self.end:
                first = after = (self.push if closing else self.tau[-1])[row]
            a, b, c, d = self.gain[-1 if now >= self.end else k][row]
            feedback = a * error1 + b * error2 + c * rate1 + d * rate2
            limit = settings.limit[row]
            feedback = min(max(feedback, -LAW.feedback * limit), LAW.feedback * limit)
            tau = first + fraction * (after - first) - feedback
            torques.append(min(max(tau, -limit), limit))
        return torques[0], torques[1]

    def _hold(self, error1: float, error2: float) -> tuple[float, float]:
        """Projection of angle errors onto the displacements that are free at the end.

        Errors across them are errors of geometry. There is no integral feedback: it would grow as
        long as friction holds an error, until the contact slips.
        """
        parts = [(p * error1 + q * error2, p, q) for p, q in self.free_basis]
        return sum(error * p for error, p, _ in parts), sum(error * q for error, _, q in parts)

    def _locate(self, t: float) -> tuple[int, float]:
        """Sample before a time, and the fraction of the interval after it that has passed."""
        place = min(max(t, 0.0), self.end) / self.interval
        k = min(int(place), len(self.theta) - 2)
        return k, min(place - k, 1.0)


Law = CurveLaw | TimeLaw


class ForceFilter:
    """Filtered errors of the predicted contact forces of a phase.

    Parameters
    ----------
    names                       contacts of each phase, in the order of the table
    gained                      contact that is made at the end of the phase; empty without one
    table : (n, 2, n_c, 5) [N]  forces at both ends of intervals, of 1, s'^2, s', a, internal force
    delay                       of the torques, in periods
    """

    def __init__(
        self, names: Sequence[Sequence[str]], gained: str, table: Any, delay: float
    ) -> None:
        self.names, self.gained_contact = tuple(names), gained
        self.forces = _split(table)
        self.lag_periods = max(ceil(delay - 1e-9), 1)
        self.begin()

    def begin(self) -> None:
        """Reset the filter."""
        self.bias, self.phase = [0.0] * len(self.names[0]), 0
        self.expected: deque[list[float]] = deque(maxlen=self.lag_periods)
        self.available, self.contact_samples = False, 0

    def measure(self, forces: Mapping[str, float] | None, phase: int) -> None:
        """Update the biases by a sample in a phase; missing or NaN contacts have no sensor."""
        if phase != self.phase:
            self.begin()
            self.phase = phase
        self.available = bool(forces)
        if not forces or len(self.expected) < self.lag_periods:
            return
        names = self.names[phase]
        mean = sum(self.expected[0]) / len(names)
        closed = forces.get(self.gained_contact, 0.0) > LAW.contact_force * mean
        self.contact_samples = self.contact_samples + 1 if closed else 0
        for k, (name, expected) in enumerate(zip(names, self.expected[0], strict=True)):
            force = forces.get(name)
            if force is not None and isfinite(force):
                self.bias[k] += LAW.bias_weight * (force - expected - self.bias[k])

    def shift(
        self, place: tuple[int, float, float, float, float], low: float, high: float
    ) -> float:
        """Change of the internal force, from `low` to `high`, that corrects measured errors [N].

        `place` has the interval, the fraction of it, s', a and the internal force of the law.
        """
        j, fraction, v, a, internal = place
        rows = _evaluate(self.forces[j], fraction, v)
        nominal = [base + by_a * a + by_l * internal for base, by_a, by_l in rows]
        rates = [by_l for _, _, by_l in rows]
        least = LAW.least_force * sum(abs(f) for f in nominal) / len(nominal)
        sizes = [max(f, least) or 1.0 for f in nominal]
        terms = zip(nominal, rates, self.bias, sizes, strict=True)
        ratios = [((f + bias) / size, by_l / size) for f, by_l, bias, size in terms]
        # The least change with which all ratios are at least 1, or else the max-min one.
        lower = max([(1.0 - ratio) / rate for ratio, rate in ratios if rate > 0.0], default=-1e30)
        upper = min([(1.0 - ratio) / rate for ratio, rate in ratios if rate < 0.0], default=1e30)
        nearest = min(max(0.0, lower), upper)
        change = nearest if lower <= upper else choose_internal_force(ratios)[1]
        change = min(max(change, low), high)
        self.expected.append([f + by_l * change for f, by_l in zip(nominal, rates, strict=True)])
        return change


def choose_internal_force(lines: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Max-min slack over lines p + q lambda, given as (p, q), and its internal force lambda.

    Active-set method: the optimum is where a rising and a falling line meet; the least line there
    replaces one of them until none is less. Constant lines (q = 0) bound the slack only: lambda is
    the same whether they are active or not.
    """
    rising = [line for line in lines if line[1] > 0.0]
    falling = [line for line in lines if line[1] < 0.0]
    constant = min([p for p, q in lines if q == 0.0], default=1e30)
    lines = rising + falling
    if not rising or not falling:
        return constant, 0.0
    (p, q), (u, w) = min(rising), min(falling)
    slack, internal = 1e30, 0.0
    while True:
        crossing = (u * q - p * w) / (q - w)
        if crossing >= slack:
            break
        slack, internal = crossing, (u - p) / (q - w)
        least = slack
        for c, d in lines:
            value = c + d * internal
            if value < least:
                least, lowest = value, (c, d)
        if least > slack - TOLERANCE * (1.0 + abs(slack)):
            break
        if lowest[1] > 0.0:
            p, q = lowest
        else:
            u, w = lowest
    return min(slack, constant), internal
