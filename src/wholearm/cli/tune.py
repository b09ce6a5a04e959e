"""The command ``wholearm tune``: torques from quasistatic ones, by steps of 10 %."""

from __future__ import annotations

import argparse

from .output import name_files, print_result
from .progress import show_progress


def tune(options: argparse.Namespace) -> int:
    """Tune, print what became of each phase, and write the torques if they hold."""
    from ..common.files import require_ending, require_writable, write_text
    from ..geometry.path_guess import load
    from ..tuning.tuner import tune as run

    if options.output is not None:
        require_writable(options.output)
        require_ending(options.output, ".csv")
    given = {key: getattr(options, key) for key in ("brake", "stops", "squeeze", "share")}
    found = run(load(options.problem), **given, progress=show_progress())
    status = print_result(options, found)
    if options.output is not None and found.ok:
        write_text(options.output, found.to_csv())
        name_files(options, options.output)
    return status
