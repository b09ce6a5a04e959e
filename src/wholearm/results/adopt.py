"""Torques and motions of plans, replays and trajectories, checked against a problem; saving."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Protocol

from ..common.arrays import Array
from ..common.document import Difference, describe_differences, find_differences
from ..common.errors import InputError, name_source
from ..common.files import require_ending, write_text
from ..problem.definition import Problem
from ..problem.read import read_stored_problem, require_phases
from ..problem.table import save_problem
from .torque import TorqueProfile, format_rows, place_rows
from .trajectory import Trajectory


class MotionLike(Protocol):
    """Object with a trajectory: a plan, a simulation, a report."""

    @property
    def trajectory(self) -> Trajectory:
        """The motion with its forces and torques."""


Torques = TorqueProfile | Trajectory | MotionLike  # objects that have torques


def split_torques(what: Torques) -> tuple[TorqueProfile, Trajectory | None]:
    """Torques and trajectory of a plan, a replay or a trajectory; None for torques alone."""
    if isinstance(what, TorqueProfile):
        return what.check(), None
    trajectory = what if isinstance(what, Trajectory) else getattr(what, "trajectory", None)
    if not isinstance(trajectory, Trajectory):
        reason = "allowed are a plan, a simulation, a report, a Trajectory and a TorqueProfile"
        raise InputError("", "what", f"{what!r} given; {reason}")
    return trajectory.torque, trajectory


def adopt_phases(problem: Problem, meta: Mapping[str, Any], q: Array, source: str = "") -> Problem:
    """A problem with goals, with the phases of a plan (its `meta`) in their place.

    An `InputError` that names the plan's file `source` if the plan does not store its problem, or
    its end `q`, (3,) [m, m, rad], is not the last goal, as that of another object or hand.
    """
    if not problem.goals:
        return problem
    goal, (x, _, phi), tol = problem.goals[-1], q.tolist(), 1e-3
    rotated = abs(goal.find_angle(problem.scene, phi) - phi) > tol
    if rotated or (goal.x is not None and abs(goal.x - x) > tol * problem.scene.scales.length):
        with name_source(source):
            describe_origin(problem, meta)
        place = f"x = {1e3 * x:.4g} mm, phi = {math.degrees(phi):.4g} deg"
        raise InputError(source, "goal", f"the plan ends at {place}, and not with {goal}")
    return replace(problem, phases=read_stored_problem(meta, source).phases, goals=())


def adopt_torques(
    problem: Problem, what: Torques
) -> tuple[Problem, TorqueProfile, Trajectory | None]:
    """The problem, with the phases of the plan if it has goals, and torques and motion of the plan.

    InputError if the plan does not end at the last goal.
    """
    torque, trajectory = split_torques(what)
    if trajectory is not None:
        problem = adopt_phases(problem, trajectory.meta, trajectory.q[-1])
    return problem, torque, trajectory


def require_motion(plan: Torques) -> Trajectory:
    """The trajectory of a plan or a replay; an `InputError` if torques alone are given."""
    _, trajectory = split_torques(plan)
    if trajectory is None:
        raise InputError("", "plan", "torques alone given; a plan with its motion is needed")
    return trajectory


def adopt_motion(problem: Problem, plan: Torques) -> tuple[Problem, Trajectory]:
    """Problem and motion as of `adopt_torques`.

    InputError if torques alone are given, or the motion has other phases than the problem.
    """
    trajectory = require_motion(plan)
    problem, *_ = adopt_torques(problem, trajectory)
    require_same_phases(problem, trajectory)
    return problem, trajectory


def require_same_contacts(problem: Problem, plan: Trajectory | None) -> None:
    """Check that a plan, if there is one, has the contacts of a problem."""
    contact_names = {contact.name for contact in problem.contacts}
    if plan is not None and (difference := {*plan.contacts} ^ contact_names):
        text = f"trajectory and problem differ in {', '.join(sorted(difference))}"
        raise InputError("", "contacts", text)


def require_same_phases(problem: Problem, plan: Trajectory) -> None:
    """Check that a plan has the phases of a problem."""
    require_phases(problem)
    contact_sets = [set(motion.contacts) for motion in plan.motions]
    if contact_sets != [set(phase.formation.names) for phase in problem.phases]:
        raise InputError("", "phases", "the plan's contacts are not those of the problem's phases")


def save(what: Torques | Problem, path: str | os.PathLike[str]) -> None:
    """Write a motion to a ``.npz`` file, torques as CSV or a problem as TOML, by the ending.

    A ``.csv`` file has the columns ``t,tau1,tau2``, a repeated time being a step; the density of
    rows follows the curvature of the torques.

    InputError if the file has another ending or cannot be written, or torques alone are saved as a
    motion.
    """
    if isinstance(what, Problem):
        return save_problem(what, path)
    torque, trajectory = split_torques(what)
    if require_ending(path, ".npz", ".csv") == ".csv":
        write_text(path, format_rows(place_rows(torque)))
    elif trajectory is None:
        raise InputError(str(path), "", "torques alone have no motion; simulate them, or give .csv")
    else:
        trajectory.save(path)


_FREE = (".name", ".epsilon", ".settle_gap", ".uncertainty", ".goal", "settle", "guess")
"""Keys of a problem that may differ in its plans; those with a dot at the top level only."""


def require_made_for(problem: Problem, meta: Mapping[str, Any]) -> None:
    """InputError if the plan with this `meta` was not made for a problem."""
    if not isinstance(meta.get("problem"), Mapping):
        raise InputError("", "meta.problem", "the trajectory does not hold its problem's tables")
    if origin := describe_origin(problem, meta, "trajectory"):
        raise InputError("", "", origin)


def describe_origin(problem: Problem, meta: Mapping[str, Any], what: str = "plan") -> str:
    """Differences between `problem` and the one that a plan or a policy was made for, in one line.

    `meta` of the plan has the tables of its problem. The line is empty without tables, and if
    nothing differs.

    InputError if the plan cannot be used for the problem: the object has other vertices, or the
    hand is another one, with a base or a length that differs by more than a tenth of the link.
    """
    table = meta.get("problem")
    if not isinstance(table, Mapping) or table == problem.table:
        return ""
    # A plan for goals has phases instead.
    free = (*_FREE, ".phases") if "goal" in problem.table else _FREE
    differences = list(find_differences(table, problem.table, free))
    for difference in differences:
        if mismatch := _describe_mismatch(difference, problem):
            values = f"{difference.one} in the {what}, {difference.other} here"
            raise InputError("", difference.key, f"{values}; {mismatch}")
    text = describe_differences(differences, f"in the {what}", "here")
    return f"made for another problem: {text}" if text else ""


def _describe_mismatch(difference: Difference, problem: Problem) -> str:
    """Sentence if a difference shows that a plan is of another object or hand, or empty."""
    if difference.key == "object.vertices":
        return "its contacts are those of another polygon"
    for finger in problem.scene.fingers:
        if difference.key.startswith((f"{finger.name}.base", f"{finger.name}.length")):
            with suppress(ValueError):
                # More than an error of measurement.
                if abs(float(difference.one) - float(difference.other)) > 0.1 * finger.length:
                    return "it is one of another hand"
    return ""
