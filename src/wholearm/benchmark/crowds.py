"""Many samples through processes and Dask, a worker and then the run killed: none lost or doubled.

The samples are cheap, so that what is measured is the way to the workers and back into the file.

    python -m wholearm.benchmark.crowds --samples 100000
    python -m wholearm.benchmark.crowds --samples 100000 --dask
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ..common.arrays import Array
from ..common.journal import Journal
from ..robustness.cluster import connect
from ..robustness.study import list_records, use_processes
from ..robustness.uncertainty import Uncertainty

WORKERS = 2
"""Processes, on one machine."""
WORKER_DIES, RUN_DIES = 0.2, 0.5
"""Shares of the samples after which a worker and then the run is killed."""
PATIENCE = 3600.0
"""Longest time of a run [s]."""


class Cheap(NamedTuple):
    """A trial that takes next to no time."""

    def run(self, sample: Array) -> dict[str, Any]:
        """The sum of a sample, and which process found it."""
        return {"reached": True, "value": math.fsum(sample), "worker": os.getpid()}


def collect(path: str, samples: int, address: str) -> None:
    """Run the samples that a file does not have yet, on Dask's workers if there is an address."""
    drawn = Uncertainty().draw(samples, 0)
    start = partial(connect, address) if address else partial(use_processes, WORKERS)
    with Journal(path, {"study": "crowds", "samples": samples}) as journal:
        done = journal.done("sample")
        tasks = ((k, tuple(drawn[k].tolist())) for k in range(samples) if k not in done)
        for record in list_records(Cheap(), tasks, start):
            journal.add(record)


def _launch(path: Path, samples: int, address: str) -> subprocess.Popen[bytes]:
    call = f"from {__spec__.name} import collect; collect({str(path)!r}, {samples}, {address!r})"
    return subprocess.Popen([sys.executable, "-c", call])


def _wait_for(run: subprocess.Popen[bytes], path: Path, lines: int, end: float) -> dict[str, Any]:
    """The last whole record once there are so many."""
    while run.poll() is None and time.monotonic() < end:
        known = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
        if len(known) > max(lines, 1):
            record: dict[str, Any] = json.loads(known[-1])
            return record
        time.sleep(0.5)
    raise RuntimeError(f"the run ended, or took too long, before it had {lines} samples")


def study(samples: int, address: str, patience: float = PATIENCE) -> str:
    """Run the samples, kill a worker and the run, go on, and say what has become of them."""
    begin = time.monotonic()
    end = begin + patience
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "samples.jsonl"
        run = _launch(path, samples, address)
        try:
            os.kill(_wait_for(run, path, int(WORKER_DIES * samples), end)["worker"], signal.SIGKILL)
            _wait_for(run, path, int(RUN_DIES * samples), end)
            run.kill()
            run.wait()
            stopped = path.read_text(encoding="utf-8").count("\n") - 1
            run = _launch(path, samples, address)
            status = run.wait(timeout=end - time.monotonic())
        finally:
            run.kill()
        lines = path.read_text(encoding="utf-8").split("\n")[1:-1]
    records = [json.loads(line) for line in lines]
    times = Counter(record["sample"] for record in records)
    drawn = Uncertainty().draw(samples, 0)
    wrong = sum(record.get("value") != math.fsum(drawn[record["sample"]]) for record in records)
    lost, doubled = samples - len(times), len(records) - len(times)
    took = time.monotonic() - begin
    return (
        f"{samples} samples in {took:.0f} s, the run killed after {stopped}: {lost} lost, "
        f"{doubled} doubled, {wrong} wrong; exit status {status}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--dask", action="store_true", help="on a local cluster of Dask's")
    parser.add_argument("--patience", type=float, default=PATIENCE, help="longest time [s]")
    options = parser.parse_args(arguments)
    cluster: Any = nullcontext()
    if options.dask:
        from distributed import LocalCluster

        cluster = LocalCluster(WORKERS, threads_per_worker=1, dashboard_address=None)
    with cluster as workers:
        address = workers.scheduler_address if options.dask else ""
        print("Dask:" if options.dask else "processes:", end=" ", flush=True)
        print(study(options.samples, address, options.patience))


if __name__ == "__main__":
    main()
