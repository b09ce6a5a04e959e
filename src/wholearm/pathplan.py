"""Planning one-freedom phases: first guess, NLP, and limits that hold between nodes too.

The NLP of `wholearm.pathnlp` keeps the limits at its nodes. Once solved, the grid is drawn together
where they are missed most between nodes (where the plan switches from one limit to another). Then
limits are tightened by what they miss and the NLP is solved again from where it was, until nothing
misses more than `MISS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from .cones import name_holds
from .curve import Curve, describe_pose
from .errors import InfeasibleError, SolverError
from .model import Array
from .options import Objective, PlanOptions
from .pathdata import PhaseData, cut, fit_torque, join, prepare
from .pathmotion import Grid, PathMotion, Profile, draw_together, make_grid
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


class _StoppedError(Exception):
    """Ipopt has stopped without an answer."""


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
    """Plan one phase along a curve, from rest to rest; see `plan_curves`."""
    return plan_curves((curve,), epsilon, options, (phase,), duration)[0]


def plan_curves(
    curves: Sequence[Curve],
    epsilon: float,
    options: PlanOptions,
    phases: Sequence[int],
    duration: float | None = None,
) -> list[PhasePlan[PathMotion]]:
    """Plan phases along curves that are run through one after the other, from rest to rest.

    Parameters
    ----------
    curves : sequence of Curve
        At such paces that the speed is the same on both sides of where two of them meet.
    epsilon : float, [N]
        Least normal force.
    options : PlanOptions
    phases : sequence of int
        The phases' numbers, for messages.
    duration : float, optional, [s]
        Longest duration of all, for the objective `margin`.

    Raises
    ------
    InfeasibleError
        If no motion keeps the limits; names what is short, where and by how much.
    JammingError
        If friction jams a formation somewhere on its curve.
    SolverError
        If Ipopt stops without an answer.
    """

    def prepare_all(grids: Iterable[Grid]) -> list[PhaseData]:
        given = zip(curves, grids, phases, strict=True)
        return [prepare(curve, epsilon, grid, phase) for curve, grid, phase in given]

    parts = prepare_all(make_grid(curve, options.intervals) for curve in curves)
    data = join(parts)
    first, intervals = curves[0].formation, len(data.grid.steps)
    nlp = build_path_nlp(first.n_contacts, intervals, options.goal, first.n_rolling)
    profile, scales = guess(data)
    tightening = Tightening.none(data, duration)
    solution = _Solution(profile, 0.0, first_multipliers(nlp, data, profile, scales), 0, 0.0)
    for solves in range(1, ROUNDS + 1):
        try:
            solution = _solve(nlp, data, scales, tightening, solution, options.time_weight)
        except _StoppedError as stop:
            raise explain(parts, phases, str(stop)) from None
        profile, margin = solution.profile, solution.margin
        motions = [
            PathMotion(part.curve, part.grid, own)
            for part, own in zip(parts, cut(parts, profile), strict=True)
        ]
        short, speeding = data.misses(profile, margin)
        total = sum(motion.duration for motion in motions)
        late = max(0.0, total / duration - 1) if duration else 0.0
        if max(short.max(), speeding.max(), late) <= MISS:
            break
        coarse = short.max(axis=1) / (_COARSE * scales.force)
        if solves == 1 and coarse.max() > 1:
            old = data.grid
            shares = np.split(coarse, np.cumsum([len(part.solid) for part in parts])[:-1])
            parts = prepare_all(
                draw_together(part.grid, part.solid, share)
                for part, share in zip(parts, shares, strict=True)
            )
            data = join(parts)
            solution = solution._replace(
                profile=Profile(*(np.interp(data.grid.s, old.s, part) for part in profile)),
                multipliers=move_multipliers(nlp, solution.multipliers, old, data.grid),
            )
        else:
            reach = data.beside(data.slack_beside(profile, margin, short))
            short, speeding = data.beside(short), data.beside(speeding)
            tightening = tightening.by(reach, _OVER * short, _OVER * speeding, _OVER * late)
    else:
        raise SolverError(
            f"{_name(phases)}: after {ROUNDS} solves limits are still missed by "
            f"{short.max():.2g} N between nodes; plan with more intervals"
        )
    plans: list[PhasePlan[PathMotion]] = []
    for part, motion in zip(parts, motions, strict=True):
        torque, squares = fit_torque(part, motion)
        value = {
            Objective.TIME: motion.duration,
            Objective.EFFORT: squares + options.time_weight * motion.duration,
            Objective.MARGIN: epsilon + margin,
        }[options.goal]
        costs = (0, 0, 0.0, 0.0)
        if not plans:
            costs = (solution.iterations, solves, nlp.build_time, solution.seconds)
        plans.append(PhasePlan(motion, torque, value, *costs))
    return plans


def _solve(
    nlp: PathNLP,
    data: PhaseData,
    scales: Scales,
    tightening: Tightening,
    start: _Solution,
    time_weight: float,
) -> _Solution:
    result = nlp.solver(
        x0=pack(nlp, start.profile, scales, start.margin),
        p=parameters(nlp, data, scales, time_weight),
        **make_bounds(nlp, data, scales, tightening),
        **start.multipliers,
    )
    stats = nlp.solver.stats()
    if not stats["success"]:
        raise _StoppedError(stats["return_status"])
    profile, margin = unpack(nlp, data.grid, result["x"].full()[:, 0], scales)
    multipliers = {f"{key}0": result[key].full()[:, 0] for key in ("lam_x", "lam_g")}
    iterations = start.iterations + stats["iter_count"]
    seconds = start.seconds + stats["t_wall_total"]
    return _Solution(profile, margin, multipliers, iterations, seconds)


def guess(data: PhaseData) -> tuple[Profile, Scales]:
    """Guess a motion: b a parabola in s as high as limits allow, the squeeze amid its range."""
    length, s = float(data.grid.s[-1]), data.grid.s
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


def explain(
    parts: Sequence[PhaseData], phases: Sequence[int], status: str
) -> InfeasibleError | SolverError:
    """Say why phases have no plan: re-solve with every limit soft and rank the shortfalls."""
    data, where = join(parts), _name(phases)
    first, intervals = data.curve.formation, len(data.grid.steps)
    nlp = build_path_nlp(first.n_contacts, intervals, Objective.ELASTIC, first.n_rolling)
    profile, scales = guess(data)
    bounds = make_bounds(nlp, data, scales, Tightening.none(data, None))
    short = np.maximum(_shortfalls(data, profile), 0.0) + 0.1
    start = pack(nlp, profile, scales, 0.0, short)
    result = nlp.solver(x0=start, p=parameters(nlp, data, scales, 1.0), **bounds)
    if not nlp.solver.stats()["success"]:
        return SolverError(f"{where}: Ipopt stopped with {status}")
    profile, _ = unpack(nlp, data.grid, result["x"].full()[:, 0], scales)
    if _shortfalls(data, profile).max() < 1e-4:
        return SolverError(f"{where}: Ipopt stopped with {status} although limits can be kept")
    texts: list[tuple[float, str]] = []
    for part, own, phase in zip(parts, cut(parts, profile), phases, strict=True):
        suffix = f", phase {phase}" if len(phases) > 1 else ""
        texts += [(short, text + suffix) for short, text in _describe_shortfalls(part, own)]
    texts.sort(key=lambda pair: -pair[0])
    verb = "is" if len(phases) == 1 else "are"
    return InfeasibleError(f"{where} {verb} infeasible: {'; '.join(text for _, text in texts)}")


def _describe_shortfalls(data: PhaseData, profile: Profile) -> list[tuple[float, str]]:
    """What is short on one phase, by how much [N, N m] and in words, the worst first."""
    short, formation = _shortfalls(data, profile), data.curve.formation
    names = name_holds(formation, data.epsilon)
    units = ["N"] * len(names) + ["N m"] * 2
    names += [f"torque limit of finger {i + 1} = {data.torque_limit[i]:g} N m" for i in range(2)]
    times = PathMotion(data.curve, data.grid, profile).times
    z = data.curve.evaluate(data.grid.s).z
    texts = []
    for row in np.argsort(-short.max(axis=0)):
        worst = int(short[:, row].argmax())
        if short[worst, row] > 1e-4:
            text = (
                f"{names[row]} is {short[worst, row]:.3g} {units[row]} short at "
                f"t = {times[worst]:.4f} s ({describe_pose(z[worst])})"
            )
            texts.append((float(short[worst, row]), text))
    return texts


def _name(phases: Sequence[int]) -> str:
    """One phase or several, for messages."""
    return f"phase {phases[0]}" if len(phases) == 1 else f"phases {phases[0]} to {phases[-1]}"


def _shortfalls(data: PhaseData, profile: Profile) -> Array:
    """By how much H c and tau miss their limits at the nodes, shape (n, n_h + 2) [N, N m]."""
    slack = data.slack(data.nodes, profile)
    held, torque = slack[:, :-4], np.minimum(slack[:, -4:-2], slack[:, -2:])
    return -np.hstack([held, torque])
