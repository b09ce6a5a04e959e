"""Interface of physics engines: parts of a plan, settings, time steps and results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array, sort_unique
from ..common.errors import WholearmError
from ..policy.playback import ClosedLoop
from ..problem.definition import Problem
from ..problem.read import read_own_problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory
from ..scene.model import Scene
from ..simulation.simulate import simulate

SAME = 1e-4  # difference of replay and plan that counts as none, over the scene's length and in rad
LATE = 1e-3  # difference of phase ends, over the scene's time: rest is approached slowly
_ROWS = 400  # samples of each phase of the reference replay, besides its steps
_INSTANTS = 2000  # samples of each phase for reversals of joints
ROWS = 200  # approximate rows of a result per phase
FEWEST = 5000  # least steps of a stretch: contacts oscillate after a jump of torques
_LOOKS = 8  # samples of each step over which torques are averaged
_LEAST = 1e-3  # first of these samples after the start, in steps


class EngineStretch(NamedTuple):
    """A part of a plan that is replayed alone: one phase, or all."""

    phases: tuple[int, ...]  # indices of its phases, from 0
    start: float  # start, stop [s]
    stop: float
    z: Array  # z, z_dot, z_ddot (5,): the planned motion at its start
    z_dot: Array
    z_ddot: Array
    c_n: Mapping[str, float]  # planned normal forces at its start by contacts [N]

    @property
    def numbers(self) -> list[int]:
        """Numbers of its phases, from 1."""
        return [index + 1 for index in self.phases]

    @property
    def name(self) -> str:
        """Numbers of the phases, first to last."""
        return "-".join(map(str, dict.fromkeys((self.numbers[0], self.numbers[-1]))))

    @property
    def duration(self) -> float:
        """Planned duration [s]."""
        return self.stop - self.start


class Setting(NamedTuple):
    """Discretization of an engine."""

    step: float  # time step, over the scene's time
    softness: float = 1.0  # of contacts, over the engine's default, which is in proportion to step


class Steps(NamedTuple):
    """Time steps of a stretch.

    Engines use the semi-implicit Euler method, which is of second order in h if velocities are read
    as those of half a step before: at the start, and for the torques.
    """

    h: float  # [s]
    v: Array  # (5,): velocity half a step before the start
    tau: Array  # (n, 2) [N m]: torques, averaged over half a step before and after each position
    ends: list[int]  # numbers of the steps after which the state is recorded; the last is n


class EngineRun(NamedTuple):
    """A stretch in an engine."""

    t: Array  # (rows + 1,) [s]: from the start of the plan
    z: Array  # z, z_dot (rows + 1, 5)
    z_dot: Array
    pairs: tuple[str, ...]  # pairs of shapes, see `shapes.list_pairs`
    press: Array  # (rows, n_pairs) [N]: normal forces, averaged between rows


Engine = Callable[[Problem, EngineStretch, TorqueProfile | ClosedLoop, Setting], EngineRun]
"""Replays a stretch under the torques that are applied, or by feedback until the motion is over."""


def list_stretches(plan: Trajectory, whole: bool) -> list[EngineStretch]:
    """The whole plan, or its phases, each from its planned start."""
    starts, count = plan.phase_starts, len(plan.motions)
    found = []
    for phases in [tuple(range(count))] if whole else [(index,) for index in range(count)]:
        motion, start, stop = plan.motions[phases[0]], starts[phases[0]], starts[phases[-1] + 1]
        at = motion.evaluate(np.linspace(0.0, motion.duration, ROWS))
        # Forces of a replay that waits at rest are NaN.
        c_n = np.nan_to_num(at.c_n[int(np.argmax(np.isfinite(at.c_n).all(axis=1)))])
        forces = dict(zip(motion.contacts, c_n.tolist(), strict=True))
        state = at.z[0], at.z_dot[0], at.z_ddot[0]
        found.append(EngineStretch(phases, float(start), float(stop), *state, forces))
    return found


def list_steps(
    problem: Problem, stretch: EngineStretch, torque: TorqueProfile | ClosedLoop, step: float
) -> Steps:
    """Even steps that fit a stretch, none longer than `step` times the scene's time.

    Torques by feedback are zero here.
    """
    duration = stretch.stop - stretch.start
    count = max(int(np.ceil(duration / (step * problem.scene.scales.time) - 1e-9)), FEWEST)
    h = duration / count
    tau = np.zeros((count, 2))
    if isinstance(torque, TorqueProfile):
        t = (np.arange(count * _LOOKS) + 0.5) * (h / _LOOKS) - h / 2
        samples = torque.at(stretch.start + np.maximum(t, _LEAST * h))
        tau = np.asarray(samples.reshape(count, _LOOKS, 2).mean(axis=1))
    v = stretch.z_dot - h / 2 * stretch.z_ddot
    rows = min(count, ROWS * len(stretch.phases))
    ends = np.linspace(0, count, rows + 1)[1:].astype(int).tolist()
    return Steps(h, v, tau, ends)


def apply_friction(scene: Scene, plan: Trajectory) -> TorqueProfile:
    """The torques of a plan less D sgn(theta') of its own joint velocities, with its steps."""
    torque, reversals = plan.torque, list[Array]()
    for start, motion in zip(plan.phase_starts[:-1], plan.motions, strict=True):
        t = np.linspace(0.0, motion.duration, _INSTANTS)
        for speed in motion.evaluate(t).z_dot[:, 3:].T:
            back = np.flatnonzero(speed[1:-2] * speed[2:-1] < 0) + 1
            share = speed[back] / (speed[back] - speed[back + 1])
            reversals.append(start + t[back] + share * (t[back + 1] - t[back]))
    cuts = sort_unique(np.concatenate([torque.breaks, *reversals]))
    cuts = cuts[np.append(True, np.diff(cuts) > 1e-12 * torque.duration)]
    cuts[-1] = torque.breaks[-1]
    turns = np.sign(plan.at((cuts[1:] + cuts[:-1]) / 2).z_dot[:, 3:]) * scene.dry[3:]

    def evaluate(t: Array) -> Array:
        piece = np.searchsorted(cuts, t, side="right") - 1
        return np.asarray(torque.at(t) - turns[piece])

    return TorqueProfile.fit(cuts, evaluate, torque.coefficients.shape[2] - 1)


def find_between(plan: Trajectory) -> Trajectory:
    """The replay of a plan in its own problem, or the plan itself where that is not the same."""
    starts = plan.phase_starts
    times = np.linspace(starts[:-1], starts[1:], _ROWS)
    try:
        problem = read_own_problem(plan.meta)
        replay = simulate(problem, plan.torque, times=times.ravel()).trajectory
    except WholearmError:
        return plan
    if len(replay.motions) != len(plan.motions):
        return plan
    late = np.abs(replay.phase_starts - starts).max()
    inside = np.clip(plan.t, 0.0, replay.duration)
    error = np.abs(replay.at(inside).z - plan.z) / [*2 * [problem.scene.scales.length], 1, 1, 1]
    same = late < LATE * problem.scene.scales.time and error.max() < SAME
    return replay if same else plan
