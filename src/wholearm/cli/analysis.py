"""Commands that analyse: ``predict``, ``tune``, ``compare`` and ``robustness``."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from ..common.errors import InputError
from .output import name_files, print_result, require_output, show_progress, tell_origin

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from ..problem.definition import Problem
    from ..robustness.error_model import Uncertainty

_SPEED = 0.05  # mean speed along the phases of quasistatic torques that are written [m/s]


def predict(options: argparse.Namespace) -> int:
    """Predict up to which speed quasistatic motions keep contacts, and write what is asked for."""
    from ..problem.read import read_problem
    from ..quasistatic.slow_speeds import make_torques
    from ..quasistatic.slow_speeds import predict as run

    require_output(options.output)
    require_output(options.torques, ".csv")
    if options.torques is None and options.speed is not None:
        raise InputError("", "--speed", "is for --torques FILE, the torques to write")
    problem = read_problem(options.problem)
    prediction = run(problem, squeeze=options.squeeze, progress=show_progress())
    if options.output is not None:
        from ..figures import plots
        from ..figures.analysis_figures import draw_prediction

        plots.save(draw_prediction(prediction), options.output)
    status = print_result(options, prediction)
    if options.torques is not None:
        from ..results.adopt import save

        save(make_torques(prediction, options.speed or _SPEED), options.torques)
    name_files(options, options.output, options.torques)
    return status


def tune(options: argparse.Namespace) -> int:
    """Tune torques in steps of 10 %, print what became of each phase, write them if they hold."""
    from ..common.files import write_text
    from ..geometry.tracing import load
    from ..tuning.tuner import tune as run

    require_output(options.output, ".csv")
    given = {key: getattr(options, key) for key in ("brake", "stops", "squeeze", "share")}
    tuning = run(load(options.problem), **given, progress=show_progress())
    status = print_result(options, tuning)
    if options.output is not None and tuning.ok:
        write_text(options.output, tuning.to_csv())
        name_files(options, options.output)
    return status


def compare(options: argparse.Namespace) -> int:
    """Replay plans and torques for one problem, print the tables, and draw the margins."""
    from ..comparison.metrics import compare as run
    from ..geometry.tracing import load

    require_output(options.output)
    comparison = run(load(options.problem), options.files, show_progress())
    if options.output is not None:
        from ..figures import plots
        from ..figures.analysis_figures import draw_comparison

        plots.save(draw_comparison(comparison), options.output)
    status = print_result(options, comparison)
    name_files(options, options.output)
    return status


def robustness(options: argparse.Namespace) -> int:
    """Replay samples, and print what becomes of them."""
    from ..policy.playback import Policy
    from ..problem.read import adopt_phases, read_problem
    from ..results.trajectory import load_trajectory
    from ..robustness.sampling import assess_robustness

    output = options.output or _name_output(options)
    require_output(output, ".jsonl")
    require_output(options.figure)
    if options.sensor and options.policy is None:
        raise InputError("", "--sensor", "needs --policy")
    policy = None
    if options.policy is not None:
        policy = Policy.load(options.policy).with_sensor(options.sensor)
    plan = load_trajectory(options.plan)
    problem = read_problem(options.problem)
    problem = adopt_phases(problem, plan.meta, plan.q[-1], options.plan)
    named = None if policy is None else (options.policy, policy)
    notes = tell_origin(problem, (options.plan, plan), named, options.json)
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
        from ..figures import plots
        from ..figures.analysis_figures import draw_robustness

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
    from ..common.crowd import Processes, connect

    if options.scheduler is not None:
        return partial(connect, options.scheduler)
    return partial(Processes, options.jobs)
