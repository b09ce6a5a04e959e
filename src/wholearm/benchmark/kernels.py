"""Answers of every problem where numbers are rounded differently.

OpenBLAS has kernels for each processor, which differ in the last bits; ``OPENBLAS_CORETYPE`` makes
one machine stand in for another. Further Pythons bring other versions of the libraries. Seeds
change the numbers of the scenes themselves in the last bits.

Each problem is planned and verified for every objective, in a process for each environment. The
answers are compared with those that the corpus has stored.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields
from functools import cache
from itertools import product
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..common.files import read_json, write_text
from ..scene.model import Finger, Friction, Polygon, Scene
from .corpus import compare
from .study import Case, Row, Study, format_table

LARGEST = 4  # largest change of a number, in units of 2^-52 of it


def perturb_scenes(seed: int) -> None:
    """Multiply every number of each scene that is made from now on by 1 + k 2^-52, |k| <= 4.

    k follows from the seed, the name of the number and its first 14 digits, to which the number
    is rounded first. So a scene that is made again from its own numbers keeps them.
    """
    for kind in (Polygon, Finger, Friction, Scene):
        _perturb(kind, seed)


def _perturb(kind: Any, seed: int) -> None:
    check = getattr(kind.__post_init__, "exact", kind.__post_init__)
    names = [field.name for field in fields(kind) if field.init and field.name != "name"]

    def check_and_perturb(self: Any) -> None:
        # First as they were given: messages about bad numbers quote them.
        given = [name for name in names if getattr(self, name) is not None]
        left_out = set(names) - set(given)
        check(self)
        for name in left_out:
            object.__setattr__(self, name, None)
        for name in given:
            label = f"{seed} {kind.__name__}.{getattr(self, 'name', '')}.{name}"
            object.__setattr__(self, name, _change(getattr(self, name), label))
        check(self)

    check_and_perturb.exact = check  # type: ignore[attr-defined]
    kind.__post_init__ = check_and_perturb


def _change(value: Any, label: str) -> Any:
    if isinstance(value, np.ndarray):
        changed = [_change_number(float(v), f"{label}{i}") for i, v in np.ndenumerate(value)]
        return np.array(changed).reshape(value.shape)
    if isinstance(value, Real) and not isinstance(value, bool):
        return _change_number(float(value), label)
    return value


@cache
def _change_number(value: float, label: str) -> float:
    if value == 0.0 or not np.isfinite(value):
        return value
    rounded = float(f"{value:.13e}")
    k = random.Random(f"{label} {rounded!r}").randint(-LARGEST, LARGEST)
    return rounded * (1 + k * 2.0**-52)


OBJECTIVES = ("time", "effort", "margin")
UPDATE = "`bench corpus --update` writes it anew"


class Environment(NamedTuple):
    """Where problems are planned."""

    python: str = sys.executable  # an interpreter that has the package
    kernel: str = ""  # of OpenBLAS; empty for the processor's own
    # of the changes to the numbers of scenes in the last bits; zero leaves them as they are
    seed: int = 0

    def run(self, arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
        """Run the interpreter with this kernel and one thread."""
        asked = {"OPENBLAS_CORETYPE": self.kernel} if self.kernel else {}
        known = os.environ | {"OPENBLAS_NUM_THREADS": "1"} | asked
        command = [self.python, *arguments]
        return subprocess.run(command, env=known, capture_output=True, text=True, check=False)

    def describe(self) -> str:
        """Versions, kernel and seed in words."""
        code = (
            "import platform, casadi, numpy, scipy;"
            "print('Python', platform.python_version(), 'NumPy', numpy.__version__,"
            " 'SciPy', scipy.__version__, 'CasADi', casadi.__version__)"
        )
        kernel = find_kernel(self.kernel, self.python) or "no OpenBLAS"
        text = f"{self.run(['-c', code]).stdout.strip()}, {kernel}"
        return f"{text}, seed {self.seed}" if self.seed else text


def find_kernel(kernel: str = "", python: str = sys.executable) -> str:
    """Name of the kernel that NumPy takes where one is asked for, empty if it has no OpenBLAS."""
    code = "import os; os.environ['OPENBLAS_VERBOSE'] = '2'; import numpy"
    run = Environment(python, kernel).run(["-c", code])
    match = re.search(r"^Core: (\w+)", run.stdout + run.stderr, re.M)
    return match[1] if match else ""


class Kernels(Study):
    """Plans of the corpus in several environments against its answers."""

    name, title, keeps = "kernels", "Answers by environment", False
    options = """\
problems FILE ...  problem files (TOML)
--kernels NAME ...  kernels of OpenBLAS, as for OPENBLAS_CORETYPE (the processor's own)
--seeds K ...       of changes to all numbers in the last bits (0, none) in 0..1000000000
--pythons PYTHON ...  interpreters that have the package (this one)
--answers FILE      of the corpus = results/corpus.json
-o --output FILE    table to write (Markdown)
"""

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Every problem and objective in each environment."""
        read_json(options.answers, UPDATE)
        places = options.pythons or [sys.executable], options.kernels or [""], options.seeds or [0]
        return product(*places, options.problems, OBJECTIVES)

    def run(self, case: Case) -> Row:
        """The answer to a case of the corpus, by a process of an environment."""
        *given, path, objective = case
        asked = [path, objective, str(given[-1])]
        run = Environment(*given).run(["-m", "wholearm.benchmark.kernels", *asked])
        if run.returncode:
            return {"answer": {"refused": run.stderr.strip()[-300:]}}
        return {"answer": json.loads(run.stdout)}

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """A row for each environment, and what differs."""
        known, table, findings = read_json(options.answers, UPDATE), [], list[str]()
        for environment in dict.fromkeys(tuple(row["case"][:3]) for row in rows):
            mine = [row for row in rows if tuple(row["case"][:3]) == environment]
            label, same, offs = Environment(*environment).describe(), 0, [0.0]
            for row in mine:
                name, answer = f"plan {Path(row['case'][3]).stem} {row['case'][4]}", row["answer"]
                stored = known.get(name)
                kind, texts = compare("plan", _reduce(answer), stored and _reduce(stored))
                findings += [f"{label}: {name}: {texts[0]}"] if kind == "differs" else []
                same += kind == "same"
                if stored and "value" in answer and "value" in stored:
                    offs.append(abs(answer["value"] / stored["value"] - 1))
            table.append((label, len(mine), same, f"{max(offs):.1e}"))
        heads = ["environment", "answers", "as stored", "largest difference of a value"]
        lines = format_table(heads, table, 4)
        if options.output:
            write_text(options.output, "\n".join([f"# {self.title}", "", *lines]) + "\n")
        return "\n".join(lines), findings


STUDY = Kernels()


def _reduce(answer: Row) -> Row:
    """Verdict, value and contact modes of an answer: an optimum may leave durations open."""
    own = {key: answer[key] for key in ("refused", "objective", "value", "modes") if key in answer}
    return own | {"replay": {"ok": answer.get("replay", {}).get("ok", False)}}


def _answer(path: str, objective: str, seed: str) -> None:
    """Print the answer that the parent process asks for."""
    from .corpus_cases import answer

    if int(seed):
        perturb_scenes(int(seed))
    print(json.dumps(answer(("plan", Path(path).stem, objective), Path(path).parent)))


if __name__ == "__main__":
    _answer(*sys.argv[1:])
