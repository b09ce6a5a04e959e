"""Run the command line: ``wholearm`` and ``python -m wholearm``."""

import os
import sys
from collections.abc import Sequence

from .common.signals import end_children, guard


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
        guard(start)
    finally:
        # Only an error that nobody expected comes here.
        end_children()


if __name__ == "__main__":
    run()
