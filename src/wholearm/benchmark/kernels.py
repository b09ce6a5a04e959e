"""Answers of every problem where numbers are rounded differently.

OpenBLAS has kernels for each processor, which differ in the last bits; ``OPENBLAS_CORETYPE`` makes
one machine stand in for another. Further Pythons bring other versions of the libraries. Seeds
change the numbers of the scenes themselves in the last bits, see `rounding`.

Each problem is planned and verified for every objective, in a process for each environment. Its
answer is the value of the objective and the sequence of contact modes of each phase. Answers are
held against those that are stored.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import groupby, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from ..planning.result import Plan

OBJECTIVES = ("time", "effort", "margin")
TOLERANCE = 1e-6
"""Largest relative difference of values: what Ipopt and the refinement of limits leave open."""
BRIEF = 1e-3
"""Duration below which a stretch with other contact modes does not count, over the phase's."""
SUPPORTED = re.compile(r"^Core: (\w+)", re.M)


class Environment(NamedTuple):
    """Where problems are planned.

    Attributes
    ----------
    python : str
        An interpreter that has the package.
    kernel : str
        Of OpenBLAS; empty for the processor's own.
    seed : int
        Of the changes to the numbers of scenes in the last bits; zero leaves them as they are.
    """

    python: str = sys.executable
    kernel: str = ""
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
    match = SUPPORTED.search(run.stdout + run.stderr)
    return match[1] if match else ""


def answer(path: str, objective: str) -> dict[str, Any]:
    """Plan a problem and replay the plan.

    Returns
    -------
    dict
        ``value`` of the objective, None without a plan; ``modes``, a list for each phase; ``fault``
        says why there is no plan that holds, and is empty where there is one.
    """
    from ..common.errors import WholearmError
    from ..geometry.path_guess import load
    from ..planning.plan import solve
    from ..verification.verify import verify

    try:
        problem = load(path)
        plan = solve(problem, objective)
        fault = "; ".join(verify(problem, plan).failures)
    except WholearmError as error:
        return {"value": None, "modes": [], "fault": str(error)}
    return {"value": plan.value, "modes": list_modes(plan), "fault": fault}


def list_modes(plan: Plan) -> list[list[str]]:
    """Contact modes and directions of the joints that follow each other in every phase."""
    found = []
    for phase in plan.phases:
        spans = [s for s in phase.modes if s.stop - s.start > BRIEF * phase.duration]
        texts = (f"{' '.join(s.contacts.values())} {' '.join(s.joints)}" for s in spans)
        found.append([text for text, _ in groupby(texts)])
    return found


def answer_in(environment: Environment, path: str, objective: str) -> dict[str, Any]:
    """What `answer` returns in a process of an environment."""
    given = ["--answer", path, objective, str(environment.seed)]
    run = environment.run(["-m", "wholearm.benchmark.kernels", *given])
    if run.returncode:
        return {"value": None, "modes": [], "fault": run.stderr.strip()[-300:]}
    return dict(json.loads(run.stdout))


def compare(found: Mapping[str, Any], stored: Mapping[str, Any] | None) -> list[str]:
    """Differences of an answer from the one that is stored."""
    if found["fault"]:
        return [found["fault"]]
    if stored is None:
        return ["no answer is stored; --update stores it"]
    texts, off = [], found["value"] / stored["value"] - 1
    if abs(off) > TOLERANCE:
        texts.append(f"value {found['value']:.9g} is off {stored['value']:.9g} by {off:+.1e}")
    if found["modes"] != stored["modes"]:
        texts.append(f"contact modes {found['modes']} are not {stored['modes']}")
    return texts


def run_kernels(
    paths: Sequence[str],
    environments: Sequence[Environment],
    stored: str,
    update: bool,
    workers: int,
    progress: Callable[[str], None] | None = None,
) -> tuple[str, int]:
    """Hold the answers of all environments against those that are stored.

    Parameters
    ----------
    paths : sequence of str
        Problem files.
    stored : str
        File of answers (JSON).
    update : bool
        Whether the answers of the first environment are stored.
    workers : int
        Answers at the same time.

    Returns
    -------
    table : str
        A row for each environment (Markdown), then what differs.
    count : int
        Number of differences.
    """
    from ..common.files import read_json, write_text

    results: dict[Environment, dict[str, dict[str, Any]]] = {own: {} for own in environments}
    known = {} if update else read_json(stored, "--update writes it anew")
    with ThreadPoolExecutor(workers) as pool:
        tasks = product(environments, paths, OBJECTIVES)
        jobs = {pool.submit(answer_in, *task): task for task in tasks}
        for count, job in enumerate(as_completed(jobs), start=1):
            environment, path, objective = jobs[job]
            results[environment][f"{Path(path).stem} {objective}"] = job.result()
            if progress is not None:
                progress(f"{count} of {len(jobs)} answers")
    if update:
        known = results[environments[0]]
        write_text(stored, json.dumps(known, indent=1, sort_keys=True) + "\n")
    lines = ["| environment | answers | as stored | largest difference of a value |"]
    lines.append("|---|---|---|---|")
    faults = []
    for environment in environments:
        found, label = results[environment], environment.describe()
        texts = {name: compare(own, known.get(name)) for name, own in found.items()}
        faults += [f"{label}: {name}: {'; '.join(own)}" for name, own in texts.items() if own]
        offs = [
            abs(own["value"] / known[name]["value"] - 1)
            for name, own in found.items()
            if own["value"] and known.get(name, {}).get("value")
        ]
        same = sum(not own for own in texts.values())
        lines.append(f"| {label} | {len(found)} | {same} | {max(offs, default=0.0):.1e} |")
    return "\n".join([*lines, "", *faults]).rstrip() + "\n", len(faults)


def _answer() -> None:
    """Print the answer that the parent process asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--answer", nargs=3, required=True)
    path, objective, seed = parser.parse_args().answer
    if int(seed):
        from .rounding import perturb_scenes

        perturb_scenes(int(seed))
    print(json.dumps(answer(path, objective)))


if __name__ == "__main__":
    _answer()
