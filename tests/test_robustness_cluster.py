from __future__ import annotations

import os
import signal
import time

import pytest

from wholearm.common.crowd import run_all
from wholearm.common.errors import InputError
from wholearm.robustness.sampling import connect


def wait_and_square(number: int) -> tuple[int, int]:
    time.sleep(0.02)
    return number**2, os.getpid()


def test_a_worker_that_is_killed_loses_and_doubles_no_task() -> None:
    distributed = pytest.importorskip("distributed", reason="Dask is not installed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        answers = run_all(wait_and_square, range(100), lambda: connect(cluster.scheduler_address))
        found = [next(answers) for _ in range(10)]
        os.kill(found[-1][1][1], signal.SIGKILL)
        found += answers
    assert sorted(task for task, _ in found) == list(range(100))
    assert all(answer[0] == task**2 for task, answer in found)


def test_no_scheduler_is_bad_input() -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    with pytest.raises(InputError, match="--scheduler: tcp:"):
        connect("tcp://127.0.0.1:1", patience=0.5)
