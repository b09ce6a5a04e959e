"""What a command says first of a plan or a policy that was made for another problem."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..common.errors import name_source

if TYPE_CHECKING:
    from ..policy.playback import Policy
    from ..problem.definition import Problem
    from ..results.trajectory import Trajectory


def tell_origin(
    problem: Problem,
    plan: tuple[str, Trajectory],
    policy: tuple[str, Policy] | None = None,
    silent: bool = False,
) -> dict[str, list[str]]:
    """Print a line for what was made for another problem.

    Parameters
    ----------
    plan, policy  the file and what is in it
    silent        leave printing to the caller

    Returns
    -------
    dict  the lines as `notes`, for JSON; empty if there are none

    Raises
    ------
    InputError  if one of them makes no sense for the problem; names its file
    """
    from ..results.provenance import describe_origin

    given = [("plan", plan[0], plan[1].meta)]
    if policy is not None:
        given.append(("policy", policy[0], policy[1].about))
    notes: list[str] = []
    for what, source, meta in given:
        with name_source(source):
            notes += filter(None, [describe_origin(problem, meta, what)])
    for note in () if silent else notes:
        print(note)
    return {"notes": notes} if notes else {}
