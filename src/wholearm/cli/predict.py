"""The command ``wholearm predict``: up to which speed slow motions keep every contact."""

from __future__ import annotations

import argparse

from ..common.errors import InputError
from .output import name_files, print_result
from .progress import show_progress

_SPEED = 0.05  # mean speed along the phases of the torques that are written [m/s]


def predict(options: argparse.Namespace) -> int:
    """Predict, print, and write what is asked for."""
    from ..common.files import require_ending, require_writable
    from ..problem.read import read_problem
    from ..quasistatic.slow_speeds import make_torques
    from ..quasistatic.slow_speeds import predict as run

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
    if options.output is not None:
        from ..figures.prediction_figure import draw_prediction

        plots.save(draw_prediction(prediction), options.output)
    status = print_result(options, prediction)
    if options.torques is not None:
        from ..results.adopt import save

        save(make_torques(prediction, options.speed or _SPEED), options.torques)
    name_files(options, options.output, options.torques)
    return status
