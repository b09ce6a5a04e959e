"""Tune the torques of a problem, from rest to rest, by the 10 % rule."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, name_source
from ..common.fields import SHARE
from ..common.sharing import exclusive
from ..problem.check import require_phases
from ..problem.definition import End, Phase, Problem, Until
from ..quasistatic.predict import SQUEEZE, find_torques
from ..quasistatic.road import make_road
from ..results.torque_table import read_rows
from ..simulation.tolerances import REST_WINDOW
from ..verification.free import verify_free
from .passage import Passage, split_passages
from .result import PhaseTuning, Tuning
from .rule import FACTOR, Drive, Rule, list_starts
from .trial import Bench, Outcome, Step, Trial, make_rows

PAUSE = 0.2
"""How long the object is held at the end of each phase, relative to the scene's time."""
MOST_STOPS = 7
"""Stops of a phase that may be allowed at most: halves of halves of halves."""
_LOWERED = 6
"""How many times the acting torque is lowered for that, less one."""


@exclusive
def tune(
    problem: Problem,
    *,
    brake: bool = False,
    stops: int = 0,
    squeeze: float = SQUEEZE,
    share: float = 1.0,
    progress: Callable[[str], None] | None = None,
) -> Tuning:
    """Tune torques from the quasistatic ones, in steps of 10 %, by free simulations.

    Each phase has constant torques. That of the finger behind the motion is raised until the
    object slides to the end of the phase, and further for speed until a contact is lost; then it
    is lowered by 10 %. Phases that pass into one another in motion are tuned as one.

    Parameters
    ----------
    problem : Problem
    brake : bool
        Whether each phase may have one more step of its torques, which stops it at its end.
    stops : int
        How often a phase that does not succeed with a brake may stop on its way, 0 to 7: halfway,
        then again in the halves that do not succeed.
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
    squeeze, share = SHARE.read(squeeze, "squeeze"), SHARE.read(share, "share")
    _require_stops(stops, brake)
    found: list[PhaseTuning] = []
    steps: list[Step] = []
    z, clock = problem.start, 0.0
    with name_source(problem.source):
        for passage in split_passages(problem):
            setting = _Setting(problem, passage, brake, squeeze, share, progress or _ignore)
            parts, end, reason = _carry(setting, z, stops)
            found += parts
            if end is None:
                title = parts[-1].title
                reason = f"phase{'s' if '-' in title else ''} {title}: {reason}"
                return Tuning(problem.name, tuple(found), None, None, reason)
            for own in parts:
                steps += [step._replace(time=clock + step.time) for step in own.steps]
                clock += own.duration + setting.pause
            z = end
    rows = make_rows(steps, clock)
    report = verify_free(problem, read_rows(rows))
    return Tuning(problem.name, tuple(found), rows, report, report.reason)


def _require_stops(stops: int, brake: bool) -> None:
    if isinstance(stops, bool) or not isinstance(stops, int) or not 0 <= stops <= MOST_STOPS:
        raise InputError("", "stops", f"{stops!r} given; allowed are 0 to {MOST_STOPS}")
    if stops and not brake:
        raise InputError("", "stops", f"{stops} given without a brake; allowed then is 0")


def _ignore(text: str) -> None:
    """Where nobody looks."""


def _carry(setting: _Setting, z: Array, stops: int) -> tuple[list[PhaseTuning], Array | None, str]:
    """Tune a passage from rest at `z`, with stops on the way where that does not succeed."""
    own, end, reason = setting.tune(z)
    halves = setting.halve(z) if end is None and stops else None
    if halves is None:
        return [own], end, reason
    first, z_middle, why = _carry(halves[0], z, (stops - 1) // 2)
    spent = own.simulations
    first[0] = replace(first[0], simulations=first[0].simulations + spent)
    if z_middle is None:
        return first, None, why
    second, end, reason = _carry(halves[1], z_middle, stops - len(first))
    return [*first, *second], end, reason


class _Balance(NamedTuple):
    """What a quasistatic motion needs along a passage.

    Attributes
    ----------
    tau : ndarray, shape (n, 2), [N m]
    acting : int
        The finger behind the motion: the index of the torque that works most.
    """

    tau: Array
    acting: int


_Attempt = tuple[PhaseTuning, Array | None, str]
"""What tuning came to, where it ends at rest if it does, and why not."""


class _Setting(NamedTuple):
    """A passage, and how it is tuned."""

    problem: Problem
    passage: Passage
    brake: bool
    squeeze: float
    share: float
    tell: Callable[[str], None]

    @property
    def pause(self) -> float:
        """How long the object is held at the end [s]."""
        return PAUSE * self.problem.scene.scales.time

    def halve(self, z: Array) -> tuple[_Setting, _Setting] | None:
        """Both halves of the way from `z`, the first until x or phi is what it is there."""
        phases, roads = self.passage.phases, []
        for phase in phases:
            road = make_road(phase, z, self.problem.phases[phase.index + 1 :])
            if road is None:
                return None
            roads.append(road)
            z = road.z[-1]
        ends = np.cumsum([road.length for road in roads])
        k = int(np.searchsorted(ends, ends[-1] / 2))
        road, left = roads[k], ends[k] - ends[-1] / 2
        middle = road.z[int(np.searchsorted(road.s, road.length - left))]
        way = abs(middle - road.z[0])
        turns = way[2] * self.problem.scene.scales.length > way[0]
        name, value = ("phi", middle[2]) if turns else ("x", middle[0])
        until = Until(coordinate=name, value=float(value))
        part = replace(phases[k], until=until, end=End.REST)
        first = Passage((*phases[:k], part), phases[k])
        second = Passage(phases[k:], self.passage.after)
        return self._replace(passage=first), self._replace(passage=second)

    def tune(self, z: Array) -> _Attempt:
        """Tune it from rest at `z`; where it ends at rest, or why it does not."""
        phases = self.passage.phases
        own = PhaseTuning(phases[0].number, phases[-1].number, str(self.passage.until))
        if any(phase.until.value is not None for phase in phases[:-1]):
            return (
                own,
                None,
                "a coordinate is passed in motion; the rule tunes phases to rest",
            )
        found = self._balance(phases, z)
        if found is None:
            return (
                own,
                None,
                "no quasistatic motion keeps every contact, where tuning would start",
            )
        bench = Bench(self.problem, self.passage, z)
        first = self._tune_by(found.acting, own, bench, found)
        if first[1] is not None or first[0].raised is not None:
            return first
        # No torque of that finger reaches the end.
        second = self._tune_by(1 - found.acting, own, bench, found)
        return first if second[1] is None else second

    def _tune_by(self, acting: int, own: PhaseTuning, bench: Bench, balance: _Balance) -> _Attempt:
        """Tune it by the torque of one finger, with supporting torques until one serves."""
        title = f"phase {self.passage.title} of {len(self.problem.phases)}, finger {acting + 1}"
        best: _Attempt | None = None
        for tau in list_starts(balance.tau, acting):
            rule = Rule(
                bench,
                tau,
                balance.tau[-1],
                acting,
                lambda text: self.tell(f"{title}: {text}"),
            )
            found = self._tune_from(rule, replace(own, acting=acting + 1))
            if found[1] is not None:
                return found
            if best is None or best[0].raised is None:
                best = found
            if rule.is_enough:
                break
        assert best is not None
        return best

    def _tune_from(self, rule: Rule, own: PhaseTuning) -> _Attempt:
        """Tune it from certain torques."""
        own, bench = replace(own, quasistatic=rule.scale(0)), rule.bench
        drives = rule.drive()
        drives = drives[: 1 + round(self.share * (len(drives) - 1))]
        if not drives:
            return self._sum_up(own, bench, bench.trials[-1]), None, _explain(bench)
        if not self.brake:
            return self._arrive(own, rule, drives)
        stopped = rule.brake(drives)
        if stopped is None:
            text = "no torque in steps of 10 % brings it to rest at its end: a trial "
            own = replace(self._sum_up(own, bench, drives[-1].trial), raised=drives[-1].raised)
            return own, None, text + bench.trials[-1].to_text()
        drive, brake = stopped
        own = replace(own, raised=drive.raised, braked=brake.raised, supported=brake.supported)
        return self._hold(own, rule, brake.trial)

    def _arrive(self, own: PhaseTuning, rule: Rule, drives: Sequence[Drive]) -> _Attempt:
        """The fastest drive that is held where it arrives; the slowest arrives most gently."""
        kept: _Attempt | None = None
        for drive in drives:
            last = self._hold(replace(own, raised=drive.raised), rule, drive.trial)
            if last[1] is None:
                return last if kept is None else kept
            kept = last
        assert kept is not None
        return kept

    def _hold(self, own: PhaseTuning, rule: Rule, trial: Trial) -> _Attempt:
        """Hold the object where a trial has arrived: as it is, or lowered for the next phase."""
        own = replace(self._sum_up(own, rule.bench, trial), steps=trial.steps)
        reason, until = "", self.passage.until
        for tau in self._list_holds(rule, trial):
            steps = trial.steps if tau is None else (*trial.steps, Step(trial.time, tau))
            landing = rule.bench.land(steps, trial.time, self.pause)
            own = replace(own, steps=steps, simulations=rule.bench.simulations)
            rate = f"{until} is reached at {trial.rate:.3g}"
            rate += " rad/s" if rule.bench.is_angle else " m/s"
            rate += f" at t = {trial.time:.5g} s, and "
            if landing.parted > REST_WINDOW * self.problem.scene.scales.time:
                reason = f"{rate}{landing.contact} parts for {1e3 * landing.parted:.3g} ms"
            elif not landing.rests:
                reason = f"{rate}the object does not come to rest there"
            else:
                return own, landing.z, ""
        return own, None, reason

    def _list_holds(self, rule: Rule, trial: Trial) -> list[tuple[float, float] | None]:
        """What may hold the object: what it arrives with, or quasistatic torques lowered.

        Those are of the next phase, or of the end of the last one; then those it arrives with, the
        acting one lowered, and the supporting one more so.
        """
        after = self.passage.after
        acting, (first, second) = rule.acting, (float(tau) for tau in rule.last)
        if after is not None:
            found = self._balance((after,), trial.z)
            if found is None:
                return [None]
            acting, (first, second) = found.acting, (float(tau) for tau in found.tau[0])
        lowered = [
            (first / FACTOR**n, second) if acting == 0 else (first, second / FACTOR**n)
            for n in range(1, _LOWERED)
        ]
        if after is None:
            arrived = np.array(trial.steps[-1].tau)
            arrived[1 - acting] /= FACTOR**_LOWERED
            held = [tuple((arrived / FACTOR ** (_LOWERED * n)).tolist()) for n in range(3)]
            return [None, *lowered, *held]
        return [None, *lowered]

    def _balance(self, phases: Sequence[Phase], z: Array) -> _Balance | None:
        """What balances a quasistatic motion from `z`, as far as one keeps every contact."""
        tau: list[Array] = []
        work: list[Array] = []
        for phase in phases:
            road = make_road(phase, z, self.problem.phases[phase.index + 1 :])
            if road is None:
                break
            found = find_torques(road, self.problem.epsilon, self.squeeze)
            if found is None:
                break
            tau.append(found.tau)
            work.append(found.tau * road.z_s[:, 3:])
            z = road.z[-1]
        if not tau:
            return None
        return _Balance(np.vstack(tau), int(np.vstack(work).mean(axis=0).argmax()))

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


def _explain(bench: Bench) -> str:
    """Why no torque drives the object to the end of a phase."""
    nearest = min(bench.trials, key=lambda trial: trial.short)
    last = bench.trials[-1]
    text = f"no constant torques reach {bench.passage.until}: the nearest trial {nearest.to_text()}"
    if last.outcome is Outcome.LOSES:
        return f"{text}, and raised {len(bench.trials) - 1} times it {last.to_text()}"
    return f"{text}, up to the torque limit"
