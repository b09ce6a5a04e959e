"""The command ``wholearm robustness``: how much error a plan bears."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from ..common.errors import InputError
from .arguments import JOBS, TOLERANCE, number
from .origin import tell_origin
from .output import name_files, print_result
from .progress import show_progress

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..problem.definition import Problem
    from ..robustness.uncertainty import Uncertainty


def add_robustness(parser: argparse.ArgumentParser) -> None:
    """Add what `robustness` takes."""
    parser.add_argument("problem", help="problem file (TOML)")
    parser.add_argument("plan", help="trajectory file (.npz)")
    text = "samples to replay, a Latin hypercube of all ranges (1000)"
    parser.add_argument("--samples", type=number(1, 10**6), default=1000, help=text)
    parser.add_argument("--seed", type=number(0, 2**63), default=0, help="of the samples (0)")
    text = "only this phase, from its planned start at rest (default: the whole plan)"
    parser.add_argument("--phase", type=number(1, 1000), metavar="K", help=text)
    text = "torques by this policy (.npz), at its own period, instead of the plan's by the clock"
    parser.add_argument("--policy", metavar="FILE", help=text)
    text = "with --policy: measured normal forces are handed to it, exact ones"
    parser.add_argument("--sensor", action="store_true", help=text)
    text = (
        "half widths of ranges, instead of the problem's: mass, inertia (0.05), friction (0.1), "
        "gain of the torques (0.01), "
        "all relative; geometry, start_x [m] (6e-3 radii of gyration), "
        "delay (1e-3 s); 0 leaves a number as it is"
    )
    parser.add_argument("--vary", metavar="NAME=WIDTH", nargs="+", default=[], help=text)
    text = "of a sample-and-hold of the torques [Hz] (1000; 0: torques as planned)"
    parser.add_argument(
        "--sample-rate", type=number(0.0, 1e6), metavar="HZ", default=1000.0, help=text
    )
    text = "of the simulations, relative to the scene's scales (1e-6)"
    parser.add_argument("--tolerance", type=TOLERANCE, default=1e-6, help=text)
    text = "how far from the plan's end the goal counts as reached [m] (0.03 radii of gyration)"
    parser.add_argument("--goal-distance", type=number(1e-9, 1e6), metavar="M", help=text)
    text = "and how far from its angle [degrees] (1)"
    parser.add_argument(
        "--goal-angle", type=number(1e-9, 360.0), metavar="DEG", default=1.0, help=text
    )
    text = "file to write results to, one by one (default: NAME_robustness.jsonl, with phase and "
    text += "policy in the name); a study that is there goes on where it was stopped"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)
    parser.add_argument(
        "--fresh", action="store_true", help="begin the file anew, whatever it holds"
    )
    text = "also draw the motion with its noisy copies (.png, .pdf, .svg)"
    parser.add_argument("--figure", metavar="FILE", help=text)
    parser.add_argument("--jobs", type=JOBS, help="worker processes (default: all cores)")
    text = "run on the cluster of this Dask scheduler (extra: cluster)"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=text)
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=_robustness)


def _robustness(options: argparse.Namespace) -> int:
    from ..common.files import require_ending, require_writable
    from ..policy.policy import Policy
    from ..problem.read import adopt_phases, read_problem
    from ..results.trajectory_file import load_trajectory
    from ..robustness.study import assess_robustness

    output = options.output or _name_output(options)
    require_writable(output)
    require_ending(output, ".jsonl")
    if options.figure is not None:
        from ..figures import plots

        require_writable(options.figure)
        plots.require_format(options.figure)
    if options.sensor and options.policy is None:
        raise InputError("", "--sensor", "needs --policy")
    policy = None if options.policy is None else Policy.load(options.policy)
    plan = load_trajectory(options.plan)
    problem = read_problem(options.problem)
    problem = adopt_phases(problem, plan.meta, plan.q[-1], options.plan)
    if policy is not None:
        policy = policy.with_sensor(options.sensor)
    given = None if policy is None else (options.policy, policy)
    notes = tell_origin(problem, (options.plan, plan), given, options.json)
    study = assess_robustness(
        problem,
        plan,
        samples=options.samples,
        seed=options.seed,
        uncertainty=_read_ranges(options, problem),
        phase=options.phase,
        policy=policy,
        path=output,
        fresh=options.fresh,
        start=_choose_executor(options),
        progress=show_progress(),
    )
    if options.figure is not None:
        from ..figures.robustness import draw_robustness

        plots.save(draw_robustness(study), options.figure)
    status = print_result(options, study, notes)
    name_files(options, output, options.figure)
    return status


def _name_output(options: argparse.Namespace) -> str:
    """A file for each study that differs by more than numbers: its problem, phase and policy."""
    files = filter(None, (options.problem, options.policy))
    problem, *policy = (os.path.splitext(os.path.basename(path))[0] for path in files)
    phase = [] if options.phase is None else [f"phase{options.phase}"]
    sensor = ["sensor"] if options.sensor else []
    return "_".join([problem, "robustness", *phase, *policy, *sensor]) + ".jsonl"


def _read_ranges(options: argparse.Namespace, problem: Problem) -> Uncertainty:
    """The ranges of the problem or their defaults, and what is given in their place."""
    from ..problem.uncertainty import spread_widths
    from ..robustness.uncertainty import Uncertainty

    widths: dict[str, float] = {}
    for text in options.vary:
        name, _, value = text.partition("=")
        try:
            widths[name] = float(value)
        except ValueError:
            given = f"{text!r} given; NAME=WIDTH is needed, such as mass=0.1"
            raise InputError("", "--vary", given) from None
    known = problem.ranges | spread_widths(widths, "range of {}")
    goal = options.goal_distance, math.radians(options.goal_angle)
    return Uncertainty(known, options.sample_rate or None, options.tolerance, *goal)


def _choose_executor(options: argparse.Namespace) -> Callable[[], Executor] | None:
    if options.scheduler is not None:
        from ..robustness.cluster import connect

        return partial(connect, options.scheduler)
    from ..robustness.study import use_processes

    return partial(use_processes, options.jobs)
