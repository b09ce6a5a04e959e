"""The command ``wholearm policy``: torques as a function of the joints."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING

from ..common.errors import name_source
from .arguments import DEPARTURE, number
from .output import print_result
from .progress import clear_progress, show_progress

_QUICK = 2e-4
"""Period of the loop that is tried where a policy fails [s]; case: flips onto another edge."""

if TYPE_CHECKING:
    from ..problem.definition import Problem
    from ..results.trajectory import Trajectory


def add_policy(parser: argparse.ArgumentParser) -> None:
    """Add what `policy` takes."""
    parser.add_argument("plan", help="trajectory file (.npz)")
    text = "policy to write (.npz; default: NAME_policy.npz)"
    parser.add_argument("-o", "--output", metavar="FILE", help=text)
    text = "normal force that is kept in reserve along the way: where plan or problem have ranges "
    text += "of numbers, for so many times these (1); otherwise over what usual errors of masses, "
    text += "friction and torques take away (2.5); 0 is as fast as the plan"
    parser.add_argument("--reserve", type=number(0.0, 1e3), help=text)
    text = "of the control loop [s] (1e-3)"
    parser.add_argument("--period", type=number(1e-5, 10.0), default=1e-3, help=text)
    text = "time from measuring to when torques take effect [s] (5e-4)"
    parser.add_argument("--delay", type=number(0.0, 10.0), default=5e-4, help=text)
    text = "of both fingers, if it is more than the plan was made with [N m] (default: the same)"
    parser.add_argument("--torque-limit", type=number(1e-12, 1e12), help=text)
    text = "also look for how many times as wide ranges a policy can keep contacts in"
    parser.add_argument("--largest", action="store_true", help=text)
    text = (
        "how far contacts may open in its simulation, over the object's radius of gyration (1e-3)"
    )
    parser.add_argument("--departure", type=DEPARTURE, help=text)
    text = "write the policy although its simulation does not hold, marked so in its file"
    parser.add_argument("--write-anyway", action="store_true", help=text)
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=_policy)


def _policy(options: argparse.Namespace) -> int:
    from ..common.errors import ReplayError
    from ..common.files import require_ending, require_writable
    from ..planning.plan import solve
    from ..policy.make import make_policy
    from ..policy.widest import find_widest
    from ..problem.read import read_own_problem
    from ..results.trajectory_file import load_trajectory
    from ..verification.policy import verify_policy

    stem = os.path.splitext(os.path.basename(options.plan))[0]
    output = options.output or f"{stem}_policy.npz"
    require_writable(output)
    require_ending(output, ".npz")
    plan = load_trajectory(options.plan)
    problem = read_own_problem(plan.meta, options.plan)
    given = {key: getattr(options, key) for key in ("reserve", "period", "delay", "torque_limit")}
    allowed = {} if options.departure is None else {"departure": options.departure}
    say = show_progress()

    def plan_anew(own: Problem) -> Trajectory:
        return solve(own, replay=False, progress=say).trajectory

    def advise() -> str:
        """Whether a faster loop would do: what is lost between two periods is lost by lateness."""
        quick = {**given, "period": min(_QUICK, options.period), "delay": 0.0}
        if (quick["period"], 0.0) == (options.period, options.delay):
            return f"a period below {options.period:g} s may do"
        own = make_policy(problem, plan, **quick, planner=plan_anew)
        words = f"--period {quick['period']:g} --delay 0"
        held = verify_policy(problem, plan, own, **allowed).ok
        return f"{words} would do" if held else f"{words} would not do either"

    with name_source(options.plan):
        say("making the policy")
        policy = make_policy(problem, plan, **given, planner=plan_anew)
        say("simulating the policy")
        report = verify_policy(problem, plan, policy, **allowed)
        if options.largest:
            say("looking for the widest ranges")
            each = find_widest(problem, plan, options.delay)
            policy.about["largest"] = {str(number): factor for number, factor in each.items()}
    clear_progress()
    failures = "; ".join(report.failures)
    if not report.ok and options.write_anyway:
        # The mark by which a program, or a reader of the file, knows.
        policy.about["failures"] = list(report.failures)
        text = f"{output}: written although in the free simulation, {failures}"
        print(f"wholearm: warning: {text}", file=sys.stderr)
    elif not report.ok:
        opened = [loss.gap for own in report.phases for loss in own.losses]
        enough = ""
        if len(opened) == len(report.failures):
            # Nothing but openings: rounded up to two digits.
            share = f"{1.05 * max(opened) / problem.scene.scales.length:.2g}"
            enough = f"--departure {share} allows that; "
        raise ReplayError(
            f"{options.plan}: no policy is written: in the free simulation, {failures}; "
            f"{enough}{advise()}; --write-anyway writes it all the same"
        )
    policy.save(output)
    status = print_result(options, policy)
    if not options.json:
        print(f"{policy.duration:.6f} s in all, the plan {plan.duration:.6f} s; wrote {output}")
    return status
