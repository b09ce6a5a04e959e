"""``wholearm bench precision``: run time against error, of planners and simulators."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import product

from matplotlib.figure import Figure

from ...common.errors import InputError
from ...common.fields import Range
from ..study import Case, Row, Study
from .phases import find_files, list_instances
from .planners import LEAST_TIME, NO_DRAG, PLANNERS, is_installed, run_planner
from .simulators import FEW, MANY, SIMULATORS, TOLERANCES, run_simulator
from .tables import draw_medians, format_report, read_medians

METHODS = [*SIMULATORS, *PLANNERS]  # names of all methods, in the order of the tables
REFERENCE = 120.0  # processor time that the reference of a phase may take on top [s]


class Precision(Study):
    """Every setting of every method on every phase of four sliding contacts."""

    name, title, timed = "precision", "Run time against error, with peers", True
    columns = ("study", "phase", "method", "setting", "build", "solve", "errors", "outcome")
    packages = ("toppra", "yapss")
    allowed = 60.0

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Which methods, and for how long."""
        text = "folder of problem files (problems)"
        parser.add_argument("--problems", default="problems", metavar="DIR", help=text)
        text = "measure this part only: simulation or planning"
        parser.add_argument("--part", choices=("simulation", "planning"), help=text)
        text = "measure these methods only, by the names that the table has"
        parser.add_argument("--peers", nargs="+", default=METHODS, metavar="NAME", help=text)
        text = "processor time that one setting of a method may take on one phase [s] (60)"
        parser.add_argument("--limit", type=Range(1e-3, 1e6).parse, default=60.0, help=text)

    def list_cases(self, options: argparse.Namespace) -> Iterator[Case]:
        """Study, phase, method, setting, and the files that phases are from."""
        self.allowed = options.limit
        files = find_files(options.problems)
        if not files:
            text = f"{options.problems} has no problem files (*.toml)"
            raise InputError("", "--problems", text)
        for method in options.peers:
            if method not in METHODS:
                text = f"{method!r} given; allowed are {'; '.join(METHODS)}"
                raise InputError("", "--peers", text)
        every = {drag: [own.name for own in list_instances(files, drag)] for drag in (True, False)}
        if options.part != "planning":
            for study, phase, method in product((FEW, MANY), every[True], SIMULATORS):
                if method in options.peers:
                    settings = [f"{tolerance:g}" for tolerance in TOLERANCES[study]]
                    yield from product([study], [phase], [method], settings, [files])
        if options.part != "simulation":
            for study, (method, own) in product((LEAST_TIME, NO_DRAG), PLANNERS.items()):
                if method in options.peers and study in own.studies and is_installed(method):
                    phases = every[study != NO_DRAG]
                    yield from product([study], phases, [method], own.choices, [files])

    def limit(self, case: Case) -> float:
        """The time allowed, and that of the reference."""
        return self.allowed + REFERENCE

    def group(self, case: Case) -> object:
        """Simulators share the reference of a phase, runs of a planner what it imports."""
        study, phase, method, *_ = case
        return (study, phase) if study in (FEW, MANY) else method

    def run(self, case: Case) -> Row:
        """Measure one setting."""
        run = run_simulator if case[0] in (FEW, MANY) else run_planner
        found = run(*case)
        row = dict(zip(("study", "phase", "method", "setting"), case, strict=False))
        return row if found is None else row | found._asdict()

    def report(self, rows: Sequence[Row], options: argparse.Namespace) -> tuple[str, list[str]]:
        """All tables."""
        return format_report(read_medians(rows), options.limit), []

    def draw(self, rows: Sequence[Row]) -> Figure:
        """Times over errors."""
        return draw_medians(read_medians(rows))


STUDY = Precision()
