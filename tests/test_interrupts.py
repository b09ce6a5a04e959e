"""Signals end a command, whoever swallows the exception, and leave nothing half written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from shipped import HEPTAGON
from wholearm.cli.route import hasten
from wholearm.common import signals as interrupts
from wholearm.common.files import together, write_whole
from wholearm.common.signals import check, guard, held
from wholearm.solvers.ipopt import STOPPED, Solver

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)


def write(path: Path, text: str = "whole") -> None:
    write_whole(path, lambda stream: stream.write(text.encode()))


@BOTH
def test_a_signal_ends_a_command(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    reached: list[str] = []

    def run() -> int:
        try:
            signal.raise_signal(number)
            reached.append("after the signal")
        finally:
            reached.append("cleaned up")
        return 0

    before = signal.getsignal(number)
    assert guard(run, lambda: reached.append("tidied")) == 128 + number
    assert reached == ["cleaned up", "tidied"]
    word = "interrupted" if number == signal.SIGINT else "terminated"
    assert capsys.readouterr().err == f"wholearm: {word}\n"
    assert signal.getsignal(number) is before
    assert guard(lambda: 3) == 3


def swallow() -> int:
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        print("whatever is said about it", file=sys.stderr)
    return 0


def turn_into_another() -> int:
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise ImportError from None
    return 0


@pytest.mark.parametrize("run", [swallow, turn_into_another])
def test_a_swallowed_interrupt_counts(
    run: Callable[[], int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert guard(run) == 130
    assert capsys.readouterr().err == "wholearm: interrupted\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_search_says_that_it_plans_unless_it_is_terminated(
    number: signal.Signals, capfd: pytest.CaptureFixture[str]
) -> None:
    def search() -> int:
        try:
            with interrupts.yielding():
                signal.raise_signal(number)
        except KeyboardInterrupt:
            hasten()
        return 0

    assert guard(search) == (0 if number is signal.SIGINT else 128 + number)
    assert ("again to stop" in capfd.readouterr().err) == (number is signal.SIGINT)


def test_no_file_appears_after_a_swallowed_interrupt(tmp_path: Path) -> None:
    def run() -> int:
        swallow()
        with pytest.raises(KeyboardInterrupt):
            check()
        write(tmp_path / "late")
        return 0

    assert guard(run) == 130
    assert list(tmp_path.iterdir()) == []


def test_a_signal_waits_for_files_that_belong_together(tmp_path: Path) -> None:
    def run() -> int:
        with held():
            signal.raise_signal(signal.SIGINT)
            (tmp_path / "one").touch()
            (tmp_path / "two").touch()
        (tmp_path / "three").touch()
        return 0

    assert guard(run) == 130
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.write_text("before")

    def run() -> int:
        with together():
            write(one)
            assert one.read_text() == "before"
            signal.raise_signal(signal.SIGINT)
            write(two)
        return 0

    assert guard(run) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["one"]
    assert one.read_text() == "before"
    with together():
        write(one)
        write(two)
        assert not two.exists()
    assert (one.read_text(), two.read_text()) == ("whole", "whole")
    assert len(list(tmp_path.iterdir())) == 2


def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert guard(swallow) == 0
    finally:
        signal.signal(signal.SIGINT, before)


SWALLOWS = """
import sys, tempfile, time
from wholearm.common.files import write_whole
from wholearm.common.signals import guard

def write(stream):
    stream.write(b"half")
    stream.flush()
    print("ready", flush=True)
    while True:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            print("swallowed", file=sys.stderr)

sys.exit(guard(lambda: write_whole(sys.argv[1], write) or 0))
"""


@BOTH
def test_a_command_that_goes_on_is_ended(number: signal.Signals, tmp_path: Path) -> None:
    command = [sys.executable, "-c", SWALLOWS, str(tmp_path / "out")]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **streams) as process:  # type: ignore[call-overload]
        assert process.stdout.readline() == "ready\n"
        assert len(os.listdir(tmp_path)) == 1
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    word = "interrupted" if number == signal.SIGINT else "terminated"
    assert errors == f"wholearm: {word}\n"
    assert os.listdir(tmp_path) == []


STARTED = "import wholearm.__main__ as m; print('ready', flush=True); m.run()"


@pytest.mark.parametrize("delay", [0.05, 0.15, 0.5])
def test_planning_is_interrupted(delay: float, tmp_path: Path) -> None:
    given = ["solve", str(HEPTAGON), "--intervals", "800", "--objective", "margin"]
    command = [sys.executable, "-c", STARTED, *given, "-o", "plan.npz", "--torques", "plan.csv"]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": tmp_path}
    with subprocess.Popen(command, text=True, **streams) as process:  # type: ignore[call-overload]
        # Before the interpreter is up nobody can catch a signal.
        assert process.stdout.readline() == "ready\n"
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "wholearm: interrupted\n")
    assert list(tmp_path.iterdir()) == []


WORKS = """
import time
import wholearm.__main__ as m
from wholearm.common.crowd import Processes, run_all

def work():
    for _ in run_all(time.sleep, [0, 60, 60, 60, 60], Processes(2)):
        print("ready", flush=True)
        {then}
    return 0

m.start = work
m.run()
"""


@pytest.mark.parametrize("then", ["pass", "raise OSError('full')", "return 2"])
def test_workers_end_with_their_command(then: str, tmp_path: Path) -> None:
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, "-c", WORKS.format(then=then)]
    with subprocess.Popen(command, text=True, **streams) as process:  # type: ignore[call-overload]
        assert process.stdout.readline() == "ready\n"
        # A terminal and `timeout` may send it twice.
        for _ in range(2 * (then == "pass")):
            process.send_signal(signal.SIGINT)
        # Far below what the tasks take; pipes close when the last worker has ended.
        _, errors = process.communicate(timeout=30)
    if then == "pass":
        assert (process.returncode, errors) == (130, "wholearm: interrupted\n")
    else:
        assert process.returncode == (2 if "return" in then else 1)


class Stopped:
    """A solver as CasADi leaves it when an interrupt comes."""

    def __call__(self, **_: object) -> dict[str, object]:
        return {"x": 1.0}

    def stats(self) -> dict[str, object]:
        return {"success": False, "return_status": STOPPED}


def test_a_solver_that_an_interrupt_stops_raises_it() -> None:
    with pytest.raises(KeyboardInterrupt):
        Solver(Stopped())(x0=0.0)
