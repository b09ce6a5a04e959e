"""The command ``wholearm robustness``: how much error a plan bears."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from ..common.errors import InputError
from .origin import tell_origin
from .output import name_files, print_result
from .progress import show_progress

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..problem.definition import Problem
    from ..robustness.error_model import Uncertainty


def robustness(options: argparse.Namespace) -> int:
    """Replay samples, and print what becomes of them."""
    from ..common.files import require_ending, require_writable
    from ..policy.playback import Policy
    from ..problem.read import adopt_phases, read_problem
    from ..results.trajectory_file import load_trajectory
    from ..robustness.sampling import assess_robustness

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
        from ..figures.robustness_figure import draw_robustness

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
    from ..robustness.error_model import Uncertainty

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
    from ..robustness.sampling import use_processes

    return partial(use_processes, options.jobs)
