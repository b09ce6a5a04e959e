"""The command ``wholearm predict``: up to which speed slow motions keep every contact."""

from __future__ import annotations

import argparse
import json

from ..common.errors import InputError
from .progress import clear_progress, show_progress

_SPEED = 0.05
"""Mean speed along the phases of the torques that are written [m/s]."""


def predict(options: argparse.Namespace) -> int:
    """Predict, print, and write what is asked for."""
    from ..common.files import require_ending, require_writable
    from ..problem.read import read_problem
    from ..quasistatic.predict import make_torques
    from ..quasistatic.predict import predict as run

    for path in filter(None, (options.output, options.torques)):
        require_writable(path)
    if options.output is not None:
        from ..figures import plots

        plots.require_format(options.output)
    if options.torques is not None:
        require_ending(options.torques, ".csv")
    elif options.speed is not None:
        raise InputError("", "--speed", "is for --torques FILE, the torques to write")
    prediction = run(
        read_problem(options.problem), squeeze=options.squeeze, progress=show_progress()
    )
    clear_progress()
    wrote = []
    if options.output is not None:
        from ..figures.prediction import draw_prediction

        plots.save(draw_prediction(prediction), options.output)
        wrote.append(options.output)
    print(json.dumps(prediction.to_dict()) if options.json else prediction.to_text())
    if options.torques is not None:
        from ..results.narrow import save

        save(make_torques(prediction, options.speed or _SPEED), options.torques)
        wrote.append(options.torques)
    if wrote and not options.json:
        print(f"wrote {', '.join(wrote)}")
    return 0
