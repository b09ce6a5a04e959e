"""A progress line on stderr, where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable


def show_progress() -> Callable[[str], None] | None:
    """What shows a progress line, if anybody sees it."""
    if not sys.stderr.isatty():
        return None

    def show(text: str) -> None:
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

    return show


def announce(text: str) -> None:
    """Show one progress line, if anybody sees it."""
    show = show_progress()
    if show is not None:
        show(text)


def clear_progress() -> None:
    """Remove the progress line."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr, flush=True)
