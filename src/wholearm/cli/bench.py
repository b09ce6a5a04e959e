"""The command ``wholearm bench``: run times of a problem, and other studies."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from itertools import product
from typing import Any

from ..common.files import write_text
from .arguments import JOBS, number
from .progress import clear_progress, show_progress

STUDIES = ("problem", "precision", "stress", "guard", "kernels", "skip", "growth")
"""Words that can follow ``bench``; the word ``problem`` may be left out."""


def name_study(arguments: Sequence[str]) -> list[str]:
    """Arguments with the word ``problem`` put in where ``bench`` is followed by a file."""
    given = list(arguments)
    if given[:1] != ["bench"] or len(given) == 1:
        return given
    if given[1] in (*STUDIES, "-h", "--help"):
        return given
    return ["bench", "problem", *given[1:]]


def add_bench(bench: argparse.ArgumentParser) -> None:
    """Give the parser of ``bench`` its studies."""
    studies = bench.add_subparsers(metavar="STUDY", required=True)
    text = "measure run time against error (the word problem may be left out)"
    problem = studies.add_parser("problem", help=text, description=text)
    problem.add_argument("problem", help="problem file (TOML)")
    problem.add_argument("-o", "--output", default="results", help="folder for tables and figures")
    problem.set_defaults(run=_measure)

    _add_precision(studies)

    text = "plan generated scenes and read damaged files, and count what must not happen"
    stress = studies.add_parser("stress", help=text, description=text)
    stress.add_argument(
        "--scenes", type=number(0, 10**7), default=1000, help="generated scenes (1000)"
    )
    stress.add_argument("--files", type=number(0, 10**7), default=0, help="damaged files (0)")
    words = "problem files to plan with noise, and with other masses and forces"
    stress.add_argument("--problems", nargs="+", default=[], metavar="FILE", help=words)
    stress.add_argument(
        "--seed", type=number(0, 2**63), default=0, help="of everything that is drawn (0)"
    )
    stress.add_argument(
        "--only", type=number(0, 10**9), metavar="K", help="run scene K alone and print it"
    )
    stress.add_argument("--jobs", type=JOBS, help="worker processes (default: all cores)")
    words = "start anew instead of going on with the records in the folder"
    stress.add_argument("--fresh", action="store_true", help=words)
    stress.add_argument("--again", action="store_true", help="run again what had findings")
    stress.add_argument("-o", "--output", default="results", help="folder for records and table")
    stress.set_defaults(run=_stress)

    text = "count what plans take by other measures than time, and compare with stored counts"
    guard = studies.add_parser("guard", help=text, description=text)
    guard.add_argument("problems", nargs="+", metavar="FILE", help="problem files (TOML)")
    guard.add_argument("--counts", default="results/bench_guard.json", help="file of stored counts")
    guard.add_argument("--update", action="store_true", help="store the counts anew")
    guard.set_defaults(run=_guard)

    text = "plan for all objectives under other roundings, and compare with stored answers"
    kernels = studies.add_parser("kernels", help=text, description=text)
    kernels.add_argument("problems", nargs="+", metavar="FILE", help="problem files (TOML)")
    words = "kernels of OpenBLAS, as for OPENBLAS_CORETYPE (default: the processor's own)"
    kernels.add_argument("--kernels", nargs="+", default=[""], metavar="NAME", help=words)
    words = "seeds of changes to all numbers in the last bits; 0 for none (0)"
    kernels.add_argument(
        "--seeds", nargs="+", type=number(0, 2**63), default=[0], metavar="K", help=words
    )
    words = "interpreters that have the package (default: this one)"
    kernels.add_argument("--pythons", nargs="+", default=[sys.executable], help=words)
    words = "file of stored answers (results/bench_kernels.json)"
    kernels.add_argument("--answers", default="results/bench_kernels.json", help=words)
    words = "store the answers of the first environment"
    kernels.add_argument("--update", action="store_true", help=words)
    kernels.add_argument("--jobs", type=JOBS, help="answers at a time (default: all cores)")
    kernels.add_argument("-o", "--output", metavar="FILE", help="write the table (Markdown)")
    kernels.set_defaults(run=_compare_kernels)

    text = "measure what each part of the model costs when a scene has it and when it has not"
    skip = studies.add_parser("skip", help=text, description=text)
    skip.add_argument("--problems", default="problems", help="folder of problem files (problems)")
    skip.add_argument("-o", "--output", default="results", help="folder for the table")
    skip.set_defaults(run=_skip)

    text = "measure how cost and memory grow with intervals, phases and vertices"
    growth = studies.add_parser("growth", help=text, description=text)
    growth.add_argument("problem", help="problem file (TOML) whose first phase is made larger")
    growth.add_argument("-o", "--output", default="results", help="folder for table and figure")
    growth.set_defaults(run=_grow)


def _add_precision(studies: Any) -> None:
    """Give the parser the study of run time against error."""
    text = "measure run time against error of planner and simulator, with peers beside them"
    precision = studies.add_parser("precision", help=text, description=text)
    precision.add_argument("--problems", default="problems", help="folder of problem files")
    words = "measure this part only: simulation or planning"
    precision.add_argument("--part", choices=("simulation", "planning"), help=words)
    words = "measure these methods only, by the names that the table has"
    precision.add_argument("--peers", nargs="+", default=[], metavar="NAME", help=words)
    words = "processor time that one setting of a method may take on one phase [s] (60)"
    precision.add_argument("--limit", type=number(1e-3, 1e6), default=60.0, help=words)
    words = "measure again what the folder has runs of"
    precision.add_argument("--fresh", action="store_true", help=words)
    words = "folder for runs, table and figure"
    precision.add_argument("-o", "--output", default="results", help=words)
    precision.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    from ..benchmark.precision.study import PARTS, StudyOptions, run_precision

    chosen = StudyOptions(
        options.problems,
        (options.part,) if options.part else PARTS,
        tuple(options.peers),
        options.limit,
        options.fresh,
    )
    return _say(run_precision(chosen, options.output, show_progress()))


def _measure(options: argparse.Namespace) -> int:
    from ..benchmark.problem import run_bench
    from ..geometry.path_guess import load

    return _say(run_bench(load(options.problem), options.output, progress=show_progress()))


def _stress(options: argparse.Namespace) -> int:
    from ..benchmark.stress.study import StressOptions, run_only, run_stress
    from ..geometry.path_guess import load

    chosen = StressOptions(
        scenes=options.scenes,
        files=options.files,
        problems=tuple(options.problems),
        seed=options.seed,
        only=options.only,
        jobs=(os.cpu_count() or 1) if options.jobs is None else options.jobs,
        fresh=options.fresh,
        again=options.again,
    )
    for path in chosen.problems:
        load(path)
    if chosen.only is not None:
        path = _write_scene(chosen.seed, chosen.only, options.output)
        records = run_only(chosen)
        print(json.dumps(records, indent=2))
        print(f"wrote {path}")
        return 1 if any(record["findings"] for record in records) else 0
    text, path, count = run_stress(chosen, options.output, show_progress())
    clear_progress()
    print(text)
    print(f"wrote {path}")
    return 1 if count else 0


def _guard(options: argparse.Namespace) -> int:
    from ..benchmark.guard import run_guard

    grown = run_guard(options.problems, options.counts, options.update, show_progress())
    clear_progress()
    for text in grown:
        print(text)
    if options.update:
        print(f"wrote {options.counts}")
    elif not grown:
        print(f"{len(options.problems)} problems: no count has grown")
    return 1 if grown else 0


def _compare_kernels(options: argparse.Namespace) -> int:
    from ..benchmark.kernels import Environment, run_kernels

    given = product(options.pythons, options.kernels, options.seeds)
    environments = [Environment(*own) for own in given]
    jobs = options.jobs or os.cpu_count() or 1
    stored, update = options.answers, options.update
    text, count = run_kernels(options.problems, environments, stored, update, jobs, show_progress())
    clear_progress()
    print(text, end="")
    if options.output:
        write_text(options.output, text)
        print(f"wrote {options.output}")
    return 1 if count else 0


def _skip(options: argparse.Namespace) -> int:
    from ..benchmark.skip import run_skip

    return _say([run_skip(options.problems, options.output, show_progress())])


def _grow(options: argparse.Namespace) -> int:
    from ..benchmark.growth import run_growth

    return _say(run_growth(options.problem, options.output, show_progress()))


def _say(written: Sequence[str]) -> int:
    """Say which files a study has written; returns the exit status."""
    clear_progress()
    for path in written:
        print(f"wrote {path}")
    return 0


def _write_scene(seed: int, number: int, folder: str) -> str:
    """Write the problem file of a scene."""
    from ..benchmark.stress.cases import draw_case
    from ..benchmark.stress.toml import to_toml
    from ..common.files import make_folder, write_text

    make_folder(folder)
    path = os.path.join(folder, f"stress_{seed}_{number}.toml")
    write_text(path, to_toml(draw_case(seed, number).table))
    return path
