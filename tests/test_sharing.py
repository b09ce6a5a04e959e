"""One thread at a time: planning in threads, what is dropped there, copies and other processes."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from threading import Thread
from typing import Any

import numpy as np
import pytest

import wholearm
from shipped import FOLDER, LANDING, plan_of, problem_of
from wholearm.common.sharing import Keeper, Store, exclusive, kept_property, retire_with
from wholearm.simulation.simulate import simulate

SQUARE = str(FOLDER / "square.toml")

IN_THREADS = """
import gc, sys, threading, time
import tomllib
import wholearm
from wholearm.problem.read import build_problem

path = sys.argv[1]
failures, values, running = [], {}, True

def read():
    with open(path, "rb") as stream:
        table = tomllib.load(stream)
    return build_problem(table | {"phases": table["phases"][:1]})

common = read()

def work(number):
    goal, shared = ("time", "effort")[number % 2], number < 2
    try:
        problem = common if shared else read()
        plan = wholearm.solve(problem, goal, intervals=10, replay=False)
        values.setdefault(goal, []).append(plan.meta["value"])
        plan.at(0.3 * plan.duration)
        assert wholearm.simulate(problem, plan).outcome.reached
        try:
            wholearm.solve(problem, goal, intervals=10, degree=99)
        except wholearm.InputError as error:
            failure = error  # refers to this call, which it keeps for the collector
    except BaseException as error:
        failures.append(repr(error))

def collect():
    while running:
        gc.collect()
        time.sleep(0.02)

threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
collector = threading.Thread(target=collect)
for thread in (*threads, collector):
    thread.start()
for thread in threads:
    thread.join()
running = False
collector.join()
assert not failures, failures
for own in values.values():
    assert len(own) == 2 and max(own) - min(own) < 1e-6 * max(own), values
"""


def test_four_threads_plan_and_replay_at_once() -> None:
    """Two of them share a problem, the others have their own."""
    command = [sys.executable, "-X", "faulthandler", "-W", "error", "-c", IN_THREADS]
    run = subprocess.run([*command, SQUARE], capture_output=True, text=True)
    assert (run.returncode, run.stderr) == (0, "")


class Tracked:
    """Counts how many of its kind are alive."""

    alive = 0

    def __init__(self) -> None:
        Tracked.alive += 1

    def __del__(self) -> None:
        type(self).alive -= 1


@exclusive
def nothing() -> None:
    pass


@pytest.fixture
def tracked() -> type[Tracked]:
    nothing()
    Tracked.alive = 0
    return Tracked


class Owner(Keeper):
    def __init__(self, number: int = 1) -> None:
        self.number = number

    @kept_property
    def value(self) -> Tracked:
        return Tracked()


def in_another_thread(run: Callable[[], object]) -> None:
    thread = Thread(target=run)
    thread.start()
    thread.join()


def test_values_of_dropped_owners_are_deleted_under_the_lock(tracked: type[Tracked]) -> None:
    owners = [Owner(), Owner()]
    assert owners[0].value is owners[0].value
    retire_with(owners[1], Tracked())
    assert tracked.alive == 2
    in_another_thread(owners.clear)
    assert tracked.alive == 2
    nothing()
    assert tracked.alive == 0


def test_a_kept_value_is_computed_once_by_many_threads(tracked: type[Tracked]) -> None:
    owner, seen = Owner(), list[Tracked]()
    threads = [Thread(target=lambda: seen.append(owner.value)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({id(value) for value in seen}) == 1
    assert tracked.alive == 1


def test_an_error_takes_no_local_variables_along(tracked: type[Tracked]) -> None:
    def fail() -> None:
        value = Tracked()
        raise ValueError(f"{tracked.alive} {value.alive}")

    @exclusive
    def change() -> None:
        own = Tracked()
        try:
            fail()
        except ValueError as error:
            raise KeyError(own.alive) from error

    with pytest.raises(KeyError) as caught:
        change()
    assert isinstance(caught.value.__cause__, ValueError)
    assert tracked.alive == 0


@pytest.mark.usefixtures("unadvised")
def test_nothing_of_casadi_is_left_to_the_garbage_collector() -> None:
    def run(transcription: str = "auto", **changes: Any) -> None:
        problem = wholearm.load(SQUARE)
        problem = replace(problem, phases=problem.phases[:1], **changes)
        options: dict[str, Any] = {"transcription": transcription, "replay": False, "accuracy": 0.1}
        try:
            plan = wholearm.solve(problem, intervals=10, time_intervals=4, **options)
            wholearm.verify(problem, plan)
        except wholearm.InfeasibleError:
            assert changes

    gc.collect()
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
    return problem, trajectory, loaded, simulation, wholearm.verify(problem, trajectory)


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
    problem = wholearm.load(SQUARE)
    problem = replace(problem, phases=problem.phases[:1])
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        theirs = pool.apply(_plan, (problem,))
        with pytest.raises(wholearm.InputError, match=r"^file: gravity: is missing$"):
            pool.apply(_refuse, ("gravity",))
    assert theirs.meta["value"] == pytest.approx(_plan(problem).meta["value"], rel=1e-6)
    with pytest.raises(ValueError, match="outside"):
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
    command = [sys.executable, "-W", "ignore:This process:DeprecationWarning", "-c", code, SQUARE]
    run = subprocess.run(command, capture_output=True, timeout=100)
    assert (run.returncode, run.stderr) == (0, b"")


class Sharer:
    """What shares a value with others."""


def test_a_value_lives_as_long_as_one_of_its_owners() -> None:
    built: list[object] = []

    def build(_: object) -> list[int]:
        built.append(value := [len(built)])
        return value

    store = Store(build, lambda _: "same")
    first, second = Sharer(), Sharer()
    assert store(first) is store(second)
    kept = store(second)
    del first
    gc.collect()
    third = Sharer()
    assert store(third) is kept and len(built) == 1
    del second, third
    gc.collect()
    assert store(Sharer()) == [1]
