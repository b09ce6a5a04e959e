"""Tune the torques of a problem, phase by phase, by the 10 % rule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_source
from ..common.require import require_number
from ..common.sharing import exclusive
from ..problem.check import require_phases
from ..problem.definition import End, Phase, Problem, Until
from ..quasistatic.predict import SQUEEZE, find_torques
from ..quasistatic.prediction import QuasistaticTorques
from ..quasistatic.road import Road, make_road
from ..results.torque_table import read_rows
from ..simulation.tolerances import REST_WINDOW
from ..verification.free import verify_free
from .result import PhaseTuning, Tuning
from .rule import FACTOR, Drive, Rule
from .trial import Bench, Outcome, Step, Trial, make_rows

PAUSE = 0.2
"""How long the object is held at the end of each phase, relative to the scene's time."""
_HALVINGS = 2
"""How often a phase is halved at most."""
_LOWERED = 6
"""How many times the acting torque is lowered for that, less one."""


@exclusive
def tune(
    problem: Problem,
    *,
    brake: bool = False,
    stops: bool = False,
    squeeze: float = SQUEEZE,
    share: float = 1.0,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Tune torques from the quasistatic ones, in steps of 10 %, by free simulations.

    Each phase has constant torques. That of the finger behind the motion is raised until the
    object slides to the end of the phase, and further for speed until a contact is lost; then it
    is lowered by 10 %.

    Parameters
    ----------
    problem : Problem
    brake : bool
        Whether each phase may have one more step of its torques, which stops it at its end.
    stops : bool
        Whether a phase that then does not succeed may stop halfway, and again in both halves.
    squeeze : float
        How hard the quasistatic torques squeeze; as of `predict`.
    share : float
        Which of the raises that reach the end of a phase is taken, from the first, 0, to the last
        that keeps every contact, 1.
    progress : callable, optional
        Shown each trial, in words.

    Raises
    ------
    InputError
        If the phases cannot be carried out geometrically, or a number is out of its range.
    """
    require_phases(problem)
    for key, value in (("squeeze", squeeze), ("share", share)):
        if not 0 <= require_number(value, key) <= 1:
            raise InputError("", key, f"{value!r} given; allowed are 0 to 1")
    found: list[PhaseTuning] = []
    steps: list[Step] = []
    z, clock = problem.start, 0.0
    with name_source(problem.source):
        for phase in problem.phases:
            after = next(iter(problem.phases[phase.index + 1 :]), None)
            setting = _Setting(problem, phase, after, brake, squeeze, share, progress or _ignore)
            parts, end, reason = _carry(setting, z, _HALVINGS if stops and brake else 0)
            found += parts
            if end is None:
                reason = f"phase {phase.number}: {reason}"
                return Tuning(problem.name, tuple(found), None, None, reason)
            for own in parts:
                steps += [step._replace(time=clock + step.time) for step in own.steps]
                clock += own.duration + setting.pause
            z = end
    rows = make_rows(steps, clock)
    report = verify_free(problem, read_rows(rows))
    return Tuning(problem.name, tuple(found), rows, report, report.reason)


def _ignore(text: str) -> None:
    """Where nobody looks."""


def _carry(
    setting: _Setting, z: Array, halvings: int
) -> tuple[list[PhaseTuning], Array | None, str]:
    """Tune a phase from rest at `z`, with a stop halfway where that does not succeed."""
    own, end, reason = setting.tune(z)
    middle = setting.halve(z) if end is None and halvings else None
    if middle is None:
        return [own], end, reason
    first, z_middle, why = _carry(middle, z, halvings - 1)
    spent = own.simulations
    first[0] = replace(first[0], simulations=first[0].simulations + spent)
    if z_middle is None:
        return first, None, why
    second, end, reason = _carry(setting, z_middle, halvings - 1)
    return [*first, *second], end, reason


_Balance = tuple[Road, QuasistaticTorques]
"""The way along a phase, and what balances it."""


class _Setting(NamedTuple):
    """A phase, and how it is tuned."""

    problem: Problem
    phase: Phase
    after: Phase | None
    brake: bool
    squeeze: float
    share: float
    tell: Callable[[str], None]

    @property
    def pause(self) -> float:
        """How long the object is held at the end [s]."""
        return PAUSE * self.problem.scene.scales.time

    def halve(self, z: Array) -> _Setting | None:
        """The first half of the way from `z`, until x or phi is what it is there."""
        road = make_road(self.phase, z, self.problem.phases[self.phase.index + 1 :])
        if road is None or self.phase.end is not End.REST:
            return None
        middle = road.z[int(np.searchsorted(road.s, road.length / 2))]
        turns = abs(middle - z)[2] * self.problem.scene.scales.length > abs(middle - z)[0]
        name, value = ("phi", middle[2]) if turns else ("x", middle[0])
        until = Until(coordinate=name, value=float(value))
        return self._replace(phase=replace(self.phase, until=until), after=self.phase)

    def tune(self, z: Array) -> tuple[PhaseTuning, Array | None, str]:
        """Tune it from rest at `z`; where it ends at rest, or why it does not."""
        own = PhaseTuning(self.phase.number, str(self.phase.until))
        if self.phase.end is not End.REST:
            return own, None, "it passes into the next one in motion; the rule tunes phases to rest"
        found = self._balance(self.phase, z)
        if found is None:
            return own, None, "no quasistatic motion keeps every contact, where tuning would start"
        road, torques = found
        acting = _find_acting(road, torques)
        bench = Bench(self.problem, self.phase, z)
        first = self._tune_by(acting, own, bench, found)
        if first[1] is not None or first[0].raised is not None:
            return first
        # No torque of that finger reaches the end.
        second = self._tune_by(1 - acting, own, bench, found)
        return first if second[1] is None else second

    def _tune_by(
        self, acting: int, own: PhaseTuning, bench: Bench, balance: _Balance
    ) -> tuple[PhaseTuning, Array | None, str]:
        """Tune it by the torque of one finger."""
        torques = balance[1]
        title = f"phase {self.phase.number} of {len(self.problem.phases)}, finger {acting + 1}"
        for tau in _list_starts(torques.tau, acting):
            rule = Rule(
                bench, tau, torques.tau[-1], acting, lambda text: self.tell(f"{title}: {text}")
            )
            drives = rule.drive()
            if drives:
                break
        own = replace(own, acting=acting + 1, quasistatic=rule.scale(0))
        drives = drives[: 1 + round(self.share * (len(drives) - 1))]
        if not drives:
            return self._sum_up(own, bench, bench.trials[-1]), None, _explain(bench)
        if not self.brake:
            return self._arrive(own, rule, drives, balance)
        stopped = rule.brake(drives)
        if stopped is None:
            text = "no torque in steps of 10 % brings it to rest at its end: a trial "
            own = replace(self._sum_up(own, bench, drives[-1].trial), raised=drives[-1].raised)
            return own, None, text + bench.trials[-1].to_text()
        drive, brake = stopped
        own = replace(own, raised=drive.raised, braked=brake.raised, supported=brake.supported)
        return self._hold(own, rule, brake.trial, balance)

    def _arrive(
        self, own: PhaseTuning, rule: Rule, drives: Sequence[Drive], balance: _Balance
    ) -> tuple[PhaseTuning, Array | None, str]:
        """The fastest drive that is held where it arrives; the slowest arrives most gently."""
        kept: tuple[PhaseTuning, Array | None, str] | None = None
        for drive in drives:
            last = self._hold(replace(own, raised=drive.raised), rule, drive.trial, balance)
            if last[1] is None:
                return last if kept is None else kept
            kept = last
        assert kept is not None
        return kept

    def _hold(
        self, own: PhaseTuning, rule: Rule, trial: Trial, balance: _Balance
    ) -> tuple[PhaseTuning, Array | None, str]:
        """Hold the object where a trial has arrived: as it is, or lowered for the next phase."""
        own = replace(self._sum_up(own, rule.bench, trial), steps=trial.steps)
        reason = ""
        for tau in self._list_holds(trial, balance):
            steps = trial.steps if tau is None else (*trial.steps, Step(trial.time, tau))
            landing = rule.bench.land(steps, trial.time, self.pause, self.after)
            own = replace(own, steps=steps, simulations=rule.bench.simulations)
            rate = f"{self.phase.until} is reached at {trial.rate:.3g}"
            rate += " rad/s" if rule.bench.is_angle else " m/s"
            rate += f" at t = {trial.time:.5g} s, and "
            if landing.parted > REST_WINDOW * self.problem.scene.scales.time:
                reason = f"{rate}{landing.contact} parts for {1e3 * landing.parted:.3g} ms"
            elif not landing.rests:
                reason = f"{rate}the object does not come to rest there"
            else:
                return own, landing.z, ""
        return own, None, reason

    def _list_holds(self, trial: Trial, own: _Balance) -> list[tuple[float, float] | None]:
        """What may hold the object: what it arrives with, or quasistatic torques lowered.

        Those are of the next phase, or of the end of the last one.
        """
        row, found = (-1, own) if self.after is None else (0, self._balance(self.after, trial.z))
        if found is None:
            return [None]
        road, torques = found
        acting = _find_acting(road, torques)
        first, second = (float(tau) for tau in torques.tau[row])
        lowered = [
            (first / FACTOR**n, second) if acting == 0 else (first, second / FACTOR**n)
            for n in range(1, _LOWERED)
        ]
        return [None, *lowered]

    def _balance(self, phase: Phase, z: Array) -> _Balance | None:
        """The way along a phase and its quasistatic torques, if there are any."""
        road = make_road(phase, z, self.problem.phases[phase.index + 1 :])
        torques = None if road is None else find_torques(road, self.problem.epsilon, self.squeeze)
        return None if road is None or torques is None else (road, torques)

    def _sum_up(self, own: PhaseTuning, bench: Bench, trial: Trial) -> PhaseTuning:
        return replace(
            own,
            duration=trial.time,
            rate=trial.rate,
            least=trial.least,
            weakest=trial.weakest,
            trials=tuple(bench.trials),
            simulations=bench.simulations,
        )


def _find_acting(road: Road, torques: QuasistaticTorques) -> int:
    """The finger behind the motion: the index of the torque that works most."""
    return int((torques.tau * road.z_s[:, 3:]).mean(axis=0).argmax())


def _list_starts(tau: Array, acting: int) -> list[Array]:
    """Torques to begin with: those at the start, or the supporting one where it presses most."""
    hard = tau[0].copy()
    # The right finger presses anticlockwise, the left one clockwise.
    hard[1 - acting] = tau[:, 0].max() if acting else tau[:, 1].min()
    return [tau[0]] if np.array_equal(hard, tau[0]) else [tau[0], hard]


def _explain(bench: Bench) -> str:
    """Why no torque drives the object to the end of a phase."""
    nearest = min(bench.trials, key=lambda trial: trial.short)
    last = bench.trials[-1]
    text = f"no constant torques reach {bench.phase.until}: the nearest trial {nearest.to_text()}"
    if last.outcome is Outcome.LOSES:
        return f"{text}, and raised {len(bench.trials) - 1} times it {last.to_text()}"
    return f"{text}, up to the torque limit"
