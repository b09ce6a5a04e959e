"""The command ``wholearm bench``: studies of the package, by their names."""

from __future__ import annotations

import argparse
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ..benchmark import STUDIES
from .arguments import Parser
from .progress import clear_progress, show_progress

if TYPE_CHECKING:
    from ..benchmark.study import Study


class StudyParser(Parser):
    """A parser that asks the study for its options when it is used: only then is that imported."""

    study = ""

    def complete(self) -> None:
        """Add the options of the study."""
        if self.study:
            from ..benchmark.study import add_common

            study = load_study(self.study)
            self.study = ""
            add_common(self, study)
            study.add_options(self)
            self.set_defaults(run=partial(_run, study))

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, with all options."""
        self.complete()
        return super().parse_known_args(args, namespace)

    def format_help(self) -> str:
        """The help, with all options."""
        self.complete()
        return super().format_help()


def load_study(name: str) -> Study:
    """The study of a name."""
    module = STUDIES[name][0]
    package = "wholearm.benchmark" if module.startswith(".") else None
    study: Study = import_module(module, package).STUDY
    return study


def add_bench(bench: argparse.ArgumentParser) -> None:
    """Give the parser of ``bench`` its studies."""
    studies = bench.add_subparsers(metavar="STUDY", parser_class=StudyParser)
    for name, (_, text) in STUDIES.items():
        studies.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}."
        ).study = name
    bench.set_defaults(run=_list)


def _list(options: argparse.Namespace) -> int:
    """Print the names of all studies, with a line each."""
    width = max(map(len, STUDIES))
    print("\n".join(f"{name:{width}}  {text}" for name, (_, text) in STUDIES.items()))
    return 0


def _run(study: Study, options: argparse.Namespace) -> int:
    from ..benchmark.study import run_study

    report = run_study(study, options, show_progress())
    clear_progress()
    print(report.text, end="")
    for path in report.written:
        print(f"wrote {path}")
    return 1 if report.findings else 0
