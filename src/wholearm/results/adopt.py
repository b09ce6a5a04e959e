"""Torques and motions of plans, replays and trajectories, checked against a problem; saving."""

from __future__ import annotations

import os
from typing import Protocol

from ..common.errors import InputError
from ..common.files import require_ending, write_text
from ..problem.check import require_phases
from ..problem.definition import Problem
from ..problem.read import adopt_phases
from ..problem.write import save_problem
from .torque import TorqueProfile
from .trajectory import Trajectory


class Moved(Protocol):
    """What has a trajectory: a plan, a simulation, a report."""

    @property
    def trajectory(self) -> Trajectory:
        """The motion with its forces and torques."""


Torques = TorqueProfile | Trajectory | Moved
"""What torques can be taken of."""


def narrow(what: Torques) -> tuple[TorqueProfile, Trajectory | None]:
    """The torques of a plan, a replay or a trajectory and its motion; None for torques alone."""
    if isinstance(what, TorqueProfile):
        return what, None
    trajectory = what if isinstance(what, Trajectory) else what.trajectory
    return trajectory.torque, trajectory


def adopt_motion(problem: Problem, plan: Torques) -> tuple[Problem, Trajectory]:
    """The motion of a plan, and the problem with its phases where that has goals instead.

    Raises
    ------
    InputError  if torques alone are given, or the plan ends elsewhere than at the last goal
    """
    problem, _, trajectory = adopt_torques(problem, plan)
    if trajectory is None:
        raise InputError("", "plan", "torques alone given; a plan with its motion is needed")
    return problem, trajectory


def adopt_torques(
    problem: Problem, what: Torques
) -> tuple[Problem, TorqueProfile, Trajectory | None]:
    """The problem as of `adopt_motion`, and the torques and motion as of `narrow`."""
    torque, trajectory = narrow(what)
    if trajectory is not None:
        problem = adopt_phases(problem, trajectory.meta, trajectory.q[-1])
    return problem, torque, trajectory


def require_same_contacts(problem: Problem, plan: Trajectory | None) -> None:
    """Check that a plan, if there is one, has the contacts of a problem."""
    odd = (
        set()
        if plan is None
        else set(plan.contacts) ^ {contact.name for contact in problem.contacts}
    )
    if odd:
        text = f"trajectory and problem differ in {', '.join(sorted(odd))}"
        raise InputError("", "contacts", text)


def require_same_phases(problem: Problem, plan: Trajectory) -> None:
    """Check that a plan has the phases of a problem."""
    require_phases(problem)
    given = [set(motion.contacts) for motion in plan.motions]
    if given != [set(phase.formation.names) for phase in problem.phases]:
        raise InputError("", "phases", "the plan's contacts are not those of the problem's phases")


def save(what: Torques | Problem, path: str | os.PathLike[str]) -> None:
    """Write a motion to a ``.npz`` file, torques as CSV or a problem as TOML, by the ending.

    Parameters
    ----------
    path  a ``.csv`` file has the columns ``t,tau1,tau2``, a repeated time being a step, and rows as
          dense as the torques are bent

    Raises
    ------
    InputError  if the file has another ending or cannot be written, or torques alone are to be a
                motion
    """
    if isinstance(what, Problem):
        return save_problem(what, path)
    torque, trajectory = narrow(what)
    if require_ending(path, ".npz", ".csv") == ".csv":
        from .torque import format_rows, place_rows

        write_text(path, format_rows(place_rows(torque)))
    elif trajectory is None:
        raise InputError(str(path), "", "torques alone have no motion; simulate them, or give .csv")
    else:
        trajectory.save(path)
