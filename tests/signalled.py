"""Commands that a signal ends: how soon, with what status, and what they leave."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

SOON = 1.0
"""Longest time that a command may take to end [s]."""
STARTED = "import wholearm.__main__ as m; print('ready', flush=True); m.run()"
"""Code that runs a command, and says when the interpreter is up: before, nobody can catch a
signal."""


class Trial(NamedTuple):
    """One command and the signal that came.

    Attributes
    ----------
    command : str
    signal : str
    delay : float
        From the start of the command to the signal [s].
    latency : float
        From the signal to the end of the process [s].
    faults : tuple of str
        What should not be; empty if the command ended as it has to.
    """

    command: str
    signal: str
    delay: float
    latency: float
    faults: tuple[str, ...]


RECORDS = ".jsonl"
"""Ending of files to which commands write while they run."""


def interrupt(
    name: str,
    arguments: Sequence[str],
    number: signal.Signals,
    delay: float,
    folder: Path,
    twice: bool = False,
) -> Trial:
    """Run a command in an empty folder and send it a signal, or two, after `delay` seconds."""
    before = _list_temporary()
    process = subprocess.Popen(
        [sys.executable, "-c", STARTED, *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=_take_signals,
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(delay)
    over = process.poll() is not None
    sent = time.perf_counter()
    for _ in range(1 + twice):
        process.send_signal(number)
    try:
        _, errors = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        _, errors = process.communicate()
    latency = time.perf_counter() - sent
    left = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    left += sorted(_list_temporary() - before)
    faults = list[str]()
    word = "interrupted" if number is signal.SIGINT else "terminated"
    if over or process.returncode == 0:
        # It was done already, and all of its files are there.
        faults += [f"left {path}" for path in left if ".part" in path or path.startswith("/")]
    else:
        if process.returncode != 128 + number:
            faults.append(f"status {process.returncode}")
        if errors.strip() != f"wholearm: {word}":
            faults.append(f"stderr {errors.strip()[-200:]!r}")
        faults += [f"left {path}" for path in left if not path.endswith(RECORDS)]
    for path in folder.rglob(f"*{RECORDS}"):
        faults += [f"half a line in {path.name}"] * (not _is_whole(path))
    if latency > SOON:
        faults.append("late")
    return Trial(name, number.name, delay, latency, tuple(faults))


def _is_whole(path: Path) -> bool:
    """Whether a file of records consists of whole lines."""
    text = path.read_text(encoding="utf-8")
    try:
        [json.loads(line) for line in text.splitlines()]
    except ValueError:
        return False
    return text == "" or text.endswith("\n")


def _take_signals() -> None:
    # A shell lets background jobs ignore SIGINT.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _list_temporary() -> set[str]:
    folder = tempfile.gettempdir()
    with os.scandir(folder) as entries:
        return {e.path for e in entries if e.name.startswith("wholearm")}
