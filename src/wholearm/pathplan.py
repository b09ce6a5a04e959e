"""Planning a one-freedom phase: first guess, NLP, and limits that hold between nodes too.

The NLP of `wholearm.pathnlp` keeps the limits at its nodes. Once solved, the grid is drawn together
where they are missed most between nodes (where the plan switches from one limit to another). Then
limits are tightened by what they miss and the NLP is solved again from where it was, until nothing
misses more than `MISS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .cones import name_holds
from .curve import Curve, describe_pose
from .errors import InfeasibleError, SolverError
from .model import Array
from .options import Objective, PlanOptions
from .pathdata import PhaseData, fit_torque, prepare
from .pathmotion import PathMotion, Profile, draw_together, make_grid
from .pathnlp import (
    PathNLP,
    Scales,
    Tightening,
    build_path_nlp,
    first_multipliers,
    make_bounds,
    move_multipliers,
    pack,
    parameters,
    unpack,
)
from .phaseplan import PhasePlan

MISS = 5e-7
"""Largest miss of a force or torque limit between nodes [N or N m]; of b and T, relative."""
ROUNDS = 40
"""Most times that the NLP is solved for one phase."""
_COARSE = 1.5e-4
"""Miss, over the typical force, above which the grid is drawn together."""
_OVER = 1.05
"""How much more than the miss a limit is tightened."""


class _Solution(NamedTuple):
    profile: Profile
    margin: float
    multipliers: dict[str, Array]
    iterations: int
    seconds: float


def plan_path(
    curve: Curve,
    epsilon: float,
    options: PlanOptions,
    phase: int,
    duration: float | None = None,
) -> PhasePlan[PathMotion]:
    """Plan one phase along a curve, from rest to rest.

    Parameters
    ----------
    curve : Curve
    epsilon : float, [N]
        Least normal force.
    options : PlanOptions
    phase : int
        The phase's number, for messages.
    duration : float, optional, [s]
        Longest duration, for the objective `margin`.

    Raises
    ------
    InfeasibleError
        If no motion keeps the limits; names what is short, where and by how much.
    JammingError
        If friction jams the formation somewhere on the curve.
    SolverError
        If Ipopt stops without an answer.
    """
    formation = curve.formation
    nlp = build_path_nlp(formation.n_contacts, options.intervals, options.goal, formation.n_rolling)
    data = prepare(curve, epsilon, make_grid(curve, options.intervals), phase)
    profile, scales = guess(data)
    tightening = Tightening.none(data, duration)
    solution = _Solution(profile, 0.0, first_multipliers(nlp, data, profile, scales), 0, 0.0)
    for solves in range(1, ROUNDS + 1):
        solution = _solve(nlp, data, scales, tightening, solution, options.time_weight, phase)
        profile, margin = solution.profile, solution.margin
        motion = PathMotion(curve, data.grid, profile)
        short, speeding = data.misses(profile, margin)
        late = max(0.0, motion.duration / duration - 1) if duration else 0.0
        if max(short.max(), speeding.max(), late) <= MISS:
            break
        coarse = short.max(axis=1) / (_COARSE * scales.force)
        if solves == 1 and coarse.max() > 1:
            old = data.grid
            grid = draw_together(old, data.solid, coarse)
            data = prepare(curve, epsilon, grid, phase)
            solution = solution._replace(
                profile=Profile(*(np.interp(grid.s, old.s, part) for part in profile)),
                multipliers=move_multipliers(nlp, solution.multipliers, old, grid),
            )
        else:
            reach = data.beside(data.slack_beside(profile, margin, short))
            short, speeding = data.beside(short), data.beside(speeding)
            tightening = tightening.by(reach, _OVER * short, _OVER * speeding, _OVER * late)
    else:
        raise SolverError(
            f"phase {phase}: after {ROUNDS} solves limits are still missed by {short.max():.2g} N "
            "between nodes; plan with more intervals"
        )
    torque, squares = fit_torque(data, motion)
    value = {
        Objective.TIME: motion.duration,
        Objective.EFFORT: squares + options.time_weight * motion.duration,
        Objective.MARGIN: epsilon + margin,
    }[options.goal]
    return PhasePlan(
        motion, torque, value, solution.iterations, solves, nlp.build_time, solution.seconds
    )


def _solve(
    nlp: PathNLP,
    data: PhaseData,
    scales: Scales,
    tightening: Tightening,
    start: _Solution,
    time_weight: float,
    phase: int,
) -> _Solution:
    result = nlp.solver(
        x0=pack(nlp, start.profile, scales, start.margin),
        p=parameters(nlp, data, scales, time_weight),
        **make_bounds(nlp, data, scales, tightening),
        **start.multipliers,
    )
    stats = nlp.solver.stats()
    if not stats["success"]:
        raise explain(data, phase, stats["return_status"])
    profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], scales)
    multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
    iterations = start.iterations + stats["iter_count"]
    seconds = start.seconds + stats["t_wall_total"]
    return _Solution(profile, margin, multipliers, iterations, seconds)


def guess(data: PhaseData) -> tuple[Profile, Scales]:
    """Guess a motion: b a parabola in s as high as limits allow, the squeeze amid its range."""
    length, s = data.curve.length, data.grid.s
    shape, slope = 4 * s / length * (1 - s / length), 2 * (1 - 2 * s / length) / length

    b_max = data.largest_b(data.nodes)

    def squeeze_range(height: float) -> tuple[Array, Array]:
        profile = Profile(height * slope, height * shape, 0.0 * s)
        slack = data.slack(data.nodes, profile)
        forces = data.nodes.forces
        rate = np.hstack([forces.Cl, forces.Tl, -forces.Tl])
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = -slack / rate
        low = np.where(rate > 0, bound, -np.inf).max(axis=1)
        high = np.where(rate < 0, bound, np.inf).min(axis=1)
        return low, high

    def possible(height: float) -> bool:
        low, high = squeeze_range(height)
        return bool((low <= high).all() and (height * shape <= b_max).all())

    # Bisection over heights from 2^-12 to 2^8 times that of a fall over this length.
    low_power, high_power = -12.0, 8.0
    fall = 2 * data.curve.formation.scene.gravity * length + 1e-9
    for _ in range(7):
        power = (low_power + high_power) / 2
        if possible(fall * 2**power):
            low_power = power
        else:
            high_power = power
    height = 0.7 * fall * 2**low_power
    low, high = squeeze_range(height)
    middle = np.where(np.isfinite(low + high) & (low <= high), (low + high) / 2, 0.0)
    duration = np.pi / 2 * length / np.sqrt(height)
    force = max(1.0, data.epsilon, float(np.abs(middle).mean()))
    scales = Scales(length, 0.6 * duration, force)
    return Profile(height * slope, height * shape, middle), scales


def explain(data: PhaseData, phase: int, status: str) -> InfeasibleError | SolverError:
    """Say why a phase has no plan: re-solve with every limit soft and rank the shortfalls."""
    formation = data.curve.formation
    intervals, n_c = len(data.grid.s) - 1, formation.n_contacts
    nlp = build_path_nlp(n_c, intervals, Objective.ELASTIC, formation.n_rolling)
    profile, scales = guess(data)
    bounds = make_bounds(nlp, data, scales, Tightening.none(data, None))
    short = np.maximum(_shortfalls(data, profile), 0.0) + 0.1
    start = pack(nlp, profile, scales, 0.0, short)
    result = nlp.solver(x0=start, p=parameters(nlp, data, scales, 1.0), **bounds)
    if not nlp.solver.stats()["success"]:
        return SolverError(f"phase {phase}: Ipopt stopped with {status}")
    profile, _ = unpack(nlp, data.grid, result["x"].full()[:, 0], scales)
    short = _shortfalls(data, profile)
    if short.max() < 1e-4:
        return SolverError(
            f"phase {phase}: Ipopt stopped with {status} although limits can be kept"
        )
    names = name_holds(formation, data.epsilon)
    units = ["N"] * len(names) + ["N m"] * 2
    names += [f"torque limit of finger {i + 1} = {data.torque_limit[i]:g} N m" for i in range(2)]
    times = PathMotion(data.curve, data.grid, profile).times
    z = data.curve.evaluate(data.grid.s).z
    parts = []
    for row in np.argsort(-short.max(axis=0)):
        worst = int(short[:, row].argmax())
        if short[worst, row] > 1e-4:
            parts.append(
                f"{names[row]} is {short[worst, row]:.3g} {units[row]} short at "
                f"t = {times[worst]:.4f} s ({describe_pose(z[worst])})"
            )
    return InfeasibleError(f"phase {phase} is infeasible: {'; '.join(parts)}")


def _shortfalls(data: PhaseData, profile: Profile) -> Array:
    """By how much H c and tau miss their limits at the nodes, shape (n, n_h + 2) [N, N m]."""
    slack = data.slack(data.nodes, profile)
    held, torque = slack[:, :-4], np.minimum(slack[:, -4:-2], slack[:, -2:])
    return -np.hstack([held, torque])
