"""Phases from rest with one number off at a time: open loop by the clock, and with a policy.

``python -m wholearm.benchmark.policies problems/heptagon_four_contacts.toml [--output results]``
plans with several least normal forces and objectives. For each change it counts the phases that
reach their goal within 1 mm and 1 degree, and those that keep all contacts too, in simulations
that are not told which contacts hold. A policy measures at 1 kHz and counts on a delay of 0.5 ms.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..common.errors import SimulationError
from ..common.files import write_text
from ..geometry.path_guess import load
from ..planning.plan import solve
from ..planning.result import Plan
from ..policy.make import make_policy
from ..policy.policy import Policy
from ..problem.definition import Problem
from ..results.torque import TorqueProfile
from ..robustness.trial import Trial, make_trial
from ..robustness.uncertainty import Uncertainty
from .report import stamp

PLANS = ((0.05, "time"), (0.2, "time"), (0.05, "margin"), (0.2, "margin"))
"""Least normal forces [N] and objectives that are planned with."""
LATE = 1e-3
"""How long the previous phase's torques last too long [s]."""
TOLERANCE = 1e-6
STEPS = 2000
"""Steps of a policy that are timed."""


class Change(NamedTuple):
    """What is off: numbers, and of the torques by the clock how they are sampled."""

    name: str
    numbers: Mapping[str, float] = {}
    rate: float | None = None
    offset: float = 0.0
    late: bool = False


def _friction(share: float) -> dict[str, float]:
    return {f"friction_{part}": share for part in ("palm", "finger1", "finger2")}


CHANGES = (
    Change("nothing"),
    *(Change(f"mass {100 * w:+g} %", {"mass": w}) for w in (-0.05, 0.05)),
    *(Change(f"friction {100 * w:+g} %", _friction(w)) for w in (-0.1, 0.1)),
    *(Change(f"start x {1e3 * w:+g} mm", {"start_x": w}) for w in (-2e-4, 2e-4)),
    *(Change(f"torques {100 * w:+g} %", {"gain1": w, "gain2": w}) for w in (-0.01, 0.01)),
    Change("held at 1 kHz", rate=1000.0),
    Change("held at 1 kHz, of interval midpoints", rate=1000.0, offset=0.5),
    Change("previous phase's torques 1 ms too long; policy 1 ms late, as it knows", late=True),
    Change("policy 1 ms late, 0.5 ms more than it knows", {"delay": LATE}),
)


class Count(NamedTuple):
    """Phases that reach their goal, and those of them that keep their contacts."""

    reached: int
    kept: int

    def __str__(self) -> str:
        return f"{self.reached}/{self.kept}"


def count_phases(trials: Sequence[Trial], change: Change) -> Count:
    """What becomes of the phases of a plan."""
    records = []
    for trial in trials:
        records.append(trial.change(change.numbers, change.rate, change.offset))
    reached = [own["reached"] for own in records]
    return Count(
        sum(reached), sum(r and own["kept"] for r, own in zip(reached, records, strict=True))
    )


def make_trials(problem: Problem, plan: Plan, policy: Policy | None, late: bool) -> list[Trial]:
    """A trial of each phase; by the clock, it may begin with the end of the phase before."""
    found = []
    for phase in problem.phases:
        own = Uncertainty(sample_rate=None, tolerance=TOLERANCE)
        known = None if policy is None or not late else policy.with_(delay=LATE)
        trial = make_trial(problem, plan.trajectory, own, phase.number, known or policy)
        if late and phase.index and policy is None:
            before = plan.trajectory.torque.cut(
                0.0, float(plan.trajectory.phase_starts[phase.index])
            )
            last = before.coefficients[-1].sum(axis=1)
            prefix = TorqueProfile(np.array([0.0, LATE]), last[None, :, None])
            torque = TorqueProfile.chain([prefix, trial.torque])
            windows = [own._replace(stop=own.stop + LATE) for own in trial.windows]
            trial = Trial(
                problem, torque, trial.state, tuple(windows), trial.goal, trial.uncertainty
            )
        found.append(trial)
    return found


def time_step(policy: Policy, plan: Plan) -> float:
    """Mean time of a step along the plan's first phase [s]."""
    rows = plan.trajectory.phase == 0
    states = [
        (theta.tolist(), rates.tolist())
        for theta, rates in zip(
            plan.trajectory.theta[rows], plan.trajectory.theta_dot[rows], strict=True
        )
    ]
    policy.reset()
    begin = time.process_time()
    for k in range(STEPS):
        if k % len(states) == 0:
            policy.reset()
        policy.step(*states[k % len(states)])
    return (time.process_time() - begin) / STEPS


def study(path: Path) -> list[str]:
    """The table of a problem, as lines of Markdown."""
    head, lines = ["change"], [[change.name] for change in CHANGES]
    notes = []
    for epsilon, objective in PLANS:
        problem = load(str(path)).with_(epsilon=epsilon)
        plan = solve(problem, objective)
        policy = make_policy(
            problem, plan.trajectory, planner=lambda own: solve(own, replay=False).trajectory
        )
        title = f"{objective}, {epsilon:g} N"
        head += [f"{title}, open loop", f"{title}, policy"]
        slower = policy.duration / plan.duration - 1
        step = 1e6 * time_step(policy, plan)
        notes.append(
            f"{title}: plan {plan.duration:.4f} s, policy {policy.duration:.4f} s ({slower:+.1%}), "
            f"a step {step:.0f} us"
        )
        print(notes[-1], flush=True)
        for change, line in zip(CHANGES, lines, strict=True):
            for own in (None, policy):
                try:
                    trials = make_trials(problem, plan, own, change.late)
                    line.append(str(count_phases(trials, change)))
                except SimulationError as error:
                    line.append(str(error))
            print(change.name, *line[-2:], flush=True)
    rows = [f"| {' | '.join(line)} |" for line in lines]
    bar = "|---|" + "---:|" * (len(head) - 1)
    return [*(f"* {note}" for note in notes), "", f"| {' | '.join(head)} |", bar, *rows]


def main() -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", type=Path, help="problem file")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    lines = [
        f"# Phases of {options.problem.stem} from rest, with one number off",
        "",
        stamp(),
        "",
        "Goal reached within 1 mm and 1 degree / and all contacts kept. A contact is kept if it is",
        "never open for longer than 1e-3 of the scene's time until the next one is gained; where a",
        "start is off, it has 0.1 of that time to close.",
        "",
        *study(options.problem),
    ]
    write_text(str(options.output / "bench_policies.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
