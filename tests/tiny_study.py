"""A study of one module: how many steps of the Collatz sequence lead from numbers to one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

from wholearm.benchmark.study import Case, Row, Study


class Steps(Study):
    name, title = "steps", "Steps to one"
    columns = ("number", "steps")

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--most", type=int, default=6)

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

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        lines = ["| number | steps |", "|---|---|"]
        lines += [f"| {row['number']} | {row['steps']} |" for row in rows]
        return "\n".join(lines), [text for row in rows for text in row["findings"]]


STUDY = Steps()
