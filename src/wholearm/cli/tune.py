"""The command ``wholearm tune``: torques from quasistatic ones, by steps of 10 %."""

from __future__ import annotations

import argparse
import json

from .progress import clear_progress, show_progress


def tune(options: argparse.Namespace) -> int:
    """Tune, print what became of each phase, and write the torques if all phases have some."""
    from ..common.files import require_ending, require_writable, write_text
    from ..geometry.path_guess import load
    from ..tuning.tune import tune as run

    if options.output is not None:
        require_writable(options.output)
        require_ending(options.output, ".csv")
    problem, report = load(options.problem), show_progress()
    found = run(problem, squeeze=options.squeeze, share=options.share, progress=report)
    clear_progress()
    print(json.dumps(found.to_dict(), indent=2) if options.json else found.to_text())
    if options.output is not None and found.ok:
        write_text(options.output, found.to_csv())
        if not options.json:
            print(f"wrote {options.output}")
    return 0 if found.ok else 1
