"""What an engine is asked, and what it answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from ..common.arrays import Array
from ..policy.closed_loop import ClosedLoop
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory

ROWS = 200
"""About how many times a phase is looked at."""
FEWEST = 5000
"""Fewest steps of a stretch: after a step of torques contacts swing for tens of steps."""
_LOOKS = 8
"""Instants of each step over which torques are averaged."""
_LEAST = 1e-3
"""First of these instants after the start, in steps."""


class Stretch(NamedTuple):
    """A part of a plan that is replayed on its own: one phase, or all.

    Attributes
    ----------
    phases : tuple of int
        Indices of its phases, from 0.
    start, stop : float, [s]
    z, z_dot, z_ddot : ndarray, shape (5,)
        The planned motion at its start.
    c_n : mapping
        Planned normal forces at its start by contacts [N].
    """

    phases: tuple[int, ...]
    start: float
    stop: float
    z: Array
    z_dot: Array
    z_ddot: Array
    c_n: Mapping[str, float]

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
        """How long it is planned to last [s]."""
        return self.stop - self.start


class Setting(NamedTuple):
    """How finely an engine computes.

    Attributes
    ----------
    step : float
        Time step, over the scene's time.
    softness : float
        Softness of contacts, over the engine's default, which is in proportion to the step.
    """

    step: float
    softness: float = 1.0


class Steps(NamedTuple):
    """The time steps of a stretch, and those after which the state is recorded.

    Engines change the velocity by the forces at a position, and then the position by the new
    velocity. That is of second order in h where velocities are taken for those of half a step
    before: at the start, and for the torques.

    Attributes
    ----------
    h : float, [s]
    v : ndarray, shape (5,)
        Velocity half a step before the start.
    tau : ndarray, shape (n, 2), [N m]
        Applied torques, averaged from half a step before to half a step after each position.
    ends : ndarray of int, shape (rows,)
        Numbers of steps after which there is a row, increasing; the last is n.
    """

    h: float
    v: Array
    tau: Array
    ends: list[int]


class Run(NamedTuple):
    """A stretch in an engine.

    Attributes
    ----------
    t : ndarray, shape (rows + 1,), [s]
        From the start of the plan.
    z, z_dot : ndarray, shape (rows + 1, 5)
    pairs : tuple of str
        Pairs of shapes, see `shapes.list_pairs`.
    press : ndarray, shape (rows, n_pairs), [N]
        Normal forces, averaged between rows.
    """

    t: Array
    z: Array
    z_dot: Array
    pairs: tuple[str, ...]
    press: Array


Engine = Callable[[Problem, Stretch, TorqueProfile | ClosedLoop, Setting], Run]
"""Replays a stretch under the torques that are applied, or by feedback until the motion is over."""


def list_stretches(plan: Trajectory, whole: bool) -> list[Stretch]:
    """The whole plan, or its phases, each from its planned start."""
    starts, count = plan.phase_starts, len(plan.motions)
    found = []
    for own in [tuple(range(count))] if whole else [(index,) for index in range(count)]:
        motion, start, stop = plan.motions[own[0]], starts[own[0]], starts[own[-1] + 1]
        at = motion.evaluate(np.linspace(0.0, motion.duration, ROWS))
        # Forces are not known of a replay that waits at rest.
        known = at.c_n[int(np.argmax(np.isfinite(at.c_n).all(axis=1)))]
        forces = dict(zip(motion.contacts, np.nan_to_num(known).tolist(), strict=True))
        state = at.z[0], at.z_dot[0], at.z_ddot[0]
        found.append(Stretch(own, float(start), float(stop), *state, forces))
    return found


def list_steps(
    problem: Problem, stretch: Stretch, torque: TorqueProfile | ClosedLoop, step: float
) -> Steps:
    """Even steps that fit a stretch, none longer than `step` times the scene's time.

    Torques by feedback are zero here.
    """
    duration = stretch.stop - stretch.start
    count = max(int(np.ceil(duration / (step * problem.scene.scales.time) - 1e-9)), FEWEST)
    h = duration / count
    tau = np.zeros((count, 2))
    if isinstance(torque, TorqueProfile):
        tau = _average(torque, stretch.start, h, count)
    v = stretch.z_dot - h / 2 * stretch.z_ddot
    rows = min(count, ROWS * len(stretch.phases))
    ends = np.linspace(0, count, rows + 1)[1:].astype(int).tolist()
    return Steps(h, v, tau, ends)


def _average(torque: TorqueProfile, start: float, h: float, count: int) -> Array:
    """Torques of steps."""
    places = (np.arange(count * _LOOKS) + 0.5) * (h / _LOOKS) - h / 2
    places = start + np.maximum(places, _LEAST * h)
    return np.asarray(torque.at(places).reshape(count, _LOOKS, 2).mean(axis=1))
