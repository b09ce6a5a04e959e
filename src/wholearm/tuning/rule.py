"""The 10 % rule for one phase: a torque that drives it to its end, and one that brakes it there.

The finger behind the motion acts: the one whose torque works most in the quasistatic motion. Its
torque alone is tuned, from the quasistatic one at the start of the phase. The other finger supports
and keeps its torque there; where no drive reaches the end with that, the one with which it presses
most along the phase; and where no brake holds it is raised while braking.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

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
"""So many times the supporting torque is raised at once, by a third, as each needs a search."""
_ENOUGH = 250
"""Simulations of a phase after which no further drive or support is tried."""
_SUPPORTED = 13
"""It is raised fewer times than this."""
_SOONER = 0.02
"""Share of the time by which another 10 % has to bring the end sooner."""
_SEARCH = 24
"""Most trials that look for the instant to brake."""
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
        How many times the supporting torque is raised.
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
        self, bench: Bench, tau: Array, last: Array, acting: int, tell: Callable[[str], None]
    ) -> None:
        self.bench, self.acting, self.tell = bench, acting, tell
        self.tau, self.last = tau, last
        self.limit = bench.problem.scene.torque_limit
        scales = bench.problem.scene.scales
        self.slow = SLOW * scales.speed / (scales.length if bench.is_angle else 1.0)
        self.time = scales.time

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
        supporting one is raised, too.
        """
        count = len(drives)
        chosen = [drives[k] for k in sorted({count - 1, count // 2, count // 4, 0}, reverse=True)]
        share = float(self.last[self.acting] / self.tau[self.acting])
        balance = math.floor(math.log(max(share, FACTOR**-_RAISED)) / math.log(FACTOR))
        first = min(drives[0].raised - 1, balance)
        for supported in range(0, _SUPPORTED, _SUPPORT):
            if abs(self.scale(0, supported)[1 - self.acting]) > self.limit[1 - self.acting]:
                break
            for drive in chosen:
                if self.bench.simulations > _ENOUGH:
                    return None
                found = self._lower(drive.trial, first, supported)
                if found is not None:
                    return drive, found
        return None

    def _lower(self, drive: Trial, first: int, supported: int) -> Brake | None:
        """Lower the acting torque while that brings the end sooner; None if nothing stops there."""
        best: Brake | None = None
        for raised in range(first, -_RAISED, -1):
            steps = [*drive.steps, Step(0.0, self.scale(raised, supported))]
            trial = self._place(steps, drive, best and best.trial, _ROUGH * self.slow)
            if trial is None:
                if best or self.bench.trials[-1].outcome is Outcome.LOSES:
                    break
            elif best and trial.time > (1 - _SOONER) * best.trial.time:
                break
            else:
                best = Brake(raised, supported, trial)
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
                    return None
                high, above = at, self._overshoot(trial, slow)
                below /= 2 if side < 0 else 1
                side = -1
            else:
                losses += trial.outcome is Outcome.LOSES
                if losses > _LOSSES:
                    return None
                low, below = at, max(trial.short, 1e-12 * self.bench.way)
                above /= 2 if side > 0 else 1
                side = 1
            share = below / (below + above) if count % 4 != 3 else 0.5
            at = low + (high - low) * min(max(share, 0.02), 0.98)
            if high - low < 1e-12 * high:
                return None
        return None

    def _overshoot(self, trial: Trial, slow: float) -> float:
        """How far beyond the end the object would come to rest, less the wanted speed's part."""
        slowing = max(trial.slowing, 0.1 * trial.rate / self.time)
        return (trial.rate**2 - (0.5 * slow) ** 2) / (2 * slowing)

    def _run(self, steps: list[Step], text: str) -> Trial:
        trial = self.bench.run(steps)
        self.tell(f"{text}: {trial.to_text()}")
        return trial
