"""A small study, and tasks that do to their worker what tasks must not do."""

from __future__ import annotations

import argparse
import os
import signal
import warnings
from collections.abc import Iterator, Sequence

import numpy as np

from wholearm.benchmark.study import Case, Findings, Row, Study, measure_case
from wholearm.common.document import Table


def allow(task: str) -> float:
    """Processor time that a task may take [s]."""
    return 0.2 if task == "hang" else 20.0


def misbehave(how: str) -> str:
    """What a task may do to its worker."""
    if how == "hang":
        while True:
            pass
    if how == "die":
        os._exit(3)
    if how == "raise":
        raise KeyError(how)
    if how == "warn":
        warnings.warn("careful", RuntimeWarning, stacklevel=1)
    if how == "print":
        os.write(2, b"CasADi - WARNING\n")
    if how == "large":
        np.ones(6_000_000)
    return how


def die_once(path: str) -> str:
    """Die of the first task at a path."""
    if not os.path.exists(path):
        open(path, "x").close()
        os.kill(os.getpid(), signal.SIGKILL)
    return path


class Misbehaving(Study):
    strict = True

    def run(self, case: Case) -> Row:
        return {"how": misbehave(*case)}


def measure(how: str) -> Row:
    """What a case does and takes, measured in the process of the worker."""
    return measure_case(Misbehaving(), (how,))


class Steps(Study):
    name, title = "steps", "Steps to one"
    columns = ("number", "steps")
    options = "--most N  numbers = 6 in 0..100\n"

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        return ((number,) for number in range(options.most))

    def run(self, case: Case) -> Row:
        (number,) = start = case
        steps = 0
        if number == 5:
            raise ValueError("five")
        while number > 1:
            number, steps = number // 2 if number % 2 == 0 else 3 * number + 1, steps + 1
        return {"number": start[0], "steps": steps, "findings": ["no natural one"][number:]}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> Findings:
        table = Table(["number:d", "steps:d"], [(row["number"], row["steps"]) for row in rows])
        return [table], [text for row in rows for text in row["findings"]]


STUDY = Steps()
