"""Phases of one freedom, on four sliding contacts, that methods run on, and the timing of runs.

Peers get the equations of motion, and a slow motion as first guess.
"""

from __future__ import annotations

import math
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from ...contacts.formation import Formation
from ...geometry.curve import Curve, Segment
from ...geometry.tracing import trace_phases
from ...mechanics.dynamics import build_force_rows
from ...planning.path_domain.first_guess import guess
from ...planning.path_domain.path_data import prepare
from ...planning.path_domain.path_mesh import make_grid
from ...planning.path_domain.path_motion import PathMotion
from ...problem.definition import End, Problem
from ...problem.read import read_problem
from ...results.torque import TorqueProfile
from ...results.trajectory import Samples

REPEATS = 3  # largest number of runs that a median is of
BUDGET = 0.3  # time after which a run is not repeated any more [s]
SHIFT = 0.01  # shift of the geometric means [s]
SHORT = 0.05  # time up to which something is done several times over, in about this time [s]
SOLVED = "solved"

_Answer = TypeVar("_Answer")


class Instance(NamedTuple):
    """One phase from rest to rest."""

    name: str  # of the file, and the number of the phase
    problem: Problem  # of that phase alone
    curve: Curve


@lru_cache(maxsize=4)
def list_instances(paths: tuple[str, ...], drag: bool = True) -> tuple[Instance, ...]:
    """First phases of problem files that are curves of four sliding contacts: what peers know.

    Those that files share are there once. Without `drag` joints have no viscous friction.
    """
    instances: dict[object, Instance] = {}
    for path in paths:
        problem = read_problem(path)
        problem = problem if drag else problem.with_(viscous=0.0)
        scene = problem.scene
        for phase, curve in zip(problem.phases, trace_phases(problem), strict=False):
            if phase.formation.rolling:
                break
            single = replace(phase, index=0, end=End.REST)
            alone = replace(problem, start=curve.start, phases=(single,))
            places = np.round(np.append(curve.start, curve.end), 9) + 0.0
            limits = (problem.epsilon, *scene.torque_limit, *scene.speed_limit)
            same = scene.equations, limits, phase.formation.names, tuple(places)
            name = f"{Path(path).stem} {phase.number}"
            instances.setdefault(same, Instance(name, alone, curve))
    return tuple(instances.values())


def pick(name: str, paths: tuple[str, ...], drag: bool = True) -> Instance:
    """The phase of a name, of problem files."""
    return next(instance for instance in list_instances(paths, drag) if instance.name == name)


OPTIMUM = "Solve_Succeeded"  # Ipopt's status of a solution


class PeerPlan(NamedTuple):
    """What a planner has found for one phase."""

    status: str  # `OPTIMUM`, or why there is no plan
    duration: float  # [s]
    torque: TorqueProfile
    marks: tuple[float, ...]  # [s]: when directions reverse


NO_PLAN = PeerPlan("", 1.0, TorqueProfile(np.array([0.0, 1.0]), np.zeros((1, 2, 1))), ())
"""What there is where nothing was found."""


class PhaseStretch(NamedTuple):
    """A stretch of a phase without a reversal, as peers plan it."""

    part: Segment
    share: float  # of the curve's length
    target: float  # coordinate `progress` at its end
    progress: int  # coordinate of the object that runs along the phase: x, or phi where it turns


def build_plant(formation: Formation) -> Expression:
    """CasADi function (z, z', tau, c_n, Xi, sigma) -> (z'', A z'' + A' z')."""
    scene, n_c = formation.scene, formation.n_contacts
    z, v, c_n = ca.SX.sym("z", 5), ca.SX.sym("v", 5), ca.SX.sym("c_n", n_c)
    tau, Xi, sigma = ca.SX.sym("tau", 2), ca.SX.sym("Xi", n_c), ca.SX.sym("sigma", 2)
    _, P, P_dot_v, A_t = formation.build_constraints(z, v)
    friction = ca.DM(scene.viscous) * v + ca.DM(scene.dry) * ca.vertcat(0, 0, 0, sigma)
    applied = ca.DM(scene.applied_force) + ca.vertcat(0, 0, 0, tau) - friction
    G = build_force_rows(formation, P, A_t, Xi)
    acceleration = (applied + G.T @ c_n) / ca.DM(scene.mass_diagonal)
    missed = P @ acceleration + P_dot_v
    return ca.Function("plant", [z, v, tau, c_n, Xi, sigma], [acceleration, missed])


def list_stretches(curve: Curve) -> list[PhaseStretch]:
    """The stretches of a phase."""
    ends = curve.evaluate(np.array([0.0, *(part.stop for part in curve.segments)])).z
    progress = 2 if abs(ends[-1] - ends[0])[2] > 1e-6 else 0
    return [
        PhaseStretch(part, (part.stop - part.start) / curve.length, float(end[progress]), progress)
        for part, end in zip(curve.segments, ends[1:], strict=True)
    ]


def sample_slow_motion(instance: Instance, counts: list[int]) -> list[tuple[Array, Samples]]:
    """Times from its start and samples of each stretch of a slow motion, at so many instants.

    It keeps all limits, with its internal force amid its range.
    """
    motion = make_slow_motion(instance, 5)
    marks, stretches = find_reversals(motion), []
    for start, stop, count in zip(marks, marks[1:], counts, strict=False):
        # The ends of a stretch are evaluated within it.
        t = np.linspace(start, stop, count)
        inside = np.clip(t, start + 1e-9 * (stop - start), stop - 1e-9 * (stop - start))
        stretches.append((t - start, motion.evaluate(inside)))
    return stretches


def make_slow_motion(instance: Instance, intervals: int, share: float = 1.0) -> PathMotion:
    """The motion that the planner guesses first, with a share of its squared speed."""
    curve = instance.curve
    grid = make_grid(curve, np.zeros(0), intervals + len(curve.segments))
    data = prepare(curve, instance.problem.epsilon, grid, 0)
    profile, _ = guess(data)
    slow = profile._replace(a=share * profile.a, b=share * profile.b)
    return PathMotion(curve, data.grid, slow)


def find_reversals(motion: PathMotion) -> Array:
    """Times at which the stretches of a motion begin and the last one ends [s]."""
    last = np.flatnonzero(np.diff(motion.grid.segment, append=-1))
    return np.append(0.0, motion.times[last])


class Method(NamedTuple):
    """A planner or a simulator."""

    settings: str  # what it is told besides the setting
    # takes a phase or a course, and a setting; gives what solves it
    build: Callable[[Any, str], Callable[[], Any]]
    choices: dict[str, tuple[str, ...]]  # settings that are measured, by study
    module: str = ""  # what has to be installed, if anything

    @property
    def is_installed(self) -> bool:
        """Whether there is what it needs."""
        return not self.module or find_spec(self.module) is not None


class Median(NamedTuple):
    """The runs of one setting: medians of their times [s], and the worst of the rest."""

    build: float  # build, solve [s]: time to build, and to simulate or solve
    solve: float
    # of the state, relative to the scene; of plans those of the phase time, of the replayed end
    # state, and the worst violation of a limit between nodes
    errors: tuple[float, ...]
    outcome: str = SOLVED  # `SOLVED`, or what failed

    def reaches(self, target: float, count: int | None = None) -> bool:
        """Whether it is solved and its errors, or the first few of them, are below a target."""
        return self.outcome == SOLVED and max(map(abs, self.errors[:count])) <= target


def measure(
    build: Callable[[], Callable[[], _Answer]],
    judge: Callable[[_Answer], tuple[tuple[float, ...], str]],
) -> Median:
    """Build and run as often as the time allows; `judge` gives the errors and the outcome."""
    builds, solves, errors, outcomes = [], [], [], []
    with warnings.catch_warnings():
        # Warnings of peers are not ours.
        warnings.simplefilter("ignore")
        began = time.process_time()
        for _ in range(REPEATS):
            built, run = _time(build)
            took, answer = _time(run)
            builds.append(built)
            solves.append(took)
            enough = time.process_time() - began > BUDGET
            found, outcome = judge(answer)
            errors.append(found)
            outcomes.append(outcome)
            if enough:
                break
    worst = tuple(max(column, key=abs) for column in zip(*errors, strict=True))
    outcome = next((outcome for outcome in outcomes if outcome != SOLVED), SOLVED)
    return Median(statistics.median(builds), statistics.median(solves), worst, outcome)


def _time(work: Callable[[], _Answer]) -> tuple[float, _Answer]:
    """Processor time that something takes [s], and its answer.

    Other work on the machine hardly changes it. What is too short for its clock is done several
    times over.
    """
    wall, processor = time.perf_counter(), time.process_time()
    answer = work()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    if wall > SHORT:
        return processor, answer
    count = math.ceil(SHORT / max(wall, SHORT / 200))
    processor = time.process_time()
    for _ in range(count):
        work()
    return (time.process_time() - processor) / count, answer


def find_mean(seconds: Sequence[float]) -> float:
    """Shifted geometric mean [s]."""
    logs = [math.log(value + SHIFT) for value in seconds]
    return math.exp(math.fsum(logs) / len(logs)) - SHIFT
