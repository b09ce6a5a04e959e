"""Run the command line: ``wholearm`` and ``python -m wholearm``."""

import atexit
import os
import signal
import sys

from .interrupts import ENDED, guard


def _run() -> int:
    from .cli import main

    return main()


def run() -> None:
    """Run a command, from its imports on, and exit with its status."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")
    status = guard(_run)
    # What the command had to do is done; exiting takes a moment, and would be a traceback.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if status in ENDED:
        # To delete large expressions one by one can take seconds.
        atexit._run_exitfuncs()
        os._exit(status)
    sys.exit(status)


if __name__ == "__main__":
    run()
