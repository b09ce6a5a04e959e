"""The commands ``wholearm animate`` and ``wholearm report``: motions to look at."""

from __future__ import annotations

import argparse
import os

from .output import name_files
from .overlay import overlay
from .progress import show_progress


def gallery(options: argparse.Namespace) -> int:
    """Plan problems, and write their page."""
    from ..common.files import require_ending, require_writable
    from ..viewer.gallery import write_gallery

    require_ending(options.output, ".md")
    require_writable(options.output)
    write_gallery(options.files, options.output, show_progress())
    name_files(options, options.output)
    return 0


def animate(options: argparse.Namespace) -> int:
    """Write a movie, or a page."""
    from ..common.errors import name_source
    from ..common.files import require_ending, require_writable, write_text
    from ..problem.read import read_own_problem
    from ..results.trajectory_file import load_trajectory

    ending = require_ending(options.output, ".gif", ".mp4", ".html")
    require_writable(options.output)
    trajectory = load_trajectory(options.trajectory)
    with name_source(options.trajectory):
        problem = read_own_problem(trajectory.meta)
        ghost = overlay(options.simulate, trajectory).trajectory if options.simulate else None
        if ending == ".html":
            from ..viewer import page
            from ..viewer.motion_data import describe_motion

            motion = describe_motion(trajectory, problem, ghost) | {"speed": options.speed}
            player = page.write_player(motion)
            write_text(options.output, page.build_page(problem.name, [player]))
        else:
            from ..viewer.movie import Movie, write_movie

            movie = Movie(problem, trajectory, ghost, options.speed)
            write_movie(movie, options.output, show_progress())
    name_files(options, options.output)
    return 0


def report(options: argparse.Namespace) -> int:
    """Write the page of a problem and its plans."""
    import tempfile
    from pathlib import Path

    from ..common.files import require_ending, require_writable, write_text
    from ..problem.read import read_problem
    from ..viewer.report_page import build_report

    stem = os.path.splitext(os.path.basename(options.problem))[0]
    output = options.output or f"{stem}.html"
    require_ending(output, ".html")
    require_writable(output)
    problem, say = read_problem(options.problem), show_progress()
    with tempfile.TemporaryDirectory() as folder:
        paths = options.files
        if not paths:
            from ..search.solve import solve

            paths = [os.path.join(folder, f"{stem}.npz")]
            solve(problem, progress=say).save(paths[0])
        text = Path(options.problem).read_text(encoding="utf-8")
        content = build_report(problem, paths, text, say)
    write_text(output, content)
    name_files(options, output)
    return 0
