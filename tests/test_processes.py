"""Files, processes that are lost, signals that end a command, threads, and copies of plans."""

from __future__ import annotations

import copy
import gc
import io
import multiprocessing
import os
import pickle
import signal
import stat
import subprocess
import sys
import textwrap
import threading
import time
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO
from unittest.mock import Mock

import numpy as np
import pytest

import wholearm
from shipped import HEPTAGON, LANDING, SQUARE, part_of, plan_of, problem_of, verified
from tiny_study import die_once
from wholearm.common import files as archive
from wholearm.common.errors import InputError
from wholearm.common.files import read_arrays, together, write_whole
from wholearm.common.parallel import Processes, can_fork, count_cores, run_all, run_tasks
from wholearm.planning.nlp import INTERRUPTED, Solver
from wholearm.simulation.simulate import simulate

PARENT = os.getpid()
needs_fork = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux")


class Meeting:
    """Tasks of two processes that wait for each other, so that each does one of them."""

    def __init__(self, act: Callable[[], object] = object) -> None:
        self.barrier = multiprocessing.get_context("fork").Barrier(2)
        self.act, self.met = act, False

    def __call__(self) -> int:
        if not self.met:
            self.met = True
            self.barrier.wait(30)
        self.act()
        return os.getpid()


def stop() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fail() -> None:
    raise ValueError("only here")


@needs_fork
def test_tasks_are_done_by_two_processes_at_the_same_time() -> None:
    assert can_fork() and count_cores() >= 1
    one, other = run_tasks([Meeting()] * 2, 2)
    assert PARENT in (one, other) and one != other and not multiprocessing.active_children()


@needs_fork
def test_results_are_in_order() -> None:
    meet = Meeting()

    def task(k: int) -> Callable[[], object]:
        return lambda: meet() and k

    assert run_tasks([task(k) for k in range(1, 5)], 2) == [1, 2, 3, 4]


@needs_fork
@pytest.mark.parametrize("act", [stop, fail])
def test_what_a_child_does_not_finish_is_done_here(act: Callable[[], object]) -> None:
    meet = Meeting(lambda: act() if os.getpid() != PARENT else None)
    assert run_tasks([meet] * 2, 2) == [PARENT, PARENT]


@needs_fork
def test_the_first_error_is_raised_whoever_meets_it() -> None:
    meet = Meeting()

    def task(text: str) -> Callable[[], object]:
        def act() -> object:
            meet()
            raise ValueError(text)

        return act

    with pytest.raises(ValueError, match="one"):
        run_tasks([task("one"), task("two")], 2)


@needs_fork
def test_an_interrupt_ends_children() -> None:
    def interrupt() -> None:
        if os.getpid() == PARENT:
            raise KeyboardInterrupt
        signal.pause()

    with pytest.raises(KeyboardInterrupt):
        run_tasks([Meeting(interrupt)] * 2, 2)
    assert not multiprocessing.active_children()


LEAVES = """
import multiprocessing, os, signal, time
from wholearm.common.parallel import Processes
from wholearm.common.parallel import run_tasks

parent = os.getpid()
BUSY = "import time; print('ready', flush=True); time.sleep(60)"
barrier = multiprocessing.get_context("fork").Barrier(2)

def task():
    barrier.wait()
    if os.getpid() == parent:
        print("ready", flush=True)
    time.sleep(60)

{run}
"""


@needs_fork
@pytest.mark.parametrize(
    "run", ["run_tasks([task] * 2, 2)", "Processes(1).submit(exec, BUSY).result()"]
)
def test_processes_end_with_their_parent_however_it_ends(run: str) -> None:
    command = [sys.executable, "-c", LEAVES.format(run=run)]
    with subprocess.Popen(command, text=True, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        process.kill()
        # The pipe closes with the last process; the tasks would take a minute.
        process.communicate(timeout=30)


@needs_fork
def test_other_threads_keep_it_in_one_process() -> None:
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    try:
        found = run_tasks([os.getpid] * 2, 2)
    finally:
        over.set()
        thread.join()
    assert found == [PARENT, PARENT]


SCRIPT = """
from wholearm.common.parallel import Processes
for base in (2, 3):
    print(Processes(1).submit(abs, -base).result(), __name__)
"""


def test_a_plain_script_is_not_run_again_by_its_workers(tmp_path: Path) -> None:
    script = tmp_path / "plain.py"
    script.write_text(SCRIPT)
    found = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60)
    assert (found.stdout, found.stderr) == ("2 __main__\n3 __main__\n", "")


def square(number: int) -> int:
    if number == 13:
        raise ValueError("thirteen")
    return number**2


def test_every_task_is_answered_once() -> None:
    answers = list(run_all(square, range(200), ThreadPoolExecutor(3)))
    assert sorted(task for task, _ in answers) == list(range(200))
    for task, answer in answers:
        if task == 13:
            assert isinstance(answer, ValueError)
        else:
            assert answer == task**2


def test_tasks_are_given_a_few_at_a_time() -> None:
    given: list[int] = []

    def draw(count: int) -> Any:
        for number in range(count):
            given.append(number)
            yield number

    answers = run_all(square, draw(1000), ThreadPoolExecutor(1), max_pending=4)
    for _ in range(5):
        next(answers)
    assert len(given) <= 5 + 4


def test_a_process_that_is_killed_loses_and_doubles_no_task(tmp_path: Path) -> None:
    paths = [str(tmp_path / f"{k}") for k in range(3)]
    assert sorted(run_all(die_once, paths, Processes(2))) == [(path, path) for path in paths]
    assert not multiprocessing.active_children()


PIPES: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)


def write(path: Path, text: str = "whole") -> None:
    write_whole(path, lambda stream: stream.write(text.encode()))


def run_signalled(work: str, path: Path, number: signal.Signals = signal.SIGINT) -> tuple[int, str]:
    """Exit status and errors of a command that has a function `stop`, which sends it a signal."""
    command = [sys.executable, "-c", COMMAND.format(work=textwrap.indent(work, "    "))]
    run = subprocess.run([*command, str(number.value)], **PIPES, cwd=path, timeout=60)
    return run.returncode, run.stderr


COMMAND = """
import contextlib, functools, os, signal, sys, time
from pathlib import Path
from wholearm.cli.command import hasten
from wholearm.common.files import together, write_whole
from wholearm.common.signals import beat, defer_signals, guard, interrupt_at_beat, interruptible

stop = functools.partial(signal.raise_signal, int(sys.argv[1]))

def write(stream):
    stream.write(b"half")
    stream.flush()
    stop()

def run():
{work}
    return 0

guard(run)
"""

HALF = """
try:
    write_whole("out", write)
finally:
    Path("reached").touch()
"""
HELD = """
with defer_signals():
    stop()
    Path("one").touch()
    with defer_signals():
        Path("two").touch()
Path("three").touch()
"""
TOGETHER = """
with together():
    write_whole("one", lambda stream: stream.write(b"whole"))
    write_whole("two", write)
"""
DROPPED = """
signal.signal(signal.SIGINT, signal.default_int_handler)
with interruptible():
    with contextlib.suppress(KeyboardInterrupt):
        stop()
    beat()
    Path("reached").touch()
"""


@BOTH
@pytest.mark.parametrize(
    ("work", "left"), [(HALF, []), (HELD, ["one", "two"]), (TOGETHER, ["one"]), (DROPPED, [])]
)
def test_a_signal_ends_a_command(
    work: str, left: list[str], number: signal.Signals, tmp_path: Path
) -> None:
    """Files are whole, or those of before; signals wait for what belongs together."""
    if work is TOGETHER:
        (tmp_path / "one").write_text("before")
    word = "interrupted" if number == signal.SIGINT else "terminated"
    assert run_signalled(work, tmp_path, number) == (128 + number, f"wholearm: {word}\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == left
    if work is TOGETHER:
        assert (tmp_path / "one").read_text() == "before"


YIELDS = """
try:
    with interrupt_at_beat():
        stop()
        {then}
except KeyboardInterrupt:
    hasten()
"""


@BOTH
@pytest.mark.parametrize("then", ["beat()", "pass"])
def test_a_search_says_that_it_plans_unless_it_is_terminated(
    number: signal.Signals, then: str, tmp_path: Path
) -> None:
    status, errors = run_signalled(YIELDS.format(then=then), tmp_path, number)
    assert status == (0 if number == signal.SIGINT else 128 + number)
    assert ("again to stop" in errors) == (number == signal.SIGINT)


def test_a_second_interrupt_ends_a_search(tmp_path: Path) -> None:
    status, errors = run_signalled(YIELDS.format(then="stop()"), tmp_path)
    assert (status, errors) == (130, "wholearm: interrupted\n")


def test_an_ignored_signal_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert run_signalled("stop()", tmp_path) == (0, "")
    finally:
        signal.signal(signal.SIGINT, before)


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    one.write_text("before")
    with pytest.raises(KeyboardInterrupt), together():
        write(one)
        assert one.read_text() == "before"
        raise KeyboardInterrupt
    assert (one.read_text(), len(list(tmp_path.iterdir()))) == ("before", 1)
    with together():
        write(one)
        write(two)
        assert not two.exists()
    assert (one.read_text(), two.read_text()) == ("whole", "whole")
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("delay", [0.05, 0.15, 0.5])
def test_planning_is_interrupted(delay: float, tmp_path: Path) -> None:
    given = ["solve", str(HEPTAGON), "--intervals", "800", "--objective", "margin"]
    code = "import wholearm.__main__ as m; print('ready', flush=True); m.run()"
    command = [sys.executable, "-c", code, *given, "-o", "plan.npz", "--torques", "plan.csv"]
    with subprocess.Popen(command, cwd=tmp_path, **PIPES) as process:
        # Before the interpreter is up nobody can catch a signal.
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "wholearm: interrupted\n")
    assert list(tmp_path.iterdir()) == []


WORKS = """
import time
import wholearm.__main__ as m
from wholearm.common.parallel import Processes, run_all

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
    command = [sys.executable, "-c", WORKS.format(then=then)]
    with subprocess.Popen(command, **PIPES) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        # A terminal and `timeout` may send it twice.
        for _ in range(2 * (then == "pass")):
            process.send_signal(signal.SIGINT)
        # Far below what the tasks take; pipes close when the last worker has ended.
        _, errors = process.communicate(timeout=30)
    if then == "pass":
        assert (process.returncode, errors) == (130, "wholearm: interrupted\n")
    else:
        assert process.returncode == (2 if "return" in then else 1)


def test_a_solver_that_an_interrupt_stops_raises_it() -> None:
    stats = {"success": False, "return_status": INTERRUPTED}
    with pytest.raises(KeyboardInterrupt):
        Solver(Mock(return_value={"x": 1.0}, stats=lambda: stats))(x0=0.0)


IN_THREADS = """
import gc, sys, threading, time, tomllib
from concurrent.futures import ThreadPoolExecutor
import wholearm
from wholearm.problem.read import build_problem

path = sys.argv[1]
running = True

def read():
    with open(path, "rb") as stream:
        table = tomllib.load(stream)
    return build_problem(table | {"phases": table["phases"][:1]})

common = read()

def work(number):
    goal, problem = ("time", "effort")[number % 2], common if number < 2 else read()
    plan = wholearm.solve(problem, goal, intervals=10, replay=False)
    plan.at(0.3 * plan.duration)
    assert wholearm.simulate(problem, plan).outcome.reached
    try:
        wholearm.solve(problem, goal, intervals=10, degree=99)
    except wholearm.InputError as error:
        failure = error  # refers to this call, which it keeps for the collector
    return plan.meta["value"]

def collect():
    while running:
        gc.collect()
        time.sleep(0.02)

collector = threading.Thread(target=collect, daemon=True)
collector.start()
with ThreadPoolExecutor(4) as pool:
    values = list(pool.map(work, range(4)))
running = False
collector.join()
for one, other in zip(values[:2], values[2:]):
    assert abs(one - other) < 1e-6 * one, values
"""


def test_four_threads_plan_and_replay_at_once() -> None:
    """Two of them share a problem, the others have their own."""
    command = [sys.executable, "-X", "faulthandler", "-W", "error", "-c", IN_THREADS]
    run = subprocess.run([*command, SQUARE], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.usefixtures("unadvised")
def test_nothing_of_casadi_is_left_to_the_garbage_collector() -> None:
    def run(transcription: str = "auto", **changes: Any) -> None:
        problem = wholearm.load(str(SQUARE))
        problem = replace(problem, phases=problem.phases[:1], **changes)
        options: dict[str, Any] = {"transcription": transcription, "replay": False, "accuracy": 0.1}
        try:
            plan = wholearm.solve(problem, intervals=10, time_intervals=4, **options)
            wholearm.verify(problem, plan)
        except wholearm.InfeasibleError:
            assert changes

    # What there is by now is looked at no more.
    gc.freeze()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        run()
        run("time")
        run(epsilon=3.0)
        gc.collect()
        kinds = {type(item).__module__.partition(".")[0] for item in gc.garbage}
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert "casadi" not in kinds


def _roundtrip(item: Any) -> Any:
    return pickle.loads(pickle.dumps(item))


COPIES = pytest.mark.parametrize("duplicate", [_roundtrip, copy.copy, copy.deepcopy])


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, ...]:
    problem, trajectory = problem_of(LANDING), plan_of(LANDING)
    path = tmp_path_factory.mktemp("copies") / "plan.npz"
    trajectory.save(path)
    loaded = wholearm.load_trajectory(path)
    simulation = simulate(problem, trajectory.torque, times=[0.1])
    return problem, trajectory, loaded, simulation, verified(LANDING)


def check_same(one: wholearm.Trajectory, other: wholearm.Trajectory) -> None:
    for t in np.linspace(0.0, one.duration, 7):
        for own, copied in zip(one.at(float(t)), other.at(float(t)), strict=True):
            np.testing.assert_allclose(
                copied, own, rtol=1e-9, atol=1e-9 * max(1, np.abs(own).max())
            )


@COPIES
def test_problems_copy(planned: tuple[Any, ...], duplicate: Callable[[Any], Any]) -> None:
    problem = planned[0]
    other = duplicate(problem)
    assert other is not problem
    assert all(phase.formation.scene is other.scene for phase in other.phases)
    z = problem.start[None]
    for own, copied in zip(problem.phases, other.phases, strict=True):
        expected = own.formation.evaluate_limits(z)
        np.testing.assert_allclose(copied.formation.evaluate_limits(z), expected, atol=1e-14)
    assert (other.table, other.source) == (problem.table, problem.source)
    assert duplicate(problem.scene).scales == problem.scene.scales
    formation = duplicate(problem.phases[0].formation)
    assert formation.evaluate(z, z).A.shape == (1, 4, 5)


@COPIES
def test_results_copy(planned: tuple[Any, ...], duplicate: Callable[[Any], Any]) -> None:
    problem, trajectory, loaded, simulation, report = planned
    check_same(trajectory, duplicate(trajectory))
    check_same(loaded, duplicate(loaded))
    assert duplicate(trajectory).meta == trajectory.meta
    assert duplicate(report).to_text() == report.to_text()
    assert np.array_equal(duplicate(simulation).z, simulation.z)
    assert np.array_equal(
        duplicate(trajectory.torque).at(np.ones(1)), trajectory.torque.at(np.ones(1))
    )
    assert wholearm.verify(duplicate(problem), duplicate(trajectory)).ok == report.ok


def _plan(problem: wholearm.Problem) -> wholearm.Trajectory:
    return wholearm.solve(problem, intervals=10).trajectory


def _refuse(key: str) -> None:
    raise wholearm.InputError("file", key, "is missing")


def test_a_plan_comes_back_from_another_process() -> None:
    problem = part_of(problem_of(SQUARE), 0, 1)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        theirs = pool.apply(_plan, (problem,))
        with pytest.raises(wholearm.InputError, match=r"^file: gravity: is missing$"):
            pool.apply(_refuse, ("gravity",))
    assert theirs.meta["value"] == pytest.approx(_plan(problem).meta["value"], rel=1e-6)
    with pytest.raises(InputError, match="outside"):
        theirs.at(-1.0)
    rows = np.flatnonzero(np.diff(theirs.t) > 0)[::50]
    for row in rows:
        np.testing.assert_allclose(theirs.at(theirs.t[row]).z[0], theirs.z[row], atol=1e-9)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_can_plan() -> None:
    code = (
        "import dataclasses, os, sys, threading, wholearm\n"
        "problem, solve = wholearm.load(sys.argv[1]), wholearm.solve\n"
        "problem = dataclasses.replace(problem, phases=problem.phases[:1])\n"
        "thread = threading.Thread(target=lambda: solve(problem, intervals=10))\n"
        "thread.start()\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    solve(problem, intervals=10)\n"
        "    os._exit(7)\n"
        "thread.join()\n"
        "assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7\n"
    )
    # Python 3.12 and later warn of forks beside threads, which is what is tried here.
    command = [sys.executable, "-W", "ignore:This process:DeprecationWarning", "-c", code]
    run = subprocess.run([*command, SQUARE], capture_output=True, timeout=100)
    assert (run.returncode, run.stderr) == (0, b"")


def test_old_file_survives_a_failed_writer(tmp_path: Path) -> None:
    def fail_halfway(stream: BinaryIO) -> None:
        stream.write(b"half")
        raise RuntimeError("stopped")

    target = tmp_path / "out.txt"
    target.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="stopped"):
        write_whole(target, fail_halfway)
    assert target.read_bytes() == b"old" and list(tmp_path.iterdir()) == [target]


def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    def write(stream: BinaryIO) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="cannot be written: No space left") as caught:
        write_whole(tmp_path / "out.txt", write)
    assert caught.value.source == str(tmp_path / "out.txt") and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("mask, bits", [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_permissions_follow_the_umask(tmp_path: Path, mask: int, bits: int) -> None:
    before = os.umask(mask)
    try:
        write_whole(tmp_path / "out.txt", lambda stream: stream.write(b"x"))
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out.txt").stat().st_mode) == bits


@pytest.mark.parametrize("name", ["absent/out.txt", "", "file.txt/out.txt"])
def test_place_that_cannot_be_written(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.txt").write_bytes(b"")
    with pytest.raises(InputError, match="cannot be written") as caught:
        write_whole(tmp_path / name, lambda stream: stream.write(b"x"))
    assert caught.value.source == str(tmp_path / name) and caught.value.exit_status == 2
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


def test_a_link_keeps_pointing_to_its_file(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_bytes(b"old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_whole(tmp_path / "link.txt", lambda stream: stream.write(b"new"))
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_bytes() == b"new"


def test_a_pipe_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(pipe, lambda stream: stream.write(b"through"))
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode) and list(tmp_path.iterdir()) == [pipe]


def _write(path: Path, members: dict[str, bytes]) -> str:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return str(path)


def _header(shape: str, kind: str) -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(24)


@pytest.mark.parametrize(
    ("shape", "kind"), [("(1000000000000,)", "<f8"), ("(3,)", "<U1000000"), ("(4,)", "<f8")]
)
def test_an_array_has_to_hold_what_it_claims(tmp_path: Path, shape: str, kind: str) -> None:
    path = _write(tmp_path / "a.npz", {"t": _header(shape, kind)})
    with pytest.raises(InputError, match=r"a\.npz: t: is no array of numbers or text: "):
        read_arrays(path, ("t",))


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.array([{}], dtype=object), allow_pickle=True)
    path = _write(tmp_path / "a.npz", {"t": stream.getvalue()})
    with pytest.raises(InputError, match="t: is no array of numbers or text: Object arrays"):
        read_arrays(path, ("t",))


def test_a_member_that_is_too_large_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write(tmp_path / "a.npz", {"t": bytes(2**18 + 1)})
    monkeypatch.setattr(archive, "MAX_BYTES", 2**18)
    with pytest.raises(InputError, match="262145 bytes; allowed are up to 262144"):
        read_arrays(path, ("t",))
