"""The commands ``export`` and ``replay``: files for physics engines, and replays in them."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..common.errors import InputError, name_source
from ..common.fields import Range
from .output import name_files, print_result, require_output, show_progress, tell_origin

if TYPE_CHECKING:
    from ..engines.stretch import Setting
    from ..problem.definition import Problem
    from ..results.trajectory import Trajectory

STEPS = Range(1e-6, 1e-1, lambda scene, _: scene.scales.time, "times the scene's time")
"""Time steps with which engines get along."""


def export(options: argparse.Namespace) -> int:
    """Write the scene, with a plan if one is given."""
    from ..common.files import write_text
    from ..engines.mjcf import write_mjcf
    from ..problem.read import read_problem

    require_output(options.mjcf, ".xml")
    problem = read_problem(options.problem)
    if options.step is not None:
        STEPS.check("--step", options.step, "s", problem.scene)
    plan = None
    if options.plan is not None:
        problem, plan = _load_plan(options.plan, problem)
        tell_origin(problem, (options.plan, plan))
    with name_source(options.problem):
        write_text(options.mjcf, write_mjcf(problem, plan, step=options.step))
    name_files(options, options.mjcf)
    return 0


def replay(options: argparse.Namespace) -> int:
    """Replay a plan, and print the report."""
    from ..engines.engine_replay import ENGINES, replay_in, require_engine
    from ..problem.read import read_problem

    require_engine(options.engine)
    problem = read_problem(options.problem)
    problem, plan = _load_plan(options.plan, problem)
    setting = ENGINES[options.engine].setting
    if options.step is not None:
        STEPS.check("--step", options.step, "s", problem.scene)
        setting = setting._replace(step=options.step / problem.scene.scales.time)
    if options.softness is not None:
        setting = setting._replace(softness=options.softness)
    if options.policy is not None:
        return _play_policy(options, problem, plan, setting)
    notes = tell_origin(problem, (options.plan, plan), silent=options.json)
    with name_source(options.problem):
        report = replay_in(
            options.engine,
            problem,
            plan,
            whole=options.whole,
            setting=setting,
            allowed=options.departure,
            halvings=options.refine,
            progress=show_progress(),
        )
    return print_result(options, report, notes)


def _play_policy(
    options: argparse.Namespace, problem: Problem, plan: Trajectory, setting: Setting
) -> int:
    from ..engines.engine_replay import ALLOWED, play_policy
    from ..policy.playback import Policy

    if options.refine:
        raise InputError("", "--refine", "is for plans by the clock, not with --policy")
    policy = Policy.load(options.policy)
    notes = tell_origin(problem, (options.plan, plan), (options.policy, policy), options.json)
    with name_source(options.policy):
        report = play_policy(
            options.engine,
            problem,
            plan,
            policy,
            whole=options.whole,
            setting=setting,
            allowed=ALLOWED if options.departure is None else options.departure,
            progress=show_progress(),
        )
    return print_result(options, report, notes)


def _load_plan(path: str, problem: Problem) -> tuple[Problem, Trajectory]:
    """A plan, and the problem whose phases it has."""
    from ..common.files import require_ending
    from ..problem.read import adopt_phases
    from ..results.adopt import require_same_phases
    from ..results.trajectory import load_trajectory

    if require_ending(path, ".npz", ".csv") == ".csv":
        text = "torques alone have no motion to compare with; verify -o FILE.npz writes one"
        raise InputError(path, "", text)
    plan = load_trajectory(path)
    problem = adopt_phases(problem, plan.meta, plan.q[-1], path)
    with name_source(path):
        require_same_phases(problem, plan)
    return problem, plan
