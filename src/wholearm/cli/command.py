"""The command line: ``wholearm solve``, ``verify``, ``plot``, the studies of ``bench``, the parser.

Exit status 0 means done and all contacts held, 1 infeasible or a contact lost or a goal missed,
2 bad input, 130 interrupted, 143 terminated. Each command imports what it needs and nothing else.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..benchmark import STUDIES
from ..common.errors import InputError, WholearmError, name_source
from ..common.signals import guard
from .arguments import COMMANDS, Parser, name_simulator, protect
from .output import (
    announce,
    clear_progress,
    name_files,
    print_result,
    progress_log,
    require_output,
    show_progress,
    tell_origin,
)

if TYPE_CHECKING:
    from ..benchmark.study import Study
    from ..planning.result import Plan
    from ..planning.table_check import TorqueTable
    from ..policy.playback import Policy
    from ..problem.definition import Problem
    from ..results.report import Report
    from ..results.torque import TorqueProfile
    from ..results.trajectory import Trajectory
    from ..verification.free import FreeReport


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    return guard(lambda: _run(given), clear_progress)


def _run(given: Sequence[str]) -> int:
    try:
        named = protect(name_simulator(given))
        options = build_parser().parse_args(named)
        with progress_log():
            status: int = options.run(options)
        sys.stdout.flush()
        return status
    except WholearmError as error:
        clear_progress()
        _complain(str(error))
        return error.exit_status
    except BrokenPipeError:
        _silence_output()
        return 1
    except OSError as error:
        # Files are written elsewhere, with errors of their own; this is the output.
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
            raise
        _silence_output()
        _complain(f"standard output: cannot be written: {error.strerror}")
        return 1


def _complain(text: str) -> None:
    try:
        print(f"wholearm: {text}", file=sys.stderr, flush=True)
    except OSError:
        pass  # nobody reads it


def _silence_output() -> None:
    """Keep the interpreter from complaining again, when it exits, about what cannot be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = Parser(prog="wholearm", description="Plan and verify whole-arm manipulation.")
    version = f"wholearm {__version__}"
    parser.add_argument("--version", action="version", version=version, help="print the version")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for name, own in COMMANDS.items():
        own.add(commands.add_parser(name, help=own.text, description=_to_sentence(own.text)))
    text = "run studies: measure, compare with stored answers, look for what must not be"
    add_bench(commands.add_parser("bench", help=text, description=_to_sentence(text)))
    return parser


def _to_sentence(text: str) -> str:
    """With a capital first, and a full stop."""
    return f"{text[0].upper()}{text[1:]}."


def solve(options: argparse.Namespace) -> int:
    """Plan, and write the plan."""
    from ..common.fields import keys_of
    from ..common.files import together
    from ..geometry.tracing import load
    from ..planning.options import PlanOptions
    from ..planning.plan import solve_with
    from ..planning.result import describe_plan
    from ..scene.model import find_unit_hint

    output = options.output or f"{os.path.splitext(os.path.basename(options.problem))[0]}.npz"
    given = {key: getattr(options, key) for key in keys_of(PlanOptions)}
    plan_options = PlanOptions(**{key: own for key, own in given.items() if own is not None})
    require_output(output, ".npz")
    require_output(options.torques, ".csv")
    _check_sampling(options)
    problem = load(options.problem)
    if hint := find_unit_hint(problem.scene):
        _complain(f"{options.problem}: {hint}")
    for key in ("cache", "jobs"):
        if getattr(options, key) is not None and not problem.goals:
            raise InputError("", f"--{key}", "is for problems with [goal]")
    try:
        if problem.goals:
            from .route import find

            asked = {key: getattr(options, key) for key in ("cache", "jobs", "time_limit")}
            answer = find(problem, plan_options, **asked)
            plan, found = answer.plan, answer.to_text()
        else:
            plan = solve_with(problem, plan_options, show_progress(), options.time_limit)
            found = ""
        table = None if options.torques is None else _make_table(options, plan)
    except WholearmError as error:
        clear_progress()
        # Of bad input one line says everything.
        for path in filter(None, (output, options.torques) if error.exit_status == 1 else ()):
            if os.path.exists(path):
                _complain(f"{path}: left as it was, from an earlier run")
        raise
    with together():
        plan.save(output)
        if table is not None:
            table.save(options.torques)
    clear_progress()
    figures = None if table is None else {"file": options.torques, **table.figures}
    if options.json:
        extra = {} if figures is None else {"torques": figures}
        print(json.dumps(plan.to_dict() | extra, indent=2))
    else:
        print(found + describe_plan(plan, output, figures).to_text())
    return 0


def _check_sampling(options: argparse.Namespace) -> None:
    """Check what is asked of a table before anything is planned for it."""
    if options.sample_rate is None:
        if options.interpolation is not None:
            raise InputError("", "--interpolation", "is for tables with a --sample-rate")
        return
    if options.torques is None:
        raise InputError("", "--sample-rate", "needs --torques FILE, the table to write")
    from ..results.torque import require_sampling

    require_sampling(options.sample_rate, options.interpolation or "linear")


def _make_table(options: argparse.Namespace, plan: Plan) -> TorqueTable:
    """The torque table that is asked for, replayed."""
    from ..planning.table_check import make_table, sample_table

    if options.sample_rate is None:
        return make_table(plan.problem, plan.trajectory, options.replay)
    interpolation = options.interpolation or "linear"
    return sample_table(
        plan.problem, plan.trajectory, options.sample_rate, interpolation, options.replay
    )


def verify(options: argparse.Namespace) -> int:
    """Replay torques, and print the verdict."""
    from ..problem.read import adopt_phases, read_problem
    from ..results.trajectory import Trajectory
    from ..verification.verify import verify as run

    require_output(options.output, ".npz")
    keys = ("tolerance", "departure", "rest_speed", "uniqueness_margin")
    given = {key: own for key in keys if (own := getattr(options, key)) is not None}
    _check_free(options)
    problem = read_problem(options.problem)
    torques = _read_torques(options.torques)
    policy, notes = _read_policy(options, torques), {}
    if isinstance(torques, Trajectory):
        problem = adopt_phases(problem, torques.meta, torques.q[-1], options.torques)
        named = None if policy is None else (options.policy, policy)
        notes = tell_origin(problem, (options.torques, torques), named, options.json)
    if getattr(torques, "meta", {}).get("problem") != problem.table:
        # What has been planned or replayed can be carried out.
        from ..geometry.tracing import check_phases

        check_phases(problem)
    if options.free:
        given |= {} if options.restitution is None else {"restitution": options.restitution}
        report: Report | FreeReport = _simulate_free(problem, torques, policy, given)
    else:
        announce(f"replaying {len(problem.phases)} phases")
        report = run(problem, torques, reduced=options.reduced, **given)
    if options.output is not None:
        report.trajectory.save(options.output)
    status = print_result(options, report, notes)
    name_files(options, options.output)
    return status


def _read_policy(options: argparse.Namespace, torques: Trajectory | TorqueProfile) -> Policy | None:
    """The policy that is to carry out a plan, if one is given."""
    if options.policy is None:
        return None
    from ..policy.playback import Policy
    from ..results.torque import TorqueProfile

    if isinstance(torques, TorqueProfile):
        raise InputError(options.torques, "", "torques alone given; --policy needs the plan (.npz)")
    return Policy.load(options.policy).with_sensor(options.sensor)


def _simulate_free(
    problem: Problem,
    torques: Trajectory | TorqueProfile,
    policy: Policy | None,
    given: dict[str, float],
) -> FreeReport:
    """The report of torques, or of a policy, with no contacts told."""
    from ..results.trajectory import Trajectory

    if policy is None or not isinstance(torques, Trajectory):
        from ..verification.free import verify_free

        return verify_free(problem, torques, progress=show_progress(), **given)
    from ..verification.policy_check import verify_policy

    return verify_policy(problem, torques, policy, **given)


def _check_free(options: argparse.Namespace) -> None:
    """Check that nothing is asked for that the other simulator does."""
    others = {"--reduced": options.reduced, "--rest-speed": options.rest_speed}
    for key, value in others.items() if options.free else ():
        if value:
            raise InputError("", key, "does not go with --free")
    for key, value in {"--restitution": options.restitution, "--policy": options.policy}.items():
        if value is not None and not options.free:
            raise InputError("", key, "needs --free")
    if options.sensor and options.policy is None:
        raise InputError("", "--sensor", "needs --policy")


def _read_torques(path: str) -> Trajectory | TorqueProfile:
    from ..common.files import require_ending
    from ..results.torque import read_torque_csv
    from ..results.trajectory import load_trajectory

    csv = require_ending(path, ".npz", ".csv") == ".csv"
    return read_torque_csv(path) if csv else load_trajectory(path)


def plot(options: argparse.Namespace) -> int:
    """Draw a plan, or the replay of torques."""
    from ..figures import plots
    from ..results.trajectory import Trajectory
    from .viewer import overlay

    require_output(options.output)
    trajectory = _read_torques(options.trajectory)
    if not isinstance(trajectory, Trajectory):
        trajectory = _replay(options, trajectory)
    elif options.problem is not None:
        raise InputError("", "--problem", "is for torques (.csv); trajectories bring their own")
    with name_source(options.trajectory):
        simulation = overlay(options.simulate, trajectory) if options.simulate else None
        width = {} if options.width is None else {"width": options.width}
        figure = plots.force_margins(
            trajectory, simulation=simulation, motion=options.motion, **width
        )
    plots.save(figure, options.output)
    name_files(options, options.output)
    return 0


def _replay(options: argparse.Namespace, torques: TorqueProfile) -> Trajectory:
    """The motion that torques alone lead to."""
    if options.problem is None:
        raise InputError(options.trajectory, "--problem", "is needed to replay torques")
    from ..geometry.tracing import load
    from ..simulation.simulate import simulate

    return simulate(load(options.problem), torques, progress=show_progress()).trajectory


class StudyParser(Parser):
    """A parser that asks the study for its options when it is used: only then is that imported."""

    study = ""

    def complete(self) -> None:
        """Add the options of the study."""
        if self.study:
            from ..benchmark.study import add_common

            study = load_study(self.study)
            self.study = ""
            add_common(self, study)
            study.add_options(self)
            self.set_defaults(run=partial(_run_study, study))

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse, with all options."""
        self.complete()
        return super().parse_known_args(args, namespace)

    def format_help(self) -> str:
        """The help, with all options."""
        self.complete()
        return super().format_help()


def load_study(name: str) -> Study:
    """The study of a name."""
    module = STUDIES[name][0]
    package = "wholearm.benchmark" if module.startswith(".") else None
    study: Study = import_module(module, package).STUDY
    return study


def add_bench(bench: argparse.ArgumentParser) -> None:
    """Give the parser of ``bench`` its studies."""
    studies = bench.add_subparsers(metavar="STUDY", parser_class=StudyParser)
    for name, (_, text) in STUDIES.items():
        studies.add_parser(name, help=text, description=_to_sentence(text)).study = name
    bench.set_defaults(run=_list_studies)


def _list_studies(options: argparse.Namespace) -> int:
    """Print the names of all studies, with a line each."""
    width = max(map(len, STUDIES))
    print("\n".join(f"{name:{width}}  {text}" for name, (_, text) in STUDIES.items()))
    return 0


def _run_study(study: Study, options: argparse.Namespace) -> int:
    from ..benchmark.study import run_study

    report = run_study(study, options, show_progress())
    clear_progress()
    print(report.text, end="")
    for path in report.written:
        print(f"wrote {path}")
    return 1 if report.findings else 0
