"""Torques with limited rates: against time-optimal jerk-limited motion, and as the limit grows.

``python -m wholearm.benchmark.torque_rates problems/heptagon_four_contacts.toml [--cases 200]
[--output results]`` plans random straight lines with constant inertia and no friction, and compares
their durations with the closed form of the least time (with limits on s'' and s''' that are met at
the middle) and with Ruckig, where that is installed: ``pip install ruckig``. Then it plans the
problem with rate limits that grow, beside the plan without one.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from ..common.arrays import Array
from ..common.errors import WholearmError
from ..common.files import write_text
from ..geometry.curve import Curve, Segment
from ..geometry.path_guess import load
from ..mechanics.dynamics import PathForces
from ..planning.options import PlanOptions
from ..planning.path_domain import data
from ..planning.path_domain.plan import plan_path
from ..planning.plan import solve
from ..scene.model import Scales
from .report import stamp

ACCURACY = 1e-6
"""Accuracy that lines are planned with."""
QUICK = (0.5, 60.0)
"""Range of the rate limit over the torque limit, in the time that a line takes without it."""
GROWING = (20.0, 100.0, 500.0, 2500.0, 20_000.0, 100_000.0, 1_000_000.0)
"""Rate limits that the problem is planned with [N m/s]."""


class Line(NamedTuple):
    """A line of some length [m] along which tau_1 = inertia s'' and tau_2 = 0.

    With the limits of the torque [N m] and its rate [N m/s].
    """

    length: float
    inertia: float
    limit: float
    rate: float

    @staticmethod
    def draw(rng: np.random.Generator) -> Line:
        """A random line."""
        length, inertia, limit = 10 ** rng.uniform([-1.5, -1.0, -1.0], [0.5, 1.0, 1.0])
        lasts = 2 * math.sqrt(length * inertia / limit)
        quick = math.exp(rng.uniform(*np.log(QUICK)))
        return Line(length, inertia, limit, quick * limit / lasts)

    @property
    def least_time(self) -> float:
        """Least time from rest to rest [s]: four ramps, or six pieces where the limit is met."""
        most, jerk = self.limit / self.inertia, self.rate / self.inertia
        ramp = (self.length / (2 * jerk)) ** (1 / 3)
        if jerk * ramp <= most:
            return float(4 * ramp)
        return most / jerk + math.sqrt((most / jerk) ** 2 + 4 * self.length / most)

    def plan(self) -> float:
        """The duration that the planner finds [s]."""
        with (
            patch.object(data, "inverse", self._inverse),
            patch.object(data, "reduced_inertia", lambda *_: np.ones(1)),
        ):
            return plan_path(self._curve, 0.05, PlanOptions(accuracy=ACCURACY), 1).motion.duration

    @property
    def _curve(self) -> Curve:
        infinite = np.full(2, np.inf)
        unit = self.length, self.inertia, self.inertia * self.length
        scene = SimpleNamespace(
            scales=Scales(*unit),
            torque_limit=np.array([self.limit, self.limit]),
            speed_limit=infinite,
            torque_rate_limit=np.array([self.rate, np.inf]),
            actuator_lag=np.zeros(2),
            has_slow_motors=True,
        )
        formation = SimpleNamespace(
            scene=scene, n_contacts=1, n_rolling=0, n_constraints=1, names=("v0-palm",)
        )
        formation.rolling, formation.rolling_rows, formation.friction = (), (), np.zeros(1)
        segment = Segment(0.0, self.length, np.ones(1), np.zeros(2))
        curve: Any = SimpleNamespace(
            length=self.length, segments=[segment], formation=formation, evaluate=_evaluate
        )
        found: Curve = curve
        return found

    def _inverse(self, _: Any, z: Array, *__: Any) -> PathForces:
        none, one, flat = np.zeros((len(z), 1)), np.ones((len(z), 1)), np.zeros((len(z), 2))
        Ta = np.outer(np.ones(len(z)), [self.inertia, 0.0])
        return PathForces(none, none, none, one, flat, Ta, flat, flat, flat, none)


class LinePoint(tuple[Array, Array, Array]):
    """Points of a straight line in place of those of a curve: z, z' and z''."""

    kinematics = None

    @property
    def z(self) -> Array:
        """Configurations, shape (n, 5)."""
        return self[0]

    @property
    def z_s(self) -> Array:
        """Their derivatives along the line, shape (n, 5)."""
        return self[1]


def _evaluate(s: Array) -> LinePoint:
    z = np.outer(s, np.ones(5))
    return LinePoint((z, np.ones_like(z), 0 * z))


def ask_ruckig(line: Line) -> float:
    """The duration that Ruckig finds [s]; NaN if it is not installed."""
    try:
        import ruckig
    except ImportError:
        return math.nan
    given, found = ruckig.InputParameter(1), ruckig.Trajectory(1)
    given.current_position, given.target_position = [0.0], [line.length]
    given.max_velocity = [100 * line.length / line.least_time]
    given.max_acceleration = [line.limit / line.inertia]
    given.max_jerk = [line.rate / line.inertia]
    ruckig.Ruckig(1).calculate(given, found)
    return float(found.duration)


def compare_lines(count: int, seed: int) -> list[str]:
    """Rows on random lines."""
    rng, errors, forms, failed = np.random.default_rng(seed), [], [], 0
    for _ in range(count):
        line = Line.draw(rng)
        known = line.least_time
        peer = ask_ruckig(line)
        forms.append(abs(peer / known - 1))
        try:
            errors.append(line.plan() / (known if math.isnan(peer) else peer) - 1)
        except WholearmError:
            failed += 1
    size = np.abs(errors)
    name = "the closed form" if np.isnan(forms).all() else "Ruckig"
    return [
        f"{count} lines against {name}: {failed} without a plan; relative difference "
        f"median {np.median(size):.2g}, 95 % {np.quantile(size, 0.95):.2g}, most {size.max():.2g}; "
        f"{int((size <= 1e-5).sum())} within 1e-5.",
        f"Ruckig and the closed form differ by {np.max(forms):.2g} at most.",
    ]


def watch_growth(path: Path) -> list[str]:
    """Rows on a problem with rate limits that grow."""
    problem = load(str(path))
    solve(problem)
    started = time.process_time()
    plain = solve(problem).duration
    took = time.process_time() - started
    rows = ["", "| rate limit [N m/s] | duration [s] | over that without | CPU over that without |"]
    rows += ["|---:|---:|---:|---:|", f"| none | {plain:.5f} | 0 | 1 |"]
    for limit in GROWING:
        started = time.process_time()
        try:
            lasts = solve(problem.with_(torque_rate_limit=limit)).duration
            found = f"{lasts:.5f} | {lasts / plain - 1:+.3%}"
        except WholearmError as error:
            found = f"{error} | -"
        ratio = (time.process_time() - started) / took
        rows.append(f"| {limit:g} | {found} | {ratio:.1f} |")
    return rows


def main() -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problem", type=Path, help="problem file, all phases along curves")
    parser.add_argument("--cases", type=int, default=1000, help="random lines")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args()
    lines = ["# Torques with limited rates", "", stamp(), ""]
    lines += compare_lines(options.cases, options.seed)
    lines += watch_growth(options.problem)
    write_text(str(options.output / "bench_torque_rates.md"), "\n".join(lines) + "\n")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
