"""Commands that a signal ends at a random time: how soon, with what status, and what they leave.

``python -m wholearm.benchmark.interrupts PROBLEM [--trials 60] [--seed 0]`` prints a table.
"""

from __future__ import annotations

import argparse
import os
import random
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


def list_commands(problem: str, plan: str) -> dict[str, tuple[list[str], float]]:
    """Arguments of every command, and up to when signals are sent [s]."""
    return {
        "solve": (["solve", problem, "-o", "out.npz", "--torques", "out.csv"], 1.5),
        "solve margin": (["solve", problem, "-o", "out.npz", "--objective", "margin"], 3.0),
        "verify": (["verify", problem, plan], 1.0),
        "plot": (["plot", plan, "-o", "out.png", "--simulate"], 1.8),
        "map": (["map", problem, "-o", "out.png"], 2.5),
        "bench": (["bench", problem, "-o", "tables"], 12.0),
    }


def interrupt(
    name: str, arguments: Sequence[str], number: signal.Signals, delay: float, folder: Path
) -> Trial:
    """Run a command in an empty folder and send it a signal after `delay` seconds."""
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
        faults += [f"left {path}" for path in left]
    if latency > SOON:
        faults.append("late")
    return Trial(name, number.name, delay, latency, tuple(faults))


def _take_signals() -> None:
    # A shell lets background jobs ignore SIGINT.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _list_temporary() -> set[str]:
    folder = tempfile.gettempdir()
    with os.scandir(folder) as entries:
        return {e.path for e in entries if e.name.startswith("wholearm")}


def run_trials(problem: str, trials: int, seed: int) -> list[Trial]:
    """Interrupt all commands in turn at random times, mostly by SIGINT."""
    chance = random.Random(seed)
    found = []
    with tempfile.TemporaryDirectory() as base:
        plan = str(Path(base, "plan.npz"))
        solve = [sys.executable, "-m", "wholearm", "solve", problem, "-o", plan]
        subprocess.run(solve, check=True, stdout=subprocess.DEVNULL)
        commands = list_commands(problem, plan)
        for index in range(trials):
            name = list(commands)[index % len(commands)]
            arguments, latest = commands[name]
            number = signal.SIGTERM if chance.random() < 0.25 else signal.SIGINT
            # Many of them early, amid imports.
            delay = latest * chance.random() ** chance.choice((1, 3))
            with tempfile.TemporaryDirectory(dir=base) as folder:
                found.append(interrupt(name, arguments, number, delay, Path(folder)))
            trial = found[-1]
            text = "; ".join(trial.faults) or "as it has to"
            print(
                f"{trial.command:>12}  {trial.signal:>7}  {trial.delay:6.2f} s  "
                f"{trial.latency:6.3f} s  {text}",
                flush=True,
            )
    return found


def main() -> int:
    """Print a table; the exit status is 1 if any trial has a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem")
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    trials = run_trials(os.path.abspath(options.problem), options.trials, options.seed)
    faulty = sum(bool(trial.faults) for trial in trials)
    longest = max(trial.latency for trial in trials)
    print(f"{len(trials) - faulty} of {len(trials)} ended as they have to, within {longest:.2f} s")
    return int(faulty > 0)


if __name__ == "__main__":
    sys.exit(main())
