"""Torques for tests: inverse dynamics along the curves, from rest to rest, without a planner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from wholearm.curve import Curve
from wholearm.dynamics import Directions, inverse
from wholearm.model import Array
from wholearm.outline import load
from wholearm.path import trace_phases
from wholearm.problem import Problem
from wholearm.torque import TorqueProfile
from wholearm.trajectory import Samples, Trajectory, assemble

HEPTAGON = Path(__file__).parents[1] / "problems" / "heptagon_four_contacts.toml"
SQUEEZES = np.geomspace(0.02, 40.0, 60)


@dataclass(frozen=True, eq=False)
class CosineMotion:
    """A phase run through as s = L/2 (1 - cos(pi t / T)).

    The squeeze is constant, or falls by `fade` times itself from start to end.
    """

    curve: Curve
    duration: float
    squeeze: float
    fade: float = 0.0

    @property
    def contacts(self) -> tuple[str, ...]:
        return self.curve.formation.names

    @property
    def turns(self) -> Array:
        """Times at which a contact or a joint reverses, shape (k,), with both ends."""
        places = [segment.start for segment in self.curve.segments]
        inner = np.arccos(1 - 2 * np.array(places[1:]) / self.curve.length) * self.duration / np.pi
        return np.array([0.0, *inner, self.duration])

    def evaluate(self, t: Array) -> Samples:
        length, rate = self.curve.length, np.pi / self.duration
        t = np.clip(t, 0.0, self.duration)
        s = length / 2 * (1 - np.cos(rate * t))
        v = length / 2 * rate * np.sin(rate * t)
        a = length / 2 * rate**2 * np.cos(rate * t)
        point = self.curve.evaluate(s)
        owner = np.clip(np.searchsorted(self.turns, t, side="right") - 1, 0, len(self.turns) - 2)
        tau, c_n = np.empty((len(t), 2)), np.empty((len(t), 4))
        Xi = np.empty((len(t), 4))
        for k, segment in enumerate(self.curve.segments):
            mine = owner == k
            if not mine.any():
                continue
            directions = Directions(segment.Xi, segment.sigma)
            forces = inverse(
                self.curve.formation, point.z[mine], point.z_s[mine], point.z_ss[mine], directions
            )
            squeeze = self.squeeze * (1 - self.fade * t[mine] / self.duration)
            c_n[mine] = forces.c_n(a[mine], v[mine] ** 2, squeeze)
            tau[mine] = forces.tau(a[mine], v[mine] ** 2, squeeze)
            Xi[mine] = segment.Xi
        z_dot = point.z_s * v[:, None]
        z_ddot = point.z_s * a[:, None] + point.z_ss * (v**2)[:, None]
        return Samples(point.z, z_dot, z_ddot, tau, c_n, -self.curve.formation.friction * Xi * c_n)

    def fit(self, pieces: int, degree: int) -> TorqueProfile:
        """The torques as polynomials, broken where a sliding direction reverses."""
        turns = self.turns
        counts = np.maximum(1, np.ceil(pieces * np.diff(turns) / self.duration)).astype(int)
        grids = [
            np.linspace(*ends, n + 1)[:-1] for ends, n in zip(pairwise(turns), counts, strict=True)
        ]
        breaks = np.append(np.concatenate(grids), self.duration)
        return TorqueProfile.fit(breaks, lambda t: self.evaluate(t).tau, degree)


def choose_squeeze(curve: Curve, duration: float, least: float, limit: float) -> float:
    """Constant squeeze with every c_n above `least`, as far as possible from the torque limit."""
    t = np.linspace(0.0, duration, 101)
    for squeeze in SQUEEZES:
        samples = CosineMotion(curve, duration, float(squeeze)).evaluate(t)
        if samples.c_n.min() > least:
            if np.abs(samples.tau).max() > limit:
                break
            return float(squeeze)
    raise ValueError(f"no constant squeeze carries the phase in {duration} s")


@lru_cache(maxsize=4)
def plan(
    duration: float = 0.4, least: float = 0.2, pieces: int = 60, degree: int = 7
) -> tuple[Problem, Trajectory]:
    """The heptagon's problem and a trajectory that carries it through, `duration` a phase."""
    problem = load(str(HEPTAGON))
    motions = [
        CosineMotion(curve, duration, choose_squeeze(curve, duration, least, 2.0))
        for curve in trace_phases(problem)
    ]
    torque = join([motion.fit(pieces, degree) for motion in motions])
    return problem, assemble(motions, torque, {"epsilon": problem.epsilon}, 201)


def join(profiles: list[TorqueProfile]) -> TorqueProfile:
    """One profile after the other."""
    breaks, start = [np.zeros(1)], 0.0
    for profile in profiles:
        breaks.append(start + profile.breaks[1:])
        start = float(breaks[-1][-1])
    return TorqueProfile(
        np.concatenate(breaks), np.concatenate([profile.coefficients for profile in profiles])
    )


def change(profile: TorqueProfile, edit: Callable[[Array, Array], Array]) -> TorqueProfile:
    """The profile with coefficients edit(piece starts, coefficients)."""
    return TorqueProfile(profile.breaks, edit(profile.breaks[:-1], profile.coefficients.copy()))
