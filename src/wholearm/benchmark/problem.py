"""What planning one problem takes: orders of collocation, whole plans, changed numbers, parts."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import Any

from ..common.errors import WholearmError
from ..common.files import make_folder
from ..common.sharing import exclusive
from ..geometry.tracing import trace_phases
from ..planning.options import Objective
from ..planning.path_domain.data import prepare
from ..planning.path_domain.mesh import Mesh
from ..planning.path_domain.nlp import build_path_nlp
from ..planning.path_domain.terms import LimitShape
from ..planning.plan import solve
from ..problem.check import require_phases
from ..problem.definition import Problem
from ..problem.read import read_problem
from ..simulation.simulate import simulate
from .changes import measure_stress
from .precision.instances import keep_curves
from .report import Row, write_results
from .time_domain import measure_blocks, measure_order

REPEATS = 3


@exclusive
def run_bench(
    problem: Problem, folder: str, progress: Callable[[str], None] | None = None
) -> list[str]:
    """Measure everything and write tables as Markdown and CSV.

    Parameters
    ----------
    problem : Problem
    folder : str
        Made if it does not exist.
    progress : callable, optional
        Told what is being measured.

    Returns
    -------
    list of str
        The files written.

    Raises
    ------
    InputError
        If the problem has no phases, or the folder cannot be made or written.
    """
    require_phases(problem)
    make_folder(folder)
    report = progress or (lambda _: None)
    curves = keep_curves(problem)
    studies: list[tuple[Callable[[Problem], list[Row]], Problem | None]] = [
        (measure_order, curves),
        (measure_blocks, problem),
        (measure_stress, problem),
        (measure_parts, problem),
    ]
    rows: list[Row] = []
    for study, what in studies:
        name = study.__name__.removeprefix("measure_").replace("_", " ")
        report(f"bench: {name}")
        try:
            rows += study(what) if what is not None else []
        except WholearmError as error:
            rows.append(Row(name, "not measured", "", 0.0, None, str(error)))
    stem = os.path.splitext(os.path.basename(problem.source or problem.name))[0]
    return write_results(problem.name, rows, os.path.join(folder, f"bench_{stem}"))


def _time_runs(run: Callable[[], Any], before: Callable[[], object] = int) -> tuple[float, Any]:
    """Median of the seconds of some runs, and what the last one gave."""
    seconds, result = [], None
    for _ in range(REPEATS):
        before()
        started = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds), result


def measure_parts(problem: Problem) -> list[Row]:
    """What the parts of planning cost, and the whole process against importing its libraries."""
    rows = []

    def timed(name: str, run: Callable[[], Any], before: Callable[[], object] = int) -> Any:
        median, result = _time_runs(run, before)
        rows.append(Row("parts", name, "", median, None))
        return result

    def forget() -> None:
        build_path_nlp.cache_clear()
        trace_phases.cache_clear()

    if problem.source:
        timed("read", lambda: read_problem(problem.source))
    timed("trace", lambda: trace_phases(problem), forget)
    curve = trace_phases(problem)[0]
    data = prepare(curve, problem.epsilon, Mesh().make_grid(curve, 10), 1)
    shape, intervals = LimitShape.of(data.limits), len(data.grid.steps)
    timed("build the NLP", lambda: build_path_nlp(shape, intervals, Objective.TIME), forget)
    plan = timed("plan and sample (NLP built)", lambda: solve(problem))
    rows.append(Row("parts", "Ipopt alone", "", plan.timings.solve, None))
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "plan.npz")
        timed("write", lambda: plan.save(path))
        timed("simulate", lambda: simulate(problem, plan.trajectory.torque))
        imports = [sys.executable, "-c", "import casadi, numpy"]
        timed("process: import casadi, numpy", lambda: _run(imports))
        if problem.source:
            whole = [sys.executable, "-m", "wholearm", "solve", problem.source, "-o", path]
            timed("process: wholearm solve", lambda: _run(whole))
            ratio = rows[-1].seconds / rows[-2].seconds
            rows[-1] = rows[-1]._replace(note=f"{ratio:.2f} x the imports alone")
    return rows


def _run(command: Sequence[str]) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
