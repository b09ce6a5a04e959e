"""The 10 % rule for one passage: a torque that drives it to its end, and one that brakes it there.

The finger behind the motion acts: the one whose torque works most in the quasistatic motion. Its
torque alone is tuned, from the quasistatic one at the start. The other finger supports and keeps
its torque there; where that does not serve, the one with which it presses most on the way, or
between the two; and where no brake holds it is that of the end while braking, or raised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from .trial import Bench, Outcome, Step, Trial

FACTOR = 1.1
"""What raises a torque by 10 %; lowering divides by it, so that each torque comes again."""
SLOW = 3e-5
"""Speed at which the end of a phase may be reached by a brake, relative to the scene's: contacts
part for less than a moment then."""
_ROUGH = 50.0
"""How much faster than that an end is reached while brakes are compared."""
_RAISED = 60
"""Most times a torque is raised or lowered: a factor of 300."""
_SUPPORT = 3
"""So many times the supporting torque is raised at once, by a third, as each needs searches."""
ENOUGH = 600
"""Simulations from one start after which no further drive, brake or support is tried."""
_SUPPORTED = 13
"""It is raised fewer times than this."""
_SOONER = 0.02
"""Share of the time by which another 10 % has to bring the end sooner."""
_COARSE = 2
"""So many times the acting torque is lowered at once while it brakes too little."""
_PLACES = 16
"""Instants to brake at that are looked at, where each of them lets the object arrive."""
_CLOSER = 45
"""Most steps to the one at which it arrives most slowly, by golden sections."""
_GOLDEN = (3 - math.sqrt(5)) / 2
_MISSES = 2
"""So many torques that stop nothing end that, once one has."""
_SEARCH = 24
"""Most trials that look for the instant to brake."""
_NARROW = 1e-3
"""Share of the time in which the end is either reached at speed or not at all: what starts the
motion again, or lets it turn back, is not a matter of when to brake."""
_FAR, _FAST = 0.02, 0.1
"""Shares of the way and of the drive's speed that are much for that."""
_SOON = 1e-3
"""Share of a drive's time: where the end is reached with a brake that early it is none."""
_LOSSES = 4
"""Most of them that may lose a contact."""


class Drive(NamedTuple):
    """What sets the object in motion until the end of the phase.

    Attributes
    ----------
    raised : int
        How many times the acting torque was raised.
    trial : Trial
    """

    raised: int
    trial: Trial


class Brake(NamedTuple):
    """What stops it there.

    Attributes
    ----------
    raised : int
        How many times the acting torque is raised from the quasistatic one; lowered if negative.
    supported : int
        How many times the supporting torque is raised; lowered if negative.
    trial : Trial
    """

    raised: int
    supported: int
    trial: Trial


class Rule:
    """The rule at work on one phase.

    Parameters
    ----------
    bench : Bench
    tau : ndarray, shape (2,), [N m]
        Quasistatic torques that are raised and lowered.
    last : ndarray, shape (2,), [N m]
        Those at the end of the phase.
    acting : int
        Index of the acting finger.
    tell : callable
        Shown each trial, in words.
    """

    def __init__(
        self,
        bench: Bench,
        tau: Array,
        last: Array,
        acting: int,
        tell: Callable[[str], None],
    ) -> None:
        self.bench, self.acting, self.tell = bench, acting, tell
        self.tau, self.last = tau, last
        self.limit = bench.problem.scene.torque_limit
        scales = bench.problem.scene.scales
        self.slow = SLOW * scales.speed / (scales.length if bench.is_angle else 1.0)
        self.time = scales.time

    @property
    def is_enough(self) -> bool:
        """Whether there have been so many simulations that no other torques are tried."""
        return self.bench.simulations > ENOUGH

    @property
    def is_free(self) -> bool:
        """Whether the object has two freedoms where it arrives."""
        return self.bench.passage.phases[-1].formation.n_constraints < 4

    def scale(self, acting: int, supporting: int = 0) -> tuple[float, float]:
        """The torques raised so many times, lowered where negative."""
        powers = [supporting, supporting]
        powers[self.acting] = acting
        first, second = (float(tau) * FACTOR**n for tau, n in zip(self.tau, powers, strict=True))
        return first, second

    def drive(self) -> list[Drive]:
        """Raise the acting torque until a contact is lost; those that reach the end, by torque.

        The last trial says what was lost, or that the object did not slide.
        """
        found = []
        for raised in range(_RAISED):
            tau = self.scale(raised)
            if self.is_enough:
                break
            if abs(tau[self.acting]) > self.limit[self.acting]:
                break
            trial = self._run([Step(0.0, tau)], f"raised {raised} times")
            if trial.outcome is Outcome.ARRIVES:
                found.append(Drive(raised, trial))
            elif trial.outcome is Outcome.LOSES:
                break
        return found

    def brake(self, drives: Sequence[Drive]) -> tuple[Drive, Brake] | None:
        """Stop a drive at the end of the phase, the fastest that lets itself be stopped.

        The acting torque is lowered to less than the slowest drive's and than balances the object
        at the end. Where no such torque stops any drive there without losing a contact the
        supporting one becomes that of the end, and then is raised, too.
        """
        count = len(drives)
        chosen = [drives[k] for k in sorted({count - 1, count // 2, count // 4, 0}, reverse=True)]
        first = min(drives[0].raised - 1, self._count_steps(self.acting))
        last = self._count_steps(1 - self.acting)
        # With two freedoms either torque sets the object in motion again, if it is too much there.
        likely = [last, 0] if self.is_free else [0, last]
        for supported in dict.fromkeys([*likely, *range(_SUPPORT, _SUPPORTED, _SUPPORT)]):
            if abs(self.scale(0, supported)[1 - self.acting]) > self.limit[1 - self.acting]:
                continue
            for drive in chosen:
                if self.is_enough:
                    return None
                found = self._lower(drive.trial, first, supported)
                if found is not None:
                    return drive, found
        return None

    def _count_steps(self, finger: int) -> int:
        """How many times a torque is raised, lowered if negative, until it is that of the end."""
        share = float(self.last[finger] / self.tau[finger]) if self.tau[finger] else 1.0
        return math.floor(math.log(max(share, FACTOR**-_RAISED)) / math.log(FACTOR))

    def _lower(self, drive: Trial, first: int, supported: int) -> Brake | None:
        """Lower the acting torque while that brings the end sooner; None if nothing stops there."""
        best: Brake | None = None
        raised, missed = first, 0
        while raised > -_RAISED and missed < _MISSES and not self.is_enough:
            steps = [*drive.steps, Step(0.0, self.scale(raised, supported))]
            trial = self._place(steps, drive, best and best.trial, _ROUGH * self.slow)
            if trial is None:
                if best is None and self.bench.trials[-1].outcome is Outcome.LOSES:
                    break
                missed += best is not None
                raised -= _COARSE
                continue
            if best and trial.time > (1 - _SOONER) * best.trial.time:
                break
            best = Brake(raised, supported, trial)
            if trial.rate < self.slow:
                return best
            raised -= 1
        if best is None:
            return None
        last = self._place(list(best.trial.steps), drive, best.trial, self.slow)
        return None if last is None else best._replace(trial=last)

    def _place(
        self, steps: list[Step], drive: Trial, near: Trial | None, slow: float
    ) -> Trial | None:
        """Find the instant from which on the last step brings the object to the end slowly.

        Where a weaker brake, or nearly the same instant, is known the search begins near it.
        """
        low, high = 0.0, drive.time
        below, above = self.bench.way, self._overshoot(drive, slow)
        at, side, losses = 0.5 * high, 0, 0
        short, rate = self.bench.way, drive.rate
        if near is not None and slow == self.slow:
            at, high, above = (
                near.steps[-1].time * (1 - 1e-4),
                near.steps[-1].time,
                self._overshoot(near, slow),
            )
        elif near is not None:
            at = min(1.02 * near.steps[-1].time, 0.5 * (near.steps[-1].time + high))
        for count in range(_SEARCH):
            steps = [*steps[:-1], steps[-1]._replace(time=at)]
            trial = self._run(steps, f"brake at {at:.5g} s")
            if trial.outcome is Outcome.ARRIVES:
                if trial.rate < slow:
                    return trial
                if at < _SOON * drive.time:
                    return self._graze(steps, drive) if self.is_free else None
                high, above, rate = at, self._overshoot(trial, slow), trial.rate
                below /= 2 if side < 0 else 1
                side = -1
            else:
                losses += trial.outcome is Outcome.LOSES
                if losses > _LOSSES:
                    return None
                low, short = at, trial.short
                # How far it is through several phases is not known.
                below = above if short == math.inf else max(short, 1e-12 * self.bench.way)
                above /= 2 if side > 0 else 1
                side = 1
            jumps = short > _FAR * self.bench.way and rate > _FAST * drive.rate
            if jumps and high - low < _NARROW * high:
                return None
            share = below / (below + above) if count % 4 != 3 else 0.5
            at = low + (high - low) * min(max(share, 0.02), 0.98)
            if high - low < 1e-12 * high:
                return None
        return None

    def _graze(self, steps: list[Step], drive: Trial) -> Trial | None:
        """Find the instant to brake at which the end is just touched, on a way that always arrives.

        With two freedoms the object may turn back before the end, and come there later another way:
        how fast it arrives has a kink where it just touches, and falls to zero there.
        """

        def run(at: float) -> tuple[float, Trial]:
            again = [*steps[:-1], steps[-1]._replace(time=at)]
            trial = self._run(again, f"brake at {at:.5g} s")
            return trial.rate if trial.outcome is Outcome.ARRIVES else math.inf, trial

        grid = [drive.time * (k + 1) / (_PLACES + 1) for k in range(_PLACES)]
        found = [run(at) for at in grid]
        k = min(range(1, _PLACES - 1), key=lambda k: found[k][0])
        low, at, high = grid[k - 1 : k + 2]
        rate, best = found[k]
        if rate > min(found[k - 1][0], found[k + 1][0]):
            return None
        for count in range(_CLOSER):
            if rate < self.slow:
                return best
            if count == _PLACES and rate > 2 * _ROUGH * self.slow:
                return None
            left = at - low > high - at
            other = at - _GOLDEN * (at - low) if left else at + _GOLDEN * (high - at)
            new, trial = run(other)
            if new < rate:
                low, high = (low, at) if left else (at, high)
                at, rate, best = other, new, trial
            else:
                low, high = (other, high) if left else (low, other)
        return None

    def _overshoot(self, trial: Trial, slow: float) -> float:
        """How far beyond the end the object would come to rest, less the wanted speed's part."""
        slowing = max(trial.slowing, 0.1 * trial.rate / self.time)
        return (trial.rate**2 - (0.5 * slow) ** 2) / (2 * slowing)

    def _run(self, steps: list[Step], text: str) -> Trial:
        trial = self.bench.run(steps)
        self.tell(f"{text}: {trial.to_text()}")
        return trial


def list_starts(tau: Array, acting: int) -> list[Array]:
    """Torques to begin with, of quasistatic ones along the way, shape (n, 2) [N m].

    Those at the start; then with the supporting one where it presses most, or between the two. The
    right finger presses anticlockwise, the left one clockwise.
    """
    start, other = float(tau[0, 1 - acting]), 1 - acting
    hard = float(tau[:, 0].max() if acting else tau[:, 1].min())
    values = list(dict.fromkeys([start, hard]))
    if start and hard / start > 1:
        count = math.ceil(math.log(hard / start) / math.log(FACTOR) / _SUPPORT)
        values += [start * FACTOR ** (_SUPPORT * n) for n in range(1, count)]
    found = np.tile(tau[0], (len(values), 1))
    found[:, other] = values
    return list(found)
