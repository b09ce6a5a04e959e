"""Progress on stderr: a line that changes in a terminal, and else a line every ten seconds."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ..common.signals import listen

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
