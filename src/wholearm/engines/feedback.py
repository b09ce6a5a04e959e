"""Simulation of policies in physics engines."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from ..common.document import Document, Result, Table
from ..common.errors import InputError
from ..policy.playback import ROOM, ClosedLoop, Policy
from ..problem.definition import Problem
from ..results.adopt import Moved, adopt_motion
from ..results.trajectory import Trajectory
from .engine_replay import ENGINES, require_engine
from .stretch import EngineRun, EngineStretch, Setting, find_between, list_stretches

# Allowed error of the final pose, over the scene's length and in rad; soft contacts cause 2e-3.
ALLOWED = 1e-2


class StretchEnd(NamedTuple):
    """A stretch that a policy carries out in an engine."""

    stretch: EngineStretch
    duration: float  # [s]: until the joints are at rest at the end
    over: bool  # whether they are
    position: float  # [m]: final error of the object's position
    angle: float  # [rad]: of its angle
    contact: str  # the planned contact that opens most during its phase
    gap: float  # [m]: its gap


@dataclass(frozen=True, eq=False, repr=False)
class PolicyReport(Result):
    """Final errors of a policy in an engine; `allowed` is over the scene's length and in rad."""

    problem: Problem
    title: str
    allowed: float
    arrivals: tuple[StretchEnd, ...]

    @property
    def ok(self) -> bool:
        """Whether every stretch ends, at the planned pose."""
        return all(self.find_failure(end) is None for end in self.arrivals)

    def find_failure(self, end: StretchEnd) -> str | None:
        """Description of a failure, if there is one."""
        far = max(end.position / self.problem.scene.scales.length, end.angle)
        if not far <= self.allowed:
            text = f"{end.position * 1e3:.3g} mm and {math.degrees(end.angle):.3g} degrees"
            return f"phase {end.stretch.name} ends {text} away from the plan"
        if not end.over:
            return f"phase {end.stretch.name} does not end within {end.duration:.4g} s"
        return None

    @property
    def document(self) -> Document:
        """Durations and final errors."""
        columns = {
            "stretch.name": "phase:d", "stretch.duration": "plan [s]:.6f",
            "duration": "policy [s]:.6f", "position": "end off [mm]:.4f", "angle": "[deg]:.4f",
            "gap": "largest gap [mm]:.4f", "contact": "",
        }  # fmt: skip
        failures = [self.find_failure(end) or "" for end in self.arrivals]
        title = f"{self.problem.name} in {self.title}, by the policy"
        verdict, table = "ok" if self.ok else "FAILS", Table.of(self.arrivals, columns)
        return Document(title, verdict, parts=[*failures, table])

    @property
    def values(self) -> dict[str, Any]:
        """The report for machines, in m, rad and s."""
        stretches = [{"phases": end.stretch.numbers, **end._asdict()} for end in self.arrivals]
        for stretch in stretches:
            del stretch["stretch"]
        values = {"problem": self.problem.name, "engine": self.title, "ok": self.ok}
        return {**values, "allowed": self.allowed, "stretches": stretches}


def play_policy(
    engine: str,
    problem: Problem,
    plan: Trajectory | Moved,
    policy: Policy,
    *,
    whole: bool = False,
    setting: Setting | None = None,
    allowed: float = ALLOWED,
    progress: Callable[[str], None] | None = None,
) -> PolicyReport:
    """Simulate a policy in an engine that does not know the contact sequence.

    Parameters
    ----------
    engine : {"mujoco", "drake"}
    plan                        start and end of each phase
    whole                       from start to end; otherwise from each phase that begins at rest
    setting, allowed, progress  as of `replay_in`

    Raises
    ------
    InputError  if the engine is unknown or not installed, or the policy is of other phases
    """
    problem, plan = adopt_motion(problem, plan)
    play = require_engine(engine)
    if policy.count != len(problem.phases):
        given = f"{policy.count} given; the problem has {len(problem.phases)}"
        raise InputError("", "phases of the policy", given)
    info = ENGINES[engine]
    setting = info.setting if setting is None else setting
    arrivals = []
    for stretch in _join(list_stretches(find_between(plan), False), policy, whole):
        if progress is not None:
            progress(f"phase {stretch.name} in {info.title}")
        last = stretch.phases[-1] + 1
        loop = ClosedLoop(policy.cut(last), stretch.phases[0] + 1)
        until = stretch.start + (1 + ROOM) * loop.find_duration(last)
        run = play(problem, stretch._replace(stop=until), loop, setting)
        arrivals.append(_judge(problem, plan, stretch, loop, run))
    title = f"{info.title} {version(engine)}"
    return PolicyReport(problem, title, allowed, tuple(arrivals))


def _join(parts: list[EngineStretch], policy: Policy, whole: bool) -> list[EngineStretch]:
    """Stretches that begin at rest, or one of all phases."""
    begins = [1] if whole else policy.resting
    found = []
    for first, after in zip(begins, [*begins[1:], len(parts) + 1], strict=True):
        phases, stop, rest = tuple(range(first - 1, after - 1)), parts[after - 2].stop, np.zeros(5)
        start = parts[first - 1]
        found.append(start._replace(phases=phases, stop=stop, z_dot=rest, z_ddot=rest))
    return found


def _judge(
    problem: Problem, plan: Trajectory, stretch: EngineStretch, loop: ClosedLoop, run: EngineRun
) -> StretchEnd:
    """Final error of a run, and the planned contact that opens most."""
    goal = plan.z[np.flatnonzero(plan.phase == stretch.phases[-1])[-1]]
    away, t = np.abs(run.z[-1] - goal), run.t - stretch.start
    position, angle = float(np.hypot(*away[:2])), float(away[2])
    begins = [loop.began.get(index + 1, np.inf) for index in stretch.phases]
    contact, gap = "", 0.0
    for index, start, stop in zip(stretch.phases, begins, [*begins[1:], np.inf], strict=True):
        phase = problem.phases[index]
        rows = np.flatnonzero((t >= start) & (t < stop))
        rows = run.cut(rows, phase.until.contact, problem.scene)
        gaps = phase.formation.evaluate(run.z[rows], run.z_dot[rows]).C
        if gaps.size and gaps.max() > gap:
            gap = float(gaps.max())
            contact = phase.formation.names[int(gaps.max(axis=0).argmax())]
    return StretchEnd(stretch, float(t[-1]), loop.over, position, angle, contact, gap)
