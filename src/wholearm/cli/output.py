"""What commands print: progress, results, files, and notes on plans made for another problem.

Progress on stderr is a line that changes in a terminal, and else a line every ten seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from ..common.errors import name_source
from ..common.signals import listen

if TYPE_CHECKING:
    from ..common.document import Result
    from ..policy.playback import Policy
    from ..problem.definition import Problem
    from ..results.trajectory import Trajectory


EVERY = 10.0  # time between lines where stderr is no terminal [s]


class _Lines:
    """Lines for a log: what is being done, for how long already."""

    def __init__(self) -> None:
        listen(self.look)
        self.begin(0)

    def begin(self, process: int) -> None:
        """Count from now on, for the work of a process."""
        self._process, self._text = process, "working"
        self._begun = self._last = time.monotonic()

    def say(self, text: str) -> None:
        self._text = text
        self.look()

    def look(self) -> None:
        """Print what was said last, if it is time."""
        now = time.monotonic()
        # A forked process has the same work, whose progress its parent tells.
        if now - self._last < EVERY or os.getpid() != self._process:
            return
        self._last = now
        try:
            print(f"wholearm: {now - self._begun:.0f} s: {self._text}", file=sys.stderr, flush=True)
        except OSError:
            pass  # nobody reads it


_LINES = _Lines()  # those of the command, which may show progress of several things


@contextmanager
def progress_log() -> Iterator[None]:
    """Where stderr is no terminal, have a line logged every ten seconds of a command."""
    if not sys.stderr.isatty():
        _LINES.begin(os.getpid())
    try:
        yield
    finally:
        _LINES.begin(0)


def show_progress() -> Callable[[str], None]:
    """What shows progress."""
    if not sys.stderr.isatty():
        return _LINES.say

    def show(text: str) -> None:
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    return show


def announce(text: str) -> None:
    """Show one progress line, if anybody sees it."""
    show_progress()(text)


def clear_progress() -> None:
    """Remove the progress line."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)


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
    from ..results.adopt import describe_origin

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
