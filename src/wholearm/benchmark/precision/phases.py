"""The phases that a study runs on, and what peers are given of them.

Phases are those of one freedom, on four sliding contacts. Peers get the equations of motion, and a
slow motion to start from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np

from ...common.arrays import Array, Expression
from ...contacts.formation import Formation
from ...geometry.curve import Curve, Segment
from ...geometry.tracing import trace_phases
from ...mechanics.dynamics import build_force_rows
from ...planning.path_domain.first_guess import guess
from ...planning.path_domain.path_data import prepare
from ...planning.path_domain.path_mesh import Mesh
from ...planning.path_domain.path_motion import PathMotion
from ...problem.definition import End, Problem
from ...problem.read import read_problem
from ...results.torque import TorqueProfile
from ...results.trajectory import Samples


class Instance(NamedTuple):
    """One phase from rest to rest."""

    name: str  # of the file, and the number of the phase
    problem: Problem  # of that phase alone
    curve: Curve


def keep_curves(problem: Problem) -> Problem | None:
    """The first phases of a problem as far as each is a curve of four sliding contacts.

    These are what peers know; None if already the first phase is not.
    """
    curves = trace_phases(problem)
    rolling = [bool(phase.formation.rolling) for phase in problem.phases[: len(curves)]]
    count = [*rolling, True].index(True)
    kept = tuple(replace(phase, end=End.REST) for phase in problem.phases[:count])
    return replace(problem, phases=kept) if kept else None


@lru_cache(maxsize=4)
def list_instances(paths: tuple[str, ...], drag: bool = True) -> tuple[Instance, ...]:
    """Every phase of problem files that is such a curve; those that files share once.

    Without `drag` joints have no viscous friction.
    """
    found: dict[object, Instance] = {}
    for path in paths:
        read = read_problem(path)
        problem = keep_curves(read if drag else read.with_(viscous=0.0))
        for instance in isolate(problem, Path(path).stem) if problem else ():
            found.setdefault(_identify(instance), instance)
    return tuple(found.values())


def isolate(problem: Problem, name: str) -> list[Instance]:
    """Each phase of a problem as a problem of its own."""
    found = []
    for phase, curve in zip(problem.phases, trace_phases(problem), strict=True):
        alone = replace(problem, start=curve.start, phases=(replace(phase, index=0),))
        found.append(Instance(f"{name} {phase.number}", alone, curve))
    return found


def _identify(instance: Instance) -> object:
    """Equal for phases that are the same in different files."""
    problem = instance.problem
    (phase,), scene = problem.phases, problem.scene
    limits = (problem.epsilon, *scene.torque_limit, *scene.speed_limit)
    places = np.round(np.append(problem.start, instance.curve.end), 9) + 0.0
    return scene.equations, limits, phase.formation.names, tuple(places)


def find_files(folder: str) -> tuple[str, ...]:
    """Problem files of a folder."""
    return tuple(str(path) for path in sorted(Path(folder).glob("*.toml")))


def pick(instances: Sequence[Instance], name: str) -> Instance:
    """The instance of a name."""
    return next(instance for instance in instances if instance.name == name)


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

    It keeps all limits, with its squeeze amid the range that they allow.
    """
    curve = instance.curve
    grid = Mesh().make_grid(curve, 5 + len(curve.segments))
    data = prepare(curve, instance.problem.epsilon, grid, 0)
    motion = PathMotion(curve, data.grid, guess(data)[0])
    last = np.flatnonzero(np.diff(motion.grid.segment, append=-1))
    marks = np.append(0.0, motion.times[last])
    found = []
    for start, stop, count in zip(marks, marks[1:], counts, strict=False):
        # Ends of a stretch are looked at from within it.
        t = np.linspace(start, stop, count)
        inside = np.clip(t, start + 1e-9 * (stop - start), stop - 1e-9 * (stop - start))
        found.append((t - start, motion.evaluate(inside)))
    return found


def count_intervals(stretches: list[PhaseStretch], intervals: int, least: int = 4) -> list[int]:
    """About so many intervals, shared among the stretches of a phase."""
    return [max(least, round(intervals * stretch.share)) for stretch in stretches]
