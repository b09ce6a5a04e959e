"""Replay plans and torques for one problem, and put side by side what they do."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.arrays import Array
from ..common.errors import InputError, JammingError, SimulationError, name_source
from ..common.files import require_ending
from ..problem.check import require_phases
from ..problem.definition import Problem
from ..problem.read import adopt_phases
from ..results.report import Report
from ..results.torque import TorqueProfile, read_notes, read_torque_csv
from ..results.trajectory import Trajectory
from ..results.trajectory_file import load_trajectory
from ..verification.verdict import find_least_force
from ..verification.verify import verify
from .side_by_side import Comparison, Contender

SIMULATIONS = "simulations"
"""Key of a comment of torques, and of the `meta` of a trajectory, with how many it took."""
_FREE = ("name", "epsilon", "settle_gap", "uncertainty")
"""Keys of a problem in which trajectories may differ from it; so may `settle`, of a phase too."""


def compare(
    problem: Problem, paths: Sequence[str], progress: Callable[[str], None] | None = None
) -> Comparison:
    """Replay trajectory files (.npz) and torques (.csv) for a problem, and compare them.

    Parameters
    ----------
    problem : Problem
    paths : sequence of str
    progress : callable
        Told which of them is replayed.

    Raises
    ------
    InputError
        If a file cannot be read, or a trajectory is one of another problem; names the file.
    """
    short = [os.path.basename(path) for path in paths]
    names = short if len({*short}) == len(short) else paths
    contenders = []
    for name, path in zip(names, paths, strict=True):
        if progress is not None:
            progress(f"replaying {name}")
        own, what, simulations = _read(problem, str(path))
        planned = what if isinstance(what, Trajectory) else None
        judged = _judge(name, own, what, simulations)
        contenders.append(replace(judged, problem=own, planned=planned))
    return Comparison(problem.name, problem.epsilon, tuple(contenders))


def _read(problem: Problem, path: str) -> tuple[Problem, Trajectory | TorqueProfile, int | None]:
    """Torques or a trajectory that fits the problem, and how many simulations it took.

    Goals of the problem give way to the phases that a trajectory has found.
    """
    if require_ending(path, ".npz", ".csv") == ".csv":
        noted = read_notes(path).get(SIMULATIONS)
        if noted is not None and not noted.isdecimal():
            raise InputError(path, SIMULATIONS, f"{noted!r} given; a whole number is needed")
        require_phases(problem)
        return problem, read_torque_csv(path), None if noted is None else int(noted)
    trajectory = load_trajectory(path)
    problem = adopt_phases(problem, trajectory.meta, trajectory.q[-1], path)
    with name_source(path):
        _require_fit(problem, trajectory)
    replay = trajectory.meta.get("replay")
    known = (replay or {}).get(SIMULATIONS, trajectory.meta.get(SIMULATIONS))
    return problem, trajectory, known if isinstance(known, int) else None


def _require_fit(problem: Problem, trajectory: Trajectory) -> None:
    """Check that a trajectory is one of this problem."""
    own = trajectory.meta.get("problem")
    if not isinstance(own, Mapping):
        raise InputError("", "meta.problem", "the trajectory does not hold its problem's tables")
    found = _find_difference(own, problem.table, "")
    if found is not None:
        key, one, other = found
        text = f"{one} in the trajectory, {other} in the problem; it is one of another problem"
        raise InputError("", key, text)


def _find_difference(own: Any, other: Any, key: str) -> tuple[str, str, str] | None:
    """The first key in which two tables differ, and both of its values."""
    if isinstance(own, Mapping) and isinstance(other, Mapping):
        for name in dict.fromkeys([*own, *other]):
            if name != "settle" and (key or name not in _FREE):
                inner = f"{key}.{name}" if key else str(name)
                found = _find_difference(own.get(name), other.get(name), inner)
                if found is not None:
                    return found
        return None
    if isinstance(own, list | tuple) and isinstance(other, list | tuple):
        if len(own) != len(other):
            return key, f"{len(own)} entries", f"{len(other)}"
        pairs = enumerate(zip(own, other, strict=True), start=1)
        every = (_find_difference(*pair, f"{key}[{k}]") for k, pair in pairs)
        return next((found for found in every if found is not None), None)
    if own == other:
        return None
    one, two = ("nothing" if value is None else repr(value) for value in (own, other))
    return key, one, two


def _judge(
    name: str, problem: Problem, what: Trajectory | TorqueProfile, simulations: int | None
) -> Contender:
    """What one of them does."""
    torque = what if isinstance(what, TorqueProfile) else what.torque
    limits = np.abs(_find_peaks(torque))
    peaks = (float(limits[0]), float(limits[1]))
    effort = torque.integrate_squares()
    try:
        report = verify(problem, what)
    except (JammingError, SimulationError) as error:
        return Contender(name, False, str(error), torque.duration, effort, peaks, simulations)
    return _collect(name, report, torque, effort, peaks, simulations)


def _collect(
    name: str,
    report: Report,
    torque: TorqueProfile,
    effort: float,
    peaks: tuple[float, float],
    simulations: int | None,
) -> Contender:
    found = [(find_least_force(phase), phase) for phase in report.phases]
    known = [(least, phase.number) for least, phase in found if least is not None]
    least = min(known, key=lambda pair: pair[0].least, default=None)
    energy = report.energy
    lasts = [
        math.nan if phase.arrival is None else phase.arrival - phase.start
        for phase in report.phases
    ]
    end = report.phases[-1].arrival if report.reached else None
    return Contender(
        name,
        report.ok,
        report.reason,
        torque.duration if end is None else end,
        effort,
        peaks,
        simulations,
        None if least is None else least[0].margin,
        "" if least is None else least[0].contact,
        0 if least is None else least[1],
        energy.viscous + energy.dry + energy.contact + energy.impact,
        tuple(lasts),
        tuple(math.nan if own is None else own.margin for own, _ in found),
        report,
    )


def _find_peaks(torque: TorqueProfile) -> Array:
    """Largest torque of each joint, shape (2,) [N m]."""
    powers = np.linspace(-1, 1, 17)[:, None] ** np.arange(torque.coefficients.shape[2])
    return np.asarray(np.abs(torque.coefficients @ powers.T).max(axis=(0, 2)))
