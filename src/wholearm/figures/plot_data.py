"""Samples of a plan for figures: snapshots, steps of forces, torques, friction-cone shares."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..common.arrays import Array
from ..results.torque import TorqueProfile
from ..results.trajectory import Trajectory


def choose_snapshots(trajectory: Trajectory) -> NDArray[np.int64]:
    """Rows of the trajectory to draw: phase boundaries, and instants between if they are few."""
    starts = trajectory.phase_starts
    parts = np.ones(len(starts) - 1, dtype=int)
    while parts.sum() + 1 < 6:
        parts[np.argmax(np.diff(starts) / parts)] += 1
    rows = [0, len(trajectory.t) - 1]
    for k, (start, end) in enumerate(pairwise(starts)):
        own = np.flatnonzero(trajectory.phase == k)
        for t in np.linspace(start, end, parts[k] + 1)[:-1]:
            rows.append(own[np.abs(trajectory.t[own] - t).argmin()])
    return np.unique(rows)


STEP = 0.1
"""Step of the torques, over the largest, from which on lines are broken: less cannot be seen."""


def find_steps(trajectory: Trajectory) -> NDArray[np.int64]:
    """Rows before which forces step: a new phase, a torque's step, a reversed sliding direction."""
    profile = trajectory.torque
    before = profile.coefficients[:-1].sum(axis=2)
    signs = (-1.0) ** np.arange(profile.coefficients.shape[2])
    after = (profile.coefficients[1:] * signs).sum(axis=2)
    stepping = np.abs(after - before).max(axis=1) > STEP * np.abs(profile.coefficients).max()
    breaks, starts = profile.breaks[1:-1], trajectory.phase_starts
    inner = np.abs(breaks[:, None] - starts).min(axis=1) > 1e-9 * trajectory.duration
    t = trajectory.t
    # Where a time is there twice, in a replay, the step is between the two rows.
    repeated = np.flatnonzero(np.diff(t) == 0) + 1
    steps = np.searchsorted(t, np.setdiff1d(breaks[stepping & inner], t[repeated]), side="right")
    phases = np.append(np.flatnonzero(np.diff(trajectory.phase)) + 1, repeated)
    # The friction of a contact that rolls passes zero without a step.
    slid = np.where(trajectory.rolling, 0.0, trajectory.c_t)
    turns = np.flatnonzero((slid[1:] * slid[:-1] < 0).any(axis=1)) + 1
    every = np.unique(np.concatenate([steps, phases, turns]))
    # Torques may go on after a motion that has failed.
    return every[every < len(t)]


def sample_torques(torque: TorqueProfile) -> tuple[Array, Array]:
    """Times, shape (n,) [s], and torques, (n, 2) [N m], with both ends of every piece."""
    pieces, _, order = torque.coefficients.shape
    count = 2 if order <= 2 else max(order, math.ceil(2000 / pieces))
    x = np.linspace(-1.0, 1.0, count)
    middle, half = (torque.breaks[1:] + torque.breaks[:-1]) / 2, np.diff(torque.breaks) / 2
    coefficients = np.ascontiguousarray(torque.coefficients)  # einsum's rounding depends on it
    tau = np.einsum("kjd,xd->kxj", coefficients, np.vander(x, order, increasing=True))
    return (middle[:, None] + half[:, None] * x).ravel(), tau.reshape(-1, 2)


def cone_shares(rolling: NDArray[np.bool_], friction: Array, c_n: Array, c_t: Array) -> Array:
    """How much of its friction cone each rolling contact uses, c_t / (mu c_n), shape (n, m).

    NaN where a contact does not roll. `friction` has shape (m,), everything else (n, m).
    """
    return np.asarray(c_t / np.where(rolling, friction * c_n, np.nan))
