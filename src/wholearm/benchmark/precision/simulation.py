"""Simulators over their tolerance: the courses that they run, and how they are measured."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ...common.arrays import Array
from ...geometry.curve import Curve
from ...geometry.tracing import trace_phases
from ...planning.options import PlanOptions
from ...planning.path_domain.data import prepare
from ...planning.path_domain.first_guess import guess
from ...planning.path_domain.mesh import Mesh
from ...planning.path_domain.motion import PathMotion
from ...planning.path_domain.plan import plan_path
from ...problem.read import read_problem
from ...results.torque import TorqueProfile
from ..baseline_simulation import find_gaps
from .instances import Instance
from .reference import Course, find_course, measure_error
from .runs import SOLVED, Key, Run, repeat
from .simulators import SIMULATORS

FEW, MANY, DRIFT = "simulation, few pieces", "simulation, many pieces", "simulation, 100 s"
"""Studies: torques in a few long pieces, planned torques in eighty, and a long swing."""
TOLERANCES = {
    FEW: tuple(10.0**-k for k in (4, *range(6, 14))),
    MANY: (1e-6, 1e-9, 1e-12),
    DRIFT: (1e-6, 1e-9, 1e-12),
}
"""Tolerances of each study."""
DEGREES = {FEW: 14, MANY: 6}
"""Degrees of the torques' polynomials."""
SLOW = 0.3
"""Square of the speed of the motion with few pieces, over that of a first guess of a plan."""
LOOKS = 201
"""Instants at which contact forces of a motion are looked at."""
STOP = 0.95
"""Share of the last stretch between reversals that is run: just before a stop all is ill-posed."""
SWING = {"x": 0.03, "friction": 0.0, "viscous": 0.0, "dry": 0.0}
"""Changes of a problem in which the object swings between the fingers without friction."""
SWING_TORQUE = (0.1, -0.27)
"""Torques of the swing [N m]."""
SWING_TIME = 100.0
"""How long it lasts [s]."""


class Task(NamedTuple):
    """One setting of one simulator on one course."""

    study: str
    instance: str
    method: str
    setting: str
    course: Course | None = None

    @property
    def key(self) -> Key:
        """Of its runs."""
        return self[:4]


def run_simulator(task: Task) -> list[Run]:
    """Run one task as often as its time allows."""
    course, tolerance = task.course, float(task.setting)
    assert course is not None
    build = partial(SIMULATORS[task.method].build, course, tolerance)
    # No timing is to include its import.
    import scipy.integrate  # noqa: F401

    runs = []
    with warnings.catch_warnings():
        # Other people's libraries warn of their own affairs.
        warnings.simplefilter("ignore")
        for index, (built, took, state) in enumerate(repeat(build)):
            error = measure_error(course.problem, state, course.end)
            gap, rise = _measure_swing(course, state) if task.study == DRIFT else (np.nan, np.nan)
            outcome = SOLVED if np.isfinite(error) else "no finite state"
            runs.append(Run(*task.key, index, built, took, error, gap, rise, outcome))
    return runs


def _measure_swing(course: Course, state: Array) -> tuple[float, float]:
    """Largest gap over the scene's length, and change of energy over its unit of energy."""
    scene, start = course.problem.scene, course.problem.start
    contacts = course.problem.phases[0].formation.contacts
    gap = float(np.abs(find_gaps(scene, contacts, state[:5])).max()) / scene.scales.length
    rise = 0.5 * state[5:] ** 2 @ scene.mass_diagonal - scene.applied_force @ (state[:5] - start)
    rise -= np.array(SWING_TORQUE) @ (state[3:5] - start[3:])
    return gap, abs(float(rise)) / scene.scales.torque


def make_course(instance: Instance, study: str) -> Course | None:
    """The course of a phase, until just before it comes to rest.

    None if the slow motion would lose a contact.
    """
    problem, curve = instance.problem, instance.curve
    if study == FEW:
        motion = make_slow_motion(curve, problem.epsilon)
    else:
        motion = plan_path(curve, problem.epsilon, PlanOptions(), 1).motion
    looks = np.linspace(0.0, motion.duration, LOOKS)
    if motion.evaluate(looks).c_n.min() <= 0:
        return None
    last = np.flatnonzero(np.diff(motion.grid.segment, append=-1))
    marks = np.append(0.0, motion.times[last])
    stop = marks[-2] + STOP * (marks[-1] - marks[-2])
    breaks = motion.times[np.append(motion.grid.steps > 0, True)]
    breaks = np.append(breaks[breaks < stop], stop)
    torque = TorqueProfile.fit(breaks, lambda t: motion.evaluate(t).tau, DEGREES[study])
    return find_course(problem, torque, curve, marks[1:-1])


def make_slow_motion(curve: Curve, epsilon: float) -> PathMotion:
    """A slow smooth motion with its squeeze amid the range that limits allow."""
    data = prepare(curve, epsilon, Mesh().make_grid(curve, 2 + len(curve.segments)), 0)
    profile, _ = guess(data)
    calm = profile._replace(a=SLOW * profile.a, b=SLOW * profile.b)
    return PathMotion(curve, data.grid, calm)


def make_swing(path: str, seconds: float = SWING_TIME) -> Course:
    """The object swings between the fingers without friction, pressed by constant torques."""
    free = read_problem(path).with_(**SWING)
    alone = replace(free, phases=free.phases[:1])
    torque = TorqueProfile(np.array([0.0, seconds]), np.array(SWING_TORQUE).reshape(1, 2, 1))
    return find_course(alone, torque, trace_phases(alone)[0], np.zeros(0))


def list_tasks(study: str, instance: str) -> list[Task]:
    """Every simulator and tolerance on a course."""
    return [
        Task(study, instance, method, f"{tolerance:g}")
        for method in SIMULATORS
        for tolerance in TOLERANCES[study]
        if study != DRIFT or not method.startswith(("Radau", "LSODA"))
    ]
