"""The commands ``help``, ``completion``, ``new`` and ``schema``: what users begin with.

Pages of the documentation stand beside the code.
"""

from __future__ import annotations

import argparse
import os
import posixpath
import re
from importlib import resources
from typing import TYPE_CHECKING

from ..common.errors import InputError

if TYPE_CHECKING:
    from ..common.arrays import Array


TOPICS = {
    "python": "",
    "file-format": "problem",
    "model": "mechanics",
    "contacts": "contacts",
    "planning": "planning",
    "path-domain": "planning/path_domain",
    "time-domain": "planning/time_domain",
    "robust-plans": "planning/robust",
    "verification": "verification",
    "messages": "cli",
    "search": "search",
    "map": "mapping",
    "policy": "policy",
    "robustness": "robustness",
    "engines": "engines",
    "slow-motions": "quasistatic",
    "tuning": "tuning",
    "comparison": "comparison",
    "simulation": "simulation",
    "free-simulation": "simulation",
    "output-files": "results",
    "figures": "figures",
    "movies": "viewer",
    "studies": "benchmark",
}
"""Folder of the page of each topic."""


def show(options: argparse.Namespace) -> int:
    """Print a page, or the topics."""
    if options.topic is not None:
        print(read_page(TOPICS[options.topic]), end="")
        return 0
    for topic, folder in TOPICS.items():
        print(f"{topic:16} {read_page(folder).splitlines()[0].removeprefix('# ')}")
    return 0


def read_page(folder: str) -> str:
    """The page of a folder, with topics in place of links to other pages."""
    page = resources.files("wholearm").joinpath(*folder.split("/"), "README.md")
    topics = {posixpath.join(own, "README.md"): topic for topic, own in TOPICS.items()}

    def name(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2]))
        return f"{link[1]} (wholearm help {topics[target]})" if target in topics else link[1]

    text = page.read_text(encoding="utf-8")
    return re.sub(r"\[([^\]]+)\]\(([^)#]*)(?:#[^)]*)?\)", name, text)


SHELLS = ("bash", "zsh", "tcsh")


def complete(options: argparse.Namespace) -> int:
    """Print what a shell needs."""
    if options.shell not in SHELLS:
        raise InputError("", "shell", f"{options.shell!r} given; allowed are {', '.join(SHELLS)}")
    try:
        import shtab
    except ImportError:
        text = "is not installed; pip install 'wholearm[completion]' brings it"
        raise InputError("", "shtab", text) from None
    from .command import build_parser

    parser = build_parser()
    _complete_files(parser, shtab.FILE, shtab.DIRECTORY)
    print(shtab.complete(parser, options.shell))
    return 0


def _complete_files(parser: argparse.ArgumentParser, files: object, folders: object) -> None:
    """Let all arguments that name files or folders be completed so."""
    from .command import StudyParser

    if isinstance(parser, StudyParser):
        parser.complete()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for own in action.choices.values():
                _complete_files(own, files, folders)
        elif action.metavar == "DIR":
            action.complete = folders  # type: ignore[attr-defined]
        elif action.metavar in ("FILE", "PLAN") or (action.dest in _FILES and not action.type):
            action.complete = files  # type: ignore[attr-defined]


_FILES = {"problem", "plan", "trajectory", "torques", "files", "output"}


def write(options: argparse.Namespace) -> int:
    """Write a problem file."""
    from ..common.errors import name_source
    from ..common.files import require_writable, write_text
    from ..mapping.formation_list import write_template

    output = f"{options.name.removesuffix('.toml')}.toml"
    require_writable(output)
    if os.path.exists(output):
        raise InputError(output, "", "is there already; choose another name")
    name = os.path.splitext(os.path.basename(output))[0]
    vertices = None if options.vertices is None else _read_vertices(options.vertices)
    with name_source("--vertices" if vertices is not None else ""):
        text = write_template(name, options.polygon, options.size, options.mass, vertices)
    write_text(output, text)
    print(f"wrote {output}; next: wholearm solve {output}")
    return 0


def _read_vertices(text: str) -> Array:
    """Corners, shape (n, 2) [m]."""
    import numpy as np

    try:
        return np.array([[float(part) for part in own.split(",")] for own in text.split()])
    except ValueError:
        given = f"{text!r} given; needed are corners as x,y in m, such as '0,0 0.08,0 0.04,0.06'"
        raise InputError("", "--vertices", given) from None


def show_schema(options: argparse.Namespace) -> int:
    """Print or write the schema, or the tables of keys."""
    import json

    from ..common.files import require_writable, write_text
    from ..problem.read import build_schema, write_page

    text = write_page() if options.table else json.dumps(build_schema(), indent=2) + "\n"
    if options.output is None:
        print(text, end="")
        return 0
    require_writable(options.output)
    write_text(options.output, text)
    print(f"wrote {options.output}")
    return 0
