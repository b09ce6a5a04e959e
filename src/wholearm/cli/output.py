"""What commands check and print of files and results; notes on plans made for another problem."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..common.errors import name_source
from .progress import clear_progress

if TYPE_CHECKING:
    from ..common.document import Result
    from ..policy.playback import Policy
    from ..problem.definition import Problem
    from ..results.trajectory import Trajectory


def require_output(path: str | None, *endings: str) -> None:
    """Check, before long work, that a file can be written; without endings it is a figure."""
    if path is None:
        return
    from ..common.files import require_ending, require_writable

    if not endings:
        from ..figures.plots import require_format

        require_format(path)
    require_writable(path)
    if endings:
        require_ending(path, *endings)


def print_result(
    options: argparse.Namespace, result: Result, notes: Mapping[str, Any] | None = None
) -> int:
    """Print a result as text, or with --json and with notes as JSON; return the exit status."""
    clear_progress()
    if options.json:
        print(json.dumps({**result.to_dict(), **(notes or {})}, indent=2))
    else:
        print(result.to_text())
    return result.exit_status


def name_files(options: argparse.Namespace, *paths: str | None) -> None:
    """Say which files have been written, if any, but not amid JSON."""
    clear_progress()
    written = ", ".join(filter(None, paths))
    if written and not getattr(options, "json", False):
        print(f"wrote {written}")


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
