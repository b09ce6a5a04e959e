"""Run the command line: ``wholearm`` and ``python -m wholearm``."""

import signal
import sys

from .interrupts import guard


def _run() -> int:
    from .cli import main

    return main()


def run() -> None:
    """Run a command, from its imports on, and exit with its status."""
    status = guard(_run)
    # What the command had to do is done; exiting takes a moment, and would be a traceback.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    sys.exit(status)


if __name__ == "__main__":
    run()
