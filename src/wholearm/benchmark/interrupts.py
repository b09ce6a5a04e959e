"""Commands that a signal ends at a random time: how soon, with what status, and what they leave.

``python -m wholearm.benchmark.interrupts PROBLEM [--trials 60] [--seed 0] [--only COMMAND ...]``
prints a table.
"""

from __future__ import annotations

import argparse
import json
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


def list_commands(problem: str, plan: str, policy: str) -> dict[str, tuple[list[str], float]]:
    """Arguments of every command but searches for goals, and up to when signals are sent [s]."""
    folder = os.path.dirname(problem)
    study = ["robustness", problem, plan, "--samples", "100000", "-o", "out.jsonl"]
    return {
        "solve": (["solve", problem, "-o", "out.npz", "--torques", "out.csv"], 1.5),
        "solve margin": (["solve", problem, "-o", "out.npz", "--objective", "margin"], 3.0),
        "verify": (["verify", problem, plan], 1.0),
        "verify free": (["verify", problem, plan, "--free"], 2.0),
        "plot": (["plot", plan, "-o", "out.png", "--simulate"], 1.8),
        "map": (["map", problem, "-o", "out.png"], 2.5),
        "predict": (["predict", problem, "-o", "out.png"], 2.0),
        "tune": (["tune", problem, "-o", "out.csv", "--brake"], 2.0),
        "compare": (["compare", problem, plan, "-o", "out.png"], 1.5),
        "export": (["export", problem, plan, "--mjcf", "out.xml"], 0.5),
        "policy": (["policy", plan, "-o", "out.npz"], 3.0),
        "robustness": ([*study, "--jobs", "1"], 5.0),
        "robustness 2": ([*study, "--jobs", "2"], 5.0),
        "by policy 2": ([*study, "--jobs", "2", "--policy", policy], 5.0),
        "animate": (["animate", plan, "-o", "out.gif"], 4.0),
        "report": (["report", problem, plan, "-o", "out.html"], 2.5),
        "gallery": (["gallery", problem, "-o", "out.md"], 4.0),
        "bench": (["bench", problem, "-o", "tables"], 12.0),
        "stress 2": (["bench", "stress", "--scenes", "20", "--jobs", "2", "-o", "tables"], 6.0),
        "precision": (["bench", "precision", "--problems", folder, "-o", "tables"], 6.0),
        "growth": (["bench", "growth", problem, "-o", "tables"], 6.0),
    }


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


def run_trials(problem: str, trials: int, seed: int, only: Sequence[str] = ()) -> list[Trial]:
    """Interrupt commands, all of them or those named, in turn at random times.

    Mostly it is by SIGINT. Every other time it comes twice, as `timeout` and some terminals send
    it.
    """
    chance = random.Random(seed)
    found = []
    with tempfile.TemporaryDirectory() as base:
        plan = str(Path(base, "plan.npz"))
        solve = [sys.executable, "-m", "wholearm", "solve", problem, "-o", plan]
        subprocess.run(solve, check=True, stdout=subprocess.DEVNULL)
        policy = str(Path(base, "policy.npz"))
        make = [sys.executable, "-m", "wholearm", "policy", plan, "-o", policy]
        subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
        every = list_commands(problem, plan, policy)
        commands = {name: every[name] for name in only or every}
        for index in range(trials):
            name = list(commands)[index % len(commands)]
            arguments, latest = commands[name]
            number = signal.SIGTERM if chance.random() < 0.25 else signal.SIGINT
            # Many of them early, amid imports.
            delay = latest * chance.random() ** chance.choice((1, 3))
            with tempfile.TemporaryDirectory(dir=base) as folder:
                twice = bool(index // len(commands) % 2)
                found.append(interrupt(name, arguments, number, delay, Path(folder), twice))
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
    parser.add_argument("--only", nargs="+", default=[], metavar="COMMAND", help="of the table")
    options = parser.parse_args()
    problem = os.path.abspath(options.problem)
    trials = run_trials(problem, options.trials, options.seed, options.only)
    faulty = sum(bool(trial.faults) for trial in trials)
    longest = max(trial.latency for trial in trials)
    print(f"{len(trials) - faulty} of {len(trials)} ended as they have to, within {longest:.2f} s")
    return int(faulty > 0)


if __name__ == "__main__":
    sys.exit(main())
