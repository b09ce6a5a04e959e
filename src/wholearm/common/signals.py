"""SIGINT and SIGTERM end a command within a second, whoever swallows the exception.

A signal raises KeyboardInterrupt, so that files and child processes are cleaned up on the way out.
Code in between may swallow that (CasADi stops its solver and goes on), so the signal is remembered:
no file appears after it (`check`), and the command's status is that of the signal. A thread watches
over it: children of a command that has not ended in half of `PATIENCE` are ended, and when that is
over, because it swallowed the exception or is inside a long call, it is ended itself.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TextIO

_listeners: list[Callable[[], object]] = []
_deadline: float | None = None
PATIENCE = 0.45  # longest time that a command may take to clean up [s]
WATCHER = "wholearm signals"  # name of that thread
_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
ENDED = tuple(128 + number for number in _WORDS)  # exit statuses of commands that a signal ended
_guarded = False
_received: int | None = None
_holding = _said = False
_yielding = _pardoned = _inside = False
_ending = threading.RLock()
"""Held while something is done that may not be left half done, ending the process included."""
_cleanups: list[Callable[[], object]] = []


def guard(
    run: Callable[[], int], tidy: Callable[[], object] = int, leave: Callable[[int], object] = int
) -> int:
    """Run a command with signals that end it, and return its exit status: 128 + the signal's.

    Parameters
    ----------
    run    the command. One inside another leaves signals to the outer one.
    tidy   called before the line that says why the command ends
    leave  called last, with the status. No signal interrupts it; after one it may take `PATIENCE`.
    """
    global _guarded, _received, _holding, _said
    if _guarded or threading.current_thread() is not threading.main_thread():
        try:
            return run()
        except KeyboardInterrupt:
            tidy()
            raise
    errors, _guarded, _received, _said = sys.stderr, True, None, False
    status = 0
    try:
        with _handlers(), _watcher():
            try:
                status = run()
                _holding = True
            except KeyboardInterrupt:
                _received = _received or signal.SIGINT
            except BaseException:
                # Some extension modules turn the interrupt of an import into an error of their own.
                if _received is None:
                    raise
            return _end_command(status, errors, tidy, leave)
    except KeyboardInterrupt:
        # It came before all handlers were in place.
        _received = _received or signal.SIGINT
        return _end_command(status, errors, tidy, leave)
    finally:
        sys.stderr, _guarded, _holding = errors, False, False


def _end_command(
    status: int, errors: TextIO, tidy: Callable[[], object], leave: Callable[[int], object]
) -> int:
    """Say which signal has come, if one has; returns the exit status."""
    global _holding
    # From here on no signal raises anything: a second one often follows the first at once.
    _holding, sys.stderr = True, errors
    if _received is not None:
        status = 128 + _received
        tidy()
        _say(_received)
    leave(status)
    return status


def check() -> None:
    """Raise KeyboardInterrupt if a signal has come, though somebody swallowed it."""
    if _inside and not _yielding:
        raise KeyboardInterrupt
    if _guarded and _received is not None and not _holding:
        raise KeyboardInterrupt


@contextmanager
def held() -> Iterator[None]:
    """Have signals wait while something is done that may not be left half done."""
    global _holding
    check()
    with _ending:
        outer, _holding = _holding, True
        try:
            yield
        finally:
            _holding = outer
    check()


@contextmanager
def yielding() -> Iterator[None]:
    """Have the first SIGINT only raise KeyboardInterrupt: what is done has an answer to give then.

    Where somebody swallows it, it is raised at the end.
    """
    global _yielding, _inside
    errors, _yielding, _inside = sys.stderr, True, True
    try:
        yield
        if not _yielding:
            raise KeyboardInterrupt
    finally:
        sys.stderr, _yielding, _inside = errors, False, False


def on_end(cleanup: Callable[[], object]) -> None:
    """Register what has to be cleaned up when a command is ended by force."""
    _cleanups.append(cleanup)


@contextmanager
def _handlers() -> Iterator[None]:
    # A shell lets background jobs ignore SIGINT, which is not for us to change.
    ours = [n for n in _WORDS if signal.getsignal(n) not in (signal.SIG_IGN, None)]
    previous = {number: signal.signal(number, _interrupt) for number in ours}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _interrupt(number: int, _: FrameType | None) -> None:
    """Handle a signal: the first one raises KeyboardInterrupt.

    Whoever swallows it writes about it, which nobody is to read: what has to be said is said later.
    """
    global _received, _yielding, _pardoned
    if _yielding and number == signal.SIGINT:
        _yielding, _pardoned, sys.stderr = False, True, io.StringIO()
        raise KeyboardInterrupt
    first, _received = _received is None, _received or number
    sys.stderr = io.StringIO()
    if first and not _holding:
        raise KeyboardInterrupt


def _is_pardoned(number: int) -> bool:
    """Whether a signal is one that does not end the command; handlers run before or after this."""
    global _pardoned
    pardoned, _pardoned = number == signal.SIGINT and (_yielding or _pardoned), False
    return pardoned


@contextmanager
def _watcher() -> Iterator[None]:
    """Watch for signals in a thread, which sees them even while the main thread is in a call."""
    if os.name != "posix":
        yield
        return
    errors, over = sys.stderr, threading.Event()
    source, sink = os.pipe()
    os.set_blocking(sink, False)
    previous = signal.set_wakeup_fd(sink, warn_on_full_buffer=False)

    def watch() -> None:
        while not over.is_set():
            number = os.read(source, 1)[0]
            if _is_pardoned(number):
                continue
            if number in _WORDS and not over.wait(PATIENCE / 2):
                # Who waits for a child goes on; case: `bench skip`.
                end_children()
                over.wait(PATIENCE / 2)
                with _ending:
                    if not over.is_set():
                        _end(number, errors)

    thread = threading.Thread(target=watch, name=WATCHER, daemon=True)
    thread.start()
    try:
        yield
    finally:
        with _ending:
            over.set()
        signal.set_wakeup_fd(previous)
        os.write(sink, b"\0")
        thread.join()
        os.close(source)
        os.close(sink)


def _end(number: int, errors: TextIO) -> None:
    """End the process now."""
    for cleanup in _cleanups:
        cleanup()
    end_children()
    sys.stderr = errors
    _say(number)
    os._exit(128 + number)


def end_children() -> None:
    """Kill the processes that `multiprocessing` has started."""
    processes = sys.modules.get("multiprocessing")
    for child in processes.active_children() if processes else ():
        child.kill()


def _say(number: int) -> None:
    """Say once why the command ends."""
    global _said
    if _said:
        return
    _said = True
    try:
        print(f"wholearm: {_WORDS[signal.Signals(number)]}", file=sys.stderr, flush=True)
    except OSError:
        pass  # nobody reads it


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
