"""Run the command line: ``wholearm`` and ``python -m wholearm``."""

import atexit
import contextlib
import os
import signal
import sys
from collections.abc import Sequence

from .common.interrupts import ENDED, guard


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
    status = guard(start)
    # What the command had to do is done; exiting takes a moment, and would be a traceback.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    # To delete every object one by one takes a tenth of a short command, or seconds of a long one.
    atexit._run_exitfuncs()
    if status not in ENDED:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
