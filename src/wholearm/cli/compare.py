"""The command ``wholearm compare``: plans and torques for one problem, side by side."""

from __future__ import annotations

import argparse

from .output import name_files, print_result
from .progress import show_progress


def compare(options: argparse.Namespace) -> int:
    """Replay what is given, print the tables, and draw the margins."""
    from ..common.files import require_writable
    from ..comparison.metrics import compare as run
    from ..geometry.path_guess import load

    if options.output is not None:
        from ..figures import plots

        plots.require_format(options.output)
        require_writable(options.output)
    found = run(load(options.problem), options.files, show_progress())
    if options.output is not None:
        from ..figures.comparison import draw_comparison

        plots.save(draw_comparison(found), options.output)
    status = print_result(options, found)
    name_files(options, options.output)
    return status
