"""Plans made in the time domain, each of them once."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from plane import accelerate
from wholearm.model import Array
from wholearm.options import PlanOptions
from wholearm.outline import load
from wholearm.path import trace_phases
from wholearm.phaseplan import PhasePlan
from wholearm.plan import solve
from wholearm.problem import Problem
from wholearm.timemotion import StageMotion, TimeMotion
from wholearm.timeplan import plan_phases
from wholearm.trajectory import Trajectory

HEPTAGON = Path(__file__).parents[1] / "problems" / "heptagon.toml"


@lru_cache(maxsize=1)
def landing() -> Problem:
    """A slide, a flip and a landing; its last two phases are joined smoothly."""
    return load(str(HEPTAGON))


def plan_landing(**options: Any) -> list[PhasePlan[TimeMotion]]:
    """Plan the flip's last formation and the landing, from rest to rest."""
    problem, duration = landing(), options.pop("duration", None)
    start = trace_phases(problem)[-1].end
    return plan_phases(problem, problem.phases[4:], start, PlanOptions(**options), duration)


@lru_cache(maxsize=16)
def fastest(path: Path) -> Trajectory:
    """The plan of a problem file for least time, with every other option at its default."""
    return solve(load(str(path)))


def fastest_landing() -> list[TimeMotion]:
    """The motions of the same two phases for least time."""
    motions = fastest(HEPTAGON).motions[4:]
    return [motion for motion in motions if isinstance(motion, TimeMotion)]


def instants(stage: StageMotion, per_interval: int) -> Array:
    """Times inside the intervals of a stage, shape (n,) [s]: none where its torque may step."""
    inside = (np.arange(per_interval) + 0.5) / per_interval
    places = np.arange(stage.intervals)[:, None] + inside
    return np.asarray(places.ravel() * stage.duration / stage.intervals)


def integrate(stage: StageMotion, z: Array, v: Array) -> tuple[Array, Array]:
    """Where the torques of a stage carry z and z', by plain Newton and Euler."""
    formation, (Xi, sigma) = stage.formation, stage.directions
    breaks = stage.torque.breaks

    def rate(t: float, state: Array) -> Array:
        # Just inside the piece, so that the later torque never answers at its end.
        tau = stage.torque.at(np.array([min(t, stop * (1 - 1e-14))]))[0]
        return np.append(state[5:], accelerate(formation, state[:5], state[5:], tau, Xi, sigma)[0])

    state = np.append(z, v)
    for start, stop in pairwise(breaks):
        run = solve_ivp(rate, (start, stop), state, method="DOP853", rtol=1e-9, atol=1e-11)
        assert run.success
        state = run.y[:, -1]
    return state[:5], state[5:]
