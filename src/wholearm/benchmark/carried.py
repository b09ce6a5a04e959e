"""How far torques by the clock carry an error on along one-freedom curves, linearised.

``python -m wholearm.benchmark.carried problems/*.toml [--output results]`` lists for each phase
along a curve by what factor a start that is off moves its end, the least factor found for any
motion with a tenth of the whole plan's time more where no contact is gained, and for each contact
that is gained in which time constant torques close it at least.

With torques by the clock s'' = f(s, s', t). A motion that is off by d obeys d'' = f_s d + f_s' d',
where f_s and f_s' follow from tau(s, s', s'', lambda) = tau(t): with a = s'' and b = s'^2,

    [Ta, Tl] (da, dlambda) = -(dT0/ds + dTa/ds a + dTb/ds b + dTl/ds lambda + dTv/ds s') d
                             - (2 Tb s' + Tv) d'.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array, Expression
from ..common.files import write_text
from ..contacts.formation import Formation
from ..geometry.curve import Curve
from ..mechanics.arrival import Standstill, find_opening, list_ways, maximise_margin
from ..mechanics.dynamics import PathForces, inverse
from ..mechanics.limits import SPEED, make_limits
from ..mechanics.wedging import find_static_torques
from ..planning.path_domain.motion import PathMotion, directions_of
from ..planning.plan import solve
from ..planning.settling import list_touching
from ..problem.definition import Problem
from ..problem.read import read_problem
from .report import stamp

LONGER = 0.1
"""How much more time a motion may take, over the whole plan's."""
GAP = 1e-4
"""By how much contacts are open that are to close [m]."""
COUNT = 4000
"""Steps in which errors are integrated, evenly spaced angles whose cosine is the time."""
INTERVALS = 120
"""Intervals of the search for the least factor, spaced in the same way along the curve."""
_STEP = 1e-6
"""Step of differences along a curve, over its length."""
_SLOWEST = 1e-6
"""Least s'^2 inside, over that of an even motion."""
HEAD = (
    "# Errors that torques by the clock carry on",
    "",
    stamp(),
    "",
    "`factor` is by what an error along the curve grows from a phase's start to its end, in x, or",
    "in phi where x hardly changes, linearised; `least` the least one found over all motions",
    "within limits with a tenth of the whole plan's time more, at ends where no contact is",
    "gained. `closes` is the least time in which constant torques that are in balance with all",
    "that touches at the end close a contact from rest that is open by 0.1 mm: what it reaches it",
    "then throws off again.",
    "",
    "| problem | phase | a tenth of the time [ms] | ends at | factor | least | closes [ms] |",
    "|---|---:|---:|---|---:|---:|---:|",
)


class Motion(NamedTuple):
    """A motion along a curve: s [m], a [m/s^2], b [m^2/s^2], squeeze [N] at n places."""

    s: Array
    a: Array
    b: Array
    squeeze: Array


class Slopes(NamedTuple):
    """Forces at n places of a curve, and their derivatives along it."""

    forces: PathForces
    rates: PathForces


def find_slopes(curve: Curve, s: Array, segment: NDArray[np.int64]) -> Slopes:
    """Forces and their derivatives by s, by central differences."""
    h = _STEP * curve.length
    s = np.clip(s, h, curve.length - h)
    directions = directions_of(curve, segment)
    parts = []
    for shift in (0.0, h, -h):
        point = curve.evaluate(s + shift)
        parts.append(inverse(curve.formation, *point[:3], directions, point.kinematics))
    here, ahead, back = parts
    both = zip(ahead, back, strict=True)
    return Slopes(here, PathForces(*((one - two) / (2 * h) for one, two in both)))


def measure_growth(motion: PathMotion) -> float:
    """By what factor an error along the curve grows from the phase's start to its end."""
    turns = motion.times[np.flatnonzero(np.diff(motion.grid.segment))]
    even = motion.duration * (1 - np.cos(np.linspace(0.0, np.pi, COUNT + 1))) / 2
    t = np.unique(np.concatenate([even, turns]))
    s, segment, (a, b, squeeze) = motion.locate((t[1:] + t[:-1]) / 2)
    stiff, drag = _find_response(find_slopes(motion.curve, s, segment), Motion(s, a, b, squeeze))
    off, rate = 1.0, 0.0
    for start, h, own, slow in zip(t[:-1], np.diff(t), stiff, drag, strict=True):
        if start in turns:
            rate += _find_kick(motion, float(start)) * off
        middle_rate = rate + h / 2 * (own * off + slow * rate)
        middle_off = off + h / 2 * rate
        off, rate = off + h * middle_rate, rate + h * (own * middle_off + slow * middle_rate)
    return off


def _find_response(slopes: Slopes, motion: Motion) -> tuple[Array, Array]:
    """f_s [1/s^2] and f_s' [1/s], shape (n,) each."""
    forces, rates = slopes
    speed = np.sqrt(np.maximum(motion.b, 0.0))[:, None]
    matrix = np.stack([forces.Ta, forces.Tl], axis=-1)
    along = rates.tau(motion.a, motion.b, motion.squeeze)
    sides = np.stack([along, 2 * forces.Tb * speed + forces.Tv], axis=-1)
    found = np.asarray(-np.linalg.solve(matrix, sides), dtype=float)
    return found[:, 0, 0], found[:, 0, 1]


def _find_kick(motion: PathMotion, t: float) -> float:
    """By how much d' steps, over d, where a direction reverses [1/s]: friction does so early."""
    tiny = 1e-9 * motion.duration
    s, segment, (a, b, squeeze) = motion.locate(np.array([t - tiny, t + tiny]))
    before = find_slopes(motion.curve, s[:1], segment[:1]).forces
    after = find_slopes(motion.curve, s[:1], segment[1:]).forces
    own = before.tau(a[:1], b[:1], squeeze[:1])
    rest = own - after.tau(0 * a[:1], b[:1], 0 * a[:1])
    matrix = np.stack([after.Ta, after.Tl], axis=-1)
    new = float(np.linalg.solve(matrix, rest[..., None])[0, 0, 0])
    return (new - float(a[0])) / math.sqrt(max(float(b[0]), 1e-300))


def find_least_growth(curve: Curve, epsilon: float, duration: float, shape: float) -> float:
    """The least factor found for any motion within limits, from rest to rest in a time at most.

    Parameters
    ----------
    curve : Curve
        Without reversals.
    epsilon : float, [N]
    duration : float, [s]
    shape : float
        Where the motion that the search begins with is fastest, from 0 to 1.

    Returns
    -------
    float
        NaN if the search ends without an answer.
    """
    x = (1 - np.cos(np.linspace(0.0, np.pi, INTERVALS + 1))) / 2
    s, unit = x * curve.length, (curve.length / duration) ** 2
    h, middle = np.diff(s) / curve.length, (s[1:] + s[:-1]) / 2
    slopes = find_slopes(curve, middle, np.zeros(INTERVALS, dtype=np.int64))
    b, squeeze = ca.SX.sym("b", INTERVALS - 1), ca.SX.sym("squeeze", INTERVALS)
    ends = ca.vertcat(0, b, 0)
    a, mean = (ends[1:] - ends[:-1]) / (2 * h), (ends[1:] + ends[:-1]) / 2
    speed = ca.sqrt(ends + _SLOWEST**2)
    steps = 2 * ca.DM(h) / (speed[1:] + speed[:-1])
    lengths, pace = curve.length / duration**2, curve.length / duration
    weight = curve.formation.scene.scales.force
    motion = a * lengths, mean * unit, squeeze * weight, ca.DM(h) / steps * pace
    rows, low, high = _write_limits(curve, epsilon, slopes.forces, motion)
    stiff, drag = _write_response(slopes, motion)
    off, rate = ca.SX(1), ca.SX(0)
    for k in range(INTERVALS):
        step = steps[k]
        push, hold = stiff[k] * duration**2, drag[k] * duration
        # Implicit midpoint rule of both.
        old, fast = off, rate
        rate = (fast * (1 + step / 2 * hold + step**2 / 4 * push) + step * push * old) / (
            1 - step / 2 * hold - step**2 / 4 * push
        )
        off = old + step / 2 * (fast + rate)
    nlp = {"x": ca.vertcat(b, squeeze), "f": off, "g": ca.vertcat(rows, ca.sum1(steps))}
    options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "max_iter": 500}}
    solver = ca.nlpsol("least_growth", "ipopt", nlp, {**options, "show_eval_warnings": False})
    guess = np.interp(x[1:-1], [0.0, shape, 1.0], [0.0, 4.0, 0.0])
    found = solver(
        x0=np.concatenate([guess, np.zeros(INTERVALS)]),
        lbx=np.concatenate([np.full(INTERVALS - 1, _SLOWEST), np.full(INTERVALS, -np.inf)]),
        lbg=np.append(low, 0.0),
        ubg=np.append(high, 1.0),
    )
    return float(found["f"]) if solver.stats()["success"] else math.nan


def _write_limits(
    curve: Curve, epsilon: float, forces: PathForces, motion: tuple[Expression, ...]
) -> tuple[Expression, Array, Array]:
    """Rows of forces and torques in the middles of intervals, over their scales, with bounds."""
    a, b, squeeze, speed = motion
    limits = make_limits(curve.formation, epsilon).without(SPEED)
    of_c, of_tau, _ = (part.T / limits.scales for part in limits.columns)
    constant = forces.C0 @ of_c + forces.T0 @ of_tau
    rows = ca.DM(constant)
    columns = (
        (forces.Ca @ of_c + forces.Ta @ of_tau, a),
        (forces.Cb @ of_c + forces.Tb @ of_tau, b),
        (forces.Cl @ of_c + forces.Tl @ of_tau, squeeze),
        (forces.Tv @ of_tau, speed),
    )
    for table, column in columns:
        rows = rows + ca.DM(table) * ca.repmat(column, 1, table.shape[1])
    low, high = (
        np.repeat(side / limits.scales, len(constant)) for side in (limits.low, limits.high)
    )
    return ca.vec(rows), low, high


def _write_response(
    slopes: Slopes, motion: tuple[Expression, ...]
) -> tuple[Expression, Expression]:
    """f_s and f_s' as expressions, shape (n,) each."""
    a, b, squeeze, speed = motion
    forces, rates = slopes
    first = np.linalg.inv(np.stack([forces.Ta, forces.Tl], axis=-1))[:, 0, :]

    def project(table: Array) -> Expression:
        return ca.DM(np.einsum("ni,ni->n", first, table))

    stiff = project(rates.T0) + project(rates.Ta) * a + project(rates.Tb) * b
    stiff += project(rates.Tl) * squeeze + project(rates.Tv) * speed
    return -stiff, -(2 * project(forces.Tb) * speed + project(forces.Tv))


def find_least_closing(place: Standstill, epsilon: float, gap: float) -> float:
    """The least time in which constant torques close a contact that is open by `gap` [s].

    From rest, in the formation that has to gain it, with torques in balance with all that touches
    once it is closed. Infinite where none do; NaN where no contact is gained.
    """
    opening = find_opening(place)
    if opening is None or place.gained is None:
        return math.nan
    scene, z = place.formation.scene, place.z + gap * opening
    normal = Formation(scene, (place.gained,)).evaluate(z[None], np.zeros((1, 5))).A[0][0]
    static = find_static_torques([place.touching], place.z, epsilon)
    balance = np.column_stack([static.bounds, -static.normals]) / scene.scales.torque
    unit, swiftest = scene.scales.acceleration, 0.0
    for way in list_ways(place.formation, z):
        if way.heading is None or normal @ way.heading < 0:
            closing = -normal @ way.acceleration / unit
            found = maximise_margin(scene, closing[None], np.vstack([balance, way.consistent]))
            swiftest = max(swiftest, found[1] if found else 0.0)
    return math.sqrt(2 * gap / (swiftest * unit)) if swiftest else math.inf


def list_rows(problem: Problem) -> list[str]:
    """The rows of a problem in the table, one for each phase."""
    plan = solve(problem)
    rows, extra = [], LONGER * plan.duration
    for phase, motion in zip(problem.phases, plan.trajectory.motions, strict=True):
        factor = least = math.nan
        if isinstance(motion, PathMotion):
            curve = motion.curve
            ratio = _find_ratio(curve)
            factor = ratio * measure_growth(motion)
            if phase.until.value is not None and len(curve.segments) == 1:
                time = motion.duration + extra
                found = [
                    find_least_growth(curve, problem.epsilon, time, at) for at in (0.3, 0.5, 0.7)
                ]
                least = ratio * float(np.nanmin(found)) if np.isfinite(found).any() else math.nan
        z = motion.evaluate(np.array([motion.duration])).z[0]
        place = Standstill(z, phase.formation, phase.until.contact, list_touching(problem, phase))
        closes = 1e3 * find_least_closing(place, problem.epsilon, GAP)
        cells = [f"{value:.3g}" if value == value else "-" for value in (factor, least, closes)]
        cells = [problem.name, str(phase.number), f"{1e3 * extra:.3g}", str(phase.until), *cells]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def _find_ratio(curve: Curve) -> float:
    """Factor between errors of s and those of x, or of phi where x hardly changes."""
    rates = curve.evaluate(np.array([0.0, curve.length])).z_s[:, [0, 2]]
    rates[:, 1] *= curve.formation.scene.scales.length
    which = 0 if np.abs(rates[:, 0]).min() > 0.1 * np.abs(rates[:, 1]).min() else 1
    return float(rates[1, which] / rates[0, which])


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the table and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("problems", nargs="+", type=Path, help="problem files")
    parser.add_argument("--output", type=Path, default=Path("results"))
    options = parser.parse_args(arguments)
    lines = [*HEAD]
    for path in options.problems:
        for row in list_rows(read_problem(str(path))):
            lines.append(row)
            print(row, flush=True)
    write_text(str(options.output / "bench_carried.md"), "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    main()
