"""Every problem, planned and verified on a machine that rounds differently.

OpenBLAS has kernels for each processor, which differ in the last bits; ``OPENBLAS_CORETYPE`` makes
one machine stand in for another.

``python -m wholearm.benchmark.kernels PROBLEM...`` takes a kernel that is not the machine's
own, prints one line for each problem and exits with 1 if any plan fails, or a least time is not
that of the reference figures beside its problem.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

OBJECTIVES = ("time", "effort", "margin")
X86 = ("Haswell", "Sandybridge")
"""Kernels to choose from, both for any processor with AVX2."""
_SAME = {"Zen": "Haswell", "Excavator": "Haswell"}
"""Processors that have the kernels of another."""
_OFF = 5e-4
"""Most that a least time may differ from its reference figure, relatively."""


class Outcome(NamedTuple):
    """A problem that was planned and verified for one objective.

    Attributes
    ----------
    objective : str
    value : float or None
        Of the objective; None without a plan.
    fault : str
        Why there is no plan that holds, or empty.
    seconds : float
    """

    objective: str
    value: float | None
    fault: str
    seconds: float


def find_kernel(kernel: str = "") -> str:
    """Name of the kernel that NumPy takes, empty if it has no OpenBLAS.

    Parameters
    ----------
    kernel : str
        What is asked for; empty for the machine's own.
    """
    asked = {"OPENBLAS_VERBOSE": "2"} | _ask_for(kernel)
    command = [sys.executable, "-c", "import numpy"]
    run = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True)
    match = re.search(r"Core: (\w+)", run.stdout + run.stderr)
    return match[1] if match else ""


def _ask_for(kernel: str) -> dict[str, str]:
    return {"OPENBLAS_CORETYPE": kernel} if kernel else {}


def choose_kernel(own: str) -> str:
    """A kernel other than the machine's own, empty if there is none to choose."""
    if not own or platform.machine() not in ("x86_64", "AMD64"):
        return ""
    return next(kernel for kernel in X86 if kernel != _SAME.get(own, own))


def plan_and_verify(path: str, objective: str) -> Outcome:
    """Plan a problem and replay the plan."""
    # Only now: the kernel is chosen when NumPy is loaded.
    from ..common.errors import WholearmError
    from ..geometry.path_guess import load
    from ..planning.plan import solve
    from ..verification.verify import verify

    started, value = time.perf_counter(), None
    try:
        problem = load(path)
        plan = solve(problem, objective)
        value = plan.value
        faults = [*verify(problem, plan).failures, *compare(path, objective, value)]
        fault = "; ".join(faults)
    except WholearmError as error:
        fault = str(error)
    return Outcome(objective, value, fault, time.perf_counter() - started)


def compare(path: str, objective: str, value: float) -> list[str]:
    """What is wrong with a least time by the reference figures beside its problem, if there are."""
    stored = Path(path).with_suffix(".reference.json")
    if objective != "time" or not stored.exists():
        return []
    known = sum(json.loads(stored.read_text(encoding="utf-8"))["phase_durations"])
    off = value / known - 1
    return [f"least time is {off:+.2%} off its reference figure"] if abs(off) > _OFF else []


def run_all(paths: list[str], workers: int) -> int:
    """Plan and verify problems on `workers` processes; returns how many fail."""
    outcomes: dict[str, list[Outcome]] = defaultdict(list)
    failed = 0
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(plan_and_verify, p, goal): p for p in paths for goal in OBJECTIVES}
        for job in as_completed(jobs):
            path = jobs[job]
            outcomes[path].append(job.result())
            if len(outcomes[path]) == len(OBJECTIVES):
                failed += any(outcome.fault for outcome in outcomes[path])
                print(describe(path, outcomes[path]), flush=True)
    return failed


def describe(path: str, outcomes: list[Outcome]) -> str:
    """One line on a problem: its values, or what fails."""
    parts = []
    for outcome in sorted(outcomes, key=lambda outcome: OBJECTIVES.index(outcome.objective)):
        value = "-" if outcome.value is None else f"{outcome.value:.6f}"
        fault = f" FAILS: {outcome.fault}" if outcome.fault else ""
        parts.append(f"{outcome.objective} {value}{fault}")
    seconds = sum(outcome.seconds for outcome in outcomes)
    return f"{Path(path).stem}: {', '.join(parts)}; {seconds:.1f} s"


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+")
    parser.add_argument("--kernel", help="OPENBLAS_CORETYPE (default: not the machine's own)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    own = find_kernel()
    kernel = choose_kernel(own) if options.kernel is None else options.kernel
    # Worker processes inherit both, and load NumPy anew.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1"} | _ask_for(kernel)
    print(f"kernel {find_kernel(kernel) or 'unknown'}; the machine's own is {own or 'unknown'}")
    count = len(options.problems)
    failed = run_all(options.problems, options.workers)
    print(f"{count - failed} of {count} problems planned and verified")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
