"""What work costs in a process of its own, where nothing is kept from what was done before."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from ..common.workers import Spawning


class Cost(NamedTuple):
    """What some work gave, and what it took.

    Attributes
    ----------
    answer : object
    seconds : float, [s]
        Processor time.
    memory : float, [MB]
        By which the work raised the process's peak of memory.
    """

    answer: Any
    seconds: float
    memory: float


def measure_alone(work: Callable[..., Any], *given: object) -> Cost:
    """Call a function of a module with `given`, in a new process."""
    with ProcessPoolExecutor(1, mp_context=Spawning()) as pool:
        return pool.submit(_measure, work, given).result()


def _measure(work: Callable[..., Any], given: tuple[object, ...]) -> Cost:
    before, started = _find_peak(), time.process_time()
    answer = work(*given)
    seconds = time.process_time() - started
    return Cost(answer, seconds, _find_peak() - before)


def _find_peak() -> float:
    """Peak of the memory that this process has had in use [MB]."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
    # Where there is `/proc`, the other figure starts from that of the parent.
    (peak,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(peak) * 1024 / 1e6
