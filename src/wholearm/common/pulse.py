"""What long work looks at again and again: whether its time is over, and who wants to hear of it.

`beat` is called before every run of a solver and at every step of a search.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .interrupts import check

_listeners: list[Callable[[], object]] = []
_deadline: float | None = None


class OutOfTime(KeyboardInterrupt):
    """A time limit is over. Like an interrupt, it is no error that work may go on after."""


@contextmanager
def limited(seconds: float | None) -> Iterator[None]:
    """Have `beat` raise OutOfTime once so many seconds are over; None leaves an outer limit.

    Raises
    ------
    InputError
        If the limit is not a positive number.
    """
    global _deadline
    if seconds is None:
        yield
        return
    # It needs NumPy, which bad input on a command line does not wait for.
    from .require import require_number

    end = time.monotonic() + require_number(seconds, "time_limit", positive=True)
    outer, _deadline = _deadline, end if _deadline is None else min(end, _deadline)
    try:
        yield
    finally:
        _deadline = outer


def listen(heard: Callable[[], object]) -> None:
    """Have something called at every beat."""
    _listeners.append(heard)


def beat() -> None:
    """Tell listeners that work goes on, and end it with OutOfTime if its time is over."""
    check()
    for heard in _listeners:
        heard()
    if _deadline is not None and time.monotonic() > _deadline:
        raise OutOfTime


class Reporter:
    """Passes on what is being done, and remembers it.

    Attributes
    ----------
    last : str
    """

    def __init__(self, progress: Callable[[str], None] | None) -> None:
        self._progress, self.last = progress, "begun"

    def __call__(self, text: str) -> None:
        """Tell it."""
        self.last = text
        if self._progress is not None:
            self._progress(text)
        beat()
