"""Handlers of SIGINT and SIGTERM, which end a command at once; time limits; progress.

The handler removes temporary files, kills child processes, prints the reason and exits. It raises
nothing: CasADi ignores an exception that a handler raises inside its code, or crashes (2 of 800
interrupted plannings with 3.7.0). Signals are deferred while files of a group are moved
(`defer_signals`); in a search the first SIGINT is raised at the next `beat` (`interrupt_at_beat`).
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

_REASONS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_end_lock = threading.RLock()
"""Held during operations that must not be interrupted, the end of the process included."""
_holder: int | None = None  # thread that holds it
_pending: int | None = None
_deferring = _stopping = False
_cleanups: list[Callable[[], object]] = []
_listeners: list[Callable[[], object]] = []
_deadline: float | None = None


def guard(run: Callable[[], int]) -> None:
    """Run a command, and end the process with its exit status, or with 128 + a signal's number."""
    try:
        for number in _REASONS:
            # A shell may start background jobs with SIGINT ignored; that stays.
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                signal.signal(number, _interrupt)
        status = run()
    except KeyboardInterrupt:
        # The signal came before the handler was installed.
        _end_by(signal.SIGINT)
    # The command is complete; a signal during exit would change its status.
    for number in _REASONS:
        signal.signal(number, signal.SIG_IGN)
    _exit(status)


def _interrupt(number: int, _: FrameType | None) -> None:
    """Handle a signal."""
    global _pending, _stopping
    if _deferring and not _stopping and number == signal.SIGINT:
        _stopping = True
    elif _holder == threading.get_ident():
        _pending = _pending or number
    else:
        _end_by(number)


def _end_by(number: int) -> NoReturn:
    """End the process because of a signal."""
    with _end_lock:
        # A second one often follows the first at once.
        for other in _REASONS:
            signal.signal(other, signal.SIG_IGN)
        # The signal may have interrupted a print.
        for cleanup in _cleanups:
            with suppress(OSError, RuntimeError):
                cleanup()
        with suppress(OSError):
            os.write(2, f"wholearm: {_REASONS[signal.Signals(number)]}\n".encode())
        _exit(128 + number, flush=False)


def _exit(status: int, flush: bool = True) -> NoReturn:
    """End the process without deleting every object, which takes a tenth of a short command."""
    # `atexit` would wait for children of an interrupted study. Exceptions of the threads that
    # serve them are not printed.
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


def register_cleanup(cleanup: Callable[[], object]) -> None:
    """Register a function to be called when a signal ends a command."""
    _cleanups.append(cleanup)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals to the end of this context, which must not be interrupted."""
    global _holder
    with _end_lock:
        outer_holder, _holder = _holder, threading.get_ident()
        try:
            yield
        finally:
            _holder = outer_holder
            if _pending is not None and outer_holder is None:
                _end_by(_pending)


@contextmanager
def interrupt_at_beat() -> Iterator[None]:
    """Raise KeyboardInterrupt on the first SIGINT at the next `beat` or at the end, not at once."""
    global _deferring, _stopping
    _deferring = True
    try:
        yield
        check()
    finally:
        _deferring = _stopping = False


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT at the next `beat`, too: CasADi may drop the first one.

    Only in programs with Python's default handler, which raises it once.
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
    """Raise KeyboardInterrupt after a SIGINT (`interrupt_at_beat`, `interruptible`)."""
    if _stopping:
        raise KeyboardInterrupt


class OutOfTime(KeyboardInterrupt):
    """A time limit is over. Like an interrupt, it is not caught as an error."""


@contextmanager
def limit_time(seconds: float | None) -> Iterator[None]:
    """Time limit of this context: `beat` raises OutOfTime after it; None keeps an outer limit."""
    global _deadline
    if seconds is None:
        yield
        return
    # Imported here, so that messages about a wrong command line need not wait for NumPy.
    from .errors import require_number

    end = time.monotonic() + require_number(seconds, "time_limit", positive=True)
    outer_deadline, _deadline = _deadline, end if _deadline is None else min(end, _deadline)
    try:
        yield
    finally:
        _deadline = outer_deadline


def listen(listener: Callable[[], object]) -> None:
    """Register a function to be called at every beat."""
    _listeners.append(listener)


def beat() -> None:
    """Call the listeners; raise OutOfTime if the time limit is over."""
    check()
    for listener in _listeners:
        listener()
    if _deadline is not None and time.monotonic() > _deadline:
        raise OutOfTime


class Reporter:
    """Calls `progress` with each text, and stores it as `last`."""

    def __init__(self, progress: Callable[[str], None] | None) -> None:
        self._progress, self.last = progress, "begun"

    def __call__(self, text: str) -> None:
        """Report a text."""
        self.last = text
        if self._progress is not None:
            self._progress(text)
        beat()
