"""The command ``wholearm completion``: what makes a shell complete commands, options and files."""

from __future__ import annotations

import argparse

from ..common.errors import InputError
from .bench import StudyParser

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
