"""The command ``wholearm policy``: torques as a function of the joints."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING

from ..common.errors import name_source
from .output import clear_progress, print_result, require_output, show_progress

_QUICK = 2e-4
"""Period of the loop that is tried where a policy fails [s]; case: flips onto another edge."""

if TYPE_CHECKING:
    from ..problem.definition import Problem
    from ..results.trajectory import Trajectory


def policy(options: argparse.Namespace) -> int:
    """Make a policy, simulate it, and write it if it holds."""
    from ..common.errors import ReplayError
    from ..planning.plan import solve
    from ..policy.make import find_widest, make_policy
    from ..problem.read import read_own_problem
    from ..results.trajectory import load_trajectory
    from ..verification.policy_check import verify_policy

    stem = os.path.splitext(os.path.basename(options.plan))[0]
    output = options.output or f"{stem}_policy.npz"
    require_output(output, ".npz")
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
        made = make_policy(problem, plan, **given, planner=plan_anew)
        say("simulating the policy")
        report = verify_policy(problem, plan, made, **allowed)
        if options.largest:
            say("looking for the widest ranges")
            each = find_widest(problem, plan, options.delay)
            made.about["largest"] = {str(number): factor for number, factor in each.items()}
    clear_progress()
    failures = "; ".join(report.failures)
    if not report.ok and options.write_anyway:
        # The mark by which a program, or a reader of the file, knows.
        made.about["failures"] = list(report.failures)
        text = f"{output}: written although in the free simulation, {failures}"
        print(f"wholearm: warning: {text}", file=sys.stderr)
    elif not report.ok:
        opened = [loss.gap for phase in report.phases for loss in phase.losses]
        enough = ""
        if len(opened) == len(report.failures):
            # Nothing but openings: rounded up to two digits.
            share = f"{1.05 * max(opened) / problem.scene.scales.length:.2g}"
            enough = f"--departure {share} allows that; "
        raise ReplayError(
            f"{options.plan}: no policy is written: in the free simulation, {failures}; "
            f"{enough}{advise()}; --write-anyway writes it all the same"
        )
    made.save(output)
    status = print_result(options, made)
    if not options.json:
        print(f"{made.duration:.6f} s in all, the plan {plan.duration:.6f} s; wrote {output}")
    return status
