"""SIGINT and SIGTERM end a command at once, wherever it is.

The handler removes temporary files, ends child processes, says why and leaves the process. It
raises nothing: CasADi goes on after an exception that a handler raises inside its code, or crashes
(2 of 800 interrupted plannings with 3.7.0). Signals wait while files that belong together are moved
(`held`), and a search is told of the first SIGINT at its next `beat` (`yielding`).
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_ending = threading.RLock()
"""Held while something is done that may not be left half done, ending the process included."""
_holder: int | None = None  # thread that holds it
_received: int | None = None
_yielding = _stopping = False
_cleanups: list[Callable[[], object]] = []
_listeners: list[Callable[[], object]] = []
_deadline: float | None = None


def guard(run: Callable[[], int]) -> None:
    """Run a command, and end the process with its exit status, or with 128 + a signal's number."""
    try:
        for number in _WORDS:
            # A shell lets background jobs ignore SIGINT, which is not for us to change.
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                signal.signal(number, _interrupt)
        status = run()
    except KeyboardInterrupt:
        # It came before the handler was in place.
        _end_by(signal.SIGINT)
    # What the command had to do is done, and exiting takes a moment.
    for number in _WORDS:
        signal.signal(number, signal.SIG_IGN)
    _leave(status)


def _interrupt(number: int, _: FrameType | None) -> None:
    """Handle a signal."""
    global _received, _stopping
    if _yielding and not _stopping and number == signal.SIGINT:
        _stopping = True
    elif _holder == threading.get_ident():
        _received = _received or number
    else:
        _end_by(number)


def _end_by(number: int) -> NoReturn:
    """End the process because of a signal."""
    with _ending:
        # A second one often follows the first at once.
        for other in _WORDS:
            signal.signal(other, signal.SIG_IGN)
        # It may have come in the middle of printing.
        for cleanup in _cleanups:
            with suppress(OSError, RuntimeError):
                cleanup()
        with suppress(OSError):
            os.write(2, f"wholearm: {_WORDS[signal.Signals(number)]}\n".encode())
        _leave(128 + number, flush=False)


def _leave(status: int, flush: bool = True) -> NoReturn:
    """End the process without deleting every object, which takes a tenth of a short command."""
    # `atexit` waits for children, and nothing tells those of a study that was left to end. The
    # thread that looks after them may be surprised, which nobody is to read.
    threading.excepthook = lambda _: None
    end_children()
    atexit._run_exitfuncs()
    if flush:
        with suppress(OSError, ValueError):
            sys.stdout.flush()
    os._exit(status)


def end_children() -> None:
    """Kill the processes that `multiprocessing` has started."""
    processes = sys.modules.get("multiprocessing")
    for child in processes.active_children() if processes else ():
        child.kill()


def on_end(cleanup: Callable[[], object]) -> None:
    """Register what has to be cleaned up when a signal ends a command."""
    _cleanups.append(cleanup)


@contextmanager
def held() -> Iterator[None]:
    """Have signals wait while something is done that may not be left half done."""
    global _holder
    with _ending:
        outer, _holder = _holder, threading.get_ident()
        try:
            yield
        finally:
            _holder = outer
            if _received is not None and outer is None:
                _end_by(_received)


@contextmanager
def yielding() -> Iterator[None]:
    """Have the first SIGINT only raise KeyboardInterrupt, at the next `beat` or at the end."""
    global _yielding, _stopping
    _yielding = True
    try:
        yield
        check()
    finally:
        _yielding = _stopping = False


@contextmanager
def interruptible() -> Iterator[None]:
    """Have SIGINT raise KeyboardInterrupt at the next `beat`, too: CasADi may drop the first one.

    That is for programs with the handler of Python, which raises it once.
    """
    global _stopping
    handler, main = signal.default_int_handler, threading.main_thread()
    if threading.current_thread() is not main or signal.getsignal(signal.SIGINT) is not handler:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        global _stopping
        _stopping = True
        handler(number, frame)

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
        check()
    finally:
        _stopping = False
        signal.signal(signal.SIGINT, handler)


def check() -> None:
    """Raise KeyboardInterrupt if a signal asks for the end of what is done here (`yielding`)."""
    if _stopping:
        raise KeyboardInterrupt


class OutOfTime(KeyboardInterrupt):
    """A time limit is over. Like an interrupt, it is no error that work may go on after."""


@contextmanager
def limited(seconds: float | None) -> Iterator[None]:
    """Have `beat` raise OutOfTime once so many seconds are over; None leaves an outer limit."""
    global _deadline
    if seconds is None:
        yield
        return
    # It needs NumPy, which bad input on a command line does not wait for.
    from .errors import require_number

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
    """Passes on what is being done, and remembers it as `last`."""

    def __init__(self, progress: Callable[[str], None] | None) -> None:
        self._progress, self.last = progress, "begun"

    def __call__(self, text: str) -> None:
        """Tell it."""
        self.last = text
        if self._progress is not None:
            self._progress(text)
        beat()
