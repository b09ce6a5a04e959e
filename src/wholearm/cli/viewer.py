"""The commands ``wholearm animate`` and ``wholearm report``: motions to look at."""

from __future__ import annotations

import argparse
import os

from .arguments import SIMULATORS, number
from .output import name_files
from .overlay import overlay
from .progress import show_progress


def add_animate(parser: argparse.ArgumentParser) -> None:
    """Add what `animate` takes."""
    parser.add_argument("trajectory", help="trajectory file (.npz)")
    text = "what to write: .gif, .mp4 (needs ffmpeg), or .html, which plays in any browser"
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=text)
    text = "speed over real time (0.1: ten times slower)"
    parser.add_argument("--speed", type=number(1e-6, 1e3), default=0.1, help=text)
    text = "draw the simulated motion behind; free: simulated without telling which contacts hold"
    parser.add_argument("--simulate", choices=SIMULATORS, metavar="[free]", help=text)
    parser.set_defaults(run=_animate)


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add what `report` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    text = "trajectory files (.npz) or torques (.csv); none: plan the least time"
    parser.add_argument("files", nargs="*", metavar="PLAN", help=text)
    text = "page to write (default: NAME.html)"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)
    parser.set_defaults(run=_report)


def add_gallery(parser: argparse.ArgumentParser) -> None:
    """Add what `gallery` takes."""
    parser.add_argument("files", nargs="+", metavar="PROBLEM", help="problem files (TOML)")
    text = "page to write (.md); figures and movies go to a folder beside it (results/gallery.md)"
    parser.add_argument("-o", "--output", metavar="FILE", default="results/gallery.md", help=text)
    parser.set_defaults(run=_gallery)


def _gallery(options: argparse.Namespace) -> int:
    from ..common.files import require_ending, require_writable
    from ..viewer.gallery import write_gallery

    require_ending(options.output, ".md")
    require_writable(options.output)
    write_gallery(options.files, options.output, show_progress())
    name_files(options, options.output)
    return 0


def _animate(options: argparse.Namespace) -> int:
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
            from ..viewer.motion import describe_motion

            motion = describe_motion(trajectory, problem, ghost) | {"speed": options.speed}
            player = page.write_player(motion)
            write_text(options.output, page.build_page(problem.name, [player]))
        else:
            from ..viewer.movie import Movie, write_movie

            movie = Movie(problem, trajectory, ghost, options.speed)
            write_movie(movie, options.output, show_progress())
    name_files(options, options.output)
    return 0


def _report(options: argparse.Namespace) -> int:
    import tempfile
    from pathlib import Path

    from ..common.files import require_ending, require_writable, write_text
    from ..problem.read import read_problem
    from ..viewer.report import build_report

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
