"""Run times of one problem: of the planner, a plain baseline beside it, and all parts."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import WholearmError
from ..common.files import make_folder
from ..common.sharing import exclusive
from ..geometry.curve import Curve
from ..geometry.tracing import trace_phases
from ..planning.options import Objective, PlanOptions
from ..planning.path_domain.data import prepare
from ..planning.path_domain.motion import make_grid
from ..planning.path_domain.nlp import build_path_nlp
from ..planning.path_domain.plan import plan_path
from ..planning.path_domain.terms import LimitShape
from ..planning.plan import solve
from ..problem.definition import Problem
from ..problem.read import read_problem
from ..simulation.simulate import simulate
from ..solvers.statistics import open_ledger
from ..verification.verify import verify
from .baseline_opti import plan_with_opti
from .changes import measure_stress
from .precision.instances import keep_curves
from .report import Row, write_results
from .time_domain import measure_blocks, measure_order, measure_transcriptions

INTERVALS = (10, 20, 40, 80, 160, 320, 640, 800)
FINE = 1600
BASELINE_INTERVALS = 40
REPEATS = 3


@exclusive
def run_bench(
    problem: Problem, folder: str, progress: Callable[[str], None] | None = None
) -> list[str]:
    """Measure everything and write a table (Markdown, CSV) and a figure (PNG).

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
        If the folder cannot be made or written.
    """
    make_folder(folder)
    report = progress or (lambda _: None)
    curves = keep_curves(problem)
    studies: list[tuple[Callable[[Problem], list[Row]], Problem | None]] = [
        *((study, curves) for study in ON_CURVES),
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


def measure_planner(problem: Problem) -> list[Row]:
    """Planner over the number of intervals, building included.

    The error of the phase time is the largest relative one against a fine solution; that of the
    simulated end is the largest difference of any z between plan and simulation at a phase's end.
    """
    curves = trace_phases(problem)
    fine = _plan_times(problem, curves, FINE)
    rows = []
    for intervals in INTERVALS:
        plan_all = partial(_plan_times, problem, curves, intervals)
        median, times = _time_runs(plan_all, build_path_nlp.cache_clear)
        trajectory = solve(problem, intervals=intervals).trajectory
        ends = trajectory.phase_starts[1:]
        simulation = simulate(problem, trajectory.torque, tolerance=1e-11, times=ends)
        missed = 0.0
        for index, end in enumerate(ends):
            start = ends[index - 1] if index else 0.0
            planned = trajectory.motions[index].evaluate(np.array([end - start]))
            nearest = np.flatnonzero(simulation.phase == index)[-1]
            missed = max(missed, float(np.abs(planned.z[0] - simulation.z[nearest]).max()))
        error = float(np.abs(times / fine - 1).max())
        rows.append(Row("planner: phase time", "path NLP", str(intervals), median, error))
        rows.append(Row("planner: simulated end", "path NLP", str(intervals), median, missed))
    return rows


def _time_runs(run: Callable[[], Any], before: Callable[[], object] = int) -> tuple[float, Any]:
    """Median of the seconds of some runs, and what the last one gave."""
    seconds, result = [], None
    for _ in range(REPEATS):
        before()
        started = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds), result


def _plan_times(problem: Problem, curves: Sequence[Curve], intervals: int) -> Array:
    options = PlanOptions(intervals=intervals)
    plans = [
        plan_path(curve, problem.epsilon, options, phase.number)
        for phase, curve in zip(problem.phases, curves, strict=True)
    ]
    return np.array([plan.motion.duration for plan in plans])


def measure_baseline(problem: Problem) -> list[Row]:
    """Plain time-domain transcription of the same phases, and ours beside it.

    The error is that of the phase time against a fine solution; a negative one is a time that
    limits do not allow. The note has the least c_n of an open-loop replay of the phase.
    """
    options, fine = PlanOptions(), PlanOptions(intervals=FINE)
    rows, ours, theirs = list[Row](), 0.0, 0.0
    build_path_nlp.cache_clear()
    for phase, curve in zip(problem.phases, trace_phases(problem), strict=True):
        started = time.perf_counter()
        with open_ledger() as ledger:
            plan = plan_path(curve, problem.epsilon, options, phase.number)
        elapsed = time.perf_counter() - started
        plain = plan_with_opti(curve, problem.epsilon, BASELINE_INTERVALS)
        took = plain.build_time + plain.solve_time
        least = plan_path(curve, problem.epsilon, fine, phase.number).motion.duration
        number = f"phase {phase.number}"
        alone = replace(problem, start=curve.start, phases=(replace(phase, index=0),))
        for method, seconds, duration, torque, iterations in (
            ("path NLP", elapsed, plan.motion.duration, plan.torque, ledger.of(0).iterations),
            ("plain Opti", took, plain.duration, plain.torque, plain.iterations),
        ):
            margins = verify(alone, torque).phases[0].contacts
            weakest = min(contact.least for contact in margins)
            note = f"T = {duration:.6f} s, {iterations} iterations, least c_n {weakest:.4f} N"
            rows.append(Row("least time", method, number, seconds, duration / least - 1, note))
        ours, theirs = ours + elapsed, theirs + took
    note = f"{ours / theirs:.4f} of plain Opti"
    rows.append(Row("least time", "path NLP", "all phases", ours, None, note))
    note = f"{theirs / ours:.0f} x path NLP"
    rows.append(Row("least time", "plain Opti", "all phases", theirs, None, note))
    return rows


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
    limits = prepare(curve, problem.epsilon, make_grid(curve, 20), 1).limits
    shape, intervals = LimitShape.of(limits), PlanOptions().intervals
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


ON_CURVES: tuple[Callable[[Problem], list[Row]], ...] = (
    measure_planner,
    measure_baseline,
    measure_order,
    measure_transcriptions,
)
"""Studies of phases that are curves of four sliding contacts."""
