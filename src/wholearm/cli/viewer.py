"""The commands ``gallery``, ``animate`` and ``report``: movies and pages of motions."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING

from .output import name_files, require_output, show_progress

if TYPE_CHECKING:
    from ..results.trajectory import Trajectory
    from ..simulation.events import Simulation


def overlay(simulator: str, trajectory: Trajectory) -> Simulation:
    """Simulate the torques of a trajectory; `simulator` is told or free."""
    from ..problem.read import read_own_problem

    problem, say = read_own_problem(trajectory.meta), show_progress()
    if simulator == "free":
        from ..simulation.simulate import simulate_free

        say("simulating the whole")
        return simulate_free(problem, trajectory).show(trajectory.contacts)
    from ..simulation.simulate import simulate

    return simulate(problem, trajectory.torque, progress=say)


def gallery(options: argparse.Namespace) -> int:
    """Plan problems, and write their page."""
    from ..viewer.gallery import write_gallery

    require_output(options.output, ".md")
    write_gallery(options.files, options.output, show_progress())
    name_files(options, options.output)
    return 0


def animate(options: argparse.Namespace) -> int:
    """Write a movie, or a page."""
    from ..common.errors import name_source
    from ..common.files import write_text
    from ..problem.read import read_own_problem
    from ..results.trajectory import load_trajectory

    require_output(options.output, ".gif", ".mp4", ".html")
    trajectory = load_trajectory(options.trajectory)
    with name_source(options.trajectory):
        problem = read_own_problem(trajectory.meta)
        ghost = overlay(options.simulate, trajectory).trajectory if options.simulate else None
        if options.output.lower().endswith(".html"):
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

    from ..common.files import write_text
    from ..problem.read import read_problem
    from ..viewer.report_page import build_report

    stem = os.path.splitext(os.path.basename(options.problem))[0]
    output = options.output or f"{stem}.html"
    require_output(output, ".html")
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
