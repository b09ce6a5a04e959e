"""The law of phases with more freedoms: linear feedback of the joints along a motion over time.

The gains are those of a linear-quadratic regulator (`regulator`). Time counts from when the phases
begin, which is when the contact before them is made. At the end torques hold what is reached until
the joints have stood still. From then on only what contacts leave free counts: where numbers are
off, joints that press an object between them are never where they were planned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .pace import Pace

SHARE = 0.3
"""Part of the torque limits that feedback adds at most."""

MEMORY = 30.0
"""Gain on the integral of what the angles are off at the end, over that on the angles [1/s]."""


class MotionLaw:
    """The law of phases that pass into one another in motion.

    Parameters
    ----------
    tables : mapping of str to ndarray
        `starts`, (m,), of the phases [s]; `step`, (1,), of the samples that follow [s]; `theta`,
        `rates`, `tau`, (n, 2); `gain`, (n, 2, 4), torques over what angles and speeds are off, the
        last ones for when the end is held;
        `push`, (2,); `still`, (1,), the joint speed that counts as none [rad/s]; `ways`, (f, 2),
        what the joints show of displacements that contacts leave at the end, orthonormal.
    pace : Pace

    Attributes
    ----------
    over : bool
        Whether the next phase may begin.
    passed : int
        How many of the phases have been passed.
    """

    passes = False

    def __init__(self, tables: Mapping[str, Any], pace: Pace) -> None:
        self.pace, self.starts = pace, tables["starts"].tolist()
        self.every, self.still = float(tables["step"][0]), float(tables["still"][0])
        self.theta, self.rates = tables["theta"].tolist(), tables["rates"].tolist()
        self.tau, self.gain = tables["tau"].tolist(), tables["gain"].tolist()
        self.push = tuple(tables["push"].tolist())
        self.ways = tables["ways"].tolist()
        self.end = self.every * (len(self.theta) - 1)
        self.begin()

    @property
    def count(self) -> int:
        """Number of phases."""
        return len(self.starts)

    def begin(self, at_end: bool = False) -> None:
        """Start anew, at the beginning or at the end."""
        self.clock = self.end if at_end else 0.0
        self.passed = len(self.starts) - 1 if at_end else 0
        self.over, self.rested = False, 0.0
        self.settled, self.left = False, [0.0] * len(self.ways)

    def step(
        self, theta: Sequence[float], rates: Sequence[float], forces: Mapping[str, float] | None
    ) -> tuple[float, float]:
        """Torques for joint angles and speeds [N m]."""
        pace, now = self.pace, self.clock
        self.clock = now + pace.period
        last = self.passed + 1
        if last < len(self.starts) and now >= self.starts[last] - 0.5 * pace.period:
            self.passed = last
        if now >= self.end:
            stands = max(abs(rates[0]), abs(rates[1])) < self.still
            self.rested = self.rested + pace.period if stands else 0.0
            self.over = self.rested > pace.dwell + pace.delay
            self.settled = self.settled or self.over
        lead = pace.delay + 0.5 * pace.period
        k, share = self._locate(now)
        (p, q), (u, w) = self.theta[k], self.theta[k + 1]
        (f, g), (c, d) = self.rates[k], self.rates[k + 1]
        fast_one = rates[0] - f - share * (c - f)
        fast_two = rates[1] - g - share * (d - g)
        one = theta[0] - p - share * (u - p) + lead * fast_one
        two = theta[1] - q - share * (w - q) + lead * fast_two
        k, share = self._locate(now + lead)
        found = []
        if self.settled:
            one, two = self._find_left(one, two)
        for row in (0, 1):
            first, after = self.tau[k][row], self.tau[k + 1][row]
            if now >= self.end:
                first = after = self.push[row]
            a, b, c, d = self.gain[-1 if now >= self.end else k][row]
            feedback = a * one + b * two + c * fast_one + d * fast_two
            most = pace.limit[row]
            feedback = min(max(feedback, -SHARE * most), SHARE * most)
            tau = first + share * (after - first) - feedback
            found.append(min(max(tau, -most), most))
        return found[0], found[1]

    def _find_left(self, one: float, two: float) -> tuple[float, float]:
        """What is left of angles that are off, and what it adds up to until it is gone."""
        found_one = found_two = 0.0
        for k, (p, q) in enumerate(self.ways):
            off = p * one + q * two
            self.left[k] += MEMORY * self.pace.period * off
            found_one += p * (off + self.left[k])
            found_two += q * (off + self.left[k])
        return found_one, found_two

    def _locate(self, t: float) -> tuple[int, float]:
        """Sample before a time, and the share of the way to the next one."""
        place = min(t, self.end) / self.every
        k = min(int(place), len(self.theta) - 2)
        return k, min(place - k, 1.0)
