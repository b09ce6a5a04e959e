"""Plans made in the time domain, each of them once, and stages of motions that are known."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from once import once
from plane import accelerate
from shipped import LANDING, part_of, plan_of, problem_of
from wholearm import Formation, PlanOptions, Problem
from wholearm.common.arrays import Array
from wholearm.geometry.tracing import trace_phases
from wholearm.mechanics.dynamics import Directions
from wholearm.planning.phase_plan import PhasePlan
from wholearm.planning.time_domain.stage import Scheme, StagePoints
from wholearm.planning.time_domain.time_motion import StageMotion, TimeMotion
from wholearm.planning.time_domain.time_plan import plan_phases


def landing() -> Problem:
    """A slide, a flip and a landing; its last two phases are joined smoothly."""
    return problem_of(LANDING)


@lru_cache(maxsize=1)
def flip() -> Problem:
    """Phase 4 of the slide and the flip alone, in which nothing reverses."""
    return part_of(landing(), 3, 4)


@once
def plan_landing(**options: Any) -> list[PhasePlan[TimeMotion]]:
    """Plan the flip's last formation and the landing, from rest to rest."""
    problem, duration = landing(), options.pop("duration", None)
    start = trace_phases(problem)[-1].end
    return plan_phases(problem, problem.phases[4:], start, PlanOptions(**options), duration)


def fastest_landing() -> list[TimeMotion]:
    """The motions of the same two phases for least time."""
    motions = plan_of(LANDING).motions[4:]
    return [motion for motion in motions if isinstance(motion, TimeMotion)]


def total(plans: list[PhasePlan[TimeMotion]]) -> float:
    """Duration of all phases [s]."""
    return sum(plan.motion.duration for plan in plans)


def stages_of(plans: list[PhasePlan[TimeMotion]]) -> list[StageMotion]:
    return [stage for plan in plans for stage in plan.motion.stages]


def instants(stage: StageMotion, per_interval: int) -> Array:
    """Times inside the intervals of a stage, shape (n,) [s]: none where its torque may step."""
    inside = (np.arange(per_interval) + 0.5) / per_interval
    return np.asarray(stage.duration * stage.points.places(inside).ravel())


def integrate(stage: StageMotion, z: Array, v: Array) -> tuple[Array, Array]:
    """Where the torques of a stage carry z and z', by plain Newton and Euler."""
    formation, (Xi, sigma) = stage.formation, stage.directions

    def rate(t: float, state: Array, stop: float) -> Array:
        # Just inside the piece, so that the later torque never answers at its end.
        tau = stage.torque.at(np.array([min(t, stop * (1 - 1e-14))]))[0]
        return np.append(state[5:], accelerate(formation, state[:5], state[5:], tau, Xi, sigma)[0])

    state = np.append(z, v)
    for start, stop in pairwise(stage.torque.breaks):
        run = solve_ivp(
            rate, (start, stop), state, method="DOP853", rtol=1e-9, atol=1e-11, args=(stop,)
        )
        assert run.success
        state = run.y[:, -1]
    return state[:5], state[5:]


Sampler = Callable[[Scheme, int], StagePoints]


def drive(
    formation: Formation, z: Array, tau: Array, signs: Directions, duration: float
) -> Sampler:
    """Motion from rest at `z` under a torque that is linear in time, by plain Newton and Euler.

    `tau` has the torques at the start and at the end in its rows [N m].
    """

    def torque(t: float) -> Array:
        return np.asarray(tau[0] + (tau[1] - tau[0]) * t / duration)

    def move(t: float, state: Array) -> tuple[Array, Array]:
        return accelerate(formation, state[:5], state[5:], torque(t), *signs)

    run = solve_ivp(
        lambda t, state: np.append(state[5:], move(t, state)[0]),
        (0.0, duration),
        np.append(z, np.zeros(5)),
        method="DOP853",
        rtol=1e-12,
        atol=1e-14,
        max_step=duration / 40,
        dense_output=True,
    )
    assert run.success

    def sample(scheme: Scheme, count: int) -> StagePoints:
        breaks = duration * np.arange(count + 1) / count
        t = (breaks[:-1, None] + duration / count * scheme.points).ravel()
        states = run.sol(t).T
        answers = [move(*pair) for pair in zip(t, states, strict=True)]
        shape = (count, scheme.degree, -1)
        ends = np.array([[torque(t) for t in pair] for pair in pairwise(breaks)])
        return StagePoints(
            np.full(count, duration / count),
            run.sol(breaks).T.reshape(-1, 2, 5),
            states[:, :5].reshape(shape),
            states[:, 5:].reshape(shape),
            np.array([a for a, _ in answers]).reshape(shape),
            np.array([c for _, c in answers]).reshape(shape),
            ends,
            np.zeros(0),
        )

    return sample
