"""A study of samples: run, kept as they come, and counted."""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from threading import Thread
from typing import Any, Protocol

import numpy as np

from .. import __version__
from ..common.arrays import Array
from ..common.brief import write_brief
from ..common.crowd import DiedError, run_all
from ..common.errors import InputError
from ..common.journal import Journal
from ..policy.policy import Policy
from ..problem.definition import Problem
from ..results.narrow import Torques, adopt_motion, require_same_phases
from .sensitivity import Sensitivities, measure_sensitivities
from .statistics import Share, count_share
from .trial import Trial, make_trial
from .uncertainty import Uncertainty

Task = tuple[int, tuple[float, ...]]
"""Number and values of a sample."""
DRAWN = 200
"""Samples whose paths are kept, for figures."""


@dataclass(frozen=True, eq=False)
class Robustness:
    """What a plan bears.

    Attributes
    ----------
    trial : Trial
    samples : ndarray, shape (n, len(varied) + 1)
        As `Uncertainty.draw` gives them.
    seed : int
    records : tuple of dict
        As `Trial.run` gives them, in the order of the samples.
    """

    trial: Trial
    samples: Array
    seed: int
    records: tuple[dict[str, Any], ...]

    @cached_property
    def nominal(self) -> dict[str, Any]:
        """The record without anything that is off."""
        return self.trial.change({})

    @cached_property
    def sensitivities(self) -> Sensitivities:
        """What the least normal force of the motion depends on; nothing with a policy."""
        if self.trial.policy is not None:
            return Sensitivities("", math.nan, math.nan, ())
        return measure_sensitivities(self.trial)

    __repr__ = write_brief

    @property
    def headline(self) -> str:
        """What it is, in a line."""
        count = len(self.records)
        return f"{count} samples, goal reached {self.reached}, contacts kept {self.kept}"

    @property
    def reached(self) -> Share:
        """How many reach the goal, as near as the uncertainty says."""
        return count_share(sum(own["reached"] for own in self.records), len(self.records))

    @property
    def kept(self) -> Share:
        """How many reach it and keep all planned contacts."""
        good = sum(own["reached"] and own["kept"] for own in self.records)
        return count_share(good, len(self.records))

    @property
    def first_lost(self) -> dict[str, Share]:
        """Which contact goes first, by number of the phase and name, the most frequent first."""
        names = Counter(_name_loss(own) for own in self.records if own["lost"])
        return {name: count_share(n, len(self.records)) for name, n in names.most_common()}


def _name_loss(record: dict[str, Any]) -> str:
    phase = record.get("phase")
    return record["lost"] if phase is None else f"{record['lost']} in phase {phase}"


def assess_robustness(
    problem: Problem,
    plan: Torques,
    *,
    samples: int = 1000,
    seed: int = 0,
    uncertainty: Uncertainty | None = None,
    phase: int | None = None,
    policy: Policy | None = None,
    path: str | os.PathLike[str] | None = None,
    fresh: bool = False,
    start: Callable[[], Executor] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Robustness:
    """Replay a plan with numbers that are off, free of assumptions, and count what becomes of it.

    Parameters
    ----------
    problem : Problem
    plan : Plan or Trajectory
    samples : int
    seed : int
        Of the samples, a Latin hypercube of all ranges.
    uncertainty : Uncertainty, optional
        The ranges; those of the problem, or their defaults, if left out.
    phase : int, optional
        Number of the only phase that is tried, from its planned start at rest.
    policy : Policy, optional
        What carries the plan out, by feedback from the joints.
    path : path, optional
        File to which results are written one by one. A study that is there already goes on where it
        was stopped, and ends the same to the last bit, unless it is to be `fresh`.
    start : callable, optional
        Makes a `concurrent.futures.Executor`, anew when its workers have died; processes on all
        cores if left out.
    progress : callable, optional

    Raises
    ------
    InputError
        If the plan has no such phase, or the file cannot be written.
    """
    problem, trajectory = adopt_motion(problem, plan)
    if isinstance(samples, bool) or not isinstance(samples, int) or samples < 1:
        raise InputError("", "samples", f"{samples!r} given; allowed are 1 and more")
    require_same_phases(problem, trajectory)
    own = uncertainty or Uncertainty(problem.ranges)
    trial = make_trial(problem, trajectory, own, phase, policy)
    drawn = own.draw(samples, seed)
    stamp = _stamp(trial, samples, seed)
    journal = None if path is None else Journal(os.fspath(path), stamp, fresh)
    found = {} if journal is None else {own["sample"]: own for own in journal.records}
    tasks = ((k, tuple(drawn[k].tolist())) for k in range(samples) if k not in found)
    good = sum(own["reached"] for own in found.values())
    for record in list_records(trial, tasks, start or use_processes):
        found[record["sample"]] = record
        good += record["reached"]
        if journal is not None:
            journal.add(record)
        if progress is not None:
            progress(f"{len(found)} of {samples} samples, {good} reach the goal")
    records = tuple(found[number] for number in range(samples))
    return Robustness(trial, drawn, seed, records)


class Runs(Protocol):
    """What runs a sample, here or in another process."""

    def run(self, sample: Array) -> dict[str, Any]:
        """What becomes of a sample, as plain values; as of `Trial`."""


def list_records(
    trial: Runs, tasks: Iterable[Task], start: Callable[[], Executor]
) -> Iterator[dict[str, Any]]:
    """Records as they come; a sample that workers die of has one that says so."""
    for (number, _), answer in run_all(partial(_run, trial), tasks, start):
        if isinstance(answer, DiedError):
            answer = {"ended": str(answer), "reached": False, "kept": False, "lost": "worker"}
        elif isinstance(answer, Exception):
            raise answer
        yield {"sample": number, **answer}


def _run(trial: Runs, task: Task) -> dict[str, Any]:
    number, sample = task
    record = trial.run(np.array(sample))
    if number >= DRAWN:
        record.pop("path", None)
    return record


def use_processes(jobs: int | None = None) -> Executor:
    """Processes of one thread each, on all cores or as many as `jobs` says."""
    return ProcessPoolExecutor(jobs or os.cpu_count(), get_context("spawn"), _end_with_parent)


def _end_with_parent() -> None:
    """Have this process end when the one that started it is killed, and can tell it no more."""
    parent = parent_process()
    if parent is not None:

        def watch() -> None:
            wait([parent.sentinel])
            os._exit(1)

        Thread(target=watch, daemon=True).start()


def _stamp(trial: Trial, samples: int, seed: int) -> dict[str, Any]:
    """What records belong to: another plan, range or version makes them another study's."""
    known = [trial.torque.breaks, trial.torque.coefficients, trial.state]
    if trial.policy is not None:
        known += [part for tables in trial.policy.tables for part in tables.values()]
        known.append(np.array([*trial.policy.pace[:-1], float(trial.policy.sensor)]))
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in known))
    return {
        "study": "robustness",
        "version": __version__,
        "problem": trial.problem.table,
        "plan": digest.hexdigest(),
        "phases": [own.phase for own in trial.windows],
        "widths": trial.uncertainty.widths,
        "sample_rate": trial.uncertainty.sample_rate,
        "tolerance": trial.uncertainty.tolerance,
        "goal": [trial.uncertainty.distance, trial.uncertainty.angle],
        "samples": samples,
        "seed": seed,
    }
