"""Run the command line: ``wholearm`` and ``python -m wholearm``."""

import atexit
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Sequence

from .common.signals import ENDED, end_children, guard


def start(arguments: Sequence[str] | None = None) -> int:
    """Run the command of the given arguments, or of the process's, and return its exit status."""
    from .cli.command import main

    return main(arguments)


def run() -> None:
    """Run a command, from its imports on, and exit with its status."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")
    try:
        guard(start, leave=_leave)
    finally:
        # Only an error that nobody expected comes here.
        end_children()


def _leave(status: int) -> None:
    """End the process."""
    # What the command had to do is done; exiting takes a moment, and would be a traceback.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    # `atexit` waits for children, and nothing tells those of a study that was left to end. The
    # thread that looks after them may be surprised, which nobody is to read.
    threading.excepthook = lambda _: None
    end_children()
    # To delete every object one by one takes a tenth of a short command, or seconds of a long one.
    atexit._run_exitfuncs()
    if status not in ENDED:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
