"""The command ``wholearm compare``: plans and torques for one problem, side by side."""

from __future__ import annotations

import argparse
import json

from .progress import clear_progress, show_progress


def compare(options: argparse.Namespace) -> int:
    """Replay what is given, print the tables, and draw the margins."""
    from ..common.files import require_writable
    from ..comparison.compare import compare as run
    from ..geometry.path_guess import load

    if options.output is not None:
        from ..figures import plots

        plots.require_format(options.output)
        require_writable(options.output)
    found = run(load(options.problem), options.files, show_progress())
    clear_progress()
    if options.output is not None:
        from ..figures.comparison import draw_comparison

        plots.save(draw_comparison(found), options.output)
    print(json.dumps(found.to_dict(), indent=2) if options.json else found.to_text())
    if options.output is not None and not options.json:
        print(f"wrote {options.output}")
    return found.exit_status
