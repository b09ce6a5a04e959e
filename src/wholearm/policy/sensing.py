"""What a sensor of normal forces adds to the law of a curve: the squeeze follows what is measured.

Along a curve forces are C0 + Cb s'^2 + Ca a + Cl lambda. What is measured less what this gives for
the torques that were in effect is a bias of each contact, smoothed over samples. With it each force
is to be at least what the law plans: the squeeze changes by the least that this takes, or by what
makes the least part of them largest where no squeeze serves them all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from math import ceil, isfinite
from typing import Any

from .squeeze import choose_squeeze

SMOOTH = 0.3
"""Part of a bias that the last sample makes up."""
FELT = 0.1
"""Force with which a contact presses, over the mean of all."""
FEW = 0.2
"""Least force that is aimed at, over the mean of all: a part of less is no measure."""


class Sensing:
    """Biases of the forces of a phase's contacts.

    Parameters
    ----------
    names : sequence of str
        Contacts, in the order of the table.
    gained : str
        The contact that the phase ends with, if it does.
    table : ndarray, shape (n, 2, n_c, 5), [N]
        Forces at both ends of intervals, of 1, s'^2, s', a and the squeeze.
    late : float
        Delay of the torques, in periods.
    """

    def __init__(self, names: Sequence[str], gained: str, table: Any, late: float) -> None:
        self.names, self.gained = tuple(names), gained
        self.first = table[:, 0].tolist()
        self.rises = (table[:, 1] - table[:, 0]).tolist()
        self.lag = max(ceil(late - 1e-9), 1)
        self.begin()

    def begin(self) -> None:
        """Forget what was measured."""
        self.bias = [0.0] * len(self.names)
        self.expected: deque[list[float]] = deque(maxlen=self.lag)
        self.heard, self.felt = False, 0

    @property
    def feels(self) -> bool:
        """Whether the gained contact presses, in two samples one after the other."""
        return self.felt > 1

    def measure(self, forces: Mapping[str, float] | None) -> None:
        """Take a sample; contacts that are not in it, or not a number, have no sensor."""
        self.heard = bool(forces)
        if not forces or len(self.expected) < self.lag:
            return
        mean = sum(self.expected[0]) / len(self.names)
        presses = forces.get(self.gained, 0.0) > FELT * mean
        self.felt = self.felt + 1 if presses else 0
        for k, (name, known) in enumerate(zip(self.names, self.expected[0], strict=True)):
            force = forces.get(name)
            if force is not None and isfinite(force):
                self.bias[k] += SMOOTH * (force - known - self.bias[k])

    def shift(
        self,
        place: tuple[int, float, float, float, float],
        low: float,
        high: float,
    ) -> float:
        """Change of the squeeze, from `low` to `high`.

        `place` has the interval, the share of it, s', a and the squeeze that the law asks for.
        """
        j, share, v, a, squeeze = place
        plain, press = [], []
        for (c, cb, _, ca, cl), (d, db, _, da, dl) in zip(
            self.first[j], self.rises[j], strict=True
        ):
            by = cl + share * dl
            force = c + share * d + (cb + share * db) * v * v + (ca + share * da) * a
            plain.append(force + by * squeeze)
            press.append(by)
        least = FEW * sum(abs(own) for own in plain) / len(plain)
        sizes = [max(own, least) or 1.0 for own in plain]
        parts = [(own + off) / size for own, off, size in zip(plain, self.bias, sizes, strict=True)]
        rates = [own / size for own, size in zip(press, sizes, strict=True)]
        change = min(max(self._choose(parts, rates), low), high)
        self.expected.append([own + by * change for own, by in zip(plain, press, strict=True)])
        return change

    def _choose(self, parts: list[float], rates: list[float]) -> float:
        """The least change with which all parts are 1, or the one with the largest least part."""
        low, high = -1e30, 1e30
        for part, rate in zip(parts, rates, strict=True):
            if rate > 0.0:
                low = max(low, (1.0 - part) / rate)
            elif rate < 0.0:
                high = min(high, (1.0 - part) / rate)
        if low <= high:
            return min(max(0.0, low), high)
        return choose_squeeze(parts, [0.0] * len(parts), rates, 0.0)[1]
